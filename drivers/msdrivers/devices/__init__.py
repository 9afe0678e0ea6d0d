"""Drivers of devices: each an `Endpoint` at the host's end of a line."""
