"""An inertial unit as the report's 3DM-GX1 in vertical-gyro mode: rates, specific force, its own orientation.

Its tilt is held by gravity; its yaw starts anywhere and is nothing but the integral of its own gyros, so that it drifts
with their bias and with the earth's rotation.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

from modelserver import earth
from modelserver.geodesy import Geodesy, about_up
from modelserver.messages import ImuSample, OrientationReference, YawSource
from modelserver.simulation import rigid
from modelserver.simulation.noise import Noise, diagonal, quantised
from modelserver.simulation.stamps import Timing, headers
from modelserver.simulation.trajectory import Trajectory
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


@dataclass(frozen=True, slots=True)
class ImuModel:
    """How good the unit is. SI units; the defaults are those of a MEMS unit of the report's day.

    gyro_bias_sigma, accelerometer_bias_sigma: of the bias, drawn once for each axis. gyro_walk: how the gyro
    biases wander, rad/s/sqrt(s). gyro_noise, accelerometer_noise: densities, rad/s/sqrt(Hz) and m/s2/sqrt(Hz).
    gyro_step, accelerometer_step: quantisation, 0 for none. tilt_sigma: of the error of its tilt, drawn once;
    tilt_noise: of what is new in each sample. yaw_offset: where its yaw starts, None for anywhere.
    reference: against what it states its orientation; NONE for a unit that does not.
    earth_rotation: whether its gyros feel the earth turn, and its accelerometers what follows from it.
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
    model: ImuModel, trajectory: Trajectory, X_VS: Pose, geodesy: Geodesy, start_utime: int, seed: int, source: str
) -> Iterator[ImuSample]:
    """Yield the samples, for ever. `X_VS` is the pose of the unit's own axes in the vehicle's moving frame.

    Gravity is normal gravity at the origin, along the up of its tangent plane: a hundred metres away the vertical of
    the place leans by 16 microradians from it, which no such unit can tell.
    """
    latitude, _, height = geodesy.geodetic_from_enu((0.0, 0.0, 0.0))
    up = earth.gravity(latitude, height)
    turning = earth.rotation(latitude) if model.earth_rotation else (0.0, 0.0, 0.0)
    noise = Noise(seed, f"imu/{source}")
    rate = model.timing.rate_hz
    gyro_bias = noise.vector(model.gyro_bias_sigma)
    accelerometer_bias = noise.vector(model.accelerometer_bias_sigma)
    tilt = noise.vector(model.tilt_sigma)
    yaw_error = noise.uniform(-math.pi, math.pi)
    if model.yaw_offset is not None:
        yaw_error = model.yaw_offset
    gyro_sigma = model.gyro_noise * math.sqrt(rate)
    accelerometer_sigma = model.accelerometer_noise * math.sqrt(rate)
    walk_sigma = model.gyro_walk / math.sqrt(rate)
    orientation_sigma = max(math.hypot(model.tilt_sigma, model.tilt_noise), 1e-4)
    gyro_covariance = _axes(max(math.hypot(gyro_sigma, model.gyro_bias_sigma), 1e-6))
    force_covariance = _axes(max(math.hypot(accelerometer_sigma, model.accelerometer_bias_sigma), 1e-6))
    # a yaw that starts anywhere has the variance of a uniform one
    orientation_covariance = diagonal(orientation_sigma, orientation_sigma, math.pi / math.sqrt(3.0))
    stamps = headers(model.timing, start_utime, start_utime - 1_000_000, source, Noise(seed, f"imu/{source}/arrival"))
    for header in stamps:
        motion = trajectory.at((header.utime - start_utime) * 1e-6)
        q_ES = so3.multiply(about_up(motion.yaw), X_VS.wxyz)
        q_SE = so3.conjugate(q_ES)
        wander = noise.vector(walk_sigma)
        gyro_bias = (gyro_bias[0] + wander[0], gyro_bias[1] + wander[1], gyro_bias[2] + wander[2])
        true_rate = so3.rotate(q_SE, (turning[0], turning[1], turning[2] + motion.yaw_rate))
        true_force = so3.rotate(
            q_SE, _force(rigid.acceleration(motion, X_VS.xyz), rigid.velocity(motion, X_VS.xyz), turning, up)
        )
        measured = _measured(true_rate, gyro_bias, noise.vector(gyro_sigma), model.gyro_step)
        force = _measured(true_force, accelerometer_bias, noise.vector(accelerometer_sigma), model.accelerometer_step)
        orientation = None
        if model.reference is not OrientationReference.NONE:
            shake = noise.vector(model.tilt_noise)
            tilted = so3.exponential((tilt[0] + shake[0], tilt[1] + shake[1], 0.0))
            q_stated = so3.multiply(so3.multiply(about_up(yaw_error), tilted), q_ES)
            orientation = so3.normalized(so3.multiply(_REFERENCE[model.reference], q_stated))
            # its yaw runs on by what its gyros say, so by what they say too much
            yaw_error += (so3.rotate(q_ES, measured)[2] - motion.yaw_rate) / rate
        yield ImuSample(
            header,
            angular_velocity=measured,
            specific_force=force,
            orientation=orientation,
            orientation_reference=model.reference,
            yaw_source=YawSource.NONE,
            angular_velocity_covariance=gyro_covariance,
            specific_force_covariance=force_covariance,
            orientation_covariance=orientation_covariance if orientation else None,
        )


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
