"""Frames that are picked in the scene, in a real browser."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from support_browser import TIMEOUT_MS, choose, needs_browser, show

pytest.importorskip("viser", reason="the extra view is not installed: pip install -e '.[view]'")

from mstools.view.sources import open_geometry

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytestmark = [pytest.mark.slow, needs_browser]

GEOMETRY = """\
modelserver: geometry/1
bodies:
  Base: {frames: {Root: {}, Other: {xyz: [0, 0, -1]}}}
  Ball:
    visuals: [{sphere: {radius: 0.4}}]
    frames: {Center: {}}
constraints:
  Fixed: {from: "Base:Root", to: "Ball:Center"}
"""


def click_middle(page: Page, label: str, modifier: str = "") -> str:
    """Click the middle of the scene until a field has the ball's frame; return what the field has."""
    canvas = page.locator("canvas").first.bounding_box()
    assert canvas is not None
    field = page.get_by_role("combobox", name=label, exact=True)
    for _ in range(TIMEOUT_MS // 1000):
        if modifier:
            page.keyboard.down(modifier)
        # a little aside of axes and labels
        page.mouse.move(canvas["x"] + canvas["width"] / 2 + 15, canvas["y"] + canvas["height"] / 2 + 15)
        page.wait_for_timeout(200)
        page.mouse.down()
        page.mouse.up()
        if modifier:
            page.keyboard.up(modifier)
        page.wait_for_timeout(800)
        if field.input_value() == "Ball:Center":
            break
    return str(field.input_value())


def test_given_a_body_that_is_clicked_then_it_is_the_frame_and_with_shift_the_reference(
    browser: Browser, tmp_path: Path
) -> None:
    path = tmp_path / "ball.yaml"
    path.write_text(GEOMETRY)
    with show(browser, open_geometry(path, {})) as page:
        choose(page, "Frame", "Base:Other")
        assert click_middle(page, "Frame") == "Ball:Center"
        choose(page, "Frame", "Base:Other")
        assert click_middle(page, "in", "Shift") == "Ball:Center"
        assert page.get_by_role("combobox", name="Frame", exact=True).input_value() == "Base:Other"
        page.get_by_role("cell", name="-1.0000 m").wait_for()
