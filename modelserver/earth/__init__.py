"""The earth: origin of the relative grid World:UTM, normal gravity (Somigliana) and Earth rotation.

Gravity and rotation are as a stationary IMU measures them. Source: NGA.STND.0036, WGS 84, 2014: rotation rate
(table 3.1), normal gravity on the ellipsoid (eq. 4-1) and its decrease with height (eq. 4-3). Geodesy, which loads
pyproj, and the magnetic field are in modules of their own.
"""

from __future__ import annotations

import math
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


ROTATION_RATE = 7.292115e-5
"""Of the earth, rad/s."""

_A = 6378137.0
_F = 1.0 / 298.257223563
_E2 = 6.69437999014e-3
_GAMMA_EQUATOR = 9.7803253359
_K = 1.931852652458e-3
_M = 3.449786506841e-3


def gravity(latitude_deg: float, height: float) -> float:
    """Return normal gravity, m/s2, at a latitude and a height above the ellipsoid in meters."""
    s2 = math.sin(math.radians(latitude_deg)) ** 2
    surface = _GAMMA_EQUATOR * (1.0 + _K * s2) / math.sqrt(1.0 - _E2 * s2)
    h = height / _A
    return surface * (1.0 - 2.0 * (1.0 + _F + _M - 2.0 * _F * s2) * h + 3.0 * h * h)


def earth_rate(latitude_deg: float) -> Vector3:
    """Return the earth's rotation rate, rad/s, along east, north, up at a latitude."""
    angle = math.radians(latitude_deg)
    return (0.0, ROTATION_RATE * math.cos(angle), ROTATION_RATE * math.sin(angle))
