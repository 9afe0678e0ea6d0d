"""Motion: dead reckoning of the base frame in Odom by angular rate and speed. It never jumps.

Attitude is yaw in Odom and the vertical u along the base frame's axes; with R = Rz(yaw) Ry(pitch) Rx(roll),
u = R' z = (-sin pitch, cos pitch sin roll, cos pitch cos roll). With the angular rate w along the same axes

    u' = -w x u,   yaw' = (w_y u_y + w_z u_z) / (u_y^2 + u_z^2)                                                 (1)

the latter being (w_y sin roll + w_z cos roll) / cos pitch. Position follows the speed along the heading; an interval of
constant speed and rate is an arc, whose chord points along its middle heading.

Roll and pitch: an IMU that reports its orientation gives u itself; its yaw is magnetic or drifts, and is ignored.
Else the specific force f corrects u. f = a - g, so u ~ f - a; of the acceleration a of the IMU the centripetal part
w x (v + w x r) is known, with v along the base frame's x and r the lever arm of the IMU. It is used while |f - a| is
near g (complementary filter: R. Mahony et al., "Nonlinear complementary filters on the special orthogonal group",
2008).

After `rate_hold` without a sample the turn stops; speed is held for `gps_timeout` after its fix, and decays with the
same time constant. Both are closed forms of time: one long step and many short ones end at the same place.

Limits: pitch below 84 degrees; the base frame moves along its own x.
Read top-down: `read_raw_imu` -> `correct_up` -> `RawMotion.propagate`.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

from modelserver.estimation.filter.eskf import STANDARD_GRAVITY, ZERO
from modelserver.estimation.filter.imu_monitor import MAX_FORCE
from modelserver.estimation.raw.settings import RawSettings
from modelserver.messages import ImuSample, OrientationReference
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Quaternion, Vector3, cross

LEVEL: Final[Vector3] = (0.0, 0.0, 1.0)

MAX_PATH_TIME: Final = 60.0
"""Seconds of a gap that count in the path: no segment of fixes spans it, and a stamp may be wrong by years."""

MAX_RATE: Final = 50.0
"""rad/s: above the range of any gyro for a vehicle."""

GRAVITY_TOLERANCE: Final = 1.0
"""m/s2: a tenth of g."""


# --- IMU ----------------------------------------------------------------------------------------------------


class RawImuSample(NamedTuple):
    """Angular rate, specific force and the unit's own vertical along the base axes; None: not measured."""

    rate: Vector3
    force: Vector3 | None
    up: Vector3 | None


def read_raw_imu(sample: ImuSample, X_base_imu: Pose) -> RawImuSample | str:
    """Return the sample along the base axes, or in one word why it cannot be used.

    Unlike `imu_monitor.read_imu` it accepts a unit without accelerometers: rates alone give the heading.
    """
    rate, force = sample.angular_velocity, sample.specific_force
    if rate is None:
        return "nan"
    reason = _find_fault(rate, MAX_RATE) or ("" if force is None else _find_fault(force, MAX_FORCE))
    if reason:
        return reason
    mount = X_base_imu.wxyz
    if force is not None:
        force = so3.rotate(mount, force)
    up = _read_up(sample, mount)
    if up is not None and force is not None and _contradicts_gravity(up, force):
        return "orientation"
    return RawImuSample(so3.rotate(mount, rate), force, up)


def _find_fault(v: Vector3, most: float) -> str:
    if not math.isfinite(v[0] + v[1] + v[2]):
        return "nan"
    return "range" if max(map(abs, v)) > most else ""


def _read_up(sample: ImuSample, mount: Quaternion) -> Vector3 | None:
    """Return the vertical by the unit's orientation, along the base axes; None if it reports no valid one."""
    q, reference = sample.orientation, sample.orientation_reference
    if q is None or reference == OrientationReference.NONE:
        return None
    w, x, y, z = q
    n = w * w + x * x + y * y + z * z
    if not 0.81 < n < 1.21:
        return None
    # third row of R(q): the z axis of the reference along the sensor's axes; in NED it points down
    s = (-1.0 if reference == OrientationReference.NED else 1.0) / n
    up = (2.0 * s * (x * z - w * y), 2.0 * s * (y * z + w * x), s * (w * w - x * x - y * y + z * z))
    return so3.rotate(mount, up)


def _contradicts_gravity(up: Vector3, force: Vector3) -> bool:
    """Return whether the unit's own vertical and its specific force cannot both be right.

    If |f| is near g, they can be 60 degrees apart only under an acceleration of about g that happens to preserve |f|.
    No ground vehicle does that; a wrong orientation reference or a stuck accelerometer does.
    """
    norm = _compute_norm(force)
    if abs(norm - STANDARD_GRAVITY) > GRAVITY_TOLERANCE:
        return False
    return up[0] * force[0] + up[1] * force[1] + up[2] * force[2] < 0.5 * norm


def correct_up(
    up: Vector3, force: Vector3, rate: Vector3, speed: float, lever: Vector3, dt: float, settings: RawSettings
) -> Vector3:
    """Correct the vertical towards the specific force without the centripetal acceleration, if that is near g."""
    a, b, c = rate
    x, y, z = lever
    i, j, k = cross(rate, (speed + b * z - c * y, c * x - a * z, a * y - b * x))
    f = (force[0] - i, force[1] - j, force[2] - k)
    norm = _compute_norm(f)
    if abs(norm - STANDARD_GRAVITY) > settings.tilt_gate:
        return up
    gain = min(dt, settings.rate_hold) / (settings.tilt_time + dt) / norm
    keep = 1.0 - gain * norm
    return normalize_up((keep * up[0] + gain * f[0], keep * up[1] + gain * f[1], keep * up[2] + gain * f[2]))


def get_first_up(imu: RawImuSample) -> Vector3 | None:
    """Return the vertical by a first sample; None if it measures none."""
    if imu.up is not None or imu.force is None:
        return imu.up
    return normalize_up(imu.force) if 0.5 < _compute_norm(imu.force) / STANDARD_GRAVITY < 1.5 else None


# --- attitude -----------------------------------------------------------------------------------------------


def _compute_norm(v: Vector3) -> float:
    x, y, z = v
    return math.sqrt(x * x + y * y + z * z)


def normalize_up(v: Vector3) -> Vector3:
    """Return a vector at unit length; level if it has no length."""
    n = _compute_norm(v)
    return (v[0] / n, v[1] / n, v[2] / n) if 1e-9 < n < 1e150 else LEVEL


def _rotate_up(up: Vector3, rate: Vector3, dt: float) -> Vector3:
    """Propagate the vertical by equation (1): exp(-[w dt]x) u to second order, at unit length."""
    turn = (-rate[0] * dt, -rate[1] * dt, -rate[2] * dt)
    first = cross(turn, up)
    (x, y, z), (u, v, w), (i, j, k) = up, first, cross(turn, first)
    return normalize_up((x + u + 0.5 * i, y + v + 0.5 * j, z + w + 0.5 * k))


def compute_yaw_rate(rate: Vector3, up: Vector3) -> float:
    """Return the yaw rate by equation (1), rad/s."""
    _, b, c = up
    return (rate[1] * b + rate[2] * c) / max(b * b + c * c, 1e-2)


def compute_roll_pitch(up: Vector3) -> tuple[float, float]:
    """Return fixed-axis roll and pitch of a base frame with a vertical, rad."""
    return math.atan2(up[1], up[2]), math.atan2(-up[0], math.hypot(up[1], up[2]))


def compute_attitude(up: Vector3, yaw: float) -> Quaternion:
    """Return the rotation from the base axes to Odom."""
    return so3.from_rpy(*compute_roll_pitch(up), yaw)


def to_level_axes(up: Vector3, v: Vector3) -> Vector3:
    """Return a vector of the base axes along level axes of the same yaw: Ry(pitch) Rx(roll) v."""
    a, b, c = up
    cp = max(math.hypot(b, c), 1e-9)
    sr, cr, sp = b / cp, c / cp, -a
    down = sr * v[1] + cr * v[2]
    return (cp * v[0] + sp * down, cr * v[1] - sr * v[2], cp * down - sp * v[0])


# --- motion -------------------------------------------------------------------------------------------------


class RawMotion(NamedTuple):
    """The base frame in Odom at `utime`. A NamedTuple, because a new one is made for every IMU sample.

    Attributes
    ----------
    x, y, z: position, m.
    yaw: rad, not wrapped.
    up: vertical along the base axes.
    rate: angular rate along the base axes without bias, rad/s.
    path: integral of the unit vector along the heading, seconds: the position at a speed of 1 m/s.
    speed, speed_utime, speed_sigma: horizontal, negative in reverse, m/s, with the instant of its fix and its sigma.
    yaw_variance, position_variance: of the drift since the start of Odom (each horizontal axis), rad2 and m2.
    """

    utime: int
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    yaw: float = 0.0
    up: Vector3 = LEVEL
    rate: Vector3 = ZERO
    path: complex = 0j
    speed: float = 0.0
    speed_utime: int = 0
    speed_sigma: float = 0.0
    yaw_variance: float = 0.0
    position_variance: float = 0.0

    @property
    def pose(self) -> Pose:
        """The base frame in Odom."""
        return Pose((self.x, self.y, self.z), compute_attitude(self.up, self.yaw))

    @property
    def yaw_rate(self) -> float:
        """Yaw rate, rad/s."""
        return compute_yaw_rate(self.rate, self.up)

    def propagate(self, utime: int, rate: Vector3, settings: RawSettings) -> RawMotion:
        """Propagate to `utime` with the mean angular rate until then."""
        dt = (utime - self.utime) * 1e-6
        if dt <= 0.0:
            return self
        turning = min(dt, settings.rate_hold)
        gap = dt - turning
        up = _rotate_up(self.up, rate, turning)
        turn = compute_yaw_rate(rate, self.up) * turning
        yaw = self.yaw + turn
        half = 0.5 * turn
        chord = 1.0 - half * half / 6.0 if abs(half) < 1e-2 else math.sin(half) / half
        middle = self.yaw + half
        arc = complex(math.cos(middle), math.sin(middle)) * chord
        straight = complex(math.cos(yaw), math.sin(yaw)) if dt > turning else 0j
        first = self._compute_travel(0.0, turning, settings)
        rest = self._compute_travel(turning, dt, settings) if dt > turning else 0.0
        step = arc * first + straight * rest
        travel = first + rest
        sigma = self.speed_sigma
        # the error of a speed is correlated over about the segment of fixes that it was found from
        drifted = self.position_variance + sigma * sigma * dt * settings.speed_window
        return RawMotion(
            utime,
            self.x + step.real,
            self.y + step.imag,
            self.z + travel * up[0] / math.sqrt(max(1.0 - up[0] * up[0], 1e-2)),
            yaw,
            up,
            self.rate,
            self.path + arc * turning + straight * min(gap, MAX_PATH_TIME),
            self.speed,
            self.speed_utime,
            sigma,
            min(self.yaw_variance + settings.gyro_noise**2 * dt + (settings.gap_rate_sigma * gap) ** 2, 1e3),
            min(drifted + self.yaw_variance * travel * travel, 1e12),
        )

    def _compute_travel(self, start: float, end: float, settings: RawSettings) -> float:
        """Return the distance travelled between two times after `utime`, seconds."""
        speed = self.speed
        if speed == 0.0:
            return 0.0
        age = max((self.utime - self.speed_utime) * 1e-6, 0.0)
        hold = settings.gps_timeout
        if age + end <= hold:
            return speed * (end - start)
        return speed * (_integrate_decay(age + end, hold) - _integrate_decay(age + start, hold))


def _integrate_decay(age: float, hold: float) -> float:
    """Return the integral from 0 to `age` of 1, held for `hold` and then decaying with that time constant."""
    return age if age <= hold else hold + hold * -math.expm1((hold - age) / hold)


def interpolate_motion(a: RawMotion, b: RawMotion, utime: int) -> RawMotion:
    """Return the motion at an instant between two; speed and variances are those of the later one."""
    span = b.utime - a.utime
    if span <= 0:
        return b
    f = (utime - a.utime) / span

    def mix(p: float, q: float) -> float:
        return p + (q - p) * f

    def mix_vectors(p: Vector3, q: Vector3) -> Vector3:
        return (mix(p[0], q[0]), mix(p[1], q[1]), mix(p[2], q[2]))

    return b._replace(
        utime=utime,
        x=mix(a.x, b.x),
        y=mix(a.y, b.y),
        z=mix(a.z, b.z),
        yaw=mix(a.yaw, b.yaw),
        up=normalize_up(mix_vectors(a.up, b.up)),
        rate=mix_vectors(a.rate, b.rate),
        path=a.path + (b.path - a.path) * f,
    )
