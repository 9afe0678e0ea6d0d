"""A source that errs slowly: which event names it, and what validity and levels make of it meanwhile.

All drives are the same for a minute; then one source begins to err.
"""

from __future__ import annotations

import cmath
import math
import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import pytest
from support_filter import MOUNT, PLAIN_GPS, RTK_LIKE, Run, Transform, drive, rig, simulation

from modelserver.messages import Decision, GpsSample, ImuSample, Verdict, WheelsSample
from modelserver.simulation import Event, GpsModel, figure_eight
from modelserver.simulation.scenario import START_UTIME
from modelserver.transforms import so3

pytestmark = pytest.mark.slow

EIGHTS = figure_eight(speed=3.0, radius=8.0, stationary=4.0, laps=6)
BEGIN, END, SECONDS = 60.0, 90.0, 120.0
EARTH_RADIUS = 6.37e6
HEADING_LEVEL = math.radians(20.0)

Shift = Callable[[float], complex]


def seconds_of(event: Event) -> float:
    return (event.header.utime - START_UTIME) * 1e-6


def move_fixes(shift: Shift) -> Transform:
    """Move fixes, east + i north, m, by their second."""

    def move(events: Iterable[Event]) -> Iterator[Event]:
        for event in events:
            if isinstance(event, GpsSample):
                way = shift(seconds_of(event)) * math.degrees(1.0 / EARTH_RADIUS)
                latitude, longitude = event.latitude_deg, event.longitude_deg
                longitude += way.real / math.cos(math.radians(latitude))
                event = replace(event, latitude_deg=latitude + way.imag, longitude_deg=longitude)
            yield event

    return move


def turn_gyro(step: float) -> Transform:
    """Add to the yaw rate of the gyro from the minute on, rad/s."""
    change = so3.rotate(so3.conjugate(MOUNT.wxyz), (0.0, 0.0, step))

    def turn(events: Iterable[Event]) -> Iterator[Event]:
        for event in events:
            if isinstance(event, ImuSample) and seconds_of(event) >= BEGIN:
                event = replace(event, angular_velocity=so3.add(event.angular_velocity, change))
            yield event

    return turn


def scale_wheels(factor: float) -> Transform:
    """Multiply the way of the wheels from the minute on."""

    def scale(events: Iterable[Event]) -> Iterator[Event]:
        for event in events:
            if isinstance(event, WheelsSample) and seconds_of(event) >= BEGIN:
                event = replace(
                    event, wheels=tuple(replace(each, travel=each.travel * factor) for each in event.wheels)
                )
            yield event

    return scale


def drive_with(change: Transform, seed: int = 1) -> Run:
    return drive(simulation(EIGHTS, seed=seed), SECONDS, every=0.2, transform=change)


def drive_with_fixes(find_shift: Callable[[Callable[[float], tuple[complex, float]]], Shift], gps: GpsModel) -> Run:
    """Drive with fixes that are moved by what the true place, m, and the heading, rad, of a second make of it."""
    run = simulation(EIGHTS, gps_model=gps)

    def look_up(t: float) -> tuple[complex, float]:
        pose = run.truth(START_UTIME + round(t * 1e6)).enu
        return complex(*pose.xyz[:2]), pose.rpy[2]

    return drive(run, SECONDS, every=0.2, transform=move_fixes(find_shift(look_up)))


def list_events(found: Run) -> list[tuple[float, str]]:
    """Return second and text of what the paths of fixes and dead reckoning have shown."""
    return [(found.seconds(each), each.reason) for each in found.decisions("consistency") if is_event(each)]


def is_event(word: Decision) -> bool:
    return word.verdict in (Verdict.RESET, Verdict.USED)


def find_number(text: str, pattern: str) -> float:
    matched = re.search(pattern, text)
    assert matched, text
    return float(matched[1])


def check_levels(found: Run) -> None:
    """Check that no valid pose is beyond its limit or its protection levels."""
    limit = found.localizer.summary(found.localizer.utime).horizontal_limit
    for row in found.between(20.0):
        if row.valid:
            assert row.off <= limit
            assert row.off <= row.estimate.horizontal_protection_level, row.t
            assert abs(row.heading) <= row.estimate.heading_protection_level, row.t


@pytest.mark.parametrize("seed", [1, 2])
def test_given_sources_as_they_are_modeled_then_nothing_is_found_and_every_pose_is_valid(seed: int) -> None:
    found = drive_with(move_fixes(lambda _: 0j), seed=seed)
    assert list_events(found) == []
    check_levels(found)
    rows = found.between(20.0)
    assert all(row.valid for row in rows)
    # 5.6 sigma of the error of fixes, and a little for what is not explained
    assert max(row.estimate.horizontal_protection_level for row in rows) < 3.0
    # some deg of the heading, and by what a gyro might turn it for seconds unseen
    assert max(row.estimate.heading_protection_level for row in rows) < HEADING_LEVEL


@pytest.mark.parametrize("rate", [0.3, 0.5j, -1.0])
def test_given_fixes_that_drift_then_they_are_named_within_meters_and_trusted_again_once_they_have_returned(
    rate: complex,
) -> None:
    found = drive_with(move_fixes(lambda t: rate * (t - BEGIN) if BEGIN <= t < END else 0j))
    (first, why), (last, after) = list_events(found)
    assert "they drift" in why
    assert abs(rate) * (first - BEGIN) < 2.0
    check_levels(found)
    # it is valid while the error is surely less than the limit
    drifting = found.between(BEGIN, END)
    assert all(row.valid for row in drifting if row.off < 8.0)
    assert all(row.estimate.horizontal_level > 0.6 * row.off for row in drifting)
    assert "trusted again" in after
    # ten seconds of agreement
    assert END + 9.0 < last < END + 15.0
    assert found.last.valid
    assert found.last.off < 1.5


def test_given_fixes_that_run_away_then_the_pose_does_not_follow_them() -> None:
    found = drive_with(move_fixes(lambda t: 3j * (t - BEGIN) if BEGIN <= t < END else 0j))
    (first, why), (_, follows), (_, after) = list_events(found)
    assert "they jumped" in why
    assert first < BEGIN + 1.5
    assert "too long" in follows
    assert "trusted again" in after
    check_levels(found)
    assert max(row.off for row in found.between(20.0) if row.valid) < 1.5
    assert found.last.valid


@pytest.mark.parametrize("step", [0.02, -0.02])
def test_given_a_gyro_whose_bias_changes_then_it_is_corrected_and_the_level_covers_the_turn_until_then(
    step: float,
) -> None:
    found = drive_with(turn_gyro(step))
    second, why = list_events(found)[-1]
    assert find_number(why, r"gyro's bias has changed by (\S+) deg/s") == pytest.approx(-math.degrees(step), rel=0.2)
    assert second < BEGIN + 15.0
    check_levels(found)
    # it has turned the heading by then
    assert max(abs(row.heading) for row in found.between(BEGIN)) > math.radians(5.0)
    healed = found.between(second + 8.0)
    assert all(row.valid for row in healed)
    assert all(abs(row.heading) < math.radians(2.0) for row in healed)


@pytest.mark.parametrize(("factor", "is_named"), [(0.85, False), (1.1, True)])
def test_given_wheels_that_begin_to_slip_then_the_pose_stays_right(factor: float, is_named: bool) -> None:
    found = drive_with(scale_wheels(factor))
    assert ["the wheels' scale" in why for _, why in list_events(found)] == [True] * is_named
    check_levels(found)
    assert max(row.off for row in found.between(BEGIN)) < 1.5
    assert max(abs(row.heading) for row in found.between(BEGIN)) < math.radians(2.0)
    assert sum(row.valid for row in found.between(BEGIN)) > 250


def test_given_an_antenna_that_is_elsewhere_then_precise_fixes_show_where_and_the_level_covers_it() -> None:
    arm = -0.4 + 0.3j
    found = drive_with_fixes(lambda look_up: lambda t: arm * cmath.rect(1.0, look_up(t)[1]), RTK_LIKE)
    _, why = list_events(found)[-1]
    ahead = find_number(why, r"antenna is (\S+) m forward")
    left = find_number(why, r"and (\S+) m left")
    assert abs(complex(ahead, left) - arm) < 0.25
    check_levels(found)
    assert all(row.valid for row in found.between(20.0))


def test_given_fixes_that_become_later_then_their_latency_is_named_before_any_lasting_cause() -> None:
    def be_late(look_up: Callable[[float], tuple[complex, float]]) -> Shift:
        return lambda t: look_up(t - 0.6)[0] - look_up(t)[0] if t >= BEGIN else 0j

    found = drive_with_fixes(be_late, PLAIN_GPS)
    (first, why), (second, later), *_ = list_events(found)
    assert "they jumped" in why
    assert first < BEGIN + 1.5
    assert find_number(later, r"they are (\S+) s later than before") == pytest.approx(0.6, abs=0.1)
    assert second < BEGIN + 10.0
    check_levels(found)


def test_given_one_outlier_then_nothing_is_found_and_the_pose_stays() -> None:
    found = drive_with(move_fixes(lambda t: 25.0 if BEGIN <= t < BEGIN + 0.2 else 0j))
    assert list_events(found) == []
    assert len(found.decisions("gps_position", Verdict.REJECTED)) == 1
    assert all(row.valid and row.off < 1.0 for row in found.between(BEGIN))
    # it teaches nothing about the noise of fixes
    usual = drive_with(move_fixes(lambda _: 0j))
    pairs = zip(found.between(BEGIN + 5.0), usual.between(BEGIN + 5.0), strict=True)
    assert all(a.estimate.horizontal_protection_level < 1.02 * b.estimate.horizontal_protection_level for a, b in pairs)


def test_given_fixes_that_are_off_for_seconds_then_they_are_not_used_and_soon_trusted_again() -> None:
    found = drive_with(move_fixes(lambda t: 4.0 if BEGIN <= t < BEGIN + 3.0 else 0j))
    (first, why), (last, after) = list_events(found)
    assert "they jumped" in why
    assert first < BEGIN + 1.0
    assert "trusted again" in after
    assert last < BEGIN + 3.0 + 5.0
    check_levels(found)
    assert all(row.valid and row.off < 1.5 for row in found.between(20.0))


def test_given_a_vehicle_without_wheels_then_its_path_accuses_no_fixes_that_drift() -> None:
    bare = rig(wheels=False)
    run = simulation(EIGHTS, bare, wheel_frames={}, wheels_model=None)
    away = move_fixes(lambda t: 0.5 * (t - BEGIN) if BEGIN <= t < END else 0j)
    found = drive(run, END, on=bare, transform=away)
    assert not any("drift" in why or "gyro" in why for _, why in list_events(found))
