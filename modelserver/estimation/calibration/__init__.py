"""Calibration of inertial sensors and magnetometers from recordings. Pure."""
