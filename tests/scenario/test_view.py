"""The viewer in a real browser: what a person clicks, reads and sees."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from support_browser import choose, find_fields, needs_browser, show, wait_until
from support_view import follow_drive, record_drive

pytest.importorskip("viser", reason="the extra view is not installed: pip install -e '.[view]'")

from PIL import Image

from mstools.commands.demo import find_vehicle_file
from mstools.view.scene import PATH_COLOR, TRAIL_COLOR
from mstools.view.sources import open_geometry, open_log

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

    from mstools.view.sources import Source

pytestmark = [pytest.mark.slow, needs_browser]


DRIVE_S = 30.0


@pytest.fixture(scope="module")
def drive_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_drive(tmp_path_factory.mktemp("view"), DRIVE_S)


@pytest.fixture(scope="module")
def geometry(browser: Browser) -> Iterator[tuple[Source, Page]]:
    source = open_geometry(find_vehicle_file(), {})
    with show(browser, source) as page:
        yield source, page


def enter(page: Page, label: str, value: str) -> None:
    """Enter a number beside a slider."""
    number = find_fields(page, label).and_(page.locator("[inputmode]"))
    number.fill(value)
    number.press("Enter")


def read_value(page: Page, name: str) -> float:
    """Return a number from the table of the answer."""
    row = page.get_by_role("row").filter(has=page.get_by_role("cell", name=name, exact=True))
    return float(row.get_by_role("cell").nth(1).inner_text().split()[0])


def count_pixels(page: Page, color: tuple[int, int, int]) -> int:
    """Return how many pixels of the picture have about the hue of a color."""
    pixels = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB")).astype(float)
    wanted = np.array(color, float)
    return int(np.sum(np.linalg.norm(pixels - wanted, axis=2) < 70.0))


def test_given_a_geometry_file_when_two_frames_are_chosen_then_the_answer_and_its_path_are_shown(
    geometry: tuple[Source, Page],
) -> None:
    source, page = geometry
    found = source.answers.get_pose("Digiclops:ImagePlane", "Raptor:CG").transformation
    choose(page, "Frame", "Digiclops:ImagePlane")
    choose(page, "in", "Raptor:CG")
    wait_until(page, lambda: read_value(page, "x") == pytest.approx(found.pose.xyz[0], abs=1e-4))
    assert read_value(page, "z") == pytest.approx(found.pose.xyz[2], abs=1e-4)
    assert page.get_by_role("cell", name="Digiclops:ImagePlane").count() > 0
    wait_until(page, lambda: count_pixels(page, PATH_COLOR) > 20)
    page.get_by_role("button", name="Exchange").click()
    inverse = found.pose.inverse()
    wait_until(page, lambda: read_value(page, "x") == pytest.approx(inverse.xyz[0], abs=1e-4))
    page.get_by_text("Copy", exact=True).click()
    page.get_by_text("modelserver query 'Raptor:CG' 'Digiclops:ImagePlane'").wait_for()


def test_given_a_geometry_file_when_a_joint_is_moved_then_the_picture_and_the_answer_change(
    geometry: tuple[Source, Page],
) -> None:
    source, page = geometry
    choose(page, "Frame", "FrontSICKLaser:Scan")
    choose(page, "in", "Raptor:CG")

    def get_pitch() -> float:
        return float(np.degrees(source.answers.get_pose("FrontSICKLaser:Scan", "Raptor:CG").transformation.rpy[1]))

    before = get_pitch()
    wait_until(page, lambda: read_value(page, "pitch") == pytest.approx(before, abs=1e-3))
    assert page.get_by_role("cell", name="FrontNoddingSICKAxis").count() > 0
    page.get_by_role("tab", name="Joints").click()
    enter(page, "FrontNoddingSICKAxis (deg)", "-20")
    page.get_by_role("tab", name="Query").click()
    wait_until(page, lambda: abs(read_value(page, "pitch") - before) > 5.0)
    assert read_value(page, "pitch") == pytest.approx(get_pitch(), abs=1e-3)


def test_given_the_geometry_when_the_ground_is_tilted_then_margin_and_loads_follow(
    geometry: tuple[Source, Page],
) -> None:
    pytest.importorskip("pinocchio", reason="pin has no wheel for this Python")
    _, page = geometry
    page.get_by_role("tab", name="Joints").click()
    page.get_by_text("Dynamics", exact=True).click()
    page.get_by_label("Center of mass").check()

    def read_load(name: str) -> float:
        cells = page.get_by_role("row").filter(has_text=f"Raptor:{name}WheelContact").get_by_role("cell")
        return float(cells.nth(1).inner_text()) if cells.count() > 1 else math.nan

    wait_until(page, lambda: read_load("FrontLeft") > 1000.0)
    left, right = read_load("FrontLeft"), read_load("FrontRight")
    assert abs(left - right) < 50.0
    enter(page, "Tilt: roll (deg)", "15")
    # a roll lifts the left side
    wait_until(page, lambda: read_load("FrontLeft") < left - 100.0)
    assert read_load("FrontRight") > right
    assert "Raptor:FrontRightWheelContact" in page.get_by_text("Tip-over margin").inner_text()


def test_given_a_log_when_it_is_played_and_searched_then_time_and_vehicle_follow(
    browser: Browser, drive_log: Path
) -> None:
    source = open_log(drive_log)
    seconds = (source.drive.end - source.drive.begin) * 1e-6
    with show(browser, source) as page:
        page.get_by_role("tab", name="Time").click()
        clock = page.get_by_text(re.compile(r"^\d+\.\d\d s$"))
        assert clock.inner_text() == "0.00 s"
        enter(page, "Time (s)", f"{seconds / 2:.2f}")
        wait_until(page, lambda: abs(float(clock.inner_text().split()[0]) - seconds / 2) < 0.1)
        wait_until(page, lambda: count_pixels(page, TRAIL_COLOR) > 100)
        page.get_by_role("button", name="Play").click()
        wait_until(page, lambda: float(clock.inner_text().split()[0]) > seconds / 2 + 1.0)
        page.get_by_role("button", name="Pause").click()
        choose(page, "Kind", "valid")
        page.get_by_role("button", name="Previous").click()
        valid = next(event for event in source.drive.events if event.kind == "valid")
        expected = (valid.utime - source.drive.begin) * 1e-6
        wait_until(page, lambda: abs(float(clock.inner_text().split()[0]) - expected) < 0.02)
        page.get_by_role("tab", name="State").click()
        page.get_by_text(re.compile("^The pose is")).wait_for()
        assert page.get_by_role("cell", name="gps", exact=True).count() > 0
        page.get_by_role("tab", name="Query").click()
        choose(page, "Frame", "Digiclops:ImagePlane")
        choose(page, "in", "World:UTM")
        page.get_by_text(re.compile(r"deg, height")).wait_for()


def test_given_the_running_service_then_the_laser_nods_in_the_page_while_it_drives(
    browser: Browser, lcm_url: str, tmp_path: Path
) -> None:
    with follow_drive(lcm_url, tmp_path) as source, show(browser, source) as page:
        choose(page, "Frame", "FrontSICKLaser:Scan")
        choose(page, "in", "Raptor:CG")
        wait_until(page, lambda: page.get_by_role("cell", name="FrontNoddingSICKAxis").count() > 0)
        pitches: list[float] = []
        wait_until(page, lambda: pitches.append(read_value(page, "pitch")) or np.ptp(pitches) > 10.0)
        page.get_by_role("tab", name="State").click()
        page.get_by_text(re.compile("^The pose is valid")).wait_for()
