"""VectorNav and Xsens units: frames of the makers' documents, setup, samples, and what goes wrong on a line."""

from __future__ import annotations

import itertools
import math
import random
from collections.abc import Callable, Iterator
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support_gps import START, Line, add_noise, split_in_half, split_randomly

from modelserver.messages import ImuSample, OrientationReference, SensorHeader, YawSource
from modelserver.transforms import so3
from msdrivers.devices import vectornav as vn
from msdrivers.devices import xsens
from msdrivers.devices.stream import FrameScanner, StreamDriver, recognize
from msdrivers.devices.vectornav import (
    VectornavDriver,
    VectornavSettings,
    VnBinary,
    VnBinaryFormat,
    VnText,
    VnTextFormat,
)
from msdrivers.devices.xsens import ItemId, MtData, SampleTimeUnwrapper, XbusFormat, XsensDriver, XsensSettings
from msdrivers.emulate import FaultInjector, parse_fault
from msdrivers.emulate.imu import VectornavEmulator, XsensEmulator
from msdrivers.endpoint import Endpoint, EndpointPhase


def turn(seconds: float, rate_hz: float = 200.0) -> Iterator[ImuSample]:
    """A unit that turns, as it would measure itself."""
    for n in range(round(seconds * rate_hz)):
        t = n / rate_hz
        yield ImuSample(
            SensorHeader(START + round(t * 1e6), "truth", n),
            angular_velocity=(0.1, -0.2, 0.3 * math.sin(t)),
            specific_force=(0.5, -0.25, 9.75),
            magnetic_field=(1.5e-5, -0.5e-5, 4.5e-5),
            orientation=so3.exponential((0.0, 0.1, 0.3 * t)),
        )


def connect_vectornav(seconds: float = 20.0, error: int = 0, **more: object) -> Line:
    device = VectornavEmulator(turn(seconds), error)
    return Line(VectornavDriver(VectornavSettings("imu")), device, **more)  # type: ignore[arg-type]


def connect_xsens(seconds: float = 20.0, error: int = 0, has_orientation: bool = True, **more: object) -> Line:
    device = XsensEmulator(turn(seconds), error, has_orientation)
    return Line(XsensDriver(XsensSettings("imu", field_strength=5e-5)), device, **more)  # type: ignore[arg-type]


CONNECT: list[Callable[..., Line]] = [connect_vectornav, connect_xsens]
both = pytest.mark.parametrize("connect", CONNECT, ids=["vectornav", "xsens"])

# --- frames of the documents ----------------------------------------------------------------------------------

VN_FRAMES = {
    "FA010800 93502E42 833EF13F 48B504BB 9288": {(1, 3): (43.578686, 1.8847202, -0.0020249654)},
    "FA0508001000 A4150242 4DDFEB3F F61A36BE BF2DA441 AF1A": {
        (1, 3): (32.521133, 1.8427521, -0.17783722), (3, 4): (20.522337,),
    },
    "FA0501101C00 00CA9A3B00000000 0000 00000000 00000000 0AE81CC1 0AD7233C 0AD7A3BC 8FC2F53C 0000C841 EEA4": {
        vn.ACCELERATION: (0.0, 0.0, -9.80665), vn.RATE: (0.01, -0.02, 0.03), vn.TEMPERATURE: (25.0,),
    },
}  # fmt: skip
"""VN-100 user manual UM001, and one computed by its tables."""


@pytest.mark.parametrize("frame", VN_FRAMES)
def test_given_a_binary_message_of_the_manual_then_its_fields_are_read_and_encoded(frame: str) -> None:
    data = bytes.fromhex(frame)
    (message,) = FrameScanner((VnBinaryFormat(), VnTextFormat())).feed(data)
    assert isinstance(message, VnBinary)
    for key, values in VN_FRAMES[frame].items():
        assert message.get_floats(key) == pytest.approx(values, rel=1e-6)
    assert vn.encode_binary(message.fields) == data


def test_given_text_of_a_unit_then_it_is_read_and_encoded() -> None:
    line = (
        b"$VNYMR,+100.949,-007.330,+000.715,-00.0049,-00.2449,+00.5397,-01.258,-00.100,-09.701,"
        b"-00.000018,+00.001122,-00.000551*69\r\n"
    )
    (message,) = FrameScanner((VnBinaryFormat(), VnTextFormat())).feed(line)
    assert isinstance(message, VnText)
    assert message.words[:2] == ("YMR", "+100.949")
    assert vn.encode_text("WRG,75,1,8,05,1001,073E") == b"$VNWRG,75,1,8,05,1001,073E*25\r\n"
    assert FrameScanner((VnBinaryFormat(), VnTextFormat())).feed(line.replace(b"*69", b"*68")) == []


XSENS_FRAMES = {
    "FAFF3631102002DFC510600400459DA040200CBEDC9AFA3F549F37411CBB7080200CBBAA5C803B8C5501BB813300E020040000008145": (
        57285, 4562336, (-0.43087, 0.830554, 9.79576), (-0.00519902, 0.00428259, -0.00394285), None,
    ),
    "FAFF3644102002E68610600400575126201010"
    "3F7F1DDEBDA63508BC8E1BCD3AB3C08840200C3EB6FC53BFC6F4B94117269180200CBBB384003C1FC8BDBA8DE78CE0200400000001"
    "7A": (59014, 5722406, (0.357394, -1.55434, 9.44692), None, (0.996549, -0.0811558, -0.0173472, 0.0013714)),
}  # fmt: skip
"""MT0101P, and a public recording."""


@pytest.mark.parametrize("frame", XSENS_FRAMES)
def test_given_a_packet_then_its_items_are_read(frame: str) -> None:
    counter, ticks, force, rate, orientation = XSENS_FRAMES[frame]
    (message,) = FrameScanner((XbusFormat(),)).feed(bytes.fromhex(frame))
    data = MtData.parse(message.data)
    assert data.get_integer(ItemId.PACKET_COUNTER) == counter
    assert data.get_integer(ItemId.SAMPLE_TIME_FINE) == ticks
    assert data.get_numbers(ItemId.ACCELERATION, 3) == pytest.approx(force, rel=1e-5)
    if rate is not None:
        assert data.get_numbers(ItemId.RATE_OF_TURN, 3) == pytest.approx(rate, rel=1e-5)
    if orientation is not None:
        assert data.get_numbers(ItemId.QUATERNION, 4) == pytest.approx(orientation, rel=1e-5)


def test_given_the_setup_of_the_document_then_it_is_encoded_alike() -> None:
    outputs = "1020FFFF1060FFFF4020006480200064C02000642010006408100001E020FFFF"
    expected = bytes.fromhex(f"FAFFC020{outputs}CE")
    assert xsens.encode(xsens.MessageId.SET_OUTPUT, bytes.fromhex(outputs)) == expected
    assert xsens.encode(xsens.MessageId.GO_TO_CONFIG) == bytes.fromhex("FAFF3000D1")


# --- drivers --------------------------------------------------------------------------------------------------


@both
def test_given_a_unit_when_set_up_then_each_sample_is_published_as_it_was_measured(
    connect: Callable[..., Line],
) -> None:
    line = connect().open().run(15.0)
    assert line.phases[-1] is EndpointPhase.STREAMING
    assert len(line.samples) > 1400
    truth = {round((each.header.utime - START) / 5000): each for each in turn(20.0)}
    first = line.samples[0].header
    shift = first.host_utime - first.device_utime
    for sample in line.samples[:: len(line.samples) // 50]:
        assert isinstance(sample, ImuSample)
        # the unit's clock runs as ours
        assert sample.header.device_utime + shift == pytest.approx(sample.header.host_utime, abs=200)
        same = truth[round((sample.header.host_utime - START) / 5000)]
        assert sample.angular_velocity == pytest.approx(same.angular_velocity, rel=1e-6)
        assert sample.specific_force == pytest.approx(same.specific_force, rel=1e-6)
        assert sample.magnetic_field == pytest.approx(same.magnetic_field, rel=1e-6)
        assert sample.orientation == pytest.approx(same.orientation, abs=1e-6)
        assert sample.yaw_source is YawSource.MAGNETIC
    rate = (len(line.samples) - 1) / ((line.samples[-1].header.host_utime - first.host_utime) * 1e-6)
    assert rate == pytest.approx(100.0, rel=0.01)
    assert line.driver.counts.get("lost", 0) == 0
    assert line.samples[-1].temperature_celsius in (31.5, 28.0)


def test_given_each_unit_then_the_axes_of_its_reference_are_named() -> None:
    for connect, reference in zip(CONNECT, (OrientationReference.NED, OrientationReference.ENU), strict=True):
        (found,) = {each.orientation_reference for each in connect().open().run(5.0).samples}
        assert found is reference


@pytest.mark.slow
@both
@pytest.mark.parametrize("to_host", [split_in_half, add_noise(3, 8), lambda data: split_randomly(data, len(data))])
def test_given_split_or_noisy_bytes_then_nearly_every_sample_is_published(
    connect: Callable[..., Line], to_host: object
) -> None:
    line = connect(to_host=to_host).open().run(15.0)
    assert len(line.samples) > 0.7 * 1400
    stamps = [each.header.device_utime for each in line.samples]
    assert stamps == sorted(set(stamps))


@both
def test_given_another_baud_rate_then_it_is_found(connect: Callable[..., Line]) -> None:
    line = connect(device_baud=460800, baud=115200).open().run(15.0)
    assert [each.baud for each in line.reopens] == [921600, 460800]
    assert line.phases[-1] is EndpointPhase.STREAMING


@pytest.mark.slow
@both
def test_given_an_unplugged_unit_when_it_is_back_then_samples_are_published_again(connect: Callable[..., Line]) -> None:
    line = connect(seconds=60.0).open().run(5.0)
    line.is_broken = True
    line.run(20.0)
    before = len(line.samples)
    assert "answers on this line: at " in line.status_text
    assert "received nothing: check power, cable and port" in line.status_text
    line.is_broken, line.device_baud = False, line.baud
    line.run(20.0)
    assert len(line.samples) > before + 800


@pytest.mark.slow
@both
def test_given_a_restarted_unit_then_it_is_set_up_again(connect: Callable[..., Line]) -> None:
    line = connect(device_baud=115200, baud=115200)
    maker = VectornavEmulator if connect is connect_vectornav else XsensEmulator
    samples = turn(40.0)
    line.device = FaultInjector(lambda: maker(samples), (parse_fault("restart@6:2"),))  # type: ignore[arg-type]
    line.open().run(25.0)
    late = [each for each in line.samples if each.header.host_utime > START + 15_000_000]
    assert len(late) > 900
    assert "setting the device up again" in line.status_text


def test_given_too_much_for_the_baud_rate_then_the_error_of_the_unit_is_reported_with_what_to_do() -> None:
    line = connect_vectornav(error=0x0C).open().run(5.0)
    assert "rejected 100 Hz binary output: error 0C, the baud rate is too low for this output" in line.status_text
    line = connect_xsens(error=0x29).open().run(5.0)
    assert "rejected 100 Hz of acceleration and rate of turn: error 29, the data exceed the baud rate" in (
        line.status_text
    )


def test_given_an_mti_without_orientation_then_the_rest_is_published() -> None:
    line = connect_xsens(has_orientation=False).open().run(10.0)
    assert len(line.samples) > 900
    assert all(each.orientation is None for each in line.samples)
    assert line.driver.counts["optional_rejected"] == 1
    assert not any(each.is_warning for each in line.statuses)


def test_given_a_lost_packet_then_it_is_counted() -> None:
    for connect in CONNECT:
        chance = random.Random(5)
        lost: list[bytes] = []

        def drop(data: bytes, lost: list[bytes] = lost, chance: random.Random = chance) -> list[bytes]:
            if len(data) < 40 or chance.random() > 0.02:
                return [data]
            lost.append(data)
            return []

        line = connect()
        line.open().run(3.0)
        line.to_host = drop
        line.run(10.0)
        line.to_host = lambda data: [data]
        line.run(1.0)
        assert line.driver.counts["lost"] == len(lost) > 5


def test_given_numbers_that_cannot_be_then_the_vector_is_left_out() -> None:
    for connect in CONNECT:
        line = connect()
        line.device = type(line.device)(  # type: ignore[call-arg]
            replace(each, angular_velocity=(math.inf, 0.0, 0.0)) if n % 10 == 0 else each
            for n, each in enumerate(turn(6.0))
        )
        line.open().run(5.0)
        assert any(each.angular_velocity is None for each in line.samples) or connect is connect_vectornav
        assert all(
            each.angular_velocity is None or all(map(math.isfinite, each.angular_velocity)) for each in line.samples
        )


def test_given_a_time_that_wraps_then_it_goes_on() -> None:
    for wrap in (xsens.DAY_TICKS, 1 << 32):
        unwrapper = SampleTimeUnwrapper()
        found = [unwrapper.unwrap(each % wrap) for each in range(wrap - 500, wrap + 500, 100)]
        assert [b - a for a, b in itertools.pairwise(found)] == [100] * 9
    unwrapper = SampleTimeUnwrapper()
    assert [unwrapper.unwrap(each) for each in (400_000_000, 100, 200)] == [400_000_000, 100, 200]


@both
@given(data=st.binary(max_size=400), seed=st.integers(0, 1000))
def test_given_any_bytes_then_nothing_is_raised_and_memory_is_bounded(
    connect: Callable[..., Line], data: bytes, seed: int
) -> None:
    line = connect(0.1).open()
    for piece in split_randomly(data, seed):
        line.deliver(piece)
    assert isinstance(line.driver, StreamDriver)
    assert line.driver._stream.pending_bytes <= 400


def test_given_its_bytes_then_the_device_is_recognized() -> None:
    line = connect_xsens()
    received = bytearray()
    line.to_host = lambda data: [data, received.extend(data) or b""]  # type: ignore[func-returns-value]
    line.open().run(6.0)
    for data, device in ((bytes(received[-4096:]), "xsens"), (vn.encode_text("YMR,+1.0,-2.0") * 3, "vectornav")):
        found = recognize(data)
        assert found is not None
        assert found.device == device


def test_given_an_endpoint_then_the_drivers_are_some() -> None:
    drivers: list[Endpoint[bytes]] = [VectornavDriver(VectornavSettings("a")), XsensDriver(XsensSettings("b"))]
    assert all(driver.get_deadline() == 0 for driver in drivers)
