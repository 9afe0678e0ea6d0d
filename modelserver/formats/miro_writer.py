"""Write a model as Miro body and constraint XML, in the layout of the 2005 report's Annex C."""

from __future__ import annotations

from collections.abc import Iterator

from modelserver.formats.writing import (
    SavedModel,
    format_names,
    format_number,
    list_inertia_features,
    list_joint_and_shape_features,
)
from modelserver.geometry.model import Model
from modelserver.geometry.parts import Body, BodyFrame, Constraint
from modelserver.transforms.pose import Pose

_ESCAPES = {ord("&"): "&amp;", ord("<"): "&lt;", ord(">"): "&gt;", ord('"'): "&quot;"}


def save(model: Model) -> SavedModel:
    """Return the text of `model`, and its features that this format does not support."""
    lines = ['<?xml version="1.0" encoding="UTF-8"?>', "<config>", ' <section name="Geometry">']
    lines += ['  <parameter name="BodyList">', *_indent(_format_bodies(model.bodies), 4), "  </parameter>"]
    lines += [
        '  <parameter name="ConstraintList">',
        *_indent(_format_constraints(model.constraints), 4),
        "  </parameter>",
    ]
    lines += [" </section>", "</config>"]
    return SavedModel("\n".join(lines) + "\n", tuple(_list_unsupported(model)))


def _list_unsupported(model: Model) -> Iterator[str]:
    if model.name:
        yield f"the model's name, {model.name}"
    if model.description:
        yield "the model's description"
    frames = [f"{body.name}:{frame.name}" for body in model.bodies for frame in body if frame.sigma is not None]
    if frames:
        yield f"the sigmas of {len(frames)} frames: {format_names(frames)}"
    constraints = [each.name for each in model.constraints if each.sigma is not None]
    if constraints:
        yield f"the sigmas of {len(constraints)} constraints: {format_names(constraints)}"
    yield from list_inertia_features(model)
    yield from list_joint_and_shape_features(model)
    described = [(body.name, body.description) for body in model.bodies]
    described += [(f"{body.name}:{frame.name}", frame.description) for body in model.bodies for frame in body]
    described += [(each.name, each.description) for each in model.constraints]
    if changed := [name for name, text in described if _fold_description(text) != text]:
        yield f"line breaks and control characters in {len(changed)} descriptions: {format_names(changed)}"


def _fold_description(text: str) -> str:
    """Return a text as it is read back: without control characters, which XML does not have, and with folded spaces."""
    return " ".join("".join(each if each.isprintable() else " " for each in text).split())


def _format_bodies(bodies: tuple[Body, ...]) -> Iterator[str]:
    for body in bodies:
        yield "<parameter> <!-- Body -->"
        yield _format_parameter("BodyName", body.name, 2)
        if body.description:
            yield _format_parameter("Description", _fold_description(body.description), 2)
        if body.pose is not None:
            yield from _indent(_format_transform(body.pose), 2)
        yield '  <parameter name="Frames">'
        for frame in body:
            yield from _indent(_format_frame(frame), 4)
        yield "  </parameter>"
        yield "</parameter>"


def _format_frame(frame: BodyFrame) -> Iterator[str]:
    yield "<parameter> <!-- BodyFrame -->"
    yield _format_parameter("FrameName", frame.name, 2)
    if frame.description:
        yield _format_parameter("Description", _fold_description(frame.description), 2)
    yield from _indent(_format_transform(frame.pose), 2)
    yield "</parameter>"


def _format_constraints(constraints: tuple[Constraint, ...]) -> Iterator[str]:
    for each in constraints:
        yield "<parameter> <!-- Constraint -->"
        yield _format_parameter("ConstraintName", each.name, 2)
        if each.description:
            yield _format_parameter("Description", _fold_description(each.description), 2)
        yield _format_parameter("From", each.from_, 2)
        yield _format_parameter("To", each.to, 2)
        yield from _indent(_format_transform(each.default_pose), 2)
        yield "</parameter>"


def _format_transform(pose: Pose) -> Iterator[str]:
    yield '<parameter name="HTransform">'
    for number, row in enumerate(pose.matrix_rows()[:3], 1):
        yield _format_parameter(f"Row{number}", " ".join(map(format_number, row)), 2)
    yield "</parameter>"


def _format_parameter(name: str, value: str, indent: int) -> str:
    return f'{" " * indent}<parameter name="{name}" value="{escape(value)}"/>'


def escape(value: str) -> str:
    """Escape a text for an XML attribute."""
    return value.translate(_ESCAPES)


def _indent(lines: Iterator[str], columns: int) -> Iterator[str]:
    return (" " * columns + line for line in lines)
