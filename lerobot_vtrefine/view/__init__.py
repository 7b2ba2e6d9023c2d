"""Live pictures of a simulation."""
