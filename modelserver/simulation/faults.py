"""What goes wrong between a sensor and the server: pure transforms of a stream of samples in order of arrival.

Each takes samples and yields samples, so that they nest: `drop(late(run.events(60.0), 3, "gps", 0.5), 4, 0.1)`.
`source` picks the samples whose header names it; None picks all. The same seed gives the same faults.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterable, Iterator
from dataclasses import fields, replace
from typing import Any, TypeVar

from modelserver.messages import RelativePoseSample, SensorHeader
from modelserver.simulation.noise import NoiseSource
from modelserver.simulation.scenario import Event

_E = TypeVar("_E", bound=Event)


def drop(events: Iterable[Event], seed: int, share: float, source: str | None = None) -> Iterator[Event]:
    """Yield the samples without a random `share` of them."""
    chance = NoiseSource(seed, f"drop/{source}")
    for event in events:
        if not (_is(event, source) and chance.chance(share)):
            yield event


def cut(events: Iterable[Event], begin_utime: int, end_utime: int, source: str | None = None) -> Iterator[Event]:
    """Yield the samples without those that arrive from `begin_utime` to before `end_utime`."""
    for event in events:
        if not (_is(event, source) and begin_utime <= event.header.host_utime < end_utime):
            yield event


def late(
    events: Iterable[Event],
    seed: int,
    source: str | None,
    most: float,
    share: float = 1.0,
    *,
    least: float = 0.0,
    in_order: bool = False,
) -> Iterator[Event]:
    """Yield a random `share` of the samples later by `least` to `most` seconds, evenly spread.

    Their host_utime moves, their utime stays, and the stream is in order of arrival again. With `in_order` the
    source's own samples stay behind each other, else they overtake each other.
    """
    if not 0.0 <= least <= most < math.inf:
        raise ValueError(f"a delay is finite and not negative, got {least} to {most} s")
    chance = NoiseSource(seed, f"late/{source}")
    waiting: list[tuple[int, int, Event]] = []
    last: dict[str, int] = {}
    for number, event in enumerate(events):
        arrival = event.header.host_utime
        # nothing that is still to come arrives before this one did
        while waiting and waiting[0][0] <= arrival:
            yield heapq.heappop(waiting)[2]
        at = arrival
        if _is(event, source):
            if chance.chance(share):
                at += round(chance.uniform(least, most) * 1e6)
            if in_order:
                at = last[event.header.source] = max(at, last.get(event.header.source, at))
        heapq.heappush(waiting, (at, number, event if at == arrival else _with(event, host_utime=at)))
    while waiting:
        yield heapq.heappop(waiting)[2]


def duplicate(
    events: Iterable[Event], seed: int, share: float, source: str | None = None, delay: float = 0.0
) -> Iterator[Event]:
    """Yield a random `share` of the samples twice, the second one up to `delay` seconds later."""
    chance = NoiseSource(seed, f"duplicate/{source}")
    waiting: list[tuple[int, int, Event]] = []
    for number, event in enumerate(events):
        arrival = event.header.host_utime
        while waiting and waiting[0][0] <= arrival:
            yield heapq.heappop(waiting)[2]
        yield event
        if _is(event, source) and chance.chance(share):
            at = arrival + round(chance.uniform(0.0, delay) * 1e6)
            heapq.heappush(waiting, (at, number, _with(event, host_utime=at)))
    while waiting:
        yield heapq.heappop(waiting)[2]


def not_a_number(events: Iterable[Event], seed: int, share: float, source: str | None = None) -> Iterator[Event]:
    """Yield the samples, one number in a random `share` of them nan: any of the sample's own, in vectors too."""
    chance = NoiseSource(seed, f"nan/{source}")
    for event in events:
        yield _holed(event, chance) if _is(event, source) and chance.chance(share) else event


def step_back(events: Iterable[Event], from_utime: int, seconds: float, source: str | None = None) -> Iterator[Event]:
    """Yield the samples with the time stepping back by `seconds` at `from_utime` (forward where negative).

    Without `source` the computer's clock steps: utime and host_utime of all that arrives from then on; what was
    measured before and arrives after keeps its utime. With `source` that source's stamps step alone: its utime.
    The order stays that of arrival.
    """
    back = round(seconds * 1e6)

    def stepped(utime: int) -> int:
        return utime - back if utime >= from_utime else utime

    for event in events:
        if not _is(event, source):
            yield event
            continue
        header = event.header
        host = stepped(header.host_utime) if source is None else header.host_utime
        moved: Event = _with(event, utime=stepped(header.utime), host_utime=host)
        if isinstance(moved, RelativePoseSample):
            moved = replace(moved, since_utime=stepped(moved.since_utime))
        yield moved


def _is(event: Event, source: str | None) -> bool:
    return source is None or event.header.source == source


def _with(event: _E, **changes: int) -> _E:
    """Return the sample with other fields in its header."""
    header: SensorHeader = replace(event.header, **changes)  # type: ignore[arg-type]
    return replace(event, header=header)


def _holed(event: Event, chance: NoiseSource) -> Event:
    numbers = [path for each in fields(event) if each.name != "header" for path in _numbers(event, each.name)]
    if not numbers:
        return event
    name, *inside = numbers[chance.index(len(numbers))]
    return replace(event, **{name: _put(getattr(event, name), tuple(inside))})


def _numbers(value: Any, *path: Any) -> Iterator[tuple[Any, ...]]:
    """Yield the paths, of names and places, to the floats in a field that are numbers."""
    found = value
    for step in path:
        found = getattr(found, step) if isinstance(step, str) else found[step]
    if isinstance(found, float):
        if not math.isnan(found):
            yield path
    elif isinstance(found, tuple):
        for place in range(len(found)):
            yield from _numbers(value, *path, place)
    elif hasattr(found, "__dataclass_fields__"):
        for each in fields(found):
            yield from _numbers(value, *path, each.name)


def _put(value: Any, path: tuple[Any, ...]) -> Any:
    """Return the value with nan at a path."""
    if not path:
        return math.nan
    step, *rest = path
    if isinstance(step, str):
        return replace(value, **{step: _put(getattr(value, step), tuple(rest))})
    return (*value[:step], _put(value[step], tuple(rest)), *value[step + 1 :])
