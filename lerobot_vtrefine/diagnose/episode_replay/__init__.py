"""Recorded episodes replayed in the simulated twin, and what both sides measured."""
