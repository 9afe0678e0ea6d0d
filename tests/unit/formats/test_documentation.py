"""The examples in docs/geometry-files.md do what the page states."""

import math
from pathlib import Path

import pytest
from support_formats import read

from modelserver.transforms import Pose

DOCUMENT = Path(__file__).resolve().parents[3] / "docs" / "geometry-files.md"


def test_the_worked_example_is_clean_and_does_what_its_comments_state():
    text = DOCUMENT.read_text(encoding="utf-8")
    model = read(text.split("```yaml\n")[1].split("```")[0])
    assert model.problems == ()
    assert model.get_body_frame_list("RearCamera") == ["Origin", "Left", "Right", "Lamp"]
    assert model.frame("RearCamera:Left").pose.xyz == (0.0, 0.051, 0.0)
    assert model.frame("Cart:MastFoot").sigma.rotation == (math.radians(0.2),) * 3
    assert model.frame("Cart:Origin").sigma is None
    assert model.get_transformation("FrontCamera:Left", "Cart:Origin").covariance is not None


def test_given_the_example_of_joints_then_it_is_clean_and_rests_and_moves_as_the_page_states():
    model = read(DOCUMENT.read_text(encoding="utf-8").split("```yaml\n")[2].split("```")[0])
    assert model.problems == ()
    assert list(model.joints) == ["Turn", "Lift", "KeepLevel", "Reach", "OnTheFloor"]
    # the boom rests 30 degrees up, and what follows it by -1 stays level
    tip = model.get_transformation("Boom:Tip", "Base:Origin")
    assert tip.position[2] == pytest.approx(0.4 + 0.1 + 1.2 * math.sin(math.radians(30)))
    assert model.get_transformation("Level:Origin", "Base:Origin").pose.distance(Pose(tip.position))[1] < 1e-15
    # no default: the limit next to 0
    assert model.get_transformation("Probe:Origin", "Boom:Tip").position[0] == pytest.approx(0.1)
    trolley = model.get_transformation("Trolley:Origin", "Base:Origin")
    assert trolley.pose.is_close(Pose.from_rpy((1.5, 0.5, 0), yaw=math.radians(20)), 1e-15, 1e-15)
    assert trolley.covariance is None
    assert tip.covariance is not None
    level = model.get_transformation("Level:Origin", "Turret:Front").covariance
    assert level[4, 4] == pytest.approx(math.radians(0.2) ** 2)


def test_the_example_of_libbot2s_frames_is_clean_and_has_degrees():
    text = DOCUMENT.read_text(encoding="utf-8")
    example = next(block for block in text.split("```") if block.lstrip().startswith("coordinate_frames"))
    model = read(example)
    assert model.problems == ()
    assert list(model.joints) == ["body"]
    assert model.get_transformation("laser:Origin", "body:Origin").rpy[1] == math.radians(90)


def test_given_the_example_of_walking_a_model_then_all_that_it_asserts_is_so(monkeypatch):
    monkeypatch.chdir(DOCUMENT.parents[1])
    code = DOCUMENT.read_text(encoding="utf-8").split("```python\n")[2].split("```")[0]
    assert code.count("assert ") >= 7
    exec(compile(code, str(DOCUMENT), "exec"), {})
