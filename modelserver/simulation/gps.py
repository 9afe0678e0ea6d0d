"""A satellite receiver: fixes at the antenna, with an error that lingers and one that does not."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

from modelserver.earth.geodesy import Geodesy, LocalFrame
from modelserver.messages import NAN, FixType, GpsSample
from modelserver.simulation import rigid
from modelserver.simulation.noise import GaussMarkov, NoiseSource, diagonal
from modelserver.simulation.stamps import Intervals, Timing, headers, within
from modelserver.simulation.trajectory import MotionModel
from modelserver.spatial import so3
from modelserver.spatial.pose import Pose
from modelserver.spatial.so3 import Vector3

GPS_EPOCH = 315_964_800_000_000 - 18_000_000
"""utime at which GPS time shows 0, the 18 leap seconds since 2017 taken off: what receivers stamp with."""

_LEAST_SIGMA = 1e-3
"""No receiver claims less, metres and m/s; also what a filter needs to divide by."""


_TIMING = Timing(4.0, latency=0.06, jitter=0.01)
_PROMPT = Timing(4.0)


@dataclass(frozen=True, slots=True)
class GpsModel:
    """How good the receiver is. Metres, m/s, seconds; the defaults are those of the report's differential one.

    lingering_sigma: of a Gauss-Markov error of each horizontal axis with `time_constant` (multipath, corrections'
    age). white_sigma: of the error new in each fix. vertical: how many times worse height and climb are.
    velocity_sigma: of each horizontal axis. velocity_latency: age of the velocity at the fix's utime.
    outages: seconds since the start, from and to, in which there is no fix.
    undulation: geoid's height above the ellipsoid, nan for a receiver that does not tell.

    unstated_latency: seconds by which everything in a fix is older than its utime says. jumps: seconds since the
    start, from and to, and metres east and north by which fixes are off then. duplicates: share of fixes that come
    twice. stated_factor: stated standard deviations over true ones. tells_velocity, tells_covariance: whether
    velocity, speed and course, and standard deviations of anything are told.
    baseline_sigma: radians, of the baseline's yaw where there is a second antenna.
    """

    timing: Timing = _TIMING
    lingering_sigma: float = 0.03
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
    duplicates: float = 0.0
    stated_factor: float = 1.0
    tells_velocity: bool = True
    tells_covariance: bool = True
    baseline_sigma: float = 0.003

    @classmethod
    def noise_free(cls, timing: Timing = _PROMPT) -> GpsModel:
        """Return a receiver without error."""
        return cls(timing, lingering_sigma=0.0, white_sigma=0.0, velocity_sigma=0.0, baseline_sigma=0.0)


def fixes(
    model: GpsModel,
    drive: MotionModel,
    X_VA: Pose,
    geodesy: Geodesy,
    start_utime: int,
    seed: int,
    source: str,
    second: Vector3 | None = None,
) -> Iterator[GpsSample]:
    """Yield the fixes, for ever. `X_VA` is the antenna's pose in the vehicle's moving frame.

    Position is true on the ellipsoid; velocity is along true east, north and up of the antenna's own place.
    `second` is the place of a second antenna in the vehicle's moving frame, None for none.
    """
    noise = NoiseSource(seed, f"gps/{source}").draw_ahead()
    again = NoiseSource(seed, f"gps/{source}/duplicates")
    baseline_noise = NoiseSource(seed, f"gps/{source}/baseline")
    baseline = None
    if second is not None:
        baseline = (second[0] - X_VA.xyz[0], second[1] - X_VA.xyz[1], second[2] - X_VA.xyz[2])
    scales = (1.0, 1.0, model.vertical)
    lingering = [GaussMarkov(model.lingering_sigma * scale, model.time_constant, noise) for scale in scales]
    position_sigma = max(math.hypot(model.lingering_sigma, model.white_sigma), _LEAST_SIGMA) * model.stated_factor
    velocity_sigma = max(model.velocity_sigma, _LEAST_SIGMA) * model.stated_factor
    position_covariance = diagonal(*(position_sigma * scale for scale in scales)) if model.tells_covariance else None
    velocity_covariance = diagonal(*(velocity_sigma * scale for scale in scales)) if model.tells_covariance else None
    stamps = headers(model.timing, start_utime, GPS_EPOCH, source, NoiseSource(seed, f"gps/{source}/arrival"))
    for header in stamps:
        # drawn for fixes in an outage too, so that an outage leaves the later fixes as they were
        error = [
            process.step(1.0 / model.timing.rate_hz) + noise.normal(model.white_sigma * scale)
            for process, scale in zip(lingering, scales, strict=True)
        ]
        velocity_error = noise.vector(model.velocity_sigma)
        baseline_error = baseline_noise.normal(model.baseline_sigma) if baseline else 0.0
        times = 2 if model.duplicates and again.chance(model.duplicates) else 1
        t = (header.utime - start_utime) * 1e-6
        if within(model.outages, t):
            yield from (GpsSample(header, FixType.NONE, NAN, NAN, satellites=0),) * times
            continue
        for begin, end, east, north in model.jumps:
            if begin <= t < end:
                error[0] += east
                error[1] += north
        motion = drive.at(t - model.unstated_latency)
        x, y, z = rigid.pose(motion, X_VA).xyz
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
        if model.tells_velocity:
            earlier = drive.at(t - model.unstated_latency - model.velocity_latency)
            ve, vn, vu = so3.rotate(local, rigid.velocity(earlier, X_VA.xyz))
            ve += velocity_error[0]
            vn += velocity_error[1]
            vu += velocity_error[2] * model.vertical
            speed = math.hypot(ve, vn)
            sample = replace(
                sample,
                velocity=(ve, vn, vu),
                velocity_covariance=velocity_covariance,
                velocity_latency=model.velocity_latency,
                speed=speed,
                speed_sigma=velocity_sigma if model.tells_covariance else NAN,
                course=math.atan2(vn, ve),
                course_sigma=_course_sigma(velocity_sigma, speed) if model.tells_covariance else NAN,
            )
        if baseline:
            east, north, _ = so3.rotate(local, so3.rotate(rigid.orientation(motion), baseline))
            sample = replace(
                sample,
                baseline_yaw=math.remainder(math.atan2(north, east) + baseline_error, math.tau),
                baseline_yaw_sigma=max(model.baseline_sigma, 1e-4) * model.stated_factor
                if model.tells_covariance
                else NAN,
            )
        yield from (sample,) * times


def _course_sigma(velocity_sigma: float, speed: float) -> float:
    """Return the course's standard deviation: beside a velocity as small as its error every course is alike likely."""
    anywhere = math.pi / math.sqrt(3.0)
    return min(velocity_sigma / speed, anywhere) if speed > 0 else anywhere
