"""A drive in Foxglove's schemas: frames, poses, fixes, the geometry's shapes, health and events; and the LCM messages.

`FoxgloveWriter.feed` takes the messages of the service, from a log or a bus, and logs to a context of the Foxglove SDK,
which writes an MCAP file or serves a websocket. Topics:

    /tf            FrameTransforms   the base frame in World:UTM; each other frame in the base frame
    /pose          PoseInFrame       POSE
    /pose/fix      LocationFix       POSE as latitude and longitude, at most 5 Hz
    /fix/SOURCE    LocationFix       fixes, stamped by their measurement
    /model         SceneUpdate       shapes of the bodies
    /diagnostics   DiagnosticArray   MODELSERVER_HEALTH, with the names of ROS for the Diagnostics panel, as JSON
    /events        Log               validity, rejections, resets, mode, geometry
    /lcm/CHANNEL   bytes             each LCM message as it is, with its .lcm definition as the schema

Foxglove's frames are those of the geometry, by their names in ROS where they have one: utm, base_link for
base_link:Origin.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from foxglove import Channel, Context, Schema
from foxglove.channels import (
    FrameTransformsChannel,
    LocationFixChannel,
    LogChannel,
    PoseInFrameChannel,
    SceneUpdateChannel,
)
from foxglove.messages import (
    Color,
    CubePrimitive,
    CylinderPrimitive,
    FrameTransform,
    FrameTransforms,
    LocationFix,
    LocationFixPositionCovarianceType,
    Log,
    LogLevel,
    ModelPrimitive,
    PoseInFrame,
    Quaternion,
    SceneEntity,
    SceneEntityDeletion,
    SceneEntityDeletionType,
    SceneUpdate,
    SpherePrimitive,
    Timestamp,
    Vector3,
)
from foxglove.messages import Pose as FoxglovePose

from modelserver.earth.geodesy import GeodesyError
from modelserver.errors import WireError
from modelserver.geometry import names
from modelserver.geometry.model import Model
from modelserver.geometry.parts import Shape, ShapeKind
from modelserver.messages import FixType, GpsSample, Health, PoseAnswer
from modelserver.transforms.pose import Pose
from modelserver.wire.codec import decode, fingerprint_of, type_name_of
from mstools.recordings.drive import Drive, DriveEvent, EventKind, FramePoses

FIX_PERIOD_US: Final = 200_000
STATIC_PERIOD_US: Final = 5_000_000
"""Time between two messages with all frames and shapes: a viewer that connects later needs them."""

BODY_COLOR: Final = (0.42, 0.55, 0.69, 1.0)
MAX_SOURCES: Final = 100

_WARNINGS: Final = (EventKind.INVALID, EventKind.REJECTION, EventKind.RESET)
_OK, _WARN, _ERROR, _STALE = range(4)
"""Levels of diagnostic_msgs/DiagnosticStatus."""


def _make_schema(**fields: object) -> dict[str, object]:
    """Return the JSON schema of an object; a text is the name of a plain type."""
    properties = {name: {"type": field} if isinstance(field, str) else field for name, field in fields.items()}
    return {"type": "object", "properties": properties}


_STATUS: Final = _make_schema(
    level="integer",
    name="string",
    message="string",
    hardware_id="string",
    values={"type": "array", "items": _make_schema(key="string", value="string")},
)
DIAGNOSTICS_SCHEMA: Final = {"title": "diagnostic_msgs/DiagnosticArray"} | _make_schema(
    header=_make_schema(stamp=_make_schema(sec="integer", nsec="integer"), frame_id="string"),
    status={"type": "array", "items": _STATUS},
)


class FoxgloveWriter:
    """Log a drive to a context of the Foxglove SDK.

    Parameters
    ----------
    prefix : of the service's channels
    definitions : folder of the .lcm files; with it the LCM messages are logged too, None for none
    model : geometry in place of that of the service
    """

    def __init__(self, context: Context, prefix: str = "", definitions: Path | None = None, model: Model | None = None):
        self._context = context
        base = "" if model is None else names.join(model.root.name, model.root.frames[0].name)
        self._drive = Drive(prefix, model, base, keep_geometry=model is not None, on_event=self._log_event)
        self._now = 0
        self._definitions = definitions
        self._frames: FramePoses | None = None
        self._next_static = self._next_fix = 0
        self._tf = FrameTransformsChannel("/tf", context=context)
        self._pose = PoseInFrameChannel("/pose", context=context)
        self._place = LocationFixChannel("/pose/fix", context=context)
        self._scene = SceneUpdateChannel("/model", context=context)
        self._log = LogChannel("/events", context=context)
        self._diagnostics = Channel("/diagnostics", schema=DIAGNOSTICS_SCHEMA, context=context)
        self._fixes: dict[str, LocationFixChannel] = {}
        self._raw: dict[str, Channel] = {}
        self._gps = fingerprint_of("gps_t")
        self.skipped = 0
        """Messages that could not be read."""

    @property
    def has_geometry(self) -> bool:
        return self._frames is not None

    def feed(self, channel: str, data: bytes, now: int) -> None:
        """Log what a message received at `now`, microseconds, holds."""
        drive = self._drive
        if not channel.startswith(drive.prefix):
            return
        self._now = now
        drive.feed(channel, data, now)
        name = channel[len(drive.prefix) :]
        if self._definitions is not None:
            self._log_raw(self._definitions, channel, data, now)
        try:
            if drive.model is not None:
                self._log_geometry(drive.model, now)
            if name == "POSE":
                self._log_pose(decode("pose_transform_t", data), now)
            elif name == "MODELSERVER_HEALTH":
                self._log_health(decode("health_t", data), now)
            elif data[:8] == self._gps:
                self._log_gps(decode("gps_t", data), now)
            elif self._frames is not None and (name.startswith("JOINTS") or channel == drive.joints_channel):
                self._log_frames(self._frames, self._frames.move_joints(drive.get_joints(now)), now)
        except (WireError, GeodesyError, OverflowError):
            # the last one is a stamp that Foxglove's cannot hold
            self.skipped += 1

    # --- frames

    def _log_geometry(self, model: Model, now: int) -> None:
        frames = self._frames
        if frames is not None and frames.model is model and now < self._next_static:
            return
        if frames is None or frames.model is not model:
            if frames is not None:
                everything = SceneEntityDeletion(type=SceneEntityDeletionType.All)
                self._scene.log(SceneUpdate(deletions=[everything]), log_time=now * 1000)
            frames = self._frames = FramePoses(model, self._drive.base_frame)
            frames.move_joints(self._drive.get_joints(now))
        self._next_static = now + STATIC_PERIOD_US
        self._log_frames(frames, frames.compute_bodies(), now)
        entities = [
            _make_entity(body.frames[0].full_name, body.frames[0].pose, body.visuals or body.collisions, now)
            for body in model.bodies
            if body.name in frames.paths and (body.visuals or body.collisions)
        ]
        if entities:
            self._scene.log(SceneUpdate(entities=entities), log_time=now * 1000)

    def _log_frames(self, frames: FramePoses, bodies: Mapping[str, Pose], now: int) -> None:
        base = self._drive.base_frame
        poses = frames.compute_frames(bodies)
        transforms = [_make_transform(base, name, pose, now) for name, pose in poses.items() if name != base]
        if transforms:
            self._tf.log(FrameTransforms(transforms=transforms), log_time=now * 1000)

    def _log_pose(self, answer: PoseAnswer, now: int) -> None:
        found = answer.transformation
        stamp, pose = found.utime, found.pose
        transform = _make_transform(found.frame_of_reference, found.frame_of_interest, pose, stamp)
        self._tf.log(FrameTransforms(transforms=[transform]), log_time=now * 1000)
        message = PoseInFrame(
            timestamp=_stamp(stamp), frame_id=names.shorten(found.frame_of_reference), pose=_convert_pose(pose)
        )
        self._pose.log(message, log_time=now * 1000)
        if answer.origin is None or stamp < self._next_fix <= stamp + FIX_PERIOD_US:
            return
        self._next_fix = stamp + FIX_PERIOD_US
        place = answer.geodetic
        if place is None:
            return
        covariance = None if found.covariance is None else found.covariance[:3, :3].ravel().tolist()
        fix = _make_fix(
            stamp, found.frame_of_interest, (place.latitude_deg, place.longitude_deg, place.height), covariance
        )
        self._place.log(fix, log_time=now * 1000)

    # --- fixes, health, events

    def _log_gps(self, sample: GpsSample, now: int) -> None:
        place = (sample.latitude_deg, sample.longitude_deg, sample.height_ellipsoidal)
        source = sample.header.source
        if sample.fix_type is FixType.NONE or not all(map(math.isfinite, place[:2])):
            return
        if source not in self._fixes:
            if len(self._fixes) >= MAX_SOURCES:
                return
            self._fixes[source] = LocationFixChannel(f"/fix/{source}", context=self._context)
        covariance = sample.position_covariance
        known = None if covariance is None else list(covariance)
        self._fixes[source].log(_make_fix(sample.header.utime, source, place, known), log_time=now * 1000)

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
        sec, usec = divmod(health.utime, 1_000_000)
        header = {"stamp": {"sec": sec, "nsec": usec * 1000}, "frame_id": ""}
        self._diagnostics.log({"header": header, "status": status}, log_time=now * 1000)

    def _log_event(self, event: DriveEvent) -> None:
        level = LogLevel.Warning if event.kind in _WARNINGS else LogLevel.Info
        message = Log(timestamp=_stamp(event.utime), level=level, message=event.text, name=event.kind)
        self._log.log(message, log_time=self._now * 1000)

    def _log_raw(self, definitions: Path, channel: str, data: bytes, now: int) -> None:
        if channel not in self._raw:
            if len(self._raw) >= MAX_SOURCES:
                return
            name = type_name_of(data)
            text = (definitions / f"{name}.lcm").read_bytes() if name else b""
            schema = Schema(name=f"mslcm.{name or 'unknown'}", encoding="lcm", data=text)
            self._raw[channel] = Channel(
                f"/lcm/{channel}", schema=schema, message_encoding="lcm", context=self._context
            )
        self._raw[channel].log(data, log_time=now * 1000)


def _stamp(utime: int) -> Timestamp:
    seconds, microseconds = divmod(utime, 1_000_000)
    return Timestamp(seconds, microseconds * 1000)


def _convert(pose: Pose) -> tuple[Vector3, Quaternion]:
    (x, y, z), (qw, qx, qy, qz) = pose.xyz, pose.wxyz
    return Vector3(x=x, y=y, z=z), Quaternion(x=qx, y=qy, z=qz, w=qw)


def _convert_pose(pose: Pose) -> FoxglovePose:
    position, orientation = _convert(pose)
    return FoxglovePose(position=position, orientation=orientation)


def _make_transform(parent: str, child: str, pose: Pose, utime: int) -> FrameTransform:
    translation, rotation = _convert(pose)
    return FrameTransform(
        timestamp=_stamp(utime),
        parent_frame_id=names.shorten(parent),
        child_frame_id=names.shorten(child),
        translation=translation,
        rotation=rotation,
    )


def _make_fix(utime: int, frame: str, place: tuple[float, float, float], covariance: list[float] | None) -> LocationFix:
    """Return a fix at latitude and longitude in degrees and a height, with its covariance along east, north, up."""
    latitude, longitude, height = place
    kind = LocationFixPositionCovarianceType
    return LocationFix(
        timestamp=_stamp(utime),
        frame_id=names.shorten(frame),
        latitude=latitude,
        longitude=longitude,
        altitude=height if math.isfinite(height) else 0.0,
        position_covariance=covariance,
        position_covariance_type=kind.Unknown if covariance is None else kind.Known,
    )


def _make_entity(frame: str, X_body_frame: Pose, shapes: tuple[Shape, ...], now: int) -> SceneEntity:
    to_frame = X_body_frame.inverse()
    cubes, cylinders, spheres, models = [], [], [], []
    for shape in shapes:
        pose = _convert_pose(to_frame @ shape.pose)
        material = shape.material.color if shape.material is not None else None
        r, g, b, a = material or BODY_COLOR
        color = Color(r=r, g=g, b=b, a=a)
        if shape.kind is ShapeKind.BOX:
            x, y, z = shape.size
            cubes.append(CubePrimitive(pose=pose, size=Vector3(x=x, y=y, z=z), color=color))
        elif shape.kind is ShapeKind.CYLINDER:
            radius, length = shape.size
            size = Vector3(x=2.0 * radius, y=2.0 * radius, z=length)
            cylinders.append(CylinderPrimitive(pose=pose, size=size, bottom_scale=1.0, top_scale=1.0, color=color))
        elif shape.kind is ShapeKind.SPHERE:
            width = 2.0 * shape.size[0]
            spheres.append(SpherePrimitive(pose=pose, size=Vector3(x=width, y=width, z=width), color=color))
        else:
            x, y, z = shape.size
            scale = Vector3(x=x, y=y, z=z)
            models.append(ModelPrimitive(pose=pose, scale=scale, color=color, url=shape.file))
    return SceneEntity(
        timestamp=_stamp(now),
        frame_id=names.shorten(frame),
        id=names.split(frame)[0],
        frame_locked=True,
        cubes=cubes,
        cylinders=cylinders,
        spheres=spheres,
        models=models,
    )


def _make_status(name: str, level: int, message: str, values: Mapping[str, object] | None = None) -> dict[str, object]:
    pairs = [{"key": key, "value": str(value)} for key, value in (values or {}).items()]
    return {"level": level, "name": name, "message": message, "hardware_id": "modelserver", "values": pairs}
