"""Drivers of devices: each a `Station` at the host's end of a line."""
