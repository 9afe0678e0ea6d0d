"""Emulators of devices: each a `Station` at the device's end of a line."""
