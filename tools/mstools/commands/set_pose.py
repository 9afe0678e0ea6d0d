"""`modelserver set-pose`: sets the pose of the vehicle in the running daemon, and reports the decision on it."""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np
import typer

from modelserver.errors import ForbiddenError, ModelServerError, NoServerError, RejectedError
from modelserver.geometry import names
from modelserver.messages import Decision, Invalid, PoseAnswer, PublishDecisions, Verdict
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Quaternion
from modelserver.transforms.transformation import Transformation
from modelserver.wire.provider import open_lcm, resolve_url
from mstools.commands.listener import DaemonListener
from mstools.terminal.options import JsonOption, KeyOption, PrefixOption, TimeoutOption, UrlOption, option
from mstools.terminal.output import escape, to_json

if TYPE_CHECKING:
    import lcm

    from modelserver.earth.geodesy import Geodesy

CONFIRM_S = 4.0
"""How long to wait for the decision, seconds: it is final one filter horizon, about a second, after the request."""

MAX_DISTANCE_M = 200_000.0
"""A position farther from the origin than this, meters, is an input error: another UTM zone, or exchanged numbers."""

OPERATOR = "operator"
"""The source under which the ledger lists a pose that was set."""

PROGRAM = "modelserver"

Triple = tuple[float, float, float]


class PoseTarget(NamedTuple):
    """The pose to set, as the command line states it; exactly one position and one orientation is not None.

    `utm`: grid easting, grid northing, ellipsoidal height, m, absolute. `xyz`: m from the origin. `geodetic`: latitude
    and longitude, deg, and ellipsoidal height, m; None keeps the height. `yaw`: rad from grid east, `heading`: rad
    clockwise from true north; both keep roll and pitch. `rpy`: rad.
    """

    utm: Triple | None = None
    xyz: Triple | None = None
    geodetic: tuple[float, float, float | None] | None = None
    yaw: float | None = None
    heading: float | None = None
    rpy: Triple | None = None
    quaternion: Quaternion | None = None


def command(
    utm: Annotated[
        Triple | None, option("--utm E N H", "Position: grid easting, northing, ellipsoidal height, meters.")
    ] = None,
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
    rpy: Annotated[Triple | None, option("--rpy R P Y", "Roll, pitch and yaw, degrees, yaw from grid east.")] = None,
    quaternion: Annotated[
        Quaternion | None, option("--quaternion S X Y Z", "Orientation in World:UTM, scalar first.")
    ] = None,
    sigma: Annotated[float, option("--sigma M", "Standard deviation of each coordinate, meters.")] = 1.0,
    sigma_deg: Annotated[float, option("--sigma-deg DEG", "Standard deviation about each axis, degrees.")] = 5.0,
    as_json: JsonOption = False,
    url: UrlOption = "",
    prefix: PrefixOption = "",
    timeout: TimeoutOption = 2.0,
    key: KeyOption = None,
) -> None:
    """Set the pose of the vehicle in the running daemon, and report what localization did with it.

    Give one position (--utm, --xyz or --latlon) and one orientation (--yaw, --heading, --rpy or --quaternion) of the
    base frame. Before the heading is known the pose is taken as it is; later it is a measurement like any other, fused
    by its sigmas, and the gates may reject it. The daemon accepts it where its vehicle file has commands:
    {set_pose: true, key_file: ...} and the request is signed with that key (--key). It is sent once. Exits 1 where it
    is denied or rejected.

    \b
    Examples:
      modelserver set-pose --latlon 50.27 -111.1 --heading 90 --sigma 0.05 --sigma-deg 1
      modelserver set-pose --utm 350283.1 5570712.6 700 --yaw 12.5 --key /etc/modelserver/commands.key
    """
    target = parse_target(
        {"--utm": utm, "--xyz": xyz, "--latlon": latlon},
        {"--yaw": yaw, "--heading": heading, "--rpy": rpy, "--quaternion": quaternion},
        height,
    )
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
    pose = to_pose(target, geodesy, before.transformation.pose)
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
    result = SetPoseResult(request, geodesy, (sigma, sigma_deg), decision, listener.has_decisions, listener.pose)
    typer.echo(json.dumps(as_data(result), indent=2) if as_json else describe(result))
    if decision is not None and decision.verdict is Verdict.REJECTED:
        raise ModelServerError(
            f"localization rejected the pose: {escape(decision.reason or 'it contradicts the estimate')}; if the "
            "pose is right, check axes and units, and give larger sigmas (--sigma, --sigma-deg)"
        )


class SetPoseResult(NamedTuple):
    """The pose that was set, `decision` on it if one was received, and the next pose that the daemon published."""

    request: Transformation
    geodesy: Geodesy
    sigmas: tuple[float, float]
    decision: Decision | None
    has_decisions: bool
    after: PoseAnswer | None


def parse_target(positions: dict[str, Any], orientations: dict[str, Any], height: float | None) -> PoseTarget:
    """Return the pose that the options state. Raises typer.BadParameter where they state none, two or no numbers."""
    for what, options in (("position", positions), ("orientation", orientations)):
        given = [name for name, value in options.items() if value is not None]
        if len(given) != 1:
            got = f"got {' and '.join(given)}" if given else "got none"
            raise typer.BadParameter(f"give one {what}, {', '.join(options)}; {got}")
    latlon, quaternion = positions["--latlon"], orientations["--quaternion"]
    if height is not None and latlon is None:
        raise typer.BadParameter("it goes with --latlon; --utm and --xyz have a height", param_hint="--height")
    for name, value in {"--height": height, **positions, **orientations}.items():
        if value is not None and not np.isfinite(value).all():
            raise typer.BadParameter("expected finite numbers", param_hint=name)
    if quaternion is not None and not any(quaternion):
        raise typer.BadParameter("a quaternion of zeros has no direction", param_hint="--quaternion")
    yaw, heading, rpy = (
        None if value is None else np.radians(value).tolist()
        for value in (orientations[name] for name in ("--yaw", "--heading", "--rpy"))
    )
    geodetic = None if latlon is None else (*latlon, height)
    return PoseTarget(positions["--utm"], positions["--xyz"], geodetic, yaw, heading, rpy, quaternion)


def to_covariance(sigma: float, sigma_deg: float) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return the covariance (6, 6) of a pose with one sigma (m) for the coordinates and one (deg) about the axes.

    Raises typer.BadParameter for one that is not above 0.
    """
    for name, value in (("--sigma", sigma), ("--sigma-deg", sigma_deg)):
        if not (math.isfinite(value) and value > 0.0):
            raise typer.BadParameter(f"a standard deviation is above 0, got {value:g}", param_hint=name)
    return np.diag([sigma**2] * 3 + [math.radians(sigma_deg) ** 2] * 3)


def to_pose(target: PoseTarget, geodesy: Geodesy, current: Pose) -> Pose:
    """Return the pose in World:UTM, in meters from the origin, that a target states.

    `current` is the pose in force: its height, roll and pitch stay where the target has none. Raises GeodesyError for a
    place out of reach of the zone, ModelServerError for one too far from the origin.
    """
    origin = geodesy.origin
    east, north, up = origin.initial_utm
    if target.geodetic is not None:
        latitude, longitude, height = target.geodetic
        here = up + current.xyz[2] if height is None else height
        position = geodesy.to_relative_utm(geodesy.utm_from_geodetic(latitude, longitude, here))
    else:
        position = target.xyz if target.xyz is not None else geodesy.to_relative_utm(target.utm or (0.0, 0.0, 0.0))
    away = math.hypot(*position)
    if away > MAX_DISTANCE_M:
        side = "north" if origin.north else "south"
        raise ModelServerError(
            f"the position is {away / 1e3:.0f} km from the origin (easting {east:.1f}, northing {north:.1f}, zone "
            f"{origin.zone} {side}); --utm takes absolute coordinates of that zone, --xyz meters from the origin"
        )
    if target.quaternion is not None:
        return Pose(position, target.quaternion)
    roll, pitch, _ = so3.to_rpy(current.wxyz)
    if target.heading is not None:
        latitude, longitude, _ = geodesy.geodetic_from_utm(east + position[0], north + position[1], up + position[2])
        # heading counts from true north, yaw from grid east: the convergence lies between
        yaw = math.pi / 2 - target.heading + geodesy.convergence(latitude, longitude)
    else:
        yaw = target.yaw or 0.0
    return Pose(position, so3.from_rpy(*(target.rpy or (roll, pitch, yaw))))


class SetPoseListener(DaemonListener):
    """Receive the daemon's latest `pose`, and its decisions on poses that were set, by the time of these."""

    def __init__(self, bus: lcm.LCM, prefix: str):
        self.pose: PoseAnswer | None = None
        self.has_decisions = False
        self.decisions: dict[int, Decision] = {}
        super().__init__(bus, prefix, {"POSE": self._on_pose, "LOCALIZATION_DECISIONS": self._on_decisions})

    def _on_pose(self, pose: PoseAnswer) -> None:
        self.pose = pose

    def _on_decisions(self, published: PublishDecisions) -> None:
        self.has_decisions = True
        for each in published.decisions:
            if each.source == OPERATOR and each.kind == "absolute_pose":
                self.decisions[each.utime] = each


_VERDICTS = {verdict: verdict.name.lower() for verdict in Verdict} | {Verdict.RESET: "set"}


def describe(result: SetPoseResult) -> str:
    """Format the result."""
    pose = result.request.pose
    origin = result.geodesy.origin
    east, north, height = (a + b for a, b in zip(origin.initial_utm, pose.xyz, strict=True))
    latitude, longitude, _ = result.geodesy.geodetic_from_utm(east, north, height)
    sigma, sigma_deg = result.sigmas
    lines = [
        f"{escape(result.request.frame_of_interest)} in World:UTM: {pose}",
        f"  easting {east:.3f} m, northing {north:.3f} m, height {height:.3f} m, zone {origin.zone} "
        f"{'north' if origin.north else 'south'}; latitude {latitude:.7f}, longitude {longitude:.7f} deg",
        f"  sigma {sigma:g} m, {sigma_deg:g} deg",
    ]
    decision, silent = result.decision, "LOCALIZATION_DECISIONS is silent (publish.decisions: false?)"
    if decision is not None:
        text = _VERDICTS[decision.verdict] + (f": {escape(decision.reason)}" if decision.reason else "")
        if math.isfinite(decision.statistic) and math.isfinite(decision.limit):
            text += f" (chi-square {decision.statistic:.1f} of {decision.limit:.1f} allowed, {decision.dof} numbers)"
    else:
        why = "no decision on it was received" if result.has_decisions else silent
        text = f"accepted for localization; {why}"
    lines.append(f"decision: {text}")
    if result.after is not None:
        now = result.after.transformation
        state = "valid" if now.is_valid else f"not valid: {Invalid(now.invalid_reasons).explain()}"
        lines.append(f"now: {now.pose}; {state}")
    return "\n".join(lines)


def as_data(result: SetPoseResult) -> dict[str, Any]:
    """Return the result as JSON data; angles in radians, a pose as its 7-vector."""
    origin, decision, after = result.geodesy.origin, result.decision, result.after
    sigma, sigma_deg = result.sigmas
    return {
        "frame_of_interest": result.request.frame_of_interest,
        "frame_of_reference": result.request.frame_of_reference,
        "state_vector": result.request.state_vector.tolist(),
        "sigma": [sigma] * 3 + [math.radians(sigma_deg)] * 3,
        "initial_utm": list(origin.initial_utm),
        "utm_zone": origin.zone,
        "utm_north": origin.north,
        "decision": decision
        and {
            "utime": decision.utime,
            "verdict": _VERDICTS[decision.verdict],
            "reason": decision.reason,
            "statistic": to_json(decision.statistic),
            "limit": to_json(decision.limit),
        },
        "pose_after": after
        and {
            "utime": after.transformation.utime,
            "state_vector": after.transformation.state_vector.tolist(),
            "valid": after.transformation.is_valid,
        },
    }
