"""The YAML format: what may be written, and the error for each bad input."""

import math

import numpy as np
import pytest
from support_formats import YAML, line_of, only_problem, problems_of, read

from modelserver.errors import Severity
from modelserver.geometry import Sigma
from modelserver.geometry.parts import RigidInertia
from modelserver.transforms import Pose

MAST = "Mast: {xyz: [0.2, 0, 1.1], rpy_deg: [0, -10, 0]}"


def with_mast(text, before=""):
    """Return the file with another Mast, given as it stands after the colon."""
    return YAML.replace("bodies:", f"{before}bodies:").replace(MAST, f"Mast: {text}")


def mast(text, before=""):
    return read(with_mast(text, before)).frame("Cart:Mast")


def test_bodies_frames_and_constraints_are_read_in_order():
    model = read(YAML)
    assert model.get_body_list() == ["Cart", "Camera"]
    assert model.get_body_frame_list("Cart") == ["Origin", "Mast"]
    (joint,) = model.constraints
    assert (joint.name, joint.from_, joint.to, joint.pose.xyz) == (
        "CameraFixed",
        "Cart:Mast",
        "Camera:Origin",
        (0.0, 0.0, 0.1),
    )
    assert model.problems == ()


TURNED = Pose.from_rpy((1, 2, 3), math.radians(10), math.radians(20), math.radians(30))


@pytest.mark.parametrize(
    "text",
    [
        "{xyz: [1, 2, 3], rpy_deg: [10, 20, 30]}",
        f"{{xyz: [1, 2, 3], rpy: {[math.radians(angle) for angle in (10, 20, 30)]}}}",
        f"{{xyz: [1, 2, 3], quaternion: {list(TURNED.wxyz)}}}",
        f"{{xyz: [1, 2, 3], rotation: {TURNED.rotation.tolist()}}}",
        f"{{matrix: {TURNED.matrix.tolist()}}}",
        f"{{matrix: {TURNED.matrix[:3].tolist()}}}",
        f"{{xyz: [1, 2, 3], quaternion: {[-value for value in TURNED.wxyz]}}}",
    ],
)
def test_a_pose_may_be_written_in_each_way(text):
    assert mast(text).pose.is_close(TURNED, 1e-14, 1e-14)


def test_radians_beyond_a_turn_are_warned_of_as_degrees():
    model = read(with_mast("{rpy: [0, -10, 0]}"))
    (problem,) = (each for each in model.problems if each.severity is Severity.WARNING)
    assert problem.message == "rpy: -10 rad looks like degrees"
    assert problem.fix == "write rpy_deg"
    assert not [each for each in read(with_mast("{rpy: [0, -6.2, 0]}")).problems if each.severity is Severity.WARNING]


@pytest.mark.parametrize("text", ["{}", "", "~", "null", "{xyz: [0, 0, 0]}", "{rpy_deg: [0, 0, 0]}", "{xyz: }"])
def test_what_is_left_out_is_the_identity(text):
    assert mast(text).pose == Pose.identity()


def test_names_are_taken_as_written_even_where_yaml_would_see_no_text():
    text = YAML.replace("Mast", "on").replace("Camera:", "12:")
    model = read(text)
    assert model.get_body_list() == ["Cart", "12"]
    assert model.frame("Cart:on").pose.xyz == (0.2, 0.0, 1.1)


def test_name_description_transform_and_inertia_are_read():
    rows = [[float(i == j) for j in range(6)] for i in range(6)]
    text = YAML.replace("bodies:", "name: Cart 7\ndescription: >\n  a small\n  cart\nbodies:").replace(
        "  Camera:\n", f"  Camera:\n    description: it sees\n    transform: {{xyz: [1, 2, 3]}}\n    inertia: {rows}\n"
    )
    model = read(text)
    assert (model.name, model.description) == ("Cart 7", "a small cart")
    camera = model.body("Camera")
    assert camera.description == "it sees"
    assert camera.pose.xyz == (1.0, 2.0, 3.0)
    assert np.array(camera.inertia).tolist() == rows


def test_inertia_of_mass_center_and_moments_is_that_of_the_rigid_body():
    stated = "{mass: 2, center: [0, 0, 0.5], moments: [1, 2, 2.5], products: [0.1, 0, -0.2]}"
    camera = read(YAML.replace("  Camera:\n", f"  Camera:\n    inertia: {stated}\n")).body("Camera")
    assert (camera.mass, camera.center_of_mass) == (2.0, (0.0, 0.0, 0.5))
    expected = RigidInertia(2.0, (0.0, 0.0, 0.5), ((1.0, 0.1, 0.0), (0.1, 2.0, -0.2), (0.0, -0.2, 2.5)))
    assert camera.inertia == expected.matrix()


# sigmas


@pytest.mark.parametrize(
    ("text", "position", "rotation"),
    [
        ("{xyz: 0.001, rpy_deg: 0.1}", (0.001,) * 3, (math.radians(0.1),) * 3),
        ("{xyz: [0.001, 0.002, 0.003], rpy: [0.1, 0.2, 0.3]}", (0.001, 0.002, 0.003), (0.1, 0.2, 0.3)),
        ("{xyz: 0.001}", (0.001,) * 3, (0.0,) * 3),
    ],
)
def test_a_sigma_is_one_number_or_three(text, position, rotation):
    assert mast(f"{{sigma: {text}}}").sigma == Sigma(position, rotation)
    joint = read(YAML.replace("xyz: [0, 0, 0.1]", f"sigma: {text}")).constraints[0]
    assert joint.sigma == Sigma(position, rotation)


def test_default_sigmas_count_for_what_states_a_pose():
    before = "defaults: {sigma: {xyz: 0.002, rpy: 0.01}}\n"
    model = read(with_mast("{xyz: [1, 0, 0]}", before))
    assert model.frame("Cart:Mast").sigma == Sigma((0.002,) * 3, (0.01,) * 3)
    assert model.frame("Cart:Origin").sigma is None
    assert model.constraints[0].sigma == Sigma((0.002,) * 3, (0.01,) * 3)
    assert mast("{xyz: [1, 0, 0], sigma: {xyz: 0}}", before).sigma == Sigma((0.0,) * 3, (0.01,) * 3)


@pytest.mark.parametrize(
    ("sigma", "message"),
    [
        ("{xyz: -1}", "not negative"),
        ("{xyz: [1, 2]}", "xyz has 2 numbers, not 3"),
        ("{xyz: small}", "'small' is not a number"),
        ("{xyz: 1e200}", "out of reach"),
        ("{rpy: 1, rpy_deg: 1}", "both given"),
        ("{xzy: 1}", "unknown key 'xzy'"),
        ("0.1", "expected a mapping"),
    ],
)
def test_a_bad_sigma_is_named(sigma, message):
    problem = only_problem(with_mast(f"\n        sigma: {sigma}"))
    assert message in problem.message
    assert problem.line == line_of(with_mast(f"\n        sigma: {sigma}"), "sigma:")
    assert problem.element.startswith("body Cart, frame Mast, sigma")


# templates

TEMPLATES = """\
modelserver: geometry/1
templates:
  camera:
    description: a stereo camera
    frames:
      Origin: {}
      Left: {xyz: [0, 0.05, 0]}
      Right: {xyz: [0, -0.05, 0]}
bodies:
  Cart:
    frames: {Origin: , A: , B: }
  Front:
    template: camera
  Back:
    template: camera
    description: the newer one
    frames:
      Lamp: {xyz: [0, 0, 1]}
      Left: {xyz: [0, 0.06, 0]}
constraints:
  FrontFixed: {from: Cart:A, to: Front:Origin}
  BackFixed: {from: Cart:B, to: Back:Origin}
"""


def test_bodies_of_one_template_have_its_frames_and_their_own():
    model = read(TEMPLATES)
    assert model.get_body_frame_list("Front") == ["Origin", "Left", "Right"]
    assert model.get_body_frame_list("Back") == ["Origin", "Left", "Right", "Lamp"]
    assert model.frame("Front:Left").pose.xyz[1] == 0.05
    assert model.frame("Back:Left").pose.xyz[1] == 0.06
    assert [model.body(name).description for name in ("Front", "Back")] == ["a stereo camera", "the newer one"]
    assert model.problems == ()


def test_an_unknown_template_offers_the_nearest():
    text = TEMPLATES.replace("template: camera\n    d", "template: camrea\n    d")
    problem = next(each for each in problems_of(text) if "template" in each.message)
    assert problem.nearest == ("camera",)
    assert problem.fix == "write camera"
    assert problem.element == "body Back"
    assert problem.line == line_of(text, "camrea")


def test_a_fault_in_a_template_is_reported_once():
    assert "xyz has 2 numbers" in only_problem(TEMPLATES.replace("[0, -0.05, 0]", "[0, -0.05]")).message


def test_an_unused_template_is_a_note():
    text = TEMPLATES.replace("bodies:", "  lamp:\n    frames: {Origin: }\nbodies:")
    assert [problem.severity for problem in problems_of(text)] == [Severity.NOTE]


def test_a_frame_twice_in_a_body_of_a_template_is_an_error():
    text = TEMPLATES.replace("      Left: {xyz: [0, 0.06, 0]}\n", "      Lamp: {}\n      Left: {}\n      Left: {}\n")
    assert sorted(problem.message.split(" is ")[0] for problem in problems_of(text)) == [
        "frame 'Lamp' of body 'Back'",
        "frame 'Left' of body 'Back'",
    ]


# bad input


@pytest.mark.parametrize(
    ("text", "message", "fix"),
    [
        ("{xyz: [0, 1]}", "xyz has 2 numbers, not 3", "write xyz: [number, number, number], in meters"),
        ("{xyz: [0, 1, 2, 3]}", "xyz has 4 numbers, not 3", "in meters"),
        ("{xyz: [0, one, 2]}", "xyz: 'one' is not a number", "in meters"),
        ("{xyz: [0, .nan, 2]}", "xyz: '.nan' is not a finite number", "in meters"),
        ("{xyz: [0, inf, 2]}", "xyz: 'inf' is not a finite number", "in meters"),
        ("{xyz: [0, 1e999, 2]}", "xyz: '1e999' is too large for a number", "in meters"),
        ("{xyz: [0, '1', 2]}", "xyz: '1' is a text in quotes, not a number", "in meters"),
        ("{xyz: [0, [1], 2]}", "xyz: expected a number, got a list", "in meters"),
        ("{xyz: [0, , 2]}", "not well-formed", "look at this line"),
        ("{xyz: 5}", "xyz is a list of 3 numbers, got '5'", "in meters"),
        ("{xyz: {x: 1}}", "xyz is a list of 3 numbers, got a mapping", "in meters"),
        ("{xyz: [0, 0, 2e9]}", "out of reach", "meters"),
        ("{rpy_deg: [0, 0]}", "rpy_deg has 2 numbers, not 3", "in degrees"),
        ("{rpy: [0, 0, x]}", "rpy: 'x' is not a number", "in radians"),
        ("{quaternion: [1, 0, 0]}", "quaternion has 3 numbers, not 4", "w, x, y, z"),
        ("{rotation: [[1, 0, 0], [0, 1, 0]]}", "rotation has 2 rows, not 3", "3 rows of 3"),
        ("{rotation: [[1, 0, 0], [0, 1], [0, 0, 1]]}", "rotation row 2 has 2 numbers, not 3", "rotation row 2"),
        ("{rotation: 5}", "rotation is a list of rows, got a single value", "rows"),
        ("{matrix: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 2]]}", "0 0 0 1", "leave the fourth row out"),
        ("{matrix: [[1, 0, 0, 0], [0, 5, 0, 0], [0, 0, 1, 0]]}", "this is not a rotation", "matrix"),
        ("{rpy: [0, 0, 0], rpy_deg: [0, 0, 0]}", "given twice, as rpy_deg and as rpy", "keep one"),
        ("{xyz: [0, 0, 0], matrix: [[1]]}", "matrix holds the whole pose, and xyz is given too", "remove"),
        ("{xyz: [0, 0, 0], xyz: [1, 0, 0]}", "xyz is given twice", "remove one"),
        ("{xzy: [0, 0, 0]}", "unknown key 'xzy'", "write xyz"),
        ("{color: red}", "unknown key 'color'", "keys here are xyz"),
        ("{description: [a]}", "description is a text, got a list", "description: some text"),
        ("[1, 2, 3]", "expected a mapping (key: value), got a list", "key: value"),
        ("here", "expected a mapping (key: value), got a single value", "key: value"),
        ("{[1]: 2}", "a key is a name, got a list", "name: value"),
        ("{<<: {}}", "merge keys (<<) are not supported", "templates"),
        ("!!python/object:os.system {}", "tag", "remove it"),
        ("*nothing", "alias *nothing has no complete anchor", "anchor first"),
    ],
)
def test_a_bad_frame_is_named_with_its_line_place_and_remedy(text, message, fix):
    content = with_mast(text)
    problem = only_problem(content)
    assert message in problem.message
    assert fix in problem.fix
    assert problem.line == line_of(content, f"Mast: {text}")
    assert problem.file == "file"
    if "key: value" not in fix and problem.element:
        assert problem.element.startswith("body Cart, frame Mast")


@pytest.mark.parametrize(
    ("old", "new", "message", "fix"),
    [
        ("    from: Cart:Mast\n", "", "from is missing", "add from: Body:Frame"),
        ("from: Cart:Mast", "from: Cart: Mast", "not well-formed", "missing colon"),
        ("from: Cart:Mast", "from: {Cart: Mast}", "there is a space after the colon", "without a space"),
        ("from: Cart:Mast", "from: [Cart, Mast]", "from is a text, got a list", "from:"),
        ("from: Cart:Mast", "from: Cart:Mats", "From names frame 'Mats'", "write Cart:Mast"),
        ("from: Cart:Mast", "from: Camera:Origin", "From equals To", "two different frames"),
        ("bodies:", "boddies:", "unknown key 'boddies'", "write bodies"),
        ("geometry/1", "geometry/2", "'geometry/2' is not supported", "write modelserver: geometry/1"),
        (
            "  Camera:\n    frames",
            "  Camera:\n    inertia: [[1]]\n    frames",
            "inertia has 1 rows, not 6",
            "6 rows of 6",
        ),
        (
            "  Camera:\n    frames",
            "  Camera:\n    inertia: {mass: 1}\n    frames",
            "moments missing",
            "write inertia: {mass: kg",
        ),
        (
            "  Camera:\n    frames",
            "  Camera:\n    inertia: {mass: 1, moments: [1, 1, 3]}\n    frames",
            "none can be greater than the sum",
            "mass in kg",
        ),
        (
            "  Camera:\n    frames",
            "  Camera:\n    inertia: {mass: -1, moments: [1, 1, 1]}\n    frames",
            "the mass is -1 kg",
            "mass in kg",
        ),
        ("  Camera:\n    frames", "  Cart:\n    frames", "body 'Cart' is defined twice (first at file:3", "rename one"),
        (
            "      Origin: {}\n      Mast",
            "      Mast: {}\n      Mast",
            "frame 'Mast' of body 'Cart' is defined twice",
            "rename",
        ),
        ("  Cart:\n", "  World:\n", "this name is reserved", "rename"),
        ("  Cart:\n", "  My Cart:\n", "a name has no white space", "plain name"),
    ],
)
def test_a_bad_file_has_an_error_with_a_fix(old, new, message, fix):
    content = YAML.replace(old, new, 1)
    problem = next(each for each in problems_of(content) if message in each.message)
    assert problem.severity is Severity.ERROR
    assert fix in problem.fix
    assert problem.line > 0


def test_a_constraint_twice_names_both_lines():
    content = YAML + "  CameraFixed: {from: Cart:Origin, to: Camera:Origin}\n"
    problem = only_problem(content)
    assert f"first at file:{line_of(content, 'CameraFixed')}" in problem.message
    assert problem.line == content.count("\n")


def test_every_problem_is_reported_at_once():
    content = YAML.replace("[0.2, 0, 1.1]", "[0.2, 0]").replace("xyz: [0, 0, 0.1]", "xzy: [0, 0, 0.1]")
    content = content.replace("frames:\n      Origin", "farmes:\n      Origin", 1)
    assert len(problems_of(content)) >= 3
    assert [problem.line for problem in problems_of(content)] == sorted(
        problem.line for problem in problems_of(content)
    )


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "the file is empty"),
        (b"\xef\xbb\xbf \n\t\n", "the file is empty"),
        (b"# only a comment\n", "nothing in the file but comments"),
        (b"just words", "top level is a single value"),
        (b"- a\n- b\n", "top level is a list"),
        (b"name: x\n", "there are no bodies"),
        (b"bodies:\n", "there are no bodies"),
        (b"bodies: {}\n", "there is no body"),
        (b"bodies:\n\tCart:\n", "indented with a tab"),
        (b"bodies: [\n", "not well-formed"),
        (b"bodies: {}\n---\nbodies: {}\n", "second document"),
        (b"bodies: \xff\n", "not UTF-8"),
        (b"bodies: \x00\n", "YAML forbids"),
        (bytes(range(256)) * 20, "not UTF-8"),
        (b"\x7fELF\x01\x01", "YAML forbids"),
        ("bodies: {}".encode("utf-16"), "not UTF-8"),
        (b"&a [*a]", "alias *a has no complete anchor &a before it"),
        (b"%TAG ! x\n", "not well-formed"),
    ],
)
def test_what_is_no_geometry_is_one_problem(content, message):
    problem = only_problem(content)
    assert message in problem.message
    assert problem.fix


def test_the_line_of_a_byte_that_is_not_utf8_is_named():
    assert only_problem(YAML.encode() + b"# \xe9t\xe9\n").line == YAML.count("\n") + 1


@pytest.mark.parametrize("bracket", ["[", "{a: ", "- "])
def test_deep_nesting_is_rejected_and_does_not_end_the_process(bracket):
    assert "nests deeper than 20 levels" in only_problem("bodies: " * (bracket == "[") + bracket * 100_000).message


def test_an_alias_bomb_is_rejected():
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]" for n in range(1, 12)]
    problem = only_problem("\n".join(lines))
    assert "aliases expanded" in problem.message
    assert problem.line > 5


def test_a_bomb_of_templates_is_rejected(monkeypatch):
    monkeypatch.setattr("modelserver.formats.yaml_geometry.MAX_FRAMES", 2000)
    frames = ", ".join(f"f{n}: {{}}" for n in range(300))
    bodies = "".join(f"  b{n}: {{template: t}}\n" for n in range(5000))
    found = problems_of(f"templates:\n  t: {{frames: {{{frames}}}}}\nbodies:\n{bodies}")
    assert ["more than 2000 frames" in each.message for each in found if each.severity is Severity.ERROR] == [True]


def test_anchors_and_aliases_may_be_used():
    content = with_mast("&here {xyz: [1, 0, 0]}").replace(
        "Camera:\n    frames:\n      Origin: {}", "Camera:\n    frames:\n      Origin: *here"
    )
    assert read(content).frame("Camera:Origin").pose.xyz == (1.0, 0.0, 0.0)


def test_a_file_that_does_not_state_its_form_loads_with_a_note():
    content = YAML.replace("modelserver: geometry/1\n", "")
    assert [problem.severity for problem in problems_of(content)] == [Severity.NOTE]
    assert read(content)
