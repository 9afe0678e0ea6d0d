"""Joints in the YAML format: what may be written, the error for each bad one, and how they are written again."""

from __future__ import annotations

import math

import pytest
from support_formats import YAML, line_of, only_problem, problems_of, read

from modelserver.errors import Severity
from modelserver.formats import save_model
from modelserver.geometry import Joint, JointType, Mimic

LEFT = (0.0, 1.0, 0.0)
D = math.radians


def with_joint(text):
    """Return the file with a joint in its constraint, and another constraint, Other, that slides."""
    other = "  Lamp: {frames: {Origin: }}\nconstraints:\n"
    slides = "  Other: {from: Cart:Origin, to: Lamp:Origin, joint: {type: prismatic, axis: [1, 0, 0]}}\n"
    return YAML.replace("constraints:\n", other).replace("xyz: [0, 0, 0.1]", f"joint: {text}") + slides


def joint(text):
    return read(with_joint(text)).constraints[0].joint


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("fixed", Joint()),
        ("{type: fixed}", Joint()),
        ("", Joint()),
        ("spherical", Joint(JointType.SPHERICAL)),
        ("planar", Joint(JointType.PLANAR)),
        ("floating", Joint(JointType.FLOATING)),
        ("{type: revolute, axis: [0, 2, 0]}", Joint(JointType.REVOLUTE, LEFT)),
        (
            "{type: revolute, axis: [0, 1, 0], limits_deg: [-30, 20], rate_limit_deg: 90, default_deg: 5, "
            "sigma_deg: 0.05}",
            Joint(JointType.REVOLUTE, LEFT, (D(-30),), (D(20),), (D(90),), (D(5),), (D(0.05),)),
        ),
        # as with rpy and rpy_deg, what does not name degrees is radians
        (
            "{type: revolute, axis: [0, 1, 0], limits: [-0.5, 0.25], rate_limit: 2, default: 0.125, sigma: 0.001}",
            Joint(JointType.REVOLUTE, LEFT, (-0.5,), (0.25,), (2.0,), (0.125,), (0.001,)),
        ),
        (
            "{type: prismatic, axis: [0, 1, 0], limits: [0, 0.4], rate_limit: 0.1, default: 0.2, sigma: 0.001}",
            Joint(JointType.PRISMATIC, LEFT, (0.0,), (0.4,), (0.1,), (0.2,), (0.001,)),
        ),
        ("{type: prismatic, axis: [0, 1, 0], limits: [0, .inf]}", Joint(JointType.PRISMATIC, LEFT, (0.0,))),
        ("{type: prismatic, axis: [0, 1, 0], limits: [-.inf, 1]}", Joint(JointType.PRISMATIC, LEFT, (), (1.0,))),
        ("{type: prismatic, axis: [0, 1, 0], limits: [-.inf, .inf]}", Joint(JointType.PRISMATIC, LEFT)),
        (
            "{type: planar, limits: {x: [-1, 2], turn_deg: [-90, 90]}, default: {y: 0.5}, rate_limit: {turn_deg: 10}}",
            Joint(
                JointType.PLANAR,
                lower=(-1, -math.inf, D(-90)),
                upper=(2, math.inf, D(90)),
                rate_limit=(math.inf, math.inf, D(10)),
                default=(0, 0.5, 0),
            ),
        ),
        (
            "{type: spherical, sigma: {rx_deg: 0.1, ry_deg: 0.2, rz: 0.003}}",
            Joint(JointType.SPHERICAL, sigma=(D(0.1), D(0.2), 0.003)),
        ),
        (
            "{type: floating, default: {z: 0.3, rz_deg: 45}}",
            Joint(JointType.FLOATING, default=(0, 0, 0.3, 0, 0, D(45))),
        ),
    ],
)
def test_given_a_joint_in_either_form_then_it_is_read(text, wanted):
    assert joint(text) == wanted


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("Other", Mimic("Other")),
        ("{joint: Other}", Mimic("Other")),
        ("{joint: Other, multiplier: -1, offset_deg: 3}", Mimic("Other", -1.0, D(3))),
        ("{joint: Other, offset: 0.1}", Mimic("Other", 1.0, 0.1)),
    ],
)
def test_given_a_mimic_then_it_is_read(text, wanted):
    assert joint(f"{{type: revolute, axis: [0, 1, 0], mimic: {text}}}").mimic == wanted


@pytest.mark.parametrize(
    ("text", "message", "fix"),
    [
        ("hinge", "there is no joint 'hinge'", "joints are fixed, revolute, prismatic, spherical, planar, floating"),
        ("revolut", "there is no joint 'revolut'", "write joint: revolute"),
        ("''", "there is no joint ''", "joints are fixed"),
        ("{type: [planar]}", "type is a text, got a list", "type:"),
        ("{type: revolute, axis: [0, 1, 0], mimic: ''}", "mimic names no joint", "write mimic: NAME"),
        ("{type: revolute, axis: [0, 1, 0], mimic: {joint: ''}}", "joint names no joint", "write joint: NAME"),
        ("{type: revolute, axis: [0, 1, 0], mimic: {joint: [a]}}", "joint is a text, got a list", "joint:"),
        ("[revolute]", "joint is a text, got a list", "joint:"),
        ("revolute", "a revolute joint needs an axis", "write joint: {type: revolute, axis: [0, 1, 0]}"),
        ("{type: prismatic}", "a prismatic joint needs an axis", "slides along"),
        ("{axis: [0, 1, 0]}", "type is missing", "add type:"),
        ("{type: Revolute, axis: [0, 1, 0]}", "there is no joint 'Revolute'", "write type: revolute"),
        ("{type: revolute, axis: [0, 0, 0]}", "the axis has no direction", "write e.g. axis: [0, 1, 0]"),
        ("{type: revolute, axis: [0, 1]}", "axis has 2 numbers, not 3", "write axis"),
        ("{type: revolute, axis: y}", "axis is a list of 3 numbers", "write axis"),
        ("{type: spherical, axis: [0, 1, 0]}", "a spherical joint has no axis", "remove axis"),
        ("{type: fixed, sigma: 0.1}", "sigma: a fixed joint does not move", "remove sigma"),
        ("{type: revolute, axis: [0, 1, 0], limits_dge: [0, 1]}", "unknown key 'limits_dge'", "write limits_deg"),
        ("{type: revolute, axis: [0, 1, 0], limits_deg: [20, -30]}", "limits_deg are reversed", "[-30, 20]"),
        ("{type: revolute, axis: [0, 1, 0], limits: 1}", "limits is a list of 2 numbers", "[lower, upper]"),
        ("{type: revolute, axis: [0, 1, 0], limits: [1]}", "limits is a list of 2 numbers", "[lower, upper]"),
        ("{type: revolute, axis: [0, 1, 0], limits: [.inf, .inf]}", "reversed", "limits"),
        ("{type: revolute, axis: [0, 1, 0], limits: [0, .nan]}", "is not a finite number", "[lower, upper]"),
        ("{type: revolute, axis: [0, 1, 0], limits: [0, 1], limits_deg: [0, 1]}", "both given", "keep one"),
        ("{type: prismatic, axis: [0, 1, 0], limits_deg: [0, 1]}", "a prismatic joint moves in meters", "limits:"),
        ("{type: revolute, axis: [0, 1, 0], sigma_deg: -0.1}", "sigma_deg is not negative, got -0.1", "0.1"),
        ("{type: revolute, axis: [0, 1, 0], sigma: .nan}", "sigma: '.nan' is not a finite number", "write sigma"),
        ("{type: revolute, axis: [0, 1, 0], rate_limit_deg: -90}", "rate_limit_deg is not negative", "90"),
        ("{type: revolute, axis: [0, 1, 0], default_deg: 1e12}", "out of reach", "default_deg"),
        (
            "{type: revolute, axis: [0, 1, 0], limits_deg: [-30, 20], default: 1}",
            "the default is out of the limits",
            "within",
        ),
        ("{type: planar, limits: [0, 1]}", "limits of a planar joint is a mapping by coordinate", "{x: ..., y"),
        ("{type: planar, limits_deg: {turn: [0, 1]}}", "has several coordinates", "write limits: {turn_deg"),
        ("{type: planar, limits: {z: [0, 1]}}", "unknown key 'z'", "keys here are"),
        ("{type: planar, limits: {x_deg: [0, 1]}}", "limits: x_deg is a length", "write x: in meters"),
        ("{type: planar, limits: {turn: [0, 1], turn_deg: [0, 1]}}", "turn and turn_deg are both given", "keep one"),
        ("{type: planar, sigma: {x: 0.1, turn: 0.1}}", "sigma does not state y", "0 is exact"),
        ("{type: planar, limits: {x: [1, 2]}, default: {y: 0}}", "the default of x is out of the limits", "within"),
        ("{type: planar, mimic: Other}", "a planar joint has several coordinates and cannot follow", "remove mimic"),
        ("{type: revolute, axis: [0, 1, 0], mimic: [Other]}", "mimic is a text, got a list", "mimic"),
        ("{type: revolute, axis: [0, 1, 0], mimic: {multiplier: 2}}", "does not name the joint", "{joint: NAME}"),
        ("{type: revolute, axis: [0, 1, 0], mimic: {joint: Other, multiplier: .inf}}", "not a finite", "multiplier"),
        ("{type: revolute, axis: [0, 1, 0], mimic: {joint: Othr}}", "follows 'Othr'", "write Other"),
        ("{type: revolute, axis: [0, 1, 0], mimic: {joint: CameraFixed}}", "follows itself", "remove mimic"),
        ("{type: prismatic, axis: [0, 1, 0], mimic: {joint: Other, offset_deg: 1}}", "moves in meters", "offset"),
        (
            "{type: revolute, axis: [0, 1, 0], mimic: {joint: Other, offset: 1, offset_deg: 1}}",
            "offset and offset_deg are both given",
            "keep one",
        ),
        ("{type: revolute, axis: [0, 1, 0], mimic: {joint: Other, factor: 1}}", "unknown key 'factor'", "keys here"),
    ],
)
def test_given_a_bad_joint_then_it_is_named_with_its_line_place_and_remedy(text, message, fix):
    content = with_joint(text)
    problem = only_problem(content)
    assert message in problem.message
    assert fix in problem.fix
    assert problem.line in (line_of(content, "joint: " + text), line_of(content, "CameraFixed"))
    assert problem.element.startswith("constraint CameraFixed")


def test_given_a_default_left_out_where_the_limits_exclude_0_then_it_rests_at_a_limit():
    assert joint("{type: prismatic, axis: [0, 1, 0], limits: [0.2, 0.5]}").default_position == (0.2,)


def test_given_a_joint_that_cannot_be_read_then_who_follows_it_is_no_second_fault():
    text = with_joint("{type: revolute, axis: [0, 0, 0]}").replace(
        "axis: [1, 0, 0]", "axis: [1, 0, 0], mimic: CameraFixed"
    )
    assert "no direction" in only_problem(text).message


def test_given_mimics_in_a_cycle_then_it_is_named():
    text = with_joint("{type: revolute, axis: [0, 1, 0], mimic: Other}")
    text = text.replace("axis: [1, 0, 0]", "axis: [1, 0, 0], mimic: CameraFixed")
    assert "cycle: CameraFixed follows Other follows CameraFixed" in only_problem(text).message


def test_given_a_follower_out_of_its_limits_at_rest_then_it_loads_with_a_warning():
    text = with_joint("{type: revolute, axis: [0, 1, 0], limits_deg: [-5, 5], mimic: {joint: Other, offset_deg: 9}}")
    problem = only_problem(text, Severity.WARNING)
    assert (
        problem.message == "constraint 'CameraFixed': at the default of Other, its joint is at 9 deg, out of its limits"
    )
    assert problem.line == line_of(text, "CameraFixed")


def test_given_two_constraints_on_a_frame_then_only_strict_refuses_the_second():
    text = with_joint("fixed").replace("from: Cart:Origin", "from: Cart:Mast")
    assert problems_of(text) == ()
    problem = only_problem(text, strict=True)
    assert "frame Cart:Mast already has constraint CameraFixed" in problem.message
    assert problem.line == line_of(text, "Other")


@pytest.mark.parametrize(
    "text",
    [
        "planar",
        "{type: planar, axis: [1, 0, 0]}",
        "{type: revolute, axis: [0, 1, 0], limits_deg: [-30, 20], rate_limit_deg: 90, sigma_deg: 0.021}",
        "{type: prismatic, axis: [0, 1, 0], limits: [0, .inf]}",
        "{type: revolute, axis: [0, 1, 0], mimic: Other}",
        "{type: revolute, axis: [0, 1, 0], mimic: {joint: Other, multiplier: -0.5, offset_deg: 10}}",
        "{type: planar, limits: {turn_deg: [-90, 90]}, default: {x: 0, y: 0.5, turn_deg: 0}}",
    ],
)
def test_given_a_joint_when_written_again_then_it_reads_as_a_person_wrote_it(text):
    assert f"    joint: {text}\n" in save_model(read(with_joint(text)), "yaml").text


def test_given_a_joint_that_states_much_when_written_then_it_takes_a_line_for_each():
    text = "{type: revolute, axis: [0.6, 0, 0.8], limits: [-0.123456789012345, 0.2], rate_limit_deg: 90, mimic: Other}"
    written = save_model(read(with_joint(text)), "yaml").text
    assert "    joint:\n      type: revolute\n      axis: [0.6, 0, 0.8]\n" in written
    assert read(written).revision == read(with_joint(text)).revision


@pytest.mark.parametrize("name", ["a,b", "[x", "on", "12", '"q', "{y}", "a'b", "#c", "d\\e", "Ünit"])
def test_given_a_leader_of_an_odd_name_then_it_is_written_so_that_it_reads_back(name):
    quoted = "'" + name.replace("'", "''") + "'"
    text = with_joint(f"{{type: revolute, axis: [0, 1, 0], mimic: {quoted}}}").replace("  Other:", f"  {quoted}:")
    model = read(text)
    assert model.constraints[0].joint.mimic == Mimic(name)
    assert read(save_model(model, "yaml").text).constraints[0].joint.mimic == Mimic(name)


def test_given_a_format_without_joints_then_saving_lists_them():
    unsupported = save_model(read(with_joint("planar")), "miro").unsupported
    assert "the motion of 2 joints, written as fixed at the default position: CameraFixed, Other" in unsupported
