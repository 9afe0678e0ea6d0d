"""Commands to the vehicle that come late, twice, damaged or from two sides, and a bus that is quiet or off."""

from __future__ import annotations

import math
from collections.abc import Iterable

import pytest
from support_vehicle_bus import START_UTIME, at, raptor_dbc, vehicle_settings

from modelserver.errors import ConfigError
from modelserver.messages import VehicleCommand
from msdrivers.devices.vehicle import VehicleDriver
from msdrivers.devices.vehicle_settings import LimitsMap
from msdrivers.protocol.can.database import CanDatabase, parse_dbc
from msdrivers.protocol.can.frame import CanFrame, bus_off
from msdrivers.protocol.can.mapping import CommandMap, SignalMap
from msdrivers.station import Output, Reopen, Send, StationStatus

DATABASE = raptor_dbc()


def opened(**changes: object) -> VehicleDriver:
    driver = VehicleDriver(vehicle_settings(**changes), DATABASE)
    driver.opened(at(0.0))
    return driver


def wish(t: float, seq: int, speed: float = 2.0, valid_for: float = 0.5, source: str = "arbitrator") -> VehicleCommand:
    return VehicleCommand(START_UTIME + round(t * 1e6), valid_for, seq, source, speed, 0.0)


def speeds(outputs: Iterable[Output[CanFrame]], database: CanDatabase = DATABASE) -> list[float]:
    """Return what is said to the controller, m/s; nan for stop."""
    frames = [database.decode(output.unit) for output in outputs if isinstance(output, Send)]
    return [frame["ForwardSpeed"] * 0.001 if frame["Enable"] else math.nan for frame in frames]


def texts(outputs: Iterable[Output[CanFrame]]) -> str:
    return "\n".join(output.text for output in outputs if isinstance(output, StationStatus))


# --- late and repeated -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("source", ["arbitrator", "another"])
def test_given_an_older_command_after_a_newer_stop_has_ended_then_it_does_not_drive_again(source: str) -> None:
    driver = opened(max_validity=60.0)
    fast = wish(0.0, 10, valid_for=5.0, source=source)
    assert speeds(driver.command(fast, at(0.0))) == [2.0]
    stop = wish(0.05, 11, speed=0.0, valid_for=0.1, source=source)
    assert speeds(driver.command(stop, at(0.05))) == [0.0]
    assert speeds(driver.woken(at(0.15))) == [pytest.approx(math.nan, nan_ok=True)]
    for t in (0.2, 0.5, 1.0, 4.9):
        assert speeds(driver.command(fast, at(t))) == []
    assert driver.counts["rejected.old"] == 4


def test_given_a_repeated_command_after_its_end_then_it_does_not_count_again() -> None:
    driver = opened(max_validity=60.0)
    command = wish(0.0, 10, valid_for=5.0)
    driver.command(command, at(0.0))
    driver.woken(at(0.5))
    assert speeds(driver.command(command, at(0.6))) == []


def test_given_a_line_opened_anew_then_what_came_before_still_does_not_count_again() -> None:
    driver = opened(max_validity=60.0)
    command = wish(0.0, 10, valid_for=5.0)
    driver.command(command, at(0.0))
    driver.opened(at(0.1))
    assert speeds(driver.command(command, at(0.2))) == []


def test_given_a_commander_that_was_started_again_then_it_is_heard_when_its_last_command_has_ended() -> None:
    driver = opened()
    driver.command(wish(0.0, 1000, valid_for=0.3), at(0.0))
    assert speeds(driver.command(wish(0.2, 0, speed=1.0), at(0.2))) == []
    driver.woken(at(0.3))
    assert speeds(driver.command(wish(0.4, 1, speed=1.0), at(0.4))) == [1.0]


def test_given_a_command_of_a_long_validity_that_was_held_up_then_it_does_not_count() -> None:
    driver = opened(max_validity=1.0)
    assert speeds(driver.command(wish(0.0, 1, valid_for=3600.0), at(1.1))) == []
    assert driver.counts["rejected.expired"] == 1


def test_given_a_clock_that_is_set_back_then_commands_count_again() -> None:
    driver = opened()
    driver.command(wish(3600.0, 5), at(3600.0))
    driver.woken(at(3601.0))
    back = at(3602.0)._replace(utime=at(2.0).utime)
    assert speeds(driver.command(wish(2.0, 6), back)) == [2.0]


def test_given_a_validity_below_the_dead_man_then_the_key_is_named() -> None:
    with pytest.raises(ValueError, match="max_validity is at least dead_man, 2, got 1"):
        vehicle_settings(dead_man=2.0)


# --- refused ---------------------------------------------------------------------------------------------------


def test_given_what_came_as_a_command_and_is_none_then_it_is_told_now_and_then_and_counted() -> None:
    driver = opened()
    told = [driver.refuse("malformed", "a command refused: nan", at(0.01 * n)) for n in range(2000)]
    words = [output for outputs in told for output in outputs]
    assert len(words) == 2
    assert all(isinstance(each, StationStatus) and each.is_trouble for each in words)
    assert driver.counts["rejected.malformed"] == 2000


def test_given_commands_that_are_taken_and_refused_by_turns_then_little_is_told() -> None:
    driver = opened()
    told = ""
    for n in range(100):
        now = at(0.01 * n)
        told += texts(driver.command(wish(0.01 * n, n), now)) + texts(driver.command(wish(0.01 * n, n), now))
    assert told.count("refused") == 1


# --- two on one bus --------------------------------------------------------------------------------------------

FOREIGN = CanFrame(0x300, bytes(8))


def test_given_another_node_that_commands_then_stop_is_said_once_and_nothing_more_while_it_does() -> None:
    driver = opened()
    driver.command(wish(0.0, 0), at(0.0))
    first = driver.received(FOREIGN, at(0.01))
    assert speeds(first) == [pytest.approx(math.nan, nan_ok=True)]
    assert "another node commands the vehicle too" in texts(first)
    later = []
    for n in range(1, 50):
        t = 0.01 + 0.05 * n
        later += [*driver.received(FOREIGN, at(t)), *driver.command(wish(t, n), at(t)), *driver.woken(at(t))]
    assert speeds(later) == []
    assert driver.counts["foreign_commands"] == 50
    assert driver.counts["rejected.foreign"] == 49
    assert driver.due() is None or not driver.leaving(at(3.0))


def test_given_that_the_other_node_is_quiet_again_then_a_new_command_counts() -> None:
    driver = opened()
    driver.received(FOREIGN, at(0.0))
    assert speeds(driver.command(wish(1.9, 0), at(1.9))) == []
    assert speeds(driver.command(wish(2.1, 1), at(2.1))) == [2.0]


def test_given_a_driver_that_does_not_speak_then_another_that_commands_is_told_and_nothing_sent() -> None:
    driver = opened()
    outputs = driver.received(FOREIGN, at(0.0))
    assert speeds(outputs) == []
    assert "another node commands" in texts(outputs)


def test_given_two_drivers_on_one_bus_then_the_one_that_is_commanded_drives_and_the_other_gives_way() -> None:
    one, two = opened(), opened()

    def carry(outputs: Iterable[Output[CanFrame]], to: VehicleDriver, t: float) -> list[Output[CanFrame]]:
        found = []
        for output in outputs:
            if isinstance(output, Send):
                found += to.received(output.unit, at(t))
        return found

    # both were commanded once; from then on only the first
    carry(carry(one.command(wish(0.0, 0), at(0.0)), two, 0.0), one, 0.0)
    said = []
    for n in range(1, 100):
        t = 0.1 * n
        outputs = one.command(wish(t, n), at(t)) + one.woken(at(t))
        said += [(t, speed) for speed in speeds(outputs)]
        carry(carry(outputs, two, t) + two.woken(at(t)), one, t)
    assert next(t for t, speed in said if t > 0.3 and speed == 2.0) < 2.5
    assert len(said) > 70


# --- a bus on which nothing is expected ------------------------------------------------------------------------


def test_given_a_driver_without_status_then_it_recovers_from_bus_off() -> None:
    driver = opened(status=None)
    assert any(isinstance(output, Reopen) for output in driver.received(bus_off(), at(0.1)))
    assert driver.opened(at(0.2)) == []
    assert speeds(driver.command(wish(0.3, 0), at(0.3))) == [2.0]


def test_given_a_driver_without_status_then_no_silence_is_told_and_none_is_too_long() -> None:
    driver = opened(status=None)
    assert driver.due() is None
    assert driver.woken(at(100.0)) == []
    assert driver.quiet == math.inf
    assert opened(silence=7.0).quiet == 7.0


# --- a stop that is one ----------------------------------------------------------------------------------------

DBC = """BU_: A
BO_ 768 Command: 8 A
 SG_ Speed : 0|16@1+ ({scale},{offset}) [{range}] "m/s" A
 SG_ Angle : 16|16@1- (0.01,0) [0|0] "deg" A
 SG_ Enable : 32|1@1+ (1,0) [0|1] "" A
"""


def command_map(**changes: object) -> CommandMap:
    values: dict[str, object] = {"driving": {"Enable": 1}}
    return CommandMap(SignalMap("Command.Speed"), SignalMap("Command.Angle"), **{**values, **changes})  # type: ignore[arg-type]


@pytest.mark.parametrize(("scale", "offset", "within"), [(0.3, -10, "0|0"), (0.001, 0, "0.5|20")])
def test_given_a_speed_that_cannot_be_said_as_0_then_it_is_refused_unless_something_else_stops(
    scale: float, offset: float, within: str
) -> None:
    database = parse_dbc(DBC.format(scale=scale, offset=offset, range=within), "c.dbc")

    def made(stopping: dict[str, float]) -> VehicleDriver:
        limits = LimitsMap(1.5, 0.0 if offset == 0 else 1.0, 0.5)
        settings = vehicle_settings(status=None, command=command_map(stopping=stopping), limits=limits)
        return VehicleDriver(settings, database)

    for stopping in ({}, {"Enable": 1}):
        with pytest.raises(ConfigError, match=r"Command.Speed cannot say 0: stop would be said as"):
            made(stopping)
    if offset:
        made({"Enable": 0})


def test_given_a_speed_with_an_offset_that_is_a_whole_number_of_steps_then_0_can_be_said() -> None:
    database = parse_dbc(DBC.format(scale=0.5, offset=-10, range="0|0"), "c.dbc")
    driver = VehicleDriver(vehicle_settings(status=None, command=command_map()), database)
    driver.opened(at(0.0))
    (send,) = driver.command(wish(0.0, 0, speed=0.0), at(0.0))
    assert isinstance(send, Send)
    assert database.decode(send.unit)["Speed"] == 20
