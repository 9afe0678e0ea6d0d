"""A headless browser for tests of pages: Chromium, as the machine has it, driven by playwright."""

from __future__ import annotations

import os
import re
import shutil
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Literal

import pytest

if TYPE_CHECKING:
    from playwright.sync_api import Browser, ConsoleMessage, Locator, Page
    from viser import ViserServer

    from mstools.view.background import Background
    from mstools.view.editor import Editing
    from mstools.view.sources import Source

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), "")

needs_browser = pytest.mark.skipif(
    not CHROMIUM, reason="no Chromium: sudo apt install chromium; pages are not tested in a browser without it"
)

# software rendering, as a machine without a graphics card has it; the page around the scene is composed without the
# emulated card, at half of the cost; root needs no-sandbox
OPTIONS = (
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--disable-gpu-compositing",
)
LOCAL = ("http://127.0.0.1:", "ws://127.0.0.1:", "file:", "blob:", "data:")
WIDTH, HEIGHT = 1400, 900
TIMEOUT_MS = 60_000
RETYPE_MS = 5_000
FEWER_PICTURES = """{
  const request = window.requestAnimationFrame.bind(window);
  window.requestAnimationFrame = (draw) => setTimeout(() => request(draw), 250);
  window.cancelAnimationFrame = (handle) => clearTimeout(handle);
}"""
"""Four pictures a second: drawing without a graphics card takes all processors, which the page and other tests need."""

REMOVED_MEANWHILE = "Tried to update non-existent component"
"""Error of viser's page where a field is made, changed and removed between two pictures, as by two selections: it
applies changes last, and leaves this one out."""


@contextmanager
def start_browser() -> Iterator[Browser]:
    """Start a headless browser; one at a time in a process."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright, TemporaryDirectory() as folder:
        polite = Path(folder) / "chromium"
        polite.write_text(f'#!/bin/sh\nexec nice -n 5 {CHROMIUM} "$@"\n')
        polite.chmod(0o700)
        browser = playwright.chromium.launch(executable_path=polite, args=OPTIONS, env=dict(os.environ))
        yield browser
        browser.close()


@contextmanager
def open_link(
    browser: Browser,
    link: str,
    sharpness: float = 0.5,
    expected_errors: tuple[str, ...] = (),
    width: int = WIDTH,
    is_dark: bool = False,
) -> Iterator[Page]:
    """Open a link in a page without cookies of others; errors of its console fail the test, but for expected ones.

    `sharpness`: pixels along each side of the viewer's scene, not of its panels, relative to those of the page.
    `is_dark`: whether the system prefers dark colors.
    """
    scheme: Literal["dark", "light"] = "dark" if is_dark else "light"
    page = browser.new_page(viewport={"width": width, "height": HEIGHT}, color_scheme=scheme)
    page.add_init_script(FEWER_PICTURES)
    page.set_default_timeout(TIMEOUT_MS)
    errors: list[str] = []

    def on_console(message: ConsoleMessage) -> None:
        expected = (REMOVED_MEANWHILE, *expected_errors)
        if message.type == "error" and not any(each in message.text for each in expected):
            errors.append(message.text)

    page.on("console", on_console)
    page.on("pageerror", lambda error: errors.append(str(error)))
    # nothing is loaded from the internet
    page.on("request", lambda request: None if request.url.startswith(LOCAL) else errors.append(request.url))
    if link.startswith("http"):
        link, mark, panes = link.partition("#")
        link += f"{'&' if '?' in link else '?'}fixedDpr={sharpness}{mark}{panes}"
    page.goto(link)
    try:
        yield page
    finally:
        page.close()
    assert not errors, errors


@contextmanager
def show(
    browser: Browser,
    source: Source,
    editing: Editing | None = None,
    sharpness: float = 0.5,
    path: str = "scene",
    background: Background | None = None,
) -> Iterator[Page]:
    """Show a source of the viewer in a browser, with the viewer in a thread; `sharpness` as in `open_link`.

    `path`: `scene` shows the scene with its tabs alone, an empty one the whole page.
    """
    with serve(browser, source, editing, sharpness, path, background) as (page, _):
        yield page


@contextmanager
def serve(
    browser: Browser,
    source: Source,
    editing: Editing | None = None,
    sharpness: float = 0.5,
    path: str = "scene",
    background: Background | None = None,
) -> Iterator[tuple[Page, ViserServer]]:
    """Show a source as `show` does; yield the page and its server."""
    from mstools.view.page import open_page
    from mstools.view.viewer import Viewer

    served = open_page(port=0)
    viewer = Viewer(served, source, editing, background)
    stop = threading.Event()
    thread = threading.Thread(target=viewer.run, args=(stop.is_set,))
    thread.start()
    try:
        with open_link(browser, f"{served.link}{path}", sharpness) as page:
            (page if path else page.frame_locator("#scene iframe")).get_by_role("tab", name="Query").wait_for()
            yield page, served.server
    finally:
        stop.set()
        thread.join(10.0)
        served.close()
        source.close()


def choose(page: Page, label: str, option: str) -> None:
    """Choose an option of a dropdown, by typing as a person does: again where its list was replaced meanwhile."""
    from playwright.sync_api import TimeoutError as NotThereError

    box = page.get_by_role("combobox", name=label, exact=True)
    for _ in range(TIMEOUT_MS // RETYPE_MS):
        box.click()
        box.fill(option)
        with suppress(NotThereError):
            page.get_by_role("option", name=option, exact=True).click(timeout=RETYPE_MS)
            wait_until_sent(page)
            return
    raise AssertionError(f"{label} has no option {option}")


def wait_until(page: Page, condition: Callable[[], bool]) -> None:
    for _ in range(600):
        if condition():
            return
        page.wait_for_timeout(100)
    raise AssertionError("the condition never held")


def wait_until_sent(page: Page) -> None:
    """Wait until the page has sent a change of a field; of two changes within 50 ms it sends only the later one.

    The page's own timer counts those, late on a busy machine; one that is set after it is due after it.
    """
    page.evaluate("() => new Promise(resolve => setTimeout(resolve, 60))")


def find_fields(page: Page, label: str) -> Locator:
    """Return the inputs of a row, three for a vector, two for a slider."""
    labels = page.locator("label").filter(has_text=re.compile(f"^{re.escape(label)}$"))
    return labels.locator("xpath=ancestor::div[contains(@class, 'Flex-root')][1]").locator("input")


def select_item(page: Page, kind: str, name: str) -> None:
    """Select what the editor edits, and wait until its fields are there."""
    from playwright.sync_api import expect

    choose(page, "Kind", kind)
    choose(page, "Item", name)
    expect(find_fields(page, "Name")).to_have_value(name.rpartition(":")[2], timeout=TIMEOUT_MS)
