"""`modelserver new`: the files of a new vehicle, from a few questions; kinds of vehicles, guessed frames, and texts.

Every length is a typical one; what must be measured is marked MEASURE. The base frame is the point that moves straight
ahead in a turn, on the ground: the middle of the rear axle with steered front wheels, else the middle of all wheels. In
a geometry that somebody else wrote, the sensors are guessed from names, joints and shapes; a guess carries a note for
the line that it fills: what it was guessed from, and where it is.
"""

from __future__ import annotations

import dataclasses
import math
import re
import shlex
import sys
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Final, Literal, NamedTuple, TypeAlias

import typer
import yaml

from modelserver.errors import ModelServerError, QueryError, find_nearest_names, quote
from modelserver.formats import check_file, save_model
from modelserver.geometry import Body, JointType, Model, ModelBuilder, Shape, ShapeKind, names
from modelserver.messages import GpsSample, ImuSample
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Vector3
from msdrivers.registry import KINDS, CanSettings, DeviceKind, ModbusSettings, SerialSettings, TcpSettings
from mstools import shapes
from mstools.commands.check import check_vehicle
from mstools.robot_localization import EkfSettings, read_ekf_settings
from mstools.terminal.options import choose_name, option
from mstools.terminal.output import escape, print_problems, write_file

Place: TypeAlias = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class VehicleTemplate:
    """A kind of vehicle. Lengths in meters; x forward, y left, z up from the base frame.

    `wheels` are the contact points of the wheels with encoders; `shapes` are what is drawn of the kind. `settings` are
    filter settings that it needs, and `note` is a comment for its vehicle file.
    """

    summary: str
    base: str
    kinematics: Literal["skid_steer", "differential", "ackermann"]
    wheels: Mapping[str, Place]
    antenna: Place
    imu: Place
    camera: Place
    max_speed: float
    shapes: Sequence[Shape]
    settings: Mapping[str, float] = field(default_factory=dict)
    note: str = ""

    def with_two_wheels(self) -> VehicleTemplate:
        """Return the kind with the wheels `left` and `right` of `import-bag`, in the middle of its own."""
        x, y = (sorted(place[axis] for place in self.wheels.values()) for axis in (0, 1))
        middle = 0.5 * (x[0] + x[-1])
        sides = {"left": (middle, y[-1], 0.0), "right": (middle, y[0], 0.0)}
        return dataclasses.replace(self, wheels=sides)


def _make_four(length: float, width: float) -> dict[str, Place]:
    return {
        f"{end}_{side}": (x, y, 0.0)
        for end, x in (("front", length / 2), ("rear", -length / 2))
        for side, y in (("left", width / 2), ("right", -width / 2))
    }


def _make_two(prefix: str, width: float) -> dict[str, Place]:
    return {f"{prefix}left": (0.0, width / 2, 0.0), f"{prefix}right": (0.0, -width / 2, 0.0)}


def _draw_wheels(places: Iterable[Place], radius: float, width: float) -> list[Shape]:
    return [shape for place in places for shape in shapes.make_wheel(place, radius, width)]


def _draw_tracks(width: float, length: float, radius: float, breadth: float) -> list[Shape]:
    """Return two tracks: two rollers each, and what runs around them."""
    drawn = []
    for y in (width / 2, -width / 2):
        drawn += _draw_wheels(((x, y, 0.0) for x in (length / 2 - radius, radius - length / 2)), radius, breadth)
        drawn.append(shapes.make_box((length - 2 * radius, breadth, 2 * radius), (0.0, y, radius), shapes.RUBBER))
    return drawn


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
        [
            *_draw_wheels(_make_four(0.5, 0.6).values(), 0.165, 0.11),
            shapes.make_box((0.85, 0.46, 0.2), (0.0, 0.0, 0.22), shapes.DARK),
            shapes.make_box((0.72, 0.46, 0.05), (0.0, 0.0, 0.345), shapes.PAINT),
        ],
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
        [
            *_draw_wheels(_make_two("", 0.5).values(), 0.1, 0.04),
            Shape(ShapeKind.SPHERE, (0.04,), Pose((-0.22, 0.0, 0.04)), material=shapes.RUBBER),
            shapes.make_box((0.52, 0.42, 0.14), (-0.04, 0.0, 0.16), shapes.DARK),
            shapes.make_box((0.52, 0.42, 0.04), (-0.04, 0.0, 0.25), shapes.PAINT),
        ],
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
        [
            *_draw_wheels(((x, y, 0.0) for x in (0.0, 0.8) for y in (0.3, -0.3)), 0.2, 0.13),
            shapes.make_box((1.25, 0.44, 0.22), (0.4, 0.0, 0.31), shapes.DARK),
            shapes.make_box((0.95, 0.56, 0.16), (0.4, 0.0, 0.5), shapes.PAINT),
        ],
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
        [
            *_draw_tracks(0.8, 1.3, 0.16, 0.18),
            shapes.make_box((1.15, 0.6, 0.3), (0.0, 0.0, 0.31), shapes.DARK),
            shapes.make_box((1.0, 0.6, 0.08), (0.0, 0.0, 0.5), shapes.PAINT),
        ],
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
        [
            *_draw_wheels(_make_four(0.4, 0.4).values(), 0.1, 0.08),
            shapes.make_box((0.58, 0.3, 0.14), (0.0, 0.0, 0.14), shapes.DARK),
            shapes.make_box((0.5, 0.3, 0.03), (0.0, 0.0, 0.225), shapes.PAINT),
        ],
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
        [
            # wheelbase 2.7 m, tires 205/55 R16
            *_draw_wheels(((x, y, 0.0) for x in (0.0, 2.7) for y in (0.775, -0.775)), 0.316, 0.205),
            shapes.make_box((4.4, 1.34, 0.2), (1.35, 0.0, 0.33), shapes.DARK),
            shapes.make_box((4.3, 1.66, 0.48), (1.35, 0.0, 0.66), shapes.PAINT),
            shapes.make_box((2.4, 1.48, 0.36), (0.55, 0.0, 1.08), shapes.GLASS),
            shapes.make_box((2.3, 1.45, 0.04), (0.6, 0.0, 1.28), shapes.PAINT),
        ],
    ),
}
"""Kinds of vehicles by the name that `--vehicle` takes."""

CAMERA_VIEW: Final = (math.radians(60.0), math.radians(45.0), 0.3)
"""Angles of view of the drawn camera, wide and high, and how far it is drawn, m: those of a usual 4:3 camera."""

LENS: Final[Place] = (0.03, 0.0, 0.02)
"""The entrance pupil of the camera from where it is fixed."""


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
        stem = _name_part(name, "Contact")
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


def iterate_wheels(model: Model, base: str) -> Iterator[Wheel]:
    """Yield the wheels: bodies so named that turn freely about an axis across the base frame."""
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


MARK: Final = "MEASURE"
"""Word in the comment of each line that must be adapted to the vehicle."""

GEOMETRY_FILE, VEHICLE_FILE, DBC_FILE = "geometry.yaml", "vehicle.yaml", "wheels.dbc"


@dataclass(frozen=True, slots=True)
class Device:
    """A device of the new vehicle and its line: the path of a port, a CAN channel, or HOST:PORT.

    kind: None where a program of the user or a log has its samples, and there is no driver.
    """

    kind: DeviceKind | None
    line: str = ""

    @property
    def has_z_down(self) -> bool:
        """Whether it is a unit whose own z axis is down when it stands upright."""
        return self.kind is not None and self.kind.has_z_down

    @property
    def line_key(self) -> str:
        """The key of the line in a driver's section: by its form, where the kind has several."""
        assert self.kind is not None
        keys = {SerialSettings: "port", TcpSettings: "address", CanSettings: "can", ModbusSettings: "address"}
        if SerialSettings in self.kind.lines and TcpSettings in self.kind.lines:
            return "address" if "/" not in self.line and ":" in self.line else "port"
        return keys[self.kind.lines[0]]


@dataclass(frozen=True, slots=True)
class NewVehicle:
    """What is on a new vehicle.

    `head` is the pan-tilt head below the camera; `given` are the frames in a geometry that exists, `ekf` the settings
    of robot_localization.
    """

    name: str
    template: VehicleTemplate
    gps: Device | None = None
    imu: Device | None = None
    wheels: Device | None = None
    has_camera: bool = False
    head: Device | None = None
    given: FrameChoices | None = None
    ekf: EkfSettings | None = None

    @property
    def mounts(self) -> FrameChoices:
        """The frames of the vehicle: those in a geometry that exists, else those of `make_geometry`."""
        if self.given is not None:
            return self.given
        wheels = {name: Mount(f"{self.body}:{_name_part(name, 'Wheel')}") for name in self.template.wheels}
        base, gps, imu = (Mount(f"{self.body}:{frame}") for frame in ("Base", "Antenna", "ImuUnit"))
        return FrameChoices(base, gps, imu, wheels)

    @property
    def body(self) -> str:
        words = "".join(character if character.isalnum() else " " for character in self.name).split()
        name = "".join(word[:1].upper() + word[1:] for word in words) or "Vehicle"
        return f"{name}Vehicle" if name in ("Camera", "Head") else name


def make_geometry(vehicle: NewVehicle) -> str:
    template, body = vehicle.template, vehicle.body

    def frame(name: str, place: Place, comment: str, more: str = "") -> str:
        x, y, z = place
        return f"      {name}: {{xyz: [{x:g}, {y:g}, {z:g}]{more}}}   # {comment}"

    lines = [
        "modelserver: geometry/1",
        f"name: {vehicle.name}",
        "",
        "# Axes: x forward, y left, z up. Meters and degrees. A frame is given in the coordinates of its body; the",
        f"# origin of {body} is the frame Base, {template.base}.",
        f"# A line with {MARK} has a typical length: measure it on your vehicle, and remove the word.",
        "",
        "defaults:",
        f"  sigma: {{xyz: 0.02, rpy_deg: 1}}   # {MARK}: how well you measured, one standard deviation",
        "",
        "bodies:",
        f"  {body}:",
        "    frames:",
        f"      Base: {{}}   # {template.base}",
    ]
    if vehicle.wheels is not None:
        for name, place in template.wheels.items():
            lines.append(frame(_name_part(name, "Wheel"), place, f"{MARK}: where the wheel touches the ground"))
    if vehicle.gps is not None:
        lines.append(frame("Antenna", template.antenna, f"{MARK}: phase center of the antenna"))
    if vehicle.imu is not None:
        comment = f"{MARK}: the unit and its own axes; here x forward, y left, z up"
        more = ", rpy_deg: [0, 0, 0]"
        if vehicle.imu.has_z_down:
            more, comment = ", rpy_deg: [180, 0, 0]", f"{MARK}: the unit and its own axes; here x forward, z down"
        lines.append(frame("ImuUnit", template.imu, comment, more))
    if vehicle.has_camera:
        what = f"{MARK}: where the {'head' if vehicle.head else 'camera'} is fixed"
        lines.append(frame("CameraMount", template.camera, what))
    lines += _list_visuals(_draw_vehicle(vehicle), "    # what viewers draw, of typical size; it changes no answer")
    if vehicle.has_camera:
        if vehicle.head:
            lines += [*_HEAD_BODY, *_list_visuals([shapes.make_disc(0.035, 0.05, (0.0, 0.0, 0.025), shapes.DARK)])]
        lines += [
            "  Camera:",
            "    frames:",
            "      Mount: {}",
            "      # the optical frame: z ahead out of the lens, x right, y down in the image",
            frame("Lens", LENS, f"{MARK}: the entrance pupil", ", rpy_deg: [-90, 0, -90]"),
            *_list_visuals(_draw_camera()),
            "",
            "constraints:",
            *(_make_head_joints(body) if vehicle.head else _fix_camera(body)),
        ]
    return "\n".join(lines) + "\n"


def _list_visuals(drawn: Iterable[Shape], comment: str = "") -> Iterator[str]:
    if comment:
        yield comment
    yield "    visuals:"
    yield from (f"      {line}" for line in shapes.format_shapes(drawn))


def _draw_vehicle(vehicle: NewVehicle) -> Iterator[Shape]:
    """Yield the shapes of a vehicle's body and of what is fixed on it, on masts where that is above the hull."""
    template = vehicle.template
    yield from template.shapes
    if vehicle.gps is not None:
        x, y, z = template.antenna
        # of a geodetic antenna's size; the phase center is a little below its top
        yield shapes.make_disc(0.07, 0.05, (x, y, z - 0.015), shapes.ANTENNA)
        yield from _draw_mast((x, y, z - 0.04), template.shapes)
    if vehicle.imu is not None:
        yield shapes.make_box((0.06, 0.05, 0.03), template.imu, shapes.DEVICE)
    if vehicle.has_camera:
        yield from _draw_mast(template.camera, template.shapes)


def _draw_mast(top: Place, hull: Iterable[Shape]) -> Iterator[Shape]:
    """Yield the mast below a place, down to the highest box of a hull there; none where the place is in it."""
    x, y, z = top
    below = [
        each.pose.xyz[2] + each.size[2] / 2.0
        for each in hull
        if each.kind is ShapeKind.BOX
        and abs(x - each.pose.xyz[0]) <= each.size[0] / 2.0
        and abs(y - each.pose.xyz[1]) <= each.size[1] / 2.0
    ]
    if below and z > max(below):
        yield shapes.make_disc(0.012, z - max(below), (x, y, (z + max(below)) / 2.0), shapes.METAL)


def _draw_camera() -> Iterator[Shape]:
    """Yield the housing of the camera behind its lens, the lens, and what it sees."""
    x, y, z = LENS
    yield shapes.make_box((0.06, 0.07, 0.04), (x - 0.03, y, z), shapes.DARK)
    yield shapes.make_beam((x, y, z), (x + 0.01, y, z), 0.03, shapes.GLASS)
    yield from shapes.make_frustum(Pose(LENS), *CAMERA_VIEW)


_HEAD_BODY: Final = (
    "  Head:   # the part between the two axes of the pan-tilt head",
    "    frames:",
    "      Base: {}",
    f"      TiltAxis: {{xyz: [0, 0, 0.05]}}   # {MARK}: height of the tilt axis above the mount",
)


def _fix_camera(body: str) -> Iterator[str]:
    yield "  CameraFixed:"
    yield f'    {{from: "{body}:CameraMount", to: "Camera:Mount", rpy_deg: [0, 0, 0]}}   # {MARK}: its tilt'


def _make_head_joints(body: str) -> Iterator[str]:
    yield "  # positions come from the driver head; positive turns about the axis: to the left, and up"
    for name, base, moved, axis, limits in (
        ("Pan", f"{body}:CameraMount", "Head:Base", "[0, 0, 1]", "[-170, 170]"),
        ("Tilt", "Head:TiltAxis", "Camera:Mount", "[0, -1, 0]", "[-60, 60]"),
    ):
        yield f"  {name}:   # {MARK}: sense of its axis, limits, accuracy"
        yield f'    from: "{base}"'
        yield f'    to: "{moved}"'
        yield f"    joint: {{type: revolute, axis: {axis}, limits_deg: {limits}, sigma_deg: 0.5}}"


def _name_part(wheel: str, suffix: str) -> str:
    """Return the name of something of a wheel: rear_left with Wheel is RearLeftWheel."""
    return "".join(word.capitalize() for word in wheel.split("_")) + suffix


def make_vehicle(vehicle: NewVehicle) -> str:
    template, mounts = vehicle.template, vehicle.mounts
    lines = [
        f"# {vehicle.name}: {template.summary}.",
        "# Check with: modelserver check vehicle.yaml. All keys: docs/vehicle-file.md.",
        *(f"# {line}" for line in template.note.splitlines()),
        f"vehicle: {vehicle.name}",
        f"geometry: {GEOMETRY_FILE}",
        f'base_frame: "{mounts.base.frame}"{_mark(mounts.base) or "   # POSE describes this frame"}',
        *(f'rolling_frame: "{each.frame}"{_mark(each)}' for each in (mounts.rolling,) if each is not None),
        "state_directory: state   # the origin, and the state for the next start",
        "journal: {directory: journal, megabytes: 256}   # all inputs and outputs, to replay; the oldest are deleted",
    ]
    if vehicle.ekf is not None:
        lines += _list_settings(vehicle.ekf)
    if sensors := list(_list_sensors(vehicle, mounts)):
        lines += ["", "sensors:", *sensors]
    if template.settings:
        lines += [
            "",
            "localization:",
            "  filter:",
            *(f"    {key}: {value:g}" for key, value in template.settings.items()),
        ]
    if drivers := list(_list_drivers(vehicle)):
        lines += [
            "",
            "# modelserver up runs the service and all of these; modelserver driver --list shows the ports.",
            "drivers:",
        ]
        lines += drivers
    return "\n".join(lines) + "\n"


def _list_settings(ekf: EkfSettings) -> Iterator[str]:
    if ekf.rate_hz:
        yield f"publish: {{rate_hz: {ekf.rate_hz:g}}}"
    if ekf.origin is not None:
        utm = ", ".join(f"{each:.4f}" for each in ekf.origin.initial_utm)
        hemisphere = "north" if ekf.origin.north else "south"
        yield f"origin: {{initial_utm: [{utm}], zone: {ekf.origin.zone}, hemisphere: {hemisphere}}}"


def _list_sensors(vehicle: NewVehicle, mounts: FrameChoices) -> Iterator[str]:
    for name, device, mount in (("gps", vehicle.gps, mounts.gps), ("imu", vehicle.imu, mounts.imu)):
        if device is not None and mount is not None:
            yield f'  {name}: {{channel: {name.upper()}, frame: "{mount.frame}"}}{_mark(mount)}'
    if vehicle.wheels is not None:
        yield "  wheels:"
        yield "    channel: WHEELS"
        yield f"    kinematics: {vehicle.template.kinematics}"
        yield "    frames:"
        yield from (f'      {name}: "{mount.frame}"{_mark(mount)}' for name, mount in mounts.wheels.items())


def _mark(mount: Mount) -> str:
    return f"   # {MARK}: {mount.note}" if mount.note else ""


def _list_drivers(vehicle: NewVehicle) -> Iterator[str]:
    for name, device in (("gps", vehicle.gps), ("imu", vehicle.imu)):
        if device is not None and device.kind is not None:
            yield f"  {name}:   # {device.kind.description}"
            yield f"    device: {device.kind.name}"
            yield f"    {device.line_key}: {_quote(device.line)}   # {MARK}: its line on this machine"
            yield from (f"    {line}" for line in device.kind.example)
    if vehicle.wheels is not None and vehicle.wheels.kind is not None:
        yield f"  wheels:   # {vehicle.wheels.kind.description}"
        yield f"    device: {vehicle.wheels.kind.name}"
        channel = vehicle.wheels.line
        yield f"    can: {_quote(channel)}   # {MARK}: sudo ip link set {channel} up type can bitrate 500000"
        yield f"    dbc: {DBC_FILE}   # {MARK}: the frames that your controller sends; this one is an example"
        yield f"    max_speed: {vehicle.template.max_speed:g}   # m/s: a higher one is damage"
        yield "    wheels:"
        for name in vehicle.template.wheels:
            yield f"      {name}:"
            yield f"        count:   # {MARK}: the distance of one count is circumference / counts per turn"
            yield f"          {{signal: WheelCounts.{_name_part(name, 'Count')}, meters_per_count: 0.001}}"
    if vehicle.head is not None and vehicle.head.kind is not None:
        yield f"  head:   # {vehicle.head.kind.description}"
        yield f"    device: {vehicle.head.kind.name}"
        yield f"    {vehicle.head.line_key}: {_quote(vehicle.head.line)}   # {MARK}: its line on this machine"
        yield f"    baud: 57600   # {MARK}: its rate"
        yield "    columns: 2"
        yield f"    joints:   # {MARK}: the columns of its lines, here degrees such as 12.5,-3.25"
        yield "      Pan: {column: 0, scale: 0.0174533}"
        yield "      Tilt: {column: 1, scale: 0.0174533}"


def _quote(line: str) -> str:
    return f'"{line}"' if ":" in line else line


def make_dbc(vehicle: NewVehicle) -> str:
    """Return the text of an example DBC file: a 16-bit counter for each wheel, up when it rolls forward."""
    signals = "\n".join(
        f' SG_ {_name_part(name, "Count")} : {16 * number}|16@1+ (1,0) [0|65535] "" Computer'
        for number, name in enumerate(vehicle.template.wheels)
    )
    head = f'VERSION "{vehicle.name}"\n\nNS_ :\n\nBS_:\n\nBU_: Controller Computer\n\n'
    return f"{head}BO_ 256 WheelCounts: {2 * len(vehicle.template.wheels)} Controller\n{signals}\n"


def list_marks(folder: Path, files: Iterator[str] | tuple[str, ...]) -> Iterator[str]:
    """Yield `file:line: what` for each line of some files that must be adapted."""
    for name in files:
        for number, line in enumerate((folder / name).read_text(encoding="utf-8").splitlines(), 1):
            head, mark, what = line.partition(f"# {MARK}: ")
            if mark:
                yield f"{name}:{number}: {head.split(':')[0].strip(' {')}: {what}"


def list_kinds(kinds: Mapping[str, DeviceKind], sample: type[GpsSample] | type[ImuSample]) -> dict[str, DeviceKind]:
    return {name: kind for name, kind in kinds.items() if kind.sample is sample}


NONE: Final = "none"
OWN: Final = "own"
"""Answers for a device that is not there, and for one whose samples a program of the user publishes or a log has."""

DEFAULT_PORT, DEFAULT_ADDRESS = "/dev/ttyUSB{}", "127.0.0.1:2947"
"""Lines of devices where this machine has none: gpsd has this address."""

DEFAULT_GPS, DEFAULT_IMU, DEFAULT_CAN = "ublox", "gx1", "can0"

MAX_NAME: Final = 40


def command(
    folder: Annotated[Path, typer.Argument(metavar="[DIR]", help="Folder for the files. Default: this one.")] = Path(),
    name: Annotated[str, option("--name NAME", "Name of the vehicle. Default: that of the folder.")] = "",
    vehicle: Annotated[str, option("--vehicle KIND", f"One of {', '.join(TEMPLATES)}.")] = "",
    gps: Annotated[
        str, option("--gps DEVICE[@LINE]", "GNSS receiver, e.g. ublox@/dev/ttyACM0, novatel@10.0.0.7:3001; own; none.")
    ] = "",
    imu: Annotated[str, option("--imu DEVICE[@LINE]", "Inertial unit, e.g. gx1@/dev/ttyUSB1; own; none.")] = "",
    wheels: Annotated[str, option("--wheels CHANNEL", "CAN channel of the wheel encoders, e.g. can0; own; none.")] = "",
    camera: Annotated[bool | None, option("--camera/--no-camera", "Whether there is a camera.")] = None,
    pan_tilt: Annotated[
        str, option("--pan-tilt LINE", "Port of a pan-tilt head below the camera, e.g. /dev/ttyUSB2; none.")
    ] = "",
    urdf: Annotated[
        Path | None, option("--from-urdf FILE", "Take the geometry from this URDF or geometry file.")
    ] = None,
    from_ekf: Annotated[
        Path | None, option("--from-ekf FILE", "Take what robot_localization's parameters (ekf.yaml) state.")
    ] = None,
    base_frame: Annotated[str, option("--base-frame FRAME", "With --from-urdf: the frame of the pose.")] = "",
    gps_frame: Annotated[str, option("--gps-frame FRAME", "With --from-urdf: the phase center of the antenna.")] = "",
    imu_frame: Annotated[str, option("--imu-frame FRAME", "With --from-urdf: the inertial unit.")] = "",
    yes: Annotated[bool, option("--yes -y", "Ask nothing: what no option gives has its default.")] = False,
    force: Annotated[bool, option("--force", "Replace files that exist.")] = False,
) -> None:
    """Write the files of a new vehicle: geometry, vehicle file, and a DBC file if it has wheels on a CAN bus.

    Asks what is on the vehicle, and proposes the ports that are there. An option answers its question; `own` is a
    sensor without a driver, whose samples a program of yours publishes or a log has. The lengths in the files are
    typical ones; what must be measured is marked and listed.

    \b
    Examples:
      modelserver new rover
      modelserver new rover --yes --vehicle skid --gps ublox@/dev/ttyACM0 --imu gx1@/dev/ttyUSB0 --wheels can0 --camera
      modelserver new arm --from-urdf arm.urdf --base-frame base_link
      modelserver new rover --yes --from-urdf robot.urdf --from-ekf ekf.yaml
    """
    for option_name, given in (("--base-frame", base_frame), ("--gps-frame", gps_frame), ("--imu-frame", imu_frame)):
        if given and urdf is None:
            raise typer.BadParameter("goes with --from-urdf", param_hint=option_name)
    has_head = pan_tilt not in ("", NONE)
    if has_head and (camera is False or urdf is not None):
        raise typer.BadParameter("goes with --camera, and without --from-urdf", param_hint="--pan-tilt")
    camera = True if has_head else camera
    ask = Questions(is_asking=not yes and sys.stdin.isatty())
    model = None if urdf is None else _load_geometry(urdf)
    ekf = None if from_ekf is None else read_ekf_settings(from_ekf)
    if model is not None and ekf is not None and not base_frame and ekf.base_frame in model.get_body_list():
        base_frame = ekf.base_frame
    known = {name: f"{each.summary}" for name, each in TEMPLATES.items()}
    name = _check_name(ask.text("Name of the vehicle", name, folder.resolve().name or "vehicle"))
    base = (
        None
        if model is None
        else Mount(_check_frame(model, base_frame, "--base-frame"))
        if base_frame
        else guess_base(model)
    )
    turning = () if model is None or base is None else tuple(iterate_wheels(model, base.frame))
    kind = ask.choice(
        "Which kind of vehicle is it?", vehicle, known, guess_kind(turning) if turning else "skid", "--vehicle"
    )
    gps_default, imu_default = DEFAULT_GPS, DEFAULT_IMU
    wheels_default = propose_can() if model is None or turning else NONE
    if ekf is not None:
        gps_default, imu_default, wheels_default = (
            OWN if each else NONE for each in (ekf.has_gps, ekf.has_imu, ekf.has_wheels)
        )
    wanted = NewVehicle(
        name,
        TEMPLATES[kind],
        ask.device("GNSS receiver", gps, list_kinds(KINDS, GpsSample), gps_default, "--gps"),
        ask.device("Inertial unit", imu, list_kinds(KINDS, ImuSample), imu_default, "--imu"),
        ask.wheels(wheels, wheels_default),
        model is None and ask.flag("Is there a camera?", camera),
        ekf=ekf,
    )
    if wanted.wheels is not None and wanted.wheels.kind is None:
        wanted = dataclasses.replace(wanted, template=wanted.template.with_two_wheels())
    if wanted.has_camera:
        wanted = dataclasses.replace(wanted, head=ask.head(pan_tilt))
    if model is not None and base is not None:
        model, mounts = find_mounts(model, base, wanted, turning, gps_frame, imu_frame)
        wanted = dataclasses.replace(wanted, given=mounts)
    files = {GEOMETRY_FILE: make_geometry(wanted) if model is None else save_model(model, "yaml").text}
    if wanted.wheels is not None and wanted.wheels.kind is not None:
        files[DBC_FILE] = make_dbc(wanted)
    files[VEHICLE_FILE] = make_vehicle(wanted)
    write_files(folder, files, force)
    if ekf is not None and from_ekf is not None:
        for line in ekf.to_lines(from_ekf):
            typer.echo(escape(line))
        if base is not None and ekf.base_frame and names.complete(ekf.base_frame) != base.frame:
            typer.echo(
                escape(
                    f"  base_link_frame {ekf.base_frame} is not used: base_frame is {base.frame}; --base-frame sets it"
                )
            )
        for key, is_there in (("gps", ekf.has_gps), ("imu", ekf.has_imu), ("wheels", ekf.has_wheels)):
            if not is_there and getattr(wanted, key) is None:
                typer.echo(f"  no source of {key}, so the vehicle file has no sensors.{key}; --{key} own adds it")
        typer.echo()
    show_result(folder, files, find_next(wanted, model))


class Questions:
    """The answers to questions: given by an option, else asked, else the default."""

    def __init__(self, *, is_asking: bool):
        self._is_asking = is_asking
        self._used: set[str] = set()

    def text(self, question: str, given: str, default: str) -> str:
        if given or not self._is_asking:
            return given or default
        return str(typer.prompt(question, default=default)).strip()

    def flag(self, question: str, given: bool | None) -> bool:
        if given is not None or not self._is_asking:
            return bool(given)
        return typer.confirm(question, default=False)

    def choice(self, question: str, given: str, known: Mapping[str, str], default: str, option_name: str) -> str:
        """Return one of the names in `known`, whose values describe them."""
        if given:
            return choose_name(given, known, "choice", option_name)
        if not self._is_asking:
            return default
        typer.echo(question)
        for each, text in known.items():
            typer.echo(f"  {each:<14}{text}")
        while (answer := self.text("Your choice", "", default)) not in known:
            near = find_nearest_names(answer, known)
            typer.echo(f"  {quote(answer, 40)} is none of these" + (f"; did you mean {near[0]}?" if near else ""))
        return answer

    def device(
        self, what: str, given: str, kinds: Mapping[str, DeviceKind], default: str, option_name: str
    ) -> Device | None:
        """Return a device and its line; None for none."""
        name, _, line = given.partition("@")
        known = {each: kind.description for each, kind in kinds.items()}
        known |= {OWN: "a program of yours publishes its samples, or a log has them", NONE: "there is none"}
        name = self.choice(f"{what}: which device?", name, known, default, option_name)
        if name in (NONE, OWN):
            return Device(None) if name == OWN else None
        kind = kinds[name]
        line = _check_line(self.text(f"{what}: its port", line, propose_line(kind, self._used)), kind, option_name)
        self._used.add(line)
        return Device(kind, line)

    def head(self, given: str) -> Device | None:
        """Return the pan-tilt head that carries the camera; None for none."""
        question = "Port of the pan-tilt head below the camera (none: it is fixed)"
        line, kind = self.text(question, given, NONE), KINDS["text_joints"]
        return None if line == NONE else Device(kind, _check_line(line, kind, "--pan-tilt"))

    def wheels(self, given: str, default: str) -> Device | None:
        """Return the wheels on a CAN bus; None for none."""
        channel = self.text("CAN channel of the wheel encoders (own: others publish them, none)", given, default)
        if channel in (NONE, OWN):
            return Device(None) if channel == OWN else None
        return Device(KINDS["wheels"], _check_line(channel, KINDS["wheels"], "--wheels"))


def propose_line(kind: DeviceKind, used: Collection[str]) -> str:
    """Return the port that a device is probably on: one with something plugged in, which no other device has."""
    if SerialSettings not in kind.lines:
        return DEFAULT_ADDRESS
    from msdrivers.links.serial_port import find_ports

    ports = [port.path for port in find_ports() if "USB" in port.path or "ACM" in port.path]
    return next(port for port in (*ports, *(DEFAULT_PORT.format(n) for n in range(9))) if port not in used)


def propose_can() -> str:
    """Return the first CAN interface of this machine, else a usual name."""
    from msdrivers.links.can_bus import list_can_interfaces

    return next(iter(list_can_interfaces()), DEFAULT_CAN)


def _check_name(name: str) -> str:
    if not (0 < len(name) <= MAX_NAME and all(each.isalnum() or each in "-_. " for each in name) and name[0].isalpha()):
        raise typer.BadParameter(
            f"{quote(name, 60)}: a name begins with a letter and has letters, digits, - and _, at most {MAX_NAME}",
            param_hint="--name",
        )
    if not isinstance(yaml.safe_load(name), str):
        raise typer.BadParameter(f"{name} is a value in YAML, and no name: choose another", param_hint="--name")
    return name


def _check_line(line: str, kind: DeviceKind, option_name: str) -> str:
    """Return the line of a device. Raises typer.BadParameter for one that has not the form of any of its kind."""
    forms = {
        SerialSettings: (r"/.+", "the path of a port, e.g. /dev/ttyUSB0"),
        TcpSettings: (r"[^/\s]+:\d{1,5}", "HOST:PORT"),
        CanSettings: (r"[A-Za-z][\w.-]*\d[\w.-]*", "a CAN interface, e.g. can0"),
    }
    known = [forms[each] for each in kind.lines]
    if not any(re.fullmatch(form, line) for form, _ in known):
        form = " or ".join(text for _, text in known)
        raise typer.BadParameter(f"{quote(line, 40)}: the line of {kind.name} is {form}", param_hint=option_name)
    return line


def _load_geometry(file: Path) -> Model:
    """Return the model of a URDF or another geometry file; print its problems. Raises ModelServerError."""
    model, problems = check_file(str(file))
    print_problems(problems)
    if model is None:
        raise ModelServerError(f"{escape(str(file))} has errors; nothing was written")
    return model


def find_mounts(
    model: Model, base: Mount, wanted: NewVehicle, turning: Sequence[Wheel], gps: str, imu: str
) -> tuple[Model, FrameChoices]:
    """Return the frames of what is on a vehicle, those given or guessed, and the model with those of its wheels.

    Raises typer.BadParameter, GeometryError.
    """

    def choose(given: str, words: tuple[str, ...], option_name: str) -> Mount:
        if given:
            return Mount(_check_frame(model, given, option_name))
        if guess := guess_sensor(model, words, base.frame):
            return guess
        shown = names.format_names(list_frames(model))
        raise typer.BadParameter(f"give the frame; the geometry has: {shown}", param_hint=option_name)

    mounts = FrameChoices(
        base,
        choose(gps, GPS_WORDS, "--gps-frame") if wanted.gps is not None else None,
        choose(imu, IMU_WORDS, "--imu-frame") if wanted.imu is not None else None,
    )
    if wanted.imu is not None and mounts.imu is not None and wanted.imu.kind is not None and wanted.imu.has_z_down:
        mounts = mounts._replace(imu=note_axes(model, mounts.imu, wanted.imu.kind.name, base.frame))
    if wanted.wheels is None:
        return model, mounts
    model, wheels, rolling = add_wheel_frames(model, base.frame, wanted.template, turning)
    return model, mounts._replace(wheels=wheels, rolling=rolling)


def list_frames(model: Model) -> list[str]:
    return [frame.full_name for body in model.bodies for frame in body.frames]


def _check_frame(model: Model, name: str, option_name: str) -> str:
    return choose_name(names.complete(name), list_frames(model), "frame", option_name)


def write_files(folder: Path, files: Mapping[str, str], force: bool) -> None:
    """Write all files, or none if one exists. Raises ModelServerError, OSError."""
    there = [name for name in files if (folder / name).exists()]
    if there and not force:
        raise ModelServerError(f"{', '.join(str(folder / name) for name in there)} exists; give --force to replace it")
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        write_file(str(folder / name), text, replace=True)


def show_result(folder: Path, files: Mapping[str, str], following: str) -> None:
    """Print what was written, what `check` finds, what must be measured, and what to do next."""
    for name in files:
        typer.echo(escape(f"written: {folder / name}"))
    _, problems = check_vehicle(str(folder / VEHICLE_FILE))
    print_problems(problems, err=False)
    if marks := list(list_marks(folder, tuple(files))):
        typer.echo(f"\nTo be measured or adapted, marked {MARK} in the files:")
        for mark in marks:
            typer.echo(escape(f"  {mark}"))
    where = "" if folder == Path() else f"cd {shlex.quote(str(folder))} && "
    typer.echo()
    typer.echo(escape(f"Next: {where}{following}"))


def find_next(wanted: NewVehicle, model: Model | None) -> str:
    """Return the command that comes next: without drivers, the one that makes a log of a recording."""
    devices = (wanted.gps, wanted.imu, wanted.wheels)
    if not any(each is not None and each.kind is None for each in devices):
        return "modelserver up --emulate     (no hardware needed; then modelserver status)"
    track = ""
    if wanted.wheels is not None and wanted.wheels.kind is None:
        left, right = (wanted.template.wheels[name] for name in ("left", "right"))
        if model is not None:
            frames = (wanted.mounts.wheels[name].frame for name in ("left", "right"))
            left, right = model.get_transformation(*frames).pose.xyz, (0.0, 0.0, 0.0)
        track = f" --track-width {math.dist(left, right):.3g}"
    return (
        f"modelserver import-bag YOUR.bag drive.lcm{track}, then modelserver replay drive.lcm -c {VEHICLE_FILE} "
        "--report report.html"
    )
