"""Policies that LeRobot finds by their registered type."""
