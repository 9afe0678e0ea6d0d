"""NovAtel logs by vectors from real receivers, and what is refused of them."""

from __future__ import annotations

import math

import pytest

from msdrivers.devices.gps.driver import GpsStream
from msdrivers.devices.gps.novatel import (
    CommandResponse,
    HeadingLog,
    LogHeader,
    NovatelLog,
    Position,
    PositionType,
    Prompt,
    SolutionStatus,
    TimeStatus,
    Velocity,
    crc32,
    encode,
)

BESTPOSB = bytes.fromhex(
    "aa44121c2a0000204800000096b45608f0c7331e20000402f6b100800000000010000000d34bee8b419349405c017abff6815cc0"
    "0020a37065189140000088c13d0000000e71f53fcadfd73fc1ff654000000000000000000000000010101000000000111059f44e"
)
BESTVELB = bytes.fromhex(
    "aa44121c630002a02c000000b4b42008282298180000000041011a1b00000000080000009a99193e00000000ac4381cfef2c713f"
    "3bf09117fb264c4080552fe4b965993f0000000093aed195"
)
BESTPOSA = (
    b"#BESTPOSA,ICOM1,0,80.0,FINESTEERING,1957,339804.750,00000800,7145,6938;SOL_COMPUTED,SINGLE,29.44387747069,"
    b'-98.61473389841,255.7484,-26.0000,WGS84,2.1423,2.2259,4.1807,"",0.000,0.000,8,8,8,0,0,02,00,01*b52aef0c\r\n'
)


def one(data: bytes) -> NovatelLog:
    (message,) = GpsStream().feed(data)
    assert isinstance(message, NovatelLog)
    return message


def binary(name_id: int, body: bytes, *, head: int = 28, kind: int = 0, ms: int = 1000) -> bytes:
    frame = b"\xaa\x44\x12" + bytes([head]) + name_id.to_bytes(2, "little") + bytes([kind, 32])
    frame += len(body).to_bytes(2, "little") + bytes(3) + b"\xb4" + (2288).to_bytes(2, "little")
    frame += ms.to_bytes(4, "little") + bytes(8 + head - 28) + body
    return frame + crc32(frame).to_bytes(4, "little")


def text(content: str, sync: str = "#") -> bytes:
    return f"{sync}{content}*{crc32(content.encode()):08x}\r\n".encode()


def test_given_a_real_bestposb_when_read_then_every_field_is_right():
    log = one(BESTPOSB)
    assert (log.header.week, log.header.milliseconds, log.header.time_status) == (2134, 506_710_000, 180)
    body = log.body
    assert isinstance(body, Position)
    assert (body.status, body.type) == (SolutionStatus.SOL_COMPUTED, PositionType.SINGLE)
    assert body.latitude == pytest.approx(51.15043782, abs=1e-8)
    assert body.longitude == pytest.approx(-114.03068530, abs=1e-8)
    assert body.height == pytest.approx(1094.099, abs=1e-3)
    assert body.undulation == -17.0
    assert body[7:10] == pytest.approx((1.918, 1.687, 3.594), abs=1e-3)
    assert (body.datum, body.tracked, body.used) == (61, 16, 16)


def test_given_a_real_bestvelb_when_read_then_every_field_is_right():
    body = one(BESTVELB).body
    assert isinstance(body, Velocity)
    assert body.type == PositionType.DOPPLER_VELOCITY
    assert body[2:] == pytest.approx((0.15, 0.0, 0.004193, 56.30, 0.02480), abs=1e-2)


def test_given_a_real_bestposa_when_read_then_every_field_is_right():
    log = one(BESTPOSA)
    assert log.header == LogHeader("BESTPOS", 1957, 339_804_750, TimeStatus.FINESTEERING, "ICOM1", 0, 0x800, False)
    body = log.body
    assert isinstance(body, Position)
    assert body == (0, 16, 29.44387747069, -98.61473389841, 255.7484, -26.0, 61, 2.1423, 2.2259, 4.1807, "", 0, 0, 8, 8)


@pytest.mark.parametrize("name", ["HEADING", "HEADING2"])
def test_given_a_heading_when_written_and_read_then_it_is_the_same(name: str):
    body = HeadingLog(0, PositionType.NARROW_INT, 1.0, 82.5, -1.5, 0.25, 0.5, "999", 18, 16)
    header = LogHeader(name, 2288, 5000, TimeStatus.FINE, "COM1", 0, 0, True)
    assert one(encode(NovatelLog(header, body))).body == body


@pytest.mark.parametrize("at", range(3, len(BESTPOSB)))
def test_given_one_damaged_byte_when_read_then_the_log_is_rejected_and_the_next_is_found(at: int):
    damaged = bytearray(BESTPOSB)
    damaged[at] ^= 0x10
    stream = GpsStream()
    # a broken length may claim as much as is kept: three logs are more than that of a known one
    messages = stream.feed(bytes(damaged) + BESTVELB * 20)
    names = [each.header.name for each in messages if isinstance(each, NovatelLog)]
    assert names.count("BESTPOS") == 0
    assert names.count("BESTVEL") == 20
    assert sum(number for kind, number in stream.counts.items() if kind.startswith("rejected.")) >= 1


def test_given_a_log_inside_a_broken_one_when_read_then_it_is_found():
    stream = GpsStream()
    messages = stream.feed(BESTPOSB[:40] + BESTVELB + BESTPOSB)
    assert [each.header.name for each in messages if isinstance(each, NovatelLog)] == ["BESTVEL", "BESTPOS"]
    assert stream.counts["skipped"] == 40
    assert stream.counts["rejected.novatel_checksum"] == 1


def test_given_a_longer_header_when_read_then_the_body_is_found_after_it():
    assert isinstance(one(binary(42, BESTPOSB[28:-4], head=32)).body, Position)


def test_given_a_short_header_when_read_then_the_log_is_known_by_name_and_time():
    frame = b"\xaa\x44\x13\x04" + (508).to_bytes(2, "little") + (2288).to_bytes(2, "little")
    frame += (7000).to_bytes(4, "little") + b"body"
    log = one(frame + crc32(frame).to_bytes(4, "little"))
    assert (log.header.name, log.header.milliseconds, log.body) == ("INSPVAS", 7000, None)
    assert one(text("INSPVASA,2288,7.000;1,2,3", "%")).header.milliseconds == 7000


def test_given_an_unknown_log_when_read_then_it_is_named_by_number_and_has_no_body():
    log = one(binary(4711, b"anything"))
    assert (log.header.name, log.body) == ("id 4711", None)


def test_given_a_response_in_binary_when_read_then_it_is_no_position():
    assert one(binary(42, bytes(72), kind=0x80)).body is None


@pytest.mark.parametrize(
    ("frame", "reason"),
    [
        (binary(42, bytes(71)), "novatel_header"),
        (binary(42, bytes(72), ms=604_800_000), "novatel_header"),
        (binary(42, b"\0" * 8 + b"\0\0\0\0\0\0\xf8\x7f" + bytes(56)), "novatel_value"),
        (binary(4711, bytes(2000)), "novatel_length"),
        (text("BESTPOSA,COM1,0,80.0,FINE,1957,339804.750,00000800,7145,6938;SOL_COMPUTED,SINGLE,1"), "novatel_value"),
        (text("BESTPOSA,COM1,0,80.0,FINE,1957,999999.750,00000800,7145,6938;"), "novatel_value"),
        (text("BESTPOSA;SOL_COMPUTED"), ""),
        (text("BESTVELA,COM1,0,0,FINE,1,0.0,0,0,0;SOL_COMPUTED,SINGLE,nan,0,0,0,0,0"), "novatel_value"),
        (BESTPOSA.replace(b"*b5", b"*b6"), "novatel_checksum"),
        (BESTPOSA.replace(b"*", b"\r\n*"), "novatel_incomplete"),
    ],
)
def test_given_impossible_values_when_read_then_it_is_rejected_by_reason(frame: bytes, reason: str):
    stream = GpsStream()
    assert not any(isinstance(each, NovatelLog) for each in stream.feed(frame))
    rejected = {kind for kind in stream.counts if kind.startswith("rejected.")}
    assert rejected == ({f"rejected.{reason}"} if reason else set())


def test_given_words_that_are_not_in_the_tables_when_read_then_the_log_is_taken_and_they_mean_no_fix():
    content = (
        "BESTPOSA,COM1,0,80.0,SOMEHOW,1957,339804.750,00000800,7145,6938;SOL_COMPUTED,QUANTUM,29.0,-98.0,255.0,"
        '-26.0,WGS84,2.0,2.0,4.0,"a,b",0.0,0.0,8,8,8,0,0,02,00,01'
    )
    log = one(text(content))
    assert log.header.time_status == TimeStatus.UNKNOWN
    assert isinstance(log.body, Position)
    assert log.body.type == 255
    assert log.body.station == "a,b"


def test_given_answers_and_prompts_when_read_then_they_are_distinguished():
    stream = GpsStream()
    data = (
        b"\r\n<OK\r\n[COM1]\r\n<ERROR:Invalid Message. Field = 1\r\n[COM1]<OK\n[USB2]<BESTPOS COM1 0 72.0 FINE\r\n[X]"
    )
    messages = stream.feed(data)
    assert [(type(each), getattr(each, "error", getattr(each, "port", ""))) for each in messages] == [
        (CommandResponse, ""),
        (Prompt, "COM1"),
        (CommandResponse, "Invalid Message. Field = 1"),
        (Prompt, "COM1"),
        (CommandResponse, ""),
        (Prompt, "USB2"),
    ]
    assert stream.counts["novatel.abbreviated"] == 1
    assert stream.counts["skipped"] == 3


def test_given_positions_when_starts_are_compared_then_they_are_where_the_logs_begin():
    stream = GpsStream()
    stream.feed(b"noise")
    first, second = stream.feed(BESTPOSB + b"\x00" + BESTVELB)
    assert (first.start, second.start) == (5, 5 + len(BESTPOSB) + 1)
    assert stream.offset == 5 + len(BESTPOSB) + 1 + len(BESTVELB)


def test_given_the_crc_when_compared_with_zlibs_then_it_is_another():
    assert crc32(b"") == 0
    assert crc32(BESTPOSB[:-4]) == int.from_bytes(BESTPOSB[-4:], "little")


@pytest.mark.parametrize(
    "header",
    [
        "BESTPOSA,COM1,0,80.0,FINESTEERING,1957,inf,00000800,7145,6938",
        "BESTPOSA,COM1,0,80.0,FINESTEERING,1957,1e999,00000800,7145,6938",
        "BESTPOSA,COM1,0,80.0,FINESTEERING,1957,nan,00000800,7145,6938",
        "BESTPOSA,COM1,0,80.0,FINESTEERING,1957,-1,00000800,7145,6938",
        "BESTPOSA,COM1,0,80.0,FINESTEERING,1957,604799.9999,00000800,7145,6938",
        "BESTPOSA,COM1,0,80.0,FINESTEERING,2147483648,0,00000800,7145,6938",
        "BESTPOSA,COM1,0,80.0,FINESTEERING,-1,0,00000800,7145,6938",
        "BESTPOSA,COM1,0,80.0,FINESTEERING,1957,0,100000000,7145,6938",
    ],
)
def test_given_a_header_that_cannot_be_when_read_then_the_log_is_rejected_and_the_next_is_read(header: str):
    _, body = BESTPOSA.decode("ascii").split("*")[0].split(";")
    stream = GpsStream()
    assert stream.feed(text(f"{header};{body}")) == []
    assert stream.counts["rejected.novatel_value"] == 1
    assert len(stream.feed(BESTPOSA)) == 1


@pytest.mark.parametrize("count", ["256", "2147483648", "-1", "8.5", ""])
def test_given_a_number_of_satellites_that_cannot_be_when_read_then_the_log_is_rejected(count: str):
    content = BESTPOSA.decode("ascii").split("*")[0][1:].replace(",8,8,8,0,0", f",8,{count},8,0,0")
    stream = GpsStream()
    assert stream.feed(text(content)) == []
    assert stream.counts["rejected.novatel_value"] == 1


@pytest.mark.parametrize("degrees", [-0.5, 360.5, math.nan, math.inf, 1e30])
def test_given_a_heading_that_cannot_be_when_read_then_it_is_rejected(degrees: float):
    log = HeadingLog(0, 50, 2.0, degrees, 1.0, 0.1, 0.2, "AAAA", 10, 9)
    header = LogHeader("HEADING", 2288, 1000, TimeStatus.FINESTEERING, "32", 0, 0, True)
    stream = GpsStream()
    assert stream.feed(encode(NovatelLog(header, log))) == []
    assert stream.counts["rejected.novatel_value"] == 1


@pytest.mark.parametrize("good", [BESTPOSA, b"$GPZDA,120000.00,21,11,2026,00,00*60\r\n", b"[COM1]", BESTPOSB])
@pytest.mark.parametrize("noise", [b"<", b"<noise ", b"<OK", b"<ERROR:no"])
def test_given_a_stray_beginning_of_text_when_a_good_message_follows_then_it_is_read(noise: bytes, good: bytes):
    alone, stream = GpsStream(), GpsStream()
    alone.feed(good)
    stream.feed(noise + good + b"\r\n")
    assert {**stream.counts, "skipped": 0} == {**alone.counts, "skipped": 0}


SECONDARY = LogHeader("BESTPOS", 2288, 5000, TimeStatus.FINE, "COM1", 0, 0, True, antenna=1)


@pytest.mark.parametrize(
    "frame",
    [
        encode(NovatelLog(SECONDARY, one(BESTPOSB).body)),
        text(BESTPOSA.decode()[1:].partition("*")[0].replace("BESTPOSA", "BESTPOSA_1")),
    ],
    ids=["binary", "ascii"],
)
def test_given_a_log_of_the_secondary_antenna_when_read_then_it_is_marked(frame: bytes):
    stream = GpsStream()
    (log,) = stream.feed(frame)
    assert isinstance(log, NovatelLog)
    assert log.header.name == "BESTPOS"
    assert log.header.is_secondary
    assert stream.counts[f"novatel.{log.header.label}"] == 1
    assert log.header.label.endswith("_1")


def test_given_any_source_of_five_bits_when_read_then_only_1_is_the_secondary_antenna():
    for kind in range(32):
        log = one(binary(42, one_body(), kind=kind))
        assert log.body is not None
        assert log.header.is_secondary is (kind == 1)
        assert log.header.label == ("BESTPOSB_1" if kind == 1 else "BESTPOSB")


def test_given_a_source_that_five_bits_cannot_hold_when_read_then_the_log_is_rejected():
    head = "BESTPOSA_32,COM1,0,0.0,FINE,2288,5.000,00000000,0000,0"
    stream = GpsStream()
    assert stream.feed(text(f"{head};{BESTPOSA.decode().partition(';')[2].partition('*')[0]}")) == []
    assert stream.counts["rejected.novatel_value"] == 1


def one_body() -> bytes:
    return BESTPOSB[28:-4]


def test_given_thousands_of_log_names_when_counted_then_the_counters_stay_few_and_short():
    stream = GpsStream()
    for number in range(2000):
        stream.feed(text(f"LOG{number}XA,COM1,0,0.0,FINE,2288,5.000,00000000,0000,0;1"))
        stream.feed(binary(3000 + number, b""))
    counts = stream.counts
    assert len(counts) <= 70
    assert max(map(len, counts)) <= 48
    # nothing is lost from the sum
    assert sum(number for name, number in counts.items() if name.startswith("novatel.")) == 4000
