"""A frame knows its body; the model knows its constraints, crosses them, verifies frames; a builder unconstrains."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from modelserver.errors import (
    GeometryError,
    MalformedRequestError,
    NotConnectedError,
    Severity,
    UnknownBodyError,
    UnknownFrameError,
)
from modelserver.formats import load_model
from modelserver.geometry import BodyFrame, Joint, JointType, Mimic, Model, ModelBuilder
from modelserver.transforms import Pose

RAPTOR = Path(__file__).resolve().parents[3] / "config" / "raptor"
QUARTER = Pose.from_rpy((1.0, 2.0, 3.0), 0.0, 0.0, np.pi / 2)


def cart(strict: bool = False) -> Model:
    """Return a cart with a rail that carries two cameras at one frame, and a lamp on the first."""
    builder = ModelBuilder("cart", strict=strict)
    builder.add_body("Cart").add_frame("Origin").add_frame("Rail", Pose((0.2, 0.0, 1.0)))
    camera = builder.add_body("Left").add_frame("Mount").add_frame("Lens", Pose((0.1, 0.0, 0.0)))
    builder.add_body("Right").add_frame("Mount")
    builder.add_body("Lamp").add_frame("Foot")
    builder.add_constraint("LeftFixed", "Cart:Rail", "Left:Mount", QUARTER)
    builder.add_constraint("RightFixed", "Right:Mount", "Cart:Rail", QUARTER)
    builder.add_constraint("LampFixed", "Left:Lens", "Lamp:Foot")
    assert camera.name == "Left"
    return builder.build()


# --- a frame's body ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("file", ["geometry.xml", "geometry.yaml"])
def test_given_a_file_then_every_frame_knows_its_body_and_full_name(file: str) -> None:
    model = load_model(RAPTOR / file)
    for body in model.bodies:
        for frame in body:
            assert frame.body == body.name
            assert model.frame(frame.full_name) is frame
            assert body.has_frame(frame)


def test_given_a_copied_body_then_its_frames_are_equal_and_know_the_copy() -> None:
    left = cart().body("Left")
    copy = left.with_name("Spare")
    assert [frame.full_name for frame in copy] == ["Spare:Mount", "Spare:Lens"]
    assert copy.frames == left.frames
    assert not left.has_frame(copy.frame("Lens"))
    assert copy.has_frame("Lens")
    assert not copy.has_frame(replace(copy.frame("Lens"), pose=QUARTER))
    assert not copy.has_frame(BodyFrame("Lens", Pose((0.1, 0.0, 0.0))))
    assert BodyFrame("Lens").full_name == "Lens"
    assert copy.with_frame(BodyFrame("Tip")).frame("Tip").full_name == "Spare:Tip"


# --- crossing ------------------------------------------------------------------------------------------------------


def test_given_a_constraint_when_crossed_backward_then_the_pose_is_the_inverse() -> None:
    model = cart()
    there = model.next("Left:Mount")
    assert there.frame is model.frame("Cart:Rail")
    assert there.constraint.name == "LeftFixed"
    assert not there.crossing.forward
    assert there.pose == QUARTER.inverse()
    back = model.next(there.frame, "LeftFixed")
    assert (back.frame.full_name, back.crossing.forward, back.pose) == ("Left:Mount", True, QUARTER)
    for frame, neighbor in (("Left:Mount", there), ("Cart:Rail", back)):
        assert neighbor.pose.is_close(model.get_transformation(neighbor.frame.full_name, frame).pose)


def test_given_several_constraints_then_all_are_listed_and_one_is_crossed_by_name() -> None:
    model = cart()
    rail = model.frame("Cart:Rail")
    assert [each.name for each in model.constraints_of(rail)] == ["LeftFixed", "RightFixed"]
    assert [each.frame.full_name for each in model.neighbors(rail)] == ["Left:Mount", "Right:Mount"]
    assert model.next(rail, "RightFixed").pose == QUARTER.inverse()
    with pytest.raises(MalformedRequestError, match="2 constraints, LeftFixed, RightFixed; name the one to cross"):
        model.next(rail)
    with pytest.raises(NotConnectedError, match="has no constraint 'RigthFixed'; it has") as raised:
        model.next(rail, "RigthFixed")
    assert raised.value.nearest[0] == "RightFixed"


def test_given_no_constraint_then_nothing_is_next() -> None:
    model = cart()
    assert model.neighbors("Cart:Origin") == model.constraints_of("Cart:Origin") == ()
    for constraint in ("", "LeftFixed"):
        with pytest.raises(NotConnectedError, match="Cart:Origin has no constraint"):
            model.next("Cart:Origin", constraint)


def test_given_what_is_no_frame_of_the_model_then_an_error_is_raised() -> None:
    model = cart()
    for query in (model.neighbors, model.constraints_of, model.next, model.verify):
        with pytest.raises(UnknownFrameError, match="no frame 'Rial'"):
            query("Cart:Rial")
        with pytest.raises(UnknownBodyError):
            query("Crat:Rail")
        with pytest.raises(UnknownFrameError, match="is on no body"):
            query(BodyFrame("Rail"))


def test_given_equation_13_when_constraints_are_crossed_one_by_one_then_the_product_is_the_answer() -> None:
    """The report's chain from the Raptor's origin to the Digiclops's image plane, frame by frame (4.6.3)."""
    model = load_model(RAPTOR / "geometry.xml")
    X = model.frame("Raptor:CabFrontRailCenter").pose
    sick = model.next("Raptor:CabFrontRailCenter")
    X = X @ sick.pose @ sick.frame.pose.inverse() @ model.frame("FrontNoddingSICK:BottomPlateCorner").pose
    camera = model.next("FrontNoddingSICK:BottomPlateCorner")
    X = X @ camera.pose @ camera.frame.pose.inverse() @ model.frame("Digiclops:ImagePlane").pose
    assert X.is_close(model.get_transformation("Digiclops:ImagePlane", "Raptor:Origin").pose, 1e-12, 1e-12)


# --- verify --------------------------------------------------------------------------------------------------------


def test_given_a_sound_frame_then_nothing_is_wrong_with_it() -> None:
    model = load_model(RAPTOR / "geometry.yaml")
    assert all(model.verify(frame) == () for body in model.bodies for frame in body)


def test_given_a_frame_with_two_constraints_then_a_note_reports_that_strict_models_allow_one() -> None:
    (problem,) = cart().verify("Cart:Rail")
    assert problem.severity is Severity.NOTE
    assert "2 constraints, LeftFixed, RightFixed" in problem.message
    with pytest.raises(GeometryError, match="a frame has one at most"):
        cart(strict=True)


def test_given_a_frame_of_an_orphan_or_of_another_model_then_that_is_what_is_wrong() -> None:
    builder = ModelBuilder.from_model(cart())
    builder.add_body("Loose").add_frame("Origin")
    model = builder.build()
    (problem,) = model.verify("Loose:Origin")
    assert problem.severity is Severity.WARNING
    assert "Loose is an orphan: no constraints lead to the root body Cart" in problem.message
    (problem,) = model.verify(replace(model.frame("Left:Lens"), pose=QUARTER))
    assert problem.severity is Severity.ERROR
    assert "differs" in problem.message


# --- unconstrain ---------------------------------------------------------------------------------------------------


def test_given_a_model_when_it_goes_through_a_builder_then_it_is_the_same() -> None:
    model = load_model(RAPTOR / "geometry.yaml")
    again = ModelBuilder.from_model(model).build()
    assert again.revision == model.revision
    assert again.bodies == model.bodies
    assert again.constraints == model.constraints


def test_given_an_unconstrained_frame_then_what_hung_on_it_is_an_orphan_that_answers_inside_itself() -> None:
    model = cart()
    builder = ModelBuilder.from_model(model)
    assert builder.remove_constraints(model.frame("Left:Mount")) == ("LeftFixed",)
    left = builder.build()
    assert {str(each.severity) for each in left.problems} == {"warning"}
    assert [each.message.split(":")[0] for each in left.problems if "orphan" in each.message] == [
        "body Left is an orphan",
        "body Lamp is an orphan",
    ]
    assert left.neighbors("Left:Mount") == ()
    with pytest.raises(NotConnectedError):
        left.get_transformation("Left:Lens", "Cart:Origin")
    assert left.get_transformation("Lamp:Foot", "Left:Mount").position[0] == pytest.approx(0.1)
    # the model it was made of is as it was
    assert model.next("Left:Mount").frame.full_name == "Cart:Rail"

    repaired = builder.build(repair=True)
    assert repaired.get_body_list() == ["Cart", "Right"]
    assert all("removed" in each.message for each in repaired.problems if "orphan" in each.message)


def test_given_several_constraints_then_one_is_removed_by_name_or_all_are() -> None:
    builder = ModelBuilder.from_model(cart())
    with pytest.raises(NotConnectedError, match="has no constraint 'RigthFixed'"):
        builder.remove_constraints("Cart:Rail", "RigthFixed")
    assert builder.remove_constraints("Cart:Rail", "RightFixed") == ("RightFixed",)
    assert [each.name for each in builder.build().constraints] == ["LeftFixed", "LampFixed"]
    builder = ModelBuilder.from_model(cart())
    assert builder.remove_constraints("Cart:Rail") == ("LeftFixed", "RightFixed")
    with pytest.raises(NotConnectedError, match="Cart:Rail has no constraint"):
        builder.remove_constraints("Cart:Rail")


def test_given_a_joint_that_others_follow_when_it_is_removed_then_the_build_names_the_followers() -> None:
    builder = ModelBuilder("lift")
    builder.add_body("Base").add_frame("Origin").add_frame("Other")
    builder.add_body("Arm").add_frame("Origin")
    builder.add_body("Shade").add_frame("Origin")
    builder.add_constraint("Lift", "Base:Origin", "Arm:Origin", joint=Joint(JointType.REVOLUTE))
    follows = Joint(JointType.REVOLUTE, mimic=Mimic("Lift"))
    builder.add_constraint("Shades", "Base:Other", "Shade:Origin", joint=follows)
    model = builder.build()
    assert not model.is_static("Arm:Origin", "Base:Origin")
    assert model.is_static("Base:Other", "Base:Origin")
    assert [each.is_static for each in model.constraints] == [False, False]
    changed = ModelBuilder.from_model(model)
    changed.remove_constraints("Arm:Origin")
    with pytest.raises(GeometryError, match="Shades"):
        changed.build()


# --- unique names --------------------------------------------------------------------------------------------------


def test_given_two_bodies_or_constraints_of_one_name_then_no_model_is_made_of_them() -> None:
    model = cart()
    with pytest.raises(ValueError, match="body name 'Left' is given twice"):
        Model((*model.bodies, model.body("Left")), model.constraints)
    with pytest.raises(ValueError, match="constraint name 'LampFixed' is given twice"):
        Model(model.bodies, (*model.constraints, model.constraints[-1]))
