"""Persistence across restarts."""
