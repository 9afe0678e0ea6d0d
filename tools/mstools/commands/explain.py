"""What `modelserver query` tells beyond the pose: what an answer rests on, and how a frame moves."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, Protocol, runtime_checkable

import numpy as np

from modelserver.errors import ModelServerError
from modelserver.messages import EdgeReport, Explanation, MotionAnswer, Policy
from modelserver.spatial import so3
from modelserver.spatial.pose import Pose
from mstools.terminal.output import safe
from mstools.terminal.table import drawable, table

_HEAD = ("kind", "name", "passed", "how", "age", "source", "stands at", "position", "rotation")


@runtime_checkable
class Explains(Protocol):
    """Where explanations and motions come from: the daemon, or a file, which knows no motion."""

    def explain(
        self,
        frame_of_interest: str,
        frame_of_reference: str,
        *,
        at: int = 0,
        policy: Policy = Policy.INTERPOLATED,
        wait_ms: int = 0,
    ) -> Explanation:
        """Return what an answer rests on."""
        ...

    def get_motion(
        self,
        frame_of_interest: str,
        frame_of_reference: str,
        *,
        expressed_in: str = "",
        at: int = 0,
        policy: Policy = Policy.INTERPOLATED,
        wait_ms: int = 0,
    ) -> MotionAnswer:
        """Return how a frame moves in another."""
        ...


def explaining(source: object) -> Explains:
    """Return where explanations come from. Raises ModelServerError where it gives none."""
    if not isinstance(source, Explains):
        raise ModelServerError("what is asked here gives poses only; ask the daemon for --explain and --motion")
    return source


# --- what an answer rests on ----------------------------------------------------------------------------------------


def describe_edges(explanation: Explanation) -> str:
    """Return the edges of an explanation as a table for people to read, from the frame of reference on."""
    transformation = explanation.answer.transformation
    heading = safe(f"{transformation.frame_of_interest} in {transformation.frame_of_reference} rests on")
    if not explanation.edges:
        return f"{heading} nothing: both stand in one place by definition"
    rows = [
        (
            edge.kind,
            edge.name,
            _passed(edge),
            edge.how.replace("_", " "),
            "-" if math.isnan(edge.age) else f"{edge.age:.3f} s",
            edge.source or "-",
            ", ".join(coordinates(edge)) or "-",
            _percent(edge.position_share),
            _percent(edge.rotation_share),
        )
        for edge in explanation.edges
    ]
    total = ("sum", *[""] * 6, _sum(each.position_share for each in explanation.edges),
             _sum(each.rotation_share for each in explanation.edges))  # fmt: skip
    lines = [heading, table(_HEAD, [*rows, total], numbers=(4, 7, 8))]
    lines.append("  position and rotation: shares of the sum of the variances")
    lines += [f"  {edge.name}: {edge.doubt}" for edge in explanation.edges if edge.doubt]
    if any(math.isnan(edge.position_share) for edge in explanation.edges):
        lines.append("  no share: nobody states a sigma there; it counts as exact for the shares of the others")
    return drawable("\n".join(lines))


def _passed(edge: EdgeReport) -> str:
    near, far = edge.ends if edge.forward else reversed(edge.ends)
    return f"{near} → {far}{'' if edge.forward else ', inverse'}"


def _percent(share: float) -> str:
    return "-" if math.isnan(share) else f"{100.0 * share:.1f} %"


def _sum(shares: Iterable[float]) -> str:
    known = [share for share in shares if not math.isnan(share)]
    return _percent(sum(known)) if known else "-"


def coordinates(edge: EdgeReport) -> list[str]:
    """Return where a joint stands, in degrees and metres: its own motion tells which of its numbers are angles."""
    values = edge.coordinates
    if values == (0.0,):
        return ["0"]
    X = edge.pose if edge.forward else edge.pose.inverse()
    match len(values):
        case 1:
            angles: tuple[bool, ...] = (X.xyz == (0.0, 0.0, 0.0),)
        case 3:
            x, y, z = values
            angles = (
                (True,) * 3
                if X.is_close(Pose((0.0, 0.0, 0.0), so3.exponential((x, y, z))), 1e-9, 1e-9)
                else (False, False, True)
            )
        case _:
            angles = (False,) * 3 + (True,) * 3
    return [
        f"{math.degrees(value) + 0.0:.3f} deg" if angle else f"{value + 0.0:.4f} m"
        for value, angle in zip(values, angles, strict=False)
    ]


def edges_as_data(explanation: Explanation) -> list[dict[str, Any]]:
    """Return the edges for scripts to read; what is not known is null. Angles are radians."""
    return [
        {
            "kind": edge.kind,
            "name": edge.name,
            "from": edge.ends[0],
            "to": edge.ends[1],
            "forward": edge.forward,
            "position": list(edge.pose.xyz),
            "quaternion": list(edge.pose.wxyz),
            "how": edge.how,
            "stamp": edge.stamp or None,
            "age": _known(edge.age),
            "source": edge.source or None,
            "coordinates": list(edge.coordinates),
            "position_share": _known(edge.position_share),
            "rotation_share": _known(edge.rotation_share),
            "doubt": edge.doubt or None,
        }
        for edge in explanation.edges
    ]


# --- how a frame moves ----------------------------------------------------------------------------------------------


def describe_motion(motion: MotionAnswer) -> str:
    """Return a motion for people to read: metres and degrees, a second, along the axes of `expressed_in`."""
    transformation = motion.pose.transformation
    sigmas = _sigmas(motion)
    rows = [
        ("velocity", motion.velocity, 1.0, "m/s", sigmas[:3]),
        ("turn rate", motion.rate, math.degrees(1.0), "deg/s", sigmas[3:]),
        ("acceleration", motion.acceleration, 1.0, "m/s2", ()),
        ("turn acceleration", motion.turn_acceleration, math.degrees(1.0), "deg/s2", ()),
    ]
    lines = [
        safe(f"{transformation.frame_of_interest} moves in {transformation.frame_of_reference}, ")
        + safe(f"along the axes of {motion.expressed_in}")
    ]
    for name, values, scale, unit, sigma in rows:
        text = f"  {name:<19}{_scaled(values, scale, unit)}"
        lines.append(f"{text},  sigma {_scaled(sigma, scale, '')}".rstrip() if sigma else text)
    if not sigmas:
        lines.append("  sigma           not known")
    return "\n".join(lines)


def motion_as_data(motion: MotionAnswer) -> dict[str, Any]:
    """Return a motion for scripts to read: SI, radians; what is not known is null."""
    return {
        "expressed_in": motion.expressed_in,
        "velocity": [_known(value) for value in motion.velocity],
        "rate": [_known(value) for value in motion.rate],
        "acceleration": [_known(value) for value in motion.acceleration],
        "turn_acceleration": [_known(value) for value in motion.turn_acceleration],
        "motion_covariance": None if motion.covariance is None else np.array(motion.covariance).reshape(6, 6).tolist(),
    }


def _sigmas(motion: MotionAnswer) -> tuple[float, ...]:
    if motion.covariance is None:
        return ()
    return tuple(math.sqrt(max(motion.covariance[7 * n], 0.0)) for n in range(6))


def _scaled(values: Iterable[float], scale: float, unit: str) -> str:
    known = list(values)
    if any(map(math.isnan, known)):
        return "not known"
    return "  ".join(f"{scale * value + 0.0:.4f}" for value in known) + f"  {unit}".rstrip()


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None
