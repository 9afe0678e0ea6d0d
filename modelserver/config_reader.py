"""Reading a YAML file into typed, strict values: every problem at once, each with its line and the nearest key."""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Mapping
from functools import cache
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

import yaml
from pydantic import TypeAdapter, ValidationError

from modelserver.errors import ConfigError, Location, Problem, Severity, Suggested, shown, suggest_key, suggestions

MAX_BYTES = 1 << 20

MAX_DEPTH = 16
"""No section nests deeper than 3. PyYAML's composer calls itself for each level, in C, and would end the process."""

S = TypeVar("S")


ROUNDS = 8
"""How often what was wrong is left out and the rest looked at again, at most."""


def read(raw: bytes, name: str, schema: type[S]) -> S:
    """Return the values that the bytes of a file called `name` hold, as an instance of a dataclass.

    Raises ConfigError with every problem.
    """
    found, problems = read_partly(raw, name, schema)
    if found is None or problems:
        raise ConfigError(problems)
    return found


def read_partly(
    raw: bytes, name: str, schema: type[S], blanks: Mapping[str, str] | None = None
) -> tuple[S | None, tuple[Problem, ...]]:
    """Return what the bytes hold without what is wrong in them, None where too little is left; and every problem.

    A required key of the top level that is missing or wrong takes its value from `blanks`, so that the rest can be
    examined all the same. Raises ConfigError for what is no YAML mapping at all.
    """
    reader, values = _composed(raw, name, schema)
    problems = list(reader.problems)
    if any(at[-1:] == ("?",) for at in reader.lines):
        return None, tuple(problems)  # with such keys the rest is not what was meant
    dropped: set[Path_] = set()
    found: S | None = None
    adapter = adapter_of(schema)
    for _ in range(ROUNDS):
        try:
            # by way of JSON: strict there means that "4" is no number, while a mapping still makes a section
            found = adapter.validate_json(json.dumps(values, default=str), strict=True)
            break
        except ValidationError as error:
            explained = [each for detail in error.errors() for each in reader.explain(detail)]
        # a section's own rules are looked at once all in it is of the right type: so what is wrong goes, and again
        renamed = [
            at for at, problem in explained if problem.replaced and reader.rename(values, at, problem.nearest[0])
        ]
        meant = {(*at[:-1], problem.nearest[0]) for at, problem in explained if at in renamed}
        fresh = [(at, problem) for at, problem in explained if at not in dropped and at not in meant]
        problems += [problem for _, problem in fresh]
        gone = [at in renamed or _drop(values, at, dropped) for at, _ in fresh]
        filled = [key for key, value in (blanks or {}).items() if values.setdefault(key, value) is value]
        gone = [*(each for each in gone if each), *(True for _ in filled)] if filled else gone
        if not gone or not all(gone):
            break
    return found, tuple(sorted(problems, key=lambda each: each.line))


_ADAPTERS: dict[type, TypeAdapter[Any]] = {}


def adapter_of(schema: type[S]) -> TypeAdapter[S]:
    """Return what checks values by a dataclass, kept: making one takes a hundred times as long as using it."""
    found = _ADAPTERS.get(schema)
    if found is None:
        found = _ADAPTERS[schema] = TypeAdapter(schema)
    return found


def _drop(values: Any, at: Path_, dropped: set[Path_]) -> bool:
    """Take away what stands at a place, or the nearest above it that is there; return whether there was anything."""
    steps = at[: next((n for n, step in enumerate(at) if isinstance(step, int)), len(at))]
    while steps:
        if steps in dropped:
            return True
        inside = _inside(values, steps[:-1])
        if isinstance(inside, dict) and steps[-1] in inside:
            del inside[steps[-1]]
            dropped.add(steps)
            return True
        steps = steps[:-1]
    return False


def _inside(values: Any, at: Path_) -> Any:
    for step in at:
        values = values.get(step) if isinstance(values, dict) else None
    return values


def lines(raw: bytes, name: str, schema: type) -> dict[Path_, int]:
    """Return the line of each key, by its place. Raises ConfigError as `read_partly` does."""
    reader, _ = _composed(raw, name, schema)
    return reader.lines


def _composed(raw: bytes, name: str, schema: type) -> tuple[_Reader, Any]:
    """Return the values of a file, as they stand there, and the reader that knows their lines."""
    if len(raw) > MAX_BYTES:
        raise _one(name, 0, f"the file is larger than {MAX_BYTES >> 20} MiB", "is this the vehicle file?")
    try:
        if not raw.startswith((b"\xff\xfe", b"\xfe\xff")):
            raw.decode()
        _check_shape(raw, name)
        node = yaml.compose(raw, Loader=yaml.CSafeLoader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        what = getattr(error, "problem", None) or str(error).splitlines()[0]
        raise _one(name, mark.line + 1 if mark else 0, f"not YAML: {what}", "check indentation and quotes") from None
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        what = f"not text in UTF-8: byte 0x{raw[error.start]:02x} in this line"
        raise _one(name, line, what, "save it as UTF-8; is this the vehicle file?") from None
    if not isinstance(node, yaml.MappingNode):
        required = [each.name for each in dataclasses.fields(schema) if _is_required(each)]
        what = "the file is empty" if node is None else "the file is no mapping (key: value, one a line)"
        raise _one(name, 1, what, f"start with: {', '.join(required)}")
    reader = _Reader(name, schema)
    return reader, reader.value(node, ())


def _is_required(each: dataclasses.Field[Any]) -> bool:
    return each.default is dataclasses.MISSING and each.default_factory is dataclasses.MISSING


Path_ = tuple[str | int, ...]


class _Reader:
    """Turns YAML nodes into plain values, and remembers the line of each."""

    def __init__(self, name: str, schema: type):
        self.name = name
        self.schema = schema
        self.lines: dict[Path_, int] = {}
        self.problems: list[Problem] = []

    def value(self, node: yaml.Node, at: Path_) -> Any:
        self.lines.setdefault(at, node.start_mark.line + 1)
        if isinstance(node, yaml.MappingNode):
            values: dict[str, Any] = {}
            for key_node, value_node in node.value:
                if not isinstance(key_node, yaml.ScalarNode):
                    self.lines[(*at, "?")] = key_node.start_mark.line + 1
                    self.problem((*at, "?"), "a key is a name, not a list or a mapping", "write name: value")
                    continue
                key = str(key_node.value)
                if key in values:
                    first = self.lines[(*at, key)]
                    self.lines[(*at, key)] = key_node.start_mark.line + 1
                    self.problem((*at, key), f"{key} is given twice (first on line {first})", "remove one")
                    continue
                self.lines[(*at, key)] = key_node.start_mark.line + 1
                value = self.value(value_node, (*at, key))
                # a key with nothing after it counts as left out, as when all of a section is commented out
                if value is not None:
                    values[key] = value
            return values
        if isinstance(node, yaml.SequenceNode):
            return [self.value(each, (*at, index)) for index, each in enumerate(node.value)]
        return _scalar(node)

    def problem(self, at: Path_, message: str, fix: str, nearest: tuple[str, ...] = ()) -> None:
        self.problems.append(Problem(Severity.ERROR, message, self.place(at), fix, nearest))

    def rename(self, values: Any, at: Path_, meant: str) -> bool:
        """Move what stands at a misspelled key to the key that is meant, so that it is examined, and not missing.

        Return whether there is such a key.
        """
        known, around = _known_keys(self.schema, at[:-1]), _inside(values, at[:-1])
        if meant not in known or at[-1] in known or not isinstance(around, dict) or meant in around:
            return False
        around[meant] = around.pop(at[-1])
        moved = {path: line for path, line in self.lines.items() if path[: len(at)] == at}
        self.lines.update({(*at[:-1], meant, *path[len(at) :]): line for path, line in moved.items()})
        return True

    def place(self, at: Path_) -> Location:
        line = next((self.lines[at[:n]] for n in range(len(at), -1, -1) if at[:n] in self.lines), 0)
        return Location(self.name, line, ".".join(map(str, at)))

    def explain(self, detail: Any) -> list[tuple[Path_, Problem]]:
        """Turn one of pydantic's findings into problems, each with its place, its line and the nearest key."""
        at: Path_ = tuple(detail["loc"])
        kind = detail["type"]
        if kind in ("unexpected_keyword_argument", "extra_forbidden"):
            near, fix = self._instead_of(str(at[-1]), at[:-1])
            message = f"unknown key {shown(str(at[-1]))}"
        elif kind == "missing" and isinstance(at[-1], int):
            at = at[:-1]
            near, fix, message = (), "", f"{at[-1]} has too few numbers"
        elif kind == "missing":
            near, fix, message = (), f"add a line: {at[-1]}: ...", f"{at[-1]} is missing"
        elif kind == "value_error":
            return self._of_section(at, str(detail["msg"]).removeprefix("Value error, "))
        else:
            near, fix, message = self._of_value(detail)
        return [(at, Problem(Severity.ERROR, message, self.place(at), fix, near))]

    def _of_section(self, at: Path_, text: str) -> list[tuple[Path_, Problem]]:
        """Return what a section's own rules found, one a line; each begins with the key that it is about."""
        found = []
        for message in text.splitlines():
            key = message.partition(" ")[0]
            there = (*at, key) if (*at, key) in self.lines else at
            found.append((there, Problem(Severity.ERROR, _fit(message), self.place(there))))
        return found

    def _of_value(self, detail: Any) -> tuple[tuple[str, ...], str, str]:
        """Return the nearest values, what to write, and what is wrong with a single value."""
        near: tuple[str, ...] = ()
        message, got = str(detail["msg"]), detail.get("input")
        if detail["type"] in ("dataclass_type", "dict_type"):
            message = "expected a mapping (key: value, one a line)"
        if isinstance(got, (str, int, float, bool)):
            message += f", got {shown(str(got))}"
        if detail["type"] == "literal_error" and isinstance(got, str):
            near = suggestions(got, re.findall(r"'([^']*)'", str(detail["ctx"]["expected"])))
        return near, f"write {near[0]}" if near else "", _fit(message)

    def _instead_of(self, key: str, at: Path_) -> tuple[tuple[str, ...], str]:
        """Return the known keys nearest to one that is not known at a place, and what to write."""
        known = _known_keys(self.schema, at)
        # one that is given already is not what was meant
        free = [each for each in known if (*at, each) not in self.lines]
        below: dict[str, list[str]] = {}
        for section in known:
            for each in _known_keys(self.schema, (*at, section)):
                below.setdefault(each, []).append(".".join(map(str, (*at, section))))
        near = Suggested() if key in below else suggest_key(key, free)
        if near:
            return near, f"write {near[0]}"
        deeper = (key,) if key in below else tuple(suggest_key(key, below))
        if deeper:
            # one level up is a common slip, and what an older version's file may have
            return deeper, f"write {deeper[0]} under {' or '.join(below[deeper[0]])}"
        return (), f"known here: {', '.join(known)}"


def _fit(message: str) -> str:
    if len(message) > 240:
        message = f"{message[:240]}..."
    return message[:1].lower() + message[1:]


_EXPONENT = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+", re.ASCII)
"""Numbers such as 1e-3, which YAML 1.1 takes for text."""


def _scalar(node: yaml.Node) -> Any:
    if isinstance(node, yaml.ScalarNode) and not node.style and _EXPONENT.fullmatch(node.value):
        return float(node.value)
    loader = yaml.CSafeLoader("")
    try:
        return loader.construct_object(node, deep=True)
    except (yaml.YAMLError, ValueError):
        return str(node.value)


def _known_keys(schema: type, at: Path_) -> list[str]:
    """Return the keys known at a place in the file."""
    kind: Any = schema
    for step in at:
        if get_origin(kind) is dict:
            kind = get_args(kind)[1]
        else:
            kind = _hints(kind).get(str(step)) if isinstance(kind, type) and dataclasses.is_dataclass(kind) else None
        section = (each for each in (kind, *get_args(kind)) if dataclasses.is_dataclass(each))
        kind = kind if get_origin(kind) is dict else next(section, None)
    return [each.name for each in dataclasses.fields(kind)] if dataclasses.is_dataclass(kind) else []


@cache
def _hints(kind: type) -> dict[str, Any]:
    return get_type_hints(kind)


def _check_shape(raw: bytes, name: str) -> None:
    """Raise ConfigError for what no vehicle file has and the composer cannot bear: deep nesting, aliases of aliases."""
    depth = 0
    for event in yaml.parse(raw, Loader=yaml.CSafeLoader):
        line = event.start_mark.line + 1 if event.start_mark else 0
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
            if depth > MAX_DEPTH:
                raise _one(name, line, "nested too deeply", "look for brackets that are not closed")
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        elif isinstance(event, yaml.AliasEvent):
            raise _one(name, line, f"aliases (*{event.anchor}) are not read here", "write the value again")


def _one(name: str, line: int, message: str, fix: str) -> ConfigError:
    return ConfigError([Problem(Severity.ERROR, message, Location(name, line), fix)])
