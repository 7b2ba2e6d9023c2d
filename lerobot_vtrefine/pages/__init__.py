"""What all report pages share: the base template with one look, pads in one colour map, embedded pictures."""
