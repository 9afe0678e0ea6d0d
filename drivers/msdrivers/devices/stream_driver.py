"""Common part of the drivers of devices that are configured, and then stream: search, setup, silence, status.

The device is asked who it is; without an answer the next baud rate is tried. Then it gets its configuration step by
step, each acknowledged. It is set up again when nothing has arrived for `silence`: a restarted device may have lost its
configuration. One that streams without answering is used as it is.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from typing import ClassVar, Final, Generic, Protocol, TypeVar

from modelserver.messages import Sample, SensorHeader
from modelserver.transforms.so3 import Vector3
from msdrivers.devices.ranges import check_ranges
from msdrivers.endpoint import EndpointPhase, EndpointStatus, HostTime, MeasuredSample, Output, Reopen, Send
from msdrivers.protocol.framing import FrameScanner
from msdrivers.protocol.recognition import recognize_line
from msdrivers.protocol.setup_step import SetupStep

EXAMINED_BYTES: Final = 4096
"""First bytes of a line by which another device is recognized."""

SECOND_NS: Final = 1_000_000_000
WARNING_INTERVAL_NS: Final = 60 * SECOND_NS
"""Rate limit of the warning that no device was found."""

_MAX_ARRIVALS: Final = 4096

M = TypeVar("M")
"""The decoded message of a device's protocol."""


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
