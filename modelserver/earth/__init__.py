"""The earth: geodesy, gravity and rotation, magnetic field."""
