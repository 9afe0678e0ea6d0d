"""Joint states over time: the readings of each coordinate, interpolated, held or predicted."""
