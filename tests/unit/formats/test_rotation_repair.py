"""Rotations that are not quite: fixed in silence, with a warning, or refused."""

import math

import numpy as np
import pytest
from support_formats import YAML, miro, miro_body, miro_frame, only_problem, problems_of, read, rows

from modelserver.errors import Severity
from modelserver.formats.common import MAX_DEVIATION, ROUNDING_DEVIATION


def with_rotation(matrix):
    values = [" ".join(map(repr, (*row, 0.0))) for row in matrix]
    return miro([miro_body("Cart", miro_frame("Origin"), miro_frame("Mast", rows(values))), miro_body("Camera")])


def scale_rows(deviation):
    """Return a rotation of which |R'R - I| is `deviation`."""
    c, s = math.cos(0.3), math.sin(0.3)
    return (math.sqrt(1 + deviation) * np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])).tolist()


def test_the_reports_three_decimals_are_repaired_without_a_warning():
    text = with_rotation([[0.978, 0.0, 0.208], [0.0, 1.0, 0.0], [-0.208, 0.0, 0.978]])
    assert problems_of(text) == ()
    R = read(text).frame("Cart:Mast").pose.rotation
    assert np.abs(R.T @ R - np.eye(3)).max() < 1e-15
    assert R[0, 2] / R[0, 0] == pytest.approx(0.208 / 0.978)


@pytest.mark.parametrize("deviation", [1.01e-3, 0.0499])
def test_beyond_the_tolerance_it_is_repaired_with_a_warning_that_states_the_change(deviation):
    problem = only_problem(with_rotation(scale_rows(deviation)), Severity.WARNING)
    assert "replaced by the nearest" in problem.message
    assert f"{deviation:.2g}" in problem.message
    assert problem.element == "body Cart, frame Mast, HTransform"
    assert "Row1 to Row3" in problem.fix


@pytest.mark.parametrize("deviation", [0.0501, 1e10, 1e300])
def test_far_from_a_rotation_it_is_rejected(deviation):
    problem = only_problem(with_rotation(scale_rows(deviation)))
    assert "this is not a rotation" in problem.message
    assert "wrong digit or sign" in problem.fix


def test_just_below_the_tolerance_there_is_no_warning():
    assert problems_of(with_rotation(scale_rows(0.99e-3))) == ()
    assert (ROUNDING_DEVIATION, MAX_DEVIATION) == (1e-3, 0.05)


def test_a_reflection_is_rejected():
    problem = only_problem(with_rotation([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]]))
    assert "reflection" in problem.message


def test_products_that_overflow_are_rejected_without_a_numpy_warning():
    assert "not a rotation" in only_problem(with_rotation([[1e200, -1e200, 1e200]] * 3)).message


def test_a_position_out_of_reach_is_rejected():
    text = miro().replace('value="1 0 0 0"', 'value="1 0 0 -1e10"', 1)
    assert "out of reach" in only_problem(text).message


@pytest.mark.parametrize(
    ("quaternion", "severity", "message"),
    [
        ("[1.001, 0, 0, 0]", Severity.WARNING, "length 1.001, not 1; normalized"),
        ("[1, 1, 0, 0]", Severity.ERROR, "length 1.414, not 1"),
        ("[0, 0, 0, 0]", Severity.ERROR, "length 0, not 1"),
    ],
)
def test_a_quaternion_that_is_not_unit_is_treated_alike(quaternion, severity, message):
    problem = only_problem(YAML.replace("rpy_deg: [0, -10, 0]", f"quaternion: {quaternion}"), severity)
    assert message in problem.message
