"""Emulators of devices: each an `Endpoint` at the device's end of a line. Here: faults, and what emulators share.

Faults of emulated devices have texts, instants at which they are due, and effects on what the device sends.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, Generic, NamedTuple, TypeVar, cast

from modelserver.errors import find_nearest_names, quote
from modelserver.messages import GpsSample, ImuSample, JointsSample, VehicleStatusSample, WheelsSample
from msdrivers.endpoint import BUS_OFF_FRAME, Endpoint, EndpointPhase, EndpointStatus, HostTime, Output, Send, U

S = TypeVar("S", GpsSample, ImuSample, WheelsSample, VehicleStatusSample, JointsSample)


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


class FaultInjector(Generic[U]):
    """An `Endpoint` that wraps another and applies faults in the order of their times.

    drop: `amount` units are lost. corrupt: `amount` units are damaged. stall, restart, bus_off: nothing passes for
    `amount` seconds, then a restarted device is replaced by a new one; after bus_off the interface reports it. jump:
    the device's clock is shifted. A device may have a method `apply_fault(fault, now)`, which returns whether the fault
    is one that it applies itself. `make` returns the device as after power-on.
    """

    def __init__(self, make: Callable[[], Endpoint[U]], faults: Iterable[InjectedFault]):
        self._make = make
        self._inner = make()
        self._faults = deque(sorted(faults, key=lambda fault: fault.at))
        self._started_ns: int | None = None
        self._silent_until_ns = 0
        self._pending: Counter[str] = Counter()
        self._is_restarting = False
        self._clock_jump_ns = 0
        self._counts: Counter[str] = Counter()

    def on_open(self, now: HostTime) -> Sequence[Output[U]]:
        self._started_ns = now.monotonic_ns if self._started_ns is None else self._started_ns
        return self._filter_outputs(self._inner.on_open(self._to_device_time(now)), now)

    def on_receive(self, unit: U, now: HostTime) -> Sequence[Output[U]]:
        struck = self._apply_due_faults(now)
        if now.monotonic_ns < self._silent_until_ns:
            return struck
        return [*struck, *self._filter_outputs(self._inner.on_receive(unit, self._to_device_time(now)), now)]

    def on_timer(self, now: HostTime) -> Sequence[Output[U]]:
        outputs = self._apply_due_faults(now)
        if self._is_restarting and now.monotonic_ns >= self._silent_until_ns:
            self._is_restarting = False
            self._inner = self._make()
            outputs += self._filter_outputs(self._inner.on_open(self._to_device_time(now)), now)
        due = self._inner.get_deadline()
        if not self._is_restarting and due is not None and now.monotonic_ns + self._clock_jump_ns >= due:
            outputs += self._filter_outputs(self._inner.on_timer(self._to_device_time(now)), now)
        return outputs

    def get_deadline(self) -> int | None:
        inner = self._inner.get_deadline()
        device = None if inner is None else inner - self._clock_jump_ns
        dues = (self._silent_until_ns if self._is_restarting else device, self._get_fault_ns())
        return min((due for due in dues if due is not None), default=None)

    def on_close(self, now: HostTime) -> Sequence[Output[U]]:
        return self._filter_outputs(self._inner.on_close(self._to_device_time(now)), now)

    @property
    def counts(self) -> Mapping[str, int]:
        """The device's counters, and the units that were silenced, dropped and corrupted."""
        return {**self._inner.counts, **self._counts}

    def _to_device_time(self, now: HostTime) -> HostTime:
        return HostTime(now.monotonic_ns + self._clock_jump_ns, now.utime + self._clock_jump_ns // 1000)

    def _get_fault_ns(self) -> int | None:
        if self._started_ns is None or not self._faults:
            return None
        return self._started_ns + round(self._faults[0].at * 1e9)

    def _apply_due_faults(self, now: HostTime) -> list[Output[U]]:
        outputs: list[Output[U]] = []
        while (due := self._get_fault_ns()) is not None and due <= now.monotonic_ns:
            fault = self._faults.popleft()
            outputs.append(EndpointStatus(EndpointPhase.STREAMING, f"fault: {fault.kind}, {fault.amount:g}"))
            if fault.kind == "bus_off":
                outputs.append(cast(Send[U], Send(BUS_OFF_FRAME)))
            if fault.kind in ("stall", "restart", "bus_off"):
                self._silent_until_ns = max(self._silent_until_ns, due + round(fault.amount * 1e9))
            self._pending[fault.kind] += round(fault.amount)
            if getattr(self._inner, "apply_fault", lambda *_: False)(fault, now):
                continue
            self._is_restarting = self._is_restarting or fault.kind == "restart"
            if fault.kind == "jump":
                self._clock_jump_ns += round(fault.amount * 1e9)
        return outputs

    def _filter_outputs(self, outputs: Sequence[Output[U]], now: HostTime) -> list[Output[U]]:
        """Return what passes, some units damaged."""
        passed: list[Output[U]] = []
        for output in outputs:
            if not isinstance(output, Send):
                passed.append(output)
            elif now.monotonic_ns < self._silent_until_ns:
                self._counts["fault.silenced"] += 1
            elif self._pending["drop"] > 0:
                self._pending["drop"] -= 1
                self._counts["fault.dropped"] += 1
            elif self._pending["corrupt"] > 0:
                self._pending["corrupt"] -= 1
                self._counts["fault.corrupted"] += 1
                passed.append(Send(corrupt_unit(output.unit)))
            else:
                passed.append(output)
        return passed


def corrupt_unit(unit: Any) -> Any:
    """Return bytes with one bit flipped in their middle, a CAN frame or registers without the last one.

    What is empty stays.
    """
    if isinstance(unit, bytes):
        middle = len(unit) // 2
        return unit[:middle] + bytes((unit[middle] ^ 0x10,)) + unit[middle + 1 :] if unit else unit
    field = next((each for each in ("data", "values") if hasattr(unit, each)), None)
    return unit if field is None else replace(unit, **{field: getattr(unit, field)[:-1]})


class SampleEmulator(Generic[S, U]):
    """An `Endpoint` at the device's end of a line. `samples` are in the order of their stamps.

    `latency` is the time from the instant of a sample to its first byte, seconds.
    """

    def __init__(self, samples: Iterable[S], latency: float = 0.0) -> None:
        self._samples: Iterator[S] = iter(samples)
        self._next: S | None = next(self._samples, None)
        self._first_utime = 0 if self._next is None else self._next.header.utime
        self._latency_us = round(latency * 1e6)
        self._now: HostTime | None = None
        self.counts: Counter[str] = Counter()
        """What was sent and received, by kind."""

    def _encode(self, sample: S) -> Iterable[U]:
        """Return the units that the device sends for a sample; empty ones are not sent."""
        return ()

    def _answer(self, unit: U) -> Iterable[U]:
        """Yield the answers to a received unit."""
        return ()

    def on_open(self, now: HostTime) -> Sequence[Output[U]]:
        """The host's end of the line is open; a device does not notice."""
        self._now = now
        return []

    def on_receive(self, unit: U, now: HostTime) -> Sequence[Output[U]]:
        self._now = now
        return [Send(each) for each in self._answer(unit) if each]

    def on_timer(self, now: HostTime) -> Sequence[Output[U]]:
        self._now = now
        out: list[Output[U]] = []
        while self._next is not None and self._next.header.utime + self._latency_us <= now.utime:
            out += [Send(each) for each in self._encode(self._next) if each]
            self._next = next(self._samples, None)
        return out

    def get_deadline(self) -> int | None:
        if self._now is None or self._next is None:
            return None
        return self._now.monotonic_ns + (self._next.header.utime + self._latency_us - self._now.utime) * 1000

    def on_close(self, now: HostTime) -> Sequence[Output[U]]:
        return []
