"""What the viewer's page gets for its requests."""

from __future__ import annotations

import gzip
import json
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("viser", reason="the extra view is not installed: pip install -e '.[view]'")

from support_recordings import write_log
from support_view import record_drive

from modelserver.transforms.pose import Pose
from mstools.commands.demo import find_vehicle_file
from mstools.view.dashboard import ASSETS, Dashboard, Shown
from mstools.view.sources import Source, open_geometry, open_log


class Page:
    """A dashboard, and what it was asked to change."""

    def __init__(self, source: Source):
        self.changes: list[Any] = []
        self.dashboard = Dashboard(
            source,
            seek=self.changes.append,
            play=self.changes.append,
            follow=lambda: self.changes.append("live"),
            hide=lambda *names: self.changes.append(names),
            pick=lambda *frame: self.changes.append(frame),
            find_frame=lambda browser, x, y: ("A:B", Pose((x, y, 0.0))) if browser == "b" else None,
        )

    def get(self, path: str, **query: str) -> Any:
        """Return an answer's JSON."""
        reply = self.dashboard.respond(path, query)
        assert reply is not None
        return json.loads(reply.body)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_drive(tmp_path_factory.mktemp("drive"), 12.0)


@pytest.fixture
def page(log: Path) -> Page:
    return Page(open_log(log))


def test_given_files_of_the_page_then_they_are_sent_and_no_others(page: Page) -> None:
    for name in ("/", *(f"/assets/{each}" for each in ASSETS)):
        reply = page.dashboard.respond(name, {})
        assert reply is not None
        assert len(reply.body) > 500
    plotly = page.dashboard.respond("/assets/plotly.js", {})
    assert plotly is not None
    assert plotly.is_packed
    assert b"plotly.js" in gzip.decompress(plotly.body)[:200]
    for name in ("/assets/../page.py", "/assets/", "/other", "/state/"):
        assert page.dashboard.respond(name, {}) is None


def test_given_a_log_then_its_state_at_a_time_is_described(page: Page) -> None:
    drive = page.dashboard._source.drive
    page.dashboard.shown = Shown(drive.begin + 11_000_000, is_playing=True)
    state = page.get("/state")
    assert state["at"] == pytest.approx(11.0)
    assert (state["valid"], state["is_playing"], state["is_live"]) == (True, True, False)
    assert state["speed"] == pytest.approx(3.0, abs=0.3)
    assert {each["name"] for each in state["sensors"]} >= {"gps", "imu", "wheels"}
    assert "speed" in state["charts"]
    assert any(each.startswith("state ") for each in state["charts"])
    pose = page.dashboard._source.drive.get_picture(page.dashboard.shown.utime).pose
    assert pose is not None
    assert page.get("/state")["place"] == pytest.approx(pose.xyz[:2], abs=0.001)
    assert page.get("/charts", **{"from": "0", "to": "12", "names": ",".join(state["charts"])})["data"]
    assert page.get("/strip", **{"from": "0", "to": "12"})["data"]
    assert page.changes == []


def test_given_changes_then_they_are_passed_on(page: Page) -> None:
    page.get("/seek", at="3.5")
    page.get("/play", on="1")
    page.get("/live")
    page.get("/pick", frame="A:B", reference="1")
    page.get("/hide", bodies='["A"]', kinds='["axes"]')
    assert page.changes == [3.5, True, "live", ("A:B", True), (frozenset({"A"}), frozenset({"axes"}))]
    assert [each for each in page.get("/tree")["kinds"] if not each["shown"]] == [{"name": "axes", "shown": False}]


def test_given_a_pointer_then_the_frame_below_it_has_its_pose(page: Page) -> None:
    assert page.get("/hover", browser="b", x="0.5", y="0.25")["pose"] == "0.500, 0.250, 0.000 m; 0.0, 0.0, 0.0 deg"
    assert page.get("/hover", browser="other", x="0.5", y="0.25") == {"name": ""}


@pytest.mark.parametrize(
    ("path", "query"),
    [
        ("/seek", {}),
        ("/seek", {"at": "nan"}),
        ("/seek", {"at": "-1"}),
        ("/seek", {"at": "1e99"}),
        ("/map", {"width": "1e9", "height": "10"}),
        ("/map", {"width": "10", "height": "10", "scale": "0", "east": "0", "north": "0"}),
        ("/map", {"width": "10", "height": "10", "scale": "1", "east": "inf", "north": "0"}),
        ("/charts", {"from": "2", "to": "1"}),
        ("/strip", {"from": "", "to": "1"}),
        ("/hover", {"x": "2", "y": "0"}),
        ("/hide", {"bodies": "[[]]"}),
        ("/hide", {"bodies": "{"}),
        ("/hide", {"bodies": "1"}),
    ],
)
def test_given_a_malformed_query_then_it_is_rejected(page: Page, path: str, query: dict[str, str]) -> None:
    with pytest.raises(ValueError, match=r"\w"):
        page.dashboard.respond(path, query)
    assert page.changes == []


def test_given_a_geometry_file_then_it_has_a_tree_and_no_time() -> None:
    page = Page(open_geometry(find_vehicle_file(), {}))
    state = page.get("/state")
    assert not state["has_time"]
    assert state["revision"]
    bodies = {each["name"]: each for each in page.get("/tree")["bodies"]}
    assert "Raptor:CG" in bodies["Raptor"]["frames"]


def test_given_a_log_of_fixes_alone_then_its_charts_and_map_are_there(tmp_path: Path) -> None:
    from modelserver.messages import FixType, GpsSample, SensorHeader
    from modelserver.wire.codec import encode

    start = 1_750_000_000_000_000
    fixes = [
        GpsSample(SensorHeader(start + k * 250_000, "gps"), FixType.FIX_3D, 50.27 + 1e-5 * k, -111.18, 700.0)
        for k in range(40)
    ]
    events = [(each.header.utime, "GPS", encode(each)) for each in fixes]
    page = Page(open_log(write_log(tmp_path / "raw.lcm", events)))
    state = page.get("/state")
    assert state["valid"] is None
    assert state["seconds"] == pytest.approx(9.75)
    assert "-c vehicle.yaml runs the localization" in page.dashboard._source.notes[0]
    assert len(page.get("/map", width="800", height="400")["fixes"]) > 30
    rates = page.get("/charts", **{"from": "0", "to": "9", "names": "rates"})["data"]
    assert [each["name"] for each in rates] == ["GPS"]


def test_given_no_picture_of_the_ground_then_none_is_sent_and_a_grid_only_when_asked_for(page: Page) -> None:
    view = {"east": "0", "north": "0", "scale": "1", "width": "800", "height": "600"}
    assert page.dashboard.respond("/background", view) is None
    found = page.get("/map", **view)
    assert (found["attribution"], found["grid"]) == (None, [])
    assert len(page.get("/map", **view, grid="utm")["grid"]) > 5
    with pytest.raises(ValueError, match="scale must be"):
        page.get("/map", **{**view, "scale": "inf"}, grid="geodetic")
