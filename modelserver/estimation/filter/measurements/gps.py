"""Measurement models of GNSS: position, height, velocity, dual antenna heading; lever arm and latency included."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from modelserver.earth.geodesy import LocalFrame, ecef_from_geodetic
from modelserver.estimation import fix_quality as gate
from modelserver.estimation.filter.layout import ErrorState
from modelserver.estimation.filter.measurements.base import Compared, Scene, azimuth, register, wrapped
from modelserver.estimation.filter.nav import jacobian_of_point, jacobian_of_point_velocity
from modelserver.estimation.filter.settings import FilterSettings
from modelserver.estimation.filter.strapdown import STANDARD_GRAVITY
from modelserver.estimation.findings import MIN_BASELINE
from modelserver.estimation.fix_quality import AcceptedFix
from modelserver.estimation.sensor_rig import SensorRig
from modelserver.messages import FixType, GpsSample
from modelserver.transforms import so3
from modelserver.transforms.so3 import Array, Vector3

WANDER = ("gps_wander_east", "gps_wander_north", "gps_wander_up")
"""The part of a fix's error that lingers, in units of the sigma it comes with: Gauss-Markov of sigma 1."""


EASED = 4.0
"""Up to so many times its limit a fix is used with wider noise: it pulls no harder than one at the limit does."""

LATENCY = "gps_latency"
"""By how many seconds the place that a fix tells is older than its stamp."""


def gps_states(settings: FilterSettings) -> tuple[ErrorState, ...]:
    """Return the error states of fixes: what lingers in them, and how late they are."""
    return (
        ErrorState(WANDER, 1.0, time_constant=settings.gps_correlation_time),
        ErrorState((LATENCY,), settings.gps_latency_sigma),
    )


def shares(variance: float, kind: FixType, settings: FilterSettings) -> tuple[float, float]:
    """Return the variance that is new with each fix, and the sigma of what lingers, of a fix's variance (m2).

    What lingers is no less than the range error of its kind of fix allows at an HDOP of 1, whatever the receiver says:
    it knows its noise, and not its reflections.
    """
    variance = max(variance, settings.gps_sigma_floor**2)
    white = settings.gps_white_share**2
    least = 0.5 * gate.range_error(kind, settings) ** 2
    return white * variance, math.sqrt(max((1.0 - white) * variance, least))


def place_of(fix: AcceptedFix, site: LocalFrame, fallback_up: float) -> Vector3:
    """Return a fix as east, north, up of a tangent plane; `fallback_up` stands for a height that was not told."""
    height = fix.height
    if math.isnan(height):
        # the height at which the plane is: good to r^2 / 2R, far below what a horizontal fix needs
        flat = site.from_ecef(ecef_from_geodetic(fix.latitude_deg, fix.longitude_deg, 0.0))
        height = fallback_up - flat[2]
    return site.from_ecef(ecef_from_geodetic(fix.latitude_deg, fix.longitude_deg, height))


@dataclass(frozen=True, slots=True)
class _AtAntenna:
    lever: Vector3

    @classmethod
    def of(cls, rig: SensorRig, settings: FilterSettings) -> Self | None:
        return cls(rig.lever_arm(rig.gps_frame)) if rig.gps_frame else None


@register
class GpsPosition(_AtAntenna):
    """Horizontal position of the antenna: p + R l - latency v + wander."""

    kind: ClassVar[str] = "gps_position"
    sample: ClassVar[type] = GpsSample
    states: ClassVar[tuple[ErrorState, ...]] = ()

    def instant(self, sample: GpsSample) -> int | None:
        """Return the fix's stamp."""
        return sample.header.utime

    def compare(self, scene: Scene, sample: GpsSample) -> Compared | str:
        """Compare east and north."""
        fix = gate.evaluate_fix(sample, scene.settings)
        if isinstance(fix, str):
            return fix
        if scene.site is None:
            return ""
        nav, layout = scene.nav, scene.layout
        x, y, z = nav.point(self.lever)
        east, north, _ = place_of(fix, scene.site, z)
        H = jacobian_of_point(nav, self.lever, layout.size)[:2]
        e_white, e_sigma = shares(fix.east_variance, sample.fix_type, scene.settings)
        n_white, n_sigma = shares(fix.north_variance, sample.fix_type, scene.settings)
        at = layout.index(WANDER[0])
        H[0, at], H[1, at + 1] = e_sigma, n_sigma
        # the fix tells where the antenna was: p(t - latency)
        vx, vy, _ = nav.point_velocity(self.lever)
        late = scene.extra(LATENCY)
        late_at = layout.index(LATENCY)
        H[0, late_at], H[1, late_at] = -vx, -vy
        x, y = x - vx * late, y - vy * late
        residual = np.array(
            (
                east - x - e_sigma * scene.extra(WANDER[0]),
                north - y - n_sigma * scene.extra(WANDER[1]),
            )
        )
        cross = fix.cross * scene.settings.gps_white_share**2
        # latency times speed, both unknown: without what a first order leaves out, a speed that is still being found
        # passes for one that changes, and latency for observed
        P = nav.covariance
        e_white, n_white = (white + P[late_at, late_at] * P[k, k] for white, k in ((e_white, 3), (n_white, 4)))
        return Compared(residual, H, np.array(((e_white, cross), (cross, n_white))), eased=EASED)


@register
class GpsHeight(_AtAntenna):
    """Height of the antenna above the ellipsoid, along N's up."""

    kind: ClassVar[str] = "gps_height"
    sample: ClassVar[type] = GpsSample
    states: ClassVar[tuple[ErrorState, ...]] = ()

    def instant(self, sample: GpsSample) -> int | None:
        """Return the fix's stamp; None where it tells no height."""
        return sample.header.utime if _tells_height(sample) else None

    def compare(self, scene: Scene, sample: GpsSample) -> Compared | str:
        """Compare up."""
        fix = gate.evaluate_fix(sample, scene.settings)
        if isinstance(fix, str) or scene.site is None or math.isnan(fix.height):
            return ""
        _, _, z = scene.nav.point(self.lever)
        _, _, up = place_of(fix, scene.site, z)
        H = jacobian_of_point(scene.nav, self.lever, scene.layout.size)[2:]
        white, sigma = shares(fix.up_variance, sample.fix_type, scene.settings)
        H[0, scene.layout.index(WANDER[2])] = sigma
        residual = up - z - sigma * scene.extra(WANDER[2])
        # nothing else tells the height: one that is far off pulls as hard as one at the gate, and is never shut out
        return Compared(np.array((residual,)), H, np.array(((white,),)), eased=math.inf)


def _tells_height(sample: GpsSample) -> bool:
    return math.isfinite(sample.height_ellipsoidal) or math.isfinite(sample.height_msl)


def stated_velocity(sample: GpsSample, settings: FilterSettings) -> tuple[Vector3, Array] | None:
    """Return the antenna's velocity along east, north, up with its covariance (3, 3), or (2, 2) of a course and speed.

    None where the receiver told neither, or where a course is of a vehicle too slow to have one.
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
    """Velocity of the antenna, at its own instant: some receivers tell one of the recent past."""

    kind: ClassVar[str] = "gps_velocity"
    sample: ClassVar[type] = GpsSample
    states: ClassVar[tuple[ErrorState, ...]] = ()

    def instant(self, sample: GpsSample) -> int | None:
        """Return the stamp less the latency that the receiver tells; None where it tells no velocity."""
        if sample.velocity is None and not (math.isfinite(sample.speed) and math.isfinite(sample.course)):
            return None
        late = sample.velocity_latency if 0.0 < sample.velocity_latency <= 5.0 else 0.0
        return sample.header.utime - round(late * 1e6)

    def compare(self, scene: Scene, sample: GpsSample) -> Compared | str:
        """Compare east, north and up, or for course and speed the first two."""
        if isinstance(gate.evaluate_fix(sample, scene.settings), str):
            return ""  # counted by the position
        stated = stated_velocity(sample, scene.settings)
        if stated is None or scene.site is None:
            return ""
        measured, R = stated
        m = len(R)
        nav, layout = scene.nav, scene.layout
        expected = nav.point_velocity(self.lever)
        H = jacobian_of_point_velocity(nav, self.lever, layout.size)[:m]
        # as late as the place is the velocity is: in a turn it tells the heading of then, with every fix alike. What is
        # felt along the way shakes too much to tell lateness by
        turning = nav.turn_rate[2]
        change = np.array((-turning * expected[1], turning * expected[0], 0.0))[:m]
        x, y, z = so3.rotate(nav.attitude, nav.force)
        rest = np.array((x, y, z - STANDARD_GRAVITY))[:m] - change
        late_at, late = layout.index(LATENCY), scene.extra(LATENCY)
        H[:, late_at] = -change
        R = R + (nav.covariance[late_at, late_at] + late * late) * np.outer(rest, rest)
        return Compared(np.subtract(measured, expected)[:m] + change * late, H, R)


@register
@dataclass(frozen=True, slots=True)
class GpsBaseline:
    """Azimuth of the line from the antenna whose position is told to the second one: a heading also at rest."""

    kind: ClassVar[str] = "gps_baseline"
    sample: ClassVar[type] = GpsSample
    states: ClassVar[tuple[ErrorState, ...]] = ()
    baseline: Vector3

    @classmethod
    def of(cls, rig: SensorRig, settings: FilterSettings) -> Self | None:
        """Return it where the geometry has a second antenna that does not stand straight above the first."""
        if not (rig.gps_frame and rig.second_antenna_frame):
            return None
        first, second = rig.lever_arm(rig.gps_frame), rig.lever_arm(rig.second_antenna_frame)
        baseline = (second[0] - first[0], second[1] - first[1], second[2] - first[2])
        return cls(baseline) if math.hypot(baseline[0], baseline[1]) > MIN_BASELINE else None

    def instant(self, sample: GpsSample) -> int | None:
        """Return the fix's stamp; None where it tells no baseline."""
        return sample.header.utime if math.isfinite(sample.baseline_yaw) else None

    def compare(self, scene: Scene, sample: GpsSample) -> Compared | str:
        """Compare the azimuth."""
        if scene.site is None:
            return ""
        expected, H = azimuth(so3.rotate(scene.nav.attitude, self.baseline), scene.layout.size)
        return Compared(
            np.array((wrapped(sample.baseline_yaw - expected),)), H, np.array(((baseline_sigma(sample) ** 2,),))
        )


def baseline_sigma(sample: GpsSample) -> float:
    """Return the sigma of a baseline's azimuth, rad; 1 degree where the receiver does not tell."""
    stated = sample.baseline_yaw_sigma
    return max(stated, 1e-3) if 0.0 < stated < math.pi else 0.0175


__all__ = [
    "LATENCY",
    "WANDER",
    "GpsBaseline",
    "GpsHeight",
    "GpsPosition",
    "GpsVelocity",
    "baseline_sigma",
    "gps_states",
    "place_of",
    "shares",
    "stated_velocity",
]
