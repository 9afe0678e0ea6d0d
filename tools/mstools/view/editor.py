"""The page's editor of a geometry file: what is selected, its fields, the gizmo, problems, saving and applying.

All changes go through an `EditSession`. Callbacks of the page only queue an action, which the viewer executes between
two pictures. `ItemFields` shows the numbers and texts of an item. Each number has a text field, so that what is typed
stays as it is typed, and a number that was not changed in its field is as exact as it was given. `PlacePanel` computes
a pose from a frame with which it coincides, or from distances to others.

A text field is set when Enter is pressed in it or it is left. viser's page reports neither, and of all changes within
50 ms it sends the last one only, of whatever field: a digit is lost where Tab follows it at once. `COMMIT_SCRIPT`
therefore sends the texts of the fields that were left, through a hidden field, and again after `RESEND_MS`.
"""

from __future__ import annotations

import html
import json
import math
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np
import viser

from modelserver.client.remote import Platform
from modelserver.errors import ModelServerError, Problem, QueryError, Severity, quote
from modelserver.formats.common import format_number, parse_number
from modelserver.geometry import names
from modelserver.geometry.joint import TYPES_WITH_AXIS, Joint, JointType, Mimic
from modelserver.geometry.model import Model
from modelserver.geometry.parts import Body, BodyFrame, Constraint, Sigma
from modelserver.geometry.placement import (
    DistanceFit,
    Placement,
    PlacementError,
    list_measured_points,
    locate_by_distances,
    place_constraint,
    place_frame,
)
from modelserver.messages import ReloadReply
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Vector3
from mstools.edit import SAME_RADIANS, WHOLE_FILE, EditError, EditSession, GeometryDocument, GeometryItem, ItemKind
from mstools.terminal.output import format_count
from mstools.view.page import Actions, escape_markdown, format_table
from mstools.view.scene import VehicleScene

SHOWN_PROBLEMS: Final = 8
LOOK_PERIOD_S: Final = 2.0
"""Period at which the file is compared with what was read, seconds."""

MAX_DISTANCES: Final = 6
NO_CHOICE: Final = "-"

PRECISION: Final = 6
"""Decimals of a field and of a computed placement: micrometers, and millionths of a degree."""

SAME: Final = 10.0**-PRECISION
"""A drag by less has not moved, or turned, what is dragged."""

_INFINITE: Final = {".inf": math.inf, "-.inf": -math.inf}

_MINUS: Final = str.maketrans(dict.fromkeys("\u2212\u2010\u2011\u2012\u2013\u2014\ufe63\uff0d", "-"))
"""Minus signs and dashes that keyboards and other programs write."""

_THOUSANDS: Final = re.compile(r"[+-]?[1-9][0-9]{0,2},[0-9]{3}")
"""What is one number with a decimal comma and another one with a comma between thousands."""

ACCEPTED: Final = "accepted are numbers such as -0.25, 0,25 and 2.5e-2"

_RED: Final = '<div style="color: #e03131; font-size: 0.8em; padding: 0 1em 0.5em">{}</div>'

CARRIER: Final = "typed"
"""Label of the hidden field."""

RESEND_MS: Final = 120
"""More than two periods of 50 ms in which viser's page sends one change."""

COMMIT_SCRIPT: Final = f"""\
const folder = this.closest('.mantine-Paper-root');
if (folder.isWatched) return;
folder.isWatched = true;
const find = (input) => input.closest('.mantine-Flex-root')?.querySelector('label')?.textContent;
const carrier = [...folder.querySelectorAll('input')].find((each) => find(each) === '{CARRIER}');
carrier.closest('.mantine-Flex-root').parentElement.style.display = 'none';
const write = Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, 'value').set;
const typed = new Map(), left = new Map();
let timer;
const send = () => {{
  write.call(carrier, JSON.stringify([Date.now(), ...left.values()]));
  carrier.dispatchEvent(new Event('input', {{bubbles: true}}));
}};
const leave = (input) => {{
  if (!typed.has(input)) return;
  left.set(input, [...typed.get(input), input.value]);
  typed.delete(input);
  send();
  clearTimeout(timer);
  timer = setTimeout(() => {{ send(); left.clear(); }}, {RESEND_MS});
}};
folder.addEventListener('input', (event) => {{
  if (!event.isTrusted) return;
  typed.set(event.target, [folder.querySelector('[data-shown]').dataset.shown, find(event.target)]);
  left.delete(event.target);
}}, true);
folder.addEventListener('focusout', (event) => leave(event.target));
folder.addEventListener('keydown', (event) => {{ if (event.key === 'Enter') leave(event.target); }});"""
"""Executed in the page, in the folder of the fields. Each text is reported with the number and label of its fields.
React regards a value as typed that was written by the setter of all inputs, past its own one, before an event."""

_DIFF_STYLE: Final = "font-family: monospace; font-size: 0.8em; white-space: pre-wrap; overflow-wrap: anywhere"
_DIFF_STYLES: Final = {
    "+": "color: #2b8a3e; background: rgba(64, 192, 87, 0.15)",
    "-": "color: #e03131; background: rgba(250, 82, 82, 0.15)",
    "@": "opacity: 0.6",
}

HINT: Final = "Save shows the changes first. Apply reloads the geometry in the running service, also after a question"

_PIXEL: Final = "data:image/gif;base64,R0lGODlhAQABAIAAAAAAAP///yH5BAEAAAAALAAAAAABAAEAAAIBRAA7"

Change = Callable[[GeometryDocument], GeometryDocument]
ChangeItem = Callable[[Change, GeometryItem | None], str]
"""Makes a change and selects an item; returns why it could not be made, empty if it was."""


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
        actions: Actions,
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
        self._item = self._find_first(ItemKind.FRAME)
        self._executor = ThreadPoolExecutor(1, "reload")
        self._reloading: tuple[bool, Future[ReloadReply]] | None = None
        self._next_look = 0.0
        self._is_outdated = False
        self._buttons: list[Any] = []
        self._status = gui.add_markdown("")
        buttons: dict[str, Callable[[], object]] = {
            "Undo": lambda: self._step(session.undo, session.undo_name, "undone"),
            "Redo": lambda: self._step(session.redo, session.redo_name, "made again"),
            "Save": self._ask_save,
            "Apply": self._ask_apply,
            "Read again": self._ask_read,
        }
        group = gui.add_button_group("Changes", tuple(buttons), hint=HINT)
        group.on_click(lambda event: actions.put(buttons[event.target.value]))
        self._message = gui.add_markdown("")
        self._problems = gui.add_folder("Problems")
        with self._problems:
            self._problem_texts = gui.add_markdown("")
        self._kind: Any = gui.add_dropdown("Kind", tuple(ItemKind), initial_value=ItemKind.FRAME)
        self._name: Any = gui.add_dropdown("Item", ("",))
        actions.on_choice(self._kind, lambda kind: self._select_first(ItemKind(kind)))
        actions.on_choice(self._name, lambda name: self.select(GeometryItem(self._item.kind, name)))
        self._fields = ItemFields(server, session, self._item, self._change_item, actions)
        with gui.add_folder("Gizmo", expand_by_default=False):
            self._gizmo: Any = gui.add_checkbox("Gizmo", True, hint="Drag arrows to move, arcs to turn")
            self._snap: Any = gui.add_dropdown("Snap", tuple(SNAPS), initial_value="none")
            actions.on_update(self._gizmo, self.show_gizmo)
        with gui.add_folder("Add, copy, delete", expand_by_default=False):
            self._new: Any = gui.add_text("New name", "")
            self._add_button("Add body", lambda: self._add(ItemKind.BODY))
            self._add_button("Add frame to the body", lambda: self._add(ItemKind.FRAME))
            self._add_button("Add constraint", lambda: self._add(ItemKind.CONSTRAINT))
            self._add_button("Duplicate", self._duplicate)
            self._add_button("Delete", self._delete)
        with gui.add_folder("Place by measurement", expand_by_default=False):
            self._place = PlacePanel(gui, session, self._item, self._change_item, actions)
        with gui.add_folder("As text", expand_by_default=False):
            self._text: Any = gui.add_text("YAML", "", multiline=True)
            self._add_button("Write text", self._write_text)
        self._refresh()

    def _add_button(self, label: str, action: Callable[[], object]) -> Any:
        return self._actions.add_button(self._gui, label, action)

    def _ask(self, title: str, text: str, answer: str, action: Callable[[], object]) -> None:
        """Show a text in HTML in a dialog, and execute an action if a person answers so."""
        modal: Any = self._gui.add_modal(title)

        def confirm() -> None:
            modal.close()
            action()

        with modal:
            self._gui.add_html(text)
            self._add_button(answer, confirm)
            self._add_button("Cancel", modal.close)

    # --- selection

    def select(self, item: GeometryItem) -> None:
        if item != self._item and not self._fields.commit():
            # what was typed is not lost: it stays until it can be set
            self._kind.value, self._name.value = self._item.kind, self._item.name
            return
        items = self._session.document.list_items() or [WHOLE_FILE]
        if item not in items:
            return
        self._item = item
        self._kind.value = item.kind
        self._name.options = tuple([each.name for each in items if each.kind is item.kind])
        self._name.value = item.name
        self._fields.show(item)
        self._place.show(item)
        self._text.value = self._session.document.get_yaml(item)
        self.show_gizmo()

    def _select_first(self, kind: ItemKind) -> None:
        found = self._find_first(kind)
        if found.kind is not kind:
            self._report(f"there is no {kind} yet; add one below")
            self._kind.value = self._item.kind
        else:
            self.select(found)

    def _find_first(self, kind: ItemKind) -> GeometryItem:
        """Return the first item of a kind, without one the first of all."""
        items = self._session.document.list_items()
        return next((each for each in items if each.kind is kind), next(iter(items), WHOLE_FILE))

    def _refresh(self) -> None:
        session = self._session
        self._next_look = 0.0
        self._show_status()
        self._show_problems()
        if self._item not in (session.document.list_items() or [WHOLE_FILE]):
            self._item = self._find_first(self._item.kind)
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
            state += f"; {format_count(errors, 'error')}: cannot be saved, and the scene shows " + (
                "the last model" if session.model is not None else "the bodies that can be read, not joined"
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
        lines = [f"- {_describe_problem(each)}" for each in shown] + [f"- and {more} more"] * bool(more)
        text = "\n".join(lines) or "none"
        if notes:
            text += f"\n\n{format_count(notes, 'note')}: modelserver check --notes"
        self._problem_texts.content = text
        self._problems.visible = bool(found)
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

    def _do(self, action: Callable[[], object]) -> str:
        """Execute an action; show and return why it cannot be done, if so."""
        problem = ""
        try:
            action()
        except (ModelServerError, PlacementError, OSError) as error:
            near = f"; nearest: {', '.join(error.nearest)}" if isinstance(error, QueryError) and error.nearest else ""
            problem = f"{error}{near}"
        self._report(problem and f"not done: {problem}")
        return problem

    def _step(self, action: Callable[[], None], change: str, done: str) -> None:
        """Undo a change or make it again."""
        problem = self._do(action)
        self._refresh()
        if not problem:
            self._report(f"{done}: {change}" if change else f"nothing to be {done}")

    def _change(self, name: str, change: Change, new: GeometryItem | None = None) -> str:
        """Make a change, after which `new` is selected; return why it cannot be made."""
        problem = self._do(lambda: self._session.change(name, change))
        if not problem:
            if new is not None:
                self._item = new
            self._refresh()
        return problem

    def _change_item(self, change: Change, new: GeometryItem | None = None) -> str:
        return self._change(f"edit {self._item.name}", change, new)

    def _add(self, kind: ItemKind) -> None:
        name, item, frames = self._new.value.strip(), self._item, list_frames(self._session.document)
        if kind is not ItemKind.BODY and not frames:
            self._report("not done: there is no frame yet; add a body first")
            return
        body = (frames[0] if item.kind is ItemKind.CONSTRAINT else item.name).partition(":")[0]
        new, change = name, lambda document: document.add_body(name)
        if kind is ItemKind.FRAME:
            new, change = names.join(body, name), lambda document: document.add_frame(body, name)
        elif kind is ItemKind.CONSTRAINT:
            from_ = item.name if item.kind is ItemKind.FRAME else frames[0]
            others = [each for each in frames if each.partition(":")[0] != from_.partition(":")[0]]
            if not others:
                self._report("not done: a constraint joins two bodies, and there is only one")
                return
            change = lambda document: document.add_constraint(name, from_, others[-1])  # noqa: E731
        self._make(f"add {new}", change, GeometryItem(kind, new))

    def _make(self, name: str, change: Change, new: GeometryItem) -> None:
        """Make a change that adds an item; its name is used then."""
        if not self._change(name, change, new):
            self._new.value = ""

    def _duplicate(self) -> None:
        item = self._item
        plain = item.name.rpartition(":")[2]
        name = self._new.value.strip() or _find_free_name(self._session.document, item)
        new = GeometryItem(item.kind, item.name.removesuffix(plain) + name)
        self._make(f"duplicate {item.name}", lambda document: document.duplicate(item, name), new)

    def _delete(self) -> None:
        item = self._item
        in_template = self._fields.in_template
        self._change(f"delete {item.name}", lambda document: document.delete(item, in_template))

    def _write_text(self) -> None:
        item, text = self._item, self._text.value
        self._change(f"write {item.name}", lambda document: document.set_yaml(item, text))

    # --- gizmo

    def show_gizmo(self) -> None:
        """Outline what is selected, and show the gizmo at it, where the scene has it."""
        place = self._fields.find_place()
        part = self._fields.part
        if isinstance(part, Constraint):
            # what it moves
            body, pose = names.split(part.to)[0], self._session.drawn.frame(part.to).pose
            self._scene.mark(body, pose)
        else:
            self._scene.mark(self._item.name.partition(":")[0], part.pose if part is not None else None)
        if not self._gizmo.value or place is None:
            self._scene.hide_gizmo()
            return
        body, parent, pose = place
        self._scene.show_gizmo(body, parent, pose, self._drag)

    def _drag(self, pose: Pose, is_end: bool) -> None:
        """Follow the gizmo: the fields while it moves, a change when it is released. Called in the page's thread."""
        self._actions.put(lambda: self._fields.set_dragged(pose, SNAPS[self._snap.value], is_end))

    # --- saving and applying

    def _ask_save(self) -> None:
        if not self._fields.commit():
            return
        session = self._session
        if session.has_errors:
            self._report("not saved: the geometry has errors; fix them first")
        elif not session.is_changed:
            self._report("nothing to be saved")
        else:
            shown, diff = session.document, format_diff(session.make_diff())
            self._ask(f"Save {session.file.path.name}", diff, "Save", lambda: self._write_file(shown))

    def _ask_read(self) -> None:
        """Read the file again, after a question if changes would be lost."""
        if not self._session.is_changed:
            self._read_file()
            return
        text = "The changes that are not saved are dropped."
        self._ask("Read the file again", text, "Drop them", self._read_file)

    def _read_file(self) -> None:
        self._fields.drop()
        self._do(self._session.read)
        self._refresh()

    def _write_file(self, shown: GeometryDocument) -> None:
        if self._session.document is not shown:
            # in another tab
            self._report("not saved: the geometry was edited since its difference was shown; look at it again")
        elif not self._do(self._session.save):
            self._report(f"saved {self._session.file.path}")
        message = self._message.content
        self._refresh()
        self._message.content = message

    def _ask_apply(self) -> None:
        if self._fields.commit():
            if self._session.is_changed:
                self._report("not applied: save the changes first; the service reads the file")
            else:
                self._start_reload(dry_run=True)

    def _start_reload(self, dry_run: bool) -> None:
        """Ask the service what a reload would change, or reload."""
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
            changes = "".join(f"<li>{html.escape(each)}</li>" for each in reply.changes)
            self._ask(
                "Apply to the running service",
                f"<ul>{changes}</ul>",
                "Apply",
                lambda: self._start_reload(dry_run=False),
            )

    def close(self) -> None:
        self._executor.shutdown(wait=False, cancel_futures=True)


def format_diff(diff: str) -> str:
    """Return a unified diff in HTML: what is added in green, what is removed in red, long lines in several."""
    rows = []
    for number, line in enumerate(diff.splitlines()):
        # the first two have the names of the files
        style = _DIFF_STYLES.get(line[:1], "") if number > 1 else "opacity: 0.6"
        rows.append(f'<div style="{style}">{html.escape(line) or " "}</div>')
    return f'<div style="{_DIFF_STYLE}">{"".join(rows)}</div>'


def _describe_problem(problem: Problem) -> str:
    fix = f"; {problem.fix}" if problem.fix else ""
    where = problem.element or (f"line {problem.line}" if problem.line else "")
    place = f" ({where})" if where else ""
    return f"**{problem.severity}**: {escape_markdown(problem.message + place + fix)}"


def _find_free_name(document: GeometryDocument, item: GeometryItem) -> str:
    taken = {each.name for each in document.list_items() if each.kind is item.kind}
    plain = item.name.rpartition(":")[2]
    numbers = (f"{plain}{number}" for number in range(2, len(taken) + 3))
    return next(name for name in numbers if item.name.removesuffix(plain) + name not in taken)


# --- fields of an item ---------------------------------------------------------------------------------------


def parse_typed(label: str, text: str) -> float:
    """Return the number that was typed: with a sign, an exponent, a decimal comma. Raises EditError."""
    plain = text.strip().translate(_MINUS)
    if _THOUSANDS.fullmatch(plain):
        point = plain.replace(",", ".")
        raise EditError(f"{label}: {quote(text, 40)} has two meanings; write {point}, or no comma between thousands")
    if plain.count(",") == 1 and "." not in plain:
        plain = plain.replace(",", ".")
    if "," in plain:
        raise EditError(f"{label}: {quote(text, 40)} is not a number; {ACCEPTED}")
    try:
        return parse_number(plain)
    except ValueError as error:
        raise EditError(f"{label}: {error}; {ACCEPTED}") from None


def _format_field(value: float) -> str:
    return format_number(round(value, PRECISION) + 0.0)


class TypedText:
    """A text field. What is typed in it is pending until it is set, and not overwritten until then."""

    def __init__(self, gui: viser.GuiApi, label: str, text: str, actions: Actions, hint: str | None = None):
        self.label = label
        self._shown: str | None = text
        self._field: Any = gui.add_text(label, text, hint=hint)
        self._problem: Any = gui.add_html("")
        actions.on_update(self._field, lambda: self.mark(""))

    @property
    def value(self) -> str:
        return str(self._field.value)

    @value.setter
    def value(self, text: str) -> None:
        self._field.value = text

    @property
    def is_pending(self) -> bool:
        return self.value != self._shown

    def report(self, text: str, client: int) -> None:
        """Take a text that the page of a client has, and send it to the pages of others.

        A value that is assigned is sent to this client too, and replaces what is typed there meanwhile; viser offers
        the way without that to its own messages only.
        """
        state = self._field._impl
        state.value = text
        state.sync_cb(client, {"value": text})

    def show(self, text: str) -> None:
        """Show what is set, unless something is pending."""
        if not self.is_pending:
            self._shown = self.value = text

    def settle(self) -> None:
        """What is typed is set."""
        self._shown = self.value
        self.mark("")

    def reject(self, problem: str = "") -> None:
        """What is typed could not be set: it stays, marked with the reason."""
        self._shown = None
        self.mark(problem)

    def mark(self, problem: str) -> None:
        self._problem.content = _RED.format(html.escape(problem)) if problem else ""


class NumberFields:
    """Text fields of numbers with a label each."""

    def __init__(self, gui: viser.GuiApi, labels: Sequence[str], values: Sequence[float], actions: Actions):
        self._given = tuple(map(float, values))
        self.fields = [
            TypedText(gui, label, _format_field(value), actions) for label, value in zip(labels, values, strict=True)
        ]

    def read(self, labels: Collection[str]) -> tuple[float, ...]:
        """Return the numbers, of fields without these labels what was given. Raises EditError for no number."""
        numbers = []
        for old, field in zip(self._given, self.fields, strict=True):
            number = parse_typed(field.label, field.value) if field.label in labels else old
            numbers.append(old if number == float(_format_field(old)) else number)
        return tuple(numbers)

    def show(self, values: Sequence[float]) -> None:
        """Show numbers where nothing is pending; a text that has the number stays as it is typed."""
        self._given = tuple(map(float, values))
        for number, field in zip(self._given, self.fields, strict=True):
            text = _format_field(number)
            try:
                if parse_typed("", field.value) != float(text):
                    field.show(text)
            except EditError:
                field.show(text)

    @property
    def value(self) -> tuple[float, ...]:
        """The numbers. Raises EditError for a text that is none."""
        return self.read([each.label for each in self.fields])

    @value.setter
    def value(self, numbers: Sequence[float]) -> None:
        self.texts = tuple(map(_format_field, numbers))

    @property
    def texts(self) -> tuple[str, ...]:
        return tuple([each.value for each in self.fields])

    @texts.setter
    def texts(self, words: Sequence[str]) -> None:
        for each, word in zip(self.fields, words, strict=True):
            each.value = word


SNAPS: Final = {
    "none": (1e-4, 0.01),
    "1 mm, 1 deg": (1e-3, 1.0),
    "1 cm, 5 deg": (0.01, 5.0),
    "5 cm, 15 deg": (0.05, 15.0),
}
"""Steps to which the gizmo rounds, meters and degrees; without snap what a hand can place."""


def list_frames(document: GeometryDocument) -> list[str]:
    return [each.name for each in document.list_items() if each.kind is ItemKind.FRAME]


def find_part(model: Model | None, item: GeometryItem) -> BodyFrame | Constraint | None:
    """Return the frame or constraint of a model that an item is; None for a body, and for one that is not there."""
    if model is None or item.kind is ItemKind.BODY:
        return None
    if item.kind is ItemKind.CONSTRAINT:
        return next((each for each in model.constraints if each.name == item.name), None)
    try:
        return model.frame(item.name)
    except QueryError:
        return None


class ShownField(NamedTuple):
    """What a field shows: numbers with a label each, one of `options`, yes or no, or a text; without label a note."""

    key: str
    labels: tuple[str, ...]
    value: Any
    options: tuple[str, ...] = ()
    hint: str | None = None


class ItemFields:
    """The fields of what is selected. A text is set when it is left, a choice when it is made, each as one change."""

    def __init__(
        self, server: viser.ViserServer, session: EditSession, item: GeometryItem, change: ChangeItem, actions: Actions
    ):
        self._server = server
        self._gui = gui = server.gui
        self._session = session
        self._change = change
        self._actions = actions
        self._item = item
        self._folder: Any = None
        self.part: BodyFrame | Constraint | None = None
        self._shown: list[ShownField] = []
        self._fields: dict[str, Any] = {}
        self._count = 0
        self._exact: dict[str, tuple[float, ...]] = {}
        self._place = gui.add_folder("Values")
        with self._place:
            self._carrier: Any = gui.add_text(CARRIER, "")
            script = html.escape(COMMIT_SCRIPT)
            gui.add_html(f'<img alt="" style="display: none" src="{_PIXEL}" onload="{script}">')

        def read(event: Any) -> None:
            # values that this program sets have no client
            if event.client_id is not None:
                actions.put(partial(self._set_left, event.target.value, event.client_id))

        self._carrier.on_update(read)

    # --- what is shown

    def drop(self) -> None:
        """Drop what is typed; the next `show` makes the fields again."""
        self._shown = []

    def show(self, item: GeometryItem) -> None:
        """Show an item. Fields that stay the same ones stay on the page, with what is typed in them."""
        self.part = find_part(self._session.drawn, item)
        shown = self._list_fields(item)
        is_same = item == self._item and _list_layout(shown) == _list_layout(self._shown)
        self._item, self._shown = item, shown
        if is_same:
            if not self._is_wrong:
                with self._server.atomic():
                    for each in shown:
                        self._update(each)
            # else what was set stays to be seen: the scene has the last model without an error
            return
        self._fields = {}
        old = self._folder
        with self._server.atomic():
            with self._place:
                self._folder = self._gui.add_folder(None)
            self._count += 1
            with self._folder:
                self._gui.add_html(f'<i data-shown="{self._count}" hidden></i>')
                for each in shown:
                    self._add(each)
            if old is not None:
                # last: a page hides a folder that was empty for a moment, and may never show it again
                old.remove()

    def _list_fields(self, item: GeometryItem) -> list[ShownField]:
        document = self._session.document
        self._exact = {}
        if item == WHOLE_FILE:
            return [ShownField("note", (), "No body can be read: write the file under *As text*.")]
        shown = [ShownField("name", ("Name",), item.name.rpartition(":")[2])]
        template = document.find_template(item)
        if template:
            users = ", ".join(document.list_users(template))
            hint = f"Else {item.name.partition(':')[0]} alone gets an entry of its own"
            shown.append(ShownField("template", (f"For all of {template}: {users}",), False, hint=hint))
        part: BodyFrame | Constraint | Body | None = self.part
        if isinstance(part, Constraint):
            frames = tuple(list_frames(document))
            for key, frame in (("from", part.from_), ("to", part.to)):
                shown.append(ShownField(key, (key,), frame if frame in frames else frames[0], frames))
        if self.part is not None:
            shown += _list_pose_fields(self.part.pose, self.part.sigma)
        if isinstance(part, Constraint):
            shown += self._list_joint_fields(item, part.joint)
        part = part or next((each for each in self._session.drawn.bodies if each.name == item.name), None)
        shown.append(ShownField("description", ("Description",), part.description if part is not None else ""))
        return shown

    def _list_joint_fields(self, item: GeometryItem, joint: Joint) -> list[ShownField]:
        shown = [ShownField("joint", ("Joint",), joint.type, tuple(JointType))]
        if not joint.is_movable:
            return shown
        if joint.type in TYPES_WITH_AXIS:
            shown.append(ShownField("axis", tuple([f"axis {axis}" for axis in "xyz"]), joint.axis))
        if joint.count > 1:
            note = "Limits and more of a joint with several coordinates: under *As text*."
            return [*shown, ShownField("note", (), note)]
        unit = "deg" if joint.type is JointType.REVOLUTE else "m"
        scale = math.degrees(1.0) if unit == "deg" else 1.0
        limits: tuple[float, ...] = ()
        if joint.lower or joint.upper:
            limits = (joint.lower or (-math.inf,)) + (joint.upper or (math.inf,))
        for key, label, values in (
            ("limits", f"limits ({unit})", limits),
            ("rate_limit", f"rate limit ({unit}/s)", joint.rate_limit),
            ("default", f"default ({unit})", joint.default),
            ("sigma", f"joint sigma ({unit})", joint.sigma),
        ):
            shown.append(ShownField(key, (label,), _format_values(values, scale), hint="Empty: none is stated"))
            self._exact[key] = values
        others = [each.name for each in self._session.document.list_items() if each.kind is ItemKind.CONSTRAINT]
        leaders = (NO_CHOICE, *(each for each in others if each != item.name))
        mimic = joint.mimic
        leader = mimic.joint if mimic is not None and mimic.joint in leaders else NO_CHOICE
        known = mimic or Mimic("")
        self._exact |= {"multiplier": (known.multiplier,), "offset": (known.offset,)}
        return [
            *shown,
            ShownField("leader", ("follows",), leader, leaders),
            ShownField("multiplier", ("multiplier",), format_number(known.multiplier)),
            ShownField("offset", (f"offset ({unit})",), _format_values([known.offset], scale)),
        ]

    def _add(self, shown: ShownField) -> None:
        gui, value = self._gui, shown.value
        field: Any
        if not shown.labels:
            gui.add_markdown(value)
            return
        if isinstance(value, tuple):
            field = NumberFields(gui, shown.labels, value, self._actions)
        elif shown.options or isinstance(value, bool):
            (label,) = shown.labels
            if shown.options:
                field = gui.add_dropdown(label, shown.options, initial_value=value)
            else:
                field = gui.add_checkbox(label, value, hint=shown.hint)
            if shown.key != "template":
                self._actions.on_choice(field, lambda chosen: self._choose(field, shown, chosen))
        else:
            field = TypedText(gui, shown.labels[0], value, self._actions, shown.hint)
        self._fields[shown.key] = field

    def _update(self, shown: ShownField) -> None:
        """Show another value in a field."""
        field = self._fields.get(shown.key)
        if field is None or shown.key == "template":
            return
        if isinstance(field, NumberFields | TypedText):
            field.show(shown.value)
        else:
            if shown.options and field.options != shown.options:
                field.options = shown.options
            field.value = shown.value

    @property
    def in_template(self) -> bool:
        return "template" in self._fields and bool(self._fields["template"].value)

    # --- what is set

    def _choose(self, field: Any, shown: ShownField, value: Any) -> None:
        if field in self._fields.values():
            field.value = value
            self.set(shown.labels)

    def _list_texts(self) -> list[TypedText]:
        texts: list[TypedText] = []
        for field in self._fields.values():
            texts += field.fields if isinstance(field, NumberFields) else [field] * isinstance(field, TypedText)
        return texts

    def _set_left(self, message: str, client: int) -> None:
        """Set the fields that were left, with the texts that they had on the page of a client."""
        # of another item, if they are sent again after it was selected
        texts = {label: text for shown, label, text in json.loads(message)[1:] if shown == str(self._count)}
        for field in self._list_texts():
            if field.label in texts:
                field.report(texts[field.label], client)
                if field.is_pending or self._is_wrong:
                    self.set([field.label])

    def commit(self) -> bool:
        """Set what was typed, if anything was; return whether nothing is left that cannot be set."""
        return not any(each.is_pending for each in self._list_texts()) or self.set()

    def set(self, labels: Collection[str] = ()) -> bool:
        """Set what the fields with these labels have, by default all that was changed; return whether it could be."""
        texts = [each for each in self._list_texts() if (each.label in labels if labels else each.is_pending)]
        item = self._item
        plain = item.name.rpartition(":")[2]
        is_named = any(each is self._fields["name"] for each in texts)
        name = self._fields["name"].value.strip() if is_named else plain
        new = GeometryItem(item.kind, item.name.removesuffix(plain) + name) if name != plain else None
        for each in texts:
            each.settle()
        if new is not None:
            # its fields stay the same ones
            self._item = new
        problem = self._change(lambda document: self._write(document, item, name if new else "", labels, texts), new)
        if problem:
            self._item = item
            for each in texts:
                is_meant = len(texts) == 1 or problem.startswith(f"{each.label}: ")
                each.reject(problem if is_meant else "")
        return not problem

    @property
    def _is_wrong(self) -> bool:
        """Whether the text has a wrong change of the item: the scene has the last model without an error."""
        return self._session.has_errors and not self._session.is_as_loaded(self._item)

    def _write(
        self,
        document: GeometryDocument,
        item: GeometryItem,
        name: str,
        labels: Collection[str],
        texts: Sequence[TypedText],
    ) -> GeometryDocument:
        in_template = self.in_template
        chosen = {*labels, *(each.label for each in texts)}
        values: dict[str, Any] = {}
        differing, changed = set(), set()
        for each in self._shown:
            if (field := self._fields.get(each.key)) is None:
                continue
            if isinstance(field, NumberFields):
                value: Any = field.read(chosen)
            else:
                is_read = each.labels[0] in chosen or not (labels or isinstance(field, TypedText))
                value = field.value if is_read else each.value
            values[each.key] = value
            if value != each.value:
                differing.add(each.key)
            # where the text has a wrong change of the item, the fields show another value than it
            if value != each.value or (self._is_wrong and not chosen.isdisjoint(each.labels)):
                changed.add(each.key)
        if changed & {"xyz", "rpy"}:
            xyz, rpy = (so3.to_vector3(values[key]) for key in ("xyz", "rpy"))
            document = document.set_pose(item, xyz, rpy, in_template)
        if changed & {"has_sigma", "sigma_xyz", "sigma_rpy"}:
            # numbers that are typed are meant, whatever the checkbox has
            is_stated = values["has_sigma"] or bool(changed & {"sigma_xyz", "sigma_rpy"})
            stated = [so3.to_vector3(values[key]) if is_stated else None for key in ("sigma_xyz", "sigma_rpy")]
            document = document.set_sigma(item, stated[0], stated[1], in_template)
        if "description" in changed:
            document = document.set_description(item, values["description"].strip(), in_template)
        if isinstance(self.part, Constraint):
            if changed & {"from", "to"}:
                document = document.set_ends(item.name, values["from"], values["to"])
            joint = self._read_joint(self.part.joint, values, differing)
            if joint != self.part.joint:
                document = document.set_joint(item.name, self.part.joint, joint)
        return document.rename(item, name, in_template) if name else document

    def _read_joint(self, old: Joint, values: Mapping[str, Any], differing: Collection[str]) -> Joint:
        keys = {"joint", "axis", "limits", "rate_limit", "default", "sigma", "leader", "multiplier", "offset"}
        if keys.isdisjoint(differing):
            return old
        kind = JointType(values["joint"])
        axis = so3.to_vector3(values["axis"]) if "axis" in values else (0.0, 0.0, 1.0)

        def read(key: str, count: int, is_angle: bool) -> tuple[float, ...]:
            return _read_values(key, values[key], count, is_angle) if key in differing else self._exact[key]

        try:
            if kind is JointType.FIXED:
                return Joint()
            if kind is not old.type:
                # its numbers had other units
                return Joint(kind, axis)
            if "limits" not in values:
                return replace(old, axis=axis)
            is_angle = kind is JointType.REVOLUTE
            limits = read("limits", 2, is_angle)
            if limits and limits[0] > limits[1]:
                raise EditError(f"limits: expected the lower one first, got {quote(values['limits'], 40)}")
            mimic = None
            if values["leader"] != NO_CHOICE:
                (multiplier,) = read("multiplier", 1, is_angle=False) or (1.0,)
                (offset,) = read("offset", 1, is_angle) or (0.0,)
                mimic = Mimic(values["leader"], multiplier, offset)
            return Joint(
                kind,
                axis,
                limits[:1],
                limits[1:],
                read("rate_limit", 1, is_angle),
                read("default", 1, is_angle) if mimic is None else (),
                read("sigma", 1, is_angle),
                mimic,
            )
        except ValueError as error:
            raise EditError(str(error)) from None

    # --- gizmo

    def find_place(self) -> tuple[str, Pose, Pose] | None:
        """Return the body on which the pose stands, that of its parent on it, and the pose; None for a body."""
        model, part = self._session.drawn, self.part
        if part is None:
            return None
        if isinstance(part, BodyFrame):
            return names.split(self._item.name)[0], Pose.identity(), part.pose
        return names.split(part.from_)[0], model.frame(part.from_).pose, part.pose

    def set_dragged(self, pose: Pose, steps: tuple[float, float], is_end: bool) -> None:
        """Show where the gizmo is; at the end of a drag set it. What was not moved, or not turned, stays exact."""
        if self.part is None:
            return
        meters, degrees = steps
        moved, turned = self.part.pose.distance(pose)
        if moved > SAME:
            self._fields["xyz"].value = tuple([round(round(each / meters) * meters, PRECISION) for each in pose.xyz])
        if turned > SAME:
            rpy = [math.degrees(each) for each in so3.to_rpy(pose.wxyz)]
            self._fields["rpy"].value = tuple([round(round(each / degrees) * degrees, PRECISION) for each in rpy])
        if is_end:
            self.set()


def _list_layout(shown: Sequence[ShownField]) -> list[tuple[str, tuple[str, ...]]]:
    return [(each.key, each.labels) for each in shown]


def _list_pose_fields(pose: Pose, sigma: Sigma | None) -> list[ShownField]:
    known, axes, angles = sigma or Sigma(), "xyz", ("roll", "pitch", "yaw")
    turns = tuple(np.degrees(known.rotation).tolist())
    return [
        ShownField("xyz", tuple([f"{axis} (m)" for axis in axes]), pose.xyz),
        ShownField("rpy", tuple([f"{angle} (deg)" for angle in angles]), tuple(map(math.degrees, pose.rpy))),
        ShownField("has_sigma", ("Sigma",), sigma is not None, hint="Standard deviations are stated"),
        ShownField("sigma_xyz", tuple([f"sigma {axis} (m)" for axis in axes]), known.position),
        ShownField("sigma_rpy", tuple([f"sigma {angle} (deg)" for angle in angles]), turns),
    ]


def _read_values(key: str, text: str, count: int, is_angle: bool) -> tuple[float, ...]:
    """Return the numbers in a text, none for an empty one, radians and meters. Raises EditError."""
    text = text.strip()
    if not text:
        return ()
    label, parts = key.replace("_", " "), [each.strip() for each in text.strip("[]").split(",")]
    if len(parts) != count:
        what = "two numbers with a decimal point, lower and upper" if count == 2 else "one number with a decimal point"
        raise EditError(f"{label}: expected {what}, got {quote(text, 40)}")
    numbers = [_INFINITE[each.lower()] if each.lower() in _INFINITE else parse_typed(label, each) for each in parts]
    return tuple([math.radians(each) if is_angle else each for each in numbers])


def _format_values(values: Sequence[float], scale: float) -> str:
    """Return numbers as a text, angles in degrees."""
    known = {math.inf: ".inf", -math.inf: "-.inf"}
    return ", ".join(known.get(each) or format_number(round(each * scale, 9) + 0.0) for each in values)


# --- placing -------------------------------------------------------------------------------------------------


class PlacePanel:
    """Two folders: frames that coincide, and distances."""

    def __init__(
        self, gui: viser.GuiApi, session: EditSession, item: GeometryItem, change: ChangeItem, actions: Actions
    ):
        self._session = session
        self._change = change
        self._item = item
        with gui.add_folder("Frames that coincide"):
            self._hint = gui.add_markdown("")
            self._frame: Any = gui.add_dropdown("Frame", (NO_CHOICE,))
            self._target: Any = gui.add_dropdown("is at", (NO_CHOICE,))
            self._position_only: Any = gui.add_checkbox("Position only", False)
            actions.add_button(gui, "Place there", lambda: self._place(self._coincide))
        with gui.add_folder("Distances from frames"):
            self._rows: list[tuple[Any, NumberFields]] = []
            for number in range(1, MAX_DISTANCES + 1):
                frame = gui.add_dropdown(f"From {number}", (NO_CHOICE,))
                self._rows.append((frame, NumberFields(gui, (f"distance {number} (m)",), (0.0,), actions)))
            self._sigma = NumberFields(gui, ("sigma (m)",), (0.002,), actions)
            self._mirrored: Any = gui.add_checkbox("On the other side", False, hint="Three distances fit two positions")
            actions.add_button(gui, "Place by distances", lambda: self._place(self._measure))
            self._result = gui.add_markdown("")

    def show(self, item: GeometryItem) -> None:
        """Offer the frames for an item."""
        if item != self._item:
            self._result.content = ""
        self._item = item
        frames = (NO_CHOICE, *list_frames(self._session.document))
        is_constraint = item.kind is ItemKind.CONSTRAINT
        self._frame.visible = is_constraint
        self._hint.content = {
            ItemKind.CONSTRAINT: "Moves the constraint so that two frames, one on each side, are the same place.",
            ItemKind.FRAME: "Moves the frame on its body to where another frame is.",
        }.get(item.kind, "Select a frame or a constraint.")
        for dropdown in (self._frame, self._target, *(frame for frame, _ in self._rows)):
            # a frame that is not among them gives way to the first
            dropdown.options = frames

    def _place(self, compute: Callable[[Model, GeometryItem], tuple[Placement, Pose]]) -> None:
        """Place the item where a function of the model computes it; that returns its old pose too."""
        item = self._item

        def change(document: GeometryDocument) -> GeometryDocument:
            model = self._session.model
            if model is None or self._session.has_errors:
                raise EditError("fix the errors first; a pose is computed from a geometry without any")
            return _write_placement(document, item, *compute(model, item))

        self._change(change, None)

    def _coincide(self, model: Model, item: GeometryItem) -> tuple[Placement, Pose]:
        target, position_only = self._target.value, self._position_only.value
        if target == NO_CHOICE:
            raise EditError("choose the frame with which it coincides")
        part = find_part(model, item)
        if part is None:
            raise EditError("select a frame or a constraint")
        if item.kind is ItemKind.FRAME:
            return place_frame(model, item.name, target, position_only), part.pose
        if self._frame.value == NO_CHOICE:
            raise EditError("choose the two frames that coincide")
        return place_constraint(model, item.name, self._frame.value, target, position_only), part.pose

    def _measure(self, model: Model, item: GeometryItem) -> tuple[Placement, Pose]:
        """Place a frame by its distances from others."""
        if item.kind is not ItemKind.FRAME:
            raise EditError("select the frame to which the distances were measured")
        given = [(frame.value, distance.value[0]) for frame, distance in self._rows if frame.value != NO_CHOICE]
        points, P = list_measured_points(model, item.name, [name for name, _ in given])
        distances = np.array([distance for _, distance in given], float)
        (sigma_m,) = self._sigma.value
        sigmas = np.full(len(given), sigma_m)
        frame = model.frame(item.name)
        fit = locate_by_distances(points, distances, sigmas, frame.pose.xyz, P)
        if self._mirrored.value:
            if fit.mirrored is None:
                raise EditError("the distances fit on one side only")
            fit = locate_by_distances(points, distances, sigmas, fit.mirrored, P)
        self._result.content = _describe_fit(fit, [name for name, _ in given], sigma_m)
        rotation = (frame.sigma or Sigma()).rotation
        sigma = Sigma(so3.to_vector3(np.sqrt(np.diag(fit.covariance))), rotation)
        return Placement(Pose(fit.position, frame.pose.wxyz), sigma), frame.pose


def _write_placement(document: GeometryDocument, item: GeometryItem, found: Placement, old: Pose) -> GeometryDocument:
    """Write a placement; a rotation that is the old one stays as it is written."""
    degrees = np.degrees(found.pose.rpy)
    is_turned = old.distance(found.pose)[1] > SAME_RADIANS
    placed = document.set_pose(item, _round(found.pose.xyz), _round(degrees) if is_turned else so3.to_vector3(degrees))
    if found.sigma is None:
        return placed
    return placed.set_sigma(item, _round(found.sigma.position), _round(np.degrees(found.sigma.rotation)))


def _round(values: Any) -> Vector3:
    return so3.to_vector3(round(float(each), PRECISION) + 0.0 for each in values)


def _describe_fit(fit: DistanceFit, frames: list[str], sigma: float) -> str:
    deviations = np.sqrt(np.diag(fit.covariance)).tolist()
    rows = [
        (frame, f"{1000.0 * residual:+.1f} mm", "too large" if abs(residual) > 3.0 * sigma else "")
        for frame, residual in zip(frames, fit.residuals.tolist(), strict=True)
    ]
    parts = [format_table(("from", "residual", ""), rows)]
    parts.append("Sigma x, y, z: " + ", ".join(f"{1000.0 * each:.1f} mm" for each in deviations))
    if fit.mirrored is not None:
        place = ", ".join(f"{each:.4f}" for each in fit.mirrored)
        parts.append(escape_markdown(f"They fit at {place} m too, on the other side of the plane of the frames."))
    return "\n\n".join(parts)
