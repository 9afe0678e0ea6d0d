"""Read libbot2's coordinate frames: the block `coordinate_frames` of a parameter file.

- Each frame is a body, and the body's frame `Origin` is the frame itself.
- A constraint with the name of the frame joins it to the frame it is `relative_to`; its pose is `initial_transform`.
- A frame with an `update_channel` or `pose_update_channel` moves at run time: its constraint is a floating joint, whose
  coordinates are the transform in those messages, by default `initial_transform`.

A transform maps points of the frame to the frame it is relative to, so it is the pose of the first in the second:
`bot_frames_get_trans(from, to)` is `get_transformation(frame_of_interest=from, frame_of_reference=to)`. Rotations:
`rpy` is in degrees, about fixed axes, roll first; `rodrigues` is a rotation vector and `angleaxis` an angle before its
axis, in radians; `quat` is w, x, y, z. All as in libbot2's `bot_frames.c`, `param_util.c` and `rotations.c`.

Syntax of parameter files: `name = value;`, `name = [a, b];` and `name { ... }`; # begins a comment. A value is a word
or a text in double quotes, which are equivalent; a cast in parentheses before it is ignored. Blocks are parsed without
recursion, to a bounded depth.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, field

from modelserver.errors import Location, Severity, Suggestion, quote, suggest_name
from modelserver.formats.reading import (
    MAX_POSITION,
    MAX_SUGGESTIONS,
    ORIGIN,
    check_position,
    find_cycles,
    label,
    parse_numbers,
    repair_quaternion,
    suggest_known_key,
)
from modelserver.geometry import names
from modelserver.geometry.builder import ModelBuilder
from modelserver.geometry.joint import FIXED, Joint, JointType
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Quaternion

MAX_DEPTH = 20
"""Frames are nested four levels deep."""

_SPACE = r"(?:\s|\#[^\n]*(?:\n|\Z))*"
_TOKEN = re.compile(
    rf"{_SPACE}(?:(?P<word>[A-Za-z0-9_.+-]+)|\"(?P<text>(?:[^\"\\\n]|\\.)*)\"|\((?P<cast>[^)\n]*)\)|(?P<mark>[{{}}\[\],;=])|"
    r"(?P<end>\Z)|(?P<odd>.))",
    re.DOTALL,
)
_BEGIN = re.compile(rb"(?:\s|#[^\n]*(?:\n|\Z))*[A-Za-z0-9_.+-]+(?:\s|#[^\n]*\n)*[={]")
_FRAMES_BLOCK = re.compile(rb"(?:\A|[\s;}])coordinate_frames(?:\s|#[^\n]*\n)*\{")


@dataclass(slots=True)
class ParamValue:
    """Right side of an assignment: one text or, in brackets, several."""

    texts: list[str]
    line: int


@dataclass(slots=True)
class ParamBlock:
    """A block: its entries in order, each with its name."""

    line: int
    entries: list[tuple[str, ParamValue | ParamBlock]] = field(default_factory=list)

    def values(self) -> Iterator[tuple[str, ParamValue]]:
        """Yield the assignments."""
        return ((name, entry) for name, entry in self.entries if isinstance(entry, ParamValue))

    def blocks(self) -> Iterator[tuple[str, ParamBlock]]:
        """Yield the blocks inside."""
        return ((name, entry) for name, entry in self.entries if isinstance(entry, ParamBlock))


def is_bot_param(content: bytes) -> bool:
    """Return whether a file is probably a libbot2 parameter file with coordinate frames."""
    return _BEGIN.match(content) is not None and _FRAMES_BLOCK.search(content) is not None


class _ParamSyntaxError(Exception):
    def __init__(self, message: str, line: int, fix: str):
        super().__init__(message)
        self.line = line
        self.fix = fix


def parse_param_file(content: bytes, builder: ModelBuilder, file: str) -> ParamBlock | None:
    """Parse a file into one block; None, with an error in `builder`, for a syntax error."""
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        builder.add_error(
            f"the file is not UTF-8 text: byte {content[error.start]:#04x} in this line",
            Location(file, content.count(b"\n", 0, error.start) + 1),
            "save it as UTF-8",
        )
        return None
    try:
        return _ParamParser(text).parse()
    except _ParamSyntaxError as error:
        builder.add_error(str(error), Location(file, error.line), error.fix)
        return None


class _ParamParser:
    def __init__(self, text: str):
        self.text = text
        self.at = 0
        self.line = 1

    def next_token(self) -> tuple[str, str]:
        """Return the type (word, text, cast, mark, end) and the text of the next token."""
        match = _TOKEN.match(self.text, self.at)
        assert match is not None
        kind = str(match.lastgroup)
        start = match.start(kind)
        self.line += self.text.count("\n", self.at, start)
        self.at = start
        if kind == "odd":
            wrong = match["odd"]
            fix = (
                "close the text with a quote in the same line"
                if wrong == '"'
                else "remove it, or put the text in quotes"
            )
            raise _ParamSyntaxError(f"unexpected {quote(wrong)}", self.line, fix)
        self.line += self.text.count("\n", start, match.end())
        self.at = match.end()
        return kind, match[kind]

    def parse(self) -> ParamBlock:
        root = ParamBlock(self.line)
        open_blocks = [root]
        while True:
            kind, text = self.next_token()
            if kind == "end":
                if len(open_blocks) > 1:
                    raise _ParamSyntaxError("a block is not closed", open_blocks[-1].line, "close it with }")
                return root
            if (kind, text) == ("mark", "}"):
                if len(open_blocks) == 1:
                    raise _ParamSyntaxError("a } closes nothing", self.line, "remove it, or look for a missing {")
                open_blocks.pop()
                continue
            if kind != "word":
                raise _ParamSyntaxError(
                    f"expected a name, got {quote(text)}", self.line, "write name = value; or name { ... }"
                )
            line = self.line
            mark = self.next_token()
            if mark == ("mark", "{"):
                if len(open_blocks) > MAX_DEPTH:
                    raise _ParamSyntaxError(
                        f"the file nests deeper than {MAX_DEPTH} levels",
                        line,
                        "look for blocks that are not closed",
                    )
                block = ParamBlock(line)
                open_blocks[-1].entries.append((text, block))
                open_blocks.append(block)
            elif mark == ("mark", "="):
                open_blocks[-1].entries.append((text, self.parse_value(text, line)))
            else:
                raise _ParamSyntaxError(
                    f"expected = or {{ after {quote(text)}, got {quote(mark[1])}",
                    line,
                    "write name = value; or name { ... }",
                )

    def parse_value(self, name: str, line: int) -> ParamValue:
        """Parse the right side of an assignment, including its semicolon."""
        kind, text = self.next_token()
        if kind == "cast":
            kind, text = self.next_token()
        if kind in ("word", "text"):
            value = ParamValue([text], line)
        elif (kind, text) == ("mark", "["):
            value = ParamValue(self.parse_list(name), line)
        else:
            raise _ParamSyntaxError(f"{name} has no value", line, f"write {name} = value; or {name} = [value, value];")
        if self.next_token() != ("mark", ";"):
            raise _ParamSyntaxError(
                f"a ; is missing after the value of {quote(name)}", line, "end the assignment with ;"
            )
        return value

    def parse_list(self, name: str) -> list[str]:
        line = self.line
        items: list[str] = []
        while True:
            kind, text = self.next_token()
            if kind in ("word", "text"):
                items.append(text)
                kind, text = self.next_token()
                if (kind, text) == ("mark", ","):
                    continue
            if (kind, text) == ("mark", "]"):
                return items
            raise _ParamSyntaxError(
                f"the list of {quote(name)} is not well-formed: got {quote(text)}",
                line,
                f"write {name} = [value, value];",
            )


_FRAME_KEYS = ("relative_to", "history", "update_channel", "pose_update_channel", "initial_transform")
_ROTATIONS = {"quat": 4, "rpy": 3, "rodrigues": 3, "angleaxis": 4}
_UNITS = {"quat": "w, x, y, z", "rpy": "degrees", "rodrigues": "radians", "angleaxis": "radians, then the axis"}
_CHANNEL_KEYS = ("update_channel", "pose_update_channel")


def load(content: bytes, builder: ModelBuilder, file: str) -> ModelBuilder:
    """Add the frames of a parameter file, and their problems, to `builder`."""
    root = parse_param_file(content, builder, file)
    if root is not None:
        _BotFramesReader(builder, file).read(root)
    return builder


@dataclass(slots=True)
class _BotFrame:
    name: str
    parent: str
    pose: Pose
    is_driven: bool
    source: Location
    parent_source: Location


class _BotFramesReader:
    def __init__(self, builder: ModelBuilder, file: str):
        self.builder = builder
        self.file = file
        self.frames: dict[str, _BotFrame] = {}
        self.has_errors = False

    def locate(self, line: int, place: str) -> Location:
        return Location(self.file, line, place)

    def error(self, message: str, source: Location, fix: str, nearest: tuple[str, ...] = ()) -> None:
        self.builder.add_error(message, source, fix, nearest)
        self.has_errors = True

    def read(self, root: ParamBlock) -> None:
        for name, value in root.values():
            if name == "INCLUDE":
                files = ", ".join(value.texts[:5])
                self.builder.add_warning(
                    f"INCLUDE is not followed: {quote(files)}",
                    self.locate(value.line, name),
                    "paste the included file's coordinate_frames into this one",
                )
        blocks = [block for name, block in root.blocks() if name == "coordinate_frames"]
        others = [name for name, _ in root.blocks() if name != "coordinate_frames"]
        if others:
            self.builder.add_problem(
                Severity.NOTE,
                f"{len(others)} other block{'' if len(others) == 1 else 's'} ignored: {', '.join(others[:5])}",
                self.locate(root.line, ""),
            )
        if not blocks:
            self.error(
                "there is no block coordinate_frames", self.locate(1, ""), "see docs/geometry-files.md for an example"
            )
            return
        top = self.read_root(blocks)
        if top is None:
            return
        for block in blocks:
            for name, entry in block.blocks():
                self.read_frame(name, entry, top)
        if not self.has_errors and self.check_parents(top):
            self.add_to_model(top, blocks[0])

    def read_root(self, blocks: list[ParamBlock]) -> str | None:
        """Return the name of the root frame."""
        named = [value for block in blocks for name, value in block.values() if name == "root_frame"]
        for block in blocks:
            for name, value in block.values():
                if near := suggest_known_key(name, ("root_frame",)) if name != "root_frame" else ():
                    place = self.locate(value.line, "coordinate_frames")
                    self.builder.add_warning(f"unknown name {quote(name)}; ignored", place, f"write {near[0]}", near)
        if not named or not named[0].texts:
            self.error(
                "root_frame is missing", self.locate(blocks[0].line, "coordinate_frames"), 'add root_frame = "local";'
            )
            return None
        if len(named) > 1:
            self.error(
                f"root_frame is given twice (first on line {named[0].line})",
                self.locate(named[1].line, "coordinate_frames"),
                "remove one of the two",
            )
            return None
        top = named[0].texts[0]
        return top if self.is_valid_name(top, self.locate(named[0].line, "root_frame")) else None

    def is_valid_name(self, name: str, source: Location) -> bool:
        fault = names.find_problem(name)
        if name in names.RESERVED_BODIES:
            fault = "this name is reserved for the server's world frames"
        if fault:
            self.error(f"frame {quote(name)}: {fault}", source, "rename it, here and in relative_to")
        return not fault

    def read_frame(self, name: str, block: ParamBlock, top: str) -> None:
        """Read one frame."""
        place = f"frame {label(name)}"
        source = self.locate(block.line, place)
        if not block.entries and name == top:
            return
        if not self.is_valid_name(name, source):
            return
        if name == top:
            self.error(
                f"{place} is the root frame and has no parent",
                source,
                "leave its block empty, or name another root_frame",
            )
            return
        if name in self.frames:
            first = self.frames[name].source.line
            self.error(f"{place} is defined twice (first on line {first})", source, "rename one of the two")
            return
        fields = self.read_fields(block, _FRAME_KEYS, place)
        parent, transform = fields.get("relative_to"), fields.get("initial_transform")
        if not isinstance(parent, ParamValue) or len(parent.texts) != 1 or not parent.texts[0]:
            self.error("relative_to is missing", source, f'add relative_to = "{top}"; or its parent frame')
            return
        if not isinstance(transform, ParamBlock):
            fix = "add initial_transform { translation = [0, 0, 0]; rpy = [0, 0, 0]; }"
            self.error("initial_transform is missing", source, fix)
            return
        pose = self.read_transform(transform, f"{place}, initial_transform")
        channels = [fields[key] for key in _CHANNEL_KEYS if key in fields]
        driven = any(isinstance(each, ParamValue) and any(each.texts) for each in channels)
        if pose is not None:
            self.frames[name] = _BotFrame(
                name, parent.texts[0], pose, driven, source, self.locate(parent.line, f"{place}, relative_to")
            )

    def read_fields(self, block: ParamBlock, known: tuple[str, ...], place: str) -> dict[str, ParamValue | ParamBlock]:
        """Return the entries of a block by name; duplicates are errors, unknown ones warnings."""
        found: dict[str, ParamValue | ParamBlock] = {}
        for name, entry in block.entries:
            if name in found:
                first = found[name].line
                self.error(
                    f"{name} is given twice (first on line {first})",
                    self.locate(entry.line, place),
                    "remove one of the two",
                )
            elif name in known:
                found[name] = entry
            else:
                near = suggest_known_key(name, known)
                self.builder.add_warning(
                    f"unknown name {quote(name)}; ignored",
                    self.locate(entry.line, place),
                    f"write {near[0]}" if near else f"known here: {', '.join(known)}",
                    near,
                )
        return found

    def read_transform(self, block: ParamBlock, place: str) -> Pose | None:
        fields = self.read_fields(block, ("translation", *_ROTATIONS), place)
        source = self.locate(block.line, place)
        turns = [key for key in _ROTATIONS if key in fields]
        if len(turns) != 1:
            what = f"is given twice, as {turns[0]} and as {turns[1]}" if turns else "is missing"
            self.error(f"the rotation {what}", source, f"write one of {', '.join(_ROTATIONS)}")
            return None
        if "translation" not in fields:
            self.error("translation is missing", source, "add translation = [x, y, z]; in meters")
            return None
        position = self.read_numbers(fields["translation"], "translation", 3, "meters", place)
        values = self.read_numbers(fields[turns[0]], turns[0], _ROTATIONS[turns[0]], _UNITS[turns[0]], place)
        if position is None or values is None or not check_position(position, self.builder, source):
            self.has_errors = True
            return None
        turned = self.read_rotation(turns[0], values, self.locate(fields[turns[0]].line, place))
        if turned is None:
            self.has_errors = True
            return None
        return Pose(position, turned)

    def read_rotation(self, key: str, values: list[float], source: Location) -> Quaternion | None:
        if key == "quat":
            return repair_quaternion(values, self.builder, source)
        if max(map(abs, values)) > MAX_POSITION:
            self.error(f"{key} is out of reach", source, "look for a slip in the exponent")
            return None
        if key == "rpy":
            roll, pitch, yaw = map(math.radians, values)
            return so3.from_rpy(roll, pitch, yaw)
        if key == "rodrigues":
            return so3.exponential((values[0], values[1], values[2]))
        angle, x, y, z = values
        length = math.hypot(x, y, z)
        # libbot2 reads an axis without a length as no rotation
        scale = angle / length if length > 0.0 else 0.0
        return so3.exponential((x * scale, y * scale, z * scale))

    def read_numbers(
        self, entry: ParamValue | ParamBlock, key: str, count: int, unit: str, place: str
    ) -> list[float] | None:
        source = self.locate(entry.line, place)
        fix = f"write {key} = [{', '.join(['number'] * count)}]; ({unit})"
        if isinstance(entry, ParamBlock):
            self.error(f"{key} is a block, not a list of {count} numbers", source, fix)
            return None
        try:
            return parse_numbers(entry.texts, count, key)
        except ValueError as error:
            self.error(str(error), source, fix)
            return None

    def check_parents(self, top: str) -> bool:
        """Report missing parents and cycles; return whether there are none."""
        suggested = 0
        for frame in self.frames.values():
            if frame.parent != top and frame.parent not in self.frames:
                suggested += 1
                near = suggest_name(frame.parent, (top, *self.frames)) if suggested <= MAX_SUGGESTIONS else Suggestion()
                self.error(
                    f"relative_to names frame {quote(frame.parent)}, which does not exist",
                    frame.parent_source,
                    f"write {near[0]}" if near else "name the root frame, or a frame of this file",
                    near,
                )
        if self.has_errors:
            return False
        for cycle in find_cycles(self.frames, lambda name: self.frames[name].parent if name in self.frames else None):
            self.error(
                f"frames form a cycle: {' in '.join(map(label, cycle))}",
                self.frames[cycle[-1]].parent_source,
                f"one of them must be relative to the root frame {label(top)}, or to one that is",
            )
        return not self.has_errors

    def add_to_model(self, top: str, block: ParamBlock) -> None:
        """Add the frames as bodies, root first, and their constraints."""
        bodies = {top: self.builder.add_body(top, source=self.locate(block.line, f"frame {label(top)}"))}
        for frame in self.frames.values():
            bodies[frame.name] = self.builder.add_body(frame.name, source=frame.source)
        for body in bodies.values():
            body.add_frame(ORIGIN, source=body.source)
        for frame in self.frames.values():
            mount = frame.name if frame.name != ORIGIN else f"{ORIGIN}_"
            bodies[frame.parent].add_frame(mount, source=frame.source)
            self.builder.add_constraint(
                frame.name,
                names.join(frame.parent, mount),
                names.join(frame.name, ORIGIN),
                Pose.identity() if frame.is_driven else frame.pose,
                joint=_make_floating_joint(frame.pose) if frame.is_driven else FIXED,
                source=frame.source,
            )


def _make_floating_joint(rest: Pose) -> Joint:
    """Return a joint whose coordinates are the whole transform of a frame, by default `rest`."""
    if rest == Pose.identity():
        return Joint(JointType.FLOATING)
    return Joint(JointType.FLOATING, default=(*rest.xyz, *so3.logarithm(rest.wxyz)))
