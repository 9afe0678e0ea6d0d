"""Spatial inertia: the parallel axes, the turned axes, and which numbers no body can have."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support_spatial import poses
from support_urdf import inertias

from modelserver.geometry import Body
from modelserver.geometry.parts import RigidInertia, from_spatial_inertia
from modelserver.transforms import Pose, so3

BOX = ((2.0, 0.0, 0.0), (0.0, 3.0, 0.0), (0.0, 0.0, 4.0))


@given(inertias())
def test_mass_center_and_inertia_come_back_from_the_matrix(inertia):
    found = from_spatial_inertia(inertia.matrix())
    assert found.mass == inertia.mass
    np.testing.assert_allclose(found.center, inertia.center, rtol=0, atol=1e-13)
    scale = np.abs(inertia.matrix()).max()
    np.testing.assert_allclose(found.about_center, inertia.about_center, rtol=0, atol=1e-13 * scale)
    assert inertia.find_problem() == ""


@given(inertias())
def test_the_matrix_is_symmetric_and_positive_definite(inertia):
    M = np.asarray(inertia.matrix())
    np.testing.assert_allclose(M, M.T, rtol=0, atol=1e-12 * np.abs(M).max())
    assert np.linalg.eigvalsh(M).min() > 0


@given(inertias())
def test_inertia_at_the_origin_follows_the_parallel_axis_theorem(inertia):
    c = np.array(inertia.center)
    by_steiner = np.asarray(inertia.about_center) + inertia.mass * (c @ c * np.eye(3) - np.outer(c, c))
    found = np.asarray(inertia.matrix())[3:, 3:]
    np.testing.assert_allclose(found, by_steiner, rtol=0, atol=1e-12 * np.abs(by_steiner).max())


@given(inertias(), poses)
def test_a_body_moved_has_its_center_moved_and_its_axes_turned(inertia, pose):
    R = pose.rotation
    # how momentum is carried to another origin and other axes
    X = np.block([[R, np.zeros((3, 3))], [so3.skew(pose.xyz) @ R, R]])
    there = X @ np.asarray(inertia.matrix()) @ X.T
    about = R @ np.asarray(inertia.about_center) @ R.T
    center = tuple(pose.transform(inertia.center).tolist())
    wanted = RigidInertia(inertia.mass, center, tuple(map(tuple, about.tolist()))).matrix()
    np.testing.assert_allclose(there, wanted, rtol=0, atol=1e-10 * np.abs(there).max())


@given(inertias(), st.tuples(*[st.floats(-5, 5)] * 6))
def test_kinetic_energy_is_that_of_the_moving_center_and_of_the_turn_about_it(inertia, twist):
    v, w = np.array(twist[:3]), np.array(twist[3:])
    energy = np.array(twist) @ np.asarray(inertia.matrix()) @ np.array(twist) / 2
    v_center = v + np.cross(w, inertia.center)
    wanted = inertia.mass * v_center @ v_center / 2 + w @ np.asarray(inertia.about_center) @ w / 2
    assert energy == pytest.approx(wanted, rel=1e-9, abs=1e-9 * np.abs(inertia.matrix()).max())


@pytest.mark.parametrize(
    ("mass", "moments", "message"),
    [
        (0.0, BOX, "the mass is 0 kg"),
        (-1.0, BOX, "the mass is -1 kg"),
        (1.0, ((2, 0, 0), (0, 3, 0), (0, 0, 0)), "all must be positive"),
        (1.0, ((2, 9, 0), (9, 3, 0), (0, 0, 4)), "all must be positive"),
        (1.0, ((2, 0, 0), (0, 3, 0), (0, 0, 6)), "none can be greater than the sum"),
        (1.0, ((2, 0, 0), (0, 3, 0), (0, 0, 5)), ""),
    ],
)
def test_what_no_body_can_have_is_reported(mass, moments, message):
    problem = RigidInertia.from_moments(mass, Pose(), moments).find_problem()
    assert message in problem
    assert bool(message) == bool(problem)


def test_a_body_has_mass_and_center_where_its_inertia_does():
    inertia = RigidInertia(2.0, (0.5, -1.0, 0.25), BOX).matrix()
    body = Body("b", inertia=inertia)
    assert body.mass == 2.0
    assert body.center_of_mass == (0.5, -1.0, 0.25)
    assert inertia[0] == (2.0, 0.0, 0.0, 0.0, 0.5, 2.0)
    odd = [list(row) for row in inertia]
    odd[0][1] = 0.1
    nothing = ((0.0,) * 6,) * 6
    for matrix in (None, odd, nothing, tuple((1e200,) * 6 for _ in range(6))):
        assert Body("b", inertia=matrix).mass is None
        assert Body("b", inertia=matrix).center_of_mass is None
