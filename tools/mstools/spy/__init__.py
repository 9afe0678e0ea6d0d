"""Decoded traffic of all channels: in the terminal, or for lcm-spy."""
