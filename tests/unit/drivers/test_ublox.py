"""u-blox receivers: frames, setup of both generations, epochs, and what another device on the line is."""

from __future__ import annotations

import math
import random
import struct
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyubx2 import GET, UBXMessage, calc_checksum
from support_gps import SECOND, START, Line, add_noise, drive, split_in_half, split_randomly

from modelserver.messages import FixType, GpsSample
from msdrivers.devices.gps.driver import GpsDriver, GpsSettings
from msdrivers.devices.stream import FrameScanner, recognize, recognize_line
from msdrivers.devices.ublox import UbloxDriver, UbloxSettings, UbxFormat
from msdrivers.emulate import FaultInjector, parse_fault
from msdrivers.emulate.gps import ORDER, GpsEmulator, GpsUnit, UbloxEmulator, UbloxUnit, encode_ubx
from msdrivers.endpoint import EndpointPhase

GENERATION_9 = UbloxUnit()
GENERATION_8 = UbloxUnit(18.0, "NEO-M8N", frozenset({"NAV-COV", "NAV-RELPOSNED", "RXM-RTCM"}))
ALL = replace(next(iter(drive(1.0))), velocity_covariance=(0.01, 0.001, 0.0, 0.001, 0.02, 0.0, 0.0, 0.0, 0.04))


def connect(unit: UbloxUnit = GENERATION_9, seconds: float = 20.0, rate_hz: float = 10.0, **more: object) -> Line:
    emulator = UbloxEmulator(drive(seconds), unit)
    return Line(UbloxDriver(UbloxSettings("gps", rate_hz=rate_hz)), emulator, **more)  # type: ignore[arg-type]


@pytest.mark.parametrize("unit", [GENERATION_9, GENERATION_8], ids=lambda unit: unit.product)
def test_given_a_receiver_when_set_up_then_each_fix_is_published_as_it_was_measured(unit: UbloxUnit) -> None:
    line = connect(unit).open().run(12.0)
    assert (
        line.status_text.splitlines()[-1]
        == f"streaming: {unit.product} (protocol {unit.protocol:g}), receiving NAV-PVT"
    )
    assert isinstance(line.device, UbloxEmulator)
    assert line.device.messages == frozenset(ORDER) - unit.missing | frozenset({"RXM-RTCM"}) - unit.missing
    assert 100 <= len(line.samples) <= 121
    truth = {each.header.utime: each for each in drive(20.0)}
    for sample in line.samples:
        same = truth[sample.header.device_utime]
        assert sample.fix_type is same.fix_type
        assert (sample.latitude_deg, sample.longitude_deg) == pytest.approx(
            (same.latitude_deg, same.longitude_deg), abs=1e-9
        )
        assert sample.height_ellipsoidal == pytest.approx(same.height_ellipsoidal, abs=1e-4)
        assert (sample.height_msl, sample.undulation) == pytest.approx((same.height_msl, same.undulation), abs=1e-3)
        assert (sample.hdop, sample.vdop, sample.pdop, sample.satellites) == (0.9, 1.2, 1.5, 9)
        assert sample.velocity == pytest.approx(same.velocity, abs=1e-3)
        assert sample.velocity_latency == 0.0
        assert sample.position_covariance is not None
        if "NAV-COV" not in unit.missing:
            assert sample.position_covariance == pytest.approx(same.position_covariance, rel=1e-6)
        else:  # the horizontal accuracy is shared by both axes
            assert sample.position_covariance[0] == sample.position_covariance[4] == pytest.approx(0.065, rel=0.01)
            assert sample.position_covariance[8] == pytest.approx(0.16, rel=0.01)
    assert all(0 <= each.header.host_utime - each.header.device_utime < 60_000 for each in line.samples)
    assert [each.header.seq for each in line.samples] == list(range(len(line.samples)))


def test_given_covariances_and_a_moving_base_then_they_are_along_east_north_up() -> None:
    sample = replace(
        ALL,
        position_covariance=(0.04, 0.01, 0.002, 0.01, 0.09, -0.003, 0.002, -0.003, 0.16),
        baseline_yaw=2.0,
        baseline_yaw_sigma=0.01,
    )
    driver = UbloxDriver(UbloxSettings("gps"))
    line = Line(driver, UbloxEmulator(()))
    line.open()
    for name in ORDER:
        line.deliver(encode_ubx(name, sample))
    (found,) = line.samples
    assert found.position_covariance == pytest.approx(sample.position_covariance, rel=1e-6)
    assert found.velocity_covariance == pytest.approx(ALL.velocity_covariance, rel=1e-6)
    assert (found.baseline_yaw, found.baseline_yaw_sigma) == pytest.approx((2.0, 0.01), abs=1e-6)


@pytest.mark.parametrize("fix_type", FixType)
def test_given_a_type_of_fix_then_it_is_published(fix_type: FixType) -> None:
    line = Line(UbloxDriver(UbloxSettings("gps")), UbloxEmulator(drive(8.0, fix_type=fix_type)))
    line.open().run(6.0)
    found = {sample.fix_type for sample in line.samples}
    assert found == {fix_type}
    if fix_type is FixType.NONE:
        assert all(math.isnan(each.latitude_deg) and each.velocity is None for each in line.samples)


def test_given_a_time_that_the_receiver_is_not_sure_of_then_it_is_not_used() -> None:
    pvt = bytearray(encode_ubx("NAV-PVT", ALL))
    pvt[6 + 11] &= ~0x04  # fullyResolved
    pvt[-2:] = calc_checksum(bytes(pvt[2:-2]))
    line = Line(UbloxDriver(UbloxSettings("gps")), UbloxEmulator(()))
    line.open()
    line.deliver(bytes(pvt) + encode_ubx("NAV-EOE", ALL))
    assert line.samples[0].header.device_utime == 0


def test_given_no_end_of_the_epoch_then_it_is_published_after_the_hold_or_with_the_next_one() -> None:
    line = Line(UbloxDriver(UbloxSettings("gps")), UbloxEmulator(()))
    line.open()
    line.deliver(encode_ubx("NAV-PVT", ALL))
    assert not line.samples
    line.run(0.11)
    assert len(line.samples) == 1
    line.deliver(encode_ubx("NAV-PVT", ALL))  # once more: the same instant
    line.run(0.1)
    assert len(line.samples) == 1
    for n in (1, 2):
        later = replace(ALL, header=replace(ALL.header, utime=START + n * 200_000))
        line.deliver(encode_ubx("NAV-PVT", later))
    assert len(line.samples) == 2
    assert line.driver.counts["repeated"] == 1


@pytest.mark.slow
@pytest.mark.parametrize("to_host", [split_in_half, add_noise(3), lambda data: split_randomly(data, len(data))])
def test_given_split_or_noisy_bytes_then_nearly_every_epoch_is_published(to_host: object) -> None:
    line = connect(seconds=30.0, to_host=to_host).open().run(25.0)
    assert len(line.samples) > 0.7 * 250
    utimes = [each.header.device_utime for each in line.samples]
    assert utimes == sorted(set(utimes))


def test_given_another_baud_rate_then_it_is_found() -> None:
    line = connect(device_baud=115200, baud=38400).open().run(20.0)
    assert [each.baud for each in line.reopens][:2] == [9600, 115200]
    assert line.baud == 115200
    assert line.status_text.splitlines()[-1].startswith("streaming: ZED-F9P")


@pytest.mark.slow
def test_given_an_unplugged_line_when_it_is_back_then_fixes_are_published_again() -> None:
    line = connect(seconds=60.0).open().run(8.0)
    line.is_broken = True
    line.run(10.0)
    before = len(line.samples)
    assert line.status_text.splitlines()[-1].startswith("silent: no u-blox receiver answers on this line: at ")
    line.is_broken, line.device_baud = False, line.baud
    line.run(20.0)
    assert len(line.samples) > before + 50
    assert line.phases[-1] is EndpointPhase.STREAMING


@pytest.mark.slow
def test_given_a_restart_when_its_setup_is_lost_then_it_is_set_up_again() -> None:
    samples = drive(60.0)
    device = FaultInjector(lambda: UbloxEmulator(samples), (parse_fault("restart@8:2"),))
    line = Line(UbloxDriver(UbloxSettings("gps", rate_hz=10.0)), device).open().run(30.0)
    assert sum(each.header.device_utime > START + 15 * SECOND for each in line.samples) > 100
    assert "setting the device up again" in line.status_text


def test_given_a_line_that_cannot_send_then_what_the_receiver_sends_unasked_is_used() -> None:
    line = Line(UbloxDriver(UbloxSettings("gps")), UbloxEmulator(()), device_baud=1)
    line.open()
    for n in range(40):
        later = replace(ALL, header=replace(ALL.header, utime=START + n * 200_000))
        line.deliver(encode_ubx("NAV-PVT", later) + encode_ubx("NAV-EOE", later))
        line.run(0.2)
    assert len(line.samples) == 40
    assert "sends NAV-PVT but answers nothing" in line.status_text


def test_given_a_rejected_rate_then_it_is_a_warning_and_the_rest_is_set_up() -> None:
    class Slow(UbloxEmulator):
        def _set_value(self, key: str, value: int) -> bool:
            return key != "CFG_RATE_MEAS" and super()._set_value(key, value)

    line = Line(UbloxDriver(UbloxSettings("gps", rate_hz=20.0)), Slow(drive(20.0))).open().run(10.0)
    (warning,) = (each for each in line.statuses if each.is_warning)
    assert "the device rejected a rate of 20 Hz: is `rate_hz` within" in warning.text
    assert len(line.samples) >= 8


def test_given_corrections_then_their_use_is_counted() -> None:
    line = Line(UbloxDriver(UbloxSettings("gps")), UbloxEmulator(()))
    line.open()
    for flags in (2 << 1, 1 << 1, 1):
        payload = struct.pack("<BBHHH", 2, flags, 0, 1234, 1077)
        line.deliver(UBXMessage("RXM", "RXM-RTCM", GET, payload=payload).serialize())
    counts = line.driver.counts
    assert (counts["rtcm.used"], counts["rtcm.unused"], counts["rtcm.damaged"]) == (1, 1, 1)


@settings(max_examples=100)
@given(st.binary(max_size=300), st.integers(0, 10), st.randoms(use_true_random=False))
def test_given_any_bytes_then_valid_messages_are_found_and_nothing_is_raised(
    noise: bytes, at: int, chance: random.Random
) -> None:
    noise = noise.replace(b"\xb5\x62", b"")
    frame = encode_ubx("NAV-PVT", ALL)
    data = noise[:at] + frame + noise[at:]
    whole = FrameScanner((UbxFormat(),)).feed(data)
    stream = FrameScanner((UbxFormat(),))
    pieces: list[object] = []
    position = 0
    while position < len(data):
        size = chance.randrange(1, 64)
        pieces += stream.feed(data[position : position + size])
        position += size
    assert [each.name for each in whole] == [each.name for each in pieces]  # type: ignore[attr-defined]
    if not noise[:at].endswith(b"\xb5"):
        assert "NAV-PVT" in [each.name for each in whole]


def test_given_damaged_lengths_or_payloads_then_they_are_counted() -> None:
    stream = FrameScanner((UbxFormat(),))
    stream.feed(b"\xb5\x62\x01\x07\xff\xff" + bytes(20))
    short = b"\x01\x07\x04\x00\x00\x00\x00\x00"
    stream.feed(b"\xb5\x62" + short + calc_checksum(short))
    assert stream.counts["rejected.ubx_length"] == 1
    frame = bytearray(encode_ubx("NAV-PVT", ALL))
    frame[20] ^= 1
    stream.feed(bytes(frame))
    assert stream.counts["rejected.checksum"] >= 1


# --- another device on the line -------------------------------------------------------------------------------

UBX_BYTES = b"".join(encode_ubx(name, ALL) for name in ORDER) * 3


def collect_nmea() -> bytes:
    saved = tuple(f"log com1 {name} ontime 0.25" for name in ("gpgga", "gprmc"))
    line = Line(
        GpsDriver(GpsSettings("gps", protocol="nmea")), GpsEmulator(drive(5.0), GpsUnit(saved, is_answering=False))
    )
    data = bytearray()
    line.to_host = lambda chunk: [data.extend(chunk) or chunk]  # type: ignore[func-returns-value]
    line.open().run(4.0)
    return bytes(data)


def test_given_ubx_bytes_on_the_line_of_another_driver_then_its_status_names_the_device_to_write() -> None:
    for protocol in ("nmea", "novatel"):
        line = Line(GpsDriver(GpsSettings("gps", protocol=protocol)), UbloxEmulator(()))
        line.open()
        for _ in range(40):
            line.deliver(UBX_BYTES)
            line.run(0.2)
        assert "UBX messages of a u-blox receiver: write device: ublox" in line.status_text


def test_given_nmea_on_the_line_of_a_ublox_driver_then_its_status_names_the_device_to_write() -> None:
    sentences = collect_nmea()
    line = Line(UbloxDriver(UbloxSettings("gps", bauds=(38400,))), UbloxEmulator(()), device_baud=1)
    line.open()
    for _ in range(20):
        line.deliver(sentences)
        line.run(0.2)
    assert "received NMEA sentences: write device: nmea" in line.status_text


@given(st.binary(max_size=600))
def test_given_noise_then_no_device_is_recognized(noise: bytes) -> None:
    assert recognize(noise) is None
    assert recognize_line(b"", "ublox") == "received nothing: check power, cable and port"


def test_given_a_sample_of_the_emulator_then_its_type_is_that_of_the_driver() -> None:
    assert isinstance(ALL, GpsSample)
