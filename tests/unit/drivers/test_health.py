"""Which sample goes out on which channel."""

from __future__ import annotations

import pytest

from modelserver.messages import (
    DriverHealth,
    DriverPhase,
    FixType,
    GpsSample,
    ImuSample,
    JointsSample,
    Sample,
    SensorHeader,
    VehicleMode,
    VehicleStatusSample,
    WheelSample,
    WheelsSample,
)
from modelserver.wire.codec import decode
from msdrivers.registry import CHANNELS
from msdrivers.runner import DriverPublisher

HEADER = SensorHeader(1_700_000_000_000_000, "some", 7, 1_700_000_000_000_100, utime_sigma=0.001)

SAMPLES: list[tuple[Sample, str]] = [
    (GpsSample(HEADER, FixType.FIX_3D, 50.0, -111.0), "gps_t"),
    (ImuSample(HEADER), "imu_t"),
    (WheelsSample(HEADER, (WheelSample("left", 1.0, 0.1, 0.5, 0.1),)), "wheels_t"),
    (JointsSample(HEADER, ()), "joints_t"),
    (VehicleStatusSample(HEADER, VehicleMode.MANUAL), "vehicle_status_t"),
]


@pytest.mark.parametrize(("sample", "type_name"), SAMPLES)
def test_given_no_channel_then_a_sample_goes_out_whole_on_the_customary_one(sample: Sample, type_name: str) -> None:
    sent: list[tuple[str, bytes]] = []
    DriverPublisher(lambda channel, data: sent.append((channel, data)), {}).publish_sample(sample)
    ((channel, data),) = sent
    assert channel == CHANNELS[type(sample)]
    assert decode(type_name, data).header == HEADER


def test_given_channels_and_a_prefix_then_samples_and_reports_have_them() -> None:
    sent: list[str] = []
    publisher = DriverPublisher(
        lambda channel, data: sent.append(channel), {GpsSample: "ROOF_GPS", ImuSample: ""}, "raptor/"
    )
    publisher.publish_sample(GpsSample(HEADER, FixType.FIX_3D, 50.0, -111.0))
    publisher.publish_sample(ImuSample(HEADER))
    publisher.publish_health(DriverHealth(1, "some", "gx1", DriverPhase.STREAMING))
    assert sent == ["raptor/ROOF_GPS", "raptor/IMU", "raptor/DRIVER_HEALTH"]


def test_given_a_report_then_it_goes_out_whole() -> None:
    sent: list[bytes] = []
    health = DriverHealth(5, "imu", "gx1", DriverPhase.SILENT, text="nothing received", samples=3, counters=(("a", 1),))
    DriverPublisher(lambda channel, data: sent.append(data), {}).publish_health(health)
    received = decode("driver_health_t", sent[0])
    assert (received.source, received.phase, received.text, received.samples) == (
        "imu",
        DriverPhase.SILENT,
        "nothing received",
        3,
    )
    assert received.counters == (("a", 1),)
