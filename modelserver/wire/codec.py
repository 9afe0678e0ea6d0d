"""The only place that knows both sides: bytes of a wire type, and the values that the core speaks."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from io import BytesIO
from typing import Any, NamedTuple

from modelserver import messages
from modelserver.errors import WireError
from modelserver.wire import (
    aiding,
    commands,
    driver_health,
    health,
    many,
    moving,
    navigation,
    packed,
    poses,
    queries,
    requests,
    sensors,
    signed,
    snapshot,
    vehicle,
)
from mslcm.absolute_pose_t import absolute_pose_t
from mslcm.acknowledgement_t import acknowledgement_t
from mslcm.decisions_t import decisions_t
from mslcm.driver_health_t import driver_health_t
from mslcm.get_body_frame_list_request_t import get_body_frame_list_request_t
from mslcm.get_body_list_request_t import get_body_list_request_t
from mslcm.get_explanation_reply_t import get_explanation_reply_t
from mslcm.get_explanation_request_t import get_explanation_request_t
from mslcm.get_h_transform_request_t import get_h_transform_request_t
from mslcm.get_history_reply_t import get_history_reply_t
from mslcm.get_history_request_t import get_history_request_t
from mslcm.get_motion_reply_t import get_motion_reply_t
from mslcm.get_motion_request_t import get_motion_request_t
from mslcm.get_state_vector_reply_t import get_state_vector_reply_t
from mslcm.get_state_vector_request_t import get_state_vector_request_t
from mslcm.get_transformation_reply_t import get_transformation_reply_t
from mslcm.get_transformation_request_t import get_transformation_request_t
from mslcm.get_transformations_reply_t import get_transformations_reply_t
from mslcm.get_transformations_request_t import get_transformations_request_t
from mslcm.gps_t import gps_t
from mslcm.health_t import health_t
from mslcm.imu_t import imu_t
from mslcm.joints_t import joints_t
from mslcm.localization_mode_t import localization_mode_t
from mslcm.model_snapshot_t import model_snapshot_t
from mslcm.name_list_reply_t import name_list_reply_t
from mslcm.navigation_state_t import navigation_state_t
from mslcm.pose_transform_t import pose_transform_t
from mslcm.pose_vector_t import pose_vector_t
from mslcm.range_t import range_t
from mslcm.relative_pose_t import relative_pose_t
from mslcm.reload_model_reply_t import reload_model_reply_t
from mslcm.reload_model_request_t import reload_model_request_t
from mslcm.set_h_transform_request_t import set_h_transform_request_t
from mslcm.set_state_vector_request_t import set_state_vector_request_t
from mslcm.signed_t import signed_t
from mslcm.vehicle_command_t import vehicle_command_t
from mslcm.vehicle_status_t import vehicle_status_t
from mslcm.wheels_t import wheels_t


class _Codec(NamedTuple):
    """A wire type, the value it becomes, and the functions between them."""

    type_name: str
    fingerprint: bytes
    value: type
    read: Callable[[bytes], Any]
    write: Callable[[Any], bytes]


def _generated(wire: Any, value: type, read: Callable[[Any], Any], write: Callable[[Any], Any]) -> _Codec:
    """Return the codec of a type that goes through the generated class."""

    # what is shorter than a message of empty names and arrays is recognized without decoding it
    least = len(wire().encode())

    def read_bytes(data: bytes) -> Any:
        if len(data) < least:
            raise WireError("truncated", f"{len(data)} bytes are no whole {wire.__name__}: the end is cut")
        # The generated decoder takes a text cut short for a shorter one. With one byte more at the end it reads
        # into that byte instead, so that a message is whole exactly when the decoder stops where the data end.
        stream = BytesIO(data + b"\0")
        message = wire.decode(stream)
        end = stream.tell()
        if end > len(data):
            raise WireError("truncated", f"{len(data)} bytes are no whole {wire.__name__}: the end is cut")
        packed.check_end(data, end)
        return read(message)

    return _Codec(
        wire.__name__, wire._get_packed_fingerprint(), value, read_bytes, lambda value: bytes(write(value).encode())
    )


def _packed(wire: Any, value: type, read: Callable[[bytes], Any], write: Callable[[Any], bytes]) -> _Codec:
    """Return the codec of a type that is packed by hand."""
    return _Codec(wire.__name__, wire._get_packed_fingerprint(), value, read, write)


_CODECS = (
    _generated(gps_t, messages.GpsSample, sensors.read_gps, sensors.write_gps),
    _generated(imu_t, messages.ImuSample, sensors.read_imu, sensors.write_imu),
    _generated(wheels_t, messages.WheelsSample, sensors.read_wheels, sensors.write_wheels),
    _generated(joints_t, messages.JointsSample, sensors.read_joints, sensors.write_joints),
    _generated(absolute_pose_t, messages.AbsolutePoseSample, aiding.read_absolute_pose, aiding.write_absolute_pose),
    _generated(relative_pose_t, messages.RelativePoseSample, aiding.read_relative_pose, aiding.write_relative_pose),
    _generated(range_t, messages.RangeSample, aiding.read_range, aiding.write_range),
    _generated(
        vehicle_status_t, messages.VehicleStatusSample, vehicle.read_vehicle_status, vehicle.write_vehicle_status
    ),
    _generated(vehicle_command_t, messages.VehicleCommand, vehicle.read_vehicle_command, vehicle.write_vehicle_command),
    _generated(localization_mode_t, messages.SwitchMode, navigation.read_mode, navigation.write_mode),
    _generated(decisions_t, messages.PublishDecisions, navigation.read_decisions, navigation.write_decisions),
    _generated(navigation_state_t, messages.NavigationState, navigation.read_state, navigation.write_state),
    _packed(get_transformation_request_t, messages.GetTransformation, queries.read_request, queries.write_request),
    _generated(
        get_body_list_request_t, messages.GetBodyList, requests.read_get_body_list, requests.write_get_body_list
    ),
    _generated(
        get_body_frame_list_request_t,
        messages.GetBodyFrameList,
        requests.read_get_body_frame_list,
        requests.write_get_body_frame_list,
    ),
    _generated(
        get_state_vector_request_t,
        messages.GetStateVector,
        requests.read_get_state_vector,
        requests.write_get_state_vector,
    ),
    _generated(
        get_h_transform_request_t, messages.GetHTransform, requests.read_get_h_transform, requests.write_get_h_transform
    ),
    _generated(get_history_request_t, messages.GetHistory, requests.read_get_history, requests.write_get_history),
    _packed(
        get_transformation_reply_t,
        messages.TransformReply,
        queries.read_transform_reply,
        queries.write_transform_reply,
    ),
    _packed(
        get_state_vector_reply_t,
        messages.StateVectorReply,
        queries.read_state_vector_reply,
        queries.write_state_vector_reply,
    ),
    _packed(get_history_reply_t, messages.HistoryReply, queries.read_history_reply, queries.write_history_reply),
    _generated(
        name_list_reply_t, messages.NameListReply, requests.read_name_list_reply, requests.write_name_list_reply
    ),
    _packed(get_transformations_request_t, messages.GetTransformations, many.read_request, many.write_request),
    _packed(get_transformations_reply_t, messages.ManyReply, many.read_reply, many.write_reply),
    _packed(get_motion_request_t, messages.GetMotion, moving.read_get_motion, moving.write_get_motion),
    _packed(get_motion_reply_t, messages.MotionReply, moving.read_motion_reply, moving.write_motion_reply),
    _packed(
        get_explanation_request_t, messages.GetExplanation, moving.read_get_explanation, moving.write_get_explanation
    ),
    _packed(
        get_explanation_reply_t,
        messages.ExplanationReply,
        moving.read_explanation_reply,
        moving.write_explanation_reply,
    ),
    _packed(reload_model_request_t, messages.ReloadModel, commands.read_reload, commands.write_reload),
    _packed(reload_model_reply_t, messages.ReloadReply, commands.read_reload_reply, commands.write_reload_reply),
    _packed(set_state_vector_request_t, messages.SetStateVector, commands.read_set_vector, commands.write_set_vector),
    _packed(
        set_h_transform_request_t, messages.SetHTransform, commands.read_set_transform, commands.write_set_transform
    ),
    _packed(acknowledgement_t, messages.Acknowledgement, commands.read_acknowledgement, commands.write_acknowledgement),
    _packed(signed_t, messages.Envelope, signed.read_signed, signed.write_signed),
    _generated(model_snapshot_t, messages.SnapshotPart, snapshot.read_snapshot, snapshot.write_snapshot),
    _generated(health_t, messages.Health, health.read_health, health.write_health),
    _generated(
        driver_health_t, messages.DriverHealth, driver_health.read_driver_health, driver_health.write_driver_health
    ),
    _packed(pose_transform_t, messages.PoseAnswer, poses.read_transform, poses.write_transform),
    _packed(pose_vector_t, messages.PoseAnswer, poses.read_vector, poses.write_vector),
)

_BY_TYPE_NAME: Mapping[str, _Codec] = {codec.type_name: codec for codec in _CODECS}
_BY_VALUE: Mapping[type, _Codec] = {codec.value: codec for codec in reversed(_CODECS)}


def type_names() -> tuple[str, ...]:
    """Return the names of the wire types that can be decoded."""
    return tuple(_BY_TYPE_NAME)


def fingerprint_of(type_name: str) -> bytes:
    """Return the eight bytes that a message of a wire type begins with."""
    return _BY_TYPE_NAME[type_name].fingerprint


def decode(type_name: str, data: bytes) -> Any:
    """Return the value in `data`, which should hold a message of the wire type `type_name`.

    Raises WireError with reason `fingerprint` (another type, or no message at all), `truncated` or `malformed`.
    """
    codec = _BY_TYPE_NAME[type_name]
    if data[:8] != codec.fingerprint:
        raise WireError("fingerprint", f"{len(data)} bytes are no {type_name}: the fingerprint differs")
    try:
        return codec.read(data)
    except WireError:
        raise
    except (struct.error, ValueError, IndexError, OverflowError, MemoryError) as error:
        raise WireError("truncated", f"{len(data)} bytes are no whole {type_name}: {error}") from None


def encode(value: Any, type_name: str = "") -> bytes:
    """Return the bytes of a value; a pose goes out as pose_transform_t unless `type_name` says otherwise."""
    codec = _BY_TYPE_NAME[type_name] if type_name else _BY_VALUE[type(value)]
    return codec.write(value)
