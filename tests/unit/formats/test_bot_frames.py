"""libbot2's coordinate frames: what is read, and the error for each bad input."""

import math

import numpy as np
import pytest
from support_formats import only_problem, problems_of, read
from support_urdf import BOT_FRAMES, pose_at

from modelserver.errors import Severity
from modelserver.geometry import JointType
from modelserver.transforms import Pose

LASER = 'relative_to = "body";'
RPY = "rpy = [ 0, 90, 0 ];"


def test_frames_are_bodies_root_first_and_a_driven_one_floats():
    model = read(BOT_FRAMES)
    assert model.get_body_list() == ["local", "body", "laser"]
    body, laser = model.constraints
    assert (body.name, body.from_, body.to, body.joint.type) == (
        "body",
        "local:body",
        "body:Origin",
        JointType.FLOATING,
    )
    assert (laser.from_, laser.to, laser.joint.is_movable) == ("body:laser", "laser:Origin", False)
    assert model.problems == ()


def test_a_transform_takes_points_of_the_frame_to_those_of_the_other():
    # by hand: the laser's z axis is the body's x axis, its x axis the body's down
    model = read(BOT_FRAMES)
    T = model.get_transformation("laser:Origin", "local:Origin").matrix
    np.testing.assert_allclose(T, [[0, 0, 1, 1.5], [0, 1, 0, 2], [-1, 0, 0, 3.25], [0, 0, 0, 1]], atol=1e-15)


def test_a_driven_frame_follows_its_messages():
    model = read(BOT_FRAMES)
    # quarter turn to the left at (5, 6, 7); the laser is half a meter ahead, a quarter above
    names = ("body.x", "body.y", "body.z", "body.rx", "body.ry", "body.rz")
    values = dict(zip(names, (5, 6, 7, 0, 0, math.pi / 2), strict=True))
    found = pose_at(model, "laser:Origin", "local:Origin", values)
    assert found.is_close(Pose.from_rpy((5, 6.5, 7.25), 0, math.pi / 2, math.pi / 2))


@pytest.mark.parametrize(
    ("rotation", "wanted"),
    [
        ("rpy = [ 10, 20, 30 ];", (math.radians(10), math.radians(20), math.radians(30))),
        ("rodrigues = [ 0, 0, 0.5 ];", (0, 0, 0.5)),
        ("angleaxis = [ 0.5, 0, 2, 0 ];", (0, 0.5, 0)),
        ("angleaxis = [ 0.5, 0, 0, 0 ];", (0, 0, 0)),
        ("quat = [ 0.7071, 0.7071, 0, 0 ];", (math.pi / 2, 0, 0)),
        ('rpy = (double) ["0", ".0", "-9e1",];', (0, 0, -math.pi / 2)),
    ],
)
def test_every_way_to_write_a_rotation(rotation, wanted):
    model = read(BOT_FRAMES.replace(RPY, rotation))
    found = model.get_transformation("laser:Origin", "body:Origin").pose
    assert found.is_close(Pose.from_rpy((0.5, 0, 0.25), *wanted))


def test_blocks_of_others_comments_and_several_blocks_of_frames_are_no_matter():
    more = """# end
cameras { a { lcm_channel = "}"; } }
coordinate_frames {
  local {}
  lamp {
    relative_to = laser; pose_update_channel = POSE;
    initial_transform { translation = [0, 0, 1]; rodrigues = [0, 0, 0]; }
  }
}"""
    model = read(BOT_FRAMES + more)
    assert model.get_body_list() == ["local", "body", "laser", "lamp"]
    assert model.constraints[-1].joint.type is JointType.FLOATING
    assert [problem.severity for problem in model.problems] == [Severity.NOTE]


@pytest.mark.parametrize(
    ("old", "new", "message", "fix", "line"),
    [
        (LASER, 'relative_to = "bodi";', "relative_to names frame 'bodi'", "write body", 13),
        (LASER, 'relative_to = "laser";', "laser in laser", "root frame", 13),
        (LASER, "", "relative_to is missing", "relative_to =", 12),
        (LASER, 'relative_to = "body"', "a ; is missing", "end the assignment with ;", 13),
        (LASER, 'relative_to = "body;', "unexpected '\"'", "close the text", 13),
        (LASER, "relative_to = ;", "relative_to has no value", "= value;", 13),
        (LASER, "relative_to body;", "expected = or {", "name = value;", 13),
        (LASER, "= body;", "expected a name", "name = value;", 13),
        (LASER, "relative_to = body; }", "a } closes nothing", "missing {", 19),
        (LASER, LASER + " a {", "a block is not closed", "close it with }", 1),
        (LASER, LASER * 2, "relative_to is given twice (first on line 13)", "remove", 13),
        (LASER, "@", "unexpected '@'", "quotes", 13),
        (RPY, "", "the rotation is missing", "quat, rpy", 14),
        (RPY, RPY + "quat = [1,0,0,0];", "given twice, as quat and as rpy", "one of", 14),
        (RPY, "rpy = [ 0, 90 ];", "rpy has 2 numbers, not 3", "(degrees)", 16),
        (RPY, "rpy = [ 0, 90 0 ];", "the list of 'rpy' is not well-formed", "[value, value]", 16),
        (RPY, "rpy = [ 0, nan, 0 ];", "'nan' is not a finite number", "rpy =", 16),
        (RPY, "rpy = [ 0, 1e300, 0 ];", "rpy is out of reach", "exponent", 16),
        (RPY, "quat = [ 2, 0, 0, 0 ];", "length 2, not 1", "w first", 16),
        (RPY, "rpy { x = 1; }", "rpy is a block", "rpy =", 16),
        ("translation = [ 0.5, 0, 0.25 ];", "", "translation is missing", "meters", 14),
        ("0.5, 0, 0.25", "0.5, 0, 1e12", "out of reach", "meters", 14),
        ('root_frame = "local";', "", "root_frame is missing", "add root_frame", 1),
        ('root_frame = "local";', 'root_frame = "body";', "is the root frame", "another root_frame", 3),
        ('root_frame = "local";', 'root_frame = "a b";', "no white space", "rename", 2),
        ("  laser {", "  body {", "frame body is defined twice (first on line 3)", "rename", 12),
        ("  laser {", "  World {", "this name is reserved", "rename", 12),
    ],
)
def test_a_bad_file_has_an_error_with_place_and_fix(old, new, message, fix, line):
    found = [each for each in problems_of(BOT_FRAMES.replace(old, new, 1)) if each.severity is Severity.ERROR]
    problem = next(each for each in found if message in each.message)
    assert fix in problem.fix
    assert problem.line == line
    assert problem.file == "file"


def test_unknown_names_and_includes_are_warnings():
    assert "write history" in only_problem(BOT_FRAMES.replace("history", "histori"), Severity.WARNING).fix
    text = 'INCLUDE = "more.cfg";\n' + BOT_FRAMES
    assert "INCLUDE is not followed: 'more.cfg'" in only_problem(text, Severity.WARNING).message


def test_deep_nesting_and_bytes_that_are_no_text_are_problems():
    assert "nests deeper" in only_problem(BOT_FRAMES + "a {" * 5000).message
    assert "not UTF-8" in only_problem(BOT_FRAMES.encode() + b"\xff").message
