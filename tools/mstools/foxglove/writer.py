"""A drive in Foxglove's schemas: frames, poses, fixes, the geometry's shapes, health and events; and the LCM messages.

`FoxgloveWriter.feed` takes the messages of the service, from a log or a bus, and logs to a context of the Foxglove SDK,
which writes an MCAP file or serves a websocket. Topics:

    /tf               FrameTransforms   the base frame in World:UTM; each other frame in the base frame
    /pose             Odometry          POSE with its covariance
    /pose/fix         LocationFix       POSE as latitude and longitude, at most 5 Hz
    /fix/SOURCE       LocationFix       fixes, stamped by their measurement
    /model            SceneUpdate       shapes of the bodies with their meshes, once for each geometry
    /uncertainty      SceneUpdate       95 % ellipsoid of the position, disc of the horizontal protection level
    /state            JSON              validity, speed, heading, sigma, protection levels
    /nis              JSON              normalized innovations squared per degree of freedom, by source and kind
    /diagnostics      DiagnosticArray   MODELSERVER_HEALTH, with the names of ROS for the Diagnostics panel, as JSON
    /events           Log               validity, rejections, resets, mode, geometry
    /decoded/CHANNEL  JSON              each LCM message with the names of its .lcm definition; not those of bytes
    /lcm/CHANNEL      bytes             each LCM message as it is, with its .lcm definition as the schema

Foxglove's frames are those of the geometry, by their names in ROS where they have one: utm, base_link for
base_link:Origin. Signals are those of the viewer (`pose_signals`), at its rate. JSON is made only where a client or a
file takes it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Final

from foxglove import Channel, Context, Schema
from foxglove.channels import (
    FrameTransformsChannel,
    LocationFixChannel,
    LogChannel,
    OdometryChannel,
    SceneUpdateChannel,
)
from foxglove.messages import (
    FrameTransforms,
    Log,
    LogLevel,
    Odometry,
    SceneEntityDeletion,
    SceneEntityDeletionType,
    SceneUpdate,
)

from modelserver.earth.geodesy import GeodesyError
from modelserver.errors import WireError
from modelserver.geometry import names
from modelserver.geometry.model import Model
from modelserver.messages import FixType, GpsSample, Health, PoseAnswer, PublishDecisions
from modelserver.transforms.pose import Pose
from modelserver.wire.codec import decode, fingerprint_of, type_name_of
from mstools.foxglove.lcm_json import convert_number, decode_to_json, make_array_schema, make_json_type, make_schema
from mstools.foxglove.primitives import (
    BodyDrawer,
    convert_pose,
    make_fix,
    make_timestamp,
    make_transform,
    make_uncertainty,
)
from mstools.meshes import MeshFolders
from mstools.recordings.drive import MAX_CHANNELS, MAX_STAMP, Drive, DriveEvent, EventKind, FramePoses, compute_nis
from mstools.recordings.pose_signals import compute_signals
from mstools.report.charts import encode_json

TF_TOPIC: Final = "/tf"
POSE_TOPIC: Final = "/pose"
POSE_FIX_TOPIC: Final = "/pose/fix"
MODEL_TOPIC: Final = "/model"
UNCERTAINTY_TOPIC: Final = "/uncertainty"
STATE_TOPIC: Final = "/state"
NIS_TOPIC: Final = "/nis"
DIAGNOSTICS_TOPIC: Final = "/diagnostics"
EVENTS_TOPIC: Final = "/events"
FIX_PREFIX: Final = "/fix/"
DECODED_PREFIX: Final = "/decoded/"
RAW_PREFIX: Final = "/lcm/"

FIX_PERIOD_US: Final = 200_000
STATIC_PERIOD_US: Final = 5_000_000
"""Time between two messages with all frames: a viewer that jumps to a time has only the last one before it."""

WORLD: Final = "World:UTM"

_WARNINGS: Final = (EventKind.INVALID, EventKind.REJECTION, EventKind.RESET)
_OK, _WARN, _ERROR, _STALE = range(4)
"""Levels of diagnostic_msgs/DiagnosticStatus."""

_TIME: Final = make_schema(sec="integer", nsec="integer")

_STATUS: Final = make_schema(
    level="integer",
    name="string",
    message="string",
    hardware_id="string",
    values=make_array_schema(make_schema(key="string", value="string")),
)
DIAGNOSTICS_SCHEMA: Final = make_schema(
    "diagnostic_msgs/DiagnosticArray",
    header=make_schema(stamp=_TIME, frame_id="string"),
    status=make_array_schema(_STATUS),
)
STATE_SCHEMA: Final = make_schema(
    "modelserver.State",
    timestamp=_TIME,
    valid="boolean",
    reason="string",
    speed="number",
    heading_deg="number",
    horizontal_sigma="number",
    horizontal_protection_level="number",
    heading_protection_level_deg="number",
)
"""Speed in m/s, of the last 0.2 s; heading clockwise from grid north; sigma and levels in m or degrees, see POSE."""

NIS_SCHEMA: Final = make_schema(
    "modelserver.Nis",
    timestamp=_TIME,
    measurements=make_array_schema(
        make_schema(label="string", source="string", kind="string", value="number", gate="number", verdict="string")
    ),
)
"""`label` is source and kind; `value` and `gate`, above which it is rejected, are per degree of freedom."""


class FoxgloveWriter:
    """Log a drive to a context of the Foxglove SDK.

    Parameters
    ----------
    prefix : of the service's channels
    definitions : folder of the .lcm files; with it the LCM messages are logged too, None for none
    with_decoded : whether they are logged as JSON
    model : geometry in place of that of the service
    meshes : the folders in which mesh files are looked up
    """

    def __init__(
        self,
        context: Context,
        prefix: str = "",
        definitions: Path | None = None,
        with_decoded: bool = True,
        model: Model | None = None,
        meshes: MeshFolders | None = None,
    ):
        self._context = context
        base = "" if model is None else names.join(model.root.name, model.root.frames[0].name)
        self._drive = Drive(prefix, model, base, keep_geometry=model is not None, on_event=self._log_event)
        self._now = 0
        self._definitions = definitions
        self._drawer = BodyDrawer(meshes or MeshFolders())
        self._frames: FramePoses | None = None
        self._next_static = self._next_fix = self._last_state = 0
        self._are_shapes_due = True
        self._tf = FrameTransformsChannel(TF_TOPIC, context=context)
        self._pose = OdometryChannel(POSE_TOPIC, context=context)
        self._place = LocationFixChannel(POSE_FIX_TOPIC, context=context)
        self._scene = SceneUpdateChannel(MODEL_TOPIC, context=context)
        self._uncertainty = SceneUpdateChannel(UNCERTAINTY_TOPIC, context=context)
        self._log = LogChannel(EVENTS_TOPIC, context=context)
        self._state = Channel(STATE_TOPIC, schema=STATE_SCHEMA, context=context)
        self._nis = Channel(NIS_TOPIC, schema=NIS_SCHEMA, context=context)
        self._diagnostics = Channel(DIAGNOSTICS_TOPIC, schema=DIAGNOSTICS_SCHEMA, context=context)
        self._fixes: dict[str, LocationFixChannel] = {}
        self._raw: dict[str, Channel] = {}
        self._decoded: dict[str, tuple[str, Channel]] = {}
        self._gps = fingerprint_of("gps_t")
        self._steps: list[Callable[[str, bytes, int], None]] = [self._log_derived]
        if with_decoded:
            self._steps.append(self._log_decoded)
        if definitions is not None:
            self._steps.append(self._log_raw)
        self.skipped = 0
        """Messages that could not be read."""

    @property
    def has_geometry(self) -> bool:
        return self._frames is not None

    @property
    def base_frame(self) -> str:
        """The frame whose pose is published."""
        return self._drive.base_frame

    @property
    def sources(self) -> Collection[str]:
        """The sources of fixes."""
        return self._fixes.keys()

    @property
    def measurements(self) -> Collection[str]:
        """The labels of innovations."""
        return self._drive.nis.keys()

    @property
    def unread(self) -> Mapping[str, list[str]]:
        """Mesh files that are not drawn, by the reason."""
        return self._drawer.unread

    def refresh(self) -> None:
        """Log frames and shapes again with the next message: a client takes them. Any thread may call it."""
        self._are_shapes_due = True

    def feed(self, channel: str, data: bytes, now: int) -> None:
        """Log what a message received at `now`, microseconds, holds. Raises nothing; `skipped` counts the damaged."""
        if not channel.startswith(self._drive.prefix):
            return
        is_whole = True
        for step in self._steps:
            try:
                step(channel, data, now)
            except (WireError, GeodesyError, OverflowError):
                # the last one is a time that Foxglove's or MCAP's cannot hold
                is_whole = False
        self.skipped += not is_whole

    def _log_derived(self, channel: str, data: bytes, now: int) -> None:
        if not 0 <= now < MAX_STAMP:
            raise WireError("malformed", f"{now} is no time of receipt")
        drive = self._drive
        self._now = now
        drive.feed(channel, data, now)
        name = channel[len(drive.prefix) :]
        if drive.model is not None:
            self._log_geometry(drive.model, now)
        if name == "POSE":
            self._log_pose(decode("pose_transform_t", data), now)
            if drive.poses.last != self._last_state:
                self._last_state = drive.poses.last
                self._log_state(now)
        elif name == "LOCALIZATION_DECISIONS":
            self._log_nis(decode("decisions_t", data), now)
        elif name == "MODELSERVER_HEALTH":
            self._log_health(decode("health_t", data), now)
        elif data[:8] == self._gps:
            self._log_gps(decode("gps_t", data), now)
        elif self._frames is not None and (name.startswith("JOINTS") or channel == drive.joints_channel):
            self._log_frames(self._frames, self._frames.move_joints(drive.get_joints(now)), now)

    # --- frames and shapes

    def _log_geometry(self, model: Model, now: int) -> None:
        frames = self._frames
        is_fresh = 0 < self._next_static - now <= STATIC_PERIOD_US and not self._are_shapes_due
        if frames is not None and frames.model is model and is_fresh:
            return
        if frames is None or frames.model is not model:
            frames = self._frames = FramePoses(model, self._drive.base_frame)
            frames.move_joints(self._drive.get_joints(now))
            self._are_shapes_due = True
        self._next_static = now + STATIC_PERIOD_US
        self._log_frames(frames, frames.compute_bodies(), now)
        if self._are_shapes_due:
            self._are_shapes_due = False
            entities = [self._drawer.draw(body, now) for body in model.bodies if body.name in frames.paths]
            # those of an earlier geometry
            everything = SceneEntityDeletion(type=SceneEntityDeletionType.All, timestamp=make_timestamp(now))
            self._scene.log(SceneUpdate(deletions=[everything], entities=entities), log_time=now * 1000)

    def _log_frames(self, frames: FramePoses, bodies: Mapping[str, Pose], now: int) -> None:
        base = self._drive.base_frame
        poses = frames.compute_frames(bodies)
        transforms = [make_transform(base, name, pose, now) for name, pose in poses.items() if name != base]
        if transforms:
            self._tf.log(FrameTransforms(transforms=transforms), log_time=now * 1000)

    # --- pose

    def _log_pose(self, answer: PoseAnswer, now: int) -> None:
        found = answer.transformation
        stamp, pose, covariance = found.utime, found.pose, found.covariance
        transform = make_transform(found.frame_of_reference, found.frame_of_interest, pose, stamp)
        self._tf.log(FrameTransforms(transforms=[transform]), log_time=now * 1000)
        message = Odometry(
            timestamp=make_timestamp(stamp),
            frame_id=names.shorten(found.frame_of_reference),
            body_frame_id=names.shorten(found.frame_of_interest),
            pose=convert_pose(pose),
            pose_covariance=None if covariance is None else covariance.ravel().tolist(),
        )
        self._pose.log(message, log_time=now * 1000)
        if answer.origin is None or stamp < self._next_fix <= stamp + FIX_PERIOD_US:
            return
        self._next_fix = stamp + FIX_PERIOD_US
        place = answer.geodetic
        if place is None:
            return
        fix = make_fix(
            stamp,
            found.frame_of_interest,
            (place.latitude_deg, place.longitude_deg, place.height),
            None if covariance is None else covariance[:3, :3].ravel().tolist(),
            math.radians(place.heading_deg) if math.isfinite(place.heading_deg) else None,
        )
        self._place.log(fix, log_time=now * 1000)

    def _log_state(self, now: int) -> None:
        drive = self._drive
        picture = drive.get_picture(drive.poses.last)
        entity = make_uncertainty(picture, WORLD)
        self._uncertainty.log(SceneUpdate(entities=[entity]), log_time=now * 1000)
        signals = compute_signals(drive, picture.utime)
        values = {
            "speed": signals.speed,
            "heading_deg": signals.heading,
            "horizontal_sigma": signals.sigma,
            "horizontal_protection_level": picture.horizontal_protection_level,
            "heading_protection_level_deg": math.degrees(picture.heading_protection_level),
        }
        state = {
            "timestamp": _make_time(picture.utime),
            "valid": not picture.invalid,
            "reason": picture.invalid.explain(),
            **{name: convert_number(value) for name, value in values.items()},
        }
        _log_json(self._state, state, now)

    def _log_nis(self, message: PublishDecisions, now: int) -> None:
        measurements = []
        for each in message.decisions:
            normalized = compute_nis(each)
            if normalized is not None:
                label, value = normalized
                gate = convert_number(each.limit / each.dof)
                measurements.append(
                    {
                        "label": label,
                        "source": each.source,
                        "kind": each.kind,
                        "value": value,
                        "gate": gate,
                        "verdict": each.verdict.name.lower(),
                    }
                )
        if measurements:
            _log_json(self._nis, {"timestamp": _make_time(message.utime), "measurements": measurements}, now)

    # --- fixes, health, events

    def _log_gps(self, sample: GpsSample, now: int) -> None:
        place = (sample.latitude_deg, sample.longitude_deg, sample.height_ellipsoidal)
        source = sample.header.source
        if sample.fix_type is FixType.NONE or not all(map(math.isfinite, place[:2])):
            return
        if source not in self._fixes:
            _check_count(self._fixes)
            self._fixes[source] = LocationFixChannel(f"{FIX_PREFIX}{source}", context=self._context)
        covariance = sample.position_covariance
        known = None if covariance is None else list(covariance)
        self._fixes[source].log(make_fix(sample.header.utime, source, place, known), log_time=now * 1000)

    def _log_health(self, health: Health, now: int) -> None:
        invalid = health.invalid_reasons.explain() if health.invalid_reasons else "the pose is valid"
        status = [_make_status("pose", _WARN if health.invalid_reasons else _OK, invalid)]
        for each in health.channels:
            level = _STALE if each.silent else _OK
            message = "silent" if each.silent else f"{each.rate_hz:.1f} Hz"
            values = {"count": each.count, "used": each.used, "measured": each.measured, "age": f"{each.age:.3f}"}
            status.append(_make_status(each.channel, level, message, values))
        status += [_make_status(subject, _WARN, text) for subject, text in health.warnings]
        if health.handler_errors:
            status.append(_make_status("internal errors", _ERROR, str(health.handler_errors)))
        header = {"stamp": _make_time(health.utime), "frame_id": ""}
        _log_json(self._diagnostics, {"header": header, "status": status}, now)

    def _log_event(self, event: DriveEvent) -> None:
        level = LogLevel.Warning if event.kind in _WARNINGS else LogLevel.Info
        message = Log(timestamp=make_timestamp(event.utime), level=level, message=event.text, name=event.kind)
        self._log.log(message, log_time=self._now * 1000)

    # --- LCM messages

    def _log_decoded(self, channel: str, data: bytes, now: int) -> None:
        name = type_name_of(data)
        made = make_json_type(name) if name else None
        if made is None:
            return
        known, decoded = self._decoded.get(channel, (name, None))
        if decoded is None:
            _check_count(self._decoded)
            decoded = Channel(f"{DECODED_PREFIX}{channel}", schema=dict(made.schema), context=self._context)
            self._decoded[channel] = name, decoded
        if known != name:
            raise WireError("malformed", f"{channel} had messages of type {known}, this one is {name}")
        if decoded.has_sinks():
            _log_json(decoded, decode_to_json(name, data), now)

    def _log_raw(self, channel: str, data: bytes, now: int) -> None:
        if channel not in self._raw:
            _check_count(self._raw)
            assert self._definitions is not None
            name = type_name_of(data)
            text = (self._definitions / f"{name}.lcm").read_bytes() if name else b""
            schema = Schema(name=f"mslcm.{name or 'unknown'}", encoding="lcm", data=text)
            topic = f"{RAW_PREFIX}{channel}"
            self._raw[channel] = Channel(topic, schema=schema, message_encoding="lcm", context=self._context)
        self._raw[channel].log(data, log_time=now * 1000)


def _check_count(channels: Collection[str]) -> None:
    """Raise WireError where there are too many to add one."""
    if len(channels) >= MAX_CHANNELS:
        raise WireError("malformed", f"more than {MAX_CHANNELS} channels")


def _log_json(channel: Channel, message: Mapping[str, object], now: int) -> None:
    channel.log(encode_json(message).encode(), log_time=now * 1000)


def _make_time(utime: int) -> dict[str, int]:
    seconds, microseconds = divmod(utime, 1_000_000)
    return {"sec": seconds, "nsec": microseconds * 1000}


def _make_status(name: str, level: int, message: str, values: Mapping[str, object] | None = None) -> dict[str, object]:
    pairs = [{"key": key, "value": str(value)} for key, value in (values or {}).items()]
    return {"level": level, "name": name, "message": message, "hardware_id": "modelserver", "values": pairs}
