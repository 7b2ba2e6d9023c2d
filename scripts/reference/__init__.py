"""Published work that this package is compared with.

The reference implementation of DPPO (``checkout.py``) meets ours on Hopper and on insertion tasks; BAM's
friction models (``bam_ladder.py``) meet ``vtrefine-diagnose``.
"""
