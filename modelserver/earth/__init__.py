"""The earth: origin of the relative grid World:UTM; geodesy, gravity and rotation, magnetic field in its modules."""

from __future__ import annotations

from dataclasses import dataclass

from modelserver.transforms.so3 import Vector3


@dataclass(frozen=True, slots=True)
class Origin:
    """Origin of World:UTM: grid coordinates in a pinned zone, ellipsoidal height, meters.

    `origin_id` identifies it and changes with any of the numbers.
    """

    easting: float
    northing: float
    height: float
    zone: int
    north: bool
    origin_id: int

    @property
    def initial_utm(self) -> Vector3:
        """Grid easting, grid northing, height above the ellipsoid, meters."""
        return (self.easting, self.northing, self.height)
