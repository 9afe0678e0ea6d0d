"""What a model has that URDF cannot hold."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from modelserver.formats.saved import some
from modelserver.geometry.inertia import rigid
from modelserver.geometry.model import Model


def losses(model: Model, stiff: list[str], led: Mapping[str, str]) -> Iterator[str]:
    """Yield it. `stiff` are joints that are written as fixed, `led` those that follow another in the file too."""
    frames = [frame for body in model.bodies for frame in body]
    texts = [model.description, *(each.description for each in model.bodies), *(each.description for each in frames)]
    if described := sum(map(bool, (*texts, *(each.description for each in model.constraints)))):
        yield f"{described} descriptions"
    if sigmas := sum(each is not None for each in (*(f.sigma for f in frames), *(c.sigma for c in model.constraints))):
        yield f"{sigmas} sigmas"
    if odd := [body.name for body in model.bodies if body.inertia is not None and rigid(body.inertia) is None]:
        yield f"the inertia of {some(odd)}: not that of a rigid body with mass"
    if posed := [body.name for body in model.bodies if body.pose is not None]:
        yield f"the own transform of {some(posed)}"
    if stiff:
        yield f"the motion of {some(stiff)}; written as fixed where it rests"
    moving = {name: each.joint for name, each in model.joints.items() if name not in stiff}
    if unled := [name for name, joint in moving.items() if joint.mimic is not None and name not in led]:
        yield f"which joint {some(unled)} follows"
    # one that follows another rests where that one does
    if resting := [name for name, joint in moving.items() if joint.default and joint.mimic is None]:
        yield f"the default position of {some(resting)}"
    if unsure := [name for name, joint in moving.items() if joint.sigma]:
        yield f"the sigma of the position of {some(unsure)}"
    if limited := [
        name for name, joint in moving.items() if joint.count > 1 and (joint.lower or joint.upper or joint.rate_limit)
    ]:
        yield f"the limits of {some(limited)}, which has several coordinates"
