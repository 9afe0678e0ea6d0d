"""What is possible in a geometry but improbable: numbers in another unit, a constraint the wrong way round. Pure.

Each is a warning: what was seen, and what would be expected.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator
from typing import Final

from modelserver.geometry.parts import Body, Constraint
from modelserver.transforms.pose import Pose

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


def find_reversed(bodies: Iterable[Body], constraints: Iterable[Constraint]) -> Iterator[Constraint]:
    """Yield the constraints of a tree with a pose that begin at the part farther from the first body.

    The pose of a constraint is given in its From: on the new part, an offset is measured from there.
    """
    first = next(iter(bodies), None)
    listed = tuple(constraints)
    if first is None:
        return
    neighbors: dict[str, list[str]] = {}
    ends = {each.name: tuple(end.partition(":")[0] for end in (each.from_, each.to)) for each in listed}
    for a, b in ends.values():
        neighbors.setdefault(a, []).append(b)
        neighbors.setdefault(b, []).append(a)
    distance, waiting = {first.name: 0}, deque([first.name])
    while waiting:
        body = waiting.popleft()
        for other in neighbors.get(body, ()):
            if other not in distance:
                distance[other] = distance[body] + 1
                waiting.append(other)
    for each in listed:
        a, b = ends[each.name]
        if a in distance and distance[a] > distance[b] and not each.pose.is_close(Pose.identity()):
            yield each
