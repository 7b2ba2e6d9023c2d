"""Console entry points: thin wrappers that parse options and call the library.

Importing this package, which every command does first, tells OpenMP how long its threads spin while they
wait. By default that is milliseconds, so that a thread which waits for another one keeps the core that the
other one needs as soon as any other process runs; once PyTorch is loaded it is too late to say.
"""

import os

SPIN_VARIABLE = "GOMP_SPINCOUNT"
SPINS = 1000
"""Rounds, some microseconds: what GNU OpenMP itself takes where it knows of more threads than cores."""

if "OMP_WAIT_POLICY" not in os.environ:
    os.environ.setdefault(SPIN_VARIABLE, str(SPINS))
