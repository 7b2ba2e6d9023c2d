"""Many presses through the simulator's stages at once, in double precision, for fitting."""
