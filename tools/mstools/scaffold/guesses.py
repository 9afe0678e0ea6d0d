"""Where the sensors of a vehicle are in a geometry that somebody else wrote, guessed from names, joints and shapes.

A guess carries a note for the line that it fills: what it was guessed from, and where it is.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Final, NamedTuple

from modelserver.errors import QueryError
from modelserver.geometry import Body, JointType, Model, ModelBuilder, ShapeKind
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Vector3
from mstools.scaffold.templates import VehicleTemplate

BASE_WORDS: Final = ("base_footprint", "base_link", "base")
GPS_WORDS: Final = ("gnss", "gps", "navsat", "antenna")
IMU_WORDS: Final = ("imu", "ahrs")
WHEEL_WORDS: Final = ("wheel", "tire", "tyre")
NO_WHEEL_WORDS: Final = ("caster", "castor", "steering")

HOLDER_WORDS: Final = ("mount", "bracket", "plate", "base", "wifi", "radio")
"""Words of parts that carry a sensor, or only sound like it: taken where no other part has the name."""

UPRIGHT: Final = 0.7
"""An axis with a component above this one, 45 deg, is along that direction."""

OFF_MIDDLE: Final = 0.03
"""A base frame this far from the middle of the wheels, m, is another point: twice what a drawing is rounded to."""


class Mount(NamedTuple):
    """The frame of something on the vehicle; `note`: what it was guessed from, empty if it was given."""

    frame: str
    note: str = ""


class FrameChoices(NamedTuple):
    """The frames of a new vehicle. `rolling` is the frame that moves straight ahead, where it is not `base`."""

    base: Mount
    gps: Mount | None = None
    imu: Mount | None = None
    wheels: Mapping[str, Mount] = MappingProxyType({})
    rolling: Mount | None = None


class Wheel(NamedTuple):
    """A body that turns about an axle: its center in the base frame and its radius, m, nan where it has no shape."""

    body: str
    center: Vector3
    radius: float
    is_steered: bool


def guess_base(model: Model) -> Mount:
    """Return the frame of the pose: the body, or else the frame, that is named so; else the root's first frame."""
    bodies = {body.name.lower(): body.name for body in model.bodies}
    for word in BASE_WORDS:
        if word in bodies:
            return Mount(_get_main_frame(model, bodies[word]), f"guessed from the name {bodies[word]}")
        for frame in model.root:
            if frame.name.lower() == word:
                return Mount(frame.full_name, "guessed from its name")
    return Mount(next(iter(model.root)).full_name, "guessed: the first frame of the root")


def list_sensor_frames(model: Model, words: Iterable[str]) -> list[str]:
    """Return the frames that may be those of a sensor with one of some names, the likeliest first.

    A part of that name, by its origin, is before a frame of that name on another part; a frame at which a further part
    is fixed stands for that part.
    """
    wanted = tuple(words)
    found: list[tuple[bool, bool, int, str]] = []
    for body in model.bodies:
        if body is not model.root and (rank := _rank_name(body.name, wanted)) is not None:
            found.append((rank[0], False, rank[1], _get_main_frame(model, body.name)))
        for frame in body:
            if (rank := _rank_name(frame.name, wanted)) is not None:
                beyond = [each.to for each in model.constraints_of(frame) if each.from_ == frame.full_name]
                found.append((rank[0], True, rank[1], beyond[0] if len(beyond) == 1 else frame.full_name))
    # sorted is stable: of equals the first in the file
    return list(dict.fromkeys(each[-1] for each in sorted(found, key=lambda each: each[:-1])))


def guess_sensor(model: Model, words: Iterable[str], base: str) -> Mount | None:
    """Return the likeliest frame of a sensor, None if no name fits; the note has its place and the other candidates."""
    frames = list_sensor_frames(model, words)
    if not frames:
        return None
    others = f"; also possible: {', '.join(frames[1:4])}" if len(frames) > 1 else ""
    return Mount(frames[0], f"guessed from its name, {_describe_place(model, frames[0], base)}{others}")


def list_wheels(model: Model, base: str) -> tuple[Wheel, ...]:
    """Return the wheels: bodies so named that turn freely about an axis across the base frame."""
    return tuple(_iterate_wheels(model, base))


def guess_kind(wheels: Sequence[Wheel]) -> str:
    """Return the kind of vehicle, a name in TEMPLATES."""
    if any(wheel.is_steered for wheel in wheels):
        return "ackermann"
    return "differential" if len(wheels) == 2 else "skid"


def add_wheel_frames(
    model: Model, base: str, template: VehicleTemplate, wheels: Sequence[Wheel]
) -> tuple[Model, dict[str, Mount], Mount | None]:
    """Return the model with a frame where each wheel of a template meets the ground, these frames, and the rolling one.

    The frames are on the base frame's body: a wheel's own frame turns with it. A wheel that the geometry does not have
    is at the template's typical place. The rolling frame is added where the base frame is not in the middle of the
    wheels, else None. Raises GeometryError.
    """
    builder = ModelBuilder.from_model(model)
    body = next(each for each in builder.bodies if each.name == base.partition(":")[0])

    def add(stem: str, place: Vector3, note: str) -> Mount:
        taken = {frame.name for frame, _ in body.frames}
        name = next(each for each in (stem, *(f"{stem}{k}" for k in range(2, len(taken) + 3))) if each not in taken)
        body.add_frame(name, model.frame(base).pose @ Pose(place))
        return Mount(f"{body.name}:{name}", note)

    mounts: dict[str, Mount] = {}
    places: list[Vector3] = []
    for name, typical in template.wheels.items():
        stem = "".join(word.capitalize() for word in name.split("_")) + "Contact"
        if turning := _select_wheels(name, wheels):
            places.append(_find_contact(turning, base))
            mounts[name] = add(
                stem,
                places[-1],
                f"guessed: where {', '.join(each.body for each in turning)} "
                f"{'meet' if len(turning) > 1 else 'meets'} the ground, {_format_place(places[-1])} from {base}",
            )
        else:
            mounts[name] = add(stem, typical, "a typical place: the geometry has no such wheel")
    if len(places) < len(mounts):
        return builder.build(), mounts, None
    x, y, z = (sum(each[k] for each in places) / len(places) for k in range(3))
    if math.hypot(x, y) <= OFF_MIDDLE:
        return builder.build(), mounts, None
    rolling = add(
        "RollingCenter", (x, y, z), f"guessed: the middle of these wheels, {_format_place((x, y, z))} from {base}"
    )
    return builder.build(), mounts, rolling


def note_axes(model: Model, unit: Mount, device: str, base: str) -> Mount:
    """Return the frame of an inertial unit whose own z axis is down, noted where the z axis of the frame is up."""
    up = so3.rotate(model.get_transformation(unit.frame, base).pose.wxyz, (0.0, 0.0, 1.0))[2]
    if up < UPRIGHT:
        return unit
    note = f"z of {device} itself is down when it stands upright, that of this frame is up: which way is it mounted?"
    return Mount(unit.frame, f"{unit.note}; {note}" if unit.note else note)


def _iterate_wheels(model: Model, base: str) -> Iterator[Wheel]:
    assembly = next(each for each in model.assemblies if base.partition(":")[0] in each)
    for name, constraint in model.joints.items():
        for end in (constraint.to, constraint.from_):
            body = model.body(end.partition(":")[0])
            words = f"{body.name} {name}"
            if body.name not in assembly or not _fits(body.name, WHEEL_WORDS) or _fits(words, NO_WHEEL_WORDS):
                continue
            if abs(_find_axis(model, name, base)[1]) > UPRIGHT:
                others = [each.name for each in model.get_kinematic_path(end, base).joints if each.name != name]
                steered = any(abs(_find_axis(model, each, base)[2]) > UPRIGHT for each in others)
                yield Wheel(body.name, model.get_transformation(end, base).pose.xyz, _find_radius(body), steered)
                break


def _find_axis(model: Model, joint: str, base: str) -> Vector3:
    """Return the axis about which a joint turns, in the base frame; 0 for a joint that does not turn about one."""
    constraint = model.joints[joint]
    if constraint.joint.type is not JointType.REVOLUTE:
        return (0.0, 0.0, 0.0)
    # turning about the axis does not move it, so that the frame behind the joint has it too
    return so3.rotate(model.get_transformation(constraint.to, base).pose.wxyz, constraint.joint.axis)


def _find_radius(body: Body) -> float:
    """Return the radius of a wheel from its shapes, m; nan where it has none but meshes."""
    shapes = (each for each in (*body.collisions, *body.visuals) if each.kind in (ShapeKind.CYLINDER, ShapeKind.SPHERE))
    return max((each.size[0] for each in shapes), default=math.nan)


def _select_wheels(name: str, wheels: Sequence[Wheel]) -> list[Wheel]:
    """Return the wheels that a template's name means, e.g. rear_left: those of a side, of it those of an end."""
    words = name.split("_")
    sign = 1.0 if "left" in words else -1.0
    side = [wheel for wheel in wheels if sign * wheel.center[1] > OFF_MIDDLE]
    if words[0] not in ("front", "rear") or not side:
        return side
    along = [wheel.center[0] for wheel in side]
    middle = (min(along) + max(along)) / 2.0
    if max(along) - middle <= OFF_MIDDLE:
        # one axle: it is the rear one where only that one has encoders
        return side if words[0] == "rear" else []
    return [wheel for wheel in side if (wheel.center[0] > middle) == (words[0] == "front")]


def _find_contact(wheels: Sequence[Wheel], base: str) -> Vector3:
    """Return where some wheels meet level ground in the middle; at the height of the axle where nothing has a radius.

    A base frame that is called a footprint is on the ground (REP 120).
    """
    x, y, z = (sum(each.center[k] for each in wheels) / len(wheels) for k in range(3))
    radius = sum(each.radius for each in wheels) / len(wheels)
    if "footprint" in base.lower():
        return (x, y, 0.0)
    return (x, y, z - radius if math.isfinite(radius) else z)


def _split_words(name: str) -> list[str]:
    """Return the words of a name in lower case: `IMULink_2` has imu, link."""
    return [word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", name)]


def _fits(name: str, wanted: Iterable[str]) -> bool:
    words = _split_words(name)
    return any(word.startswith(each) or word.endswith(each) for each in wanted for word in words)


def _rank_name(name: str, wanted: Sequence[str]) -> tuple[bool, int] | None:
    """Return the rank of a name by the words that it has, smaller is likelier; None where it has none of them."""
    found = [number for number, word in enumerate(wanted) if _fits(name, [word])]
    return (_fits(name, HOLDER_WORDS), found[0]) if found else None


def _get_main_frame(model: Model, body: str) -> str:
    """Return the frame of a body that stands for it: its origin, else its first frame."""
    there = model.body(body)
    return there.frame("Origin").full_name if there.has_frame("Origin") else next(iter(there)).full_name


def _describe_place(model: Model, frame: str, base: str) -> str:
    try:
        return f"{_format_place(model.get_transformation(frame, base).pose.xyz)} from {base}"
    except QueryError:
        return f"not joined to {base}"


def _format_place(place: Vector3) -> str:
    return f"({', '.join(f'{round(each, 3) + 0.0:g}' for each in place)}) m"
