"""Changes from one model to another, a line each."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest

from modelserver.geometry import Joint, JointType, ModelBuilder, Sigma
from modelserver.geometry.model import Model, describe_changes
from modelserver.transforms import Pose

NOD = Joint(JointType.REVOLUTE, (0.0, 1.0, 0.0))


def cart(
    mast: Pose = Pose((0.5, 0.0, 1.0)),  # noqa: B008
    mounted: Pose = Pose((0.0, 0.0, 0.1)),  # noqa: B008
    sigma: Sigma | None = None,
    joint: Joint | None = None,
    lens: str = "Lens",
    camera: str = "Camera",
    more: str = "",
    description: str = "",
) -> Model:
    builder = ModelBuilder("cart")
    body = builder.add_body("Cart", description=description)
    body.add_frame("Base").add_frame("Mast", mast, sigma=sigma)
    builder.add_body(camera).add_frame("Origin").add_frame(lens)
    if more:
        builder.add_body(more).add_frame("Origin")
    extra = {} if joint is None else {"joint": joint}
    builder.add_constraint("Mounted", "Cart:Mast", f"{camera}:Origin", mounted, sigma=sigma, **extra)
    return builder.build()


@pytest.mark.parametrize(
    ("new", "expected"),
    [
        (cart(), ()),
        (cart(mast=Pose((0.5 + 1e-13, 0.0, 1.0))), ("descriptions or the order of what is listed",)),
        (cart(description="as it stands"), ("descriptions or the order of what is listed",)),
        (cart(mast=Pose((0.5, 0.0, 1.002))), ("frame Cart:Mast moves by 2 mm and 0 deg",)),
        (cart(mast=Pose.from_rpy((0.5, 0, 1), yaw=math.radians(3))), ("frame Cart:Mast moves by 0 mm and 3 deg",)),
        (cart(mounted=Pose((0.0, 0.3, 0.5))), ("constraint Mounted moves by 500 mm and 0 deg",)),
        (
            cart(sigma=Sigma((0.1,) * 3, (0.1,) * 3)),
            ("frame Cart:Mast states another sigma", "constraint Mounted states another sigma"),
        ),
        (cart(joint=NOD), ("the joint of constraint Mounted is revolute, it was fixed",)),
        (cart(lens="Glass"), ("frame Camera:Lens is removed", "frame Camera:Glass is new")),
        (
            cart(camera="Eye"),
            (
                "body Camera is removed",
                "body Eye is new",
                "constraint Mounted joins Cart:Mast and Eye:Origin, it joined Cart:Mast and Camera:Origin",
            ),
        ),
        (cart(more="Lamp"), ("body Lamp is new",)),
    ],
)
def test_given_another_model_then_each_change_has_its_line(new: Model, expected: tuple[str, ...]) -> None:
    assert describe_changes(cart(), new) == expected


@pytest.mark.parametrize(
    "change",
    [{"axis": (0.0, 0.0, 1.0)}, {"lower": (-0.5,)}, {"sigma": (0.01,)}, {"default": (1e-12,)}, {"rate_limit": (0.7,)}],
)
def test_given_a_joint_that_states_otherwise_then_it_is_reported(change: dict[str, Any]) -> None:
    found = describe_changes(cart(joint=NOD), cart(joint=replace(NOD, **change)))
    assert found == ("the joint of constraint Mounted has other numbers",)


def test_given_constraints_that_come_and_go_and_another_root_then_it_is_reported() -> None:
    def pair(first: str, second: str, constraint: str) -> Model:
        builder = ModelBuilder("pair")
        builder.add_body(first).add_frame("Origin")
        builder.add_body(second).add_frame("Origin")
        builder.add_constraint(constraint, "A:Origin", "B:Origin")
        return builder.build()

    assert describe_changes(pair("A", "B", "Weld"), pair("B", "A", "Bolt")) == (
        "constraint Weld is removed",
        "constraint Bolt is new",
        "the root body is B, it was A",
    )


def test_given_mass_that_changes_then_it_is_reported() -> None:
    def build_with_mass(mass: float) -> Model:
        builder = ModelBuilder("weight")
        inertia = [[0.0] * 6 for _ in range(6)]
        for n in range(3):
            inertia[n][n], inertia[n + 3][n + 3] = mass, 1.0
        builder.add_body("Cart", inertia=inertia).add_frame("Base")
        return builder.build()

    assert describe_changes(build_with_mass(1.0), build_with_mass(2.0)) == ("body Cart has another inertia",)
