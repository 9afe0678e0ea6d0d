"""Commands to the vehicle that come late, twice, damaged or from two sides, and a bus that is quiet or off."""

from __future__ import annotations

import math
from collections.abc import Iterable

import pytest
from support_vehicle_bus import START_UTIME, at, raptor_dbc, vehicle_settings

from modelserver.errors import ConfigError
from modelserver.messages import VehicleCommand
from msdrivers.devices.can import CanDatabase, SignalMap, parse_dbc
from msdrivers.devices.vehicle import CommandLimits, CommandMap, VehicleDriver
from msdrivers.endpoint import BUS_OFF_FRAME, CanFrame, EndpointStatus, Output, Reopen, Send

DATABASE = raptor_dbc()


def open_driver(**changes: object) -> VehicleDriver:
    driver = VehicleDriver(vehicle_settings(**changes), DATABASE)
    driver.on_open(at(0.0))
    return driver


def make_command(
    t: float, seq: int, speed: float = 2.0, valid_for: float = 0.5, source: str = "arbitrator"
) -> VehicleCommand:
    return VehicleCommand(START_UTIME + round(t * 1e6), valid_for, seq, source, speed, 0.0)


def speeds(outputs: Iterable[Output[CanFrame]], database: CanDatabase = DATABASE) -> list[float]:
    """Return what is sent to the controller, m/s; nan for stop."""
    frames = [database.decode(output.unit) for output in outputs if isinstance(output, Send)]
    return [frame["ForwardSpeed"] * 0.001 if frame["Enable"] else math.nan for frame in frames]


def texts(outputs: Iterable[Output[CanFrame]]) -> str:
    return "\n".join(output.text for output in outputs if isinstance(output, EndpointStatus))


# --- late and repeated -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("source", ["arbitrator", "another"])
def test_given_an_older_command_after_a_newer_stop_has_ended_then_it_does_not_drive_again(source: str) -> None:
    driver = open_driver(max_validity=60.0)
    fast = make_command(0.0, 10, valid_for=5.0, source=source)
    assert speeds(driver.on_command(fast, at(0.0))) == [2.0]
    stop = make_command(0.05, 11, speed=0.0, valid_for=0.1, source=source)
    assert speeds(driver.on_command(stop, at(0.05))) == [0.0]
    assert speeds(driver.on_timer(at(0.15))) == [pytest.approx(math.nan, nan_ok=True)]
    for t in (0.2, 0.5, 1.0, 4.9):
        assert speeds(driver.on_command(fast, at(t))) == []
    assert driver.counts["rejected.stale"] == 4


def test_given_a_repeated_command_after_its_end_then_it_does_not_count_again() -> None:
    driver = open_driver(max_validity=60.0)
    command = make_command(0.0, 10, valid_for=5.0)
    driver.on_command(command, at(0.0))
    driver.on_timer(at(0.5))
    assert speeds(driver.on_command(command, at(0.6))) == []


def test_given_a_line_reopened_then_what_came_before_does_not_count_again() -> None:
    driver = open_driver(max_validity=60.0)
    command = make_command(0.0, 10, valid_for=5.0)
    driver.on_command(command, at(0.0))
    driver.on_open(at(0.1))
    assert speeds(driver.on_command(command, at(0.2))) == []


def test_given_a_commander_that_was_started_again_then_it_is_received_when_its_last_command_has_ended() -> None:
    driver = open_driver()
    driver.on_command(make_command(0.0, 1000, valid_for=0.3), at(0.0))
    assert speeds(driver.on_command(make_command(0.2, 0, speed=1.0), at(0.2))) == []
    driver.on_timer(at(0.3))
    assert speeds(driver.on_command(make_command(0.4, 1, speed=1.0), at(0.4))) == [1.0]


def test_given_a_command_of_a_long_validity_that_was_held_up_then_it_does_not_count() -> None:
    driver = open_driver(max_validity=1.0)
    assert speeds(driver.on_command(make_command(0.0, 1, valid_for=3600.0), at(1.1))) == []
    assert driver.counts["rejected.expired"] == 1


def test_given_a_clock_that_is_set_back_then_commands_count_again() -> None:
    driver = open_driver()
    driver.on_command(make_command(3600.0, 5), at(3600.0))
    driver.on_timer(at(3601.0))
    back = at(3602.0)._replace(utime=at(2.0).utime)
    assert speeds(driver.on_command(make_command(2.0, 6), back)) == [2.0]


def test_given_a_validity_below_the_dead_man_then_the_key_is_named() -> None:
    with pytest.raises(ValueError, match="max_validity is at least dead_man, 2, got 1"):
        vehicle_settings(dead_man=2.0)


# --- refused ---------------------------------------------------------------------------------------------------


def test_given_what_came_as_a_command_and_is_none_then_it_is_reported_now_and_then_and_counted() -> None:
    driver = open_driver()
    reported = [driver.reject_command("malformed", "a command rejected: nan", at(0.01 * n)) for n in range(2000)]
    words = [output for outputs in reported for output in outputs]
    assert len(words) == 2
    assert all(isinstance(each, EndpointStatus) and each.is_warning for each in words)
    assert driver.counts["rejected.malformed"] == 2000


def test_given_commands_that_are_taken_and_rejected_by_turns_then_little_is_reported() -> None:
    driver = open_driver()
    reported = ""
    for n in range(100):
        now = at(0.01 * n)
        reported += texts(driver.on_command(make_command(0.01 * n, n), now)) + texts(
            driver.on_command(make_command(0.01 * n, n), now)
        )
    assert reported.count("rejected") == 1


# --- two on one bus --------------------------------------------------------------------------------------------

FOREIGN = CanFrame(0x300, bytes(8))


def test_given_another_node_that_commands_then_stop_is_sent_once_and_nothing_more_while_it_does() -> None:
    driver = open_driver()
    driver.on_command(make_command(0.0, 0), at(0.0))
    first = driver.on_receive(FOREIGN, at(0.01))
    assert speeds(first) == [pytest.approx(math.nan, nan_ok=True)]
    assert "another node commands the vehicle too" in texts(first)
    later = []
    for n in range(1, 50):
        t = 0.01 + 0.05 * n
        later += [
            *driver.on_receive(FOREIGN, at(t)),
            *driver.on_command(make_command(t, n), at(t)),
            *driver.on_timer(at(t)),
        ]
    assert speeds(later) == []
    assert driver.counts["foreign_commands"] == 50
    assert driver.counts["rejected.foreign"] == 49
    assert driver.get_deadline() is None or not driver.on_close(at(3.0))


def test_given_that_the_other_node_is_quiet_again_then_a_new_command_counts() -> None:
    driver = open_driver()
    driver.on_receive(FOREIGN, at(0.0))
    assert speeds(driver.on_command(make_command(1.9, 0), at(1.9))) == []
    assert speeds(driver.on_command(make_command(2.1, 1), at(2.1))) == [2.0]


def test_given_a_driver_that_does_not_transmit_then_another_that_commands_is_reported_and_nothing_sent() -> None:
    driver = open_driver()
    outputs = driver.on_receive(FOREIGN, at(0.0))
    assert speeds(outputs) == []
    assert "another node commands" in texts(outputs)


def test_given_two_drivers_on_one_bus_then_the_one_that_is_commanded_drives_and_the_other_gives_way() -> None:
    one, two = open_driver(), open_driver()

    def carry(outputs: Iterable[Output[CanFrame]], to: VehicleDriver, t: float) -> list[Output[CanFrame]]:
        found = []
        for output in outputs:
            if isinstance(output, Send):
                found += to.on_receive(output.unit, at(t))
        return found

    # both were commanded once; from then on only the first
    carry(carry(one.on_command(make_command(0.0, 0), at(0.0)), two, 0.0), one, 0.0)
    sent = []
    for n in range(1, 100):
        t = 0.1 * n
        outputs = one.on_command(make_command(t, n), at(t)) + one.on_timer(at(t))
        sent += [(t, speed) for speed in speeds(outputs)]
        carry(carry(outputs, two, t) + two.on_timer(at(t)), one, t)
    assert next(t for t, speed in sent if t > 0.3 and speed == 2.0) < 2.5
    assert len(sent) > 70


# --- a bus on which nothing is expected ------------------------------------------------------------------------


def test_given_a_driver_without_status_then_it_recovers_from_bus_off() -> None:
    driver = open_driver(status=None)
    assert any(isinstance(output, Reopen) for output in driver.on_receive(BUS_OFF_FRAME, at(0.1)))
    assert driver.on_open(at(0.2)) == []
    assert speeds(driver.on_command(make_command(0.3, 0), at(0.3))) == [2.0]


def test_given_a_driver_without_status_then_no_silence_is_reported_and_none_is_too_long() -> None:
    driver = open_driver(status=None)
    assert driver.get_deadline() is None
    assert driver.on_timer(at(100.0)) == []
    assert driver.max_silence == math.inf
    assert open_driver(silence=7.0).max_silence == 7.0


# --- a stop that is one ----------------------------------------------------------------------------------------

DBC = """BU_: A
BO_ 768 Command: 8 A
 SG_ Speed : 0|16@1+ ({scale},{offset}) [{range}] "m/s" A
 SG_ Angle : 16|16@1- (0.01,0) [0|0] "deg" A
 SG_ Enable : 32|1@1+ (1,0) [0|1] "" A
"""


def command_map(**changes: object) -> CommandMap:
    values: dict[str, object] = {"drive_signals": {"Enable": 1}}
    return CommandMap(SignalMap("Command.Speed"), SignalMap("Command.Angle"), **{**values, **changes})  # type: ignore[arg-type]


@pytest.mark.parametrize(("scale", "offset", "within"), [(0.3, -10, "0|0"), (0.001, 0, "0.5|20")])
def test_given_a_speed_that_cannot_represent_0_then_it_is_rejected_unless_something_else_stops(
    scale: float, offset: float, within: str
) -> None:
    database = parse_dbc(DBC.format(scale=scale, offset=offset, range=within), "c.dbc")

    def make_driver(stopping: dict[str, float]) -> VehicleDriver:
        limits = CommandLimits(1.5, 0.0 if offset == 0 else 1.0, 0.5)
        settings = vehicle_settings(status=None, command=command_map(stop_signals=stopping), limits=limits)
        return VehicleDriver(settings, database)

    for stopping in ({}, {"Enable": 1}):
        with pytest.raises(ConfigError, match=r"Command.Speed cannot represent 0: stop would be sent as"):
            make_driver(stopping)
    if offset:
        make_driver({"Enable": 0})


def test_given_a_speed_with_an_offset_that_is_a_whole_number_of_steps_then_0_can_be_represented() -> None:
    database = parse_dbc(DBC.format(scale=0.5, offset=-10, range="0|0"), "c.dbc")
    driver = VehicleDriver(vehicle_settings(status=None, command=command_map()), database)
    driver.on_open(at(0.0))
    (send,) = driver.on_command(make_command(0.0, 0, speed=0.0), at(0.0))
    assert isinstance(send, Send)
    assert database.decode(send.unit)["Speed"] == 20
