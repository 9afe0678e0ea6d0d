"""What is possible in a geometry but improbable: numbers in another unit. Pure.

Each is a warning: what was seen, and what would be expected.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Final

FARTHEST: Final = 30.0
"""Meters from a body's origin, or along a constraint, that a part of a vehicle has at most."""

LARGEST_SIGMA: Final = 0.1
"""Standard deviation of a joint, rad, that a sensor of angles has at most: 6 deg."""

LARGEST_SURVEY_SIGMA: Final = 0.5
"""The same of how well a mount is known, rad: 29 deg."""

LARGEST_ANGLE: Final = math.tau + 0.01
"""Radians beyond which an angle was hardly written as such."""


def is_far(position: Iterable[float]) -> bool:
    """Return whether a position, m, was hardly meant in meters."""
    return math.hypot(*position) > FARTHEST


def looks_like_radians(degrees: float) -> bool:
    """Return whether a number of degrees is a fraction of pi: multiples of 90 deg to two decimals, of 15 to three."""
    size = abs(degrees)
    for unit, decimals in ((math.pi / 2.0, 2), (math.pi / 12.0, 3)):
        count = round(size / unit)
        if 0 < count * unit <= 2.1 * math.pi and any(
            math.isclose(size, round(count * unit, digits), abs_tol=1e-9) for digits in range(decimals, 16)
        ):
            return True
    return False


def looks_like_degrees(radians: float) -> bool:
    """Return whether a number of radians is more than a turn, or a whole number of more than half a one."""
    return abs(radians) > LARGEST_ANGLE or (abs(radians) >= 4.0 and float(radians).is_integer())
