"""Conversion of Miro's process configuration (report, Annex B.3) to a vehicle file.

The server of 2005 read a process configuration in XML that named the geometry file and held its tunables. The report
has the format of such files and none of ModelServer's own parameters, so a parameter is matched by its name: the keys
of the vehicle file without punctuation and case (`Publish`/`RateHz`, `PublishRateHz` and `RateHz` are publish.rate_hz),
and the names in `SYNONYMS` for those of the report. A name that fits several keys fits none. Each line of the
result names the parameter that it comes from; what has no counterpart, or a value that the key rejects, is listed in a
comment at the end and reported as a warning.
"""

from __future__ import annotations

import dataclasses
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import islice
from pathlib import Path
from types import NoneType, UnionType
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple, Union, get_args, get_origin, get_type_hints

import yaml

from modelserver.config.vehicle_file import VehicleConfig, parse_partly
from modelserver.errors import GeometryError, Location, Problem, QueryError, Severity, quote
from modelserver.files.kinds import EXAMINED_BYTES
from modelserver.formats import check_file, xml_document
from modelserver.geometry.builder import ModelBuilder
from modelserver.geometry.model import Model
from mstools.terminal.output import escape
from mstools.terminal.problems import find_nearest_path, make_error

if TYPE_CHECKING:
    from lxml.etree import _Element as Element

Key = tuple[str, ...]

_SYNONYMS: Final[Mapping[Key, str]] = {
    ("geometry",): "geometryfile geometryfilename geometryxml vehiclegeometry modelfile",
    ("vehicle",): "vehiclename robotname",
    ("publish", "mode"): "updatemode eventdriven timerdriven",
    ("publish", "rate_hz"): "updaterate updateratehz poserate poseratehz",
    ("localization", "mode"): "rawmode",
    ("localization", "filter", "recapture_time"): "stationarytime biasrecapturetime",
    ("origin", "initial_utm"): "utmorigin",
    ("origin", "zone"): "utmzone",
    ("origin", "hemisphere"): "utmhemisphere",
}

SYNONYMS: Final = {name: key for key, names in _SYNONYMS.items() for name in names.split()}
"""Names in the report, without punctuation and case, with the key of the vehicle file."""

SWITCHES: Final[Mapping[str, tuple[str, str]]] = {
    "eventdriven": ("event", "timer"),
    "timerdriven": ("timer", "event"),
    "rawmode": ("raw", "full"),
}
"""Names with a Boolean value, and the vehicle file's values for true and false."""

OWN_SECTION: Final = "modelserver"
"""Sections with this in their name are ModelServer's; if there is one, parameters of others need section and name."""

MIN_NAME_LENGTH: Final = 6
"""Letters of a name that is matched without its section: `Type` or `Mode` alone are ambiguous."""

MAX_SETTINGS: Final = 10_000
"""Largest number of parameters."""

_MAPPINGS: Final = frozenset({("variables",), ("sensors", "wheels", "frames")})
"""Keys of the vehicle file with entries named by the user."""


class ProcessParameter(NamedTuple):
    """A parameter of the process configuration with a value, or a list of values: `path` from its section down."""

    path: tuple[str, ...]
    value: str | tuple[str, ...]
    line: int

    @property
    def label(self) -> str:
        """The path for messages."""
        return "/".join(self.path)


class Conversion(NamedTuple):
    """The text of the vehicle file, and a warning for each unconverted parameter."""

    text: str
    problems: tuple[Problem, ...]


def convert_process(file: str, target: str, variables: Mapping[str, str] | None = None) -> Conversion:
    """Convert a process configuration to the text of a vehicle file at `target`.

    `target` is a path, or - for standard output; the geometry file is named relative to it. `variables` fill `$NAME` in
    a frame-tree geometry. Raises ConfigError if the file names no geometry file, GeometryError if one of the two
    is wrong, OSError if one cannot be read.
    """
    with open(file, "rb") as stream:
        content = stream.read(EXAMINED_BYTES + 1)
    if len(content) > EXAMINED_BYTES:
        why = f"the file is larger than {EXAMINED_BYTES >> 20} MiB"
        raise make_error(why, file, "is this the process configuration?")
    builder = ModelBuilder()
    root = xml_document.parse(content, builder, file)
    if root is None:
        raise GeometryError(builder.problems)
    settings = list(islice(_iter_parameters(root, ()), MAX_SETTINGS + 1))
    if len(settings) > MAX_SETTINGS:
        why = f"the file has more than {MAX_SETTINGS} parameters"
        raise make_error(why, Location(file, settings[-1].line), "remove the sections of other processes")
    matching = _KeyMatcher(file, settings)
    for setting in settings:
        matching.add(setting)
    geometry = _find_geometry(matching, file)
    model, problems = check_file(geometry, variables)
    if model is None:
        raise GeometryError(problems)
    # as a vehicle file at `target` names it
    folder = os.path.dirname(target) if target != "-" else None
    matching.values["geometry",] = os.path.relpath(geometry, folder)
    matching.complete(model)
    return Conversion(_format_vehicle_file(matching, file), matching.list_problems())


def _iter_parameters(element: Element, path: tuple[str, ...]) -> Iterator[ProcessParameter]:
    """Yield every parameter with a value, or with a list of values, below an element, in the order of the file."""
    for number, child in enumerate(xml_document.iterate_children(element)):
        below = (*path, (child.get("name") or "").strip() or f"[{number}]")
        value, inside = child.get("value"), list(xml_document.iterate_children(child))
        if value is not None:
            yield ProcessParameter(below, value.strip(), xml_document.get_line(child))
        elif inside and all(each.get("name") is None and each.get("value") is not None for each in inside):
            values = tuple([(each.get("value") or "").strip() for each in inside])
            yield ProcessParameter(below, values, xml_document.get_line(child))
            continue
        # libxml2 limits the depth of this recursion
        yield from _iter_parameters(child, below)


class _KeyMatcher:
    """Match parameters with keys of the vehicle file: value and source of each key, and the skipped parameters."""

    def __init__(self, file: str, settings: Iterable[ProcessParameter]):
        self.file = file
        self.own = {each.path[0] for each in settings if OWN_SECTION in _normalize(each.path[0])}
        self.values: dict[Key, Any] = {}
        self.sources: dict[Key, ProcessParameter] = {}
        self.notes: dict[Key, str] = {}
        self.skipped: list[tuple[ProcessParameter, str, tuple[str, ...]]] = []
        self._types = dict(_iter_keys(VehicleConfig, ()))

    def add(self, setting: ProcessParameter) -> None:
        """Match a parameter with a key, or skip it."""
        found = self._keys_of(setting)
        if len(found) != 1:
            near = tuple(".".join(key) for key in found)
            self.skipped.append((setting, "its name fits several keys" if found else "no counterpart", near))
            return
        (key,) = found
        if key in self.values:
            why = f"{'.'.join(key)} is given already (line {self.sources[key].line})"
            self.skipped.append((setting, why, ()))
            return
        try:
            self.values[key] = _parse_value(setting, self._types.get(key, str))
            self.sources[key] = setting
        except ValueError as error:
            self.skipped.append((setting, f"{'.'.join(key)} {error}", ()))

    def list_problems(self) -> tuple[Problem, ...]:
        """Return a warning for each skipped parameter, and for a vehicle file without sensors, by line."""
        problems = []
        for setting, why, near in sorted(self.skipped, key=lambda each: each[0].line):
            fix = f"write it under {' or '.join(near)} if that is what it means" if near else ""
            message = f"{quote(setting.label, 80)} is not converted: {why}"
            place = Location(self.file, setting.line, setting.label)
            problems.append(Problem(Severity.WARNING, message, place, fix or "see docs/vehicle-file.md", near))
        if not any(key[0] == "sensors" for key in self.values):
            fix = "add sensors to the vehicle file: docs/vehicle-file.md has an example"
            why = "no parameter names a sensor's channel and frame, so there will be no pose"
            problems.insert(0, Problem(Severity.WARNING, why, Location(self.file), fix))
        return tuple(problems)

    def drop(self, key: Key, why: str) -> None:
        """Remove the key of a parameter, which is skipped."""
        del self.values[key]
        self.skipped.append((self.sources.pop(key), why, ()))

    def complete(self, model: Model) -> None:
        """Remove what the geometry or the vehicle file rejects, and add required keys."""
        for key in tuple(self.values):
            if key[-1].endswith("frame") or key[:-1] == ("sensors", "wheels", "frames"):
                try:
                    model.frame(self.values[key])
                except QueryError as error:
                    self.drop(key, str(error))
        frame = next((name for name in ("CG", "Origin") if model.root.has_frame(name)), model.root.frames[0].name)
        for name, value, place in (
            ("base_frame", model.root.frame(frame).full_name, "root body"),
            ("vehicle", model.name or model.root.name, "geometry"),
        ):
            if (name,) not in self.values:
                self.values[name,], self.notes[name,] = value, f"no parameter names it; taken from the {place}"
        while True:
            _, problems = parse_partly(_format_vehicle_file(self, "").encode(), self.file)
            # remove wrong keys and check the rest again: a section's own rules are checked last
            if not sum(self._drop_wrong(problem) for problem in problems):
                break

    def _drop_wrong(self, problem: Problem) -> bool:
        """Remove the keys of a problem of the vehicle file; return whether there was one."""
        at = tuple(problem.element.split("."))
        while at and not (below := [key for key in self.sources if key[: len(at)] == at]):
            at = at[:-1]
        for key in below if at else ():
            self.drop(key, problem.message)
        return bool(at)

    def _keys_of(self, setting: ProcessParameter) -> list[Key]:
        """Return the keys that match the longest part of a parameter's path."""
        words = [_normalize(each) for each in setting.path]
        # the file is common to all processes: a rate in the section of another one is not ours
        is_own = not self.own or setting.path[0] in self.own
        synonym = SYNONYMS.get(words[-1])
        if synonym is not None and (is_own or len(synonym) == 1):
            return [synonym]
        for count in range(len(words), 0 if is_own else 1, -1):
            name = "".join(words[-count:])
            found = [
                key for key in self._types if any(name == "".join(map(_normalize, key[n:])) for n in range(len(key)))
            ]
            whole = [key for key in found if name == "".join(map(_normalize, key))]
            if found and (count > 1 or len(name) >= MIN_NAME_LENGTH or whole or len(found) > 1):
                return whole or found
        section = "".join(words[:-1])
        return [(*key, setting.path[-1]) for key in _MAPPINGS if section.endswith("".join(map(_normalize, key[-2:])))]


def _normalize(name: str) -> str:
    return re.sub(r"[\W_]", "", name).lower()


def _iter_keys(schema: type, at: Key) -> Iterator[tuple[Key, Any]]:
    """Yield the keys of the vehicle file that have a value, and its type."""
    hints = get_type_hints(schema)
    for each in dataclasses.fields(schema):
        kind = hints[each.name]
        choices = [one for one in (kind, *_get_choices(kind)) if dataclasses.is_dataclass(one)]
        if choices:
            assert isinstance(choices[0], type)
            yield from _iter_keys(choices[0], (*at, each.name))
        elif get_origin(kind) is not dict:
            yield (*at, each.name), kind


def _get_choices(kind: Any) -> tuple[Any, ...]:
    """Return the types of a union without None, one type alone as it is."""
    if get_origin(kind) in (Union, UnionType):
        return tuple(each for each in get_args(kind) if each is not NoneType)
    return (kind,)


def _parse_value(setting: ProcessParameter, kind: Any) -> Any:
    """Return the value of a parameter as the type of its key. Raises ValueError with what is expected."""
    text, switch = setting.value, SWITCHES.get(_normalize(setting.path[-1]))
    (kind, *_) = _get_choices(bool if switch else kind)
    if get_origin(kind) is tuple:
        return [_parse_word(word, float) for word in (text.split() if isinstance(text, str) else text)]
    if not isinstance(text, str):
        raise ValueError(f"takes one value, got a list of {len(text)}")
    if get_origin(kind) is Literal and text.lower() in get_args(kind):
        return text.lower()
    value = _parse_word(text, kind)
    return switch[0 if value else 1] if switch else value


_BOOLEANS: Final = dict.fromkeys(("true", "1", "yes", "on"), True) | dict.fromkeys(("false", "0", "no", "off"), False)

_PARSERS: Final[Mapping[Any, tuple[Callable[[str], Any], str]]] = {
    bool: (lambda text: _BOOLEANS[text.lower()], "true or false"),
    int: (int, "a whole number"),
    float: (float, "a number"),
}


def _parse_word(text: str, kind: Any) -> Any:
    parse, expected = _PARSERS.get(kind, (str, ""))
    try:
        return parse(text)
    except (ValueError, KeyError):
        raise ValueError(f"takes {expected}, got {quote(text, 40)}") from None


def _find_geometry(matching: _KeyMatcher, file: str) -> str:
    """Return the path of the geometry file that the process configuration names. Raises ConfigError."""
    named = matching.values.get(("geometry",))
    if named is None:
        # accept any name whose value is an existing file, if there is only one
        folder = Path(file).parent
        files = [
            setting
            for setting, *_ in matching.skipped
            if isinstance(setting.value, str)
            and setting.value.lower().endswith((".xml", ".yaml", ".yml", ".urdf"))
            and (folder / setting.value).is_file()
        ]
        if len(files) != 1:
            known = ", ".join(each.label for each in files[:5])
            why = "no parameter names the geometry file" + (f"; it may be one of {known}" if files else "")
            fix = 'add <parameter name="GeometryFile" value="geometry.xml"/> to its section'
            raise make_error(why, file, fix)
        (found,) = files
        matching.skipped = [each for each in matching.skipped if each[0] is not found]
        named = str(found.value)
        matching.sources[("geometry",)] = found
    path = Path(file).parent / os.path.expanduser(named)
    if not path.exists():
        setting = matching.sources[("geometry",)]
        near = find_nearest_path(path)
        fix = f"did you mean {near}?" if near else "paths are taken relative to the process configuration; correct it"
        why = f"the geometry file {quote(named, 100)} is missing"
        raise make_error(why, Location(file, setting.line, setting.label), fix)
    return str(path)


def _format_vehicle_file(matching: _KeyMatcher, file: str) -> str:
    """Format the vehicle file: required keys first, sections in schema order, each line with its source."""
    order = {each.name: number for number, each in enumerate(dataclasses.fields(VehicleConfig))}
    keys = sorted(matching.values, key=lambda key: (order[key[0]], len(key) > 1, key))
    lines = []
    if file:
        name = escape(os.path.basename(file))
        lines.append(f"# Converted from {name} by modelserver convert. Keys that are not here have their defaults; see")
        lines.append("# docs/vehicle-file.md. The comments name the lines of that file.")
    open_section: Key = ()
    for key in keys:
        shared = 0
        while shared < min(len(open_section), len(key) - 1) and open_section[shared] == key[shared]:
            shared += 1
        lines += [f"{'  ' * depth}{_format_scalar(key[depth])}:" for depth in range(shared, len(key) - 1)]
        open_section = key[:-1]
        source = matching.sources.get(key)
        origin = f"line {source.line}: {escape(source.label)}" if source is not None else matching.notes.get(key, "")
        line = f"{'  ' * (len(key) - 1)}{_format_scalar(key[-1])}: {_format_scalar(matching.values[key])}"
        lines.append(f"{line} # {origin}" if origin else line)
    if matching.skipped and file:
        lines += ["", "# Not converted:"]
        for setting, why, _ in sorted(matching.skipped, key=lambda each: each[0].line):
            value = setting.value if isinstance(setting.value, str) else " ".join(setting.value)
            lines.append(f"#   line {setting.line}: {escape(setting.label)} = {quote(value, 80)}: {escape(why)}")
    return "\n".join(lines) + "\n"


def _format_scalar(value: Any) -> str:
    """Format a value or a key as YAML on one line."""
    text: str = yaml.safe_dump(value, default_flow_style=True, width=1e9, allow_unicode=True)
    return text.removesuffix("\n").removesuffix("...").rstrip()
