"""Calibration of an inertial unit and its magnetometer from a log."""
