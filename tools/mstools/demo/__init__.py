"""The demo: its processes, its drive, its lines on the screen."""
