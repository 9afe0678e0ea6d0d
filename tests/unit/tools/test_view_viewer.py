"""The viewer between its page and its source, without a browser."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("viser", reason="the extra view is not installed: pip install -e '.[view]'")

from modelserver.messages import VALID, ChannelHealth, Health
from mstools.commands.demo import find_vehicle_file
from mstools.recordings.drive import Drive
from mstools.view.page import Page, open_page
from mstools.view.sources import NoGeometry, Source, open_geometry
from mstools.view.viewer import Viewer, _format_sensors

URDF = """<robot name="r">
<link name="a"><visual><geometry><mesh filename="&lt;b&gt;{x}*.stl"/></geometry></visual></link>
<link name="b"/><joint name="j" type="fixed"><parent link="a"/><child link="b"/></joint></robot>"""


@pytest.fixture
def page() -> Iterator[Page]:
    opened = open_page(port=0)
    yield opened
    opened.close()


def make_live() -> Source:
    """Return a source of a service that never publishes."""
    return Source("live", Drive(), NoGeometry("here"), is_live=True)


def test_given_an_error_of_an_action_then_the_viewer_goes_on(page: Page, capsys: pytest.CaptureFixture[str]) -> None:
    viewer = Viewer(page, open_geometry(find_vehicle_file(), {}))
    done: list[str] = []
    viewer._actions.put(lambda: done.append(str(1 // 0)))
    viewer._actions.put(lambda: done.append("next"))
    viewer.draw(0.0, 0.0)
    assert done == ["next"]
    assert "ZeroDivisionError" in capsys.readouterr().err


def test_given_a_mesh_file_with_markup_in_its_name_then_it_is_listed_as_text(page: Page, tmp_path: Path) -> None:
    (tmp_path / "robot.urdf").write_text(URDF)
    viewer = Viewer(page, open_geometry(tmp_path / "robot.urdf", {}))
    viewer.draw(0.0, 0.0)
    assert r"- \<b\>\{x\}\*.stl" in viewer._notes.content


def test_given_no_service_then_the_page_reports_it_and_shows_no_time(page: Page) -> None:
    source = make_live()
    viewer = Viewer(page, source)
    viewer.draw(0.0, 0.0)
    assert viewer._title == "ModelServer: live - no message"
    assert viewer._state is not None
    assert viewer._time is not None
    assert "no message of a service yet" in viewer._state._validity.content
    assert viewer._time._clock.content == "no pose and no joints yet"
    source.close()


def test_given_a_slider_that_a_browser_moved_then_its_value_is_sent_again_once_it_stays(page: Page) -> None:
    source = make_live()
    source.drive.set_joint("a", 10**15, 0.0)
    source.drive.set_joint("a", 10**15 + 10_000_000, 0.0)
    viewer = Viewer(page, source)
    panel = viewer._time
    assert panel is not None
    panel.advance(source.drive, 0.0)
    panel.jump(5.0)
    # as the page's own update does
    panel._slider._impl.value = 5.0
    sent: list[float] = []
    panel._slider.on_update(lambda event: sent.append(event.target.value))
    for _ in range(4):
        panel.show()
    assert sent[-1] == 5.0
    assert len(sent) == 2
    source.close()


def make_health(seconds: float, *channels: ChannelHealth) -> Health:
    utime = round(seconds * 1e6)
    return Health(utime, 1.0, "", "", "", 0, VALID, 0, 0, 0, 0, 0, 0, 0, channels=channels)


def test_given_sensors_then_their_rates_are_means_and_a_silent_one_shows() -> None:
    earlier = make_health(1.0, ChannelHealth("sensor:gps", 100, 0.0, 0.1), ChannelHealth("sensor:imu", 500, 0.0, 0.1))
    health = make_health(
        4.0,
        # a report of a tenth of a second has none of a receiver at 4 Hz
        ChannelHealth("sensor:gps", 112, 0.0, 0.2, measured=30, used=29),
        ChannelHealth("sensor:imu", 3, 99.0, 7.0, silent=True),
        ChannelHealth("v_WHEELS", 0, 0.0, math.nan, silent=True),
        ChannelHealth("command:view", 3, 99.0, 0.0),
    )
    rows = [tuple(line.strip("| ").split(" | ")) for line in _format_sensors(health, earlier).splitlines()[2:]]
    assert rows == [
        ("gps", "4.0", "200 ms", "29 of 30"),
        ("imu", "99.0", "7.0 s, silent", "-"),
        (r"v\_WHEELS", "0.0", "never", "-"),
    ]
