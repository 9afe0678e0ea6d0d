"""The codec with arbitrary values and bytes."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support_wire import EXAMPLES, many_poses, same

import mslcm
from modelserver import messages
from modelserver.errors import Status, WireError
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.transformation import Transformation
from modelserver.wire.codec import decode, encode, get_type_names
from modelserver.wire.fields import MAX_UTIME
from modelserver.wire.generated import KIND_WORDS, PROVENANCE_WORDS

int32 = st.integers(-(1 << 31), (1 << 31) - 1)
int64 = st.integers(-(1 << 63), (1 << 63) - 1)
count64 = st.integers(0, (1 << 63) - 1)
utimes = st.integers(0, MAX_UTIME - 1)
numbers = st.floats(allow_nan=True, allow_infinity=True)
known = st.floats(allow_nan=False, allow_infinity=True)
# LCM strings are UTF-8
texts = st.text(st.characters(exclude_categories=("Cs",)), max_size=20)


def vectors(length: int) -> st.SearchStrategy[Any]:
    # opposite infinities add up to nan, which means a missing vector; no device sends them
    return st.none() | st.tuples(*[st.floats(allow_nan=False, allow_infinity=False, width=32)] * length)


sensor_headers = st.builds(
    messages.SensorHeader,
    st.integers(1, MAX_UTIME - 1),
    st.text(st.characters(exclude_categories=("Cs",)), max_size=64),
    int64,
    utimes,
    int64,
    numbers,
)
request_headers = st.builds(messages.RequestHeader, int64, texts)
demands = st.builds(
    messages.PoseDemand,
    st.floats(0.0, 1e12, exclude_max=True),
    st.floats(0.0, math.pi, exclude_max=True),
    st.floats(0.0, allow_infinity=False),
    st.floats(0.0, 1.0, exclude_max=True),
)
unmets = st.integers(0, 15).map(messages.Unmet)
times = st.builds(messages.TimeQuery, utimes, st.sampled_from(messages.Policy), st.integers(0, (1 << 31) - 1))


def reply_headers(status: st.SearchStrategy[Status]) -> st.SearchStrategy[messages.ReplyHeader]:
    return st.builds(messages.ReplyHeader, int64, int64, status, texts, st.lists(texts, max_size=3).map(tuple), texts)


@st.composite
def answers(draw: st.DrawFn) -> messages.PoseAnswer:
    meters = st.floats(-1e9, 1e9)
    quaternion = draw(st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: math.hypot(*q) > 1e-3))
    covariance = draw(st.none() | st.lists(known, min_size=36, max_size=36))
    origin = draw(st.none() | st.builds(messages.Origin, known, known, known, st.integers(1, 60), st.booleans(), int64))
    return messages.PoseAnswer(
        Transformation(
            draw(texts),
            draw(texts),
            Pose(draw(st.tuples(meters, meters, meters)), quaternion),
            None if covariance is None else np.array(covariance).reshape(6, 6),
            draw(int64),
            draw(st.integers(0, (1 << 31) - 1)),
            draw(int32),
            # the wire has the origin's id once
            draw(int64) if origin is None else origin.origin_id,
            draw(texts),
        ),
        origin,
        messages.Quality(draw(st.integers(0, 63))),
        *draw(st.tuples(*[numbers] * 7)),
    )


places = st.tuples(*[st.floats(-1e9, 1e9)] * 3)
turns = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: math.hypot(*q) > 1e-3).map(so3.normalize)
frames = st.text(st.characters(exclude_categories=("Cs",)), max_size=40)
covariances = st.none() | st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=36, max_size=36).map(
    tuple
)


def optional_numbers(length: int) -> st.SearchStrategy[tuple[float, ...]]:
    """Numbers of which the first is not nan, which means missing."""
    if not length:
        return st.just(())
    return st.tuples(known, *[numbers] * (length - 1))


@st.composite
def relative_poses(draw: st.DrawFn) -> messages.RelativePoseSample:
    header = draw(sensor_headers.filter(lambda header: header.utime > 1))
    since = draw(st.integers(1, header.utime - 1))
    return messages.RelativePoseSample(header, draw(frames), since, draw(places), draw(turns), draw(covariances))


@st.composite
def measurements(draw: st.DrawFn) -> messages.MeasurementSample:
    n = draw(st.integers(1, 5))
    values = tuple(draw(st.lists(numbers, min_size=n, max_size=n)))
    return messages.MeasurementSample(
        draw(sensor_headers), values, draw(frames), draw(st.just(()) | optional_numbers(n * n))
    )


@st.composite
def decisions(draw: st.DrawFn) -> messages.Decision:
    n = draw(st.integers(0, 4))
    return messages.Decision(
        draw(utimes),
        draw(texts),
        draw(int64),
        draw(texts),
        draw(st.sampled_from(messages.Verdict)),
        draw(texts),
        tuple(draw(st.lists(numbers, min_size=n, max_size=n))),
        draw(st.just(()) | optional_numbers(n * n)),
        draw(st.just(()) | optional_numbers(n * n)),
        draw(numbers),
        draw(numbers),
    )


@st.composite
def states(draw: st.DrawFn) -> messages.NavigationState:
    n = draw(st.integers(0, 5))
    square = np.zeros((n, n))
    for row in range(n):
        for column in range(row + 1):
            square[row, column] = square[column, row] = draw(numbers)
    vectors3 = st.tuples(numbers, numbers, numbers)
    return messages.NavigationState(
        draw(utimes),
        draw(st.sampled_from(messages.Mode)),
        draw(st.sampled_from(messages.Phase)),
        draw(st.booleans()),
        messages.Invalid(draw(st.integers(0, 2047))),
        draw(int32),
        draw(numbers),
        draw(numbers),
        draw(numbers),
        Pose(draw(places), draw(turns)),
        draw(vectors3),
        draw(vectors3),
        draw(st.just(()) | optional_numbers(36)),
        tuple(draw(st.lists(texts, min_size=n, max_size=n))),
        tuple(draw(st.lists(numbers, min_size=n, max_size=n))),
        tuple(square.ravel().tolist()),
    )


edges = st.builds(
    messages.EdgeReport,
    st.sampled_from(KIND_WORDS),
    texts,
    st.booleans(),
    st.tuples(texts, texts),
    st.builds(Pose, places, turns),
    st.sampled_from(PROVENANCE_WORDS),
    int64,
    numbers,
    texts,
    st.lists(numbers, max_size=6).map(tuple),
    numbers,
    numbers,
    texts,
)
failed = reply_headers(st.sampled_from([status for status in Status if status is not Status.OK]))
fine = reply_headers(st.just(Status.OK))
names = st.lists(st.tuples(texts, texts), max_size=4)

VALUES: dict[str, st.SearchStrategy[Any]] = {
    "gps_t": st.builds(
        messages.GpsSample,
        sensor_headers,
        st.sampled_from(messages.FixType),
        *[numbers] * 5,
        st.integers(-(1 << 15), (1 << 15) - 1),
        *[numbers] * 3,
        vectors(9),
        vectors(3),
        vectors(9),
        *[numbers] * 7,
    ),
    "imu_t": st.builds(
        messages.ImuSample,
        sensor_headers,
        vectors(3),
        vectors(3),
        vectors(3),
        vectors(4),
        st.sampled_from(messages.OrientationReference),
        st.sampled_from(messages.YawSource),
        vectors(9),
        vectors(9),
        vectors(9),
        numbers,
    ),
    "wheels_t": st.builds(
        messages.WheelsSample,
        sensor_headers,
        st.lists(
            st.builds(messages.WheelSample, texts, *[numbers] * 4, st.sampled_from(messages.Direction), numbers),
            max_size=6,
        ).map(tuple),
    ),
    "joints_t": st.builds(
        messages.JointsSample,
        sensor_headers,
        st.lists(st.builds(messages.JointSample, texts, *[numbers] * 4), max_size=6).map(tuple),
    ),
    "absolute_pose_t": st.builds(
        messages.AbsolutePoseSample, sensor_headers, frames, frames, st.none() | places, st.none() | turns, covariances
    ),
    "relative_pose_t": relative_poses(),
    "range_t": st.builds(
        messages.RangeSample, sensor_headers, frames, texts, places, frames, st.floats(0.0, 1e9), numbers
    ),
    "measurement_t": measurements(),
    "localization_mode_t": st.builds(messages.SwitchMode, sensor_headers, st.sampled_from(messages.Mode)),
    "decisions_t": st.builds(messages.PublishDecisions, utimes, st.lists(decisions(), max_size=4).map(tuple)),
    "navigation_state_t": states(),
    "get_transformation_request_t": st.builds(
        messages.GetTransformation, request_headers, texts, texts, times, demands
    ),
    "get_body_list_request_t": st.builds(messages.GetBodyList, request_headers),
    "get_body_frame_list_request_t": st.builds(messages.GetBodyFrameList, request_headers, texts),
    "get_state_vector_request_t": st.builds(messages.GetStateVector, request_headers, times, demands),
    "get_h_transform_request_t": st.builds(messages.GetHTransform, request_headers, st.booleans(), times, demands),
    "get_history_request_t": st.builds(messages.GetHistory, request_headers, utimes, utimes, numbers),
    "get_transformation_reply_t": failed.map(messages.TransformReply)
    | st.builds(messages.TransformReply, fine, answers(), unmets, texts),
    "get_state_vector_reply_t": failed.map(messages.StateVectorReply)
    | st.builds(messages.StateVectorReply, fine, answers(), unmets, texts),
    "name_list_reply_t": st.builds(
        lambda header, found: messages.NameListReply(
            header, tuple(name for name, _ in found), tuple(about for _, about in found)
        ),
        fine | failed,
        names,
    ),
    "get_history_reply_t": st.builds(messages.HistoryReply, fine | failed, st.lists(answers(), max_size=3).map(tuple)),
    "get_transformations_request_t": st.builds(
        messages.GetTransformations,
        request_headers,
        st.lists(st.tuples(frames, frames), min_size=1, max_size=4).map(tuple),
        st.lists(utimes, max_size=5).map(tuple),
        frames,
        utimes,
        st.booleans(),
    ),
    "get_transformations_reply_t": failed.map(messages.PoseBatchReply)
    | st.builds(
        messages.PoseBatchReply,
        fine,
        st.just(1),
        st.just(3),
        st.integers(0, 63),
        st.integers(0, 1 << 30),
        st.booleans().map(many_poses),
    ).map(lambda reply: reply._replace(poses=reply.poses._replace(model_revision=reply.header.model_revision))),
    "get_motion_request_t": st.builds(messages.GetMotion, request_headers, frames, frames, frames, times),
    "get_motion_reply_t": failed.map(messages.MotionReply)
    | st.builds(
        messages.MotionReply,
        fine,
        st.builds(messages.MotionAnswer, answers(), texts, *[places] * 4, covariances, covariances),
    ),
    "get_explanation_request_t": st.builds(messages.GetExplanation, request_headers, frames, frames, times),
    "get_explanation_reply_t": failed.map(messages.ExplanationReply)
    | st.builds(
        messages.ExplanationReply,
        fine,
        st.builds(messages.Explanation, answers(), st.lists(edges, max_size=3).map(tuple)),
    ),
    "get_dynamics_request_t": st.builds(
        messages.GetDynamics, request_headers, frames, st.booleans(), st.booleans(), times
    ),
    "get_dynamics_reply_t": failed.map(messages.DynamicsReply)
    | st.builds(
        messages.DynamicsReply,
        fine,
        st.integers(0, 5).flatmap(
            lambda n: st.builds(
                messages.DynamicsAnswer,
                utimes,
                st.just(messages.Invalid.STALE_JOINT),
                frames,
                numbers,
                places,
                st.tuples(*[numbers] * 36),
                st.tuples(*[frames] * n),
                *[st.tuples(*[numbers] * n)] * 4,
                numbers.map(lambda number: (number,) * (n * n)),
            )
        ),
    ),
    "reload_model_request_t": st.builds(messages.ReloadModel, request_headers, st.booleans()),
    "set_frame_request_t": st.builds(
        messages.SetFrame,
        request_headers,
        frames,
        st.builds(Pose, places, turns),
        places,
        places,
        st.sampled_from(messages.Lifetime),
    ),
    "reload_model_reply_t": st.builds(
        messages.ReloadReply, fine | failed, texts, st.lists(texts, max_size=3).map(tuple)
    ),
    "set_state_vector_request_t": st.builds(messages.SetStateVector, request_headers, answers()),
    "set_h_transform_request_t": st.builds(messages.SetHTransform, request_headers, answers()),
    "acknowledgement_t": st.builds(messages.Acknowledgement, fine | failed),
    "signed_t": st.builds(
        messages.Envelope,
        texts,
        texts,
        utimes,
        int64,
        texts,
        st.binary(max_size=4096),
        st.binary(min_size=32, max_size=32),
    ),
    "model_snapshot_t": st.builds(
        messages.SnapshotPart,
        utimes,
        st.text(st.characters(exclude_categories=("Cs",)), max_size=64),
        st.integers(0, 6),
        st.integers(7, 100_000),
        st.binary(max_size=100),
    ),
    "health_t": st.builds(
        messages.Health,
        int64,
        numbers,
        texts,
        texts,
        texts,
        st.integers(0, 2),
        st.integers(0, 2047).map(messages.Invalid),
        int32,
        int64,
        count64,
        count64,
        st.integers(0, (1 << 31) - 1),
        count64,
        count64,
        *[numbers] * 4,
        texts,
        texts,
        int32,
        int32,
        int64,
        numbers,
        st.builds(
            messages.LocalizationHealth,
            st.none() | st.sampled_from(messages.Mode),
            st.none() | st.sampled_from(messages.Phase),
            st.booleans(),
            *[numbers] * 4,
        ),
        st.lists(st.tuples(frames, numbers), max_size=4).flatmap(
            lambda rows: st.builds(
                messages.StabilityHealth,
                *[numbers] * 5,
                st.just(tuple(name for name, _ in rows)),
                st.just(tuple(load for _, load in rows)),
            )
        ),
        st.lists(
            st.builds(messages.ChannelHealth, texts, count64, numbers, numbers, numbers, st.booleans()), max_size=3
        ).map(tuple),
        st.lists(st.builds(messages.RejectedCount, texts, texts, count64), max_size=3).map(tuple),
        st.lists(st.tuples(texts, texts), max_size=3).map(tuple),
    ),
    "vehicle_status_t": st.builds(
        messages.VehicleStatusSample,
        sensor_headers,
        st.sampled_from(messages.VehicleMode),
        *[numbers] * 4,
        int32,
        count64,
    ),
    "vehicle_command_t": st.builds(
        messages.VehicleCommand,
        st.integers(1, MAX_UTIME - 1),
        st.floats(0.0, exclude_min=True, allow_infinity=False),
        int64,
        st.text(st.characters(exclude_categories=("Cs",)), max_size=64),
        st.floats(allow_nan=False, allow_infinity=False),
        st.floats(allow_nan=False, allow_infinity=False),
    ),
    "driver_health_t": st.builds(
        messages.DriverHealth,
        utimes,
        texts,
        texts,
        st.sampled_from(messages.DriverPhase),
        texts,
        texts,
        st.integers(0, (1 << 31) - 1),
        count64,
        count64,
        *[numbers] * 5,
        count64,
        st.lists(st.tuples(texts, count64), max_size=4).map(tuple),
    ),
    "pose_transform_t": answers(),
    "pose_vector_t": answers(),
}

typed_values = st.sampled_from(sorted(VALUES)).flatmap(lambda name: st.tuples(st.just(name), VALUES[name]))


def test_given_the_codec_then_every_type_has_a_strategy() -> None:
    assert sorted(VALUES) == sorted(get_type_names())


@given(typed_values)
def test_given_any_value_when_encoded_and_decoded_then_it_is_the_same(typed: tuple[str, Any]) -> None:
    type_name, value = typed
    assert same(decode(type_name, encode(value, type_name)), value)


@given(typed_values)
def test_given_any_value_when_encoded_then_the_generated_type_reads_and_writes_the_same_bytes(
    typed: tuple[str, Any],
) -> None:
    type_name, value = typed
    data = encode(value, type_name)
    assert getattr(mslcm, type_name).decode(data).encode() == data


@given(st.sampled_from(sorted(VALUES)), st.binary(max_size=600))
def test_given_any_bytes_when_decoded_then_they_are_rejected(type_name: str, data: bytes) -> None:
    with pytest.raises(WireError) as caught:
        decode(type_name, data)
    assert caught.value.reason == "fingerprint"


@given(st.sampled_from(sorted(VALUES)), st.binary(max_size=1500))
def test_given_any_bytes_behind_a_fingerprint_when_decoded_then_only_wire_error_is_raised(
    type_name: str, data: bytes
) -> None:
    _decode_any(type_name, getattr(mslcm, type_name)._get_packed_fingerprint() + data)


@given(typed_values, st.data())
def test_given_a_value_with_bytes_changed_when_decoded_then_only_wire_error_is_raised(
    typed: tuple[str, Any], data: st.DataObject
) -> None:
    type_name, value = typed
    damaged = bytearray(encode(value, type_name))
    for _ in range(data.draw(st.integers(1, 4))):
        place = data.draw(st.integers(8, len(damaged) - 1))
        damaged[place] = data.draw(st.integers(0, 255))
    _decode_any(type_name, bytes(damaged))


def _decode_any(type_name: str, data: bytes) -> None:
    """Decode; an accepted value must be printable and encodable."""
    try:
        value = decode(type_name, data)
    except WireError as error:
        reason = error.reason
    else:
        reason = ""
        assert repr(value)
        assert same(decode(type_name, encode(value, type_name)), value)
    assert reason in ("", "truncated", "malformed")


def test_given_an_example_of_each_type_then_same_distinguishes_it_from_the_others() -> None:
    values = [value for values in EXAMPLES.values() for value in values if not isinstance(value, messages.PoseAnswer)]
    for left in range(len(values)):
        for right in range(len(values)):
            assert same(values[left], values[right]) == (left == right)
    sample = EXAMPLES["gps_t"][1]
    assert not same(sample, dataclasses.replace(sample, course=sample.course + 1e-9))
