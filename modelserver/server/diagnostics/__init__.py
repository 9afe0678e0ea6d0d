"""Diagnostics of bus, host clock, machine and other servers."""
