"""Drives of `benchmarks.integrity`: exact truth, and sensors whose errors are not those of the filter's model.

Nothing here is from `modelserver.simulation`, which shares its error models with the filter. All is computed at once
over arrays at `RATE` Hz; samples are created one at a time, in the order of their arrival.

Truth. World: the tangent plane (ENU) at `ORIGIN`, on a spherical earth. The rolling frame moves with the speeds v along
its x and u along its y axis and turns at r; both axes lie in the ground, whose slope the frame follows. `platform_*` of
a scenario add the motion of what carries the vehicle: a ferry, a crane. With derivatives of the path at the IMU,
f = R' (a + 2 W x v - g) and w = vee(R' dR/dt) + R' W, W the earth rate (Groves 2013, 2.3 and 5.4).

Errors. IMU: bias, flicker (Gauss-Markov processes of 3, 30 and 300 s), scale, misalignment, warming up, vibration in
proportion to speed. Wheels: scale of each wheel, slip with heavy tails, spin at the start, quantization, jitter. GNSS:
processes of 10, 120 and 600 s, white noise, outliers, reflections that change as the heading does, latency.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import Enum
from typing import Final, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt
from pyproj import Transformer

from modelserver.earth import earth_rate, gravity
from modelserver.earth.geodesy import Geodesy, origin_at
from modelserver.estimation.sensor_rig import Kinematics, SensorRig
from modelserver.geometry import ModelBuilder
from modelserver.messages import FixType, GpsSample, ImuSample, SensorHeader, WheelSample, WheelsSample
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Vector3

Array: TypeAlias = npt.NDArray[np.float64]
Mask: TypeAlias = npt.NDArray[np.bool_]
Window: TypeAlias = tuple[float, float]
"""Begin and end, seconds since the start."""
Received: TypeAlias = tuple[float, ImuSample | WheelsSample | GpsSample]
"""When a sample arrives, seconds since the start, and the sample."""

RATE: Final = 100
"""Instants of the truth per second."""
WHEELS_HZ: Final = 10
GPS_HZ: Final = 2
START: Final = 1_750_000_000_000_000
LATITUDE, LONGITUDE, HEIGHT = 50.27, -111.18, 700.0
ORIGIN: Final = origin_at(LATITUDE, LONGITUDE, HEIGHT)
EARTH_RADIUS: Final = 6.37e6
AREA: Final = 800.0
"""Meters from the origin from which on a drive turns back."""
IMU_DELAY, WHEELS_DELAY, FIX_DELAY = 0.005, 0.015, (0.05, 0.15)
"""Seconds from the stamp of a sample to its arrival; of fixes the least and the most."""


# --- vehicles -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Vehicle:
    """A vehicle. Meters, m/s, seconds.

    `smoothing` is how long a change of speed or curvature takes, `half_track` half the distance between its two wheels,
    `lateral` the largest lateral acceleration (m/s2), `vibration` that of the IMU at top speed (m/s2 and rad/s),
    `wavelength` that of the hills, `ruts` a side slip (rad) of which few are several times as large.
    """

    name: str
    kinematics: Kinematics
    top_speed: float
    smoothing: float
    half_track: float
    min_radius: float
    lateral: float
    imu: Pose
    antenna: Vector3
    imu_hz: int
    travel_step: float
    fix_type: FixType
    vibration: tuple[float, float]
    wavelength: float
    ruts: float

    def build_rig(self, has_wheels: bool) -> SensorRig:
        """Return the vehicle as the filter knows it."""
        builder = ModelBuilder(self.name)
        body = builder.add_body("Car")
        body.add_frame("Base")
        body.add_frame("Imu", self.imu)
        body.add_frame("Antenna", Pose(self.antenna))
        for name, y in self.contacts.items():
            body.add_frame(name, Pose((0.0, y, 0.0)))
        wheels = {name: f"Car:{name}" for name in self.contacts} if has_wheels else {}
        return SensorRig(builder.build(), "Car:Base", "Car:Imu", "Car:Antenna", "", wheels, self.kinematics)

    @property
    def contacts(self) -> dict[str, float]:
        """Lateral positions of the wheels' contact points."""
        return {"Left": self.half_track, "Right": -self.half_track}


VEHICLES: Final = {
    vehicle.name: vehicle
    for vehicle in (
        Vehicle(
            name="rover",
            kinematics="differential",
            top_speed=2.0,
            smoothing=2.0,
            half_track=0.3,
            min_radius=1.0,
            lateral=1.0,
            imu=Pose((0.1, 0.05, 0.3)),
            antenna=(-0.2, 0.1, 1.0),
            imu_hz=25,
            travel_step=0.004,
            fix_type=FixType.DIFFERENTIAL,
            vibration=(0.4, 0.008),
            wavelength=25.0,
            ruts=0.003,
        ),
        Vehicle(
            name="car",
            kinematics="ackermann",
            top_speed=15.0,
            smoothing=9.0,
            half_track=0.75,
            min_radius=7.0,
            lateral=3.5,
            imu=Pose((0.8, -0.2, 0.6)),
            antenna=(0.6, 0.3, 1.5),
            imu_hz=50,
            travel_step=0.02,
            fix_type=FixType.FIX_3D,
            vibration=(0.5, 0.006),
            wavelength=200.0,
            ruts=0.001,
        ),
        Vehicle(
            name="skid",
            kinematics="skid_steer",
            top_speed=1.0,
            smoothing=1.6,
            half_track=0.28,
            min_radius=0.8,
            lateral=0.7,
            imu=Pose.from_rpy((0.15, 0.0, 0.2), 0.0, 0.0, math.pi / 2),
            antenna=(0.2, 0.0, 0.7),
            imu_hz=50,
            travel_step=0.002,
            fix_type=FixType.DIFFERENTIAL,
            vibration=(0.6, 0.015),
            wavelength=20.0,
            ruts=0.002,
        ),
    )
}


# --- scenario -----------------------------------------------------------------------------------------------


class Receiver(Enum):
    """Errors of the fixes, and what the receiver states of them."""

    STATED = "sigma 0.9 m, stated"
    RTK = "sigma 0.02 m, stated"
    UNSTATED = "3D, sigma 2.1 m correlated over minutes, nothing stated but an HDOP of 1"
    WANDERING = "2 m rms horizontally that change within seconds, 6 m at most, sigma 0.9 m stated"


class Segment(NamedTuple):
    """A part of a drive: seconds, speed (m/s), curvature (1/m), turn rate in place (rad/s)."""

    seconds: float
    speed: float
    curvature: float = 0.0
    spin: float = 0.0


def _zeros() -> Array:
    return np.zeros(0)


@dataclass
class Scenario:
    """A drive before it is computed; a fault changes it.

    Arrays have one value per instant of the truth. `segments` replaces the random drive; `stops` are times at which the
    vehicle is stationary. `fix_offset` (n, 2) in meters and `velocity_offset` (n, 2) in m/s along east and north are
    added to fixes; `age` is how old their position is at their stamp beside the latency, and `stamp_shift` is added to
    the stamp, seconds. `gyro_bias` (rad/s) is about the vehicle's z axis, `mount_yaw` (rad) how far the IMU is turned,
    `antenna_error` (m) how far the antenna is, from where the geometry has it. `idling` is the vibration of a
    stationary vehicle, as a share of that at top speed. `stated_more` (n) is added to the stated sigma of fixes, m.
    `dead_axes` are times at which an axis of the gyro (0 to 2) reads 0: begin, end, axis. `platform_velocity` (n, 2) in
    m/s along east and north, `platform_rate` (rad/s), `lift` (m), `tilt` (n, 2: roll, pitch, rad).
    """

    vehicle: Vehicle
    seconds: float
    rng: np.random.Generator
    has_wheels: bool = True
    has_velocity: bool = False
    receiver: Receiver = Receiver.STATED
    has_errors: bool = True
    is_flat: bool = False
    events: list[Window] = field(default_factory=list)
    stops: list[Window] = field(default_factory=list)
    outages: list[Window] = field(default_factory=list)
    stuck: list[Window] = field(default_factory=list)
    silent: list[Window] = field(default_factory=list)
    dead_axes: list[tuple[float, float, int]] = field(default_factory=list)
    segments: list[Segment] = field(default_factory=list)
    latency: float = 0.0
    mount_yaw: float = 0.0
    antenna_error: Vector3 = (0.0, 0.0, 0.0)
    idling: float = 0.02
    gyro_scale: float = 0.0
    gyro_bias: Array = field(default_factory=_zeros)
    age: Array = field(default_factory=_zeros)
    stamp_shift: Array = field(default_factory=_zeros)
    fix_offset: Array = field(default_factory=_zeros)
    stated_more: Array = field(default_factory=_zeros)
    velocity_offset: Array = field(default_factory=_zeros)
    platform_velocity: Array = field(default_factory=_zeros)
    platform_rate: Array = field(default_factory=_zeros)
    lift: Array = field(default_factory=_zeros)
    tilt: Array = field(default_factory=_zeros)

    def __post_init__(self) -> None:
        n = self.size
        self.latency = float(self.rng.uniform(0.06, 0.1))
        self.gyro_bias, self.age, self.stamp_shift = np.zeros(n), np.zeros(n), np.zeros(n)
        self.fix_offset, self.velocity_offset, self.stated_more = np.zeros((n, 2)), np.zeros((n, 2)), np.zeros(n)
        self.platform_velocity, self.platform_rate = np.zeros((n, 2)), np.zeros(n)
        self.lift, self.tilt = np.zeros(n), np.zeros((n, 2))

    @property
    def size(self) -> int:
        """Number of instants."""
        return round(self.seconds * RATE) + 1

    @property
    def t(self) -> Array:
        """The instants, seconds since the start."""
        return np.arange(self.size) / RATE

    def between(self, window: Window) -> slice:
        """Return the instants of a window."""
        return slice(round(window[0] * RATE), round(window[1] * RATE))

    def ramp(self, window: Window, rise: float, fall: float) -> Array:
        """Return 0 outside of a window and 1 within, with linear flanks of so many seconds inside of it."""
        begin, end = window
        return np.interp(self.t, (begin - 1e-6, begin + rise, end - fall, end + 1e-6), (0.0, 1.0, 1.0, 0.0))


# --- random functions ---------------------------------------------------------------------------------------


def smooth(values: Array, seconds: float, rate: float = RATE) -> Array:
    """Return the moving mean, three times over a third of the time: with two continuous derivatives."""
    width = max(round(seconds * rate / 3.0) | 1, 1)
    half = width // 2
    for _ in range(3):
        padded = np.concatenate((np.full(half + 1, values[0]), values, np.full(half, values[-1])))
        total = np.cumsum(padded)
        values = (total[width:] - total[:-width]) / width
    return values


def wander(rng: np.random.Generator, n: int, seconds: float) -> Array:
    """Return a smooth random function of unit variance that changes within so many seconds."""
    knots = max(math.ceil(n / (seconds * RATE)) + 3, 4)
    rough = np.interp(np.arange(n) / (seconds * RATE), np.arange(knots), rng.standard_normal(knots))
    smoothed = smooth(rough, seconds)
    return smoothed * 1.5


def gauss_markov(
    rng: np.random.Generator, n: int, dt: float, sigma: float, tau: float, pace: Array | None = None
) -> Array:
    """Return a first-order Gauss-Markov process; `pace` (n) multiplies the time of each step."""
    steps = np.full(n, dt / tau) if pace is None else dt / tau * pace
    decay = np.exp(-steps)
    drive = sigma * np.sqrt(1.0 - decay * decay) * rng.standard_normal(n)
    out, x = [], float(sigma * rng.standard_normal())
    for a, w in zip(decay.tolist(), drive.tolist(), strict=True):
        x = a * x + w
        out.append(x)
    return np.array(out)


def flicker(rng: np.random.Generator, n: int, dt: float, sigma: float) -> Array:
    """Return bias instability: Gauss-Markov processes of 3, 30 and 300 s, of `sigma` each."""
    every = max(round(0.5 / dt), 1)
    coarse = sum(gauss_markov(rng, n // every + 2, every * dt, sigma, tau) for tau in (3.0, 30.0, 300.0))
    return np.interp(np.arange(n) / every, np.arange(n // every + 2), coarse)


def _integrate(values: Array) -> Array:
    """Return the integral from the first instant (trapezoids)."""
    return np.concatenate(([0.0], np.cumsum(0.5 * (values[1:] + values[:-1])) / RATE))


# --- truth --------------------------------------------------------------------------------------------------


def plan_drive(vehicle: Vehicle, seconds: float, stops: list[Window], rng: np.random.Generator) -> list[Segment]:
    """Return a random drive: straights, turns, circles, stops, reverse; it turns back far from the origin.

    It starts stationary and drives straight ahead and through turns for a minute; `stops` are kept.
    """
    segments: list[Segment] = []
    t, place, yaw = 0.0, 0j, 0.0
    pending = sorted(stops)

    def add(segment: Segment) -> None:
        nonlocal t, place, yaw
        while pending and pending[0][1] <= t:
            pending.pop(0)
        if pending and t <= pending[0][0] < t + segment.seconds:
            segment = segment._replace(seconds=max(pending[0][0] - t, 0.01))
        turn = segment.speed * segment.curvature + segment.spin
        way = segment.speed * segment.seconds
        place += way * complex(
            math.cos(yaw + 0.5 * turn * segment.seconds), math.sin(yaw + 0.5 * turn * segment.seconds)
        )
        yaw += turn * segment.seconds
        t += segment.seconds
        segments.append(segment)

    top = vehicle.top_speed
    add(Segment(rng.uniform(6.0, 12.0), 0.0))
    while t < seconds + 1.0:
        if pending and pending[0][0] <= t < pending[0][1]:
            segments.append(Segment(pending[0][1] - t, 0.0))
            t = pending.pop(0)[1]
            continue
        speed = float(rng.uniform(0.45, 1.0)) * top
        back = math.remainder(math.atan2(-place.imag, -place.real) - yaw, math.tau)
        is_far = abs(place) > AREA * min(1.0, top / 5.0) and abs(back) > 0.6
        chance = rng.uniform()
        if is_far or chance < 0.4 or t < 60.0:
            radius = vehicle.min_radius * float(rng.choice([1.3, 2.5, 5.0, 15.0]))
            speed = min(speed, math.sqrt(vehicle.lateral * 0.6 * radius))
            angle = abs(back) if is_far else float(rng.uniform(0.3, 2.4))
            sign = math.copysign(1.0, back) if is_far else float(rng.choice([-1.0, 1.0]))
            add(Segment(max(angle * radius / speed, 0.5 * vehicle.smoothing), speed, sign / radius))
            add(Segment(float(rng.uniform(5.0, 25.0)), float(rng.uniform(0.45, 1.0)) * top))
        elif chance < 0.75:
            add(Segment(float(rng.uniform(8.0, 45.0)), speed, float(rng.normal(0.0, 0.1 / vehicle.min_radius / 10.0))))
        elif chance < 0.9:
            add(Segment(float(rng.uniform(5.0, 40.0)), 0.0))
            if rng.uniform() < 0.3:
                curvature = float(rng.normal(0.0, 0.15)) / vehicle.min_radius
                add(Segment(float(rng.uniform(6.0, 15.0)), -min(0.5 * top, 1.5), curvature))
                add(Segment(float(rng.uniform(3.0, 8.0)), 0.0))
        elif chance < 0.95 and vehicle.kinematics != "ackermann":
            add(Segment(float(rng.uniform(2.0, 5.0)), 0.0))
            add(Segment(float(rng.uniform(2.0, 8.0)), 0.0, spin=float(rng.choice([-0.5, 0.5]))))
        else:
            radius = 2.5 * vehicle.min_radius
            speed = min(speed, math.sqrt(vehicle.lateral * 0.6 * radius))
            add(
                Segment(
                    math.tau * radius / speed * float(rng.uniform(0.8, 2.0)), speed, float(rng.choice([-1, 1])) / radius
                )
            )
    return segments


class Truth(NamedTuple):
    """The motion of the rolling frame at each instant.

    `position` and `velocity` (n, 3) in the tangent plane, `rotation` (n, 3, 3) from the vehicle's axes to it, `rate`
    (n, 3) with respect to the earth along the vehicle's axes; `speed` (n) along the ground, `turn` (n) relative to it.
    """

    position: Array
    velocity: Array
    rotation: Array
    rate: Array
    speed: Array
    turn: Array

    @property
    def yaw(self) -> Array:
        """Heading of the x axis, rad from east."""
        return np.arctan2(self.rotation[:, 1, 0], self.rotation[:, 0, 0])

    def locate(self, lever: Vector3) -> Array:
        """Return the position (n, 3) of a point of the vehicle."""
        located: Array = self.position + self.rotation @ np.array(lever)
        return located


def compute_truth(scenario: Scenario) -> Truth:
    """Return the motion of a scenario."""
    vehicle, rng, n = scenario.vehicle, scenario.rng, scenario.size
    segments = scenario.segments or plan_drive(vehicle, scenario.seconds, scenario.stops, rng)
    counts = np.array([max(round(each.seconds * RATE), 1) for each in segments])
    commands = np.repeat(np.array([each[1:] for each in segments]), counts, axis=0)
    if len(commands) < n:
        commands = np.concatenate((commands, np.repeat(commands[-1:], n - len(commands), axis=0)))
    speed, curvature, spin = (smooth(column, vehicle.smoothing) for column in commands[:n].T)
    speed[np.abs(speed) < 1e-9] = 0.0
    turn = (curvature + 0.004 / vehicle.min_radius * wander(rng, n, 4.0)) * speed
    turn /= np.sqrt(1.0 + (turn * speed / vehicle.lateral) ** 2)
    turn += spin
    # side slip: cornering stiffness that varies, gusts and ruts; a skid-steered vehicle turns about a moving point
    slip = -0.004 * turn * speed * np.exp(0.5 * wander(rng, n, 10.0)) + vehicle.ruts * wander(rng, n, 2.0) ** 3
    side = slip * speed
    if vehicle.kinematics == "skid_steer":
        side -= (0.02 + 0.03 * wander(rng, n, 5.0)) * turn
    yaw = rng.uniform(-math.pi, math.pi) + _integrate(turn + scenario.platform_rate)
    c, s = np.cos(yaw), np.sin(yaw)
    ground = np.stack((speed * c - side * s, speed * s + side * c), axis=1)
    flat = ground + scenario.platform_velocity
    x, y = _integrate(flat[:, 0]), _integrate(flat[:, 1])
    slope_x, slope_y, height = _terrain(rng, x, y, 0.0 if scenario.is_flat else 0.02, vehicle.wavelength)
    z = height + scenario.lift
    velocity = np.stack((flat[:, 0], flat[:, 1], np.gradient(z, 1.0 / RATE)), axis=1)
    R = _attitude(c, s, slope_x, slope_y)
    if np.any(scenario.tilt):
        roll, pitch = scenario.tilt.T
        R = R @ _rotation(1, pitch) @ _rotation(0, roll)
    rate = _angular_rate(R)
    along = ground[:, 0] * R[:, 0, 0] + ground[:, 1] * R[:, 1, 0]
    along += (slope_x * ground[:, 0] + slope_y * ground[:, 1]) * R[:, 2, 0]
    return Truth(np.stack((x, y, z), axis=1), velocity, R, rate, along, turn)


def _terrain(
    rng: np.random.Generator, x: Array, y: Array, slope: float, wavelength: float
) -> tuple[Array, Array, Array]:
    """Return slope along east and north, and height, of hills on a sphere."""
    slope_x, slope_y, height = -x / EARTH_RADIUS, -y / EARTH_RADIUS, -(x * x + y * y) / (2.0 * EARTH_RADIUS)
    for _ in range(6):
        k = math.tau / (wavelength * rng.uniform(1.0, 6.0))
        angle, phase = rng.uniform(-math.pi, math.pi, 2)
        kx, ky = k * math.cos(angle), k * math.sin(angle)
        argument = kx * x + ky * y + phase
        amplitude = slope / k * math.sqrt(2.0 / 6.0)
        height = height + amplitude * np.sin(argument)
        slope_x = slope_x + amplitude * kx * np.cos(argument)
        slope_y = slope_y + amplitude * ky * np.cos(argument)
    return slope_x, slope_y, height


def _attitude(c: Array, s: Array, slope_x: Array, slope_y: Array) -> Array:
    """Return the rotations (n, 3, 3) of a frame on the ground: x ahead, z along the normal."""
    ahead = np.stack((c, s, slope_x * c + slope_y * s), axis=1)
    up = np.stack((-slope_x, -slope_y, np.ones_like(c)), axis=1)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    return np.stack((ahead, np.cross(up, ahead), up), axis=2)


def _rotation(axis: int, angle: Array) -> Array:
    """Return the rotations (n, 3, 3) about the x (0) or y (1) axis."""
    c, s, R = np.cos(angle), np.sin(angle), np.tile(np.eye(3), (len(angle), 1, 1))
    i, j = ((1, 2), (2, 0))[axis]
    R[:, i, i], R[:, j, j], R[:, i, j], R[:, j, i] = c, c, -s, s
    return R


def _angular_rate(R: Array) -> Array:
    """Return vee(R' dR/dt) from the rotation between the instants before and after each."""
    before, after = np.concatenate((R[:1], R[:-1])), np.concatenate((R[1:], R[-1:]))
    D = np.transpose(before, (0, 2, 1)) @ after
    half = 0.5 * np.stack((D[:, 2, 1] - D[:, 1, 2], D[:, 0, 2] - D[:, 2, 0], D[:, 1, 0] - D[:, 0, 1]), axis=1)
    sine = np.minimum(np.linalg.norm(half, axis=1), 1.0)
    factor = np.where(sine > 1e-9, np.arcsin(sine) / np.maximum(sine, 1e-9), 1.0)
    rate: Array = half * (factor * RATE / 2.0)[:, None]
    rate[0] *= 2.0
    rate[-1] *= 2.0
    return rate


# --- sensors ------------------------------------------------------------------------------------------------


def compute_imu(truth: Truth, lever: Vector3) -> tuple[Array, Array]:
    """Return angular rate and specific force (n, 3) at a point of the vehicle, along its axes, without error."""
    W = np.array(earth_rate(LATITUDE))
    place = truth.locate(lever)
    R = truth.rotation
    velocity = truth.velocity + np.einsum("nij,nj->ni", R, np.cross(truth.rate, lever))
    acceleration = np.gradient(velocity, 1.0 / RATE, axis=0)
    g = gravity(LATITUDE, HEIGHT)
    down = np.stack((-place[:, 0] / EARTH_RADIUS, -place[:, 1] / EARTH_RADIUS, -np.ones(len(place))), axis=1)
    force = acceleration + 2.0 * np.cross(W, velocity) - g * down
    return truth.rate + W @ R, np.einsum("nji,nj->ni", R, force)


def measure_imu(scenario: Scenario, truth: Truth) -> Iterator[Received]:
    """Yield the IMU's samples."""
    vehicle, rng = scenario.vehicle, scenario.rng
    rate, force = compute_imu(truth, vehicle.imu.xyz)
    every = RATE // vehicle.imu_hz
    t, dt = scenario.t[::every], every / RATE
    rate, force, n = rate[::every].copy(), force[::every], len(t)
    rate[:, 2] = rate[:, 2] * (1.0 + scenario.gyro_scale) + scenario.gyro_bias[::every]
    # the sensor's axes, and where they truly are
    yaw = so3.from_rpy(0.0, 0.0, scenario.mount_yaw)
    M = np.array(so3.matrix_rows(so3.multiply(yaw, vehicle.imu.wxyz)))
    rate, force = rate @ M, force @ M
    if scenario.has_errors:
        moving = np.abs(truth.speed[::every]) / vehicle.top_speed
        warm = 1.0 - np.exp(-t / 900.0)
        scales = (
            (rate, 0.003, 3e-3, 1e-4, 5e-4, vehicle.vibration[1]),
            (force, 0.04, 0.03, 8e-4, 3e-3, vehicle.vibration[0]),
        )
        for values, bias, heat, instability, white, shaking in scales:
            misaligned = np.eye(3) + rng.normal(0.0, math.radians(0.3), (3, 3))
            misaligned[np.diag_indices(3)] = 1.0 + rng.normal(0.0, 0.003, 3)
            values[:] = values @ misaligned
            noise = white / math.sqrt(dt) + shaking * (scenario.idling + moving)
            for axis in range(3):
                values[:, axis] += rng.normal(0.0, bias) + rng.normal(0.0, heat) * warm
                values[:, axis] += flicker(rng, n, dt, instability)
                values[:, axis] += noise * rng.standard_normal(n)
    for begin, end, axis in scenario.dead_axes:
        rate[(t >= begin) & (t < end), axis] = 0.0
    lost = np.zeros(n, bool)
    for begin, end in scenario.silent:
        lost |= (t >= begin) & (t < end)
    for k, (when, w, f, is_lost) in enumerate(
        zip(t.tolist(), rate.tolist(), force.tolist(), lost.tolist(), strict=True)
    ):
        if not is_lost:
            header = SensorHeader(START + round(when * 1e6), "imu", k)
            yield when + IMU_DELAY, ImuSample(header, tuple(w), tuple(f))


def measure_wheels(scenario: Scenario, truth: Truth) -> Iterator[Received]:
    """Yield the samples of the wheels: travel."""
    vehicle, rng, n = scenario.vehicle, scenario.rng, scenario.size
    is_skid = vehicle.kinematics == "skid_steer"
    t = np.arange(0.03, scenario.seconds, 1.0 / WHEELS_HZ)
    taken = t + (rng.normal(0.0, 0.002, len(t)) if scenario.has_errors else 0.0)
    push = np.gradient(truth.speed, 1.0 / RATE)
    # 1 % each: load and pressure change both alike, the rest is of each wheel
    common = 1.0 + float(np.clip(rng.normal(0.0, 0.008), -0.016, 0.016))
    columns = []
    for y in vehicle.contacts.values():
        rolled = truth.speed - truth.turn * y
        if scenario.has_errors:
            heavy = np.interp(
                scenario.t, np.arange(0.0, scenario.seconds + 2.0, 0.7), _heavy(rng, scenario.seconds, 0.7)
            )
            slip = 0.012 * push + 0.003 * heavy * (
                1.0 + np.minimum(np.abs(push) + 2.0 * np.abs(truth.turn * truth.speed), 3.0)
            )
            slip += _spin(rng, scenario.t, truth.speed)
            scale = common + float(np.clip(rng.normal(0.0, 0.006), -0.012, 0.012))
            rolled = rolled * scale * (1.0 + slip)
            if is_skid:
                rolled -= truth.turn * y * (0.3 + 0.1 * wander(rng, n, 6.0))
                rolled += 0.05 * np.abs(truth.turn) * vehicle.half_track * wander(rng, n, 6.0)
        for window in scenario.stuck:
            rolled[scenario.between(window)] = 0.0
        travel = np.interp(taken, scenario.t, _integrate(rolled))
        if scenario.has_errors:
            travel = np.floor(travel / vehicle.travel_step) * vehicle.travel_step
        columns.append(travel)
    names, sigma = tuple(vehicle.contacts), max(vehicle.travel_step / math.sqrt(3.0), 1e-3)
    for k, (when, *travels) in enumerate(zip(t.tolist(), *(column.tolist() for column in columns), strict=True)):
        wheels = tuple(WheelSample(name, travel, sigma) for name, travel in zip(names, travels, strict=True))
        yield when + WHEELS_DELAY, WheelsSample(SensorHeader(START + round(when * 1e6), "wheels", k), wheels)


def _heavy(rng: np.random.Generator, seconds: float, step: float) -> Array:
    """Return numbers with heavy tails (Student, 3 degrees of freedom), one per step."""
    return np.clip(rng.standard_t(3.0, len(np.arange(0.0, seconds + 2.0, step))), -12.0, 12.0)


def _spin(rng: np.random.Generator, t: Array, speed: Array) -> Array:
    """Return the slip of a wheel that spins at some of the starts, for up to a second."""
    slip = np.zeros(len(t))
    moves = np.abs(speed) > 0.05
    starts = np.flatnonzero(moves[1:] & ~moves[:-1])
    for start in starts.tolist():
        if rng.uniform() < 0.3:
            slip[start : start + round(RATE * rng.uniform(0.3, 1.0))] += rng.uniform(0.05, 0.3)
    return slip


def _fix_errors(scenario: Scenario, truth: Truth, when: Array) -> Array:
    """Return the errors (m, 3) of the fixes along east, north, up."""
    rng, m, dt = scenario.rng, len(when), 1.0 / GPS_HZ
    e = np.zeros((m, 3))
    if not scenario.has_errors:
        return e
    turning = np.interp(when, scenario.t, np.abs(truth.turn + scenario.platform_rate))
    # reflections change as the vehicle turns: 1 rad is as good as 20 s
    pace = 1.0 + 20.0 * turning
    parts: tuple[tuple[float, float, Array | None], ...]
    if scenario.receiver is Receiver.RTK:
        white, parts = 0.008, ((0.01, 10.0, pace), (0.012, 120.0, None), (0.008, 600.0, None))
    elif scenario.receiver is Receiver.UNSTATED:
        white, parts = 0.2, ((0.5, 10.0, pace), (1.7, 80.0, None), (1.1, 600.0, None))
    elif scenario.receiver is Receiver.WANDERING:
        white, parts = 0.1, ((0.5, 40.0, None), (0.4, 600.0, None))
    else:
        white, parts = 0.2, ((0.35, 10.0, pace), (0.55, 120.0, None), (0.55, 600.0, None))
    for axis, factor in enumerate((1.0, 1.0, 1.6)):
        e[:, axis] = white * rng.standard_normal(m)
        for sigma, tau, of_turns in parts:
            e[:, axis] += gauss_markov(rng, m, dt, sigma, tau, of_turns)
        e[:, axis] *= factor
    if scenario.receiver is Receiver.WANDERING:
        e[:, :2] += np.stack([1.05 * np.interp(when, scenario.t, wander(rng, scenario.size, 8.0)) for _ in range(2)], 1)
        e[:, :2] *= np.minimum(1.0, 6.0 / np.linalg.norm(e[:, :2], axis=1))[:, None]
    elif scenario.receiver is not Receiver.RTK:
        for at in np.flatnonzero(rng.uniform(size=m) < dt / 150.0).tolist():
            angle, size = rng.uniform(-math.pi, math.pi), min(rng.exponential(1.5), 6.0)
            last = at + int(rng.integers(1, 8))
            e[at:last, 0] += size * math.cos(angle)
            e[at:last, 1] += size * math.sin(angle)
    return e


def measure_fixes(scenario: Scenario, truth: Truth) -> Iterator[Received]:
    """Yield the fixes."""
    vehicle, rng = scenario.vehicle, scenario.rng
    lever = so3.add(vehicle.antenna, scenario.antenna_error)
    stamps = np.arange(0.2 + rng.uniform(0.0, 0.3), scenario.seconds - 0.5, 1.0 / GPS_HZ)
    m = len(stamps)
    late = scenario.latency if scenario.has_errors else 0.0
    held = stamps - late - np.interp(stamps, scenario.t, scenario.age)
    antenna = _sample(held, scenario.t, truth.locate(lever)) + _fix_errors(scenario, truth, held)
    antenna[:, :2] += _sample(stamps, scenario.t, scenario.fix_offset)
    velocity = truth.velocity + np.einsum("nij,nj->ni", truth.rotation, np.cross(truth.rate, lever))
    velocity = _sample(held, scenario.t, velocity)
    velocity[:, :2] += _sample(stamps, scenario.t, scenario.velocity_offset)
    if scenario.has_errors:
        for axis in range(3):
            velocity[:, axis] += gauss_markov(rng, m, 1.0 / GPS_HZ, 0.03, 5.0) + 0.03 * rng.standard_normal(m)
    arrival = stamps + rng.uniform(*FIX_DELAY, m)
    stamps = stamps + np.interp(stamps, scenario.t, scenario.stamp_shift)
    tangent = Geodesy(ORIGIN).tangent
    ecef = np.array(tangent.ecef) + antenna @ np.array(so3.matrix_rows(tangent.rotation)).T
    to_geodetic = Transformer.from_pipeline(
        "+proj=pipeline +step +inv +proj=cart +ellps=WGS84 +step +proj=unitconvert +xy_in=rad +xy_out=deg"
    )
    longitude, latitude, height = to_geodetic.transform(*ecef.T)
    lost = np.zeros(m, bool)
    for begin, end in scenario.outages:
        lost |= (arrival >= begin) & (arrival < end)
    fix_type, sigma = vehicle.fix_type, 0.9
    if scenario.receiver is Receiver.RTK:
        fix_type, sigma = FixType.RTK_FIXED, 0.02
    is_stated = scenario.receiver is not Receiver.UNSTATED
    if not is_stated:
        fix_type = FixType.FIX_3D
    variances = ((sigma + np.interp(stamps, scenario.t, scenario.stated_more)) ** 2).tolist()
    accuracy = (0.05**2, 0.0, 0.0, 0.0, 0.05**2, 0.0, 0.0, 0.0, 0.05**2)
    for k in np.flatnonzero(~lost).tolist():
        variance = variances[k]
        covariance = (variance, 0.0, 0.0, 0.0, variance, 0.0, 0.0, 0.0, 1.6**2 * variance)
        yield (
            float(arrival[k]),
            GpsSample(
                SensorHeader(START + round(float(stamps[k]) * 1e6), "gps", k),
                fix_type,
                float(latitude[k]),
                float(longitude[k]),
                float(height[k]),
                satellites=9,
                hdop=1.0,
                position_covariance=covariance if is_stated else None,
                velocity=tuple(velocity[k].tolist()) if scenario.has_velocity else None,
                velocity_covariance=accuracy if scenario.has_velocity else None,
            ),
        )


def _sample(at: Array, t: Array, values: Array) -> Array:
    """Return the columns of values at other instants."""
    return np.stack([np.interp(at, t, column) for column in values.T], axis=1)


def measure(scenario: Scenario, truth: Truth) -> Iterator[Received]:
    """Yield all samples of a drive in the order of their arrival."""
    streams = [measure_imu(scenario, truth), _sort(measure_fixes(scenario, truth))]
    if scenario.has_wheels:
        streams.append(measure_wheels(scenario, truth))
    return heapq.merge(*streams, key=lambda received: received[0])


def _sort(received: Iterator[Received]) -> list[Received]:
    return sorted(received, key=lambda each: each[0])
