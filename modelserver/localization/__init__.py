"""Localization: from sensor samples to the vehicle's pose and how sure it is. Pure."""
