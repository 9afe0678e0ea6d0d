"""The whole state of the localization filter: more than a pose, for those who want to look inside."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum
from typing import NamedTuple

from modelserver.messages.flags import Invalid
from modelserver.spatial.pose import Pose
from modelserver.spatial.so3 import Vector3


class Mode(IntEnum):
    """Which sources localization uses."""

    FULL = 0
    """All that are there."""
    RAW = 1
    """GPS and inertial unit straight, no filter (report 7.2)."""
    NO_IMU = 2
    NO_WHEELS = 3
    NO_GPS = 4
    """Neither GPS fixes nor velocities; other absolute sources count."""
    DEAD_RECKONING = 5
    """Inertial unit and wheels alone: nothing that knows of the world."""


class Phase(IntEnum):
    """How far the filter has come."""

    LEVELLING = 0
    """Finding which way is up, and the gyros' biases."""
    UNALIGNED = 1
    """Level and moving in Odom; heading in the world not known yet."""
    ALIGNED = 2
    """Known in the world."""


class SensorFinding(NamedTuple):
    """Why a configured sensor cannot be used, in whole or in part.

    `element` is the key of the vehicle file that it is about, `reason` a word for programs, `text` what is wrong and
    what follows, `fix` what to do. `sensor` is the sensor's key under `sensors`. `is_choice`: the vehicle file asks for
    it, e.g. by its mode.
    """

    sensor: str
    reason: str
    element: str
    text: str
    fix: str = ""
    is_choice: bool = False


class LocalizerSummary(NamedTuple):
    """The state of a localizer in short: `phase` is None in raw mode, `fix_utime` 0 before a fix was used.

    `findings` are the configured sensors that cannot be used now, and why.
    """

    mode: Mode
    phase: Phase | None = None
    standing: bool = False
    fix_utime: int = 0
    findings: tuple[SensorFinding, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class NavigationState:
    """The filter's state at `utime`, the instant of the newest measurement in it.

    `pose` is the rolling frame's in a tangent plane (east, north, up) near the vehicle, whose origin is at
    `latitude_deg`, `longitude_deg`, `height` (nan: not known yet). `linear_velocity` and `angular_velocity` are of the
    rolling frame relative to the ground, along its own axes (m/s, rad/s); `twist_covariance` is their 6 x 6, row-major.
    `names` (n) name the error states, e.g. position_east, gyro_bias_x, wheel_scale; `values` (n) are the estimates
    (rotations: fixed-axis roll, pitch, yaw), `covariance` (n x n, row-major) that of their errors. SI, radians.
    """

    utime: int
    mode: Mode
    phase: Phase
    standing: bool
    invalid: Invalid
    pose_epoch: int
    latitude_deg: float
    longitude_deg: float
    height: float
    pose: Pose
    linear_velocity: Vector3
    angular_velocity: Vector3
    twist_covariance: tuple[float, ...] = field(repr=False)
    names: tuple[str, ...]
    values: tuple[float, ...]
    covariance: tuple[float, ...] = field(repr=False)
