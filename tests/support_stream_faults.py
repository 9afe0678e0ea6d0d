"""Faults between sensor and server: pure transforms of a stream of samples in order of arrival.

Each takes samples and yields samples, so that they nest: `duplicate(delay(run.events(60.0), 3, "gps", 0.5), 4, 0.1)`.
`source` selects the samples by the source of their header; None selects all. The same seed gives the same faults.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import TypeVar

from modelserver.messages import RelativePoseSample, SensorHeader
from modelserver.simulation import Event
from modelserver.simulation.sensors import NoiseSource

_E = TypeVar("_E", bound=Event)


def delay(
    events: Iterable[Event],
    seed: int,
    source: str | None,
    max_delay: float,
    share: float = 1.0,
    *,
    min_delay: float = 0.0,
) -> Iterator[Event]:
    """Yield the samples, a random `share` of them delayed by `min_delay` to `max_delay` seconds, uniformly distributed.

    Their host_utime moves, their utime stays, and the stream stays in order of arrival: samples may overtake others.
    """
    if not 0.0 <= min_delay <= max_delay < math.inf:
        raise ValueError(f"delays must be finite and not negative; got {min_delay} to {max_delay} s")
    chance = NoiseSource(seed, f"late/{source}").generator
    waiting: list[tuple[int, int, Event]] = []
    for number, event in enumerate(events):
        arrival = event.header.host_utime
        # no later event can arrive before this one
        yield from _release(waiting, arrival)
        at = arrival
        if _is_from(event, source) and chance.random() < share:
            at += round(chance.uniform(min_delay, max_delay) * 1e6)
        heapq.heappush(waiting, (at, number, event if at == arrival else _replace_header(event, host_utime=at)))
    yield from _release(waiting, math.inf)


def duplicate(
    events: Iterable[Event], seed: int, share: float, source: str | None = None, max_delay: float = 0.0
) -> Iterator[Event]:
    """Yield a random `share` of the samples twice, the second one up to `max_delay` seconds later."""
    chance = NoiseSource(seed, f"duplicate/{source}").generator
    waiting: list[tuple[int, int, Event]] = []
    for number, event in enumerate(events):
        arrival = event.header.host_utime
        yield from _release(waiting, arrival)
        yield event
        if _is_from(event, source) and chance.random() < share:
            at = arrival + round(chance.uniform(0.0, max_delay) * 1e6)
            heapq.heappush(waiting, (at, number, _replace_header(event, host_utime=at)))
    yield from _release(waiting, math.inf)


def step_clock_back(
    events: Iterable[Event], from_utime: int, seconds: float, source: str | None = None
) -> Iterator[Event]:
    """Yield the samples with the time stepping back by `seconds` at `from_utime` (forward where negative).

    Without `source` the host's clock steps: utime and host_utime of all that arrives from then on; samples measured
    before keep their utime. With `source` only that source's stamps (utime) step. The order stays that of arrival.
    """
    back = round(seconds * 1e6)

    def step_utime(utime: int) -> int:
        return utime - back if utime >= from_utime else utime

    for event in events:
        if not _is_from(event, source):
            yield event
            continue
        header = event.header
        host = step_utime(header.host_utime) if source is None else header.host_utime
        changed: Event = _replace_header(event, utime=step_utime(header.utime), host_utime=host)
        if isinstance(changed, RelativePoseSample):
            changed = replace(changed, since_utime=step_utime(changed.since_utime))
        yield changed


def _release(waiting: list[tuple[int, int, Event]], until: float) -> Iterator[Event]:
    """Yield what has arrived until an instant, and remove it from the heap."""
    while waiting and waiting[0][0] <= until:
        yield heapq.heappop(waiting)[2]


def _is_from(event: Event, source: str | None) -> bool:
    return source is None or event.header.source == source


def _replace_header(event: _E, **changes: int) -> _E:
    """Return the sample with other fields in its header."""
    header: SensorHeader = replace(event.header, **changes)  # type: ignore[arg-type]
    return replace(event, header=header)
