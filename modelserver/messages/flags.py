"""Enumerations and flags, with the numbers of the wire types."""

from __future__ import annotations

import math
from enum import IntEnum, IntFlag

NAN = math.nan


class FixType(IntEnum):
    """What a fix rests on."""

    NONE = 0
    FIX_2D = 1
    FIX_3D = 2
    DIFFERENTIAL = 3
    RTK_FLOAT = 4
    RTK_FIXED = 5
    DEAD_RECKONING = 6


class OrientationReference(IntEnum):
    """What an inertial unit's own orientation is measured against."""

    NONE = 0
    ENU = 1
    NED = 2


class YawSource(IntEnum):
    """Where an inertial unit's own yaw comes from."""

    NONE = 0
    MAGNETIC = 1
    TRUE = 2


class Direction(IntEnum):
    """Which way a wheel turns, as its encoder tells."""

    BACKWARD = -1
    STOPPED = 0
    FORWARD = 1
    UNKNOWN = 2
    UNSIGNED = 3


class VehicleMode(IntEnum):
    """Who drives; the numbers are those of the wire, MODE_UNKNOWN and so on."""

    UNKNOWN = 0
    MANUAL = 1
    AUTONOMOUS = 2
    EMERGENCY_STOP = 3
    FAULT = 4


class Policy(IntEnum):
    """What a question about a time accepts for an answer."""

    INTERPOLATED = 0
    LATEST = 1
    HELD = 2
    PREDICTED = 3


class Invalid(IntFlag):
    """Why a pose may not be used; 0 = it may."""

    NO_FIX = 1
    NO_IMU = 2
    NO_ORIGIN = 4
    NOT_MOVED_YET = 8
    STATIONARY_HEADING = 16
    STALE_GPS = 32
    STALE_IMU = 64
    GPS_REJECTED = 128
    BOUND_EXCEEDED = 256
    CLOCK_STEPPED = 512
    TILTED = 1024
    STALE_JOINT = 2048
    JOINT_UNKNOWN = 4096

    def explain(self) -> str:
        """Return the reasons in words; empty where there is none."""
        return "; ".join(_INVALID_TEXT[flag] for flag in Invalid if flag in self)


_INVALID_TEXT = {
    Invalid.NO_FIX: "no usable GPS fix yet",
    Invalid.NO_IMU: "no inertial sample yet",
    Invalid.NO_ORIGIN: "the origin is not set yet, still averaging fixes",
    Invalid.NOT_MOVED_YET: "heading is not known before the vehicle moves",
    Invalid.STATIONARY_HEADING: "standing too long, the heading has drifted",
    Invalid.STALE_GPS: "the last usable GPS fix is too old",
    Invalid.STALE_IMU: "the last inertial sample is too old",
    Invalid.GPS_REJECTED: "GPS fixes arrive but are refused",
    Invalid.BOUND_EXCEEDED: "a protection bound passes the configured limit",
    Invalid.CLOCK_STEPPED: "the clock stepped, time is being taken up anew",
    Invalid.TILTED: "gravity says that the vehicle lies on its side: check the inertial unit's mount in the geometry",
    Invalid.STALE_JOINT: "a joint on the way was silent around that time",
    Invalid.JOINT_UNKNOWN: "a joint on the way was never heard, and the geometry states no default for it",
}


class Quality(IntFlag):
    """What a user of a pose should know although it may be used."""

    HEADING_FROM_GYRO = 1
    PREDICTED = 2
    INTERPOLATED = 4
    HELD = 8
    CORRELATION_UNKNOWN = 16
    REVERSING = 32
    OUT_OF_LIMITS = 64
    AT_REST = 128
    LOOP = 256

    def explain(self) -> str:
        """Return the flags in words; empty where there is none."""
        return "; ".join(_QUALITY_TEXT[flag] for flag in Quality if flag in self)


_QUALITY_TEXT = {
    Quality.HEADING_FROM_GYRO: "heading is carried by the gyro",
    Quality.PREDICTED: "predicted past the last sample",
    Quality.INTERPOLATED: "between two samples",
    Quality.HELD: "the last value known before",
    Quality.CORRELATION_UNKNOWN: "the covariance is an upper bound",
    Quality.REVERSING: "the vehicle is taken to drive backwards",
    Quality.OUT_OF_LIMITS: "a joint on the way stands beyond its limits",
    Quality.AT_REST: "a joint on the way was never heard; it is taken to stand at its default",
    Quality.LOOP: "there is another way round; this is the shortest",
}


SILENCE = Invalid.STALE_GPS | Invalid.STALE_IMU
"""What speaks against a pose because sensors have fallen silent."""

VALID = Invalid(0)
NO_FLAGS = Quality(0)
