"""A session of editing: undo, check at each change, and a file that is saved whole or not at all."""

from __future__ import annotations

import os
import shlex
import shutil
from pathlib import Path

import pytest
from support_urdf import BOT_FRAMES, URDF

from modelserver.errors import GeometryError
from modelserver.formats import load_model
from mstools.cli import main
from mstools.edit import WHOLE_FILE, EditedFile, EditError, EditSession, GeometryItem, ItemKind

RAPTOR = Path(__file__).resolve().parents[3] / "config" / "raptor"
LENS = GeometryItem(ItemKind.FRAME, "FLEA:Lens")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for each in ("geometry.yaml", "vehicle.yaml", "raptor.dbc", "geometry.xml"):
        shutil.copy(RAPTOR / each, tmp_path)
    return tmp_path


def open_session(path: Path) -> EditSession:
    return EditSession(EditedFile.open(path))


def move(session: EditSession, x: float, item: GeometryItem = LENS) -> bool:
    return session.change("move", lambda document: document.set_pose(item, (x, 0.0, 0.06), (0.0, 10.0, 0.0)))


def test_given_changes_then_they_are_undone_and_made_again(folder: Path) -> None:
    session = open_session(folder / "geometry.yaml")
    before = session.document.text
    assert move(session, 0.07)
    assert not move(session, 0.07)
    assert move(session, 0.08)
    assert session.undo_name == "move"
    session.undo()
    assert session.model is not None
    assert session.model.frame(LENS.name).pose.xyz[0] == 0.07
    session.undo()
    session.undo()
    assert (session.document.text, session.is_changed, session.undo_name) == (before, False, "")
    session.redo()
    session.redo()
    session.redo()
    assert session.model.frame(LENS.name).pose.xyz[0] == 0.08
    session.undo()
    move(session, 0.09)
    assert session.redo_name == ""


def test_given_a_save_then_the_file_has_the_change_and_nothing_else(folder: Path) -> None:
    path = folder / "geometry.yaml"
    path.chmod(0o640)
    link = folder / "link.yaml"
    link.symlink_to(path)
    session = open_session(link)
    move(session, 0.07)
    diff = session.make_diff()
    assert [line for line in diff.split("\n") if line[:1] in "+-" and line[1:2] not in "+-"] == [
        "-        xyz: [0.05, 0, 0.06]",
        "+        xyz: [0.07, 0, 0.06]",
    ]
    session.save()
    assert not session.is_changed
    assert load_model(path).frame(LENS.name).pose.xyz == (0.07, 0.0, 0.06)
    assert path.stat().st_mode & 0o777 == 0o640
    assert link.is_symlink()
    # what is saved can be undone, and saved again
    session.undo()
    session.save()
    assert path.read_bytes() == (RAPTOR / "geometry.yaml").read_bytes()
    assert sorted(each.name for each in folder.iterdir()) == sorted(
        ["geometry.yaml", "geometry.xml", "vehicle.yaml", "raptor.dbc", "link.yaml"]
    )


def test_given_a_wrong_change_then_its_culprit_is_found_and_nothing_is_saved(folder: Path) -> None:
    path = folder / "geometry.yaml"
    session = open_session(path)
    session.change("sigma", lambda document: document.set_sigma(LENS, (-1.0, 0.0, 0.0), None))
    assert session.has_errors
    assert session.find_culprit(session.problems[0]) == LENS
    # the last model without an error stays
    assert session.model is not None
    with pytest.raises(EditError, match="has errors"):
        session.save()
    assert path.read_bytes() == (RAPTOR / "geometry.yaml").read_bytes()
    session.change("sigma", lambda document: document.set_sigma(LENS, (1.0, 0.0, 0.0), None))
    assert not session.has_errors
    session.save()


def test_given_a_frame_of_the_vehicle_file_then_its_name_is_checked_there(folder: Path) -> None:
    session = open_session(folder / "vehicle.yaml")
    session.change(
        "rename", lambda document: document.rename(GeometryItem(ItemKind.FRAME, "GPSAntenna:PhaseCenter"), "Phase")
    )
    assert session.has_errors
    problem = next(each for each in session.problems if each.severity == "error")
    assert problem.element == "sensors.gps.frame"
    assert session.find_culprit(problem) is None
    session.undo()
    assert not session.has_errors


def test_given_a_file_that_changed_meanwhile_then_it_is_not_written_over(folder: Path) -> None:
    path = folder / "geometry.yaml"
    session = open_session(path)
    move(session, 0.07)
    other = path.read_text().replace("name: raptor", "name: other")
    path.write_text(other)
    with pytest.raises(EditError, match="changed meanwhile"):
        session.save()
    assert path.read_text() == other
    session.read()
    assert not session.is_changed
    move(session, 0.07)
    session.save()
    assert load_model(path).name == "other"
    path.unlink()
    move(session, 0.08)
    with pytest.raises(EditError, match="removed meanwhile"):
        session.save()


def test_given_a_folder_without_permission_then_the_error_names_the_file_and_the_change_stays(folder: Path) -> None:
    if os.geteuid() == 0:
        pytest.skip("root writes into read-only directories")
    session = open_session(folder / "geometry.yaml")
    move(session, 0.07)
    folder.chmod(0o500)
    with pytest.raises(OSError, match=r"geometry\.yaml"):
        session.save()
    folder.chmod(0o700)
    assert session.is_changed


def test_given_a_file_that_was_broken_meanwhile_then_it_is_not_overwritten_and_can_be_read(folder: Path) -> None:
    path = folder / "geometry.yaml"
    session = open_session(path)
    move(session, 0.07)
    path.write_text("bodies: {")
    with pytest.raises(EditError, match="changed meanwhile"):
        session.save()
    assert path.read_text() == "bodies: {"
    session.read()
    assert (session.document.text, session.is_changed, session.has_errors) == ("bodies: {", False, True)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("modelserver: geometry/1\nbodies:\n  A: {frames: {Origin: {}}\n", "not well-formed"),
        ("bodies:\n\tA: {frames: {Origin: {}}}\n", "indented with a tab"),
        ("", "the file is empty"),
        ("# to do\n", "nothing in the file but comments"),
        ("some words", "top level is a single value"),
        ("modelserver: geometry/1\n", "there are no bodies"),
    ],
)
def test_given_a_file_without_readable_bodies_then_it_is_opened_as_text_and_can_be_fixed(
    tmp_path: Path, text: str, message: str
) -> None:
    path = tmp_path / "geometry.yaml"
    path.write_text(text)
    session = open_session(path)
    assert session.document.list_items() == []
    assert session.document.get_yaml(WHOLE_FILE) == text
    assert message in session.problems[0].message
    assert session.drawn.bodies == ()
    with pytest.raises(EditError, match="has errors"):
        session.save()
    fixed = "modelserver: geometry/1\nbodies:\n  A: {frames: {Origin: {}}}\n"
    session.change("write", lambda document: document.set_yaml(WHOLE_FILE, "bodies: ["))
    assert session.has_errors
    session.change("write", lambda document: document.set_yaml(WHOLE_FILE, fixed))
    assert session.document.list_items()[1] == GeometryItem(ItemKind.FRAME, "A:Origin")
    session.save()
    assert load_model(path).frame("A:Origin").pose.xyz == (0.0, 0.0, 0.0)


def test_given_text_that_cannot_be_read_when_a_body_is_added_then_it_is_written_first(tmp_path: Path) -> None:
    (tmp_path / "broken.yaml").write_text("bodies: {")
    session = open_session(tmp_path / "broken.yaml")
    with pytest.raises(EditError, match="write it as text first"):
        session.change("add", lambda document: document.add_body("A"))
    (tmp_path / "short.yaml").write_text("modelserver: geometry/1\n")
    session = open_session(tmp_path / "short.yaml")
    session.change("add", lambda document: document.add_body("A"))
    assert session.model is not None
    assert session.model.frame("A:Origin").pose.xyz == (0.0, 0.0, 0.0)


def test_given_a_new_file_then_it_has_one_body_and_is_there_once_it_is_saved(tmp_path: Path) -> None:
    path = tmp_path / "my rover.yaml"
    session = EditSession(EditedFile(path, is_new=True))
    assert session.model is not None
    assert [body.name for body in session.model.bodies] == ["Base"]
    assert session.model.name == "my rover"
    assert session.is_changed
    assert not session.has_changed_on_disk()
    assert not path.exists()
    assert session.make_diff().startswith(
        "--- my rover.yaml\n+++ my rover.yaml (edited)\n@@ -0,0 +1,7 @@\n+modelserver"
    )
    session.save()
    assert load_model(path).revision == session.model.revision
    assert not session.is_changed
    path.unlink()
    assert session.has_changed_on_disk()
    with pytest.raises(EditError, match="changed meanwhile"):
        session.save()


def test_given_a_new_file_that_another_program_wrote_meanwhile_then_it_stays(tmp_path: Path) -> None:
    path = tmp_path / "rover.yaml"
    session = EditSession(EditedFile(path, is_new=True))
    path.write_text("bodies: {}")
    with pytest.raises(EditError, match="changed meanwhile"):
        session.save()
    assert path.read_text() == "bodies: {}"


@pytest.mark.parametrize("name", ["robot.urdf", "my frames.cfg"])
def test_given_another_format_then_the_command_of_the_error_makes_a_file_that_is_edited(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path(name).write_text(URDF if name.endswith("urdf") else BOT_FRAMES)
    with pytest.raises(EditError) as caught:
        open_session(Path(name))
    first, _, second = str(caught.value).partition("only YAML is edited: ")[2].partition(", then ")
    program, *words = shlex.split(first)
    assert program == "modelserver"
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert not ended.value.code
    assert second == "modelserver view geometry.yaml --edit"
    assert not open_session(Path("geometry.yaml")).has_errors


@pytest.mark.parametrize("begin", ["", "\ufeff"])
def test_given_a_byte_order_mark_then_it_stays(folder: Path, begin: str) -> None:
    path = folder / "geometry.yaml"
    path.write_text(begin + path.read_text())
    session = open_session(path)
    move(session, 0.07)
    session.save()
    assert path.read_text().startswith(f"{begin}modelserver:")


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("geometry.xml", None, "only YAML is edited: modelserver convert"),
        ("binary.yaml", b"bodies: \xff", "not UTF-8"),
        ("frames.cfg", b'coordinate_frames { root_frame = "local"; }', "libbot2"),
    ],
)
def test_given_a_file_that_is_not_edited_then_the_error_has_why(
    folder: Path, name: str, content: bytes | None, words: str
) -> None:
    if content is not None:
        (folder / name).write_bytes(content)
    with pytest.raises((EditError, GeometryError), match=words):
        open_session(folder / name)
