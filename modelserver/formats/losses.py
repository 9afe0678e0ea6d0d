"""What forms without joints and shapes lose of a model, as phrases for a person."""

from __future__ import annotations

from collections.abc import Iterator

from modelserver.formats.saved import some
from modelserver.geometry.model import Model


def of_joints(model: Model) -> Iterator[str]:
    """Yield which joints a form loses that writes them standing still."""
    if model.joints:
        count = f"{len(model.joints)} joint{'' if len(model.joints) == 1 else 's'}"
        yield f"the motion of {count}, written as fixed where they rest: {some(list(model.joints))}"


def of_shapes(model: Model) -> Iterator[str]:
    """Yield which bodies' visuals and collisions a form loses."""
    for what, bodies in (
        ("visuals", [body.name for body in model.bodies if body.visuals]),
        ("collisions", [body.name for body in model.bodies if body.collisions]),
    ):
        if bodies:
            yield f"the {what} of {len(bodies)} bod{'y' if len(bodies) == 1 else 'ies'}: {some(bodies)}"
