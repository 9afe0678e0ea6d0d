"""The `drivers` section of a vehicle file: read into the settings of the kind of device that each driver names.

    drivers:
      gps: {device: novatel, port: /dev/ttyUSB0, baud: 38400}

`device` is the kind; which further keys there are follows from the kind's lines and its settings, both dataclasses:
names, types and limits are written there and nowhere else.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from modelserver.errors import ConfigError, Location, Problem, Severity
from msdrivers.line_settings import LineSettings, TcpSettings
from msdrivers.registry import KINDS, DeviceKind
from msdrivers.section_reader import SectionReader, keys_of
from msdrivers.settings_words import Words

SOURCE = "source"
"""The field of a kind's settings that takes the driver's name."""

BAUDS = "bauds"
"""The field of a kind's settings that has the rates to try; `baud` in the section gives it one."""


@dataclass(frozen=True, slots=True)
class Place:
    """Where in which file a section stands; `lines` has the line of each key by its path."""

    file: str = ""
    lines: Mapping[tuple[str | int, ...], int] = field(default_factory=dict)

    def source(self, *path: str | int) -> Location:
        """Return the place of a key, or of the nearest section around it."""
        line = next((self.lines[path[:n]] for n in range(len(path), 0, -1) if path[:n] in self.lines), 0)
        return Location(self.file, line, ".".join(map(str, path)))

    def located(self, name: str, problems: Iterable[Problem]) -> tuple[Problem, ...]:
        """Return problems of the driver `name` with the lines of the keys that they are about.

        Those of another file, e.g. of the syntax of a DBC, stay as they are. Names in a path may have dots.
        """
        lines = {".".join(map(str, path)): line for path, line in self.lines.items()}

        def there(problem: Problem) -> Problem:
            key = problem.element
            if not key.startswith("drivers."):
                if problem.file:
                    return problem
                key = f"drivers.{name}.{key}"
            parts = key.split(".")
            around = (".".join(parts[:n]) for n in range(len(parts), 0, -1))
            line = next((lines[each] for each in around if each in lines), 0)
            return dataclasses.replace(problem, source=Location(self.file, line, key))

        return tuple(map(there, problems))


@dataclass(frozen=True, slots=True)
class DriverSettings:
    """A driver: its name, its kind, its line, the settings of its station; `channel` empty: that of the sensor.

    `place` is where they were read from.
    """

    name: str
    kind: DeviceKind
    line: LineSettings
    station: Any
    channel: str = ""
    place: Place = field(default=Place(), compare=False, repr=False)


def read_drivers(
    sections: Mapping[str, Mapping[str, Any]], place: Place | None = None, kinds: Mapping[str, DeviceKind] = KINDS
) -> tuple[dict[str, DriverSettings], tuple[Problem, ...]]:
    """Return the settings of every driver of which nothing is wrong, by its name; and every problem of the others."""
    place = place or Place()
    problems = [empty_section(name, place) for name in empty_sections(sections, place)]
    found = {}
    for name, section in sections.items():
        try:
            found[name] = read_driver(name, section, place, kinds)
        except ConfigError as error:
            problems += error.problems
    return found, tuple(problems)


def empty_sections(sections: Mapping[str, object], place: Place) -> list[str]:
    """Return the names of drivers that stand in the file with nothing after them, which counts as left out."""
    named = [path[1] for path in place.lines if len(path) == 2 and path[0] == "drivers"]
    return [str(name) for name in named if name not in sections]


def empty_section(name: str, place: Place) -> Problem:
    """Return the problem of a driver that has a name and nothing else."""
    message, fix = f"drivers.{name} is empty: device is missing", "add a line: device: ..., or take the name out"
    return Problem(Severity.ERROR, message, place.source("drivers", name), fix)


def read_driver(
    name: str, section: Mapping[str, Any], place: Place | None = None, kinds: Mapping[str, DeviceKind] = KINDS
) -> DriverSettings:
    """Return the settings of one driver. Raises ConfigError with every problem of its section."""
    place = place or Place()
    reader = SectionReader(name, section, place.source)
    kind = reader.kind(kinds)
    settings = kind.load().settings
    station_keys = [key for key in keys_of(settings) if key != SOURCE and key not in kind.presets]
    more = [*keys_of(_Common), *station_keys]
    line = reader.line(kind, more)
    reader.refuse_unknown(kind, line, more)
    line_values = reader.values(line)
    given: dict[str, Any] = {SOURCE: name, **kind.presets}
    baud = getattr(line_values, "baud", 0)
    if "bauds" in section and "baud" in section:
        reader.refuse("baud", Words("both baud and bauds are given", "keep one of baud or bauds"))
    elif baud and BAUDS in station_keys:
        given[BAUDS] = [baud]
    if line is TcpSettings and BAUDS in station_keys:
        # the device server has the rate, and cannot be told another
        given[BAUDS] = []
    values = reader.values(settings, given)
    common = reader.values(_Common)
    if reader.problems:
        raise ConfigError(reader.problems)
    return DriverSettings(name, kind, line_values, values, common.channel, place)


@dataclass(frozen=True, slots=True)
class _Common:
    """Keys that every driver has: its kind, and the channel, where it is not that of the sensors section."""

    device: str = ""
    channel: str = ""


COMMON = tuple(keys_of(_Common))
"""Keys that every driver has."""
