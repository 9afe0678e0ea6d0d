"""Simulated sensors: IMU, GNSS receiver, wheel odometry, vehicle controller, with their errors and sampling instants.

What the sensors of a run share (`Run`): random numbers come from one generator per source, so that sensors do not
change each other's numbers.

IMU: angular rate, specific force, orientation and, where there is one, a magnetometer.

Measurement of the gyros and accelerometers, along the sensor axes (`_SimulatedImu`):

    y = x + b + b_walk(t) + n

x is the true angular rate (with the Earth's, if `earth_rotation`) or the specific force f = a + 2 w_e x v - g (Groves
(2013) 5.4), b a constant bias, b_walk a random walk of the gyros, n white noise of density N: sigma = N sqrt(rate).
Terms as in Allan-variance data sheets (IEEE Std 952-1997, annex C). Further errors of x: `TriadErrors`.
Orientation: tilt is true up to an error drawn once plus noise. Without a yaw source, yaw starts anywhere and integrates
the measured rate about up, so it drifts with the gyro bias and the Earth's rotation (vertical gyro, as 3DM-GX1). With
one it is relative to magnetic or true north.
Magnetometer: y = soft_iron (field + disturbance) + hard_iron + n.
Limits: gravity is normal gravity at the origin along the up of its tangent plane; 100 m away the true vertical differs
by 16 microradians.

GNSS receiver: fixes at the antenna with time-correlated and white errors.

Position error per axis: e(t) = g(t) + n, where g is a first-order Gauss-Markov process (multipath, age of corrections)
and n is white; vertical errors are `vertical` times larger. Velocity error is white and may have a latency of its own.
Faults: outages, jumps, latency that the stamp does not include, wrong stated covariance.

Wheels: travel, speed and direction of each wheel, and the vehicle controller's status.

Kinematics: the speed of a contact point at (x, y, z) of the rolling frame is v_x - k w_z y + w_y z along the vehicle
and for a steered wheel the speed along the wheel, which is steered for
level ground without side slip. Travel is its integral: closed form on level ground without slip, else Gauss-Legendre
with three nodes per sample.
Encoder: travel is quantized to pulses; scale error per wheel; slip proportional to traction.
Limits: side slip is not measured by a wheel; the wheels follow the slope of the ground without suspension.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from modelserver import earth, messages
from modelserver.earth.geodesy import Geodesy, LocalFrame, rotation_about_up
from modelserver.simulation.trajectory import MotionModel, Trajectory, TrajectoryMotion
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Matrix3, Quaternion, Vector3

_BLOCK = 512


class NoiseSource:
    """Random generator of one source: the same seed (not negative) and name give the same numbers."""

    __slots__ = ("_prefetched", "_random")

    def __init__(self, seed: int, name: str):
        self._random = np.random.default_rng([seed, *name.encode()])
        self._prefetched: Iterator[float] | None = None

    def prefetch(self) -> NoiseSource:
        """Draw normal numbers in blocks from now on, and return itself: the same numbers at a fifth of the cost.

        Draws from other distributions would come out of sequence and raise ValueError then.
        """
        self._prefetched = self._blocks()
        return self

    def _blocks(self) -> Iterator[float]:
        while True:
            yield from self._random.standard_normal(_BLOCK).tolist()

    def normal(self, sigma: float = 1.0) -> float:
        if self._prefetched is not None:
            return sigma * next(self._prefetched)
        return sigma * float(self._random.standard_normal())

    def vector(self, sigma: float = 1.0) -> Vector3:
        """Return three normal numbers of standard deviation `sigma`."""
        prefetched = self._prefetched
        if prefetched is not None:
            return (sigma * next(prefetched), sigma * next(prefetched), sigma * next(prefetched))
        x, y, z = self._random.standard_normal(3).tolist()
        return (sigma * x, sigma * y, sigma * z)

    @property
    def generator(self) -> np.random.Generator:
        """Other distributions. Raises ValueError while normal numbers are prefetched."""
        if self._prefetched is not None:
            raise ValueError("this source prefetches normal numbers; use another NoiseSource for other distributions")
        return self._random


class GaussMarkov:
    """First-order Gauss-Markov process: zero mean, `sigma`, correlation exp(-dt / time_constant).

    It starts in its steady state. P. Maybeck, "Stochastic models, estimation, and control", vol. 1, 1979, 4.11.
    """

    __slots__ = ("_decay", "_driving_sigma", "_dt", "_noise", "sigma", "time_constant", "value")

    def __init__(self, sigma: float, time_constant: float, noise: NoiseSource):
        self.sigma = sigma
        self.time_constant = time_constant
        self._noise = noise
        self._dt, self._decay, self._driving_sigma = 0.0, 1.0, 0.0
        self.value = noise.normal(sigma)

    def step(self, dt: float) -> float:
        if dt != self._dt:
            keep = math.exp(-dt / self.time_constant)
            self._dt, self._decay, self._driving_sigma = dt, keep, self.sigma * math.sqrt(1.0 - keep * keep)
        self.value = self._decay * self.value + self._noise.normal(self._driving_sigma)
        return self.value


def quantize(value: float, step: float) -> float:
    """Return the multiple of `step` nearest to `value`; a step of 0 changes nothing."""
    return round(value / step) * step if step > 0 else value


def diagonal_covariance(x: float, y: float, z: float) -> Matrix3:
    """Return the row-major covariance of three independent standard deviations."""
    return (x * x, 0.0, 0.0, 0.0, y * y, 0.0, 0.0, 0.0, z * z)


Intervals: TypeAlias = tuple[tuple[float, float], ...]
"""Begin and end in seconds since the start."""


def is_within(intervals: Intervals, t: float) -> bool:
    """Return whether an instant lies in one of the intervals [begin, end)."""
    return any(begin <= t < end for begin, end in intervals)


@dataclass(frozen=True, slots=True)
class Timing:
    """Sampling rate, latency from measurement to arrival, and its jitter, seconds.

    Jitter only delays, by the absolute value of a normal number of that standard deviation; samples of one sensor
    arrive in the order of measurement.
    """

    rate_hz: float
    latency: float = 0.0
    jitter: float = 0.0

    def __post_init__(self) -> None:
        if not (0 < self.rate_hz <= 10_000 and self.latency >= 0 and self.jitter >= 0):
            raise ValueError(f"rate_hz must be in (0, 10000], latency and jitter not negative; got {self}")


@dataclass(frozen=True, slots=True)
class Run:
    """What the sensors of a run share. `start_utime` is the instant of the first samples."""

    drive: MotionModel
    geodesy: Geodesy
    start_utime: int
    seed: int

    def noise(self, name: str) -> NoiseSource:
        return NoiseSource(self.seed, name)

    def generate_headers(
        self, timing: Timing, name: str, device_epoch: int | None = None
    ) -> Iterator[tuple[messages.SensorHeader, float]]:
        """Yield the header of each sample of `kind/source` without end, and its instant in seconds since the start.

        `device_epoch` is the utime at which the device's own clock shows 0; None for a second before the start.
        """
        epoch = self.start_utime - 1_000_000 if device_epoch is None else device_epoch
        noise = self.noise(f"{name}/arrival").prefetch()
        source = name.rpartition("/")[2]
        arrived = seq = 0
        while True:
            utime = self.start_utime + round(seq * 1e6 / timing.rate_hz)
            delay = timing.latency + (abs(noise.normal(timing.jitter)) if timing.jitter else 0.0)
            arrived = max(arrived, utime + round(delay * 1e6))
            header = messages.SensorHeader(
                utime, source, seq, host_utime=arrived, device_utime=utime - epoch, utime_sigma=0.0
            )
            yield header, (utime - self.start_utime) * 1e-6
            seq += 1


# --- IMU --------------------------------------------------------------------------------------------------------------

Rows = tuple[Vector3, Vector3, Vector3]

FIELD: Vector3 = (0.0, 18e-6, -50e-6)
"""Geomagnetic field along east, north, up, tesla: typical of mid northern latitudes, without declination."""

_IDENTITY: Rows = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@dataclass(frozen=True, slots=True)
class MagnetometerModel:
    """Errors of a magnetometer. Tesla.

    Attributes
    ----------
    field : geomagnetic field along east, north, up
    hard_iron : offset from the vehicle, along the sensor axes
    soft_iron : rows of the matrix (3, 3) that the vehicle applies to the ambient field, sensor axes
    noise : standard deviation of each axis and sample
    disturbances : (begin, end, field) in seconds since the start: field along east, north, up of external iron
    """

    field: Vector3 = FIELD
    hard_iron: Vector3 = (0.0, 0.0, 0.0)
    soft_iron: Rows = _IDENTITY
    noise: float = 0.0
    disturbances: tuple[tuple[float, float, Vector3], ...] = ()

    def ambient_field(self, t: float) -> Vector3:
        return so3.add(self.field, *(field for begin, end, field in self.disturbances if begin <= t < end))

    def measure(self, t: float, q_SE: Quaternion, noise: NoiseSource) -> Vector3:
        """Return the sample along the sensor axes; `q_SE` rotates east, north, up to them."""
        ambient = so3.rotate(q_SE, self.ambient_field(t))
        return so3.add(apply_rows(self.soft_iron, ambient), self.hard_iron, noise.vector(self.noise))


def apply_rows(M: Rows, v: Vector3) -> Vector3:
    x, y, z = v
    a, b, c = M
    return (
        a[0] * x + a[1] * y + a[2] * z,
        b[0] * x + b[1] * y + b[2] * z,
        c[0] * x + c[1] * y + c[2] * z,
    )


_HALF = math.sqrt(0.5)
_REFERENCE: dict[messages.OrientationReference, Quaternion] = {
    messages.OrientationReference.ENU: so3.IDENTITY,
    # rotates east, north, up to north, east, down: half a turn about the axis between east and north
    messages.OrientationReference.NED: (0.0, _HALF, _HALF, 0.0),
}


TriadErrors = Callable[[float, NoiseSource], Callable[[Vector3, float], Vector3]]
"""Draws the errors (misalignment, vibration and so on) of three gyros or accelerometers that give `rate_hz` samples a
second; the result returns the measured vector for a true one at the vehicle's speed, m/s."""


@dataclass(frozen=True, slots=True)
class ImuModel:
    """Errors of an IMU, SI units; the defaults are those of the 3DM-GX1 (MEMS).

    Attributes
    ----------
    gyro_bias_sigma, accelerometer_bias_sigma : standard deviation of each axis's bias, drawn once
    gyro_walk : random walk of the gyro bias, rad/s/sqrt(s)
    gyro_noise, accelerometer_noise : noise densities, rad/s/sqrt(Hz) and m/s2/sqrt(Hz)
    tilt_sigma, tilt_noise : standard deviation of the tilt error drawn once, and of each sample's
    yaw_offset : initial yaw, None for a random one
    reference : frame that its orientation refers to; NONE for a unit without orientation
    earth_rotation : include the Earth's rotation in the gyros and its Coriolis term in the accelerometers
    gyro, accelerometer : further errors; as for `magnetometer`, None for none
    yaw_source : reference of its yaw. Then the yaw error is `yaw_offset` (None for 0) plus one drawn once with
        `yaw_sigma` plus `yaw_noise` in each sample, and magnetic disturbances also act on a magnetic yaw. Without a
        magnetometer magnetic north is true north
    frozen_from : time from which the last values are repeated with new stamps, s; None for never
    outages : (begin, end) in seconds since the start without samples; `seq` counts on
    """

    timing: Timing = Timing(100.0, latency=0.004, jitter=0.001)
    gyro_bias_sigma: float = 0.003
    gyro_walk: float = 1e-5
    gyro_noise: float = 1e-3
    accelerometer_bias_sigma: float = 0.03
    accelerometer_noise: float = 3e-3
    tilt_sigma: float = 0.004
    tilt_noise: float = 0.001
    yaw_offset: float | None = None
    reference: messages.OrientationReference = messages.OrientationReference.NED
    earth_rotation: bool = True
    gyro: TriadErrors | None = None
    accelerometer: TriadErrors | None = None
    magnetometer: MagnetometerModel | None = None
    yaw_source: messages.YawSource = messages.YawSource.NONE
    yaw_sigma: float = 0.0
    yaw_noise: float = 0.0
    frozen_from: float | None = None
    outages: Intervals = ()


def simulate_imu(model: ImuModel, run: Run, X_VS: Pose) -> Iterator[messages.ImuSample]:
    """Yield samples without end. `X_VS` is the pose of the sensor axes in the vehicle's moving frame."""
    unit = _SimulatedImu(model, run, X_VS)
    last: messages.ImuSample | None = None
    for header, t in run.generate_headers(model.timing, "imu/imu"):
        if last is None or model.frozen_from is None or t < model.frozen_from:
            last = unit.sample(header, t)
        else:
            last = replace(last, header=header)
        if not (model.outages and is_within(model.outages, t)):
            yield last


class _SimulatedImu:
    """One simulated IMU: errors drawn once, and drifting ones."""

    def __init__(self, model: ImuModel, run: Run, X_VS: Pose):
        latitude, _, height = run.geodesy.geodetic_from_enu((0.0, 0.0, 0.0))
        self.model, self.drive, self.X_VS = model, run.drive, X_VS
        self.up = earth.gravity(latitude, height)
        self.earth_rate = earth.earth_rate(latitude) if model.earth_rotation else (0.0, 0.0, 0.0)
        noise, rate = run.noise("imu/imu"), model.timing.rate_hz
        self.gyro_bias = noise.vector(model.gyro_bias_sigma)
        self.accelerometer_bias = noise.vector(model.accelerometer_bias_sigma)
        self.tilt = noise.vector(model.tilt_sigma)
        self.yaw_error = noise.generator.uniform(-math.pi, math.pi)
        if model.yaw_offset is not None:
            self.yaw_error = model.yaw_offset
        self.noise = noise.prefetch()
        self.gyro_sigma = model.gyro_noise * math.sqrt(rate)
        self.accelerometer_sigma = model.accelerometer_noise * math.sqrt(rate)
        self.walk_sigma = model.gyro_walk / math.sqrt(rate)
        # standard deviation of a uniform angle
        yaw_sigma = math.pi / math.sqrt(3.0)
        self.yaw_noise = run.noise("imu/imu/yaw")
        if model.yaw_source is not messages.YawSource.NONE:
            self.yaw_error = (model.yaw_offset or 0.0) + self.yaw_noise.normal(model.yaw_sigma)
            yaw_sigma = max(math.hypot(model.yaw_sigma, model.yaw_noise), 1e-4)
        tilt_sigma = max(math.hypot(model.tilt_sigma, model.tilt_noise), 1e-4)
        self.orientation_covariance = diagonal_covariance(tilt_sigma, tilt_sigma, yaw_sigma)
        self.gyro_covariance = _covariance(self.gyro_sigma, model.gyro_bias_sigma)
        self.force_covariance = _covariance(self.accelerometer_sigma, model.accelerometer_bias_sigma)
        self.gyro, self.accelerometer = (
            None if draw is None else draw(rate, run.noise(f"imu/imu/{name}"))
            for name, draw in (("gyro", model.gyro), ("accelerometer", model.accelerometer))
        )
        self.magnetometer_noise = run.noise("imu/imu/magnetometer").prefetch()

    def sample(self, header: messages.SensorHeader, t: float) -> messages.ImuSample:
        model, noise, lever, turning = self.model, self.noise, self.X_VS.xyz, self.earth_rate
        magnetometer = model.magnetometer
        motion = self.drive.at(t)
        q_ES = so3.multiply(motion.orientation(), self.X_VS.wxyz)
        q_SE = so3.conjugate(q_ES)
        self.gyro_bias = so3.add(self.gyro_bias, noise.vector(self.walk_sigma))
        turn = motion.angular_rate()
        rate = so3.rotate(q_SE, so3.add(turning, turn))
        acceleration, velocity = motion.acceleration_at(lever), motion.velocity_at(lever)
        force = so3.rotate(q_SE, _specific_force(acceleration, velocity, turning, self.up))
        if self.gyro is not None:
            rate = self.gyro(rate, motion.speed)
        if self.accelerometer is not None:
            force = self.accelerometer(force, motion.speed)
        rate = so3.add(rate, self.gyro_bias, noise.vector(self.gyro_sigma))
        force = so3.add(force, self.accelerometer_bias, noise.vector(self.accelerometer_sigma))
        orientation = None
        if model.reference is not messages.OrientationReference.NONE:
            orientation = self._orientation(t, q_ES)
            if model.yaw_source is messages.YawSource.NONE:
                # yaw integrates the gyros, and so their error
                self.yaw_error += (so3.rotate(q_ES, rate)[2] - turn[2]) / model.timing.rate_hz
        return messages.ImuSample(
            header,
            angular_velocity=rate,
            specific_force=force,
            magnetic_field=magnetometer.measure(t, q_SE, self.magnetometer_noise) if magnetometer else None,
            orientation=orientation,
            orientation_reference=model.reference,
            yaw_source=model.yaw_source,
            angular_velocity_covariance=self.gyro_covariance,
            specific_force_covariance=self.force_covariance,
            orientation_covariance=self.orientation_covariance if orientation else None,
        )

    def _orientation(self, t: float, q_ES: Quaternion) -> Quaternion:
        model = self.model
        x, y, _ = so3.add(self.tilt, self.noise.vector(model.tilt_noise))
        tilted = so3.exponential((x, y, 0.0))
        error = self.yaw_error
        if model.yaw_source is not messages.YawSource.NONE:
            error += self.yaw_noise.normal(model.yaw_noise)
            if model.yaw_source is messages.YawSource.MAGNETIC and model.magnetometer is not None:
                east, north, _ = model.magnetometer.ambient_field(t)
                # declination is clockwise from true north; yaw relative to magnetic north is larger by it
                error += math.atan2(east, north)
        q_stated = so3.multiply(so3.multiply(rotation_about_up(error), tilted), q_ES)
        return so3.normalize(so3.multiply(_REFERENCE[model.reference], q_stated))


def _specific_force(acceleration: Vector3, velocity: Vector3, turning: Vector3, gravity: float) -> Vector3:
    """Return specific force along east, north, up: acceleration, Coriolis term, reaction to gravity (Groves 5.4).

    The centrifugal term is part of gravity.
    """
    _, n, u = turning
    vx, vy, vz = velocity
    ax, ay, az = acceleration
    return (ax + 2.0 * (n * vz - u * vy), ay + 2.0 * u * vx, az - 2.0 * n * vx + gravity)


def _covariance(noise: float, bias: float) -> Matrix3:
    sigma = max(math.hypot(noise, bias), 1e-6)
    return diagonal_covariance(sigma, sigma, sigma)


# --- GNSS receiver ----------------------------------------------------------------------------------------------------

GPS_EPOCH = 315_964_800_000_000 - 18_000_000
"""utime of GPS time 0, minus the 18 leap seconds since 2017: the epoch of receivers' stamps."""

_MIN_SIGMA = 1e-3
"""Smallest standard deviation that a receiver states, meters and m/s; also keeps a filter from dividing by zero."""


@dataclass(frozen=True, slots=True)
class GpsModel:
    """Errors of a receiver. Meters, m/s, seconds; the defaults are those of a differential receiver.

    Attributes
    ----------
    correlated_sigma : Gauss-Markov error of each horizontal axis, with `time_constant`
    white_sigma : error of each fix
    vertical : factor of the vertical errors, of height and climb rate
    velocity_sigma : error of each horizontal axis of the velocity
    velocity_latency : age of the velocity at the fix's utime
    outages : (begin, end) in seconds since the start without a fix
    undulation : geoid height above the ellipsoid, nan for a receiver that does not report it
    unstated_latency : age of the whole fix at its utime
    jumps : (begin, end, east, north): offsets of the fixes, meters
    sigma_factor : stated over true standard deviations
    has_velocity : whether velocity, speed and course are reported
    baseline_sigma : error of the yaw of a two-antenna baseline, radians
    """

    timing: Timing = Timing(4.0, latency=0.06, jitter=0.01)
    correlated_sigma: float = 0.03
    time_constant: float = 60.0
    white_sigma: float = 0.01
    vertical: float = 1.5
    velocity_sigma: float = 0.03
    velocity_latency: float = 0.0
    fix_type: messages.FixType = messages.FixType.DIFFERENTIAL
    satellites: int = 9
    hdop: float = 0.9
    outages: Intervals = ()
    undulation: float = messages.NAN
    unstated_latency: float = 0.0
    jumps: tuple[tuple[float, float, float, float], ...] = ()
    sigma_factor: float = 1.0
    has_velocity: bool = True
    baseline_sigma: float = 0.003


def simulate_fixes(
    model: GpsModel, run: Run, X_VA: Pose, second_antenna: Vector3 | None = None
) -> Iterator[messages.GpsSample]:
    """Yield fixes without end. `X_VA` is the antenna's pose in the vehicle's moving frame.

    Position is on the ellipsoid; velocity is along true east, north and up at the antenna's position. `second_antenna`
    is its position in the vehicle's moving frame, None for none.
    """
    drive, geodesy = run.drive, run.geodesy
    noise = run.noise("gps/gps").prefetch()
    baseline_noise = run.noise("gps/gps/baseline")
    baseline = so3.add(second_antenna, so3.scale(-1.0, X_VA.xyz)) if second_antenna is not None else None
    scales = (1.0, 1.0, model.vertical)
    correlated = [GaussMarkov(model.correlated_sigma * scale, model.time_constant, noise) for scale in scales]
    position_sigma = max(math.hypot(model.correlated_sigma, model.white_sigma), _MIN_SIGMA) * model.sigma_factor
    velocity_sigma = max(model.velocity_sigma, _MIN_SIGMA) * model.sigma_factor
    position_covariance, velocity_covariance = (
        diagonal_covariance(sigma, sigma, sigma * model.vertical) for sigma in (position_sigma, velocity_sigma)
    )
    for header, t in run.generate_headers(model.timing, "gps/gps", GPS_EPOCH):
        # drawn during outages too, so that an outage does not change later fixes
        error = [
            process.step(1.0 / model.timing.rate_hz) + noise.normal(model.white_sigma * scale)
            for process, scale in zip(correlated, scales, strict=True)
        ]
        velocity_error = noise.vector(model.velocity_sigma)
        baseline_error = baseline_noise.normal(model.baseline_sigma) if baseline else 0.0
        if is_within(model.outages, t):
            yield messages.GpsSample(header, messages.FixType.NONE, messages.NAN, messages.NAN, satellites=0)
            continue
        for begin, end, east, north in model.jumps:
            if begin <= t < end:
                error[0] += east
                error[1] += north
        motion = drive.at(t - model.unstated_latency)
        x, y, z = motion.pose_of(X_VA).xyz
        latitude, longitude, height = geodesy.geodetic_from_enu((x + error[0], y + error[1], z + error[2]))
        sample = messages.GpsSample(
            header,
            model.fix_type,
            latitude,
            longitude,
            height_ellipsoidal=height,
            height_msl=height - model.undulation,
            undulation=model.undulation,
            satellites=model.satellites,
            hdop=model.hdop,
            vdop=model.hdop * model.vertical,
            pdop=model.hdop * math.hypot(1.0, model.vertical),
            position_covariance=position_covariance,
        )
        local = LocalFrame.at(latitude, longitude, height).rotation_of(geodesy.tangent)
        if model.has_velocity:
            earlier = drive.at(t - model.unstated_latency - model.velocity_latency)
            de, dn, du = velocity_error
            velocity = so3.rotate(local, earlier.velocity_at(X_VA.xyz))
            ve, vn, vu = so3.add(velocity, (de, dn, du * model.vertical))
            speed = math.hypot(ve, vn)
            sample = replace(
                sample,
                velocity=(ve, vn, vu),
                velocity_covariance=velocity_covariance,
                velocity_latency=model.velocity_latency,
                speed=speed,
                speed_sigma=velocity_sigma,
                course=math.atan2(vn, ve),
                course_sigma=_course_sigma(velocity_sigma, speed),
            )
        if baseline:
            east, north, _ = so3.rotate(local, so3.rotate(motion.orientation(), baseline))
            sigma = max(model.baseline_sigma, 1e-4) * model.sigma_factor
            yaw = math.remainder(math.atan2(north, east) + baseline_error, math.tau)
            sample = replace(sample, baseline_yaw=yaw, baseline_yaw_sigma=sigma)
        yield sample


def _course_sigma(velocity_sigma: float, speed: float) -> float:
    """Return the course's standard deviation: sigma_v / v, at most that of a uniform angle."""
    uniform_sigma = math.pi / math.sqrt(3.0)
    return min(velocity_sigma / speed, uniform_sigma) if speed > 0 else uniform_sigma


# --- wheels -----------------------------------------------------------------------------------------------------------

_GRAVITY = 9.81
_NODES = ((0.5 - math.sqrt(0.15), 5.0 / 18.0), (0.5, 8.0 / 18.0), (0.5 + math.sqrt(0.15), 5.0 / 18.0))
"""Gauss-Legendre nodes and weights on [0, 1]."""


class Encoder:
    """One simulated encoder; each call of `sample` follows the last."""

    def __init__(self, model: WheelsModel, name: str, noise: NoiseSource, run: Run):
        """Draw the errors of a wheel's encoder; `noise` is shared by the wheels, `run` has others for more."""
        self._model, self._name, self._noise = model, name, noise
        self._scale = 1.0 + noise.normal(model.scale_sigma)
        self._rotated = 0.0

    def sample(self, t: float, rolled: float, speed: float, excess: float, steering: float) -> messages.WheelSample:
        """Return the encoder's sample at `t` seconds.

        `rolled` (m since the last sample) and `speed` are those over ground; wheel slip multiplies them by `excess`.
        """
        model, seen = self._model, self._scale * excess
        error = self._noise.normal(model.speed_sigma) if abs(speed) > model.stationary_speed else 0.0
        self._rotated += rolled * seen
        return messages.WheelSample(
            self._name,
            travel=quantize(self._rotated, model.travel_step),
            travel_sigma=max(model.travel_step / math.sqrt(12.0), 1e-4),
            speed=speed * seen + error,
            speed_sigma=max(model.speed_sigma, 1e-4),
            direction=_direction(speed, model.stationary_speed),
            steering=steering,
        )


@dataclass(frozen=True, slots=True)
class WheelsModel:
    """Errors of the wheel encoders, and the steering geometry. Meters, m/s.

    Attributes
    ----------
    scale_sigma : standard deviation of each wheel's scale error, drawn once (tire pressure, load)
    speed_sigma : noise of the speed
    travel_step : travel per pulse, 0 for continuous
    slip : share of excess rotation at a traction of 1 g
    stationary_speed : speed below which an encoder measures none
    steered : names of the wheels that steer into the direction of motion of their contact points
    unstated_latency : age of a sample at its utime, s
    encoder : makes the encoder of a wheel by model, name, the noise that the wheels share, and the run
    """

    timing: Timing = Timing(20.0, latency=0.01, jitter=0.002)
    scale_sigma: float = 0.01
    speed_sigma: float = 0.02
    travel_step: float = 0.01
    slip: float = 0.0
    stationary_speed: float = 0.02
    steered: frozenset[str] = frozenset()
    unstated_latency: float = 0.0
    encoder: Callable[[WheelsModel, str, NoiseSource, Run], Encoder] = Encoder


def _direction(speed: float, stationary_speed: float) -> messages.Direction:
    if abs(speed) <= stationary_speed:
        return messages.Direction.STOPPED
    return messages.Direction.FORWARD if speed > 0 else messages.Direction.BACKWARD


def simulate_wheels(model: WheelsModel, run: Run, contacts: Mapping[str, Vector3]) -> Iterator[messages.WheelsSample]:
    """Yield samples without end. `contacts` has each wheel's contact point in the vehicle's moving frame, meters."""
    noise = run.noise("wheels/wheels")
    encoders = {name: model.encoder(model, name, noise, run) for name in contacts}
    noise.prefetch()
    rolling = _WheelOdometry(model, run.drive, contacts)
    for header, t in run.generate_headers(model.timing, "wheels/wheels"):
        t -= model.unstated_latency
        motion, distances = rolling.advance(t)
        slip = model.slip * _traction(motion) / _GRAVITY
        wheels = []
        for name, contact in contacts.items():
            if name in model.steered:
                speed = _steered_speed(motion, contact)
                steering = math.atan2(motion.curvature * contact[0], 1.0 - motion.curvature * contact[1])
            else:
                forward, turn, pitch = _rates(motion)
                speed, steering = forward - contact[1] * turn + contact[2] * pitch, 0.0
            wheels.append(encoders[name].sample(t, distances[name], speed, 1.0 + slip, steering))
        yield messages.WheelsSample(header, tuple(wheels))


class _WheelOdometry:
    """Travel of each wheel between two calls, in meters."""

    def __init__(self, model: WheelsModel, drive: MotionModel, contacts: Mapping[str, Vector3]):
        self.model = model
        self.drive = drive
        self.contacts = contacts
        # on level ground without side slip the travel of wheels that do not steer has a closed form
        self.has_closed_form = isinstance(drive, Trajectory)
        self.quadrature = bool(model.steered) or not self.has_closed_form
        self.previous = drive.at(0.0)
        self.t_previous = 0.0

    def advance(self, t: float) -> tuple[TrajectoryMotion, dict[str, float]]:
        """Return the motion at `t` seconds, and each wheel's travel since the last call, the first since 0."""
        model, drive, t_previous, before = self.model, self.drive, self.t_previous, self.previous
        motion = drive.at(t)
        elapsed = t - t_previous
        between = [(drive.at(t_previous + u * elapsed), weight) for u, weight in _NODES] if self.quadrature else []
        if self.has_closed_form:
            along, turned, pitched = motion.distance - before.distance, motion.yaw - before.yaw, 0.0
        else:
            along = turned = pitched = 0.0
            for each, weight in between:
                speed, turn, pitch = _rates(each)
                along += weight * elapsed * speed
                turned += weight * elapsed * turn
                pitched += weight * elapsed * pitch
        distances = {}
        for name, contact in self.contacts.items():
            if name in model.steered:
                distances[name] = elapsed * sum(weight * _steered_speed(each, contact) for each, weight in between)
            else:
                distances[name] = along - contact[1] * turned + contact[2] * pitched
        self.previous, self.t_previous = motion, t
        return motion, distances


@dataclass(frozen=True, slots=True)
class StatusModel:
    """Measurements of the vehicle controller. `wheelbase`: meters from the rolling frame to the steered axle.

    `angle_sigma` is the noise of the steering angle and `angle_error` its offset, radians.
    """

    wheelbase: float
    timing: Timing = Timing(20.0, latency=0.01, jitter=0.002)
    angle_sigma: float = 0.002
    angle_error: float = 0.0


def simulate_status(model: StatusModel, run: Run) -> Iterator[messages.VehicleStatusSample]:
    """Yield the controller's samples without end: forward speed and steering angle of the equivalent front wheel."""
    noise = run.noise("status/vehicle")
    for header, t in run.generate_headers(model.timing, "status/vehicle"):
        motion = run.drive.at(t)
        angle = math.atan(motion.curvature * model.wheelbase) + model.angle_error + noise.normal(model.angle_sigma)
        yield messages.VehicleStatusSample(header, messages.VehicleMode.AUTONOMOUS, motion.speed, angle)


def _rates(motion: TrajectoryMotion) -> Vector3:
    """Return forward speed, yaw rate and pitch rate, along the vehicle's axes."""
    if motion.attitude is None:
        return (motion.speed, motion.yaw_rate, 0.0)
    return (motion.speed, motion.attitude.rate[2], motion.attitude.rate[1])


def _steered_speed(motion: TrajectoryMotion, contact: Vector3) -> float:
    """Return the speed of a contact point along its wheel, negative in reverse, steered as without side slip."""
    k = motion.curvature
    x, y, z = contact
    wx, wy, wz = motion.attitude.rate if motion.attitude is not None else (0.0, 0.0, motion.yaw_rate)
    ahead, left = motion.speed - wz * y + wy * z, motion.lateral_speed + wz * x - wx * z
    return (ahead * (1.0 - k * y) + left * k * x) / math.hypot(1.0 - k * y, k * x)


def _traction(motion: TrajectoryMotion) -> float:
    """Return the acceleration at the tires, m/s2: positive makes wheels rotate too much, braking too little."""
    along = math.copysign(1.0, motion.speed) * motion.forward_acceleration
    return along + abs(motion.speed * motion.yaw_rate)
