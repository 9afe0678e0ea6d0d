"""Parameters of robot_localization as settings of a vehicle file, and what becomes of each."""

from __future__ import annotations

from pathlib import Path

import pytest

from modelserver.config.vehicle_file import load_config
from modelserver.errors import ModelServerError, Severity
from mstools import cli
from mstools.commands.check import check_vehicle
from mstools.robot_localization import FIELDS, INSTEAD, NOT_NEEDED, Outcome, read_ekf_settings

URDF = """
<robot name="rover">
  <link name="base_link"/><link name="gps_link"/><link name="imu_link"/>
  <joint name="g" type="fixed"><parent link="base_link"/><child link="gps_link"/><origin xyz="0 0 0.9"/></joint>
  <joint name="i" type="fixed"><parent link="base_link"/><child link="imu_link"/><origin xyz="0.2 0 0.1"/></joint>
</robot>
"""


def fields(*names: str) -> str:
    """The 15 flags of a source."""
    return str([name in names for name in FIELDS]).lower()


EKF = f"""
ekf_filter_node:
  ros__parameters:
    frequency: 30.0
    two_d_mode: true
    base_link_frame: base_link
    odom0: wheel/odom
    odom0_config: {fields("vx", "vyaw")}
    odom0_queue_size: 10
    imu0: imu/data
    imu0_config: {fields("yaw", "vyaw")}
    pose0: /amcl_pose
    pose0_config: {fields("x", "y", "yaw")}
    process_noise_covariance: [0.1]
    steering: 3
navsat_transform:
  ros__parameters:
    datum: [42.38, -71.14, 0.5]
    wait_for_datum: true
    yaw_offset: 1.5708
ekf_filter_node_map:
  ros__parameters:
    odom1: odometry/gps
    odom1_config: {fields("x", "y")}
"""


def write(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def test_given_two_filters_and_navsat_then_the_vehicle_file_has_their_sensors_rate_and_origin(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ekf, urdf = write(tmp_path / "ekf.yaml", EKF), write(tmp_path / "rover.urdf", URDF)
    with pytest.raises(SystemExit) as end:
        cli.main(["new", str(tmp_path / "my rover"), "--yes", "--from-ekf", str(ekf), "--from-urdf", str(urdf)])
    out, err = capsys.readouterr()
    assert (end.value.code or 0, err) == (0, "")
    config = load_config(tmp_path / "my rover" / "vehicle.yaml")
    assert config.base_frame == "base_link:Origin"
    assert config.publish.rate_hz == 30.0
    assert config.drivers == {}
    gps, imu, wheels = config.sensors.gps, config.sensors.imu, config.sensors.wheels
    assert gps is not None
    assert imu is not None
    assert wheels is not None
    assert (gps.channel, gps.frame, imu.frame) == ("GPS", "gps_link:Origin", "imu_link:Origin")
    assert sorted(wheels.frames) == ["left", "right"]
    assert config.origin.zone == 19
    assert config.origin.initial_utm == pytest.approx((323825, 4694187, 0.0), abs=1.0)
    _, problems = check_vehicle(str(tmp_path / "my rover" / "vehicle.yaml"))
    assert [each for each in problems if each.severity is not Severity.NOTE] == []
    assert f"cd '{tmp_path / 'my rover'}' && modelserver import-bag" in out
    assert "--track-width 0.6" in out
    instead = out[out.index(Outcome.OPEN.value) :]
    for words in (
        "its yaw is not used",
        "absolute_pose_t",
        "modelserver tune",
        "rpy_deg",
        "0.5 rad",
        "steering: no par",
    ):
        assert words in instead


@pytest.mark.parametrize("key", [*NOT_NEEDED, *INSTEAD])
def test_given_any_parameter_then_it_has_an_outcome(tmp_path: Path, key: str) -> None:
    ekf = write(tmp_path / "ekf.yaml", f"odom0: odom\nodom0_{key}: true\n{key}: true\n")
    found = read_ekf_settings(ekf)
    assert found.has_wheels
    assert [each.line for each in found.findings if each.key == key] == [3]
    assert all("no parameter" not in each.text for each in found.findings if each.key == key)


def test_given_parameters_of_ros_1_then_datum_is_a_text_and_there_is_no_node(tmp_path: Path) -> None:
    text = "frequency: 50\nbase_link_frame: chassis\ndatum: 42.38, -71.14, 0.0, map, chassis\nodom0: /odometry/gps\n"
    text += "wait_for_datum: true\n"
    found = read_ekf_settings(write(tmp_path / "ekf.yaml", text))
    assert (found.base_frame, found.rate_hz, found.has_gps, found.has_wheels) == ("chassis", 50.0, True, False)
    assert found.origin is not None
    assert (found.origin.zone, found.origin.north) == (19, True)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "no parameters of robot_localization"),
        ("node: [1, 2]\n", "no parameters of robot_localization"),
        ("odom0: [\n", "ekf.yaml:"),
        ("\tfrequency: 1\n", "tab"),
    ],
)
def test_given_another_file_then_the_error_names_what_is_expected(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(ModelServerError, match=words):
        read_ekf_settings(write(tmp_path / "ekf.yaml", text))


@pytest.mark.parametrize("datum", ["[]", "[99, 0, 0]", "[nan, 0, 0]", "here", "{}"])
def test_given_a_datum_that_is_none_then_it_is_left_open(tmp_path: Path, datum: str) -> None:
    found = read_ekf_settings(write(tmp_path / "ekf.yaml", f"wait_for_datum: true\ndatum: {datum}\n"))
    assert found.origin is None
    assert [each.outcome for each in found.findings if each.key == "datum"] == [Outcome.OPEN]


@pytest.mark.parametrize("text", ["", "wait_for_datum: false\n"])
def test_given_a_datum_that_the_node_ignores_then_it_is_no_origin(tmp_path: Path, text: str) -> None:
    found = read_ekf_settings(write(tmp_path / "ekf.yaml", f"{text}datum: [55.94, -3.18, 0]\n"))
    assert (found.origin, found.has_gps) == (None, True)
    assert ["wait_for_datum: true" in each.text for each in found.findings if each.key == "datum"] == [True]


def test_given_several_sources_of_a_kind_then_those_that_are_not_used_are_named(tmp_path: Path) -> None:
    text = "odom0: wheel/odom\nodom1: zed/odom\nimu0: imu/data\nimu1: imu2/data\n"
    found = read_ekf_settings(write(tmp_path / "ekf.yaml", text))
    left = {each.key: each.text for each in found.findings if each.outcome is Outcome.OPEN}
    assert left.keys() == {"odom1", "imu1"}
    assert "zed/odom" in left["odom1"]
    assert "imu2/data" in left["imu1"]


def test_given_a_base_frame_that_is_not_in_the_geometry_then_it_is_named_with_the_one_used(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ekf = write(tmp_path / "ekf.yaml", "base_link_frame: base_footprint\nodom0: odom\n")
    urdf = write(tmp_path / "rover.urdf", URDF)
    with pytest.raises(SystemExit):
        cli.main(["new", str(tmp_path / "rover"), "--yes", "--from-ekf", str(ekf), "--from-urdf", str(urdf)])
    out = capsys.readouterr().out
    assert "base_link_frame base_footprint is not used: base_frame is base_link:Origin; --base-frame sets it" in out
    assert "no source of gps, so the vehicle file has no sensors.gps; --gps own adds it" in out
