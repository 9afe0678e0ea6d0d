"""An inertial unit: rates, specific force, its own orientation; magnetic field where it has a magnetometer.

As the report's 3DM-GX1 in vertical-gyro mode unless told otherwise: its tilt is held by gravity; its yaw starts
anywhere and is nothing but the integral of its own gyros, so that it drifts with their bias and with the earth's
rotation. With a yaw source it is that of magnetic or true north, with an error.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

from modelserver.earth import gravity as earth
from modelserver.earth.geodesy import Geodesy, about_up
from modelserver.messages import ImuSample, OrientationReference, SensorHeader, YawSource
from modelserver.simulation import rigid
from modelserver.simulation.magnetometer import MagnetometerModel, SimulatedMagnetometer
from modelserver.simulation.noise import NoiseSource, diagonal, quantised
from modelserver.simulation.stamps import Intervals, Timing, headers, within
from modelserver.simulation.trajectory import MotionModel
from modelserver.simulation.triad import Triad, TriadModel
from modelserver.spatial import so3
from modelserver.spatial.pose import Pose
from modelserver.spatial.so3 import Quaternion, Vector3

_HALF = math.sqrt(0.5)
_REFERENCE: dict[OrientationReference, Quaternion] = {
    OrientationReference.ENU: so3.IDENTITY,
    # north, east, down of a vector of east, north, up: half a turn about the line between east and north
    OrientationReference.NED: (0.0, _HALF, _HALF, 0.0),
}


_TIMING = Timing(100.0, latency=0.004, jitter=0.001)
_PROMPT = Timing(100.0)
_SOUND = TriadModel()


@dataclass(frozen=True, slots=True)
class ImuModel:
    """How good the unit is. SI units; the defaults are those of a MEMS unit of the report's day.

    gyro_bias_sigma, accelerometer_bias_sigma: of the bias, drawn once for each axis. gyro_walk: how the gyro
    biases wander, rad/s/sqrt(s). gyro_noise, accelerometer_noise: densities, rad/s/sqrt(Hz) and m/s2/sqrt(Hz).
    gyro_step, accelerometer_step: quantisation, 0 for none. tilt_sigma: of the error of its tilt, drawn once;
    tilt_noise: of what is new in each sample. yaw_offset: where its yaw starts, None for anywhere.
    reference: against what it states its orientation; NONE for a unit that does not.
    earth_rotation: whether its gyros feel the earth turn, and its accelerometers what follows from it.

    gyro, accelerometer: errors beyond these. magnetometer: None for none. yaw_source: what its own yaw is against;
    then its error is `yaw_offset` (None for 0) plus one drawn once with `yaw_sigma` plus `yaw_noise` new in each
    sample, and what pulls at the magnetometer pulls at a magnetic yaw; without one magnetic north is true north.
    frozen_from: seconds from which on it repeats its last values under new stamps, None for never.
    outages: seconds since the start, from and to, in which no sample comes; `seq` runs on.
    """

    timing: Timing = _TIMING
    gyro_bias_sigma: float = 0.003
    gyro_walk: float = 1e-5
    gyro_noise: float = 1e-3
    gyro_step: float = 0.0
    accelerometer_bias_sigma: float = 0.03
    accelerometer_noise: float = 3e-3
    accelerometer_step: float = 0.0
    tilt_sigma: float = 0.004
    tilt_noise: float = 0.001
    yaw_offset: float | None = None
    reference: OrientationReference = OrientationReference.NED
    earth_rotation: bool = True
    gyro: TriadModel = _SOUND
    accelerometer: TriadModel = _SOUND
    magnetometer: MagnetometerModel | None = None
    yaw_source: YawSource = YawSource.NONE
    yaw_sigma: float = 0.0
    yaw_noise: float = 0.0
    frozen_from: float | None = None
    outages: Intervals = ()

    @classmethod
    def noise_free(cls, timing: Timing = _PROMPT, yaw_offset: float = 0.0, earth_rotation: bool = True) -> ImuModel:
        """Return a unit without error; its yaw still starts at `yaw_offset` and integrates what its gyros feel."""
        return cls(
            timing,
            gyro_bias_sigma=0.0,
            gyro_walk=0.0,
            gyro_noise=0.0,
            accelerometer_bias_sigma=0.0,
            accelerometer_noise=0.0,
            tilt_sigma=0.0,
            tilt_noise=0.0,
            yaw_offset=yaw_offset,
            earth_rotation=earth_rotation,
        )


def readings(
    model: ImuModel, drive: MotionModel, X_VS: Pose, geodesy: Geodesy, start_utime: int, seed: int, source: str
) -> Iterator[ImuSample]:
    """Yield the samples, for ever. `X_VS` is the pose of the unit's own axes in the vehicle's moving frame.

    Gravity is normal gravity at the origin, along the up of its tangent plane: a hundred metres away the vertical of
    the place leans by 16 microradians from it, which no such unit can tell.
    """
    stamps = headers(
        model.timing, start_utime, start_utime - 1_000_000, source, NoiseSource(seed, f"imu/{source}/arrival")
    )
    unit = _Unit(model, drive, X_VS, geodesy, seed, source)
    last: ImuSample | None = None
    for header in stamps:
        t = (header.utime - start_utime) * 1e-6
        if last is None or model.frozen_from is None or t < model.frozen_from:
            last = unit.sample(header, t)
        else:
            last = replace(last, header=header)
        if not (model.outages and within(model.outages, t)):
            yield last


class _Unit:
    """The unit at work: what is drawn once, and what drifts."""

    def __init__(self, model: ImuModel, drive: MotionModel, X_VS: Pose, geodesy: Geodesy, seed: int, source: str):
        latitude, _, height = geodesy.geodetic_from_enu((0.0, 0.0, 0.0))
        self.model = model
        self.drive = drive
        self.q_VS = X_VS.wxyz
        self.lever = X_VS.xyz
        self.up = earth.gravity(latitude, height)
        self.turning = earth.rotation(latitude) if model.earth_rotation else (0.0, 0.0, 0.0)
        noise = NoiseSource(seed, f"imu/{source}")
        rate = model.timing.rate_hz
        self.gyro_bias = noise.vector(model.gyro_bias_sigma)
        self.accelerometer_bias = noise.vector(model.accelerometer_bias_sigma)
        self.tilt = noise.vector(model.tilt_sigma)
        self.yaw_error = noise.uniform(-math.pi, math.pi)
        if model.yaw_offset is not None:
            self.yaw_error = model.yaw_offset
        self.noise = noise.draw_ahead()
        self.gyro_sigma = model.gyro_noise * math.sqrt(rate)
        self.accelerometer_sigma = model.accelerometer_noise * math.sqrt(rate)
        self.walk_sigma = model.gyro_walk / math.sqrt(rate)
        orientation_sigma = max(math.hypot(model.tilt_sigma, model.tilt_noise), 1e-4)
        # a yaw that starts anywhere has the variance of a uniform one
        yaw_sigma = math.pi / math.sqrt(3.0)
        self.yaw_noise = NoiseSource(seed, f"imu/{source}/yaw")
        if model.yaw_source is not YawSource.NONE:
            self.yaw_error = (model.yaw_offset or 0.0) + self.yaw_noise.normal(model.yaw_sigma)
            yaw_sigma = max(math.hypot(model.yaw_sigma, model.yaw_noise), 1e-4)
        self.gyro_covariance = _axes(max(math.hypot(self.gyro_sigma, model.gyro_bias_sigma), 1e-6))
        self.force_covariance = _axes(max(math.hypot(self.accelerometer_sigma, model.accelerometer_bias_sigma), 1e-6))
        self.orientation_covariance = diagonal(orientation_sigma, orientation_sigma, yaw_sigma)
        # None costs nothing: most units are without
        self.gyro = None if model.gyro == _SOUND else Triad(model.gyro, rate, NoiseSource(seed, f"imu/{source}/gyro"))
        self.accelerometer = (
            None
            if model.accelerometer == _SOUND
            else Triad(model.accelerometer, rate, NoiseSource(seed, f"imu/{source}/accelerometer"))
        )
        self.magnetometer = (
            None
            if model.magnetometer is None
            else SimulatedMagnetometer(model.magnetometer, NoiseSource(seed, f"imu/{source}/magnetometer"))
        )

    def sample(self, header: SensorHeader, t: float) -> ImuSample:
        model, noise, lever, turning = self.model, self.noise, self.lever, self.turning
        motion = self.drive.at(t)
        q_ES = so3.multiply(rigid.orientation(motion), self.q_VS)
        q_SE = so3.conjugate(q_ES)
        wander = noise.vector(self.walk_sigma)
        bias = self.gyro_bias
        self.gyro_bias = bias = (bias[0] + wander[0], bias[1] + wander[1], bias[2] + wander[2])
        turn = rigid.angular_rate(motion)
        rate = so3.rotate(q_SE, (turning[0] + turn[0], turning[1] + turn[1], turning[2] + turn[2]))
        force = so3.rotate(
            q_SE, _force(rigid.acceleration(motion, lever), rigid.velocity(motion, lever), turning, self.up)
        )
        if self.gyro is not None:
            rate = self.gyro.seen(rate, motion.speed)
        if self.accelerometer is not None:
            force = self.accelerometer.seen(force, motion.speed)
        rate = _measured(rate, bias, noise.vector(self.gyro_sigma), model.gyro_step)
        force = _measured(
            force, self.accelerometer_bias, noise.vector(self.accelerometer_sigma), model.accelerometer_step
        )
        orientation = None
        if model.reference is not OrientationReference.NONE:
            orientation = self._orientation(t, q_ES)
            if model.yaw_source is YawSource.NONE:
                # its yaw runs on by what its gyros say, so by what they say too much
                self.yaw_error += (so3.rotate(q_ES, rate)[2] - turn[2]) / model.timing.rate_hz
        return ImuSample(
            header,
            angular_velocity=rate,
            specific_force=force,
            magnetic_field=None if self.magnetometer is None else self.magnetometer.seen(t, q_SE),
            orientation=orientation,
            orientation_reference=model.reference,
            yaw_source=model.yaw_source,
            angular_velocity_covariance=self.gyro_covariance,
            specific_force_covariance=self.force_covariance,
            orientation_covariance=self.orientation_covariance if orientation else None,
        )

    def _orientation(self, t: float, q_ES: Quaternion) -> Quaternion:
        model, tilt = self.model, self.tilt
        shake = self.noise.vector(model.tilt_noise)
        tilted = so3.exponential((tilt[0] + shake[0], tilt[1] + shake[1], 0.0))
        error = self.yaw_error
        if model.yaw_source is not YawSource.NONE:
            error += self.yaw_noise.normal(model.yaw_noise)
            if model.yaw_source is YawSource.MAGNETIC and self.magnetometer is not None:
                east, north, _ = self.magnetometer.outside(t)
                # clockwise from true north lies magnetic north: by so much larger is a yaw counted from it
                error += math.atan2(east, north)
        q_stated = so3.multiply(so3.multiply(about_up(error), tilted), q_ES)
        return so3.normalized(so3.multiply(_REFERENCE[model.reference], q_stated))


def _force(acceleration: Vector3, velocity: Vector3, turning: Vector3, gravity: float) -> Vector3:
    """Return specific force along east, north, up: acceleration, Coriolis's share, and what holds against gravity.

    The centrifugal share of the earth's rotation is part of gravity. `turning` is the earth's rotation.
    """
    _, n, u = turning
    vx, vy, vz = velocity
    ax, ay, az = acceleration
    return (ax + 2.0 * (n * vz - u * vy), ay + 2.0 * u * vx, az - 2.0 * n * vx + gravity)


def _measured(true: Vector3, bias: Vector3, noise: Vector3, step: float) -> Vector3:
    return (
        quantised(true[0] + bias[0] + noise[0], step),
        quantised(true[1] + bias[1] + noise[1], step),
        quantised(true[2] + bias[2] + noise[2], step),
    )


def _axes(sigma: float) -> tuple[float, float, float, float, float, float, float, float, float]:
    return diagonal(sigma, sigma, sigma)
