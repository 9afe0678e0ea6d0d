"""`modelserver query`: where is one frame in another?"""

from __future__ import annotations

import json
import math
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer

from modelserver.messages import Invalid, Policy, PoseAnswer, Quality, TimeQuery
from mstools.commands.asking import (
    AnswerSource,
    JsonOption,
    ModelOption,
    PrefixOption,
    TimeoutOption,
    UrlOption,
    answers,
    log_answers,
)
from mstools.commands.explain import describe_edges, describe_motion, edges_as_data, explaining, motion_as_data
from mstools.terminal.options import Variables
from mstools.terminal.output import safe

POLICIES = {policy.name.lower(): policy for policy in Policy}


def command(
    frame_of_interest: Annotated[str, typer.Argument(metavar="INTEREST", help="The frame that is looked for.")],
    frame_of_reference: Annotated[str, typer.Argument(metavar="REFERENCE", help="The frame that it is told in.")],
    model: ModelOption = None,
    settings: Variables = None,
    log: Annotated[
        Path | None,
        typer.Option("--log", metavar="FILE", help="Ask this LCM log of the service instead of the daemon."),
    ] = None,
    at: Annotated[
        str,
        typer.Option(
            "--at",
            metavar="TIME",
            help="Microseconds since 1970, or 2026-11-21T08:30:00.5Z (without Z: local time); with --log also +12.5, "
            "seconds from its start. Default: the latest.",
        ),
    ] = "",
    policy: Annotated[
        str, typer.Option("--policy", help=f"What is accepted for an answer at a time: {', '.join(POLICIES)}.")
    ] = "interpolated",
    wait_ms: Annotated[
        int, typer.Option("--wait-ms", min=0, max=60_000, help="Let the daemon wait for data that cover it.")
    ] = 0,
    inverse: Annotated[bool, typer.Option("--inverse", help="Print the reverse relation.")] = False,
    matrix: Annotated[bool, typer.Option("--matrix", help="Print the 4x4 transform too.")] = False,
    explain: Annotated[
        bool, typer.Option("--explain", help="Print each edge that the answer rests on, then the answer.")
    ] = False,
    motion: Annotated[
        bool, typer.Option("--motion", help="Print velocity, turn rate and how they change, then the pose.")
    ] = False,
    expressed_in: Annotated[
        str, typer.Option("--expressed-in", metavar="FRAME", help="Along whose axes --motion is told.")
    ] = "",
    as_json: JsonOption = False,
    url: UrlOption = "",
    prefix: PrefixOption = "",
    timeout: TimeoutOption = 1.0,
) -> None:
    """Where is one frame in another? Frames are named Body:Frame.

    Asks the running daemon, with --model a geometry file, or with --log what a log tells: the geometry that the service
    broadcast, its poses and the joints. World:UTM, World:ENU and Odom:Origin are known beside
    the file's frames. Exit code 1 where there is no answer; a pose that is not valid is printed, says why, and
    exits 0.

    --explain tells what the answer rests on: each frame, constraint and joint on the way, how it was come by, how old
    it is, who told it, and its share of what is unsure. --motion tells how the one frame moves in the other.

    \b
    Example:
      modelserver query Digiclops:ImagePlane FrontNoddingSICK:Origin --model config/raptor/geometry.xml
    """
    if expressed_in and not motion:
        raise typer.BadParameter(
            "it says along whose axes --motion is told; give that too", param_hint="--expressed-in"
        )
    if explain and motion:
        raise typer.BadParameter("--explain and --motion are two questions; ask one after the other")
    if policy not in POLICIES:
        raise typer.BadParameter(f"{policy!r} is not one of {', '.join(POLICIES)}", param_hint="--policy")
    if inverse:
        frame_of_interest, frame_of_reference = frame_of_reference, frame_of_interest
    source: AnswerSource
    utime = None
    if log is not None:
        recorded = source = log_answers(log, model, settings, prefix)
        utime = recorded.time(at)
    else:
        source = answers(model, settings, url, prefix, timeout)
    utime = _utime(at) if utime is None else utime
    if log is None:
        _check_unit(utime)
    if explain or motion:
        when = TimeQuery(utime, POLICIES[policy], wait_ms)
        ends = (frame_of_interest, frame_of_reference)
        told = _explained(source, *ends, when) if explain else _moved(source, *ends, expressed_in, when)
        typer.echo(json.dumps(told.data, indent=2) if as_json else f"{told.words}\n\n{describe(told.answer, matrix)}")
        return
    answer = source.get_pose(
        frame_of_interest,
        frame_of_reference,
        at=utime,
        policy=POLICIES[policy],
        wait_ms=wait_ms,
    )
    typer.echo(json.dumps(as_dict(answer), indent=2) if as_json else describe(answer, matrix))


class _Told(NamedTuple):
    """An answer with what was asked beyond it, in words and for scripts."""

    answer: PoseAnswer
    words: str
    data: dict[str, Any]


def _explained(source: object, interest: str, reference: str, time: TimeQuery) -> _Told:
    found = explaining(source).explain(interest, reference, at=time.at, policy=time.policy, wait_ms=time.wait_ms)
    data = as_dict(found.answer) | {"edges": edges_as_data(found)}
    return _Told(found.answer, describe_edges(found), data)


def _moved(source: object, interest: str, reference: str, axes: str, time: TimeQuery) -> _Told:
    found = explaining(source).get_motion(
        interest, reference, expressed_in=axes, at=time.at, policy=time.policy, wait_ms=time.wait_ms
    )
    return _Told(found.pose, describe_motion(found), as_dict(found.pose) | motion_as_data(found))


_SECONDS = (1_000_000_000, 10_000_000_000)
"""What seconds since 1970 are in this age; as microseconds that is the first three hours of 1970."""


def _check_unit(utime: int) -> None:
    if _SECONDS[0] < utime < _SECONDS[1]:
        raise typer.BadParameter(
            f"{utime} looks like seconds since 1970; times are microseconds: {utime}000000", param_hint="--at"
        )


def _utime(text: str) -> int:
    if not text:
        return 0
    if text.isascii() and text.isdigit():
        return int(text)
    try:
        when = datetime.fromisoformat(text)
        return round((when if when.tzinfo else when.astimezone()).timestamp() * 1e6)
    except (ValueError, OverflowError, OSError):
        raise typer.BadParameter(
            f"{text!r} is neither microseconds since 1970 nor a time like 2026-11-21T08:30:00.5Z, nor with --log "
            "seconds from its start like +12.5",
            param_hint="--at",
        ) from None


def describe(answer: PoseAnswer, matrix: bool = False) -> str:
    """Return an answer for people to read."""
    transformation = answer.transformation
    x, y, z = transformation.pose.xyz
    roll, pitch, yaw = (math.degrees(angle) + 0.0 for angle in transformation.rpy)
    quaternion = " ".join(f"{value:.6f}" for value in transformation.pose.wxyz)
    lines = [
        safe(f"{transformation.frame_of_interest} in {transformation.frame_of_reference}"),
        f"  position        {x + 0.0:.4f}  {y + 0.0:.4f}  {z + 0.0:.4f}  m",
        f"  roll pitch yaw  {roll:.3f}  {pitch:.3f}  {yaw:.3f}  deg",
        f"  quaternion      {quaternion}  (w x y z)",
    ]
    if transformation.covariance is not None:
        variances = [transformation.covariance[n, n] for n in range(6)]
        metres = "  ".join(f"{math.sqrt(value):.4f}" for value in variances[:3])
        degrees = "  ".join(f"{math.degrees(math.sqrt(value)):.3f}" for value in variances[3:])
        lines.append(f"  sigma           {metres}  m,  {degrees}  deg")
    if matrix:
        lines += ["  transform", *("    " + "  ".join(f"{v: .6f}" for v in row) for row in transformation.matrix)]
    if transformation.utime:
        when = datetime.fromtimestamp(transformation.utime * 1e-6, UTC)
        lines.append(f"  at              {when.isoformat()}  ({transformation.utime})")
    if answer.origin is not None:
        origin = answer.origin
        easting, northing, height = (value + shift for value, shift in zip(origin.initial_utm, (x, y, z), strict=True))
        if transformation.frame_of_reference == "World:UTM":
            half = "N" if origin.north else "S"
            lines.append(
                f"  UTM             {easting:.3f} E  {northing:.3f} N  {height:.3f} up  zone {origin.zone}{half}"
            )
        lines.append(f"  epoch           {transformation.pose_epoch}, origin {origin.origin_id:016x}")
    if not math.isnan(answer.horizontal_bound):
        bound = f"{answer.horizontal_bound:.2f} m, heading {math.degrees(answer.heading_bound):.2f} deg"
        lines.append(f"  bounds          {bound}")
    if answer.quality:
        flags = ", ".join(flag.name or "" for flag in Quality if flag in answer.quality)
        lines.append(f"  flags           {flags}: {answer.quality.explain()}")
    if not transformation.valid:
        lines.append(f"  NOT VALID       {Invalid(transformation.invalid_reasons).explain()}")
    return "\n".join(lines)


def as_dict(answer: PoseAnswer) -> dict[str, Any]:
    """Return an answer for scripts to read; what is not known is null."""
    transformation = answer.transformation
    covariance = transformation.covariance
    origin = answer.origin
    return {
        "frame_of_interest": transformation.frame_of_interest,
        "frame_of_reference": transformation.frame_of_reference,
        "utime": transformation.utime,
        "position": list(transformation.pose.xyz),
        "quaternion": list(transformation.pose.wxyz),
        "rpy": transformation.rpy.tolist(),
        "matrix": [list(row) for row in transformation.pose.matrix_rows()],
        "covariance": None if covariance is None else covariance.tolist(),
        "valid": transformation.valid,
        "invalid_reasons": [flag.name for flag in Invalid if flag & transformation.invalid_reasons],
        "flags": [flag.name for flag in Quality if flag in answer.quality],
        "initial_utm": None if origin is None else list(origin.initial_utm),
        "utm_zone": None if origin is None else f"{origin.zone}{'N' if origin.north else 'S'}",
        "origin_id": f"{transformation.origin_id:016x}" if transformation.origin_id else None,
        "pose_epoch": transformation.pose_epoch,
        "horizontal_bound": _number(answer.horizontal_bound),
        "heading_bound": _number(answer.heading_bound),
        "model_revision": transformation.model_revision,
    }


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None
