"""A report in a real browser, from the file and without internet: charts, one time on all, one zoom, light and dark."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from support_browser import needs_browser, open_link
from support_tuning import write_simulated_log

from mstools import cli

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
    # findings and headings are text, before any chart
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
