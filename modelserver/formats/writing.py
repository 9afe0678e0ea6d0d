"""Shared by the writers of geometry files: result, numbers, XML elements, features that a format does not support."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from xml.sax import saxutils

from modelserver.geometry.model import Model


@dataclass(frozen=True, slots=True)
class SavedModel:
    """The text of a file, and the features of the model that it does not hold, each as a phrase."""

    text: str
    unsupported: tuple[str, ...] = ()


def format_number(value: float) -> str:
    """Return the shortest text that reads back as the same float, without a trailing `.0`."""
    text = repr(value)
    return text[:-2] if text.endswith(".0") else text


def escape(value: str) -> str:
    """Escape a text for an XML attribute."""
    return saxutils.escape(value, {'"': "&quot;"})


def format_element(
    tag: str, inside: Iterable[str] = (), comment: str = "", /, **attributes: str | float | Sequence[float]
) -> Iterator[str]:
    """Yield the lines of an XML element with the lines `inside`; a comment is written behind the start tag."""
    head = f"<{tag}"
    for key, value in attributes.items():
        if not isinstance(value, str):
            value = " ".join(map(format_number, [value] if isinstance(value, float) else value))
        head += f' {key}="{escape(value)}"'
    lines = [f"  {line}" for line in inside]
    if not lines:
        yield f"{head}/>"
        return
    yield f"{head}>" + (f" <!-- {comment} -->" if comment else "")
    yield from lines
    yield f"</{tag}>"


def format_names(names: list[str], limit: int = 5) -> str:
    rest = len(names) - limit
    return ", ".join(names[:limit]) + (f" and {rest} more" if rest > 0 else "")


def list_text_and_sigma_features(model: Model) -> Iterator[str]:
    """Yield how many descriptions and sigmas a format without them drops."""
    frames = [frame for body in model.bodies for frame in body]
    texts = [each.description for each in model.bodies] + [each.description for each in frames]
    texts += [model.description, *(each.description for each in model.constraints)]
    if described := sum(map(bool, texts)):
        yield f"{described} descriptions"
    if sigmas := sum(each is not None for each in (*(f.sigma for f in frames), *(c.sigma for c in model.constraints))):
        yield f"{sigmas} sigmas"


def list_inertia_features(model: Model) -> Iterator[str]:
    """Yield the bodies whose inertia a format without inertias drops."""
    if heavy := [body.name for body in model.bodies if body.inertia is not None]:
        yield f"the inertia of {len(heavy)} bodies: {format_names(heavy)}"


def list_joint_and_shape_features(model: Model) -> Iterator[str]:
    """Yield the joints that a format without joints writes as fixed, and the bodies whose shapes it drops."""
    if model.joints:
        count = f"{len(model.joints)} joint{'' if len(model.joints) == 1 else 's'}"
        yield f"the motion of {count}, written as fixed at the default position: {format_names(list(model.joints))}"
    for what, bodies in (
        ("visuals", [body.name for body in model.bodies if body.visuals]),
        ("collisions", [body.name for body in model.bodies if body.collisions]),
    ):
        if bodies:
            yield f"the {what} of {len(bodies)} bod{'y' if len(bodies) == 1 else 'ies'}: {format_names(bodies)}"
