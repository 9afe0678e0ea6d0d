"""Receiver logs of many makers compared with gpsd's reports: times, positions, speeds, courses, fix status.

gpsd prints a report after each sentence and carries values from one to the next; the last report of an instant holds
the values of its sentences. Only values of the receiver are compared: not a speed that gpsd computed from two
positions, nor a third dimension that it carries over from an earlier instant or sets against the receiver's own GSA.
"""

from __future__ import annotations

import itertools
import json
import math
import re
from collections.abc import Iterator, Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest
from support_gps import split_randomly

from modelserver.messages import FixType
from msdrivers.devices.gps import ROLLOVER
from msdrivers.devices.gps.driver import GpsStream
from msdrivers.devices.gps.nmea import NmeaEpoch

pytestmark = pytest.mark.realdata

Report = Mapping[str, Any]

EXCEPTIONS = {
    "rst39": "gpsd takes 2014 for a date that has rolled over: its time is 1024 weeks later than the receiver's",
    "tcp-torture": "gpsd takes 2007 for a date that has rolled over, in this file alone",
    "april6_2019": "a sentence with the date '2208-1' is rejected; gpsd uses its position without a time",
}
"""Recordings whose values differ, and why."""

MIN_FILES = 50
"""Recordings with NMEA positions."""

STATUS = {2: FixType.DIFFERENTIAL, 3: FixType.RTK_FIXED, 4: FixType.RTK_FLOAT, 5: FixType.DEAD_RECKONING}
"""gpsd's `status`, where it is more than "fix"."""


def content(path: Path) -> bytes:
    """Return the log's bytes without the directives for gpsd's own test harness."""
    data = path.read_bytes()
    cookie = re.search(rb"^# Delay-Cookie: (\S)", data, re.MULTILINE)
    if cookie:
        data = b"".join(line.replace(cookie[1], b"") for line in data.splitlines(keepends=True) if line[:1] != b"#")
    return data


def epochs(data: bytes) -> list[NmeaEpoch]:
    stream = GpsStream()
    return [each for each in [*stream.feed(data), *stream.flush()] if isinstance(each, NmeaEpoch)]


def reports(path: Path) -> list[Report]:
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    return [json.loads(line) for line in lines if line.startswith("{") and '"class":"TPV"' in line]


def utime(report: Report) -> int:
    return round(datetime.fromisoformat(report["time"]).timestamp() * 1e6)


def last_of_each_instant(found: list[Report]) -> Iterator[Report]:
    """Yield the last report of each instant, if possible one with a fix: gpsd stamps an epoch without time ("no fix")
    with the time before it."""
    for _, run in itertools.groupby((each for each in found if "time" in each), key=lambda each: each["time"]):
        of_instant = list(run)
        fixed = [each for each in of_instant if each["mode"] >= 2]
        yield (fixed or of_instant)[-1]


def print_precision(data: bytes) -> float:
    """Return half the last digit of the coarsest position in a log, degrees, and gpsd's own half digit."""
    minutes = re.findall(rb",\d{4}\.(\d+),[NS],\d{5}\.(\d+),[EW],", data)
    digits = min((len(part) for pair in minutes for part in pair), default=4)
    return 0.5 * 10.0**-digits / 60.0 + 1e-9


def logs(data_dir: Path) -> Iterator[Path]:
    folder = data_dir / "gpsd"
    if not folder.is_dir():
        pytest.skip(f"no {folder.name} among the recordings")
    return iter(sorted(folder.glob("*.log")))


def differences(data: bytes, found: list[Report], later: int = 0) -> Iterator[str]:
    """Yield the differences; `later`: microseconds by which gpsd's times exceed the receiver's."""
    own = epochs(data)
    own_at: dict[int, list[NmeaEpoch]] = {}
    for each in own:
        own_at.setdefault(each.utime, []).append(each)
    tolerance = print_precision(data)
    for report in last_of_each_instant(found):
        at = report["time"]
        of_instant = own_at.get(utime(report) - later, [])
        if report["mode"] == 0:
            continue  # gpsd knows only the time of this instant
        has_fix = report["mode"] >= 2
        if not of_instant:
            if has_fix:
                yield f"{at}: no epoch"
            continue
        if not has_fix:
            if all(each.fix_type is not FixType.NONE for each in of_instant):
                yield f"{at}: a fix where gpsd has none"
            continue
        mine = min(of_instant, key=lambda each: abs(each.latitude - report["lat"]))
        yield from (f"{at}: {what}" for what in differing(mine, report, tolerance))
    # positions before the date was known
    for report in found:
        if "time" not in report and "lat" in report and not any(_near(each, report, tolerance) for each in own):
            yield f"no epoch at {report['lat']}, {report['lon']}"


def _near(epoch: NmeaEpoch, report: Report, tolerance: float) -> bool:
    return abs(epoch.latitude - report["lat"]) <= tolerance and abs(epoch.longitude - report["lon"]) <= tolerance


def differing(mine: NmeaEpoch, report: Report, tolerance: float) -> Iterator[str]:
    if not _near(mine, report, tolerance):
        yield f"place {mine.latitude}, {mine.longitude}, not {report['lat']}, {report['lon']}"
    for name, ours, theirs, bound in (
        ("height", mine.height_msl, report.get("altMSL"), 1e-4),
        ("speed", mine.speed, report.get("speed"), 6e-4),
        ("course", mine.track, report.get("track"), 1e-4),
    ):
        if math.isnan(ours):
            # without pauses the epoch of a VTG's course is ambiguous
            if theirs is not None and name == "course" and "RMC" in mine.kinds:
                yield f"no {name}, not {theirs}"
        elif theirs is None or abs(ours - theirs) > bound:
            yield f"{name} {ours}, not {theirs}"
    if mine.fix_type is FixType.NONE:
        yield "no fix"
    if mine.fix_type > FixType.FIX_3D or report.get("status", 1) in STATUS:
        expected = STATUS.get(report.get("status", 1))
        if mine.fix_type is not expected:
            yield f"{mine.fix_type!r}, not {expected!r}"
    # gpsd never has fewer dimensions than the receiver
    if mine.fix_type is FixType.FIX_3D and report["mode"] != 3:
        yield "three dimensions, not two"
    if mine.fix_type is FixType.FIX_2D and report["mode"] == 3 and "GSA" not in mine.kinds and "GGA" in mine.kinds:
        yield "two dimensions, not three"


def test_given_gpsds_recordings_when_read_then_they_equal_gpsds_reports(data_dir: Path):
    compared = 0
    wrong: dict[str, list[str]] = {}
    for log in logs(data_dir):
        data = content(log)
        found = reports(Path(f"{log}.chk"))
        if not any("lat" in each for each in found) or not any(not math.isnan(each.latitude) for each in epochs(data)):
            continue
        compared += 1
        problems = list(differences(data, found))
        if problems:
            wrong[log.stem] = problems
    assert compared >= MIN_FILES
    assert set(wrong) == set(EXCEPTIONS), "\n".join(
        f"{name}: {'; '.join(problems[:3])}" for name, problems in wrong.items() if name not in EXCEPTIONS
    )
    assert len(EXCEPTIONS) <= 0.1 * compared
    assert len(wrong["april6_2019"]) == 1


@pytest.mark.parametrize("name", ["rst39", "tcp-torture"])
def test_given_a_date_that_gpsd_moves_by_a_rollover_when_compared_then_all_else_agrees(data_dir: Path, name: str):
    log = data_dir / "gpsd" / f"{name}.log"
    if not log.is_file():
        pytest.skip(f"no gpsd/{name}.log among the recordings")
    assert not list(differences(content(log), reports(Path(f"{log}.chk")), later=ROLLOVER))


def test_given_no_fix_when_coordinates_are_there_then_the_fix_is_none(data_dir: Path):
    log = data_dir / "gpsd" / "bn-9015.log"
    if not log.is_file():
        pytest.skip("no gpsd/bn-9015.log among the recordings")
    first = epochs(content(log))[0]
    assert first.fix_type is FixType.NONE
    assert not math.isnan(first.latitude)


@pytest.mark.parametrize("seed", range(2))
def test_given_recordings_when_split_anyhow_then_the_epochs_are_the_same(data_dir: Path, seed: int):
    number = 0
    for log in logs(data_dir):
        data = log.read_bytes()
        whole, pieces = GpsStream(), GpsStream()
        expected = [*whole.feed(data), *whole.flush()]
        parts = [data[n : n + 1] for n in range(len(data))] if seed == 0 else split_randomly(data, seed)
        got = [each for part in parts for each in pieces.feed(part)] + pieces.flush()
        # nan differs from itself, its text does not
        assert repr(got) == repr(expected), log.name
        assert pieces.counts == whole.counts, log.name
        number += 1
    assert number >= MIN_FILES
