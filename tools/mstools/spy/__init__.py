"""Channels decoded for watching: in the terminal, or for lcm-spy."""
