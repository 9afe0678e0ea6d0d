"""Parsers of satellite receivers: independent of the chunks, silent on noise, inverse of the encoders."""

from __future__ import annotations

import math
import random
from collections.abc import Sequence

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support_gps import drive, split_randomly

from modelserver.messages import GpsSample
from msdrivers.devices.gps.driver import GpsMessage, GpsStream
from msdrivers.devices.gps.nmea import NmeaEpoch, format_angle, parse_angle
from msdrivers.devices.gps.novatel import (
    LogHeader,
    NovatelLog,
    Position,
    PositionType,
    SolutionStatus,
    TimeStatus,
    Velocity,
    crc32,
    encode,
)
from msdrivers.emulate import gps as gps_logs

MAX_PENDING = 1024
ALL = (*gps_logs.NMEA, *(f"{log}b" for log in gps_logs.NOVATEL))


def speech(samples: Sequence[GpsSample], names: Sequence[str] = ALL) -> bytes:
    return b"".join(gps_logs.encode_sample(name, each, each.header.utime) for each in samples for name in names)


GOOD = speech(list(drive(1.0, 2.0)))


def everything(parts: Sequence[bytes]) -> tuple[str, dict[str, int]]:
    """Return the messages, as text because nan differs from itself, and the counters."""
    stream = GpsStream()
    messages: list[GpsMessage] = []
    for part in parts:
        messages += stream.feed(part)
        assert stream.pending_bytes <= MAX_PENDING
    return repr(messages + stream.flush()), dict(stream.counts)


@given(st.binary(max_size=3000), st.integers(0, 2**32))
def test_given_any_bytes_when_split_anyhow_then_the_messages_are_the_same(data: bytes, seed: int):
    assert everything(split_randomly(data, seed)) == everything([data])


@settings(max_examples=15)
@given(
    st.lists(st.sampled_from([b"#", b"%", b"$", b"<", b"[", b"*", b"\xaa\x44\x12", b"\xaa\x44\x13"]), max_size=12),
    st.integers(0, 2**32),
)
def test_given_good_messages_with_beginnings_between_when_split_anyhow_then_the_messages_are_the_same(
    beginnings: list[bytes], seed: int
):
    chance = random.Random(seed)
    at = sorted(chance.randrange(len(GOOD)) for _ in beginnings)
    pieces = [GOOD[i:j] + lead for i, j, lead in zip([0, *at], [*at, len(GOOD)], [*beginnings, b""], strict=True)]
    data = b"".join(pieces)
    assert everything([data[n : n + 1] for n in range(len(data))]) == everything([data])


@pytest.mark.parametrize("seed", range(3))
def test_given_noise_when_a_good_stream_follows_then_it_is_followed_within_one_message(seed: int):
    chance = random.Random(seed)
    stream = GpsStream()
    for _ in range(20):
        messages = stream.feed(chance.randbytes(10_000))
        assert not [each for each in messages if isinstance(each, (NovatelLog, NmeaEpoch))]
        assert stream.pending_bytes <= MAX_PENDING
    samples = list(drive(10.0, 4.0))
    logs = [each for each in stream.feed(speech(samples, ["bestposb", "bestvelb"])) if isinstance(each, NovatelLog)]
    assert len(logs) >= 2 * len(samples) - 1


angles = st.floats(-180.0, 180.0, allow_nan=False)
small = st.floats(-1000.0, 1000.0, width=32)
sigma = st.floats(0.0, 1000.0, width=32)
status = st.sampled_from(SolutionStatus)
kind = st.sampled_from(PositionType)
count = st.integers(0, 255)
station = st.text("0123456789ABC", max_size=4)
bodies = {
    "BESTPOS": st.builds(
        Position,
        status,
        kind,
        st.floats(-90.0, 90.0),
        angles,
        small,
        small,
        st.just(61),
        sigma,
        sigma,
        sigma,
        station,
        sigma,
        sigma,
        count,
        count,
    ),
    "BESTVEL": st.builds(Velocity, status, kind, sigma, sigma, sigma, st.floats(0.0, 360.0), small),
}
headers = st.builds(
    LogHeader,
    st.just(""),
    st.integers(0, 5000),
    st.integers(0, 604_799_999),
    st.sampled_from(TimeStatus),
    st.just("COM1"),
    st.integers(0, 65_535),
    st.integers(0, 2**32 - 1),
    st.just(True),
    st.integers(0, 1),
)


@given(st.sampled_from(sorted(bodies)).flatmap(lambda name: st.tuples(st.just(name), bodies[name])), headers)
def test_given_a_log_when_written_and_read_then_it_is_the_same(named: tuple[str, Position], header: LogHeader):
    name, body = named
    log = NovatelLog(header._replace(name=name), body)
    (back,) = GpsStream().feed(encode(log))
    assert isinstance(back, NovatelLog)
    assert back.body is not None
    assert back.header == log.header._replace(port="32")
    for field, got, expected in zip(body._fields, back.body, body, strict=True):
        if isinstance(expected, float):
            assert got == pytest.approx(expected, rel=1e-6), field
        else:
            assert got == expected, field


@given(st.floats(-179.9999999, 179.9999999))
def test_given_an_angle_when_written_and_read_then_it_is_the_same(degrees: float):
    assert parse_angle(*format_angle(degrees, "EW", 3), "EW", 180.0) == pytest.approx(degrees, abs=1e-9)


@given(angles.filter(lambda x: abs(x) < 89.0), angles, st.integers(0, 40 * 365 * 86_400_000))
def test_given_a_sample_when_encoded_in_nmea_and_read_then_it_is_the_same(latitude: float, longitude: float, ms: int):
    utime = 400_000_000_000_000 + ms * 1000
    sample = next(iter(drive(1.0)))
    moved = GpsSample(sample.header, sample.fix_type, latitude, longitude, height_msl=12.5, speed=3.0, course=1.0)
    data = b"".join(gps_logs.encode_sample(name, moved, utime) for name in ("gpgga", "gprmc", "gpzda"))
    stream = GpsStream()
    (epoch,) = [*stream.feed(data), *stream.flush()]
    assert isinstance(epoch, NmeaEpoch)
    assert epoch.utime == utime
    assert epoch.latitude == pytest.approx(latitude, abs=1e-9)
    assert epoch.longitude == pytest.approx(longitude, abs=1e-9)
    assert (epoch.height_msl, epoch.fix_type) == (12.5, sample.fix_type)
    assert epoch.speed == pytest.approx(3.0, abs=1e-4)
    assert math.isnan(epoch.heading)


numbers = st.sampled_from(["inf", "-inf", "nan", "1e999", "-1", "2147483648", "4294967296", "", "1e308", "0x1", "8.5"])
fields = st.one_of(numbers, st.text("0123456789.eE+-naifNAIF", max_size=12), st.integers().map(str))


@given(
    st.sampled_from(("#BESTPOSA", "#BESTVELA", "#HEADINGA", "#HEADING2A", "%BESTPOSSA", "%RAWIMUSA")),
    st.lists(st.tuples(st.integers(0, 40), fields), min_size=1, max_size=4),
)
def test_given_a_text_log_with_any_fields_and_a_right_checksum_then_nothing_is_raised_and_the_next_is_read(
    name: str, changes: list[tuple[int, str]]
):
    kind = "SOL_COMPUTED,SINGLE"
    bodies = {
        "#BESTPOSA": f'{kind},50,-111,700,-20,WGS84,1,2,3,"",0,0,8,8,8,0,0,02,00,01',
        "#BESTVELA": f"{kind},0.1,0,1.5,90,0.1,0",
        "#HEADINGA": f'{kind},2,90,1,0,0.1,0.2,"AA",10,9,9,9,00,00,00',
        "#HEADING2A": f'{kind},2,90,1,0,0.1,0.2,"AA","BB",10,9,9,9,00,00,00',
    }
    short = name.startswith("%")
    header = (
        ["1957", "339804.750"]
        if short
        else ["COM1", "0", "80.0", "FINESTEERING", "1957", "339804.750", "800", "7145", "6938"]
    )
    parts = [header, bodies.get(name, "1,2,3").split(",")]
    for at, value in changes:
        part = parts[at % 2]
        part[at // 2 % len(part)] = value
    content = f"{name[1:]},{','.join(parts[0])};{','.join(parts[1])}"
    log = f"{name[0]}{content}*{crc32(content.encode()):08x}\r\n".encode()
    stream = GpsStream()
    for each in stream.feed(log):
        assert isinstance(each, NovatelLog)
        # what is taken can be published
        assert 0 <= each.header.week <= 0xFFFF
    assert stream.counts.get("rejected.error", 0) == 0
    assert len(stream.feed(GOOD)) > 0
    assert stream.pending_bytes <= MAX_PENDING
