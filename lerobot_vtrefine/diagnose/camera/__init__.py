"""What depth images say about the camera: its pose and the scale of its depths, against the twin's arms."""
