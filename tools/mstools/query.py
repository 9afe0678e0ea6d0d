"""`modelserver query`: where is one frame in another?"""

from __future__ import annotations

import json
import math
from datetime import UTC, datetime
from typing import Annotated, Any

import typer

from modelserver.messages import Invalid, Policy, PoseAnswer, Quality
from mstools.asking import JsonOption, ModelOption, PrefixOption, TimeoutOption, UrlOption, answers
from mstools.options import Variables

POLICIES = {policy.name.lower(): policy for policy in Policy}


def command(
    frame_of_interest: Annotated[str, typer.Argument(metavar="INTEREST", help="The frame that is looked for.")],
    frame_of_reference: Annotated[str, typer.Argument(metavar="REFERENCE", help="The frame that it is told in.")],
    model: ModelOption = None,
    settings: Variables = None,
    at: Annotated[
        str,
        typer.Option(
            "--at", metavar="TIME", help="Microseconds since 1970, or 2026-11-21T08:30:00.5Z (without Z: local time)."
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
    as_json: JsonOption = False,
    url: UrlOption = "",
    prefix: PrefixOption = "",
    timeout: TimeoutOption = 1.0,
) -> None:
    """Where is one frame in another? Frames are named Body:Frame.

    Asks the running daemon, or with --model a geometry file. World:UTM, World:ENU and Odom:Origin are known beside
    the file's frames. Exit code 1 where there is no answer; a pose that is not valid is printed, says why, and
    exits 0.

    Example: modelserver query Digiclops:ImagePlane FrontNoddingSICK:Origin --model config/raptor/geometry.xml
    """
    if policy not in POLICIES:
        raise typer.BadParameter(f"{policy!r} is not one of {', '.join(POLICIES)}", param_hint="--policy")
    if inverse:
        frame_of_interest, frame_of_reference = frame_of_reference, frame_of_interest
    source = answers(model, settings, url, prefix, timeout)
    answer = source.get_pose(
        frame_of_interest, frame_of_reference, at=_utime(at), policy=POLICIES[policy], wait_ms=wait_ms
    )
    typer.echo(json.dumps(as_dict(answer), indent=2) if as_json else describe(answer, matrix))


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
            f"{text!r} is neither microseconds since 1970 nor a time like 2026-11-21T08:30:00.5Z", param_hint="--at"
        ) from None


def describe(answer: PoseAnswer, matrix: bool = False) -> str:
    """Return an answer for people to read."""
    transformation = answer.transformation
    x, y, z = transformation.pose.xyz
    roll, pitch, yaw = (math.degrees(angle) + 0.0 for angle in transformation.rpy)
    quaternion = " ".join(f"{value:.6f}" for value in transformation.pose.wxyz)
    lines = [
        f"{transformation.frame_of_interest} in {transformation.frame_of_reference}",
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
        lines.append(f"  flags           {', '.join(flag.name or '' for flag in Quality if flag in answer.quality)}")
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
