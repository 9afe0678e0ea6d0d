"""The viewer: one page that shows a source, until it is stopped."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable
from functools import partial
from typing import Final

from modelserver.geometry.model import Model
from mstools.edit.document import GeometryItem, ItemKind
from mstools.view.editor import Editing, Editor
from mstools.view.page import Actions, Page
from mstools.view.panels import (
    STATE_PERIOD_S,
    DisplayPanel,
    JointsPanel,
    QueryPanel,
    StatePanel,
    TimePanel,
    escape_markdown,
)
from mstools.view.scene import NameLabels, VehicleScene
from mstools.view.sources import Source

PICTURE_S: Final = 1.0 / 30.0
"""Period of pictures, seconds."""

SLIDER_PERIOD_S: Final = 0.2
"""Period at which slider and clock follow playback, seconds."""

FIX_PERIOD_S: Final = 0.5
"""Period at which the fixes follow, seconds: all of them are sent to the browser again."""


class Viewer:
    """Show a source on a page. `run` draws picture after picture; callbacks of the page are executed between them."""

    def __init__(self, page: Page, source: Source, editing: Editing | None = None):
        self._source = source
        self._server = page.server
        self._actions = Actions()
        self._model: Model | None = None
        self._named: tuple[NameLabels, tuple[str, str]] | None = None
        self._next_slider = self._next_state = self._next_fixes = 0.0
        gui = page.server.gui
        gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
        gui.main_panel.dock_right()
        self._title = ""
        self._show_title("")
        self._scene = VehicleScene(page.server, source.folder, self._pick)
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
        self._editor: Editor | None = None
        if source.set_model is not None:
            if editing is not None:
                with tabs.add_tab("Edit"):
                    self._editor = Editor(page.server, self._scene, editing, self._actions, source.set_model)
            with tabs.add_tab("Joints"):
                self._joints = JointsPanel(gui, source, self._actions)
        with tabs.add_tab("Display"):
            self._display = DisplayPanel(gui)
            self._notes = gui.add_markdown("")

    def _pick(self, frame: str, is_reference: bool) -> None:
        self._actions.put(lambda: self._query.pick(frame, is_reference))
        if self._editor is not None and not is_reference:
            self._actions.put(partial(self._editor.select, GeometryItem(ItemKind.FRAME, frame)))

    def run(self, is_stopped: Callable[[], bool]) -> None:
        """Draw pictures until `is_stopped`."""
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
            utimes, track = drive.get_track(picture.utime, display.trail_s)
            fixes = drive.get_fixes(picture.utime) if now >= self._next_fixes else None
            origin, (model, base_frame) = drive.origin, drive.get_geometry(utime)
        with self._server.atomic():
            if model is not None and model is not self._model:
                self._set_model(model, base_frame)
            if (named := (display.labels, self._query.frames)) != self._named:
                self._named = named
                self._scene.show_labels(*named)
            self._scene.follow = display.follow
            self._scene.show(picture)
            self._scene.show_trail(utimes, track)
            if fixes is not None:
                self._next_fixes = now + FIX_PERIOD_S
                self._scene.show_fixes(*fixes)
            self._scene.show_uncertainty(picture, display.confidence, display.uncertainty)
            self._scene.label_grid(picture, origin)
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
        size = self._scene.set_model(model, base_frame, self._display.labels)
        self._named = None
        if self._model is None:
            self._server.initial_camera.look_at = (0.0, 0.0, 0.0)
            self._server.initial_camera.position = (1.2 * size, 1.6 * size, 1.3 * size)
        self._model = model
        self._query.set_model(model, base_frame)
        if self._joints is not None:
            self._joints.set_model(model)
        if self._editor is not None:
            self._editor.show_gizmo()
        rows = "\n".join(f"- {escape_markdown(each)}" for each in self._scene.unread)
        self._notes.content = f"Meshes that are not drawn:\n\n{rows}" if rows else ""
