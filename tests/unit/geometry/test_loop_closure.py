"""Loops against cases worked out by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chi2, norm

from modelserver.errors import Location, Severity
from modelserver.geometry import Joint, JointType, ModelBuilder, Sigma
from modelserver.geometry.topology import (
    MAX_SIGMAS,
    Topology,
    chi_square_to_sigmas,
    compute_misclosure,
    residual_significance,
)
from modelserver.transforms import Pose

MILLIMETER = Sigma((0.001, 0.0, 0.0))
Y = (0.0, 1.0, 0.0)


def ladder(miss, sigma=MILLIMETER, joint=None, frame_sigma=MILLIMETER):
    """Return a builder of two bodies joined twice, a meter apart on either; the misclosure is `miss` along x."""
    builder = ModelBuilder()
    builder.add_body("A").add_frame("a").add_frame("b", Pose((1, 0, 0)), sigma=frame_sigma)
    builder.add_body("B").add_frame("a").add_frame("b", Pose((1 + miss, 0, 0)), sigma=frame_sigma)
    builder.add_constraint("one", "A:a", "B:a")
    builder.add_constraint("two", "A:b", "B:b", sigma=sigma, joint=joint or Joint(), source=Location("ladder", 7))
    return builder


def round_of(model):
    (loop,) = Topology(model.bodies, model.constraints).find_loop_closures()
    return compute_misclosure(loop.path, model.frame)


def only(model):
    (problem,) = model.problems
    assert problem.line == 7
    return problem


def test_given_three_surveys_of_a_millimeter_then_a_miss_is_weighed_by_their_root_of_squares():
    found = round_of(ladder(0.005).build())
    assert found.meters == pytest.approx(0.005)
    assert found.radians == 0.0
    # A:b, B:b and the constraint itself: one direction is uncertain, so it is the plain number of sigmas
    assert found.sigmas == pytest.approx(5 / math.sqrt(3))
    assert (found.missing_sigmas, found.joints) == ((), ())


@pytest.mark.parametrize("degrees", [3, 4, 10, 28, 29, 30, 90, 180])
def test_given_a_mount_turned_the_wrong_way_then_no_survey_excuses_it(degrees):
    survey = Sigma((0.002,) * 3, (math.radians(0.2),) * 3)
    builder = ModelBuilder()
    builder.add_body("Cart").add_frame("Left", Pose((0, 0.5, 0)), sigma=survey).add_frame(
        "Right", Pose((0, -0.5, 0)), sigma=survey
    )
    builder.add_body("Bar").add_frame("L", Pose((0, 0.5, 0)), sigma=survey).add_frame(
        "R", Pose((0, -0.5, 0)), sigma=survey
    )
    builder.add_constraint("BoltL", "Cart:Left", "Bar:L", sigma=survey)
    turned = Pose.from_rpy((0, 0, 0), 0, math.radians(degrees), 0)
    builder.add_constraint("BoltR", "Cart:Right", "Bar:R", turned, sigma=survey, source=Location("bar", 7))
    problem = only(builder.build())
    assert problem.severity is Severity.WARNING
    assert "no error at all" not in problem.message


def test_given_a_miss_that_the_survey_allows_then_it_is_a_note():
    problem = only(ladder(0.005).build())
    assert problem.severity is Severity.NOTE
    assert problem.message == (
        "constraint two closes a loop through A, B; its misclosure is 5 mm and 0 deg, 2.9 sigma of the "
        "surveys; answers take the shortest path"
    )


def test_given_a_miss_beyond_three_sigmas_then_it_is_a_warning_with_the_remedy():
    problem = only(ladder(0.0053).build())
    assert problem.severity is Severity.WARNING
    assert "3.1 sigma of the surveys" in problem.message
    assert "fix the survey" in problem.fix
    assert "more than 30.0 sigma" in only(ladder(0.5).build()).message


def test_given_no_sigmas_then_that_is_a_warning_that_names_those_missing():
    problem = only(ladder(0.005, frame_sigma=None).build())
    assert problem.severity is Severity.WARNING
    assert "misclosure is 5 mm and 0 deg, and no sigma is stated for B:b, A:b" in problem.message
    assert "state sigma: of B:b, A:b" in problem.fix


def test_given_a_loop_that_closes_then_it_is_a_note_with_or_without_sigmas():
    for builder in (ladder(0.0), ladder(0.0, frame_sigma=None)):
        problem = only(builder.build())
        assert problem.severity is Severity.NOTE
        assert "it closes exactly" in problem.message


def test_given_a_miss_where_the_survey_states_no_error_at_all_then_it_is_a_warning():
    sideways = Sigma((0.0, 0.001, 0.0), (0.0, 0.0, 0.001))
    problem = only(ladder(0.005, sideways, frame_sigma=sideways).build())
    assert problem.severity is Severity.WARNING
    assert "in a direction that the surveys state as exact" in problem.message


def test_given_a_joint_in_the_loop_then_it_is_taken_at_its_default_and_that_is_reported():
    slide = Joint(JointType.PRISMATIC, (1, 0, 0), default=(-0.2,), sigma=(0.5,))
    builder = ladder(0.0, joint=slide)
    problem = only(builder.build())
    assert problem.severity is Severity.WARNING
    assert "its misclosure, with joints at their defaults, is 200 mm" in problem.message
    assert "the default of a joint" in problem.fix
    # the sigma of what a joint reads is no survey's
    found = round_of(ladder(-0.203, joint=slide).build())
    assert found.joints == ("two",)
    assert found.meters == pytest.approx(0.003)
    assert found.sigmas == pytest.approx(math.sqrt(3))
    exact = only(ladder(-0.2, joint=slide).build())
    assert exact.severity is Severity.NOTE
    assert "it closes exactly, with joints at their defaults" in exact.message


def test_given_a_doubtful_turn_far_away_then_its_arm_counts():
    """A triangle whose far corner may be turned by 1 mrad at 10 m: 10 mm sideways, and a misclosure of 20 mm."""
    builder = ModelBuilder()
    exact = Sigma()
    builder.add_body("A").add_frame("o").add_frame("turn", Pose(), sigma=Sigma((0, 0, 0), (0, 0, 0.001)))
    builder.add_body("B").add_frame("o").add_frame("far", Pose((10, 0, 0)), sigma=exact)
    builder.add_body("C").add_frame("o")
    builder.add_constraint("AB", "A:turn", "B:o")
    builder.add_constraint("BC", "B:far", "C:o")
    builder.add_constraint(
        "CA", "A:o", "C:o", Pose.from_rpy((10, 0.02, 0.0), yaw=0.002), sigma=exact, source=Location("", 7)
    )
    found = round_of(builder.build())
    # turn and arm are one error, so that one degree of freedom has them both: 2 mrad of 1. To the second order it
    # a misclosure ahead as well, by 20 um, which is consistent with the survey in that direction
    assert found.sigmas == pytest.approx(2.0, rel=1e-3)
    assert found.meters == pytest.approx(0.02, rel=1e-2)


@given(st.floats(1e-3, 200), st.integers(1, 6))
def test_given_any_chi_squared_then_its_sigmas_are_those_of_equal_probability(square, degrees):
    beyond = chi2.sf(square, degrees)
    assert chi_square_to_sigmas(square, degrees) == pytest.approx(norm.isf(beyond / 2), rel=1e-6, abs=1e-6)
    if degrees == 1:
        assert chi_square_to_sigmas(square, 1) == pytest.approx(math.sqrt(square), rel=1e-6, abs=1e-6)


def test_given_probabilities_near_nothing_then_the_number_is_bounded():
    for degrees in range(1, 7):
        # also where the probability underflows
        squares = [*np.arange(1300.0, 1900.0, 10.0), 1e4, 1e300, math.inf]
        assert [chi_square_to_sigmas(square, degrees) for square in squares] == [MAX_SIGMAS] * len(squares)
    assert chi_square_to_sigmas(0.0, 3) == 0.0
    assert chi_square_to_sigmas(1.0, 0) == 0.0


def test_given_a_covariance_of_any_rank_then_the_residual_is_weighed_in_the_directions_it_has():
    rng = np.random.default_rng(3)
    for rank in range(1, 7):
        root = rng.normal(size=(6, rank)) * 1e-3
        along = rng.normal(size=rank)
        # within the span: the Mahalanobis distance is that of the unit normals behind it
        assert residual_significance(root @ along, root @ root.T) == pytest.approx(
            chi_square_to_sigmas(float(along @ along), rank), rel=1e-6
        )
        if rank < 6:
            outside = np.linalg.svd(root)[0][:, -1] * 1e-2
            assert residual_significance(root @ along + outside, root @ root.T) == math.inf
    assert residual_significance(np.zeros(6), np.zeros((6, 6))) == 0.0
    assert residual_significance(np.full(6, 1e-9), np.zeros((6, 6))) == 0.0
    assert residual_significance(np.array([1e-3, 0, 0, 0, 0, 0]), np.zeros((6, 6))) == math.inf


def test_given_sigmas_beyond_all_reason_then_nothing_breaks():
    huge = Sigma((1e150,) * 3, (1e150,) * 3)
    assert only(ladder(0.5, huge, frame_sigma=huge).build()).severity is Severity.NOTE


def test_given_a_loop_beside_then_a_path_knows_whether_it_is_in_the_loop():
    builder = ladder(0.001)
    builder.add_body("Tail").add_frame("o")
    builder.add_constraint("tail", "A:a", "Tail:o")
    model = builder.build()
    assert model.get_kinematic_path("B:b", "A:a").is_in_loop
    assert model.get_kinematic_path("B:b", "Tail:o").is_in_loop
    assert not model.get_kinematic_path("A:b", "Tail:o").is_in_loop
    assert not model.get_kinematic_path("A:b", "A:a").is_in_loop


def test_given_a_loop_with_a_joint_then_the_shortest_path_answers_and_the_joint_on_it_moves():
    turn = Joint(JointType.REVOLUTE, Y)
    model = ladder(0.0, joint=turn).build()
    assert [each.constraint.name for each in model.find_path("B:b", "A:b")] == ["one"]
    assert model.get_kinematic_path("B:b", "A:b").joints == ()
