"""Ingress: the configured latency is subtracted from stamps."""

from __future__ import annotations

from dataclasses import replace

import pytest
from support_wire import EXAMPLES, UTIME, same

from modelserver.errors import WireError
from modelserver.messages import RelativePoseSample
from modelserver.server.ingress import SensorChannel, subtract_latency
from modelserver.wire.codec import encode

TYPES = ["gps_t", "imu_t", "wheels_t", "absolute_pose_t", "relative_pose_t", "range_t"]


@pytest.mark.parametrize("type_name", TYPES)
def test_given_a_latency_then_the_measurement_times_are_earlier_and_nothing_else(type_name: str) -> None:
    for sample in EXAMPLES[type_name]:
        wanted = replace(sample, header=replace(sample.header, utime=UTIME - 80_000))
        if isinstance(sample, RelativePoseSample):
            wanted = replace(wanted, since_utime=max(1, sample.since_utime - 80_000))
        assert same(SensorChannel(type_name, 80_000).decode(encode(sample)), wanted)
        assert same(SensorChannel(type_name).decode(encode(sample)), sample)


def test_given_a_stamp_shortly_after_1970_then_it_stays_a_time() -> None:
    sample = EXAMPLES["gps_t"][0]
    assert subtract_latency(replace(sample, header=replace(sample.header, utime=5)), 80_000).header.utime == 1


def test_given_another_type_then_it_is_rejected() -> None:
    with pytest.raises(WireError) as caught:
        SensorChannel("imu_t", 80_000).decode(encode(EXAMPLES["gps_t"][0]))
    assert caught.value.reason == "fingerprint"
