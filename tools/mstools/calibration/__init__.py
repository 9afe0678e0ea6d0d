"""Calibration of inertial sensors and magnetometers from recordings. Pure."""

from modelserver.errors import ModelServerError


class CalibrationError(ModelServerError, ValueError):
    """The samples do not determine the result; the message states what is missing and what to do."""
