"""Insertion tasks of this package, for both implementations of DPPO."""
