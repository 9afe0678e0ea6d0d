"""Which form a file is in: told by what it holds, for names of files lie."""

from __future__ import annotations

import gc
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import PurePath

from modelserver.errors import Location, shown
from modelserver.file_kinds import FileKind, conversion_command, file_kind, geometry_named
from modelserver.formats import bot_param
from modelserver.formats.saved import Saved
from modelserver.geometry.builder import ModelBuilder
from modelserver.geometry.model import Model

FORMS = ("yaml", "miro", "miro-frames", "urdf")
"""Forms that `save` writes: YAML, Miro body and constraint XML, Miro frame-tree XML, URDF."""

_ENDINGS = {".yaml": "yaml", ".yml": "yaml", ".xml": "miro", ".urdf": "urdf"}

_XML_ENDINGS = (".xml", ".urdf")

_ELSEWHERE = {
    "sdf": "this looks like SDF, which is not read",
    "config_group": "this is Miro's compile-time parameter file; the run-time file holds the geometry",
}


_INSTEAD = {
    FileKind.VEHICLE: "a vehicle file goes with -c; here give the geometry file that it names",
    FileKind.LOG: "give a geometry file; modelserver query --log and modelserver replay take logs",
    FileKind.COMMENTS: "see docs/geometry-files.md for an example to begin with",
    FileKind.MIRO_PROCESS: "convert it to a vehicle file, which names the geometry file: {command}",
}
"""What to give instead of a file that is no geometry file."""


def form_of_path(path: str | os.PathLike[str]) -> str:
    """Return the form to write to a file of that name. Raises ValueError for an ending that names none."""
    ending = PurePath(path).suffix.lower()
    if ending not in _ENDINGS:
        raise ValueError(
            f"{shown(ending)} names no form; endings are {', '.join(_ENDINGS)}"
            if ending
            else f"a file name without an ending names no form; endings are {', '.join(_ENDINGS)}"
        )
    return _ENDINGS[ending]


def read(
    content: bytes, file: str = "", variables: Mapping[str, str] | None = None, strict: bool = False
) -> ModelBuilder:
    """Return a builder with what `content` holds and every problem met; never raises for what is in it.

    `file` is named in problems; the builder is `strict`, or not.
    """
    builder = ModelBuilder(strict=strict)
    text = content.removeprefix(b"\xef\xbb\xbf").lstrip()
    if not text:
        builder.error("the file is empty", Location(file), "see docs/geometry-files.md for an example to begin with")
    elif (kind := file_kind(text)) in _INSTEAD:
        named = geometry_named(text) if kind is FileKind.VEHICLE else ""
        what = kind.value if kind.is_nothing else f"{kind.value}, not a geometry file"
        fix = _INSTEAD[kind].replace("{command}", conversion_command(file or "FILE.xml"))
        builder.error(what, Location(file), fix + (f", {shown(named, 100)}" if named else ""))
    else:
        with _collector_paused():
            if text.startswith(b"<") or PurePath(file).suffix.lower() in _XML_ENDINGS:
                _read_xml(content, builder, file, variables or {})
            elif bot_param.is_likely(text):
                _read_bot_frames(content, builder, file)
            else:
                _read_yaml(content, builder, file)
    return builder


@contextmanager
def _collector_paused() -> Iterator[None]:
    """Keep the garbage collector from walking the growing tree again and again: it doubles the time of a parse.

    All that a parse makes stays alive until its end, so there is nothing to find; sizes are bounded.
    """
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


def _read_yaml(content: bytes, builder: ModelBuilder, file: str) -> None:
    # yaml and lxml are imported where they are needed: a file of one kind must not pay for the other
    from modelserver.formats import yaml_form

    yaml_form.load(content, builder, file)


def _read_bot_frames(content: bytes, builder: ModelBuilder, file: str) -> None:
    from modelserver.formats import bot_frames_text

    bot_frames_text.load(content, builder, file)


def _read_xml(content: bytes, builder: ModelBuilder, file: str, variables: Mapping[str, str]) -> None:
    from modelserver.formats import frame_tree_xml, miro_xml, urdf_xml, xml_document
    from modelserver.formats.spelling import label

    root = xml_document.parse(content, builder, file)
    if root is None:
        return
    name = xml_document.tag(root)
    first = Location(file, xml_document.line(root), f"<{label(name)}>")
    if name == "robot":
        urdf_xml.load(root, builder, file)
        return
    if name in _ELSEWHERE:
        builder.error(_ELSEWHERE[name], first, "give a file in one of Miro's forms, URDF or YAML")
        return
    if next(root.iter("{*}config_group"), None) is not None:
        builder.error(_ELSEWHERE["config_group"], first, "give the file with BodyName and ConstraintName in it")
        return
    before = len(builder.problems)
    if next(frame_tree_xml.instances(root), None) is not None:
        frame_tree_xml.load(root, builder, file, variables)
        if not miro_xml.has_bodies(root):
            return
        # one configuration may hold both; nothing is passed over in silence
    miro_xml.load(root, builder, file)
    if builder.is_empty and not any(problem.severity == "error" for problem in builder.problems[before:]):
        builder.error(
            "there is no geometry in this file: no parameter BodyName, no instance of type FrameRpyParameters"
            + ("" if name == "config" else f", and the outermost element is {label(name)}, not config"),
            first,
            "a geometry file is <config><section><parameter> with bodies; see docs/geometry-files.md",
        )


def save(model: Model, form: str) -> Saved:
    """Return the text of `model` in one of `FORMS`, and what that form cannot hold. Raises ValueError."""
    if form == "yaml":
        from modelserver.formats import yaml_text

        return yaml_text.save(model)
    if form == "miro":
        from modelserver.formats import miro_text

        return miro_text.save(model)
    if form == "miro-frames":
        from modelserver.formats import frame_tree_text

        return frame_tree_text.save(model)
    if form == "urdf":
        from modelserver.formats import urdf_text

        return urdf_text.save(model)
    raise ValueError(f"{shown(form)} is no form; forms are {', '.join(FORMS)}")
