"""Moving the stamps of a recording."""

from __future__ import annotations

from dataclasses import replace

import pytest

from modelserver.messages import GetBodyList, GpsSample, ImuSample, RequestHeader, WheelsSample
from modelserver.wire.codec import decode, encode
from modelserver.wire.restamp import restamped
from tests.support_wire import EXAMPLES


@pytest.mark.parametrize("type_name", ["gps_t", "imu_t", "wheels_t", "joints_t"])
def test_given_a_sample_then_only_its_two_stamps_move(type_name: str) -> None:
    for sample in EXAMPLES[type_name]:
        assert isinstance(sample, GpsSample | ImuSample | WheelsSample) or type_name == "joints_t"
        header = sample.header
        host = header.host_utime + 5_000 if header.host_utime else 0
        wanted = replace(sample, header=replace(header, utime=header.utime + 5_000, host_utime=host))
        assert restamped(encode(sample), 5_000) == encode(wanted)
        assert decode(type_name, restamped(encode(sample), 5_000)).header.utime == header.utime + 5_000


@pytest.mark.parametrize("data", [b"", b"x" * 40, encode(GetBodyList(RequestHeader(1, "REPLY_X")))])
def test_given_what_is_no_sample_then_it_comes_back_unchanged(data: bytes) -> None:
    assert restamped(data, 5_000) == data


def test_given_a_cut_sample_then_it_comes_back_unchanged() -> None:
    data = encode(EXAMPLES["gps_t"][0])[:20]
    assert restamped(data, 5_000) == data
