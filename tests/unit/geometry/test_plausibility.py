"""What is possible in a file but improbable: the warning, and that following its advice ends it."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from support_samples import write_vehicle

from modelserver.errors import Problem, Severity
from modelserver.formats import check_file
from modelserver.formats.common import looks_like_degrees, looks_like_radians
from mstools.commands.check import check_vehicle

GEOMETRY = """\
modelserver: geometry/1
name: cart
bodies:
  Cart:
    frames:
      Base: {}
      Left: {xyz: [0, 0.4, 0]}
      Right: {xyz: [0, -0.4, 0]}
      Mount: {xyz: [0.5, 0, 0.6], rpy_deg: [0, 0, 180]}
  Camera:
    frames:
      Foot: {}
      Lens: {xyz: [0.03, 0, 0.02]}
constraints:
  Pan:
    from: "Cart:Mount"
    to: "Camera:Foot"
    xyz: [0, 0, 0.1]
    joint: {type: revolute, axis: [0, 0, 1], limits_deg: [-170, 170], sigma_deg: 0.5}
"""

VEHICLE = """\
vehicle: cart
geometry: geometry.yaml
base_frame: Cart:Base
state_directory: state
sensors:
  wheels:
    channel: WHEELS
    frames: {front_left: "Cart:Left", front_right: "Cart:Right"}
drivers:
  wheels:
    device: wheels
    can: can0
    dbc: wheels.dbc
    wheels:
      front_left: {count: {signal: W.L, meters_per_count: 0.001}}
      front_right: {count: {signal: W.R, meters_per_count: 0.001}}
"""

DBC = 'BO_ 5 W: 8 A\n SG_ L : 0|16@1+ (1,0) [0|0] "" A\n SG_ R : 16|16@1+ (1,0) [0|0] "" A\n'


def check(folder: Path, geometry: str = GEOMETRY, vehicle: str = VEHICLE) -> list[Problem]:
    path = write_vehicle(folder, vehicle, geometry)
    (folder / "wheels.dbc").write_text(DBC)
    _, problems = check_vehicle(str(path))
    return [each for each in problems if each.severity is not Severity.NOTE]


def test_given_a_usual_vehicle_then_there_is_nothing_to_report(tmp_path: Path) -> None:
    assert check(tmp_path) == []


@pytest.mark.parametrize(
    ("old", "new", "message", "fix"),
    [
        ("[0.5, 0, 0.6]", "[500, 0, 600]", "781.025 m from where it is measured looks like millimeters", "0.781025 m"),
        ("xyz: [0, 0, 0.1]", "xyz: [0, 0, 100]", "100 m from where it is measured looks like millimeters", "0.1 m"),
        ("[0, 0, 180]", "[0, 0, 3.14159]", "rpy_deg: 3.14159 deg looks like radians", "write rpy, or 180"),
        ("[0, 0, 180]", "[-1.5708, 0, 0]", "rpy_deg: -1.5708 deg looks like radians", "-90"),
        ("rpy_deg: [0, 0, 180]", "rpy: [0, 0, 180]", "rpy: 180 rad looks like degrees", "write rpy_deg"),
        (
            "limits_deg: [-170, 170]",
            "limits: [-170, 170]",
            "the lower limit of its joint is -170 rad, 27.1 turns",
            "limits_deg",
        ),
        ("limits_deg: [-170, 170]", "limits_deg: [-3.14, 3.14]", "limits_deg: -3.14 deg looks like", "write limits"),
        ("sigma_deg: 0.5", "sigma: 0.5", "a sigma of 0.5 rad (29 deg) of a joint", "write sigma_deg"),
        ("180]}", "180], sigma: {xyz: 0.01, rpy: 1}}", "a sigma of 1 rad (57 deg)", "write rpy_deg"),
        (
            'from: "Cart:Mount"\n    to: "Camera:Foot"',
            'from: "Camera:Foot"\n    to: "Cart:Mount"',
            "constraint Pan goes from Camera to Cart, which is nearer to Cart: its pose is measured from Camera",
            "exchange From and To",
        ),
    ],
)
def test_given_an_improbable_geometry_then_it_is_a_warning(
    tmp_path: Path, old: str, new: str, message: str, fix: str
) -> None:
    (found,) = check(tmp_path, GEOMETRY.replace(old, new))
    assert found.severity is Severity.WARNING
    assert message in found.message
    assert fix in found.fix


def test_given_a_constraint_without_a_pose_then_its_direction_does_not_matter(tmp_path: Path) -> None:
    swapped = GEOMETRY.replace("    xyz: [0, 0, 0.1]\n", "").replace('from: "Cart:Mount"', 'from: "Camera:Foot"')
    assert check(tmp_path, swapped.replace('to: "Camera:Foot"', 'to: "Cart:Mount"')) == []


@pytest.mark.parametrize(
    ("old", "new", "severity", "message", "count"),
    [
        ('front_left: "Cart:Left"', 'front_left: "Cart:Right"', Severity.ERROR, "stand in one frame, Cart:Right", 1),
        (
            '"Cart:Left", front_right: "Cart:Right"',
            '"Cart:Right", front_right: "Cart:Left"',
            Severity.WARNING,
            "0.4 m to the",
            2,
        ),
        (
            "W.R, meters_per_count: 0.001",
            "W.R, meters_per_count: -0.001",
            Severity.WARNING,
            "rolls backward as its count",
            1,
        ),
    ],
)
def test_given_improbable_wheels_then_it_is_reported(
    tmp_path: Path, old: str, new: str, severity: Severity, message: str, count: int
) -> None:
    found = check(tmp_path, vehicle=VEHICLE.replace(old, new))
    assert [each.severity for each in found] == [severity] * count
    assert all(message in each.message for each in found)


def test_given_two_wheels_in_one_place_then_it_is_an_error_whatever_their_frames(tmp_path: Path) -> None:
    (found,) = check(tmp_path, GEOMETRY.replace("[0, -0.4, 0]", "[0, 0.4, 0]"))
    assert found.severity is Severity.ERROR
    assert "stand in one place" in found.message


def test_given_a_lever_arm_of_a_building_then_it_is_a_warning(tmp_path: Path) -> None:
    far = GEOMETRY.replace("      Left:", "      Antenna: {xyz: [20, 25, 1]}\n      Left:")
    sensors = VEHICLE.replace("sensors:\n", 'sensors:\n  gps: {channel: GPS, frame: "Cart:Antenna"}\n')
    messages = [each.message for each in check(tmp_path, far, sensors)]
    assert "Cart:Antenna is 32.0312 m from Cart:Base" in messages


def test_given_frames_beside_their_body_then_the_advice_when_followed_is_a_remedy(tmp_path: Path) -> None:
    camera = "  Camera:\n    frames:\n      Foot: {}\n      Lens: {xyz: [0.03, 0, 0.02]}\n"
    path = tmp_path / "geometry.yaml"
    path.write_text(GEOMETRY.replace(camera, camera.replace("    frames:", "  frames:")))
    model, (found,) = check_file(path)
    assert model is None
    assert "frames stands beside the body Camera, not within it" in found.message
    assert "indent frames and what is below it further than Camera" in found.fix
    lines = path.read_text().splitlines()
    lines[found.line - 1 : found.line + 2] = [f"  {each}" for each in lines[found.line - 1 : found.line + 2]]
    path.write_text("\n".join(lines))
    assert check_file(path)[0] is not None


def test_given_an_unknown_body_then_the_advice_lists_those_that_there_are(tmp_path: Path) -> None:
    path = tmp_path / "geometry.yaml"
    path.write_text(GEOMETRY.replace('from: "Cart:Mount"', 'from: "Submarine:Mount"'))
    _, (found,) = check_file(path)
    names = re.search(r"bodies are: (.*)", found.fix)
    assert names is not None
    assert names[1] == "Cart, Camera"


@pytest.mark.parametrize("value", [3.14, -3.14159, 1.57, 1.5708, 6.2832, 0.785, 0.7854, 2.094, 4.71238898])
def test_given_a_fraction_of_pi_then_it_looks_like_radians(value: float) -> None:
    assert looks_like_radians(value)


@pytest.mark.parametrize("value", [0.0, 3.0, 3.1, 1.5, 1.6, 0.8, 1.05, 2.1, 90.0, 180.0, 12.566, 31.4159])
def test_given_another_number_of_degrees_then_it_does_not(value: float) -> None:
    assert not looks_like_radians(value)


@pytest.mark.parametrize(("value", "does"), [(3.0, False), (6.2832, False), (4.7, False), (5.0, True), (6.5, True)])
def test_given_a_number_of_radians_then_more_than_a_turn_looks_like_degrees(value: float, does: bool) -> None:
    assert looks_like_degrees(value) is does
    assert looks_like_degrees(-value) is does
