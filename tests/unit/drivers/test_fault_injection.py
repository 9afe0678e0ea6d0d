"""A device to which faults happen, whatever it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import pytest

from msdrivers.emulate import FAULT_AMOUNTS, FaultInjector, InjectedFault, corrupt_unit, parse_fault
from msdrivers.endpoint import CanFrame, EndpointPhase, EndpointStatus, HostTime, Output, ReadRegisters, Registers, Send

TENTH_NS = 100_000_000


@dataclass
class Ticker:
    """A device that sends its own time in tenths of a second, ten times a second, and echoes what it receives."""

    number: int
    next_ns: int = 0
    received: list[bytes] = field(default_factory=list)

    def on_open(self, now: HostTime) -> Sequence[Output[bytes]]:
        self.next_ns = now.monotonic_ns + TENTH_NS
        return [EndpointStatus(EndpointPhase.STREAMING, f"device {self.number}")]

    def on_receive(self, unit: bytes, now: HostTime) -> Sequence[Output[bytes]]:
        self.received.append(unit)
        return [Send(unit)]

    def on_timer(self, now: HostTime) -> Sequence[Output[bytes]]:
        self.next_ns += TENTH_NS
        return [Send(b"%d" % (now.monotonic_ns // TENTH_NS))]

    def get_deadline(self) -> int | None:
        return self.next_ns

    def on_close(self, now: HostTime) -> Sequence[Output[bytes]]:
        return [Send(b"bye")]

    @property
    def counts(self) -> dict[str, int]:
        return {"received": len(self.received)}


class Bench:
    """Runs a device with faults and records its output with the time in tenths of a second."""

    def __init__(self, *faults: InjectedFault):
        self.made: list[Ticker] = []
        self.station: FaultInjector[bytes] = FaultInjector(self._make, faults)
        self.sent: list[tuple[int, bytes]] = []
        self.statuses: list[str] = []
        self.now = HostTime(0, 0)
        self._take(self.station.on_open(self.now))

    def until(self, tenths: int) -> Bench:
        while (due := self.station.get_deadline()) is not None and due <= tenths * TENTH_NS:
            at_ns = max(due, self.now.monotonic_ns)
            self.now = HostTime(at_ns, at_ns // 1000)
            self._take(self.station.on_timer(self.now))
        self.now = HostTime(tenths * TENTH_NS, tenths * TENTH_NS // 1000)
        return self

    def receive(self, unit: bytes) -> None:
        self._take(self.station.on_receive(unit, self.now))

    def _make(self) -> Ticker:
        self.made.append(Ticker(len(self.made)))
        return self.made[-1]

    def _take(self, outputs: Sequence[Output[bytes]]) -> None:
        for output in outputs:
            if isinstance(output, Send):
                self.sent.append((self.now.monotonic_ns // TENTH_NS, output.unit))
            elif isinstance(output, EndpointStatus):
                self.statuses.append(output.text)


def make_units(*tenths: int) -> list[tuple[int, bytes]]:
    return [(n, b"%d" % n) for n in tenths]


def test_given_no_fault_then_the_device_is_as_it_is() -> None:
    bench = Bench().until(5)
    bench.receive(b"x")
    assert bench.sent == [*make_units(1, 2, 3, 4, 5), (5, b"x")]
    assert bench.station.counts == {"received": 1}
    assert [output.unit for output in bench.station.on_close(bench.now) if isinstance(output, Send)] == [b"bye"]


def test_given_drops_then_so_many_units_are_lost() -> None:
    bench = Bench(InjectedFault(0.25, "drop", 2)).until(7)
    assert bench.sent == make_units(1, 2, 5, 6, 7)
    assert bench.station.counts["fault.dropped"] == 2
    assert "fault: drop, 2" in bench.statuses


def test_given_damage_then_so_many_units_differ() -> None:
    bench = Bench(InjectedFault(0.25, "corrupt", 1)).until(4)
    assert bench.sent == [*make_units(1, 2), (3, corrupt_unit(b"3")), (4, b"4")]
    assert bench.station.counts["fault.corrupted"] == 1


def test_given_a_stall_then_nothing_is_sent_or_received_and_the_device_goes_on_afterwards() -> None:
    bench = Bench(InjectedFault(0.25, "stall", 0.3)).until(4)
    bench.receive(b"lost")
    bench.until(8)
    assert bench.sent == make_units(1, 2, 6, 7, 8)
    assert bench.made[0].received == []
    assert len(bench.made) == 1


def test_given_a_restart_then_the_device_is_replaced_after_that_time() -> None:
    bench = Bench(InjectedFault(0.25, "restart", 0.5)).until(4)
    bench.receive(b"lost")
    bench.until(10)
    assert len(bench.made) == 2
    assert bench.statuses[-1] == "device 1"
    # it was powered on at 0.75 s, and sends first a tenth of a second later
    assert bench.sent == make_units(1, 2, 8, 9)
    assert bench.station.counts["received"] == 0


def test_given_a_jump_then_its_time_is_ahead_from_then_on() -> None:
    bench = Bench(InjectedFault(0.25, "jump", 1.0)).until(4)
    ahead = [int(unit) - tenth for tenth, unit in bench.sent]
    assert ahead[:2] == [0, 0]
    assert set(ahead[2:]) == {10}


def test_given_faults_in_any_order_then_each_comes_in_its_time() -> None:
    bench = Bench(InjectedFault(0.55, "drop"), InjectedFault(0.15, "drop")).until(8)
    assert bench.sent == make_units(1, 3, 4, 5, 7, 8)


@pytest.mark.parametrize("unit", [b"\x00", b"some bytes"], ids=["one", "b"])
def test_given_a_unit_when_damaged_then_one_bit_differs_and_nothing_else(unit: object) -> None:
    spoilt = corrupt_unit(unit)
    assert type(spoilt) is type(unit)
    assert spoilt != unit
    assert corrupt_unit(spoilt) == unit


def test_given_a_frame_or_registers_when_damaged_then_they_are_shorter() -> None:
    assert corrupt_unit(CanFrame(256, b"\x01\x02")) == CanFrame(256, b"\x01")
    assert corrupt_unit(Registers(3, (7, 8), 1)) == Registers(3, (7,), 1)


@pytest.mark.parametrize("unit", [b"", Registers(3, (), 1), ReadRegisters(0, 2)])
def test_given_a_unit_without_content_then_it_stays(unit: object) -> None:
    assert corrupt_unit(unit) == unit


@pytest.mark.parametrize(
    ("text", "fault"),
    [("stall@10:2", InjectedFault(10.0, "stall", 2.0)), ("drop@0.5", InjectedFault(0.5, "drop", 1.0))],
)
def test_given_a_text_then_it_is_the_fault(text: str, fault: InjectedFault) -> None:
    assert parse_fault(text, FAULT_AMOUNTS) == fault


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("stall", "KIND@SECONDS"),
        ("stal@3", "did you mean stall?"),
        ("flood@3", "there are, with their amounts"),
        ("stall@soon", "SECONDS[:AMOUNT]"),
        ("stall@-1", "seconds are 0 or more"),
        ("stall@1:0", "an amount is above 0"),
        ("stall@nan", "seconds are 0 or more"),
    ],
)
def test_given_a_text_that_is_no_fault_then_the_reason_is_reported(text: str, expected: str) -> None:
    with pytest.raises(ValueError, match=expected.replace("[", r"\[").replace("?", r"\?")):
        parse_fault(text)
