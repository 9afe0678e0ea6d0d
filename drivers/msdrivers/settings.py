"""Read and validate the `drivers` section of a vehicle file, make what it describes, and check it against the rest.

    drivers:
      gps: {device: novatel, port: /dev/ttyUSB0, baud: 38400}

`device` is the kind. The other keys follow from the dataclasses of the kind's lines and settings, which alone define
names, types and limits. `SectionReader` validates a section as `modelserver.config.reader` does a file, and collects
every problem with its line and fix. Of the settings drivers, emulators and links are made (`make_driver`).
"""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Callable, Collection, Hashable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, get_args

from modelserver.config.reader import Path_, SettingsReader, get_value, list_known_keys
from modelserver.errors import ConfigError, Location, Problem, Severity, Suggestion, quote, suggest_key, suggest_name
from msdrivers import registry
from msdrivers.emulate import InjectedFault
from msdrivers.endpoint import Endpoint
from msdrivers.links import Link
from msdrivers.registry import KINDS, DeviceKind, LineSettings, NtripSettings, get_line_key


def list_keys(*kinds: type) -> list[str]:
    """Return the names of the fields of dataclasses."""
    return list(dict.fromkeys(each.name for kind in kinds for each in dataclasses.fields(kind)))


class SectionReader(SettingsReader):
    """Reads one driver's section and collects its problems."""

    def __init__(self, name: str, section: Mapping[str, Any], locate: Callable[..., Location]):
        """`locate` returns the location of a key path in the vehicle file."""
        super().__init__(name, _CommonKeys)
        self.section, self._locate_key = section, locate
        self._has_line = True

    def locate(self, at: Path_) -> Location:
        return self._locate_key("drivers", self.name, *at)

    def read_kind(self, kinds: Mapping[str, DeviceKind]) -> DeviceKind:
        """Return the kind of device that the section names. Raises ConfigError."""
        given = self.section.get("device")
        if isinstance(given, str) and given in kinds:
            return kinds[given]
        known = f"kinds: {', '.join(kinds)}"
        if given is None:
            self.report("device", "device is missing", f"add a line: device: ... ({known})")
        elif given in KINDS.problems:
            why = f"device {quote(str(given))} of an installed package cannot be used: {KINDS.problems[given]}"
            self.report("device", why, "repair or reinstall that package")
        else:
            near = suggest_name(str(given), kinds)
            self.report("device", f"unknown device {quote(str(given))}", f"write {near[0]}" if near else known, near)
        raise ConfigError(self.problems)

    def read_line_type(self, kind: DeviceKind, more: list[str]) -> type[LineSettings]:
        """Return the type of line that the section names by its first key.

        `more`: the keys beside those of the line.
        """
        firsts = {get_line_key(each): each for each in kind.lines}
        if not any(key in self.section for key in firsts):
            known = [*list_keys(*kind.lines), *more]
            for key in [each for each in self.section if each not in known]:
                if not firsts.keys().isdisjoint(self._suggest((key,), known)):
                    self._report_misspelled(key, known)
        given = [key for key in firsts if key in self.section]
        if len(given) == 1:
            return firsts[given[0]]
        wanted = " or ".join(firsts)
        if given:
            self.report(given[-1], f"both {' and '.join(given)} are given", f"keep one of {wanted}")
        elif not any(key in self.section for key in map(get_line_key, get_args(LineSettings))):
            self.add_problem((), f"no line is named: {wanted} is missing", f"add a line: {next(iter(firsts))}: ...")
        self._has_line = False
        return next(iter(firsts.values()))

    def report_unknown_keys(self, kind: DeviceKind, line: type[LineSettings], more: list[str]) -> None:
        """Report keys that a driver of this kind on this line does not have."""
        known = [*list_keys(*((line,) if self._has_line else kind.lines)), *more]
        firsts = [get_line_key(each) for each in kind.lines]
        for key in [each for each in self.section if each not in known]:
            if key in list_keys(*get_args(LineSettings)):
                fix = "take it out" if self._has_line else f"write {firsts[0]}: ... in its place"
                here = get_line_key(line) if self._has_line else f"device {kind.name}"
                self.report(key, f"{key} does not go with {here}: device {kind.name} is on {' or '.join(firsts)}", fix)
            else:
                self._report_misspelled(key, known)

    def suggest_keys(self, key: str, at: Path_) -> tuple[tuple[str, ...], str]:
        """Return what an unknown key at a path misspells, and the fix."""
        known = list_known_keys(self.schema, at)
        near = self._suggest((*at, key), known)
        return near, f"write {near[0]}" if near else f"known here: {', '.join(known)}"

    def _suggest(self, path: Path_, known: list[str]) -> Suggestion:
        """Return the key that an unknown one at a path misspells; none that is given already."""
        given = get_value(self.section, path[:-1])
        known = [each for each in known if not isinstance(given, dict) or each not in given]
        return suggest_key(str(path[-1]), known)

    def _report_misspelled(self, key: str, known: list[str]) -> None:
        """Report an unknown key; its value is that of the key that is meant, which is not missing then."""
        near = self._suggest((key,), known)
        fix = f"write {near[0]}" if near else f"known here: {', '.join(dict.fromkeys(known))}"
        self.report(key, f"unknown key {quote(key)}", fix, near)
        if near:
            self.section = {near[0] if name == key else name: value for name, value in self.section.items()}

    def report(self, key: str, message: str, fix: str = "", nearest: tuple[str, ...] = ()) -> None:
        self.problems.append(Problem(Severity.ERROR, message, self.locate((key,)), fix, nearest))

    def read_values(self, kind: type, given: Mapping[str, Any] | None = None) -> Any:
        """Return the instance of `kind` that the section makes, None where something is wrong with it.

        What is `given` goes before the section; what `kind` does not have is left out.
        """
        self.schema, known = kind, len(self.problems)
        merged = json.loads(json.dumps({**self.section, **(given or {})}, default=str))
        found = self.validate({key: value for key, value in merged.items() if key in list_keys(kind)}, {})
        return found if len(self.problems) == known else None

    def explain(self, detail: Any) -> list[tuple[Path_, Problem]]:
        """Turn one of pydantic's errors into problems; a missing line is reported otherwise."""
        is_of_line = detail["loc"] and detail["loc"][-1] in list_keys(*get_args(LineSettings))
        return [] if detail["type"] == "missing" and is_of_line and not self._has_line else super().explain(detail)


@dataclass(frozen=True, slots=True)
class SourceMap:
    """File and lines of the keys by path."""

    file: str = ""
    lines: Mapping[tuple[str | int, ...], int] = field(default_factory=dict)

    def locate(self, *path: str | int) -> Location:
        """Return the place of a key, or of the nearest section around it. Names in a path may have dots."""
        lines = {".".join(map(str, each)): line for each, line in self.lines.items()}
        key = ".".join(map(str, path))
        parts = key.split(".")
        around = (".".join(parts[:n]) for n in range(len(parts), 0, -1))
        return Location(self.file, next((lines[each] for each in around if each in lines), 0), key)

    def locate_problems(self, name: str, problems: Iterable[Problem]) -> tuple[Problem, ...]:
        """Return problems of the driver `name` with the lines of the keys that they are about.

        Those of another file, e.g. of the syntax of a DBC, stay as they are.
        """
        found = []
        for problem in problems:
            if problem.element.startswith("drivers."):
                problem = dataclasses.replace(problem, source=self.locate(problem.element))
            elif not problem.file:
                problem = dataclasses.replace(problem, source=self.locate("drivers", name, problem.element))
            found.append(problem)
        return tuple(found)


@dataclass(frozen=True, slots=True)
class DriverSettings:
    """A driver: its name, its kind, its line, the settings of its station; `channel` empty: that of the sensor.

    `source_map` is where they were read from; `ntrip` the caster of its corrections, None for none.
    """

    name: str
    kind: DeviceKind
    line: LineSettings
    device_settings: Any
    channel: str = ""
    source_map: SourceMap = field(default=SourceMap(), compare=False, repr=False)
    ntrip: NtripSettings | None = None

    def make_warning(self, message: str, fix: str, *path: str, nearest: tuple[str, ...] = ()) -> Problem:
        """Return a problem of the key at a path of the driver's section."""
        source = self.source_map.locate("drivers", self.name, *path)
        return Problem(Severity.WARNING, message, source, fix, nearest)


def read_drivers(
    sections: Mapping[str, Mapping[str, Any]],
    source_map: SourceMap | None = None,
    kinds: Mapping[str, DeviceKind] = KINDS,
) -> tuple[dict[str, DriverSettings], tuple[Problem, ...]]:
    """Return the settings of every driver of which nothing is wrong, by its name; and every problem of the others."""
    source_map = source_map or SourceMap()
    problems = [*find_empty_sections(sections, source_map).values()]
    found = {}
    for name, section in sections.items():
        try:
            found[name] = read_driver(name, section, source_map, kinds)
        except ConfigError as error:
            problems += error.problems
    return found, tuple(problems)


def find_empty_sections(sections: Mapping[str, object], place: SourceMap) -> dict[str | int, Problem]:
    """Return the problems of drivers whose section is empty, which the parser leaves out, by name."""
    fix = "add a line: device: ..., or take the name out"
    return {
        path[1]: Problem(Severity.ERROR, f"{path[0]}.{path[1]} is empty: device is missing", place.locate(*path), fix)
        for path in place.lines
        if len(path) == 2 and path[0] == "drivers" and path[1] not in sections
    }


def read_driver(
    name: str, section: Mapping[str, Any], source_map: SourceMap | None = None, kinds: Mapping[str, DeviceKind] = KINDS
) -> DriverSettings:
    """Return the settings of one driver. Raises ConfigError with every problem of its section."""
    source_map = source_map or SourceMap()
    reader = SectionReader(name, section, source_map.locate)
    kind = reader.read_kind(kinds)
    settings = kind.load().settings
    station_keys = [key for key in list_keys(settings) if key != "source" and key not in kind.presets]
    more = [*COMMON_KEYS, *(["ntrip"] if kind.takes_corrections else []), *station_keys]
    line = reader.read_line_type(kind, more)
    reader.report_unknown_keys(kind, line, more)
    line_values = reader.read_values(line)
    given: dict[str, Any] = {"source": name, **kind.presets}
    baud = getattr(line_values, "baud", 0)
    if "bauds" in section and "baud" in section:
        reader.report("baud", "both baud and bauds are given", "keep one of baud or bauds")
    elif baud and "bauds" in station_keys:
        given["bauds"] = [baud]
    if line is registry.TcpSettings and "bauds" in station_keys:
        # the device server owns the rate; it cannot be changed from here
        given["bauds"] = []
    values = reader.read_values(settings, given)
    common = reader.read_values(_CommonKeys)
    if reader.problems:
        raise ConfigError(reader.problems)
    return DriverSettings(name, kind, line_values, values, common.channel, source_map, common.ntrip)


@dataclass(frozen=True, slots=True)
class _CommonKeys:
    """Keys that every driver has: its kind, and the channel, where it is not that of the sensors section."""

    device: str = ""
    channel: str = ""
    ntrip: NtripSettings | None = None


COMMON_KEYS = tuple(key for key in list_keys(_CommonKeys) if key != "ntrip")
"""Keys that every driver has; `ntrip` is of receivers that take corrections."""


def make_link(settings: DriverSettings) -> Link[Any]:
    """Return a driver's line, not opened yet."""
    line = settings.line
    # each kind of line needs another library, and some of them are slow to load
    if isinstance(line, registry.SerialSettings):
        from msdrivers.links.serial_port import SerialLink

        return SerialLink(line.port, choose_first_baud(settings))
    if isinstance(line, registry.CanSettings):
        from msdrivers.links.can_bus import CanLink

        return CanLink(line.can, line.interface, line.bitrate)
    from msdrivers.links import TcpLink

    link = TcpLink(*registry.split_address(line.address))
    if isinstance(line, registry.TcpSettings):
        return link
    from msdrivers.links.modbus import ModbusLink

    return ModbusLink(link, line.unit_id)


def choose_first_baud(settings: DriverSettings) -> int:
    """Return the rate to open a serial port at: the first to be tried, the port's, or the maker's."""
    bauds = getattr(settings.device_settings, "bauds", ())
    given = settings.line.baud if isinstance(settings.line, registry.SerialSettings) else 0
    return bauds[0] if bauds else given or settings.kind.baud


def make_driver(driver: DriverSettings, folder: Path) -> Endpoint[Any]:
    """Return a driver's station; paths in its settings start from `folder`. Raises ConfigError."""
    with _locate_errors(driver):
        return driver.kind.load().make_driver(driver.device_settings, folder)


def make_emulator(
    driver: DriverSettings,
    folder: Path,
    samples: Iterable[Any],
    faults: tuple[InjectedFault, ...] = (),
) -> Endpoint[Any]:
    """Return the endpoint of the emulated device; see `EmulatorInputs`. Raises ConfigError."""
    with _locate_errors(driver):
        return driver.kind.make_emulator(registry.EmulatorInputs(driver.device_settings, folder, samples, faults))


@contextmanager
def _locate_errors(driver: DriverSettings) -> Iterator[None]:
    try:
        yield
    except ConfigError as error:
        raise ConfigError(driver.source_map.locate_problems(driver.name, error.problems)) from None


def find_unbuildable_drivers(drivers: Iterable[DriverSettings], folder: Path) -> Iterator[Problem]:
    """Yield the problems of drivers that cannot be made: a missing DBC file, an unknown signal; and of their files."""
    for driver in drivers:
        try:
            yield from getattr(make_driver(driver, folder), "problems", ())
        except ConfigError as error:
            yield from error.problems


def find_shared_lines(drivers: Iterable[DriverSettings]) -> Iterator[Problem]:
    """Yield lines that several drivers use exclusively; a CAN bus can be shared."""
    owners: dict[Hashable, str] = {}
    for driver in drivers:
        if isinstance(driver.line, registry.CanSettings):
            continue
        # a port has several names, e.g. below /dev/serial/by-id/
        port = driver.line.port if isinstance(driver.line, registry.SerialSettings) else ""
        owner = owners.setdefault(os.path.realpath(port) if port else driver.line, driver.name)
        if owner != driver.name:
            message = f"drivers {owner} and {driver.name} have one line, {driver.line}: only one of them can use it"
            fix = "give each a line of its own, or start only one of them"
            yield driver.make_warning(message, fix, get_line_key(type(driver.line)))


def find_unknown_wheels(driver: DriverSettings, frames: Collection[str]) -> Iterator[Problem]:
    """Yield wheels that are not in `sensors.wheels.frames`; none if that is empty."""
    wheels = tuple(getattr(driver.device_settings, "wheels", ()))
    for name in wheels if frames else ():
        if name in frames:
            continue
        what = f"sensors.wheels.frames has no {quote(name)}: what is measured of this wheel is not used"
        # a wheel there that this driver does not measure is meant: but which of the two names is the misspelled one?
        left = [frame for frame in frames if frame not in wheels]
        near = suggest_name(name, left)
        both = f"write one name in both places: here it is {quote(name)}, in sensors.wheels.frames"
        fix = f"{both} {quote(near[0])}" if near else f"known: {', '.join(list(frames)[:10])}"
        yield driver.make_warning(what, fix, "wheels", name)


def find_backward_counters(driver: DriverSettings) -> Iterator[Problem]:
    """Yield the wheels whose count falls as they roll forward."""
    for name, wheel in getattr(driver.device_settings, "wheels", {}).items():
        if wheel.count is not None and wheel.count.meters_per_count < 0.0:
            why = (
                f"wheel {name} rolls backward as its count rises: meters_per_count is {wheel.count.meters_per_count:g}"
            )
            fix = "right for an encoder that is mounted mirrored, else drop the sign"
            yield driver.make_warning(why, fix, "wheels", name)


def find_unknown_joint(driver: DriverSettings, constraints: Collection[str]) -> Iterator[Problem]:
    """Yield the joints that are no constraints of the geometry."""
    settings = driver.device_settings
    places = {joint: ("joint",) for joint in [getattr(settings, "joint", "")] if joint}
    places |= {joint: ("joints", joint) for joint in getattr(settings, "joints", ())}
    for joint, place in places.items():
        if joint in constraints:
            continue
        what = f"the geometry has no constraint {quote(joint)}: what is measured of this joint moves nothing"
        near = suggest_name(joint, constraints)
        fix = f"write {near[0]}" if near else f"known: {', '.join(list(constraints)[:10]) or 'none'}"
        yield driver.make_warning(what, fix, *place, nearest=near)
