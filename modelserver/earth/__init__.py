"""The earth: ellipsoid and UTM, gravity and rotation, magnetic field."""
