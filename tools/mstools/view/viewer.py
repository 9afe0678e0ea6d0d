"""The viewer: one page that shows a source, until it is stopped; and the panels of its tabs."""

from __future__ import annotations

import gc
import json
import math
import shlex
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from datetime import UTC, datetime
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import viser

from modelserver.errors import ModelServerError, QueryError
from modelserver.geometry import names
from modelserver.geometry.joint import Joint
from modelserver.geometry.model import Model
from modelserver.messages import Explanation, Health, Invalid, MotionAnswer, Policy, PoseAnswer, Quality
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Array
from mstools.edit import GeometryItem, ItemKind
from mstools.recordings.drive import Drive, DriveEvent, EventKind, Picture
from mstools.recordings.pose_signals import CHI_SQUARE_3
from mstools.terminal.health import format_body, format_duration
from mstools.view.balance import BalancePanel
from mstools.view.camera import ViewCamera
from mstools.view.dashboard import Dashboard, Shown
from mstools.view.editor import Editing, Editor
from mstools.view.page import Actions, Page, escape_markdown, format_table
from mstools.view.scene import NameLabels, VehicleScene
from mstools.view.sources import Source, list_coordinates

if TYPE_CHECKING:
    from mstools.view.background import Background

WORLDS: Final = (names.WORLD_UTM, names.WORLD_ENU, names.ODOM)
SPEEDS: Final = ("0.25x", "0.5x", "1x", "2x", "5x", "10x", "30x")
ALL: Final = "all"
SHOWN_EVENTS: Final = 8
QUERY_PERIOD_S: Final = 0.5
STATE_PERIOD_S: Final = 0.5
SHOWN_STATES: Final = 40
POSE_NAMES: Final = ("x", "y", "z", "roll", "pitch", "yaw")
TRAILS: Final = {"10 s": 10.0, "60 s": 60.0, "10 min": 600.0, "all": math.inf}
"""Lengths of the trail, seconds."""

RATE_PERIOD_US: Final = 3_000_000
"""Rates of sensors are means over this time: a report alone may be of a tenth of a second."""

PICTURE_S: Final = 1.0 / 25.0
"""Period of pictures, seconds."""

SLIDER_PERIOD_S: Final = 0.2
"""Period at which slider and clock follow playback, seconds."""

HOVER_S: Final = 0.5
"""Longest time to find the frame below a pointer, seconds: a later answer would be of where it was."""

HOVER_DISTANCE: Final = 0.03
"""Distance of the pointer from a frame whose name is shown, as a part of the picture's height: half of its axes."""

LABEL_PERIOD_S: Final = 0.2
"""Period at which it is decided which names are shown, seconds."""

UNCERTAINTY_PERIOD_S: Final = 0.2
"""Period at which the shape of the uncertainty follows, seconds; its place does with each picture."""

FIX_PERIOD_S: Final = 0.5
"""Period at which the fixes follow, seconds: all of them are sent to the browser again."""


class Viewer:
    """Show a source on a page. `run` draws picture after picture; callbacks of the page are executed between them."""

    def __init__(
        self, page: Page, source: Source, editing: Editing | None = None, background: Background | None = None
    ):
        self._source = source
        self._server = page.server
        self._actions = Actions()
        self._model: Model | None = None
        self._is_following = True
        self._named: tuple[NameLabels, tuple[str, str]] | None = None
        self._next_slider = self._next_state = self._next_fixes = self._next_labels = self._next_uncertainty = 0.0
        gui = page.server.gui
        gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
        gui.main_panel.dock_right()
        self._title = ""
        self._show_title("")
        self._scene = VehicleScene(page.server, source.meshes, self._pick)
        self._camera = ViewCamera(page.server, self._scene.list_points, lambda: self._scene.heading)
        tabs = gui.add_tab_group()
        with tabs.add_tab("Query"):
            self._query = QueryPanel(gui, source)
        self._time: TimePanel | None = None
        self._state: StatePanel | None = None
        if source.has_time:
            with tabs.add_tab("Time"):
                self._time = TimePanel(gui, source.is_live, self._actions)
            with tabs.add_tab("State"):
                self._state = StatePanel(gui)
        self._joints: JointsPanel | None = None
        self._balance: BalancePanel | None = None
        self._editor: Editor | None = None
        if source.set_model is not None:
            if editing is not None:
                with tabs.add_tab("Edit"):
                    self._editor = Editor(page.server, self._scene, editing, self._actions, source.set_model)
            with tabs.add_tab("Joints"):
                self._balance = BalancePanel(gui, page.server.scene, source.dynamics)
                self._joints = JointsPanel(gui, source, self._actions)
        with tabs.add_tab("Display"):
            self._camera.add_controls(gui, self._actions)
            self._display = DisplayPanel(gui)
            self._actions.on_update(self._display.shadows, lambda: self._scene.set_shadows(self._display.shadows.value))
            self._notes = gui.add_markdown("")
        self._dashboard = Dashboard(
            source,
            seek=lambda at: self._change_time(lambda panel: panel.jump(at)),
            play=lambda on: self._change_time(lambda panel: panel.play(on)),
            follow=lambda: self._change_time(lambda panel: panel.follow()),
            find_frame=self._find_frame,
            hide=lambda bodies, kinds: self._actions.put(partial(self._scene.hide, bodies, kinds)),
            pick=self._pick,
            background=background,
        )
        page.respond = self._dashboard.respond

    def _find_frame(self, browser: str, x: float, y: float) -> tuple[str, Pose] | None:
        """Return the frame below the pointer of a browser, as found between two pictures; None within `HOVER_S`."""
        found: Future[tuple[str, Pose] | None] = Future()

        def find() -> None:
            client = self._server.find_client(browser)
            frame = None if client is None else self._scene.find_frame(client.camera, x, y, HOVER_DISTANCE)
            found.set_result(frame)

        self._actions.put(find)
        try:
            return found.result(HOVER_S)
        except TimeoutError:
            return None

    def _change_time(self, change: Callable[[TimePanel], object]) -> None:
        if self._time is not None:
            self._actions.put(partial(change, self._time))

    def _pick(self, frame: str, is_reference: bool) -> None:
        self._actions.put(lambda: self._query.pick(frame, is_reference))
        if self._editor is not None and not is_reference:
            self._actions.put(partial(self._editor.select, GeometryItem(ItemKind.FRAME, frame)))

    def run(self, is_stopped: Callable[[], bool]) -> None:
        """Draw pictures until `is_stopped`."""
        # what the libraries left is not searched again and again: of 12 ms for an answer to the map that took 8
        gc.freeze()
        before = time.monotonic()
        while not is_stopped():
            now = time.monotonic()
            self.draw(now, now - before)
            before = now
            time.sleep(max(PICTURE_S - (time.monotonic() - now), 0.002))
        self._query.close()
        if self._editor is not None:
            self._editor.close()

    def _execute(self, action: Callable[[], object]) -> None:
        """Execute an action of the page. An error of this program does not end it: changes may not be saved yet."""
        try:
            action()
        except Exception as error:
            traceback.print_exc()
            text = f"{type(error).__name__}: {error}. Details are where modelserver view was started."
            for client in self._server.get_clients().values():
                client.add_notification("Internal error; nothing was done", text, color="red")

    def draw(self, now: float, seconds: float) -> None:
        """Draw one picture, `seconds` after the last one."""
        while not self._actions.empty():
            self._execute(self._actions.get())
        if self._editor is not None:
            self._editor.update(now)
        source, display = self._source, self._display
        with source.lock:
            drive = source.drive
            utime = 0
            if self._time is not None:
                self._time.advance(drive, seconds)
                utime = self._time.utime
            picture = drive.get_picture(utime)
            utimes, track = drive.get_track(picture.utime, TRAILS[display.trail.value])
            fixes = drive.get_fixes(picture.utime) if now >= self._next_fixes else None
            origin, (model, base_frame) = drive.origin, drive.get_geometry(utime)
        with self._server.atomic():
            is_loaded = model is not None and model is not self._model
            if model is not None and is_loaded:
                self._set_model(model, base_frame)
            named = (NameLabels(display.labels.value), self._query.frames)
            if named != self._named or now >= self._next_labels:
                self._named, self._next_labels = named, now + LABEL_PERIOD_S
                latest = self._camera.find_latest()
                density = 1.0 if latest is None else self._server.get_density(latest.client)
                self._scene.show_labels(*named, latest, density)
                if latest is not None:
                    self._scene.scale_axes(latest, density)
            center, is_following = self._scene.center, display.follow.value
            self._scene.show(picture, is_following)
            if self._balance is not None:
                self._balance.update(picture.joints, self._scene.size)
            if is_following != self._is_following:
                self._is_following = is_following
                self._camera.move(self._scene.center - center)
            self._scene.show_trail(utimes, track)
            if fixes is not None:
                self._next_fixes = now + FIX_PERIOD_S
                self._scene.show_fixes(*fixes)
            if now >= self._next_uncertainty:
                self._next_uncertainty = now + UNCERTAINTY_PERIOD_S
                confidence = int(display.confidence.value.split()[0])
                self._scene.show_uncertainty(picture, confidence, display.uncertainty.value)
            self._scene.label_grid(picture, origin)
            self._camera.update(is_loaded)
        is_playing = self._time is not None and self._time.is_playing
        places = {}
        if picture.pose is not None and (frame := self._scene.get_frame_pose(self._query.frames[0])) is not None:
            places[self._query.frames[0]] = (picture.pose @ frame).xyz
        self._dashboard.shown = Shown(utime, is_playing, TRAILS[display.trail.value], places)
        if now >= self._next_slider and self._time is not None:
            self._next_slider = now + SLIDER_PERIOD_S
            self._time.show()
        if now >= self._next_state and self._state is not None:
            self._next_state = now + STATE_PERIOD_S
            clock = time.time_ns() // 1000 if source.is_live else 0
            with source.lock:
                self._state.show(drive, picture, utime, clock)
                is_silent = source.is_live and bool(drive.find_silence(clock))
            self._show_title("no message" if is_silent else "")
        if self._query.update(utime, now, picture.utime):
            self._scene.highlight_path(self._query.path)

    def _show_title(self, note: str) -> None:
        title = f"ModelServer: {self._source.title}{f' - {note}' if note else ''}"
        if title != self._title:
            self._title = title
            self._server.gui.set_panel_label(title)

    def _set_model(self, model: Model, base_frame: str) -> None:
        self._scene.set_model(model, base_frame)
        self._named = None
        self._model = model
        self._query.set_model(model, base_frame)
        if self._joints is not None:
            self._joints.set_model(model)
        if self._balance is not None:
            self._balance.set_model(model, base_frame)
        if self._editor is not None:
            self._editor.show_gizmo()
        self._notes.content = describe_unread(self._scene.unread)


def describe_unread(unread: Mapping[str, Sequence[str]]) -> str:
    """Return the meshes that are not drawn, by the reason, as Markdown."""
    if not unread:
        return ""
    parts = [f"Meshes that are not drawn: {sum(map(len, unread.values()))}"]
    for reason, files in unread.items():
        # a long path is broken at its slashes: a page cuts what is wider than the panel
        rows = "\n".join(f"- {escape_markdown(each).replace('/', '/<wbr>')}" for each in files)
        parts.append(f"**{escape_markdown(reason).replace('/', '/<wbr>')}**\n\n{rows}")
    return "\n\n".join(parts)


# --- panels


class QueryPanel:
    """Two frames, and where one is in the other: transformation, uncertainty, motion, and the path with its shares.

    Queries run in a thread of their own: those of a log read it, which may take a second.
    """

    def __init__(self, gui: viser.GuiApi, source: Source):
        self._source = source
        self._executor = ThreadPoolExecutor(1, "query")
        self._running: Future[tuple[str, str, tuple[str, ...]]] | None = None
        self._last_query: tuple[object, ...] = ()
        self._queried_at = -math.inf
        self.path: tuple[str, ...] = ()
        """Frames on the path of the shown answer."""
        gui.add_markdown("Click an axis or a body in the scene: **frame**. With Shift: **in**.")
        self._interest: Any = gui.add_dropdown("Frame", ("",))
        self._reference: Any = gui.add_dropdown("in", ("",))
        exchange = gui.add_button("Exchange")
        exchange.on_click(lambda _: self.set_frames(self._reference.value, self._interest.value))
        self._answer = gui.add_markdown("")
        with gui.add_folder("Copy", expand_by_default=False):
            self._code = gui.add_markdown("")

    def set_model(self, model: Model, base_frame: str) -> None:
        """Offer the frames of a model."""
        frames = [frame.full_name for body in model.bodies for frame in body]
        chosen = (self._interest.value, self._reference.value)
        for dropdown in (self._interest, self._reference):
            dropdown.options = (*frames, *WORLDS)
        offered = (frames[-1] if frames else WORLDS[0], base_frame or WORLDS[0])
        self.set_frames(*[old if old in (*frames, *WORLDS) else new for old, new in zip(chosen, offered, strict=True)])

    @property
    def frames(self) -> tuple[str, str]:
        return self._interest.value, self._reference.value

    def set_frames(self, interest: str, reference: str) -> None:
        self._interest.value, self._reference.value = interest, reference

    def pick(self, frame: str, is_reference: bool) -> None:
        (self._reference if is_reference else self._interest).value = frame

    def update(self, utime: int, now: float, state: object) -> bool:
        """Query again where the frames or the time changed; return whether the shown answer changed.

        `utime` is 0 for the latest; `state` differs where the answer to the same query may.
        """
        if self._running is not None:
            if not self._running.done():
                return False
            text, code, self.path = self._running.result()
            self._running = None
            self._answer.content, self._code.content = text, code
            return True
        query = (self._interest.value, self._reference.value, utime, state)
        if query == self._last_query or now - self._queried_at < QUERY_PERIOD_S or not self._interest.value:
            return False
        self._last_query, self._queried_at = query, now
        self._running = self._executor.submit(self._run_query, self._interest.value, self._reference.value, utime)
        return False

    def _run_query(self, interest: str, reference: str, utime: int) -> tuple[str, str, tuple[str, ...]]:
        """Return the answer, the code of the query, and the frames of the path."""
        answers = self._source.answers
        code = format_code(interest, reference, utime, None)
        try:
            explanation = answers.explain(interest, reference, at=utime, policy=Policy.INTERPOLATED)
        except (ModelServerError, OSError) as error:
            near = f" Nearest: {', '.join(error.nearest)}" if isinstance(error, QueryError) and error.nearest else ""
            return f"**No answer:** {escape_markdown(str(error))}.{escape_markdown(near)}", code, ()
        motion = None
        try:
            if self._source.set_joints is None:
                motion = answers.get_motion(interest, reference, at=utime)
        except (ModelServerError, OSError):
            # not every pair at every time has one; the pose has its own reasons
            pass
        frames = [reference]
        for edge in explanation.edges:
            frames += edge.ends if edge.forward else edge.ends[::-1]
        text = describe_answer(explanation, motion)
        return text, format_code(interest, reference, utime, explanation.answer), (*frames, interest)

    def close(self) -> None:
        self._executor.shutdown(wait=False, cancel_futures=True)


def describe_answer(explanation: Explanation, motion: MotionAnswer | None) -> str:
    answer = explanation.answer
    found = answer.transformation
    values = (*found.pose.xyz, *map(math.degrees, found.rpy))
    sigmas = ["unknown"] * 6
    if found.covariance is not None:
        known = zip(_list_sigmas(found.covariance), ("m",) * 3 + ("deg",) * 3, strict=True)
        sigmas = [f"{sigma:.4f} {unit}" for sigma, unit in known]
    formats = ("{:.4f} m",) * 3 + ("{:.3f} deg",) * 3
    rows = [
        (name, form.format(value + 0.0), sigma)
        for name, form, value, sigma in zip(POSE_NAMES, formats, values, sigmas, strict=True)
    ]
    parts = [format_table(("", "value", "sigma"), rows)]
    if answer.geodetic is not None:
        place = answer.geodetic
        heading = "" if math.isnan(place.heading_deg) else f", heading {place.heading_deg:.2f} deg"
        parts.append(f"{place.latitude_deg:.8f}, {place.longitude_deg:.8f} deg, height {place.height:.2f} m{heading}")
    if math.isfinite(answer.horizontal_protection_level):
        degrees = math.degrees(answer.heading_protection_level)
        parts.append(f"Protection level {answer.horizontal_protection_level:.2f} m, heading {degrees:.2f} deg")
    if not found.is_valid:
        parts.append(f"**Not valid:** {escape_markdown(Invalid(found.invalid_reasons).explain())}")
    flags = [flag.name or "" for flag in Quality if flag in answer.quality]
    if flags:
        parts.append(f"Flags: {escape_markdown(', '.join(flags))}")
    if motion is not None:
        turn_rate = [math.degrees(each) for each in motion.angular_velocity]
        moving = [
            (name, *(f"{value + 0.0:.3f}" for value in values), unit)
            for name, values, unit in (("velocity", motion.velocity, "m/s"), ("turn rate", turn_rate, "deg/s"))
        ]
        parts.append(format_table(("motion", "x", "y", "z", ""), moving))
    # a joint has the name of its constraint
    edges = [
        (
            f"joint {each.name}" if each.kind == "joint" else each.name,
            _format_known(100.0 * each.position_share, " %"),
            _format_known(100.0 * each.rotation_share, " %"),
        )
        for each in explanation.edges
    ]
    if edges:
        parts.append(format_table(("path", "position", "rotation"), edges))
        parts.append("Shares are of the variance.")
    return "\n\n".join(parts)


def _list_sigmas(covariance: Array) -> list[float]:
    variances = np.maximum(np.diag(covariance), 0.0)
    return list(map(float, np.sqrt(variances) * np.repeat((1.0, math.degrees(1.0)), 3)))


def _format_known(value: float, unit: str = "") -> str:
    return "-" if math.isnan(value) else f"{value:.1f}{unit}"


def format_code(interest: str, reference: str, utime: int, answer: PoseAnswer | None) -> str:
    """Return the query in Python and for the command line, and the answer in YAML, as code blocks."""
    at = f", at={utime}" if utime else ""
    blocks = [
        ("python", f"platform.get_pose({_quote(interest)}, {_quote(reference)}{at})"),
        (
            "shell",
            f"modelserver query {_quote_shell(interest)} {_quote_shell(reference)}{f' --at {utime}' if utime else ''}",
        ),
    ]
    if answer is not None:
        found = answer.transformation
        xyz, rpy = (
            ", ".join(f"{value + 0.0:.6g}" for value in each) for each in (found.pose.xyz, map(math.degrees, found.rpy))
        )
        lines = [f"xyz: [{xyz}]", f"rpy_deg: [{rpy}]"]
        if found.covariance is not None:
            sigmas = _list_sigmas(found.covariance)
            meters, degrees = (", ".join(f"{each:.4g}" for each in part) for part in (sigmas[:3], sigmas[3:]))
            lines.append(f"sigma: {{xyz: [{meters}], rpy_deg: [{degrees}]}}")
        blocks.append(("yaml", "\n".join(lines)))
    return "\n\n".join(f"```{language}\n{text}\n```" for language, text in blocks)


def _quote(name: str) -> str:
    return json.dumps(name, ensure_ascii=False)


def _quote_shell(name: str) -> str:
    return f"'{name}'" if "'" not in name else shlex.quote(name)


class TimePanel:
    """The time that is shown: a slider over the drive, playback, and jumps to events.

    `utime` is 0 while the newest picture of a live drive is followed.
    """

    def __init__(self, gui: viser.GuiApi, is_live: bool, actions: Actions):
        self._begin = 0
        self._end = 0
        self._at = 0.0
        self._shown_at = math.nan
        self._is_settled = False
        self.is_playing = False
        self._drive: Drive | None = None
        self._clock = gui.add_markdown("")
        self._slider: Any = gui.add_slider("Time (s)", 0.0, 1.0, 0.05, 0.0)
        actions.on_update(self._slider, lambda: self.jump(self._slider.value))
        self._play = actions.add_button(gui, "Play", self.toggle)
        self._speed = gui.add_dropdown("Speed", SPEEDS, initial_value="1x")
        self._follow: Any = gui.add_checkbox("Live", is_live, visible=is_live)
        with gui.add_folder("Events"):
            self._kind = gui.add_dropdown("Kind", (ALL, *EventKind))
            actions.add_button(gui, "Previous", lambda: self._jump_to_event(-1))
            actions.add_button(gui, "Next", lambda: self._jump_to_event(1))
            self._events = gui.add_markdown("")

    @property
    def utime(self) -> int:
        return 0 if self._follow.value else self._here

    @property
    def _here(self) -> int:
        return self._begin + round(self._at * 1e6)

    def jump(self, seconds: float) -> None:
        """Show the time so many seconds after the begin of the drive."""
        self._at = min(max(seconds, 0.0), (self._end - self._begin) * 1e-6)
        self._follow.value = False

    def toggle(self) -> None:
        """Play or pause; playing from the end begins again."""
        self.is_playing = not self.is_playing
        if self.is_playing and self._at >= (self._end - self._begin) * 1e-6 - 0.05:
            self.jump(0.0)
        self._play.label = "Pause" if self.is_playing else "Play"

    def play(self, is_playing: bool) -> None:
        if is_playing != self.is_playing:
            self.toggle()

    def follow(self) -> None:
        """Show the newest picture of a live drive, and those that come."""
        self._follow.value = self._follow.visible

    def _list_events(self) -> list[DriveEvent]:
        wanted = self._kind.value
        events = sorted(self._drive.events if self._drive else [], key=lambda each: each.utime)
        return [each for each in events if wanted in (ALL, each.kind)]

    def _jump_to_event(self, direction: int) -> None:
        distances = [each.utime - self._here for each in self._list_events()]
        later = [each for each in distances if each * direction > 1_000]
        if later:
            if self.is_playing:
                self.toggle()
            self.jump((self._here + min(later, key=abs) - self._begin) * 1e-6)

    def advance(self, drive: Drive, seconds: float) -> None:
        """Continue playback after `seconds` of wall time, over a drive that may have become longer."""
        self._drive = drive
        begin, end = drive.begin, drive.end
        if self._begin and begin != self._begin:
            self._at += (self._begin - begin) * 1e-6
        self._begin, self._end = begin, end
        length = max((end - begin) * 1e-6, 0.1)
        if self._follow.value:
            self._at = length
        elif self.is_playing:
            self._at = min(self._at + seconds * float(self._speed.value.rstrip("x")), length)
            if self._at >= length:
                self.toggle()

    def show(self) -> None:
        """Update slider, clock and events."""
        length = max((self._end - self._begin) * 1e-6, 0.1)
        if abs(self._slider.max - length) > 0.5:
            self._slider.max = math.ceil(length * 20.0) / 20.0
        if self._at != self._shown_at or not self._is_settled:
            # sent again once it stays: a browser may have moved the slider while another value was underway to it
            self._is_settled = self._at == self._shown_at
            self._shown_at = self._at
            value = round(min(self._at, self._slider.max) * 20.0) / 20.0
            if self._is_settled:
                self._slider.value = value + 0.05
            self._slider.value = value
        here = self._here if self._begin else 0
        when = datetime.fromtimestamp(here * 1e-6, UTC).isoformat(sep=" ", timespec="milliseconds") if here else ""
        clock = f"**{self._at:.2f} s** of {length:.1f} s  \n{when}"
        self._clock.content = clock if here else "no pose and no joints yet"
        events = self._list_events()
        before = [each for each in events if each.utime <= here][-SHOWN_EVENTS:]
        after = [each for each in events if each.utime > here][:2]
        rows = [
            (f"{(each.utime - self._begin) * 1e-6:.2f}", each.kind, each.text + f" ({each.count}x)" * (each.count > 1))
            for each in (*before, *after)
        ]
        self._events.content = format_table(("s", "event", ""), rows) if rows else "none"


class StatePanel:
    """Validity in words, sensors with ages and rates, drivers, findings, and the states of the filter."""

    def __init__(self, gui: viser.GuiApi):
        self._validity = gui.add_markdown("no report yet")
        with gui.add_folder("Sensors and channels"):
            self._channels = gui.add_markdown("")
        with gui.add_folder("Findings"):
            self._findings = gui.add_markdown("")
        with gui.add_folder("Filter", expand_by_default=False):
            self._states = gui.add_markdown("")

    def show(self, drive: Drive, picture: Picture, utime: int, now: int = 0) -> None:
        """Show the state at a time, 0 for the newest. `now` is the time that ages are counted to, 0 in a log."""
        health: Health | None = drive.get_report("MODELSERVER_HEALTH", utime)
        state = "**invalid:** " + escape_markdown(picture.invalid.explain()) if picture.invalid else "**valid**"
        text = "no pose" if picture.pose is None else f"The pose is {state}"
        silent = drive.find_silence(now) if now and not utime else ""
        if silent:
            text = f"**{escape_markdown(silent)}**\n\nBefore: {text[:1].lower() + text[1:]}"
        if health is not None:
            rows = [(line[:9].strip(), line[9:].strip()) for line in format_body(health).splitlines()]
            text += f"\n\n{format_table(('', ''), rows)}"
        self._validity.content = text
        earlier = drive.get_report("MODELSERVER_HEALTH", health.utime - RATE_PERIOD_US) if health is not None else None
        parts = [] if health is None else [_format_sensors(health, earlier)]
        self._channels.content = "\n\n".join([*parts, _format_channels(drive, now)])
        findings = [(subject, text) for subject, text in health.warnings] if health is not None else []
        rejected = [(what, f"{reason}: {count}") for what, reason, count in health.rejected] if health else []
        parts = [format_table(("", "finding"), findings) if findings else "no finding"]
        if rejected:
            parts.append(format_table(("rejected", "reason"), rejected))
        self._findings.content = "\n\n".join(parts)
        navigation = drive.get_report("LOCALIZATION_STATE", utime)
        self._states.content = "no state published" if navigation is None else _format_states(navigation)


def _format_sensors(health: Health, earlier: Health | None) -> str:
    """Format the sensors of a report, with rates since an earlier one, as of the report alone where there is none."""
    before = {each.channel: each.count for each in earlier.channels} if earlier is not None else {}
    seconds = (health.utime - earlier.utime) * 1e-6 if earlier is not None else 0.0
    rows = []
    for each in health.channels:
        if each.channel.startswith("command:"):
            continue
        # less after a restart of the service
        has_rate = seconds > 0.0 and each.count >= before.get(each.channel, each.count + 1)
        rate = (each.count - before[each.channel]) / seconds if has_rate else each.rate_hz
        age = "never" if math.isnan(each.age) else format_duration(each.age)
        rows.append(
            (
                each.channel.removeprefix("sensor:"),
                f"{rate:.1f}",
                f"{age}, silent" if each.silent and each.count else age,
                f"{each.used} of {each.measured}" if each.measured else "-",
            )
        )
    return format_table(("sensor", "Hz", "age", "used"), rows) if rows else "no sensor"


def _format_channels(drive: Drive, now: int) -> str:
    """Format the channels of the bus: live with age and rate, in a log with the mean rate of all of it."""
    found = [(name, each) for name, each in sorted(drive.channels.items()) if not name.startswith("REPLY_")]
    if now:
        header = ("channel", "Hz", "age", "count")
        rows = [
            (name, _format_known(each.rate), format_duration(max(now - each.last, 0) * 1e-6), str(each.count))
            for name, each in found
        ]
    else:
        header = ("channel", "mean Hz", "count", "")
        rows = [(name, _format_known(each.mean_rate), str(each.count), "") for name, each in found]
    parts = [format_table(header, rows) if rows else "no message"]
    drivers = [(each.source, each.phase.name.lower(), f"{each.rate_hz:.1f} Hz") for each in drive.drivers.values()]
    if drivers:
        parts.append(format_table(("driver", "phase", "rate"), sorted(drivers)))
    return "\n\n".join(parts)


def _format_states(navigation: Any) -> str:
    count = len(navigation.names)
    rows = []
    for n, (name, value) in enumerate(zip(navigation.names, navigation.values, strict=True)):
        sigma = math.sqrt(max(navigation.covariance[n * (count + 1)], 0.0))
        rows.append((name, f"{value:.4g}", f"{sigma:.3g}"))
    return format_table(("state", "value", "sigma"), rows[:SHOWN_STATES]) if rows else "no state"


class DisplayPanel:
    """What the scene shows."""

    def __init__(self, gui: viser.GuiApi):
        self.labels = gui.add_dropdown("Names", tuple(NameLabels), initial_value=NameLabels.BODIES)
        self.follow = gui.add_checkbox("Follow the vehicle", True)
        self.uncertainty = gui.add_checkbox("Uncertainty", True, hint="Ellipsoid of the position; protection levels")
        confidences = tuple(f"{each} %" for each in CHI_SQUARE_3)
        self.confidence = gui.add_dropdown("Confidence", confidences, initial_value="95 %")
        self.trail = gui.add_dropdown("Trail", tuple(TRAILS), initial_value="10 min")
        self.shadows: Any = gui.add_checkbox(
            "Shadows", False, hint="And soft light; for a machine with a graphics card"
        )


class JointsPanel:
    """A slider for each coordinate of a geometry file, degrees and meters, within its limits."""

    def __init__(self, gui: viser.GuiApi, source: Source, actions: Actions):
        self._gui = gui
        self._source = source
        self._actions = actions
        self._sliders: dict[str, tuple[Any, float, float]] = {}
        self._folder = gui.add_folder("Positions")

    def set_model(self, model: Model) -> None:
        """Offer the coordinates of a model; those that were moved stay where they are."""
        moved = {
            name: slider.value
            for name, (slider, _, default) in self._sliders.items()
            if not math.isclose(slider.value, default, abs_tol=1e-6)
        }
        old, self._sliders = self._sliders, {}
        with self._folder:
            for name, joint, number in list_coordinates(model):
                self._add_slider(name, joint, number, moved.get(name))
        for slider, *_ in old.values():
            # last: a page hides a folder that was empty for a moment, and may never show it again
            slider.remove()
        if moved.keys() & self._sliders.keys():
            self._apply()

    def _add_slider(self, name: str, joint: Joint, number: int, moved: float | None) -> None:
        is_angle = joint.angle_flags[number]
        scale = math.degrees(1.0) if is_angle else 1.0
        free = math.pi if is_angle else 1.0
        low = max(joint.lower[number], -free) if joint.lower else -free
        high = min(joint.upper[number], free) if joint.upper else free
        lower, upper = low * scale, max(high, low + 1e-6) * scale
        default = min(max(joint.default_position[number] * scale, lower), upper)
        value = default if moved is None else min(max(moved, lower), upper)
        unit, step = ("deg", 0.1) if is_angle else ("m", 0.001)
        slider = self._gui.add_slider(f"{name} ({unit})", lower, upper, step, value)
        self._actions.on_update(slider, self._apply)
        self._sliders[name] = (slider, scale, default)

    def _apply(self) -> None:
        assert self._source.set_joints is not None
        self._source.set_joints({name: slider.value / scale for name, (slider, scale, _) in self._sliders.items()})
