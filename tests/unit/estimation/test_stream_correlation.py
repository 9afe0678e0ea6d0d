"""Streams of sensors that contradict each other: offsets between clocks, wrong axes and signs; and healthy drives."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterable
from dataclasses import replace

import pytest
from support_filter import GPS_TIMING, ORIGIN, RIG, rig, simulation

from modelserver.estimation.filter.localizer import FilterLocalizer
from modelserver.estimation.filter.state import Setup
from modelserver.estimation.filter.stream_correlation import MAX_LAG, STEP, WINDOW, StreamCorrelation
from modelserver.estimation.sensor_rig import SensorRig
from modelserver.messages import FixType, GpsSample, ImuSample, Mode, Phase, SensorFinding, WheelsSample
from modelserver.simulation import DrivePhase, Event, GpsModel, Simulation, city, figure_eight

SECONDS = 70.0
NOISY = GpsModel(GPS_TIMING, correlated_sigma=1.0, white_sigma=0.3, fix_type=FixType.FIX_3D, has_velocity=False)

Change = Callable[[Event], Event]


def plan_turns(seed: int) -> list[DrivePhase]:
    """Return a drive that turns both ways from its start on."""
    rng = random.Random(seed)
    phases = [DrivePhase(2.5, 0.0, 0.0), DrivePhase(1.0, 5.0, 0.1)]
    while sum(phase.duration for phase in phases) < SECONDS - 8.0:
        phases += [DrivePhase(1.5, curvature=rng.choice((-0.12, -0.08, 0.05, 0.08, 0.12)))]
        phases += [DrivePhase(rng.uniform(1.0, 4.0))]
    return [*phases, DrivePhase(3.0, 0.0, 0.0)]


def drive_turns(seed: int = 3) -> Simulation:
    return simulation(plan_turns(seed), gps_model=NOISY, seed=seed)


def change_samples(events: Iterable[Event], kind: type, change: Change) -> list[Event]:
    """Return the events with those of a kind changed, in the order of their arrival."""
    changed = [change(event) if isinstance(event, kind) else event for event in events]
    return sorted(changed, key=lambda event: event.header.host_utime)


def shift(seconds: float, *, arrival: bool) -> Change:
    """Return a change of the stamp, or with `arrival` of the whole message: then its content is late."""

    def change(event: Event) -> Event:
        us, header = round(seconds * 1e6), event.header
        header = replace(header, utime=header.utime + us, host_utime=header.host_utime + (us if arrival else 0))
        return replace(event, header=header)

    return change


def turn_rates(map_axes: Callable[[float, float, float], tuple[float, float, float]]) -> Change:
    def change(event: Event) -> Event:
        assert isinstance(event, ImuSample)
        assert event.angular_velocity is not None
        return replace(event, angular_velocity=map_axes(*event.angular_velocity))

    return change


def swap_sides(event: Event) -> Event:
    assert isinstance(event, WheelsSample)
    names = [wheel.name for wheel in reversed(event.wheels)]
    return replace(event, wheels=tuple(replace(w, name=name) for w, name in zip(event.wheels, names, strict=True)))


def correlate(
    events: Iterable[Event], mode: Mode = Mode.FULL, on: SensorRig = RIG
) -> tuple[StreamCorrelation, tuple[SensorFinding, ...], set[tuple[str, str]]]:
    """Return the component after all events, its findings then, and all findings on the way."""
    setup, streams, seen = Setup(on), StreamCorrelation(), set()
    found: tuple[SensorFinding, ...] = ()
    for event in events:
        streams = streams.update(setup, mode, event)
        found = streams.find_contradictions(has_gyro=mode is not Mode.NO_IMU, has_heading=False)
        seen |= {(each.sensor, each.reason) for each in found}
    return streams, found, seen


@pytest.mark.slow
@pytest.mark.parametrize("arrival", [True, False])
@pytest.mark.parametrize(
    ("seconds", "text"),
    [(4.5, "GPS seems 4.5 s late"), (-3.0, "GPS seems 3.0 s early"), (0.5, ""), (-0.5, "")],
)
def test_given_an_offset_of_the_receivers_clock_then_its_seconds_are_found(seconds, text, arrival):
    events = change_samples(drive_turns().events(SECONDS), GpsSample, shift(seconds, arrival=arrival))
    _, found, seen = correlate(events)
    assert seen == ({("gps", "offset")} if text else set())
    assert [text in each.text for each in found] == ([True] if text else [])
    assert all(each.fix for each in found)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "change", "expected"),
    [
        (WheelsSample, shift(3.0, arrival=True), ("wheels", "offset", "the wheels seem 3.0 s late")),
        (ImuSample, shift(-2.5, arrival=True), ("imu", "offset", "the IMU seems 2.5 s early")),
        (ImuSample, turn_rates(lambda x, y, z: (-x, -y, -z)), ("imu", "turn", "has the opposite sign")),
        (ImuSample, turn_rates(lambda x, y, z: (y, x, z)), ("imu", "turn", "does not follow")),
        (WheelsSample, swap_sides, ("wheels", "turn", "has the opposite sign")),
    ],
    ids=["wheels late", "imu early", "gyro inverted", "axes swapped", "sides swapped"],
)
def test_given_a_wrong_clock_sign_or_axis_then_the_sensor_is_found(kind, change, expected):
    _, found, _ = correlate(change_samples(drive_turns().events(SECONDS), kind, change))
    (finding,) = found
    assert (finding.sensor, finding.reason) == expected[:2]
    assert expected[2] in finding.text
    assert "without heading" in finding.text


@pytest.mark.slow
def test_given_no_imu_then_swapped_wheels_are_found_by_the_fixes():
    _, found, _ = correlate(change_samples(drive_turns().events(SECONDS), WheelsSample, swap_sides), Mode.NO_IMU)
    assert [(each.sensor, each.reason) for each in found] == [("wheels", "turn")]


@pytest.mark.slow
@pytest.mark.parametrize(
    "phases",
    [plan_turns(5), plan_turns(6), city(7, SECONDS, speed=5.0), figure_eight(3.0, 8.0, laps=3, stop=3.0, reverse=4.0)],
    ids=["turns", "more turns", "town", "eights with reverse"],
)
@pytest.mark.parametrize("mode", [Mode.FULL, Mode.NO_WHEELS, Mode.NO_IMU])
def test_given_a_healthy_drive_then_nothing_is_found_and_the_work_ends(phases, mode):
    run = simulation(phases, gps_model=NOISY, seed=8)
    streams, _, seen = correlate(run.events(SECONDS), mode)
    assert seen == set()
    assert streams.is_settled or mode is Mode.NO_IMU or len(streams.places) < 60


@pytest.mark.slow
def test_given_a_skid_steered_vehicle_without_imu_then_its_wheels_are_not_compared():
    events = drive_turns().events(SECONDS)
    streams, _, seen = correlate(events, Mode.NO_IMU, rig(kinematics="skid_steer"))
    assert not seen
    assert streams.turns == ()


@pytest.mark.slow
def test_given_a_vehicle_without_fixes_then_its_wheels_are_compared_with_the_gyro():
    indoors = replace(RIG, gps_frame="")
    events = [event for event in drive_turns().events(SECONDS) if not isinstance(event, GpsSample)]
    streams, _, seen = correlate(events, on=indoors)
    assert streams.is_settled
    assert not seen
    _, found, _ = correlate(change_samples(events, WheelsSample, swap_sides), on=indoors)
    assert [(each.sensor, each.reason) for each in found] == [("wheels", "turn")]


@pytest.mark.slow
def test_given_a_contradiction_for_long_then_memory_is_bounded():
    events = change_samples(drive_turns().events(SECONDS), GpsSample, shift(4.5, arrival=False))
    streams, _, _ = correlate(events)
    most = (WINDOW + 2.0 * MAX_LAG) / STEP + 2
    assert max(len(streams.turns), len(streams.places), len(streams.wheels)) <= most
    later = [replace(each, header=replace(each.header, utime=each.header.utime + 100_000_000)) for each in events]
    for event in later[:20]:
        streams = streams.update(Setup(RIG), Mode.FULL, event)
    # a gap: what was stored belongs to another part of the drive
    assert len(streams.turns) < 10


@pytest.mark.slow
def test_given_fixes_that_are_rejected_by_their_stamps_then_the_localizer_reports_the_offset_and_the_distance():
    events = change_samples(drive_turns().events(SECONDS), GpsSample, shift(-3.0, arrival=False))
    localizer = FilterLocalizer.start(Setup(RIG), ORIGIN)
    for event in events:
        localizer, _ = localizer.process(event)
    summary = localizer.summary(localizer.utime)
    assert summary.phase is Phase.UNALIGNED
    (finding,) = summary.findings
    assert "m without heading: GPS seems 3.0 s early" in finding.text


@pytest.mark.slow
def test_given_a_vehicle_that_has_not_moved_then_it_is_stated_how_far_it_must_drive():
    phases = [DrivePhase(8.0, 0.0, 0.0), DrivePhase(2.0, 3.0), DrivePhase(20.0), DrivePhase(2.0, 0.0)]
    localizer = FilterLocalizer.start(Setup(RIG), ORIGIN)
    distances, run = [], simulation(phases, gps_model=NOISY)
    for event in run.events(32.0):
        localizer, _ = localizer.process(event)
        summary = localizer.summary(localizer.utime)
        if isinstance(event, GpsSample):
            distances.append(
                ((event.header.utime - run.start_utime) * 1e-6, summary.distance_to_heading, summary.phase)
            )
    at_rest = [distance for t, distance, phase in distances if phase is Phase.UNALIGNED and t < 8.0]
    before = [(t, distance) for t, distance, phase in distances if phase is Phase.UNALIGNED and t > 8.0]
    assert all(5.0 < distance < 25.0 for distance in at_rest)
    # it comes down as the vehicle drives
    assert before[-1][1] < 0.7 * min(at_rest)
    assert all(math.isnan(distance) for _, distance, phase in distances if phase is Phase.ALIGNED)
    assert distances[-1][2] is Phase.ALIGNED
