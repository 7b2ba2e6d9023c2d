"""Presses of a pad with hidden effects, by an author who had seen the file formats and the physics alone.

He had seen neither the engine nor its other benchmarks, and nothing here is to be tuned to the engine: the code
stands as he wrote it, but for imports. Every effect has a plain form, several others, and a size that takes
away a requested part of the squared error of the best spring and damper.
"""
