"""Answers of random models against independent searches and products."""

from __future__ import annotations

import itertools
import random

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support_geometry import (
    all_frames,
    body_distances,
    product_along,
    random_builder,
    report_depth_first,
)

from modelserver.errors import NotConnectedError
from modelserver.geometry import Search
from modelserver.transforms import Pose

TREES = [(seed, bodies, 0) for seed, bodies in enumerate((2, 3, 5, 8, 12))]
LOOPED = [(100 + seed, bodies, extra) for seed, (bodies, extra) in enumerate([(2, 1), (3, 2), (4, 3), (6, 3), (8, 4)])]


def pairs(model, rng, count=60):
    every = list(itertools.product(all_frames(model), repeat=2))
    return rng.sample(every, min(count, len(every)))


def cross(path):
    return [(crossing.near_frame, crossing.far_frame) for crossing in path]


@pytest.mark.parametrize(("seed", "bodies", "extra"), TREES + LOOPED)
def test_depth_first_takes_the_path_of_the_report(seed, bodies, extra):
    rng = random.Random(seed)
    model = random_builder(rng, bodies, extra).build()
    for interest, reference in pairs(model, rng, 150):
        expected = report_depth_first(model, reference, interest)
        found = model.find_path(interest, reference, Search.DEPTH_FIRST)
        assert [crossing.near_frame for crossing in found] == expected, (interest, reference)


@pytest.mark.parametrize(("seed", "bodies", "extra"), [*TREES, *LOOPED, (7, 30, 15)])
def test_breadth_first_is_shortest(seed, bodies, extra):
    rng = random.Random(seed)
    model = random_builder(rng, bodies, extra).build()
    number = {body.name: index for index, body in enumerate(model.bodies)}
    distances = body_distances(model)
    for interest, reference in pairs(model, rng, 150):
        path = model.find_path(interest, reference)
        assert len(path) == distances[number[reference.split(":")[0]], number[interest.split(":")[0]]]
        # and it is a path: each crossing starts in the body that the last one came into
        stops = [reference, *[end for crossing in cross(path) for end in crossing], interest]
        for out, into in zip(stops[::2], stops[1::2], strict=True):
            assert out.split(":")[0] == into.split(":")[0]


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "bodies", "extra"), TREES + LOOPED)
def test_answers_are_the_products_along_the_shortest_path(seed, bodies, extra):
    rng = random.Random(seed)
    model = random_builder(rng, bodies, extra).build()
    for interest, reference in pairs(model, rng):
        answer = model.get_transformation(interest, reference)
        assert (answer.frame_of_interest, answer.frame_of_reference) == (interest, reference)
        assert answer.model_revision == model.revision
        expected = product_along(model, cross(model.find_path(interest, reference)), interest, reference)
        np.testing.assert_allclose(answer.matrix, expected, atol=1e-12)
        for search in Search:
            path = model.find_path(interest, reference, search)
            walked = model.compose_path(path, interest, reference)
            np.testing.assert_allclose(
                walked.matrix, product_along(model, cross(path), interest, reference), atol=1e-12
            )


@pytest.mark.parametrize(("seed", "bodies", "extra"), TREES)
def test_in_a_tree_answers_form_a_group(seed, bodies, extra):
    rng = random.Random(seed)
    model = random_builder(rng, bodies, extra).build()
    frames = all_frames(model)
    for _ in range(60):
        a, b, c = (rng.choice(frames) for _ in range(3))
        ab, bc = model.get_transformation(b, a), model.get_transformation(c, b)
        assert (ab @ bc).pose.is_close(model.get_transformation(c, a).pose, 1e-11, 1e-11)
        assert ab.inverse().pose.is_close(model.get_transformation(a, b).pose, 1e-11, 1e-11)
        assert model.get_transformation(a, a).pose == Pose.identity()


@pytest.mark.parametrize("assemblies", [2, 3])
def test_orphans_answer_inside_their_own_assembly_only(assemblies):
    rng = random.Random(assemblies)
    model = random_builder(rng, 12, 3, assemblies).build()
    number = {body.name: index for index, body in enumerate(model.bodies)}
    distances = body_distances(model)
    assert sorted(len(assembly) for assembly in model.assemblies) == [12 // assemblies] * assemblies
    assert model.assemblies[0][0] == "B0"
    for interest, reference in pairs(model, rng, 200):
        a, b = interest.split(":")[0], reference.split(":")[0]
        if np.isinf(distances[number[a], number[b]]):
            with pytest.raises(NotConnectedError, match=f"from {b} to {a}"):
                model.get_transformation(interest, reference)
            for search in Search:
                with pytest.raises(NotConnectedError):
                    model.find_path(interest, reference, search)
        else:
            model.get_transformation(interest, reference)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_covariance_along_a_path_agrees_with_monte_carlo(seed):
    rng = random.Random(seed)
    model = random_builder(rng, 4, sigmas=True).build()
    frames = all_frames(model)
    interest, reference = max(itertools.product(frames, repeat=2), key=lambda pair: len(model.find_path(*pair)))
    answer = model.get_transformation(interest, reference)
    A = {f"{body.name}:{frame.name}": frame for body in model.bodies for frame in body}
    count, noise = 15_000, np.random.default_rng(seed)

    def sample(part):
        d = noise.normal(size=(count, 6)) * np.array(part.sigma.position + part.sigma.rotation)
        turned = Rotation.from_rotvec(d[:, 3:]) * Rotation.from_matrix(part.pose.rotation)
        return np.array(part.pose.xyz) + d[:, :3], turned

    def inverse(X):
        p, R = X
        return -R.inv().apply(p), R.inv()

    steps, here = [], reference
    for crossing in model.find_path(interest, reference):
        if crossing.near_frame != here:
            steps += [inverse(sample(A[here])), sample(A[crossing.near_frame])]
        drawn = sample(crossing.constraint)
        steps.append(drawn if crossing.forward else inverse(drawn))
        here = crossing.far_frame
    if here != interest:
        steps += [inverse(sample(A[here])), sample(A[interest])]
    p, R = np.zeros((count, 3)), Rotation.identity(count)
    for step_p, step_R in steps:
        p, R = p + R.apply(step_p), R * step_R
    d = np.hstack([p - answer.position, (R * Rotation.from_matrix(answer.rotation).inv()).as_rotvec()])
    scale = np.sqrt(np.diag(answer.covariance))
    ratio = (d.T @ d / count - answer.covariance) / np.outer(scale, scale)
    assert len(steps) > 6
    assert np.abs(ratio).max() < 5 * (2 / count) ** 0.5


def test_covariance_is_none_where_a_part_states_none_and_zero_for_a_frame_in_itself():
    builder = random_builder(random.Random(3), 5, sigmas=True)
    frame, source = builder.bodies[4].frames[0]
    builder.bodies[4].frames[0] = (type(frame)(frame.name, frame.pose), source)
    model = builder.build()
    without_sigma = f"B4:{frame.name}"
    other = next(name for name in all_frames(model) if name.startswith("B0:"))
    last = {crossing.far_frame for crossing in model.find_path(without_sigma, other)}
    assert (model.get_transformation(without_sigma, other).covariance is None) == (without_sigma not in last)
    np.testing.assert_array_equal(model.get_transformation(without_sigma, without_sigma).covariance, np.zeros((6, 6)))
