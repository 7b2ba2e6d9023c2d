"""What the simulation gets wrong about a single servo that swings a known load: motor, friction, drive."""
