"""CAN: frames, DBC databases, and the mapping of their signals to this vehicle."""
