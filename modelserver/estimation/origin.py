"""The origin of the world frames: its capture from the first fixes, and the projection at the vehicle."""

from __future__ import annotations

import math
from dataclasses import dataclass

from modelserver.earth.geodesy import Geodesy, GeodesyError, LocalFrame, geodetic_from_ecef, origin_at
from modelserver.estimation.fix_quality import AcceptedFix
from modelserver.estimation.settings import FixSettings
from modelserver.messages import Origin
from modelserver.transforms import so3
from modelserver.transforms.so3 import Quaternion, Vector3


@dataclass(frozen=True, slots=True)
class OriginCapture:
    """The fixes so far: (utime, ECEF position, sigma)."""

    fixes: tuple[tuple[int, Vector3, float], ...] = ()

    def add_fix(
        self, utime: int, ecef: Vector3, sigma: float, settings: FixSettings
    ) -> tuple[OriginCapture, Origin | None]:
        """Return the capture with a further fix, and the origin once it is found.

        The origin is the mean of the last `origin_fixes` fixes, once they scatter about a straight drive at constant
        speed by no more than `origin_scatter` sigmas. The vehicle may be moving: any nearby point serves as origin.
        """
        fixes = (*self.fixes, (utime, ecef, sigma))[-settings.origin_fixes :]
        if len(fixes) < settings.origin_fixes:
            return OriginCapture(fixes), None
        n = len(fixes)
        start = fixes[0][0]
        times = [(each[0] - start) * 1e-6 for each in fixes]
        mean_t = sum(times) / n
        spread = sum((t - mean_t) ** 2 for t in times)
        means, squares = [], 0.0
        for axis in range(3):
            values = [each[1][axis] for each in fixes]
            mean = sum(values) / n
            means.append(mean)
            slope = sum((t - mean_t) * (v - mean) for t, v in zip(times, values, strict=True))
            slope = slope / spread if spread > 0.0 else 0.0
            squares += sum((v - mean - slope * (t - mean_t)) ** 2 for t, v in zip(times, values, strict=True))
        scatter = math.sqrt(squares / n)
        # height has a larger error than the horizontal axes: one limit for all three together
        if scatter > settings.origin_scatter * max(each[2] for each in fixes) * math.sqrt(3.0):
            return OriginCapture(fixes), None
        try:
            return OriginCapture(), origin_at(*geodetic_from_ecef((means[0], means[1], means[2])))
        except GeodesyError:
            return OriginCapture(fixes), None


@dataclass(frozen=True, slots=True)
class OriginProjection:
    """The origin's geodesy, evaluated at the last fix and used for all poses until the next.

    `tangent_from_work` rotates from the working frame's axes to World:ENU's; `convergence` from those at the vehicle to
    World:UTM's.
    """

    geodesy: Geodesy
    tangent_from_work: Quaternion = so3.IDENTITY
    convergence: float = 0.0

    def is_in_zone(self, fix: AcceptedFix) -> bool:
        """Return whether a fix is within the range of the pinned zone."""
        try:
            self.geodesy.utm_from_geodetic(fix.latitude_deg, fix.longitude_deg, 0.0)
        except GeodesyError:
            return False
        return True

    def at(self, latitude_deg: float, longitude_deg: float, work: LocalFrame) -> OriginProjection:
        """Return the projection with the vehicle at another place."""
        return OriginProjection(
            self.geodesy,
            self.geodesy.tangent.rotation_of(work),
            self.geodesy.convergence(latitude_deg, longitude_deg),
        )
