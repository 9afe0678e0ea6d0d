"""Geometry files: reading, checking and writing the forms that a model may stand in.

    model = load_model("config/raptor/geometry.xml")
    text, losses = save_model(model, "yaml")

Importing this loads neither lxml nor yaml; each is imported when a file of its kind is met.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import NamedTuple

from modelserver.errors import GeometryError, Problem
from modelserver.formats import content, registry
from modelserver.formats.registry import FORMS, form_of_path
from modelserver.formats.saved import Saved
from modelserver.geometry.model import Model

__all__ = [
    "FORMS",
    "Examined",
    "Saved",
    "check_file",
    "examine_file",
    "form_of_path",
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
    """Return the model in a geometry file; its `problems` hold the warnings and notes.

    The form is told by the content: YAML; Miro XML, with bodies and constraints or with a tree of frames; URDF; or
    libbot2's coordinate frames.
    `variables` fill `$NAME` in a frame tree, before the environment does. With `repair`, what is badly formed
    and what is not traceable to the first body is dropped and reported instead of refused. With `strict`, a frame has
    one constraint at most, as in 2005.

    Raises GeometryError, with every problem, where the file is wrong; OSError where it cannot be opened.
    """
    return parse_model(content.read(path), os.fspath(path), repair=repair, variables=variables, strict=strict)


def parse_model(
    text: bytes,
    file: str = "",
    *,
    repair: bool = False,
    variables: Mapping[str, str] | None = None,
    strict: bool = False,
) -> Model:
    """Return the model that the bytes of a geometry file hold; as `load_model`, with `file` named in problems."""
    return registry.read(text, file, variables, strict).build(repair)


def check_file(
    path: str | os.PathLike[str],
    variables: Mapping[str, str] | None = None,
    *,
    repair: bool = False,
    strict: bool = False,
) -> tuple[Model | None, tuple[Problem, ...]]:
    """Return the model in a file, None where there is an error, and every problem in the order of the file.

    Raises OSError where the file cannot be opened.
    """
    try:
        text = content.read(path)
    except GeometryError as error:
        return None, error.problems
    return registry.read(text, os.fspath(path), variables, strict).check(repair)


class Examined(NamedTuple):
    """What is found in a geometry file.

    model: None where there is an error. problems: in the order of the file. stated: the bodies of a file with errors
    too, without constraints, so that what others say of its frames can be checked; None where none can be read.
    constraints: the names of all constraints; None where no body can be read.
    """

    model: Model | None = None
    problems: tuple[Problem, ...] = ()
    stated: Model | None = None
    constraints: tuple[str, ...] | None = None


def examine_file(
    path: str | os.PathLike[str], variables: Mapping[str, str] | None = None, *, strict: bool = False
) -> Examined:
    """Return what is in a geometry file, as far as it can be read. Raises OSError where it cannot be opened."""
    try:
        text = content.read(path)
    except GeometryError as error:
        return Examined(problems=error.problems)
    builder = registry.read(text, os.fspath(path), variables, strict)
    model, problems = builder.check()
    stated = model or builder.stated()
    return Examined(model, problems, stated, None if stated is None else builder.constraint_names)


def save_model(model: Model, form: str) -> Saved:
    """Return the text of `model` in a form (`FORMS`), and what that form cannot hold.

    Raises ValueError for a form that is not known.
    """
    return registry.save(model, form)
