"""Restamping of recorded messages."""

from __future__ import annotations

from dataclasses import replace

import pytest
from support_wire import EXAMPLES

from modelserver.messages import GetBodyList, RelativePoseSample, RequestHeader
from modelserver.wire.codec import decode, encode, is_of_service, is_stamped, restamp


@pytest.mark.parametrize(
    "type_name",
    [
        "gps_t",
        "imu_t",
        "wheels_t",
        "joints_t",
        "absolute_pose_t",
        "relative_pose_t",
        "range_t",
        "measurement_t",
        "localization_mode_t",
    ],
)
def test_given_a_sample_then_only_its_two_stamps_move(type_name: str) -> None:
    for sample in EXAMPLES[type_name]:
        header = sample.header
        host = header.host_utime + 5_000 if header.host_utime else 0
        wanted = replace(sample, header=replace(header, utime=header.utime + 5_000, host_utime=host))
        if isinstance(wanted, RelativePoseSample):
            wanted = replace(wanted, since_utime=wanted.since_utime + 5_000)
        assert restamp(encode(sample), 5_000) == encode(wanted)
        assert decode(type_name, restamp(encode(sample), 5_000)).header.utime == header.utime + 5_000


@pytest.mark.parametrize("data", [b"", b"x" * 40, encode(GetBodyList(RequestHeader(1, "REPLY_X")))])
def test_given_what_is_no_sample_then_it_is_unchanged(data: bytes) -> None:
    assert restamp(data, 5_000) == data


def test_given_a_cut_sample_then_it_is_unchanged() -> None:
    for type_name in ("gps_t", "relative_pose_t"):
        whole = encode(EXAMPLES[type_name][0])
        for length in (*range(20), 40, 50, 60) if type_name == "relative_pose_t" else range(20):
            assert restamp(whole[:length], 5_000) == whole[:length]


def test_given_stamps_that_would_leave_64_bits_then_the_message_is_unchanged() -> None:
    data = encode(EXAMPLES["gps_t"][0])
    for shift in (1 << 63, -(1 << 64)):
        assert restamp(data, shift) == data


def test_given_a_recording_then_commands_and_samples_are_inputs_and_the_rest_is_of_the_service() -> None:
    inputs = {type_name for type_name, values in EXAMPLES.items() if not is_of_service(encode(values[0], type_name))}
    assert inputs == {
        "gps_t", "imu_t", "wheels_t", "joints_t", "absolute_pose_t", "relative_pose_t", "range_t", "measurement_t",
        "localization_mode_t", "vehicle_status_t", "vehicle_command_t",
    }  # fmt: skip
    # A command keeps its instant, so that an old one has expired for every receiver: no recording drives a vehicle.
    stamped = {name for name, values in EXAMPLES.items() if is_stamped(encode(values[0], name))}
    assert stamped == inputs - {"vehicle_command_t"}
