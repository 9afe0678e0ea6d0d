"""What the viewer's map shows of a drive."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

pytest.importorskip("plotly", reason="the extra view is not installed: pip install -e '.[view]'")

from modelserver.earth.geodesy import geodesy_of, origin_at
from modelserver.messages import VALID, FixType, GpsSample, Invalid, SensorHeader
from modelserver.wire.codec import encode
from mstools.recordings.drive import Drive, FixColor
from mstools.view.map import MIN_GRID_PX, View, describe_map, describe_origin, fit_view, make_grid

START = 1_750_000_000_000_000
ORIGIN = origin_at(50.27, -111.18, 700.0)


def add_fix(drive: Drive, number: int, east: float, north: float) -> None:
    geodesy = geodesy_of(ORIGIN)
    place = geodesy.geodetic_from_utm(ORIGIN.easting + east, ORIGIN.northing + north, ORIGIN.height)
    header = SensorHeader(START + number * 100_000, "gps", number, START + number * 100_000)
    covariance = (4.0, 1.0, 0.0, 1.0, 9.0, 0.0, 0.0, 0.0, 16.0)
    sample = GpsSample(header, FixType.FIX_3D, *place, position_covariance=covariance)
    drive.feed("GPS", encode(sample), header.utime)


def make_drive(count: int = 0) -> Drive:
    drive = Drive(origin=ORIGIN)
    for k in range(count):
        add_fix(drive, k, 3.0 * k, 0.0)
    return drive


def add_poses(drive: Drive, flags: list[Invalid]) -> None:
    for k, flag in enumerate(flags):
        drive.poses.append(START + k * 100_000, k * 1.0, 0.0, 0.0, 1.0, *(0.0,) * 9, 2.0, 0.1, flag, 1)


def describe(drive: Drive, view: View) -> dict[str, object]:
    found = describe_map(drive, drive.get_picture(), math.inf, view, {"Rover:Antenna": (1.0, 2.0, 3.0)})
    # as it is sent
    return dict(json.loads(json.dumps(found, allow_nan=False)))


def test_given_fixes_then_their_places_and_variances_are_in_world_utm() -> None:
    drive = make_drive(5)
    found = describe(drive, View(0.0, 0.0, 0.1, 800, 600))
    (east, north, color, *variances), *_ = found["fixes"]
    assert (east, north) == pytest.approx((0.0, 0.0), abs=0.01)
    assert color == FixColor.NO_DECISION
    assert variances == [4.0, 9.0, 1.0]
    assert [round(each[0]) for each in found["fixes"]] == [0, 3, 6, 9, 12]
    assert found["places"] == {"Rover:Antenna": [1.0, 2.0, 3.0]}


def test_given_many_fixes_in_a_pixel_then_one_is_sent_but_a_rejected_one_too() -> None:
    drive = make_drive()
    for k in range(50):
        add_fix(drive, k, 0.001 * k, 0.0)
    table = drive._fixes["gps"]
    table.rows[7, 6] = FixColor.REJECTED
    found = describe(drive, View(0.5, 0.5, 1.0, 800, 600))
    assert sorted(each[2] for each in found["fixes"]) == [FixColor.REJECTED, FixColor.NO_DECISION]
    assert len(describe(drive, View(5000.0, 0.0, 1.0, 800, 600))["fixes"]) == 0


def test_given_an_invalid_part_then_the_track_has_a_line_for_each_validity_and_no_gap() -> None:
    drive = make_drive()
    add_poses(drive, [VALID] * 10 + [Invalid.NO_FIX] * 10 + [VALID] * 10)
    lines = describe(drive, View(15.0, 0.0, 0.1, 800, 600))["trail"]
    assert [each["valid"] for each in lines] == [True, False, True]
    assert lines[0]["points"][-1] == lines[1]["points"][0]
    assert lines[-1]["points"][-1] == [29.0, 0.0]


def test_given_a_long_track_then_what_is_sent_is_bounded_by_the_pixels() -> None:
    drive = make_drive()
    for k in range(100_000):
        drive.poses.append(START + k * 33_000, 0.1 * k, 0.0, 0.0, 1.0, *(0.0,) * 9, 2.0, 0.1, 0, 1)
    lines = describe(drive, View(5000.0, 0.0, 20.0, 800, 600))["trail"]
    assert sum(len(each["points"]) for each in lines) < 1600
    near = describe(drive, View(5000.0, 0.0, 0.1, 800, 600))["trail"]
    assert sum(len(each["points"]) for each in near) < 3000


@pytest.mark.parametrize("size", [100.0, 2000.0])
def test_given_a_place_on_the_map_then_its_geodetic_coordinates_are_exact_to_a_centimeter(size: float) -> None:
    view = View(1500.0, -700.0, size / 1000.0, 800, 600)
    found = describe_origin(ORIGIN, view)
    assert found is not None
    geodesy = geodesy_of(ORIGIN)
    for x, y in np.random.default_rng(1).uniform(-1.0, 1.0, (20, 2)):
        east, north = view.east + x * found["half"], view.north + y * found["half"]
        terms = np.array([1.0, x, y, x * x, x * y, y * y])
        latitude, longitude = terms @ found["latitude"], terms @ found["longitude"]
        utm = geodesy.utm_from_geodetic(latitude, longitude, 0.0)
        assert math.dist(utm[:2], (ORIGIN.easting + east, ORIGIN.northing + north)) < 0.01


def test_given_a_track_then_the_view_that_fits_has_all_of_it_in_the_middle() -> None:
    drive = make_drive()
    add_poses(drive, [VALID] * 101)
    view = fit_view(drive, 1000, 500)
    west, _, east, _ = view.bounds
    assert west < 0.0 < 100.0 < east
    assert (view.east, view.north) == pytest.approx((50.0, 0.0))
    assert east - west < 130.0


def test_given_fixes_alone_then_they_are_placed_around_the_first_and_the_drive_has_their_time() -> None:
    drive = Drive()
    for k in range(20):
        add_fix(drive, k, 3.0 * k, 0.0)
    assert drive.origin is not None
    assert drive.end - drive.begin == 1_900_000
    places, _ = drive.get_fixes(drive.end)
    assert places[-1][:2] - places[0][:2] == pytest.approx((57.0, 0.0), abs=0.01)


@pytest.mark.parametrize("scale", [0.01, 0.3, 7.0, 150.0])
def test_given_a_grid_of_utm_then_its_lines_are_at_round_coordinates_not_too_near(scale: float) -> None:
    view = View(1234.5, -678.9, scale, 800, 600)
    lines = make_grid(ORIGIN, view, "utm")
    for letter, axis, first in (("E", 0, ORIGIN.easting), ("N", 1, ORIGIN.northing)):
        found = [line for line in lines if line["label"].endswith(letter)]
        places = [line["points"][0][axis] + first for line in found]
        assert [float(line["label"][:-1]) for line in found] == pytest.approx(places, abs=0.002)
        steps = np.diff(places) / scale
        assert np.all((steps > 0.99 * MIN_GRID_PX) & (steps < 2.6 * MIN_GRID_PX))
        assert len(found) >= 3


@pytest.mark.parametrize("scale", [0.01, 0.3, 7.0, 150.0])
def test_given_a_grid_of_degrees_then_each_point_of_a_line_has_the_coordinate_of_its_label(scale: float) -> None:
    lines = make_grid(ORIGIN, View(1234.5, -678.9, scale, 800, 600), "geodetic")
    geodesy = geodesy_of(ORIGIN)
    for line in lines:
        text, side = line["label"].split("\u00b0 ")
        value = float(text) * (-1.0 if side in "SW" else 1.0)
        for east, north in line["points"]:
            place = geodesy.geodetic_from_utm(ORIGIN.easting + east, ORIGIN.northing + north, 0.0)
            # rounded to a millimeter
            assert place[1 if line["is_upright"] else 0] == pytest.approx(value, abs=2e-8)
    assert sum(line["is_upright"] for line in lines) >= 3
    assert sum(not line["is_upright"] for line in lines) >= 3


def test_given_a_view_beyond_the_zone_then_there_is_no_grid_of_degrees() -> None:
    assert make_grid(ORIGIN, View(0.0, 0.0, 2000.0, 8000, 8000), "geodetic") == []


def test_given_a_view_across_180_degrees_then_its_meridians_have_both_sides() -> None:
    lines = make_grid(origin_at(-17.0, 179.99, 0.0), View(0.0, 0.0, 10.0, 800, 600), "geodetic")
    sides = {line["label"][-1] for line in lines if line["is_upright"]}
    assert sides == {"E", "W"}
    assert sum(line["is_upright"] for line in lines) < 10
