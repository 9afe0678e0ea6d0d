"""Geometry files: detect the format by the content; read, check and write it.

    model = load_model("config/raptor/geometry.xml")
    text, unsupported = save_model(model, "yaml")

Importing this package loads neither lxml nor yaml: a file of one format does not pay for the other.
"""

from __future__ import annotations

import gc
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from pathlib import PurePath
from typing import NamedTuple

from modelserver import files
from modelserver.errors import GeometryError, Location, Problem, Severity, quote
from modelserver.formats.common import SavedModel as SavedModel
from modelserver.geometry.builder import ModelBuilder
from modelserver.geometry.model import Model

_WRITERS = {"yaml": "yaml_geometry", "miro": "miro", "urdf": "urdf"}

FORMATS = tuple(_WRITERS)
"""Formats that `save_model` writes: YAML, Miro body and constraint XML, URDF."""

MAX_BYTES = 32 * 1024 * 1024
"""Larger files are rejected unread: 10,000 frames take 3 MiB in the most verbose format."""

_FORMAT_BY_SUFFIX = {".yaml": "yaml", ".yml": "yaml", ".xml": "miro", ".urdf": "urdf"}

_XML_SUFFIXES = (".xml", ".urdf")

_OTHER_XML = {
    "sdf": "this looks like SDF, which is not supported",
    "config_group": "this is Miro's compile-time parameter file; the run-time file holds the geometry",
}

_EXAMPLE_HINT = "docs/geometry-files.md has an example to begin with"
_FIXES = {
    files.FileKind.EMPTY: _EXAMPLE_HINT,
    files.FileKind.COMMENTS: _EXAMPLE_HINT,
    files.FileKind.VEHICLE: "a vehicle file goes with -c; here give the geometry file that it names",
    files.FileKind.LOG: "give a geometry file; modelserver query --log and modelserver replay take logs",
    files.FileKind.MIRO_PROCESS: files.PROCESS_FIX,
}
"""Fix for a file that is not a geometry file."""


def format_of_path(path: str | os.PathLike[str]) -> str:
    """Return the format to write to a file of this name. Raises ValueError for an unknown suffix."""
    suffix = PurePath(path).suffix.lower()
    if suffix not in _FORMAT_BY_SUFFIX:
        what = quote(suffix) if suffix else "a file name without a suffix"
        raise ValueError(f"{what} names no format; suffixes are {', '.join(_FORMAT_BY_SUFFIX)}")
    return _FORMAT_BY_SUFFIX[suffix]


def read_content(path: str | os.PathLike[str]) -> bytes:
    """Read the bytes of a geometry file.

    Raises GeometryError for a directory, a FIFO, a device or a file that is too large, OSError if it cannot be opened.
    """
    try:
        return files.read_regular(path, MAX_BYTES)
    except files.NotRegularFileError as error:
        message = f"this is {error.kind}, not a geometry file"
        fix = "name the file inside it" if error.is_directory else "save the geometry to a file, and give that"
    except files.FileTooLargeError as error:
        message, fix = str(error.strerror), "name a geometry file; point clouds and meshes do not belong in one"
    raise GeometryError([Problem(Severity.ERROR, message, Location(os.fspath(path)), fix)])


def parse_content(
    content: bytes, file: str = "", variables: Mapping[str, str] | None = None, strict: bool = False
) -> ModelBuilder:
    """Return a builder with the parts of the model in `content` and every problem; never raises for the content.

    Problems name `file`. See `load_model` for the other parameters.
    """
    builder = ModelBuilder(strict=strict)
    text = content.removeprefix(b"\xef\xbb\xbf").lstrip()
    kind = files.detect_file_kind(text)
    if kind in _FIXES:
        named = files.find_geometry_path(text) if kind is files.FileKind.VEHICLE else ""
        what = kind.value if kind.is_empty else f"{kind.value}, not a geometry file"
        builder.add_error(what, Location(file), _FIXES[kind] + (f", {quote(named, 100)}" if named else ""))
        return builder
    from modelserver.formats import bot_frames

    with _pause_garbage_collector():
        if text.startswith(b"<") or PurePath(file).suffix.lower() in _XML_SUFFIXES:
            _read_xml(content, builder, file, variables or {})
        elif bot_frames.is_bot_param(text):
            bot_frames.load(content, builder, file)
        else:
            from modelserver.formats import yaml_geometry

            yaml_geometry.load(content, builder, file)
    return builder


@contextmanager
def _pause_garbage_collector() -> Iterator[None]:
    """Disable the garbage collector while a tree grows: walking it again and again doubles the time of a parse.

    All objects of a parse live until its end, so there is nothing to collect; sizes are bounded.
    """
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


def _read_xml(content: bytes, builder: ModelBuilder, file: str, variables: Mapping[str, str]) -> None:
    from modelserver.formats import miro, urdf, xml_document
    from modelserver.formats.common import label

    root = xml_document.parse(content, builder, file)
    if root is None:
        return
    name = xml_document.get_tag(root)
    first = Location(file, xml_document.get_line(root), f"<{label(name)}>")
    if name == "robot":
        urdf.load(root, builder, file)
        return
    if name in _OTHER_XML:
        builder.add_error(_OTHER_XML[name], first, "give a file in one of Miro's formats, URDF or YAML")
        return
    if next(root.iter("{*}config_group"), None) is not None:
        builder.add_error(_OTHER_XML["config_group"], first, "give the file with BodyName and ConstraintName in it")
        return
    before = len(builder.problems)
    if next(miro.find_instances(root), None) is not None:
        miro.load_frame_tree(root, builder, file, variables)
        if not miro.has_bodies(root):
            return
        # one configuration may hold both
    miro.load(root, builder, file)
    if builder.is_empty and not any(problem.severity == "error" for problem in builder.problems[before:]):
        builder.add_error(
            "there is no geometry in this file: no parameter BodyName, no instance of type FrameRpyParameters"
            + ("" if name == "config" else f", and the outermost element is {label(name)}, not config"),
            first,
            "a geometry file is <config><section><parameter> with bodies; see docs/geometry-files.md",
        )


def save_model(model: Model, file_format: str) -> SavedModel:
    """Return the text of `model` in one of `FORMATS`, and the features that the format does not support.

    Raises ValueError for an unknown format.
    """
    if file_format not in _WRITERS:
        raise ValueError(f"{quote(file_format)} is not a format; formats are {', '.join(FORMATS)}")
    saved: SavedModel = import_module(f"modelserver.formats.{_WRITERS[file_format]}").save(model)
    return saved


def load_model(
    path: str | os.PathLike[str],
    *,
    repair: bool = False,
    variables: Mapping[str, str] | None = None,
    strict: bool = False,
) -> Model:
    """Load the model in a geometry file.

    The format is detected from the content: YAML; Miro XML with bodies and constraints, or with a tree of frames; URDF;
    libbot2's coordinate frames.

    Parameters
    ----------
    repair : drop what is badly formed and what is not connected to the first body, with a warning, instead of rejecting
        the file
    variables : values of `$NAME` in a frame tree, before those of the environment
    strict : allow one constraint per frame at most, as the 2005 report does

    Returns
    -------
    The model; its `problems` are the warnings and notes. Raises GeometryError with every problem, OSError.
    """
    return parse_model(read_content(path), os.fspath(path), repair=repair, variables=variables, strict=strict)


def parse_model(
    text: bytes,
    file: str = "",
    *,
    repair: bool = False,
    variables: Mapping[str, str] | None = None,
    strict: bool = False,
) -> Model:
    """Return the model in the bytes of a geometry file, as `load_model`; problems name `file`."""
    return parse_content(text, file, variables, strict).build(repair)


def check_file(
    path: str | os.PathLike[str],
    variables: Mapping[str, str] | None = None,
    *,
    repair: bool = False,
    strict: bool = False,
) -> tuple[Model | None, tuple[Problem, ...]]:
    """Return the model in a file, None if there is an error, and every problem in the order of the file.

    Raises OSError if the file cannot be opened.
    """
    try:
        text = read_content(path)
    except GeometryError as error:
        return None, error.problems
    return parse_content(text, os.fspath(path), variables, strict).check(repair)


class FileExamination(NamedTuple):
    """The content of a geometry file, as far as it can be read."""

    model: Model | None = None
    """None if there is an error."""
    problems: tuple[Problem, ...] = ()
    """In the order of the file."""
    partial_model: Model | None = None
    """The bodies, without constraints if there is an error, to check references to frames; None without any body."""
    constraints: tuple[str, ...] | None = None
    """Names of all constraints; None if no body can be read."""


def examine_file(
    path: str | os.PathLike[str], variables: Mapping[str, str] | None = None, *, strict: bool = False
) -> FileExamination:
    """Read as much of a geometry file as is valid. Raises OSError if it cannot be opened."""
    try:
        text = read_content(path)
    except GeometryError as error:
        return FileExamination(problems=error.problems)
    builder = parse_content(text, os.fspath(path), variables, strict)
    model, problems = builder.check()
    partial = model or builder.build_bodies()
    return FileExamination(model, problems, partial, None if partial is None else builder.constraint_names)
