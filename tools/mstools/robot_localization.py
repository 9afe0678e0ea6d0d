"""Settings of ROS's robot_localization (ekf.yaml, navsat_transform) for a vehicle file, and what becomes of each.

The file is that of one or several nodes, of ROS 2 (`node: {ros__parameters: {...}}`) or ROS 1 (with or without node). A
source `odom0`, `imu0`, `pose0`, `twist0` has its topic there and which of 15 quantities it gives in `odom0_config`:
x y z, roll pitch yaw, their velocities, ax ay az. Parameters are those of robot_localization 3.8 (doc/state_estimation_
nodes, doc/navsat_transform_node).

What is a sensor here and an input there differs: the receiver itself is used, and not navsat_transform's odometry; the
heading comes from the motion, the gyro and the receiver, and not from the IMU's yaw.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Final, NamedTuple

from modelserver.earth import Origin
from modelserver.earth.geodesy import GeodesyError, origin_at
from modelserver.errors import ModelServerError, SyntaxProblemError
from modelserver.files import read_regular
from modelserver.yaml_tree import NodeKind, YamlNode, parse_yaml

MAX_BYTES: Final = 1 << 20

FIELDS: Final = (
    *("x", "y", "z", "roll", "pitch", "yaw", "vx", "vy", "vz"),
    *("vroll", "vpitch", "vyaw", "ax", "ay", "az"),
)

SOURCE: Final = re.compile(r"(odom|imu|pose|twist)\d+")


class Outcome(Enum):
    """What became of a parameter; the value is the heading of its list."""

    TAKEN = "Taken from {file}:"
    NOT_NEEDED = "Not needed here:"
    OPEN = "Without a counterpart, and what to do instead:"


class Finding(NamedTuple):
    """What became of a parameter, in words."""

    line: int
    key: str
    outcome: Outcome
    text: str


@dataclass(slots=True)
class EkfSettings:
    """What a vehicle file takes of the parameters, and a finding for each of them; a rate of 0 is not stated."""

    base_frame: str = ""
    rate_hz: float = 0.0
    origin: Origin | None = None
    has_gps: bool = False
    has_imu: bool = False
    has_wheels: bool = False
    findings: list[Finding] = field(default_factory=list)

    def to_lines(self, file: Path) -> Iterator[str]:
        """Yield the findings as lines, each once."""
        for outcome in Outcome:
            of_key = {f"{each.key}: {each.text}": each.line for each in self.findings if each.outcome is outcome}
            if of_key:
                yield outcome.value.format(file=file)
            yield from (f"  line {line}, {text}" for text, line in of_key.items())


NOT_NEEDED: Final = {
    "map_frame": "the map frame is always there: World:ENU, in short map",
    "odom_frame": "the odom frame is always there: Odom:Origin, in short odom",
    "world_frame": "one filter answers in map, odom and utm at once",
    "publish_tf": "transforms are answered on request, and POSE is published",
    "broadcast_utm_transform": "the pose in utm is always answered",
    "broadcast_cartesian_transform": "the pose in utm is always answered",
    "publish_filtered_gps": "every pose has its latitude and longitude",
    "publish_acceleration": "modelserver query --motion answers it",
    "print_diagnostics": "MODELSERVER_HEALTH is always published: modelserver status",
    "wait_for_datum": "a configured origin is used from the start",
    "use_odometry_yaw": "the heading is found from motion, gyro and receiver",
    "smooth_lagged_data": "late samples are always sorted in, up to localization.filter.horizon",
    "history_length": "late samples are always sorted in, up to localization.filter.horizon",
    "delay": "nothing waits for a first heading",
    "use_local_cartesian": "World:ENU is the local tangent plane, World:UTM the grid",
    "cartesian_frame_id": "the grid is World:UTM, in short utm",
    "gravitational_acceleration": "gravity is computed for the place",
    "transform_time_offset": "answers are for the time that is asked for",
    "transform_timeout": "mounts are in the geometry file",
    "use_sim_time": "stamps are those of the samples; a replay has its own time",
    "two_d_mode": "roll, pitch and height are estimated; on level ground they stay level",
    "reset_on_time_jump": "a clock that was set back restarts what depends on it",
    "queue_size": "queues are bounded by the service",
    "nodelay": "the bus is UDP",
    "relative": "poses are relative to the origin, velocities need none",
    "remove_gravitational_acceleration": "the specific force is used with gravity: leave it in the IMU's samples",
}
"""Parameters, and suffixes to a source's name, that need no counterpart, and why."""

INSTEAD: Final = {
    "sensor_timeout": "an IMU is stale after localization.filter.imu_timeout, fixes after gps_timeout",
    "process_noise_covariance": "noise is that of the sensors: modelserver tune fits it to a log",
    "initial_estimate_covariance": "the filter starts from the first fixes and the IMU",
    "initial_state": "modelserver set-pose gives a pose to the running service",
    "dynamic_process_noise_covariance": "noise is that of the sensors: modelserver tune fits it to a log",
    "magnetic_declination_radians": "the declination is computed for place and date; with a calibrated magnetometer "
    "write localization.filter.use_magnetometer: true",
    "yaw_offset": "turn the IMU's frame in the geometry (rpy_deg) so that its axes are those of the vehicle",
    "zero_altitude": "the height is estimated; leave it out where only x and y are used",
    "use_control": "the wheels measure what a command asks for",
    "predict_to_current_time": "ask with --policy predicted",
    "permit_corrected_publication": "poses are published at their instants, never again",
    "disabled_at_startup": "stop the service, or start it in another mode (localization.mode)",
    "rejection_threshold": "gates follow from localization.filter.gate_risk",
    "differential": "publish the change of a pose as relative_pose_t, under sensors.aiding",
}
"""Parameters, and suffixes to a source's name, without a counterpart, and what to do instead."""


NAVSAT: Final = frozenset(("datum", "magnetic_declination_radians", "wait_for_datum", "yaw_offset", "zero_altitude"))
"""Parameters of navsat_transform_node alone."""


def read_ekf_settings(path: Path) -> EkfSettings:
    """Read a file of parameters. Raises ModelServerError, OSError."""
    try:
        root = parse_yaml(read_regular(path, MAX_BYTES))
    except SyntaxProblemError as error:
        raise ModelServerError(f"{path}:{error.line}: {error}; {error.fix}") from None
    nodes = list(_find_nodes(root))
    if not nodes:
        raise ModelServerError(
            f"{path}: no parameters of robot_localization; give the file with odom0, imu0 or datum in it"
        )
    found = EkfSettings()
    for parameters in nodes:
        if parameters.keys() & NAVSAT:
            found.has_gps = True  # of navsat_transform_node, whose input are fixes
        for key, node in parameters.items():
            for outcome, text in _read_parameter(found, parameters, key, node):
                found.findings.append(Finding(node.line, key, outcome, text))
    return found


def _find_nodes(node: YamlNode) -> Iterator[dict[str, YamlNode]]:
    if node.kind is not NodeKind.MAPPING:
        return
    pairs = {key.text: value for key, value in node.pairs}
    if any(SOURCE.fullmatch(key) or key in ("base_link_frame", "datum", "yaw_offset") for key in pairs):
        yield pairs
        return
    for value in pairs.values():
        yield from _find_nodes(value)


def _read_parameter(
    found: EkfSettings, parameters: dict[str, YamlNode], key: str, node: YamlNode
) -> Iterator[tuple[Outcome, str]]:
    """Set what a parameter gives; yield what became of it."""
    source, _, suffix = key.partition("_")
    if SOURCE.fullmatch(source) is None:
        source, suffix = "", key
    if source and not suffix:
        yield from _read_source(found, key, node.text, _read_fields(parameters.get(f"{key}_config")))
    elif source and suffix == "config":
        return  # with its source
    elif key == "base_link_frame":
        is_other = found.base_frame not in ("", node.text)
        found.base_frame = found.base_frame or node.text
        yield Outcome.OPEN if is_other else Outcome.TAKEN, f"base_frame is {found.base_frame}"
    elif key == "frequency":
        rate = _read_number(node)
        if 0.1 <= rate <= 1000.0:
            found.rate_hz = max(found.rate_hz, rate)
            yield Outcome.TAKEN, "publish.rate_hz"
        else:
            yield Outcome.OPEN, "publish.rate_hz is between 0.1 and 1000"
    elif key == "datum":
        waits = parameters.get("wait_for_datum")
        if waits is not None and waits.text.lower() == "true":
            yield from _read_datum(found, node)
        else:
            yield (
                Outcome.OPEN,
                "it is not used without wait_for_datum: true; for an origin there write origin into the vehicle file",
            )
    elif suffix in NOT_NEEDED:
        yield Outcome.NOT_NEEDED, NOT_NEEDED[suffix]
    elif node.text == "false" and suffix in ("differential", "use_control", "zero_altitude", "disabled_at_startup"):
        yield Outcome.NOT_NEEDED, "it is off"
    else:
        stem = next((each for each in INSTEAD if suffix == each or (source and suffix.endswith(each))), "")
        if re.match(r"(control|acceleration|deceleration|stamped_control)_", suffix):
            stem = "use_control"
        unknown = "no parameter of robot_localization 3.8: look up what it is for"
        yield Outcome.OPEN, INSTEAD.get(stem, unknown)


def _read_source(found: EkfSettings, name: str, topic: str, fields: set[str]) -> Iterator[tuple[Outcome, str]]:
    used = f"{topic} ({', '.join(each for each in FIELDS if each in fields)})" if fields else topic
    words = set(re.findall(r"[a-z]+", topic.lower()))
    if name.startswith("imu"):
        if found.has_imu:
            yield Outcome.OPEN, f"a second inertial unit, {used}: sensors.imu is one, which is that named first"
            return
        found.has_imu = True
        yield Outcome.TAKEN, f"sensors.imu, from {used}: its rates and specific force"
        if "yaw" in fields:
            yield Outcome.OPEN, f"its yaw is not used: {INSTEAD['magnetic_declination_radians']}"
    elif name.startswith("odom") and words & {"gps", "navsat"}:
        found.has_gps = True
        yield Outcome.TAKEN, f"sensors.gps instead of {used}: the receiver's own fixes (NavSatFix)"
    elif name.startswith("odom") and not words & {"visual", "vo", "vio", "laser", "lidar"}:
        if found.has_wheels:
            what = "publish it as relative_pose_t, under sensors.aiding (docs/publish-samples.md)"
            yield Outcome.OPEN, f"a second odometry, {used}: sensors.wheels is one, that named first; {what}"
            return
        found.has_wheels = True
        yield Outcome.TAKEN, f"sensors.wheels, from {used}: the speeds of a left and a right wheel"
        if "vy" in fields:
            yield Outcome.OPEN, "vy: wheels measure no speed sideways; for mecanum wheels give --vehicle mecanum"
    else:
        kind = "relative_pose" if name.startswith("odom") else "absolute_pose"
        what = "publish forward_speed, or wheels, of" if name.startswith("twist") else f"publish as {kind}_t"
        yield Outcome.OPEN, f"{what} {used}, under sensors.aiding (docs/publish-samples.md)"


def _read_datum(found: EkfSettings, node: YamlNode) -> Iterator[tuple[Outcome, str]]:
    """Read latitude, longitude in degrees and heading in radians: a list, or a text as in ROS 1."""
    texts = [each.text for each in node.items] or re.split(r"[\s,]+", node.text.strip("[] "))
    try:
        latitude, longitude, heading = (*map(float, texts[:3]), 0.0)[:3]
        found.origin = origin_at(latitude, longitude, 0.0)
    except (ValueError, GeodesyError):
        yield Outcome.OPEN, "no latitude and longitude in degrees; write origin into the vehicle file"
        return
    yield Outcome.TAKEN, "origin, at height 0 above the ellipsoid as there"
    if heading:
        yield Outcome.OPEN, f"its heading of {heading:g} rad: x of World:ENU is to the east; turn what reads it"


def _read_fields(config: YamlNode | None) -> set[str]:
    flags = [] if config is None else [each.text.lower() == "true" for each in config.items]
    return {name for name, flag in zip(FIELDS, flags, strict=False) if flag}


def _read_number(node: YamlNode) -> float:
    try:
        return float(node.text)
    except ValueError:
        return math.nan
