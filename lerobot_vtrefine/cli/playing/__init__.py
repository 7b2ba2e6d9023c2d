"""What `vtrefine-play` consists of."""
