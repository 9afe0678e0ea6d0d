"""What the viewer's charts show of a drive."""

from __future__ import annotations

import base64
import math
from typing import Any

import numpy as np
import pytest

pytest.importorskip("plotly", reason="the extra view is not installed: pip install -e '.[view]'")

from modelserver.messages import Invalid
from mstools.recordings.drive import QUATERNION, Drive
from mstools.recordings.pose_signals import compute_headings, compute_signals, compute_speeds
from mstools.report.charts import COLUMNS
from mstools.view.signals import CHARTS, Span, make_panels, make_strip

START = 1_750_000_000_000_000
SPEED, RADIUS = 3.0, 8.0


def make_drive(seconds: float, hz: float = 30.0) -> Drive:
    """Return a drive on a circle, eastwards at first, whose pose is invalid in its second quarter."""
    drive = Drive()
    for k in range(round(seconds * hz)):
        t = k / hz
        turned = SPEED / RADIUS * t
        invalid = Invalid.NO_FIX if 0.25 < t / seconds < 0.5 else 0
        place = RADIUS * math.sin(turned), RADIUS * (1.0 - math.cos(turned)), 0.0
        rotation = math.cos(0.5 * turned), 0.0, 0.0, math.sin(0.5 * turned)
        drive.poses.append(
            START + round(t * 1e6), *place, *rotation, *(4.0, 0.0, 0.0, 1.0, 0.0, 1.0), 5.0, 0.1, invalid, 1
        )
    return drive


def get_span(drive: Drive, begin: float, end: float) -> Span:
    return Span(drive.begin + round(begin * 1e6), drive.begin + round(end * 1e6), drive.begin)


def read(values: dict[str, str]) -> np.ndarray[Any, Any]:
    return np.frombuffer(base64.b64decode(values["bdata"]), "<f4")


def test_given_a_circle_then_speed_and_heading_are_those_of_the_drive() -> None:
    drive = make_drive(10.0)
    utimes, rows = drive.poses.utimes, drive.poses.rows
    assert compute_speeds(utimes, rows)[10:-10] == pytest.approx(np.full(len(rows) - 20, SPEED), rel=1e-3)
    headings = compute_headings(rows[:, QUATERNION])
    assert headings[0] == pytest.approx(90.0)
    assert headings[30] == pytest.approx(90.0 - math.degrees(SPEED / RADIUS), abs=1e-6)


def test_given_a_reset_or_a_gap_then_no_speed_is_computed_across_it() -> None:
    drive = make_drive(2.0)
    last = drive.poses.last
    for k in range(5):
        drive.poses.append(last + 33_000 * (k + 1), 500.0, 0.0, 0.0, 1.0, *(0.0,) * 12, 2)
    drive.poses.append(last + 60_000_000, 900.0, 0.0, 0.0, 1.0, *(0.0,) * 12, 2)
    speeds = compute_speeds(drive.poses.utimes, drive.poses.rows)
    assert np.nanmax(speeds) < 2 * SPEED
    assert math.isnan(speeds[-1])


def test_given_odometry_then_a_correction_of_the_pose_is_no_speed() -> None:
    drive = make_drive(10.0)
    drive.odometry = make_drive(10.0).poses
    drive.poses.rows[150:, 0] += 0.8
    assert drive.motion is drive.odometry
    chart = read(make_panels(drive, get_span(drive, 0.0, 10.0), ["speed"])["data"][0]["y"])
    assert np.nanmax(chart) == pytest.approx(SPEED, rel=0.01)
    assert compute_signals(drive, int(drive.poses.utimes[150])).speed == pytest.approx(SPEED, rel=0.01)


def test_given_an_hour_then_a_chart_has_its_extremes_and_a_zoom_all_of_its_points() -> None:
    drive = make_drive(3600.0)
    drive.poses.rows[50_000, 0] += 10.0
    whole = make_panels(drive, get_span(drive, 0.0, 3600.0), ["speed"])["data"][0]
    assert len(read(whole["x"])) <= 4 * COLUMNS + 8
    assert np.nanmax(read(whole["y"])) > 20.0
    zoomed = make_panels(drive, get_span(drive, 100.0, 102.0), ["speed"])["data"][0]
    assert len(read(zoomed["x"])) == pytest.approx(60, abs=3)
    assert read(zoomed["x"])[1] == pytest.approx(100.0, abs=0.05)


def test_given_an_invalid_quarter_then_the_strip_shows_it_with_its_reason() -> None:
    drive = make_drive(40.0)
    valid, reason = make_strip(drive, get_span(drive, 0.0, 40.0))["data"]
    assert valid["y"][0] == "valid"
    assert reason["y"] == ["no_fix"]
    assert reason["base"][0] == pytest.approx(10.0, abs=0.1)
    assert reason["x"][0] == pytest.approx(10.0, abs=0.1)
    assert sum(valid["x"]) == pytest.approx(30.0, abs=0.2)
    assert Invalid.NO_FIX.explain()[:10] in reason["text"][0]


def test_given_a_zoom_then_the_strip_is_cut_to_it() -> None:
    drive = make_drive(40.0)
    (only,) = make_strip(drive, get_span(drive, 12.0, 15.0))["data"][1:]
    assert (only["base"], only["x"]) == ([12.0], [3.0])


def test_given_no_data_then_each_chart_is_empty_and_unknown_names_are_left_out() -> None:
    figure = make_panels(Drive(), Span(START, START + 1_000_000, START), [*CHARTS, "state x", "other"])
    assert len([key for key in figure["layout"] if key.startswith("yaxis")]) == len(CHARTS) + 1
