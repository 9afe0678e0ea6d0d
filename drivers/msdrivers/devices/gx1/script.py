"""Scripted dialogues with a 3DM-GX1, the host's receiver, and the scripts that find a device and read its gains.

A script is a generator that yields steps (request, pause, collect, send, status, reopen) and is sent the replies. It
knows neither clock nor line: `ScriptRunner` advances it by the times and replies that it gets. A request is repeated
after its timeout; after a retry the runner waits for the other replies, so that none passes for the next reply.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Generator, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, TypeAlias, TypeVar

from msdrivers.endpoint import EndpointPhase, EndpointStatus, HostTime, Output, Reopen, Send
from msdrivers.protocol import gx1
from msdrivers.protocol.gx1 import requests
from msdrivers.protocol.gx1.scaling import QUARTER_TURN, format_version, is_unit
from msdrivers.protocol.recognition import recognize

QUOTED_BYTES = 32
"""Number of received bytes that are quoted."""

EXAMINED_BYTES = 4096
"""Number of received bytes by which another device is recognized."""


class Gx1Reply(NamedTuple):
    """A valid reply and its unwrapped ticks; -1 without ticks."""

    packet: gx1.Gx1Packet
    ticks: int


class Gx1Receiver:
    """Parses bytes to valid replies: expected, with right checksum, plausible ticks and content."""

    def __init__(self) -> None:
        self.parser = gx1.Gx1Parser(self._validate)
        self.ticks = gx1.TickUnwrapper()
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
        if len(self._first_bytes) < EXAMINED_BYTES:
            self._first_bytes = (self._first_bytes + data)[:EXAMINED_BYTES]
        packets = self.parser.feed(data)
        replies = [Gx1Reply(packet, count) for packet, count in zip(packets, self._tick_counts, strict=True)]
        self._tick_counts.clear()
        for packet in packets:
            self.messages[f"message.{gx1.CommandByte(packet.command).name.lower()}"] += 1
        return replies

    def set_streamed(self, command: int) -> None:
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
        self._first_bytes, self.bytes_received = b"", 0

    def describe_input(self) -> str:
        """Describe the input since `reset_input`."""
        if not self.bytes_received:
            return "nothing"
        if (protocol := recognize(self._first_bytes)) is not None:
            return f"{protocol.name} (write device: {protocol.devices[0]})"
        shown = self._first_bytes[:QUOTED_BYTES]
        if sum(32 <= byte < 127 or byte in b"\r\n" for byte in shown) > 0.9 * len(shown):
            return f"{self.bytes_received} bytes of text, beginning {shown.decode('ascii', 'replace')!r}"
        return f"{self.bytes_received} bytes, beginning {shown.hex(' ')}"

    def _validate(self, packet: gx1.Gx1Packet) -> str:
        if not _is_plausible(packet):
            return "content"
        if packet.ticks is None:
            self._tick_counts.append(-1)
            return ""
        command = packet.command
        count = self.ticks.unwrap(packet.ticks, self.now.monotonic_ns, command == self._streamed)
        if count is None:
            return "ticks"
        if command in gx1.MEASUREMENTS:
            if count <= self._newest.get(command, -1):
                return "repeated"
            self._newest[command] = count
        self._tick_counts.append(count)
        return ""


def _is_plausible(packet: gx1.Gx1Packet) -> bool:
    """Return whether the content is possible: pitch within 90 degrees, a unit quaternion, a known command."""
    if packet.has("euler"):
        return abs(packet.field("euler")[1]) <= QUARTER_TURN
    if packet.has("quaternion"):
        return is_unit(packet.field("quaternion"))
    if packet.command == gx1.CommandByte.CONTINUOUS:
        # a command byte behind a zero
        return packet.words[0] == 0 or packet.words[0] in gx1.LAYOUTS
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
        return self.request[0]

    def is_answered_by(self, packet: gx1.Gx1Packet) -> bool:
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
T = TypeVar("T")
ScriptPart: TypeAlias = Generator[Step, tuple[gx1.Gx1Packet, ...], T]
"""A part of a script that finds a value."""
Script: TypeAlias = ScriptPart[None]


class NoReplyError(Exception):
    """A request was not answered."""

    def __init__(self, command: int, tries: int):
        self.command = command
        name = gx1.CommandByte(command).name.lower().replace("_", " ")
        super().__init__(f"the request '{name}' was sent {tries} times and not answered")


def report(text: str) -> EndpointStatus:
    return EndpointStatus(EndpointPhase.CONFIGURING, text)


class ScriptRunner:
    """Executes a script step by step."""

    def __init__(self, link: Gx1Receiver, script: Callable[[], Script]):
        """`script` makes the script's generator."""
        self._link, self._make_script = link, script
        self._script: Script | None = None
        self._step: Step | None = None
        self._deadline_ns = 0
        self._attempt = 0
        self._collected: list[gx1.Gx1Packet] = []

    @property
    def is_running(self) -> bool:
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
        self.stop()
        self._script = self._make_script()
        return self._advance(partial(next, self._script), now)

    def stop(self) -> None:
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

    def _resume(self, packets: tuple[gx1.Gx1Packet, ...], now: HostTime) -> list[Output[bytes]]:
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


LISTEN_S = 0.3
FLUSH_TIMEOUT_S = 1.0
"""How long a device may take to end its stream, as DUNE's driver allows."""

KNOWN_FLUSH_TIMEOUT_S = 0.2
"""The same for a device that has answered here before: if that was too short it is tried again."""

KNOWN_ATTEMPTS = 3
"""Attempts at the baud rate at which a device was found before."""

RETRY_DELAY_S = 5.0
"""Delay between failed attempts."""

GAIN_RANGE = (1000, 30_000)
"""The least and the greatest gain that is believed: a vector's full scale is a thousandth of it in gauss, g or rad/s.
Those that are known of are 2000 to 10000."""

GYRO_GAIN_3DMG = 64
"""Of the 3DM-G, the older model with the same protocol and other scales."""


class UnusableDeviceError(Exception):
    """The device answers, but its data cannot be used."""


@dataclass(slots=True)
class LineState:
    """Baud rates to try, in this order, and what the device streamed when it was found.

    found_stream: None until known, 0 for none. is_known: a device has answered at the first baud rate.
    """

    bauds: list[int]
    """Empty for a line that has none."""
    found_stream: int | None = None
    is_known: bool = False

    @property
    def at_baud_text(self) -> str:
        """Text for the present baud rate; empty without one."""
        return f" at {self.bauds[0]} baud" if self.bauds else ""

    def make_restore_request(self) -> bytes:
        """Return the request that leaves the continuous mode as it was found."""
        return requests.make_stream(self.found_stream) if self.found_stream else requests.STOP


def find_device(link: Gx1Receiver, found: LineState) -> ScriptPart[str]:
    """Find the device: stop what it streams at one baud rate after the other. Return its serial number and firmware.

    Returns once one answers. The line is taken to be open at the first of the baud rates.
    """
    while True:
        received: list[str] = []
        for number in range(max(1, len(found.bauds))):
            if number:
                found.bauds.append(found.bauds.pop(0))
                yield Reopen(f"no 3DM-GX1 at {found.bauds[-1]} baud, received {received[-1]}", found.bauds[0])
            # a known device returns at its rate: try others only after several attempts
            for attempt in range(KNOWN_ATTEMPTS if found.is_known else 1):
                link.reset()
                try:
                    yield from _stop_stream(
                        link, found, KNOWN_FLUSH_TIMEOUT_S if found.is_known and not attempt else FLUSH_TIMEOUT_S
                    )
                    device = yield from _read_identity()
                except NoReplyError:
                    continue
                found.is_known = True
                return device
            found.is_known = False
            received.append(link.describe_input())
        yield EndpointStatus(EndpointPhase.SILENT, _explain_no_device(found.bauds, received))
        yield PauseStep(RETRY_DELAY_S)
        if len(found.bauds) > 1:
            found.bauds.append(found.bauds.pop(0))
            yield Reopen("no 3DM-GX1 found, trying again", found.bauds[0])


def _stop_stream(link: Gx1Receiver, found: LineState, flush: float) -> ScriptPart[None]:
    """Record what the device streams (two replies of one kind) and stop it, within `flush` seconds."""
    listened = yield CollectStep(LISTEN_S, frozenset(gx1.MEASUREMENTS))
    kinds = [packet.command for packet in listened]
    if found.found_stream is None:
        found.found_stream = next((kind for kind in kinds if kinds.count(kind) > 1), None)
    if link.bytes_received:
        # a stop command may be sent in the middle of a streamed reply: the second one is answered clearly
        yield Send(requests.STOP)
        yield PauseStep(flush)
    yield RequestStep(requests.STOP, value=0)
    if found.found_stream is None:
        found.found_stream = 0
    # what was listened to may have been noise that looked like replies
    link.ticks.reset()


def _read_identity() -> ScriptPart[str]:
    (serial,) = yield RequestStep(requests.make_poll(gx1.CommandByte.SERIAL))
    (firmware,) = yield RequestStep(requests.make_poll(gx1.CommandByte.FIRMWARE))
    return f"3DM-GX1 serial {serial.unsigned}, firmware {format_version(firmware.unsigned)}"


def _explain_no_device(bauds: Sequence[int], received: Sequence[str]) -> str:
    # after the attempts the list of rates is rotated by one
    order = [f"at {baud} baud " for baud in (*bauds[1:], *bauds[:1])] or [""]
    attempts = "; ".join(f"{at}received {what}" for at, what in zip(order, received, strict=True))
    if all(what == "nothing" for what in received):
        why = "check the device's power, the cable, and that the port is the right one"
    elif any("text" in what for what in received):
        why = "text is from another device: check which port the 3DM-GX1 is on"
    elif bauds:
        why = "another device, or a baud rate that was not tried: check the port, and the list of baud rates"
    else:
        why = "another device, or the baud rate of the device server is not the 3DM-GX1's: check both"
    return f"no 3DM-GX1 answers on this line: {attempts}; {why}; trying again in {RETRY_DELAY_S:g} s"


def read_words(addresses: Iterable[int]) -> ScriptPart[tuple[int, ...]]:
    """Read words of the EEPROM, unsigned."""
    words: tuple[int, ...] = ()
    for address in addresses:
        (reply,) = yield RequestStep(requests.make_read_eeprom(address))
        words = (*words, reply.unsigned)
    return words


def read_gains() -> ScriptPart[gx1.Gains]:
    """Read the gains. Raises UnusableError for those that no 3DM-GX1 can have.

    They are read twice: a reply does not contain its address, and a delayed one would pass for the next.
    """
    words = yield from read_words(gx1.EepromAddress.GAINS)
    again = yield from read_words(gx1.EepromAddress.GAINS)
    if words != again:
        raise UnusableDeviceError(
            f"the gains in its EEPROM were read twice, as {list(words)} and as {list(again)}: its replies come late or "
            "are damaged; check the cable, and the device server if there is one"
        )
    gains = gx1.Gains(*words)
    if gains.gyro == GYRO_GAIN_3DMG:
        raise UnusableDeviceError(
            f"the gyro gain in its EEPROM (address {gx1.EepromAddress.GYRO_GAIN}) is {gains.gyro}, that of the older "
            "3DM-G with other scales: connect a 3DM-GX1"
        )
    for name, address, gain in zip(gx1.Gains._fields, gx1.EepromAddress.GAINS, gains, strict=True):
        if not GAIN_RANGE[0] <= gain <= GAIN_RANGE[1]:
            raise UnusableDeviceError(
                f"the {name} gain in its EEPROM (address {address}) is {gain}, and no 3DM-GX1 has one outside "
                f"{GAIN_RANGE[0]} to {GAIN_RANGE[1]}: the EEPROM is erased or damaged; write the gain "
                "from the device's calibration sheet to it"
            )
    return gains
