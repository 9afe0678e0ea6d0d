"""NovAtel receivers' own bytes: captures of their ports, and streams made to break a parser."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import pytest
from support_gps import split_randomly
from support_pcap import streams

from msdrivers.devices.gps.driver import FIX_TYPES, GpsMessage, GpsStream
from msdrivers.devices.gps.nmea import NmeaEpoch
from msdrivers.devices.gps.novatel import NovatelLog, Position, Prompt, TimeStatus

pytestmark = pytest.mark.realdata

CAPTURES = {
    "bestpos-bestvel-psrdop2-sync.pcap": {"BESTPOS": 33, "BESTVEL": 33, "PSRDOP2": 43},
    "corrimudata.pcap": {"BESTPOS": 28, "INSPVAX": 28, "CORRIMUDATA": 29, "TIME": 2, "INSCOV": 2},
    "gpgga-gprmc-bestpos.pcap": {"BESTPOS": 40, "TIME": 2, "GGA": 40, "RMC": 40},
}
PLACES = {
    "bestpos-bestvel-psrdop2-sync.pcap": (29, -99),
    "corrimudata.pcap": (43, -80),
    "gpgga-gprmc-bestpos.pcap": (29, -99),
}
BROKEN = 7


def novatel(data_dir: Path) -> Path:
    folder = data_dir / "novatel"
    if not folder.is_dir():
        pytest.skip("no novatel among the recordings")
    return folder


def read(data: bytes | Sequence[bytes]) -> tuple[list[GpsMessage], GpsStream]:
    stream = GpsStream()
    parts = [data] if isinstance(data, bytes) else data
    return [each for part in parts for each in stream.feed(part)] + stream.flush(), stream


def names(messages: list[GpsMessage]) -> Counter[str]:
    logs = [each.header.name for each in messages if isinstance(each, NovatelLog)]
    return Counter(logs + [kind for each in messages if isinstance(each, NmeaEpoch) for kind in each.kinds])


@pytest.mark.parametrize("name", CAPTURES)
def test_given_a_capture_when_read_then_every_message_is_there(data_dir: Path, name: str):
    (data,) = streams(novatel(data_dir) / "swri" / name)
    messages, stream = read(data)
    assert names(messages) == CAPTURES[name]
    assert stream.counts["skipped"] == 0
    assert not any(kind.startswith("rejected") for kind in stream.counts)
    for each in messages:
        if isinstance(each, NovatelLog) and isinstance(each.body, Position):
            assert each.header.time_status >= TimeStatus.FINE
            assert (round(each.body.latitude), round(each.body.longitude)) == PLACES[name]
            assert each.body.type in FIX_TYPES


@pytest.mark.parametrize("name", CAPTURES)
def test_given_a_capture_when_split_anyhow_then_the_messages_are_the_same(data_dir: Path, name: str):
    (data,) = streams(novatel(data_dir) / "swri" / name)
    whole, stream = read(data)
    for parts in ([data[n : n + 1] for n in range(len(data))], split_randomly(data, 1), split_randomly(data, 2)):
        again, pieces = read(parts)
        assert repr(again) == repr(whole)
        assert pieces.counts == stream.counts


def test_given_gga_beside_bestpos_when_read_then_they_report_the_same_instants_and_positions(data_dir: Path):
    (data,) = streams(novatel(data_dir) / "swri" / "gpgga-gprmc-bestpos.pcap")
    messages, _ = read(data)
    epochs = [each for each in messages if isinstance(each, NmeaEpoch)]
    positions = [each for each in messages if isinstance(each, NovatelLog) and isinstance(each.body, Position)]
    assert len(epochs) == len(positions) == 40
    for epoch, log in zip(epochs, positions, strict=True):
        assert isinstance(log.body, Position)
        # GPS time is 18 s ahead of UTC
        assert epoch.time_of_day is not None
        assert epoch.time_of_day // 1000 == (log.header.milliseconds - 18_000) % 86_400_000
        assert epoch.latitude == pytest.approx(log.body.latitude, abs=1e-6)
        assert epoch.longitude == pytest.approx(log.body.longitude, abs=2e-6)
        assert epoch.height_msl == pytest.approx(log.body.height, abs=0.01)
        assert epoch.undulation == log.body.undulation


def test_given_streams_made_to_break_a_parser_when_read_then_there_is_no_log_and_nothing_is_buffered(data_dir: Path):
    files = sorted((novatel(data_dir) / "edie").rglob("*sync_error*"))
    assert len(files) == BROKEN
    for file in files:
        messages, stream = read(file.read_bytes())
        assert messages == [], file.name
        assert stream.pending_bytes <= 1024, file.name


def test_given_commands_answers_and_logs_when_read_then_each_is_there(data_dir: Path):
    (file,) = (novatel(data_dir) / "edie").rglob("BESTUTMBIN.GPS")
    messages, stream = read(file.read_bytes())
    assert names(messages) == {"BESTUTM": 2, "VERSION": 1}
    assert [each.port for each in messages if isinstance(each, Prompt)] == ["USB1"] * 3
    assert stream.counts["novatel.OK"] == 3


def test_given_the_same_line_a_thousand_times_when_read_then_each_is_a_log(data_dir: Path):
    (file,) = (novatel(data_dir) / "edie").rglob("BESTPOS.GPS")
    messages, _ = read(file.read_bytes())
    assert names(messages) == {"BESTPOS": 1000}
