"""Two daemons on one bus: each hears the other's health report, and says so until the other is gone."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from modelserver.errors import WireError, shown
from modelserver.messages import Health
from modelserver.service.bus import Inbox
from modelserver.service.clock import Clock
from modelserver.wire.codec import decode

SUBJECT: Final = "servers"

GONE_AFTER_S: Final = 5.0
"""A rival that was not heard for so long is gone."""

READ_PER_S: Final = 40
"""Reports read in a second; one daemon sends ten at most. More are a flood, and not read."""

OLD_S: Final = 30.0
"""A report stamped so far from now is of a recording that is played."""


class Rivals:
    """Reads the health reports on the bus; `notice(subject, text)` is told of another daemon, and when it is gone.

    `host` and `pid` are this daemon's own, as in its reports.
    """

    def __init__(self, host: str, pid: int, notice: Callable[[str, str], None], clock: Clock):
        self._me = (host, pid)
        self._notice = notice
        self._clock = clock
        self._heard_ns = 0
        self._window_ns = 0
        self._read = 0
        self._said = ""

    def watch(self, inbox: Inbox, prefix: str) -> None:
        """Listen on the channel of this daemon's own reports."""
        inbox.subscribe(f"{prefix}MODELSERVER_HEALTH", self.heard)

    def heard(self, channel: str, data: bytes) -> None:
        """Take a report: our own, another daemon's, or a stranger's bytes."""
        now = self._clock.monotonic_ns()
        if now - self._window_ns >= 1_000_000_000:
            self._window_ns, self._read = now, 0
        self._read += 1
        if self._read > READ_PER_S:
            return
        try:
            health: Health = decode("health_t", data)
        except WireError:
            return  # it is not what this one listens for; nobody relies on it
        if (health.host, health.pid) != self._me:
            self._heard_ns = now
            self._say(_words(health, self._clock.utime()))
        elif self._said and now - self._heard_ns > GONE_AFTER_S * 1e9:
            self._say("")

    def _say(self, text: str) -> None:
        if text != self._said:
            self._said = text
            self._notice(SUBJECT, text)


def _words(health: Health, utime: int) -> str:
    who = f"modelserver process {health.pid} on {shown(health.host, 64)}, vehicle {shown(health.vehicle, 64)}"
    if abs(health.utime - utime) > OLD_S * 1e6:
        return (
            f"a recording of {who}, is being played on this bus: clients cannot tell its poses from ours. Stop the "
            "player, or have it leave out what the service says (modelserver replay)"
        )
    return (
        f"another daemon speaks on this bus: {who}. Clients get the answers of either, and POSE is of both. Stop one "
        f"(kill {health.pid} there), or give it a lcm.channel_prefix or a port of its own"
    )
