"""Recording sets with known causes, made by code that shares nothing with the engine.

Only numpy, scipy, pyarrow and json: physics, motions, noise and file writing are written here a second time,
on a time grid finer than the frames, so that agreement with the engine means something.
"""
