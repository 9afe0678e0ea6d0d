"""Codec of the messages. Generated from lcmtypes/*.lcm by `make types`; do not edit."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import Final

from modelserver.errors import Status
from modelserver.messages import (
    AbsolutePoseSample,
    Acknowledgement,
    ChannelHealth,
    Decision,
    Direction,
    DriverHealth,
    DriverPhase,
    DynamicsAnswer,
    DynamicsReply,
    EdgeReport,
    Envelope,
    Explanation,
    ExplanationReply,
    FixType,
    GetBodyFrameList,
    GetBodyList,
    GetDynamics,
    GetExplanation,
    GetHistory,
    GetHTransform,
    GetMotion,
    GetStateVector,
    GetTransformation,
    GetTransformations,
    GpsSample,
    Health,
    HistoryReply,
    ImuSample,
    Invalid,
    JointSample,
    JointsSample,
    LocalizationHealth,
    MeasurementSample,
    Mode,
    MotionAnswer,
    MotionReply,
    NameListReply,
    NavigationState,
    OrientationReference,
    Phase,
    Policy,
    PoseAnswer,
    PoseBatchReply,
    PoseDemand,
    PublishDecisions,
    RangeSample,
    RejectedCount,
    RelativePoseSample,
    ReloadModel,
    ReloadReply,
    RequestHeader,
    SensorHeader,
    SetHTransform,
    SetStateVector,
    SnapshotPart,
    StabilityHealth,
    StateVectorReply,
    SwitchMode,
    TimeQuery,
    TransformReply,
    Unmet,
    VehicleCommand,
    VehicleMode,
    VehicleStatusSample,
    Verdict,
    WheelSample,
    WheelsSample,
    YawSource,
)
from modelserver.transforms.pose import Pose
from modelserver.wire.batch import pack_get_transformations_reply, unpack_get_transformations_reply
from modelserver.wire.fields import (
    MAX_ANGLE,
    MAX_CONTACTS,
    MAX_COORDINATES,
    MAX_DECISIONS,
    MAX_DISTANCE,
    MAX_FRAME_NAME,
    MAX_MESSAGE_INSTANTS,
    MAX_PAIRS,
    MAX_STATES,
    MAX_VALUES,
    NAN3,
    NAN4,
    NAN9,
    NAN36,
    Codec,
    check_count,
    check_demand,
    check_distance,
    check_finite,
    check_instants,
    check_name,
    check_not_negative,
    check_number,
    check_outgoing,
    check_position,
    check_positive,
    check_sample_utime,
    check_unit_quaternion,
    check_utime,
    pack_matrix,
    pack_numbers,
    pack_text,
    pack_triangle,
    read_bytes,
    read_each,
    read_enum,
    read_matrix3,
    read_numbers,
    read_partial_vector3,
    read_quaternion,
    read_text,
    read_triangle,
    read_vector3,
    read_word,
    skip_nothing,
    verify_model_snapshot,
    verify_relative_pose,
)
from modelserver.wire.poses import (
    NO_POSE_TRANSFORM,
    NO_POSE_VECTOR,
    pack_pose_transform,
    pack_pose_vector,
    pack_reply_header,
    skip_pose_transform,
    skip_pose_vector,
    unpack_pose_transform,
    unpack_pose_vector,
    unpack_reply_header,
)

FINGERPRINTS: Final[Mapping[str, bytes]] = {
    "absolute_pose_t": bytes.fromhex("305f281754526b71"),
    "acknowledgement_t": bytes.fromhex("56db4119c8a4967a"),
    "channel_health_t": bytes.fromhex("ed447313ec93b898"),
    "decision_t": bytes.fromhex("44de773b00abcc98"),
    "decisions_t": bytes.fromhex("21bd524309243fd5"),
    "driver_health_t": bytes.fromhex("0c62286d0ae44df8"),
    "get_body_frame_list_request_t": bytes.fromhex("2497e2c3fc56ff7f"),
    "get_body_list_request_t": bytes.fromhex("02ff54e76e2dd188"),
    "get_dynamics_reply_t": bytes.fromhex("00861eac3d9f9d3e"),
    "get_dynamics_request_t": bytes.fromhex("17b1653b9c6c7292"),
    "get_explanation_reply_t": bytes.fromhex("ddec09b464af1541"),
    "get_explanation_request_t": bytes.fromhex("349d6de2b7954177"),
    "get_h_transform_request_t": bytes.fromhex("eaa07547a5aa8674"),
    "get_history_reply_t": bytes.fromhex("efbd31ec8c327a94"),
    "get_history_request_t": bytes.fromhex("6e2a16f04ed99393"),
    "get_motion_reply_t": bytes.fromhex("971a5c4b691ee19b"),
    "get_motion_request_t": bytes.fromhex("cfb4f4d1e8b42938"),
    "get_state_vector_reply_t": bytes.fromhex("5418e07322bf542b"),
    "get_state_vector_request_t": bytes.fromhex("c2e813b9e147ca53"),
    "get_transformation_reply_t": bytes.fromhex("80d1a584dffd24de"),
    "get_transformation_request_t": bytes.fromhex("d407ba8092d6daa1"),
    "get_transformations_reply_t": bytes.fromhex("5c17dce904d61a93"),
    "get_transformations_request_t": bytes.fromhex("d71f006e179d5a75"),
    "gps_t": bytes.fromhex("661a4b5c1827f64c"),
    "health_t": bytes.fromhex("6e281f3e3adf44dd"),
    "imu_t": bytes.fromhex("a488946aa26727f7"),
    "joints_t": bytes.fromhex("2f8bc69e04097f3d"),
    "localization_health_t": bytes.fromhex("a5ed7486dbf96129"),
    "localization_mode_t": bytes.fromhex("5862804cd0a8b608"),
    "measurement_t": bytes.fromhex("a98787409a8c023c"),
    "model_snapshot_t": bytes.fromhex("0ed3b5078061bb8f"),
    "name_list_reply_t": bytes.fromhex("c14f1581c7c4db7b"),
    "navigation_state_t": bytes.fromhex("d8c235934651b218"),
    "path_edge_t": bytes.fromhex("3b32c8e843fbfdb3"),
    "pose_demand_t": bytes.fromhex("cd355948604c6f2a"),
    "pose_transform_t": bytes.fromhex("bc2058190e65ce1c"),
    "pose_vector_t": bytes.fromhex("227eb5f4b95e58cc"),
    "range_t": bytes.fromhex("39acec7e5e030304"),
    "rejected_count_t": bytes.fromhex("cc9becbf2c78c790"),
    "relative_pose_t": bytes.fromhex("d75db953643bc60a"),
    "reload_model_reply_t": bytes.fromhex("5e9feb331c508f32"),
    "reload_model_request_t": bytes.fromhex("5c5ab9383ef5362c"),
    "reply_header_t": bytes.fromhex("25053b2b5b842c4d"),
    "request_header_t": bytes.fromhex("fb1745122e48c9d4"),
    "sensor_header_t": bytes.fromhex("c35bf2781d281ef1"),
    "set_h_transform_request_t": bytes.fromhex("308f17d404f01ca7"),
    "set_state_vector_request_t": bytes.fromhex("fd4bd38b5ae13207"),
    "signed_t": bytes.fromhex("9e853d013a985096"),
    "stability_health_t": bytes.fromhex("52cc5abffcacc888"),
    "time_query_t": bytes.fromhex("e0e3ae7a2bde3465"),
    "vehicle_command_t": bytes.fromhex("c0060a5442733d61"),
    "vehicle_status_t": bytes.fromhex("68dabe3bdb8f1c77"),
    "wheels_t": bytes.fromhex("ebe9d01835d4ee64"),
}
"""Of the wire types, as lcm-gen computes them."""

_S0 = struct.Struct(">qdqqq")
_S1 = struct.Struct(">3d4d36d")
_S2 = struct.Struct(">qdddbqq")
_S3 = struct.Struct(">q")
_S4 = struct.Struct(">b")
_S5 = struct.Struct(">i")
_S6 = struct.Struct(">dd")
_S7 = struct.Struct(">qi")
_S8 = struct.Struct(">iqqdddddqi")
_S9 = struct.Struct(">d3d36di")
_S10 = struct.Struct(">9d")
_S11 = struct.Struct(">d3d36d")
_S12 = struct.Struct(">bbqbi")
_S13 = struct.Struct(">qbi")
_S14 = struct.Struct(">bqbidddd")
_S15 = struct.Struct(">qqd")
_S16 = struct.Struct(">3d3d3d3d36d36d")
_S17 = struct.Struct(">3d3d3d3d36d")
_S18 = struct.Struct(">36d")
_S19 = struct.Struct(">qbidddd")
_S20 = struct.Struct(">qb")
_S21 = struct.Struct(">bhdddddddd9d3d9dddddddd")
_S22 = struct.Struct(">qd")
_S23 = struct.Struct(">biiqqqiqqdddd")
_S24 = struct.Struct(">iiqdbbbddddddddddddddddddddi")
_S25 = struct.Struct(">3d9d3d9d3dbb4d9dd")
_S26 = struct.Struct(">bbbddddddddddddddd")
_S27 = struct.Struct(">iii")
_S28 = struct.Struct(">qbbbiiddd3d4d3d3d36di")
_S29 = struct.Struct(">qbbbiiddd3d4d3d3d36d")
_S30 = struct.Struct(">b7dbqd")
_S31 = struct.Struct(">dddd")
_S32 = struct.Struct(">3d")
_S33 = struct.Struct(">qq")
_S34 = struct.Struct(">32s")
_S35 = struct.Struct(">dddddi")
_S36 = struct.Struct(">qdq")
_S37 = struct.Struct(">bddddiq")


NO_GET_DYNAMICS_REPLY = (
    bytes(8) + bytes(4) + pack_text("") + bytes(8) + bytes(24) + bytes(288) + bytes(4) + bytes(4) + bytes(72)
)
NO_GET_EXPLANATION_REPLY = NO_POSE_TRANSFORM + bytes(4)
NO_GET_MOTION_REPLY = (
    NO_POSE_TRANSFORM + pack_text("") + bytes(24) + bytes(24) + bytes(24) + bytes(24) + bytes(288) + bytes(288)
)
KIND_WORDS = ("frame", "constraint", "joint", "vehicle")
PROVENANCE_WORDS = ("fixed", "measured", "interpolated", "held", "predicted", "default")


def pack_absolute_pose(value: AbsolutePoseSample) -> bytes:
    """Return the bytes of a absolute_pose_t without the fingerprint."""
    return b"%b%b%b%b%b" % (
        _S0.pack(
            value.header.utime,
            value.header.utime_sigma,
            value.header.host_utime,
            value.header.device_utime,
            value.header.seq,
        ),
        pack_text(value.header.source),
        pack_text(value.frame_of_interest),
        pack_text(value.frame_of_reference),
        _S1.pack(*(value.position or NAN3), *(value.orientation or NAN4), *(value.covariance or NAN36)),
    )


def unpack_absolute_pose(data: bytes, at: int) -> tuple[AbsolutePoseSample, int]:
    """Return the absolute_pose_t that begins at `at`, and its end. Raises WireError, struct.error."""
    header_utime, header_utime_sigma, header_host_utime, header_device_utime, header_seq = _S0.unpack_from(data, at)
    header_source, at = read_text(data, at + 40)
    frame_of_interest, at = read_text(data, at)
    frame_of_reference, at = read_text(data, at)
    position_0, position_1, position_2, orientation_0, orientation_1, orientation_2, orientation_3, *covariance = (
        _S1.unpack_from(data, at)
    )
    return AbsolutePoseSample(
        SensorHeader(
            check_sample_utime(header_utime, "utime"),
            check_name(header_source, "source"),
            header_seq,
            check_utime(header_host_utime, "host_utime"),
            header_device_utime,
            header_utime_sigma,
        ),
        check_name(frame_of_interest, "frame_of_interest", MAX_FRAME_NAME),
        check_name(frame_of_reference, "frame_of_reference", MAX_FRAME_NAME),
        None
        if (position := read_vector3((position_0, position_1, position_2))) is None
        else check_position(position, "position"),
        None
        if (orientation := read_quaternion((orientation_0, orientation_1, orientation_2, orientation_3))) is None
        else check_unit_quaternion(orientation, "orientation"),
        None if covariance[0] != covariance[0] else check_finite(tuple(covariance), "covariance"),
    ), at + 344


def pack_acknowledgement(value: Acknowledgement) -> bytes:
    """Return the bytes of a acknowledgement_t without the fingerprint."""
    return pack_reply_header(value.header)


def unpack_acknowledgement(data: bytes, at: int) -> tuple[Acknowledgement, int]:
    """Return the acknowledgement_t that begins at `at`, and its end. Raises WireError, struct.error."""
    header, at = unpack_reply_header(data, at)
    return Acknowledgement(header), at


def pack_channel_health(value: ChannelHealth) -> bytes:
    """Return the bytes of a channel_health_t without the fingerprint."""
    return b"%b%b" % (
        pack_text(value.channel),
        _S2.pack(value.count, value.rate_hz, value.age, value.delay_max, value.silent, value.measured, value.used),
    )


def unpack_channel_health(data: bytes, at: int) -> tuple[ChannelHealth, int]:
    """Return the channel_health_t that begins at `at`, and its end. Raises WireError, struct.error."""
    channel, at = read_text(data, at)
    count, rate_hz, age, delay_max, silent, measured, used = _S2.unpack_from(data, at)
    return ChannelHealth(channel, count, rate_hz, age, delay_max, bool(silent), measured, used), at + 49


def pack_decision(value: Decision) -> bytes:
    """Return the bytes of a decision_t without the fingerprint."""
    return b"%b%b%b%b%b%b%b%b%b%b%b" % (
        _S3.pack(value.utime),
        pack_text(value.source),
        _S3.pack(value.seq),
        pack_text(value.kind),
        _S4.pack(value.verdict),
        pack_text(value.reason),
        _S5.pack(len(value.residual)),
        pack_numbers("d", value.residual),
        pack_matrix(value.innovation_covariance, len(value.residual)),
        pack_matrix(value.noise, len(value.residual)),
        _S6.pack(value.statistic, value.limit),
    )


def unpack_decision(data: bytes, at: int) -> tuple[Decision, int]:
    """Return the decision_t that begins at `at`, and its end. Raises WireError, struct.error."""
    (utime,) = _S3.unpack_from(data, at)
    source, at = read_text(data, at + 8)
    (seq,) = _S3.unpack_from(data, at)
    kind, at = read_text(data, at + 8)
    (verdict,) = _S4.unpack_from(data, at)
    reason, at = read_text(data, at + 1)
    (num,) = _S5.unpack_from(data, at)
    check_count(num, "num", MAX_STATES)
    residual, at = read_numbers("d", data, at + 4, num)
    innovation_covariance, at = read_numbers("d", data, at, num * num)
    noise, at = read_numbers("d", data, at, num * num)
    statistic, limit = _S6.unpack_from(data, at)
    return Decision(
        check_utime(utime, "utime"),
        check_name(source, "source"),
        seq,
        check_name(kind, "kind"),
        read_enum(Verdict, verdict, "verdict"),
        check_name(reason, "reason"),
        residual,
        () if innovation_covariance and innovation_covariance[0] != innovation_covariance[0] else innovation_covariance,
        () if noise and noise[0] != noise[0] else noise,
        statistic,
        limit,
    ), at + 16


def pack_decisions(value: PublishDecisions) -> bytes:
    """Return the bytes of a decisions_t without the fingerprint."""
    check_outgoing(len(value.decisions), MAX_DECISIONS, "count")
    return b"".join((_S7.pack(value.utime, len(value.decisions)), *map(pack_decision, value.decisions)))


def unpack_decisions(data: bytes, at: int) -> tuple[PublishDecisions, int]:
    """Return the decisions_t that begins at `at`, and its end. Raises WireError, struct.error."""
    utime, count = _S7.unpack_from(data, at)
    check_count(count, "count", MAX_DECISIONS)
    decisions, at = read_each(unpack_decision, data, at + 12, count)
    return PublishDecisions(check_utime(utime, "utime"), decisions), at


def pack_driver_health(value: DriverHealth) -> bytes:
    """Return the bytes of a driver_health_t without the fingerprint."""
    check_outgoing(len(value.counters), 256, "num_counters")
    return b"".join(
        (
            _S3.pack(value.utime),
            pack_text(value.source),
            pack_text(value.device),
            _S4.pack(value.phase),
            pack_text(value.text),
            pack_text(value.link),
            _S8.pack(
                value.baud,
                value.reconnects,
                value.samples,
                value.rate_hz,
                value.age,
                value.clock_offset,
                value.clock_drift,
                value.clock_sigma,
                value.clock_restarts,
                len(value.counters),
            ),
            *map(pack_text, [each[0] for each in value.counters]),
            pack_numbers("q", [each[1] for each in value.counters]),
        )
    )


def unpack_driver_health(data: bytes, at: int) -> tuple[DriverHealth, int]:
    """Return the driver_health_t that begins at `at`, and its end. Raises WireError, struct.error."""
    (utime,) = _S3.unpack_from(data, at)
    source, at = read_text(data, at + 8)
    device, at = read_text(data, at)
    (phase,) = _S4.unpack_from(data, at)
    text, at = read_text(data, at + 1)
    link, at = read_text(data, at)
    baud, reconnects, samples, rate_hz, age, clock_offset, clock_drift, clock_sigma, clock_restarts, num_counters = (
        _S8.unpack_from(data, at)
    )
    check_count(num_counters, "num_counters", 256)
    counter_names, at = read_each(read_text, data, at + 72, num_counters)
    counter_values, at = read_numbers("q", data, at, num_counters)
    return DriverHealth(
        check_utime(utime, "utime"),
        check_name(source, "source"),
        check_name(device, "device"),
        read_enum(DriverPhase, phase, "phase"),
        text,
        link,
        baud,
        reconnects,
        samples,
        rate_hz,
        age,
        clock_offset,
        clock_drift,
        clock_sigma,
        clock_restarts,
        tuple(zip(counter_names, counter_values, strict=True)),
    ), at


def pack_get_body_frame_list_request(value: GetBodyFrameList) -> bytes:
    """Return the bytes of a get_body_frame_list_request_t without the fingerprint."""
    return b"%b%b%b" % (_S3.pack(value.header.request_id), pack_text(value.header.reply_channel), pack_text(value.body))


def unpack_get_body_frame_list_request(data: bytes, at: int) -> tuple[GetBodyFrameList, int]:
    """Return the get_body_frame_list_request_t that begins at `at`, and its end. Raises WireError, struct.error."""
    (header_request_id,) = _S3.unpack_from(data, at)
    header_reply_channel, at = read_text(data, at + 8)
    body, at = read_text(data, at)
    return GetBodyFrameList(RequestHeader(header_request_id, header_reply_channel), body), at


def pack_get_body_list_request(value: GetBodyList) -> bytes:
    """Return the bytes of a get_body_list_request_t without the fingerprint."""
    return b"%b%b" % (_S3.pack(value.header.request_id), pack_text(value.header.reply_channel))


def unpack_get_body_list_request(data: bytes, at: int) -> tuple[GetBodyList, int]:
    """Return the get_body_list_request_t that begins at `at`, and its end. Raises WireError, struct.error."""
    (header_request_id,) = _S3.unpack_from(data, at)
    header_reply_channel, at = read_text(data, at + 8)
    return GetBodyList(RequestHeader(header_request_id, header_reply_channel)), at


def pack_get_dynamics_reply(value: DynamicsReply) -> bytes:
    """Return the bytes of a get_dynamics_reply_t without the fingerprint."""
    if value.answer is None:
        return pack_reply_header(value.header) + NO_GET_DYNAMICS_REPLY
    return b"".join(
        (
            pack_reply_header(value.header),
            _S7.pack(value.answer.utime, value.answer.invalid_reasons),
            pack_text(value.answer.frame),
            _S9.pack(value.answer.mass, *value.answer.center, *value.answer.inertia, len(value.answer.coordinates)),
            *map(pack_text, value.answer.coordinates),
            pack_numbers("d", value.answer.position, len(value.answer.coordinates)),
            pack_numbers("d", value.answer.rate, len(value.answer.coordinates)),
            pack_numbers("d", value.answer.gravity, len(value.answer.coordinates)),
            pack_numbers("d", value.answer.bias, len(value.answer.coordinates)),
            _S5.pack(len(value.answer.coordinates) * (len(value.answer.coordinates) + 1) // 2),
            pack_triangle(value.answer.mass_matrix, len(value.answer.coordinates)),
            _S10.pack(*(value.answer.center_covariance or NAN9)),
        )
    )


def unpack_get_dynamics_reply(data: bytes, at: int) -> tuple[DynamicsReply, int]:
    """Return the get_dynamics_reply_t that begins at `at`, and its end. Raises WireError, struct.error."""
    header, at = unpack_reply_header(data, at)
    if header.status is not Status.OK:
        return DynamicsReply(header), skip_nothing(data, at, NO_GET_DYNAMICS_REPLY)
    utime, invalid_reasons = _S7.unpack_from(data, at)
    frame, at = read_text(data, at + 12)
    mass, center_0, center_1, center_2, *inertia = _S11.unpack_from(data, at)
    (n,) = _S5.unpack_from(data, at + 320)
    check_count(n, "n", MAX_COORDINATES)
    coordinates, at = read_each(read_text, data, at + 324, n)
    position, at = read_numbers("d", data, at, n)
    rate, at = read_numbers("d", data, at, n)
    gravity, at = read_numbers("d", data, at, n)
    bias, at = read_numbers("d", data, at, n)
    (num_mass_matrix,) = _S5.unpack_from(data, at)
    check_count(num_mass_matrix, "num_mass_matrix", n * (n + 1) // 2, n * (n + 1) // 2)
    mass_matrix, at = read_numbers("d", data, at + 4, num_mass_matrix)
    (
        center_covariance_0,
        center_covariance_1,
        center_covariance_2,
        center_covariance_3,
        center_covariance_4,
        center_covariance_5,
        center_covariance_6,
        center_covariance_7,
        center_covariance_8,
    ) = _S10.unpack_from(data, at)
    return DynamicsReply(
        header,
        DynamicsAnswer(
            check_utime(utime, "utime"),
            Invalid(invalid_reasons),
            frame,
            mass,
            (center_0, center_1, center_2),
            tuple(inertia),
            tuple([check_name(each, "coordinates", MAX_FRAME_NAME) for each in coordinates]),
            position,
            rate,
            gravity,
            bias,
            read_triangle(mass_matrix, n),
            read_matrix3(
                (
                    center_covariance_0,
                    center_covariance_1,
                    center_covariance_2,
                    center_covariance_3,
                    center_covariance_4,
                    center_covariance_5,
                    center_covariance_6,
                    center_covariance_7,
                    center_covariance_8,
                )
            ),
        ),
    ), at + 72


def pack_get_dynamics_request(value: GetDynamics) -> bytes:
    """Return the bytes of a get_dynamics_request_t without the fingerprint."""
    return b"%b%b%b%b" % (
        _S3.pack(value.header.request_id),
        pack_text(value.header.reply_channel),
        pack_text(value.frame),
        _S12.pack(value.with_equations, value.is_floating, value.time.at, value.time.policy, value.time.wait_ms),
    )


def unpack_get_dynamics_request(data: bytes, at: int) -> tuple[GetDynamics, int]:
    """Return the get_dynamics_request_t that begins at `at`, and its end. Raises WireError, struct.error."""
    (header_request_id,) = _S3.unpack_from(data, at)
    header_reply_channel, at = read_text(data, at + 8)
    frame, at = read_text(data, at)
    with_equations, is_floating, time_at_, time_policy, time_wait_ms = _S12.unpack_from(data, at)
    return GetDynamics(
        RequestHeader(header_request_id, header_reply_channel),
        check_name(frame, "frame", MAX_FRAME_NAME),
        bool(with_equations),
        bool(is_floating),
        TimeQuery(
            check_utime(time_at_, "at"),
            read_enum(Policy, time_policy, "policy"),
            check_not_negative(time_wait_ms, "wait_ms"),
        ),
    ), at + 15


def pack_get_explanation_reply(value: ExplanationReply) -> bytes:
    """Return the bytes of a get_explanation_reply_t without the fingerprint."""
    if value.answer is None:
        return pack_reply_header(value.header) + NO_GET_EXPLANATION_REPLY
    return b"".join(
        (
            pack_reply_header(value.header),
            pack_pose_transform(value.answer.answer),
            _S5.pack(len(value.answer.edges)),
            *map(pack_path_edge, value.answer.edges),
        )
    )


def unpack_get_explanation_reply(data: bytes, at: int) -> tuple[ExplanationReply, int]:
    """Return the get_explanation_reply_t that begins at `at`, and its end. Raises WireError, struct.error."""
    header, at = unpack_reply_header(data, at)
    if header.status is not Status.OK:
        return ExplanationReply(header), skip_nothing(data, at, NO_GET_EXPLANATION_REPLY)
    transform, at = unpack_pose_transform(data, at)
    (num_edges,) = _S5.unpack_from(data, at)
    check_count(num_edges, "num_edges")
    edges, at = read_each(unpack_path_edge, data, at + 4, num_edges)
    return ExplanationReply(header, Explanation(transform, edges)), at


def pack_get_explanation_request(value: GetExplanation) -> bytes:
    """Return the bytes of a get_explanation_request_t without the fingerprint."""
    return b"%b%b%b%b%b" % (
        _S3.pack(value.header.request_id),
        pack_text(value.header.reply_channel),
        _S13.pack(value.time.at, value.time.policy, value.time.wait_ms),
        pack_text(value.frame_of_interest),
        pack_text(value.frame_of_reference),
    )


def unpack_get_explanation_request(data: bytes, at: int) -> tuple[GetExplanation, int]:
    """Return the get_explanation_request_t that begins at `at`, and its end. Raises WireError, struct.error."""
    (header_request_id,) = _S3.unpack_from(data, at)
    header_reply_channel, at = read_text(data, at + 8)
    time_at_, time_policy, time_wait_ms = _S13.unpack_from(data, at)
    frame_of_interest, at = read_text(data, at + 13)
    frame_of_reference, at = read_text(data, at)
    return GetExplanation(
        RequestHeader(header_request_id, header_reply_channel),
        check_name(frame_of_interest, "frame_of_interest", MAX_FRAME_NAME),
        check_name(frame_of_reference, "frame_of_reference", MAX_FRAME_NAME),
        TimeQuery(
            check_utime(time_at_, "at"),
            read_enum(Policy, time_policy, "policy"),
            check_not_negative(time_wait_ms, "wait_ms"),
        ),
    ), at


def pack_get_h_transform_request(value: GetHTransform) -> bytes:
    """Return the bytes of a get_h_transform_request_t without the fingerprint."""
    return b"%b%b%b" % (
        _S3.pack(value.header.request_id),
        pack_text(value.header.reply_channel),
        _S14.pack(
            value.inverse,
            value.time.at,
            value.time.policy,
            value.time.wait_ms,
            value.demand.max_horizontal,
            value.demand.max_heading,
            value.demand.max_age,
            value.demand.min_integrity,
        ),
    )


def unpack_get_h_transform_request(data: bytes, at: int) -> tuple[GetHTransform, int]:
    """Return the get_h_transform_request_t that begins at `at`, and its end. Raises WireError, struct.error."""
    (header_request_id,) = _S3.unpack_from(data, at)
    header_reply_channel, at = read_text(data, at + 8)
    (
        inverse,
        time_at_,
        time_policy,
        time_wait_ms,
        demand_max_horizontal,
        demand_max_heading,
        demand_max_age,
        demand_min_integrity,
    ) = _S14.unpack_from(data, at)
    return GetHTransform(
        RequestHeader(header_request_id, header_reply_channel),
        bool(inverse),
        TimeQuery(
            check_utime(time_at_, "at"),
            read_enum(Policy, time_policy, "policy"),
            check_not_negative(time_wait_ms, "wait_ms"),
        ),
        PoseDemand(
            check_demand(demand_max_horizontal, "max_horizontal", MAX_DISTANCE),
            check_demand(demand_max_heading, "max_heading", MAX_ANGLE),
            check_demand(demand_max_age, "max_age"),
            check_demand(demand_min_integrity, "min_integrity", 1.0),
        ),
    ), at + 46


def pack_get_history_reply(value: HistoryReply) -> bytes:
    """Return the bytes of a get_history_reply_t without the fingerprint."""
    return b"".join(
        (pack_reply_header(value.header), _S5.pack(len(value.answers)), *map(pack_pose_vector, value.answers))
    )


def unpack_get_history_reply(data: bytes, at: int) -> tuple[HistoryReply, int]:
    """Return the get_history_reply_t that begins at `at`, and its end. Raises WireError, struct.error."""
    header, at = unpack_reply_header(data, at)
    (num_poses,) = _S5.unpack_from(data, at)
    check_count(num_poses, "num_poses")
    poses, at = read_each(unpack_pose_vector, data, at + 4, num_poses)
    return HistoryReply(header, poses), at


def pack_get_history_request(value: GetHistory) -> bytes:
    """Return the bytes of a get_history_request_t without the fingerprint."""
    return b"%b%b%b" % (
        _S3.pack(value.header.request_id),
        pack_text(value.header.reply_channel),
        _S15.pack(value.start_utime, value.end_utime, value.rate_hz),
    )


def unpack_get_history_request(data: bytes, at: int) -> tuple[GetHistory, int]:
    """Return the get_history_request_t that begins at `at`, and its end. Raises WireError, struct.error."""
    (header_request_id,) = _S3.unpack_from(data, at)
    header_reply_channel, at = read_text(data, at + 8)
    start_utime, end_utime, rate_hz = _S15.unpack_from(data, at)
    return GetHistory(
        RequestHeader(header_request_id, header_reply_channel),
        check_utime(start_utime, "start_utime"),
        check_utime(end_utime, "end_utime"),
        rate_hz,
    ), at + 24


def pack_get_motion_reply(value: MotionReply) -> bytes:
    """Return the bytes of a get_motion_reply_t without the fingerprint."""
    if value.answer is None:
        return pack_reply_header(value.header) + NO_GET_MOTION_REPLY
    return b"%b%b%b%b" % (
        pack_reply_header(value.header),
        pack_pose_transform(value.answer.pose),
        pack_text(value.answer.expressed_in),
        _S16.pack(
            *value.answer.velocity,
            *value.answer.angular_velocity,
            *value.answer.acceleration,
            *value.answer.angular_acceleration,
            *(value.answer.covariance or NAN36),
            *(value.answer.acceleration_covariance or NAN36),
        ),
    )


def unpack_get_motion_reply(data: bytes, at: int) -> tuple[MotionReply, int]:
    """Return the get_motion_reply_t that begins at `at`, and its end. Raises WireError, struct.error."""
    header, at = unpack_reply_header(data, at)
    if header.status is not Status.OK:
        return MotionReply(header), skip_nothing(data, at, NO_GET_MOTION_REPLY)
    transform, at = unpack_pose_transform(data, at)
    expressed_in, at = read_text(data, at)
    (
        velocity_0,
        velocity_1,
        velocity_2,
        angular_velocity_0,
        angular_velocity_1,
        angular_velocity_2,
        acceleration_0,
        acceleration_1,
        acceleration_2,
        angular_acceleration_0,
        angular_acceleration_1,
        angular_acceleration_2,
        *covariance,
    ) = _S17.unpack_from(data, at)
    (*acceleration_covariance,) = _S18.unpack_from(data, at + 384)
    return MotionReply(
        header,
        MotionAnswer(
            transform,
            expressed_in,
            (velocity_0, velocity_1, velocity_2),
            (angular_velocity_0, angular_velocity_1, angular_velocity_2),
            (acceleration_0, acceleration_1, acceleration_2),
            (angular_acceleration_0, angular_acceleration_1, angular_acceleration_2),
            None if covariance[0] != covariance[0] else tuple(covariance),
            None if acceleration_covariance[0] != acceleration_covariance[0] else tuple(acceleration_covariance),
        ),
    ), at + 672


def pack_get_motion_request(value: GetMotion) -> bytes:
    """Return the bytes of a get_motion_request_t without the fingerprint."""
    return b"%b%b%b%b%b%b" % (
        _S3.pack(value.header.request_id),
        pack_text(value.header.reply_channel),
        pack_text(value.frame_of_interest),
        pack_text(value.frame_of_reference),
        pack_text(value.expressed_in),
        _S13.pack(value.time.at, value.time.policy, value.time.wait_ms),
    )


def unpack_get_motion_request(data: bytes, at: int) -> tuple[GetMotion, int]:
    """Return the get_motion_request_t that begins at `at`, and its end. Raises WireError, struct.error."""
    (header_request_id,) = _S3.unpack_from(data, at)
    header_reply_channel, at = read_text(data, at + 8)
    frame_of_interest, at = read_text(data, at)
    frame_of_reference, at = read_text(data, at)
    expressed_in, at = read_text(data, at)
    time_at_, time_policy, time_wait_ms = _S13.unpack_from(data, at)
    return GetMotion(
        RequestHeader(header_request_id, header_reply_channel),
        check_name(frame_of_interest, "frame_of_interest", MAX_FRAME_NAME),
        check_name(frame_of_reference, "frame_of_reference", MAX_FRAME_NAME),
        check_name(expressed_in, "expressed_in", MAX_FRAME_NAME),
        TimeQuery(
            check_utime(time_at_, "at"),
            read_enum(Policy, time_policy, "policy"),
            check_not_negative(time_wait_ms, "wait_ms"),
        ),
    ), at + 13


def pack_get_state_vector_reply(value: StateVectorReply) -> bytes:
    """Return the bytes of a get_state_vector_reply_t without the fingerprint."""
    return b"%b%b%b%b" % (
        pack_reply_header(value.header),
        NO_POSE_VECTOR if value.answer is None else pack_pose_vector(value.answer),
        _S5.pack(value.unmet),
        pack_text(value.unmet_reason),
    )


def unpack_get_state_vector_reply(data: bytes, at: int) -> tuple[StateVectorReply, int]:
    """Return the get_state_vector_reply_t that begins at `at`, and its end. Raises WireError, struct.error."""
    header, at = unpack_reply_header(data, at)
    if header.status is Status.OK:
        pose, at = unpack_pose_vector(data, at)
    else:
        pose, at = None, skip_pose_vector(data, at)
    (unmet,) = _S5.unpack_from(data, at)
    unmet_reason, at = read_text(data, at + 4)
    return StateVectorReply(header, pose, Unmet(unmet), unmet_reason), at


def pack_get_state_vector_request(value: GetStateVector) -> bytes:
    """Return the bytes of a get_state_vector_request_t without the fingerprint."""
    return b"%b%b%b" % (
        _S3.pack(value.header.request_id),
        pack_text(value.header.reply_channel),
        _S19.pack(
            value.time.at,
            value.time.policy,
            value.time.wait_ms,
            value.demand.max_horizontal,
            value.demand.max_heading,
            value.demand.max_age,
            value.demand.min_integrity,
        ),
    )


def unpack_get_state_vector_request(data: bytes, at: int) -> tuple[GetStateVector, int]:
    """Return the get_state_vector_request_t that begins at `at`, and its end. Raises WireError, struct.error."""
    (header_request_id,) = _S3.unpack_from(data, at)
    header_reply_channel, at = read_text(data, at + 8)
    (
        time_at_,
        time_policy,
        time_wait_ms,
        demand_max_horizontal,
        demand_max_heading,
        demand_max_age,
        demand_min_integrity,
    ) = _S19.unpack_from(data, at)
    return GetStateVector(
        RequestHeader(header_request_id, header_reply_channel),
        TimeQuery(
            check_utime(time_at_, "at"),
            read_enum(Policy, time_policy, "policy"),
            check_not_negative(time_wait_ms, "wait_ms"),
        ),
        PoseDemand(
            check_demand(demand_max_horizontal, "max_horizontal", MAX_DISTANCE),
            check_demand(demand_max_heading, "max_heading", MAX_ANGLE),
            check_demand(demand_max_age, "max_age"),
            check_demand(demand_min_integrity, "min_integrity", 1.0),
        ),
    ), at + 45


def pack_get_transformation_reply(value: TransformReply) -> bytes:
    """Return the bytes of a get_transformation_reply_t without the fingerprint."""
    return b"%b%b%b%b" % (
        pack_reply_header(value.header),
        NO_POSE_TRANSFORM if value.answer is None else pack_pose_transform(value.answer),
        _S5.pack(value.unmet),
        pack_text(value.unmet_reason),
    )


def unpack_get_transformation_reply(data: bytes, at: int) -> tuple[TransformReply, int]:
    """Return the get_transformation_reply_t that begins at `at`, and its end. Raises WireError, struct.error."""
    header, at = unpack_reply_header(data, at)
    if header.status is Status.OK:
        transform, at = unpack_pose_transform(data, at)
    else:
        transform, at = None, skip_pose_transform(data, at)
    (unmet,) = _S5.unpack_from(data, at)
    unmet_reason, at = read_text(data, at + 4)
    return TransformReply(header, transform, Unmet(unmet), unmet_reason), at


def pack_get_transformation_request(value: GetTransformation) -> bytes:
    """Return the bytes of a get_transformation_request_t without the fingerprint."""
    return b"%b%b%b%b%b" % (
        _S3.pack(value.header.request_id),
        pack_text(value.header.reply_channel),
        pack_text(value.frame_of_interest),
        pack_text(value.frame_of_reference),
        _S19.pack(
            value.time.at,
            value.time.policy,
            value.time.wait_ms,
            value.demand.max_horizontal,
            value.demand.max_heading,
            value.demand.max_age,
            value.demand.min_integrity,
        ),
    )


def unpack_get_transformation_request(data: bytes, at: int) -> tuple[GetTransformation, int]:
    """Return the get_transformation_request_t that begins at `at`, and its end. Raises WireError, struct.error."""
    (header_request_id,) = _S3.unpack_from(data, at)
    header_reply_channel, at = read_text(data, at + 8)
    frame_of_interest, at = read_text(data, at)
    frame_of_reference, at = read_text(data, at)
    (
        time_at_,
        time_policy,
        time_wait_ms,
        demand_max_horizontal,
        demand_max_heading,
        demand_max_age,
        demand_min_integrity,
    ) = _S19.unpack_from(data, at)
    return GetTransformation(
        RequestHeader(header_request_id, header_reply_channel),
        frame_of_interest,
        frame_of_reference,
        TimeQuery(
            check_utime(time_at_, "at"),
            read_enum(Policy, time_policy, "policy"),
            check_not_negative(time_wait_ms, "wait_ms"),
        ),
        PoseDemand(
            check_demand(demand_max_horizontal, "max_horizontal", MAX_DISTANCE),
            check_demand(demand_max_heading, "max_heading", MAX_ANGLE),
            check_demand(demand_max_age, "max_age"),
            check_demand(demand_min_integrity, "min_integrity", 1.0),
        ),
    ), at + 45


def pack_get_transformations_request(value: GetTransformations) -> bytes:
    """Return the bytes of a get_transformations_request_t without the fingerprint."""
    return b"".join(
        (
            _S3.pack(value.header.request_id),
            pack_text(value.header.reply_channel),
            _S5.pack(len(value.pairs)),
            *map(pack_text, [each[0] for each in value.pairs]),
            *map(pack_text, [each[1] for each in value.pairs]),
            _S5.pack(len(value.at)),
            pack_numbers("q", value.at),
            pack_text(value.fixed_frame),
            _S20.pack(value.reference_at, value.with_covariance),
        )
    )


def unpack_get_transformations_request(data: bytes, at: int) -> tuple[GetTransformations, int]:
    """Return the get_transformations_request_t that begins at `at`, and its end. Raises WireError, struct.error."""
    (header_request_id,) = _S3.unpack_from(data, at)
    header_reply_channel, at = read_text(data, at + 8)
    (num_pairs,) = _S5.unpack_from(data, at)
    check_count(num_pairs, "num_pairs", MAX_PAIRS, 1)
    frames_of_interest, at = read_each(read_text, data, at + 4, num_pairs)
    frames_of_reference, at = read_each(read_text, data, at, num_pairs)
    (num_instants,) = _S5.unpack_from(data, at)
    check_count(num_instants, "num_instants", MAX_MESSAGE_INSTANTS)
    at_, at = read_numbers("q", data, at + 4, num_instants)
    fixed_frame, at = read_text(data, at)
    reference_at, with_covariance = _S20.unpack_from(data, at)
    return GetTransformations(
        RequestHeader(header_request_id, header_reply_channel),
        tuple(
            zip(
                tuple([check_name(each, "frames_of_interest", MAX_FRAME_NAME) for each in frames_of_interest]),
                tuple([check_name(each, "frames_of_reference", MAX_FRAME_NAME) for each in frames_of_reference]),
                strict=True,
            )
        ),
        check_instants(at_, "at"),
        check_name(fixed_frame, "fixed_frame", MAX_FRAME_NAME),
        check_utime(reference_at, "reference_at"),
        bool(with_covariance),
    ), at + 9


def pack_gps(value: GpsSample) -> bytes:
    """Return the bytes of a gps_t without the fingerprint."""
    return b"%b%b%b" % (
        _S0.pack(
            value.header.utime,
            value.header.utime_sigma,
            value.header.host_utime,
            value.header.device_utime,
            value.header.seq,
        ),
        pack_text(value.header.source),
        _S21.pack(
            value.fix_type,
            value.satellites,
            value.hdop,
            value.vdop,
            value.pdop,
            value.latitude_deg,
            value.longitude_deg,
            value.height_ellipsoidal,
            value.height_msl,
            value.undulation,
            *(value.position_covariance or NAN9),
            *(value.velocity or NAN3),
            *(value.velocity_covariance or NAN9),
            value.velocity_latency,
            value.speed,
            value.speed_sigma,
            value.course,
            value.course_sigma,
            value.baseline_yaw,
            value.baseline_yaw_sigma,
        ),
    )


def unpack_gps(data: bytes, at: int) -> tuple[GpsSample, int]:
    """Return the gps_t that begins at `at`, and its end. Raises WireError, struct.error."""
    header_utime, header_utime_sigma, header_host_utime, header_device_utime, header_seq = _S0.unpack_from(data, at)
    header_source, at = read_text(data, at + 40)
    (
        fix_type,
        satellites,
        hdop,
        vdop,
        pdop,
        latitude_deg,
        longitude_deg,
        height_ellipsoidal,
        height_msl,
        undulation,
        position_covariance_0,
        position_covariance_1,
        position_covariance_2,
        position_covariance_3,
        position_covariance_4,
        position_covariance_5,
        position_covariance_6,
        position_covariance_7,
        position_covariance_8,
        velocity_0,
        velocity_1,
        velocity_2,
        velocity_covariance_0,
        velocity_covariance_1,
        velocity_covariance_2,
        velocity_covariance_3,
        velocity_covariance_4,
        velocity_covariance_5,
        velocity_covariance_6,
        velocity_covariance_7,
        velocity_covariance_8,
        velocity_latency,
        speed,
        speed_sigma,
        course,
        course_sigma,
        baseline_yaw,
        baseline_yaw_sigma,
    ) = _S21.unpack_from(data, at)
    return GpsSample(
        SensorHeader(
            check_sample_utime(header_utime, "utime"),
            check_name(header_source, "source"),
            header_seq,
            check_utime(header_host_utime, "host_utime"),
            header_device_utime,
            header_utime_sigma,
        ),
        read_enum(FixType, fix_type, "fix_type"),
        latitude_deg,
        longitude_deg,
        height_ellipsoidal,
        height_msl,
        undulation,
        satellites,
        hdop,
        vdop,
        pdop,
        read_matrix3(
            (
                position_covariance_0,
                position_covariance_1,
                position_covariance_2,
                position_covariance_3,
                position_covariance_4,
                position_covariance_5,
                position_covariance_6,
                position_covariance_7,
                position_covariance_8,
            )
        ),
        read_vector3((velocity_0, velocity_1, velocity_2)),
        read_matrix3(
            (
                velocity_covariance_0,
                velocity_covariance_1,
                velocity_covariance_2,
                velocity_covariance_3,
                velocity_covariance_4,
                velocity_covariance_5,
                velocity_covariance_6,
                velocity_covariance_7,
                velocity_covariance_8,
            )
        ),
        velocity_latency,
        speed,
        speed_sigma,
        course,
        course_sigma,
        baseline_yaw,
        baseline_yaw_sigma,
    ), at + 291


def pack_health(value: Health) -> bytes:
    """Return the bytes of a health_t without the fingerprint."""
    return b"".join(
        (
            _S22.pack(value.utime, value.uptime),
            pack_text(value.version),
            pack_text(value.vehicle),
            pack_text(value.model_revision),
            _S23.pack(
                value.state,
                value.invalid_reasons,
                value.pose_epoch,
                value.origin_id,
                value.poses_published,
                value.requests_answered,
                value.requests_waiting,
                value.ticks_missed,
                value.handler_errors,
                value.tick_latency_p50,
                value.tick_latency_p90,
                value.tick_latency_p99,
                value.tick_latency_max,
            ),
            pack_text(value.invalid_text),
            pack_text(value.host),
            _S24.pack(
                value.pid,
                value.requests_queued,
                value.memory,
                value.cpu_share,
                -1 if value.localization.mode is None else value.localization.mode,
                -1 if value.localization.phase is None else value.localization.phase,
                value.localization.stationary,
                value.localization.horizontal_protection_level,
                value.localization.heading_protection_level,
                value.localization.seconds_to_limit,
                value.localization.fix_age,
                value.localization.latitude_deg,
                value.localization.longitude_deg,
                value.localization.height,
                value.localization.heading_deg,
                value.localization.sigma_horizontal,
                value.localization.sigma_up,
                value.localization.horizontal_level,
                value.localization.heading_level,
                value.localization.limit_risk,
                value.localization.horizontal_limit,
                value.localization.heading_limit,
                value.stability.margin,
                value.stability.margin_sigma,
                value.stability.dynamic_margin,
                value.stability.dynamic_margin_sigma,
                value.stability.limit,
                len(value.stability.contacts),
            ),
            *map(pack_text, value.stability.contacts),
            pack_numbers("d", value.stability.loads, len(value.stability.contacts)),
            _S5.pack(len(value.channels)),
            *map(pack_channel_health, value.channels),
            _S5.pack(len(value.rejected)),
            *map(pack_rejected_count, value.rejected),
            _S5.pack(len(value.warnings)),
            *map(pack_text, [each[0] for each in value.warnings]),
            *map(pack_text, [each[1] for each in value.warnings]),
        )
    )


def unpack_health(data: bytes, at: int) -> tuple[Health, int]:
    """Return the health_t that begins at `at`, and its end. Raises WireError, struct.error."""
    utime, uptime = _S22.unpack_from(data, at)
    version, at = read_text(data, at + 16)
    vehicle, at = read_text(data, at)
    model_revision, at = read_text(data, at)
    (
        state,
        invalid_reasons,
        pose_epoch,
        origin_id,
        poses_published,
        requests_answered,
        requests_waiting,
        ticks_missed,
        handler_errors,
        tick_latency_p50,
        tick_latency_p90,
        tick_latency_p99,
        tick_latency_max,
    ) = _S23.unpack_from(data, at)
    invalid_text, at = read_text(data, at + 85)
    host, at = read_text(data, at)
    (
        pid,
        requests_queued,
        memory,
        cpu_share,
        localization_mode,
        localization_phase,
        localization_stationary,
        localization_horizontal_protection_level,
        localization_heading_protection_level,
        localization_seconds_to_limit,
        localization_fix_age,
        localization_latitude_deg,
        localization_longitude_deg,
        localization_height,
        localization_heading_deg,
        localization_sigma_horizontal,
        localization_sigma_up,
        localization_horizontal_level,
        localization_heading_level,
        localization_limit_risk,
        localization_horizontal_limit,
        localization_heading_limit,
        stability_margin,
        stability_margin_sigma,
        stability_dynamic_margin,
        stability_dynamic_margin_sigma,
        stability_limit,
        stability_num_contacts,
    ) = _S24.unpack_from(data, at)
    check_count(stability_num_contacts, "num_contacts", MAX_CONTACTS)
    stability_contacts, at = read_each(read_text, data, at + 191, stability_num_contacts)
    stability_loads, at = read_numbers("d", data, at, stability_num_contacts)
    (num_channels,) = _S5.unpack_from(data, at)
    check_count(num_channels, "num_channels")
    channels, at = read_each(unpack_channel_health, data, at + 4, num_channels)
    (num_rejected,) = _S5.unpack_from(data, at)
    check_count(num_rejected, "num_rejected")
    rejected, at = read_each(unpack_rejected_count, data, at + 4, num_rejected)
    (num_warnings,) = _S5.unpack_from(data, at)
    check_count(num_warnings, "num_warnings")
    warning_subjects, at = read_each(read_text, data, at + 4, num_warnings)
    warning_texts, at = read_each(read_text, data, at, num_warnings)
    return Health(
        utime,
        uptime,
        version,
        vehicle,
        model_revision,
        state,
        Invalid(invalid_reasons),
        pose_epoch,
        origin_id,
        poses_published,
        requests_answered,
        requests_waiting,
        ticks_missed,
        handler_errors,
        tick_latency_p50,
        tick_latency_p90,
        tick_latency_p99,
        tick_latency_max,
        invalid_text,
        host,
        pid,
        requests_queued,
        memory,
        cpu_share,
        LocalizationHealth(
            None if localization_mode == -1 else read_enum(Mode, localization_mode, "mode"),
            None if localization_phase == -1 else read_enum(Phase, localization_phase, "phase"),
            bool(localization_stationary),
            localization_horizontal_protection_level,
            localization_heading_protection_level,
            localization_seconds_to_limit,
            localization_fix_age,
            localization_latitude_deg,
            localization_longitude_deg,
            localization_height,
            localization_heading_deg,
            localization_sigma_horizontal,
            localization_sigma_up,
            localization_horizontal_level,
            localization_heading_level,
            localization_limit_risk,
            localization_horizontal_limit,
            localization_heading_limit,
        ),
        StabilityHealth(
            stability_margin,
            stability_margin_sigma,
            stability_dynamic_margin,
            stability_dynamic_margin_sigma,
            stability_limit,
            tuple([check_name(each, "contacts", MAX_FRAME_NAME) for each in stability_contacts]),
            stability_loads,
        ),
        channels,
        rejected,
        tuple(zip(warning_subjects, warning_texts, strict=True)),
    ), at


def pack_imu(value: ImuSample) -> bytes:
    """Return the bytes of a imu_t without the fingerprint."""
    return b"%b%b%b" % (
        _S0.pack(
            value.header.utime,
            value.header.utime_sigma,
            value.header.host_utime,
            value.header.device_utime,
            value.header.seq,
        ),
        pack_text(value.header.source),
        _S25.pack(
            *(value.angular_velocity or NAN3),
            *(value.angular_velocity_covariance or NAN9),
            *(value.specific_force or NAN3),
            *(value.specific_force_covariance or NAN9),
            *(value.magnetic_field or NAN3),
            value.orientation_reference,
            value.yaw_source,
            *(value.orientation or NAN4),
            *(value.orientation_covariance or NAN9),
            value.temperature_celsius,
        ),
    )


def unpack_imu(data: bytes, at: int) -> tuple[ImuSample, int]:
    """Return the imu_t that begins at `at`, and its end. Raises WireError, struct.error."""
    header_utime, header_utime_sigma, header_host_utime, header_device_utime, header_seq = _S0.unpack_from(data, at)
    header_source, at = read_text(data, at + 40)
    (
        angular_velocity_0,
        angular_velocity_1,
        angular_velocity_2,
        angular_velocity_covariance_0,
        angular_velocity_covariance_1,
        angular_velocity_covariance_2,
        angular_velocity_covariance_3,
        angular_velocity_covariance_4,
        angular_velocity_covariance_5,
        angular_velocity_covariance_6,
        angular_velocity_covariance_7,
        angular_velocity_covariance_8,
        specific_force_0,
        specific_force_1,
        specific_force_2,
        specific_force_covariance_0,
        specific_force_covariance_1,
        specific_force_covariance_2,
        specific_force_covariance_3,
        specific_force_covariance_4,
        specific_force_covariance_5,
        specific_force_covariance_6,
        specific_force_covariance_7,
        specific_force_covariance_8,
        magnetic_field_0,
        magnetic_field_1,
        magnetic_field_2,
        orientation_reference,
        yaw_source,
        orientation_0,
        orientation_1,
        orientation_2,
        orientation_3,
        orientation_covariance_0,
        orientation_covariance_1,
        orientation_covariance_2,
        orientation_covariance_3,
        orientation_covariance_4,
        orientation_covariance_5,
        orientation_covariance_6,
        orientation_covariance_7,
        orientation_covariance_8,
        temperature_celsius,
    ) = _S25.unpack_from(data, at)
    return ImuSample(
        SensorHeader(
            check_sample_utime(header_utime, "utime"),
            check_name(header_source, "source"),
            header_seq,
            check_utime(header_host_utime, "host_utime"),
            header_device_utime,
            header_utime_sigma,
        ),
        read_partial_vector3((angular_velocity_0, angular_velocity_1, angular_velocity_2)),
        read_vector3((specific_force_0, specific_force_1, specific_force_2)),
        read_vector3((magnetic_field_0, magnetic_field_1, magnetic_field_2)),
        read_quaternion((orientation_0, orientation_1, orientation_2, orientation_3)),
        read_enum(OrientationReference, orientation_reference, "orientation_reference"),
        read_enum(YawSource, yaw_source, "yaw_source"),
        read_matrix3(
            (
                angular_velocity_covariance_0,
                angular_velocity_covariance_1,
                angular_velocity_covariance_2,
                angular_velocity_covariance_3,
                angular_velocity_covariance_4,
                angular_velocity_covariance_5,
                angular_velocity_covariance_6,
                angular_velocity_covariance_7,
                angular_velocity_covariance_8,
            )
        ),
        read_matrix3(
            (
                specific_force_covariance_0,
                specific_force_covariance_1,
                specific_force_covariance_2,
                specific_force_covariance_3,
                specific_force_covariance_4,
                specific_force_covariance_5,
                specific_force_covariance_6,
                specific_force_covariance_7,
                specific_force_covariance_8,
            )
        ),
        read_matrix3(
            (
                orientation_covariance_0,
                orientation_covariance_1,
                orientation_covariance_2,
                orientation_covariance_3,
                orientation_covariance_4,
                orientation_covariance_5,
                orientation_covariance_6,
                orientation_covariance_7,
                orientation_covariance_8,
            )
        ),
        temperature_celsius,
    ), at + 330


def pack_joints(value: JointsSample) -> bytes:
    """Return the bytes of a joints_t without the fingerprint."""
    return b"".join(
        (
            _S0.pack(
                value.header.utime,
                value.header.utime_sigma,
                value.header.host_utime,
                value.header.device_utime,
                value.header.seq,
            ),
            pack_text(value.header.source),
            _S5.pack(len(value.joints)),
            *map(pack_text, [each.name for each in value.joints]),
            pack_numbers("d", [each.position for each in value.joints]),
            pack_numbers("d", [each.position_sigma for each in value.joints]),
            pack_numbers("d", [each.rate for each in value.joints]),
            pack_numbers("d", [each.rate_sigma for each in value.joints]),
        )
    )


def unpack_joints(data: bytes, at: int) -> tuple[JointsSample, int]:
    """Return the joints_t that begins at `at`, and its end. Raises WireError, struct.error."""
    header_utime, header_utime_sigma, header_host_utime, header_device_utime, header_seq = _S0.unpack_from(data, at)
    header_source, at = read_text(data, at + 40)
    (num_joints,) = _S5.unpack_from(data, at)
    check_count(num_joints, "num_joints", 1024)
    names, at = read_each(read_text, data, at + 4, num_joints)
    position, at = read_numbers("d", data, at, num_joints)
    position_sigma, at = read_numbers("d", data, at, num_joints)
    rate, at = read_numbers("d", data, at, num_joints)
    rate_sigma, at = read_numbers("d", data, at, num_joints)
    return JointsSample(
        SensorHeader(
            check_sample_utime(header_utime, "utime"),
            check_name(header_source, "source"),
            header_seq,
            check_utime(header_host_utime, "host_utime"),
            header_device_utime,
            header_utime_sigma,
        ),
        tuple(map(JointSample, names, position, position_sigma, rate, rate_sigma)),
    ), at


def pack_localization_health(value: LocalizationHealth) -> bytes:
    """Return the bytes of a localization_health_t without the fingerprint."""
    return _S26.pack(
        -1 if value.mode is None else value.mode,
        -1 if value.phase is None else value.phase,
        value.stationary,
        value.horizontal_protection_level,
        value.heading_protection_level,
        value.seconds_to_limit,
        value.fix_age,
        value.latitude_deg,
        value.longitude_deg,
        value.height,
        value.heading_deg,
        value.sigma_horizontal,
        value.sigma_up,
        value.horizontal_level,
        value.heading_level,
        value.limit_risk,
        value.horizontal_limit,
        value.heading_limit,
    )


def unpack_localization_health(data: bytes, at: int) -> tuple[LocalizationHealth, int]:
    """Return the localization_health_t that begins at `at`, and its end. Raises WireError, struct.error."""
    (
        mode,
        phase,
        stationary,
        horizontal_protection_level,
        heading_protection_level,
        seconds_to_limit,
        fix_age,
        latitude_deg,
        longitude_deg,
        height,
        heading_deg,
        sigma_horizontal,
        sigma_up,
        horizontal_level,
        heading_level,
        limit_risk,
        horizontal_limit,
        heading_limit,
    ) = _S26.unpack_from(data, at)
    return LocalizationHealth(
        None if mode == -1 else read_enum(Mode, mode, "mode"),
        None if phase == -1 else read_enum(Phase, phase, "phase"),
        bool(stationary),
        horizontal_protection_level,
        heading_protection_level,
        seconds_to_limit,
        fix_age,
        latitude_deg,
        longitude_deg,
        height,
        heading_deg,
        sigma_horizontal,
        sigma_up,
        horizontal_level,
        heading_level,
        limit_risk,
        horizontal_limit,
        heading_limit,
    ), at + 123


def pack_localization_mode(value: SwitchMode) -> bytes:
    """Return the bytes of a localization_mode_t without the fingerprint."""
    return b"%b%b%b" % (
        _S0.pack(
            value.header.utime,
            value.header.utime_sigma,
            value.header.host_utime,
            value.header.device_utime,
            value.header.seq,
        ),
        pack_text(value.header.source),
        _S4.pack(value.mode),
    )


def unpack_localization_mode(data: bytes, at: int) -> tuple[SwitchMode, int]:
    """Return the localization_mode_t that begins at `at`, and its end. Raises WireError, struct.error."""
    header_utime, header_utime_sigma, header_host_utime, header_device_utime, header_seq = _S0.unpack_from(data, at)
    header_source, at = read_text(data, at + 40)
    (mode,) = _S4.unpack_from(data, at)
    return SwitchMode(
        SensorHeader(
            check_sample_utime(header_utime, "utime"),
            check_name(header_source, "source"),
            header_seq,
            check_utime(header_host_utime, "host_utime"),
            header_device_utime,
            header_utime_sigma,
        ),
        read_enum(Mode, mode, "mode"),
    ), at + 1


def pack_measurement(value: MeasurementSample) -> bytes:
    """Return the bytes of a measurement_t without the fingerprint."""
    return b"%b%b%b%b%b%b" % (
        _S0.pack(
            value.header.utime,
            value.header.utime_sigma,
            value.header.host_utime,
            value.header.device_utime,
            value.header.seq,
        ),
        pack_text(value.header.source),
        pack_text(value.frame),
        _S5.pack(len(value.values)),
        pack_numbers("d", value.values),
        pack_matrix(value.covariance, len(value.values)),
    )


def unpack_measurement(data: bytes, at: int) -> tuple[MeasurementSample, int]:
    """Return the measurement_t that begins at `at`, and its end. Raises WireError, struct.error."""
    header_utime, header_utime_sigma, header_host_utime, header_device_utime, header_seq = _S0.unpack_from(data, at)
    header_source, at = read_text(data, at + 40)
    frame, at = read_text(data, at)
    (num_values,) = _S5.unpack_from(data, at)
    check_count(num_values, "num_values", MAX_VALUES, 1)
    values, at = read_numbers("d", data, at + 4, num_values)
    covariance, at = read_numbers("d", data, at, num_values * num_values)
    return MeasurementSample(
        SensorHeader(
            check_sample_utime(header_utime, "utime"),
            check_name(header_source, "source"),
            header_seq,
            check_utime(header_host_utime, "host_utime"),
            header_device_utime,
            header_utime_sigma,
        ),
        values,
        check_name(frame, "frame", MAX_FRAME_NAME),
        () if covariance and covariance[0] != covariance[0] else covariance,
    ), at


def pack_model_snapshot(value: SnapshotPart) -> bytes:
    """Return the bytes of a model_snapshot_t without the fingerprint."""
    return b"%b%b%b%b" % (
        _S3.pack(value.utime),
        pack_text(value.model_revision),
        _S27.pack(value.part, value.parts, len(value.data)),
        value.data,
    )


def unpack_model_snapshot(data: bytes, at: int) -> tuple[SnapshotPart, int]:
    """Return the model_snapshot_t that begins at `at`, and its end. Raises WireError, struct.error."""
    (utime,) = _S3.unpack_from(data, at)
    model_revision, at = read_text(data, at + 8)
    part, num_parts, size = _S27.unpack_from(data, at)
    check_count(size, "size")
    data_, at = read_bytes(data, at + 12, size)
    return verify_model_snapshot(
        SnapshotPart(check_utime(utime, "utime"), check_name(model_revision, "model_revision"), part, num_parts, data_)
    ), at


def pack_name_list_reply(value: NameListReply) -> bytes:
    """Return the bytes of a name_list_reply_t without the fingerprint."""
    return b"".join(
        (
            pack_reply_header(value.header),
            _S5.pack(len(value.names)),
            *map(pack_text, value.names),
            *map(pack_text, value.descriptions),
        )
    )


def unpack_name_list_reply(data: bytes, at: int) -> tuple[NameListReply, int]:
    """Return the name_list_reply_t that begins at `at`, and its end. Raises WireError, struct.error."""
    header, at = unpack_reply_header(data, at)
    (num_names,) = _S5.unpack_from(data, at)
    check_count(num_names, "num_names")
    names, at = read_each(read_text, data, at + 4, num_names)
    descriptions, at = read_each(read_text, data, at, num_names)
    return NameListReply(header, names, descriptions), at


def pack_navigation_state(value: NavigationState) -> bytes:
    """Return the bytes of a navigation_state_t without the fingerprint."""
    check_outgoing(len(value.names), MAX_STATES, "n")
    return b"".join(
        (
            _S28.pack(
                value.utime,
                value.mode,
                value.phase,
                value.stationary,
                value.invalid,
                value.pose_epoch,
                value.latitude_deg,
                value.longitude_deg,
                value.height,
                *value.pose.xyz,
                *value.pose.wxyz,
                *value.linear_velocity,
                *value.angular_velocity,
                *(value.twist_covariance or NAN36),
                len(value.names),
            ),
            *map(pack_text, value.names),
            pack_numbers("d", value.values, len(value.names)),
            _S5.pack(len(value.names) * (len(value.names) + 1) // 2),
            pack_triangle(value.covariance, len(value.names)),
        )
    )


def unpack_navigation_state(data: bytes, at: int) -> tuple[NavigationState, int]:
    """Return the navigation_state_t that begins at `at`, and its end. Raises WireError, struct.error."""
    (
        utime,
        mode,
        phase,
        stationary,
        invalid_reasons,
        pose_epoch,
        latitude_deg,
        longitude_deg,
        height,
        position_0,
        position_1,
        position_2,
        orientation_0,
        orientation_1,
        orientation_2,
        orientation_3,
        linear_velocity_0,
        linear_velocity_1,
        linear_velocity_2,
        angular_velocity_0,
        angular_velocity_1,
        angular_velocity_2,
        *twist_covariance,
    ) = _S29.unpack_from(data, at)
    (n,) = _S5.unpack_from(data, at + 435)
    check_count(n, "n", MAX_STATES)
    names, at = read_each(read_text, data, at + 439, n)
    values, at = read_numbers("d", data, at, n)
    (num_covariance,) = _S5.unpack_from(data, at)
    check_count(num_covariance, "num_covariance", n * (n + 1) // 2, n * (n + 1) // 2)
    covariance, at = read_numbers("d", data, at + 4, num_covariance)
    return NavigationState(
        check_utime(utime, "utime"),
        read_enum(Mode, mode, "mode"),
        read_enum(Phase, phase, "phase"),
        bool(stationary),
        Invalid(invalid_reasons),
        pose_epoch,
        latitude_deg,
        longitude_deg,
        height,
        Pose(
            check_position((position_0, position_1, position_2), "position"),
            check_unit_quaternion((orientation_0, orientation_1, orientation_2, orientation_3), "orientation"),
        ),
        (linear_velocity_0, linear_velocity_1, linear_velocity_2),
        (angular_velocity_0, angular_velocity_1, angular_velocity_2),
        () if twist_covariance[0] != twist_covariance[0] else tuple(twist_covariance),
        tuple([check_name(each, "names") for each in names]),
        values,
        read_triangle(covariance, n),
    ), at


def pack_path_edge(value: EdgeReport) -> bytes:
    """Return the bytes of a path_edge_t without the fingerprint."""
    return b"%b%b%b%b%b%b%b%b%b%b" % (
        _S4.pack(KIND_WORDS.index(value.kind)),
        pack_text(value.name),
        pack_text(value.ends[0]),
        pack_text(value.ends[1]),
        _S30.pack(
            value.forward,
            *value.pose.xyz,
            *value.pose.wxyz,
            PROVENANCE_WORDS.index(value.provenance),
            value.stamp,
            value.age,
        ),
        pack_text(value.source),
        _S5.pack(len(value.coordinates)),
        pack_numbers("d", value.coordinates),
        _S6.pack(value.position_share, value.rotation_share),
        pack_text(value.warning),
    )


def unpack_path_edge(data: bytes, at: int) -> tuple[EdgeReport, int]:
    """Return the path_edge_t that begins at `at`, and its end. Raises WireError, struct.error."""
    (kind,) = _S4.unpack_from(data, at)
    name, at = read_text(data, at + 1)
    from_end, at = read_text(data, at)
    to_end, at = read_text(data, at)
    forward, vector_0, vector_1, vector_2, vector_3, vector_4, vector_5, vector_6, provenance, stamp, age = (
        _S30.unpack_from(data, at)
    )
    source, at = read_text(data, at + 74)
    (num_coordinates,) = _S5.unpack_from(data, at)
    check_count(num_coordinates, "num_coordinates", 6)
    coordinates, at = read_numbers("d", data, at + 4, num_coordinates)
    position_share, rotation_share = _S6.unpack_from(data, at)
    warning, at = read_text(data, at + 16)
    return EdgeReport(
        read_word(KIND_WORDS, kind, "kind"),
        name,
        bool(forward),
        (from_end, to_end),
        Pose((vector_0, vector_1, vector_2), (vector_3, vector_4, vector_5, vector_6)),
        read_word(PROVENANCE_WORDS, provenance, "provenance"),
        stamp,
        age,
        source,
        coordinates,
        position_share,
        rotation_share,
        warning,
    ), at


def pack_pose_demand(value: PoseDemand) -> bytes:
    """Return the bytes of a pose_demand_t without the fingerprint."""
    return _S31.pack(value.max_horizontal, value.max_heading, value.max_age, value.min_integrity)


def unpack_pose_demand(data: bytes, at: int) -> tuple[PoseDemand, int]:
    """Return the pose_demand_t that begins at `at`, and its end. Raises WireError, struct.error."""
    max_horizontal, max_heading, max_age, min_integrity = _S31.unpack_from(data, at)
    return PoseDemand(
        check_demand(max_horizontal, "max_horizontal", MAX_DISTANCE),
        check_demand(max_heading, "max_heading", MAX_ANGLE),
        check_demand(max_age, "max_age"),
        check_demand(min_integrity, "min_integrity", 1.0),
    ), at + 32


def pack_range(value: RangeSample) -> bytes:
    """Return the bytes of a range_t without the fingerprint."""
    return b"%b%b%b%b%b%b%b" % (
        _S0.pack(
            value.header.utime,
            value.header.utime_sigma,
            value.header.host_utime,
            value.header.device_utime,
            value.header.seq,
        ),
        pack_text(value.header.source),
        pack_text(value.frame),
        pack_text(value.beacon),
        _S32.pack(*value.beacon_position),
        pack_text(value.frame_of_reference),
        _S6.pack(value.distance, value.sigma),
    )


def unpack_range(data: bytes, at: int) -> tuple[RangeSample, int]:
    """Return the range_t that begins at `at`, and its end. Raises WireError, struct.error."""
    header_utime, header_utime_sigma, header_host_utime, header_device_utime, header_seq = _S0.unpack_from(data, at)
    header_source, at = read_text(data, at + 40)
    frame, at = read_text(data, at)
    beacon, at = read_text(data, at)
    beacon_position_0, beacon_position_1, beacon_position_2 = _S32.unpack_from(data, at)
    frame_of_reference, at = read_text(data, at + 24)
    distance, sigma = _S6.unpack_from(data, at)
    return RangeSample(
        SensorHeader(
            check_sample_utime(header_utime, "utime"),
            check_name(header_source, "source"),
            header_seq,
            check_utime(header_host_utime, "host_utime"),
            header_device_utime,
            header_utime_sigma,
        ),
        check_name(frame, "frame", MAX_FRAME_NAME),
        check_name(beacon, "beacon"),
        check_position((beacon_position_0, beacon_position_1, beacon_position_2), "beacon_position"),
        check_name(frame_of_reference, "frame_of_reference", MAX_FRAME_NAME),
        check_distance(distance, "distance"),
        sigma,
    ), at + 16


def pack_rejected_count(value: RejectedCount) -> bytes:
    """Return the bytes of a rejected_count_t without the fingerprint."""
    return b"%b%b%b" % (pack_text(value.channel), pack_text(value.reason), _S3.pack(value.occurrences))


def unpack_rejected_count(data: bytes, at: int) -> tuple[RejectedCount, int]:
    """Return the rejected_count_t that begins at `at`, and its end. Raises WireError, struct.error."""
    channel, at = read_text(data, at)
    reason, at = read_text(data, at)
    (count,) = _S3.unpack_from(data, at)
    return RejectedCount(channel, reason, count), at + 8


def pack_relative_pose(value: RelativePoseSample) -> bytes:
    """Return the bytes of a relative_pose_t without the fingerprint."""
    return b"%b%b%b%b%b" % (
        _S0.pack(
            value.header.utime,
            value.header.utime_sigma,
            value.header.host_utime,
            value.header.device_utime,
            value.header.seq,
        ),
        pack_text(value.header.source),
        _S3.pack(value.since_utime),
        pack_text(value.frame),
        _S1.pack(*value.position, *value.orientation, *(value.covariance or NAN36)),
    )


def unpack_relative_pose(data: bytes, at: int) -> tuple[RelativePoseSample, int]:
    """Return the relative_pose_t that begins at `at`, and its end. Raises WireError, struct.error."""
    header_utime, header_utime_sigma, header_host_utime, header_device_utime, header_seq = _S0.unpack_from(data, at)
    header_source, at = read_text(data, at + 40)
    (since_utime,) = _S3.unpack_from(data, at)
    frame, at = read_text(data, at + 8)
    position_0, position_1, position_2, orientation_0, orientation_1, orientation_2, orientation_3, *covariance = (
        _S1.unpack_from(data, at)
    )
    return verify_relative_pose(
        RelativePoseSample(
            SensorHeader(
                check_sample_utime(header_utime, "utime"),
                check_name(header_source, "source"),
                header_seq,
                check_utime(header_host_utime, "host_utime"),
                header_device_utime,
                header_utime_sigma,
            ),
            check_name(frame, "frame", MAX_FRAME_NAME),
            since_utime,
            check_position((position_0, position_1, position_2), "position"),
            check_unit_quaternion((orientation_0, orientation_1, orientation_2, orientation_3), "orientation"),
            None if covariance[0] != covariance[0] else check_finite(tuple(covariance), "covariance"),
        )
    ), at + 344


def pack_reload_model_reply(value: ReloadReply) -> bytes:
    """Return the bytes of a reload_model_reply_t without the fingerprint."""
    return b"".join(
        (
            pack_reply_header(value.header),
            pack_text(value.revision),
            _S5.pack(len(value.changes)),
            *map(pack_text, value.changes),
        )
    )


def unpack_reload_model_reply(data: bytes, at: int) -> tuple[ReloadReply, int]:
    """Return the reload_model_reply_t that begins at `at`, and its end. Raises WireError, struct.error."""
    header, at = unpack_reply_header(data, at)
    new_revision, at = read_text(data, at)
    (num_changes,) = _S5.unpack_from(data, at)
    check_count(num_changes, "num_changes")
    changes, at = read_each(read_text, data, at + 4, num_changes)
    return ReloadReply(header, new_revision, changes), at


def pack_reload_model_request(value: ReloadModel) -> bytes:
    """Return the bytes of a reload_model_request_t without the fingerprint."""
    return b"%b%b%b" % (
        _S3.pack(value.header.request_id),
        pack_text(value.header.reply_channel),
        _S4.pack(value.dry_run),
    )


def unpack_reload_model_request(data: bytes, at: int) -> tuple[ReloadModel, int]:
    """Return the reload_model_request_t that begins at `at`, and its end. Raises WireError, struct.error."""
    (header_request_id,) = _S3.unpack_from(data, at)
    header_reply_channel, at = read_text(data, at + 8)
    (dry_run,) = _S4.unpack_from(data, at)
    return ReloadModel(RequestHeader(header_request_id, header_reply_channel), bool(dry_run)), at + 1


def pack_request_header(value: RequestHeader) -> bytes:
    """Return the bytes of a request_header_t without the fingerprint."""
    return b"%b%b" % (_S3.pack(value.request_id), pack_text(value.reply_channel))


def unpack_request_header(data: bytes, at: int) -> tuple[RequestHeader, int]:
    """Return the request_header_t that begins at `at`, and its end. Raises WireError, struct.error."""
    (request_id,) = _S3.unpack_from(data, at)
    reply_channel, at = read_text(data, at + 8)
    return RequestHeader(request_id, reply_channel), at


def pack_sensor_header(value: SensorHeader) -> bytes:
    """Return the bytes of a sensor_header_t without the fingerprint."""
    return b"%b%b" % (
        _S0.pack(value.utime, value.utime_sigma, value.host_utime, value.device_utime, value.seq),
        pack_text(value.source),
    )


def unpack_sensor_header(data: bytes, at: int) -> tuple[SensorHeader, int]:
    """Return the sensor_header_t that begins at `at`, and its end. Raises WireError, struct.error."""
    utime, utime_sigma, host_utime, device_utime, seq = _S0.unpack_from(data, at)
    source, at = read_text(data, at + 40)
    return SensorHeader(
        check_sample_utime(utime, "utime"),
        check_name(source, "source"),
        seq,
        check_utime(host_utime, "host_utime"),
        device_utime,
        utime_sigma,
    ), at


def pack_set_h_transform_request(value: SetHTransform) -> bytes:
    """Return the bytes of a set_h_transform_request_t without the fingerprint."""
    return b"%b%b%b" % (
        _S3.pack(value.header.request_id),
        pack_text(value.header.reply_channel),
        pack_pose_transform(value.pose),
    )


def unpack_set_h_transform_request(data: bytes, at: int) -> tuple[SetHTransform, int]:
    """Return the set_h_transform_request_t that begins at `at`, and its end. Raises WireError, struct.error."""
    (header_request_id,) = _S3.unpack_from(data, at)
    header_reply_channel, at = read_text(data, at + 8)
    pose, at = unpack_pose_transform(data, at)
    return SetHTransform(RequestHeader(header_request_id, header_reply_channel), pose), at


def pack_set_state_vector_request(value: SetStateVector) -> bytes:
    """Return the bytes of a set_state_vector_request_t without the fingerprint."""
    return b"%b%b%b" % (
        _S3.pack(value.header.request_id),
        pack_text(value.header.reply_channel),
        pack_pose_vector(value.pose),
    )


def unpack_set_state_vector_request(data: bytes, at: int) -> tuple[SetStateVector, int]:
    """Return the set_state_vector_request_t that begins at `at`, and its end. Raises WireError, struct.error."""
    (header_request_id,) = _S3.unpack_from(data, at)
    header_reply_channel, at = read_text(data, at + 8)
    pose, at = unpack_pose_vector(data, at)
    return SetStateVector(RequestHeader(header_request_id, header_reply_channel), pose), at


def pack_signed(value: Envelope) -> bytes:
    """Return the bytes of a signed_t without the fingerprint."""
    return b"%b%b%b%b%b%b%b" % (
        pack_text(value.key_name),
        pack_text(value.sender),
        _S33.pack(value.utime, value.counter),
        pack_text(value.channel),
        _S5.pack(len(value.payload)),
        value.payload,
        _S34.pack(value.mac),
    )


def unpack_signed(data: bytes, at: int) -> tuple[Envelope, int]:
    """Return the signed_t that begins at `at`, and its end. Raises WireError, struct.error."""
    key_name, at = read_text(data, at)
    sender, at = read_text(data, at)
    utime, counter = _S33.unpack_from(data, at)
    channel, at = read_text(data, at + 16)
    (size,) = _S5.unpack_from(data, at)
    check_count(size, "size", 4096)
    payload, at = read_bytes(data, at + 4, size)
    (mac,) = _S34.unpack_from(data, at)
    return Envelope(
        check_name(key_name, "key_name"),
        check_name(sender, "sender"),
        check_utime(utime, "utime"),
        counter,
        check_name(channel, "channel"),
        payload,
        mac,
    ), at + 32


def pack_stability_health(value: StabilityHealth) -> bytes:
    """Return the bytes of a stability_health_t without the fingerprint."""
    return b"".join(
        (
            _S35.pack(
                value.margin,
                value.margin_sigma,
                value.dynamic_margin,
                value.dynamic_margin_sigma,
                value.limit,
                len(value.contacts),
            ),
            *map(pack_text, value.contacts),
            pack_numbers("d", value.loads, len(value.contacts)),
        )
    )


def unpack_stability_health(data: bytes, at: int) -> tuple[StabilityHealth, int]:
    """Return the stability_health_t that begins at `at`, and its end. Raises WireError, struct.error."""
    margin, margin_sigma, dynamic_margin, dynamic_margin_sigma, limit, num_contacts = _S35.unpack_from(data, at)
    check_count(num_contacts, "num_contacts", MAX_CONTACTS)
    contacts, at = read_each(read_text, data, at + 44, num_contacts)
    loads, at = read_numbers("d", data, at, num_contacts)
    return StabilityHealth(
        margin,
        margin_sigma,
        dynamic_margin,
        dynamic_margin_sigma,
        limit,
        tuple([check_name(each, "contacts", MAX_FRAME_NAME) for each in contacts]),
        loads,
    ), at


def pack_time_query(value: TimeQuery) -> bytes:
    """Return the bytes of a time_query_t without the fingerprint."""
    return _S13.pack(value.at, value.policy, value.wait_ms)


def unpack_time_query(data: bytes, at: int) -> tuple[TimeQuery, int]:
    """Return the time_query_t that begins at `at`, and its end. Raises WireError, struct.error."""
    at_, policy, wait_ms = _S13.unpack_from(data, at)
    return TimeQuery(
        check_utime(at_, "at"), read_enum(Policy, policy, "policy"), check_not_negative(wait_ms, "wait_ms")
    ), at + 13


def pack_vehicle_command(value: VehicleCommand) -> bytes:
    """Return the bytes of a vehicle_command_t without the fingerprint."""
    return b"%b%b%b" % (
        _S36.pack(value.utime, value.valid_for, value.seq),
        pack_text(value.source),
        _S6.pack(value.forward_speed, value.steering_angle),
    )


def unpack_vehicle_command(data: bytes, at: int) -> tuple[VehicleCommand, int]:
    """Return the vehicle_command_t that begins at `at`, and its end. Raises WireError, struct.error."""
    utime, valid_for, seq = _S36.unpack_from(data, at)
    source, at = read_text(data, at + 24)
    forward_speed, steering_angle = _S6.unpack_from(data, at)
    return VehicleCommand(
        check_sample_utime(utime, "utime"),
        check_positive(valid_for, "valid_for"),
        seq,
        check_name(source, "source"),
        check_number(forward_speed, "forward_speed"),
        check_number(steering_angle, "steering_angle"),
    ), at + 16


def pack_vehicle_status(value: VehicleStatusSample) -> bytes:
    """Return the bytes of a vehicle_status_t without the fingerprint."""
    return b"%b%b%b" % (
        _S0.pack(
            value.header.utime,
            value.header.utime_sigma,
            value.header.host_utime,
            value.header.device_utime,
            value.header.seq,
        ),
        pack_text(value.header.source),
        _S37.pack(
            value.mode,
            value.forward_speed,
            value.steering_angle,
            value.supply_voltage,
            value.engine_speed,
            value.fault_bits,
            value.commands_rejected,
        ),
    )


def unpack_vehicle_status(data: bytes, at: int) -> tuple[VehicleStatusSample, int]:
    """Return the vehicle_status_t that begins at `at`, and its end. Raises WireError, struct.error."""
    header_utime, header_utime_sigma, header_host_utime, header_device_utime, header_seq = _S0.unpack_from(data, at)
    header_source, at = read_text(data, at + 40)
    mode, forward_speed, steering_angle, supply_voltage, engine_speed, fault_bits, commands_rejected = _S37.unpack_from(
        data, at
    )
    return VehicleStatusSample(
        SensorHeader(
            check_sample_utime(header_utime, "utime"),
            check_name(header_source, "source"),
            header_seq,
            check_utime(header_host_utime, "host_utime"),
            header_device_utime,
            header_utime_sigma,
        ),
        read_enum(VehicleMode, mode, "mode"),
        forward_speed,
        steering_angle,
        supply_voltage,
        engine_speed,
        fault_bits,
        check_not_negative(commands_rejected, "commands_rejected"),
    ), at + 45


def pack_wheels(value: WheelsSample) -> bytes:
    """Return the bytes of a wheels_t without the fingerprint."""
    return b"".join(
        (
            _S0.pack(
                value.header.utime,
                value.header.utime_sigma,
                value.header.host_utime,
                value.header.device_utime,
                value.header.seq,
            ),
            pack_text(value.header.source),
            _S5.pack(len(value.wheels)),
            *map(pack_text, [each.name for each in value.wheels]),
            pack_numbers("d", [each.travel for each in value.wheels]),
            pack_numbers("d", [each.travel_sigma for each in value.wheels]),
            pack_numbers("d", [each.speed for each in value.wheels]),
            pack_numbers("d", [each.speed_sigma for each in value.wheels]),
            pack_numbers("b", [each.direction for each in value.wheels]),
            pack_numbers("d", [each.steering for each in value.wheels]),
        )
    )


def unpack_wheels(data: bytes, at: int) -> tuple[WheelsSample, int]:
    """Return the wheels_t that begins at `at`, and its end. Raises WireError, struct.error."""
    header_utime, header_utime_sigma, header_host_utime, header_device_utime, header_seq = _S0.unpack_from(data, at)
    header_source, at = read_text(data, at + 40)
    (num_wheels,) = _S5.unpack_from(data, at)
    check_count(num_wheels, "num_wheels", 1024)
    names, at = read_each(read_text, data, at + 4, num_wheels)
    travel, at = read_numbers("d", data, at, num_wheels)
    travel_sigma, at = read_numbers("d", data, at, num_wheels)
    speed, at = read_numbers("d", data, at, num_wheels)
    speed_sigma, at = read_numbers("d", data, at, num_wheels)
    direction, at = read_numbers("b", data, at, num_wheels)
    steering, at = read_numbers("d", data, at, num_wheels)
    return WheelsSample(
        SensorHeader(
            check_sample_utime(header_utime, "utime"),
            check_name(header_source, "source"),
            header_seq,
            check_utime(header_host_utime, "host_utime"),
            header_device_utime,
            header_utime_sigma,
        ),
        tuple(
            map(
                WheelSample,
                names,
                travel,
                travel_sigma,
                speed,
                speed_sigma,
                [read_enum(Direction, each, "direction") for each in direction],
                steering,
            )
        ),
    ), at


CODECS = (
    Codec(
        "absolute_pose_t", FINGERPRINTS["absolute_pose_t"], AbsolutePoseSample, pack_absolute_pose, unpack_absolute_pose
    ),
    Codec(
        "acknowledgement_t",
        FINGERPRINTS["acknowledgement_t"],
        Acknowledgement,
        pack_acknowledgement,
        unpack_acknowledgement,
    ),
    Codec("decisions_t", FINGERPRINTS["decisions_t"], PublishDecisions, pack_decisions, unpack_decisions),
    Codec("driver_health_t", FINGERPRINTS["driver_health_t"], DriverHealth, pack_driver_health, unpack_driver_health),
    Codec(
        "get_body_frame_list_request_t",
        FINGERPRINTS["get_body_frame_list_request_t"],
        GetBodyFrameList,
        pack_get_body_frame_list_request,
        unpack_get_body_frame_list_request,
    ),
    Codec(
        "get_body_list_request_t",
        FINGERPRINTS["get_body_list_request_t"],
        GetBodyList,
        pack_get_body_list_request,
        unpack_get_body_list_request,
    ),
    Codec(
        "get_dynamics_reply_t",
        FINGERPRINTS["get_dynamics_reply_t"],
        DynamicsReply,
        pack_get_dynamics_reply,
        unpack_get_dynamics_reply,
    ),
    Codec(
        "get_dynamics_request_t",
        FINGERPRINTS["get_dynamics_request_t"],
        GetDynamics,
        pack_get_dynamics_request,
        unpack_get_dynamics_request,
    ),
    Codec(
        "get_explanation_reply_t",
        FINGERPRINTS["get_explanation_reply_t"],
        ExplanationReply,
        pack_get_explanation_reply,
        unpack_get_explanation_reply,
    ),
    Codec(
        "get_explanation_request_t",
        FINGERPRINTS["get_explanation_request_t"],
        GetExplanation,
        pack_get_explanation_request,
        unpack_get_explanation_request,
    ),
    Codec(
        "get_h_transform_request_t",
        FINGERPRINTS["get_h_transform_request_t"],
        GetHTransform,
        pack_get_h_transform_request,
        unpack_get_h_transform_request,
    ),
    Codec(
        "get_history_reply_t",
        FINGERPRINTS["get_history_reply_t"],
        HistoryReply,
        pack_get_history_reply,
        unpack_get_history_reply,
    ),
    Codec(
        "get_history_request_t",
        FINGERPRINTS["get_history_request_t"],
        GetHistory,
        pack_get_history_request,
        unpack_get_history_request,
    ),
    Codec(
        "get_motion_reply_t",
        FINGERPRINTS["get_motion_reply_t"],
        MotionReply,
        pack_get_motion_reply,
        unpack_get_motion_reply,
    ),
    Codec(
        "get_motion_request_t",
        FINGERPRINTS["get_motion_request_t"],
        GetMotion,
        pack_get_motion_request,
        unpack_get_motion_request,
    ),
    Codec(
        "get_state_vector_reply_t",
        FINGERPRINTS["get_state_vector_reply_t"],
        StateVectorReply,
        pack_get_state_vector_reply,
        unpack_get_state_vector_reply,
    ),
    Codec(
        "get_state_vector_request_t",
        FINGERPRINTS["get_state_vector_request_t"],
        GetStateVector,
        pack_get_state_vector_request,
        unpack_get_state_vector_request,
    ),
    Codec(
        "get_transformation_reply_t",
        FINGERPRINTS["get_transformation_reply_t"],
        TransformReply,
        pack_get_transformation_reply,
        unpack_get_transformation_reply,
    ),
    Codec(
        "get_transformation_request_t",
        FINGERPRINTS["get_transformation_request_t"],
        GetTransformation,
        pack_get_transformation_request,
        unpack_get_transformation_request,
    ),
    Codec(
        "get_transformations_reply_t",
        FINGERPRINTS["get_transformations_reply_t"],
        PoseBatchReply,
        pack_get_transformations_reply,
        unpack_get_transformations_reply,
    ),
    Codec(
        "get_transformations_request_t",
        FINGERPRINTS["get_transformations_request_t"],
        GetTransformations,
        pack_get_transformations_request,
        unpack_get_transformations_request,
    ),
    Codec("gps_t", FINGERPRINTS["gps_t"], GpsSample, pack_gps, unpack_gps),
    Codec("health_t", FINGERPRINTS["health_t"], Health, pack_health, unpack_health),
    Codec("imu_t", FINGERPRINTS["imu_t"], ImuSample, pack_imu, unpack_imu),
    Codec("joints_t", FINGERPRINTS["joints_t"], JointsSample, pack_joints, unpack_joints),
    Codec(
        "localization_mode_t",
        FINGERPRINTS["localization_mode_t"],
        SwitchMode,
        pack_localization_mode,
        unpack_localization_mode,
    ),
    Codec("measurement_t", FINGERPRINTS["measurement_t"], MeasurementSample, pack_measurement, unpack_measurement),
    Codec(
        "model_snapshot_t", FINGERPRINTS["model_snapshot_t"], SnapshotPart, pack_model_snapshot, unpack_model_snapshot
    ),
    Codec(
        "name_list_reply_t",
        FINGERPRINTS["name_list_reply_t"],
        NameListReply,
        pack_name_list_reply,
        unpack_name_list_reply,
    ),
    Codec(
        "navigation_state_t",
        FINGERPRINTS["navigation_state_t"],
        NavigationState,
        pack_navigation_state,
        unpack_navigation_state,
    ),
    Codec("pose_transform_t", FINGERPRINTS["pose_transform_t"], PoseAnswer, pack_pose_transform, unpack_pose_transform),
    Codec("pose_vector_t", FINGERPRINTS["pose_vector_t"], PoseAnswer, pack_pose_vector, unpack_pose_vector),
    Codec("range_t", FINGERPRINTS["range_t"], RangeSample, pack_range, unpack_range),
    Codec(
        "relative_pose_t", FINGERPRINTS["relative_pose_t"], RelativePoseSample, pack_relative_pose, unpack_relative_pose
    ),
    Codec(
        "reload_model_reply_t",
        FINGERPRINTS["reload_model_reply_t"],
        ReloadReply,
        pack_reload_model_reply,
        unpack_reload_model_reply,
    ),
    Codec(
        "reload_model_request_t",
        FINGERPRINTS["reload_model_request_t"],
        ReloadModel,
        pack_reload_model_request,
        unpack_reload_model_request,
    ),
    Codec(
        "set_h_transform_request_t",
        FINGERPRINTS["set_h_transform_request_t"],
        SetHTransform,
        pack_set_h_transform_request,
        unpack_set_h_transform_request,
    ),
    Codec(
        "set_state_vector_request_t",
        FINGERPRINTS["set_state_vector_request_t"],
        SetStateVector,
        pack_set_state_vector_request,
        unpack_set_state_vector_request,
    ),
    Codec("signed_t", FINGERPRINTS["signed_t"], Envelope, pack_signed, unpack_signed),
    Codec(
        "vehicle_command_t",
        FINGERPRINTS["vehicle_command_t"],
        VehicleCommand,
        pack_vehicle_command,
        unpack_vehicle_command,
    ),
    Codec(
        "vehicle_status_t",
        FINGERPRINTS["vehicle_status_t"],
        VehicleStatusSample,
        pack_vehicle_status,
        unpack_vehicle_status,
    ),
    Codec("wheels_t", FINGERPRINTS["wheels_t"], WheelsSample, pack_wheels, unpack_wheels),
)
