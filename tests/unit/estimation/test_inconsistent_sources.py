"""A source that errs slowly: which event names it, and what validity and levels make of it meanwhile.

All drives are the same for a minute; then one source begins to err.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import pytest
from support_filter import MOUNT, PLAIN_GPS, RTK_LIKE, Run, Transform, drive, rig, simulation

from modelserver.messages import Decision, GpsSample, ImuSample, Verdict, WheelsSample
from modelserver.simulation import START_UTIME, Event, GpsModel, figure_eight
from modelserver.transforms import so3

pytestmark = pytest.mark.slow

EIGHTS = figure_eight(speed=3.0, radius=8.0, stationary=4.0, laps=6)
BEGIN, END, SECONDS = 60.0, 90.0, 120.0
EARTH_RADIUS = 6.37e6

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


def check_levels(found: Run, least_valid: float = 1.0) -> None:
    """Check that no pose is beyond its levels, no valid one beyond its limit, and how many are valid."""
    limit = found.localizer.summary(found.localizer.utime).horizontal_limit
    rows = found.between(20.0)
    for row in rows:
        assert row.off <= row.estimate.horizontal_level, row.t
        assert abs(row.heading) <= row.estimate.heading_level, row.t
        assert row.estimate.horizontal_level <= row.estimate.horizontal_protection_level, row.t
        assert not row.valid or row.off <= limit
    assert sum(row.valid for row in rows) >= least_valid * len(rows)


@pytest.mark.parametrize("seed", [1, 2])
def test_given_sources_as_they_are_modeled_then_nothing_is_found_and_every_pose_is_valid(seed: int) -> None:
    found = drive_with(move_fixes(lambda _: 0j), seed=seed)
    assert list_events(found) == []
    check_levels(found)
    rows = found.between(20.0)
    assert all(row.off < 1.2 and abs(row.heading) < math.radians(2.0) for row in rows)
    levels = sorted(row.estimate.horizontal_level for row in rows)
    # the error that one in 10,000 exceeds is some four of the fixes' sigma
    assert levels[len(levels) // 2] < 2.0
    assert max(row.estimate.heading_level for row in found.between(40.0)) < math.radians(8.0)


@pytest.mark.parametrize(("rate", "most"), [(0.3, 7.3), (0.5j, 7.3), (-1.0, 6.0), (3j, 2.0)])
def test_given_fixes_that_drift_then_they_are_not_used_and_trusted_again_once_they_have_returned(
    rate: complex, most: float
) -> None:
    found = drive_with(move_fixes(lambda t: rate * (t - BEGIN) if BEGIN <= t < END else 0j))
    (first, why), *_, (last, after) = list_events(found)
    assert "off dead reckoning" in why
    # a share of the limit, 36 m, that is worth it
    assert abs(rate) * (first - BEGIN) < 25.0
    # for a second or two the path that fixes show may be that of a vehicle that has turned
    check_levels(found, 0.98)
    assert max(row.off for row in found.between(BEGIN)) < most
    assert "trusted again" in after
    assert END <= last < END + 3.0
    assert found.last.off < 1.0


@pytest.mark.parametrize("step", [0.02, -0.02])
def test_given_a_gyro_whose_bias_changes_then_the_heading_is_corrected_and_its_level_covers_the_turn_until_then(
    step: float,
) -> None:
    found = drive_with(turn_gyro(step))
    second, why = list_events(found)[0]
    assert "the heading is not that of dead reckoning" in why
    assert second < BEGIN + 15.0
    check_levels(found)
    # it has turned the heading by then
    assert math.radians(5.0) < max(abs(row.heading) for row in found.between(BEGIN)) < math.radians(9.0)
    assert all(abs(row.heading) < math.radians(3.5) for row in found.between(second + 8.0))


@pytest.mark.parametrize("factor", [0.85, 1.1])
def test_given_wheels_that_begin_to_slip_then_the_pose_stays_right(factor: float) -> None:
    found = drive_with(scale_wheels(factor))
    check_levels(found)
    assert max(row.off for row in found.between(BEGIN)) < 1.5
    assert max(abs(row.heading) for row in found.between(BEGIN)) < math.radians(2.0)


def test_given_an_antenna_that_is_elsewhere_then_the_level_covers_it() -> None:
    arm = -0.4 + 0.3j
    found = drive_with_fixes(lambda look_up: lambda t: arm * cmath.rect(1.0, look_up(t)[1]), RTK_LIKE)
    check_levels(found)
    assert max(row.off for row in found.between(20.0)) < 0.7


@pytest.mark.parametrize(("seconds", "most"), [(0.15, 1.2), (0.6, 2.6)])
def test_given_fixes_that_become_later_then_the_level_covers_it(seconds: float, most: float) -> None:
    def be_late(look_up: Callable[[float], tuple[complex, float]]) -> Shift:
        return lambda t: look_up(t - seconds)[0] - look_up(t)[0] if t >= BEGIN else 0j

    found = drive_with_fixes(be_late, PLAIN_GPS)
    check_levels(found)
    assert max(row.off for row in found.between(20.0)) < most


def test_given_one_outlier_then_nothing_is_found_and_the_pose_stays() -> None:
    found = drive_with(move_fixes(lambda t: 25.0 if BEGIN <= t < BEGIN + 0.2 else 0j))
    assert list_events(found) == []
    assert len(found.decisions("gps_position", Verdict.REJECTED)) == 1
    check_levels(found)
    assert all(row.off < 1.0 for row in found.between(BEGIN))


@pytest.mark.parametrize(("size", "seconds"), [(4.0, 3.0), (30.0, 15.0), (700.0, 10.0), (30.0, 1e3)])
def test_given_fixes_that_jump_then_the_pose_does_not_follow_them(size: float, seconds: float) -> None:
    found = drive_with(move_fixes(lambda t: size if BEGIN <= t < BEGIN + seconds else 0j))
    check_levels(found)
    assert all(row.off < 1.0 for row in found.between(BEGIN))
    words = [why for _, why in list_events(found)]
    assert any("jumped" in why for why in words) == (size > 10.0)
    assert any("trusted again" in why for why in words) == (size > 10.0 and seconds < 60.0)


def test_given_a_vehicle_without_wheels_then_its_path_accuses_no_fixes_that_drift() -> None:
    bare = rig(wheels=False)
    run = simulation(EIGHTS, bare, wheel_frames={}, wheels_model=None)
    away = move_fixes(lambda t: 0.5 * (t - BEGIN) if BEGIN <= t < END else 0j)
    found = drive(run, END, on=bare, transform=away)
    assert not any("drift" in why or "gyro's" in why for _, why in list_events(found))
