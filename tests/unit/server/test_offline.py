from __future__ import annotations

import math
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import pytest
from support_signing import envelope

from modelserver import core
from modelserver.core import CoreSettings, CoreState, Instant
from modelserver.errors import UnknownFrameError
from modelserver.estimation.history import LocalizerEvent
from modelserver.geometry import ModelBuilder
from modelserver.messages import (
    STALE_SENSORS,
    AbsolutePoseSample,
    Decision,
    Estimate,
    FixType,
    GpsSample,
    Invalid,
    LocalizerSummary,
    Mode,
    Origin,
    Rejected,
    Sample,
    SensorHeader,
    SwitchMode,
    Verdict,
)
from modelserver.server.ingress import SensorChannel
from modelserver.server.recordings import CSV_HEADER, LOOKED_AT, OfflineRun, TrackRow
from modelserver.transforms.pose import Pose
from modelserver.wire.codec import encode
from modelserver.wire.eventlog import LogEvent

ORIGIN = Origin(1000.0, 2000.0, 30.0, 19, True, 7)
T0 = 1_700_000_000_000_000


@dataclass(frozen=True)
class Counting:
    """A localizer whose estimate has the number of samples as easting and the requested time as northing."""

    count_samples: int = 0
    utime: int = 0

    def process(self, sample: Sample | SwitchMode) -> tuple[Counting, tuple[LocalizerEvent, ...]]:
        if isinstance(sample, GpsSample) and sample.fix_type is FixType.NONE:
            return self, (Rejected("sensor:gps", "fix"),)
        decision = Decision(sample.header.utime, sample.header.source, self.count_samples, "any", Verdict.USED)
        return Counting(self.count_samples + 1, max(self.utime, sample.header.utime)), (decision,)

    def navigation(self, utime: int) -> None:
        return None

    def find_stale_sensors(self, utime: int) -> Invalid:
        return self.estimate(utime).invalid & STALE_SENSORS

    def summary(self, utime: int) -> LocalizerSummary:
        return LocalizerSummary(Mode.FULL)

    def estimate(self, utime: int) -> Estimate:
        if not self.count_samples:
            return Estimate(utime, Pose.identity(), invalid=Invalid.NO_FIX | Invalid.NO_IMU)
        pose = Pose((float(self.count_samples), (utime - T0) * 1e-6, 0.0))
        return Estimate(
            utime,
            pose,
            pose,
            pose,
            origin=ORIGIN,
            invalid=Invalid.NOT_MOVED_YET if self.count_samples < 2 else Invalid(0),
        )

    def defer_estimate(self, utime: int) -> Estimate:
        return self.estimate(utime)


def vehicle() -> Any:
    builder = ModelBuilder("test")
    builder.add_body("V").add_frame("Base").add_frame("Mast", Pose((0.0, 0.0, 2.0)))
    model = builder.build()

    def start(now: Instant) -> CoreState:
        return core.start(CoreSettings("V:Base", publish_decisions=False), model, Counting(), now)

    return SimpleNamespace(
        model=model,
        config=SimpleNamespace(base_frame="V:Base"),
        sensor_channels=lambda: {
            "GPS": SensorChannel("gps_t"),
            "MAP": SensorChannel("absolute_pose_t", 40),
            "MODE": SensorChannel("localization_mode_t"),
        },
        start_core=start,
    )


def gps(arrival: int, stamp: int | None = None, fix: FixType = FixType.FIX_3D, channel: str = "GPS") -> LogEvent:
    """Return a fix by its arrival and stamp, microseconds after T0."""
    sample = GpsSample(SensorHeader(T0 + (arrival if stamp is None else stamp), "gps"), fix, 42.0, -71.0)
    return LogEvent(0, T0 + arrival, channel, encode(sample), arrival)


def count_samples(run: OfflineRun, *times: int) -> list[float]:
    """Return the number of samples behind the estimate for each time."""
    return [row.easting - 1000.0 for row in run.rows([T0 + time for time in times])]


def test_given_times_when_replayed_then_an_estimate_rests_on_what_arrived_strictly_before() -> None:
    run = OfflineRun(vehicle(), [gps(100, 0), gps(200, 150), gps(300, 290)], "V:Base")
    assert count_samples(run, 101, 200, 201, 300, 301) == [1, 1, 2, 2, 3]


def test_given_a_measurement_before_the_time_that_arrived_after_it_when_replayed_then_it_is_not_used() -> None:
    run = OfflineRun(vehicle(), [gps(100, 0), gps(500, 110)], "V:Base")
    assert count_samples(run, 400) == [1]


def test_given_a_time_before_anything_arrived_when_replayed_then_the_row_has_the_reason() -> None:
    run = OfflineRun(vehicle(), [gps(100), gps(200)], "V:Base")
    first, second, third = run.rows([T0 - 50, T0 + 150, T0 + 250])
    assert math.isnan(first.easting)
    assert (first.valid, first.invalid) == (False, Invalid.NO_FIX | Invalid.NO_IMU)
    assert (second.valid, second.invalid) == (False, Invalid.NOT_MOVED_YET)
    assert (third.valid, third.invalid) == (True, 0)


def test_given_times_past_the_end_when_replayed_then_predicted_and_then_none() -> None:
    run = OfflineRun(vehicle(), [gps(100), gps(200)], "V:Base")
    near, far = run.rows([T0 + 1_000_000, T0 + 60_000_000])
    assert near.northing == pytest.approx(2001.0)
    assert math.isnan(far.northing)
    assert not far.valid


def test_given_a_rate_when_replayed_then_rows_stand_at_even_times_of_the_log() -> None:
    run = OfflineRun(vehicle(), [gps(0), gps(50_000), gps(100_000)], "V:Base")
    rows = list(run.rows(None, 30.0))
    assert [row.utime - T0 for row in rows] == [0, 33_333, 66_667, 100_000]
    assert [row.easting - 1000.0 for row in rows[1:]] == [1, 2, 2]
    assert math.isnan(rows[0].easting)


def test_given_a_time_asked_twice_when_replayed_then_it_is_answered_twice() -> None:
    assert count_samples(OfflineRun(vehicle(), [gps(100), gps(300)], "V:Base"), 200, 200, 400) == [1, 1, 2]


def test_given_a_mounted_frame_when_replayed_then_its_position_is_relative_to_the_origin() -> None:
    run = OfflineRun(vehicle(), [gps(0), gps(10)], "V:Mast")
    (row,) = run.rows([T0 + 1_000_000])
    assert (row.easting, row.northing, row.up) == pytest.approx((1002.0, 2001.0, 32.0))
    assert row.rotation == (1.0, 0.0, 0.0, 0.0)


def test_given_an_unknown_frame_when_replayed_then_the_error_comes_before_any_work() -> None:
    with pytest.raises(UnknownFrameError):
        OfflineRun(vehicle(), [], "V:Mats")


def test_given_bad_messages_when_replayed_then_they_are_counted_and_the_rest_is_used() -> None:
    whole = gps(10)
    cut = whole._replace(data=whole.data[:40])
    junk = whole._replace(data=b"junk")
    run = OfflineRun(
        vehicle(), [cut, junk, gps(20), gps(30, fix=FixType.NONE), gps(40, channel="RADAR"), gps(50)], "V:Base"
    )
    assert count_samples(run, 100) == [2]
    assert run.rejected == {("GPS", "truncated"): 1, ("GPS", "fingerprint"): 1, ("sensor:gps", "fix"): 1}
    assert (run.events, run.samples) == (6, 5)
    assert (run.first_utime, run.last_utime) == (T0 + 10, T0 + 50)


def test_given_aiding_sources_and_modes_when_replayed_then_they_are_processed_at_their_instants() -> None:
    pose = AbsolutePoseSample(SensorHeader(T0 + 20, "map"), "V:Base", "World:UTM", (1.0, 2.0, 3.0))
    command = SwitchMode(SensorHeader(T0 + 30, "console"), Mode.NO_GPS)
    decisions: list[Decision] = []
    log = [gps(10), LogEvent(0, T0 + 20, "MAP", encode(pose), 20), LogEvent(0, T0 + 30, "MODE", encode(command), 30)]
    run = OfflineRun(vehicle(), log, "V:Base", decisions.append)
    assert count_samples(run, 100) == [3]
    assert [(each.source, each.utime - T0) for each in decisions] == [("gps", 10), ("map", -20), ("console", 30)]
    assert (run.samples, run.unconfigured_channels) == (3, set())


def test_given_a_signed_mode_command_when_replayed_then_it_is_processed_as_a_plain_one() -> None:
    command = SwitchMode(SensorHeader(T0 + 30, "console"), Mode.NO_GPS)
    sealed = encode(envelope(command, T0 + 30, channel="MODE"))
    other = encode(envelope(command, T0 + 30, channel="PLATFORM_RELOAD_MODEL"))
    decisions: list[Decision] = []
    log = [gps(10)]
    log += [LogEvent(0, T0 + 30, "MODELSERVER_SIGNED", data, 30) for data in (sealed, other, b"junk", sealed[:-1])]
    run = OfflineRun(vehicle(), log, "V:Base", decisions.append)
    assert count_samples(run, 100) == [2]
    assert [(each.source, each.utime - T0) for each in decisions] == [("gps", 10), ("console", 30)]
    assert (run.samples, run.unconfigured_channels) == (2, {"MODELSERVER_SIGNED"})


def test_given_no_callback_for_decisions_when_replayed_then_the_rows_are_the_same() -> None:
    decisions: list[Decision] = []
    log = [gps(100), gps(200), gps(300)]
    with_, without = (list(OfflineRun(vehicle(), log, "V:Base", each).rows(None)) for each in (decisions.append, None))
    assert [row.to_csv() for row in with_] == [row.to_csv() for row in without]
    assert len(decisions) == 3


def test_given_a_row_when_written_then_tenths_of_a_millimeter_survive() -> None:
    bounds, sigmas, place = (2.34567, 0.1234567), (0.12345, 0.23456, 0.34567, 0.0123456), (42.37, -71.1234567891, 39.7)
    levels = (1.23456, 0.0123456, 1.234e-9)
    row = TrackRow(
        T0, 323204.28072018, 4693737.10237474, -21.00005, (0.5, -0.5, 0.5, -0.5), True, 0, bounds, sigmas, place, levels
    )
    assert row.to_csv() == (
        "1700000000000000,323204.28072,4693737.10237,-21.00005,0.500000000,-0.500000000,0.500000000,-0.500000000,1,0,"
        "2.3457,0.123457,0.1235,0.2346,0.3457,0.012346,42.370000000,-71.123456789,39.70000,1.2346,0.012346,1.23e-09"
    )
    assert TrackRow(T0, invalid=3).to_csv() == "1700000000000000,nan,nan,nan,nan,nan,nan,nan,0,3,,,,,,,,,,,,"
    assert row.to_csv().count(",") == CSV_HEADER.count(",")


@pytest.mark.parametrize(
    ("offset_s", "known"),
    [
        (-1_700_000_000.0, "(from 0 on, as of a simulation"),
        (3600.0, "3,600.0 s (1 h: a time zone?) ahead of"),
        (-7200.3, "(2 h: a time zone?) behind"),
        (18.0, "18.0 s (GPS time instead of UTC?) ahead of"),
        (-0.999 * T0 * 1e-6, "(milliseconds instead of microseconds?) behind"),
        (999.0 * T0 * 1e-6, "(nanoseconds instead of microseconds?) ahead of"),
        (-40.0, "all stamps are 40.0 s behind their receipt"),
    ],
)
def test_given_stamps_on_another_axis_then_the_log_is_evaluated_on_it_and_the_amount_is_reported(
    offset_s: float, known: str
) -> None:
    offset = round(offset_s * 1e6) + 1000 * (offset_s < -1e9)
    run = OfflineRun(vehicle(), [gps(n * 100, n * 100 + offset) for n in range(5)], "V:Base")
    rows = list(run.rows([T0 + offset + 150, T0 + offset + 350]))
    assert [row.easting - 1000.0 for row in rows] == [2, 4]
    (sentence,) = run.axis.describe()
    assert known in sentence
    assert "the axis of the stamps is used" in sentence


def test_given_one_source_with_another_clock_then_that_one_is_named_and_nothing_is_moved() -> None:
    log = [event for n in range(5) for event in (gps(n * 100), absolute_pose(n * 100 + 50, -3_600_000_000))]
    run = OfflineRun(vehicle(), log, "V:Base")
    assert [row.utime for row in run.rows([T0 + 150])] == [T0 + 150]
    assert run.axis.describe() == [
        "the stamps on MAP are 3,600.0 s (1 h: a time zone?) behind their receipt: the clock of that source is off"
    ]


def test_given_stamps_that_are_late_by_seconds_then_they_are_as_they_are() -> None:
    run = OfflineRun(vehicle(), [gps(n * 100, n * 100 - 3_000_000) for n in range(5)], "V:Base")
    list(run.rows([T0]))
    assert run.axis.describe() == []


def absolute_pose(arrival: int, offset: int) -> LogEvent:
    header = SensorHeader(T0 + arrival + offset, "map")
    data = encode(AbsolutePoseSample(header, "V:Base", "World:UTM", (1.0, 2.0, 3.0)))
    return LogEvent(0, T0 + arrival, "MAP", data, arrival)


def test_given_more_events_than_are_looked_at_then_none_is_lost() -> None:
    run = OfflineRun(vehicle(), (gps(n) for n in range(LOOKED_AT + 3)), "V:Base")
    assert count_samples(run, 10 * LOOKED_AT) == [LOOKED_AT + 3]
