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
from msdrivers.publishing import Publisher
from msdrivers.registry import CHANNELS

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
    Publisher(lambda channel, data: sent.append((channel, data)), {}).sample(sample)
    ((channel, data),) = sent
    assert channel == CHANNELS[type(sample)]
    assert decode(type_name, data).header == HEADER


def test_given_channels_and_a_prefix_then_samples_and_reports_have_them() -> None:
    sent: list[str] = []
    publisher = Publisher(lambda channel, data: sent.append(channel), {GpsSample: "ROOF_GPS", ImuSample: ""}, "raptor/")
    publisher.sample(GpsSample(HEADER, FixType.FIX_3D, 50.0, -111.0))
    publisher.sample(ImuSample(HEADER))
    publisher.health(DriverHealth(1, "some", "gx1", DriverPhase.STREAMING))
    assert sent == ["raptor/ROOF_GPS", "raptor/IMU", "raptor/DRIVER_HEALTH"]


def test_given_a_report_then_it_goes_out_whole() -> None:
    sent: list[bytes] = []
    health = DriverHealth(5, "imu", "gx1", DriverPhase.SILENT, text="nothing heard", samples=3, counters=(("a", 1),))
    Publisher(lambda channel, data: sent.append(data), {}).health(health)
    heard = decode("driver_health_t", sent[0])
    assert (heard.source, heard.phase, heard.text, heard.samples) == ("imu", DriverPhase.SILENT, "nothing heard", 3)
    assert heard.counters == (("a", 1),)
