"""The server: bus, clocks, loop, requests, journal, persistence and daemon around the pure core."""
