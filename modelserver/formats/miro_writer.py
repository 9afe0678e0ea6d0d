"""Write a model as Miro body and constraint XML, in the layout of the 2005 report's Annex C."""

from __future__ import annotations

from collections.abc import Iterator

from modelserver.formats.writing import (
    SavedModel,
    format_element,
    format_names,
    list_inertia_features,
    list_joint_and_shape_features,
)
from modelserver.geometry.model import Model
from modelserver.geometry.parts import Body, Constraint
from modelserver.transforms.pose import Pose


def save(model: Model) -> SavedModel:
    """Return the text of `model`, and its features that this format does not support."""
    bodies = [line for body in model.bodies for line in _format_body(body)]
    constraints = [line for each in model.constraints for line in _format_constraint(each)]
    lines = ['<?xml version="1.0" encoding="UTF-8"?>', "<config>", ' <section name="Geometry">']
    for name, inside in (("BodyList", bodies), ("ConstraintList", constraints)):
        lines += [f'  <parameter name="{name}">', *(f"    {line}" for line in inside), "  </parameter>"]
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


def _format_body(body: Body) -> Iterator[str]:
    lines = _format_head("BodyName", body.name, body.description)
    if body.pose is not None:
        lines += _format_transform(body.pose)
    lines.append('<parameter name="Frames">')
    for frame in body:
        inside = [*_format_head("FrameName", frame.name, frame.description), *_format_transform(frame.pose)]
        lines += [f"  {line}" for line in format_element("parameter", inside, "BodyFrame")]
    lines.append("</parameter>")
    return format_element("parameter", lines, "Body")


def _format_constraint(each: Constraint) -> Iterator[str]:
    lines = _format_head("ConstraintName", each.name, each.description)
    for key, end in (("From", each.from_), ("To", each.to)):
        lines += format_element("parameter", name=key, value=end)
    return format_element("parameter", [*lines, *_format_transform(each.default_pose)], "Constraint")


def _format_head(key: str, name: str, description: str) -> list[str]:
    lines = [*format_element("parameter", name=key, value=name)]
    if description:
        lines += format_element("parameter", name="Description", value=_fold_description(description))
    return lines


def _format_transform(pose: Pose) -> Iterator[str]:
    rows = enumerate(pose.matrix_rows()[:3], 1)
    inside = [line for n, row in rows for line in format_element("parameter", name=f"Row{n}", value=row)]
    return format_element("parameter", inside, name="HTransform")
