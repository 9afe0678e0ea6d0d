"""Joint states over time: the readings of each coordinate, and where it is between them."""
