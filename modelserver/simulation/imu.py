"""IMU simulation: angular rate, specific force, orientation and, where there is one, a magnetometer.

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
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

from modelserver import earth
from modelserver.earth.geodesy import rotation_about_up
from modelserver.messages import ImuSample, OrientationReference, SensorHeader, YawSource
from modelserver.simulation.noise import (
    Intervals,
    NoiseSource,
    Run,
    Timing,
    diagonal_covariance,
    is_within,
)
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Matrix3, Quaternion, Vector3

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
_REFERENCE: dict[OrientationReference, Quaternion] = {
    OrientationReference.ENU: so3.IDENTITY,
    # rotates east, north, up to north, east, down: half a turn about the axis between east and north
    OrientationReference.NED: (0.0, _HALF, _HALF, 0.0),
}


_TIMING = Timing(100.0, latency=0.004, jitter=0.001)

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

    timing: Timing = _TIMING
    gyro_bias_sigma: float = 0.003
    gyro_walk: float = 1e-5
    gyro_noise: float = 1e-3
    accelerometer_bias_sigma: float = 0.03
    accelerometer_noise: float = 3e-3
    tilt_sigma: float = 0.004
    tilt_noise: float = 0.001
    yaw_offset: float | None = None
    reference: OrientationReference = OrientationReference.NED
    earth_rotation: bool = True
    gyro: TriadErrors | None = None
    accelerometer: TriadErrors | None = None
    magnetometer: MagnetometerModel | None = None
    yaw_source: YawSource = YawSource.NONE
    yaw_sigma: float = 0.0
    yaw_noise: float = 0.0
    frozen_from: float | None = None
    outages: Intervals = ()


def simulate_imu(model: ImuModel, run: Run, X_VS: Pose) -> Iterator[ImuSample]:
    """Yield samples without end. `X_VS` is the pose of the sensor axes in the vehicle's moving frame."""
    unit = _SimulatedImu(model, run, X_VS)
    last: ImuSample | None = None
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
        if model.yaw_source is not YawSource.NONE:
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

    def sample(self, header: SensorHeader, t: float) -> ImuSample:
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
        if model.reference is not OrientationReference.NONE:
            orientation = self._orientation(t, q_ES)
            if model.yaw_source is YawSource.NONE:
                # yaw integrates the gyros, and so their error
                self.yaw_error += (so3.rotate(q_ES, rate)[2] - turn[2]) / model.timing.rate_hz
        return ImuSample(
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
        if model.yaw_source is not YawSource.NONE:
            error += self.yaw_noise.normal(model.yaw_noise)
            if model.yaw_source is YawSource.MAGNETIC and model.magnetometer is not None:
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
