"""Emulators of devices: each an `Endpoint` at the device's end of a line. Here: faults, and what emulators share.

Faults of emulated devices have texts, instants at which they are due, and effects on what the device sends.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, Generic, NamedTuple, TypeVar

from modelserver.errors import find_nearest_names, quote
from modelserver.messages import GpsSample, ImuSample, VehicleStatusSample, WheelsSample
from msdrivers.endpoint import (
    CanFrame,
    Endpoint,
    EndpointPhase,
    EndpointStatus,
    HostTime,
    Output,
    Registers,
    Send,
    make_bus_off_frame,
)

U = TypeVar("U")

S = TypeVar("S", GpsSample, ImuSample, WheelsSample, VehicleStatusSample)


class InjectedFault(NamedTuple):
    """A fault `at` seconds after the start; the meaning of `amount` depends on the kind."""

    at: float
    kind: str
    amount: float = 1.0


FAULT_AMOUNTS: Mapping[str, str] = {
    "drop": "units that are lost",
    "corrupt": "units that arrive damaged",
    "stall": "seconds of silence",
    "restart": "seconds that a restart takes",
    "jump": "seconds by which its time jumps ahead",
}
"""Kinds of faults and the default meaning of their amounts."""


def parse_fault(text: str, known: Mapping[str, str] = FAULT_AMOUNTS) -> InjectedFault:
    """Return the fault of `KIND@SECONDS[:AMOUNT]`, one of the `known` kinds.

    Raises ValueError for a malformed text.
    """
    kind, at_sign, when = text.partition("@")
    if not at_sign:
        raise ValueError(f"{quote(text, 40)} is not of the form KIND@SECONDS[:AMOUNT], e.g. stall@10:2")
    if kind not in known:
        near = find_nearest_names(kind, known)
        kinds = "; ".join(f"{name}: {amount}" for name, amount in known.items())
        hint = f"did you mean {near[0]}?" if near else f"there are, with their amounts: {kinds}"
        raise ValueError(f"{quote(kind, 40)} is no fault; {hint}")
    at, _, amount = when.partition(":")
    try:
        fault = InjectedFault(float(at), kind, float(amount) if amount else 1.0)
    except ValueError:
        raise ValueError(f"{quote(when, 40)} is not of the form SECONDS[:AMOUNT], e.g. 10:2") from None
    if not (0.0 <= fault.at < 1e9 and 0.0 < fault.amount < 1e9):
        raise ValueError(f"{quote(when, 40)}: seconds are 0 or more, an amount is above 0")
    return fault


class FaultQueue(Generic[U]):
    """The faults of one device in the order of their times, monotonic nanoseconds; applies those of the line.

    drop: `amount` units are lost. corrupt: `amount` units are damaged by `corrupt`. `silencing` kinds, e.g. stall:
    nothing passes for `amount` seconds. The others are the device's to apply.
    """

    def __init__(
        self,
        faults: Iterable[InjectedFault],
        corrupt: Callable[[U], U],
        silencing: Sequence[str] = ("stall", "restart", "bus_off"),
    ):
        self.counts: Counter[str] = Counter()
        """Units that were silenced, dropped and corrupted."""
        self.silent_until_ns = 0
        self._faults = deque(sorted(faults, key=lambda fault: fault.at))
        self._corrupt, self._silencing = corrupt, silencing
        self._started_ns: int | None = None
        self._pending: Counter[str] = Counter()

    def start(self, at_ns: int) -> None:
        """Set the reference time of the faults at the first call."""
        self._started_ns = at_ns if self._started_ns is None else self._started_ns

    def get_deadline(self) -> int | None:
        """Return when the next fault is due; None if there is none, or before the start."""
        if self._started_ns is None or not self._faults:
            return None
        return self._started_ns + round(self._faults[0].at * 1e9)

    def pop_due(self, at_ns: int) -> Iterator[tuple[InjectedFault, int]]:
        """Yield the faults that are due and their times."""
        while (due := self.get_deadline()) is not None and due <= at_ns:
            fault = self._faults.popleft()
            if fault.kind in self._silencing:
                self.silent_until_ns = max(self.silent_until_ns, due + round(fault.amount * 1e9))
            self._pending[fault.kind] += round(fault.amount)
            yield fault, due

    def is_silent(self, at_ns: int) -> bool:
        """Return whether the line is silent in both directions."""
        return at_ns < self.silent_until_ns

    def filter_units(self, units: Iterable[U], at_ns: int) -> list[Send[U]]:
        """Return the units that pass, some of them damaged."""
        sent = []
        for unit in units:
            if self.is_silent(at_ns):
                self.counts["fault.silenced"] += 1
            elif self._pending["drop"] > 0:
                self._pending["drop"] -= 1
                self.counts["fault.dropped"] += 1
            elif self._pending["corrupt"] > 0:
                self._pending["corrupt"] -= 1
                self.counts["fault.corrupted"] += 1
                sent.append(Send(self._corrupt(unit)))
            else:
                sent.append(Send(unit))
        return sent


class FaultInjector(Generic[U]):
    """An `Endpoint` that wraps another and drops, corrupts or delays its output, restarts it, or shifts its clock.

    `make` returns the device as after power-on.
    """

    def __init__(self, make: Callable[[], Endpoint[U]], faults: Sequence[InjectedFault]):
        self._make = make
        self._inner = make()
        self._faults = FaultQueue[U](faults, corrupt_unit)
        self._is_restarting = False
        self._clock_jump_ns = 0

    def on_open(self, now: HostTime) -> Sequence[Output[U]]:
        self._faults.start(now.monotonic_ns)
        return self._filter_outputs(self._inner.on_open(self._to_device_time(now)), now)

    def on_receive(self, unit: U, now: HostTime) -> Sequence[Output[U]]:
        """Pass on a received unit unless the device is silent."""
        struck = self._apply_due_faults(now)
        if self._faults.is_silent(now.monotonic_ns):
            return struck
        return [*struck, *self._filter_outputs(self._inner.on_receive(unit, self._to_device_time(now)), now)]

    def on_timer(self, now: HostTime) -> Sequence[Output[U]]:
        """Apply due faults; fire the device's timer."""
        outputs = self._apply_due_faults(now)
        if self._is_restarting and not self._faults.is_silent(now.monotonic_ns):
            self._is_restarting = False
            self._inner = self._make()
            outputs += self._filter_outputs(self._inner.on_open(self._to_device_time(now)), now)
        due = self._inner.get_deadline()
        if not self._is_restarting and due is not None and now.monotonic_ns + self._clock_jump_ns >= due:
            outputs += self._filter_outputs(self._inner.on_timer(self._to_device_time(now)), now)
        return outputs

    def get_deadline(self) -> int | None:
        """Return when the device, or a fault, is due."""
        inner = self._inner.get_deadline()
        device = None if inner is None else inner - self._clock_jump_ns
        dues = (self._faults.silent_until_ns if self._is_restarting else device, self._faults.get_deadline())
        return min((due for due in dues if due is not None), default=None)

    def on_close(self, now: HostTime) -> Sequence[Output[U]]:
        return self._filter_outputs(self._inner.on_close(self._to_device_time(now)), now)

    @property
    def counts(self) -> Mapping[str, int]:
        """The device's counters, and the units that faults took or damaged."""
        return {**self._inner.counts, **self._faults.counts}

    def _to_device_time(self, now: HostTime) -> HostTime:
        return HostTime(now.monotonic_ns + self._clock_jump_ns, now.utime + self._clock_jump_ns // 1000)

    def _apply_due_faults(self, now: HostTime) -> list[Output[U]]:
        outputs: list[Output[U]] = []
        for fault, _ in self._faults.pop_due(now.monotonic_ns):
            self._is_restarting = self._is_restarting or fault.kind == "restart"
            if fault.kind == "jump":
                self._clock_jump_ns += round(fault.amount * 1e9)
            outputs.append(EndpointStatus(EndpointPhase.STREAMING, f"fault: {fault.kind}, {fault.amount:g}"))
        return outputs

    def _filter_outputs(self, outputs: Sequence[Output[U]], now: HostTime) -> list[Output[U]]:
        passed: list[Output[U]] = []
        for output in outputs:
            passed += (
                self._faults.filter_units((output.unit,), now.monotonic_ns) if isinstance(output, Send) else [output]
            )
        return passed


def corrupt_unit(unit: Any) -> Any:
    """Return a unit with one bit flipped in its middle; one without anything in it as it is."""
    if isinstance(unit, bytes):
        middle = len(unit) // 2
        return unit[:middle] + bytes((unit[middle] ^ 0x10,)) + unit[middle + 1 :] if unit else unit
    if isinstance(unit, CanFrame):
        return replace(unit, data=corrupt_unit(unit.data))
    if isinstance(unit, Registers) and unit.values:
        return replace(unit, values=(unit.values[0] ^ 0x10, *unit.values[1:]))
    return unit


class CanEmulator(ABC, Generic[S]):
    """Base of an emulator on a CAN bus that sends samples at their stamps, with faults.

    If the first stamp is in the past when the line is first opened, all are shifted equally. A corrupt frame lacks its
    last byte. After bus_off the interface reports it, and no frame passes for `amount` seconds.
    """

    def __init__(self, text: str, samples: Iterable[S], faults: Iterable[InjectedFault]):
        """`text` is the status when the line is opened."""
        self._text = text
        self._samples: Iterator[S] = iter(samples)
        self._next: S | None = next(self._samples, None)
        self._faults = FaultQueue[CanFrame](
            faults, lambda frame: CanFrame(frame.arbitration_id, frame.data[:-1], frame.is_extended)
        )
        self._started: tuple[int, int] | None = None
        self.counts: Counter[str] = Counter()

    def on_open(self, now: HostTime) -> list[Output[CanFrame]]:
        """Start at the first opening; later the device has continued."""
        self._faults.start(now.monotonic_ns)
        if self._started is None:
            first = now.utime if self._next is None else self._next.header.utime
            self._started = (now.monotonic_ns, min(now.utime, first))
        return [EndpointStatus(EndpointPhase.STREAMING, self._text), *self.on_timer(now)]

    def on_receive(self, unit: CanFrame, now: HostTime) -> list[Output[CanFrame]]:
        return []

    def on_timer(self, now: HostTime) -> list[Output[CanFrame]]:
        """Apply the faults and send the frames that are due."""
        outputs: list[Output[CanFrame]] = []
        while (due := self.get_deadline()) is not None and due <= now.monotonic_ns:
            for fault, _ in self._faults.pop_due(due):
                if fault.kind == "bus_off":
                    outputs.append(Send(make_bus_off_frame()))
                self._on_fault(fault)
            sample = None
            if self._get_sample_ns() == due:
                sample, self._next = self._next, next(self._samples, None)
            outputs += self._faults.filter_units(self._make_frames(sample, due), due)
        return outputs

    def get_deadline(self) -> int | None:
        """Return when the next sample or fault is due, monotonic nanoseconds."""
        deadlines = (self._get_sample_ns(), self._faults.get_deadline())
        return min((each for each in deadlines if each is not None), default=None)

    def on_close(self, now: HostTime) -> list[Output[CanFrame]]:
        return []

    def _get_sample_ns(self) -> int | None:
        if self._next is None or self._started is None:
            return None
        return self._started[0] + (self._next.header.utime - self._started[1]) * 1000

    @abstractmethod
    def _on_fault(self, fault: InjectedFault) -> None:
        """Apply a fault that is the device's own."""

    @abstractmethod
    def _make_frames(self, sample: S | None, at_ns: int) -> Iterable[CanFrame]:
        """Make the frames of an instant; `sample` is the one that is due, if any."""


class SampleEmulator(ABC, Generic[S]):
    """An `Endpoint` of bytes at the device's end of a line. `samples` are in the order of their stamps.

    `latency` is the time from the instant of a sample to its first byte, seconds.
    """

    def __init__(self, samples: Iterable[S], latency: float = 0.0) -> None:
        self._samples: Iterator[S] = iter(samples)
        self._next: S | None = next(self._samples, None)
        self._latency_us = round(latency * 1e6)
        self._now: HostTime | None = None
        self.counts: Counter[str] = Counter()
        """What was sent and received, by kind."""

    @abstractmethod
    def _encode(self, sample: S) -> bytes:
        """Return what the device sends for a sample; empty for nothing."""

    def _answer(self, unit: bytes) -> Iterable[bytes]:
        """Yield the answers to received bytes."""
        return ()

    def on_open(self, now: HostTime) -> Sequence[Output[bytes]]:
        """The host's end of the line is open; a device does not notice."""
        self._now = now
        return []

    def on_receive(self, unit: bytes, now: HostTime) -> Sequence[Output[bytes]]:
        self._now = now
        return [Send(each) for each in self._answer(unit) if each]

    def on_timer(self, now: HostTime) -> Sequence[Output[bytes]]:
        """Send the samples up to now."""
        self._now = now
        out: list[Output[bytes]] = []
        while self._next is not None and self._next.header.utime + self._latency_us <= now.utime:
            if data := self._encode(self._next):
                out.append(Send(data))
            self._next = next(self._samples, None)
        return out

    def get_deadline(self) -> int | None:
        if self._now is None or self._next is None:
            return None
        return self._now.monotonic_ns + (self._next.header.utime + self._latency_us - self._now.utime) * 1000

    def on_close(self, now: HostTime) -> Sequence[Output[bytes]]:
        return []
