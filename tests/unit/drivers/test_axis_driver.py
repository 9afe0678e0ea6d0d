"""The driver of the nodding axis against the emulated one: angles at 50 Hz and more, nodding, and what goes wrong."""

from __future__ import annotations

import gc
import math
import random
import re
import tracemalloc
from typing import Any

import pytest
from support_vehicle_bus import AXIS_REGISTERS, DEG, START_UTIME, Wire, at, axis_settings

from modelserver.messages import DriverHealth, DriverPhase, JointsSample
from msdrivers.devices.axis import AxisDriver, AxisRegisters, AxisSettings, NodSettings, RegisterMap
from msdrivers.emulate import FaultInjector, InjectedFault
from msdrivers.emulate.vehicle import AxisEmulator, AxisUnit
from msdrivers.endpoint import (
    EndpointPhase,
    HostTime,
    MeasuredSample,
    ModbusFailure,
    ModbusUnit,
    ReadRegisters,
    Registers,
    RegistersWritten,
    Reopen,
    Send,
    WriteRegisters,
)
from msdrivers.links.fake import FakeLink, FakeTimeSource
from msdrivers.runner import Runner, RunnerSettings

STEP = 0.072 * DEG


def connect(
    *faults: InjectedFault, settings: AxisSettings | None = None, unit: AxisUnit | None = None, flight_s: float = 0.001
) -> tuple[Wire[ModbusUnit], AxisDriver, AxisEmulator]:
    settings = settings or axis_settings()
    driver = AxisDriver(settings)
    emulator = AxisEmulator(settings.registers, unit)
    return Wire(driver, FaultInjector(lambda: emulator, faults), flight_s=flight_s), driver, emulator


def joints(wire: Wire[ModbusUnit], begin: float = 0.0) -> list[JointsSample]:
    found = wire.values(begin)
    assert all(isinstance(each, JointsSample) for each in found)
    return found  # type: ignore[return-value]


def degrees(wire: Wire[ModbusUnit], begin: float = 0.0) -> list[float]:
    return [sample.joints[0].position / DEG for sample in joints(wire, begin)]


# --- reading ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("flight_s", "poll_hz", "least"), [(0.001, 100.0, 100), (0.004, 60.0, 60), (0.008, 50.0, 50)])
def test_given_a_nodding_axis_then_angles_come_at_50_hz_or_more_and_are_true(
    flight_s: float, poll_hz: float, least: int
) -> None:
    wire, driver, _ = connect(settings=axis_settings(poll_hz=poll_hz), flight_s=flight_s)
    wire.run(21.0)
    samples = [(t, measured) for t, measured in wire.samples if 1.0 <= t < 21.0]
    assert len(samples) >= 20 * least
    assert driver.counts["skipped"] == 0
    angles = degrees(wire, 1.0)
    assert min(angles) == pytest.approx(-30.24, abs=0.46)
    assert max(angles) == pytest.approx(20.16, abs=0.46)
    for sample in joints(wire, 1.0):
        (joint,) = sample.joints
        assert joint.name == "FrontNodding"
        assert joint.position / STEP == pytest.approx(round(joint.position / STEP), abs=1e-6)
        assert joint.position_sigma == pytest.approx(STEP / math.sqrt(12.0))
        assert abs(joint.rate) == pytest.approx(45.0 * DEG)
    steps = [
        (b.joints[0].position - a.joints[0].position) / ((b.header.utime - a.header.utime) * 1e-6) / DEG
        for a, b in zip(joints(wire, 1.0), joints(wire, 1.0)[1:], strict=False)
    ]
    # between two turning points
    assert sorted(map(abs, steps))[len(steps) // 2] == pytest.approx(45.0, rel=0.2)


@pytest.mark.parametrize("rate", [2.0, 30.0, 90.0])
def test_given_the_lowest_and_the_highest_rate_then_the_axis_turns_so(rate: float) -> None:
    wire, _, emulator = connect(settings=axis_settings(nod=NodSettings(-20.16, 20.16, rate)))
    wire.run(3.0)
    assert emulator.commanded["nod_rate"] == rate
    # per stretch without a turning point
    samples = [(sample.header.utime * 1e-6, sample.joints[0]) for sample in joints(wire, 0.5)]
    for (t1, a), (t2, b) in zip(samples, samples[20:], strict=False):
        if all(math.copysign(1.0, each.rate) == math.copysign(1.0, a.rate) for t, each in samples if t1 <= t <= t2):
            assert abs(b.position - a.position) / (t2 - t1) / DEG == pytest.approx(rate, abs=0.072 / 0.2 + 0.02 * rate)


def test_given_the_time_of_a_turn_then_the_delay_is_its_half() -> None:
    wire, _, _ = connect(flight_s=0.003)
    wire.run(1.0)
    for t, measured in wire.samples:
        assert measured.sample.header.host_utime == START_UTIME + round(t * 1e6)
        assert measured.delay == pytest.approx(0.003, abs=1e-9)
        assert measured.delay_sigma == pytest.approx(0.006 / math.sqrt(12.0), abs=1e-9)


def test_given_an_axis_that_measures_more_slowly_than_it_is_read_then_nothing_is_published_twice() -> None:
    wire, driver, _ = connect(unit=AxisUnit(measure_hz=25.0))
    wire.run(2.0)
    assert 45 <= len(wire.samples) <= 51
    assert driver.counts["repeated"] > 100


def test_given_no_rate_and_no_number_then_rate_is_nan() -> None:
    registers = AxisRegisters(RegisterMap(7, scale_deg=0.072), table="input")
    wire, driver, _ = connect(settings=axis_settings(registers=registers, nod=None), unit=AxisUnit(angle_deg=7.2))
    wire.run(1.0)
    assert degrees(wire)[0] == pytest.approx(7.2)
    assert math.isnan(joints(wire)[0].joints[0].rate)
    assert wire.sent[0][1] == ReadRegisters(7, 1, "input", 1)
    assert driver.on_close(at(1.0)) == []


# --- nodding ---------------------------------------------------------------------------------------------------


def test_given_a_nodding_motion_then_it_is_written_read_back_and_reported() -> None:
    wire, driver, emulator = connect()
    wire.run(0.5)
    assert emulator.commanded == pytest.approx({"lower_limit": -30.24, "upper_limit": 20.16, "nod_rate": 45.0})
    assert "the nodding motion is set" in wire.status_text()
    # measuring does not wait for the set-up
    assert wire.samples[0][0] < 0.01
    assert driver.counts.get("readback", 0) == 0


def test_given_other_nodding_motions_then_limits_never_cross_on_the_way() -> None:
    before = (-15.0, 15.0)
    for lower, upper in [(36.0, 72.0), (-72.0, -36.0), (-3.6, 3.6), (7.2, 14.4)]:
        unit, nod = AxisUnit(*before, angle_deg=before[0]), NodSettings(lower, upper, 90.0)
        wire, _, emulator = connect(settings=axis_settings(nod=nod), unit=unit)
        wire.run(4.0)
        assert emulator.commanded["lower_limit"] == pytest.approx(lower)
        assert emulator.commanded["upper_limit"] == pytest.approx(upper)
        angles = degrees(wire, wire.t - 1.5)
        assert (min(angles), max(angles)) == (pytest.approx(lower, abs=1.0), pytest.approx(upper, abs=1.0))
        assert emulator.counts["exceptions"] == 0
        steps = [b - a for (a, _), (b, _) in zip(wire.samples, wire.samples[1:], strict=False)]
        assert max(steps) < 0.02
        before = (lower, upper)


@pytest.mark.parametrize(
    ("nod", "expected"),
    [
        (NodSettings(-10.0, 10.0, 1.0), "rate_deg 1 is not 2 to 90 deg/s, or 0 (stationary)"),
        (NodSettings(-10.0, 10.0, 91.0), "rate_deg 91 is not"),
        (NodSettings(-100.0, 10.0, 30.0), "-100 to 10 degrees is not within -90 to 90"),
    ],
)
def test_given_a_motion_that_the_axis_cannot_do_then_it_is_rejected(nod: NodSettings, expected: str) -> None:
    with pytest.raises(ValueError, match=re.escape(f"nod cannot be done: {expected}")):
        axis_settings(nod=nod)


def test_given_rate_zero_then_the_axis_is_stationary_and_measured() -> None:
    settings = axis_settings(nod=NodSettings(-30.24, 20.16, 0.0))
    wire, _, _ = connect(settings=settings, unit=AxisUnit(rate_deg=30.0))
    wire.run(2.0)
    assert len(set(degrees(wire))) > 1
    assert len(set(degrees(wire, 1.1))) == 1
    assert len(wire.samples) > 190


def test_given_limits_that_the_axis_does_not_take_then_it_is_reported_and_measured_on() -> None:
    wire, driver, _ = connect(unit=AxisUnit(lowest_deg=-20.0, highest_deg=20.0))
    wire.run(2.0)
    assert (
        "the axis rejects writing -30.24 to lower_limit (register 16): exception 3: it does not take"
        in wire.status_text()
    )
    assert wire.status_text().count("rejects") == 1
    assert driver.counts["rejected.exception_3"] == 1
    assert len(wire.samples) > 190


def test_given_an_axis_that_takes_another_limit_than_written_then_it_is_reported() -> None:
    wire, driver, _ = connect()

    def spoil(unit: ModbusUnit, t: float) -> list[ModbusUnit]:
        if isinstance(unit, Registers) and unit.address == 18 and len(wire.sent) > 8:
            return [Registers(18, AXIS_REGISTERS.commanded["upper_limit"].from_degrees(14.4), unit.transaction)]
        return [unit]

    wire.corrupt = spoil
    wire.run(1.0)
    assert "upper_limit is 14.4 where 20.16 was written" in wire.status_text()
    assert driver.counts["readback"] == 1


def test_given_that_the_driver_leaves_then_the_axis_is_as_it_was_found() -> None:
    found = AxisUnit(lower_deg=36.0, upper_deg=54.0, rate_deg=10.0, angle_deg=40.0)
    wire, driver, emulator = connect(unit=found)
    wire.run(3.0)
    assert emulator.commanded["lower_limit"] == pytest.approx(-30.24)
    for output in driver.on_close(at(3.0)):
        assert isinstance(output, Send)
        (reply,) = emulator.on_receive(output.unit, at(3.0))
        assert isinstance(reply, Send)
        assert isinstance(reply.unit, RegistersWritten)
    assert emulator.commanded == pytest.approx({"lower_limit": 36.0, "upper_limit": 54.0, "nod_rate": 10.0})
    assert driver.get_deadline() is None


# --- what goes wrong -------------------------------------------------------------------------------------------


def test_given_replies_that_are_lost_then_no_reading_is_published_twice_and_reading_goes_on() -> None:
    wire, driver, _ = connect(InjectedFault(2.0, "drop", 3))
    wire.run(4.0)
    assert driver.counts["unanswered"] == 3
    assert not [t for t, _ in wire.samples if 2.02 < t < 2.29]
    assert wire.samples[-1][0] > 3.98
    assert [reopen for _, reopen in wire.reopens] == []


def test_given_silence_then_the_line_is_reopened_and_the_axis_set_up_again() -> None:
    wire, driver, emulator = connect(InjectedFault(2.0, "restart", 3.0))
    wire.run(8.0)
    assert wire.reopens
    assert "has not answered for 1 s; check its power, the network cable, address and port" in wire.status_text()
    assert not [t for t, _ in wire.samples if 2.01 < t < 5.0]
    assert emulator.commanded["nod_rate"] == 45.0
    assert wire.samples[-1][0] > 7.98
    assert [status.phase for _, status in wire.statuses][-1] is EndpointPhase.STREAMING
    # what was found first is what is left
    left = [output.unit for output in driver.on_close(at(8.0)) if isinstance(output, Send)]
    assert all(isinstance(unit, WriteRegisters) for unit in left)
    assert len({unit.transaction for unit in left}) == 3
    assert (left[2].address, left[2].values) == (20, (0,))  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("code", "expected"),
    [(2, "it has no such register"), (6, "it is busy"), (77, "a code that the standard does not have")],
)
def test_given_exceptions_then_they_are_reported_once_in_words_and_tried_again(code: int, expected: str) -> None:
    wire, driver, _ = connect(*[InjectedFault(2.0, "exception", code)] * 3)
    wire.run(6.0)
    assert wire.status_text().count(expected) == 1
    assert driver.counts[f"rejected.exception_{code}"] == 3
    assert not [t for t, _ in wire.samples if 2.01 < t < 3.4]
    assert wire.samples[-1][0] > 5.98


def test_given_an_axis_that_rejects_to_be_read_then_the_rejection_is_reported_when_nothing_usable_came() -> None:
    driver = AxisDriver(axis_settings(nod=None))
    time = FakeTimeSource()
    link: FakeLink[ModbusUnit] = FakeLink(time)
    send = link.send

    def refuses(unit: ModbusUnit) -> None:
        send(unit)
        at_s = time.monotonic_ns * 1e-9 + 0.001
        link.incoming.append((at_s, ModbusFailure(code=2, transaction=unit.transaction)))

    link.send = refuses  # type: ignore[method-assign]
    reports: list[DriverHealth] = []
    runner = Runner(driver, link, RunnerSettings("axis", "axis"), time, publish_health=reports.append)
    while time.monotonic_ns < 4_000_000_000:
        runner.run_once()
    assert reports[-1].phase is DriverPhase.SILENT
    assert "no usable reading for 1 s although the axis answers" in reports[-1].text
    assert "before that: the axis rejects reading 4 holding registers from 0: exception 2" in reports[-1].text


def test_given_an_axis_that_is_busy_while_it_is_set_up_then_it_is_tried_again() -> None:
    wire, driver, emulator = connect(InjectedFault(0.0, "exception", 6), InjectedFault(0.0, "exception", 6))
    wire.run(3.0)
    assert emulator.commanded["nod_rate"] == 45.0
    assert driver.counts["rejected.exception_6"] == 2
    first, second, *_ = [t for t, unit in wire.sent if getattr(unit, "address", 0) == 16]
    assert second - first == pytest.approx(0.502)


def test_given_wrong_lengths_then_they_are_reported_once_and_not_used() -> None:
    wire, driver, _ = connect(InjectedFault(2.0, "corrupt", 5))
    wire.run(4.0)
    assert driver.counts["rejected.length"] == 5
    assert wire.status_text().count("another address or length") == 1


def test_given_an_angle_that_jumps_then_one_reading_is_rejected() -> None:
    wire, driver, _ = connect(InjectedFault(2.0, "jump", -30.0))
    wire.run(4.0)
    assert driver.counts["rejected.jump"] == 1
    assert "an angle that the axis cannot have reached" in wire.status_text()


def test_given_replies_that_do_not_belong_to_the_request_then_they_are_not_used() -> None:
    driver = AxisDriver(axis_settings(nod=None))
    (_, request) = driver.on_open(at(0.0))
    assert request == Send(ReadRegisters(0, 4, "holding", 1))
    assert driver.on_receive(Registers(0, (0, 0, 0, 1), 7), at(0.001)) == []
    assert driver.counts["rejected.stale"] == 1
    assert any(isinstance(each, MeasuredSample) for each in driver.on_receive(Registers(0, (0, 0, 0, 1), 1), at(0.002)))
    assert driver.on_receive(Registers(0, (0, 0, 0, 2), 1), at(0.003)) == []


def test_given_a_line_that_breaks_then_it_is_reopened_once() -> None:
    driver = AxisDriver(axis_settings())
    driver.on_open(at(0.0))
    broken = ModbusFailure("connection reset by the device")
    (status, reopen) = driver.on_receive(broken, at(0.1))
    assert isinstance(reopen, Reopen)
    assert "connection reset by the device" in status.text  # type: ignore[union-attr]
    assert driver.on_receive(broken, at(0.2)) == []
    assert driver.get_deadline() is None


@pytest.mark.parametrize(
    ("kind", "order", "words", "number"),
    [
        # 123456.0 is 0x47F12000 in IEEE 754
        ("float32", None, (0x47F1, 0x2000), 123456.0),
        ("float32", "ABCD", (0x47F1, 0x2000), 123456.0),
        ("float32", "CDAB", (0x2000, 0x47F1), 123456.0),
        ("float32", "BADC", (0xF147, 0x0020), 123456.0),
        ("float32", "DCBA", (0x0020, 0xF147), 123456.0),
        ("int32", "CDAB", (0xFFFE, 0xFFFF), -2),
        ("uint32", "DCBA", (0x0403, 0x0201), 0x01020304),
        ("int16", "ABCD", (0xFFFE,), -2),
        ("uint16", "BADC", (0x0201,), 0x0102),
        ("uint16", "DCBA", (0x0201,), 0x0102),
        ("uint16", "CDAB", (0x0102,), 0x0102),
    ],
)
def test_given_a_type_and_an_order_of_bytes_then_numbers_are_read_and_written_so(
    kind: Any, order: Any, words: tuple[int, ...], number: float
) -> None:
    mapped = RegisterMap(0, type=kind, order=order)
    assert mapped.to_number(words) == number
    assert mapped.to_words(number) == words


def test_given_an_axis_of_floats_then_it_nods_and_its_angles_are_published() -> None:
    def real(address: int, scale_deg: float = math.degrees(1.0)) -> RegisterMap:
        return RegisterMap(address, type="float32", order="CDAB", scale_deg=scale_deg)

    registers = AxisRegisters(
        real(0), real(2), RegisterMap(4, type="uint32", order="DCBA"),
        lower_limit=real(16), upper_limit=real(18), nod_rate=real(20),
    )  # fmt: skip
    wire, driver, emulator = connect(settings=axis_settings(registers=registers))
    wire.run(5.0)
    assert len(joints(wire, 1.0)) > 350
    assert min(degrees(wire, 1.0)) == pytest.approx(-30.24, abs=0.46)
    assert max(degrees(wire, 1.0)) == pytest.approx(20.16, abs=0.46)
    assert all(abs(each.joints[0].rate) == pytest.approx(45.0 * DEG) for each in joints(wire, 1.0))
    assert emulator.commanded == pytest.approx({"lower_limit": -30.24, "upper_limit": 20.16, "nod_rate": 45.0})
    assert not driver.counts["readback"]
    assert not any(name.startswith("rejected") for name in driver.counts)


@pytest.mark.parametrize("words", [(0x7FC0, 0), (0x7F80, 0), (0xFF80, 0)])
def test_given_a_float_that_is_not_finite_then_it_is_no_angle(words: tuple[int, int]) -> None:
    registers = AxisRegisters(RegisterMap(0, type="float32"))
    driver = AxisDriver(axis_settings(registers=registers, nod=None))
    driver.on_open(at(0.0))
    driver.on_receive(Registers(0, words, 1), at(0.001))
    assert driver.counts["rejected.range"] == 1
    registers = AxisRegisters(RegisterMap(0, type="float32"), RegisterMap(2, type="float32"))
    driver = AxisDriver(axis_settings(registers=registers, nod=None))
    driver.on_open(at(0.0))
    (*_, measured) = (
        each
        for each in driver.on_receive(Registers(0, (0, 0, *words), 1), at(0.001))
        if isinstance(each, MeasuredSample)
    )
    assert math.isnan(measured.sample.joints[0].rate)  # type: ignore[union-attr]


def test_given_registers_of_another_scale_then_angles_out_of_range_are_reported() -> None:
    registers = AxisRegisters(RegisterMap(0, 2, high_word_first=False, scale_deg=0.072))
    driver = AxisDriver(axis_settings(registers=registers, nod=None))
    driver.on_open(at(0.0))
    (status, *_) = driver.on_receive(Registers(0, (0, 100), 1), at(0.001))
    assert "are scale_deg, is_signed and high_word_first right?" in status.text  # type: ignore[union-attr]
    now = at(1.0)
    assert any("although the axis answers" in getattr(each, "text", "") for each in driver.on_timer(now))


@pytest.mark.slow
def test_given_random_replies_then_nothing_is_raised_and_memory_stays_flat() -> None:
    rng = random.Random(5)
    driver = AxisDriver(axis_settings())
    driver.on_open(at(0.0))

    def reply(transaction: int) -> ModbusUnit:
        kind = rng.randrange(6)
        if kind == 0:
            return ModbusFailure("x" * rng.randrange(99), rng.randrange(1, 256), transaction)
        if kind == 1:
            return RegistersWritten(rng.choice((16, 18, 20)), rng.randrange(4), transaction)
        if kind == 2:
            return ReadRegisters(0, 4, "holding", transaction)
        words = tuple(
            rng.choice((0, 1, 0xFFFF, 70_000, -1, rng.randrange(1 << 16))) for _ in range(rng.choice((1, 2, 4, 200)))
        )
        return Registers(rng.choice((0, 16, 18, 20)), words, transaction)

    def flood(begin: int, count: int) -> None:
        transaction = 1
        for n in range(begin, begin + count):
            now: HostTime = at(0.004 * n)
            outputs = driver.on_receive(reply(rng.choice((transaction, transaction, 0))), now) + driver.on_timer(now)
            for output in outputs:
                if isinstance(output, Send):
                    assert isinstance(output.unit, ReadRegisters | WriteRegisters)
                    transaction = output.unit.transaction
                elif isinstance(output, Reopen):
                    outputs += driver.on_open(now)
                elif isinstance(output, MeasuredSample):
                    assert isinstance(output.sample, JointsSample)
                    assert abs(output.sample.joints[0].position) <= 90.1 * DEG

    flood(0, 2_000)
    tracemalloc.start()
    try:
        flood(2_000, 1_000)
        gc.collect()
        before, _ = tracemalloc.get_traced_memory()
        flood(3_000, 5_000)
        gc.collect()
        after, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert after - before < 65_536
    assert len(driver.counts) < 300


# --- the emulated axis, and settings -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("request_", "code"),
    [
        (ReadRegisters(100, 1, transaction=4), 2),
        (ReadRegisters(0, 0, transaction=4), 2),
        (ReadRegisters(0, 126, transaction=4), 2),
        (ReadRegisters(0, 4, "input", 4), 2),
        (WriteRegisters(0, (1, 2), 4), 2),
        (WriteRegisters(20, (100,), 4), 3),
        (WriteRegisters(16, (0, 5000), 4), 3),
    ],
)
def test_given_a_request_that_the_axis_does_not_take_then_it_answers_with_the_exception(
    request_: ModbusUnit, code: int
) -> None:
    emulator = AxisEmulator(AXIS_REGISTERS)
    emulator.on_open(at(0.0))
    (reply,) = emulator.on_receive(request_, at(0.1))
    assert isinstance(reply, Send)
    assert isinstance(reply.unit, ModbusFailure)
    assert (reply.unit.code, reply.unit.transaction) == (code, 4)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"joint": ""}, "joint is the name"),
        ({"poll_hz": 49.0}, "poll_hz is between 50 and 1000"),
        ({"silence": math.nan}, "silence is between"),
        ({"lowest_deg": 95.0}, "lowest_deg is below highest_deg"),
        ({"slowest_deg": 100.0}, "slowest_deg is at most fastest_deg"),
        ({"nod": NodSettings(-1.0, 1.0, 700.0), "fastest_deg": 900.0}, "the registers of nod_rate cannot hold 700"),
        ({"registers": AxisRegisters(RegisterMap(0))}, "nod cannot be done: registers names no lower_limit"),
    ],
)
def test_given_settings_that_cannot_be_then_the_key_is_named(changes: dict[str, object], expected: str) -> None:
    with pytest.raises(ValueError, match=expected):
        axis_settings(**changes)


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (lambda: RegisterMap(0, 3), "registers is one of 1, 2"),
        (lambda: RegisterMap(-1), "address is 0 to 65535"),
        (lambda: RegisterMap(65535, 2), "address is 0 to 65534"),
        (lambda: RegisterMap(40001, scale_deg=0.0), "scale_deg is a number and not 0"),
        (lambda: RegisterMap(0, offset_deg=math.nan), "offset_deg is a number"),
        (lambda: RegisterMap(0, type="float64"), "type is one of int16, uint16, int32, uint32, float32, got 'float64'"),  # type: ignore[arg-type]
        (lambda: RegisterMap(0, order="ACBD"), "order is one of ABCD, CDAB, BADC, DCBA, got 'ACBD'"),  # type: ignore[arg-type]
        (lambda: RegisterMap(65535, type="float32"), "address is 0 to 65534"),
        (lambda: RegisterMap(0, 2, type="int16"), "registers is left out with type: int16 has 1, got 2"),
        (lambda: RegisterMap(0, is_signed=False, type="int32"), "is_signed is left out with type: int32 is signed"),
        (lambda: RegisterMap(0, high_word_first=False, order="BADC"), "high_word_first is left out with order"),
        (lambda: NodSettings(1.0, 1.0), "lower_deg is below upper_deg"),
        (lambda: AxisRegisters(RegisterMap(0), RegisterMap(125)), "lie 126 registers apart; at most 125"),
        (lambda: AxisRegisters(RegisterMap(0), nod_rate=RegisterMap(1)), "given together"),
        (lambda: AxisRegisters(RegisterMap(0), table="coils"), "table is one of holding, input"),  # type: ignore[arg-type]
    ],
)
def test_given_registers_that_cannot_be_then_the_key_is_named(make: object, expected: str) -> None:
    with pytest.raises(ValueError, match=expected):
        make()  # type: ignore[operator]
