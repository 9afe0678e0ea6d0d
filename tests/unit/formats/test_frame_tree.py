"""Miro frame-tree XML: grouping into bodies, variables, duplicates."""

import math

import pytest
from support_formats import line_of, miro_body, miro_constraint, only_problem, problems_of, read, tree, tree_frame

from modelserver.errors import Severity
from modelserver.transforms import Pose

ROVER = tree(
    tree_frame("Rover"),
    tree_frame("Mast", "Rover", Z="-1.2", Yaw="90"),
    tree_frame("Camera", "Mast", X="0.1", Pitch="-10"),
    tree_frame("Antenna", "Rover", Y="0.3"),
)


@pytest.fixture(autouse=True)
def _no_rover_name(monkeypatch):
    monkeypatch.delenv("MRN", raising=False)


def test_roots_and_frames_that_carry_others_are_bodies_and_leaves_are_their_frames():
    model = read(ROVER)
    assert model.get_body_list() == ["Rover", "Mast"]
    assert model.get_body_frame_list("Rover") == ["Origin", "Mast", "Antenna"]
    assert model.get_body_frame_list("Mast") == ["Origin", "Camera"]
    (joint,) = model.constraints
    assert (joint.name, joint.from_, joint.to) == ("MastFixed", "Rover:Mast", "Mast:Origin")
    assert joint.pose == Pose.identity()
    assert model.problems == ()


def test_angles_are_degrees_about_fixed_axes_and_what_is_left_out_is_0():
    model = read(ROVER)
    found = model.get_transformation("Mast:Camera", "Rover:Origin")
    expected = Pose.from_rpy((0, 0, -1.2), yaw=math.radians(90)) @ Pose.from_rpy((0.1, 0, 0), pitch=math.radians(-10))
    assert found.pose.is_close(expected, 1e-15, 1e-15)
    turned = read(tree(tree_frame("A"), tree_frame("B", "A", Roll="30", Pitch="20", Yaw="10"))).frame("A:B").pose
    assert turned.rpy == pytest.approx([math.radians(30), math.radians(20), math.radians(10)], abs=1e-15)


def test_a_root_is_first_though_its_child_stands_before_it():
    model = read(tree(tree_frame("Leaf", "Mast"), tree_frame("Mast", "Rover"), tree_frame("Rover")))
    assert model.root.name == "Rover"


def test_several_roots_load_and_the_others_are_orphans():
    problem = only_problem(tree(tree_frame("A"), tree_frame("B")), Severity.WARNING)
    assert "B is an orphan" in problem.message


def test_a_variable_comes_from_the_option_before_the_environment(monkeypatch):
    text = ROVER.replace("Rover", "$MRN")
    monkeypatch.setenv("MRN", "FromEnvironment")
    assert read(text).root.name == "FromEnvironment"
    assert read(text, variables={"MRN": "K11"}).root.name == "K11"
    assert read(text.replace("$MRN", "${MRN}x"), variables={"MRN": "K11"}).root.name == "K11x"


def test_an_undefined_variable_in_names_is_one_warning_and_stays_as_written():
    text = ROVER.replace("Rover", "$MRN")
    problem = only_problem(text, Severity.WARNING)
    assert problem.line == line_of(text, "$MRN")
    assert "used 3 times" in problem.message
    assert "--set MRN=NAME" in problem.fix
    assert read(text).get_transformation("Mast:Camera", "$MRN:Origin")
    near = only_problem(text, Severity.WARNING, variables={"MNR": "K11"})
    assert near.nearest == ("MNR",)


def test_an_undefined_variable_in_a_number_is_an_error():
    text = ROVER.replace('value="0.3"', 'value="$WIDTH"')
    problem = only_problem(text)
    assert problem.element == "frame Antenna, Y"
    assert problem.line == line_of(text, "$WIDTH")
    assert "--set WIDTH=NUMBER" in problem.fix
    assert read(text, variables={"WIDTH": "0.25"}).frame("Rover:Antenna").pose.xyz == (0.0, 0.25, 0.0)


def test_a_frame_twice_retains_the_first_and_states_the_distance():
    text = ROVER.replace("</section>", tree_frame("Camera", "Mast", X="0.6", Pitch="-13") + "</section>")
    problem = only_problem(text, Severity.WARNING)
    lines = [number for number, line in enumerate(text.split("\n"), 1) if 'name="Camera"' in line]
    assert problem.line == lines[1]
    assert f"on line {lines[0]} and on line {lines[1]}" in problem.message
    assert "0.5 m and 3 deg apart" in problem.message
    assert "the first is used" in problem.message
    assert read(text).frame("Mast:Camera").pose.xyz == (0.1, 0.0, 0.0)


def test_a_missing_parent_offers_the_nearest():
    text = ROVER.replace('value="Mast" name="Parent"', 'value="Mats" name="Parent"')
    problem = only_problem(text)
    assert problem.nearest == ("Mast",)
    assert problem.fix == "write Mast"
    assert problem.element == "frame Camera, Parent"
    assert problem.line == line_of(text, "Mats")


ARM = (tree_frame("Rover"), tree_frame("PanTiltUnit", "Rover", Z="-1"), tree_frame("Pan", "PanTiltUnit", X="0.5"))


@pytest.mark.parametrize(
    "parent",
    [
        "Pan",
        "PanTiltUnit/Pan",
        "Rover/PanTiltUnit/Pan",
        "/Rover/PanTiltUnit/Pan",
        "Rover/.../Pan",
        "/.../Pan",
        "/Rover/.../Pan",
        ".../PanTiltUnit/Pan",
        "PanTiltUnit//Pan/",
        "./PanTiltUnit/./Pan",
        "PanTiltUnit/Pan/Tilt/..",
        "PanTiltUnit/Other/../Pan",
        "/Earth/UtmGrid10S/Rover/PanTiltUnit/Pan",
        " PanTiltUnit / Pan ",
    ],
)
def test_a_parent_that_is_a_path_is_resolved(parent):
    model = read(tree(tree_frame("Lens", parent, X="1"), *ARM))
    assert model.problems == ()
    assert model.get_transformation("Pan:Lens", "Rover:Origin").pose.xyz == (1.5, 0.0, -1.0)
    # as if the name alone had been written
    assert model.revision == read(tree(tree_frame("Lens", "Pan", X="1"), *ARM)).revision


@pytest.mark.parametrize("parent", ["Rover/Pan", "/Pan", "/PanTiltUnit/Pan", "Pan/PanTiltUnit", "Pan/.../Rover"])
def test_a_path_that_leads_nowhere_is_an_error_and_no_ancestor_is_proposed(parent):
    problem = only_problem(tree(*ARM, tree_frame("Lens", parent)))
    assert "does not exist" in problem.message
    assert problem.nearest == ()
    assert "write" not in problem.fix


@pytest.mark.parametrize(
    ("parent", "meant"),
    [
        ("PanTiltUnit/Pna", "PanTiltUnit/Pan"),
        ("PanTitlUnit/Pan", "PanTiltUnit/Pan"),
        ("/Rovre/PanTiltUnit/Pan", "/Rover/PanTiltUnit/Pan"),
        ("Rover/.../Pna", "Rover/.../Pan"),
        # an ancestor, or the frame itself, is never meant
        ("PanTiltUnit/Camera", ""),
        ("PanTiltUnits/Camera", ""),
        ("PanTiltUnit/Lnes", ""),
        ("Lnes", ""),
        ("PanTiltUnit/PanTiltUnti", ""),
    ],
)
def test_a_misspelled_name_in_a_path_is_corrected_in_its_place_or_not_at_all(parent, meant):
    problem = only_problem(tree(*ARM, tree_frame("Lens", parent)))
    assert problem.nearest == ((meant,) if meant else ())
    if meant:
        assert read(tree(*ARM, tree_frame("Lens", meant))).frame("Pan:Lens")


@pytest.mark.parametrize("parent", ["/Earth", "/Site", "UtmGrid10S", "/Earth/UtmGrid10S", "Earth", "/Moon/Crater"])
def test_a_parent_outside_the_file_becomes_a_root_and_what_stands_in_it_stays_together(parent):
    text = tree(tree_frame("Rover", parent, X="3"), tree_frame("Beacon", parent, X="1"), tree_frame("Mast", "Rover"))
    (note,) = problems_of(text)
    name = parent.split("/")[-1]
    assert (note.severity, note.nearest) == (Severity.NOTE, ())
    assert note.message == f"Parent {parent} is not in the file; it becomes a root"
    model = read(text)
    assert model.root.name == name
    assert model.get_transformation("Rover:Mast", f"{name}:Beacon").pose.xyz == (2.0, 0.0, 0.0)


def test_another_utm_zone_or_hemisphere_is_never_proposed():
    text = tree(tree_frame("UtmGrid11S"), tree_frame("UtmGrid10N"), tree_frame("Rover", "UtmGrid10S"))
    assert all(not each.nearest for each in problems_of(text))
    assert read(text).frame("UtmGrid10S:Rover")
    # nor where the name is no known one of the frame store
    assert only_problem(tree(tree_frame("Grid11S"), tree_frame("Rover", "Grid10S"))).nearest == ()


def test_a_misspelled_root_in_an_absolute_path_is_an_error_not_another_root():
    assert only_problem(tree(tree_frame("Rover"), tree_frame("Mast", "/Rovr"))).nearest == ("/Rover",)


def test_a_parent_in_the_world_that_the_service_keeps_is_a_root():
    assert read(tree(tree_frame("Rover", "/World", X="3"), tree_frame("Mast", "Rover"))).root.name == "Rover"


TWO_ARMS = (
    tree_frame("Rover"),
    tree_frame("LeftArm", "Rover", Y="1"),
    tree_frame("RightArm", "Rover", Y="-1"),
    tree_frame("Wrist", "LeftArm", X="0.5"),
    tree_frame("Wrist", "RightArm", X="0.7"),
)


def test_a_name_that_occurs_below_two_parents_is_two_frames():
    model = read(tree(*TWO_ARMS))
    assert model.problems == ()
    assert model.get_transformation("LeftArm:Wrist", "RightArm:Wrist").pose.xyz == pytest.approx((-0.2, 2.0, 0.0))


@pytest.mark.parametrize(
    ("parent", "x"), [("LeftArm/Wrist", 0.5), ("RightArm/Wrist", 0.7), ("/Rover/.../RightArm/Wrist", 0.7)]
)
def test_a_path_distinguishes_frames_of_one_name(parent, x):
    for frames in ((tree_frame("Tip", parent), *TWO_ARMS), (*TWO_ARMS, tree_frame("Tip", parent))):
        model = read(tree(*frames))
        assert model.problems == ()
        (tip,) = [body for body in model.bodies if body.has_frame("Tip")]
        assert model.get_transformation(f"{tip.name}:Tip", "Rover:Origin").pose.xyz[0] == x


def test_a_name_that_is_ambiguous_is_a_warning_with_the_paths():
    problem = only_problem(tree(*TWO_ARMS, tree_frame("Tip", "Wrist")), Severity.WARNING)
    assert "names 2 frames: Rover/LeftArm/Wrist, Rover/RightArm/Wrist" in problem.message
    # a root goes before frames further down
    text = tree(*TWO_ARMS, tree_frame("Wrist"), tree_frame("Tip", "/Wrist"), tree_frame("Tap", "Wrist"))
    model = read(text)
    assert model.frame("Wrist:Tip")
    assert model.frame("Wrist:Tap")


def test_both_of_a_name_may_carry_frames():
    model = read(tree(*TWO_ARMS, tree_frame("Tip", "LeftArm/Wrist"), tree_frame("Tip", "RightArm/Wrist", X="0.1")))
    assert model.problems == ()
    assert model.get_body_list() == ["Rover", "LeftArm", "RightArm", "Wrist", "RightArm.Wrist"]
    assert model.get_transformation("RightArm.Wrist:Tip", "Wrist:Tip").pose.xyz == pytest.approx((0.3, -2.0, 0.0))


def test_a_frame_twice_in_one_parent_that_is_written_in_two_ways_is_a_warning():
    text = tree(*ARM, tree_frame("Lens", "Pan", X="1"), tree_frame("Lens", "PanTiltUnit/Pan", X="2"))
    problem = only_problem(text, Severity.WARNING)
    assert "defined twice" in problem.message
    assert read(text).frame("Pan:Lens").pose.xyz == (1.0, 0.0, 0.0)


def test_paths_in_a_cycle_are_an_error():
    for frames in (
        (tree_frame("A", "B/C"), tree_frame("B", "A"), tree_frame("C", "B")),
        (tree_frame("R"), tree_frame("A", "A/A")),
        (tree_frame("A", "A/B"), tree_frame("B", "A/B"), tree_frame("B", "B/A")),
    ):
        assert any(each.severity is Severity.ERROR for each in problems_of(tree(*frames)))


def test_a_name_with_slashes_is_a_name_where_a_frame_has_it():
    model = read(tree(tree_frame("A"), tree_frame("A/B", "A", X="1"), tree_frame("C", "A/B")))
    assert model.get_transformation("A/B:C", "A:Origin").pose.xyz == (1.0, 0.0, 0.0)


@pytest.mark.slow
def test_many_deep_paths_end_in_time():
    deep = "/".join(f"F{n}" for n in range(2000))
    frames = [tree_frame("F0"), *(tree_frame(f"F{n}", f"F{n - 1}") for n in range(1, 2000))]
    frames += [tree_frame(f"G{n}", f"/{deep}") for n in range(2000)]
    (problem,) = [each for each in problems_of(tree(*frames)) if each.severity is Severity.ERROR]
    assert "too many and too deep" in problem.message


def test_paths_with_many_wildcards_end_in_time():
    frames = [tree_frame("F0"), *(tree_frame(f"F{n}", f"F{n - 1}") for n in range(1, 1000))]
    wild = "/.../".join(f"F{n}" for n in range(0, 1000, 2))
    frames += [tree_frame(f"G{n}", wild) for n in range(200)]
    (problem,) = [each for each in problems_of(tree(*frames)) if each.severity is Severity.ERROR]
    assert "too many and too deep" in problem.message


@pytest.mark.slow
def test_many_frames_of_one_name_end_in_time():
    frames = [tree_frame("Top"), *(tree_frame(f"F{n}", "Top") for n in range(3000))]
    frames += [tree_frame("Pan", f"F{n}") for n in range(3000)]
    frames += [tree_frame(f"G{n}", "Pan") for n in range(3000)]
    (problem,) = [each for each in problems_of(tree(*frames)) if each.severity is Severity.ERROR]
    assert "too many and too deep" in problem.message


def test_many_parents_outside_the_file_are_roots():
    frames = [tree_frame(f"Frame{n:04d}", f"/Outside{n:04d}") for n in range(3000)]
    problems = problems_of(tree(*frames))
    assert sum("it becomes a root" in problem.message for problem in problems) == 3000
    assert not [each for each in problems if each.severity is Severity.ERROR]


def test_parents_in_a_cycle_are_an_error_that_lists_them():
    text = tree(tree_frame("A"), tree_frame("B", "D"), tree_frame("C", "B"), tree_frame("D", "C"), tree_frame("E", "D"))
    problem = only_problem(text)
    assert "B in D in C in B" in problem.message
    assert "outside the cycle" in problem.fix
    assert "A in A" in only_problem(tree(tree_frame("A", "A"))).message


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("ten", "X: 'ten' is not a number"),
        ("", "X: '' is not a number"),
        ("nan", "not a finite number"),
        ("1 2", "not a number"),
    ],
)
def test_a_bad_number_is_named_with_its_line(value, message):
    text = ROVER.replace('value="0.1"', f'value="{value}"')
    problem = only_problem(text)
    assert message in problem.message
    assert problem.element == "frame Camera, X"
    assert problem.line == line_of(text, f'"{value}" name="X"')
    assert "meters" in problem.fix


def test_an_unknown_parameter_is_a_warning_with_the_nearest():
    problem = only_problem(ROVER.replace('name="Pitch"', 'name="Pich"'), Severity.WARNING)
    assert problem.nearest == ("Pitch",)


def test_a_name_that_disagrees_with_its_instance_is_a_warning():
    text = ROVER.replace('value="-1.2" name="Z"', 'value="Pole" name="Name"').replace(
        'value="0.1" name="X"', 'value="Camera" name="Name"'
    )
    problem = only_problem(text, Severity.WARNING)
    assert "Mast is used" in problem.message
    assert problem.element == "frame Mast, Name"


def test_a_child_named_origin_is_an_error():
    assert "named Origin" in only_problem(ROVER.replace("Camera", "Origin")).message


def test_instances_of_other_types_are_noted_and_other_frames_warned_of():
    extra = (
        '<instance type="rapid::CameraParameters" name="x"/><instance type="rapid::FrameMatrixParameters" name="y"/>'
    )
    found = problems_of(ROVER.replace("</section>", extra + "</section>"))
    assert [problem.severity for problem in found] == [Severity.NOTE, Severity.WARNING]


def test_bodies_beside_a_frame_tree_are_read_as_well():
    bodies = miro_body("Lamp") + miro_constraint("LampFixed", "Rover:Antenna", "Lamp:Origin")
    model = read(ROVER.replace("</section>", f"</section><section name='Geometry'>{bodies}</section>"))
    assert model.get_body_list() == ["Rover", "Mast", "Lamp"]
    assert model.problems == ()


@pytest.mark.slow
def test_a_chain_of_thousands_of_frames_needs_no_recursion():
    frames = [tree_frame("F0"), *(tree_frame(f"F{n}", f"F{n - 1}", X="1") for n in range(1, 3000))]
    model = read(tree(*frames))
    assert model.get_transformation("F2998:F2999", "F0:Origin").pose.xyz == (2999.0, 0.0, 0.0)
