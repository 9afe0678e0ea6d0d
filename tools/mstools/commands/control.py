"""Signed commands to the running daemon: `modelserver mode`, `reload`, `set-pose`; and `key`, to sign with."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from modelserver.errors import ForbiddenError, Location, ModelServerError, NoServerError, RejectedError
from modelserver.geometry import names
from modelserver.key_files import KEY_FILE_VARIABLE
from modelserver.messages import (
    Decision,
    Health,
    Invalid,
    Mode,
    PoseAnswer,
    PublishDecisions,
    ReloadReply,
    SensorHeader,
    SwitchMode,
    Verdict,
)
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.transformation import Transformation
from modelserver.wire.channels import SIGNED
from modelserver.wire.provider import open_lcm, resolve_url
from mstools.commands.status import DaemonListener, HealthListener
from mstools.terminal.options import (
    KeyOption,
    PrefixOption,
    TimeoutOption,
    UrlOption,
    argument,
    choose_name,
    option,
)
from mstools.terminal.output import escape, make_error

if TYPE_CHECKING:
    import lcm

    from modelserver.earth.geodesy import Geodesy

MODES = tuple(mode.name.lower() for mode in Mode)

TIMEOUT_S = 2.5
"""Timeout for a health report, seconds: one is published per second."""


def mode(
    mode: Annotated[str, argument("MODE", f"One of {', '.join(MODES)}.")],
    config: Annotated[Path, option("--config -c FILE", "The vehicle file.")],
    url: UrlOption = "",
    key: KeyOption = None,
) -> None:
    """Switch which sources the localization of the running daemon uses, and report the mode in force.

    The command is sent once, signed, for the channel in the vehicle file (localization.mode_channel), with which the
    daemon must have been started. The key is that of --key, else of $MODELSERVER_KEY_FILE, else of the vehicle file
    (commands.key_file). The next health report confirms the mode. Exit code 1 if no daemon answers, or the mode does
    not change.

    Example: modelserver mode no_gps -c config/husky/vehicle.yaml
    """
    wanted = parse_mode(mode)
    from modelserver.client.remote import load_signer
    from modelserver.config.vehicle_file import load_config
    from modelserver.wire.codec import encode

    vehicle = load_config(config)
    if not vehicle.localization.mode_channel:
        why = "no channel for mode commands is configured, so the daemon receives none"
        fix = "write mode_channel: LOCALIZATION_MODE under localization, and restart the daemon"
        raise make_error(why, Location(str(config), element="localization.mode_channel"), fix)
    prefix = vehicle.lcm.channel_prefix
    channel = f"{prefix}{vehicle.localization.mode_channel}"
    given = str(key or "") or os.environ.get(KEY_FILE_VARIABLE, "") or vehicle.commands.key_file
    signing = load_signer(given, prefix, "modelserver")
    if signing is None:
        raise ModelServerError(f"the command must be signed; give the daemon's key with --key or ${KEY_FILE_VARIABLE}")
    provider = resolve_url(url or vehicle.lcm.url)
    bus = open_lcm(provider)
    listener = HealthListener(bus, prefix)
    listener.listen(TIMEOUT_S, lambda: listener.health is not None)
    before, reports = listener.health, listener.reports
    utime = time.time_ns() // 1000
    content = encode(SwitchMode(SensorHeader(utime, OPERATOR, host_utime=utime), wanted))
    bus.publish(signing.channel, signing.seal(vehicle.localization.mode_channel, content))
    sent = f"sent {channel}: {wanted.name.lower()}"
    is_confirmed = listener.listen(
        TIMEOUT_S, lambda: listener.reports > reports and listener.report.localization.mode is wanted
    )
    if listener.health is None:
        raise NoServerError(
            f"{sent}, but no health report was received on {provider}: is the daemon running, on this bus and with "
            "this vehicle file? (modelserver run -c FILE, --url)"
        )
    if not is_confirmed:
        now = listener.report.localization.mode
        why = find_rejection(before, listener.report, (channel, f"{prefix}{SIGNED}", f"command:{OPERATOR}"))
        stays = f"the daemon stays in mode {now.name.lower()}" if now is not None else "the daemon has no localization"
        raise ModelServerError(f"{sent}, but {stays}{why or '; was it started with this vehicle file?'}")
    was = None if before is None else before.localization.mode
    typer.echo(f"now {wanted.name.lower()}" + ("" if was is None else f" (was {was.name.lower()})"))


def find_rejection(before: Health | None, now: Health, sources: Collection[str]) -> str:
    """Return why the daemon rejected a command of these sources between two reports, in parentheses, empty if not."""
    counts = {} if before is None else {(source, why): count for source, why, count in before.rejected}
    for source, why, count in now.rejected:
        if source in sources and count > counts.get((source, why), 0):
            return f" ({why}: see docs/words.md)"
    return ""


def parse_mode(text: str) -> Mode:
    name = text.strip().replace("-", "_").lower()
    return Mode[(name if name in MODES else choose_name(text, MODES, "mode", "MODE")).upper()]


PERMISSION_HINT = (
    "or on its machine send SIGHUP to the daemon (kill -HUP PID), which needs no permission; the result is in its log"
)


def reload(
    dry_run: Annotated[bool, option("--dry-run", "Only print what would change.")] = False,
    url: UrlOption = "",
    prefix: PrefixOption = "",
    timeout: TimeoutOption = 2.0,
    key: KeyOption = None,
) -> None:
    """Reload the geometry file of the running daemon, and print the changes.

    Either the whole file fits the vehicle and is used from now on, or nothing changes and all problems are printed.
    The vehicle file itself is not reloaded: restart the daemon for that. The daemon applies the request if its vehicle
    file has commands: {reload: true, key_file: ...} and the request is signed with that key (--key); kill -HUP on its
    machine needs no permission. Exit code 1 if the geometry is rejected.

    Example: modelserver reload --dry-run
    """
    from modelserver.client.remote import Platform

    with Platform(
        url, channel_prefix=prefix, timeout=timeout, retries=0, name="modelserver", key_file=key or ""
    ) as platform:
        try:
            reply = platform.reload_model(dry_run=dry_run)
        except ForbiddenError as error:
            raise ModelServerError(f"reload denied: {error}; {PERMISSION_HINT}") from None
        except RejectedError as error:
            for line in str(error).splitlines():
                typer.echo(escape(line), err=True)
            stays = "the geometry in force stays" if not dry_run else "the daemon would reject it"
            raise ModelServerError(f"{stays}; run modelserver check for details with line numbers") from None
    typer.echo(describe_reload(reply, dry_run))


def describe_reload(reply: ReloadReply, dry_run: bool) -> str:
    if not reply.changes:
        return f"nothing {'would change' if dry_run else 'changed'}: revision {escape(reply.revision)}"
    head = "would be" if dry_run else "is now"
    lines = [f"the geometry in force {head} revision {escape(reply.revision)}; changes:"]
    return "\n".join(lines + [f"  {escape(change)}" for change in reply.changes])


CONFIRM_S = 4.0
"""How long to wait for the decision, seconds: it is final one filter horizon, about a second, after the request."""

MAX_DISTANCE_M = 200_000.0
"""A position farther from the origin than this, meters, is an input error: another UTM zone, or exchanged numbers."""

OPERATOR = "operator"
"""Source of mode commands, and under which the ledger lists a pose that was set."""

PROGRAM = "modelserver"

Triple = tuple[float, float, float]


def set_pose(
    xyz: Annotated[
        Triple | None, option("--xyz X Y Z", "Position: meters from the origin of World:UTM (initial_utm).")
    ] = None,
    latlon: Annotated[
        tuple[float, float] | None, option("--latlon LAT LON", "Position: WGS 84, degrees, north and east positive.")
    ] = None,
    height: Annotated[
        float | None, option("--height H", "With --latlon: ellipsoidal height, meters. Default: as it is.")
    ] = None,
    yaw: Annotated[
        float | None, option("--yaw DEG", "Degrees counterclockwise from grid east; roll and pitch stay.")
    ] = None,
    heading: Annotated[
        float | None, option("--heading DEG", "Degrees clockwise from true north; roll and pitch stay.")
    ] = None,
    sigma: Annotated[float, option("--sigma M", "Standard deviation of each coordinate, meters.")] = 1.0,
    sigma_deg: Annotated[float, option("--sigma-deg DEG", "Standard deviation about each axis, degrees.")] = 5.0,
    url: UrlOption = "",
    prefix: PrefixOption = "",
    timeout: TimeoutOption = 2.0,
    key: KeyOption = None,
) -> None:
    """Set the pose of the vehicle in the running daemon, and report what localization did with it.

    Give one position (--xyz or --latlon) and one orientation (--yaw or --heading) of the base frame. Before the heading
    is known the pose is taken as it is; later it is a measurement like any other, fused by its sigmas, and the gates
    may reject it. The daemon accepts it where its vehicle file has commands: {set_pose: true, key_file: ...} and the
    request is signed with that key (--key). It is sent once. Exits 1 where it is denied or rejected.

    \b
    Examples:
      modelserver set-pose --latlon 50.27 -111.1 --heading 90 --sigma 0.05 --sigma-deg 1
      modelserver set-pose --xyz 12.5 -3.0 0.2 --yaw 12.5 --key /etc/modelserver/commands.key
    """
    check_target({"--xyz": xyz, "--latlon": latlon}, {"--yaw": yaw, "--heading": heading}, height)
    covariance = to_covariance(sigma, sigma_deg)
    from modelserver.client.remote import Platform
    from modelserver.earth.geodesy import Geodesy

    bus = open_lcm(resolve_url(url))
    listener = SetPoseListener(bus, prefix)
    if not listener.listen(timeout, lambda: listener.pose is not None):
        raise NoServerError(
            f"no {prefix}POSE within {timeout:g} s on {resolve_url(url)}, so the base frame and the origin are not "
            "known: is the daemon running, on this bus (--url) and with this prefix (--prefix)?"
        )
    before = listener.pose
    assert before is not None
    if before.origin is None:
        raise ModelServerError(
            "the origin of World:UTM is not known yet: wait for fixes, or write initial_utm, zone and hemisphere under "
            "origin in the vehicle file"
        )
    geodesy = Geodesy(before.origin)
    pose = to_pose(geodesy, before.transformation.pose, xyz, latlon, height, yaw, heading)
    base = before.transformation.frame_of_interest
    request = Transformation(base, names.WORLD_UTM, pose, covariance, origin_id=before.origin.origin_id)
    with Platform(url, channel_prefix=prefix, timeout=timeout, retries=0, name=PROGRAM, key_file=key or "") as platform:
        try:
            accepted = platform.set_state_vector(request)
        except (ForbiddenError, RejectedError) as error:
            raise ModelServerError(f"the pose was not set: {error}") from None
    listener.listen(CONFIRM_S, lambda: accepted.header.utime in listener.decisions)
    decision = listener.decisions.get(accepted.header.utime)
    listener.pose = None
    listener.listen(timeout, lambda: listener.pose is not None)
    typer.echo(describe_set_pose(request, (sigma, sigma_deg), decision, listener.pose))
    if decision is not None and decision.verdict is Verdict.REJECTED:
        raise ModelServerError(
            f"localization rejected the pose: {escape(decision.reason or 'it contradicts the estimate')}; if the "
            "pose is right, check axes and units, and give larger sigmas (--sigma, --sigma-deg)"
        )


def check_target(positions: Mapping[str, Any], orientations: Mapping[str, Any], height: float | None) -> None:
    """Raise typer.BadParameter where the options state no pose, two, or no numbers."""
    for what, options in (("position", positions), ("orientation", orientations)):
        given = [name for name, value in options.items() if value is not None]
        if len(given) != 1:
            got = f"got {' and '.join(given)}" if given else "got none"
            raise typer.BadParameter(f"give one {what}, {', '.join(options)}; {got}")
    if height is not None and positions["--latlon"] is None:
        raise typer.BadParameter("it goes with --latlon; --xyz has a height", param_hint="--height")
    for name, value in {"--height": height, **positions, **orientations}.items():
        if value is not None and not np.isfinite(value).all():
            raise typer.BadParameter("expected finite numbers", param_hint=name)


def to_covariance(sigma: float, sigma_deg: float) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return the covariance (6, 6) of a pose with one sigma (m) for the coordinates and one (deg) about the axes.

    Raises typer.BadParameter for one that is not above 0.
    """
    for name, value in (("--sigma", sigma), ("--sigma-deg", sigma_deg)):
        if not (math.isfinite(value) and value > 0.0):
            raise typer.BadParameter(f"a standard deviation is above 0, got {value:g}", param_hint=name)
    return np.diag([sigma**2] * 3 + [math.radians(sigma_deg) ** 2] * 3)


def to_pose(
    geodesy: Geodesy,
    current: Pose,
    xyz: Triple | None,
    latlon: tuple[float, float] | None,
    height: float | None,
    yaw: float | None,
    heading: float | None,
) -> Pose:
    """Return the pose in World:UTM, in meters from the origin, that the options state (angles in degrees).

    `current` is the pose in force: its roll and pitch stay, and its height where none is given. Raises GeodesyError for
    a place out of reach of the zone, ModelServerError for one too far from the origin.
    """
    origin = geodesy.origin
    east, north, up = origin.initial_utm
    if latlon is not None:
        here = up + current.xyz[2] if height is None else height
        xyz = geodesy.to_relative_utm(geodesy.utm_from_geodetic(*latlon, here))
    assert xyz is not None
    away = math.hypot(*xyz)
    if away > MAX_DISTANCE_M:
        side = "north" if origin.north else "south"
        raise ModelServerError(
            f"the position is {away / 1e3:.0f} km from the origin (easting {east:.1f}, northing {north:.1f}, zone "
            f"{origin.zone} {side}); --xyz takes meters from the origin"
        )
    roll, pitch, _ = so3.to_rpy(current.wxyz)
    if yaw is None:
        assert heading is not None
        latitude, longitude, _ = geodesy.geodetic_from_utm(east + xyz[0], north + xyz[1], up + xyz[2])
        # heading counts from true north, yaw from grid east: the convergence lies between
        turn = math.radians(90.0 - heading) + geodesy.convergence(latitude, longitude)
    else:
        turn = math.radians(yaw)
    return Pose(xyz, so3.from_rpy(roll, pitch, turn))


class SetPoseListener(DaemonListener):
    """Receive the daemon's latest `pose`, and its decisions on poses that were set, by the time of these."""

    def __init__(self, bus: lcm.LCM, prefix: str):
        self.pose: PoseAnswer | None = None
        self.decisions: dict[int, Decision] = {}
        super().__init__(bus, prefix, {"POSE": self._on_pose, "LOCALIZATION_DECISIONS": self._on_decisions})

    def _on_pose(self, pose: PoseAnswer) -> None:
        self.pose = pose

    def _on_decisions(self, published: PublishDecisions) -> None:
        for each in published.decisions:
            if each.source == OPERATOR and each.kind == "absolute_pose":
                self.decisions[each.utime] = each


_VERDICTS = {verdict: verdict.name.lower() for verdict in Verdict} | {Verdict.RESET: "set"}


def describe_set_pose(
    request: Transformation, sigmas: tuple[float, float], decision: Decision | None, after: PoseAnswer | None
) -> str:
    """Describe the pose that was set, the decision on it, and the next pose that the daemon published."""
    lines = [
        f"{escape(request.frame_of_interest)} in World:UTM: {request.pose}",
        f"  sigma {sigmas[0]:g} m, {sigmas[1]:g} deg",
    ]
    if decision is not None:
        text = _VERDICTS[decision.verdict] + (f": {escape(decision.reason)}" if decision.reason else "")
        if math.isfinite(decision.statistic) and math.isfinite(decision.limit):
            text += f" (chi-square {decision.statistic:.1f} of {decision.limit:.1f} allowed, {decision.dof} numbers)"
    else:
        text = "accepted for localization; no decision on it was received (publish.decisions: false?)"
    lines.append(f"decision: {text}")
    if after is not None:
        now = after.transformation
        state = "valid" if now.is_valid else f"not valid: {Invalid(now.invalid_reasons).explain()}"
        lines.append(f"now: {now.pose}; {state}")
    return "\n".join(lines)


key = typer.Typer(
    help="""Create the key to sign commands to a vehicle with.

    The vehicle file names the key file (commands: {key_file: ...}); the commanding program gets it by --key FILE or
    $MODELSERVER_KEY_FILE. docs/network.md explains how to distribute and change keys.

    Example: modelserver key new /etc/modelserver/commands.key
    """,
    no_args_is_help=True,
    rich_markup_mode=None,
)


@key.callback()
def _group() -> None:
    """Keep `new` a subcommand."""


@key.command("new")
def create(
    file: Annotated[Path, argument("FILE", "The file to create; it must not exist.")],
    name: Annotated[str, option("--name TEXT", "Name of the key.")] = "",
) -> None:
    """Write a new key to a file that only its owner can read."""
    from modelserver.key_files import generate_key, write_key

    new = generate_key(name)
    write_key(file, new)
    typer.echo(f"{escape(str(file))}: key {new.name}, readable by its owner only")
