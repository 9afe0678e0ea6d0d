"""The codec with example values: round trip, and damaged bytes are rejected with a reason."""

from __future__ import annotations

import dataclasses
import struct
import tracemalloc
from typing import Any

import numpy as np
import pytest
from support_wire import EXAMPLES, same, state

import mslcm
from modelserver.errors import WireError
from modelserver.messages import (
    Decision,
    GetTransformation,
    PoseAnswer,
    PublishDecisions,
    Quality,
    RequestHeader,
    Verdict,
)
from modelserver.transforms.pose import Pose
from modelserver.transforms.transformation import Transformation
from modelserver.wire.codec import decode, encode, get_type_names

CASES = [
    pytest.param(type_name, value, id=f"{type_name}-{number}")
    for type_name, values in EXAMPLES.items()
    for number, value in enumerate(values)
]
TYPES = sorted(EXAMPLES)


def test_given_the_codec_then_every_type_has_examples() -> None:
    assert sorted(get_type_names()) == TYPES


@pytest.mark.parametrize(("type_name", "value"), CASES)
def test_given_a_value_when_encoded_and_decoded_then_it_is_the_same(type_name: str, value: Any) -> None:
    assert same(decode(type_name, encode(value, type_name)), value)


@pytest.mark.parametrize(("type_name", "value"), CASES)
def test_given_a_value_when_encoded_then_the_generated_type_reads_it(type_name: str, value: Any) -> None:
    data = encode(value, type_name)
    assert getattr(mslcm, type_name).decode(data).encode() == data


@pytest.mark.parametrize(("type_name", "value"), CASES)
def test_given_a_message_cut_at_any_length_when_decoded_then_it_is_rejected(type_name: str, value: Any) -> None:
    data = encode(value, type_name)
    for length in range(len(data)):
        with pytest.raises(WireError) as caught:
            decode(type_name, data[:length])
        assert caught.value.reason == ("fingerprint" if length < 8 else "truncated")


@pytest.mark.parametrize(("type_name", "value"), CASES)
def test_given_bytes_after_a_message_when_decoded_then_it_is_rejected(type_name: str, value: Any) -> None:
    for tail in (b"\0", b"x", b"\0" * 100):
        with pytest.raises(WireError) as caught:
            decode(type_name, encode(value, type_name) + tail)
        assert caught.value.reason == "malformed"


@pytest.mark.parametrize("type_name", TYPES)
def test_given_every_other_type_when_decoded_then_the_fingerprint_is_rejected(type_name: str) -> None:
    for other in TYPES:
        if other != type_name:
            with pytest.raises(WireError) as caught:
                decode(type_name, encode(EXAMPLES[other][-1], other))
            assert caught.value.reason == "fingerprint"


@pytest.mark.slow
@pytest.mark.parametrize(("type_name", "value"), CASES)
def test_given_any_bit_flipped_when_decoded_then_nothing_but_wire_error_is_raised(type_name: str, value: Any) -> None:
    data = encode(value, type_name)
    for place in range(0, len(data), _step(data)):
        for bit in (0, 6, 7):
            damaged = bytearray(data)
            damaged[place] ^= 1 << bit
            _decode_any(type_name, bytes(damaged))


@pytest.mark.slow
@pytest.mark.parametrize(("type_name", "value"), CASES)
def test_given_a_huge_count_anywhere_when_decoded_then_little_memory_is_used(type_name: str, value: Any) -> None:
    data = encode(value, type_name)
    tracemalloc.start()
    try:
        for number, place in enumerate(range(8, len(data) - 3, _step(data))):
            # both at each place of a short message, in turn in a long one
            for count in COUNTS if _step(data) == 1 else COUNTS[number % 2 :][:1]:
                _decode_any(type_name, data[:place] + struct.pack(">I", count) + data[place + 4 :])
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 4 << 20


COUNTS = (0x7FFFFFFF, 0xFFFFFFFF)


def _step(data: bytes) -> int:
    """Every byte of a short message; every fifth of a long one, which is mostly numbers, reaches all alignments."""
    return 1 if len(data) < 400 else 5


def _decode_any(type_name: str, data: bytes) -> None:
    """Decode bytes that may be no message, and evaluate every field of the result."""
    try:
        value = decode(type_name, data)
    except WireError as error:
        value = error.reason
    assert repr(value)
    assert not isinstance(value, str) or value in ("fingerprint", "truncated", "malformed")


# --- single rules -------------------------------------------------------------------------------------------


def _message(type_name: str, **fields: Any) -> bytes:
    """Return the bytes of a full example with some fields of the wire type changed; `a__b` reaches inside."""
    message = getattr(mslcm, type_name).decode(encode(EXAMPLES[type_name][-1], type_name))
    for path, value in fields.items():
        *outer, name = path.split("__")
        target = message
        for step in outer:
            target = getattr(target, step)
        setattr(target, name, value)
    return bytes(message.encode())


@pytest.mark.parametrize(
    ("type_name", "fields"),
    [
        ("gps_t", {"fix_type": 99}),
        ("gps_t", {"header__utime": 0}),
        ("gps_t", {"header__utime": -1}),
        ("gps_t", {"header__utime": 1 << 62}),
        ("gps_t", {"header__host_utime": -5}),
        ("gps_t", {"header__source": "s" * 65}),
        ("imu_t", {"orientation_reference": 3}),
        ("imu_t", {"yaw_source": -1}),
        ("wheels_t", {"direction": [4, 0]}),
        ("absolute_pose_t", {"orientation": [1.0, 0.0, 0.0, 0.1]}),
        ("absolute_pose_t", {"position": [0.0, 0.0, float("inf")]}),
        ("absolute_pose_t", {"covariance": [1.0] * 35 + [float("nan")]}),
        ("absolute_pose_t", {"frame_of_interest": "A:" + "b" * 400}),
        ("relative_pose_t", {"since_utime": 0}),
        ("relative_pose_t", {"since_utime": 1 << 61}),
        ("relative_pose_t", {"position": [float("nan")] * 3}),
        ("relative_pose_t", {"orientation": [float("nan")] * 4}),
        ("relative_pose_t", {"orientation": [0.0] * 4}),
        ("range_t", {"distance": -0.5}),
        ("range_t", {"distance": float("nan")}),
        ("range_t", {"distance": float("inf")}),
        ("range_t", {"beacon_position": [0.0, float("nan"), 0.0]}),
        ("range_t", {"beacon": "b" * 65}),
        ("range_t", {"header__utime": 0}),
        ("vehicle_status_t", {"mode": 5}),
        ("vehicle_status_t", {"commands_rejected": -1}),
        ("vehicle_status_t", {"header__utime": 0}),
        ("vehicle_command_t", {"utime": 0}),
        ("vehicle_command_t", {"valid_for": 0.0}),
        ("vehicle_command_t", {"valid_for": float("inf")}),
        ("vehicle_command_t", {"forward_speed": float("nan")}),
        ("vehicle_command_t", {"steering_angle": float("inf")}),
        ("vehicle_command_t", {"source": "s" * 65}),
        ("localization_mode_t", {"mode": 6}),
        ("localization_mode_t", {"mode": -1}),
        ("localization_mode_t", {"header__source": "s" * 65}),
        ("decisions_t", {"utime": -1}),
        ("decisions_t", {"count": -1, "decisions": []}),
        ("decisions_t", {"count": 1025, "decisions": [mslcm.decision_t()] * 1025}),
        ("navigation_state_t", {"mode": 17}),
        ("navigation_state_t", {"phase": 3}),
        ("navigation_state_t", {"utime": -1}),
        ("navigation_state_t", {"orientation": [0.0] * 4}),
        ("navigation_state_t", {"position": [float("nan")] * 3}),
        ("navigation_state_t", {"num_covariance": 5, "covariance": [0.0] * 5}),
        ("navigation_state_t", {"names": ["a", "b", "c" * 65]}),
        ("navigation_state_t", {"n": 65, "names": [""] * 65, "values": [0.0] * 65}),
        ("get_transformation_request_t", {"time__policy": 4}),
        ("get_transformation_request_t", {"time__wait_ms": -1}),
        ("get_transformation_request_t", {"time__at": -1}),
        ("get_transformation_request_t", {"demand__max_horizontal": -0.1}),
        ("get_transformation_request_t", {"demand__max_horizontal": 1e200}),
        ("get_transformation_request_t", {"demand__max_heading": 5.0}),
        ("get_h_transform_request_t", {"demand__max_age": float("nan")}),
        ("get_state_vector_request_t", {"demand__max_age": float("inf")}),
        ("get_state_vector_request_t", {"demand__min_integrity": 1.0}),
        ("get_history_request_t", {"start_utime": -1}),
        ("get_history_request_t", {"end_utime": 1 << 62}),
        ("get_transformation_reply_t", {"transform__h_transform": [[0.0] * 4] * 4}),
        ("pose_transform_t", {"h_transform": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 2.0]]}),
        ("pose_transform_t", {"h_transform": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]]}),
        ("pose_transform_t", {"h_transform": [[1, 0, 0, float("inf")], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}),
        ("pose_transform_t", {"h_transform": [[1e308, 0, 0, 0], [0, 1e308, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}),
        ("pose_vector_t", {"vec": [0.0] * 7}),
        ("pose_vector_t", {"vec": [float("nan")] * 7}),
        ("pose_vector_t", {"vec": [0.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0]}),
    ],
)
def test_given_a_number_that_cannot_be_when_decoded_then_it_is_malformed(
    type_name: str, fields: dict[str, Any]
) -> None:
    with pytest.raises(WireError) as caught:
        decode(type_name, _message(type_name, **fields))
    assert caught.value.reason == "malformed"


@pytest.mark.parametrize(
    ("type_name", "fields"),
    [
        ("health_t", {"num_channels": -1, "channels": []}),
        ("health_t", {"num_rejected": -1, "rejected": []}),
        ("name_list_reply_t", {"num_names": -1, "names": [], "descriptions": []}),
        ("name_list_reply_t", {"header__num_nearest": -1, "header__nearest": []}),
    ],
)
def test_given_a_negative_count_when_decoded_then_it_is_malformed(type_name: str, fields: dict[str, Any]) -> None:
    with pytest.raises(WireError) as caught:
        decode(type_name, _message(type_name, **fields))
    assert caught.value.reason == "malformed"


def test_given_flags_of_a_later_version_when_decoded_then_they_are_preserved() -> None:
    value = decode("pose_transform_t", _message("pose_transform_t", invalid_reasons=1 << 20 | 1, quality_flags=1 << 21))
    assert value.transformation.invalid_reasons == 1 << 20 | 1
    assert value.quality == 1 << 21


def test_given_one_relation_in_two_answers_when_encoded_then_each_keeps_its_own_fields() -> None:
    relation = Transformation("Camera:Image", "Raptor:CG", Pose(), model_revision="ab12")
    for answer in (PoseAnswer(relation), PoseAnswer(relation, None, Quality.HELD, 1.5), PoseAnswer(relation)):
        assert same(decode("pose_transform_t", encode(answer)), answer)


def test_given_a_flood_of_long_frame_names_when_decoded_then_they_are_not_cached() -> None:
    header = RequestHeader(1, "REPLY_TEST")
    tracemalloc.start()
    try:
        for number in range(200):
            request = GetTransformation(header, f"{number}:{'x' * 60_000}", "Raptor:CG")
            assert decode("get_transformation_request_t", encode(request)) == request
        held, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert held < 2 << 20


def test_given_text_that_is_not_utf8_when_decoded_then_nothing_breaks() -> None:
    data = encode(EXAMPLES["get_body_frame_list_request_t"][0]).replace(b"Raptor", b"R\xff\xfeptor"[:6])
    assert decode("get_body_frame_list_request_t", data).body == "R��pto"


@pytest.mark.parametrize(
    "changed",
    [{"verdict": 4}, {"kind": "k" * 65}, {"source": "s" * 65}, {"reason": "r" * 65}, {"utime": -5},
     {"num": 65, "residual": [0.0] * 65, "innovation_covariance": [[0.0] * 65] * 65, "noise": [[0.0] * 65] * 65}],
)  # fmt: skip
def test_given_one_decision_that_cannot_be_when_decoded_then_the_message_is_malformed(changed: dict[str, Any]) -> None:
    decision = mslcm.decision_t()
    for name, value in changed.items():
        setattr(decision, name, value)
    with pytest.raises(WireError) as caught:
        decode("decisions_t", _message("decisions_t", count=1, decisions=[decision]))
    assert caught.value.reason == "malformed"


def test_given_as_much_as_fits_when_encoded_then_it_survives() -> None:
    one = Decision(5, "gps", 1, "k" * 64, Verdict.USED, "", (0.0,) * 64, (1.0,) * 4096, (2.0,) * 4096)
    for value in (PublishDecisions(5, (one,)), PublishDecisions(5, (Decision(5, "", 1, "", Verdict.USED),) * 1024)):
        assert same(decode("decisions_t", encode(value)), value)
    assert same(decode("navigation_state_t", encode(state(64))), state(64))


def test_given_more_than_fits_when_encoded_then_it_is_rejected_before_sending() -> None:
    one = Decision(5, "gps", 1, "speed", Verdict.USED)
    for value in (
        PublishDecisions(5, (one,) * 1025),
        PublishDecisions(5, (one._replace(residual=(1.0, 2.0), noise=(1.0,)),)),
        state(65),
        dataclasses.replace(state(), values=(1.0,)),
        dataclasses.replace(state(), covariance=()),
    ):
        with pytest.raises(ValueError, match=r"expected|at most|inconsistent"):
            encode(value)


def test_given_a_covariance_when_packed_then_the_wire_has_the_lower_triangle_row_by_row() -> None:
    message = mslcm.navigation_state_t.decode(encode(state()))
    error = np.arange(1.0, 10.0).reshape(3, 3)
    assert list(message.covariance) == (error @ error.T)[np.tril_indices(3)].tolist()
