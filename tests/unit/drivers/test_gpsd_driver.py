"""gpsd as a source of fixes: reports, sigmas, several receivers, and what goes wrong on a line."""

from __future__ import annotations

import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support_gps import START, Line, drive, split_in_half, split_randomly

from modelserver.messages import FixType
from msdrivers.devices.gpsd import GpsdDriver, GpsdFormat, GpsdSettings
from msdrivers.devices.stream import FrameScanner
from msdrivers.emulate.gps import GpsdEmulator
from msdrivers.endpoint import EndpointPhase


def connect(seconds: float = 30.0, has_gst: bool = True, **more: object) -> Line:
    device = GpsdEmulator(drive(seconds, 5.0), has_gst=has_gst)
    return Line(GpsdDriver(GpsdSettings("gps")), device, **more)  # type: ignore[arg-type]


@pytest.mark.parametrize("has_gst", [True, False])
def test_given_gpsd_then_each_fix_is_published_as_it_was_measured(has_gst: bool) -> None:
    line = connect(has_gst=has_gst).open().run(10.0)
    assert line.status_text.splitlines()[-1] == "streaming: gpsd, receiving TPV"
    assert len(line.samples) >= 48
    truth = {each.header.utime: each for each in drive(30.0, 5.0)}
    for sample in line.samples:
        same = truth[sample.header.device_utime]
        assert (sample.fix_type, sample.hdop, sample.satellites) == (same.fix_type, same.hdop, 9)
        assert (sample.latitude_deg, sample.longitude_deg) == (same.latitude_deg, same.longitude_deg)
        assert (sample.height_ellipsoidal, sample.undulation) == (same.height_ellipsoidal, same.undulation)
        assert sample.velocity == pytest.approx(same.velocity)
        assert sample.course == pytest.approx(math.pi / 4)
        if has_gst:
            assert sample.position_covariance == pytest.approx(same.position_covariance)
        else:
            assert sample.position_covariance is None
        assert 0 <= sample.header.host_utime - sample.header.device_utime < 60_000


@pytest.mark.parametrize("fix_type", FixType)
def test_given_a_type_of_fix_then_it_is_published(fix_type: FixType) -> None:
    line = Line(GpsdDriver(GpsdSettings("gps")), GpsdEmulator(drive(8.0, 5.0, fix_type))).open().run(6.0)
    assert {each.fix_type for each in line.samples} == {fix_type}


@pytest.mark.parametrize(
    ("heights", "height"),
    [
        ({"alt": 152.3}, 152.3),
        ({"alt": 152.3, "altMSL": 150.0}, 150.0),
        ({"alt": 152.3, "altHAE": 199.0}, None),
        ({}, None),
    ],
)
def test_given_the_height_of_releases_up_to_3_19_then_it_is_that_above_mean_sea_level(
    heights: dict[str, float], height: float | None
) -> None:
    line = Line(GpsdDriver(GpsdSettings("gps")), GpsdEmulator(()))
    line.open()
    report = {"class": "TPV", "mode": 3, "time": "2027-01-15T08:00:00.000Z", "lat": 50.0, "lon": 8.0}
    line.deliver(json.dumps(report | heights).encode() + b"\n")
    line.run(0.1)
    (sample,) = line.samples
    assert sample.height_msl == height if height is not None else math.isnan(sample.height_msl)


def test_given_several_receivers_then_only_the_chosen_one_is_used() -> None:
    for receiver, count in (("/dev/ttyACM0", 2), ("/dev/ttyUSB9", 0)):
        line = Line(GpsdDriver(GpsdSettings("gps", receiver=receiver)), GpsdEmulator(()))
        line.open()
        for second in range(2):
            report = {"class": "TPV", "device": "/dev/ttyACM0", "mode": 3, "lat": 50.0, "lon": 8.0}
            line.deliver(json.dumps(report | {"time": f"2027-01-15T08:00:0{second}.000Z"}).encode() + b"\n")
            line.run(0.1)
        assert len(line.samples) == count


@pytest.mark.parametrize("to_host", [split_in_half, lambda data: split_randomly(data, len(data))])
def test_given_split_bytes_then_every_fix_is_published(to_host: object) -> None:
    line = connect(to_host=to_host).open().run(25.0)
    assert len(line.samples) >= 120
    stamps = [each.header.device_utime for each in line.samples]
    assert stamps == sorted(set(stamps))


def test_given_gpsd_that_was_away_when_it_is_back_then_fixes_are_published_again() -> None:
    line = connect(120.0).open().run(5.0)
    line.is_broken = True
    line.run(30.0)
    assert "no gpsd answers on this line: received nothing" in line.status_text
    line.is_broken = False
    line.run(30.0)
    assert line.phases[-1] is EndpointPhase.STREAMING
    assert line.samples[-1].header.device_utime > START + 60_000_000
    assert not line.reopens


def test_given_fields_that_are_none_then_they_are_not_known() -> None:
    line = Line(GpsdDriver(GpsdSettings("gps")), GpsdEmulator(()))
    line.open()
    line.deliver(
        b'{"class":"TPV","mode":3,"lat":"fifty","lon":8,"time":"soon","status":"x"}\n'
        b'{"class":"TPV","mode":3,"lat":1e999,"lon":NaN,"time":5}\n'
        b'[1,2]\n{"class":5}\n{"class":"TPV"\n'
    )
    line.run(0.1)
    assert [each.fix_type for each in line.samples] == [FixType.NONE, FixType.NONE]
    assert all(each.header.device_utime == 0 for each in line.samples)
    assert line.driver.counts["rejected.json"] >= 1


HEAD = {"device": "/dev/ttyACM0", "time": "2027-01-15T08:00:00.000Z"}
FIX = {"class": "TPV", **HEAD, "mode": 3, "lat": 50.0, "lon": 8.0}


def receive(*reports: dict[str, object] | bytes, **settings: object) -> Line:
    line = Line(GpsdDriver(GpsdSettings("gps", **settings)), GpsdEmulator(()))  # type: ignore[arg-type]
    line.open()
    for each in reports:
        line.deliver((each if isinstance(each, bytes) else json.dumps(each).encode()) + b"\r\n")
    line.run(0.1)
    return line


def test_given_a_release_without_usat_then_the_used_satellites_are_counted() -> None:
    satellites = [{"PRN": n, "ss": 30, "used": n % 2 == 0} for n in range(12)]
    sky = {"class": "SKY", "device": "/dev/ttyACM0", "hdop": 1.5, "satellites": satellites}
    (sample,) = receive(sky, FIX).samples
    assert (sample.satellites, sample.hdop) == (6, 1.5)


def test_given_a_sky_report_in_two_then_dilution_and_satellites_are_of_both() -> None:
    dilution = {"class": "SKY", **HEAD, "hdop": 0.9, "pdop": 1.4}
    satellites = {"class": "SKY", **HEAD, "nSat": 20, "uSat": 11, "satellites": []}
    for both in ((dilution, satellites), (satellites, dilution)):
        (sample,) = receive(*both, FIX).samples
        assert (sample.satellites, sample.hdop, sample.pdop) == (11, 0.9, 1.4)


def test_given_several_reports_of_an_instant_then_the_fix_has_what_all_have() -> None:
    later = {"class": "TPV", **HEAD, "mode": 3, "lat": 50.0, "lon": 8.0, "altMSL": 150.0, "track": 90.0, "speed": 2.0}
    line = receive(FIX, later)
    (sample,) = line.samples
    assert (sample.height_msl, sample.speed) == (150.0, 2.0)
    assert line.driver.counts["repeated"] == 1


def test_given_numbers_as_printf_writes_those_that_are_none_then_the_report_is_used() -> None:
    line = receive(
        b'{"class":"TPV","mode":3,"time":"2027-01-15T08:00:00.000Z","lat":50.0,"lon":8.0,"epx":nan,"climb":-inf}'
    )
    (sample,) = line.samples
    assert sample.fix_type is FixType.FIX_3D
    assert not line.driver.counts["rejected.json"]


@pytest.mark.parametrize(
    ("report", "settings", "words"),
    [
        ({"class": "DEVICES", "devices": []}, {}, "gpsd has no receiver; name it in DEVICES of /etc/default/gpsd"),
        (
            {"class": "DEVICES", "devices": [{"class": "DEVICE", "path": "/dev/ttyUSB0"}]},
            {"receiver": "/dev/gps"},
            "gpsd has no receiver '/dev/gps'; it has '/dev/ttyUSB0': correct `receiver`",
        ),
        (
            {"class": "DEVICE", "path": "/dev/ttyACM0", "activated": 0},
            {},
            "gpsd has closed '/dev/ttyACM0': is it plugged in",
        ),
        ({"class": "ERROR", "message": "Can't open /dev/gps"}, {}, 'its last error: "Can\'t open /dev/gps"'),
    ],
)
def test_given_gpsd_without_fixes_then_the_status_has_why(
    report: dict[str, object], settings: dict[str, object], words: str
) -> None:
    line = Line(GpsdDriver(GpsdSettings("gps", **settings)), GpsdEmulator(()))  # type: ignore[arg-type]
    line.open().run(1.0)
    line.deliver(json.dumps(report).encode() + b"\r\n")
    line.run(6.0)
    assert words in line.status_text


@given(st.binary(max_size=300), st.integers(0, 100))
def test_given_any_bytes_then_nothing_is_raised_and_pieces_give_the_same(data: bytes, seed: int) -> None:
    data += b'\n{"class":"TPV","mode":1}\n'
    stream, whole = FrameScanner((GpsdFormat(),)), FrameScanner((GpsdFormat(),)).feed(data)
    pieces = [each for piece in split_randomly(data, seed) for each in stream.feed(piece)]
    assert pieces == whole
    assert whole[-1].name == "TPV"
