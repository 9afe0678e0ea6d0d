"""Devices that send lines of text: columns, factors, checksums, and lines that are not used."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support_gps import START, Line, split_in_half, split_randomly

from modelserver.errors import ConfigError
from msdrivers.devices.text import (
    MAX_LINE,
    ColumnMap,
    TextImuDriver,
    TextImuSettings,
    TextJointsDriver,
    TextJointsSettings,
)
from msdrivers.emulate.imu import TextImuEmulator
from msdrivers.emulate.vehicle import TextJointsEmulator
from msdrivers.endpoint import EndpointPhase
from msdrivers.settings import find_unknown_joint, read_driver
from tests.unit.drivers.test_imu_units import turn

G, DEGREE = 9.80665, math.pi / 180.0
FIELDS: dict[str, ColumnMap] = {
    "time": ColumnMap(0, 1e-3),
    **{f"specific_force_{axis}": ColumnMap(1 + n, G) for n, axis in enumerate("xyz")},
    **{f"angular_velocity_{axis}": ColumnMap(4 + n, DEGREE) for n, axis in enumerate("xyz")},
}


def make_settings(**more: Any) -> TextImuSettings:
    return TextImuSettings(**{"source": "imu", "fields": FIELDS, "columns": 7, **more})


def connect(settings: TextImuSettings | None = None, **more: Any) -> Line:
    settings = settings or make_settings()
    return Line(TextImuDriver(settings), TextImuEmulator(turn(20.0), settings), **more)


@pytest.mark.parametrize(
    "more",
    [
        {},
        {"separator": ""},
        {"separator": ";", "checksum": "xor"},
        {"columns": 9, "starts_with": "$IMU", "checksum": "xor", "fields": {
            name: ColumnMap(each.column + 1, each.scale) for name, each in FIELDS.items()
        }},
        {"columns": 11, "fields": FIELDS | {f"magnetic_field_{axis}": ColumnMap(7 + n, 1e-6) for n, axis in
            enumerate("xyz")} | {"temperature": ColumnMap(10, 0.1, 5.0)}},
    ],
)  # fmt: skip
def test_given_a_description_of_columns_then_each_line_is_a_sample(more: Mapping[str, Any]) -> None:
    settings = make_settings(**more)
    line = connect(settings).open().run(5.0)
    assert line.phases[-1] is EndpointPhase.STREAMING
    assert 990 <= len(line.samples) <= 1000
    truth = {each.header.utime: each for each in turn(20.0)}
    for sample in line.samples[::50]:
        same = truth[sample.header.host_utime]
        assert sample.angular_velocity == pytest.approx(same.angular_velocity, rel=1e-6, abs=1e-9)
        assert sample.specific_force == pytest.approx(same.specific_force, rel=1e-6)
        assert sample.header.device_utime - 1_000_000 == pytest.approx(sample.header.host_utime - START, abs=2)
        if "temperature" in settings.fields:
            assert sample.magnetic_field == pytest.approx(same.magnetic_field, rel=1e-6)
            assert sample.temperature_celsius == pytest.approx(25.0)
        else:
            assert sample.magnetic_field is None
    assert not [name for name in line.driver.counts if name.startswith("rejected")]


@pytest.mark.parametrize("to_host", [split_in_half, lambda data: split_randomly(data, len(data))])
def test_given_split_bytes_then_each_line_is_a_sample(to_host: Any) -> None:
    assert len(connect(to_host=to_host).open().run(5.0).samples) >= 990


def test_given_a_turn_rate_alone_then_the_other_axes_are_not_known() -> None:
    fields = {"angular_velocity_z": ColumnMap(0, DEGREE)}
    line = connect(make_settings(fields=fields, columns=1)).open().run(1.0)
    x, y, z = line.samples[0].angular_velocity
    assert math.isnan(x)
    assert math.isnan(y)
    assert math.isfinite(z)
    assert line.samples[0].header.device_utime == 0


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (b"1,2,3", "rejected.columns"),
        (b"1,2,3,4,5,6,7,8", "rejected.columns"),
        (b"1,x,3,4,5,6,7", "rejected.number"),
        (b"1,2,,4,5,6,7", "rejected.number"),
        (b"1,nan,3,4,5,6,7", "rejected.range"),
        (b"1,1e9,3,4,5,6,7", "rejected.range"),
        (b"x" * (MAX_LINE + 5), "rejected.length"),
        (bytes(range(128, 250)), "rejected.columns"),
    ],
)
def test_given_a_line_that_cannot_be_then_it_is_rejected_and_shown(text: bytes, reason: str) -> None:
    line = Line(TextImuDriver(make_settings()), TextImuEmulator((), make_settings()))
    line.open()
    for _ in range(3):
        line.deliver(text + b"\r\n")
    line.run(2.0)
    assert not line.samples
    assert line.driver.counts[reason] == 2  # the first one may be the end of a line
    assert "check columns, separator and starts_with" in line.status_text


def test_given_a_wrong_checksum_or_another_line_then_it_is_not_used() -> None:
    settings = make_settings(checksum="xor", starts_with="1")
    line = Line(TextImuDriver(settings), TextImuEmulator((), settings))
    line.open()
    line.deliver(b"\n1,2,3,4,5,6,7*00\n#hello*4B\n1,0,0,1,0,0,0*" + b"30\n")
    assert line.driver.counts["rejected.checksum"] >= 1
    assert line.driver.counts["other_lines"] + line.driver.counts["rejected.checksum"] + len(line.samples) == 3


def test_given_nothing_then_the_cable_is_to_be_checked() -> None:
    line = Line(TextImuDriver(make_settings()), TextImuEmulator((), make_settings())).open().run(3.0)
    assert "no usable line for 1 s; received nothing: check power, cable and port" in line.status_text


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"fields": {"acceleration_x": ColumnMap(0)}}, "is unknown"),
        ({"fields": {"specific_force_x": ColumnMap(0)}}, "specific_force_y is missing"),
        ({"fields": {**FIELDS, "time": ColumnMap(7)}}, "is in column 7, but a line has 7"),
        ({"fields": {"time": ColumnMap(0)}}, "or both"),
        ({"checksum": "crc"}, "checksum is one of none, xor"),
        ({"columns": 0}, "columns is between"),
    ],
)
def test_given_a_wrong_description_then_the_error_names_it(more: Mapping[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        make_settings(**more)


def test_given_a_section_of_the_vehicle_file_then_its_settings_are_read() -> None:
    section = {
        "device": "text_imu", "port": "/dev/ttyACM0", "columns": 3,
        "fields": {f"angular_velocity_{axis}": {"column": n, "scale": DEGREE} for n, axis in enumerate("xyz")},
    }  # fmt: skip
    settings = read_driver("imu", section).device_settings
    assert settings.fields["angular_velocity_y"] == ColumnMap(1, DEGREE)


@given(st.binary(max_size=300), st.integers(0, 100))
def test_given_any_bytes_then_nothing_is_raised(data: bytes, seed: int) -> None:
    line = Line(TextImuDriver(make_settings()), TextImuEmulator((), make_settings()))
    line.open()
    for piece in split_randomly(data, seed):
        line.deliver(piece)
    assert sum(line.driver.counts.values()) >= 0


# --- joints ---------------------------------------------------------------------------------------------------

JOINTS = {"Pan": ColumnMap(0, DEGREE), "Tilt": ColumnMap(2, -DEGREE, 0.1)}


def make_joints(**more: Any) -> TextJointsSettings:
    return TextJointsSettings(**{"source": "head", "joints": JOINTS, "columns": 3, "separator": "", **more})


@pytest.mark.parametrize("time", [None, ColumnMap(3, 1e-3)])
def test_given_a_pan_tilt_head_then_its_joints_are_published_as_they_sweep(time: ColumnMap | None) -> None:
    settings = make_joints(time=time, columns=4, sigma=0.001)
    emulator = TextJointsEmulator(settings)
    line = Line(TextJointsDriver(settings), emulator).open().run(10.0)
    assert 490 <= len(line.samples) <= 500
    for sample in line.samples[::25]:
        values = emulator.get_values((sample.header.host_utime - START) * 1e-6)
        for joint in sample.joints:
            assert joint.position == pytest.approx(values[joint.name], abs=1e-6)
            assert joint.position_sigma == 0.001
        assert [each.name for each in sample.joints] == ["Pan", "Tilt"]
        assert (sample.header.device_utime > 0) == (time is not None)


def test_given_wrong_joints_then_the_error_names_them() -> None:
    for more, words in (
        ({"joints": {}}, "1 to 64 joints"),
        ({"columns": 2}, "Tilt is in column 2"),
        ({"sigma": -1.0}, "sigma"),
    ):
        with pytest.raises(ValueError, match=words):
            make_joints(**more)
    joints = {"Pann": {"column": 0}, "Tilt": {"column": 1}}
    section = {"device": "text_joints", "port": "/dev/ttyUSB3", "columns": 2, "joints": joints}
    (problem,) = find_unknown_joint(read_driver("head", section), ["Pan", "Tilt"])
    assert (problem.nearest, problem.fix) == (("Pan",), "write Pan")
    with pytest.raises(ConfigError, match="joints"):
        read_driver("head", {key: value for key, value in section.items() if key != "joints"})


def test_given_a_line_that_is_opened_again_then_the_rest_of_a_line_is_not_used() -> None:
    settings = make_settings(fields={"angular_velocity_z": ColumnMap(0)}, columns=2)
    line = Line(TextImuDriver(settings), TextImuEmulator((), settings)).open()
    line.deliver(b"3,4\n5,6\n7,")
    line.open()
    line.run(0.5)
    line.deliver(b"8\n9,10\n")
    found = [(each.angular_velocity[2], each.header.host_utime - START) for each in line.samples]
    assert found == [(5.0, 0), (9.0, 500_000)]
