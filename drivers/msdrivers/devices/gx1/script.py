"""Scripted dialogues with a 3DM-GX1, and the host's receiver.

A script is a generator that yields steps (request, pause, collect, send, status, reopen) and is sent the replies. It
knows neither clock nor line: `ScriptRunner` advances it by the times and replies that it gets. A request is repeated
after its timeout; after a retry the runner waits for the other replies, so that none passes for the next reply.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Generator
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, TypeAlias

from msdrivers.endpoint import EndpointStatus, HostTime, Output, Reopen, Send
from msdrivers.protocol.gx1 import LAYOUTS, MEASUREMENTS, CommandByte, Gx1Packet, Gx1Parser, TickUnwrapper
from msdrivers.protocol.gx1.scaling import QUARTER_TURN, is_unit

QUOTED_BYTES = 32
"""Number of received bytes that are quoted."""


class Gx1Reply(NamedTuple):
    """A valid reply and its unwrapped ticks; -1 without ticks."""

    packet: Gx1Packet
    ticks: int


class Gx1Receiver:
    """Parses bytes to valid replies: expected, with right checksum, plausible ticks and content."""

    def __init__(self) -> None:
        self.parser = Gx1Parser(self._validate)
        self.ticks = TickUnwrapper()
        self.now = HostTime(0, 0)
        self.messages: Counter[str] = Counter()
        self._tick_counts: list[int] = []
        self._newest: dict[int, int] = {}
        self._streamed = 0
        self._first_bytes = b""
        self.bytes_received = 0
        """Number of bytes received since `reset_input`."""

    def feed(self, data: bytes, now: HostTime) -> list[Gx1Reply]:
        """Return the replies that `data` completes."""
        self.now = now
        self.bytes_received += len(data)
        if len(self._first_bytes) < QUOTED_BYTES:
            self._first_bytes = (self._first_bytes + data)[:QUOTED_BYTES]
        packets = self.parser.feed(data)
        replies = [Gx1Reply(packet, count) for packet, count in zip(packets, self._tick_counts, strict=True)]
        self._tick_counts.clear()
        for packet in packets:
            self.messages[f"message.{CommandByte(packet.command).name.lower()}"] += 1
        return replies

    def set_streamed(self, command: int) -> None:
        """Set the streamed measurement; 0 for none."""
        self._streamed = command
        self.parser.set_streamed(*((command,) if command else ()))

    def reset(self) -> None:
        """Forget expected replies and ticks."""
        self.set_streamed(0)
        self.parser.clear()
        self.ticks.reset()
        self._newest.clear()
        self.reset_input()

    def reset_input(self) -> None:
        """Start to record the input."""
        self._first_bytes, self.bytes_received = b"", 0

    def describe_input(self) -> str:
        """Describe the input since `reset_input`."""
        if not self.bytes_received:
            return "nothing"
        shown = self._first_bytes
        if sum(32 <= byte < 127 or byte in b"\r\n" for byte in shown) > 0.9 * len(shown):
            return f"{self.bytes_received} bytes of text, beginning {shown.decode('ascii', 'replace')!r}"
        return f"{self.bytes_received} bytes, beginning {shown.hex(' ')}"

    @property
    def rejected(self) -> Counter[str]:
        """Number of rejected replies by reason."""
        return Counter(
            {key.removeprefix("rejected."): count for key, count in self.parser.counts.items() if "." in key}
        )

    def _validate(self, packet: Gx1Packet) -> str:
        if not _is_plausible(packet):
            return "content"
        if packet.ticks is None:
            self._tick_counts.append(-1)
            return ""
        command = packet.command
        count = self.ticks.unwrap(packet.ticks, self.now.monotonic_ns, command == self._streamed)
        if count is None:
            return "ticks"
        if command in MEASUREMENTS:
            if count <= self._newest.get(command, -1):
                return "repeated"
            self._newest[command] = count
        self._tick_counts.append(count)
        return ""


def _is_plausible(packet: Gx1Packet) -> bool:
    """Return whether the content is possible: pitch within 90 degrees, a unit quaternion, a known command."""
    if packet.has("euler"):
        return abs(packet.field("euler")[1]) <= QUARTER_TURN
    if packet.has("quaternion"):
        return is_unit(packet.field("quaternion"))
    if packet.command == CommandByte.CONTINUOUS:
        # a command byte behind a zero
        return packet.words[0] == 0 or packet.words[0] in LAYOUTS
    return True


@dataclass(frozen=True, slots=True)
class RequestStep:
    """Send a request and wait for its reply, `attempts` times for `timeout` seconds; then raise NoReplyError.

    value: expected first word of the reply, None for any.
    """

    request: bytes
    timeout: float = 0.5
    attempts: int = 3
    value: int | None = None

    @property
    def command(self) -> int:
        """The command whose reply is expected."""
        return self.request[0]

    def is_answered_by(self, packet: Gx1Packet) -> bool:
        """Return whether a reply answers the request."""
        return packet.command == self.command and (self.value is None or packet.words[0] == self.value)


@dataclass(frozen=True, slots=True)
class PauseStep:
    """Wait; discard the input."""

    seconds: float


@dataclass(frozen=True, slots=True)
class CollectStep:
    """Collect for `seconds` the unrequested replies to some commands."""

    seconds: float
    commands: frozenset[int]


Step: TypeAlias = RequestStep | PauseStep | CollectStep | Send[bytes] | EndpointStatus | Reopen
Script: TypeAlias = Generator[Step, tuple[Gx1Packet, ...], None]


class NoReplyError(Exception):
    """A request was not answered."""

    def __init__(self, command: int, tries: int):
        self.command = command
        name = CommandByte(command).name.lower().replace("_", " ")
        super().__init__(f"the request '{name}' was sent {tries} times and not answered")


class ScriptRunner:
    """Executes a script step by step."""

    def __init__(self, link: Gx1Receiver, script: Callable[[], Script]):
        """`script` makes the script's generator."""
        self._link = link
        self._make_script = script
        self._script: Script | None = None
        self._step: Step | None = None
        self._deadline_ns = 0
        self._attempt = 0
        self._collected: list[Gx1Packet] = []

    @property
    def is_running(self) -> bool:
        """Whether a script is active."""
        return self._script is not None

    @property
    def deadline_ns(self) -> int | None:
        """When to call `on_timer`; None if no step waits for time."""
        return self._deadline_ns if isinstance(self._step, RequestStep | PauseStep | CollectStep) else None

    def on_open(self, now: HostTime) -> list[Output[bytes]]:
        """Continue a script that requested the reopening, else start it."""
        if self._script is not None and isinstance(self._step, Reopen):
            return self._resume((), now)
        return self.start(now)

    def start(self, now: HostTime) -> list[Output[bytes]]:
        """Start the script from its beginning."""
        self.stop()
        self._script = self._make_script()
        return self._advance(partial(next, self._script), now)

    def stop(self) -> None:
        """Abort the script."""
        if self._script is not None:
            self._script.close()
        self._script = self._step = None

    def on_reply(self, reply: Gx1Reply, now: HostTime) -> list[Output[bytes]]:
        """Process a reply."""
        step, packet = self._step, reply.packet
        if isinstance(step, CollectStep):
            self._collected.append(packet)
        elif isinstance(step, RequestStep) and step.is_answered_by(packet):
            if self._attempt == 1:
                return self._resume((packet,), now)
            # the other tries may be answered yet, each as late as this one, and would pass for replies to what is
            # asked next
            self._wait(PauseStep(self._attempt * step.timeout), now)
            self._collected.append(packet)
        elif isinstance(step, RequestStep) and packet.command == step.command:
            self._link.parser.expect(packet.command)
        return []

    def on_timer(self, now: HostTime) -> list[Output[bytes]]:
        """Process a timeout."""
        due = self.deadline_ns
        if due is None or now.monotonic_ns < due:
            return []
        step = self._step
        if not isinstance(step, RequestStep):
            return self._resume(tuple(self._collected), now)
        if self._attempt < step.attempts:
            return [self._send_request(step, now)]
        assert self._script is not None
        return self._advance(partial(self._script.throw, NoReplyError(step.command, step.attempts)), now)

    def _resume(self, packets: tuple[Gx1Packet, ...], now: HostTime) -> list[Output[bytes]]:
        assert self._script is not None
        return self._advance(partial(self._script.send, packets), now)

    def _advance(self, resume: Callable[[], Step], now: HostTime) -> list[Output[bytes]]:
        """Continue to the next step that waits; return the outputs until there."""
        self._link.now = now
        self._step = None
        outputs: list[Output[bytes]] = []
        while True:
            try:
                step = resume()
            except StopIteration:
                self._script = None
                return outputs
            if isinstance(step, Send | EndpointStatus | Reopen):
                outputs.append(step)
            if isinstance(step, Send | EndpointStatus):
                assert self._script is not None
                resume = partial(self._script.send, ())
                continue
            self._step = step
            if isinstance(step, RequestStep):
                self._attempt = 0
                outputs.append(self._send_request(step, now))
            elif isinstance(step, PauseStep | CollectStep):
                self._wait(step, now)
            return outputs

    def _wait(self, step: PauseStep | CollectStep, now: HostTime) -> None:
        self._step = step
        self._deadline_ns = now.monotonic_ns + round(step.seconds * 1e9)
        self._collected.clear()
        self._link.parser.clear()
        if isinstance(step, CollectStep):
            self._link.parser.set_streamed(*step.commands)

    def _send_request(self, step: RequestStep, now: HostTime) -> Send[bytes]:
        self._attempt += 1
        self._deadline_ns = now.monotonic_ns + round(step.timeout * 1e9)
        self._link.parser.cancel(step.command)
        self._link.parser.expect(step.command)
        return Send(step.request)
