"""Every threshold of a single servo's diagnosis, once, with its reason; the method's are in `core.rules`."""

MIN_SETTINGS = 3
"""With so many settings (gain, supply, load), folds are settings: a simulation is to predict new ones."""
MIN_REPEATED = 4
"""Repeated conditions that a test of what repeats takes."""
ALARM_STEP = 0.5
"""Part of the encoder's step below which nothing that repeats is worth an alarm."""
