"""Queries: where a frame is in another at a time, from geometry, joints and the vehicle's estimates. Pure."""
