"""Hopper, one of the reference's own tasks, for both implementations of DPPO."""
