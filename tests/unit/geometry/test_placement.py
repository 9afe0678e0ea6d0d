"""A frame or constraint is placed by frames that coincide, or by distances from other frames."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from modelserver.formats import parse_model
from modelserver.geometry import Model
from modelserver.geometry.placement import (
    PlacementError,
    list_measured_points,
    locate_by_distances,
    place_constraint,
    place_frame,
)
from modelserver.transforms import Pose, so3

FILE = """
modelserver: geometry/1
bodies:
  Cart:
    frames:
      Origin: {}
      Rail: {xyz: [0.2, 0.1, 1], rpy_deg: [10, 20, 30], sigma: {xyz: 0.01, rpy_deg: 1}}
      Mark: {xyz: [1.1, -0.2, 0.9], rpy_deg: [0, 5, 80], sigma: {xyz: 0.002, rpy_deg: 0.5}}
      Corner: {xyz: [0, 1, 0], sigma: {xyz: 0.001}}
      Edge: {xyz: [1, 1, 0.2], sigma: {xyz: 0.001}}
  Head:
    frames:
      Foot: {xyz: [0, 0, -0.1], rpy_deg: [0, 0, 90], sigma: {xyz: 0.003, rpy_deg: 0.2}}
      Lens: {xyz: [0.1, 0.02, 0.03], rpy_deg: [-90, 0, -90], sigma: {xyz: 0.004, rpy_deg: 0.3}}
  Lamp:
    frames:
      Bottom: {}
      Bulb: {xyz: [0, 0, 0.3]}
constraints:
  Pan:
    from: Cart:Rail
    to: Head:Foot
    xyz: [0, 0, 0.05]
    sigma: {xyz: 0, rpy_deg: 0}
    joint: {type: revolute, axis: [0, 0, 1], default_deg: 25, sigma_deg: 0}
  LampFixed: {from: Head:Lens, to: Lamp:Bottom}
"""


def load(text: str = FILE) -> Model:
    return parse_model(text.encode())


def replace_pose(name: str, pose: Pose) -> Model:
    """Return the model with another pose of the constraint Pan."""
    xyz, rpy = list(pose.xyz), np.degrees(pose.rpy).tolist()
    return load(FILE.replace("    xyz: [0, 0, 0.05]\n", f"    xyz: {xyz}\n    rpy_deg: {rpy}\n"))


@pytest.mark.parametrize("frames", [("Head:Lens", "Cart:Mark"), ("Cart:Mark", "Head:Lens"), ("Lamp:Bulb", "Cart:Mark")])
def test_given_two_frames_then_the_constraint_makes_them_coincide(frames: tuple[str, str]) -> None:
    placed = place_constraint(load(), "Pan", *frames)
    moved = replace_pose("Pan", placed.pose)
    assert moved.get_transformation(*frames).pose.is_close(Pose.identity(), 1e-9, 1e-7)
    # the joint's default stays
    assert moved.joints["Pan"].joint.default_position == (math.radians(25),)


def test_given_position_only_then_the_rotation_stays() -> None:
    placed = place_constraint(load(), "Pan", "Head:Lens", "Cart:Mark", position_only=True)
    assert placed.pose.wxyz == (1.0, 0.0, 0.0, 0.0)
    moved = replace_pose("Pan", placed.pose)
    assert math.hypot(*moved.get_transformation("Head:Lens", "Cart:Mark").pose.xyz) < 1e-9


def test_given_sigmas_then_those_of_the_placed_constraint_are_what_random_surveys_have() -> None:
    model = load()
    placed = place_constraint(model, "Pan", "Head:Lens", "Cart:Mark")
    random = np.random.default_rng(5)
    X_FG = model.get_transformation("Cart:Mark", "Cart:Rail")
    X_TM = model.get_transformation("Head:Lens", "Head:Foot")
    X_J = model.joints["Pan"].joint.compute_pose((math.radians(25),))

    def disturb(pose: Pose, cov: np.ndarray) -> Pose:
        error = random.multivariate_normal(np.zeros(6), cov)
        turn = Pose((0.0, 0.0, 0.0), so3.exponential(so3.to_vector3(error[3:])))
        return Pose(np.add(pose.xyz, error[:3]), (turn @ Pose((0.0, 0.0, 0.0), pose.wxyz)).wxyz)

    assert X_FG.covariance is not None
    assert X_TM.covariance is not None
    offsets = []
    for _ in range(2000):
        pose = disturb(X_FG.pose, X_FG.covariance) @ disturb(X_TM.pose, X_TM.covariance).inverse() @ X_J.inverse()
        offsets.append(np.subtract(pose.xyz, placed.pose.xyz))
    assert placed.sigma is not None
    assert np.std(offsets, axis=0) == pytest.approx(placed.sigma.position, rel=0.1)


def test_given_frames_on_one_side_then_it_is_rejected() -> None:
    for pair in (("Cart:Mark", "Cart:Corner"), ("Head:Lens", "Lamp:Bulb")):
        with pytest.raises(PlacementError, match="one side"):
            place_constraint(load(), "Pan", *pair)
    with pytest.raises(PlacementError, match="no constraint"):
        place_constraint(load(), "Tilt", "Head:Lens", "Cart:Mark")


def test_given_a_target_then_a_frame_stands_where_it_is() -> None:
    model = load()
    placed = place_frame(model, "Cart:Mark", "Head:Lens")
    there = model.get_transformation("Head:Lens", "Cart:Origin")
    assert placed.pose.is_close(there.pose)
    assert there.covariance is not None
    assert placed.sigma is not None
    assert placed.sigma.position == pytest.approx(np.sqrt(np.diag(there.covariance)[:3]))
    moved = place_frame(model, "Cart:Mark", "Head:Lens", position_only=True)
    assert moved.pose.is_close(Pose(there.pose.xyz, model.frame("Cart:Mark").pose.wxyz))
    for frame, target in (("Head:Foot", "Cart:Mark"), ("Cart:Mark", "Cart:Mark")):
        with pytest.raises(PlacementError):
            place_frame(model, frame, target)
    # a frame that states no sigma, and is not at the origin by definition, has an unknown one
    assert place_frame(model, "Cart:Mark", "Lamp:Bulb").sigma is None


# --- distances

POINTS = np.array([(0.0, 0.0, 0.0), (1.0, 0.1, 0.0), (0.2, 1.2, 0.3), (0.8, 0.9, -0.4)])
coordinates = st.floats(-3.0, 3.0)


@settings(max_examples=100)
@given(st.tuples(coordinates, coordinates, coordinates), st.integers(3, 4))
def test_given_exact_distances_then_the_position_is_found(place: tuple[float, float, float], count: int) -> None:
    points = POINTS[:count]
    distances = np.linalg.norm(np.array(place) - points, axis=1)
    if distances.min() < 1e-3:
        return
    fit = locate_by_distances(points, distances, np.full(count, 0.001), place)
    # near the plane of three points the distances hardly change across it
    assert math.dist(fit.position, place) < (1e-6 if count == 4 else 2e-3)
    assert np.abs(fit.residuals).max() < 1e-6


def test_given_three_distances_then_the_mirrored_position_is_reported() -> None:
    place = (0.3, 0.4, 0.9)
    distances = np.linalg.norm(np.array(place) - POINTS[:3], axis=1)
    above = locate_by_distances(POINTS[:3], distances, np.full(3, 0.001), place)
    assert above.mirrored is not None
    below = locate_by_distances(POINTS[:3], distances, np.full(3, 0.001), above.mirrored)
    assert below.position == pytest.approx(above.mirrored)
    assert below.mirrored == pytest.approx(place)
    # a fourth one decides
    distances = np.linalg.norm(np.array(place) - POINTS, axis=1)
    assert locate_by_distances(POINTS, distances, np.full(4, 0.001), above.mirrored).mirrored is None


@pytest.mark.slow
@pytest.mark.parametrize("place", [(0.3, 0.4, 0.9), (2.0, 1.0, 1.0), (0.4, 0.4, -0.6)])
def test_given_noise_then_the_covariance_is_consistent(place: tuple[float, float, float]) -> None:
    random = np.random.default_rng(3)
    sigmas = np.array([0.002, 0.004, 0.003])
    P = np.array([np.eye(3) * 1e-6, np.eye(3) * 4e-6, np.zeros((3, 3))])
    nees = []
    for _ in range(500):
        true = POINTS[:3] + random.normal(size=(3, 3)) * np.sqrt([[1e-6], [4e-6], [0.0]])
        distances = np.linalg.norm(np.array(place) - true, axis=1) + random.normal(size=3) * sigmas
        fit = locate_by_distances(POINTS[:3], distances, sigmas, place, P)
        error = np.subtract(fit.position, place)
        nees.append(error @ np.linalg.solve(fit.covariance, error))
    assert np.mean(nees) == pytest.approx(3.0, abs=0.4)


@pytest.mark.slow
def test_given_a_place_in_the_plane_then_the_sigma_across_it_covers_the_error() -> None:
    random = np.random.default_rng(4)
    normal = np.cross(POINTS[1], POINTS[2])
    normal /= np.linalg.norm(normal)
    place = 0.4 * POINTS[1] + 0.3 * POINTS[2]
    ratios = []
    for _ in range(300):
        distances = np.linalg.norm(place - POINTS[:3], axis=1) + random.normal(size=3) * 0.002
        fit = locate_by_distances(POINTS[:3], distances, np.full(3, 0.002), tuple(place))
        ratios.append(normal @ np.subtract(fit.position, place) / math.sqrt(normal @ fit.covariance @ normal))
    assert np.percentile(np.abs(ratios), 95) < 2.0


def test_given_distances_that_disagree_then_the_residuals_have_it() -> None:
    place = np.array((0.3, 0.4, 0.9))
    distances = np.linalg.norm(place - POINTS, axis=1)
    distances[2] += 0.1
    fit = locate_by_distances(POINTS, distances, np.full(4, 0.001), tuple(place))
    assert np.abs(fit.residuals).max() > 0.02


@pytest.mark.parametrize(
    ("points", "distances", "words"),
    [
        (POINTS[:2], [1.0, 1.0], "three frames"),
        (np.array([(0, 0, 0), (1, 0, 0), (2, 0, 0)], float), [1.0, 1.0, 1.5], "on a line"),
        (np.zeros((3, 3)), [1.0, 1.0, 1.0], "on a line"),
        (POINTS[:3], [1.0, -1.0, 1.0], "positive"),
        (POINTS[:3], [1.0, math.nan, 1.0], "positive"),
    ],
)
def test_given_what_determines_no_position_then_the_reason_is_given(
    points: np.ndarray, distances: list[float], words: str
) -> None:
    with pytest.raises(PlacementError, match=words):
        locate_by_distances(points, np.array(distances), np.full(len(distances), 0.001), (0.0, 0.0, 0.0))


def test_given_a_model_then_the_points_are_in_the_coordinates_of_the_body() -> None:
    model = load()
    points, P = list_measured_points(model, "Cart:Mark", ["Cart:Corner", "Cart:Edge", "Head:Lens"])
    assert points[0] == pytest.approx((0, 1, 0))
    assert points[2] == pytest.approx(model.get_transformation("Head:Lens", "Cart:Origin").pose.xyz)
    assert np.diag(P[0]) == pytest.approx([1e-6] * 3)
    for others in (["Cart:Mark", "Cart:Edge"], ["Cart:Edge", "Cart:Edge"]):
        with pytest.raises(PlacementError):
            list_measured_points(model, "Cart:Mark", others)
