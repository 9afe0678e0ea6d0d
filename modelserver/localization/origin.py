"""Setting the origin from the first good fixes, where none is configured."""

from __future__ import annotations

import math
from dataclasses import dataclass

from modelserver.earth.geodesy import GeodesyError, geodetic_from_ecef, origin_at
from modelserver.localization.settings import FixSettings
from modelserver.messages import Origin
from modelserver.spatial.so3 import Vector3


@dataclass(frozen=True, slots=True)
class Capture:
    """The fixes so far: (seconds since the first, earth-centred position, sigma)."""

    fixes: tuple[tuple[int, Vector3, float], ...] = ()

    def take(self, utime: int, ecef: Vector3, sigma: float, settings: FixSettings) -> tuple[Capture, Origin | None]:
        """Return the capture with one fix more, and the origin once it is found.

        The origin is the mean of the last `origin_fixes` fixes, once they scatter about a straight drive at
        constant speed by no more than `origin_scatter` sigmas: the vehicle may be moving, an origin is but a
        place to count from.
        """
        fixes = (*self.fixes, (utime, ecef, sigma))[-settings.origin_fixes :]
        if len(fixes) < settings.origin_fixes:
            return Capture(fixes), None
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
        # the height errs more than the horizontal axes: the limit is on all three together
        if scatter > settings.origin_scatter * max(each[2] for each in fixes) * math.sqrt(3.0):
            return Capture(fixes), None
        try:
            return Capture(), origin_at(*geodetic_from_ecef((means[0], means[1], means[2])))
        except GeodesyError:
            return Capture(fixes), None
