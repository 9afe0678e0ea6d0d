"""The `drivers` section of a vehicle file: read into the settings of the kind of device that each driver names.

    drivers:
      gps: {device: novatel, port: /dev/ttyUSB0, baud: 38400}

`device` is the kind; which further keys there are follows from the kind's lines and its settings, both dataclasses:
names, types and limits are written there and nowhere else.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, get_args, get_type_hints

from pydantic import TypeAdapter, ValidationError

from modelserver.errors import ConfigError, Problem, Severity, Source, nearest_names, shown
from msdrivers.line_settings import LineSettings
from msdrivers.registry import KINDS, Kind

SOURCE = "source"
"""The field of a kind's settings that takes the driver's name."""

BAUDS = "bauds"
"""The field of a kind's settings that has the rates to try; `baud` in the section gives it one."""

COMMON = ("device", "channel")
"""Keys that every driver has: the kind of its device, and the channel, where it is not that of the sensors section."""


@dataclass(frozen=True, slots=True)
class DriverSettings:
    """A driver: its name, its kind, its line, the settings of its station; `channel` empty: that of the sensor."""

    name: str
    kind: Kind
    line: LineSettings
    station: Any
    channel: str = ""


@dataclass(frozen=True, slots=True)
class Place:
    """Where in which file a section stands; `lines` has the line of each key by its path."""

    file: str = ""
    lines: Mapping[tuple[str | int, ...], int] = field(default_factory=dict)

    def source(self, *path: str | int) -> Source:
        """Return the place of a key, or of the nearest section around it."""
        line = next((self.lines[path[:n]] for n in range(len(path), 0, -1) if path[:n] in self.lines), 0)
        return Source(self.file, line, ".".join(map(str, path)))


def read_drivers(
    sections: Mapping[str, Mapping[str, Any]], place: Place | None = None, kinds: Mapping[str, Kind] = KINDS
) -> dict[str, DriverSettings]:
    """Return the settings of every driver by its name. Raises ConfigError with every problem."""
    problems: list[Problem] = []
    found = {}
    for name, section in sections.items():
        try:
            found[name] = read_driver(name, section, place, kinds)
        except ConfigError as error:
            problems += error.problems
    if problems:
        raise ConfigError(problems)
    return found


def read_driver(
    name: str, section: Mapping[str, Any], place: Place | None = None, kinds: Mapping[str, Kind] = KINDS
) -> DriverSettings:
    """Return the settings of one driver. Raises ConfigError with every problem of its section."""
    reader = _Reader(name, section, place or Place())
    kind = reader.kind(kinds)
    settings = kind.load().settings
    line = reader.line(kind)
    station_keys = [key for key in _keys(settings) if key != SOURCE and key not in kind.presets]
    reader.refuse_unknown([*COMMON, *_keys(*kind.lines), *station_keys])
    given: dict[str, Any] = {SOURCE: name, **kind.presets}
    if "baud" in section and BAUDS in station_keys and BAUDS not in section:
        given[BAUDS] = [section["baud"]]
    values = reader.values(settings, given)
    line_values = reader.values(line)
    channel = reader.values(_Common).channel
    if reader.problems:
        raise ConfigError(reader.problems)
    return DriverSettings(name, kind, line_values, values, channel)


@dataclass(frozen=True, slots=True)
class _Common:
    device: str = ""
    channel: str = ""


def _keys(*kinds: type) -> list[str]:
    return list(dict.fromkeys(each.name for kind in kinds for each in dataclasses.fields(kind)))


def _known_keys(kind: Any, path: tuple[str | int, ...]) -> list[str]:
    """Return the keys known at a place below settings of `kind`: in a section, a mapping or a list of sections."""
    for step in path:
        if dataclasses.is_dataclass(kind):
            kind = get_type_hints(kind).get(str(step))
        else:
            # a mapping or a list: what it holds is its last argument, or the first of tuple[X, ...]
            kind = next((each for each in reversed(get_args(kind)) if each is not Ellipsis), None)
        if type(None) in get_args(kind):
            kind = next(each for each in get_args(kind) if each is not type(None))
    return _keys(kind) if dataclasses.is_dataclass(kind) and isinstance(kind, type) else []


class _Reader:
    """Reads one section, and keeps what is wrong with it."""

    def __init__(self, name: str, section: Mapping[str, Any], place: Place):
        self.name, self.section, self.place = name, section, place
        self.problems: list[Problem] = []

    def kind(self, kinds: Mapping[str, Kind]) -> Kind:
        given = self.section.get("device")
        known = f"kinds: {', '.join(kinds)}"
        if given is None:
            raise ConfigError([self._problem("device is missing", ("device",), f"add a line: device: ... ({known})")])
        if not isinstance(given, str) or given not in kinds:
            near = nearest_names(str(given), kinds)
            fix = f"write {near[0]}" if near else known
            raise ConfigError([self._problem(f"unknown device {shown(str(given))}", ("device",), fix, near)])
        return kinds[given]

    def line(self, kind: Kind) -> type[LineSettings]:
        """Return which of its lines the section names: the one whose first key stands there."""
        firsts = {dataclasses.fields(each)[0].name: each for each in kind.lines}
        given = [key for key in firsts if key in self.section]
        if len(given) == 1:
            return firsts[given[0]]
        wanted = " or ".join(firsts)
        what = f"both {' and '.join(given)} are given" if given else f"no line is named: {wanted} is missing"
        fix = f"keep one of {wanted}" if given else f"add a line: {next(iter(firsts))}: ..."
        self.problems.append(self._problem(what, (given[-1],) if given else (), fix))
        return next(iter(firsts.values()))

    def refuse_unknown(self, known: list[str]) -> None:
        for key in self.section:
            if key not in known:
                near = nearest_names(key, known)
                fix = f"write {near[0]}" if near else f"known here: {', '.join(dict.fromkeys(known))}"
                self.problems.append(self._problem(f"unknown key {shown(key)}", (key,), fix, near))

    def values(self, kind: type, given: Mapping[str, Any] | None = None) -> Any:
        """Return the instance of `kind` that the section makes, None where something is wrong with it.

        What is `given` goes before the section; what `kind` does not have is left out.
        """
        merged = {**self.section, **(given or {})}
        values = {key: value for key, value in merged.items() if key in _keys(kind)}
        try:
            # by way of JSON: strict there means that "4" is no number, while a list still makes a tuple
            return TypeAdapter(kind).validate_json(json.dumps(values, default=str), strict=True)
        except ValidationError as error:
            missing_line = any("no line is named" in problem.message for problem in self.problems)
            for detail in error.errors():
                if not (detail["type"] == "missing" and missing_line):
                    self.problems.append(self._explained(kind, detail))
            return _Common() if kind is _Common else None

    def _explained(self, kind: type, detail: Any) -> Problem:
        path = tuple(detail["loc"])
        if detail["type"] == "missing":
            return self._problem(f"{path[-1]} is missing", path, f"add a line: {path[-1]}: ...")
        if detail["type"] in ("unexpected_keyword_argument", "extra_forbidden"):
            known = _known_keys(kind, path[:-1])
            near = nearest_names(str(path[-1]), known)
            fix = f"write {near[0]}" if near else f"known here: {', '.join(known)}"
            return self._problem(f"unknown key {shown(str(path[-1]))}", path, fix, near)
        message = str(detail["msg"]).removeprefix("Value error, ")
        given = detail.get("input")
        if detail["type"] == "value_error":
            # found by the section as a whole; the message begins with the key that it is about
            key = message.partition(" ")[0].rstrip(":")
            path = (*path, key) if not path and key in self.section else path
        elif isinstance(given, (str, int, float, bool)):
            message += f", got {shown(str(given))}"
        return self._problem(message[:1].lower() + message[1:], path)

    def _problem(self, message: str, path: tuple[str | int, ...], fix: str = "", near: tuple[str, ...] = ()) -> Problem:
        return Problem(Severity.ERROR, message, self.place.source("drivers", self.name, *path), fix, near)
