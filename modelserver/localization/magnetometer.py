"""A magnetometer's calibration, and the field it should feel."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

from modelserver.earth import magnetism
from modelserver.spatial.so3 import Vector3

_YEAR_US = 31_557_600_000_000


@dataclass(frozen=True, slots=True)
class MagnetometerCalibration:
    """How the inertial unit's magnetic field is corrected, along the unit's own axes: soft_iron (measured - hard_iron).

    hard_iron: the vehicle's own field, tesla. soft_iron: 3 by 3, row-major, no unit: how iron bends the earth's field,
    undone. `modelserver calibrate magnetometer` finds both. declination_deg: true yaw of magnetic north at the place,
    degrees, east positive; left out, the world magnetic model's.
    """

    __pydantic_config__: ClassVar[dict[str, object]] = {"extra": "forbid", "strict": True, "allow_inf_nan": False}

    hard_iron: tuple[float, float, float] = (0.0, 0.0, 0.0)
    soft_iron: tuple[float, float, float, float, float, float, float, float, float] = (
        *(1.0, 0.0, 0.0),
        *(0.0, 1.0, 0.0),
        *(0.0, 0.0, 1.0),
    )
    declination_deg: float | None = None

    def __post_init__(self) -> None:
        a, b, c, d, e, f, g, h, i = self.soft_iron
        if not a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) > 0.0:
            raise ValueError(
                "soft_iron is a correction close to 1 0 0 0 1 0 0 0 1; this one has no positive determinant"
            )
        if self.declination_deg is not None and not -180.0 <= self.declination_deg <= 180.0:
            raise ValueError(f"declination_deg is between -180 and 180, got {self.declination_deg:g}")

    def applied(self, felt: Vector3) -> Vector3:
        """Return the field without the vehicle's share, along the unit's axes, tesla."""
        x, y, z = (a - b for a, b in zip(felt, self.hard_iron, strict=True))
        a, b, c, d, e, f, g, h, i = self.soft_iron
        return (a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z)

    def declination(self, field: Vector3) -> float:
        """Return the angle from true to magnetic north, clockwise, radians: the stated one, else that of a field."""
        if self.declination_deg is not None:
            return math.radians(self.declination_deg)
        return math.atan2(field[0], field[1])


def magnetic_field(latitude_deg: float, longitude_deg: float, height: float, utime: int) -> Vector3 | None:
    """Return the earth's field along east, north, up, tesla, to 0.1 degree of place and a month: it is slow.

    None where no model covers the time or the place.
    """
    month = utime // (_YEAR_US // 12) * (_YEAR_US // 12)
    if not magnetism.is_covered(month):
        return None
    return _field(round(latitude_deg, 1), round(longitude_deg, 1), round(height, -3), month)


@lru_cache(maxsize=64)
def _field(latitude_deg: float, longitude_deg: float, height: float, utime: int) -> Vector3 | None:
    try:
        return magnetism.field_at(latitude_deg, longitude_deg, height, utime)
    except magnetism.MagnetismError:
        return None
