"""The diagnosis of a LeRobot dataset: its robot, the parts in its hands, its camera, in one verdict."""
