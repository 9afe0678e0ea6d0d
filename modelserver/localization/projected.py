"""The origin's geodesy, with what it says at the vehicle."""

from __future__ import annotations

from dataclasses import dataclass

from modelserver.earth.geodesy import Geodesy, GeodesyError, LocalFrame
from modelserver.localization.gate import GoodFix
from modelserver.spatial import so3
from modelserver.spatial.so3 import Quaternion


@dataclass(frozen=True, slots=True)
class Projected:
    """The origin's geodesy with what it says at the last fix, worked out once for all poses until the next.

    `tangent_from_work` turns the working frame's axes to World:ENU's; `convergence` those at the vehicle to
    World:UTM's.
    """

    geodesy: Geodesy
    tangent_from_work: Quaternion = so3.IDENTITY
    convergence: float = 0.0

    def reaches(self, fix: GoodFix) -> bool:
        """Return whether the pinned zone serves the place of a fix."""
        try:
            self.geodesy.utm_from_geodetic(fix.latitude_deg, fix.longitude_deg, 0.0)
        except GeodesyError:
            return False
        return True

    def at(self, latitude_deg: float, longitude_deg: float, work: LocalFrame) -> Projected:
        """Return the same with the vehicle at another place."""
        return Projected(
            self.geodesy,
            self.geodesy.tangent.rotation_of(work),
            self.geodesy.convergence(latitude_deg, longitude_deg),
        )
