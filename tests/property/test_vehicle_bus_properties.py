"""CAN and Modbus on any numbers: what goes in comes out, and nothing but what is announced is raised."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support_vehicle_bus import (
    AXIS_REGISTERS,
    DBC,
    DEG,
    RAPTOR_COMMAND,
    at,
    raptor_dbc,
    vehicle_settings,
    wheels_settings,
)

from modelserver.errors import ConfigError
from modelserver.messages import VehicleCommand, VehicleStatusSample, WheelsSample
from msdrivers.devices.axis import RegisterMap
from msdrivers.devices.can import parse_dbc
from msdrivers.devices.vehicle import VehicleDriver, bind_command
from msdrivers.devices.wheels import Odometer, WheelsDriver
from msdrivers.emulate.vehicle import AxisEmulator, AxisUnit
from msdrivers.endpoint import CanFrame, MeasuredSample, ReadRegisters, Registers, Send

DATABASE = raptor_dbc()
COMMAND = bind_command(RAPTOR_COMMAND, DATABASE, "command")

maps = st.builds(
    RegisterMap,
    st.integers(0, 60_000),
    st.sampled_from((1, 2)),
    st.booleans(),
    st.booleans(),
    st.floats(1e-3, 10.0).flatmap(lambda scale: st.sampled_from((scale, -scale))),
    st.floats(-360.0, 360.0),
    st.none(),
    st.sampled_from((None, "CDAB", "DCBA")),
)
frames = st.builds(
    CanFrame,
    st.sampled_from((0x100, 0x101, 0x200, 0x201, 0x300, 0x7FF)),
    st.one_of(st.binary(min_size=8, max_size=8), st.binary(min_size=4, max_size=4), st.binary(max_size=64)),
    st.booleans(),
    st.booleans(),
)


@given(maps, st.data())
def test_given_any_whole_number_when_written_to_registers_then_it_is_read_again(
    mapped: RegisterMap, data: st.DataObject
) -> None:
    number = data.draw(st.integers(mapped.lowest, mapped.highest))
    words = mapped.to_words(number)
    assert len(words) == mapped.word_count
    assert all(0 <= word <= 0xFFFF for word in words)
    assert mapped.to_number(words) == number
    assert mapped.to_degrees(mapped.from_degrees(mapped.to_degrees(words))) == pytest.approx(
        mapped.to_degrees(words), abs=1e-6
    )


@given(maps)
def test_given_a_number_beyond_then_it_is_not_written(mapped: RegisterMap) -> None:
    for number in (mapped.lowest - 1, mapped.highest + 1):
        with pytest.raises(ValueError, match="is not within"):
            mapped.to_words(number)


@given(
    st.integers(4, 33), st.integers(0, 1 << 33), st.lists(st.floats(-1.0, 1.0), min_size=1, max_size=60), st.booleans()
)
def test_given_any_counts_that_a_wheel_can_do_then_the_travel_is_their_sum(
    bits: int, first: int, shares: list[float], reverse: bool
) -> None:
    wrap = 1 << bits
    meters = -0.01 if reverse else 0.01
    fastest = (wrap // 2 - 2) * 0.01 * 10.0
    odometer = Odometer(wrap, meters, max_speed=fastest, delay=0.0)
    count, way = first % wrap, 0
    odometer, travel, reason = odometer.update(count, 0)
    assert (travel, reason) == (0.0, "")
    for n, share in enumerate(shares, 1):
        step = math.trunc(share * (wrap // 2 - 2))
        count, way = (count + step) % wrap, way + step
        # half of the counters are signed
        odometer, travel, reason = odometer.update(count - wrap if count >= wrap // 2 and n % 2 else count, n * 10**8)
        assert reason == ""
        assert travel == pytest.approx(way * meters)


@given(st.floats(-20.0, 20.0), st.floats(-60.0 * DEG, 60.0 * DEG), st.integers(0, 1 << 40), st.booleans())
def test_given_any_command_then_the_controller_reads_it(speed: float, angle: float, number: int, is_stop: bool) -> None:
    raw = DATABASE.decode(COMMAND.make_frame(speed, angle, number, is_stop=is_stop))
    assert raw["ForwardSpeed"] * 0.001 == pytest.approx(speed, abs=0.00051)
    assert raw["SteeringAngle"] * 0.01 * DEG == pytest.approx(angle, abs=0.0051 * DEG)
    assert raw["Alive"] == number % 256
    assert raw["Enable"] == (not is_stop)


@given(st.lists(st.tuples(frames, st.floats(0.0, 0.05)), max_size=30))
def test_given_any_frames_then_the_drivers_publish_only_what_can_be(arrivals: list[tuple[CanFrame, float]]) -> None:
    wheels, vehicle = WheelsDriver(wheels_settings(), DATABASE), VehicleDriver(vehicle_settings(), DATABASE)
    t = 0.0
    for driver in (wheels, vehicle):
        driver.on_open(at(t))
    for frame, wait in arrivals:
        t += wait
        outputs = [*wheels.on_receive(frame, at(t)), *vehicle.on_receive(frame, at(t)), *wheels.on_timer(at(t))]
        for output in [*outputs, *vehicle.on_timer(at(t))]:
            assert not isinstance(output, Send)
            if isinstance(output, MeasuredSample) and isinstance(output.sample, WheelsSample):
                assert all(not abs(wheel.speed) > 8.0 for wheel in output.sample.wheels)
            elif isinstance(output, MeasuredSample):
                assert isinstance(output.sample, VehicleStatusSample)
                assert not abs(output.sample.forward_speed) > 20.0
        for driver in (wheels, vehicle):
            due = driver.get_deadline()
            assert due is None or due >= at(0.0).monotonic_ns


@given(
    st.lists(
        st.tuples(
            st.floats(-1e6, 1e6) | st.floats(),
            st.floats(-1e6, 1e6) | st.floats(),
            st.floats(-1.0, 2.0),
            st.floats(0.0, 0.4),
        ),
        max_size=20,
    )
)
def test_given_any_commands_then_what_is_sent_is_within_the_limits_and_ends(
    commands: list[tuple[float, float, float, float]],
) -> None:
    driver = VehicleDriver(vehicle_settings(), DATABASE)
    driver.on_open(at(0.0))
    t, sent = 0.0, []
    for seq, (speed, angle, valid_for, wait) in enumerate(commands):
        t += wait
        command = VehicleCommand(at(t).utime, valid_for, seq, "any", speed, angle)
        sent += [output.unit for output in driver.on_command(command, at(t)) if isinstance(output, Send)]
    for frame in sent:
        raw = DATABASE.decode(frame)
        assert -1000 <= raw["ForwardSpeed"] <= 3000
        assert abs(raw["SteeringAngle"]) <= 2865
    # after the dead-man's time whatever is text_out is stop
    last = [output.unit for output in driver.on_timer(at(t + 0.5)) if isinstance(output, Send)]
    assert all(DATABASE.decode(frame)["Enable"] == 0 for frame in last)
    assert bool(last) == bool(sent)


@given(
    st.lists(
        st.tuples(st.integers(0, 9), st.sampled_from(("one", "two")), st.floats(0.0, 0.4), st.booleans()), max_size=40
    )
)
def test_given_copies_of_commands_in_any_order_then_none_counts_after_a_newer_one(
    copies: list[tuple[int, str, float, bool]],
) -> None:
    driver = VehicleDriver(vehicle_settings(max_validity=60.0), DATABASE)
    driver.on_open(at(10.0))
    t, taken = 10.0, []
    for seq, source, wait, is_opened in copies:
        t += wait
        if is_opened:
            driver.on_open(at(t))
        driver.on_timer(at(t))
        command = VehicleCommand(at(float(seq)).utime, 60.0, seq, source, 1.0, 0.0)
        before = driver.counts["commands"]
        driver.on_command(command, at(t))
        taken += [command] if driver.counts["commands"] > before else []
    assert [each.utime for each in taken] == sorted(each.utime for each in taken)
    assert len({(each.source, each.seq) for each in taken}) == len(taken)


@given(
    st.floats(-80.0, 70.0),
    st.floats(0.5, 10.0),
    st.floats(2.0, 90.0),
    st.floats(-90.0, 90.0),
    st.lists(st.floats(0.001, 1.0), min_size=2, max_size=30),
)
def test_given_any_limits_then_the_emulated_axis_turns_at_its_rate_and_stays_between(
    lower: float, span: float, rate: float, start: float, waits: list[float]
) -> None:
    unit = AxisUnit(lower, lower + span, rate, start)
    axis = AxisEmulator(AXIS_REGISTERS, unit)
    axis.on_open(at(0.0))
    t, before = 0.0, start
    inside = lower <= start <= lower + span
    for wait in waits:
        t += wait
        (output,) = axis.on_receive(ReadRegisters(0, 4), at(t))
        assert isinstance(output, Send)
        assert isinstance(output.unit, Registers)
        angle = AXIS_REGISTERS.angle.to_degrees(output.unit.values[:2])
        assert angle == pytest.approx(axis.degrees, abs=0.037)
        # it measures at most 2 ms before it is asked
        assert abs(axis.degrees - before) <= rate * (wait + 0.002) + 1e-6
        inside = inside or lower - 1e-9 <= axis.degrees <= lower + span + 1e-9
        assert not inside or lower - 1e-6 <= axis.degrees <= lower + span + 1e-6
        before = axis.degrees


@settings(max_examples=25, deadline=None)
@given(st.data())
def test_given_a_dbc_file_with_characters_changed_then_it_is_read_or_reported(data: st.DataObject) -> None:
    text = DBC.read_text(encoding="utf-8")[:1200]
    for _ in range(data.draw(st.integers(1, 3))):
        place = data.draw(st.integers(0, len(text)))
        text = text[:place] + data.draw(st.text(max_size=5)) + text[place + data.draw(st.integers(0, 5)) :]
    text_out = ""
    try:
        text_out = repr(parse_dbc(text, "damaged.dbc"))
    except ConfigError as error:
        text_out = str(error)
    assert text_out.count("damaged.dbc") >= 1
    assert len(text_out) < 2000
