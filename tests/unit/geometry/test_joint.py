"""Joints by themselves: what they state, how they move, how they err."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from support_joints import MOVING, joints, positions_of
from support_spatial import axes

from modelserver.geometry import Joint, JointType, Mimic
from modelserver.geometry.joint import FIXED, coordinate_names
from modelserver.transforms import Pose

MOVED = joints(types=MOVING)
UP, LEFT = (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)


def rotation_of(joint, *position):
    return joint.compute_pose(position).rotation


# what it does


def test_given_a_fixed_joint_then_it_has_no_coordinates_and_does_not_move():
    assert (FIXED.count, FIXED.is_movable, FIXED.default_position, FIXED.compute_pose(())) == (
        0,
        False,
        (),
        Pose.identity(),
    )
    assert FIXED.jacobian(()).shape == (6, 0)
    assert coordinate_names("A", FIXED) == ()


def test_given_a_revolute_joint_then_it_turns_about_its_axis_by_the_right_hand():
    joint = Joint(JointType.REVOLUTE, LEFT)
    # about y, which points left, x goes down
    np.testing.assert_allclose(rotation_of(joint, math.pi / 2) @ (1, 0, 0), (0, 0, -1), atol=1e-15)
    assert joint.compute_pose((7 * math.tau + 0.5,)).is_close(joint.compute_pose((0.5,)), 0, 1e-14)


def test_given_a_prismatic_joint_then_it_slides_along_its_axis():
    assert Joint(JointType.PRISMATIC, (0, 0, 5)).compute_pose((0.4,)) == Pose((0, 0, 0.4))


@pytest.mark.parametrize("length", [1.0, 2.0])
def test_given_an_axis_with_negative_zeros_then_it_has_positive_ones(length: float) -> None:
    for axis in ((length, -0.0, -0.0), (-0.0, -0.0, length)):
        assert min(math.copysign(1.0, each) for each in Joint(JointType.REVOLUTE, axis).axis) == 1.0


def test_given_a_spherical_joint_then_its_coordinates_are_a_rotation_vector():
    joint = Joint(JointType.SPHERICAL)
    np.testing.assert_allclose(
        rotation_of(joint, 0.3, -0.2, 0.9), Rotation.from_rotvec((0.3, -0.2, 0.9)).as_matrix(), atol=1e-14
    )


def test_given_a_planar_joint_then_it_slides_in_its_plane_and_turns_about_the_normal():
    moved = Joint(JointType.PLANAR).compute_pose((0.3, -0.4, math.pi / 2))
    assert moved.is_close(Pose.from_rpy((0.3, -0.4, 0), yaw=math.pi / 2), 1e-15, 1e-15)
    # the normal turned to x: the shortest way takes z to x, and x to -z
    moved = Joint(JointType.PLANAR, (1, 0, 0)).compute_pose((0.3, -0.4, 0.0))
    assert moved.is_close(Pose((0, -0.4, -0.3)), 1e-15, 1e-15)


def test_given_a_floating_joint_then_it_has_a_position_and_a_rotation_vector():
    moved = Joint(JointType.FLOATING).compute_pose((1, 2, 3, 0, 0, 0.5))
    assert moved.is_close(Pose.from_rpy((1, 2, 3), yaw=0.5), 1e-15, 1e-15)


@pytest.mark.parametrize(
    ("kind", "names", "angles"),
    [
        (JointType.REVOLUTE, ("A",), (True,)),
        (JointType.PRISMATIC, ("A",), (False,)),
        (JointType.SPHERICAL, ("A.rx", "A.ry", "A.rz"), (True,) * 3),
        (JointType.PLANAR, ("A.x", "A.y", "A.turn"), (False, False, True)),
        (JointType.FLOATING, ("A.x", "A.y", "A.z", "A.rx", "A.ry", "A.rz"), (False,) * 3 + (True,) * 3),
    ],
)
def test_given_a_type_then_each_coordinate_has_a_name_and_a_unit(kind, names, angles):
    assert coordinate_names("A", Joint(kind)) == names
    assert Joint(kind).angle_flags == angles


@given(MOVED, st.data())
def test_given_any_joint_when_its_coordinates_change_then_the_jacobian_is_its_derivative(joint, data):
    position = data.draw(positions_of(joint))
    found = joint.jacobian(position)
    step = 1e-5
    for number in range(joint.count):
        ahead, behind = list(position), list(position)
        ahead[number] += step
        behind[number] -= step
        X, Y = joint.compute_pose(ahead), joint.compute_pose(behind)
        turn = Rotation.from_matrix(X.rotation) * Rotation.from_matrix(Y.rotation).inv()
        numerical = np.concatenate(((X.position - Y.position), turn.as_rotvec())) / (2 * step)
        np.testing.assert_allclose(found[:, number], numerical, atol=1e-6)


@given(axes)
def test_given_any_normal_then_a_planes_axes_are_square_to_it_and_right_handed(normal):
    joint = Joint(JointType.PLANAR, normal)
    x, y = joint.compute_pose((1, 0, 0)).position, joint.compute_pose((0, 1, 0)).position
    np.testing.assert_allclose(
        np.column_stack((x, y, joint.axis)).T @ np.column_stack((x, y, joint.axis)), np.eye(3), atol=1e-12
    )
    np.testing.assert_allclose(np.cross(x, y), joint.axis, atol=1e-12)


@pytest.mark.parametrize("tilt", [0.0, 1e-200, 1e-9, 1e-7, 1e-6, 3e-6, 1e-3])
def test_given_a_normal_near_straight_down_then_a_planes_axes_are_square_to_it(tilt):
    joint = Joint(JointType.PLANAR, (tilt, tilt / 2, -1.0))
    frame = np.column_stack((*(joint.compute_pose(at).position for at in ((1, 0, 0), (0, 1, 0))), joint.axis))
    np.testing.assert_allclose(frame.T @ frame, np.eye(3), atol=1e-14)


# what it states


@given(MOVED)
def test_given_any_joint_then_it_rests_within_its_limits_at_its_default_if_it_has_one(joint):
    assert not joint.is_out_of_limits(joint.default_position)
    assert joint.default_position == (joint.default or (0.0,) * joint.count)


def test_given_limits_that_exclude_0_then_it_rests_at_the_nearer_one():
    assert Joint(JointType.PRISMATIC, UP, (0.2,), (0.5,)).default_position == (0.2,)
    assert Joint(JointType.PRISMATIC, UP, (-0.5,), (-0.2,)).default_position == (-0.2,)
    assert Joint(JointType.PLANAR, UP, (0.1, -1, -1), (1, 1, -0.5)).default_position == (0.1, 0.0, -0.5)


def test_given_a_position_beyond_a_limit_by_rounding_alone_then_it_is_within():
    joint = Joint(JointType.REVOLUTE, UP, (-0.5,), (0.5,))
    assert not joint.is_out_of_limits((0.5 + 1e-12,))
    assert joint.is_out_of_limits((0.5 + 1e-6,))
    assert joint.is_out_of_limits((-0.6,))


def test_given_no_limits_written_in_several_ways_then_the_joints_are_equal():
    endless = Joint(JointType.REVOLUTE, (0, 0, 3), (-math.inf,), (math.inf,), (math.inf,))
    assert endless == Joint(JointType.REVOLUTE)
    assert Joint("revolute") == Joint(JointType.REVOLUTE)


@pytest.mark.parametrize(
    ("given_", "message"),
    [
        ({"type": "hinge"}, "hinge"),
        ({"axis": (0, 0, 0)}, "not all 0"),
        ({"axis": (0, math.nan, 0)}, "finite"),
        ({"lower": (1,), "upper": (-1,)}, "reversed: lower 1 is above upper -1"),
        ({"lower": (math.nan,)}, "the lower limit is a number"),
        ({"lower": (1, 2)}, "a revolute joint has 1 coordinate, and its lower 2"),
        ({"sigma": (-0.1,)}, "sigma is finite and not negative"),
        ({"sigma": (math.nan,)}, "sigma is finite and not negative"),
        ({"sigma": (1e200,)}, "sigma is finite and not negative"),
        ({"rate_limit": (-1,)}, "a rate limit is not negative"),
        ({"rate_limit": (math.nan,)}, "a rate limit is not negative"),
        ({"default": (math.inf,)}, "a default is finite"),
        ({"default": (0.6,), "upper": (0.5,)}, "the default 0.6 is out of the joint's own limits"),
        ({"type": JointType.PLANAR, "mimic": Mimic("B")}, "a planar one has 3"),
        ({"type": JointType.FIXED, "mimic": Mimic("B")}, "a fixed one has none"),
        ({"type": JointType.FIXED, "default": (0.0,)}, "a fixed joint has 0 coordinates"),
    ],
)
def test_given_what_no_joint_can_state_then_it_is_rejected(given_, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        Joint(**({"type": JointType.REVOLUTE} | given_))


@pytest.mark.parametrize("number", [math.nan, math.inf])
def test_given_a_mimic_that_is_no_number_then_it_is_rejected(number):
    with pytest.raises(ValueError, match="finite"):
        Mimic("A", number)
    with pytest.raises(ValueError, match="finite"):
        Mimic("A", 1.0, number)
