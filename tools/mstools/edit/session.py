"""A session of editing one geometry file: changes with undo and redo, checked at each step, saved whole or not at all.

A change may leave the geometry wrong, so that several can fix it; only one without an error is saved.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from modelserver.config.vehicle_file import VehicleConfig, load_config
from modelserver.errors import ModelServerError, Problem, has_error
from modelserver.files import EXAMINED_BYTES, FileKind, detect_file_kind, read_start
from modelserver.formats import parse_content, read_content
from modelserver.geometry.model import Model
from mstools.edit.document import GeometryDocument, GeometryItem
from mstools.edit.yaml_text import EditError
from mstools.terminal.output import open_atomic

MAX_STEPS = 500
"""Changes that can be undone."""

_BOM = "\ufeff"


class Step(NamedTuple):
    """A document with the name of the change that led to it."""

    document: GeometryDocument
    change: str


class CheckedText(NamedTuple):
    """The model in a text, None if it has an error; what can be drawn of it, then its bodies alone; all problems."""

    model: Model | None
    drawn: Model | None
    problems: tuple[Problem, ...]


@dataclass(frozen=True)
class EditedFile:
    """The geometry file that is edited; `config` of the vehicle file `vehicle` if that names it."""

    path: Path
    vehicle: Path | None = None
    config: VehicleConfig | None = None

    @classmethod
    def open(cls, path: Path) -> EditedFile:
        """Return the geometry file at a path, or that of a vehicle file. Raises ConfigError, OSError."""
        if detect_file_kind(read_start(path, EXAMINED_BYTES)) is not FileKind.VEHICLE:
            return cls(path)
        config = load_config(path)
        return cls(Path(config.geometry), path, config)

    def read(self) -> str:
        """Return the text of the file. Raises OSError, GeometryError, EditError for one that is not YAML."""
        content = read_content(self.path)
        if content.removeprefix(b"\xef\xbb\xbf").lstrip().startswith(b"<"):
            raise EditError(f"{self.path} is XML; only YAML is edited: modelserver convert {self.path} geometry.yaml")
        try:
            return content.decode()
        except UnicodeDecodeError:
            raise EditError(f"{self.path} is not UTF-8 text; save it as that first") from None

    def check(self, text: str, variables: Mapping[str, str]) -> CheckedText:
        """Return what a text has, with all problems, also of frames in the vehicle file."""
        builder = parse_content(text.encode(), str(self.path), variables)
        model, problems = builder.check()
        partial = model or builder.build_bodies()
        if self.config is not None and partial is not None:
            from modelserver.server.vehicle import find_frame_problems

            problems += tuple(find_frame_problems(self.config, partial, str(self.vehicle), model is not None))
        return CheckedText(model, partial, problems)


class EditSession:
    """Edit a file. Raises EditError for a file that cannot be edited, OSError."""

    def __init__(self, file: EditedFile, variables: Mapping[str, str] | None = None):
        self.file = file
        self._variables = variables or {}
        self.read()

    def read(self) -> None:
        """Read the file again; all changes are dropped. Raises as `EditSession`, with all as before."""
        saved = self.file.read()
        document = GeometryDocument(saved.removeprefix(_BOM))
        if not document.list_items():
            path = self.file.path
            raise EditError(f"{path} has no bodies in YAML: modelserver convert {path} geometry.yaml")
        drawn = self.file.check(document.text, self._variables).drawn
        if drawn is None:
            raise EditError(f"{self.file.path} has no body that can be drawn: modelserver check {self.file.path}")
        self._saved = saved
        self._steps = [Step(document, "")]
        self._undone: list[Step] = []
        self.drawn: Model = drawn
        """The last model without an error; before there is one, the bodies of the file alone."""
        self.model: Model | None = None
        """The last model without an error."""
        self._loaded: GeometryDocument | None = None
        self._check()

    def _check(self) -> None:
        found = self.file.check(self.document.text, self._variables)
        self.problems = found.problems
        if found.model is not None:
            self.model = self.drawn = found.model
            self._loaded = self.document
        elif self.model is None and found.drawn is not None:
            self.drawn = found.drawn

    @property
    def document(self) -> GeometryDocument:
        return self._steps[-1].document

    @property
    def is_changed(self) -> bool:
        """Whether there is something to save."""
        return self.document.text != self._saved.removeprefix(_BOM)

    @property
    def has_errors(self) -> bool:
        """Whether a problem forbids to save."""
        return has_error(self.problems)

    @property
    def undo_name(self) -> str:
        """The change that `undo` undoes, empty for none."""
        return self._steps[-1].change if len(self._steps) > 1 else ""

    @property
    def redo_name(self) -> str:
        """The change that `redo` makes again, empty for none."""
        return self._undone[-1].change if self._undone else ""

    def change(self, name: str, change: Callable[[GeometryDocument], GeometryDocument]) -> bool:
        """Make a change; return whether it changed anything. Raises EditError, with all as before."""
        document = change(self.document)
        if document.text == self.document.text:
            return False
        self._steps.append(Step(document, name))
        del self._steps[1:-MAX_STEPS]
        self._undone.clear()
        self._check()
        return True

    def undo(self) -> None:
        if len(self._steps) > 1:
            self._undone.append(self._steps.pop())
            self._check()

    def redo(self) -> None:
        """Make the last undone change again."""
        if self._undone:
            self._steps.append(self._undone.pop())
            self._check()

    def is_as_loaded(self, item: GeometryItem) -> bool:
        """Return whether the entry of an item is written as in the document of `model`."""
        try:
            return self._loaded is not None and self._loaded.get_yaml(item) == self.document.get_yaml(item)
        except EditError:
            return False

    def has_changed_on_disk(self) -> bool:
        """Return whether the file is no longer what was read or saved."""
        try:
            return self.file.read() != self._saved
        except (ModelServerError, OSError):
            return True

    def find_culprit(self, problem: Problem) -> GeometryItem | None:
        return self.document.find_item(problem.line) if problem.file == str(self.file.path) else None

    def make_diff(self) -> str:
        """Return what saving changes, as a unified diff."""
        old, new = (text.splitlines() for text in (self._saved.removeprefix(_BOM), self.document.text))
        name = self.file.path.name
        return "\n".join(difflib.unified_diff(old, new, name, f"{name} (edited)", lineterm=""))

    def save(self) -> None:
        """Write the file whole. Raises EditError if it has an error or changed since it was read, OSError."""
        if self.has_errors:
            raise EditError("the geometry has errors; nothing is saved until they are fixed")
        try:
            current = self.file.read()
        except FileNotFoundError:
            raise EditError(f"{self.file.path} was removed meanwhile; nothing is saved") from None
        if current != self._saved:
            raise EditError(f"{self.file.path} changed meanwhile on disk; nothing is saved. Read it again first")
        text = (_BOM if self._saved.startswith(_BOM) else "") + self.document.text
        with open_atomic(str(self.file.path), replace=True) as stream:
            stream.write(text)
        self._saved = text
