"""Editing a geometry file: its text, what is in it, and the session that checks and saves."""
