"""Write the pictures of viewer and charts for the docs: python tests/make_screenshots.py (make screenshots)."""

from __future__ import annotations

import io
import math
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import trimesh
from PIL import Image
from playwright.sync_api import FrameLocator, Page
from support_browser import CHROMIUM, find_fields, open_link, select_item, show, start_browser
from support_lcm import reserved_url
from support_recordings import HUSKY, REPOSITORY
from support_view import follow_drive, record_drive
from trimesh.visual.material import PBRMaterial

from mstools.commands.demo import find_vehicle_file
from mstools.commands.replay import open_localized
from mstools.edit import EditedFile, EditSession
from mstools.recordings.bag_log import open_lcm_log
from mstools.report import charts
from mstools.view.editor import Editing
from mstools.view.sources import Source, open_geometry, open_log

IMAGES = REPOSITORY / "docs" / "images"
SHARED = REPOSITORY.parent / "shared" / "data"
DRIVE_S = 40.0


def main() -> int:
    """Write all screenshots."""
    if not CHROMIUM:
        print("no Chromium: sudo apt install chromium", file=sys.stderr)
        return 1
    take_charts("drive.png")
    take("view-geometry.png", open_geometry(find_vehicle_file(), {}))
    take_editor("view-edit.png")
    take_dynamics("view-dynamics.png")
    with tempfile.TemporaryDirectory() as folder:
        log = record_drive(Path(folder), DRIVE_S)
        take_page("view-log.png", open_log(log), at=0.75 * DRIVE_S)
        take_state("view-state.png", open_log(log))
        take_report("report.png", Path(folder), log)
        take("view-robot.png", open_geometry(make_robot(Path(folder)), {}))
    if (bag := SHARED / "husky" / "test1.bag").exists():
        with open_lcm_log(bag) as log, open_localized(log, HUSKY) as localized:
            take_page("view-husky.png", open_log(localized), at=200.0, panes=("map", "plots"))
    with tempfile.TemporaryDirectory() as folder, reserved_url() as url, follow_drive(url, Path(folder)) as source:
        take_page("view-live.png", source, seconds=25.0)
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


def take(name: str, source: Source) -> None:
    """Write the screenshot of a scene with its tabs."""
    with start_browser() as browser, show(browser, source, sharpness=1.0) as page:
        close_warning(page)
        page.wait_for_timeout(3e3)
        write_picture(page.screenshot(), IMAGES / name)
    print(IMAGES / name)


def take_state(name: str, source: Source) -> None:
    """Write the screenshot of the tab State, of a log that plays."""
    with start_browser() as browser, show(browser, source, sharpness=1.0) as page:
        close_warning(page)
        page.get_by_role("tab", name="Time").click()
        page.get_by_role("button", name="Play").click()
        page.wait_for_timeout(20e3)
        page.get_by_role("tab", name="State").click()
        page.wait_for_timeout(2e3)
        write_picture(page.screenshot(), IMAGES / name)
    print(IMAGES / name)


def take_page(
    name: str, source: Source, at: float = 0.0, seconds: float = 5.0, panes: Sequence[str] = ("scene", "map", "plots")
) -> None:
    """Write the screenshot of the whole page at a time of a drive, after some seconds."""
    with start_browser() as browser, show(browser, source, sharpness=1.0, path="") as page:
        close_warning(page.frame_locator("#scene iframe"))
        for pane in ("scene", "map"):
            if (page.locator(f"[data-pane={pane}]").get_attribute("aria-pressed") == "true") != (pane in panes):
                page.locator(f"[data-pane={pane}]").click()
        page.wait_for_function("document.documentElement.dataset.charts !== undefined")
        if at:
            page.evaluate(f"seek({at})")
        page.wait_for_timeout(seconds * 1e3)
        write_picture(page.screenshot(), IMAGES / name)
    print(IMAGES / name)


def make_robot(folder: Path) -> Path:
    """Write an arm whose meshes have colors of their own, and return its URDF."""
    parts = {"base": (60, 60, 66), "upper": (230, 120, 20), "fore": (230, 120, 20), "hand": (40, 90, 170)}
    sizes = {"base": (0.3, 0.3, 0.2), "upper": (0.12, 0.12, 0.5), "fore": (0.1, 0.1, 0.4), "hand": (0.16, 0.05, 0.12)}
    lines = []
    for name, color in parts.items():
        mesh = trimesh.creation.box(sizes[name])
        mesh.apply_translation((0.0, 0.0, sizes[name][2] / 2.0))
        mesh.visual = trimesh.visual.TextureVisuals(material=PBRMaterial(baseColorFactor=(*color, 255)))
        mesh.export(folder / f"{name}.glb")
        lines.append(f'<link name="{name}"><visual><geometry><mesh filename="{name}.glb"/></geometry></visual></link>')
    for (below, above), pitch in zip(pairwise(parts), (0.3, 0.9, 0.5), strict=True):
        place = f'<origin xyz="0 0 {sizes[below][2]}" rpy="0 {pitch} 0"/><axis xyz="0 1 0"/>'
        ends = f'<parent link="{below}"/><child link="{above}"/>'
        limit = '<limit lower="-2" upper="2" effort="1" velocity="1"/>'
        lines.append(f'<joint name="{above}_joint" type="revolute">{ends}{place}{limit}</joint>')
    path = folder / "robot.urdf"
    path.write_text(f'<robot name="arm">{"".join(lines)}</robot>')
    return path


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


def take_dynamics(name: str) -> None:
    """Write the screenshot of center of mass and loads on tilted ground."""
    with start_browser() as browser, show(browser, open_geometry(find_vehicle_file(), {}), sharpness=1.0) as page:
        close_warning(page)
        page.get_by_role("tab", name="Joints").click()
        page.get_by_text("Dynamics", exact=True).click()
        page.get_by_label("Center of mass").check()
        tilt = find_fields(page, "Tilt: roll (deg)").and_(page.locator("[inputmode]"))
        tilt.fill("10")
        tilt.press("Enter")
        page.wait_for_timeout(4e3)
        write_picture(page.screenshot(), IMAGES / name)
    print(IMAGES / name)


def take_report(name: str, folder: Path, log: Path) -> None:
    """Write the screenshot of the begin of a replay report."""
    arguments = ["replay", str(log), "-c", str(find_vehicle_file()), "--report", str(folder / "report.html")]
    run = "from mstools.cli import main; main()"
    subprocess.run([sys.executable, "-c", run, *arguments], check=True, stdout=subprocess.DEVNULL)
    with start_browser() as browser, open_link(browser, (folder / "report.html").as_uri()) as page:
        page.locator("html[data-drawn]").wait_for()
        write_picture(page.screenshot(), IMAGES / name)
    print(IMAGES / name)


def write_picture(png: bytes, path: Path) -> None:
    """Write a picture with 128 colors, which halves its size."""
    picture = Image.open(io.BytesIO(png)).convert("RGB")
    picture.quantize(128, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE).save(path, optimize=True)


def close_warning(page: Page | FrameLocator) -> None:
    """Close the note that the picture is computed without a graphics card."""
    page.locator(".mantine-Notification-closeButton").first.click()


if __name__ == "__main__":
    sys.exit(main())
