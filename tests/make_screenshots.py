"""Write the pictures of viewer and charts for the docs: python tests/make_screenshots.py (make screenshots)."""

from __future__ import annotations

import io
import math
import sys
import tempfile
from pathlib import Path

from PIL import Image
from playwright.sync_api import Page
from support_browser import CHROMIUM, open_link, select_item, show, start_browser
from support_lcm import reserved_url
from support_view import follow_drive, record_drive

from mstools.commands.demo import find_vehicle_file
from mstools.edit import EditedFile, EditSession
from mstools.report import charts
from mstools.view.editor import Editing
from mstools.view.sources import Source, open_geometry, open_log

IMAGES = Path(__file__).resolve().parents[1] / "docs" / "images"
DRIVE_S = 40.0


def main() -> int:
    """Write all screenshots."""
    if not CHROMIUM:
        print("no Chromium: sudo apt install chromium", file=sys.stderr)
        return 1
    take_charts("drive.png")
    take("view-geometry.png", open_geometry(find_vehicle_file(), {}))
    take_editor("view-edit.png")
    with tempfile.TemporaryDirectory() as folder:
        log = record_drive(Path(folder), DRIVE_S)
        source = open_log(log)
        take("view-log.png", source, "Time", "Play", 12.0)
        take("view-state.png", open_log(log), "Time", "Play", 20.0)
    with tempfile.TemporaryDirectory() as folder, reserved_url() as url, follow_drive(url, Path(folder)) as source:
        take("view-live.png", source, seconds=25.0)
    return 0


OUTAGE = (40.0, 70.0)
"""Seconds of the drawn drive without GPS."""


def render_drive() -> str:
    """Return charts of a simulated drive of the Raptor: track, fixes, estimate; error and protection level."""
    from modelserver.config.vehicle_file import load_config
    from modelserver.earth.geodesy import Geodesy, origin_at
    from modelserver.estimation.filter.localizer import FilterLocalizer
    from modelserver.estimation.filter.state import Setup
    from modelserver.messages import GpsSample, ImuSample
    from modelserver.server.vehicle import load_vehicle
    from modelserver.simulation import GpsModel, ImuModel, Timing
    from mstools.launch.drive import SUFFIELD, make_simulation

    vehicle = load_vehicle(load_config(find_vehicle_file()))
    config, geodesy = vehicle.config, Geodesy(origin_at(*SUFFIELD))
    models = {"gps_model": GpsModel(outages=(OUTAGE,)), "imu_model": ImuModel(Timing(50.0))}
    simulation = make_simulation(config, 10**15, 96.0, "city", seed=8, sensors=(GpsSample, ImuSample), **models)
    X_rolling_base = vehicle.model.get_transformation(config.base_frame, config.rolling_frame).pose
    localizer = FilterLocalizer.start(Setup(vehicle.rig), geodesy.origin)
    fixes, truth, rows = [], [], []
    for sample in simulation.events(96.0):
        localizer, _ = localizer.process(sample)
        if isinstance(sample, GpsSample):
            if math.isfinite(sample.latitude_deg) and sample.header.seq % 4 == 0:
                fixes.append(geodesy.enu_from_geodetic(sample.latitude_deg, sample.longitude_deg, SUFFIELD[2]))
        elif sample.header.seq % 10 == 0:
            estimate, true = localizer.estimate(localizer.utime), simulation.truth(localizer.utime).enu.xyz
            truth.append(true)
            if estimate.enu is not None and not estimate.invalid:
                x, y, _ = (estimate.enu @ X_rolling_base).xyz
                seconds = localizer.utime * 1e-6 - 1e9
                rows.append((seconds, x, y, math.dist((x, y), true[:2]), estimate.horizontal_protection_level))
    t, x, y, error, bound = zip(*rows, strict=True)
    hidden = [each if OUTAGE[0] <= at <= OUTAGE[1] else math.nan for at, each in zip(t, x, strict=True)]
    drawn = [
        charts.Series("truth", [each[0] for each in truth], [each[1] for each in truth], "#cfd8dc", 8.0),
        charts.dots("fixes", fixes, charts.GREEN, 6.0),
        charts.Series("estimate", x, y, charts.BLUE, 2.0),
        charts.Series("without GPS", hidden, y, charts.AMBER, 2.0),
    ]
    track = charts.render_map("Track", "east, m", "north, m", drawn, heights=(300, 300))
    top = 2.0 * math.ceil(0.5 * max(bound))
    errors = [
        charts.Series("without GPS", OUTAGE, (0.0, 0.0), charts.AMBER, shape="band", high=(top, top)),
        charts.Series("protection level (10^-5 per hour)", t, bound, charts.RED, 2.0),
        charts.Series("true error", t, error, charts.BLUE, 2.0),
    ]
    panel = charts.Panel("Horizontal error and protection level", charts.Axis("m", 0.0, top), errors, 150.0)
    error_chart = charts.render_panels("Error", charts.Axis("seconds", 0.0, 98.0), [panel])
    return track + error_chart


def take_charts(name: str) -> None:
    """Write the picture of the charts of a simulated drive."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "drive.html"
        file.write_text(charts.render_page("drive", render_drive()))
        with start_browser() as browser, open_link(browser, file.as_uri()) as page:
            page.locator("html[data-drawn]").wait_for()
            page.add_style_tag(content="#theme { display: none }")
            write_picture(page.locator("body").screenshot(), IMAGES / name)
    print(IMAGES / name)


def take(name: str, source: Source, tab: str = "", button: str = "", seconds: float = 3.0) -> None:
    """Write one screenshot, after a tab and a button were clicked and some seconds have passed."""
    with start_browser() as browser, show(browser, source, sharpness=1.0) as page:
        close_warning(page)
        if tab:
            page.get_by_role("tab", name=tab).click()
            page.get_by_role("button", name=button).click()
        page.wait_for_timeout(seconds * 1e3)
        if "state" in name:
            page.get_by_role("tab", name="State").click()
            page.wait_for_timeout(2e3)
        write_picture(page.screenshot(), IMAGES / name)
    print(IMAGES / name)


def take_editor(name: str) -> None:
    """Write the screenshot of the editor with a constraint selected."""
    file = find_vehicle_file()
    session = EditSession(EditedFile.open(file))
    editing = Editing(session)
    with start_browser() as browser, show(browser, open_geometry(file, {}), editing, sharpness=1.0) as page:
        close_warning(page)
        page.get_by_role("tab", name="Edit").click()
        select_item(page, "constraint", "FrontNoddingSICKFixed")
        page.wait_for_timeout(3e3)
        write_picture(page.screenshot(), IMAGES / name)
    print(IMAGES / name)


def write_picture(png: bytes, path: Path) -> None:
    """Write a picture with 128 colors, which halves its size."""
    picture = Image.open(io.BytesIO(png)).convert("RGB")
    picture.quantize(128, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE).save(path, optimize=True)


def close_warning(page: Page) -> None:
    """Close the note that the picture is computed without a graphics card."""
    page.locator(".mantine-Notification-closeButton").first.click()


if __name__ == "__main__":
    sys.exit(main())
