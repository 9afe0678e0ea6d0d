"""Faults of emulated devices: when they are due, and what they do to what the device sends."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Generic, NamedTuple, TypeVar

from modelserver.messages import VehicleStatusSample, WheelsSample
from msdrivers.endpoint import EndpointPhase, EndpointStatus, HostTime, Output, Send
from msdrivers.protocol.can.frame import CanFrame, make_bus_off_frame

U = TypeVar("U")
S = TypeVar("S", WheelsSample, VehicleStatusSample)


class InjectedFault(NamedTuple):
    """A fault `at` seconds after the start; the meaning of `amount` depends on the kind."""

    at: float
    kind: str
    amount: float = 1.0


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
        """Ignore received frames."""
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
        """Send nothing."""
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
