"""Common part of the emulators on a CAN bus: samples at their stamps, fault injection."""

from __future__ import annotations

from abc import ABC
from collections import Counter, deque
from collections.abc import Iterable, Iterator
from typing import Generic, TypeVar

from modelserver.messages import VehicleStatusSample, WheelsSample
from msdrivers.emulate import InjectedFault
from msdrivers.endpoint import HostTime, Output, Send
from msdrivers.protocol.can.frame import CanFrame, make_bus_off_frame

S = TypeVar("S", WheelsSample, VehicleStatusSample)


class CanFaultInjector:
    """Applies faults to the frames of an emulated device.

    drop: `amount` frames are lost. corrupt: `amount` frames lack their last byte. stall: no frame for `amount` seconds.
    restart: the same, and counters start at 0 afterwards. jump: counters jump by `amount` counts. bus_off: the
    interface reports bus-off, and no frame passes for `amount` seconds.
    """

    def __init__(self, faults: Iterable[InjectedFault]):
        self._faults = deque(sorted(faults, key=lambda fault: fault.at))
        self._started_ns: int | None = None
        self._silent_until_ns = 0
        self._drop = self._corrupt = 0

    def start(self, at_ns: int) -> None:
        """Set the reference time of the faults at the first call."""
        if self._started_ns is None:
            self._started_ns = at_ns

    def get_deadline(self) -> int | None:
        """Return when the next fault is due, monotonic nanoseconds."""
        if self._started_ns is None or not self._faults:
            return None
        return self._started_ns + round(self._faults[0].at * 1e9)

    def pop_due(self, at_ns: int) -> list[InjectedFault]:
        """Return the faults that are due; apply those of the line."""
        found = []
        while (due := self.get_deadline()) is not None and due <= at_ns:
            fault = self._faults.popleft()
            found.append(fault)
            if fault.kind == "drop":
                self._drop += round(fault.amount)
            elif fault.kind == "corrupt":
                self._corrupt += round(fault.amount)
            elif fault.kind in ("stall", "restart", "bus_off"):
                self._silent_until_ns = max(self._silent_until_ns, due + round(fault.amount * 1e9))
        return found

    def is_silent(self, at_ns: int) -> bool:
        """Return whether the line is silent in both directions."""
        return at_ns < self._silent_until_ns

    def filter_frames(self, frames: Iterable[CanFrame], at_ns: int) -> list[Send[CanFrame]]:
        """Return the frames that pass, after drops and corruption."""
        sent = []
        for frame in frames:
            if self.is_silent(at_ns):
                continue
            if self._drop:
                self._drop -= 1
                continue
            if self._corrupt:
                self._corrupt -= 1
                frame = CanFrame(frame.arbitration_id, frame.data[:-1], frame.is_extended)
            sent.append(Send(frame))
        return sent


class CanEmulator(ABC, Generic[S]):
    """Base of an emulator that sends samples at their stamps, with faults.

    If the first stamp is in the past when the line is first opened, all are shifted equally.
    """

    def __init__(self, samples: Iterable[S], faults: Iterable[InjectedFault]):
        self._samples: Iterator[S] = iter(samples)
        self._next: S | None = next(self._samples, None)
        self._faults = CanFaultInjector(faults)
        self._started: tuple[int, int] | None = None
        self.counts: Counter[str] = Counter()

    def on_close(self, now: HostTime) -> list[Output[CanFrame]]:
        """Send nothing."""
        return []

    def _start(self, now: HostTime) -> bool:
        """Set the reference time at the first call; return whether this is the first."""
        self._faults.start(now.monotonic_ns)
        if self._started is not None:
            return False
        first = now.utime if self._next is None else self._next.header.utime
        self._started = (now.monotonic_ns, min(now.utime, first))
        return True

    def _get_sample_ns(self) -> int | None:
        """Return when the next sample is due, monotonic nanoseconds."""
        if self._next is None or self._started is None:
            return None
        return self._started[0] + (self._next.header.utime - self._started[1]) * 1000

    def _pop_due(self, at_ns: int) -> tuple[list[InjectedFault], S | None, list[Output[CanFrame]]]:
        """Return the faults and the sample that are due, and the error frames of bus-off faults."""
        faults = self._faults.pop_due(at_ns)
        outputs: list[Output[CanFrame]] = [Send(make_bus_off_frame()) for each in faults if each.kind == "bus_off"]
        sample_ns = self._get_sample_ns()
        if sample_ns is None or sample_ns > at_ns:
            return faults, None, outputs
        sample, self._next = self._next, next(self._samples, None)
        return faults, sample, outputs
