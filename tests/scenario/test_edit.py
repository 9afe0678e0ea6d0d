"""The editor in a real browser, with the real service: what a person types, drags, saves and applies."""

from __future__ import annotations

import io
import math
import re
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pytest
from support_browser import TIMEOUT_MS, choose, find_fields, needs_browser, open_link, select_item, wait_until_sent
from support_command import run_command
from support_lcm import TIMEOUT_S, reserved_url
from support_signing import ALLOWED, write_test_key

pytest.importorskip("viser", reason="the extra view is not installed: pip install -e '.[view]'")

from PIL import Image

from modelserver.client.remote import Platform
from modelserver.formats import load_model
from mstools.view.scene import SELECTED_COLOR

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Locator, Page

pytestmark = [pytest.mark.slow, needs_browser]

RAPTOR = Path(__file__).resolve().parents[2] / "config" / "raptor"
MOUNT = "FrontNoddingSICKFixed"
SCENE_WIDTH = 990
"""Pixels left of the panels."""


def copy_raptor(folder: Path) -> Path:
    """Copy the Raptor's files to a folder, with a key for commands, and return the folder."""
    shutil.copy(RAPTOR / "geometry.yaml", folder)
    text, _, _ = (RAPTOR / "vehicle.yaml").read_text().partition("\ndrivers:")
    (folder / "vehicle.yaml").write_text(f"{text}\nstate_directory: state\n{ALLOWED}")
    write_test_key(folder)
    return folder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return copy_raptor(tmp_path)


class EditedPage(NamedTuple):
    """The editor of a geometry file, beside a service that is reached at `url`."""

    path: Path
    page: Page
    url: str


@pytest.fixture(scope="module")
def edited_page(browser: Browser, tmp_path_factory: pytest.TempPathFactory) -> Iterator[EditedPage]:
    """Open one editor, without a key for commands; each test leaves its file saved."""
    folder = copy_raptor(tmp_path_factory.mktemp("edited"))
    with (
        reserved_url() as url,
        run_command(["run", "-c", str(folder / "vehicle.yaml")], url),
        edit(browser, folder / "vehicle.yaml", url) as page,
    ):
        yield EditedPage(folder / "geometry.yaml", page, url)


@contextmanager
def edit(browser: Browser, path: Path, url: str, *more: str) -> Iterator[Page]:
    """Open the editor of a file as a person does: by the command, and its link in a browser."""
    words = ["view", str(path), "--edit", "--no-browser", "--port", "0", *more]
    with ExitStack() as stack:
        process = stack.enter_context(run_command(words, url, stdout=subprocess.PIPE))
        assert process.stdout is not None
        stack.callback(process.stdout.close)
        link = re.search(r"http\S+\?token=\S+", process.stdout.readline())
        assert link is not None
        # the scene with its tabs alone, without the page around it
        page = stack.enter_context(open_link(browser, link[0].replace("/?", "/scene?")))
        page.get_by_role("tab", name="Edit").click()
        page.get_by_text(re.compile("^geometry.yaml: ")).wait_for()
        yield page


def find_gizmo_box(page: Page) -> Locator:
    """Return the checkbox of the gizmo, with its folder open."""
    box = find_fields(page, "Gizmo")
    if not box.is_visible():
        page.get_by_text("Gizmo", exact=True).first.click()
    return box


def take_picture(page: Page) -> np.ndarray:
    """Return the picture of a page once it does not change any more."""
    before = np.zeros((1, 1, 3), int)
    for _ in range(60):
        page.wait_for_timeout(500)
        picture = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB")).astype(int)
        if picture.shape == before.shape and (np.abs(picture - before).sum(axis=2) > 90).sum() < 5:
            break
        before = picture
    return picture


def find_gizmo(page: Page) -> tuple[tuple[float, float], list[tuple[float, float]]]:
    """Return center and outermost points of the gizmo: where the scene differs without it."""
    box = find_fields(page, "Gizmo")
    box.set_checked(False)
    hidden = take_picture(page)
    box.set_checked(True)
    for _ in range(60):
        shown = take_picture(page)
        changed = np.abs(shown - hidden).sum(axis=2)[:, :SCENE_WIDTH] > 90
        if changed.sum() > 50:
            break
    rows, columns = np.nonzero(changed)
    assert len(rows) > 50, "there is no gizmo"
    center = (float(np.median(columns)), float(np.median(rows)))
    angles = np.arctan2(rows - center[1], columns - center[0])
    distances = np.hypot(rows - center[1], columns - center[0])
    tips = []
    for begin in np.linspace(-np.pi, np.pi, 12, endpoint=False):
        inside = np.nonzero((angles >= begin) & (angles < begin + np.pi / 6))[0]
        if len(inside):
            at = inside[np.argmax(distances[inside])]
            tips.append((float(distances[at]), float(columns[at]), float(rows[at])))
    return center, [(x, y) for _, x, y in sorted(tips, reverse=True)]


def press(page: Page, name: str) -> None:
    page.get_by_role("button", name=name, exact=True).click()


def confirm(page: Page, name: str) -> None:
    """Press a button of a dialog."""
    page.get_by_role("dialog").get_by_role("button", name=name, exact=True).click()


def set_number(page: Page, label: str, value: str) -> None:
    """Set a number of the selected item."""
    find_fields(page, label).nth(0).fill(value)
    page.keyboard.press("Enter")


def wait_for_value(field: Locator, value: str) -> None:
    from playwright.sync_api import expect

    expect(field).to_have_value(value, timeout=TIMEOUT_MS)


def wait_for_text(page: Page, text: str) -> None:
    page.get_by_text(re.compile(text)).first.wait_for()


def test_given_the_mount_of_the_front_laser_then_an_edit_changes_answers_and_is_undone(
    browser: Browser, folder: Path, lcm_url: str
) -> None:
    pair = ("FrontSICKLaser:Scan", "Raptor:CG")
    key = str(folder / "commands.key")
    with ExitStack() as stack:
        stack.enter_context(run_command(["run", "-c", str(folder / "vehicle.yaml")], lcm_url))
        platform = stack.enter_context(Platform(lcm_url, timeout=1.0, retries=30))
        before = platform.get_pose(*pair).transformation.pose
        page = stack.enter_context(edit(browser, folder / "vehicle.yaml", lcm_url, "--key", key))
        select_item(page, "constraint", MOUNT)
        set_number(page, "x (m)", "0.0625")
        wait_for_text(page, "^geometry.yaml: not saved$")
        # nothing is applied yet
        assert platform.get_pose(*pair).transformation.pose == before
        press(page, "Save")
        wait_for_text(page, r"\+    xyz: \[0.0625, 0, 0\]")
        confirm(page, "Save")
        wait_for_text(page, "^geometry.yaml: saved$")
        press(page, "Apply")
        wait_for_text(page, f"constraint {MOUNT} moves by 62.5 mm")
        confirm(page, "Apply")
        applied = time.monotonic()
        after = before
        while after == before:
            after = platform.get_pose(*pair).transformation.pose
            assert time.monotonic() < applied + TIMEOUT_S, "the answer did not change"
        assert after.xyz[0] - before.xyz[0] == pytest.approx(0.0625 * math.cos(math.radians(12.0)), abs=1e-6)
        wait_for_text(page, "^applied: ")
        # undone, saved and applied
        press(page, "Undo")
        wait_for_text(page, "^geometry.yaml: not saved$")
        press(page, "Save")
        wait_for_text(page, r"\-    xyz: \[0.0625, 0, 0\]")
        confirm(page, "Save")
        wait_for_text(page, "^geometry.yaml: saved$")
        press(page, "Apply")
        wait_for_text(page, f"constraint {MOUNT} moves by 62.5 mm")
        confirm(page, "Apply")
        wait_for_text(page, "^applied: ")
        assert platform.get_pose(*pair).transformation.pose == before
    assert (folder / "geometry.yaml").read_bytes() == (RAPTOR / "geometry.yaml").read_bytes()


def test_given_no_key_then_the_service_denies_and_the_answer_stays(edited_page: EditedPage) -> None:
    pair = ("FrontSICKLaser:Scan", "Raptor:CG")
    with Platform(edited_page.url, timeout=1.0, retries=30) as platform:
        before = platform.get_pose(*pair).transformation.pose
        press(edited_page.page, "Apply")
        wait_for_text(edited_page.page, "^not applied: .*not signed")
        assert platform.get_pose(*pair).transformation.pose == before


def test_given_a_wrong_number_then_a_click_leads_to_it_and_nothing_is_saved(edited_page: EditedPage) -> None:
    path, page, _ = edited_page
    select_item(page, "frame", "FLEA:Lens")
    set_number(page, "sigma x (m)", "-0.5")
    wait_for_text(page, "cannot be saved")
    wait_for_text(page, "a standard deviation is not negative, got -0.5")
    press(page, "Save")
    wait_for_text(page, "^not saved: the geometry has errors")
    select_item(page, "body", "Raptor")
    press(page, "1: FLEA:Lens")
    wait_for_value(find_fields(page, "Name"), "Lens")
    set_number(page, "sigma x (m)", "0.015")
    wait_for_text(page, "^geometry.yaml: not saved$")
    press(page, "Save")
    confirm(page, "Save")
    wait_for_text(page, "^geometry.yaml: saved$")
    sigma = load_model(path).frame("FLEA:Lens").sigma
    assert sigma is not None
    assert sigma.position[0] == 0.015


def test_given_numbers_that_are_typed_in_any_way_then_the_file_has_what_was_typed(edited_page: EditedPage) -> None:
    path, page, _ = edited_page
    select_item(page, "frame", "FLEA:Lens")
    x, y = (find_fields(page, f"{axis} (m)") for axis in "xy")
    x.click(click_count=3)
    page.keyboard.type("-0.2")
    page.keyboard.press("Tab")
    # the cursor is in the next field, and stays there while the first one is set; faster than the page sends
    page.keyboard.type("1e-1")
    page.keyboard.press("Tab")
    page.keyboard.type("\u22120,25")
    page.keyboard.press("Tab")
    wait_for_text(page, "^geometry.yaml: not saved$")
    x.click()
    page.keyboard.press("Control+A")
    page.keyboard.type("-0.3")
    page.keyboard.press("Enter")
    page.keyboard.type("5")
    y.click(click_count=3)
    page.keyboard.type("1/3")
    page.keyboard.press("Enter")
    wait_for_text(page, r"^y \(m\): '1/3' is not a number; accepted are numbers such as")
    y.fill("0.15")
    # not left: the selection of another item sets it
    select_item(page, "constraint", MOUNT)
    press(page, "Save")
    confirm(page, "Save")
    wait_for_text(page, "^geometry.yaml: saved$")
    assert load_model(path).frame("FLEA:Lens").pose.xyz == (-0.35, 0.15, -0.25)


def test_given_a_gizmo_then_a_drag_moves_the_frame_and_undo_brings_it_back(edited_page: EditedPage) -> None:
    path, page, _ = edited_page
    before = load_model(path).frame("Raptor:CG").pose.xyz
    select_item(page, "frame", "Raptor:CG")
    page.get_by_text("Gizmo", exact=True).first.click()
    choose(page, "Snap", "1 cm, 5 deg")
    center, tips = find_gizmo(page)
    moved = ""
    for x, y in tips:
        # from a little inside the end of an arrow, outwards
        dx, dy = (x - center[0], y - center[1])
        page.mouse.move(x - 0.1 * dx, y - 0.1 * dy)
        page.wait_for_timeout(300)
        page.mouse.down()
        for part in range(1, 6):
            page.mouse.move(x + 0.2 * part * dx, y + 0.2 * part * dy)
            page.wait_for_timeout(100)
        page.mouse.up()
        for _ in range(20):
            page.wait_for_timeout(200)
            moved = page.get_by_text(re.compile("^geometry.yaml: ")).inner_text()
            if moved.endswith("not saved"):
                break
        if moved.endswith("not saved"):
            break
    assert moved.endswith("not saved"), "no drag has moved the gizmo"
    values = [float(find_fields(page, f"{axis} (m)").input_value()) for axis in "xyz"]
    assert values != pytest.approx(before, abs=0.009)
    for value, old in zip(values, before, strict=True):
        assert value == pytest.approx(old) or value * 100 == pytest.approx(round(value * 100))
    press(page, "Undo")
    wait_for_text(page, "^geometry.yaml: saved$")
    wait_for_value(find_fields(page, "x (m)"), f"{before[0]:g}")
    find_fields(page, "Gizmo").set_checked(False)


def test_given_other_items_and_kinds_in_turn_then_the_gizmo_is_where_the_item_is(edited_page: EditedPage) -> None:
    _, page, _ = edited_page
    box = find_gizmo_box(page)
    box.set_checked(True)
    choose(page, "Kind", "constraint")
    # its first item, and then another one of the same body
    choose(page, "Kind", "frame")
    choose(page, "Item", "Raptor:CG")
    pictures = []
    for is_shown in (True, False, True):
        box.set_checked(is_shown)
        pictures.append(take_picture(page)[:, :SCENE_WIDTH])
    shown, hidden, again = pictures
    assert (np.abs(shown - hidden).sum(axis=2) > 90).sum() > 50, "the gizmo has vanished"
    assert (np.abs(shown - again).sum(axis=2) > 90).sum() < 50, "the gizmo was somewhere else"


def test_given_a_selected_item_then_it_is_outlined_without_the_gizmo_too(edited_page: EditedPage) -> None:
    _, page, _ = edited_page
    box = find_gizmo_box(page)
    box.set_checked(False)
    counts = []
    for kind, name in (("body", "Raptor"), ("frame", "FLEA:Lens"), ("constraint", MOUNT)):
        select_item(page, kind, name)
        picture = take_picture(page)[:, :SCENE_WIDTH]
        counts.append(int((np.abs(picture - SELECTED_COLOR).sum(axis=2) < 60).sum()))
    # the Raptor is larger than what is mounted on it
    assert counts[0] > 2 * max(counts[1:]), counts
    assert min(counts) > 50, counts


def test_given_a_file_that_changed_meanwhile_then_it_stays_as_it_is(edited_page: EditedPage) -> None:
    path, page, _ = edited_page
    select_item(page, "frame", "FLEA:Lens")
    set_number(page, "x (m)", "0.07")
    wait_for_text(page, "^geometry.yaml: not saved$")
    other = path.read_text().replace("name: raptor", "name: other")
    path.write_text(other)
    press(page, "Save")
    confirm(page, "Save")
    wait_for_text(page, "changed meanwhile on disk")
    assert path.read_text() == other
    press(page, "Read again")
    confirm(page, "Drop them")
    wait_for_text(page, "^geometry.yaml: saved$")


def test_given_a_path_without_a_file_then_a_geometry_begins_and_is_there_once_it_is_saved(
    browser: Browser, tmp_path: Path, lcm_url: str
) -> None:
    path = tmp_path / "geometry.yaml"
    with edit(browser, path, lcm_url) as page:
        page.get_by_text("Add, copy, delete").click()
        find_fields(page, "New name").fill("Mast")
        press(page, "Add body")
        wait_for_value(find_fields(page, "Name"), "Mast")
        # the name was used; a copy gets a free one
        wait_for_value(find_fields(page, "New name"), "")
        press(page, "Duplicate")
        wait_for_value(find_fields(page, "Name"), "Mast2")
        assert not path.exists()
        press(page, "Save")
        added = page.get_by_text(re.compile(r"^\+  Base:$"))
        assert added.evaluate("(line) => getComputedStyle(line).color") == "rgb(43, 138, 62)"
        confirm(page, "Save")
        wait_for_text(page, f"^saved {re.escape(str(path))}")
    assert [body.name for body in load_model(path, repair=True).bodies] == ["Base"]
    assert "  Mast2:\n" in path.read_text()


def test_given_a_file_that_is_no_yaml_then_it_is_fixed_as_text(browser: Browser, tmp_path: Path, lcm_url: str) -> None:
    path = tmp_path / "geometry.yaml"
    path.write_text("modelserver: geometry/1\nbodies:\n  A: {frames: {Origin: {}}\n")
    with edit(browser, path, lcm_url) as page:
        wait_for_text(page, "the YAML is not well-formed.*line 4")
        page.get_by_text("As text", exact=True).last.click()
        page.locator("textarea").first.fill("modelserver: geometry/1\nbodies:\n  A: {frames: {Origin: {}}}\n")
        wait_until_sent(page)
        press(page, "Write text")
        wait_for_text(page, "^geometry.yaml: not saved$")
        wait_for_value(find_fields(page, "Name"), "A")
        press(page, "Save")
        confirm(page, "Save")
        wait_for_text(page, "^geometry.yaml: saved$")
    assert load_model(path).frame("A:Origin").pose.xyz == (0.0, 0.0, 0.0)
