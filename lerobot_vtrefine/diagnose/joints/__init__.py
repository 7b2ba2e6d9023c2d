"""What the simulation gets wrong about a robot's joints: servo model, causes, evidence."""
