"""Frames that programs add to the bodies of the geometry while the service runs, as tf2's static broadcaster does.

They are beside the geometry file, which stays as it is: a model is the file's with these frames. A reload of the file
adds them to what it read; one that does not fit, since its body is gone or the file has a frame of its name, is left
out until it does. Permanent ones are stored
(`persistence.AddedFramesStore`) and are there after a restart.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Final

from modelserver.geometry import Body, BodyFrame, Model, Sigma, names
from modelserver.messages import Lifetime, SetFrame

MAX_FRAMES: Final = 1_000
"""Added frames of a vehicle; each change sends the whole geometry, which 1,000 make 100 kB larger."""


def change_frames(frames: tuple[SetFrame, ...], request: SetFrame, of_file: Model) -> tuple[SetFrame, ...]:
    """Return the added frames after a request. Raises ValueError with the reason where it cannot be executed."""
    others = tuple(each for each in frames if each.frame != request.frame)
    if request.lifetime is Lifetime.REMOVED:
        if len(others) == len(frames):
            added = names.format_names([each.frame for each in frames]) or "there are none"
            raise ValueError(f"{request.frame!r} is no added frame; added frames: {added}")
        return others
    if len(others) >= MAX_FRAMES:
        raise ValueError(f"there are {MAX_FRAMES} added frames, more are not possible; remove one, or reuse its name")
    add_frame({body.name: body for body in of_file.bodies}, request)
    return (*others, request)


def add_frames(of_file: Model, frames: Iterable[SetFrame]) -> tuple[Model, dict[str, str]]:
    """Return a geometry with frames added to it; and of those that do not fit the reason, by name."""
    bodies = {body.name: body for body in of_file.bodies}
    left_out = {}
    for each in frames:
        try:
            bodies |= add_frame(bodies, each)
        except ValueError as error:
            left_out[each.frame] = str(error)
    if all(body is before for body, before in zip(bodies.values(), of_file.bodies, strict=True)):
        return of_file, left_out
    named = (of_file.name, of_file.description, of_file.problems)
    return Model(tuple(bodies.values()), of_file.constraints, *named), left_out


def add_frame(bodies: dict[str, Body], frame: SetFrame) -> dict[str, Body]:
    """Return the body of a frame with it, by name. Raises ValueError with the reason where it does not fit."""
    name, own = names.split(frame.frame)
    if why := names.find_problem(own):
        raise ValueError(f"frame {frame.frame!r}: {why}")
    body = bodies.get(name)
    if body is None:
        raise ValueError(
            f"frame {frame.frame!r}: the geometry has no such body; bodies: {names.format_names(list(bodies))}"
        )
    if body.has_frame(own):
        raise ValueError(f"the geometry file has a frame {frame.frame!r}; give the added one another name")
    sigma = Sigma(frame.position_sigma, frame.rotation_sigma)
    added = BodyFrame(own, frame.pose, "added at run time", None if sigma.is_zero else sigma)
    return {name: replace(body, frames=(*body.frames, added))}
