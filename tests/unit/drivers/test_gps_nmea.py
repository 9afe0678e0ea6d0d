"""NMEA 0183: content of sentences, assembly of epochs, rejection of damaged sentences."""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import UTC, datetime

import pytest

from modelserver.messages import FixType
from msdrivers.devices.gps.driver import GpsStream
from msdrivers.devices.gps.nmea import (
    NmeaEpoch,
    encode,
    format_angle,
    format_number,
    format_time_of_day,
    parse_sentence,
)

KNOT = 1852.0 / 3600.0


def make_sentences(*sentences: str) -> bytes:
    return b"".join(encode(each[:2], each[2:5], each.split(",")[1:]) for each in sentences)


def epochs(*sentences: str) -> list[NmeaEpoch]:
    stream = GpsStream()
    found = [*stream.feed(make_sentences(*sentences)), *stream.flush()]
    assert all(isinstance(each, NmeaEpoch) for each in found)
    return found  # type: ignore[return-value]


def gga(clock: str = "120000.00", quality: str = "1", place: str = "5000.0,N,11100.0,W", height: str = "700.0") -> str:
    return f"GPGGA,{clock},{place},{quality},08,0.9,{height},M,-20.0,M,,"


def rmc(clock: str = "120000.00", status: str = "A", date: str = "211126", mode: str = "A") -> str:
    return f"GPRMC,{clock},{status},5000.0,N,11100.0,W,10.0,90.0,{date},,,{mode}"


GNS = "GNGNS,120000.00,5000.0,N,11100.0,W,RR,13,0.9,700.0,-20.0,,"


def utime(*parts: int) -> int:
    return round(datetime(*parts, tzinfo=UTC).timestamp() * 1e6)  # type: ignore[misc]


def test_given_all_sentences_of_an_instant_when_read_then_one_epoch_contains_all():
    sentences = (gga(), rmc(), "GPVTG,91.0,T,,M,11.0,N,20.4,K,A", "GPGSA,A,3,,,,,,,,,,,,,1.5,0.9,1.2")
    more = ("GPGST,120000.00,,,,,0.3,0.2,0.4", "GPHDT,45.0,T", "GPZDA,120000.00,21,11,2026,00,00")
    (epoch,) = epochs(*sentences, *more)
    assert epoch.kinds == ("GGA", "RMC", "VTG", "GSA", "GST", "HDT", "ZDA")
    assert epoch.utime == utime(2026, 11, 21, 12)
    assert epoch.fix_type is FixType.FIX_3D
    assert (epoch.latitude, epoch.longitude) == (50.0, -111.0)
    assert (epoch.height_msl, epoch.undulation, epoch.satellites) == (700.0, -20.0, 8)
    assert (epoch.pdop, epoch.hdop, epoch.vdop) == (1.5, 0.9, 1.2)
    assert (epoch.speed, epoch.track, epoch.heading) == (10.0 * KNOT, 90.0, 45.0)
    assert (epoch.sigma_latitude, epoch.sigma_longitude, epoch.sigma_height) == (0.3, 0.2, 0.4)


@pytest.mark.parametrize("talker", ["GN", "GL", "IN", "BD", "QZ"])
def test_given_any_talker_when_it_speaks_then_it_is_read(talker: str):
    (epoch,) = epochs(talker + gga()[2:])
    assert epoch.latitude == 50.0


@pytest.mark.parametrize(
    ("sentences", "fix"),
    [
        ((gga(quality="0"),), FixType.NONE),
        ((gga(quality="1"),), FixType.FIX_3D),
        ((gga(quality="1", height=""),), FixType.FIX_2D),
        ((gga(quality="2"),), FixType.DIFFERENTIAL),
        ((gga(quality="4"),), FixType.RTK_FIXED),
        ((gga(quality="5"),), FixType.RTK_FLOAT),
        ((gga(quality="6"),), FixType.DEAD_RECKONING),
        ((gga(quality="7"),), FixType.NONE),
        ((gga(quality="8"),), FixType.NONE),
        ((gga(quality="9"),), FixType.DIFFERENTIAL),
        ((gga(quality="1").replace(",08,", ",00,"),), FixType.NONE),
        ((gga(quality="4").replace(",08,", ",0,"),), FixType.NONE),
        ((gga(quality="1").replace(",08,", ",,"),), FixType.FIX_3D),
        ((gga(quality="2").replace(",08,", ",00,"), "GPGSA,A,3,04,05,,09,,,,,,,,,1.5,1.3,1.0"), FixType.DIFFERENTIAL),
        ((gga(quality="2").replace(",08,", ",00,"), "GPGSA,A,3,,,,,,,,,,,,,1.5,1.3,1.0"), FixType.NONE),
        ((gga(quality="1").replace(",08,", ",00,"), rmc()), FixType.NONE),
        ((gga(quality=""),), FixType.NONE),
        ((gga(), rmc(status="V")), FixType.NONE),
        ((gga(), rmc(mode="S")), FixType.NONE),
        ((gga(), rmc(mode="D")), FixType.FIX_3D),
        ((rmc(),), FixType.FIX_2D),
        ((rmc(mode="D"),), FixType.DIFFERENTIAL),
        ((rmc(status="V", mode="E"),), FixType.DEAD_RECKONING),
        ((rmc(mode=""),), FixType.FIX_2D),
        ((gga(), "GPGSA,A,2,,,,,,,,,,,,,1.5,0.9,1.2"), FixType.FIX_2D),
        ((gga(), "GPGSA,A,1,,,,,,,,,,,,,,,"), FixType.NONE),
        ((gga(), "GPGSA,A,3,,,,,,,,,,,,,1,1,1", "GLGSA,A,1,,,,,,,,,,,,,,,"), FixType.FIX_3D),
        (("GNGNS,120000.00,5000.0,N,11100.0,W,RNN,09,0.9,700.0,-20.0,,",), FixType.RTK_FIXED),
        (("GNGNS,120000.00,5000.0,N,11100.0,W,NNN,09,0.9,700.0,-20.0,,",), FixType.NONE),
        ((GNS, "GPGNS,120000.00,,,,,,8,,,,1.0,23", "GLGNS,120000.00,,,,,,5,,,,1.0,23"), FixType.RTK_FIXED),
        (("GLGNS,120000.00,,,,,N,0,,,,,", GNS), FixType.RTK_FIXED),
        (("GPGNS,120000.00,,,,,,8,,,,1.0,23", gga(quality="4")), FixType.RTK_FIXED),
        ((gga(quality="4"), "GNGNS,120000.00,,,,,NN,0,,,,,"), FixType.NONE),
        ((GNS, "GLGNS,120000.00,5000.0,N,11100.0,W,N,0,,,,,"), FixType.RTK_FIXED),
        (("GPGLL,5000.0,N,11100.0,W,120000.00,A,A",), FixType.FIX_2D),
        (("GPGLL,5000.0,N,11100.0,W,120000.00,V,N",), FixType.NONE),
    ],
)
def test_given_the_fix_data_of_sentences_when_together_then_the_strictest_counts(
    sentences: Sequence[str], fix: FixType
):
    (epoch,) = epochs(*sentences)
    assert epoch.fix_type is fix
    # a fix flagged invalid keeps the coordinates that came with it
    assert (epoch.latitude, epoch.longitude) == (50.0, -111.0)


def test_given_empty_fields_when_read_then_nothing_is_reported():
    (epoch,) = epochs("GPGGA,120000.00,,,,,0,00,,,M,,M,,", "GPVTG,,T,,M,,N,,K,N")
    assert epoch.fix_type is FixType.NONE
    values = (epoch.latitude, epoch.height_msl, epoch.undulation, epoch.hdop, epoch.speed, epoch.track, epoch.heading)
    assert all(map(math.isnan, values))


def test_given_filler_for_no_fix_when_it_cannot_be_a_place_then_it_is_no_place():
    (epoch,) = epochs("GPRMC,120000.00,V,36000.0000,N,72000.0000,E,0.0,,211126,,,N")
    assert math.isnan(epoch.latitude)
    assert epoch.fix_type is FixType.NONE


def test_given_instants_when_they_change_then_each_is_an_epoch_of_its_own():
    found = epochs(gga("120000.00"), rmc("120000.00"), gga("120000.20"), rmc("120000.20"), gga("120000.40"))
    assert [each.kinds for each in found] == [("GGA", "RMC"), ("GGA", "RMC"), ("GGA",)]
    assert [each.utime for each in found] == [utime(2026, 11, 21, 12) + n * 200_000 for n in range(3)]


def test_given_cycles_that_were_alike_for_a_second_when_the_last_sentence_comes_then_nobody_waits():
    stream = GpsStream()
    for n in range(8):
        clock = f"12000{n // 4}.{n % 4 * 25:02d}"
        got = stream.feed(make_sentences(gga(clock), rmc(clock)))
    # the epoch is complete with its own RMC
    assert [each.time_of_day for each in got if isinstance(each, NmeaEpoch)][-1] == 43_201_750_000
    assert stream.flush() == []


def test_given_a_sentence_that_comes_once_a_second_when_between_fast_ones_then_it_is_not_lost():
    found = []
    for n in range(40):
        clock = f"12000{n // 10}.{n % 10}0"
        found += [gga(clock)] + ([rmc(clock)] if n % 10 == 9 else [])
    assert [each.speed == each.speed for each in epochs(*found)] == [n % 10 == 9 for n in range(40)]


def test_given_a_clock_that_does_not_advance_when_the_same_instant_comes_again_then_it_is_one_epoch():
    assert len(epochs(*[gga(), rmc()] * 50)) == 1
    stream = GpsStream()
    assert len([*stream.feed(make_sentences(gga(), rmc())), *stream.flush()]) == 1
    stream.feed(make_sentences(gga(), rmc()))
    assert stream.flush() == []
    assert stream.counts["rejected.late"] == 2


def test_given_midnight_with_gga_only_then_the_day_goes_on():
    found = epochs(rmc("235959.50"), gga("000000.00"), gga("000000.50"))
    assert [each.utime for each in found] == [utime(2026, 11, 22) + n * 500_000 for n in (-1, 0, 1)]


def test_given_no_date_when_read_then_there_is_none():
    (epoch,) = epochs(gga())
    assert (epoch.utime, epoch.time_of_day) == (0, 43_200_000_000)


@pytest.mark.parametrize(
    "sentence",
    [
        gga(clock="246000.00"),
        gga(clock="125960.00"),
        gga(clock="-12000.00"),
        gga(place="5060.0,N,11100.0,W"),
        gga(place="9100.0,N,11100.0,W"),
        gga(place="5000.0,X,11100.0,W"),
        gga(place="5000.0,,11100.0,W"),
        gga(place="5000.0,N,18100.0,W"),
        gga(place="5000.0,N,11100.0,"),
        gga(height="high"),
        gga(height="1e400"),
        gga(quality="x"),
        rmc(date="310226"),
        rmc(date="2208-1"),
        "GPVTG,361.0,T,,M,1.0,N,,K",
        "GPVTG,,T,,M,-1.0,N,,K",
        "GPHDT,nan,T",
        "GPGSA,A,4,,,,,,,,,,,,,1.5,0.9,1.2",
        "GPZDA,120000.00,31,02,2026,00,00",
    ],
)
def test_given_a_field_that_cannot_be_when_read_then_the_sentence_is_rejected(sentence: str):
    stream = GpsStream()
    assert [*stream.feed(make_sentences(sentence)), *stream.flush()] == []
    assert stream.counts["rejected.nmea_field"] == 1


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (lambda data: data.replace(b"5000.0", b"5000.1"), "nmea_checksum"),
        (lambda data: data[:-4] + b"+1\r\n", "nmea_checksum"),
        (lambda data: data[:-5] + b"\r\n", "nmea_incomplete"),
        (lambda data: data[:7] + b"0" * 200 + data[7:], "nmea_length"),
    ],
)
def test_given_a_damaged_sentence_when_read_then_it_is_rejected_and_the_next_is_read(damage, reason: str):
    stream = GpsStream()
    good = make_sentences(rmc())
    found = [*stream.feed(damage(make_sentences(gga())) + good), *stream.flush()]
    assert [each.kinds for each in found if isinstance(each, NmeaEpoch)] == [("RMC",)]
    assert stream.counts[f"rejected.{reason}"] == 1


def test_given_sentences_of_no_use_when_read_then_they_are_counted_and_nothing_else():
    stream = GpsStream()
    data = b"$PGRME,15.0,M,22.5,M,27.0,M*1A\r\n" + make_sentences("GPGSV,1,1,00", "HEROT,0.0,A")
    assert stream.feed(data) == []
    assert stream.counts == {"nmea.unsupported": 3, "skipped": 0}


def test_given_a_number_of_decimals_when_read_then_none_is_lost():
    sentence = parse_sentence(
        make_sentences(gga(clock="120000.289999", place="4404.1306024,N,12118.8446777,W")).decode().strip()
    )
    assert sentence is not None
    assert sentence.time_of_day == 43_200_289_999
    assert sentence.latitude == pytest.approx(44.06884337333, abs=1e-11)


def test_given_values_when_written_then_they_read_as_they_should():
    assert format_angle(-111.99999999999, "EW", 3) == ("11200.0000000", "W")
    assert format_angle(5.5, "NS", 2) == ("0530.0000000", "N")
    assert format_angle(math.nan, "NS", 2) == ("", "")
    assert format_time_of_day(86_399_500_000) == "235959.500"
    assert (format_number(math.nan, 2), format_number(1.005, 1)) == ("", "1.0")


@pytest.mark.parametrize(
    ("sentence", "moves"),
    [
        ("GPVTG,90.0,T,,M,17.0,N,,K,A", True),
        ("GPVTG,90.0,T,,M,17.0,N,,K,D", True),
        ("GPVTG,90.0,T,,M,17.0,N,,K", True),
        ("GPVTG,90.0,T,,M,17.0,N,,K,", True),
        ("GPVTG,90.0,T,,M,17.0,N,,K,N", False),
        ("GPVTG,90.0,T,,M,17.0,N,,K,S", False),
        ("GPVTG,90.0,T,,M,17.0,N,,K,M", False),
        (rmc(), True),
        (rmc(mode=""), True),
        (rmc(status="V"), False),
        (rmc(mode="N"), False),
        (rmc(mode="S"), False),
        (rmc(status="V", mode="E"), True),
        (rmc(status="", mode=""), False),
    ],
)
def test_given_motion_that_is_flagged_invalid_when_read_then_it_is_not_reported(sentence: str, moves: bool):
    (epoch,) = epochs(gga(), sentence)
    assert [value == value for value in (epoch.speed, epoch.track)] == [moves, moves]


def test_given_a_gns_for_each_system_when_read_then_the_satellites_are_those_of_the_fix():
    (epoch,) = epochs("GPGNS,120000.00,,,,,,18,,,,1.0,23", GNS, "GLGNS,120000.00,,,,,,5,,,,1.0,23")
    assert (epoch.fix_type, epoch.satellites) == (FixType.RTK_FIXED, 13)


def test_given_a_gns_without_a_mode_when_read_then_it_is_no_fix_as_a_gga_without_quality():
    (epoch,) = epochs("GNGNS,120000.00,5000.0,N,11100.0,W,,09,0.9,700.0,-20.0,,")
    assert epoch.fix_type is FixType.NONE


def cycles(order: Sequence[str], silent: Sequence[int], number: int = 8) -> list[tuple[int, float, float]]:
    """Return second, speed and heading of each epoch of a receiver; both encode the second.

    silent: the cycles after which the line is silent.
    """
    stream, found = GpsStream(), []
    for n in range(number):
        kinds = {
            "GGA": gga(f"12000{n}.00"),
            "VTG": f"GPVTG,90.0,T,,M,{n}.0,N,,K,A",
            "HDT": f"GPHDT,{n}.0,T",
            "GSA": "GPGSA,A,3,,,,,,,,,,,,,1.5,0.9,1.2",
        }
        found += stream.feed(make_sentences(*(kinds[each] for each in order)))
        if n in silent:
            found += stream.flush()
    assert all(isinstance(each, NmeaEpoch) for each in found)
    return [(each.time_of_day // 1_000_000 % 10, each.speed / KNOT, each.heading) for each in found]  # type: ignore[union-attr]


ORDERS = [
    ["VTG", "GGA"],
    ["GGA", "VTG"],
    ["HDT", "GGA", "VTG"],
    ["GSA", "VTG", "HDT", "GGA"],
    ["VTG", "GGA", "GSA"],
    ["GGA", "GSA", "HDT", "VTG"],
]


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("silent", [range(8), (0, 1), (2,), ()])
def test_given_sentences_without_a_time_when_they_lead_or_follow_then_no_epoch_has_anothers(
    order: list[str], silent: Sequence[int]
):
    found = cycles(order, silent)
    assert len(found) >= 6
    for second, *motion in found:
        assert all(value != value or value == pytest.approx(second) for value in motion)
    if len(silent) == 8:
        # the first cycle may have begun before the line was opened, and two must have shown the order
        for second, speed, _ in found[3:]:
            assert speed == pytest.approx(second)


@pytest.mark.parametrize("order", ORDERS[:2])
def test_given_the_order_learned_from_silence_when_the_line_is_full_then_motion_is_published(order: list[str]):
    for second, speed, _ in cycles(order, (0, 1))[2:-1]:
        assert speed == pytest.approx(second)


def test_given_a_pause_amid_a_cycle_when_it_contradicts_the_others_then_motion_is_left_out_rather_than_wrong():
    stream, found = GpsStream(), []
    for n in range(8):
        found += stream.feed(make_sentences(gga(f"12000{n}.00")))
        if n == 3:
            found += stream.flush()
        found += stream.feed(make_sentences(f"GPVTG,90.0,T,,M,{n}.0,N,,K,A"))
    found += stream.flush()
    wrong = [each for each in found if abs(each.speed / KNOT - each.time_of_day // 1_000_000 % 10) > 0.1]  # type: ignore[union-attr,operator]
    assert len(wrong) <= 1
