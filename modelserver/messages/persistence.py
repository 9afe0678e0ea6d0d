"""State of localization that persists across restarts, for a warm start. Values only; files: `server.persistence`."""

from __future__ import annotations

from typing import NamedTuple

from modelserver.transforms.so3 import Quaternion, Vector3


class PersistedPose(NamedTuple):
    """Pose of a stationary vehicle, persisted only while it is valid.

    `latitude_deg`, `longitude_deg`, `height` (ellipsoidal, m) locate the origin of the tangent plane N. `position` (m)
    is that of the IMU in N, `attitude` the quaternion from body to N axes. `correlated_error` (m along N) is the
    time-correlated GNSS error contained in the pose, `correlated_error_variance` (m2) the variance it adds; `allowance`
    (m) and `gnss_noise_inflation` as in the filter's state. `fix_utime` is the last fix that was used or confirmed, 0 =
    none; `confirmed` counts them. `wheels` holds the distance travelled of each wheel by name (m), from sample
    `wheels_seq` of `wheels_source`.
    """

    latitude_deg: float
    longitude_deg: float
    height: float
    position: Vector3
    attitude: Quaternion
    correlated_error: Vector3
    correlated_error_variance: Vector3
    allowance: float
    gnss_noise_inflation: float
    fix_utime: int
    confirmed: int
    pose_epoch: int
    wheels_source: str = ""
    wheels_seq: int = 0
    wheels: tuple[tuple[str, float], ...] = ()


class PersistedState(NamedTuple):
    """State that one run of the service leaves to the next. Numbers are finite; SI units, body axes.

    `utime` and `monotonic_ns` are the host's clocks when it was saved, `boot` the boot id that the monotonic clock
    counts from, empty = not known. `setup` identifies mounts, kinematics and error states that the numbers depend on.
    `sensor_utime` is the instant of the newest measurement. `names` (n) are the error states; `gyro_bias` (rad/s),
    `accelerometer_bias` (m/s2) and `extras` (those after the strapdown's 15) their estimates, `covariance` (n x n,
    row-major) that of their errors.
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
    pose: PersistedPose | None = None


class RestoredState(NamedTuple):
    """State of the previous run and its age (s), or the reason why there is none.

    A pose older than `max_pose_age` and biases older than `max_age`, seconds, are not used.
    """

    state: PersistedState | None = None
    age: float = 0.0
    reason: str = ""
    max_pose_age: float = 20.0
    max_age: float = 86400.0
