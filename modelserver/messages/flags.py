"""Enumerations and flags, with the numbers of the wire types."""

from __future__ import annotations

import math
from enum import IntFlag

NAN = math.nan


class Invalid(IntFlag):
    """Reasons why a pose may not be used; 0 = it may."""

    NO_FIX = 1
    NO_IMU = 2
    NO_ORIGIN = 4
    NOT_MOVED_YET = 8
    STATIONARY_HEADING = 16
    STALE_GPS = 32
    STALE_IMU = 64
    GPS_REJECTED = 128
    LIMIT_EXCEEDED = 256
    CLOCK_STEPPED = 512
    TILTED = 1024
    STALE_JOINT = 2048
    JOINT_UNKNOWN = 4096
    GNSS_INCONSISTENT = 8192
    MISMOUNTED = 16384

    def explain(self) -> str:
        """Return the reasons in words; empty where there is none."""
        return "; ".join(_INVALID_TEXT[flag] for flag in Invalid if flag in self)


_INVALID_TEXT = {
    Invalid.NO_FIX: "no usable GPS fix yet",
    Invalid.NO_IMU: "no inertial sample yet",
    Invalid.NO_ORIGIN: "the origin is not set yet, still averaging fixes",
    Invalid.NOT_MOVED_YET: "heading is not known before the vehicle moves",
    Invalid.STATIONARY_HEADING: "stationary for too long, the heading has drifted",
    Invalid.STALE_GPS: "the last usable GPS fix is too old",
    Invalid.STALE_IMU: "the last usable inertial sample is too old",
    Invalid.GPS_REJECTED: "GPS fixes arrive but are rejected",
    Invalid.LIMIT_EXCEEDED: "the error may be beyond the limit: that is more probable than 0.01",
    Invalid.CLOCK_STEPPED: "the clock stepped, localization restarts at the new time",
    Invalid.TILTED: "gravity indicates a vehicle on its side: check the mount of the IMU in the geometry",
    Invalid.STALE_JOINT: "a joint on the path was silent around that time",
    Invalid.JOINT_UNKNOWN: "no sample of a joint on the path was received, and the geometry has no default for it",
    Invalid.GNSS_INCONSISTENT: "GPS fixes and the path driven contradict each other",
    Invalid.MISMOUNTED: "the IMU's accelerations do not fit the wheels: its mount, or the wheels' signs, are wrong",
}


class Quality(IntFlag):
    """Properties of a pose that is usable but limited."""

    HEADING_FROM_GYRO = 1
    PREDICTED = 2
    INTERPOLATED = 4
    HELD = 8
    CORRELATION_UNKNOWN = 16
    REVERSING = 32
    OUT_OF_LIMITS = 64
    JOINT_DEFAULT = 128
    LOOP = 256

    def explain(self) -> str:
        """Return the flags in words; empty where there is none."""
        return "; ".join(_QUALITY_TEXT[flag] for flag in Quality if flag in self)


_QUALITY_TEXT = {
    Quality.HEADING_FROM_GYRO: "heading is propagated by the gyro alone",
    Quality.PREDICTED: "predicted past the last sample",
    Quality.INTERPOLATED: "between two samples",
    Quality.HELD: "the last value known before",
    Quality.CORRELATION_UNKNOWN: "the covariance is an upper bound",
    Quality.REVERSING: "the vehicle is assumed to drive backwards",
    Quality.OUT_OF_LIMITS: "a joint on the path is beyond its limits",
    Quality.JOINT_DEFAULT: "no sample of a joint on the path was received; its position is assumed",
    Quality.LOOP: "the loop of constraints has another path; this is the shortest",
}


class Unmet(IntFlag):
    """What an answer lacks of the demand in its request; 0 = all that was asked for is met."""

    HORIZONTAL = 1
    HEADING = 2
    AGE = 4
    NOT_VALID = 8


STALE_SENSORS = Invalid.STALE_GPS | Invalid.STALE_IMU
"""Reasons that sensors which stopped sending have."""

VALID = Invalid(0)
NO_FLAGS = Quality(0)
MET = Unmet(0)
