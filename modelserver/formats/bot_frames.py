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

from modelserver.errors import Location, Suggestion, SyntaxProblemError, has_error, quote, suggest_name
from modelserver.formats import common
from modelserver.geometry import names
from modelserver.geometry.builder import ModelBuilder
from modelserver.geometry.joint import FIXED, Joint, JointType
from modelserver.geometry.names import ORIGIN
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
        return ((name, entry) for name, entry in self.entries if isinstance(entry, ParamValue))

    def blocks(self) -> Iterator[tuple[str, ParamBlock]]:
        return ((name, entry) for name, entry in self.entries if isinstance(entry, ParamBlock))


def is_bot_param(content: bytes) -> bool:
    return _BEGIN.match(content) is not None and _FRAMES_BLOCK.search(content) is not None


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
            raise SyntaxProblemError(f"unexpected {quote(wrong)}", self.line, fix)
        self.line += self.text.count("\n", start, match.end())
        self.at = match.end()
        return kind, match[kind]

    def parse(self) -> ParamBlock:
        root = ParamBlock(self.line)
        open_blocks = [root]
        while True:
            token = kind, text = self.next_token()
            if kind == "end":
                if len(open_blocks) > 1:
                    raise SyntaxProblemError("a block is not closed", open_blocks[-1].line, "close it with }")
                return root
            if token == ("mark", "}"):
                if len(open_blocks) == 1:
                    raise SyntaxProblemError("a } closes nothing", self.line, "remove it, or look for a missing {")
                open_blocks.pop()
                continue
            line, fix = self.line, "write name = value; or name { ... }"
            if kind != "word":
                raise SyntaxProblemError(f"expected a name, got {quote(text)}", line, fix)
            mark = self.next_token()
            if mark == ("mark", "{"):
                if len(open_blocks) > MAX_DEPTH:
                    message = f"the file nests deeper than {MAX_DEPTH} levels"
                    raise SyntaxProblemError(message, line, "look for blocks that are not closed")
                block = ParamBlock(line)
                open_blocks[-1].entries.append((text, block))
                open_blocks.append(block)
            elif mark == ("mark", "="):
                open_blocks[-1].entries.append((text, self.parse_value(text, line)))
            else:
                raise SyntaxProblemError(f"expected = or {{ after {quote(text)}, got {quote(mark[1])}", line, fix)

    def parse_value(self, name: str, line: int) -> ParamValue:
        token = self.next_token()
        if token[0] == "cast":
            token = self.next_token()
        if token[0] in ("word", "text"):
            value = ParamValue([token[1]], line)
        elif token == ("mark", "["):
            value = ParamValue(self.parse_list(name), line)
        else:
            raise SyntaxProblemError(f"{name} has no value", line, f"write {name} = value; or {name} = [value, value];")
        if self.next_token() != ("mark", ";"):
            message = f"a ; is missing after the value of {quote(name)}"
            raise SyntaxProblemError(message, line, "end the assignment with ;")
        return value

    def parse_list(self, name: str) -> list[str]:
        line = self.line
        items: list[str] = []
        while True:
            token = self.next_token()
            if token[0] in ("word", "text"):
                items.append(token[1])
                token = self.next_token()
                if token == ("mark", ","):
                    continue
            if token == ("mark", "]"):
                return items
            message = f"the list of {quote(name)} is not well-formed: got {quote(token[1])}"
            raise SyntaxProblemError(message, line, f"write {name} = [value, value];")


_FRAME_KEYS = ("relative_to", "history", "update_channel", "pose_update_channel", "initial_transform")
_ROTATIONS = {"quat": 4, "rpy": 3, "rodrigues": 3, "angleaxis": 4}
_UNITS = {"quat": "w, x, y, z", "rpy": "degrees", "rodrigues": "radians", "angleaxis": "radians, then the axis"}
_CHANNEL_KEYS = ("update_channel", "pose_update_channel")


def load(content: bytes, builder: ModelBuilder, file: str) -> None:
    try:
        _BotFramesReader(builder, file).read(_ParamParser(content.decode("utf-8-sig")).parse())
    except UnicodeDecodeError as error:
        message = f"the file is not UTF-8 text: byte {content[error.start]:#04x} in this line"
        builder.add_error(message, Location(file, content.count(b"\n", 0, error.start) + 1), "save it as UTF-8")
    except SyntaxProblemError as error:
        builder.add_error(str(error), Location(file, error.line), error.fix)


class _BlockReader(common.ElementReader):
    """Reads the entries of a block; duplicates are errors, unknown names warnings."""

    def __init__(self, builder: ModelBuilder, file: str, block: ParamBlock, place: str, known: tuple[str, ...]):
        super().__init__(builder, file, block.line, place)
        entries = [(name, entry, entry.line) for name, entry in block.entries]
        self.fields = self.select(entries, known, "name")

    def read_transform(self) -> Pose | None:
        turns = [key for key in _ROTATIONS if key in self.fields]
        if len(turns) != 1:
            what = f"is given twice, as {turns[0]} and as {turns[1]}" if turns else "is missing"
            self.error(f"the rotation {what}", f"write one of {', '.join(_ROTATIONS)}")
            return None
        (key,) = turns
        if "translation" not in self.fields:
            self.error("translation is missing", "add translation = [x, y, z]; in meters")
            return None
        position = self.read_numbers("translation", 3, "meters")
        values = self.read_numbers(key, _ROTATIONS[key], _UNITS[key])
        if position is None or values is None or not self.check_position(position):
            return None
        turned = self.read_rotation(key, values)
        return None if turned is None else Pose(position, turned)

    def read_rotation(self, key: str, values: list[float]) -> Quaternion | None:
        line = self.fields[key].line
        if key == "quat":
            return self.repair_quaternion(values, line)
        if max(map(abs, values)) > common.MAX_POSITION:
            self.error(f"{key} is out of reach", "look for a slip in the exponent", line)
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

    def read_numbers(self, key: str, count: int, unit: str) -> list[float] | None:
        entry, fix = self.fields[key], f"write {key} = [{', '.join(['number'] * count)}]; ({unit})"
        if isinstance(entry, ParamBlock):
            self.error(f"{key} is a block, not a list of {count} numbers", fix, entry.line)
            return None
        return self.read_row(entry.texts, count, key, fix, entry.line)


@dataclass(slots=True)
class _BotFrame:
    name: str
    parent: str
    pose: Pose
    is_driven: bool
    source: Location
    parent_source: Location


class _BotFramesReader(common.ElementReader):
    def __init__(self, builder: ModelBuilder, file: str):
        super().__init__(builder, file)
        self.frames: dict[str, _BotFrame] = {}

    @property
    def has_errors(self) -> bool:
        return has_error(self.builder.problems)

    def enter(self, line: int, place: str) -> common.ElementReader:
        return common.ElementReader(self.builder, self.file, line, place)

    def read(self, root: ParamBlock) -> None:
        for name, value in root.values():
            if name == "INCLUDE":
                message = f"INCLUDE is not followed: {quote(', '.join(value.texts[:5]))}"
                fix = "paste the included file's coordinate_frames into this one"
                self.enter(value.line, name).warning(message, fix)
        blocks = [block for name, block in root.blocks() if name == "coordinate_frames"]
        others = [name for name, _ in root.blocks() if name != "coordinate_frames"]
        if others:
            plural = "" if len(others) == 1 else "s"
            self.note(f"{len(others)} other block{plural} ignored: {', '.join(others[:5])}", at=root.line)
        if not blocks:
            self.error("there is no block coordinate_frames", "see docs/geometry-files.md for an example", 1)
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
        at = self.enter(blocks[0].line, "coordinate_frames")
        named = []
        for name, value in (entry for block in blocks for entry in block.values()):
            if name == "root_frame":
                named.append(value)
            elif near := common.suggest_known_key(name, ("root_frame",)):
                at.warning(f"unknown name {quote(name)}; ignored", f"write {near[0]}", value.line, near)
        if not named or not named[0].texts:
            at.error("root_frame is missing", 'add root_frame = "local";')
            return None
        if len(named) > 1:
            message = f"root_frame is given twice (first on line {named[0].line})"
            at.error(message, "remove one of the two", named[1].line)
            return None
        top = named[0].texts[0]
        return top if self.is_valid_name(top, self.enter(named[0].line, "root_frame")) else None

    def is_valid_name(self, name: str, at: common.ElementReader) -> bool:
        fault = names.find_body_problem(name)
        if fault:
            at.error(f"frame {quote(name)}: {fault}", "rename it, here and in relative_to")
        return not fault

    def read_frame(self, name: str, block: ParamBlock, top: str) -> None:
        place = f"frame {common.label(name)}"
        at = self.enter(block.line, place)
        if (name == top and not block.entries) or not self.is_valid_name(name, at):
            return
        if name == top:
            fix = "leave its block empty, or name another root_frame"
            at.error(f"{place} is the root frame and has no parent", fix)
            return
        if name in self.frames:
            message = f"{place} is defined twice (first on line {self.frames[name].source.line})"
            at.error(message, "rename one of the two")
            return
        fields = _BlockReader(self.builder, self.file, block, place, _FRAME_KEYS).fields
        parent, transform = fields.get("relative_to"), fields.get("initial_transform")
        if not isinstance(parent, ParamValue) or len(parent.texts) != 1 or not parent.texts[0]:
            at.error("relative_to is missing", f'add relative_to = "{top}"; or its parent frame')
            return
        if not isinstance(transform, ParamBlock):
            fix = "add initial_transform { translation = [0, 0, 0]; rpy = [0, 0, 0]; }"
            at.error("initial_transform is missing", fix)
            return
        keys, inside = ("translation", *_ROTATIONS), f"{place}, initial_transform"
        pose = _BlockReader(self.builder, self.file, transform, inside, keys).read_transform()
        channels = [fields[key] for key in _CHANNEL_KEYS if key in fields]
        driven = any(isinstance(each, ParamValue) and any(each.texts) for each in channels)
        if pose is not None:
            parent_source = Location(self.file, parent.line, f"{place}, relative_to")
            self.frames[name] = _BotFrame(name, parent.texts[0], pose, driven, at.locate(), parent_source)

    def check_parents(self, top: str) -> bool:
        missing = [each for each in self.frames.values() if each.parent != top and each.parent not in self.frames]
        for number, frame in enumerate(missing):
            near = Suggestion()
            if number < common.MAX_SUGGESTIONS:
                near = suggest_name(frame.parent, (top, *self.frames))
            message = f"relative_to names frame {quote(frame.parent)}, which does not exist"
            fix = f"write {near[0]}" if near else "name the root frame, or a frame of this file"
            self.builder.add_error(message, frame.parent_source, fix, near)
        if missing:
            return False
        for cycle in common.find_cycles(
            self.frames, lambda name: self.frames[name].parent if name in self.frames else None
        ):
            message = f"frames form a cycle: {' in '.join(map(common.label, cycle))}"
            fix = f"one of them must be relative to the root frame {common.label(top)}, or to one that is"
            self.builder.add_error(message, self.frames[cycle[-1]].parent_source, fix)
        return not self.has_errors

    def add_to_model(self, top: str, block: ParamBlock) -> None:
        sources = {top: Location(self.file, block.line, f"frame {common.label(top)}")}
        sources |= {name: frame.source for name, frame in self.frames.items()}
        bodies = {
            name: self.builder.add_body(name, source=source).add_frame(ORIGIN, source=source)
            for name, source in sources.items()
        }
        for name, frame in self.frames.items():
            mount = name if name != ORIGIN else f"{ORIGIN}_"
            bodies[frame.parent].add_frame(mount, source=frame.source)
            pose, joint = frame.pose, FIXED
            if frame.is_driven:
                # the coordinates are the whole transform
                rest = () if pose == Pose.identity() else (*pose.xyz, *so3.logarithm(pose.wxyz))
                pose, joint = Pose.identity(), Joint(JointType.FLOATING, default=rest)
            ends = (names.join(frame.parent, mount), names.join(name, ORIGIN))
            self.builder.add_constraint(name, *ends, pose, joint=joint, source=frame.source)
