"""GNSS receiver simulation: fixes at the antenna with time-correlated and white errors.

Position error per axis: e(t) = g(t) + n, where g is a first-order Gauss-Markov process (multipath, age of corrections)
and n is white; vertical errors are `vertical` times larger. Velocity error is white and may have a latency of its own.
Faults: outages, jumps, latency that the stamp does not include, wrong stated covariance.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

from modelserver.earth.geodesy import LocalFrame
from modelserver.messages import NAN, FixType, GpsSample
from modelserver.simulation.noise import GaussMarkov, Intervals, Run, Timing, diagonal_covariance, is_within
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Vector3

GPS_EPOCH = 315_964_800_000_000 - 18_000_000
"""utime of GPS time 0, minus the 18 leap seconds since 2017: the epoch of receivers' stamps."""

_MIN_SIGMA = 1e-3
"""Smallest standard deviation that a receiver states, meters and m/s; also keeps a filter from dividing by zero."""


_TIMING = Timing(4.0, latency=0.06, jitter=0.01)


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

    timing: Timing = _TIMING
    correlated_sigma: float = 0.03
    time_constant: float = 60.0
    white_sigma: float = 0.01
    vertical: float = 1.5
    velocity_sigma: float = 0.03
    velocity_latency: float = 0.0
    fix_type: FixType = FixType.DIFFERENTIAL
    satellites: int = 9
    hdop: float = 0.9
    outages: Intervals = ()
    undulation: float = NAN
    unstated_latency: float = 0.0
    jumps: tuple[tuple[float, float, float, float], ...] = ()
    sigma_factor: float = 1.0
    has_velocity: bool = True
    baseline_sigma: float = 0.003


def simulate_fixes(model: GpsModel, run: Run, X_VA: Pose, second_antenna: Vector3 | None = None) -> Iterator[GpsSample]:
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
            yield GpsSample(header, FixType.NONE, NAN, NAN, satellites=0)
            continue
        for begin, end, east, north in model.jumps:
            if begin <= t < end:
                error[0] += east
                error[1] += north
        motion = drive.at(t - model.unstated_latency)
        x, y, z = motion.pose_of(X_VA).xyz
        latitude, longitude, height = geodesy.geodetic_from_enu((x + error[0], y + error[1], z + error[2]))
        sample = GpsSample(
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
