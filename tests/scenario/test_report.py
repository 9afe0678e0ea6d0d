"""A report in a real browser, from the file and without internet: charts, one time on all, one zoom, light and dark."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from support_browser import needs_browser, open_link
from support_tuning import write_simulated_log

from modelserver.estimation.sensor_rig import MagnetometerCalibration
from mstools import cli
from mstools.calibration.ellipsoid import fit_level
from mstools.calibration.reports import render_magnetometer_page
from mstools.report import charts

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Locator, Page

pytestmark = [pytest.mark.slow, needs_browser]

CURSORS = ".chart[data-time] .cursor"


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    log, config = write_simulated_log(folder, seconds=25.0)
    out = folder / "report.html"
    with pytest.raises(SystemExit):
        cli.main(["replay", str(log), "-c", str(config), "--report", str(out)])
    return out


@pytest.fixture(scope="module")
def page(browser: Browser, report: Path) -> Iterator[Page]:
    """Open the report once, with all charts drawn; each test leaves it as it was."""
    with open_link(browser, report.as_uri()) as opened:
        opened.locator("html[data-drawn]").wait_for()
        yield opened


def find_charts(page: Page) -> tuple[Locator, Locator]:
    """Return the charts over time, and the map."""
    return page.locator(".chart[data-time]"), page.locator(".chart:not([data-time])")


def read_ranges(page: Page) -> list[list[float]]:
    """Return the range of the time axis of each chart over time."""
    found: list[list[float]] = page.evaluate(
        "[...document.querySelectorAll('.chart[data-time]')].map((each) => [...each._fullLayout.xaxis.range])"
    )
    return found


def test_given_a_report_then_all_its_charts_are_drawn_and_a_time_is_shown_on_all(report: Path, page: Page) -> None:
    assert report.stat().st_size < 3_000_000
    over_time, track = find_charts(page)
    assert over_time.count() >= 5
    assert track.count() == 1
    for number in range(over_time.count()):
        assert over_time.nth(number).locator("svg").count() > 0
    # none of the library's buttons sends a chart anywhere
    buttons = {each.get_attribute("data-title") for each in page.locator(".modebar-btn").all()}
    assert buttons == {"Download plot as a PNG", "Zoom", "Pan", "Zoom in", "Zoom out", "Reset axes"}
    # the answer is seen first, then the findings, before any chart
    answer = page.locator(".answer strong")
    assert re.match(r"Valid \d\d\.\d% of 25\.0 s", answer.inner_text())
    box = answer.bounding_box()
    assert box is not None
    assert box["y"] < 250
    assert page.locator("h2").first.inner_text() == "Findings"
    over_time.nth(1).scroll_into_view_if_needed()
    over_time.nth(1).locator(".nsewdrag").first.hover()
    page.locator("html[data-time]").wait_for(state="attached")
    time = float(page.locator("html").get_attribute("data-time") or "nan")
    assert 0.0 < time < 25.0
    assert page.locator(CURSORS).evaluate_all("(all) => all.every((each) => each.style.display === 'block')")
    assert track.locator(".spot").evaluate("(each) => each.style.display") == "block"
    # a timeline has one between its bars too
    page.locator("html").evaluate("(each) => delete each.dataset.time")
    over_time.nth(0).scroll_into_view_if_needed()
    box = over_time.nth(0).locator(".nsewdrag").first.bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 1)
    page.locator("html[data-time]").wait_for(state="attached")
    over_time.nth(1).scroll_into_view_if_needed()
    over_time.nth(1).locator(".nsewdrag").first.hover()
    page.wait_for_timeout(300)
    # and from the map to the others
    track.scroll_into_view_if_needed()
    spot = track.locator(".spot").bounding_box()
    assert spot is not None
    page.mouse.move(spot["x"] + 30, spot["y"] + 30)
    page.mouse.move(spot["x"] + 7, spot["y"] + 7, steps=5)
    page.wait_for_timeout(300)
    assert float(page.locator("html").get_attribute("data-time") or "nan") == pytest.approx(time, abs=1.0)


def test_given_a_zoom_of_one_time_axis_then_all_have_it_and_a_double_click_resets_them(page: Page) -> None:
    over_time, _ = find_charts(page)
    before = read_ranges(page)
    over_time.nth(1).scroll_into_view_if_needed()
    box = over_time.nth(1).locator(".nsewdrag").first.bounding_box()
    assert box is not None
    middle = box["y"] + box["height"] / 2
    page.mouse.move(box["x"] + 0.3 * box["width"], middle)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.6 * box["width"], middle, steps=6)
    page.mouse.up()
    page.wait_for_timeout(800)
    zoomed = read_ranges(page)
    for low, high in zoomed:
        assert low == pytest.approx(0.3 * before[1][1], abs=0.5)
        assert high == pytest.approx(0.6 * before[1][1], abs=0.5)
    page.mouse.dblclick(box["x"] + 0.5 * box["width"], middle)
    page.wait_for_timeout(800)
    for found, old in zip(read_ranges(page), before, strict=True):
        assert found == pytest.approx(old, abs=1.0)


def test_given_a_button_then_the_page_and_its_charts_are_dark(page: Page) -> None:
    color = "document.querySelector('.chart .xtick text').style.fill"
    assert page.locator("html").get_attribute("data-theme") == "light"
    light = page.evaluate(color)
    page.get_by_role("button", name="Dark").click()
    page.get_by_role("button", name="Light").wait_for()
    page.wait_for_timeout(500)
    assert page.evaluate(color) != light
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(20, 24, 29)"
    page.get_by_role("button", name="Light").click()
    page.get_by_role("button", name="Dark").wait_for()


@pytest.fixture(scope="module")
def calibration(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the page of a magnetometer in a circle beside its own field."""
    yaw = np.linspace(0.0, 4.0 * np.pi, 300)
    fields = np.column_stack([20e-6 * np.cos(yaw) + 5e-6, 20e-6 * np.sin(yaw), np.full(300, -45e-6)])
    found = fit_level(fields, (0.0, 0.0, 9.8), 20e-6, -45e-6)
    page = tmp_path_factory.mktemp("calibration") / "circle.html"
    page.write_text(
        render_magnetometer_page("turned.lcm", ["text"], found, fields, MagnetometerCalibration(), "default")
    )
    return page


@pytest.mark.parametrize(("name", "headline"), [("report", "Valid"), ("calibration", "Heading is wrong by up to 14.5")])
def test_given_a_dark_telephone_then_a_report_fits_it_and_all_its_charts_are_drawn(
    browser: Browser, request: pytest.FixtureRequest, name: str, headline: str
) -> None:
    file: Path = request.getfixturevalue(name)
    with open_link(browser, file.as_uri(), width=390, is_dark=True) as page:
        page.locator("html[data-drawn]").wait_for()
        labels = page.locator(".chart").evaluate_all(
            "(all) => all.map((each) => each.querySelectorAll('.xtick').length)"
        )
        assert labels
        assert all(labels)
        assert page.locator(".answer strong").inner_text().startswith(headline)
        assert page.evaluate("document.documentElement.scrollWidth") == 390
        assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(20, 24, 29)"
        widths = page.locator(".chart").evaluate_all("(all) => all.map((each) => each._fullLayout._size.w)")
        assert min(widths) > 200


RANGES = {"a": (1.0e-5, 1.6e-5), "b": (0.0012, 0.0014), "c": (500000.001, 500000.004), "d": (-0.00586, -0.00584)}


def test_given_small_changes_of_any_value_then_the_labels_of_ticks_differ_and_are_values(
    browser: Browser, tmp_path: Path
) -> None:
    t = np.linspace(0.0, 100.0, 300)
    panels = [
        charts.Panel(name, charts.Axis("m", low, high), [charts.Series(name, t, low + (high - low) * t / 100.0)])
        for name, (low, high) in RANGES.items()
    ]
    file = tmp_path / "small.html"
    file.write_text(charts.render_page("a", charts.render_panels("a", charts.Axis("s", 0.0, 100.0), panels)))
    with open_link(browser, file.as_uri()) as page:
        page.locator("html[data-drawn]").wait_for()
        for number, (low, high) in enumerate(RANGES.values(), 1):
            axis = f".y{number if number > 1 else ''}tick text"
            labels = page.locator(axis).evaluate_all("(all) => all.map((each) => each.textContent)")
            # a power of ten is a superscript, behind an invisible space
            words = [re.sub("[\u2009\u200b]", "", each).replace("−", "-").replace("×10", "e") for each in labels]
            values = list(map(float, words))
            assert len(set(values)) == len(values) >= 3, labels
            assert low <= min(values) < max(values) <= high
            # a label is beside its axis's title, not over it
            title = page.locator(f".g-y{number if number > 1 else ''}title").bounding_box()
            boxes = page.locator(axis).evaluate_all("(all) => all.map((each) => each.getBoundingClientRect().left)")
            assert title is not None
            assert title["x"] + title["width"] <= min(boxes)
