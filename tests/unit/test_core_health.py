"""The health report: its content, its period, and reports at once on changed conditions, without a flood."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support_moving import rover
from support_samples import ORIGIN, START, ScriptedLocalizer, cart, gps, imu, instant_at, start_core

from modelserver import core
from modelserver.core import CoreState, ExpectedSensor, ModelLoaded, percentile, step
from modelserver.core.state import CHANGE_PERIOD_NS, MIN_SILENCE_S
from modelserver.messages import (
    Decision,
    Event,
    Gauges,
    GpsSample,
    Health,
    HealthWarning,
    ImuSample,
    Invalid,
    JointsSample,
    LocalizerSummary,
    Mode,
    Phase,
    PublishHealth,
    RangeSample,
    SensorFinding,
    SensorHeader,
    SwitchMode,
    Tick,
    Verdict,
)
from modelserver.wire.codec import encode

S = 1_000_000


class Run:
    """A core with ticks every 20 ms; `reports` are the published ones, with the seconds since START."""

    def __init__(self, localizer: Any = ScriptedLocalizer(), **settings: object):  # noqa: B008
        self.state: CoreState = start_core(localizer, **settings)
        self.reports: list[tuple[float, Health]] = []
        self.ticks = 0

    def feed(self, event: Event | ModelLoaded, at: float) -> None:
        self.state, outputs = step(self.state, event, instant_at(START + round(at * S)))
        self.reports += [(at, each.health) for each in outputs if isinstance(each, PublishHealth)]

    def until(self, end: float, events: Iterable[tuple[float, Event | ModelLoaded]] = ()) -> None:
        """Tick until `end`, with events at their times between."""
        waiting = sorted(events, key=lambda each: each[0])
        while self.ticks * 0.02 < end:
            at = self.ticks * 0.02
            while waiting and waiting[0][0] <= at:
                when, event = waiting.pop(0)
                self.feed(event, when)
            self.feed(Tick(gauges=Gauges("pc", 7, 3, 1000, at * 0.25)), at)
            self.ticks += 1

    @property
    def last(self) -> Health:
        return self.reports[-1][1]

    def times(self) -> list[float]:
        return [round(at, 3) for at, _ in self.reports]

    def channel(self, name: str) -> Any:
        return {each.channel: each for each in self.last.channels}[name]


def imus(begin: float, end: float, hz: float = 100.0) -> list[tuple[float, Event | ModelLoaded]]:
    return [(begin + n / hz, imu(START + round((begin + n / hz) * S))) for n in range(round((end - begin) * hz))]


# --- content -----------------------------------------------------------------------------------------------


def test_given_configured_sensors_then_those_without_messages_are_reported() -> None:
    sensors = (
        ExpectedSensor("A_GPS", GpsSample),
        ExpectedSensor("A_IMU", ImuSample),
        ExpectedSensor("A_RANGE", RangeSample, "beacons"),
    )
    run = Run(sensors=sensors)
    run.until(0.2, [(0.05, imu(START))])
    silent = {each.channel: each for each in run.last.channels}
    assert set(silent) == {"A_GPS", "A_RANGE", "sensor:imu"}
    assert (silent["A_GPS"].count, silent["A_GPS"].silent) == (0, True)
    assert math.isnan(silent["A_GPS"].age)
    assert not silent["sensor:imu"].silent
    # another source of this type of sample is not the configured one
    run.until(0.4, [(0.25, RangeSample(SensorHeader(START, "other"), "a", (0.0, 0.0, 0.0), "Cart:Base", 1.0, 0.1))])
    assert "A_RANGE" in {each.channel for each in run.last.channels}
    run.until(0.7, [(0.45, RangeSample(SensorHeader(START, "beacons"), "a", (0.0, 0.0, 0.0), "Cart:Base", 1.0, 0.1))])
    assert {each.channel for each in run.last.channels} == {"A_GPS", "sensor:imu", "sensor:other", "sensor:beacons"}


def test_given_a_geometry_without_joints_then_joints_are_not_missed() -> None:
    run = Run(sensors=(ExpectedSensor("JOINTS", JointsSample),))
    run.until(0.1)
    assert run.last.channels == ()


def test_given_gauges_then_the_report_has_them_and_the_share_of_a_processor() -> None:
    run = Run()
    run.until(0.5)
    assert (run.last.host, run.last.pid, run.last.requests_queued, run.last.memory) == ("pc", 7, 3, 1000)
    assert math.isnan(run.last.cpu_share)
    run.until(1.1)
    assert run.last.cpu_share == pytest.approx(0.25)


def test_given_no_gauges_then_unknown_values_are_reported_as_such() -> None:
    run = Run()
    run.feed(Tick(), 0.0)
    assert (run.last.host, run.last.pid, run.last.memory) == ("", 0, 0)
    assert math.isnan(run.last.cpu_share)


def test_given_a_localizer_then_mode_protection_levels_and_fix_age_are_reported() -> None:
    run = Run(ScriptedLocalizer(newest=START, has_state=True))
    run.until(0.51)
    run.until(1.1)
    summary = run.last.localization
    assert (summary.mode, summary.phase, summary.stationary) == (Mode.FULL, Phase.ALIGNED, False)
    assert (summary.horizontal_protection_level, summary.heading_protection_level) == (1.5, 0.1)
    assert summary.fix_age == pytest.approx(1.0)
    assert run.last.origin_id == ORIGIN.origin_id


def test_given_no_localizer_then_nothing_is_reported_of_localization() -> None:
    run = Run(None)
    run.until(0.1)
    assert run.last.localization.mode is None
    assert encode(run.last)


def test_given_samples_with_receipt_times_then_the_greatest_delay_is_reported_once() -> None:
    run = Run()
    run.until(0.1)

    def make_sample(at: float, utime: int) -> ImuSample:
        sample = imu(utime)
        return replace(sample, header=replace(sample.header, host_utime=START + round(at * S)))

    late = [(0.5, make_sample(0.4955, START)), (0.6, make_sample(0.599, START + 1)), (0.7, imu(START + 2))]
    run.until(1.01, late)
    assert run.channel("sensor:imu").delay_max == pytest.approx(0.0045)
    run.until(2.01)
    assert math.isnan(run.channel("sensor:imu").delay_max)


@given(st.lists(st.floats(0.0, 10.0), min_size=1, max_size=200), st.floats(0.0, 1.0))
def test_given_values_then_a_percentile_is_one_of_them_and_enough_do_not_pass_it(
    values: list[float], share: float
) -> None:
    found = percentile(sorted(values), share)
    assert found in values
    assert sum(value <= found for value in values) >= share * len(values) - 1e-9


def test_given_no_values_then_a_percentile_is_0() -> None:
    assert percentile([], 0.99) == 0.0


# --- schedule -----------------------------------------------------------------------------------------------


def test_given_unchanged_conditions_then_reports_follow_their_period() -> None:
    run = Run(None)
    run.until(3.5)
    assert run.times() == [0.0, 1.0, 2.0, 3.0]


def test_given_a_change_then_a_report_goes_out_within_a_tenth_of_a_second_and_the_period_stays() -> None:
    run = Run(None)
    run.until(2.5, [(0.33, HealthWarning("journal", "the disk is full"))])
    first, change, *others = run.times()
    assert first == 0.0
    assert 0.33 <= change <= 0.33 + CHANGE_PERIOD_NS * 1e-9
    assert others == [1.0, 2.0]
    assert run.reports[1][1].warnings == (("journal", "the disk is full"),)


def test_given_validity_that_is_lost_then_it_is_reported_at_once_with_the_reason() -> None:
    run = Run(ScriptedLocalizer(stale_s=0.5))
    run.until(3.0, imus(0.0, 1.25))
    states = {(health.state, health.invalid_reasons) for _, health in run.reports}
    assert (core.RUNNING, Invalid(0)) in states
    # STALE after 1.74 s
    lost = next(at for at, health in run.reports if health.state == core.DEGRADED)
    assert 1.74 <= lost <= 1.74 + 0.021 + CHANGE_PERIOD_NS * 1e-9


def test_given_a_new_geometry_then_its_revision_is_reported_at_once() -> None:
    other = rover()
    run = Run(None)
    run.until(0.9, [(0.4, ModelLoaded(None, other, None))])
    assert [health.model_revision for _, health in run.reports] == [cart().revision, other.revision]


def test_given_a_sensor_that_falls_silent_and_returns_then_both_are_reported() -> None:
    run = Run(None)
    run.until(6.0, [*imus(0.0, 2.0), *imus(4.5, 6.0)])
    silent = [(at, next(each.silent for each in health.channels)) for at, health in run.reports if health.channels]
    changes = [(at, now) for (_, before), (at, now) in itertools.pairwise(silent) if before != now]
    (fell, gone), (back, there) = changes
    assert (gone, there) == (True, False)
    assert 1.99 + MIN_SILENCE_S <= fell <= 1.99 + MIN_SILENCE_S + 0.13
    assert 4.5 <= back <= 4.63


def test_given_a_slow_source_then_its_usual_interval_is_no_silence() -> None:
    run = Run(None)
    slow = [(n * 1.5, gps(START + round(n * 1.5 * S))) for n in range(8)]
    run.until(13.0, slow)
    assert not any(each.silent for _, health in run.reports for each in health.channels)
    run.until(20.0)
    assert run.channel("sensor:gps").silent


def test_given_a_long_silence_then_a_second_one_is_reported_as_soon_as_the_first() -> None:
    run = Run(None)
    run.until(64.0, [*imus(0.0, 2.0), *imus(60.0, 60.5)])
    assert run.channel("sensor:imu").silent
    fell = [at for at, health in run.reports if at > 60.5 and health.channels[0].silent]
    assert fell[0] < 63.0


def test_given_a_commanding_client_then_a_pause_is_no_silence() -> None:
    run = Run(None)
    command = SwitchMode(SensorHeader(START, "console"), Mode.FULL)
    run.until(5.0, [(0.1, command), (0.2, command), (0.3, command), (0.4, command)])
    assert not run.channel("command:console").silent


def test_given_changes_to_and_fro_at_every_tick_then_at_most_ten_reports_a_second_go_out_for_them() -> None:
    run = Run(None)
    flapping = [(n * 0.005, HealthWarning("x", str(n % 7))) for n in range(2000)]
    run.until(10.0, flapping)
    assert 20 < len(run.reports) <= 10 * 10 + 10
    gaps = [b - a for a, b in itertools.pairwise(run.times())]
    assert min(gaps) > 0.0


def test_given_a_report_for_a_change_then_rates_are_those_of_the_last_whole_period() -> None:
    run = Run(None)
    run.until(2.0, [*imus(0.0, 2.0), (1.32, HealthWarning("x", "y"))])
    by_time = dict(run.reports)
    change = next(health for at, health in by_time.items() if 1.3 < at < 1.5)
    assert change.channels[0].rate_hz == pytest.approx(100.0, abs=2.0)
    assert change.channels[0].count > by_time[1.0].channels[0].count


# --- sensors that cannot be used ---


class Unusable(ScriptedLocalizer):
    """A localizer with findings and decisions that a test sets."""

    findings: tuple[SensorFinding, ...] = ()
    distance: float = math.nan
    verdicts: tuple[Decision, ...] = ()

    def summary(self, utime: int) -> LocalizerSummary:
        return super().summary(utime)._replace(findings=type(self).findings, distance_to_heading=type(self).distance)

    def process(self, sample: Any) -> tuple[Any, tuple[Any, ...]]:
        taken, notes = super().process(sample)
        return taken, notes + tuple(each for each in type(self).verdicts if each.source == sample.header.source)


@pytest.fixture
def unusable() -> Iterable[type[Unusable]]:
    yield Unusable
    Unusable.findings = Unusable.verdicts = ()
    Unusable.distance = math.nan


def verdict(source: str, verdict: Verdict, reason: str = "", kind: str = "wheel_speed") -> Decision:
    return Decision(START, source, 0, kind, verdict, reason)


def test_given_a_sensor_that_cannot_be_used_then_a_report_goes_out_at_once_with_why_until_it_can(unusable) -> None:
    run = Run(unusable())
    run.until(1.5)
    before = len(run.reports)
    choice = SensorFinding("gps", "mode", "localization.mode", "mode no_gps does not use it", is_choice=True)
    unusable.findings = (SensorFinding("wheels", "steering", "sensors.wheels.steering", "no angle", "start it"), choice)
    run.until(1.8)
    assert len(run.reports) == before + 1
    assert dict(run.reports[-1][1].warnings) == {"sensors.wheels (steering)": "no angle; start it"}
    unusable.findings = ()
    run.until(2.5)
    assert run.reports[-1][1].warnings == ()


def test_given_a_heading_that_is_not_known_then_the_report_states_how_far_to_drive(unusable) -> None:
    run = Run(unusable(invalid=Invalid.NOT_MOVED_YET, stale_s=10.0))
    run.until(0.1, [(0.05, imu(START + 40_000))])
    for begin, distance, words in (
        (0.5, 8.6, "; drive about 9 m more"),
        (1.5, 0.2, "fixes do not show the heading yet"),
    ):
        unusable.distance = distance
        run.until(begin + 1.0)
        assert Invalid.NOT_MOVED_YET.explain() in run.last.invalid_text
        assert run.last.invalid_text.endswith(words)
    unusable.distance = math.nan
    run.until(3.6)
    assert run.last.invalid_text.endswith(Invalid.NOT_MOVED_YET.explain())


def test_given_dropped_measurements_then_the_used_and_all_are_reported(unusable) -> None:
    run = Run(unusable())
    unusable.verdicts = (verdict("gps", Verdict.REJECTED, "names"), verdict("gps", Verdict.REJECTED, "gate", "imu_yaw"))
    run.until(1.05, [(0.04 * n + 0.01, gps(START + 40_000 * n)) for n in range(19)])
    (channel,) = run.reports[-1][1].channels
    assert (channel.measured, channel.used) == (19, 0)
    assert run.reports[-1][1].warnings == ()
    run.until(1.4, [(1.2, gps(START + S))])
    ((subject, text),) = run.reports[-1][1].warnings
    assert subject == "sensor:gps"
    assert text == "20 received, 0 of 20 measurements used; the last 20 were dropped: names"
    unusable.verdicts = (verdict("gps", Verdict.USED), verdict("gps", Verdict.MONITORED, "at_rest"))
    run.until(3.05, [(2.5, gps(START + 5 * S // 2))])
    assert run.reports[-1][1].warnings == ()
    (channel,) = run.reports[-1][1].channels
    assert (channel.measured, channel.used) == (22, 1)
