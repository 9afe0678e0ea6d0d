"""What drives share is computed once in a process: their samples, and the state after samples that they begin with.

The localizer and the core are immutable values, so the state after the same samples may be used again. A drive that
differs from an earlier one from second 60 on, by its samples, starts at that second. Nothing is shared with a test that
patches the code under test, nor where MODELSERVER_SHARED_DRIVES is "off".
"""

from __future__ import annotations

import os
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable
from typing import Any, Protocol, Self, TypeVar

from msgspec.msgpack import encode

STRIDE = 200
"""Events between two stored states: 3 s of the filter's drives."""

NUM_VALUES = 600
"""Stored values, the least recently used are dropped: some 0.5 MB each."""

is_enabled = os.environ.get("MODELSERVER_SHARED_DRIVES") != "off"
_is_patched = False
_values: OrderedDict[Hashable, Any] = OrderedDict()

V = TypeVar("V")


class Progress(Protocol):
    """A computation over events: immutable values, and lists that `resume` copies."""

    def update(self, event: Any) -> None: ...

    def resume(self, at: Self) -> Self:
        """Return this computation with what another one has reached."""


P = TypeVar("P", bound=Progress)


def begin_test(fixtures: Iterable[str]) -> None:
    """Share nothing with a test that may patch the code."""
    global _is_patched
    _is_patched = "monkeypatch" in fixtures


def share(key: Hashable, compute: Callable[[], V]) -> V:
    """Return the value of a key, computed once; without a key that can be hashed it is computed."""
    if not is_enabled or _is_patched or not _is_hashable(key):
        return compute()
    if key not in _values:
        _store(key, compute())
    _values.move_to_end(key)
    found: V = _values[key]
    return found


def run_shared(key: Hashable, begin: P, events: Iterable[Any]) -> P:
    """Return the progress after all events; `key` is what it depends on beside them.

    As long as states after the events so far are stored, events are only read.
    """
    if not is_enabled or _is_patched or not _is_hashable(key):
        for event in events:
            begin.update(event)
        return begin
    count, chain, progress = 0, hash(key), begin
    waiting: list[Any] | None = []
    for event in events:
        count += 1
        # the bytes, since a value that is not a number differs from itself
        chain = hash((chain, type(event), encode(event)))
        if waiting is None:
            progress.update(event)
        else:
            waiting.append(event)
        if count % STRIDE:
            continue
        name = (key, count, chain)
        if waiting is not None and name in _values:
            progress = _values[name]
            _values.move_to_end(name)
            waiting.clear()
            continue
        progress, waiting = _catch_up(begin, progress, waiting), None
        _store(name, progress.resume(progress))
    name = (key, count, chain)
    if name not in _values:
        _store(name, _catch_up(begin, progress, waiting))
    return begin.resume(_values[name])


def _catch_up(begin: P, progress: P, waiting: list[Any] | None) -> P:
    """Return the progress after the events that were only read."""
    if waiting is None:
        return progress
    progress = begin.resume(progress)
    for event in waiting:
        progress.update(event)
    return progress


def _store(key: Hashable, value: object) -> None:
    _values[key] = value
    while len(_values) > NUM_VALUES:
        _values.popitem(last=False)


def _is_hashable(key: Hashable) -> bool:
    try:
        hash(key)
    except TypeError:
        return False
    return True


def freeze(value: object) -> Hashable:
    """Return arguments of a simulation as a key: mappings and sequences as tuples."""
    if isinstance(value, dict):
        return tuple((name, freeze(each)) for name, each in value.items())
    if isinstance(value, list | tuple) and not hasattr(value, "_fields"):
        return tuple(map(freeze, value))
    return value  # type: ignore[return-value]


class SameObject:
    """An object as a part of a key, by its identity: it stays alive with the key."""

    def __init__(self, value: object):
        self.value = value

    def __hash__(self) -> int:
        return id(self.value)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, SameObject) and self.value is other.value
