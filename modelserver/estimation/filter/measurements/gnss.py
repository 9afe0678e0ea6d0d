"""Measurement models of GNSS: position, height, velocity, dual antenna heading.

A fix measures the antenna at p + R l, l its lever arm, with two errors that are states: the time-correlated GNSS error
c (Gauss-Markov of standard deviation 1, in units of the sigma of the fix) and the latency t by which the fix is older
than its stamp:

    z = p + R l + sigma_c c - t v + t^2 a / 2 + white noise                                                     (1)

(P. Groves 2013, 14.3.1), with a = w x v of the turn. Where a receiver states no covariance, sigma_c is at least the
range error of the type of fix. The products of two unknowns, latency and velocity, or latency twice, add their
variances to the noise: to first order a speed that is still being found would pass for one that changes, and make the
latency observable.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Final, Self

import numpy as np

from modelserver.earth.geodesy import LocalFrame, ecef_from_geodetic
from modelserver.estimation.filter.eskf import STANDARD_GRAVITY, ErrorState, Innovation
from modelserver.estimation.filter.measurements.measurement import (
    MeasurementContext,
    compute_azimuth,
    point_jacobian,
    point_velocity_jacobian,
    register,
    wrap_angle,
)
from modelserver.estimation.filter.settings import FilterSettings
from modelserver.estimation.inputs import AcceptedFix, evaluate_fix, range_error, reuse_last
from modelserver.estimation.sensor_rig import MIN_BASELINE, SensorRig
from modelserver.messages import FixType, GpsSample
from modelserver.transforms import so3
from modelserver.transforms.so3 import Array, Vector3

CORRELATED_ERROR: Final = ("gps_wander_east", "gps_wander_north", "gps_wander_up")
"""States: the time-correlated GNSS error in units of the sigma of the fix, Gauss-Markov of standard deviation 1."""

LARGEST_CORRELATED: Final = 3.0
"""Standard deviations beyond which an error was taken for a time-correlated one: of 370 such errors one is larger."""

LATENCY: Final = "gps_latency"
"""State: seconds by which the position of a fix is older than its stamp."""

FIX_INFLATION_LIMIT: Final = 4.0
"""A fix with a NIS up to this many times the gate is used with inflated noise, with the weight of one at the gate."""


def gnss_states(settings: FilterSettings) -> tuple[ErrorState, ...]:
    """Return the error states of fixes: time-correlated error and latency."""
    return (
        ErrorState(CORRELATED_ERROR, 1.0, time_constant=settings.gps_correlation_time),
        ErrorState((LATENCY,), settings.gps_latency_sigma),
    )


def split_variance(
    variance: float, fix: AcceptedFix, fix_type: FixType, settings: FilterSettings
) -> tuple[float, float]:
    """Return the white variance of a fix (m2), and the standard deviation of its time-correlated error (m).

    The latter is at least the range error of the type of fix at an HDOP of 1, where the receiver states no covariance.
    """
    variance = max(variance, settings.gps_sigma_floor**2)
    white = settings.gps_white_share**2
    least = 0.0 if fix.is_stated else 0.5 * range_error(fix_type, settings) ** 2
    return white * variance, math.sqrt(max((1.0 - white) * variance, least))


def locate_fix(fix: AcceptedFix, site: LocalFrame, fallback_up: float) -> Vector3:
    """Return a fix as east, north, up of a tangent plane; `fallback_up` replaces an unknown height."""
    if not math.isnan(fix.height):
        return _locate_at_height(fix, site)
    # the height of the plane there: off by r^2 / 2R, far below what a horizontal fix needs
    flat = site.from_ecef(ecef_from_geodetic(fix.latitude_deg, fix.longitude_deg, 0.0))
    height = fallback_up - flat[2]
    return site.from_ecef(ecef_from_geodetic(fix.latitude_deg, fix.longitude_deg, height))


@reuse_last
def _locate_at_height(fix: AcceptedFix, site: LocalFrame) -> Vector3:
    return site.from_ecef(ecef_from_geodetic(fix.latitude_deg, fix.longitude_deg, fix.height))


@dataclass(frozen=True, slots=True)
class _AtAntenna:
    lever: Vector3

    @classmethod
    def create(cls, rig: SensorRig, settings: FilterSettings) -> Self | None:
        return cls(rig.lever_arm(rig.gps_frame)) if rig.gps_frame else None


@register
class GpsPosition(_AtAntenna):
    """Horizontal position of the antenna, equation (1)."""

    kind: ClassVar[str] = "gps_position"
    sample: ClassVar[type] = GpsSample
    states: ClassVar[tuple[ErrorState, ...]] = ()

    def get_utime(self, sample: GpsSample) -> int | None:
        return sample.header.utime

    def evaluate(self, context: MeasurementContext, sample: GpsSample) -> Innovation | str:
        """Compare east and north."""
        fix = evaluate_fix(sample, context.settings, True)
        if isinstance(fix, str):
            return fix
        if context.site is None:
            return ""
        nav, layout = context.nav, context.layout
        x, y, z = nav.point(self.lever)
        east, north, _ = locate_fix(fix, context.site, z)
        H = point_jacobian(nav, self.lever, layout.size)[:2]
        e_white, e_sigma = split_variance(fix.east_variance, fix, sample.fix_type, context.settings)
        n_white, n_sigma = split_variance(fix.north_variance, fix, sample.fix_type, context.settings)
        at = layout.index(CORRELATED_ERROR[0])
        H[0, at], H[1, at + 1] = e_sigma, n_sigma
        # the antenna at t - latency
        vx, vy, _ = nav.point_velocity(self.lever)
        latency = context.extra(LATENCY)
        latency_at = layout.index(LATENCY)
        ax, ay = -nav.angular_rate[2] * vy, nav.angular_rate[2] * vx
        H[0, latency_at], H[1, latency_at] = ax * latency - vx, ay * latency - vy
        x, y = x + (0.5 * ax * latency - vx) * latency, y + (0.5 * ay * latency - vy) * latency
        residual = np.array(
            (
                east - x - e_sigma * context.extra(CORRELATED_ERROR[0]),
                north - y - n_sigma * context.extra(CORRELATED_ERROR[1]),
            )
        )
        covariance = fix.cross * context.settings.gps_white_share**2
        # the product of two unknowns: see the module's theory
        P = nav.covariance
        of_latency = P[latency_at, latency_at]
        e_white += of_latency * (P[3, 3] + 0.5 * of_latency * ax * ax)
        n_white += of_latency * (P[4, 4] + 0.5 * of_latency * ay * ay)
        R = np.array(((e_white, covariance), (covariance, n_white)))
        return Innovation(residual, H, R, inflation_limit=FIX_INFLATION_LIMIT)


@register
class GpsHeight(_AtAntenna):
    """Height of the antenna above the ellipsoid, along N's up."""

    kind: ClassVar[str] = "gps_height"
    sample: ClassVar[type] = GpsSample
    states: ClassVar[tuple[ErrorState, ...]] = ()

    def get_utime(self, sample: GpsSample) -> int | None:
        """Return the stamp of the fix; None without a height."""
        return sample.header.utime if _has_height(sample) else None

    def evaluate(self, context: MeasurementContext, sample: GpsSample) -> Innovation | str:
        """Compare up."""
        fix = evaluate_fix(sample, context.settings, True)
        if isinstance(fix, str) or context.site is None or math.isnan(fix.height):
            return ""
        _, _, z = context.nav.point(self.lever)
        _, _, up = locate_fix(fix, context.site, z)
        H = point_jacobian(context.nav, self.lever, context.layout.size)[2:]
        white, sigma = split_variance(fix.up_variance, fix, sample.fix_type, context.settings)
        H[0, context.layout.index(CORRELATED_ERROR[2])] = sigma
        residual = up - z - sigma * context.extra(CORRELATED_ERROR[2])
        # nothing else measures the height, so a large innovation is used with the weight of one at the gate
        return Innovation(np.array((residual,)), H, np.array(((white,),)), inflation_limit=math.inf)


def _has_height(sample: GpsSample) -> bool:
    return math.isfinite(sample.height_ellipsoidal) or math.isfinite(sample.height_msl)


def read_velocity(sample: GpsSample, settings: FilterSettings) -> tuple[Vector3, Array] | None:
    """Return the velocity of the antenna along east, north, up with its covariance (3, 3), or (2, 2) for a course and
    speed. None if the receiver reports neither, or a course of a vehicle that is too slow to have one.
    """
    if sample.velocity is not None and all(map(math.isfinite, sample.velocity)):
        stated = sample.velocity_covariance
        R = np.eye(3) * settings.velocity_sigma**2
        if stated is not None and all(0.0 < stated[k] < 1e4 for k in (0, 4, 8)):
            R = np.diag([max(stated[k], 1e-4) for k in (0, 4, 8)])
        return sample.velocity, R
    if math.isfinite(sample.speed) and math.isfinite(sample.course) and sample.speed >= settings.course_speed:
        along = sample.speed_sigma if 0.0 < sample.speed_sigma < 1e2 else settings.velocity_sigma
        turn = sample.course_sigma if 0.0 < sample.course_sigma < math.pi else settings.course_sigma
        across = max(sample.speed * turn, settings.velocity_sigma)
        c, s = math.cos(sample.course), math.sin(sample.course)
        turned = np.array(((c, -s), (s, c)))
        R = turned @ np.diag((along * along, across * across)) @ turned.T
        return (sample.speed * c, sample.speed * s, 0.0), R
    return None


@register
class GpsVelocity(_AtAntenna):
    """Velocity of the antenna, at its own instant: some receivers report one of the recent past."""

    kind: ClassVar[str] = "gps_velocity"
    sample: ClassVar[type] = GpsSample
    states: ClassVar[tuple[ErrorState, ...]] = ()

    def get_utime(self, sample: GpsSample) -> int | None:
        """Return the stamp minus the latency that the receiver reports; None without a velocity."""
        if sample.velocity is None and not (math.isfinite(sample.speed) and math.isfinite(sample.course)):
            return None
        latency = sample.velocity_latency if 0.0 < sample.velocity_latency <= 5.0 else 0.0
        return sample.header.utime - round(latency * 1e6)

    def evaluate(self, context: MeasurementContext, sample: GpsSample) -> Innovation | str:
        """Compare east, north and up; for course and speed the first two."""
        if isinstance(evaluate_fix(sample, context.settings, True), str):
            return ""  # counted by the position
        stated = read_velocity(sample, context.settings)
        if stated is None or context.site is None:
            return ""
        measured, R = stated
        m = len(R)
        nav, layout = context.nav, context.layout
        expected = nav.point_velocity(self.lever)
        H = point_velocity_jacobian(nav, self.lever, layout.size)[:m]
        # the velocity has the latency of the position: in a turn it has the heading of then, in every fix alike. The
        # acceleration along the path vibrates too much to find the latency from, so it only adds noise
        turning = nav.angular_rate[2]
        change = np.array((-turning * expected[1], turning * expected[0], 0.0))[:m]
        x, y, z = so3.rotate(nav.attitude, nav.force)
        rest = np.array((x, y, z - STANDARD_GRAVITY))[:m] - change
        latency_at, latency = layout.index(LATENCY), context.extra(LATENCY)
        H[:, latency_at] = -change
        R = R + (nav.covariance[latency_at, latency_at] + latency * latency) * np.outer(rest, rest)
        return Innovation(np.subtract(measured, expected)[:m] + change * latency, H, R)


@register
@dataclass(frozen=True, slots=True)
class GpsBaseline:
    """Azimuth of the line from the antenna of the position to the second one: a heading also while stationary."""

    kind: ClassVar[str] = "gps_baseline"
    sample: ClassVar[type] = GpsSample
    states: ClassVar[tuple[ErrorState, ...]] = ()
    baseline: Vector3

    @classmethod
    def create(cls, rig: SensorRig, settings: FilterSettings) -> Self | None:
        """Return it for a geometry with a second antenna that is not straight above the first."""
        if not (rig.gps_frame and rig.second_antenna_frame):
            return None
        first, second = rig.lever_arm(rig.gps_frame), rig.lever_arm(rig.second_antenna_frame)
        baseline = (second[0] - first[0], second[1] - first[1], second[2] - first[2])
        return cls(baseline) if math.hypot(baseline[0], baseline[1]) > MIN_BASELINE else None

    def get_utime(self, sample: GpsSample) -> int | None:
        """Return the stamp of the fix; None without a baseline."""
        return sample.header.utime if math.isfinite(sample.baseline_yaw) else None

    def evaluate(self, context: MeasurementContext, sample: GpsSample) -> Innovation | str:
        """Compare the azimuth."""
        if context.site is None:
            return ""
        expected, H = compute_azimuth(so3.rotate(context.nav.attitude, self.baseline), context.layout.size)
        residual = wrap_angle(sample.baseline_yaw - expected)
        return Innovation(np.array((residual,)), H, np.array(((get_baseline_sigma(sample) ** 2,),)))


def get_baseline_sigma(sample: GpsSample) -> float:
    """Return the standard deviation of a baseline's azimuth, rad; 1 degree if the receiver reports none."""
    stated = sample.baseline_yaw_sigma
    return max(stated, 1e-3) if 0.0 < stated < math.pi else 0.0175
