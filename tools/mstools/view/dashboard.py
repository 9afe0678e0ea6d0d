"""What the page around the scene asks for: the strip above, charts and map, and the files of the page itself.

    /               the page, in which /scene is the 3D scene (viser's)
    /state          the strip: validity, speed, heading, uncertainty, ages, time
    /charts         the charts of a span of time; /strip the validity over it
    /map            what a view of the map shows; /background the picture of the ground below it
    /hover          the frame below the pointer in the scene
    /tree           bodies with their frames, and what is hidden; /hide, /pick change that and the query
    /seek, /play, /live   change the time that is shown
    /assets/NAME    scripts and styles

Answers are computed in threads of the server, under the source's lock where they read the drive. A change of time is
queued, and executed by the viewer between two pictures.
"""

from __future__ import annotations

import gzip
import json
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any, Final

from modelserver.messages import Health
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Vector3
from mstools.recordings.drive import Drive, Picture
from mstools.recordings.pose_signals import compute_signals
from mstools.report.charts import encode_json, read_plotly
from mstools.view.map import MAX_METERS_PER_PIXEL, View, describe_map, fit_view, make_grid
from mstools.view.page import Reply
from mstools.view.scene import KINDS
from mstools.view.signals import Span, list_charts, make_panels, make_strip
from mstools.view.sources import Source

if TYPE_CHECKING:
    from mstools.view.background import Background

ASSETS: Final = {
    "view.css": ("mstools.view.web", "text/css; charset=utf-8"),
    "view.js": ("mstools.view.web", "text/javascript; charset=utf-8"),
    "map.js": ("mstools.view.web", "text/javascript; charset=utf-8"),
    "charts.js": ("mstools.report", "text/javascript; charset=utf-8"),
}
"""Package and media type of the page's files."""

MAX_PIXELS: Final = 8192
"""Largest width and height of a map that is answered."""


@dataclass(frozen=True)
class Shown:
    """What is shown: the time, 0 for the newest; whether it plays; named places in World:UTM for the map."""

    utime: int = 0
    is_playing: bool = False
    trail_s: float = math.inf
    places: Mapping[str, Vector3] = field(default_factory=dict)


class Dashboard:
    """Answers the requests of the page around the scene.

    Parameters
    ----------
    seek : called with seconds after the drive's begin
    play : called with whether it is to play
    follow : called to show the newest picture
    hide : called with the names of bodies and the kinds of things that are not to be drawn
    pick : called with a frame for the query, and whether it is its frame of reference
    background : the picture of the ground below the map
    find_frame : returns the frame below the pointer of a browser and its pose in the base frame; None without one
    """

    def __init__(
        self,
        source: Source,
        seek: Callable[[float], None],
        play: Callable[[bool], None],
        follow: Callable[[], None],
        find_frame: Callable[[str, float, float], tuple[str, Pose] | None],
        hide: Callable[[frozenset[str], frozenset[str]], None],
        pick: Callable[[str, bool], None],
        background: Background | None = None,
    ):
        self._source = source
        self._seek, self._play, self._follow, self._find_frame = seek, play, follow, find_frame
        self._hide, self._pick, self._background = hide, pick, background
        self._hidden: tuple[frozenset[str], frozenset[str]] = (frozenset(), frozenset())
        self.shown = Shown()

    def respond(self, path: str, query: Mapping[str, str]) -> Reply | None:
        """Return the answer to a request; None for what is not here. Raises ValueError for a malformed query."""
        if path == "/":
            return Reply((files("mstools.view.web") / "index.html").read_bytes(), "text/html; charset=utf-8")
        if path.startswith("/assets/"):
            return _read_asset(path.removeprefix("/assets/"))
        if path == "/background":
            return self._draw_background(query)
        answer = self._answers.get(path)
        return None if answer is None else Reply(encode_json(answer(self, query)).encode())

    def _describe_state(self, query: Mapping[str, str]) -> dict[str, Any]:
        source, shown = self._source, self.shown
        now = time.time_ns() // 1000 if source.is_live else 0
        with source.lock:
            drive = source.drive
            picture = drive.get_picture(shown.utime)
            health: Health | None = drive.get_report("MODELSERVER_HEALTH", shown.utime)
            model, _ = drive.get_geometry(shown.utime)
            state: dict[str, Any] = {
                "title": source.title,
                "has_time": source.has_time,
                "has_poses": bool(drive.poses.count),
                "is_live": source.is_live,
                "follows": source.is_live and not shown.utime,
                "is_playing": shown.is_playing,
                "begin": drive.begin,
                "seconds": (drive.end - drive.begin) * 1e-6,
                "at": (picture.utime - drive.begin) * 1e-6 if drive.begin else 0.0,
                "utime": picture.utime,
                "silence": drive.find_silence(now) if now else "",
                "revision": model.revision if model is not None else "",
                "charts": list_charts(drive),
                **_describe_pose(drive, picture),
            }
        age = max((now - health.utime) * 1e-6, 0.0) if health is not None and now and not shown.utime else 0.0
        sensors = [each for each in health.channels if each.channel.startswith("sensor:")] if health is not None else []
        state["sensors"] = [
            {
                "name": each.channel.removeprefix("sensor:"),
                "age": each.age + age if math.isfinite(each.age) else None,
                "silent": each.silent,
            }
            for each in sensors
        ]
        return state

    def _make_charts(self, query: Mapping[str, str]) -> dict[str, Any]:
        names = [each for each in query.get("names", "").split(",") if each]
        with self._source.lock:
            drive = self._source.drive
            return make_panels(drive, self._read_span(drive, query), names)

    def _make_strip(self, query: Mapping[str, str]) -> dict[str, Any]:
        with self._source.lock:
            drive = self._source.drive
            return make_strip(drive, self._read_span(drive, query))

    def _read_span(self, drive: Drive, query: Mapping[str, str]) -> Span:
        begin, end = (_read_number(query, name, 0.0, 1e9) for name in ("from", "to"))
        if not begin < end:
            raise ValueError("the span is empty")
        return Span(drive.begin + round(begin * 1e6), drive.begin + round(end * 1e6), drive.begin)

    def _describe_map(self, query: Mapping[str, str]) -> dict[str, Any]:
        shown = self.shown
        with self._source.lock:
            drive = self._source.drive
            picture = drive.get_picture(shown.utime)
            view = _read_view(query) if "scale" in query else fit_view(drive, *_read_size(query))
            found = describe_map(drive, picture, shown.trail_s, view, shown.places)
            origin = drive.origin
        kind = query.get("grid", "")
        found["grid"] = make_grid(origin, view, kind) if kind and origin is not None else []
        found["attribution"] = None if self._background is None else self._background.attribution
        return found

    def _draw_background(self, query: Mapping[str, str]) -> Reply | None:
        origin = self._source.drive.origin
        if self._background is None or origin is None:
            return None
        return Reply(self._background.draw(_read_view(query), origin), "image/png")

    def _change_time(self, query: Mapping[str, str]) -> dict[str, Any]:
        self._seek(_read_number(query, "at", 0.0, 1e9))
        return {}

    def _change_play(self, query: Mapping[str, str]) -> dict[str, Any]:
        self._play(query.get("on") == "1")
        return {}

    def _change_live(self, query: Mapping[str, str]) -> dict[str, Any]:
        self._follow()
        return {}

    def _describe_frame(self, query: Mapping[str, str]) -> dict[str, Any]:
        x, y = (_read_number(query, name, 0.0, 1.0) for name in ("x", "y"))
        found = self._find_frame(query.get("browser", ""), x, y)
        if found is None:
            return {"name": ""}
        name, pose = found
        xyz, rpy = ([value + 0.0 for value in each] for each in (pose.xyz, map(math.degrees, pose.rpy)))
        place = ", ".join(f"{value:.3f}" for value in xyz)
        angles = ", ".join(f"{value:.1f}" for value in rpy)
        return {"name": name, "pose": f"{place} m; {angles} deg"}

    def _describe_tree(self, query: Mapping[str, str]) -> dict[str, Any]:
        with self._source.lock:
            model, _ = self._source.drive.get_geometry(self.shown.utime)
        bodies, kinds = self._hidden
        listed = [] if model is None else model.bodies
        return {
            "bodies": [
                {"name": body.name, "shown": body.name not in bodies, "frames": [each.full_name for each in body]}
                for body in listed
            ],
            "kinds": [{"name": kind, "shown": kind not in kinds} for kind in KINDS],
        }

    def _change_hidden(self, query: Mapping[str, str]) -> dict[str, Any]:
        bodies, kinds = (_read_names(query, name) for name in ("bodies", "kinds"))
        self._hidden = (bodies, kinds)
        self._hide(bodies, kinds)
        return {}

    def _change_query(self, query: Mapping[str, str]) -> dict[str, Any]:
        self._pick(query.get("frame", ""), query.get("reference") == "1")
        return {}

    _answers: Final[Mapping[str, Callable[[Dashboard, Mapping[str, str]], dict[str, Any]]]] = {
        "/state": _describe_state,
        "/charts": _make_charts,
        "/strip": _make_strip,
        "/map": _describe_map,
        "/hover": _describe_frame,
        "/tree": _describe_tree,
        "/hide": _change_hidden,
        "/pick": _change_query,
        "/seek": _change_time,
        "/play": _change_play,
        "/live": _change_live,
    }


@cache
def _read_asset(name: str) -> Reply | None:
    """Return a file of the page; None for an unknown one."""
    if name == "plotly.js":
        return Reply(gzip.compress(read_plotly(), 6, mtime=0), "text/javascript; charset=utf-8", True, True)
    if name not in ASSETS:
        return None
    package, media_type = ASSETS[name]
    return Reply((files(package) / name).read_bytes(), media_type)


def _describe_pose(drive: Drive, picture: Picture) -> dict[str, Any]:
    """Return the pose of a picture as the strip shows it."""
    if picture.pose is None:
        return {"valid": None, "reason": "no pose"}
    values = compute_signals(drive, picture.utime)._asdict() | {"level": picture.horizontal_protection_level}
    return {
        "valid": not picture.invalid,
        "reason": picture.invalid.explain() if picture.invalid else "",
        "place": [round(each, 3) for each in picture.pose.xyz[:2]],
        **{name: value if math.isfinite(value) else None for name, value in values.items()},
    }


def _read_number(query: Mapping[str, str], name: str, low: float, high: float) -> float:
    value = float(query.get(name, "nan"))
    if not low <= value <= high:
        raise ValueError(f"{name} must be a number from {low:g} to {high:g}")
    return value


def _read_size(query: Mapping[str, str]) -> tuple[int, int]:
    width, height = (round(_read_number(query, name, 1.0, MAX_PIXELS)) for name in ("width", "height"))
    return width, height


def _read_view(query: Mapping[str, str]) -> View:
    east, north = (_read_number(query, name, -1e7, 1e7) for name in ("east", "north"))
    return View(east, north, _read_number(query, "scale", 1e-4, MAX_METERS_PER_PIXEL), *_read_size(query))


def _read_names(query: Mapping[str, str], name: str) -> frozenset[str]:
    value = json.loads(query.get(name, "[]"))
    if not (isinstance(value, list) and all(isinstance(each, str) for each in value)):
        raise ValueError(f"{name} must be a list of names in JSON")
    return frozenset(value)
