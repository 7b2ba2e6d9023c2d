"""Feature names and shapes, and helpers around LeRobot datasets."""
