"""`modelserver new`: every file that it writes loads without a finding, and what must be measured is listed."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from modelserver import load_model
from modelserver.config.vehicle_file import load_config
from modelserver.errors import Severity
from modelserver.messages import GpsSample, ImuSample, WheelsSample
from msdrivers.line_settings import SerialSettings
from msdrivers.registry import KINDS
from mstools import cli
from mstools.commands.check import check_vehicle
from mstools.launch.drive import make_simulation
from mstools.scaffold.templates import TEMPLATES

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    def new(*arguments: object) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as end:
            cli.main(["new", *map(str, arguments)])
        out, err = capsys.readouterr()
        return int(end.value.code or 0), out, err

    return new


def find_problems(folder: Path) -> list[str]:
    _, problems = check_vehicle(str(folder / "vehicle.yaml"))
    return [str(each) for each in problems if each.severity is not Severity.NOTE]


def test_given_a_pan_tilt_head_then_the_camera_moves_with_its_joints(tmp_path: Path, run: Run) -> None:
    folder = tmp_path / "head"
    code, out, err = run(folder, "--yes", "--pan-tilt", "/dev/ttyUSB7")
    assert (code, err) == (0, "")
    assert find_problems(folder) == []
    model = load_model(folder / "geometry.yaml")
    assert list(model.joints) == ["Pan", "Tilt"]
    # to the left and up: what lies ahead of the lens
    path = model.get_kinematic_path("Camera:Lens", "HeadVehicle:Base")
    positions = {"Pan": (0.2,), "Tilt": (0.3,)}
    ahead = path.compute_pose([positions[each.name] for each in path.joints])
    x, y, z = np.subtract(ahead.transform((0.0, 0.0, 1.0)), ahead.xyz)
    assert (math.atan2(y, x), math.asin(z)) == pytest.approx((0.2, 0.3))
    head = load_config(folder / "vehicle.yaml").drivers["head"]
    assert (head["device"], head["port"], set(head["joints"])) == ("text_joints", "/dev/ttyUSB7", {"Pan", "Tilt"})
    assert ":49: port: its line" in out


@pytest.mark.parametrize("options", [("--no-camera",), ("--from-urdf", "arm.urdf")])
def test_given_a_head_without_a_camera_then_the_error_names_the_option(
    options: tuple[str, ...], tmp_path: Path, run: Run
) -> None:
    code, _, err = run(tmp_path / "rover", "--yes", "--pan-tilt", "/dev/ttyUSB7", *options)
    assert (code, "--camera" in err) == (2, True)


@pytest.mark.parametrize("kind", TEMPLATES)
def test_given_a_kind_of_vehicle_then_its_files_are_clean_and_what_must_be_measured_is_listed(
    kind: str, tmp_path: Path, run: Run
) -> None:
    folder = tmp_path / "my-rover"
    code, out, err = run(folder, "--yes", "--vehicle", kind, "--camera")
    assert (code, err) == (0, "")
    assert find_problems(folder) == []
    marked = [
        f"{path.name}:{number}:"
        for path in folder.iterdir()
        for number, line in enumerate(path.read_text().splitlines(), 1)
        if "# MEASURE: " in line
    ]
    assert len(marked) > 10
    assert all(mark in out for mark in marked)
    assert "modelserver up --emulate" in out
    assert "written" not in out.partition("measured or adapted")[2]
    config = load_config(folder / "vehicle.yaml")
    assert (config.vehicle, config.base_frame) == ("my-rover", "MyRover:Base")
    sensors = (GpsSample, ImuSample, WheelsSample)
    events = make_simulation(config, 1_800_000_000_000_000, 4.0, sensors=sensors).events(4.0)
    assert {type(event) for event in events} >= set(sensors)


@pytest.mark.parametrize(
    ("option", "name"),
    [
        *(("--gps", name) for name, kind in KINDS.items() if kind.sample is GpsSample),
        *(("--imu", name) for name, kind in KINDS.items() if kind.sample is ImuSample),
    ],
)
def test_given_a_device_then_its_driver_is_configured(option: str, name: str, tmp_path: Path, run: Run) -> None:
    section: Any
    if SerialSettings in KINDS[name].lines:
        assert run(tmp_path, "--yes", "--name", "cart", option, f"{name}@/dev/ttyACM7")[0] == 0
        assert find_problems(tmp_path) == []
        section = load_config(tmp_path / "vehicle.yaml").drivers[option.removeprefix("--")]
        assert (section["device"], section["port"]) == (name, "/dev/ttyACM7")
    if option == "--gps":
        assert run(tmp_path, "--yes", "--name", "cart", option, f"{name}@10.0.0.7:3001", "--force")[0] == 0
        section = load_config(tmp_path / "vehicle.yaml").drivers["gps"]
        assert section["address"] == "10.0.0.7:3001"


def test_given_nothing_on_the_vehicle_then_the_files_are_valid(tmp_path: Path, run: Run) -> None:
    options = ("--gps", "none", "--imu", "none", "--wheels", "none", "--no-camera")
    assert run(tmp_path, "--yes", "--name", "bare", *options)[0] == 0
    assert find_problems(tmp_path) == []
    assert not (tmp_path / "wheels.dbc").exists()


def test_given_two_devices_then_each_has_a_port_of_its_own(tmp_path: Path, run: Run) -> None:
    assert run(tmp_path, "--yes", "--name", "cart")[0] == 0
    drivers: Any = load_config(tmp_path / "vehicle.yaml").drivers
    assert drivers["gps"]["port"] != drivers["imu"]["port"]


def test_given_files_that_exist_then_none_is_touched_without_force(tmp_path: Path, run: Run) -> None:
    (tmp_path / "geometry.yaml").write_text("mine")
    code, _, err = run(tmp_path, "--yes", "--name", "cart")
    assert (code, [path.name for path in tmp_path.iterdir()]) == (1, ["geometry.yaml"])
    assert "geometry.yaml exists; give --force" in err
    assert (tmp_path / "geometry.yaml").read_text() == "mine"
    assert run(tmp_path, "--yes", "--name", "cart", "--force")[0] == 0


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("--vehicle", "skit"), "did you mean skid?"),
        (("--gps", "novatell"), "did you mean novatel?"),
        (("--name", "a: b"), "a name begins with a letter"),
        (("--base-frame", "Cart:Base"), "goes with --from-urdf"),
    ],
)
def test_given_a_wrong_option_then_nothing_is_written(
    arguments: tuple[str, ...], expected: str, tmp_path: Path, run: Run
) -> None:
    code, _, err = run(tmp_path, "--yes", *arguments)
    assert code == 2
    assert expected in " ".join(err.split())
    assert list(tmp_path.iterdir()) == []


URDF = """<robot name="arm">
  <link name="base_link"/> <link name="imu_link"/> <link name="gnss_antenna"/>
  <joint name="a" type="fixed"><parent link="base_link"/><child link="imu_link"/></joint>
  <joint name="b" type="fixed"><parent link="base_link"/><child link="gnss_antenna"/><origin xyz="0 0 1"/></joint>
</robot>
"""


def test_given_a_urdf_then_its_frames_are_found_or_asked_for(tmp_path: Path, run: Run) -> None:
    urdf = tmp_path / "arm.urdf"
    urdf.write_text(URDF)
    assert run(tmp_path / "a", "--yes", "--from-urdf", urdf)[0] == 0
    assert find_problems(tmp_path / "a") == []
    config = load_config(tmp_path / "a" / "vehicle.yaml")
    assert config.base_frame == "base_link:Origin"
    assert config.sensors.gps is not None
    assert config.sensors.gps.frame == "gnss_antenna:Origin"
    urdf.write_text(URDF.replace("gnss_antenna", "mast"))
    code, _, err = run(tmp_path / "b", "--yes", "--from-urdf", urdf)
    assert code == 2
    assert "mast:Origin" in " ".join(err.split())
    assert run(tmp_path / "b", "--yes", "--from-urdf", urdf, "--gps-frame", "mast:Origin")[0] == 0


def test_given_a_terminal_then_it_asks_until_the_answer_is_known(
    tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    answers = iter(
        ["cart", "tank", "tracked", "novatel", "/dev/ttyUSB5", "gx1", "/dev/ttyUSB6", "none", "y", "/dev/ttyUSB7"]
    )
    monkeypatch.setattr(sys.stdin, "isatty", lambda: True)
    monkeypatch.setattr("typer.prompt", lambda question, default: next(answers))
    monkeypatch.setattr("typer.confirm", lambda question, default: next(answers) == "y")
    code, out, _ = run(tmp_path)
    assert code == 0
    assert next(answers, None) is None
    assert "'tank' is none of these" in out
    config = load_config(tmp_path / "vehicle.yaml")
    drivers: Any = config.drivers
    assert set(drivers) == {"gps", "imu", "head"}
    assert drivers["gps"]["port"] == "/dev/ttyUSB5"
    assert find_problems(tmp_path) == []
