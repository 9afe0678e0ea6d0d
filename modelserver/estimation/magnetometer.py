"""Calibration of a magnetometer, and the field that it should measure."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

from modelserver.earth import magnetism
from modelserver.transforms.so3 import Vector3

_YEAR_US = 31_557_600_000_000


@dataclass(frozen=True, slots=True)
class MagnetometerCalibration:
    """Correction of the measured magnetic field, along the unit's own axes: soft_iron (measured - hard_iron).

    hard_iron: the vehicle's own field, tesla. soft_iron: correction of the distortion by iron, 3 by 3, row-major, no
    unit. `modelserver calibrate magnetometer` finds both. declination_deg: true yaw of magnetic north at the place,
    degrees, east positive; default: that of the World Magnetic Model.
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

    def apply(self, measured: Vector3) -> Vector3:
        """Return the field corrected for the vehicle's own, along the unit's axes, tesla."""
        x, y, z = (a - b for a, b in zip(measured, self.hard_iron, strict=True))
        a, b, c, d, e, f, g, h, i = self.soft_iron
        return (a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z)

    def declination(self, field: Vector3) -> float:
        """Return the angle from true to magnetic north, clockwise, radians: the configured one, else by `field`."""
        if self.declination_deg is not None:
            return math.radians(self.declination_deg)
        return math.atan2(field[0], field[1])


def magnetic_field(latitude_deg: float, longitude_deg: float, height: float, utime: int) -> Vector3 | None:
    """Return the earth's field along east, north, up, tesla, cached for 0.1 degree of place and a month.

    None where no model covers the time or the place.
    """
    month = utime // (_YEAR_US // 12) * (_YEAR_US // 12)
    if not magnetism.is_covered(month):
        return None
    return _compute_field(round(latitude_deg, 1), round(longitude_deg, 1), round(height, -3), month)


@lru_cache(maxsize=64)
def _compute_field(latitude_deg: float, longitude_deg: float, height: float, utime: int) -> Vector3 | None:
    try:
        return magnetism.field_at(latitude_deg, longitude_deg, height, utime)
    except magnetism.MagnetismError:
        return None
