"""The editor of the page, without a browser: what its fields and buttons change in the file."""

from __future__ import annotations

import html
import json
import math
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("viser", reason="the extra view is not installed: pip install -e '.[view]'")

from modelserver.errors import ModelServerError, Problem, Severity
from modelserver.geometry import Joint, JointType, Mimic
from modelserver.geometry.model import Model
from modelserver.transforms.pose import Pose
from mstools.commands.view import open_editing
from mstools.edit import EditedFile, EditSession, GeometryItem, ItemKind
from mstools.view.editor import SNAPS, Editing, Editor, format_diff
from mstools.view.page import Actions, open_page
from mstools.view.scene import VehicleScene
from mstools.view.sources import open_geometry
from mstools.view.viewer import Viewer

RAPTOR = Path(__file__).resolve().parents[3] / "config" / "raptor"
LENS = GeometryItem(ItemKind.FRAME, "FLEA:Lens")
NOD = GeometryItem(ItemKind.CONSTRAINT, "FrontNoddingSICKAxis")


class EditedPage:
    """An editor on a page that nobody looks at."""

    def __init__(self, path: Path, server: Any):
        self.session = EditSession(EditedFile.open(path))
        self.actions = Actions()
        self.shown: list[Model] = []
        scene = VehicleScene(server, None, lambda frame, is_reference: None)
        scene.set_model(self.session.drawn, "Raptor:CG")
        self.scene = scene
        self.editor = Editor(server, scene, Editing(self.session), self.actions, self.shown.append)
        self.fields = self.editor._fields

    def set(self, **values: Any) -> str:
        """Type and choose in fields, set what was changed, and return the message."""
        for key, value in values.items():
            self.fields._fields[key].value = value
        self.fields.set()
        return self.message

    def undo(self) -> None:
        self.editor._step(self.session.undo, self.session.undo_name, "undone")

    def leave(self, **texts: str) -> str:
        """Report texts of fields that were left, by their labels, as the page does; return the message."""
        shown = str(self.fields._count)
        self.fields._set_left(json.dumps([0, *[(shown, *each) for each in texts.items()]]), 0)
        return self.message

    @property
    def message(self) -> str:
        return str(self.editor._message.content).replace("\\", "")

    @property
    def model(self) -> Model:
        assert self.session.model is not None
        return self.session.model

    def constraint(self, name: str) -> Any:
        return next(each for each in self.model.constraints if each.name == name)


@pytest.fixture
def page(tmp_path: Path) -> Iterator[EditedPage]:
    for each in ("geometry.yaml", "vehicle.yaml", "raptor.dbc"):
        shutil.copy(RAPTOR / each, tmp_path)
    opened = open_page(port=0)
    yield EditedPage(tmp_path / "vehicle.yaml", opened.server)
    opened.close()


ERRORS = {
    "unknown body": ("to: Digiclops:Mount", "to: Digiclopz:Mount", "DigiclopsFixed"),
    "sigma": ("xyz: [1.15, 0.6, -0.017]", "xyz: [1.15, 0.6]", "Raptor:CG"),
}


@pytest.fixture(params=ERRORS)
def wrong_page(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[EditedPage, str]]:
    right, wrong, culprit = ERRORS[request.param]
    for each in ("vehicle.yaml", "raptor.dbc"):
        shutil.copy(RAPTOR / each, tmp_path)
    text = (RAPTOR / "geometry.yaml").read_text()
    assert right in text
    (tmp_path / "geometry.yaml").write_text(text.replace(right, wrong, 1))
    opened = open_page(port=0)
    yield EditedPage(tmp_path / "vehicle.yaml", opened.server), culprit
    opened.close()


def test_given_a_file_with_an_error_then_it_opens_with_its_problems_and_can_be_fixed(
    wrong_page: tuple[EditedPage, str],
) -> None:
    page, culprit = wrong_page
    session, editor = page.session, page.editor
    assert session.model is None
    assert "not joined" in editor._status.content
    assert "**error**" in editor._problem_texts.content
    (button,) = [each for each in editor._buttons if each.label == f"1: {culprit}"]
    assert button is not None
    item = session.find_culprit(next(each for each in session.problems if each.severity == "error"))
    assert item is not None
    editor.select(item)
    text = session.document.get_yaml(item)
    for right, wrong, _ in ERRORS.values():
        text = text.replace(wrong, right)
    editor._text.value = text
    editor._write_text()
    assert not session.has_errors
    assert page.shown == [session.model]
    session.save()
    assert (session.file.path).read_text() == (RAPTOR / "geometry.yaml").read_text()


def test_given_a_file_that_is_no_yaml_then_it_is_fixed_as_text(tmp_path: Path) -> None:
    path = tmp_path / "geometry.yaml"
    path.write_text("modelserver: geometry/1\nbodies:\n  A: {frames: {Origin: {}}\n")
    opened = open_page(port=0)
    session = EditSession(EditedFile.open(path))
    viewer = Viewer(opened, open_geometry(path, {}, session), Editing(session))
    viewer.draw(0.0, 0.0)
    editor = viewer._editor
    assert editor is not None
    assert "not well-formed" in editor._problem_texts.content
    assert "(line 4)" in editor._problem_texts.content
    assert editor._text.value == session.document.text
    editor._new.value = "B"
    for kind in ItemKind:
        editor._add(kind)
        assert "not done" in editor._message.content
    editor._text.value += "  B: {frames: {Origin: {}}}}\n"
    editor._write_text()
    assert session.has_errors
    editor._text.value = "modelserver: geometry/1\nbodies:\n  A: {frames: {Origin: {}}}\n"
    editor._write_text()
    viewer.draw(0.1, 0.1)
    assert not session.has_errors
    assert (editor._item.name, editor._text.value) == ("A", "A: {frames: {Origin: {}}}")
    session.save()
    viewer._query.close()
    editor.close()
    opened.close()


def test_given_a_path_without_a_file_then_only_yaml_begins_a_new_one(tmp_path: Path) -> None:
    session = open_editing(tmp_path / "new.yaml", None, "", "", "").session
    assert session.file.is_new
    assert session.model is not None
    assert list(tmp_path.iterdir()) == []
    for name in ("robot.urdf", "drive.lcm", "new"):
        with pytest.raises(FileNotFoundError):
            open_editing(tmp_path / name, None, "", "", "")
    with pytest.raises(ModelServerError, match="create it first"):
        open_editing(tmp_path / "absent" / "new.yaml", None, "", "", "")


@pytest.mark.slow
def test_given_all_items_then_their_fields_without_a_change_change_nothing(page: EditedPage) -> None:
    before = page.session.document.text
    for item in page.session.document.list_items():
        page.editor.select(item)
        assert page.set() == ""
        assert page.session.document.text == before, item
    assert page.session.undo_name == ""


def test_given_numbers_then_the_frame_moves_and_undo_brings_it_back(page: EditedPage) -> None:
    page.editor.select(LENS)
    page.set(xyz=(0.051234, 0.0, 0.06), rpy=(0.0, 12.0, 0.0), has_sigma=True, sigma_xyz=(0.002, 0.002, 0.002))
    frame = page.model.frame(LENS.name)
    assert frame.pose.is_close(Pose.from_rpy((0.051234, 0.0, 0.06), 0.0, math.radians(12.0), 0.0))
    assert frame.sigma is not None
    assert frame.sigma.position == (0.002, 0.002, 0.002)
    assert page.shown == [page.model]
    page.undo()
    assert not page.session.is_changed
    assert page.fields._fields["xyz"].value == (0.05, 0.0, 0.06)


def test_given_a_sigma_that_is_taken_away_then_none_is_stated(page: EditedPage) -> None:
    page.editor.select(GeometryItem(ItemKind.FRAME, "Digiclops:ImagePlane"))
    page.set(has_sigma=False)
    # the defaults of the file apply where none is stated
    sigma = page.model.frame("Digiclops:ImagePlane").sigma
    assert sigma is not None
    assert sigma.position == (0.05, 0.05, 0.05)


def test_given_a_wrong_number_then_it_is_listed_and_a_right_one_fixes_it(page: EditedPage) -> None:
    page.editor.select(LENS)
    page.set(sigma_xyz=(-0.1, 0.0, 0.0))
    assert page.session.has_errors
    assert "not negative" in page.editor._problem_texts.content
    assert "cannot be saved" in page.editor._status.content
    page.editor._ask_save()
    assert page.message == "not saved: the geometry has errors; fix them first"
    assert page.editor._buttons[0].label == "1: FLEA:Lens"
    page.editor.select(NOD)
    page.editor.select(LENS)
    page.set(sigma_xyz=(0.01, 0.0, 0.0))
    assert not page.session.has_errors
    assert page.editor._problem_texts.content.startswith(("none", "- and"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("values", "joint"),
    [
        ({"limits": "-25, 15"}, {"lower": (math.radians(-25),), "upper": (math.radians(15),)}),
        ({"limits": "-.inf, 15"}, {"lower": (), "upper": (math.radians(15),)}),
        ({"limits": ""}, {"lower": (), "upper": ()}),
        ({"rate_limit": "45", "sigma": ""}, {"rate_limit": (math.radians(45),), "sigma": ()}),
        ({"default": "-5"}, {"default": (math.radians(-5),)}),
        ({"axis": (0.0, 0.0, 2.0)}, {"axis": (0.0, 0.0, 1.0)}),
        (
            {"leader": "BackNoddingSICKAxis", "multiplier": "-1"},
            {"mimic": Mimic("BackNoddingSICKAxis", -1.0, 0.0), "default": (0.0,)},
        ),
    ],
)
def test_given_fields_of_a_joint_then_the_joint_has_them(
    page: EditedPage, values: dict[str, Any], joint: dict[str, Any]
) -> None:
    page.editor.select(NOD)
    old = page.constraint(NOD.name).joint
    assert page.set(**values) == ""
    new = page.constraint(NOD.name).joint
    for key in ("lower", "upper", "rate_limit", "default", "sigma", "axis", "mimic"):
        assert getattr(new, key) == pytest.approx(joint.get(key, getattr(old, key))), key


def test_given_one_number_of_a_joint_then_the_others_stay_as_they_are_written(page: EditedPage) -> None:
    page.editor.select(NOD)
    page.set(limits="-25, 20", rate_limit="35.3")
    old = "limits_deg: [-30, 20], rate_limit_deg: 90, sigma_deg: 0.021}"
    new = "limits_deg: [-25, 20], rate_limit_deg: 35.3, sigma_deg: 0.021}"
    text = (RAPTOR / "geometry.yaml").read_text()
    first = text.index(old, text.index(f"{NOD.name}:"))
    assert page.session.document.text == text[:first] + new + text[first + len(old) :]


def test_given_another_type_then_the_joint_changes_to_it(page: EditedPage) -> None:
    page.editor.select(GeometryItem(ItemKind.CONSTRAINT, "SpeedLanFixed"))
    page.set(joint=JointType.PRISMATIC)
    page.set(axis=(0.0, 0.0, 1.0), limits="0, 0.5")
    assert page.constraint("SpeedLanFixed").joint == Joint(JointType.PRISMATIC, (0.0, 0.0, 1.0), (0.0,), (0.5,))
    page.set(joint=JointType.REVOLUTE)
    assert page.constraint("SpeedLanFixed").joint == Joint(JointType.REVOLUTE, (0.0, 0.0, 1.0))
    page.set(joint=JointType.FLOATING)
    assert page.constraint("SpeedLanFixed").joint == Joint(JointType.FLOATING)
    page.set(joint=JointType.FIXED)
    assert page.constraint("SpeedLanFixed").joint == Joint()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"limits": "5"}, "two numbers with a decimal point, lower and upper"),
        ({"limits": "20, -20"}, "lower one first, got '20, -20'"),
        ({"limits": "a, b"}, "'a' is not a number"),
        ({"default": "70"}, "out of"),
        ({"sigma": "-1"}, "not negative"),
        ({"axis": (0.0, 0.0, 0.0)}, "axis"),
        ({"name": "FLEALateral"}, "already"),
        ({"name": "a b"}, "white space"),
    ],
)
def test_given_a_wrong_field_then_the_message_has_why_and_nothing_changes(
    page: EditedPage, values: dict[str, Any], words: str
) -> None:
    page.editor.select(NOD)
    assert words in page.set(**values)
    assert not page.session.is_changed


def test_given_another_name_then_what_refers_to_it_follows_and_it_stays_selected(page: EditedPage) -> None:
    page.editor.select(GeometryItem(ItemKind.BODY, "FLEA"))
    page.set(name="Camera", description="The color camera.")
    assert page.constraint("FLEALateral").to == "Camera:BracketFixing"
    assert page.model.body("Camera").description == "The color camera."
    assert page.editor._item == GeometryItem(ItemKind.BODY, "Camera")


def test_given_the_frame_of_a_template_then_one_or_all_bodies_change(page: EditedPage) -> None:
    item = GeometryItem(ItemKind.FRAME, "FrontNoddingSICK:NoddingAxis")
    page.editor.select(item)
    page.set(xyz=(0.25, 0.0, 0.18), template=True)
    assert page.model.frame("BackNoddingSICK:NoddingAxis").pose.xyz[0] == 0.25
    page.set(xyz=(0.26, 0.0, 0.18), template=False)
    assert page.model.frame("BackNoddingSICK:NoddingAxis").pose.xyz[0] == 0.25
    assert page.model.frame(item.name).pose.xyz[0] == 0.26


def test_given_a_drag_then_the_fields_follow_and_its_end_is_one_change(page: EditedPage) -> None:
    page.editor.select(GeometryItem(ItemKind.CONSTRAINT, "FrontNoddingSICKFixed"))
    body, parent, pose = page.fields.find_place() or pytest.fail("no place")
    assert body == "Raptor"
    assert parent == page.model.frame("Raptor:CabFrontRailCenter").pose
    dragged = Pose((0.0123456, 0.0, 0.0)) @ pose
    page.fields.set_dragged(dragged, SNAPS["none"], is_end=False)
    assert page.fields._fields["xyz"].value == (0.0123, 0.0, 0.0)
    assert not page.session.is_changed
    page.fields.set_dragged(dragged, SNAPS["1 mm, 1 deg"], is_end=True)
    assert page.constraint("FrontNoddingSICKFixed").pose == Pose((0.012, 0.0, 0.0))
    turned = Pose.from_rpy((0.012, 0.0, 0.0), 0.0, 0.0, math.radians(44.0))
    page.fields.set_dragged(turned, SNAPS["1 cm, 5 deg"], is_end=True)
    assert np.degrees(page.constraint("FrontNoddingSICKFixed").pose.rpy) == pytest.approx([0.0, 0.0, 45.0])
    page.undo()
    page.undo()
    assert not page.session.is_changed


def test_given_names_then_items_are_added_copied_and_deleted(page: EditedPage) -> None:
    editor = page.editor
    editor._new.value = "Beacon"
    editor._add(ItemKind.BODY)
    assert editor._item == GeometryItem(ItemKind.BODY, "Beacon")
    editor._new.value = "Lamp"
    editor._add(ItemKind.FRAME)
    assert editor._item == GeometryItem(ItemKind.FRAME, "Beacon:Lamp")
    editor.select(GeometryItem(ItemKind.FRAME, "Raptor:CabRearRailCenter"))
    editor._new.value = "BeaconFixed"
    editor._add(ItemKind.CONSTRAINT)
    page.set(to="Beacon:Origin")
    assert page.model.get_transformation("Beacon:Lamp", "Raptor:CabRearRailCenter").pose == Pose.identity()
    editor.select(GeometryItem(ItemKind.FRAME, "Beacon:Lamp"))
    # the name was used
    assert editor._new.value == ""
    editor._duplicate()
    assert editor._item == GeometryItem(ItemKind.FRAME, "Beacon:Lamp2")
    editor.select(GeometryItem(ItemKind.BODY, "Beacon"))
    editor._delete()
    assert page.session.document.text == (RAPTOR / "geometry.yaml").read_text()
    editor._new.value = "World"
    editor._add(ItemKind.BODY)
    assert "reserved" in page.message
    assert editor._new.value == "World"


def test_given_a_diff_then_its_lines_are_colored_and_escaped() -> None:
    shown = format_diff("--- a\n+++ b\n@@ -1 +1 @@\n same\n-<old>\n+new\n ")
    lines = re.findall('<div style="([^"]*)">([^<]+)</div>', shown)
    assert [text for _, text in lines] == ["--- a", "+++ b", "@@ -1 +1 @@", " same", "-&lt;old&gt;", "+new", " "]
    red, green = "#e03131", "#2b8a3e"
    assert [(red in style, green in style) for style, _ in lines] == [
        *[(False, False)] * 4,
        (True, False),
        (False, True),
        (False, False),
    ]
    assert "pre-wrap" in shown


@pytest.mark.slow
def test_given_text_then_it_is_written_and_a_wrong_one_is_not(page: EditedPage) -> None:
    page.editor.select(LENS)
    assert page.editor._text.value.startswith("Lens:\n  xyz: [0.05, 0, 0.06]")
    page.editor._text.value = "Lens: {xyz: [0.06, 0, 0]}"
    page.editor._write_text()
    assert page.model.frame(LENS.name).pose == Pose((0.06, 0.0, 0.0))
    page.editor._text.value = "Lens: {xyz: [0.06, 0, 0]"
    page.editor._write_text()
    assert "not done" in page.message


@pytest.mark.slow
@pytest.mark.parametrize(
    ("typed", "number"),
    [
        ("-0.2", -0.2),
        ("1e-1", 0.1),
        ("-2.5E+0", -2.5),
        ("0,25", 0.25),
        ("\u22120.3", -0.3),
        ("\u20130.4", -0.4),
        (" +0.5 ", 0.5),
        (".5", 0.5),
    ],
)
def test_given_a_number_in_any_notation_then_it_is_what_was_typed(page: EditedPage, typed: str, number: float) -> None:
    page.editor.select(LENS)
    page.fields._fields["xyz"].texts = (typed, "0", "0.06")
    assert page.set() == ""
    assert page.model.frame(LENS.name).pose.xyz == (number, 0.0, 0.06)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("typed", "words"),
    [
        ("1/3", "'1/3' is not a number; accepted are"),
        ("abc", "'abc' is not a number; accepted are"),
        ("", "'' is not a number; accepted are"),
        ("1 2", "'1 2' is not a number; accepted are"),
        ("0,1,2", "'0,1,2' is not a number; accepted are"),
        ("1.000,5", "'1.000,5' is not a number; accepted are"),
        ("1,000", "'1,000' has two meanings; write 1.000, or no comma"),
        ("-12,345", "'-12,345' has two meanings; write -12.345, or no comma"),
        ("--1", "'--1' is not a number; accepted are"),
        ("nan", "'nan' is not a finite number"),
        ("inf", "'inf' is not a finite number"),
    ],
)
def test_given_what_is_no_number_then_it_is_marked_and_stays_and_nothing_changes(
    page: EditedPage, typed: str, words: str
) -> None:
    page.editor.select(LENS)
    before, field = page.session.document.text, page.fields._fields["xyz"]
    field.texts = (typed, "0", "0.06")
    assert f"x (m): {words}" in page.set()
    assert f"x (m): {words}" in html.unescape(field.fields[0]._problem.content)
    assert page.session.document.text == before
    assert field.texts[0] == typed
    field.texts = ("0.1", "0", "0.06")
    assert page.set() == ""
    assert field.fields[0]._problem.content == ""


def test_given_a_field_that_is_left_then_it_alone_is_set_and_the_others_stay_as_they_are_typed(
    page: EditedPage,
) -> None:
    page.editor.select(LENS)
    folder, field = page.fields._folder, page.fields._fields["xyz"]
    # the page sent the first of two digits; the next field is being typed in
    field.texts = ("0.1", "-", "0.06")
    assert page.leave(**{"x (m)": "0.12"}) == ""
    assert page.model.frame(LENS.name).pose.xyz == (0.12, 0.0, 0.06)
    assert field.texts == ("0.12", "-", "0.06")
    assert page.fields._folder is folder
    assert page.session.undo_name == f"edit {LENS.name}"
    # sent again
    steps = len(page.session._steps)
    page.leave(**{"x (m)": "0.12"})
    assert len(page.session._steps) == steps
    assert page.leave(**{"y (m)": "-1e-1"}) == ""
    assert page.model.frame(LENS.name).pose.xyz == (0.12, -0.1, 0.06)
    # as it was typed
    assert field.texts[1] == "-1e-1"
    page.undo()
    assert field.texts == ("0.12", "0", "0.06")


def test_given_a_field_that_was_left_when_another_item_is_selected_then_that_has_its_own_value(
    page: EditedPage,
) -> None:
    page.editor.select(LENS)
    message = json.dumps([0, (str(page.fields._count), "x (m)", "0.12")])
    page.fields._set_left(message, 0)
    page.editor.select(GeometryItem(ItemKind.FRAME, "Raptor:CG"))
    before = page.session.document.text
    page.fields._set_left(message, 0)
    assert page.session.document.text == before


def test_given_a_name_that_is_left_then_the_other_fields_stay_on_the_page(page: EditedPage) -> None:
    page.editor.select(LENS)
    folder = page.fields._folder
    page.fields._fields["xyz"].texts = ("0.", "0", "0.06")
    assert page.leave(Name="Lens2") == ""
    assert page.editor._item == GeometryItem(ItemKind.FRAME, "FLEA:Lens2")
    assert page.fields._folder is folder
    assert page.fields._fields["xyz"].texts[0] == "0."
    assert "already" in page.leave(Name="BracketFixing")
    assert page.fields._item == page.editor._item


def test_given_a_wrong_value_then_it_stays_to_be_seen_and_can_be_fixed(page: EditedPage) -> None:
    page.editor.select(LENS)
    before = page.session.document.text
    page.leave(**{"x (m)": "2e9"})
    assert page.session.has_errors
    assert page.fields._fields["xyz"].texts[0] == "2e9"
    page.leave(**{"x (m)": "0.05"})
    assert not page.session.has_errors
    assert page.session.document.text == before
    page.editor.select(GeometryItem(ItemKind.CONSTRAINT, "SpeedLanFixed"))
    page.set(to="Raptor:CG")
    assert page.session.has_errors
    assert page.fields._fields["to"].value == "Raptor:CG"
    page.undo()
    assert page.fields._fields["to"].value == "SpeedLan:BracketHole"


def test_given_a_typed_number_when_another_item_is_selected_then_it_is_set(page: EditedPage) -> None:
    page.editor.select(LENS)
    page.fields._fields["xyz"].texts = ("0.123", "0", "0.06")
    page.editor.select(NOD)
    assert page.editor._item == NOD
    assert page.model.frame(LENS.name).pose.xyz == (0.123, 0.0, 0.06)


def test_given_what_is_no_number_when_another_item_is_selected_then_it_stays_selected_and_nothing_is_lost(
    page: EditedPage,
) -> None:
    page.editor.select(LENS)
    page.fields._fields["xyz"].texts = ("1/3", "0", "0.06")
    page.editor.select(NOD)
    assert page.editor._item == LENS
    assert (page.editor._kind.value, page.editor._name.value) == (ItemKind.FRAME, LENS.name)
    assert page.fields._fields["xyz"].texts[0] == "1/3"
    assert "'1/3' is not a number" in page.message


def test_given_frames_that_coincide_then_the_constraint_is_placed(page: EditedPage) -> None:
    page.editor.select(GeometryItem(ItemKind.CONSTRAINT, "FLEALateral"))
    place = page.editor._place
    place._frame.value, place._target.value = "FLEA:Lens", "Digiclops:RightLens"
    place._place(place._coincide)
    assert page.message == ""
    assert page.model.get_transformation("FLEA:Lens", "Digiclops:RightLens").pose.is_close(Pose.identity(), 2e-6, 1e-7)
    place._target.value = "Raptor:CG"
    place._frame.value = "Raptor:Origin"
    place._place(place._coincide)
    assert "one side" in page.message


def test_given_distances_then_the_frame_is_placed_with_residuals_and_sigma(page: EditedPage) -> None:
    item = GeometryItem(ItemKind.FRAME, "Raptor:CG")
    page.editor.select(item)
    true = np.array((1.2, 0.55, 0.1))
    place = page.editor._place
    others = ["Raptor:FrontLeftCorner", "Raptor:FrontRightCorner", "Raptor:RearLeftCorner", "Raptor:CabFrontRailCenter"]
    for (frame, distance), name in zip(place._rows, others, strict=False):
        frame.value = name
        distance.value = [float(np.linalg.norm(true - page.model.frame(name).pose.xyz))]
    place._place(place._measure)
    assert page.message == ""
    frame = page.model.frame(item.name)
    assert frame.pose.xyz == pytest.approx(true, abs=1e-5)
    assert frame.sigma is not None
    assert 0.0 < max(frame.sigma.position) < 0.5
    assert "+0.0 mm" in place._result.content.replace("-0.0", "+0.0")
    for row, _ in place._rows[2:]:
        row.value = "-"
    place._place(place._measure)
    assert "three frames" in page.message


def test_given_an_error_elsewhere_then_an_item_keeps_its_notation(page: EditedPage) -> None:
    page.editor.select(GeometryItem(ItemKind.FRAME, "Digiclops:ImagePlane"))
    page.set(sigma_xyz=(-0.1, 0.0, 0.0))
    assert page.session.has_errors
    before = page.session.document.text
    # its description has several lines, its sigma is that of the file's defaults
    page.editor.select(LENS)
    page.set()
    assert page.session.document.text == before
    page.set(xyz=(0.051, 0.0, 0.06))
    changed = set(page.session.document.text.splitlines()) - set(before.splitlines())
    assert [line.strip() for line in changed] == ["xyz: [0.051, 0, 0.06]"]


def test_given_a_wrong_number_then_its_old_value_typed_again_is_set(page: EditedPage) -> None:
    before = page.session.document.text
    page.editor.select(LENS)
    page.set(xyz=(2e9, 0.0, 0.06))
    assert page.session.has_errors
    page.set(xyz=(0.05, 0.0, 0.06))
    assert not page.session.has_errors
    assert page.model.frame(LENS.name).pose.xyz == (0.05, 0.0, 0.06)
    assert "description: >-" in page.session.document.text
    assert page.session.document.text == before


def test_given_a_file_that_changes_on_disk_then_that_is_shown_until_it_is_read(page: EditedPage) -> None:
    path = page.session.file.path
    page.editor.update(1.0)
    assert "meanwhile" not in page.editor._status.content
    path.write_text(path.read_text().replace("name: raptor", "name: other"))
    page.editor.update(1.1)
    assert "meanwhile" not in page.editor._status.content
    page.editor.update(10.0)
    assert "changed meanwhile on disk" in page.editor._status.content
    page.editor._ask_read()
    page.editor.update(10.1)
    assert "meanwhile" not in page.editor._status.content
    path.unlink()
    page.editor.update(20.0)
    assert "changed meanwhile on disk" in page.editor._status.content


def test_given_an_edit_after_the_difference_was_shown_then_it_is_not_saved(page: EditedPage) -> None:
    path = page.session.file.path
    before = path.read_text()
    page.editor.select(LENS)
    page.set(xyz=(0.051, 0.0, 0.06))
    shown = page.session.document
    page.set(xyz=(0.052, 0.0, 0.06))
    page.editor._write_file(shown)
    assert "edited since its difference was shown" in page.message
    assert path.read_text() == before
    page.editor._write_file(page.session.document)
    assert path.read_text() == page.session.document.text


def test_given_notes_alone_then_they_are_counted(page: EditedPage) -> None:
    page.editor.select(LENS)
    note = Problem(Severity.NOTE, "x")
    page.session.problems = (note, note)
    page.editor._show_problems()
    assert page.editor._problem_texts.content == "none\n\n2 notes: modelserver check --notes"


def test_given_a_service_that_does_not_answer_then_the_reason_is_shown(page: EditedPage) -> None:
    page.editor._editing = Editing(page.session, "memq://", "", 0.05)
    page.editor._start_reload(dry_run=True)
    assert page.editor._reloading is not None
    page.editor._reloading[1].exception(10.0)
    page.editor.update(0.0)
    assert page.message.startswith("not applied: ")
    page.editor.close()
