"""The page around the viewer's scene in a real browser: strip, map and plots against the drive they show."""

from __future__ import annotations

import math
import re
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from support_bags import ROBOT, write_drive
from support_browser import needs_browser, open_link, serve, show, wait_until
from support_lcm import MODELSERVER
from support_tuning import write_simulated_log
from support_view import record_drive

pytest.importorskip("viser", reason="the extra view is not installed: pip install -e '.[view]'")

from modelserver.earth.geodesy import geodesy_of
from mstools.commands.demo import find_vehicle_file
from mstools.recordings.drive import QUATERNION, Drive
from mstools.recordings.pose_signals import compute_headings, compute_signals
from mstools.view.page import open_page
from mstools.view.sources import open_geometry, open_log
from mstools.view.viewer import Viewer

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytestmark = [pytest.mark.slow, needs_browser]

AT = 20.0
ONE_FRAME = "modelserver: geometry/1\nbodies:\n  Mast: {frames: {Top: {}}}\n"
PHONE = {"width": 390, "height": 800}


@pytest.fixture(scope="module")
def drive_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_drive(tmp_path_factory.mktemp("view"), 30.0)


@pytest.fixture(scope="module", name="shown")
def show_log(browser: Browser, drive_log: Path) -> Iterator[tuple[Page, Drive]]:
    source = open_log(drive_log)
    with show(browser, source, path="") as page:
        page.wait_for_function("document.documentElement.dataset.charts !== undefined")
        page.evaluate(f"seek({AT})")
        page.wait_for_function(f"state.at.toFixed(1) === '{AT:.1f}'")
        yield page, source.drive


def read_figure(page: Page, name: str) -> float:
    text = page.locator("#figures div").filter(has_text=re.compile(f"^{name}")).locator("dd").inner_text()
    return float(re.match(r"[-\d.]+", text)[0])  # type: ignore[index]


def test_given_a_time_of_a_log_then_the_strip_has_validity_motion_and_ages(shown: tuple[Page, Drive]) -> None:
    page, drive = shown
    assert page.get_by_role("status").inner_text().strip() == "VALID"
    table = drive.poses
    row = table.find(drive.begin + round(AT * 1e6))
    assert read_figure(page, "speed") == pytest.approx(
        compute_signals(drive, drive.begin + round(AT * 1e6)).speed, abs=0.02
    )
    assert read_figure(page, "heading") == pytest.approx(compute_headings(table.rows[:, QUATERNION])[row], abs=1.0)
    assert page.get_by_label("Age of each sensor").get_by_role("listitem").count() == 4
    page.evaluate("seek(1)")
    page.get_by_role("status").get_by_text("INVALID").wait_for()
    page.evaluate(f"seek({AT})")
    page.get_by_role("status").get_by_text("VALID", exact=True).wait_for()


def test_given_the_map_when_the_vehicle_is_pointed_at_then_its_coordinates_are_read_within_a_meter(
    shown: tuple[Page, Drive],
) -> None:
    page, drive = shown
    page.get_by_role("button", name="Map").click()
    canvas = page.locator("#map canvas")
    page.wait_for_function("document.querySelector('#map canvas').dataset.vehicle !== undefined")
    assert int(canvas.get_attribute("data-fixes") or 0) > 20
    page.get_by_role("button", name="Follow").click()
    for _ in range(4):
        page.get_by_role("button", name="+", exact=True).click()
    page.wait_for_timeout(1000)
    x, y = map(float, (canvas.get_attribute("data-vehicle") or "").split(","))
    canvas.hover(position={"x": x, "y": y})
    text = page.locator("#map .readout").inner_text()
    numbers = list(map(float, re.findall(r"-?\d+\.\d+", text)))
    assert drive.origin is not None
    pose = drive.get_picture(drive.begin + round(AT * 1e6)).pose
    assert pose is not None
    place = (drive.origin.easting + pose.xyz[0], drive.origin.northing + pose.xyz[1])
    assert math.dist(numbers[:2], place) < 1.0
    latitude, longitude = numbers[2:4]
    assert math.dist(geodesy_of(drive.origin).utm_from_geodetic(latitude, longitude, 0.0)[:2], numbers[:2]) < 0.1
    page.get_by_role("button", name="Map").click()


def test_given_a_picture_of_the_ground_then_the_map_has_it_below_the_track_and_a_grid_where_asked_for(
    browser: Browser, drive_log: Path, tmp_path: Path
) -> None:
    rasterio = pytest.importorskip("rasterio", reason="the extra map is not installed: pip install -e '.[map]'")
    from mstools.view.background import open_background

    source = open_log(drive_log)
    origin = source.drive.origin
    assert origin is not None
    # green west of 10 m east of the origin, blue east of it
    pixels = np.zeros((3, 200, 200), dtype=np.uint8)
    pixels[1, :, :110] = pixels[2, :, 110:] = 200
    place = rasterio.Affine(1.0, 0.0, origin.easting - 100.0, 0.0, -1.0, origin.northing + 100.0)
    size = {"width": 200, "height": 200, "count": 3, "dtype": "uint8"}
    with rasterio.open(tmp_path / "site.tif", "w", **size, crs=f"EPSG:{32600 + origin.zone}", transform=place) as file:
        file.write(pixels)
        file.update_tags(TIFFTAG_COPYRIGHT="Survey")
    with show(browser, source, path="", background=open_background(tmp_path / "site.tif")) as page:
        page.get_by_role("button", name="Map").click()
        page.wait_for_function("document.querySelector('#map canvas').dataset.ground")
        assert page.locator("#map .attribution").inner_text() == "Survey"

        def find_color(east: float, north: float) -> list[int]:
            x, y = page.evaluate(f"map.toPixels([{east}, {north}])")
            read = f"document.querySelector('#map canvas').getContext('2d').getImageData({x}, {y}, 1, 1).data"
            return list(page.evaluate(f"[...{read}]"))

        page.evaluate("map.show([10, -60, 0.1])")
        page.wait_for_function("document.querySelector('#map canvas').dataset.ground.startsWith('10,-60,0.1')")
        assert find_color(9.0, -60.0) == pytest.approx([0, 200, 0, 255], abs=2)
        assert find_color(11.0, -60.0) == pytest.approx([0, 0, 200, 255], abs=2)
        for count, name in enumerate(("Grid", "Grid: UTM")):
            page.get_by_role("button", name=name, exact=True).click()
            page.wait_for_function("document.querySelector('#map canvas').dataset.grid > 4")
            assert page.get_by_role("button", name=("Grid: UTM", "Grid: degrees")[count]).is_visible()
        page.get_by_role("button", name="Ground").click()
        assert find_color(9.0, -60.3)[3] == 0


def test_given_the_plots_then_they_have_the_drive_and_a_click_shows_that_time(shown: tuple[Page, Drive]) -> None:
    page, drive = shown
    x, y = page.evaluate(
        "(() => { const {x, y} = strip.ownerDocument.getElementById('charts')._fullData[0];"
        " return [[...x], [...y]]; })()"
    )
    at = min(range(len(x)), key=lambda n: abs(x[n] - AT))
    assert y[at] == pytest.approx(compute_signals(drive, drive.begin + round(x[at] * 1e6) + 500).speed, abs=0.01)
    chart = page.locator("#charts")
    left, width = page.evaluate(
        "(() => { const chart = document.getElementById('charts');"
        " return [chart._fullLayout._size.l, chart._fullLayout.xaxis._length]; })()"
    )
    chart.click(position={"x": left + width / 2, "y": 80})
    page.wait_for_function(f"Math.abs(state.at - {(drive.end - drive.begin) * 0.5e-6}) < 0.5")
    page.evaluate("document.getElementById('charts').scrollIntoView()")
    page.evaluate("Plotly.relayout(document.getElementById('charts'), {'xaxis.range': [10, 12]})")
    page.wait_for_function("document.getElementById('charts')._fullData[0].x.length < 200")
    assert page.evaluate("document.getElementById('strip')._fullLayout.xaxis.range") == [10, 12]
    page.get_by_role("button", name="All").click()
    page.wait_for_function("document.getElementById('charts')._fullLayout.xaxis.range[1] > 25")
    page.evaluate(f"seek({AT})")


def test_given_signals_that_are_chosen_then_they_are_drawn_and_the_browser_remembers_them(
    shown: tuple[Page, Drive],
) -> None:
    page, _ = shown
    page.get_by_text("Signals").click()
    page.get_by_label("rates").check()
    page.wait_for_function("document.documentElement.dataset.charts.includes('rates')")
    assert page.evaluate("[...document.getElementById('charts')._fullData].map(each => each.name)").count("IMU") == 1
    assert "rates" in page.evaluate("localStorage['modelserver.charts']")
    page.get_by_label("rates").uncheck()
    page.get_by_text("Signals").click()


def test_given_a_telephone_then_nothing_is_wider_than_its_screen(shown: tuple[Page, Drive]) -> None:
    page, _ = shown
    size = page.viewport_size
    page.set_viewport_size(PHONE)  # type: ignore[arg-type]
    page.wait_for_timeout(300)
    assert page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
    page.set_viewport_size(size)  # type: ignore[arg-type]


def test_given_a_geometry_file_then_the_scene_is_alone(browser: Browser) -> None:
    with show(browser, open_geometry(find_vehicle_file(), {}), path="") as page:
        page.wait_for_function("state !== null")
        assert page.locator("#plots").is_hidden()
        assert page.get_by_role("button", name="Map").is_hidden()
        assert page.get_by_role("status").is_hidden()
        assert len(page.locator("#revision").inner_text()) == 16


def test_given_a_pointer_at_a_frame_then_its_name_and_pose_are_shown(browser: Browser, tmp_path: Path) -> None:
    path = tmp_path / "geometry.yaml"
    path.write_text(ONE_FRAME)
    with show(browser, open_geometry(path, {}), path="") as page:
        canvas = page.frame_locator("#scene iframe").locator("canvas").first
        box = canvas.bounding_box()
        assert box is not None
        hover = page.locator("#hover")
        for _ in range(60):
            # the only frame is in the middle, where the camera looks once it has fitted the scene
            page.mouse.move(box["x"] + box["width"] / 2 + 3, box["y"] + box["height"] / 2 + 3)
            page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
            page.wait_for_timeout(200)
            if hover.is_visible():
                break
        assert hover.inner_text().split("\n") == ["Mast:Top", "0.000, 0.000, 0.000 m; 0.0, 0.0, 0.0 deg"]
        page.mouse.move(box["x"] + 30, box["y"] + box["height"] - 30)
        hover.wait_for(state="hidden")


def test_given_the_tree_then_a_search_finds_frames_a_click_asks_for_one_and_bodies_are_hidden(browser: Browser) -> None:
    with serve(browser, open_geometry(find_vehicle_file(), {}), path="") as (page, server):
        page.get_by_role("button", name="Tree").click()
        tree = page.get_by_label("Bodies and frames", exact=True)
        tree.locator("button:visible").first.wait_for()
        tree.get_by_label("Search").fill("lens")
        found = [each.get_attribute("data-frame") for each in tree.locator("button:visible").all()]
        assert found
        assert all("lens" in (each or "").lower() for each in found)
        tree.locator("button:visible").first.click()
        frame = page.frame_locator("#scene iframe").get_by_role("combobox", name="Frame", exact=True)
        wait_until(page, lambda: frame.input_value() == found[0])
        tree.get_by_label("Search").fill("")
        node = server.scene.get_handle_by_name("/world/vehicle/body/0")
        assert node is not None
        assert node.visible
        tree.locator("ul input").first.uncheck()
        tree.get_by_label("grid").uncheck()
        grid = server.scene.get_handle_by_name("/world/grid")
        assert grid is not None
        wait_until(page, lambda: not node.visible and not grid.visible)


def test_given_a_viewer_that_ends_then_the_page_reports_it_and_returns_with_the_next(
    browser: Browser, drive_log: Path
) -> None:
    source = open_log(drive_log)
    served = open_page(port=0)
    Viewer(served, source)
    port = int(served.link.rsplit(":", 1)[1].strip("/"))
    with open_link(browser, served.link, expected_errors=("ERR_CONNECTION_REFUSED", "WebSocket")) as page:
        page.wait_for_function("state !== null")
        served.close()
        page.get_by_role("alert").wait_for()
        served = open_page(port=port)
        Viewer(served, source)
        page.get_by_role("alert").wait_for(state="hidden")
    served.close()


def test_given_a_link_with_a_token_then_page_and_scene_open_and_without_it_neither(browser: Browser) -> None:
    served = open_page(port=0, with_token=True)
    Viewer(served, open_geometry(find_vehicle_file(), {}))
    try:
        with open_link(browser, served.link) as page:
            page.frame_locator("#scene iframe").get_by_role("tab", name="Query").wait_for()
            assert "token" not in page.frame_locator("#scene iframe").locator("html").evaluate("() => location.href")
        with open_link(browser, served.link.partition("?")[0], expected_errors=("403",)) as page:
            page.get_by_text("the token is missing or wrong").wait_for()
    finally:
        served.close()


@contextmanager
def run_view(folder: Path, *words: str) -> Iterator[str]:
    """Run `modelserver view` in a folder; yield the link that it prints."""
    command = [*MODELSERVER, "view", *words, "--no-browser", "--port", "0"]
    with subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as shown:
        try:
            assert shown.stdout is not None
            yield shown.stdout.readline().split()[1]
        finally:
            shown.terminate()


def test_given_a_bag_then_one_command_shows_its_drive_on_map_and_plots(browser: Browser, tmp_path: Path) -> None:
    pytest.importorskip("rosbags", reason="the extra bags is not installed: pip install -e '.[bags]'")
    (tmp_path / "robot.urdf").write_text(ROBOT)
    write_drive(tmp_path / "drive.bag", tmp_path / "robot.urdf", 60.0)
    new = [*MODELSERVER, "new", "rover", "--yes", "--from-urdf", "robot.urdf"]
    subprocess.run(new, cwd=tmp_path, check=True, capture_output=True)
    with (
        run_view(tmp_path, "drive.bag", "-c", "rover/vehicle.yaml") as link,
        open_link(browser, f"{link}#map,plots") as page,
    ):
        page.wait_for_function("state !== null && state.has_time")
        assert page.locator("#title").inner_text() == "drive.bag"
        page.evaluate("seek(40)")
        page.get_by_role("status").get_by_text("VALID", exact=True).wait_for()
        # a figure eight at 2 m/s
        wait_until(page, lambda: read_figure(page, "speed") == pytest.approx(2.0, abs=0.2))
        page.wait_for_function("Number(document.querySelector('#map canvas').dataset.fixes) > 100")
        page.wait_for_function("document.documentElement.dataset.charts !== undefined")
        assert page.locator("#scene").is_hidden()


def test_given_a_log_of_sensors_alone_then_all_fixes_and_the_rates_are_shown(browser: Browser, tmp_path: Path) -> None:
    log, _ = write_simulated_log(tmp_path, 20.0)
    with run_view(tmp_path, str(log)) as link, open_link(browser, link) as page:
        page.wait_for_function("document.documentElement.dataset.charts === 'rates,latencies'")
        page.wait_for_function("Number(document.querySelector('#map canvas').dataset.fixes) > 50")
        assert page.locator("#scene").is_hidden()
        assert page.locator("#strip").is_hidden()
        assert page.get_by_role("status").inner_text().strip() == "NO POSE"
        names = page.evaluate("[...document.getElementById('charts')._fullData].map(each => each.name)")
        assert {"GPS", "IMU"} <= set(names)
