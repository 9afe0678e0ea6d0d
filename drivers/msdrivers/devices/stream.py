"""Devices that stream bytes: framing, recognition, and the common driver: search, setup, silence, status.

Framing: the scanner searches the next start byte and lets its format check the frame there: length, checksum, values.
After a rejected frame the search continues one byte further, so that a valid frame that began inside a damaged one is
found. The buffer is bounded: every format rejects a frame that would be longer than its limit.

Recognition: which device speaks on a line, by frames with a valid checksum.

Setup (`ScriptRunner`): a script of requests and pauses, repeated after timeouts.

Driver (`StreamDriver`): the device is asked who it is; without an answer the next baud rate is tried. Then it gets its
configuration step by step, each acknowledged. It is set up again when nothing has arrived for `silence`: a restarted
device may have lost its configuration. One that streams without answering is used as it is.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial, reduce
from itertools import accumulate
from operator import xor
from typing import Any, ClassVar, Final, Generic, NamedTuple, Protocol, TypeAlias, TypeVar

from modelserver.messages import Sample, SensorHeader
from modelserver.transforms.so3 import Vector3
from msdrivers.devices import check_ranges
from msdrivers.endpoint import EndpointPhase, EndpointStatus, HostTime, MeasuredSample, Output, Reopen, Send

M = TypeVar("M")
"""The decoded message of a device's protocol."""

M_co = TypeVar("M_co", covariant=True)

MAX_NAMES: Final = 64
"""Largest number of names; further ones are counted as `other`."""

MAX_NAME_LENGTH: Final = 48
"""Longer names are truncated."""


class BoundedCounter(Counter[str]):
    """Counts by name; once `MAX_NAMES` are known, a new one is counted as `other` of its kind.

    The kind is the part before the first dot: `novatel.id 4711B` becomes `novatel.other`.
    """

    def add(self, name: str) -> None:
        name = name[:MAX_NAME_LENGTH]
        if name not in self and len(self) >= MAX_NAMES:
            # one `other` for each kind; kinds are this program's own words
            name = f"{name.partition('.')[0]}.other"
        self[name] += 1


@dataclass(frozen=True, slots=True)
class ParsedFrame(Generic[M_co]):
    """A valid frame: its end in the buffer, its kind for the counters, its message (None: valid but not used here)."""

    end: int
    kind: str
    message: M_co | None


@dataclass(frozen=True, slots=True)
class RejectedFrame:
    """No valid frame starts here. An empty reason means chance: a byte that only looked like a start."""

    reason: str


NO_FRAME = RejectedFrame("")


class FrameFormat(Protocol[M_co]):
    """A frame format."""

    @property
    def start_bytes(self) -> bytes:
        """First bytes of a frame; formats of one scanner share none."""

    def scan(self, buffer: bytearray, at: int, start: int) -> ParsedFrame[M_co] | RejectedFrame | None:
        """Parse the frame at `at`, `start` bytes after the beginning of the stream; None: more bytes are needed."""


class FrameScanner(Generic[M]):
    """Finds the frames of several formats in a byte stream. `feed` never raises; memory is bounded."""

    def __init__(self, formats: Sequence[FrameFormat[M]]) -> None:
        self._formats = {lead: each for each in formats for lead in each.start_bytes}
        self._start_pattern = re.compile(b"[" + re.escape(bytes(self._formats)) + b"]")
        self._buffer = bytearray()
        self._offset = 0
        self._skipped = 0
        self._counts = BoundedCounter()

    @property
    def offset(self) -> int:
        """Number of bytes fed so far."""
        return self._offset + len(self._buffer)

    @property
    def pending_bytes(self) -> int:
        """Number of buffered bytes of an incomplete frame."""
        return len(self._buffer)

    @property
    def counts(self) -> dict[str, int]:
        """Frames by kind, `rejected.<reason>`, and `skipped`: bytes in no frame, ends of lines not counted."""
        return {**self._counts, "skipped": self._skipped}

    def reject(self, reason: str) -> None:
        """Count a message that was rejected for its content."""
        self._counts[f"rejected.{reason}"] += 1

    def clear(self) -> None:
        """Discard the incomplete frame after an interruption; counters and offsets continue."""
        self._skip(0, len(self._buffer))
        self._offset += len(self._buffer)
        self._buffer.clear()

    def feed(self, data: bytes) -> list[M]:
        """Return the messages that `data` completes, in stream order."""
        buffer = self._buffer
        buffer += data
        messages = []
        at = 0
        while found := self._start_pattern.search(buffer, at):
            if found.start() > at:
                self._skip(at, found.start())
                at = found.start()
            try:
                verdict = self._formats[buffer[at]].scan(buffer, at, self._offset + at)
            except Exception:
                verdict = RejectedFrame("error")
            if verdict is None:
                break
            if isinstance(verdict, RejectedFrame):
                if verdict.reason:
                    self.reject(verdict.reason)
                self._skip(at, at + 1)
                at += 1
                continue
            self._counts.add(verdict.kind)
            if verdict.message is not None:
                messages.append(verdict.message)
            at = verdict.end
        else:
            self._skip(at, len(buffer))
            at = len(buffer)
        self._offset += at
        del buffer[:at]
        return messages

    def _skip(self, begin: int, end: int) -> None:
        part = self._buffer[begin:end]
        self._skipped += len(part) - part.count(b"\r") - part.count(b"\n")


MIN_FRAMES: Final = 2
"""Fewer valid frames may be chance."""


class KnownProtocol(NamedTuple):
    """A protocol: its name, the kind of device that reads it, and a function that counts valid frames."""

    name: str
    device: str
    count: Callable[[bytes], int]


def _count_ubx(data: bytes) -> int:
    number = 0
    for found in re.finditer(rb"\xb5\x62", data):
        begin = found.end()
        end = begin + 4 + int.from_bytes(data[begin + 2 : begin + 4], "little")
        body = data[begin:end]
        # Fletcher's checksum
        checksum = bytes((sum(body) & 0xFF, sum(accumulate(body)) & 0xFF))
        number += end + 2 <= len(data) and checksum == data[end : end + 2]
    return number


def _count_xbus(data: bytes) -> int:
    number = 0
    for found in re.finditer(rb"\xfa[\xff\x01].", data, re.DOTALL):
        size, begin = data[found.end() : found.end() + 1], found.end() + 1
        if size == b"\xff":
            size, begin = data[begin : begin + 2], begin + 2
        end = begin + int.from_bytes(size, "big") + 1
        number += end <= len(data) and sum(data[found.start() + 1 : end]) & 0xFF == 0
    return number


_SENTENCE: Final = re.compile(rb"\$([A-Z]{2,6}[^*\r\n]{0,200})\*([0-9A-Fa-f]{2})")
_NOVATEL: Final = re.compile(rb"\xaa\x44\x12\x1c|#[A-Z0-9]{4,20}A,[^;\r\n]{10,120};")


def _count_sentences(data: bytes, is_vectornav: bool) -> int:
    return sum(
        reduce(xor, body, 0) == int(checksum, 16)
        for body, checksum in _SENTENCE.findall(data)
        if body.startswith(b"VN") is is_vectornav
    )


PROTOCOLS: Final = (
    KnownProtocol("UBX messages of a u-blox receiver", "ublox", _count_ubx),
    KnownProtocol("NovAtel logs", "novatel", lambda data: len(_NOVATEL.findall(data))),
    KnownProtocol("Xbus messages of an Xsens unit", "xsens", _count_xbus),
    # as it comes from its maker: binary output is switched on by a driver
    KnownProtocol("messages of a VectorNav unit", "vectornav", partial(_count_sentences, is_vectornav=True)),
    KnownProtocol("NMEA sentences", "nmea", partial(_count_sentences, is_vectornav=False)),
)


def recognize(data: bytes) -> KnownProtocol | None:
    """Return the protocol with the most valid frames; None if there is none beyond chance."""
    best = max(PROTOCOLS, key=lambda each: each.count(data))
    return best if best.count(data) >= MIN_FRAMES else None


def recognize_line(data: bytes, device: str) -> str:
    """Describe what a line carries for a driver of `device`, with what to write in the vehicle file."""
    if not data:
        return "received nothing: check power, cable and port"
    found = recognize(data)
    if found is None:
        return f"received {len(data)} bytes that no driver knows, beginning {data[:24]!r}: check port and baud rate"
    if device == found.device:
        return f"received {found.name}"
    return f"received {found.name}: write device: {found.device}"


@dataclass(frozen=True, slots=True)
class RequestStep:
    """Send a request and await its reply, `attempts` times for `timeout` seconds; then raise NoReplyError."""

    frame: bytes
    timeout: float = 0.5
    attempts: int = 3

    @property
    def what(self) -> str:
        return "the request"


@dataclass(frozen=True, slots=True)
class PauseStep:
    """Wait; a reply that arrives meanwhile is not used."""

    seconds: float


Step: TypeAlias = RequestStep | PauseStep | Output[bytes]
T = TypeVar("T")
ScriptPart: TypeAlias = Generator[Step, Any, T]
"""A part of a script that finds a value. A request returns its reply."""
Script: TypeAlias = ScriptPart[None]


class NoReplyError(Exception):
    """A request was not answered."""


class ScriptRunner:
    """Executes the setup of a device, a script: a generator that yields steps and is sent the replies.

    The script knows neither clock nor line. After a retry more than one reply may arrive: the runner waits for them
    before it goes on, each as late as the first, so that none passes for the reply to the next request.
    """

    def __init__(self) -> None:
        self.step: Step | None = None
        self._script: Script | None = None
        self._deadline_ns = self._attempt = 0
        self._reply: Any = None

    @property
    def is_running(self) -> bool:
        return self._script is not None

    @property
    def deadline_ns(self) -> int | None:
        """When to call `on_timer`; None if no step waits for time."""
        return self._deadline_ns if isinstance(self.step, RequestStep | PauseStep) else None

    def start(self, script: Script, now: HostTime) -> list[Output[bytes]]:
        self.stop()
        self._script = script
        return self._advance(now)

    def stop(self) -> None:
        if self._script is not None:
            self._script.close()
        self._script = self.step = None

    def reopen(self, now: HostTime) -> list[Output[bytes]] | None:
        """Continue a script that has requested the reopening of the line; None if none has."""
        return self._advance(now) if isinstance(self.step, Reopen) else None

    def on_reply(self, reply: Any, now: HostTime) -> list[Output[bytes]]:
        """Complete the request under way."""
        step = self.step
        if not isinstance(step, RequestStep):
            return []
        if self._attempt == 1:
            return self._advance(now, reply)
        self._wait(PauseStep(self._attempt * step.timeout), now, reply)
        return []

    def on_timer(self, now: HostTime) -> list[Output[bytes]]:
        due, step = self.deadline_ns, self.step
        if due is None or now.monotonic_ns < due:
            return []
        if not isinstance(step, RequestStep):
            return self._advance(now, self._reply)
        if self._attempt < step.attempts:
            return [self._send_request(step, now)]
        return self._advance(now, error=NoReplyError(f"{step.what} was sent {step.attempts} times and not answered"))

    def _advance(self, now: HostTime, reply: Any = None, error: NoReplyError | None = None) -> list[Output[bytes]]:
        """Continue with a reply or an error to the next step that waits; return the outputs until there."""
        script, self.step = self._script, None
        assert script is not None
        outputs: list[Output[bytes]] = []
        while True:
            try:
                step = script.send(reply) if error is None else script.throw(error)
            except StopIteration:
                self._script = None
                return outputs
            if isinstance(step, RequestStep):
                self.step, self._attempt = step, 0
                return [*outputs, self._send_request(step, now)]
            if isinstance(step, PauseStep):
                self._wait(step, now)
                return outputs
            outputs.append(step)
            if isinstance(step, Reopen):
                self.step = step
                return outputs
            reply = error = None

    def _wait(self, step: PauseStep, now: HostTime, reply: Any = None) -> None:
        self.step, self._reply = step, reply
        self._deadline_ns = now.monotonic_ns + round(step.seconds * 1e9)

    def _send_request(self, step: RequestStep, now: HostTime) -> Send[bytes]:
        self._attempt += 1
        self._deadline_ns = now.monotonic_ns + round(step.timeout * 1e9)
        return Send(step.frame)


@dataclass(frozen=True, slots=True)
class SetupStep:
    """A configuration message, which the device acknowledges. `is_optional`: its rejection does not matter."""

    frame: bytes
    what: str
    is_optional: bool = False


EXAMINED_BYTES: Final = 4096
"""First bytes of a line by which another device is recognized."""

SECOND_NS: Final = 1_000_000_000
NEVER_NS: Final = 1 << 62
WARNING_INTERVAL_NS: Final = 60 * SECOND_NS
"""Rate limit of the warning that no device was found."""

_MAX_ARRIVALS: Final = 4096


@dataclass(frozen=True, slots=True, kw_only=True)
class ByteSettings:
    """Settings that all these devices have. Raises ValueError with the key for an invalid value."""

    source: str = field(kw_only=False)
    silence: float = 0.5
    """Timeout for samples, seconds, after which the setup is repeated."""
    delay: float = 0.0
    """From the measurement to the instant that the device states, seconds."""
    delay_sigma: float = 0.0
    """Standard deviation of `delay`, seconds."""

    def __post_init__(self) -> None:
        check_ranges(self, silence=(0.05, 3600.0), delay=(-5.0, 5.0), delay_sigma=(0.0, 5.0))
        if any(baud <= 0 for baud in self.bauds):
            raise ValueError(f"bauds are above 0, got {self.bauds}")
        rate_hz = getattr(self, "rate_hz", 0.0)
        if 0.0 < rate_hz * self.silence < 1.5:
            raise ValueError(f"silence is at least 1.5 periods, {1.5 / rate_hz:g} s, got {self.silence:g}")

    @property
    def bauds(self) -> tuple[int, ...]:
        """Baud rates to try; the line is opened at the first. Empty: the line has none."""
        return ()


class StreamDriver(ABC, Generic[M]):
    """An `Endpoint` of bytes at the host's end of a device's line."""

    device: str
    """Name in the vehicle file."""
    description: str
    """What is looked for, e.g. "u-blox receiver"."""
    awaited: str
    """What it streams, e.g. "NAV-PVT"."""
    formats: ClassVar[Sequence[FrameFormat[Any]]] = ()
    """Those of its frames, unless it has a scanner of its own."""
    identification = b""
    """Request for the device's identity; nothing for one that is only read."""
    answer_timeout = 0.5
    """Timeout for an answer, seconds."""
    attempts = 3
    """How often an unanswered message is sent."""

    def __init__(self, settings: ByteSettings, stream: FrameScanner[M] | None = None) -> None:
        self._settings, self._stream = settings, stream or FrameScanner(self.formats)
        self.max_silence = settings.silence
        self._phase, self._reported = EndpointPhase.WAITING, ""
        self._setup = ScriptRunner()
        self._product = ""
        self._setup_step: SetupStep | None = None
        self._now = HostTime(0, 0)
        self._silence_deadline_ns = 0
        self._arrivals: deque[tuple[int, int]] = deque(maxlen=_MAX_ARRIVALS)
        self._first_bytes = b""
        self._baud_index = 0
        self._tried: list[str] = []
        self._next_warning_ns = 0
        self._seq = 0
        self._counts: Counter[str] = Counter()

    @abstractmethod
    def _on_message(self, message: M, now: HostTime) -> list[Output[bytes]]:
        """Process a message: call `_on_identity`, `_on_acknowledgement` or `_publish`."""

    def _on_start(self) -> None:
        """Discard what is incomplete: the line was opened."""

    def _get_extra_deadline(self) -> int | None:
        """Return when to call `_on_extra_timer`, monotonic nanoseconds."""
        return None

    def _on_extra_timer(self, now: HostTime) -> list[Output[bytes]]:
        """Do what the device's own deadline is for."""
        return []

    @property
    def counts(self) -> Mapping[str, int]:
        """Messages by kind, `rejected.<reason>`, `skipped` bytes, `samples`, and the device's own."""
        return Counter({**self._stream.counts, **self._counts})

    def on_open(self, now: HostTime) -> Sequence[Output[bytes]]:
        """Discard incomplete data and ask the device who it is."""
        self._now = now
        self._stream.clear()
        self._arrivals.clear()
        self._on_start()
        if (out := self._setup.reopen(now)) is not None:
            return out
        is_silent = self._phase is EndpointPhase.SILENT
        status = [] if is_silent else self._set_status(EndpointPhase.WAITING, f"waiting for {self.description}")
        return [*status, *self._setup.start(self._run_setup(), now)]

    def on_receive(self, unit: bytes, now: HostTime) -> Sequence[Output[bytes]]:
        self._now = now
        self._arrivals.append((self._stream.offset, now.utime))
        if len(self._first_bytes) < EXAMINED_BYTES:
            self._first_bytes += unit[: EXAMINED_BYTES - len(self._first_bytes)]
        return [output for message in self._stream.feed(unit) for output in self._on_message(message, now)]

    def on_timer(self, now: HostTime) -> Sequence[Output[bytes]]:
        self._now = now
        out: list[Output[bytes]] = []
        extra = self._get_extra_deadline()
        if extra is not None and now.monotonic_ns >= extra:
            out += self._on_extra_timer(now)
        if self._setup.is_running:
            return [*out, *self._setup.on_timer(now)]
        return [*out, *(self._on_silence(now) if now.monotonic_ns >= self._silence_deadline_ns else [])]

    def get_deadline(self) -> int | None:
        deadline = self._setup.deadline_ns if self._setup.is_running else self._silence_deadline_ns
        return min((each for each in (deadline, self._get_extra_deadline()) if each is not None), default=None)

    def on_close(self, now: HostTime) -> Sequence[Output[bytes]]:
        return []

    def _on_identity(self, product: str, steps: Sequence[SetupStep], now: HostTime) -> list[Output[bytes]]:
        """Begin the setup of a device that has answered."""
        return [] if self._setup_step else self._setup.on_reply((product, steps), now)

    @property
    def _step(self) -> SetupStep | None:
        """The step whose acknowledgement is awaited."""
        return self._setup_step if isinstance(self._setup.step, RequestStep) else None

    def _on_acknowledgement(self, now: HostTime, error: str = "") -> list[Output[bytes]]:
        """Go on to the next step; `error`: why the device rejected this one."""
        return self._setup.on_reply(error, now) if self._step else []

    def _make_header(self, host_utime: int, device_utime: int) -> SensorHeader:
        self._seq += 1
        return SensorHeader(0, self._settings.source, self._seq - 1, host_utime, device_utime)

    def _publish(self, sample: Sample, now: HostTime, tick: float = 1e-6, delay: float = 0.0) -> list[Output[bytes]]:
        """Publish a sample; `delay`: seconds by which it is older than the settings state."""
        self._counts["samples"] += 1
        self._tried = []
        self._restart_silence_timer()
        delay += self._settings.delay
        out: list[Output[bytes]] = [MeasuredSample(sample, delay, self._settings.delay_sigma, tick)]
        if not self._setup.is_running and self._phase is not EndpointPhase.STREAMING:
            out += self._set_status(EndpointPhase.STREAMING, f"{self._product or 'a device'}, receiving {self.awaited}")
        return out

    def _read_vector(self, values: tuple[float, ...] | None, most: float, scale: float = 1.0) -> Vector3 | None:
        """Return a vector in SI units; None for one that is not measured, or beyond `most` in the device's unit."""
        if values is None:
            return None
        if not all(abs(each) <= most for each in values):
            self._counts["rejected.range"] += 1
            return None
        return (values[0] * scale, values[1] * scale, values[2] * scale)

    def _find_arrival(self, start: int, now: HostTime) -> int:
        """Return when the first byte of a message was received, utime; `start` is its offset in the stream."""
        return next((utime for offset, utime in reversed(self._arrivals) if offset <= start), now.utime)

    def _set_status(self, phase: EndpointPhase, text: str, *, is_warning: bool = False) -> list[Output[bytes]]:
        """Report a status unless it is unchanged."""
        if (phase, text) == (self._phase, self._reported):
            return []
        self._phase, self._reported = phase, text
        return [EndpointStatus(phase, text, is_warning)]

    def _run_setup(self) -> Script:
        """Find the device and configure it; then samples must come."""
        limits = self.answer_timeout, self.attempts
        while True:
            self._setup_step, self._first_bytes, seq = None, b"", self._seq
            try:
                self._product, steps = yield RequestStep(self.identification, *limits)
                break
            except NoReplyError:
                if self._seq > seq:
                    use = "a device that does not answer commands is used as it is; can the line send to it?"
                    text = f"it sends {self.awaited} but answers nothing: {use}"
                    yield from self._set_status(EndpointPhase.STREAMING, text)
                    self._restart_silence_timer()
                    return
                yield from self._try_next_baud()
        self._tried = []
        yield from self._set_status(EndpointPhase.CONFIGURING, f"{self._product} answers, setting it up")
        for step in steps:
            self._setup_step = step
            try:
                error = yield RequestStep(step.frame, *limits)
            except NoReplyError:
                self._counts["unanswered"] += 1
                error = "" if step.is_optional else "no answer"
            if error and step.is_optional:
                self._counts["optional_rejected"] += 1
            elif error:
                text = f"the device rejected {step.what}: {error}"
                yield from self._set_status(EndpointPhase.CONFIGURING, text, is_warning=True)
        if self._phase is not EndpointPhase.STREAMING:
            text = f"{self._product} is set up, waiting for {self.awaited}"
            yield from self._set_status(EndpointPhase.CONFIGURING, text)
        self._restart_silence_timer()

    def _restart_silence_timer(self) -> None:
        self._silence_deadline_ns = self._now.monotonic_ns + round(self._settings.silence * SECOND_NS)

    def _on_silence(self, now: HostTime) -> list[Output[bytes]]:
        text = f"no usable {self.awaited} for {self._settings.silence:g} s, setting the device up again"
        return [*self._set_status(EndpointPhase.SILENT, text), *self._setup.start(self._run_setup(), now)]

    def _try_next_baud(self) -> Script:
        bauds, found = self._settings.bauds, recognize_line(self._first_bytes, self.device)
        baud = bauds[self._baud_index] if bauds else None
        self._tried.append(f"at {baud} baud {found}" if baud else found)
        if len(self._tried) >= max(1, len(bauds)):
            # the text differs with the noise: rate limit
            if self._phase is not EndpointPhase.SILENT or self._now.monotonic_ns >= self._next_warning_ns:
                self._next_warning_ns = self._now.monotonic_ns + WARNING_INTERVAL_NS
                text = f"no {self.description} answers on this line: {'; '.join(self._tried)}"
                yield from self._set_status(EndpointPhase.SILENT, text)
            self._tried = []
        if len(bauds) > 1:
            self._baud_index = (self._baud_index + 1) % len(bauds)
            yield Reopen(f"no {self.description} at {baud} baud, {found}", bauds[self._baud_index])
