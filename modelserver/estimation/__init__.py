"""Localization: estimates the vehicle's pose and its uncertainty from sensor samples. Pure."""
