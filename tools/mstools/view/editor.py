"""The page's editor of a geometry file: what is selected, its fields, the gizmo, problems, saving and applying.

All changes go through an `EditSession`. Callbacks of the page run in threads of their own; they only queue an action,
which the viewer executes between two pictures.
"""

from __future__ import annotations

import queue
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Final

import viser

from modelserver.client.remote import Platform
from modelserver.errors import ModelServerError, Problem, QueryError, Severity
from modelserver.geometry import names
from modelserver.geometry.model import Model
from modelserver.geometry.placement import PlacementError
from modelserver.messages import ReloadReply
from modelserver.transforms.pose import Pose
from mstools.edit.document import EditSession, GeometryDocument, GeometryItem, ItemKind
from mstools.view.item_fields import ItemFields, Snap, list_frames
from mstools.view.panels import escape_markdown
from mstools.view.placing import PlacePanel
from mstools.view.scene import VehicleScene

SHOWN_PROBLEMS: Final = 8
MAX_LABEL: Final = 60
LOOK_PERIOD_S: Final = 2.0
"""Period at which the file is compared with what was read, seconds."""

Change = Callable[[GeometryDocument], GeometryDocument]


@dataclass(frozen=True)
class Editing:
    """What is edited, and how the running service is reached; an empty key is that of the environment."""

    session: EditSession
    url: str = ""
    prefix: str = ""
    timeout: float = 2.0
    key: str = ""

    def reload(self, dry_run: bool) -> ReloadReply:
        """Reload the geometry file in the service. Raises as `Platform.reload_model`."""
        with Platform(
            self.url, channel_prefix=self.prefix, timeout=self.timeout, retries=0, name="view", key_file=self.key
        ) as platform:
            return platform.reload_model(dry_run=dry_run)


class Editor:
    """The tab that edits.

    Parameters
    ----------
    show : called with the model after each change without an error
    """

    def __init__(
        self,
        server: viser.ViserServer,
        scene: VehicleScene,
        editing: Editing,
        actions: queue.SimpleQueue[Callable[[], None]],
        show: Callable[[Model], None],
    ):
        self._gui = gui = server.gui
        self._scene = scene
        scene.is_edited = True
        self._session = session = editing.session
        self._editing = editing
        self._actions = actions
        self._show = show
        self._shown = session.drawn
        self._item: GeometryItem | None = None
        self._executor = ThreadPoolExecutor(1, "reload")
        self._reloading: tuple[bool, Future[ReloadReply]] | None = None
        self._next_look = 0.0
        self._is_outdated = False
        self._buttons: list[Any] = []
        self._status = gui.add_markdown("")
        self._message = gui.add_markdown("")
        self._undo = self._add_button("Undo", lambda: self._step(session.undo))
        self._redo = self._add_button("Redo", lambda: self._step(session.redo))
        self._save = self._add_button("Save ...", self._ask_save)
        self._apply = self._add_button("Apply to the service ...", self._ask_apply)
        self._add_button("Read the file again", self._ask_read)
        self._problems = gui.add_folder("Problems")
        with self._problems:
            self._problem_texts = gui.add_markdown("")
        self._kind: Any = gui.add_dropdown("Kind", tuple(ItemKind), initial_value=ItemKind.FRAME)
        self._name: Any = gui.add_dropdown("Item", ("",))
        self._kind.on_update(lambda event: self._queue(event, lambda: self._select_first(ItemKind(event.target.value))))
        self._name.on_update(
            lambda event: self._queue(
                event, lambda: self.select(GeometryItem(ItemKind(self._kind.value), event.target.value))
            )
        )
        self._fields = ItemFields(server, session, self._change_item, actions)
        with gui.add_folder("Gizmo", expand_by_default=False):
            self._gizmo: Any = gui.add_checkbox("Gizmo", True, hint="Drag arrows to move, arcs to turn")
            self._snap: Any = gui.add_dropdown("Snap", tuple(Snap), initial_value=Snap.NONE)
            self._gizmo.on_update(lambda event: self._queue(event, self.show_gizmo))
        with gui.add_folder("Add, copy, delete", expand_by_default=False):
            self._new: Any = gui.add_text("New name", "")
            self._add_button("Add body", lambda: self._add(ItemKind.BODY))
            self._add_button("Add frame to the body", lambda: self._add(ItemKind.FRAME))
            self._add_button("Add constraint", lambda: self._add(ItemKind.CONSTRAINT))
            self._add_button("Duplicate", self._duplicate)
            self._add_button("Delete", self._delete)
        with gui.add_folder("Place by measurement", expand_by_default=False):
            self._place = PlacePanel(gui, session, self._change_item, actions)
        with gui.add_folder("As text", expand_by_default=False):
            self._text: Any = gui.add_text("YAML", "", multiline=True)
            self._add_button("Write text", self._write_text)
        self._select_first(ItemKind.FRAME)
        self._refresh()

    # --- from the page

    def _queue(self, event: Any, action: Callable[[], None]) -> None:
        """Queue an action of the page; values that this program sets have no client."""
        if event.client_id is not None:
            self._actions.put(action)

    def _add_button(self, label: str, action: Callable[[], None]) -> Any:
        button = self._gui.add_button(label)
        button.on_click(lambda _: self._actions.put(action))
        return button

    # --- selection

    def select(self, item: GeometryItem) -> None:
        """Select what is edited."""
        if self._item is not None and item != self._item and not self._fields.commit():
            # what was typed is not lost: it stays until it can be set
            self._kind.value, self._name.value = self._item.kind, self._item.name
            return
        items = self._session.document.list_items()
        if item not in items:
            return
        self._item = item
        self._kind.value = item.kind
        self._name.options = tuple([each.name for each in items if each.kind is item.kind])
        self._name.value = item.name
        self._show_item()

    def _select_first(self, kind: ItemKind) -> None:
        found = next((each for each in self._session.document.list_items() if each.kind is kind), None)
        if found is None:
            self._report(f"there is no {kind} yet; add one below")
            self._kind.value = self._item.kind if self._item is not None else ItemKind.BODY
        else:
            self.select(found)

    def _show_item(self) -> None:
        """Show the fields, the text and the gizmo of what is selected."""
        assert self._item is not None
        self._fields.show(self._item)
        self._place.show(self._item)
        self._text.value = self._session.document.get_yaml(self._item)
        self.show_gizmo()

    def _refresh(self) -> None:
        """Show the session as it is after a change."""
        session = self._session
        self._next_look = 0.0
        self._show_status()
        for button, name, change in (
            (self._undo, "Undo", session.undo_name),
            (self._redo, "Redo", session.redo_name),
        ):
            button.label = f"{name}: {change}"[:MAX_LABEL] if change else name
            button.disabled = not change
        self._save.disabled = not session.is_changed or session.has_errors
        self._apply.disabled = session.is_changed
        self._show_problems()
        items = session.document.list_items()
        if self._item not in items:
            kind = self._item.kind if self._item is not None else ItemKind.FRAME
            self._item = next((each for each in items if each.kind is kind), items[0])
        assert self._item is not None
        self.select(self._item)
        if session.model is not None and session.model is not self._shown:
            self._shown = session.drawn
            self._show(session.model)

    def _show_status(self) -> None:
        """Show whether there is something to save, and what is against it."""
        session = self._session
        errors = sum(each.severity is Severity.ERROR for each in session.problems)
        state = "not saved" if session.is_changed else "saved"
        if errors:
            state += f"; {errors} error{'' if errors == 1 else 's'}: cannot be saved, and the scene shows " + (
                "the last model" if session.model is not None else "the bodies, not joined"
            )
        if self._is_outdated:
            state += ". **The file changed meanwhile on disk:** read it again before you go on"
        self._status.content = f"**{escape_markdown(session.file.path.name)}**: {state}"

    def _show_problems(self) -> None:
        for button in self._buttons:
            button.remove()
        self._buttons = []
        found = sorted(self._session.problems, key=lambda each: list(Severity).index(each.severity))
        shown = [each for each in found if each.severity is not Severity.NOTE][:SHOWN_PROBLEMS]
        notes = sum(each.severity is Severity.NOTE for each in found)
        more = len(found) - len(shown) - notes
        lines = [f"- {_describe(each)}" for each in shown] + [f"- and {more} more"] * bool(more)
        text = "\n".join(lines) or "none"
        if notes:
            text += f"\n\n{notes} note{'' if notes == 1 else 's'}: modelserver check --notes"
        self._problem_texts.content = text
        with self._problems:
            for number, problem in enumerate(shown, 1):
                culprit = self._session.find_culprit(problem)
                if culprit is not None:
                    self._buttons.append(
                        self._add_button(f"{number}: {culprit.name}", lambda item=culprit: self.select(item))  # type: ignore[misc]
                    )

    def _report(self, text: str) -> None:
        self._message.content = escape_markdown(text) if text else ""

    # --- changes

    def _do(self, action: Callable[[], object]) -> bool:
        """Execute an action; show why it cannot be done, if so."""
        try:
            action()
        except (ModelServerError, PlacementError, OSError) as error:
            near = f"; nearest: {', '.join(error.nearest)}" if isinstance(error, QueryError) and error.nearest else ""
            self._report(f"not done: {error}{near}")
            return False
        self._report("")
        return True

    def _step(self, action: Callable[[], None]) -> None:
        self._do(action)
        self._refresh()

    def _change(self, name: str, change: Change, new: GeometryItem | None = None) -> bool:
        """Make a change, after which `new` is selected."""
        if not self._do(lambda: self._session.change(name, change)):
            return False
        if new is not None:
            self._item = new
        self._refresh()
        return True

    def _change_item(self, change: Change, new: GeometryItem | None = None) -> bool:
        """Make a change of what is selected; return whether it could be made."""
        assert self._item is not None
        return self._change(f"edit {self._item.name}", change, new)

    def _add(self, kind: ItemKind) -> None:
        name = self._new.value.strip()
        item = self._item
        assert item is not None
        frames = list_frames(self._session.document)
        if kind is ItemKind.BODY:
            self._change(f"add {name}", lambda document: document.add_body(name), GeometryItem(kind, name))
        elif kind is ItemKind.FRAME:
            body = item.name.partition(":")[0] if item.kind is not ItemKind.CONSTRAINT else frames[0].partition(":")[0]
            new = GeometryItem(kind, names.join(body, name))
            self._change(f"add {new.name}", lambda document: document.add_frame(body, name), new)
        else:
            from_ = item.name if item.kind is ItemKind.FRAME else frames[0]
            others = [each for each in frames if each.partition(":")[0] != from_.partition(":")[0]]
            if not others:
                self._report("not done: a constraint joins two bodies, and there is only one")
                return
            to = others[-1]
            self._change(
                f"add {name}", lambda document: document.add_constraint(name, from_, to), GeometryItem(kind, name)
            )

    def _duplicate(self) -> None:
        item = self._item
        assert item is not None
        plain = item.name.rpartition(":")[2]
        name = self._new.value.strip() or _find_free_name(self._session.document, item)
        new = GeometryItem(item.kind, item.name.removesuffix(plain) + name)
        self._change(f"duplicate {item.name}", lambda document: document.duplicate(item, name), new)

    def _delete(self) -> None:
        item = self._item
        assert item is not None
        in_template = self._fields.in_template
        self._change(f"delete {item.name}", lambda document: document.delete(item, in_template))

    def _write_text(self) -> None:
        item, text = self._item, self._text.value
        assert item is not None
        self._change(f"write {item.name}", lambda document: document.set_yaml(item, text))

    # --- gizmo

    def show_gizmo(self) -> None:
        """Show the gizmo at what is selected, where the scene has it."""
        place = self._fields.find_place()
        if not self._gizmo.value or place is None:
            self._scene.hide_gizmo()
            return
        body, parent, pose = place
        self._scene.show_gizmo(body, parent, pose, self._drag)

    def _drag(self, pose: Pose, is_end: bool) -> None:
        """Follow the gizmo: the fields while it moves, a change when it is released. Called in the page's thread."""
        self._actions.put(lambda: self._fields.set_dragged(pose, Snap(self._snap.value), is_end))

    # --- saving and applying

    def _ask_save(self) -> None:
        """Show what would be saved, with what was typed and not set yet."""
        if not self._fields.commit():
            return
        diff, shown = self._session.make_diff(), self._session.document
        modal = self._gui.add_modal(f"Save {self._session.file.path.name}")
        with modal:
            # longer than what the file may have
            fence = "`" * (3 + diff.count("`"))
            self._gui.add_markdown(f"{fence}diff\n{diff}\n{fence}")
            self._add_button("Save", lambda: self._confirm(modal, lambda: self._write_file(shown)))
            self._add_button("Cancel", modal.close)

    def _ask_read(self) -> None:
        """Read the file again, after a question if changes would be lost."""
        if not self._session.is_changed:
            self._step(self._session.read)
            return
        modal = self._gui.add_modal("Read the file again")
        with modal:
            self._gui.add_markdown("The changes that are not saved are dropped.")
            self._add_button("Drop them", lambda: self._confirm(modal, lambda: self._step(self._session.read)))
            self._add_button("Cancel", modal.close)

    def _write_file(self, shown: GeometryDocument) -> None:
        if self._session.document is not shown:
            # in another tab
            self._report("not saved: the geometry was edited since its difference was shown; look at it again")
        elif self._do(self._session.save):
            self._report(f"saved {self._session.file.path}")
        self._refresh_quietly()

    def _refresh_quietly(self) -> None:
        message = self._message.content
        self._refresh()
        self._message.content = message

    @staticmethod
    def _confirm(modal: Any, action: Callable[[], None]) -> None:
        modal.close()
        action()

    def _ask_apply(self) -> None:
        """Ask the service what a reload would change."""
        self._start_reload(dry_run=True)

    def _start_reload(self, dry_run: bool) -> None:
        if self._reloading is None:
            self._report("asking the service ...")
            self._reloading = dry_run, self._executor.submit(self._editing.reload, dry_run)

    def update(self, now: float) -> None:
        """Show the reply of the service, once it is there, and that the file has changed on disk."""
        if now >= self._next_look:
            self._next_look = now + LOOK_PERIOD_S
            if self._session.has_changed_on_disk() != self._is_outdated:
                self._is_outdated = not self._is_outdated
                self._show_status()
        if self._reloading is None or not self._reloading[1].done():
            return
        (dry_run, future), self._reloading = self._reloading, None
        try:
            reply = future.result()
        except (ModelServerError, OSError) as error:
            self._report(f"not applied: {error}")
            return
        if not dry_run:
            self._report(f"applied: the service has geometry revision {reply.revision}")
            return
        own = self._session.model.revision if self._session.model is not None else ""
        if reply.revision != own:
            self._report(
                f"not applied: the service reads another geometry (revision {reply.revision}, this file {own}); "
                "is its vehicle file the one of this geometry?"
            )
        elif not reply.changes:
            self._report(f"the service has this geometry already, revision {reply.revision}")
        else:
            self._report("")
            modal = self._gui.add_modal("Apply to the running service")
            with modal:
                self._gui.add_markdown("\n".join(f"- {escape_markdown(each)}" for each in reply.changes))
                self._add_button("Apply", lambda: self._confirm(modal, lambda: self._start_reload(dry_run=False)))
                self._add_button("Cancel", modal.close)

    def close(self) -> None:
        self._executor.shutdown(wait=False, cancel_futures=True)


def _describe(problem: Problem) -> str:
    fix = f"; {problem.fix}" if problem.fix else ""
    place = f" ({problem.element})" if problem.element else ""
    return f"**{problem.severity}**: {escape_markdown(problem.message + place + fix)}"


def _find_free_name(document: GeometryDocument, item: GeometryItem) -> str:
    """Return a name for a copy of an item: its own with the first free number."""
    taken = {each.name for each in document.list_items() if each.kind is item.kind}
    plain = item.name.rpartition(":")[2]
    numbers = (f"{plain}{number}" for number in range(2, len(taken) + 3))
    return next(name for name in numbers if item.name.removesuffix(plain) + name not in taken)
