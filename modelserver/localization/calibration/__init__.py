"""Calibration: what recorded samples tell of an inertial unit, its noise, its magnetometer and its mount. Pure."""
