"""A driver's section of the vehicle file against the dataclasses of its settings: every mistake in it at once."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping
from typing import Any, TypeAlias, get_args, get_type_hints

from pydantic import ValidationError

from modelserver.config_reader import adapter_of
from modelserver.errors import ConfigError, Location, Problem, Severity, Suggested, shown, suggest_key, suggestions
from msdrivers.line_settings import LineSettings, first_key
from msdrivers.registry import DeviceKind
from msdrivers.settings_words import Words, of_value

Path: TypeAlias = tuple[str | int, ...]
"""Where in a section a value stands."""


def keys_of(*kinds: type) -> list[str]:
    """Return the names of the fields of dataclasses."""
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
    return keys_of(kind) if dataclasses.is_dataclass(kind) and isinstance(kind, type) else []


class SectionReader:
    """Reads one section, and keeps what is wrong with it."""

    def __init__(self, name: str, section: Mapping[str, Any], source: Callable[..., Location]):
        """Take the driver's name, its section, and what tells the place of a path in the vehicle file."""
        self.name, self.section, self._source = name, section, source
        self.problems: list[Problem] = []
        self._has_line = True

    def kind(self, kinds: Mapping[str, DeviceKind]) -> DeviceKind:
        """Return the kind of device that the section names. Raises ConfigError."""
        given = self.section.get("device")
        known = f"kinds: {', '.join(kinds)}"
        if given is None:
            words = Words("device is missing", f"add a line: device: ... ({known})")
            raise ConfigError([self._problem(words, "device")])
        if not isinstance(given, str) or given not in kinds:
            near = suggestions(str(given), kinds)
            fix = f"write {near[0]}" if near else known
            raise ConfigError([self._problem(Words(f"unknown device {shown(str(given))}", fix, near), "device")])
        return kinds[given]

    def line(self, kind: DeviceKind, more: list[str]) -> type[LineSettings]:
        """Return which of its lines the section names: the one whose first key stands there.

        `more`: the keys beside those of the line.
        """
        firsts = {first_key(each): each for each in kind.lines}
        if not any(key in self.section for key in firsts):
            known = [*keys_of(*kind.lines), *more]
            for key in [each for each in self.section if each not in known]:
                if not firsts.keys().isdisjoint(self._meant(key, known)):
                    self._refuse_misspelled(key, known)
        given = [key for key in firsts if key in self.section]
        if len(given) == 1:
            return firsts[given[0]]
        wanted = " or ".join(firsts)
        if given:
            self.refuse(given[-1], Words(f"both {' and '.join(given)} are given", f"keep one of {wanted}"))
        elif not any(key in self.section for key in _other_lines(kind)):
            fix = f"add a line: {next(iter(firsts))}: ..."
            self.problems.append(self._problem(Words(f"no line is named: {wanted} is missing", fix)))
        self._has_line = False
        return next(iter(firsts.values()))

    def refuse_unknown(self, kind: DeviceKind, line: type[LineSettings], more: list[str]) -> None:
        """Tell the keys that a driver of this kind on this line does not have."""
        known = [*keys_of(*((line,) if self._has_line else kind.lines)), *more]
        firsts = [first_key(each) for each in kind.lines]
        on = f"device {kind.name} is on {' or '.join(firsts)}"
        others = _other_lines(kind)
        for key in [each for each in self.section if each not in known]:
            if key in others:
                what = f"{on}, not on {others[key]}"
                fix = "take it out" if self._has_line else f"write {firsts[0]}: ... in its place"
                self.refuse(key, Words(what, fix))
            elif key in keys_of(*get_args(LineSettings)):
                owner = next(first_key(each) for each in get_args(LineSettings) if key in keys_of(each))
                there = f"and {on}" if owner not in firsts else f"and the line here is {first_key(line)}"
                self.refuse(key, Words(f"{key} goes with {owner}, {there}", "take it out"))
            else:
                self._refuse_misspelled(key, known)

    def _meant(self, key: str, known: list[str]) -> Suggested:
        """Return the key that one of the section misspells; one that is given already is not what was meant."""
        return suggest_key(key, [each for each in known if each not in self.section])

    def _refuse_misspelled(self, key: str, known: list[str]) -> None:
        """Report an unknown key; its value is that of the key that is meant, which is not missing then."""
        near = self._meant(key, known)
        fix = f"write {near[0]}" if near else f"known here: {', '.join(dict.fromkeys(known))}"
        self.refuse(key, Words(f"unknown key {shown(key)}", fix, near))
        if near:
            self.section = {near[0] if name == key else name: value for name, value in self.section.items()}

    def refuse(self, key: str, words: Words) -> None:
        """Tell what is wrong with a key of the section."""
        self.problems.append(self._problem(words, key))

    def values(self, kind: type, given: Mapping[str, Any] | None = None) -> Any:
        """Return the instance of `kind` that the section makes, None where something is wrong with it.

        What is `given` goes before the section; what `kind` does not have is left out. A section's own rules are looked
        at once all in it can be read, and end at the first: so what is wrong is left out, and the rest read again.
        """
        merged = json.loads(json.dumps({**self.section, **(given or {})}, default=str))
        values = {key: value for key, value in merged.items() if key in keys_of(kind)}
        gone: set[Path] = set()
        while True:
            try:
                # by way of JSON: strict there means that "4" is no number, while a list still makes a tuple
                found: Any = adapter_of(kind).validate_json(json.dumps(values), strict=True)
                return None if gone else found
            except ValidationError as error:
                wrong = [self._explained(kind, detail) for detail in error.errors()]
            # a key that is misspelled is not missing
            meant = {each for path, words in wrong for each in _meant_paths(path, words)}
            for path, words in wrong:
                # what misses a part that was left out is no mistake
                if words is not None and path not in meant and not any(each[: len(path)] == path for each in gone):
                    self.problems.append(self._problem(words, *path))
            # each goes, also where one before it could not
            dropped = [_drop(values, path, gone) for path, _ in wrong]
            if not all(dropped):
                return None

    def _explained(self, kind: type, detail: Any) -> tuple[Path, Words | None]:
        """Return what is wrong where with a value; None for what has been told otherwise."""
        path = tuple(detail["loc"])
        last = str(path[-1]) if path else ""
        if detail["type"] == "missing":
            words = Words(f"{last} is missing", f"add a line: {last}: ...")
            return path, words if self._has_line or last not in keys_of(*get_args(LineSettings)) else None
        if detail["type"] in ("unexpected_keyword_argument", "extra_forbidden"):
            known = _known_keys(kind, path[:-1])
            around = _inside(self.section, path[:-1])
            given = around if isinstance(around, dict) else {}
            near = suggest_key(last, [each for each in known if each not in given])
            return path, Words(
                f"unknown key {shown(last)}", f"write {near[0]}" if near else f"known here: {', '.join(known)}", near
            )
        if detail["type"] != "value_error":
            return path, of_value(detail, _known_keys(kind, path))
        # found by the section as a whole; the message begins with the key that it is about
        message = str(detail["msg"]).removeprefix("Value error, ")
        key = message.partition(" ")[0].rstrip(":")
        path = (*path, key) if key in _known_keys(kind, path) else path
        return path, Words(message[:1].lower() + message[1:])

    def _problem(self, words: Words, *path: str | int) -> Problem:
        source = self._source("drivers", self.name, *path)
        return Problem(Severity.ERROR, words.message, source, words.fix, words.nearest)


def _other_lines(kind: DeviceKind) -> dict[str, str]:
    """Return the first keys of the lines that a kind is not on, and what they are lines to."""
    own = {first_key(each) for each in kind.lines}
    every = {first_key(each): each.about for each in get_args(LineSettings)}
    return {key: about for key, about in every.items() if key not in own}


def _meant_paths(path: Path, words: Words | None) -> tuple[Path, ...]:
    """Return the path of the key that is meant by one that is misspelled; none where that is not what is wrong."""
    if words is None or not isinstance(words.nearest, Suggested) or path[-1:] != (words.nearest.replaced,):
        return ()
    return tuple((*path[:-1], each) for each in words.nearest)


def _inside(values: Any, path: Path) -> Any:
    for step in path:
        values = values.get(step) if isinstance(values, dict) else None
    return values


def _drop(values: Any, path: Path, gone: set[Path]) -> bool:
    """Leave out what stands at a path, or around it where nothing stands there; return whether there was anything.

    Of a list all goes.
    """
    path = path[: next((n for n, step in enumerate(path) if isinstance(step, int)), len(path))]
    while path:
        around = _inside(values, path[:-1])
        if isinstance(around, dict) and path[-1] in around:
            del around[path[-1]]
            gone.add(path)
            return True
        gone.add(path)
        path = path[:-1]
    return False
