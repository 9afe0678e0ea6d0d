"""Emulators of devices: each an `Endpoint` at the device's end of a line."""
