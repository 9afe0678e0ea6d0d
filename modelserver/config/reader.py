"""Read a YAML file into a dataclass: strict types, every problem at once, each with its line and a suggestion.

The nodes of the YAML tree (bounded in size and depth, without aliases) are turned into plain values whose
lines are recorded, and validated by pydantic with the dataclass as the schema: its attributes are the keys.

pydantic examines the rules of a section (its `__post_init__`) only when every value in it has the right type. So the
validation is repeated without the keys that were found wrong, until nothing new is found (`read_partly`). The value
under a misspelled key moves to the key that is meant: it is examined, and not reported as missing.
"""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Mapping
from functools import cache
from typing import Any, TypeVar, get_args, get_type_hints

import yaml
from pydantic import TypeAdapter, ValidationError

from modelserver import errors
from modelserver.yaml_tree import NodeKind, YamlNode, parse_yaml

MAX_BYTES = 1 << 20

MAX_ROUNDS = 8
"""Validations of one file at most, each without what the ones before found wrong."""

S = TypeVar("S")
Path_ = tuple[str | int, ...]
"""Keys and list indices from the top of the file down to a value."""


def read_partly(
    raw: bytes, name: str, schema: type[S], blanks: Mapping[str, str] | None = None
) -> tuple[S | None, tuple[errors.Problem, ...]]:
    """Return the instance of a dataclass, None where too little is valid, and every problem in the order of the file.

    `blanks` are values for required top-level keys that are missing or wrong, so that the rest can be examined. Raises
    ConfigError for a file that is not a YAML mapping.
    """
    reader, values = _compose(raw, name, schema)
    if any(at[-1:] == ("?",) for at in reader.lines):
        return None, tuple(reader.problems)  # with keys that are no names the rest is not what was meant
    found: S | None = reader.validate(values, blanks or {})
    return found, tuple(sorted(reader.problems, key=lambda each: each.line))


@cache
def get_adapter(schema: type) -> TypeAdapter[Any]:
    """Return pydantic's validator of a dataclass, cached: building one takes a hundred times as long as using it."""
    return TypeAdapter(schema)


def _remove(values: Any, at: Path_, dropped: set[Path_]) -> bool:
    """Remove the value at a path, or the nearest section around it; return whether there was any."""
    steps = at[: next((n for n, step in enumerate(at) if isinstance(step, int)), len(at))]
    while steps:
        dropped.add(steps)
        inside = get_value(values, steps[:-1])
        if isinstance(inside, dict) and steps[-1] in inside:
            del inside[steps[-1]]
            return True
        steps = steps[:-1]
    return False


def get_value(values: Any, at: Path_) -> Any:
    for step in at:
        values = values.get(step) if isinstance(values, dict) else None
    return values


def read_lines(raw: bytes, name: str, schema: type) -> dict[Path_, int]:
    """Return the line of each key by its path. Raises ConfigError as `read_partly` does."""
    return _compose(raw, name, schema)[0].lines


def _compose(raw: bytes, name: str, schema: type) -> tuple[SettingsReader, Any]:
    """Return the plain values of a file, and the reader that has their lines."""
    if len(raw) > MAX_BYTES:
        raise make_error(name, 0, f"the file is larger than {MAX_BYTES >> 20} MiB", "is this the vehicle file?")
    try:
        node = parse_yaml(raw, has_aliases=False)
    except errors.SyntaxProblemError as error:
        raise make_error(name, error.line, str(error), error.fix) from None
    if node.kind is not NodeKind.MAPPING:
        missing = dataclasses.MISSING
        required = [
            each.name
            for each in dataclasses.fields(schema)
            if each.default is missing and each.default_factory is missing
        ]
        what = "the file is empty" if node.is_null else "the file is not a mapping (key: value, one per line)"
        raise make_error(name, 1, what, f"start with: {', '.join(required)}")
    reader = SettingsReader(name, schema)
    return reader, reader.read_value(node, ())


class SettingsReader:
    """Turns YAML nodes into plain values, records the line of each, validates them, and explains pydantic's errors."""

    def __init__(self, name: str, schema: type):
        self.name = name
        self.schema = schema
        self.lines: dict[Path_, int] = {}
        self.problems: list[errors.Problem] = []

    def validate(self, values: Any, blanks: Mapping[str, str]) -> Any:
        """Return the instance that the values make, None where too little is valid; record every problem."""
        dropped: set[Path_] = set()
        for _ in range(MAX_ROUNDS):
            try:
                # strict JSON: "4" is not a number, while a mapping still makes a section
                return get_adapter(self.schema).validate_json(json.dumps(values, default=str), strict=True)
            except ValidationError as error:
                explained = [each for detail in error.errors() for each in self.explain(detail)]
            renamed = [
                at for at, problem in explained if problem.replaced and self.rename(values, at, problem.nearest[0])
            ]
            meant = {(*at[:-1], problem.nearest[0]) for at, problem in explained if at in renamed}
            wrong = [(at, problem) for at, problem in explained if at not in meant]
            # what misses a value that was removed is no mistake
            self.problems += [problem for at, problem in wrong if not any(each[: len(at)] == at for each in dropped)]
            removed = [at in renamed or _remove(values, at, dropped) for at, _ in wrong]
            filled = [key for key, value in blanks.items() if values.setdefault(key, value) is value]
            if not filled and not (removed and all(removed)):
                break
        return None

    def read_value(self, node: YamlNode, at: Path_) -> Any:
        """Return the plain value of a node; record its lines and duplicate keys."""
        self.lines.setdefault(at, node.line)
        if node.kind is NodeKind.LIST:
            return [self.read_value(each, (*at, index)) for index, each in enumerate(node.items)]
        if node.kind is NodeKind.SCALAR:
            return _read_scalar(node) if node.is_plain else node.text
        values: dict[str, Any] = {}
        for key_node, value_node in node.pairs:
            line, key = key_node.line, key_node.text
            if key_node.kind is not NodeKind.SCALAR:
                self.lines[(*at, "?")] = line
                self.add_problem((*at, "?"), "a key is a name, not a list or a mapping", "write name: value")
                continue
            first = self.lines.get((*at, key), 0)
            self.lines[(*at, key)] = line
            if key in values:
                self.add_problem((*at, key), f"{key} is given twice (first on line {first})", "remove one")
                continue
            value = self.read_value(value_node, (*at, key))
            # a key without a value counts as absent, as when all of a section is commented out
            if value is not None:
                values[key] = value
        return values

    def add_problem(self, at: Path_, message: str, fix: str) -> None:
        self.problems.append(errors.Problem(errors.Severity.ERROR, message, self.locate(at), fix))

    def rename(self, values: Any, at: Path_, meant: str) -> bool:
        """Move the value under a misspelled key to the key that is meant; return whether there is such a key."""
        known, around = list_known_keys(self.schema, at[:-1]), get_value(values, at[:-1])
        if meant not in known or at[-1] in known or not isinstance(around, dict) or meant in around:
            return False
        around[meant] = around.pop(at[-1])
        below = {path: line for path, line in self.lines.items() if path[: len(at)] == at}
        self.lines.update({(*at[:-1], meant, *path[len(at) :]): line for path, line in below.items()})
        return True

    def locate(self, at: Path_) -> errors.Location:
        """Return the location of a path, or of the nearest section around it."""
        line = next((self.lines[at[:n]] for n in range(len(at), -1, -1) if at[:n] in self.lines), 0)
        return errors.Location(self.name, line, ".".join(map(str, at)))

    def explain(self, detail: Any) -> list[tuple[Path_, errors.Problem]]:
        """Turn one of pydantic's errors into problems, each with its path, line and suggestion."""
        at: Path_ = tuple(detail["loc"])
        kind = detail["type"]
        if kind == "value_error":
            return self._explain_section(at, str(detail["msg"]).removeprefix("Value error, "))
        near: tuple[str, ...] = ()
        fix = ""
        if kind in ("unexpected_keyword_argument", "extra_forbidden"):
            near, fix = self.suggest_keys(str(at[-1]), at[:-1])
            message = f"unknown key {errors.quote(str(at[-1]))}"
        elif kind == "missing" and isinstance(at[-1], int):
            at = at[:-1]
            message = f"{at[-1]} has too few numbers"
        elif kind == "missing":
            fix, message = f"add a line: {at[-1]}: ...", f"{at[-1]} is missing"
        else:
            near, fix, message = self.explain_value(detail)
        return [(at, errors.Problem(errors.Severity.ERROR, message, self.locate(at), fix, near))]

    def _explain_section(self, at: Path_, text: str) -> list[tuple[Path_, errors.Problem]]:
        """Return the problems that a section's own rules found, one per line; each begins with its key."""
        found = []
        for message in text.splitlines():
            key = message.partition(" ")[0].rstrip(":")
            there = (*at, key) if key in list_known_keys(self.schema, at) else at
            found.append((there, errors.Problem(errors.Severity.ERROR, _shorten(message), self.locate(there))))
        return found

    def suggest_keys(self, key: str, at: Path_) -> tuple[tuple[str, ...], str]:
        """Return the known keys nearest to an unknown one at a path, and the fix."""
        known = list_known_keys(self.schema, at)
        present = {each for each in known if (*at, each) in self.lines}
        below: dict[str, list[str]] = {}
        for section in known:
            for each in list_known_keys(self.schema, (*at, section)):
                below.setdefault(each, []).append(".".join(map(str, (*at, section))))
        # a key that is present already is not what was meant
        near = (
            errors.Suggestion()
            if key in below
            else errors.suggest_key(key, [each for each in known if each not in present])
        )
        if near:
            return near, f"write {near[0]}"
        deeper = (key,) if key in below else tuple(errors.suggest_key(key, below))
        if deeper:
            return deeper, f"write {deeper[0]} under {' or '.join(below[deeper[0]])}"
        return (), f"known here: {', '.join(known)}"

    def explain_value(self, detail: Any) -> tuple[tuple[str, ...], str, str]:
        """Return suggestion, fix and message for a single wrong value."""
        near: tuple[str, ...] = ()
        message, got = str(detail["msg"]), detail.get("input")
        if detail["type"] in ("dataclass_type", "dict_type"):
            message = "expected a mapping (key: value, one per line)"
        if isinstance(got, (str, int, float, bool)):
            message += f", got {errors.quote(str(got))}"
        if detail["type"] == "literal_error" and isinstance(got, str):
            near = errors.suggest_name(got, re.findall(r"'([^']*)'", str(detail["ctx"]["expected"])))
        return near, f"write {near[0]}" if near else "", _shorten(message)


def _shorten(message: str) -> str:
    if len(message) > 240:
        message = f"{message[:240]}..."
    return message[:1].lower() + message[1:]


_EXPONENT = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+", re.ASCII)
"""Numbers such as 1e-3, which are text in YAML 1.1."""


def _read_scalar(node: YamlNode) -> Any:
    """Return the value that YAML 1.1 gives a text without quotes: a number, a truth value, null, or the text."""
    if _EXPONENT.fullmatch(node.text):
        return float(node.text)
    loader = yaml.CSafeLoader("")
    tag = loader.resolve(yaml.ScalarNode, node.text, (True, False))  # type: ignore[no-untyped-call]
    try:
        return loader.construct_object(yaml.ScalarNode(tag, node.text), deep=True)
    except (yaml.YAMLError, ValueError):
        return node.text


def list_known_keys(schema: Any, at: Path_) -> list[str]:
    """Return the keys known at a path below a schema: in a section, in a mapping or a list of sections."""
    kind = schema
    for step in at:
        if isinstance(kind, type) and dataclasses.is_dataclass(kind):
            kind = _get_type_hints(kind).get(str(step))
        else:
            kind = next((each for each in reversed(get_args(kind)) if each is not Ellipsis), None)
        if type(None) in get_args(kind):
            kind = next(each for each in get_args(kind) if each is not type(None))
    return [each.name for each in dataclasses.fields(kind)] if dataclasses.is_dataclass(kind) else []


_get_type_hints = cache(get_type_hints)


def make_error(name: str, line: int, message: str, fix: str) -> errors.ConfigError:
    """Return the error of a file that cannot be read; line 0 for the whole file."""
    return errors.ConfigError([errors.Problem(errors.Severity.ERROR, message, errors.Location(name, line), fix)])
