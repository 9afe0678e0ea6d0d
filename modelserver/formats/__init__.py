"""Geometry files: read, check and write the formats of a model.

    model = load_model("config/raptor/geometry.xml")
    text, unsupported = save_model(model, "yaml")

Importing this package loads neither lxml nor yaml; each is imported for the first file of its format.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import NamedTuple

from modelserver.errors import GeometryError, Problem
from modelserver.formats.registry import FORMATS, format_of_path, parse_content, read_content, save_model
from modelserver.formats.writing import SavedModel
from modelserver.geometry.model import Model

__all__ = [
    "FORMATS",
    "FileExamination",
    "SavedModel",
    "check_file",
    "examine_file",
    "format_of_path",
    "load_model",
    "parse_model",
    "save_model",
]


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
    The model; its `problems` are the warnings and notes.

    Raises
    ------
    GeometryError
        The file is wrong; with every problem.
    OSError
        The file cannot be opened.
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
