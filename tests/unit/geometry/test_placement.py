"""A frame or constraint is placed by frames that coincide."""

from __future__ import annotations

import math

import numpy as np
import pytest

from modelserver.formats import parse_model
from modelserver.geometry import Model
from modelserver.geometry.placement import (
    PlacementError,
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
    for frame, target in (("Head:Foot", "Cart:Mark"), ("Cart:Mark", "Cart:Mark")):
        with pytest.raises(PlacementError):
            place_frame(model, frame, target)
    # a frame that states no sigma, and is not at the origin by definition, has an unknown one
    assert place_frame(model, "Cart:Mark", "Lamp:Bulb").sigma is None
