"""Writing a model as Miro body and constraint XML, laid out as in the report's Annex C."""

from __future__ import annotations

from collections.abc import Iterator

from modelserver.formats import losses
from modelserver.formats.saved import Saved, plain, some
from modelserver.geometry.model import Model
from modelserver.geometry.parts import Body, BodyFrame, Constraint
from modelserver.spatial.pose import Pose

_ESCAPES = {ord("&"): "&amp;", ord("<"): "&lt;", ord(">"): "&gt;", ord('"'): "&quot;"}


def save(model: Model) -> Saved:
    """Return the text of `model`, and what it has that this form cannot hold."""
    lines = ['<?xml version="1.0" encoding="UTF-8"?>', "<config>", ' <section name="Geometry">']
    lines += ['  <parameter name="BodyList">', *_indented(_bodies(model.bodies), 4), "  </parameter>"]
    lines += ['  <parameter name="ConstraintList">', *_indented(_constraints(model.constraints), 4), "  </parameter>"]
    lines += [" </section>", "</config>"]
    return Saved("\n".join(lines) + "\n", tuple(_losses(model)))


def _losses(model: Model) -> Iterator[str]:
    if model.name:
        yield f"the model's name, {model.name}"
    if model.description:
        yield "the model's description"
    frames = [f"{body.name}:{frame.name}" for body in model.bodies for frame in body if frame.sigma is not None]
    if frames:
        yield f"the sigmas of {len(frames)} frames: {some(frames)}"
    constraints = [each.name for each in model.constraints if each.sigma is not None]
    if constraints:
        yield f"the sigmas of {len(constraints)} constraints: {some(constraints)}"
    if heavy := [body.name for body in model.bodies if body.inertia is not None]:
        yield f"the inertia of {len(heavy)} bodies: {some(heavy)}"
    yield from losses.of_joints(model)
    yield from losses.of_shapes(model)
    if changed := [name for name, text in _descriptions(model) if _description(text) != text]:
        yield f"line breaks and control characters in {len(changed)} descriptions: {some(changed)}"


def _descriptions(model: Model) -> Iterator[tuple[str, str]]:
    for body in model.bodies:
        yield body.name, body.description
        for frame in body:
            yield f"{body.name}:{frame.name}", frame.description
    for constraint in model.constraints:
        yield constraint.name, constraint.description


def _description(text: str) -> str:
    """Return a text as it will be read back: XML has no control characters, and white space is folded."""
    return " ".join("".join(each if each.isprintable() else " " for each in text).split())


def _bodies(bodies: tuple[Body, ...]) -> Iterator[str]:
    for body in bodies:
        yield "<parameter> <!-- Body -->"
        yield _parameter("BodyName", body.name, 2)
        if body.description:
            yield _parameter("Description", _description(body.description), 2)
        if body.pose is not None:
            yield from _indented(_transform(body.pose), 2)
        yield '  <parameter name="Frames">'
        for frame in body:
            yield from _indented(_frame(frame), 4)
        yield "  </parameter>"
        yield "</parameter>"


def _frame(frame: BodyFrame) -> Iterator[str]:
    yield "<parameter> <!-- BodyFrame -->"
    yield _parameter("FrameName", frame.name, 2)
    if frame.description:
        yield _parameter("Description", _description(frame.description), 2)
    yield from _indented(_transform(frame.pose), 2)
    yield "</parameter>"


def _constraints(constraints: tuple[Constraint, ...]) -> Iterator[str]:
    for each in constraints:
        yield "<parameter> <!-- Constraint -->"
        yield _parameter("ConstraintName", each.name, 2)
        if each.description:
            yield _parameter("Description", _description(each.description), 2)
        yield _parameter("From", each.from_, 2)
        yield _parameter("To", each.to, 2)
        yield from _indented(_transform(each.at_rest), 2)
        yield "</parameter>"


def _transform(pose: Pose) -> Iterator[str]:
    yield '<parameter name="HTransform">'
    for number, row in enumerate(pose.matrix_rows()[:3], 1):
        yield _parameter(f"Row{number}", " ".join(map(plain, row)), 2)
    yield "</parameter>"


def _parameter(name: str, value: str, indent: int) -> str:
    return f'{" " * indent}<parameter name="{name}" value="{escaped(value)}"/>'


def escaped(value: str) -> str:
    """Return a text as it stands in an attribute."""
    return value.translate(_ESCAPES)


def _indented(lines: Iterator[str], columns: int) -> Iterator[str]:
    return (" " * columns + line for line in lines)
