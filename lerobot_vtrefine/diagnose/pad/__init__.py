"""Tactile pads: presses of an indenter are trials, and one channel holds all taxels."""
