"""Datasets of others as LeRobotDatasets with this project's features."""
