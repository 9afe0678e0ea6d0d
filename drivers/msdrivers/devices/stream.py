"""Devices that stream bytes: framing, recognition, and the common driver: search, setup, silence, status.

Framing: the scanner searches the next start byte and lets its format check the frame there: length, checksum, values.
After a rejected frame the search continues one byte further, so that a valid frame that began inside a damaged one is
found. The buffer is bounded: every format rejects a frame that would be longer than its limit.

Recognition: which device speaks on a line, by frames with a valid checksum.

Driver (`StreamDriver`): the device is asked who it is; without an answer the next baud rate is tried. Then it gets its
configuration step by step, each acknowledged. It is set up again when nothing has arrived for `silence`: a restarted
device may have lost its configuration. One that streams without answering is used as it is.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from binascii import crc_hqx
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import xor
from typing import ClassVar, Final, Generic, NamedTuple, Protocol, TypeVar

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
        """Count one more of `name`."""
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
    """Finds the frames of several formats in a byte stream; `feed` never raises."""

    def __init__(self, formats: Sequence[FrameFormat[M]]) -> None:
        self._formats = {lead: each for each in formats for lead in each.start_bytes}
        self._start_pattern = re.compile(b"[" + re.escape(bytes(self._formats)) + b"]")
        self._buffer = bytearray()
        self._offset = 0
        self._skipped = 0
        self._frames = BoundedCounter()
        self._rejected: Counter[str] = Counter()

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
        rejected = {f"rejected.{reason}": number for reason, number in self._rejected.items()}
        return {**self._frames, **rejected, "skipped": self._skipped}

    def reject(self, reason: str) -> None:
        """Count a message that was rejected for its content."""
        self._rejected[reason] += 1

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
                    self._rejected[verdict.reason] += 1
                self._skip(at, at + 1)
                at += 1
                continue
            self._frames.add(verdict.kind)
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


def compute_fletcher(data: bytes) -> bytes:
    """Return Fletcher's checksum of 2 bytes, as UBX messages have it."""
    a = b = 0
    for byte in data:
        a = (a + byte) & 0xFF
        b = (b + a) & 0xFF
    return bytes((a, b))


def _count_ubx(data: bytes) -> int:
    number = 0
    for found in re.finditer(rb"\xb5\x62", data):
        begin = found.end()
        end = begin + 4 + int.from_bytes(data[begin + 2 : begin + 4], "little")
        number += end + 2 <= len(data) and compute_fletcher(data[begin:end]) == data[end : end + 2]
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

_VECTORNAV: Final = re.compile(rb"\$VN[A-Z]{3},[^*\r\n]{0,200}\*[0-9A-Fa-f]{2}")

_NOVATEL_ASCII: Final = re.compile(rb"#[A-Z0-9]{4,20}A,[^;\r\n]{10,120};")


def _count_nmea(data: bytes) -> int:
    return sum(
        reduce(xor, body, 0) == int(checksum, 16)
        for body, checksum in _SENTENCE.findall(data)
        if not body.startswith(b"VN")
    )


def _count_vectornav(data: bytes) -> int:
    # binary output: FA, groups, then fields of a length that the groups give; CRC-16 over all after FA is 0
    number, at = len(_VECTORNAV.findall(data)), 0
    while (at := data.find(b"\xfa", at)) >= 0:
        for size in range(8, min(200, len(data) - at)):
            if size > 20 and data[at + size : at + size + 1] == b"\xfa" and crc_hqx(data[at + 1 : at + size], 0) == 0:
                number += 1
                at += size - 1
                break
        at += 1
        if number >= MIN_FRAMES:
            break
    return number


def _count_novatel(data: bytes) -> int:
    return data.count(b"\xaa\x44\x12\x1c") + len(_NOVATEL_ASCII.findall(data))


PROTOCOLS: Final = (
    KnownProtocol("UBX messages of a u-blox receiver", "ublox", _count_ubx),
    KnownProtocol("NovAtel logs", "novatel", _count_novatel),
    KnownProtocol("Xbus messages of an Xsens unit", "xsens", _count_xbus),
    KnownProtocol("messages of a VectorNav unit", "vectornav", _count_vectornav),
    KnownProtocol("NMEA sentences", "nmea", _count_nmea),
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
class SetupStep:
    """A configuration message, which the device acknowledges. `is_optional`: its rejection does not matter."""

    frame: bytes
    what: str
    is_optional: bool = False


EXAMINED_BYTES: Final = 4096
"""First bytes of a line by which another device is recognized."""

SECOND_NS: Final = 1_000_000_000

WARNING_INTERVAL_NS: Final = 60 * SECOND_NS
"""Rate limit of the warning that no device was found."""

_MAX_ARRIVALS: Final = 4096


class StreamSettings(Protocol):
    """Settings that these drivers have in common."""

    @property
    def source(self) -> str:
        """Source of the samples."""

    @property
    def bauds(self) -> tuple[int, ...]:
        """Baud rates to try; empty: the line has none."""

    @property
    def silence(self) -> float:
        """Timeout for samples, seconds."""

    @property
    def answer_timeout(self) -> float:
        """Timeout for an answer, seconds."""

    @property
    def attempts(self) -> int:
        """How often an unanswered message is sent."""

    @property
    def delay(self) -> float:
        """Time from the measurement to the device's time, seconds."""

    @property
    def delay_sigma(self) -> float:
        """Its standard deviation, seconds."""


def check_stream_settings(settings: StreamSettings) -> None:
    """Raise ValueError with the key for a setting out of range."""
    check_ranges(settings, silence=(0.05, 3600.0), answer_timeout=(0.05, 60.0), attempts=(1, 100))
    check_ranges(settings, delay=(-5.0, 5.0), delay_sigma=(0.0, 5.0))
    if any(baud <= 0 for baud in settings.bauds):
        raise ValueError(f"bauds are above 0, got {settings.bauds}")


class StreamDriver(ABC, Generic[M]):
    """An `Endpoint` of bytes at the host's end of a device's line."""

    device: ClassVar[str]
    """Name in the vehicle file."""
    description: ClassVar[str]
    """What is looked for, e.g. "u-blox receiver"."""
    awaited: ClassVar[str]
    """What it streams, e.g. "NAV-PVT"."""

    def __init__(self, settings: StreamSettings, stream: FrameScanner[M]) -> None:
        self._settings, self._stream = settings, stream
        self.max_silence = settings.silence
        self._bauds = settings.bauds
        self._phase, self._reported = EndpointPhase.WAITING, ""
        self._product = ""
        self._steps: tuple[SetupStep, ...] = ()
        self._index = self._attempt = 0
        self._is_identifying = False
        self._answer_deadline_ns: int | None = None
        self._silence_deadline_ns = 0
        self._arrivals: deque[tuple[int, int]] = deque(maxlen=_MAX_ARRIVALS)
        self._first_bytes = b""
        self._baud_index = 0
        self._tried: list[str] = []
        self._next_warning_ns = 0
        self._seq = self._seq_at_setup = 0
        self._counts: Counter[str] = Counter()

    # --- what a device defines ---

    @abstractmethod
    def _make_identification(self) -> bytes:
        """Return the request for the device's identity."""

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

    # --- endpoint ---

    @property
    def counts(self) -> Mapping[str, int]:
        """Messages by kind, `rejected.<reason>`, `skipped` bytes, `samples`, and the device's own."""
        return {**self._stream.counts, **self._counts}

    def on_open(self, now: HostTime) -> Sequence[Output[bytes]]:
        """Discard incomplete data and ask the device who it is."""
        self._stream.clear()
        self._arrivals.clear()
        self._on_start()
        # no new status within a search over the baud rates
        searching = self._tried or self._phase is EndpointPhase.SILENT
        status = (
            [] if searching else self._set_status(EndpointPhase.WAITING, f"waiting for an answer: {self.description}")
        )
        return [*status, *self._identify(now)]

    def on_receive(self, unit: bytes, now: HostTime) -> Sequence[Output[bytes]]:
        """Process received bytes."""
        self._arrivals.append((self._stream.offset, now.utime))
        if len(self._first_bytes) < EXAMINED_BYTES:
            self._first_bytes += unit[: EXAMINED_BYTES - len(self._first_bytes)]
        return [output for message in self._stream.feed(unit) for output in self._on_message(message, now)]

    def on_timer(self, now: HostTime) -> Sequence[Output[bytes]]:
        """Do what is due."""
        out: list[Output[bytes]] = []
        extra = self._get_extra_deadline()
        if extra is not None and now.monotonic_ns >= extra:
            out += self._on_extra_timer(now)
        if self._answer_deadline_ns is not None:
            return [*out, *(self._on_unanswered(now) if now.monotonic_ns >= self._answer_deadline_ns else [])]
        if now.monotonic_ns >= self._silence_deadline_ns:
            text = f"no {self.awaited} for {self._settings.silence:g} s, setting the device up again"
            out += [*self._set_status(EndpointPhase.SILENT, text), *self._identify(now)]
        return out

    def get_deadline(self) -> int | None:
        """Return when to call `on_timer`, monotonic nanoseconds."""
        answer, extra = self._answer_deadline_ns, self._get_extra_deadline()
        deadline = self._silence_deadline_ns if answer is None else answer
        return deadline if extra is None else min(deadline, extra)

    def on_close(self, now: HostTime) -> Sequence[Output[bytes]]:
        return []

    # --- for the device ---

    def _on_identity(self, product: str, steps: Sequence[SetupStep], now: HostTime) -> list[Output[bytes]]:
        """Begin the setup of a device that has answered."""
        if not self._is_identifying:
            return []
        self._is_identifying, self._tried = False, []
        self._product, self._steps, self._index, self._attempt = product, tuple(steps), 0, 0
        words = f"{product} answers, setting it up"
        return [*self._set_status(EndpointPhase.CONFIGURING, words), *self._send_step(now)]

    @property
    def _step(self) -> SetupStep | None:
        is_waiting = not self._is_identifying and self._answer_deadline_ns is not None
        return self._steps[self._index] if is_waiting and self._index < len(self._steps) else None

    def _on_acknowledgement(self, now: HostTime, error: str = "") -> list[Output[bytes]]:
        """Go on to the next step; `error`: why the device rejected this one."""
        step = self._step
        if step is None:
            return []
        out: list[Output[bytes]] = []
        if error and step.is_optional:
            self._counts["optional_rejected"] += 1
        elif error:
            text = f"the device rejected {step.what}: {error}"
            out += self._set_status(EndpointPhase.CONFIGURING, text, is_warning=True)
        self._index, self._attempt = self._index + 1, 0
        return [*out, *self._send_step(now)]

    def _make_header(self, host_utime: int, device_utime: int) -> SensorHeader:
        self._seq += 1
        return SensorHeader(0, self._settings.source, self._seq - 1, host_utime, device_utime)

    def _publish(self, sample: Sample, now: HostTime, tick: float = 1e-6) -> list[Output[bytes]]:
        self._counts["samples"] += 1
        self._tried = []
        self._silence_deadline_ns = now.monotonic_ns + round(self._settings.silence * SECOND_NS)
        out: list[Output[bytes]] = [MeasuredSample(sample, self._settings.delay, self._settings.delay_sigma, tick)]
        if self._answer_deadline_ns is None and self._phase is not EndpointPhase.STREAMING:
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

    # --- setup ---

    def _identify(self, now: HostTime) -> list[Output[bytes]]:
        self._is_identifying, self._steps, self._index, self._attempt = True, (), 0, 1
        self._seq_at_setup, self._first_bytes = self._seq, b""
        self._answer_deadline_ns = now.monotonic_ns + round(self._settings.answer_timeout * SECOND_NS)
        return [Send(self._make_identification())]

    def _send_step(self, now: HostTime) -> list[Output[bytes]]:
        """Send the next step; after the last one samples must come."""
        if self._index == len(self._steps):
            self._wait_for_samples(now)
            text = f"{self._product} is set up, waiting for {self.awaited}"
            return [] if self._phase is EndpointPhase.STREAMING else self._set_status(EndpointPhase.CONFIGURING, text)
        self._attempt += 1
        self._answer_deadline_ns = now.monotonic_ns + round(self._settings.answer_timeout * SECOND_NS)
        return [Send(self._steps[self._index].frame)]

    def _wait_for_samples(self, now: HostTime) -> None:
        self._answer_deadline_ns, self._is_identifying = None, False
        self._silence_deadline_ns = now.monotonic_ns + round(self._settings.silence * SECOND_NS)

    def _on_unanswered(self, now: HostTime) -> list[Output[bytes]]:
        """Repeat a message without an answer; after the last attempt use what arrives, else try the next baud rate."""
        if self._attempt < self._settings.attempts:
            if not self._is_identifying:
                return self._send_step(now)
            self._attempt += 1
            self._answer_deadline_ns = now.monotonic_ns + round(self._settings.answer_timeout * SECOND_NS)
            return [Send(self._make_identification())]
        if not self._is_identifying:
            self._counts["unanswered"] += 1
            return self._on_acknowledgement(now, "" if self._steps[self._index].is_optional else "no answer")
        self._wait_for_samples(now)
        if self._seq > self._seq_at_setup:
            text = f"it sends {self.awaited} but answers nothing: using what it sends; can the line send to it?"
            return self._set_status(EndpointPhase.STREAMING, text)
        return self._try_next_baud(now)

    def _try_next_baud(self, now: HostTime) -> list[Output[bytes]]:
        found = recognize_line(self._first_bytes, self.device)
        baud = self._bauds[self._baud_index] if self._bauds else None
        self._tried.append(f"at {baud} baud {found}" if baud else found)
        out: list[Output[bytes]] = []
        if len(self._tried) >= max(1, len(self._bauds)):
            # the text differs with the noise: rate limit
            if self._phase is not EndpointPhase.SILENT or now.monotonic_ns >= self._next_warning_ns:
                self._next_warning_ns = now.monotonic_ns + WARNING_INTERVAL_NS
                text = f"no {self.description} answers on this line: {'; '.join(self._tried)}"
                out += self._set_status(EndpointPhase.SILENT, text)
            self._tried = []
        if len(self._bauds) < 2:
            return [*out, *self._identify(now)]
        self._baud_index = (self._baud_index + 1) % len(self._bauds)
        return [*out, Reopen(f"no {self.description} at {baud} baud, {found}", self._bauds[self._baud_index])]
