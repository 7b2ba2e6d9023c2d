"""Parts of ``compare_reality.py``."""
