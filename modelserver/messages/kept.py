"""What is worth keeping of localization when the service ends, and what a start recalls of it. Values, no files."""

from __future__ import annotations

from typing import NamedTuple

from modelserver.spatial.so3 import Quaternion, Vector3


class KeptPose(NamedTuple):
    """Where the vehicle stood: it is kept only of one that stood, and whose pose was valid.

    `latitude_deg`, `longitude_deg`, `height` (ellipsoidal, metres) are the place of the tangent plane N, in which
    `position` (m) is that of the inertial unit's point and `attitude` turns the body's axes to N's. `shown` is how far
    the pose goes with what lingers in fixes, metres along N, `doubt` the variance that this adds (m2), `allowance`
    (m) and `restless` see the filter's state. `fix_utime` is the last fix that was used or confirmed, 0: none;
    `confirmed` counts them. `wheels` are the ways that the wheels had told, by name, in metres, with the source and the
    number of that sample.
    """

    latitude_deg: float
    longitude_deg: float
    height: float
    position: Vector3
    attitude: Quaternion
    shown: Vector3
    doubt: Vector3
    allowance: float
    restless: float
    fix_utime: int
    confirmed: int
    pose_epoch: int
    wheels_source: str = ""
    wheels_seq: int = 0
    wheels: tuple[tuple[str, float], ...] = ()


class Kept(NamedTuple):
    """What one run of the service leaves to the next. Numbers are finite; SI units, body axes.

    `vehicle` is its name, `utime` the host's time of day when this was told, `monotonic_ns` its monotonic clock and
    `boot` the name of the boot that clock counts from, empty where nobody knows. `setup` stands for all that the
    numbers rest on: mounts, kinematics, error states. `sensor_utime` is the instant of the newest measurement in it.
    `names` (n) are the error states; `gyro_bias` (rad/s), `accelerometer_bias` (m/s2) and `extras` (those after the
    strapdown's 15) their estimates, `covariance` (n x n, row-major) that of their errors.
    """

    vehicle: str
    utime: int
    monotonic_ns: int
    boot: str
    setup: str
    sensor_utime: int
    names: tuple[str, ...]
    gyro_bias: Vector3
    accelerometer_bias: Vector3
    extras: tuple[float, ...]
    covariance: tuple[float, ...]
    pose: KeptPose | None = None


class Recalled(NamedTuple):
    """What a start knows of the run before: what it kept and how old that is (s), or why nothing is known.

    `pose_age` and `most_age` are the greatest ages, seconds, at which a kept pose and the rest are used.
    """

    kept: Kept | None = None
    age: float = 0.0
    why: str = ""
    pose_age: float = 20.0
    most_age: float = 86400.0
