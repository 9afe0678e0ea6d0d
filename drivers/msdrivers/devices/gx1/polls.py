"""What is polled while a device streams: when it is due, and which replies are waited for."""

from __future__ import annotations

NEVER = 1 << 62
WAIT_NS = 500_000_000
"""How long a reply may take."""


class Polls:
    """Commands that are polled in periods. Instants are monotonic nanoseconds."""

    __slots__ = ("_next", "_periods", "_waiting")

    def __init__(self) -> None:
        self._periods: dict[int, int] = {}
        self._next: dict[int, int] = {}
        self._waiting: dict[int, int] = {}

    def add(self, command: int, period_s: float, now_ns: int) -> None:
        """Poll a command from now on."""
        self._periods[command] = round(period_s * 1e9)
        self._next[command] = now_ns

    def remove(self, command: int) -> None:
        """Poll it no more."""
        for table in (self._periods, self._next, self._waiting):
            table.pop(command, None)

    @property
    def due(self) -> int:
        """The next instant at which something is due or overdue."""
        return min((*self._next.values(), *self._waiting.values()), default=NEVER)

    def take_due(self, now_ns: int) -> list[int]:
        """Return the commands to be asked for now. One that still waits for its reply is not asked for again."""
        commands = [command for command, at in self._next.items() if at <= now_ns]
        asked = []
        for command in commands:
            self._next[command] = max(self._next[command] + self._periods[command], now_ns + 1)
            if command not in self._waiting:
                self._waiting[command] = now_ns + WAIT_NS
                asked.append(command)
        return asked

    def overdue(self, now_ns: int) -> list[int]:
        """Return the commands whose reply did not come in time; they wait no longer."""
        late = [command for command, until in self._waiting.items() if until <= now_ns]
        for command in late:
            del self._waiting[command]
        return late

    def answered(self, command: int) -> None:
        """Take note of a reply."""
        self._waiting.pop(command, None)
