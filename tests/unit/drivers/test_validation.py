"""What is found wrong with drivers before any of their devices is there."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest
from support_vehicle_bus import DBC

from modelserver.errors import ConfigError, Severity
from msdrivers.settings import (
    DriverSettings,
    SourceMap,
    find_shared_lines,
    find_unbuildable_drivers,
    find_unknown_joint,
    find_unknown_wheels,
    make_driver,
    make_emulator,
    read_driver,
)

LINES = {("drivers", "wheels"): 5, ("drivers", "wheels", "dbc"): 8, ("drivers", "wheels", "wheels", "front_left"): 10}
PLACE = SourceMap("v.yaml", LINES)
COUNT = {"signal": "WheelCounts.FrontLeftCount", "meters_per_count": 0.0125}


def driver(name: str, **section: Any) -> DriverSettings:
    return read_driver(name, section, PLACE)


def wheels(dbc: str = "raptor.dbc", signal: str = "WheelCounts.FrontLeftCount") -> DriverSettings:
    count = {"signal": signal, "meters_per_count": 0.0125}
    return driver("wheels", device="wheels", can="can0", dbc=dbc, wheels={"front_left": {"count": count}})


def axis(joint: str, name: str = "axis", unit_id: int = 1) -> DriverSettings:
    registers = {"angle": {"address": 0, "scale_deg": 0.01}}
    return driver(name, device="axis", address="h:502", joint=joint, registers=registers, unit_id=unit_id)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    shutil.copy(DBC, tmp_path)
    return tmp_path


def test_given_drivers_that_can_be_made_then_nothing_is_reported(folder: Path) -> None:
    assert list(find_unbuildable_drivers([wheels(), axis("nod")], folder)) == []


def test_given_a_missing_dbc_then_its_line_in_the_vehicle_file_and_the_nearest_file_are_reported(folder: Path) -> None:
    (problem,) = find_unbuildable_drivers([wheels("rapter.dbc")], folder)
    assert str(problem.source) == "v.yaml:8 (drivers.wheels.dbc)"
    assert problem.message == f"the DBC file '{folder}/rapter.dbc' cannot be read: No such file or directory"
    assert problem.fix == "write raptor.dbc"


@pytest.mark.parametrize("dbc", [".", "/", "nowhere/raptor.dbc", "a\0b"])
def test_given_a_path_that_cannot_be_a_dbc_then_it_is_reported_at_its_line(dbc: str, folder: Path) -> None:
    (problem,) = find_unbuildable_drivers([wheels(dbc)], folder)
    assert (problem.file, problem.line) == ("v.yaml", 8)
    assert problem.fix == "the path of a DBC file, relative to the vehicle file"


def test_given_a_signal_that_the_dbc_lacks_then_driver_and_emulator_name_the_line_to_edit(folder: Path) -> None:
    wrong = wheels(signal="WheelCounts.FrontLeftCuont")
    for make in (lambda: make_driver(wrong, folder), lambda: make_emulator(wrong, folder, ())):
        with pytest.raises(ConfigError) as caught:
            make()
        (problem,) = caught.value.problems
        assert str(problem.source) == "v.yaml:10 (drivers.wheels.wheels.front_left.count)"
        assert "raptor.dbc: message WheelCounts has no signal 'FrontLeftCuont'" in problem.message
        assert problem.fix == "write WheelCounts.FrontLeftCount"


def test_given_a_dbc_that_is_none_then_the_line_is_the_dbcs_own(folder: Path) -> None:
    (folder / "raptor.dbc").write_text("hello")
    (problem,) = find_unbuildable_drivers([wheels()], folder)
    assert (problem.file, problem.line) == (str(folder / "raptor.dbc"), 1)


def test_given_two_drivers_on_one_port_then_it_is_a_warning_at_the_second(tmp_path: Path) -> None:
    by_id = tmp_path / "usb-FTDI"
    by_id.symlink_to("/dev/ttyUSB0")
    drivers = [
        driver("gps", device="nmea", port="/dev/ttyUSB0"),
        driver("imu", device="gx1", port=str(by_id)),
        driver("other", device="gx1", port="/dev/ttyUSB1"),
        driver("far", device="nmea", address="h:4001"),
        driver("farther", device="nmea", address="h:4001"),
    ]
    reported = [(each.severity, each.element, each.message) for each in find_shared_lines(drivers)]
    assert reported == [
        (
            Severity.WARNING,
            "drivers.imu.port",
            f"drivers gps and imu have one line, {by_id}: only one of them can use it",
        ),
        (
            Severity.WARNING,
            "drivers.farther.address",
            "drivers far and farther have one line, TCP h:4001: only one of them can use it",
        ),
    ]


def test_given_lines_that_are_for_many_then_nothing_is_reported() -> None:
    two_units = [axis("a", "front", unit_id=1), axis("b", "back", unit_id=2)]
    assert list(find_shared_lines([wheels(), wheels(), *two_units])) == []
    assert len(list(find_shared_lines([axis("a", "front"), axis("b", "back")]))) == 1


def test_given_a_wheel_that_the_vehicle_does_not_have_then_both_names_are_shown_and_neither_is_preferred() -> None:
    (problem,) = find_unknown_wheels(wheels(), ["frontleft", "front_right"])
    assert problem.severity is Severity.WARNING
    assert str(problem.source) == "v.yaml:10 (drivers.wheels.wheels.front_left)"
    assert problem.message.startswith("sensors.wheels.frames has no 'front_left'")
    # which of the two is the misspelled one nobody knows
    assert problem.nearest == ()
    assert "write one name in both places: here it is 'front_left', in sensors.wheels.frames 'frontleft'" in problem.fix
    for frames in (["front_left"], []):
        assert list(find_unknown_wheels(wheels(), frames)) == []
    assert list(find_unknown_wheels(axis("nod"), ["front_left"])) == []


def test_given_a_joint_that_the_geometry_does_not_have_then_it_is_a_warning() -> None:
    (problem,) = find_unknown_joint(axis("nodd"), ["Nod", "Fixed"])
    assert (problem.severity, problem.element, problem.fix) == (Severity.WARNING, "drivers.axis.joint", "write Nod")
    assert "the geometry has no constraint 'nodd'" in problem.message
    assert list(find_unknown_joint(axis("Nod"), ["Nod"])) == []
    assert list(find_unknown_joint(wheels(), ["Nod"])) == []
