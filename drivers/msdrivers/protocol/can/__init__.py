"""CAN: frames, what a DBC file says of them, and which signal of it is what for this vehicle."""
