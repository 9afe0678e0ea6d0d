"""The drivers section: every problem at once, each with its line, its nearest name and what was expected."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from modelserver.config.vehicle_file import load_config, read_config_lines
from modelserver.errors import ConfigError, Location, Problem, Severity
from modelserver.messages import ImuSample
from msdrivers.emulate import InjectedFault, parse_fault
from msdrivers.registry import (
    CHANNELS,
    KINDS,
    CanSettings,
    DeviceKind,
    DeviceModules,
    ModbusSettings,
    SerialSettings,
    TcpSettings,
    split_group,
)
from msdrivers.settings import DriverSettings, SourceMap, choose_first_baud, read_driver, read_drivers


@dataclass(frozen=True, slots=True)
class Part:
    __pydantic_config__: ClassVar[dict[str, object]] = {"extra": "forbid"}

    scale: float
    name: str = ""


@dataclass(frozen=True, slots=True)
class EchoSettings:
    source: str
    rate_hz: float = 10.0
    heading: Literal["magnetic", "gyro"] = "gyro"
    offsets: tuple[float, ...] = ()
    bauds: tuple[int, ...] = ()
    parts: Mapping[str, Part] | None = None
    one: Part | None = None
    hidden: str = "plain"

    def __post_init__(self) -> None:
        if not 1.0 <= self.rate_hz <= 100.0:
            raise ValueError(f"rate_hz: must be 1 to 100 Hz, got {self.rate_hz:g}")


def never(*_: Any) -> Any:
    raise AssertionError("nothing is made here")


ECHO = DeviceKind(
    "echo",
    "a device of the tests",
    ImuSample,
    (SerialSettings, TcpSettings),
    lambda: DeviceModules(EchoSettings, never),
    never,
    9600,
    presets={"hidden": "preset"},
)
CAN = DeviceKind("canner", "another", ImuSample, (CanSettings,), lambda: DeviceModules(EchoSettings, never), never)
MODBUS = DeviceKind("axle", "a third", ImuSample, (ModbusSettings,), lambda: DeviceModules(EchoSettings, never), never)
KNOWN = {kind.name: kind for kind in (ECHO, CAN, MODBUS)}


def read(section: Mapping[str, Any]) -> DriverSettings:
    return read_driver("imu", section, kinds=KNOWN)


def problems(section: Mapping[str, Any]) -> tuple[Problem, ...]:
    with pytest.raises(ConfigError) as caught:
        read(section)
    return caught.value.problems


def test_given_a_section_then_line_and_settings_come_from_their_dataclasses() -> None:
    driver = read(
        {
            "device": "echo",
            "port": "/dev/ttyUSB0",
            "baud": 38400,
            "rate_hz": 5,
            "offsets": [1, 2.5],
            "heading": "magnetic",
            "channel": "IMU2",
            "parts": {"a": {"scale": 2.0}},
        }
    )
    assert driver.line == SerialSettings("/dev/ttyUSB0", 38400)
    assert driver.device_settings == EchoSettings(
        "imu", 5.0, "magnetic", (1.0, 2.5), (38400,), {"a": Part(2.0)}, hidden="preset"
    )
    assert (driver.name, driver.kind, driver.channel) == ("imu", ECHO, "IMU2")


@pytest.mark.parametrize(
    ("section", "line"),
    [
        ({"device": "echo", "address": "10.0.0.5:3001"}, TcpSettings("10.0.0.5:3001")),
        ({"device": "canner", "can": "can0"}, CanSettings("can0", "socketcan", 0)),
        ({"device": "axle", "address": "[::1]:502", "unit_id": 3}, ModbusSettings("[::1]:502", 3)),
    ],
)
def test_given_a_lines_first_key_then_it_is_that_line(section: dict[str, Any], line: object) -> None:
    assert read(section).line == line


@pytest.mark.parametrize(
    ("section", "key", "expected"),
    [
        ({"can": "can0", "interface": "sockcan"}, "interface", "write socketcan"),
        ({"can": "", "interface": "pcan"}, "can", "is the channel as the interface names it, got nothing"),
        ({"can": ""}, "can", "is the name of a network interface, e.g. can0, got ''"),
        ({"can": "a_name_of_sixteen"}, "can", "is the name of a network interface"),
        ({"can": "/dev/ttyACM0"}, "can", "is the name of a network interface"),
        ({"can": "239.74.163.9"}, "can", "is a group of IP multicast; add interface: udp_multicast"),
        ({"can": "239.74.163.9:5000"}, "can", "is a group of IP multicast; add interface: udp_multicast"),
        ({"can": "can0", "interface": "udp_multicast"}, "can", "is GROUP:PORT with udp_multicast, e.g. 239.74.163.2"),
        ({"can": "239.74.163.9:abc", "interface": "udp_multicast"}, "can", "is GROUP:PORT"),
        ({"can": "239.74.163.9:", "interface": "udp_multicast"}, "can", "is GROUP:PORT"),
        ({"can": "192.168.1.1", "interface": "udp_multicast"}, "can", "is GROUP:PORT"),
        ({"can": "can0", "bitrate": -1}, "bitrate", "bitrate is 0"),
    ],
)
def test_given_a_can_line_that_cannot_be_then_the_key_is_named(
    section: dict[str, Any], key: str, expected: str
) -> None:
    with pytest.raises(ConfigError) as caught:
        read({"device": "canner", **section})
    (problem,) = caught.value.problems
    assert f"drivers.imu.{key}" in str(problem)
    assert expected in str(problem)


@pytest.mark.parametrize(
    ("channel", "parts"),
    [
        ("239.74.163.9", ("239.74.163.9", 43113)),
        ("239.74.163.9:5000", ("239.74.163.9", 5000)),
    ],
)
def test_given_a_group_of_multicast_then_its_port_is_parsed(channel: str, parts: tuple[str, int]) -> None:
    assert split_group(channel) == parts
    assert CanSettings(channel, "udp_multicast").can == channel


def test_given_rates_to_try_then_the_line_is_opened_at_the_first_else_the_ports_else_the_makers() -> None:
    base = {"device": "echo", "port": "p"}
    assert choose_first_baud(read({**base, "bauds": [4800, 9600]})) == 4800
    assert choose_first_baud(read({**base, "baud": 19200})) == 19200
    assert choose_first_baud(read(base)) == 9600


@pytest.mark.parametrize(
    ("section", "element", "message", "fix"),
    [
        ({}, "drivers.imu.device", "device is missing", "add a line: device: ... (kinds: echo, canner, axle)"),
        ({"device": "ehco"}, "drivers.imu.device", "unknown device 'ehco'", "write echo"),
        ({"device": 5}, "drivers.imu.device", "unknown device '5'", "kinds: echo, canner, axle"),
        ({"device": "echo"}, "drivers.imu", "no line is named: port or address is missing", "add a line: port: ..."),
        (
            {"device": "echo", "port": "p", "address": "a:1"},
            "drivers.imu.address",
            "both port and address are given",
            "keep one of port or address",
        ),
        ({"device": "echo", "port": "p", "rate_h": 5}, "drivers.imu.rate_h", "unknown key 'rate_h'", "write rate_hz"),
        ({"device": "echo", "port": "p", "hidden": "x"}, "drivers.imu.hidden", "unknown key 'hidden'", None),
        ({"device": "echo", "port": "p", "source": "x"}, "drivers.imu.source", "unknown key 'source'", None),
        (
            {"device": "echo", "port": "p", "rate_hz": "5"},
            "drivers.imu.rate_hz",
            "should be a valid number, got '5'",
            "",
        ),
        ({"device": "echo", "port": "p", "rate_hz": 0.5}, "drivers.imu.rate_hz", "rate_hz: must be 1 to 100", ""),
        ({"device": "echo", "port": "p", "heading": "up"}, "drivers.imu.heading", "'magnetic' or 'gyro', got 'up'", ""),
        (
            {"device": "echo", "port": "p", "heading": "gyr"},
            "drivers.imu.heading",
            "should be 'magnetic' or 'gyro', got 'gyr'",
            "write gyro",
        ),
        (
            {"device": "echo", "port": "p", "bauds": 9600},
            "drivers.imu.bauds",
            "should be a valid array, got '9600'",
            "",
        ),
        (
            {"device": "echo", "port": "p", "bauds": [4800, "9600"]},
            "drivers.imu.bauds.1",
            "should be a valid integer, got '9600'",
            "",
        ),
        (
            {"device": "echo", "port": "p", "one": "wide"},
            "drivers.imu.one",
            "expected a mapping (key: value, one per line), got 'wide'",
            "",
        ),
        (
            {"device": "echo", "port": "p", "parts": {"a": {"scale": 1.0, "name": 5}}},
            "drivers.imu.parts.a.name",
            "should be a valid string, got '5'",
            "",
        ),
        (
            {"device": "echo", "port": "p", "parts": {"a": {"scale": True}}},
            "drivers.imu.parts.a.scale",
            "should be a valid number, got 'True'",
            "",
        ),
        (
            {"device": "echo", "can": "can0"},
            "drivers.imu.can",
            "can does not go with device echo: device echo is on port or address",
            "write port: ... in its place",
        ),
        (
            {"device": "echo", "port": "p", "can": "can0"},
            "drivers.imu.can",
            "can does not go with port: device echo is on port or address",
            "take it out",
        ),
        (
            {"device": "canner", "can": "can0", "port": "p"},
            "drivers.imu.port",
            "port does not go with can: device canner is on can",
            "take it out",
        ),
        (
            {"device": "echo", "address": "a:1", "baud": 9600},
            "drivers.imu.baud",
            "baud does not go with address: device echo is on port or address",
            "take it out",
        ),
        (
            {"device": "echo", "port": "p", "bitrate": 9600},
            "drivers.imu.bitrate",
            "bitrate does not go with port: device echo is on port or address",
            "take it out",
        ),
        (
            {"device": "echo", "port": "p", "baud": 9600, "bauds": [9600]},
            "drivers.imu.baud",
            "both baud and bauds are given",
            "keep one of baud or bauds",
        ),
        # located of what stands in the file, and not of what is made of it
        ({"device": "echo", "port": "p", "baud": -9600}, "drivers.imu.baud", "baud is between 50 and", ""),
        ({"device": "echo", "address": "host"}, "drivers.imu.address", "address is HOST:PORT", ""),
        ({"device": "echo", "address": "host:99999"}, "drivers.imu.address", "address is HOST:PORT", ""),
        ({"device": "echo", "port": "p", "baud": 3}, "drivers.imu.baud", "baud is between 50 and", ""),
        ({"device": "echo", "port": ""}, "drivers.imu.port", "port is the path of a serial port", ""),
        (
            {"device": "echo", "port": "p", "parts": {"a": {"scale": 1.0, "nmae": "x"}}},
            "drivers.imu.parts.a.nmae",
            "unknown key 'nmae'",
            "write name",
        ),
        (
            {"device": "echo", "port": "p", "one": {"scale": 1.0, "nmae": "x"}},
            "drivers.imu.one.nmae",
            "unknown key 'nmae'",
            "write name",
        ),
        (
            {"device": "echo", "port": "p", "one": {}},
            "drivers.imu.one.scale",
            "scale is missing",
            "add a line: scale: ...",
        ),
        ({"device": "axle", "address": "a:1", "unit_id": 300}, "drivers.imu.unit_id", "unit_id is between 0", ""),
    ],
)
def test_given_a_slip_then_it_is_reported_with_its_place_and_what_to_do(
    section: dict[str, Any], element: str, message: str, fix: str | None
) -> None:
    (problem,) = problems(section)
    assert problem.element == element
    assert message in problem.message
    assert fix is None or problem.fix == fix


def test_given_several_slips_then_all_are_reported_at_once() -> None:
    found = problems({"device": "echo", "port": 3, "rate_hz": "x", "color": "red"})
    assert {problem.element for problem in found} == {
        "drivers.imu.port",
        "drivers.imu.rate_hz",
        "drivers.imu.color",
    }


def test_given_rules_of_the_section_that_are_broken_then_they_are_reported_beside_the_wrong_types() -> None:
    section = {
        "device": "novatel",
        "port": "p",
        "rate_hz": -4,
        "silence": math.nan,
        "heading_log": 3,
        "bauds": 9600,
        "delay": -9,
    }
    with pytest.raises(ConfigError) as caught:
        read_driver("gps", section)
    assert {problem.element.rpartition(".")[2]: problem.message for problem in caught.value.problems} == {
        "heading_log": "input should be a valid string, got '3'",
        "bauds": "input should be a valid array, got '9600'",
        "rate_hz": "rate_hz is between 0.1 and 20, got -4",
        "silence": "silence is between 0.05 and 3600, got nan",
        "delay": "delay is between -5 and 5, got -9",
    }
    assert len(caught.value.problems) == 5


def test_given_a_wrong_part_then_what_misses_it_is_not_reported_too() -> None:
    status = {"forward_speed": {"signal": 5}}
    with pytest.raises(ConfigError) as caught:
        read_driver("car", {"device": "vehicle", "can": "can0", "dbc": "a.dbc", "status": status, "window": -1})
    assert [problem.message for problem in caught.value.problems] == [
        "input should be a valid string, got '5'",
        "window is between 0 and 1, got -1",
    ]


VALUES = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=5)),
    lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(st.text(max_size=5), inner, max_size=3)),
    max_leaves=8,
)
KEYS = sorted({field for kind in KINDS.values() for field in kind.load().settings.__dataclass_fields__})


@pytest.mark.slow
@settings(max_examples=100, deadline=None)
@given(
    st.sampled_from(sorted(KINDS)),
    st.dictionaries(st.one_of(st.sampled_from([*KEYS, "port", "can", "address", "baud"]), st.text(max_size=5)), VALUES),
)
def test_given_any_section_then_it_is_read_or_rejected_with_places(kind: str, section: dict[str, Any]) -> None:
    try:
        driver = read_driver("any", {**section, "device": kind})
    except ConfigError as error:
        located = [(problem.element, problem.message) for problem in error.problems]
        assert located
        assert len(set(located)) == len(located)
        assert all(element.startswith("drivers.any") and message for element, message in located)
    else:
        assert driver.kind is KINDS[kind]


VEHICLE = """\
vehicle: cart
geometry: geometry.yaml
base_frame: Cart:Base
drivers:
  imu:
    device: gx1
    port: /dev/ttyUSB0
    messge: 3
  gps: {device: novatell, port: /dev/ttyUSB1}
"""


def test_given_a_vehicle_file_then_problems_of_all_drivers_have_their_lines(tmp_path: Path) -> None:
    path = tmp_path / "vehicle.yaml"
    path.write_text(VEHICLE)
    config = load_config(path)
    assert list(config.drivers) == ["imu", "gps"]
    found, wrong = read_drivers(config.drivers, SourceMap(str(path), read_config_lines(path)))
    assert not found
    assert [(problem.file, problem.line, problem.nearest[:1]) for problem in wrong] == [
        (str(path), 8, ("message",)),
        (str(path), 9, ("novatel",)),
    ]


def test_given_a_name_with_nothing_after_it_then_it_is_reported_and_the_others_are_read(tmp_path: Path) -> None:
    path = tmp_path / "vehicle.yaml"
    path.write_text(
        VEHICLE.replace("messge", "message")
        .replace(": 3\n", ": 0x03\n")
        .replace("{device: novatell, port: /dev/ttyUSB1}", "# later")
    )
    config = load_config(path)
    found, (problem,) = read_drivers(config.drivers, SourceMap(str(path), read_config_lines(path)))
    assert list(found) == ["imu"]
    assert (problem.line, problem.message) == (9, "drivers.gps is empty: device is missing")


def test_given_problems_of_a_driver_then_they_get_the_lines_of_their_keys(tmp_path: Path) -> None:
    lines = {("drivers",): 4, ("drivers", "w"): 5, ("drivers", "w", "wheels", "front.left"): 7}
    problems = [
        Problem(Severity.ERROR, "a", Location(element=element))
        for element in ("drivers.w.wheels.front.left.count", "wheels.front.left", "drivers.w.dbc")
    ]
    of_another_file = Problem(Severity.ERROR, "b", Location("x.dbc", 3))
    located = SourceMap("v.yaml", lines).locate_problems("w", [*problems, of_another_file])
    assert [str(each.source) for each in located] == [
        "v.yaml:7 (drivers.w.wheels.front.left.count)",
        "v.yaml:7 (drivers.w.wheels.front.left)",
        "v.yaml:5 (drivers.w.dbc)",
        "x.dbc:3",
    ]


@pytest.mark.parametrize("name", sorted(KINDS))
def test_given_a_kind_then_its_settings_take_the_drivers_name_and_its_sample_has_a_channel(name: str) -> None:
    kind = KINDS[name]
    settings = kind.load().settings
    assert settings.__dataclass_params__.frozen
    assert "source" in settings.__dataclass_fields__
    assert set(kind.presets) <= set(settings.__dataclass_fields__)
    assert kind.sample in CHANNELS
    assert kind.lines


def test_given_texts_of_faults_then_they_are_read_or_rejected_with_what_is_wrong() -> None:
    assert parse_fault("stall@10:2") == InjectedFault(10.0, "stall", 2.0)
    assert parse_fault("drop@0.5") == InjectedFault(0.5, "drop", 1.0)
    for text, expected in (
        ("stal@10", "did you mean stall"),
        ("stall", "KIND@SECONDS"),
        ("stall@x", "SECONDS"),
        ("stall@-1", "0 or more"),
        ("stall@1:0", "above 0"),
        ("stall@nan", "0 or more"),
        ("zzz@1", "drop: units"),
    ):
        with pytest.raises(ValueError, match=expected):
            parse_fault(text)


def test_given_a_line_when_shown_then_a_person_can_read_it():
    lines = (
        SerialSettings("/dev/ttyUSB0", 38400),
        TcpSettings("10.0.0.2:4001"),
        CanSettings("can0", bitrate=500_000),
        ModbusSettings("10.0.0.3:502", 2),
    )
    assert [str(line) for line in lines] == [
        "/dev/ttyUSB0, 38400 baud",
        "TCP 10.0.0.2:4001",
        "socketcan can0, 500000 bit/s",
        "Modbus 10.0.0.3:502, unit 2",
    ]


@pytest.mark.parametrize("device", ["gx1", "novatel", "nmea"])
def test_given_a_device_server_then_no_baud_rates_are_tried_that_nobody_could_set(device: str) -> None:
    driver = read_driver("imu", {"device": device, "address": "10.0.0.5:3001"})
    assert driver.device_settings.bauds == ()
    driver = read_driver("imu", {"device": device, "port": "/dev/ttyUSB0", "bauds": [9600, 38400]})
    assert driver.device_settings.bauds == (9600, 38400)
