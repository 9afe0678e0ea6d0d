"""A dialogue with a device as a script: a generator that yields what to do next and is sent what came of it.

The script knows neither clock nor line; the `Dialogue` carries it forward by the instants and replies that it is given.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass
from functools import partial
from typing import TypeAlias

from msdrivers.devices.gx1.link import Gx1Link, Reply
from msdrivers.protocol.gx1 import CommandByte, Packet
from msdrivers.station import Now, Output, Reopen, Send, StationStatus


@dataclass(frozen=True, slots=True)
class Ask:
    """Send a request and wait for its reply, `tries` times for `timeout` seconds each.

    NoReplyError is raised in the script after them. `value`: what the first word of the reply must be, None for any.
    """

    request: bytes
    timeout: float = 0.5
    tries: int = 3
    value: int | None = None

    @property
    def command(self) -> int:
        """The command whose reply is waited for."""
        return self.request[0]

    def met_by(self, packet: Packet) -> bool:
        """Return whether a reply is the one."""
        return packet.command == self.command and (self.value is None or packet.words[0] == self.value)


@dataclass(frozen=True, slots=True)
class Pause:
    """Let `seconds` pass; what is heard is skipped."""

    seconds: float


@dataclass(frozen=True, slots=True)
class Listen:
    """Gather for `seconds` the replies that come unasked, of some commands."""

    seconds: float
    commands: frozenset[int]


Step: TypeAlias = Ask | Pause | Listen | Send[bytes] | StationStatus | Reopen
Script: TypeAlias = Generator[Step, tuple[Packet, ...], None]


class NoReplyError(Exception):
    """A request was not answered."""

    def __init__(self, command: int, tries: int):
        self.command = command
        name = CommandByte(command).name.lower().replace("_", " ")
        super().__init__(f"the request '{name}' was sent {tries} times and not answered")


class Dialogue:
    """Carries a script forward. `running` until it ends."""

    def __init__(self, link: Gx1Link, script: Callable[[], Script]):
        """Take the line, and what begins the script from its start."""
        self._link = link
        self._begin = script
        self._script: Script | None = None
        self._step: Step | None = None
        self._deadline_ns = 0
        self._tries = 0
        self._gathered: list[Packet] = []

    @property
    def running(self) -> bool:
        """Whether the script has begun and not ended."""
        return self._script is not None

    @property
    def due(self) -> int | None:
        """When to call `woken`; None where the script waits for no instant."""
        return self._deadline_ns if isinstance(self._step, Ask | Pause | Listen) else None

    def opened(self, now: Now) -> list[Output[bytes]]:
        """Go on where the script asked for the line to be opened anew, else begin from its start."""
        if self._script is not None and isinstance(self._step, Reopen):
            return self._resume((), now)
        return self.start(now)

    def start(self, now: Now) -> list[Output[bytes]]:
        """Begin the script from its start."""
        self.stop()
        self._script = self._begin()
        return self._advance(partial(next, self._script), now)

    def stop(self) -> None:
        """End the script where it stands."""
        if self._script is not None:
            self._script.close()
        self._script = self._step = None

    def take(self, reply: Reply, now: Now) -> list[Output[bytes]]:
        """Take a reply."""
        step, packet = self._step, reply.packet
        if isinstance(step, Listen):
            self._gathered.append(packet)
        elif isinstance(step, Ask) and step.met_by(packet):
            if self._tries == 1:
                return self._resume((packet,), now)
            # the other tries may be answered yet, each as late as this one, and would pass for replies to what is
            # asked next
            self._wait(Pause(self._tries * step.timeout), now)
            self._gathered.append(packet)
        elif isinstance(step, Ask) and packet.command == step.command:
            self._link.parser.expect(packet.command)
        return []

    def woken(self, now: Now) -> list[Output[bytes]]:
        """Let time pass."""
        due = self.due
        if due is None or now.monotonic_ns < due:
            return []
        step = self._step
        if not isinstance(step, Ask):
            return self._resume(tuple(self._gathered), now)
        if self._tries < step.tries:
            return [self._asked(step, now)]
        assert self._script is not None
        return self._advance(partial(self._script.throw, NoReplyError(step.command, step.tries)), now)

    def _resume(self, came: tuple[Packet, ...], now: Now) -> list[Output[bytes]]:
        assert self._script is not None
        return self._advance(partial(self._script.send, came), now)

    def _advance(self, resume: Callable[[], Step], now: Now) -> list[Output[bytes]]:
        """Go on to the next step that has to wait; return what is to be done until there."""
        self._link.now = now
        self._step = None
        outputs: list[Output[bytes]] = []
        while True:
            try:
                step = resume()
            except StopIteration:
                self._script = None
                return outputs
            if isinstance(step, Send | StationStatus | Reopen):
                outputs.append(step)
            if isinstance(step, Send | StationStatus):
                assert self._script is not None
                resume = partial(self._script.send, ())
                continue
            self._step = step
            if isinstance(step, Ask):
                self._tries = 0
                outputs.append(self._asked(step, now))
            elif isinstance(step, Pause | Listen):
                self._wait(step, now)
            return outputs

    def _wait(self, step: Pause | Listen, now: Now) -> None:
        self._step = step
        self._deadline_ns = now.monotonic_ns + round(step.seconds * 1e9)
        self._gathered.clear()
        self._link.parser.clear()
        if isinstance(step, Listen):
            self._link.parser.stream(*step.commands)

    def _asked(self, step: Ask, now: Now) -> Send[bytes]:
        self._tries += 1
        self._deadline_ns = now.monotonic_ns + round(step.timeout * 1e9)
        self._link.parser.give_up(step.command)
        self._link.parser.expect(step.command)
        return Send(step.request)
