"""Check of a mount by the direction of gravity."""

from __future__ import annotations

import math

import pytest

from modelserver.transforms import so3
from modelserver.transforms.so3 import Quaternion, Vector3
from mstools.calibration import CalibrationError
from mstools.calibration.mount import MAX_TILT, aligned_rotations, check_mount, name_axis


def create_mount(*rpy_deg: float) -> Quaternion:
    return so3.from_rpy(*(math.radians(each) for each in rpy_deg))


def compute_force(q_base_sensor: Quaternion, up: Vector3 = (0.0, 0.0, 9.81)) -> Vector3:
    return so3.rotate(so3.conjugate(q_base_sensor), up)


def test_given_the_mount_of_the_husky_when_gravity_is_on_y_then_it_is_consistent() -> None:
    advice = check_mount((0.1, 9.7, -0.2), create_mount(90, 0, -90))
    assert advice.is_consistent
    assert advice.candidates == ()
    assert advice.angle == pytest.approx(math.hypot(0.1, 0.2) / 9.7, rel=1e-2)
    assert "is consistent" in advice.text
    assert "+y axis" in advice.text


def test_given_an_upright_mount_when_gravity_is_on_y_then_the_candidates_are_the_nearest_first() -> None:
    advice = check_mount((0.0, 9.7, 0.0), create_mount(0, 0, 0))
    assert not advice.is_consistent
    assert advice.angle == pytest.approx(math.pi / 2)
    assert [each.rpy_deg for each in advice.candidates[:1]] == [(90.0, 0.0, 0.0)]
    assert {each.rpy_deg for each in advice.candidates} == {
        (90.0, 0.0, 0.0),
        (90.0, 0.0, 90.0),
        (90.0, 0.0, -90.0),
        (90.0, 0.0, 180.0),
    }
    turns = [each.rotation_angle for each in advice.candidates]
    assert turns == pytest.approx([math.pi / 2, 2 * math.pi / 3, 2 * math.pi / 3, math.pi])
    assert advice.text.startswith(
        "gravity is measured along the sensor's +y axis, but up in the geometry is +z: 90 deg apart; mounts that "
        "fit: rpy_deg [90, 0, 0], "
    )
    assert "[90, 0, -90]" in advice.text


def test_given_a_sensor_upside_down_then_the_sign_of_the_driver_is_questioned() -> None:
    advice = check_mount((0.0, 0.1, -9.8), create_mount(0, 0, 0))
    assert {each.rpy_deg[0] for each in advice.candidates} == {180.0}
    assert "driver publishes gravity instead of specific force" in advice.text


def test_given_a_bracket_with_a_tilt_of_its_own_then_the_candidates_have_it() -> None:
    advice = check_mount((0.2, 9.7, 0.1), create_mount(0, 0, 3))
    assert {each.rpy_deg for each in advice.candidates} == {
        (90.0, 0.0, 3.0),
        (90.0, 0.0, 93.0),
        (90.0, 0.0, -87.0),
        (90.0, 0.0, -177.0),
    }


@pytest.mark.parametrize("true", aligned_rotations())
@pytest.mark.parametrize("configured", [create_mount(0, 0, 0), create_mount(90, 0, -90), create_mount(0, -90, 0)])
def test_given_any_mount_along_the_axes_then_the_true_one_is_among_the_candidates_or_is_consistent(
    true: Quaternion, configured: Quaternion
) -> None:
    advice = check_mount(compute_force(true), configured)
    if advice.is_consistent:
        assert advice.angle < 1e-9
    else:
        assert len(advice.candidates) == 4
        off = [
            math.hypot(*so3.logarithm(so3.normalize(so3.multiply(so3.conjugate(true), create_mount(*each.rpy_deg)))))
            for each in advice.candidates
        ]
        assert min(off) < 1e-6


def test_given_the_rotations_of_a_cube_then_there_are_24() -> None:
    rotations = {tuple(round(each, 6) for each in q) for q in aligned_rotations()}
    assert len(rotations) == 24


def test_given_a_sensor_that_is_mounted_askew_then_no_mount_fits() -> None:
    true = create_mount(0, -45, 0)
    advice = check_mount(compute_force(true), create_mount(0, 0, 0))
    assert not advice.is_consistent
    assert advice.candidates == ()
    assert "no mount along the vehicle's axes fits" in advice.text


def test_given_a_slope_then_the_limit_decides() -> None:
    for slope, agrees in ((MAX_TILT - 0.01, True), (MAX_TILT + 0.01, False)):
        up = (9.81 * math.sin(slope), 0.0, 9.81 * math.cos(slope))
        assert check_mount(up, create_mount(0, 0, 0)).is_consistent is agrees


@pytest.mark.parametrize(
    "force", [(0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, 12.0), (math.nan, 0.0, 9.8), (math.inf, 0.0, 0.0)]
)
def test_given_no_gravity_then_it_is_rejected(force: Vector3) -> None:
    with pytest.raises(CalibrationError, match=r"gravity is 9\.81"):
        check_mount(force, create_mount(0, 0, 0))


def test_given_directions_then_the_names_of_their_axes_are_returned() -> None:
    assert name_axis((0.1, -0.9, 0.2)) == "-y"
    assert name_axis((0.0, 0.0, 1.0)) == "+z"
