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
from msdrivers.registry import KINDS, SerialSettings
from mstools import cli
from mstools.commands.check import check_vehicle
from mstools.commands.new import TEMPLATES
from mstools.launch.drive import make_simulation

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
        (("--name", "on"), "on is a value in YAML"),
        (("--gps", "ublox@vn100"), "'vn100': the line of ublox is the path of a port, e.g. /dev/ttyUSB0 or HOST:PORT"),
        (("--imu", "gx1@y"), "'y': the line of gx1 is the path of a port"),
        (("--gps", "gpsd@/dev/ttyUSB0"), "the line of gpsd is HOST:PORT"),
        (("--wheels", "y"), "'y': the line of wheels is a CAN interface, e.g. can0"),
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


def make_urdf(links: dict[str, str], wheels: dict[str, tuple[float, float]], radius: float = 0.0) -> str:
    """Return a URDF: each link fixed at a place of base_link, and each wheel turning at a place, 0.2 m up."""
    parts = ['<robot name="rover"><link name="base_link"/>']
    for name, place in links.items():
        parts.append(
            f'<link name="{name}"/><joint name="{name}_joint" type="fixed"><parent link="base_link"/>'
            f'<child link="{name}"/><origin xyz="{place}"/></joint>'
        )
    for name, (x, y) in wheels.items():
        shape = f'<collision><geometry><cylinder radius="{radius}" length="0.1"/></geometry></collision>'
        parts.append(
            f'<link name="{name}">{shape if radius else ""}</link><joint name="{name}_joint" type="continuous">'
            f'<parent link="base_link"/><child link="{name}"/><origin xyz="{x} {y} 0.2"/><axis xyz="0 1 0"/></joint>'
        )
    return "".join(parts) + "</robot>"


FOUR = {"wheel_fl": (0.5, 0.3), "wheel_fr": (0.5, -0.3), "wheel_rl": (-0.1, 0.3), "wheel_rr": (-0.1, -0.3)}


@pytest.mark.parametrize(
    ("links", "gps", "imu"),
    [
        # the parts themselves, not the frames of their joints on the parent
        ({"gps_link": "0 0 0.9", "imu_link": "0.2 0 0.1"}, "gps_link", "imu_link"),
        # a part before the one that carries it
        ({"gps_0_mount": "0 0 0.8", "gps_0_link": "0 0 1", "IMUPlate": "0 0 0", "Imu1": "0 0 0"}, "gps_0_link", "Imu1"),
        ({"wifi_antenna": "0 0 1", "navsat": "0 0 0.5", "maximum": "0 0 2", "my_imu": "0 0 0"}, "navsat", "my_imu"),
    ],
)
def test_given_a_urdf_then_each_sensor_is_on_its_own_link_and_the_guess_is_marked(
    links: dict[str, str], gps: str, imu: str, tmp_path: Path, run: Run
) -> None:
    urdf = tmp_path / "rover.urdf"
    urdf.write_text(make_urdf(links, {}))
    code, out, _ = run(tmp_path / "a", "--yes", "--from-urdf", urdf)
    sensors = load_config(tmp_path / "a" / "vehicle.yaml").sensors
    assert (code, sensors.wheels) == (0, None)
    assert sensors.gps is not None
    assert sensors.imu is not None
    assert (sensors.gps.frame, sensors.imu.frame) == (f"{gps}:Origin", f"{imu}:Origin")
    for what in ("base_frame", "gps", "imu"):
        assert f"{what}: guessed" in out.partition("To be measured")[2]
    place = ", ".join(f"{float(each):g}" for each in links[gps].split())
    assert f"gps: guessed from its name, ({place}) m from base_link:Origin" in out
    assert "z of gx1 itself is down" in out
    # what was given is no guess
    given = ("--gps-frame", f"{gps}:Origin", "--imu-frame", f"{imu}:Origin", "--base-frame", "base_link:Origin")
    _, out, _ = run(tmp_path / "b", "--yes", "--from-urdf", urdf, "--imu", "vectornav", *given)
    assert "guessed" not in out


@pytest.mark.parametrize(
    ("wheels", "vehicle", "expected"),
    [
        (FOUR, "", {"front_left": (0.5, 0.3), "rear_right": (-0.1, -0.3)}),
        (FOUR, "ackermann", {"rear_left": (-0.1, 0.3), "rear_right": (-0.1, -0.3)}),
        (FOUR, "tracked", {"left": (0.2, 0.3), "right": (0.2, -0.3)}),
        ({"l_wheel": (0.0, 0.2), "r_wheel": (0.0, -0.2), "caster_wheel": (0.3, 0.0)}, "", {"left": (0.0, 0.2)}),
    ],
)
@pytest.mark.parametrize("radius", [0.0, 0.25])
def test_given_a_urdf_with_wheels_then_they_have_contact_points(
    radius: float,
    wheels: dict[str, tuple[float, float]],
    vehicle: str,
    expected: dict[str, tuple[float, float]],
    tmp_path: Path,
    run: Run,
) -> None:
    urdf = tmp_path / "rover.urdf"
    urdf.write_text(make_urdf({"gps": "0 0 1", "imu": "0 0 0"}, wheels, radius))
    options = ("--vehicle", vehicle) if vehicle else ()
    code, out, _ = run(tmp_path / "a", "--yes", "--from-urdf", urdf, "--wheels", "can0", *options)
    assert (code, find_problems(tmp_path / "a")) == (0, [])
    config, model = load_config(tmp_path / "a" / "vehicle.yaml"), load_model(tmp_path / "a" / "geometry.yaml")
    assert config.sensors.wheels is not None
    for name, place in expected.items():
        found = model.get_transformation(config.sensors.wheels.frames[name], "base_link:Origin").pose
        assert found.xyz == pytest.approx((*place, 0.2 - radius))
        assert f"{name}: guessed: where " in out
    count = len(config.sensors.wheels.frames)
    assert count == (4 if wheels is FOUR and not vehicle else 2)
    # the point that moves straight ahead in a turn
    rolling = model.get_transformation(config.rolling_frame or config.base_frame, "base_link:Origin").pose
    x = {"": 0.2, "ackermann": -0.1, "tracked": 0.2}[vehicle] if wheels is FOUR else 0.0
    assert rolling.xyz[:2] == pytest.approx((x, 0.0))


def test_given_a_urdf_without_wheels_then_those_asked_for_have_a_typical_place(tmp_path: Path, run: Run) -> None:
    urdf = tmp_path / "rover.urdf"
    urdf.write_text(make_urdf({"gps": "0 0 1", "imu": "0 0 0"}, {}))
    code, out, _ = run(tmp_path / "a", "--yes", "--from-urdf", urdf, "--wheels", "can0")
    assert (code, find_problems(tmp_path / "a")) == (0, [])
    assert "front_left: a typical place: the geometry has no such wheel" in out


def test_given_a_urdf_with_steered_wheels_then_the_vehicle_is_one_with_a_rear_axle(tmp_path: Path, run: Run) -> None:
    urdf = tmp_path / "car.urdf"
    text = make_urdf(
        {"gps": "0 0 1", "imu": "0 0 0", "knuckle": "1 0.5 0.3"}, {k: FOUR[k] for k in FOUR if "r" in k[-2]}
    )
    text = text.replace('knuckle_joint" type="fixed"', 'knuckle_joint" type="revolute"').replace(
        "</robot>",
        '<link name="front_wheel"/><joint name="f" type="continuous"><parent link="knuckle"/>'
        '<child link="front_wheel"/>'
        '<axis xyz="0 1 0"/></joint></robot>',
    )
    urdf.write_text(
        text.replace(
            '<origin xyz="1 0.5 0.3"/>',
            '<origin xyz="1 0.5 0.3"/><axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/>',
        )
    )
    assert run(tmp_path / "a", "--yes", "--from-urdf", urdf, "--wheels", "can0")[0] == 0
    wheels = load_config(tmp_path / "a" / "vehicle.yaml").sensors.wheels
    assert wheels is not None
    assert wheels.kinematics == "ackermann"


def test_given_no_gps_then_the_geometry_needs_no_frame_for_it(tmp_path: Path, run: Run) -> None:
    urdf = tmp_path / "rover.urdf"
    urdf.write_text(make_urdf({"imu": "0 0 0"}, {}))
    assert run(tmp_path / "a", "--yes", "--from-urdf", urdf, "--gps", "none")[0] == 0


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
