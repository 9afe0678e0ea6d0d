"""Second writers on the sensors' channels: told in the health report, logged once, and by configuration ignored."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from modelserver.core import Instant
from modelserver.core.writers import RIVAL_NS, Mark, Writer
from modelserver.errors import shown
from modelserver.messages import Event, Noticed
from modelserver.service.log import RateLimited

MAX_WRITERS: Final = 256
"""Sources that are watched on shared channels; a vehicle has a dozen, and strangers make up the rest."""

SECOND: Final = "second_writer"
"""The reason under which a second writer's samples are counted."""

AGO_S: Final = 5.0
"""A second writer whose stamps lie this far in the past plays a recording."""


class PublisherMonitor:
    """Watches the sensors' channels. `shared` names those where several sources speak: each is watched by itself.

    `step` hands the core an event, `count` has it count a sample that is used by channel and reason; whoever ignores
    one counts it. `rule`: see
    `modelserver.service.loop.LoopSettings.second_writer`.
    """

    def __init__(
        self,
        step: Callable[[Event, Instant], None],
        count: Callable[[str, str, Instant], None],
        log: RateLimited,
        rule: str,
        shared: frozenset[str],
    ):
        self._step = step
        self._count = count
        self._log = log
        self._watches, self._ignore = bool(rule), rule == "ignore"
        self._shared = shared
        self._writers: dict[tuple[str, str], Writer] = {}
        self._told: dict[str, Writer] = {}

    def writer(self, channel: str) -> Writer | None:
        """Return what watches a channel that has one writer; None for others: those go through `refuses`."""
        if not self._watches or channel in self._shared:
            return None
        return Writer()

    def refuses(self, channel: str, mark: Mark, now: Instant) -> bool:
        """Return whether a sample on a channel of several sources is a second writer's, and not to be used."""
        if not self._watches:
            return False
        key = (channel, mark.source)
        writer = self._writers.get(key)
        if writer is None:
            if len(self._writers) >= MAX_WRITERS:
                return False
            writer = self._writers[key] = Writer()
        return writer.is_second(mark, now.monotonic_ns) and self.told(channel, writer, mark, now)

    def told(self, channel: str, writer: Writer, mark: Mark, now: Instant) -> bool:
        """Take notice of a second writer's sample; return whether it is not to be used."""
        if not self._ignore:
            self._count(channel, SECOND, now)
        if channel not in self._told:
            self._told[channel] = writer
            text = self._text(channel, writer, (now.utime - mark.utime) * 1e-6)
            self._step(Noticed(f"channel {channel}", text), now)
            self._log.warning(f"{channel}:second_writer", "%s", text)
        return self._ignore

    def look(self, now: Instant) -> None:
        """Take back what was told of second writers that are gone."""
        for channel, writer in list(self._told.items()):
            if now.monotonic_ns - writer.rival_ns > RIVAL_NS:
                del self._told[channel]
                self._step(Noticed(f"channel {channel}"), now)

    def _text(self, channel: str, writer: Writer, age: float) -> str:
        named = f"{shown(writer.source, 40)} and {shown(writer.rival, 40)}"
        who = f"{named} speak" if writer.rival != writer.source else f"two of the name {shown(writer.rival, 40)} speak"
        done = "the second one is ignored" if self._ignore else "both are used (sensors.second_writer)"
        old = f"; its stamps are {age:,.0f} s old: a recording played onto the bus?" if age > AGO_S else ""
        return f"{who} on {channel} at once, and {done}{old}: end one of them"
