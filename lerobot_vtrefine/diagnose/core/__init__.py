"""The method, whatever is diagnosed: T trials of J channels, a baseline, candidates, and what they explain.

Lock recordings away, fit the baseline, search forward by cross-validated gain with sign flips, drop what is
not needed, ask what else would explain it and whether something is left, and measure on the locked ones.
"""
