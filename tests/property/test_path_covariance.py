"""Covariances from the frame tree against `spatial.chain`, which carries each edge from frame to frame by itself."""

from __future__ import annotations

import itertools
import math
import random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support_formats import all_frames, models
from support_joints import positions_of

from modelserver.geometry import Joint, JointType, Mimic, ModelBuilder, Sigma
from modelserver.geometry.kinematic_path import KinematicPath
from modelserver.transforms import Pose, chain

pytestmark = pytest.mark.slow

RELATIVE = 1e-12


def scale_of(links):
    """Return (6,) the standard deviations that the links could reach together, with the longest lever there is.

    Entries of a covariance are compared as correlations of these: a variance may be small beside its neighbors, and
    two levers computed in another order differ by the rounding of the longest.
    """
    shares = chain.contributions(links)
    X, reach = Pose.identity(), 0.0
    for link in links:
        X = X @ (link.X_FT if link.forward else link.X_FT.inverse())
        reach = max(reach, math.hypot(*X.xyz))
    turn = sum(float(np.abs(share[3:]).max()) for share in shares.values())
    move = sum(float(np.abs(share[:3]).max()) for share in shares.values()) + 2.0 * reach * turn
    return np.array([move] * 3 + [turn] * 3)


def assert_same(found, links):
    expected = chain.covariance(links)
    if expected is None:
        assert found is None
        return
    found = np.array(found).reshape(6, 6)
    scale = np.outer(scale_of(links), scale_of(links))
    assert (np.abs(found - expected) <= RELATIVE * scale).all()
    np.testing.assert_array_equal(found, found.T)


@given(models(), st.data())
@settings(max_examples=30)
def test_given_any_model_and_positions_of_its_joints_then_the_covariance_is_that_of_the_chain(model, data):
    frames = all_frames(model)
    pair = data.draw(st.tuples(st.sampled_from(frames), st.sampled_from(frames)))
    route = model.get_kinematic_path(*pair)
    positions = tuple(data.draw(positions_of(leg.joint)) for leg in route.joints)
    sigmas = [
        tuple(data.draw(st.sampled_from((0.0, 1e-3, 0.2, math.nan))) for _ in range(leg.joint.count))
        for leg in route.joints
    ]
    links = route.build_links(positions, sigmas)
    assert_same(route.compute_covariance(positions, sigmas), links)
    # the same edges, without the tree
    again = KinematicPath.from_edges(route.edges, route.is_in_loop)
    assert again.compute_pose(positions).is_close(route.compute_pose(positions), 1e-10, 1e-10)
    assert_same(again.compute_covariance(positions, sigmas), links)
    rigid = model.rigid_transformation(*pair)
    if rigid is not None:
        assert route.joints == ()
        assert_same(rigid.covariance_numbers, links)


def random_tree(rng, lever, moves):
    """Return a tree of bodies with all its sigmas stated, its edges up to `lever` meters long, in both senses."""

    def pose():
        return Pose([rng.uniform(-lever, lever) for _ in range(3)], [rng.gauss(0, 1) for _ in range(4)])

    def sigma():
        about = [10 ** rng.uniform(-5, -1) for _ in range(3)]
        same = [about[0]] * 3
        return Sigma([10 ** rng.uniform(-5, -1), 0.0, 1e-3], rng.choice((about, same)))

    builder = ModelBuilder("tree")
    for body in range(10):
        made = builder.add_body(f"B{body}").add_frame("Origin")
        for frame in range(3):
            made.add_frame(f"F{frame}", pose(), sigma=sigma())
    for body in range(1, 10):
        ends = [f"B{rng.randrange(body)}:F{rng.randrange(3)}", f"B{body}:{rng.choice(('F0', 'F2', 'Origin'))}"]
        rng.shuffle(ends)
        joint = Joint()
        if moves and rng.random() < 0.6:
            mimic = Mimic("C1", -1.5, 0.1) if body > 4 and rng.random() < 0.5 else None
            kind = JointType.REVOLUTE if body == 1 or mimic else rng.choice(list(JointType)[1:])
            joint = Joint(kind, [rng.gauss(0, 1) for _ in range(3)], mimic=mimic)
        elif moves and body == 1:
            joint = Joint(JointType.REVOLUTE, (0.0, 0.6, 0.8))
        builder.add_constraint(f"C{body}", *ends, pose(), sigma=sigma(), joint=joint)
    return builder.build()


@pytest.mark.parametrize("lever", [0.01, 1.0, 1e3])
@pytest.mark.parametrize("moves", [False, True])
def test_given_trees_with_short_and_long_levers_then_pairs_have_the_covariance_of_the_chain(lever, moves):
    rng = random.Random(f"{lever} {moves}")
    for _ in range(2):
        model = random_tree(rng, lever, moves)
        for pair in rng.sample(list(itertools.product(all_frames(model), repeat=2)), 100):
            route = model.get_kinematic_path(*pair)
            positions = [tuple(rng.uniform(-1.5, 1.5) for _ in range(leg.joint.count)) for leg in route.joints]
            sigmas = [tuple(rng.uniform(0, 0.1) for _ in range(leg.joint.count)) for leg in route.joints]
            # of joints that follow the same one, the errors are one
            sigmas = [
                tuple(model.drives[leg.name].multiplier * 0.02 for _ in each)
                if model.drives[leg.name].leader == "C1"
                else each
                for leg, each in zip(route.joints, sigmas, strict=True)
            ]
            assert_same(route.compute_covariance(positions, sigmas), route.build_links(positions, sigmas))


def test_given_a_short_lever_far_from_the_root_then_its_variance_is_not_lost_in_that_of_the_long_one():
    """What is folded at the root's origin and carried back would be off by the squared ratio of the levers, 1e-4."""
    builder = ModelBuilder("mast")
    builder.add_body("Base").add_frame("Origin").add_frame("Far", Pose((1e3, 0, 0)), sigma=Sigma())
    builder.add_body("Plate").add_frame("Origin").add_frame("Near", Pose((0, 1e-3, 0)), sigma=Sigma())
    builder.add_constraint("Hinge", "Base:Far", "Plate:Origin", sigma=Sigma((0, 0, 0), (0, 0, 0.01)))
    covariance = builder.build().get_transformation("Plate:Near", "Base:Origin").covariance
    assert math.sqrt(covariance[0, 0]) == pytest.approx(1e-5, rel=1e-12)
