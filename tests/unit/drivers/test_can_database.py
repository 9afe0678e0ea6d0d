"""DBC files: bound signals, decoding and encoding, problems of a mapping that does not fit."""

from __future__ import annotations

import math
import re

import pytest
from support_vehicle_bus import DBC, METERS_PER_COUNT, RAPTOR_COMMAND, RAPTOR_STATUS, raptor_dbc, wheel

from modelserver.errors import ConfigError, Severity
from msdrivers.devices.can import CanDatabase, FrameError, SignalMap, parse_dbc
from msdrivers.devices.vehicle import CommandMap, StatusMap, bind_command, bind_status
from msdrivers.devices.wheels import CountMap, DirectionMap, SpeedMap, WheelMap, bind_wheels
from msdrivers.endpoint import BUS_OFF_FRAME, CanFrame, FrameKey

MIXED = """VERSION ""
NS_ :
BS_:
BU_: A
BO_ 2566834688 Wide: 8 A
 SG_ Up : 7|16@0+ (0.5,-100) [0|0] "" A
 SG_ Real : 32|32@1- (1,0) [0|0] "" A
BO_ 17 Many: 2 A
 SG_ Which M : 0|8@1+ (1,0) [0|0] "" A
 SG_ First m0 : 8|8@1+ (1,0) [0|0] "" A
 SG_ Second m1 : 8|8@1- (1,0) [0|0] "" A

SIG_VALTYPE_ 2566834688 Real : 1;
"""


@pytest.fixture(scope="module")
def database() -> CanDatabase:
    return raptor_dbc()


@pytest.fixture(scope="module")
def mixed_database() -> CanDatabase:
    return parse_dbc(MIXED, "mixed.dbc")


def test_given_the_raptors_file_then_every_mapped_signal_is_there(database: CanDatabase) -> None:
    assert bind_wheels({"front_left": wheel("Left"), "front_right": wheel("Right")}, database, "wheels")
    assert len(bind_status(RAPTOR_STATUS, database, "status").signals) == 7
    assert "alive" in bind_command(RAPTOR_COMMAND, database, "command").signals


def test_given_a_frame_written_by_hand_then_the_bits_are_read_as_in_the_file(database: CanDatabase) -> None:
    frame = CanFrame(0x100, bytes.fromhex("3412 ffff 09 000000"))
    assert database.decode(frame) == {
        "FrontLeftCount": 0x1234,
        "FrontRightCount": 0xFFFF,
        "FrontLeftDirection": 1,
        "FrontRightDirection": 2,
    }


def test_given_big_endian_extended_and_floating_point_signals_then_they_are_read(mixed_database: CanDatabase) -> None:
    key = next(key for key in mixed_database.by_key if key.is_extended)
    frame = CanFrame(key.arbitration_id, bytes.fromhex("01f4 0000 0000c03f"), True)
    assert mixed_database.decode(frame) == {"Up": 500, "Real": 1.5}
    assert mixed_database.bind_signals("Wide")["Up"].to_physical(500) == 150.0
    with pytest.raises(FrameError, match="no message"):
        mixed_database.decode(CanFrame(key.arbitration_id, frame.data, False))


def test_given_a_multiplexed_frame_then_only_what_it_holds_is_read(mixed_database: CanDatabase) -> None:
    assert mixed_database.decode(CanFrame(17, bytes((1, 255)))) == {"Which": 1, "Second": -1}
    with pytest.raises(FrameError) as caught:
        mixed_database.decode(CanFrame(17, bytes((2, 255))))
    assert caught.value.reason == "multiplexer"


@pytest.mark.parametrize("length", [0, 1, 7, 9, 64])
def test_given_a_wrong_length_then_the_frame_is_rejected_with_both_lengths(database: CanDatabase, length: int) -> None:
    with pytest.raises(FrameError, match=rf"WheelCounts\) has {length} bytes, raptor.dbc expects 8") as caught:
        database.decode(CanFrame(0x100, bytes(length)))
    assert caught.value.reason == "length"


@pytest.mark.parametrize(
    ("raw", "value"), [(0, 0.0), (20_000, 20.0), (20_001, 20.001), (65_535, 65.535), (math.nan, None), (math.inf, None)]
)
def test_given_a_value_beyond_the_files_range_then_it_is_that_and_what_is_no_number_is_missing(
    database: CanDatabase, raw: float, value: float | None
) -> None:
    assert database.bind_signals("WheelSpeeds")["FrontLeftSpeed"].to_physical(raw) == value


@pytest.mark.parametrize("physical", [-1e9, -20.0, -0.0004, 0.0, 1.2344, 20.0, 1e9])
def test_given_any_value_when_written_then_it_is_the_nearest_that_the_signal_holds(
    database: CanDatabase, physical: float
) -> None:
    signal = database.bind_signals("VehicleStatus")["ForwardSpeed"]
    held = signal.to_physical(signal.to_raw(physical))
    assert held == pytest.approx(min(max(physical, -20.0), 20.0), abs=0.0005)


def test_given_a_command_then_the_frame_holds_it(database: CanDatabase) -> None:
    command = bind_command(RAPTOR_COMMAND, database, "command")
    frame = command.make_frame(-1.5, math.radians(10.0), 258)
    assert frame.key == FrameKey(0x300)
    assert database.decode(frame) == {"Enable": 1, "Alive": 2, "ForwardSpeed": -1500, "SteeringAngle": 1000}
    assert database.decode(command.make_frame(0.0, 0.0, 0, is_stop=True))["Enable"] == 0


def test_given_error_frames_then_bus_off_is_distinguished() -> None:
    assert BUS_OFF_FRAME.is_bus_off
    assert not CanFrame(0x4, is_error=True).is_bus_off
    assert not CanFrame(0x40).is_bus_off


# --- what does not fit ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "line", "expected"),
    [
        ("hello", 1, "Invalid syntax"),
        ("", 1, "Invalid syntax"),
        ("\0" * 100, 1, "Invalid syntax"),
    ],
    ids=["words", "empty", "zeros"],
)
def test_given_what_is_no_dbc_file_then_it_is_reported_where_and_why(text: str, line: int, expected: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_dbc(text, "bad.dbc")
    (problem,) = caught.value.problems
    assert (problem.file, problem.line) == ("bad.dbc", line)
    assert expected in problem.message
    assert problem.fix
    assert len(str(problem)) < 500


GOOD = 'BO_ 535 Wheels: 8 A\n SG_ V : 0|16@1- (0.01,0) [0|0] "" A\n'


@pytest.mark.parametrize(
    ("flaw", "line", "message", "expected"),
    [
        ('BO_ 1 M: 1 A\n SG_ x : 0|16@1+ (1,0) [0|255] "" A\n', 4, "M", "x does not fit"),
        ('BO_ 1 M: 8 A\n SG_ x : 0|8@1+ (1,0) [0|0] "" A\n SG_ y : 1|1@1+ (1,0) [0|0] "" A\n', 4, "M", "overlapping"),
        ('BO_ 274923520 M: 8 A\n SG_ x : 0|8@1+ (1,0) [0|0] "" A\n', 3, "M", "more than 11 bits"),
        ("BO_ 1 M: 8 A\n SG_ x : zz\n", 4, "M", "Invalid syntax"),
        ("BO_ 1 M: 8 A\n SG_ x : 0|8@1+ (1,0) [0|0] km/h A\n", 4, "M", "Invalid syntax"),
        ('VAL_ 700 Gear 0 "P" 1 "D" ;\n', 3, "", "of message 700, which is not there"),
        ('VAL_ 535 Gear 0 "P" 1 "D" ;\n', 3, "", "unused VAL_"),
        ('CM_ SG_ 535 V "a\nBO_ 1 M: 8 A\n" ;\nBA_ "What" 3;\n', 0, "", "cannot be read"),
        (
            GOOD.replace("Wheels", "M").replace("535", "1") + GOOD.replace("Wheels", "N").replace("535", "1"),
            0,
            "M",
            "one id",
        ),
    ],
    ids=["too_long", "overlap", "identifier", "syntax", "unit", "names", "signal_names", "attribute", "twice"],
)
def test_given_a_flaw_elsewhere_then_the_mapped_message_is_read_and_a_flaw_in_it_is_an_error(
    flaw: str, line: int, message: str, expected: str
) -> None:
    found = parse_dbc("\ufeff" + GOOD + flaw, "d.dbc")
    assert found.decode(CanFrame(535, bytes((200, 0, 0, 0, 0, 0, 0, 0)))) == {"V": 200}
    warning = next(each for each in found.warnings if expected in each.message)
    assert warning.severity is Severity.WARNING
    assert line in (0, warning.line)
    assert "the other messages can be used" in warning.fix
    bind_wheels({"left": WheelMap(speed=SpeedMap("Wheels.V"))}, found, "w")
    if message:
        with pytest.raises(ConfigError) as caught:
            bind_wheels({"left": WheelMap(speed=SpeedMap(f"{message}.x"))}, found, "w")
        (problem,) = caught.value.problems
        assert problem.severity is Severity.ERROR
        assert (problem.message, problem.line) == (warning.message, warning.line)
        assert "can be used" not in problem.fix


def test_given_mistyped_names_then_every_one_is_reported_with_the_nearest(database: CanDatabase) -> None:
    wheels = {
        "front_left": WheelMap(CountMap("WheelCounts.FrontLeftCuont", 0.01), SpeedMap("WheelSpeds.FrontLeftSpeed")),
        "front_right": WheelMap(CountMap("WheelCounts.Zzzzz", 0.01)),
    }
    with pytest.raises(ConfigError) as caught:
        bind_wheels(wheels, database, "drivers.wheels.wheels")
    first, second, third = map(str, caught.value.problems)
    assert first.startswith("drivers.wheels.wheels.front_left.count: error: ")
    assert "raptor.dbc: message WheelCounts has no signal 'FrontLeftCuont'" in first
    assert "write WheelCounts.FrontLeftCount" in first
    assert "there is no message 'WheelSpeds'; nearest: WheelSpeeds" in second
    assert "known there: FrontLeftCount, FrontRightCount" in third


def test_given_signals_that_cannot_be_what_they_are_mapped_to_then_it_is_reported(mixed_database: CanDatabase) -> None:
    for wheel_map, expected in (
        (WheelMap(CountMap("Wide.Real", 0.01)), "floating-point"),
        (WheelMap(CountMap("Wide.Up", 0.01, wrap=1 << 17)), "does not fit into the 16 bits"),
    ):
        with pytest.raises(ConfigError, match=expected):
            bind_wheels({"a": wheel_map}, mixed_database, "wheels")
    with pytest.raises(ConfigError, match="floating-point"):
        bind_status(StatusMap(fault_bits="Wide.Real"), mixed_database, "status")


SMALL = 'BO_ 1 M: 8 A\n SG_ N : 0|8@1+ (1,0) [0|0] "" A\n'


@pytest.mark.parametrize(("max_speed", "delay"), [(15.0, 0.1), (200.0, 0.01), (1.0, 10.0)])
def test_given_a_counter_that_turns_too_soon_then_the_largest_settings_that_do_are_reported(
    max_speed: float, delay: float
) -> None:
    small = parse_dbc(SMALL, "small.dbc")
    wheels = {"left": WheelMap(CountMap("M.N", 0.01))}
    with pytest.raises(ConfigError) as caught:
        bind_wheels(wheels, small, "wheels", max_speed, delay)
    (problem,) = caught.value.problems
    assert "256 counts of 0.01 m are unambiguous up to 1.27 m" in problem.message
    lower = re.findall(r"below ([\d.e-]+) ", problem.fix)
    # the reported settings are accepted
    assert bind_wheels(wheels, small, "wheels", max_speed, 0.99 * float(lower[0]))
    assert bind_wheels(wheels, small, "wheels", 0.99 * float(lower[1]), delay)
    assert bind_wheels({"left": WheelMap(CountMap("M.N", 1.0))}, small, "wheels", 15.0, 0.1)


def test_given_a_signed_speed_mapped_as_a_magnitude_then_it_is_reported(database: CanDatabase) -> None:
    speed = SpeedMap("VehicleStatus.ForwardSpeed", is_magnitude=True)
    with pytest.raises(ConfigError, match="goes down to -20"):
        bind_wheels({"a": WheelMap(None, speed, DirectionMap("VehicleStatus.Mode"))}, database, "wheels")


def test_given_a_command_that_leaves_a_signal_without_value_then_it_is_reported(database: CanDatabase) -> None:
    speed, angle = SignalMap("VehicleCommand.ForwardSpeed"), SignalMap("VehicleCommand.SteeringAngle")
    with pytest.raises(ConfigError) as caught:
        bind_command(CommandMap(speed, angle, drive_signals={"Enalbe": 1}), database, "command")
    text = str(caught.value)
    assert "no signal 'Enalbe'; nearest: Enable" in text
    assert "VehicleCommand.Alive is given no value" in text
    with pytest.raises(ConfigError, match="cannot hold 2"):
        bind_command(CommandMap(speed, angle, "VehicleCommand.Alive", {"Enable": 2}), database, "command")


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (lambda: SignalMap("NoDot"), "signal is written Message.Signal"),
        (lambda: SignalMap("A.B.C"), "signal is written Message.Signal"),
        (lambda: SignalMap("A.B", 0.0), "scale is a number and not 0"),
        (lambda: SignalMap("A.B", 1.0, math.inf), "offset is a number"),
        (lambda: CountMap("A.B", 0.0), "meters_per_count"),
        (lambda: CountMap("A.B", math.nan), "meters_per_count"),
        (lambda: CountMap("A.B", 0.1, wrap=2), "wrap is 0"),
        (lambda: SpeedMap("A.B", sigma=-1.0), "sigma is not negative"),
        (lambda: DirectionMap("A.B", 0, 1, 1), "three different"),
        (lambda: WheelMap(), "count or speed is missing"),
        (
            lambda: WheelMap(CountMap("A.B", 0.1, counts_up_only=True), SpeedMap("A.C")),
            r"is needed with count\.counts_up_only",
        ),
        (lambda: WheelMap(CountMap("A.B", 0.1), SpeedMap("A.C", is_magnitude=True)), r"with speed\.is_magnitude"),
        (lambda: StatusMap(mode="A.B"), "mode and modes"),
        (lambda: StatusMap(mode="A.B", modes={"driving": 1}), "modes knows manual"),
        (lambda: StatusMap(mode="A.B", modes={"manual": 1, "fault": 1}), "a number of its own"),
        (lambda: CommandMap(SignalMap("A.B"), SignalMap("C.D")), "a command is one message, A; C.D"),
    ],
)
def test_given_settings_that_cannot_be_then_the_key_is_named(make: object, expected: str) -> None:
    with pytest.raises(ValueError, match=expected):
        make()  # type: ignore[operator]


def test_the_raptors_file_is_documented_as_this_projects_choice() -> None:
    assert "this project's choice" in DBC.read_text(encoding="utf-8")
    assert METERS_PER_COUNT > 0
