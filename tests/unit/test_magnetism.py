"""The earth's magnetic field, against published values."""

from __future__ import annotations

import math
import subprocess
import sys
from datetime import UTC, datetime, timedelta
from itertools import pairwise

import pytest

from modelserver.earth.magnetism import MagnetismError, declination, field_at, is_covered

# WMM2025 test values, table 6 of the report and the file WMM2025_TestValues.txt that the NCEI give out with the
# coefficients: decimal year, height in km, latitude, longitude; north, east, down in nT, declination in degrees.
PUBLISHED = [
    (2025.0, 0, 80, 0, 6521.6, 145.9, 54791.5, 1.28),
    (2025.0, 0, 0, 120, 39677.8, -109.6, -10580.2, -0.16),
    (2025.0, 0, -80, 240, 6117.5, 15751.9, -52022.5, 68.78),
    (2025.0, 100, 80, 0, 6216.0, 92.4, 52598.8, 0.85),
    (2025.0, 100, 0, 120, 37688.6, -96.2, -10152.1, -0.15),
    (2025.0, 100, -80, 240, 5907.6, 14780.3, -49540.7, 68.21),
    (2027.5, 0, 80, 0, 6500.8, 294.5, 54869.4, 2.59),
    (2027.5, 0, 0, 120, 39701.6, -167.4, -10381.8, -0.24),
    (2027.5, 0, -80, 240, 6200.7, 15730.3, -51783.7, 68.49),
    (2027.5, 100, 80, 0, 6196.7, 233.8, 52670.5, 2.16),
    (2027.5, 100, 0, 120, 37711.5, -148.7, -9969.8, -0.23),
    (2027.5, 100, -80, 240, 5984.0, 14760.1, -49317.7, 67.93),
    (2025.0, 65, 43, 93, 24299.852822, 210.517066, 50037.923998, 0.50),
]


def utime_of(year: float) -> int:
    start = datetime(int(year), 1, 1, tzinfo=UTC)
    length = datetime(int(year) + 1, 1, 1, tzinfo=UTC) - start
    return round((start + length * (year % 1)).timestamp()) * 1_000_000


START = utime_of(2026.0)


@pytest.mark.parametrize(("year", "km", "latitude", "longitude", "north", "east", "down", "degrees"), PUBLISHED)
def test_given_a_published_place_when_asked_then_the_published_field(
    year: float, km: float, latitude: float, longitude: float, north: float, east: float, down: float, degrees: float
) -> None:
    field = field_at(latitude, longitude, km * 1000.0, utime_of(year))
    assert field == pytest.approx((east * 1e-9, north * 1e-9, -down * 1e-9), abs=0.06e-9)
    turned = declination(latitude, longitude, km * 1000.0, utime_of(year))
    assert math.degrees(turned) == pytest.approx(degrees, abs=0.0051)


def test_given_a_recording_of_2015_when_asked_then_the_model_of_its_day_answers() -> None:
    # WMM2015 test values, 2015.0, 0 km, 0 N, 120 E, by the first edition; the second differs by tens of nT
    field = field_at(0.0, 120.0, 0.0, utime_of(2015.0))
    assert field == pytest.approx((392.9e-9, 39518.2e-9, 11252.4e-9), abs=40e-9)
    # Boston, where magnetic north has moved from 14.8 W to 14.2 W since
    then, now = (math.degrees(declination(42.36, -71.06, 0.0, utime_of(year))) for year in (2015.5, 2025.5))
    assert -15.2 < then < -14.4
    assert -14.5 < now < -13.5


@pytest.mark.parametrize("year", [2015, 2020, 2025])
def test_given_a_change_of_release_when_crossed_then_the_field_moves_by_the_models_error(year: int) -> None:
    for latitude, longitude in ((50.0, 10.0), (-33.0, 151.0), (42.0, -71.0)):
        before = field_at(latitude, longitude, 0.0, utime_of(year) - 1)
        after = field_at(latitude, longitude, 0.0, utime_of(year))
        assert math.dist(before, after) < 0.3e-6  # two releases, 0.15 microtesla each


def test_given_both_poles_and_the_date_line_when_asked_then_the_field_is_finite_and_continuous() -> None:
    for latitude in (90.0, -90.0):
        assert math.hypot(*field_at(latitude, 0.0, 0.0, START)) == pytest.approx(56e-6, rel=0.05)
    assert field_at(10.0, 180.0, 0.0, START) == pytest.approx(field_at(10.0, -180.0, 0.0, START), abs=1e-15)
    assert field_at(10.0, 370.0, 0.0, START) == pytest.approx(field_at(10.0, 10.0, 0.0, START), abs=1e-15)


def test_given_the_last_microsecond_of_the_models_when_asked_then_it_answers() -> None:
    first, end = utime_of(2010.0), utime_of(2030.0)
    assert (is_covered(first - 1), is_covered(first), is_covered(end - 1), is_covered(end)) == (
        False,
        True,
        True,
        False,
    )
    for utime in (first, end - 1):
        assert 40e-6 < math.hypot(*field_at(50.0, 10.0, 0.0, utime)) < 55e-6


@pytest.mark.parametrize("utime", [0, -1, utime_of(2010.0) - 1, utime_of(2030.0), 1 << 62])
def test_given_a_time_that_no_model_covers_when_asked_then_it_reports_what_to_do(utime: int) -> None:
    with pytest.raises(MagnetismError, match=r"outside 2010 to 2029.*clock"):
        field_at(50.0, 10.0, 0.0, utime)


@pytest.mark.parametrize(
    ("place", "words"),
    [
        ((91.0, 0.0, 0.0), "not a place"),
        ((math.nan, 0.0, 0.0), "not a place"),
        ((0.0, math.inf, 0.0), "not a place"),
        ((0.0, 0.0, 1e6), "ends at heights"),
        ((0.0, 0.0, -6e6), "ends at heights"),
    ],
)
def test_given_no_place_when_asked_then_it_is_reported(place: tuple[float, float, float], words: str) -> None:
    with pytest.raises(MagnetismError, match=words):
        declination(*place, START)


def test_given_a_year_when_it_passes_then_the_field_moves_evenly() -> None:
    quarter = timedelta(days=365) / 4 // timedelta(microseconds=1)
    angles = [declination(50.0, 10.0, 0.0, START + n * quarter) for n in range(5)]
    steps = [b - a for a, b in pairwise(angles)]
    assert steps == pytest.approx([steps[0]] * 4, rel=1e-2)


def test_given_the_module_when_imported_then_the_library_is_not_loaded_yet() -> None:
    code = "import sys, modelserver.earth.magnetism; print('pygeomag' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
