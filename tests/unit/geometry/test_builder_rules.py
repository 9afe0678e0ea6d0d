"""Every rule of a model (report 4.5), the place each breach is reported at, and what the 2005 server would do."""

from __future__ import annotations

import pytest

from modelserver.errors import GeometryError, Location, Severity
from modelserver.geometry import BodyFrame, ModelBuilder
from modelserver.transforms import Pose


def at(line):
    return Location("cart.xml", line, f"element {line}")


def cart(strict=False):
    """Return a good builder of Cart, Mast and Camera in a row, with a place for each thing."""
    builder = ModelBuilder("cart", strict=strict)
    builder.add_body("Cart", source=at(1)).add_frame("Origin", source=at(2)).add_frame(
        "Top", Pose((0, 0, 1)), source=at(3)
    )
    builder.add_body("Mast", source=at(4)).add_frame("Foot", source=at(5)).add_frame(
        "Head", Pose((0, 0, 2)), source=at(6)
    )
    builder.add_body("Camera", source=at(7)).add_frame("Mount", source=at(8)).add_frame(
        "Lens", Pose((0.1, 0, 0)), source=at(9)
    )
    builder.add_constraint("MastFixed", "Cart:Top", "Mast:Foot", source=at(10))
    builder.add_constraint("CameraFixed", "Mast:Head", "Camera:Mount", source=at(11))
    return builder


def one_error(builder):
    with pytest.raises(GeometryError) as caught:
        builder.build()
    (problem,) = [each for each in caught.value.problems if each.severity is Severity.ERROR]
    assert problem.message in str(caught.value)
    assert problem.fix
    return problem


def one_warning(model):
    (problem,) = model.problems
    assert problem.severity is Severity.WARNING
    assert problem.fix
    return problem


def one_note(model):
    (problem,) = model.problems
    assert problem.severity is Severity.NOTE
    return problem


def test_a_good_model_has_no_problems_and_answers():
    model = cart().build()
    assert model.problems == ()
    assert model.root.name == "Cart"
    assert model.get_body_list() == ["Cart", "Mast", "Camera"]
    assert model.get_body_frame_list("Camera") == ["Mount", "Lens"]
    assert model.get_transformation("Camera:Lens", "Cart:Origin").pose == Pose((0.1, 0, 3))


def test_no_body_at_all():
    assert "no body" in one_error(ModelBuilder()).message
    with pytest.raises(GeometryError, match="no body"):
        ModelBuilder().build(repair=True)


def test_one_body_is_worth_a_note_for_a_vehicle_may_be_one_rigid_body():
    builder = ModelBuilder()
    builder.add_body("Only", source=at(4)).add_frame("Origin")
    (problem,) = builder.build().problems
    assert problem.severity is Severity.NOTE
    assert "one body, Only" in problem.message
    assert problem.line == 4


def test_a_body_without_a_frame():
    builder = cart()
    builder.add_body("Bare", source=at(20))
    problem = one_error(builder)
    assert "body 'Bare' has no frame" in problem.message
    assert (problem.file, problem.line, problem.element) == ("cart.xml", 20, "element 20")
    model = builder.build(repair=True)
    assert model.get_body_list() == ["Cart", "Mast", "Camera"]
    assert one_warning(model).message.endswith("removed")


def test_two_bodies_of_one_name_report_both_locations():
    builder = cart()
    builder.add_body("Mast", source=at(20)).add_frame("Other")
    problem = one_error(builder)
    assert problem.message == "body 'Mast' is defined twice (first at cart.xml:4 (element 4))"
    assert problem.line == 20
    model = builder.build(repair=True)
    assert model.get_body_frame_list("Mast") == ["Foot", "Head"]
    assert one_warning(model).line == 20


def test_two_frames_of_one_name_report_both_locations():
    builder = cart()
    builder.bodies[1].add_frame("Head", Pose((9, 9, 9)), source=at(20))
    problem = one_error(builder)
    assert problem.message == "frame 'Head' of body 'Mast' is defined twice (first at cart.xml:6 (element 6))"
    assert problem.line == 20
    assert builder.build(repair=True).frame("Mast:Head").pose == Pose((0, 0, 2))


def test_two_constraints_of_one_name_report_both_locations():
    builder = cart()
    builder.add_constraint("MastFixed", "Camera:Lens", "Cart:Origin", source=at(20))
    problem = one_error(builder)
    assert problem.message == "constraint 'MastFixed' is defined twice (first at cart.xml:10 (element 10))"
    assert problem.line == 20
    assert len(builder.build(repair=True).constraints) == 2


@pytest.mark.parametrize(
    ("from_", "to", "message", "nearest"),
    [
        ("Cart:Orgin", "Camera:Lens", "From names frame 'Orgin', which body Cart does not have", ("Cart:Origin",)),
        ("Cart:Origin", "Camra:Lens", "To names body 'Camra', which does not exist", ("Camera:Lens",)),
        ("Cart:Origin", "Camra:Lenz", "To names body 'Camra', which does not exist", ()),
        ("CartOrigin", "Camera:Lens", "From 'CartOrigin' is not of the form Body:Frame", ()),
        ("", "Camera:Lens", "From '' is not of the form Body:Frame", ()),
        (":", "Camera:Lens", "From ':' is not of the form Body:Frame", ()),
        ("Cart:", "Camera:Lens", "From 'Cart:' is not of the form Body:Frame", ()),
        (":Origin", "Camera:Lens", "From ':Origin' is not of the form Body:Frame", ()),
        ("Cart:Origin:x", "Camera:Lens", "From 'Cart:Origin:x' is not of the form Body:Frame", ()),
        ("cart:Origin", "Camera:Lens", "From names body 'cart', which does not exist", ("Cart:Origin",)),
    ],
)
def test_a_constraint_end_that_does_not_exist_is_named_with_the_nearest(from_, to, message, nearest):
    builder = cart()
    builder.add_constraint("Extra", from_, to, source=at(20))
    problem = one_error(builder)
    assert problem.message == f"constraint 'Extra': {message}"
    assert problem.line == 20
    assert problem.nearest[: len(nearest)] == nearest
    if nearest:
        assert problem.fix == f"write {nearest[0]}"
        assert nearest[0] in str(problem)
    repaired = builder.build(repair=True)
    assert [each.name for each in repaired.constraints] == ["MastFixed", "CameraFixed"]
    assert one_warning(repaired).message.endswith("; removed")


def test_both_wrong_ends_are_reported_at_once():
    builder = cart()
    builder.add_constraint("Extra", "Cart:Nope", "Nobody:x", source=at(20))
    with pytest.raises(GeometryError) as caught:
        builder.build()
    assert [("From" in each.message, "To" in each.message) for each in caught.value.problems] == [
        (True, False),
        (False, True),
    ]


def test_from_equals_to():
    builder = cart()
    builder.add_constraint("Extra", "Camera:Lens", "Camera:Lens", source=at(20))
    problem = one_error(builder)
    assert problem.message == "constraint 'Extra': From equals To (Camera:Lens)"
    assert problem.line == 20


def test_a_constraint_inside_one_body():
    builder = cart()
    builder.add_constraint("Extra", "Camera:Lens", "Camera:Mount", source=at(20))
    assert "joins two frames of one body, Camera:Lens and Camera:Mount" in one_error(builder).message
    assert len(builder.build(repair=True).constraints) == 2


def test_given_strict_then_a_second_constraint_on_a_frame_reports_where_the_first_is():
    builder = cart(strict=True)
    builder.add_constraint("Extra", "Cart:Origin", "Camera:Mount", source=at(20))
    problem = one_error(builder)
    assert problem.message == (
        "constraint 'Extra': frame Camera:Mount already has constraint CameraFixed "
        "(first at cart.xml:11 (element 11)); a frame has one at most"
    )
    assert problem.line == 20
    assert [each.name for each in builder.build(repair=True).constraints] == ["MastFixed", "CameraFixed"]


@pytest.mark.parametrize("repair", [False, True])
def test_given_several_constraints_on_a_frame_when_not_strict_then_all_count(repair):
    builder = cart()
    builder.add_body("Lamp", source=at(20)).add_frame("Foot")
    builder.add_body("Horn", source=at(21)).add_frame("Foot")
    builder.add_constraint("LampFixed", "Cart:Top", "Lamp:Foot", Pose((0, 1, 0)), source=at(22))
    builder.add_constraint("HornFixed", "Cart:Top", "Horn:Foot", Pose((0, -1, 0)), source=at(23))
    model = builder.build(repair=repair)
    assert model.problems == ()
    assert len(model.constraints) == 4
    assert model.get_transformation("Lamp:Foot", "Horn:Foot").pose == Pose((0, 2, 0))
    assert [each.name for each in model.get_kinematic_path("Lamp:Foot", "Horn:Foot").edges] == [
        "HornFixed",
        "LampFixed",
    ]


def test_a_name_that_a_broken_constraint_took_is_not_free():
    builder = cart()
    builder.add_constraint("Extra", "Cart:Nope", "Camera:Lens", source=at(20))
    builder.add_constraint("Extra", "Cart:Origin", "Camera:Lens", source=at(21))
    with pytest.raises(GeometryError) as caught:
        builder.build()
    assert [each.line for each in caught.value.problems] == [20, 21]


@pytest.mark.parametrize("name", ["World", "Odom"])
def test_the_services_own_bodies_are_rejected(name):
    builder = cart()
    builder.add_body(name, source=at(20)).add_frame("Origin")
    assert "name is reserved" in one_error(builder).message


def test_orphans_are_warned_of_and_answer_inside_their_assembly():
    builder = cart()
    builder.add_body("Trailer", source=at(20)).add_frame("Hitch").add_frame("Bed", Pose((-1, 0, 0)))
    builder.add_body("Crate", source=at(21)).add_frame("Bottom")
    builder.add_constraint("CrateFixed", "Trailer:Bed", "Crate:Bottom", source=at(22))
    model = builder.build()
    assert [(each.severity, each.line) for each in model.problems] == [(Severity.WARNING, 20), (Severity.WARNING, 21)]
    assert "body Trailer is an orphan" in model.problems[0].message
    assert "answers only inside its own assembly" in model.problems[0].message
    assert model.assemblies == (("Cart", "Mast", "Camera"), ("Trailer", "Crate"))
    assert model.get_transformation("Crate:Bottom", "Trailer:Hitch").pose == Pose((-1, 0, 0))


def test_repair_does_what_the_2005_server_did():
    builder = cart(strict=True)
    builder.add_body("Trailer", source=at(20)).add_frame("Hitch").add_frame("Bed")
    builder.add_body("Crate", source=at(21)).add_frame("Bottom")
    builder.add_constraint("CrateFixed", "Trailer:Bed", "Crate:Bottom", source=at(22))
    builder.add_constraint("Broken", "Cart:Nope", "Crate:Bottom", source=at(23))
    builder.add_constraint("Second", "Cart:Top", "Crate:Bottom", source=at(24))
    model = builder.build(repair=True)
    assert model.get_body_list() == ["Cart", "Mast", "Camera"]
    assert [each.name for each in model.constraints] == ["MastFixed", "CameraFixed"]
    assert {each.severity for each in model.problems} == {Severity.WARNING}
    assert all(each.message.endswith("removed") for each in model.problems)
    # in the order of the file; the second constraint breaks the rule at both its ends
    assert [each.line for each in model.problems] == [20, 21, 23, 24, 24]


def test_a_repaired_model_is_a_good_one():
    builder = cart()
    builder.add_body("Trailer").add_frame("Hitch")
    builder.add_constraint("Broken", "Cart:Nope", "Trailer:Hitch")
    repaired = builder.build(repair=True)
    assert repaired.revision == cart().build().revision


def test_errors_met_while_reading_come_first_by_line_and_stop_the_build():
    builder = cart()
    builder.add_error("row 2 has 3 numbers", at(9), "write 4")
    builder.add_warning("rotation corrected", at(3))
    builder.add_constraint("Extra", "Camera:Lens", "Camera:Lens", source=at(5))
    with pytest.raises(GeometryError) as caught:
        builder.build()
    assert [each.line for each in caught.value.problems] == [3, 5, 9]
    assert "rotation corrected" not in str(caught.value)
    with pytest.raises(GeometryError):
        builder.build(repair=True)


def test_what_a_broken_constraint_leaves_unconnected_is_not_complained_of():
    builder = ModelBuilder()
    builder.add_body("A").add_frame("a")
    builder.add_body("B").add_frame("b")
    builder.add_constraint("AB", "A:a", "B:wrong")
    assert "B:wrong" not in one_error(builder).message


def test_building_twice_gives_the_same():
    builder = cart()
    builder.add_body("Lonely").add_frame("x")
    first, second = builder.build(), builder.build()
    assert first.problems == second.problems
    assert first.revision == second.revision


def loop(miss):
    """Return a triangle of bodies whose last constraint has the misclosure `miss`."""
    builder = ModelBuilder()
    for name in "ABC":
        builder.add_body(name).add_frame("in").add_frame("out", Pose.from_rpy((1, 0, 0), yaw=2.0943951023931953))
    builder.add_constraint("AB", "A:out", "B:in")
    builder.add_constraint("BC", "B:out", "C:in")
    builder.add_constraint("CA", "C:out", "A:in", miss, source=at(30))
    return builder


def test_a_loop_that_closes_is_reported_as_exact():
    model = loop(Pose()).build()
    problem = one_note(model)
    # A reaches B and C each in one step, so it is the constraint between those two that is left over
    assert problem.message.startswith("constraint BC closes a loop through C, A, B; it closes exactly")


def test_a_loop_that_does_not_close_reports_its_misclosure():
    model = loop(Pose.from_rpy((0.003, 0.004, 0.0), yaw=0.01)).build()
    message = one_warning(model).message
    assert "its misclosure is" in message
    assert "no sigma is stated for B:out, A:out, CA, C:out" in message
    millimeters = float(message.split("misclosure is ")[1].split(" mm")[0])
    degrees = float(message.split(" mm and ")[1].split(" deg")[0])
    assert degrees == pytest.approx(0.573, abs=1e-3)
    assert 5 < millimeters < 25  # 5 mm, and what 0.01 rad makes of it over a meter or so
    # the shortest path answers: A to C crosses CA alone
    assert [each.constraint.name for each in model.find_path("C:in", "A:in")] == ["CA"]
    assert model.get_transformation("C:out", "A:in").pose.is_close(
        Pose.from_rpy((0.003, 0.004, 0.0), yaw=0.01).inverse(), 1e-12, 1e-12
    )


def test_two_constraints_between_two_bodies_are_a_loop_of_two():
    builder = ModelBuilder()
    builder.add_body("A").add_frame("a").add_frame("b", Pose((0, 1, 0)))
    builder.add_body("B").add_frame("a").add_frame("b", Pose((0, 1.001, 0)))
    builder.add_constraint("one", "A:a", "B:a")
    builder.add_constraint("two", "A:b", "B:b", source=at(3))
    problem = one_warning(builder.build())
    assert problem.message.startswith("constraint two closes a loop through A, B; its misclosure is 1 mm and 0 deg")
    assert problem.line == 3


def test_a_loop_beside_the_root_leaves_the_other_assemblies_their_fast_answers():
    builder = loop(Pose((0.5, 0, 0)))
    builder.add_body("X").add_frame("x")
    builder.add_body("Y").add_frame("y")
    builder.add_constraint("XY", "X:x", "Y:y", Pose((1, 0, 0)))
    model = builder.build()
    assert model._assemblies_with_loops == {0}
    assert model.get_transformation("Y:y", "X:x").pose == Pose((1, 0, 0))


def test_inertia_of_another_shape_is_rejected_with_the_body_named():
    builder = cart()
    builder.add_body("Odd", inertia=((1.0, 2.0),), source=at(20)).add_frame("x")
    problem = one_error(builder)
    assert "inertia of body Odd is not 6 rows of 6" in problem.message
    assert problem.line == 20


def test_a_draft_body_may_share_frames_with_another():
    builder = ModelBuilder()
    first = builder.add_body("One").add_frame("o").add_frame("x", Pose((1, 0, 0)))
    second = builder.add_body("Two")
    second.frames.extend(first.frames)
    builder.add_constraint("12", "One:x", "Two:o")
    model = builder.build()
    assert isinstance(model.frame("Two:x"), BodyFrame)
    assert model.get_transformation("Two:x", "One:x").pose == Pose((1, 0, 0))


def test_a_body_that_exists_is_added_again_under_another_name():
    builder = cart()
    camera = builder.build().body("Camera")
    builder.add_body("Post").add_frame("Foot").add_frame("Head", Pose((0, 0, 1)))
    builder.add_constraint("PostFixed", "Mast:Head2", "Post:Foot")
    builder.copy_body(camera.with_name("Spare"), source=at(30))
    model = builder.check(repair=True)[0]
    assert "Spare" not in model.get_body_list()  # an orphan, dropped with repair
    builder.add_constraint("SpareFixed", "Camera:Lens", "Spare:Mount")
    model = builder.check(repair=True)[0]
    assert model.get_body_frame_list("Spare") == model.get_body_frame_list("Camera")
    assert model.get_transformation("Spare:Lens", "Camera:Lens").pose == Pose((0.1, 0, 0))
