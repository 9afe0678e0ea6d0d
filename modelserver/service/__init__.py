"""The daemon: bus, clocks, loop, and what it keeps across restarts."""
