"""What gravity says of a mount."""

from __future__ import annotations

import math

import pytest

from modelserver.localization.calibration.errors import CalibrationError
from modelserver.localization.calibration.mount import LIMIT, advise, aligned_rotations, axis_name
from modelserver.spatial import so3
from modelserver.spatial.so3 import Quaternion, Vector3


def stated(*rpy_deg: float) -> Quaternion:
    return so3.from_rpy(*(math.radians(each) for each in rpy_deg))


def felt_by(q_base_sensor: Quaternion, up: Vector3 = (0.0, 0.0, 9.81)) -> Vector3:
    return so3.rotate(so3.conjugate(q_base_sensor), up)


def test_given_the_huskys_mount_when_gravity_is_on_y_then_it_agrees() -> None:
    advice = advise((0.1, 9.7, -0.2), stated(90, 0, -90))
    assert advice.agrees
    assert advice.fitting == ()
    assert advice.angle == pytest.approx(math.hypot(0.1, 0.2) / 9.7, rel=1e-2)
    assert "agrees" in advice.text
    assert "+y axis" in advice.text


def test_given_an_upright_mount_when_gravity_is_on_y_then_the_fitting_ones_nearest_first() -> None:
    advice = advise((0.0, 9.7, 0.0), stated(0, 0, 0))
    assert not advice.agrees
    assert advice.angle == pytest.approx(math.pi / 2)
    assert [each.rpy_deg for each in advice.fitting[:1]] == [(90.0, 0.0, 0.0)]
    assert {each.rpy_deg for each in advice.fitting} == {
        (90.0, 0.0, 0.0),
        (90.0, 0.0, 90.0),
        (90.0, 0.0, -90.0),
        (90.0, 0.0, 180.0),
    }
    turns = [each.turn for each in advice.fitting]
    assert turns == pytest.approx([math.pi / 2, 2 * math.pi / 3, 2 * math.pi / 3, math.pi])
    assert advice.text.startswith(
        "gravity is felt along the sensor's +y axis, but the geometry says +z points up (90 deg apart); mounts that "
        "fit: rpy_deg [90, 0, 0], "
    )
    assert "[90, 0, -90]" in advice.text


def test_given_a_unit_upside_down_then_the_sign_of_the_driver_is_asked_about() -> None:
    advice = advise((0.0, 0.1, -9.8), stated(0, 0, 0))
    assert {each.rpy_deg[0] for each in advice.fitting} == {180.0}
    assert "driver gives gravity where specific force" in advice.text


def test_given_a_bracket_with_a_tilt_of_its_own_then_the_offers_keep_it() -> None:
    advice = advise((0.2, 9.7, 0.1), stated(0, 0, 3))
    assert {each.rpy_deg for each in advice.fitting} == {
        (90.0, 0.0, 3.0),
        (90.0, 0.0, 93.0),
        (90.0, 0.0, -87.0),
        (90.0, 0.0, -177.0),
    }


@pytest.mark.parametrize("true", aligned_rotations())
@pytest.mark.parametrize("told", [stated(0, 0, 0), stated(90, 0, -90), stated(0, -90, 0)])
def test_given_any_mount_along_the_axes_then_the_true_one_is_among_the_offers_or_agrees(
    true: Quaternion, told: Quaternion
) -> None:
    advice = advise(felt_by(true), told)
    if advice.agrees:
        assert advice.angle < 1e-9
    else:
        assert len(advice.fitting) == 4
        off = [
            math.hypot(*so3.logarithm(so3.normalized(so3.multiply(so3.conjugate(true), stated(*each.rpy_deg)))))
            for each in advice.fitting
        ]
        assert min(off) < 1e-6


def test_given_the_rotations_of_a_cube_then_there_are_24() -> None:
    rotations = {tuple(round(each, 6) for each in q) for q in aligned_rotations()}
    assert len(rotations) == 24


def test_given_a_unit_that_stands_askew_then_the_tilt_that_levels_it() -> None:
    true = stated(0, -45, 0)
    advice = advise(felt_by(true), stated(0, 0, 0))
    assert not advice.agrees
    assert advice.fitting == ()
    assert advice.corrected_rpy_deg == pytest.approx((0.0, -45.0, 0.0))
    assert "rpy_deg [0, -45, 0] would fit" in advice.text


def test_given_a_slope_then_the_limit_decides() -> None:
    for slope, agrees in ((LIMIT - 0.01, True), (LIMIT + 0.01, False)):
        up = (9.81 * math.sin(slope), 0.0, 9.81 * math.cos(slope))
        assert advise(up, stated(0, 0, 0)).agrees is agrees
        assert advise(up, stated(0, 0, 0), limit=1.0).agrees


@pytest.mark.parametrize(
    "force", [(0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, 12.0), (math.nan, 0.0, 9.8), (math.inf, 0.0, 0.0)]
)
def test_given_no_gravity_then_refused(force: Vector3) -> None:
    with pytest.raises(CalibrationError, match=r"gravity is 9\.81"):
        advise(force, stated(0, 0, 0))


def test_given_directions_then_their_axes_names() -> None:
    assert axis_name((0.1, -0.9, 0.2)) == "-y"
    assert axis_name((0.0, 0.0, 1.0)) == "+z"
