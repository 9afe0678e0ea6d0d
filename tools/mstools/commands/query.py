"""`modelserver query`: the pose of one frame in another, with --explain its edges, with --motion its velocity."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from modelserver.client.remote import NO_DEMAND, FrameClient, R
from modelserver.errors import (
    ModelServerError,
    NoServerError,
    QueryError,
    UnknownFrameError,
    find_nearest_names,
    quote,
)
from modelserver.geometry import names
from modelserver.messages import (
    NO_FLAGS,
    EdgeReport,
    Explanation,
    ExplanationReply,
    GetExplanation,
    GetMotion,
    Invalid,
    MotionAnswer,
    Policy,
    PoseAnswer,
    PoseDemand,
    Quality,
    Unmet,
)
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from mstools.terminal.options import (
    JsonOption,
    ModelOption,
    PrefixOption,
    TimeoutOption,
    UrlOption,
    Variables,
    argument,
    choose_name,
    complete_frame,
    option,
    parse_variables,
)
from mstools.terminal.output import catch_signals, escape, format_table, load_given_model, replace_unencodable, to_json

if TYPE_CHECKING:
    from mstools.recordings.log_platform import LogPlatform

_EDGE_HEADER = ("kind", "name", "passed", "provenance", "age", "source", "coordinates", "position", "rotation")


# --- explanation


def describe_edges(explanation: Explanation) -> str:
    """Format the edges of an explanation as a table, from the frame of reference on."""
    transformation = explanation.answer.transformation
    heading = escape(f"{transformation.frame_of_interest} in {transformation.frame_of_reference} rests on")
    if not explanation.edges:
        return f"{heading} nothing: both are the same frame"
    rows = [
        (
            edge.kind,
            edge.name,
            f"{' → '.join(edge.ends if edge.forward else edge.ends[::-1])}{'' if edge.forward else ', inverse'}",
            edge.provenance.replace("_", " "),
            "-" if math.isnan(edge.age) else f"{edge.age:.3f} s",
            edge.source or "-",
            ", ".join(format_coordinates(edge)) or "-",
            _format_shares(edge.position_share),
            _format_shares(edge.rotation_share),
        )
        for edge in explanation.edges
    ]
    position = _format_shares(*(each.position_share for each in explanation.edges))
    rotation = _format_shares(*(each.rotation_share for each in explanation.edges))
    rows.append(("sum", "", "", "", "", "", "", position, rotation))
    lines = [heading, format_table(_EDGE_HEADER, rows, numbers=(4, 7, 8))]
    lines.append("  position and rotation: shares of the sum of the variances")
    lines += [f"  {edge.name}: {edge.warning}" for edge in explanation.edges if edge.warning]
    if any(math.isnan(edge.position_share) for edge in explanation.edges):
        lines.append("  no share: no sigma is known; the shares of the others count it as exact")
    return replace_unencodable("\n".join(lines))


def _format_shares(*shares: float) -> str:
    known = [share for share in shares if not math.isnan(share)]
    return f"{100.0 * sum(known):.1f} %" if known else "-"


def format_coordinates(edge: EdgeReport) -> list[str]:
    """Format a joint's coordinates in degrees and meters; its transform shows which of them are angles."""
    values = edge.coordinates
    if values == (0.0,):
        return ["0"]
    X = edge.pose if edge.forward else edge.pose.inverse()
    angles: tuple[bool, ...] = (False,) * 3 + (True,) * 3
    if len(values) == 1:
        angles = (X.xyz == (0.0, 0.0, 0.0),)
    elif len(values) == 3:
        x, y, z = values
        is_spherical = X.is_close(Pose((0.0, 0.0, 0.0), so3.exponential((x, y, z))), 1e-9, 1e-9)
        angles = (True,) * 3 if is_spherical else (False, False, True)
    return [
        f"{math.degrees(value) + 0.0:.3f} deg" if angle else f"{value + 0.0:.4f} m"
        for value, angle in zip(values, angles, strict=False)
    ]


def edges_as_data(explanation: Explanation) -> list[dict[str, Any]]:
    """Return the edges as JSON data, in radians; unknown values are null."""
    return [
        to_json(
            {
                "kind": edge.kind,
                "name": edge.name,
                "from": edge.ends[0],
                "to": edge.ends[1],
                "forward": edge.forward,
                "position": edge.pose.xyz,
                "quaternion": edge.pose.wxyz,
                "provenance": edge.provenance,
                "stamp": edge.stamp or None,
                "age": edge.age,
                "source": edge.source or None,
                "coordinates": edge.coordinates,
                "position_share": edge.position_share,
                "rotation_share": edge.rotation_share,
                "warning": edge.warning or None,
            }
        )
        for edge in explanation.edges
    ]


# --- motion


def describe_motion(motion: MotionAnswer) -> str:
    """Format a motion in meters, degrees and seconds, along the axes of `expressed_in`."""
    transformation = motion.pose.transformation
    sigmas, changes = (
        () if covariance is None else tuple(math.sqrt(max(covariance[7 * n], 0.0)) for n in range(6))
        for covariance in (motion.covariance, motion.acceleration_covariance)
    )
    rows = [
        ("velocity", motion.velocity, 1.0, "m/s", sigmas[:3]),
        ("turn rate", motion.angular_velocity, math.degrees(1.0), "deg/s", sigmas[3:]),
        ("acceleration", motion.acceleration, 1.0, "m/s2", changes[:3]),
        ("angular acceleration", motion.angular_acceleration, math.degrees(1.0), "deg/s2", changes[3:]),
    ]
    where = f"{transformation.frame_of_interest} moves in {transformation.frame_of_reference}"
    lines = [escape(f"{where}, along the axes of {motion.expressed_in}")]
    for name, values, scale, unit, sigma in rows:
        text = f"  {name:<21}{_format_vector(values, scale, unit)}"
        lines.append(f"{text},  sigma {_format_vector(sigma, scale, '')}".rstrip() if sigma else text)
    if not sigmas:
        lines.append("  sigma                unknown")
    return "\n".join(lines)


def motion_as_data(motion: MotionAnswer) -> dict[str, Any]:
    """Return a motion as JSON data in SI units; unknown values are null."""
    names = ("expressed_in", "velocity", "angular_velocity", "acceleration", "angular_acceleration")
    data = {name: to_json(getattr(motion, name)) for name in names}
    first, second = (
        None if covariance is None else np.array(covariance).reshape(6, 6).tolist()
        for covariance in (motion.covariance, motion.acceleration_covariance)
    )
    return data | {"motion_covariance": first, "acceleration_covariance": second}


def _format_vector(values: Iterable[float], scale: float, unit: str) -> str:
    known = list(values)
    if any(map(math.isnan, known)):
        return "unknown"
    return "  ".join(f"{scale * value + 0.0:.4f}" for value in known) + f"  {unit}".rstrip()


MAX_WATCH_HZ = 100.0
"""A terminal shows no more, and a client is served at this rate (docs/reliability.md)."""

EXIT_UNMET = 3
"""Exit code of an answer that does not meet the demand."""

POLICIES = {policy.name.lower(): policy for policy in Policy}


def command(
    frame_of_interest: Annotated[str, argument("INTEREST", "Frame of interest.", autocompletion=complete_frame)],
    frame_of_reference: Annotated[str, argument("REFERENCE", "Frame of reference.", autocompletion=complete_frame)],
    model: ModelOption = None,
    settings: Variables = None,
    log: Annotated[
        Path | None, option("--log FILE", "Query this LCM log of the service instead of the daemon.")
    ] = None,
    at: Annotated[
        str,
        option(
            "--at TIME",
            "Microseconds since 1970, or 2026-11-21T08:30:00.5Z (without Z: local time); with --log also +12.5, "
            "seconds from its start. Default: the latest.",
        ),
    ] = "",
    policy: Annotated[
        str, option("--policy", f"What is accepted at that time: {', '.join(POLICIES)}.")
    ] = "interpolated",
    wait_ms: Annotated[int, option("--wait-ms", "Let the daemon wait for data that cover it.", min=0, max=60_000)] = 0,
    watch: Annotated[
        float, option("--watch HZ", "Ask again at this rate until Ctrl-C.", min=0.0, max=MAX_WATCH_HZ)
    ] = 0.0,
    explain: Annotated[bool, option("--explain", "Print each edge on the path, then the pose.")] = False,
    motion: Annotated[bool, option("--motion", "Print velocity and acceleration, then the pose.")] = False,
    expressed_in: Annotated[
        str, option("--expressed-in FRAME", "Axes of the vectors of --motion.", autocompletion=complete_frame)
    ] = "",
    max_horizontal: Annotated[
        float, option("--max-horizontal M", "Demand that the horizontal error is within this, meters.")
    ] = 0.0,
    max_heading: Annotated[float, option("--max-heading DEG", "The same of the heading error, degrees.")] = 0.0,
    max_age: Annotated[float, option("--max-age S", "Demand that the newest data are not older, seconds.")] = 0.0,
    min_integrity: Annotated[
        float, option("--min-integrity P", "Demand a valid pose, and its limits with this probability. Default: 0.99.")
    ] = 0.0,
    as_json: JsonOption = False,
    url: UrlOption = "",
    prefix: PrefixOption = "",
    timeout: TimeoutOption = 1.0,
) -> None:
    """Print the pose of one frame in another. Frames are named Body:Frame, or by a body alone its frame Origin.

    Queries the running daemon, with --model a geometry file, or with --log the geometry, poses and joints of a log.
    World:UTM, World:ENU and Odom:Origin, in short utm, map and odom, exist beside the frames of the geometry. Exit code
    1 if there is no answer, 3 if a demand (--max-..., --min-integrity) is unmet, which is printed with the reason; a
    pose that is not valid is printed with the reason, and exits 0. With --watch, what has no answer is printed and
    asked again, and JSON is one line an answer.

    --explain prints each frame, constraint and joint on the path with its provenance, age, source, and share of the
    variance. --motion prints velocity and acceleration, linear and angular.

    \b
    Example:
      modelserver query Digiclops:ImagePlane FrontNoddingSICK --model config/raptor/geometry.xml
      modelserver query base_link map --watch 2
    """
    if watch and (at or log is not None):
        raise typer.BadParameter("shows the latest pose: it goes without --at and --log", param_hint="--watch")
    when = POLICIES[choose_name(policy, POLICIES, "policy", "--policy")]
    if expressed_in and not motion:
        raise typer.BadParameter("needs --motion, whose axes it sets", param_hint="--expressed-in")
    if explain and motion:
        raise typer.BadParameter("--explain and --motion exclude each other; run one after the other")
    is_demanding = any((max_horizontal, max_heading, max_age, min_integrity))
    if is_demanding and (explain or motion):
        raise typer.BadParameter("--explain and --motion go without a demand; run one after the other")
    source: FrameClient
    if log is not None:
        recorded = source = open_log_answers(log, model, settings, prefix)
        utime = recorded.parse_time(at)
        utime = _parse_time(at) if utime is None else utime
    else:
        if model is not None:
            source = FileAnswers(model, settings)
        else:
            from modelserver.client.remote import Platform

            source = Platform(url, channel_prefix=prefix, timeout=timeout, name="modelserver")
        utime = _parse_time(at)
        # our time in seconds; as microseconds it would be the first three hours of 1970
        if 1_000_000_000 < utime < 10_000_000_000:
            raise typer.BadParameter(
                f"{utime} looks like seconds since 1970; times are microseconds: {utime}000000", param_hint="--at"
            )
    ends = (frame_of_interest, frame_of_reference)

    def ask() -> tuple[PoseAnswer, str]:
        text, data = "", dict[str, Any]()
        if explain:
            found = source.explain(*ends, at=utime, policy=when, wait_ms=wait_ms)
            answer, text, data = found.answer, f"{describe_edges(found)}\n\n", {"edges": edges_as_data(found)}
        elif motion:
            moving = source.get_motion(*ends, expressed_in=expressed_in, at=utime, policy=when, wait_ms=wait_ms)
            answer, text, data = moving.pose, f"{describe_motion(moving)}\n\n", motion_as_data(moving)
        else:
            answer = source.get_pose(
                *ends,
                at=utime,
                policy=when,
                wait_ms=wait_ms,
                max_horizontal=max_horizontal,
                max_heading=math.radians(max_heading),
                max_age=max_age,
                min_integrity=min_integrity,
            )
        if as_json:
            return answer, json.dumps(as_dict(answer) | data, indent=None if watch else 2)
        met = "\n  demand          met" if is_demanding and not answer.unmet else ""
        return answer, text + describe(answer) + met

    if watch:
        watch_answers(lambda: ask()[1], 1.0 / watch)
        return
    answer, shown = ask()
    typer.echo(shown)
    if answer.unmet:
        raise typer.Exit(EXIT_UNMET)


def watch_answers(ask: Callable[[], str], period: float) -> None:
    """Print an answer each `period` seconds until a signal; why there is none goes to stderr, a reason once."""
    reason = ""
    with catch_signals() as stop:
        due = time.monotonic()
        while not stop.is_set():
            try:
                typer.echo(ask())
                reason = ""
            except (QueryError, NoServerError) as error:
                if str(error) != reason:
                    reason = str(error)
                    typer.echo(f"modelserver: {escape(reason)}", err=True)
            # after a long answer the next one is due at once, and not all those missed
            due = max(due + period, time.monotonic())
            stop.wait(due - time.monotonic())


def _parse_time(text: str) -> int:
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


def describe(answer: PoseAnswer) -> str:
    transformation = answer.transformation
    x, y, z = transformation.pose.xyz
    roll, pitch, yaw = (math.degrees(angle) + 0.0 for angle in transformation.rpy)
    quaternion = " ".join(f"{value:.6f}" for value in transformation.pose.wxyz)
    lines = [
        escape(f"{transformation.frame_of_interest} in {transformation.frame_of_reference}"),
        f"  position        {x + 0.0:.4f}  {y + 0.0:.4f}  {z + 0.0:.4f}  m",
        f"  roll pitch yaw  {roll:.3f}  {pitch:.3f}  {yaw:.3f}  deg",
        f"  quaternion      {quaternion}  (w x y z)",
    ]
    if transformation.covariance is not None:
        variances = [transformation.covariance[n, n] for n in range(6)]
        meters = "  ".join(f"{math.sqrt(value):.4f}" for value in variances[:3])
        degrees = "  ".join(f"{math.degrees(math.sqrt(value)):.3f}" for value in variances[3:])
        lines.append(f"  sigma           {meters}  m,  {degrees}  deg")
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
        if geodetic := answer.geodetic:
            latitude, longitude, height, heading = geodetic
            lines.append(f"  geodetic        {latitude:.8f}  {longitude:.8f}  deg,  height {height:.3f} m (WGS 84)")
            if not math.isnan(heading):
                magnetic = geodetic.compute_magnetic_heading(transformation.utime)
                compass = "" if math.isnan(magnetic) else f",  compass {magnetic:.2f} deg"
                lines.append(f"  heading         {heading:.2f} deg from true north{compass}")
        lines.append(f"  epoch           {transformation.pose_epoch}, origin {origin.origin_id:016x}")
    if not math.isnan(answer.horizontal_level):
        heading = math.degrees(answer.heading_level)
        risk = f"; beyond the limit: {answer.limit_risk:.1e}" if not math.isnan(answer.limit_risk) else ""
        lines.append(f"  level           {answer.horizontal_level:.2f} m, heading {heading:.2f} deg (1e-4){risk}")
    if not math.isnan(answer.horizontal_protection_level):
        heading = math.degrees(answer.heading_protection_level)
        lines.append(f"  protection      {answer.horizontal_protection_level:.2f} m, heading {heading:.2f} deg")
    if answer.quality:
        flags = ", ".join(flag.name or "" for flag in Quality if flag in answer.quality)
        lines.append(f"  flags           {flags}: {answer.quality.explain()}")
    if not transformation.is_valid:
        lines.append(f"  NOT VALID       {Invalid(transformation.invalid_reasons).explain()}")
    if answer.unmet:
        lines.append(f"  UNMET           {escape(answer.unmet_reason)}")
    return "\n".join(lines)


def as_dict(answer: PoseAnswer) -> dict[str, Any]:
    """Return an answer as JSON data; unknown values are null."""
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
        "valid": transformation.is_valid,
        "invalid_reasons": [flag.name for flag in Invalid if flag & transformation.invalid_reasons],
        "flags": [flag.name for flag in Quality if flag in answer.quality],
        "initial_utm": None if origin is None else list(origin.initial_utm),
        "utm_zone": None if origin is None else f"{origin.zone}{'N' if origin.north else 'S'}",
        "origin_id": f"{transformation.origin_id:016x}" if transformation.origin_id else None,
        "geodetic": to_json(answer.geodetic),
        "pose_epoch": transformation.pose_epoch,
        "horizontal_protection_level": to_json(answer.horizontal_protection_level),
        "heading_protection_level": to_json(answer.heading_protection_level),
        "horizontal_level": to_json(answer.horizontal_level),
        "heading_level": to_json(answer.heading_level),
        "limit_risk": to_json(answer.limit_risk),
        "horizontal_allowance": to_json(answer.horizontal_allowance),
        "unmet": [flag.name for flag in Unmet if flag in answer.unmet],
        "unmet_reason": answer.unmet_reason,
        "model_revision": transformation.model_revision,
    }


class FileAnswers(FrameClient):
    """Poses of a geometry file, with joints at their defaults; times are ignored. Raises GeometryError, OSError."""

    def __init__(self, path: Path, settings: list[str] | None):
        self._model = load_given_model(path, parse_variables(settings))

    def _query_pose(
        self, interest: str, reference: str, at: int, policy: Policy, wait_ms: int, demand: PoseDemand = NO_DEMAND
    ) -> PoseAnswer:
        interest, reference = names.complete(interest), names.complete(reference)
        known = (names.WORLD_UTM, names.WORLD_ENU, names.ODOM)
        reserved = [each for each in (interest, reference) if each.partition(":")[0] in names.RESERVED_BODIES]
        for frame in reserved:
            if frame not in known:
                text = f"{quote(frame, 80)} is an unknown frame; known: {', '.join(known)}"
                raise UnknownFrameError(text, find_nearest_names(frame, known, 1))
        if reserved:
            raise ModelServerError("a geometry file has no pose of the vehicle in the world; query the daemon")
        rests = bool(self._model.get_kinematic_path(interest, reference).joints)
        answer = PoseAnswer(
            self._model.get_transformation(interest, reference), quality=Quality.JOINT_DEFAULT if rests else NO_FLAGS
        )
        if not any(demand):
            return answer
        from modelserver.query.answers import find_unmet

        unmet, reason = find_unmet(answer, demand, age=math.inf if rests else 0.0)
        return answer._replace(unmet=unmet, unmet_reason=reason)

    def _query(self, request: Any, reply_type: type[R]) -> R:
        from modelserver.estimation.history import History
        from modelserver.query.answers import complete_names, compute_answer
        from modelserver.query.view import PlatformView

        request = complete_names(request)

        if isinstance(request, GetMotion):
            raise ModelServerError("a geometry file has no motion; query the daemon")
        answer = (
            self._query_pose(*request[1:3], 0, Policy.INTERPOLATED, 0) if isinstance(request, GetExplanation) else None
        )
        root = self._model.root
        view = PlatformView(self._model, names.join(root.name, root.frames[0].name), None, History(0.0))
        (reply,) = compute_answer(view, request, 0)
        if isinstance(reply, ExplanationReply) and reply.answer is not None and answer is not None:
            # a joint at its default does not invalidate the geometry of a file
            answer = answer._replace(quality=reply.answer.answer.quality)
            reply = ExplanationReply(reply.header, reply.answer._replace(answer=answer))
        assert isinstance(reply, reply_type)
        return reply


def open_log_answers(log: Path, model: Path | None, settings: list[str] | None, prefix: str) -> LogPlatform:
    """Open a log as a source of poses, with `model` for its geometry. Raises RecordingError, GeometryError, OSError."""
    from mstools.recordings.log_platform import LogPlatform

    if model is None:
        return LogPlatform(log, prefix)
    given = load_given_model(model, parse_variables(settings))
    source = LogPlatform(log, prefix, given)
    if source.revision not in ("", given.revision):
        there = f"{model} has revision {given.revision}, but the poses in {log} have {source.revision}"
        typer.echo(f"modelserver: note: {there}", err=True)
    return source
