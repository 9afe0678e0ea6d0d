"""Motion: the base frame in Odom, carried on by rate and speed. It never jumps.

Attitude is kept as yaw in Odom and `up`, the vertical along the base frame's axes: with R = Rz(yaw) Ry(pitch)
Rx(roll), up = R' z = (-sin pitch, cos pitch sin roll, cos pitch cos roll). It obeys up' = -w x up, and the
yaw rate is yaw' = (w_y up_y + w_z up_z) / (up_y^2 + up_z^2), which is the usual (w_y sin roll + w_z cos roll)
/ cos pitch; w is the angular velocity along the base frame's axes.

What one inertial sample says, along the base frame's axes: angular velocity, and where up is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from modelserver.estimation.raw.settings import RawSettings
from modelserver.messages import ImuSample, OrientationReference
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Vector3

LEVEL: Vector3 = (0.0, 0.0, 1.0)

_MAX_PATH_TIME = 60.0
"""Seconds of a gap that the path counts: no stretch of fixes is drawn across it, and a stamp may be wild."""


@dataclass(frozen=True, slots=True)
class RawMotion:
    """The base frame in Odom at `utime`, and what carries it on.

    `rate` is the angular velocity along the base frame's axes, biases taken off, rad/s. `speed` is the
    horizontal speed along heading, negative backwards, m/s, as found at `speed_utime`. `path` is the integral
    over time of the unit vector along heading, seconds: what position would be at 1 m/s. `yaw` counts on past
    pi. `yaw_variance` and `position_variance` (each horizontal axis) have grown since Odom began.
    """

    utime: int
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    yaw: float = 0.0
    up: Vector3 = LEVEL
    rate: Vector3 = (0.0, 0.0, 0.0)
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
        """The rate of yaw, rad/s."""
        return compute_yaw_rate(self.rate, self.up)

    def advance(self, utime: int, rate: Vector3, settings: RawSettings) -> RawMotion:
        """Return the motion at `utime`, with `rate` the mean angular velocity until then.

        Turning stops after `rate_hold`: what a rate was tells little of what it is later. Speed is held for
        `gps_timeout` after the fix that gave it and then fades with the same time constant. Both are closed
        forms of time, so that one long step and many short ones end at one place.
        """
        dt = (utime - self.utime) * 1e-6
        if dt <= 0.0:
            return self
        turning = min(dt, settings.rate_hold)
        up = _rotate_up(self.up, rate, turning)
        wz = compute_yaw_rate(rate, self.up)
        turn = wz * turning
        yaw = self.yaw + turn
        # a stretch of constant speed and rate is an arc: its chord points along the mean heading
        half = 0.5 * turn
        chord = 1.0 - half * half / 6.0 if abs(half) < 1e-2 else math.sin(half) / half
        middle = self.yaw + half
        arc = complex(math.cos(middle), math.sin(middle)) * chord
        straight = complex(math.cos(yaw), math.sin(yaw)) if dt > turning else 0j
        first = self._compute_travel(0.0, turning, settings)
        rest = self._compute_travel(turning, dt, settings) if dt > turning else 0.0
        step = arc * first + straight * rest
        level = math.sqrt(max(1.0 - up[0] * up[0], 1e-2))
        gap = dt - turning
        sigma = self.speed_sigma
        way = first + rest
        # Motion(...) in full, here and below: dataclasses.replace costs five times as much
        return RawMotion(
            utime,
            self.x + step.real,
            self.y + step.imag,
            self.z + way * up[0] / level,
            yaw,
            up,
            self.rate,
            self.path + arc * turning + straight * min(gap, _MAX_PATH_TIME),
            self.speed,
            self.speed_utime,
            sigma,
            min(self.yaw_variance + settings.gyro_noise**2 * dt + (settings.gap_rate_sigma * gap) ** 2, 1e3),
            # the error of a speed lasts about as long as the fixes it came from
            min(
                self.position_variance + sigma * sigma * dt * settings.speed_window + self.yaw_variance * way * way,
                1e12,
            ),
        )

    def with_attitude(self, up: Vector3, rate: Vector3) -> RawMotion:
        """Return the motion with the vertical and the angular velocity that a sample said."""
        return RawMotion(
            self.utime,
            self.x,
            self.y,
            self.z,
            self.yaw,
            up,
            rate,
            self.path,
            self.speed,
            self.speed_utime,
            self.speed_sigma,
            self.yaw_variance,
            self.position_variance,
        )

    def _compute_travel(self, start: float, end: float, settings: RawSettings) -> float:
        """Return the way made between two times after `utime`, seconds, metres."""
        speed = self.speed
        if speed == 0.0:
            return 0.0
        age = max((self.utime - self.speed_utime) * 1e-6, 0.0)
        hold = settings.gps_timeout
        if age + end <= hold:
            return speed * (end - start)
        return speed * (_integrate_faded_speed(age + end, hold) - _integrate_faded_speed(age + start, hold))


def _integrate_faded_speed(age: float, hold: float) -> float:
    """Return the integral from 0 to `age` of a speed of 1 held for `hold` and then fading with that constant."""
    if age <= hold:
        return age
    return hold + hold * -math.expm1((hold - age) / hold)


def compute_yaw_rate(rate: Vector3, up: Vector3) -> float:
    """Return the rate of yaw of an angular velocity along base axes, rad/s."""
    _, b, c = up
    return (rate[1] * b + rate[2] * c) / max(b * b + c * c, 1e-2)


def _rotate_up(up: Vector3, rate: Vector3, dt: float) -> Vector3:
    """Return the vertical after turning by `rate` for `dt`: exp(-[w dt]x) up, to second order and unit again."""
    a, b, c = -rate[0] * dt, -rate[1] * dt, -rate[2] * dt
    x, y, z = up
    u, v, w = b * z - c * y, c * x - a * z, a * y - b * x
    return normalize_up((x + u + 0.5 * (b * w - c * v), y + v + 0.5 * (c * u - a * w), z + w + 0.5 * (a * v - b * u)))


def normalize_up(v: Vector3) -> Vector3:
    """Return `v` at unit length; straight up where it has none."""
    x, y, z = v
    n = math.sqrt(x * x + y * y + z * z)
    if not 1e-9 < n < 1e150:
        return LEVEL
    return (x / n, y / n, z / n)


def compute_attitude(up: Vector3, yaw: float) -> so3.Quaternion:
    """Return the quaternion of the base frame that has the vertical `up` and that yaw."""
    roll, pitch = compute_roll_pitch(up)
    return so3.from_rpy(roll, pitch, yaw)


def compute_roll_pitch(up: Vector3) -> tuple[float, float]:
    """Return the fixed-axis roll and pitch of a base frame that has the vertical `up`."""
    return math.atan2(up[1], up[2]), math.atan2(-up[0], math.hypot(up[1], up[2]))


def to_level_axes(up: Vector3, v: Vector3) -> Vector3:
    """Return a vector along base axes along level axes: Ry(pitch) Rx(roll) v."""
    a, b, c = up
    cp = max(math.hypot(b, c), 1e-9)
    sr, cr, sp = b / cp, c / cp, -a
    down = sr * v[1] + cr * v[2]
    return (cp * v[0] + sp * down, cr * v[1] - sr * v[2], cp * down - sp * v[0])


def interpolate_motion(a: RawMotion, b: RawMotion, utime: int) -> RawMotion:
    """Return the motion at `utime`, within the two."""
    span = b.utime - a.utime
    if span <= 0:
        return b
    f = (utime - a.utime) / span

    def mix(p: float, q: float) -> float:
        return p + (q - p) * f

    return replace(
        b,
        utime=utime,
        x=mix(a.x, b.x),
        y=mix(a.y, b.y),
        z=mix(a.z, b.z),
        yaw=mix(a.yaw, b.yaw),
        up=normalize_up((mix(a.up[0], b.up[0]), mix(a.up[1], b.up[1]), mix(a.up[2], b.up[2]))),
        rate=(mix(a.rate[0], b.rate[0]), mix(a.rate[1], b.rate[1]), mix(a.rate[2], b.rate[2])),
        path=a.path + (b.path - a.path) * f,
    )


STANDARD_GRAVITY = 9.80665
"""m/s2. The field differs from it by at most 0.05 over the Earth: far inside the gate."""

_MAX_RATE = 50.0
"""rad/s: above the range of any rate gyro fit for a vehicle."""
_MAX_FORCE = 500.0
"""m/s2: above the range of any accelerometer fit for a vehicle."""

_GRAVITY_TOLERANCE = 1.0
"""m/s2: a tenth of g."""


@dataclass(frozen=True, slots=True)
class RawImuSample:
    """An inertial sample along base axes. `up` is the device's own vertical, None where it gave none."""

    rate: Vector3
    force: Vector3 | None
    up: Vector3 | None


def read_raw_imu(sample: ImuSample, X_base_imu: Pose) -> RawImuSample | str:
    """Return the sample along base axes, or in one word why it cannot be used.

    Angular velocity is the same for every point of a rigid body, so only the mount's rotation counts. Of the
    device's orientation only the direction of gravity is used: its yaw is magnetic or drifts (report 7.2).
    """
    rate = sample.angular_velocity
    if rate is None or not math.isfinite(rate[0] + rate[1] + rate[2]):
        return "nan"
    if max(map(abs, rate)) > _MAX_RATE:
        return "range"
    mount = X_base_imu.wxyz
    force = sample.specific_force
    if force is not None:
        if not math.isfinite(force[0] + force[1] + force[2]):
            return "nan"
        if max(map(abs, force)) > _MAX_FORCE:
            return "range"
        force = so3.rotate(mount, force)
    up = _get_device_up(sample, mount)
    if up is not None and force is not None and _contradicts_gravity(up, force):
        return "orientation"
    return RawImuSample(so3.rotate(mount, rate), force, up)


def _contradicts_gravity(up: Vector3, force: Vector3) -> bool:
    """Return whether a device's own vertical and its specific force cannot both be right.

    Where |f| is near g, the two can be 60 degrees apart only under an acceleration of about g that happens to keep
    |f|: no ground vehicle does that, but a wrong orientation reference or a stuck accelerometer does.
    """
    norm = math.sqrt(force[0] ** 2 + force[1] ** 2 + force[2] ** 2)
    if abs(norm - STANDARD_GRAVITY) > _GRAVITY_TOLERANCE:
        return False
    return up[0] * force[0] + up[1] * force[1] + up[2] * force[2] < 0.5 * norm


def _get_device_up(sample: ImuSample, mount: so3.Quaternion) -> Vector3 | None:
    q = sample.orientation
    reference = sample.orientation_reference
    if q is None or reference == OrientationReference.NONE:
        return None
    w, x, y, z = q
    n = w * w + x * x + y * y + z * z
    if not 0.81 < n < 1.21:
        return None
    # third row of R(q): the reference's z axis along the sensor's axes; in NED that points down
    s = (-1.0 if reference == OrientationReference.NED else 1.0) / n
    return so3.rotate(
        mount, (2.0 * s * (x * z - w * y), 2.0 * s * (y * z + w * x), s * (w * w - x * x - y * y + z * z))
    )


def correct_up(
    up: Vector3, force: Vector3, rate: Vector3, speed: float, lever: Vector3, dt: float, settings: RawSettings
) -> Vector3:
    """Return the vertical carried by the gyro, drawn towards what specific force says; all along base axes.

    f = a - gravity, so up ~ f - a; of the acceleration a of the unit the centripetal part w x (v + w x r) is
    known, v along the base frame's x and r the unit's `lever` arm. Taken only while |f - a| is near g.
    (R. Mahony et al., "Nonlinear complementary filters on the special orthogonal group", 2008.)
    """
    a, b, c = rate
    x, y, z = lever
    u, v, w = speed + b * z - c * y, c * x - a * z, a * y - b * x
    fx, fy, fz = force[0] - (b * w - c * v), force[1] - (c * u - a * w), force[2] - (a * v - b * u)
    norm = math.sqrt(fx * fx + fy * fy + fz * fz)
    if abs(norm - STANDARD_GRAVITY) > settings.tilt_gate:
        return up
    gain = min(dt, settings.rate_hold) / (settings.tilt_time + dt) / norm
    keep = 1.0 - gain * norm
    return normalize_up((keep * up[0] + gain * fx, keep * up[1] + gain * fy, keep * up[2] + gain * fz))


def get_first_up(inertial: RawImuSample) -> Vector3 | None:
    """Return the vertical of a first sample, or None where it says nothing of it."""
    if inertial.up is not None:
        return inertial.up
    force = inertial.force
    if force is None:
        return None
    norm = math.sqrt(force[0] ** 2 + force[1] ** 2 + force[2] ** 2)
    return normalize_up(force) if 0.5 < norm / STANDARD_GRAVITY < 1.5 else None
