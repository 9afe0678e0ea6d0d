"""A magnetometer's calibration, and the field it should feel."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

from modelserver import magnetism
from modelserver.spatial.so3 import Vector3

_YEAR_US = 31_557_600_000_000


@dataclass(frozen=True, slots=True)
class MagnetometerCalibration:
    """What the vehicle's own iron does to the field: felt = soft_iron^-1 field + hard_iron.

    hard_iron: along the unit's axes, tesla. soft_iron: 3 x 3, row-major. `modelserver calibrate magnetometer`
    finds both.
    """

    __pydantic_config__: ClassVar[dict[str, object]] = {"extra": "forbid", "strict": True, "allow_inf_nan": False}

    hard_iron: Vector3 = (0.0, 0.0, 0.0)
    soft_iron: tuple[float, float, float, float, float, float, float, float, float] = (1, 0, 0, 0, 1, 0, 0, 0, 1)

    def applied(self, felt: Vector3) -> Vector3:
        """Return the field without the vehicle's share, along the unit's axes, tesla."""
        x, y, z = (a - b for a, b in zip(felt, self.hard_iron, strict=True))
        a, b, c, d, e, f, g, h, i = self.soft_iron
        return (a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z)


def magnetic_field(latitude_deg: float, longitude_deg: float, height: float, utime: int) -> Vector3:
    """Return the earth's field along east, north, up, tesla, to 0.1 degree of place and a month: it is slow."""
    month = utime // (_YEAR_US // 12) * (_YEAR_US // 12)
    return _field(round(latitude_deg, 1), round(longitude_deg, 1), round(height, -3), month)


@lru_cache(maxsize=64)
def _field(latitude_deg: float, longitude_deg: float, height: float, utime: int) -> Vector3:
    return magnetism.field_at(latitude_deg, longitude_deg, height, utime)
