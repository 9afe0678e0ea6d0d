"""Values of every wire type, and their comparison, for tests of the codec."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np

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
    Lifetime,
    LocalizationHealth,
    MeasurementSample,
    Mode,
    MotionAnswer,
    MotionReply,
    NameListReply,
    NavigationState,
    OrientationReference,
    Origin,
    Phase,
    Policy,
    PoseAnswer,
    PoseBatch,
    PoseBatchReply,
    PoseDemand,
    PublishDecisions,
    Quality,
    RangeSample,
    RejectedCount,
    RelativePoseSample,
    ReloadModel,
    ReloadReply,
    ReplyHeader,
    RequestHeader,
    SensorHeader,
    SetFrame,
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
from modelserver.transforms.transformation import Transformation

UTIME = 1_700_000_000_123_456
_SENSOR = SensorHeader(UTIME, "front", 7, UTIME + 900, 123_456, 1e-4)
_REQUEST = RequestHeader(-(1 << 63), "REPLY_TEST")
_OK = ReplyHeader((1 << 63) - 1, UTIME, model_revision="ab12")
_UNKNOWN = ReplyHeader(1, UTIME, Status.UNKNOWN_FRAME, "no frame 'Raptor:GC'", ("Raptor:CG", "Räptor:CG"), "ab12")
_TIME = TimeQuery(UTIME, Policy.PREDICTED, 250)
_DEMAND = PoseDemand(0.5, 0.05, 0.2, 0.999)
_NINE = (1.0, 0.1, 0.2, 0.1, 2.0, 0.3, 0.2, 0.3, 3.0)


def many_poses(covariances: bool) -> PoseBatch:
    """Return some poses at three instants, the last without an answer; names and instants are those of the request."""
    vectors = np.arange(21.0).reshape(3, 7)
    vectors[2] = math.nan
    number = np.array([0, 0, 5], dtype=np.int32)
    return PoseBatch(
        "", "", np.zeros(3, dtype=np.int64), vectors, number, number + 1, number + 2, number - 7,
        np.arange(108.0).reshape(3, 36) if covariances else None,
        answer().origin if covariances else None,
        "ab12",
    )  # fmt: skip


def answer(epoch: int = 3) -> PoseAnswer:
    """Return a pose with all fields."""
    return PoseAnswer(
        Transformation(
            "Raptor:CG",
            "World:UTM",
            Pose.from_rpy((12.5, -3.25, 1.0), 0.01, -0.02, 2.5),
            np.arange(36.0).reshape(6, 6),
            UTIME,
            int(Invalid.STALE_GPS | Invalid.CLOCK_STEPPED),
            epoch,
            -77,
            "ab12",
        ),
        Origin(445_000.5, 5_030_000.25, 71.5, 18, True, -77),
        Quality.PREDICTED | Quality.REVERSING,
        1.5,
        0.05,
        12.0,
        0.75,
        0.025,
        1e-3,
        0.4,
    )


def bare_answer() -> PoseAnswer:
    """Return a static pose without optional fields."""
    return PoseAnswer(Transformation("Camera:Image", "Raptor:CG", Pose((0.299, -0.056, 0.433))))


_TURN = (0.5, -0.5, 0.5, -0.5)


def state(n: int = 3) -> NavigationState:
    """Return the state of a filter with `n` error states."""
    error = np.arange(1.0, 1.0 + n * n).reshape(n, n)
    return NavigationState(
        UTIME,
        Mode.NO_WHEELS,
        Phase.ALIGNED,
        True,
        Invalid.STALE_GPS,
        4,
        50.25,
        -111.125,
        700.5,
        Pose.from_rpy((12.5, -3.25, 1.0), 0.01, -0.02, 2.5),
        (2.0, 0.1, -0.05),
        (0.01, -0.02, 0.3),
        tuple(float(value) for value in range(36)),
        tuple(f"state_{each}" for each in range(n)),
        tuple(0.5 * each for each in range(n)),
        tuple((error @ error.T).ravel().tolist()),
    )


EXAMPLES: dict[str, tuple[Any, ...]] = {
    "gps_t": (
        GpsSample(_SENSOR, FixType.NONE, math.nan, math.nan),
        GpsSample(
            _SENSOR, FixType.RTK_FIXED, 45.5, -75.25, 71.5, 105.5, -34.0, 12, 0.8, 1.1, 1.4, _NINE, (1.0, -2.0, 0.5),
            _NINE, 0.05, 2.25, 0.1, -1.5, 0.02, 3.0, 0.01,
        ),
    ),
    "imu_t": (
        ImuSample(_SENSOR),
        ImuSample(
            _SENSOR, (0.1, 0.2, 0.3), (0.0, 0.0, 9.81), (1e-5, 2e-5, -4e-5), (1.0, 0.0, 0.0, 0.0),
            OrientationReference.NED, YawSource.MAGNETIC, _NINE, _NINE, _NINE, 36.5,
        ),
        # all zeros is a measurement, not a missing value
        ImuSample(_SENSOR, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
    ),
    "wheels_t": (
        WheelsSample(_SENSOR, ()),
        WheelsSample(
            _SENSOR,
            (WheelSample("left", 10.5, 0.1, -1.0, 0.05, Direction.BACKWARD, 0.3), WheelSample("right")),
        ),
    ),
    "joints_t": (
        JointsSample(_SENSOR, ()),
        JointsSample(_SENSOR, (JointSample("nod", -0.336, 0.001, 1.5, 0.1), JointSample("boom", 0.25))),
    ),
    "absolute_pose_t": (
        AbsolutePoseSample(_SENSOR, "Raptor:CG", "World:UTM"),
        AbsolutePoseSample(_SENSOR, "Raptor:CG", "World:ENU", orientation=_TURN),
        AbsolutePoseSample(
            _SENSOR, "Räptor:CG", "World:ENU", (1.5, -2.5, 0.0), _TURN, tuple(float(each) for each in range(36))
        ),
    ),
    "relative_pose_t": (
        RelativePoseSample(_SENSOR, "Digiclops:ImagePlane", UTIME - 100_000, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)),
        RelativePoseSample(
            _SENSOR, "Digiclops:ImagePlane", 1, (0.25, 0.01, 0.0), _TURN, tuple(float(each) for each in range(36))
        ),
    ),
    "range_t": (
        RangeSample(_SENSOR, "Raptor:CG", "", (0.0, 0.0, 0.0), "World:UTM", 0.0),
        RangeSample(_SENSOR, "Raptor:CG", "gate", (12.5, -40.0, 3.0), "World:ENU", 41.25, 0.1),
    ),
    "measurement_t": (
        MeasurementSample(_SENSOR, (1.25,)),
        MeasurementSample(_SENSOR, (1.25, -0.5), "Raptor:CG", (0.04, 0.01, 0.01, 0.09)),
    ),
    "localization_mode_t": (SwitchMode(_SENSOR, Mode.FULL), SwitchMode(_SENSOR, Mode.DEAD_RECKONING)),
    "decisions_t": (
        PublishDecisions(UTIME, ()),
        PublishDecisions(
            UTIME + 1000,
            (
                Decision(UTIME, "gps", 6, "gps_position", Verdict.REJECTED, "no_fix"),
                Decision(UTIME, "gps", 7, "gps_position", Verdict.REJECTED, "outlier", (1.5, -2.5),
                         (4.0, 0.5, 0.5, 9.0), (1.0, 0.0, 0.0, 1.0), 0.75, 13.8),
                Decision(UTIME + 5, "wheels", 70, "wheel_speed", Verdict.USED, "", (0.02,), (0.0004,)),
            ),
        ),
    ),
    "navigation_state_t": (
        NavigationState(
            UTIME, Mode.FULL, Phase.LEVELING, False, Invalid.NO_FIX, 0, math.nan, math.nan, math.nan, Pose(),
            (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (), (), (), (),
        ),
        state(),
    ),
    "get_transformation_request_t": (
        GetTransformation(_REQUEST, "Raptor:CG", "World:UTM"),
        GetTransformation(_REQUEST, "", "Räptor:CG", _TIME, _DEMAND),
    ),
    "get_body_list_request_t": (GetBodyList(_REQUEST), GetBodyList(RequestHeader(0, ""))),
    "get_body_frame_list_request_t": (GetBodyFrameList(_REQUEST, "Raptor"), GetBodyFrameList(_REQUEST, "")),
    "get_state_vector_request_t": (GetStateVector(_REQUEST), GetStateVector(_REQUEST, _TIME, _DEMAND)),
    "get_h_transform_request_t": (GetHTransform(_REQUEST), GetHTransform(_REQUEST, True, _TIME, _DEMAND)),
    "get_history_request_t": (GetHistory(_REQUEST, UTIME, UTIME + 1_000_000, 10.0),),
    "get_transformation_reply_t": (
        TransformReply(_UNKNOWN),
        TransformReply(_OK, answer()),
        TransformReply(_OK, bare_answer()),
        TransformReply(_OK, answer(), Unmet.HORIZONTAL | Unmet.NOT_VALID, "älter als 1 s"),
    ),
    "get_state_vector_reply_t": (StateVectorReply(_UNKNOWN), StateVectorReply(_OK, answer(), Unmet.AGE, "old")),
    "name_list_reply_t": (NameListReply(_UNKNOWN), NameListReply(_OK, ("Raptor", "Camera"), ("the vehicle", ""))),
    "get_history_reply_t": (
        HistoryReply(_UNKNOWN),
        HistoryReply(_OK, (answer(1), answer(2), bare_answer())),
    ),
    "get_transformations_request_t": (
        GetTransformations(_REQUEST, (("Raptor:CG", "World:UTM"),), (UTIME,)),
        GetTransformations(_REQUEST, (("a:b", "c:d"), ("Räptor:CG", "")), (UTIME, 0, 5), "Odom:Origin", 7, False),
    ),
    "get_transformations_reply_t": (
        PoseBatchReply(_UNKNOWN),
        PoseBatchReply(_OK, 2, 3, 1, 600, many_poses(True)),
        PoseBatchReply(_OK, 0, 1, 0, 0, many_poses(False)),
    ),
    "get_motion_request_t": (
        GetMotion(_REQUEST, "Raptor:CG", "World:UTM"),
        GetMotion(_REQUEST, "", "Räptor:CG", "Raptor:CG", _TIME),
    ),
    "get_motion_reply_t": (
        MotionReply(_UNKNOWN),
        MotionReply(
            _OK,
            MotionAnswer(
                answer(), "Raptor:CG", (1.0, 2.0, 3.0), (0.1, 0.2, 0.3), (4.0, 5.0, 6.0), (0.4, 0.5, 0.6),
                tuple(float(each) for each in range(36)),
                tuple(float(each) for each in range(36, 72)),
            ),
        ),
        MotionReply(_OK, MotionAnswer(bare_answer(), "", (1.0, 2.0, 3.0), *(((math.nan,) * 3,) * 3))),
    ),
    "get_explanation_request_t": (
        GetExplanation(_REQUEST, "Raptor:CG", "World:UTM"),
        GetExplanation(_REQUEST, "", "Räptor:CG", _TIME),
    ),
    "get_explanation_reply_t": (
        ExplanationReply(_UNKNOWN),
        ExplanationReply(_OK, Explanation(bare_answer(), ())),
        ExplanationReply(
            _OK,
            Explanation(
                answer(),
                (
                    EdgeReport("vehicle", "World:UTM", False, ("World:UTM", "Raptor:CG"), Pose((1.0, 2.0, 3.0)),
                               "predicted", UTIME, -0.25, "localization", (), 0.75, 1.0),
                    EdgeReport("joint", "Nod", True, ("a:b", "c:d"), Pose.from_rpy((0, 0, 0), 0.1, 0.2, 0.3), "default",
                               coordinates=(0.1, 0.2, 0.3), warning="no sample received"),
                ),
            ),
        ),
    ),
    "get_dynamics_request_t": (
        GetDynamics(_REQUEST),
        GetDynamics(_REQUEST, "Räptor:CG", True, True, _TIME),
    ),
    "get_dynamics_reply_t": (
        DynamicsReply(_UNKNOWN),
        DynamicsReply(
            _OK,
            DynamicsAnswer(
                UTIME, Invalid(0), "Raptor:CG", 900.0, (0.1, 0.2, 0.3), tuple(float(each) for each in range(36)),
                (), (), (), (), (), (),
            ),
        ),
        DynamicsReply(
            _OK,
            DynamicsAnswer(
                UTIME, Invalid.STALE_JOINT, "", 900.0, (0.1, 0.2, 0.3), tuple(float(each) for each in range(36)),
                ("Nod", "Räd"), (0.1, 0.2), (1.0, 2.0), (0.5, -0.5), (3.0, math.nan), (1.0, 0.5, 0.5, 2.0),
                tuple(float(each) for each in range(1, 10)),  # type: ignore[arg-type]
            ),
        ),
    ),
    "reload_model_request_t": (ReloadModel(_REQUEST), ReloadModel(_REQUEST, True)),
    "set_frame_request_t": (
        SetFrame(_REQUEST, "Camera:Marker"),
        SetFrame(
            _REQUEST,
            "a:b",
            Pose((1.0, 2.0, 3.0), (0.5, 0.5, 0.5, 0.5)),
            (0.1, 0.2, 0.3),
            (0.0, 0.1, 0.2),
            Lifetime.REMOVED,
        ),
    ),
    "reload_model_reply_t": (ReloadReply(_UNKNOWN), ReloadReply(_OK, "cd34", ("frame a:b moves by 2 mm", ""))),
    "set_state_vector_request_t": (SetStateVector(_REQUEST, answer()), SetStateVector(_REQUEST, bare_answer())),
    "set_h_transform_request_t": (SetHTransform(_REQUEST, answer()), SetHTransform(_REQUEST, bare_answer())),
    "acknowledgement_t": (Acknowledgement(_UNKNOWN), Acknowledgement(_OK)),
    "signed_t": (
        Envelope("raptor", "me@here", UTIME, 1, "PLATFORM_RELOAD_MODEL", b"", bytes(32)),
        Envelope("", "", 0, -(1 << 63), "Räptor", bytes(range(256)), bytes(range(32))),
    ),
    "model_snapshot_t": (SnapshotPart(UTIME, "ab12", 0, 1, b""), SnapshotPart(UTIME, "ab12", 2, 5, bytes(range(256)))),
    "health_t": (
        Health(
            UTIME, 0.5, "0.1.0", "raptor", "ab12", 0, Invalid.NO_FIX | Invalid.NO_IMU, 0, 0, 0, 0, 0, 0, 0,
            math.nan, math.nan,
        ),
        Health(
            UTIME, 99.5, "0.1.0", "raptor", "ab12", 1, Invalid(0), 2, -77, 4950, 12, 1, 3, 1, 1e-4, 5e-4, 1e-3, 2e-3,
            "no GPS", "raptor-pc", 4711, 3, 150_000_000, 0.125,
            LocalizationHealth(
                Mode.NO_GPS, Phase.ALIGNED, True, 1.5, 0.05, 12.0, 0.3, 50.27, -111.18, 700.0, 39.7, 0.5, 99.0
            ),
            StabilityHealth(0.5, 0.01, 0.4, 0.02, 0.1, ("Raptor:A", "Raptor:B"), (2000.0, 2500.0)),
            (ChannelHealth("sensor:gps", 99, 1.0, 0.4, 2e-3), ChannelHealth("IMU", 0, 0.0, math.nan, math.nan, True)),
            (RejectedCount("GPS", "truncated", 4), RejectedCount("sensor:gps", "stale", 1)),
            (("journal", "the disk is full"),),
        ),
    ),
    "vehicle_status_t": (
        VehicleStatusSample(_SENSOR),
        VehicleStatusSample(_SENSOR, VehicleMode.EMERGENCY_STOP, -1.5, 0.25, 13.8, 261.8, -(1 << 31), 17),
    ),
    "vehicle_command_t": (VehicleCommand(UTIME, 0.5, 12, "arbitrator", -1.5, 0.25),),
    "driver_health_t": (
        DriverHealth(UTIME, "gps", "novatel", DriverPhase.CLOSED),
        DriverHealth(
            UTIME, "gps", "novatel", DriverPhase.STREAMING, "BESTPOS 5 Hz", "/dev/ttyUSB0", 38400, 2, 450, 5.0, 0.1,
            -1.5, 2e-5, 4e-4, 1, (("bestpos", 450), ("rejected.checksum", 3)),
        ),
    ),
    "pose_transform_t": (answer(), bare_answer()),
    "pose_vector_t": (answer(), bare_answer()),
}  # fmt: skip
"""Values of each type, without and with the optional fields."""


def same(left: Any, right: Any) -> bool:
    """Return whether two values of the core are equal; nan equals nan, rotations are compared to 1e-12."""
    if isinstance(left, Transformation):
        return (
            isinstance(right, Transformation)
            and left.pose.is_close(right.pose, 0.0, 1e-12)
            and (left.covariance is None) == (right.covariance is None)
            and (left.covariance is None or np.array_equal(left.covariance, right.covariance, equal_nan=True))
            and all(
                getattr(left, name) == getattr(right, name)
                for name in (
                    "frame_of_interest",
                    "frame_of_reference",
                    "utime",
                    "invalid_reasons",
                    "pose_epoch",
                    "origin_id",
                    "model_revision",
                )
            )
        )
    if isinstance(left, np.ndarray):
        return (
            isinstance(right, np.ndarray) and left.dtype == right.dtype and np.array_equal(left, right, equal_nan=True)
        )
    if isinstance(left, Pose):
        return isinstance(right, Pose) and left.is_close(right, 0.0, 1e-12)
    if type(left) is not type(right):
        return False
    if dataclasses.is_dataclass(left):
        return all(same(getattr(left, each.name), getattr(right, each.name)) for each in dataclasses.fields(left))
    if isinstance(left, tuple):
        return len(left) == len(right) and all(map(same, left, right))
    if isinstance(left, float):
        return left == right or (math.isnan(left) and math.isnan(right))
    return bool(left == right)
