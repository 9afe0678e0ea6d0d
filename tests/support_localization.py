"""Simulated vehicle for the localization tests: truth by fine integration, sensors by numerical differences.

It uses only the messages and the mounts of the localizer, so that its truth is independent.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from modelserver.earth.geodesy import Geodesy, origin_at
from modelserver.estimation.raw.localizer import RawLocalizer
from modelserver.estimation.sensor_rig import Mounts
from modelserver.messages import FixType, GpsSample, ImuSample, OrientationReference, SensorHeader
from modelserver.transforms import Pose, so3

START = 1_700_000_000_000_000
ORIGIN = origin_at(50.27, -111.1, 700.0)
GEODESY = Geodesy(ORIGIN)
MOUNTS = Mounts(
    X_base_imu=Pose.from_rpy((0.3, -0.1, 0.2), math.pi, 0.0, 0.5),
    X_base_antenna=Pose((-0.4, 0.25, 1.2)),
)
GRAVITY = 9.80665


def constant(value: float) -> Callable[[float], float]:
    return lambda t: value


def stepwise(*pieces: tuple[float, float]) -> Callable[[float], float]:
    """Return a function of time with the value of the last piece (start, value) that has started."""

    def value(t: float) -> float:
        found = 0.0
        for start, v in pieces:
            if t >= start:
                found = v
        return found

    return value


@dataclass
class Drive:
    """True motion of the base frame in the tangent plane at ORIGIN: speed along heading, yaw rate, roll and pitch."""

    seconds: float
    speed: Callable[[float], float] = field(default_factory=lambda: constant(0.0))
    yaw_rate: Callable[[float], float] = field(default_factory=lambda: constant(0.0))
    yaw: float = 0.7
    roll: Callable[[float], float] = field(default_factory=lambda: constant(0.0))
    pitch: Callable[[float], float] = field(default_factory=lambda: constant(0.0))

    def __post_init__(self) -> None:
        self._poses: dict[int, Pose] = {}
        dt = 1e-3
        self.t = np.arange(-0.1, self.seconds + 0.2, dt)
        v = np.array([self.speed(t) for t in self.t])
        w = np.array([self.yaw_rate(t) for t in self.t])
        self.yaws = self.yaw + np.concatenate([[0.0], np.cumsum((w[1:] + w[:-1]) / 2 * dt)])
        vx, vy = v * np.cos(self.yaws), v * np.sin(self.yaws)
        self.x = np.concatenate([[0.0], np.cumsum((vx[1:] + vx[:-1]) / 2 * dt)])
        self.y = np.concatenate([[0.0], np.cumsum((vy[1:] + vy[:-1]) / 2 * dt)])

    def pose(self, t: float) -> Pose:
        """Return the true pose in the tangent plane, `t` seconds after START."""
        # a sample also needs the poses around it, which are those of its neighbors
        nanoseconds = round(t * 1e9)
        found = self._poses.get(nanoseconds)
        if found is None:
            found = self._poses[nanoseconds] = self._pose(nanoseconds * 1e-9)
        return found

    def _pose(self, t: float) -> Pose:
        x, y, yaw = (float(np.interp(t, self.t, each)) for each in (self.x, self.y, self.yaws))
        return Pose.from_rpy((x, y, 0.0), self.roll(t), self.pitch(t), yaw)

    def at(self, utime: int) -> Pose:
        return self.pose((utime - START) * 1e-6)


@dataclass
class Sensors:
    """Rates, noise and biases of the sensors; sigmas in meters, m/s, rad/s, m/s2."""

    gps_hz: float = 5.0
    gps_sigma: float = 0.5
    gps_noise: float | None = None
    velocity_sigma: float | None = 0.1
    imu_hz: float = 25.0
    gyro_noise: float = 0.002
    gyro_bias: tuple[float, float, float] = (0.004, -0.003, 0.005)
    force_noise: float = 0.05
    orientation: OrientationReference = OrientationReference.NONE
    seed: int = 1

    def events(self, drive: Drive, mounts: Mounts = MOUNTS) -> list[GpsSample | ImuSample]:
        """Return all samples in the order of their instants."""
        rng = random.Random(self.seed)
        n_imu, n_gps = int(drive.seconds * self.imu_hz), int(drive.seconds * self.gps_hz)
        samples: list[GpsSample | ImuSample] = [self.imu(drive, i / self.imu_hz, i, rng, mounts) for i in range(n_imu)]
        samples += [self.gps(drive, (i + 0.37) / self.gps_hz, i, rng, mounts) for i in range(n_gps)]
        return sorted(samples, key=lambda sample: sample.header.utime)

    def imu(self, drive: Drive, t: float, seq: int, rng: random.Random, mounts: Mounts = MOUNTS) -> ImuSample:
        h = 0.02
        before, now, after = ((drive.pose(t + d) @ mounts.X_base_imu) for d in (-h, 0.0, h))
        turn = so3.logarithm(so3.normalize(so3.multiply(so3.conjugate(before.wxyz), after.wxyz)))
        rate = [angle / (2 * h) for angle in turn]
        bias = so3.rotate(so3.conjugate(mounts.X_base_imu.wxyz), self.gyro_bias)
        a = [(p - 2 * q + r) / h**2 for p, q, r in zip(before.xyz, now.xyz, after.xyz, strict=True)]
        force = so3.rotate(so3.conjugate(now.wxyz), (a[0], a[1], a[2] + GRAVITY))
        orientation = None
        if self.orientation != OrientationReference.NONE:
            # a vertical gyro: its yaw is arbitrary
            in_enu = so3.multiply((math.cos(1.1), 0.0, 0.0, math.sin(1.1)), now.wxyz)
            flip = (0.0, math.sqrt(0.5), math.sqrt(0.5), 0.0)  # NED from ENU
            orientation = in_enu if self.orientation == OrientationReference.ENU else so3.multiply(flip, in_enu)
        return ImuSample(
            SensorHeader(START + round(t * 1e6), "imu", seq),
            angular_velocity=tuple(r + b + rng.gauss(0, self.gyro_noise) for r, b in zip(rate, bias, strict=True)),
            specific_force=tuple(f + rng.gauss(0, self.force_noise) for f in force),
            orientation=orientation,
            orientation_reference=self.orientation,
        )

    def gps(self, drive: Drive, t: float, seq: int, rng: random.Random, mounts: Mounts = MOUNTS) -> GpsSample:
        h = 0.02
        noise = self.gps_sigma if self.gps_noise is None else self.gps_noise
        before, now, after = ((drive.pose(t + d) @ mounts.X_base_antenna).xyz for d in (-h, 0.0, h))
        x, y, z = now
        enu = (x + rng.gauss(0, noise), y + rng.gauss(0, noise), z + rng.gauss(0, 1.5 * noise))
        latitude, longitude, height = GEODESY.geodetic_from_enu(enu)
        velocity = velocity_covariance = None
        if self.velocity_sigma is not None:
            s = self.velocity_sigma
            velocity = tuple((b - a) / (2 * h) + rng.gauss(0, s) for a, b in zip(before, after, strict=True))
            velocity_covariance = (s**2, 0.0, 0.0, 0.0, s**2, 0.0, 0.0, 0.0, s**2)
        v = self.gps_sigma**2
        return GpsSample(
            SensorHeader(START + round(t * 1e6), "gps", seq),
            FixType.FIX_3D,
            latitude,
            longitude,
            height_ellipsoidal=height,
            satellites=9,
            hdop=0.9,
            position_covariance=(v, 0.0, 0.0, 0.0, v, 0.0, 0.0, 0.0, 2.25 * v),
            velocity=velocity,
            velocity_covariance=velocity_covariance,
        )


def run(localizer: RawLocalizer, samples):
    """Yield (sample, localizer after it, events) for each sample."""
    for sample in samples:
        localizer, events = localizer.process(sample)
        yield sample, localizer, events


def final(localizer: RawLocalizer, samples) -> RawLocalizer:
    for sample in samples:
        localizer, _ = localizer.process(sample)
    return localizer


def angle_error(a: float, b: float) -> float:
    return abs(math.remainder(a - b, math.tau))
