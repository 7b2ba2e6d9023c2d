"""What episodes say about the parts in the hands: mass, friction, clearance, by replay through the twin."""
