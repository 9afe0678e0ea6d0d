"""Kinds of vehicles that `modelserver new` knows: their wheels, their sizes, and where their sensors usually are.

Every length is a typical one and marked to be measured. The base frame is the point that moves straight ahead in a
turn, on the ground: the middle of the rear axle with steered front wheels, else the middle of all wheels.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, Literal, TypeAlias

Place: TypeAlias = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class VehicleTemplate:
    """A kind of vehicle. Lengths in meters; x forward, y left, z up from the base frame.

    `wheels` are the contact points of the wheels with encoders; `settings` are filter settings that the kind needs, and
    `note` is a comment for its vehicle file.
    """

    summary: str
    base: str
    kinematics: Literal["skid_steer", "differential", "ackermann"]
    wheels: Mapping[str, Place]
    antenna: Place
    imu: Place
    camera: Place
    max_speed: float
    settings: Mapping[str, float] = field(default_factory=dict)
    note: str = ""


def _make_four(length: float, width: float) -> dict[str, Place]:
    return {
        f"{end}_{side}": (x, y, 0.0)
        for end, x in (("front", length / 2), ("rear", -length / 2))
        for side, y in (("left", width / 2), ("right", -width / 2))
    }


def _make_two(prefix: str, width: float) -> dict[str, Place]:
    return {f"{prefix}left": (0.0, width / 2, 0.0), f"{prefix}right": (0.0, -width / 2, 0.0)}


MIDDLE: Final = "on the ground in the middle of the wheels"
REAR_AXLE: Final = "on the ground below the middle of the rear axle"

TEMPLATES: Final[Mapping[str, VehicleTemplate]] = {
    "skid": VehicleTemplate(
        "four wheels that do not steer; it turns by skidding",
        MIDDLE,
        "skid_steer",
        _make_four(0.5, 0.6),
        (-0.15, 0.0, 0.6),
        (0.0, 0.0, 0.25),
        (0.3, 0.0, 0.45),
        3.0,
    ),
    "differential": VehicleTemplate(
        "two driven wheels and a caster",
        "on the ground in the middle of the two driven wheels",
        "differential",
        _make_two("", 0.5),
        (-0.1, 0.0, 0.5),
        (0.0, 0.0, 0.2),
        (0.2, 0.0, 0.35),
        3.0,
    ),
    "ackermann": VehicleTemplate(
        "a small vehicle with steered front wheels, encoders on the rear ones",
        REAR_AXLE,
        "ackermann",
        _make_two("rear_", 0.6),
        (0.2, 0.0, 0.9),
        (0.2, 0.0, 0.4),
        (0.8, 0.0, 0.7),
        8.0,
    ),
    "tracked": VehicleTemplate(
        "two tracks",
        "on the ground in the middle of the tracks",
        "skid_steer",
        _make_two("", 0.8),
        (-0.3, 0.0, 0.9),
        (0.0, 0.0, 0.4),
        (0.5, 0.0, 0.6),
        3.0,
    ),
    "mecanum": VehicleTemplate(
        "four mecanum wheels, which also move it sideways",
        MIDDLE,
        "skid_steer",
        _make_four(0.4, 0.4),
        (-0.1, 0.0, 0.5),
        (0.0, 0.0, 0.15),
        (0.2, 0.0, 0.3),
        2.0,
        {"side_sigma": 1.0},
        "The mean speed of mecanum wheels is the speed ahead; nothing measures the one sideways (side_sigma). The\n"
        "heading is found from the way driven: drive straight ahead until the pose is valid.",
    ),
    "car": VehicleTemplate(
        "a road vehicle, wheel speeds of the rear axle",
        REAR_AXLE,
        "ackermann",
        _make_two("rear_", 1.55),
        (0.3, 0.0, 1.6),
        (0.5, 0.0, 0.6),
        (1.6, 0.0, 1.3),
        60.0,
    ),
}
"""Kinds of vehicles by the name that `--vehicle` takes."""
