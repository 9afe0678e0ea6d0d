"""Frames that are picked in the scene, and the views of its camera, in a real browser."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from support_browser import TIMEOUT_MS, choose, needs_browser, serve, show
from support_view import record_drive

pytest.importorskip("viser", reason="the extra view is not installed: pip install -e '.[view]'")

from modelserver import load_model
from mstools.view.camera import VIEWS
from mstools.view.sources import open_geometry, open_log

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page
    from viser import ClientHandle

pytestmark = [pytest.mark.slow, needs_browser]

GEOMETRY = """\
modelserver: geometry/1
bodies:
  Base: {frames: {Root: {}, Other: {xyz: [0, 0, -1]}}}
  Ball:
    visuals: [{sphere: {radius: 1}}]
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


def wait_for_view(page: Page, client: ClientHandle, direction: tuple[float, float, float]) -> None:
    """Wait until the camera is in a direction from what it looks at."""
    wanted = np.array(direction) / np.linalg.norm(direction)
    for _ in range(TIMEOUT_MS // 200):
        back = client.camera.position - client.camera.look_at
        if np.linalg.norm(back / np.linalg.norm(back) - wanted) < 0.02:
            return
        page.wait_for_timeout(200)
    raise AssertionError(f"the camera is at {client.camera.position}")


def test_given_keys_then_the_camera_shows_all_from_there_until_a_person_moves_it(
    browser: Browser, tmp_path: Path
) -> None:
    path = tmp_path / "ball.yaml"
    path.write_text(GEOMETRY)
    source = open_geometry(path, {})
    with serve(browser, source) as (page, server):
        (client,) = server.get_clients().values()
        wait_for_view(page, client, VIEWS["Oblique"])
        tangent = math.tan(client.camera.fov / 2.0) * min(client.camera.aspect, 1.0)
        # the camera sees a ball of radius 1 where the sine of the half angle is 1 / distance
        distance = float(np.linalg.norm(client.camera.position - client.camera.look_at))
        assert math.sin(math.atan(tangent)) > 1.0 / distance > 0.7 * math.sin(math.atan(tangent))
        page.mouse.move(400, 500)
        for key, view in (("2", "Side"), ("3", "Above"), ("1", "Front")):
            page.keyboard.press(key)
            wait_for_view(page, client, VIEWS[view])

        def load(radius: float) -> None:
            path.write_text(GEOMETRY.replace("radius: 1", f"radius: {radius}"))
            assert source.set_model is not None
            source.set_model(load_model(path))

        load(2.0)
        for _ in range(TIMEOUT_MS // 200):
            if np.linalg.norm(client.camera.position - client.camera.look_at) > 1.8 * distance:
                break
            page.wait_for_timeout(200)
        else:
            raise AssertionError("a model of twice the size is not fitted")
        page.mouse.down()
        page.mouse.move(500, 550, steps=5)
        page.mouse.up()
        page.wait_for_timeout(1500)
        moved = client.camera.position.copy()
        load(5.0)
        page.wait_for_timeout(1500)
        assert client.camera.position == pytest.approx(moved)
        back = client.camera.position - client.camera.look_at
        page.keyboard.press("f")
        for _ in range(TIMEOUT_MS // 200):
            if np.linalg.norm(client.camera.position - client.camera.look_at) > 2.0 * np.linalg.norm(back):
                break
            page.wait_for_timeout(200)
        wait_for_view(page, client, (float(back[0]), float(back[1]), float(back[2])))
        assert np.linalg.norm(client.camera.position - client.camera.look_at) > 2.0 * np.linalg.norm(back)


def test_given_a_vehicle_that_is_no_longer_followed_then_the_camera_is_where_the_vehicle_is(
    browser: Browser, tmp_path: Path
) -> None:
    source = open_log(record_drive(tmp_path, 6.0))
    with serve(browser, source) as (page, server):
        page.get_by_role("tab", name="Time").click()
        page.get_by_role("button", name="Play").click()
        page.get_by_role("button", name="Pause").wait_for()
        # to the end, where playback stops
        page.get_by_role("button", name="Play").wait_for()
        (client,) = server.get_clients().values()
        position, pose = client.camera.position.copy(), source.drive.get_picture().pose
        assert pose is not None
        assert np.linalg.norm(pose.position) > 1.0
        page.get_by_role("tab", name="Display").click()
        page.get_by_label("Follow the vehicle").click(force=True)
        for _ in range(TIMEOUT_MS // 200):
            if np.linalg.norm(client.camera.position - position - pose.position) < 0.1:
                return
            page.wait_for_timeout(200)
        raise AssertionError(f"the camera moved by {client.camera.position - position}, not by {pose.position}")
