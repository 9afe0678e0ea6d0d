"""The filter and its fixes: jumps, outages, latency, delayed velocities, and aiding sources instead of fixes."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest
import support_stream_faults as faults
from support_filter import GPS_TIMING, ORIGIN, PLAIN_GPS, QUICK_IMU, RIG, RTK_LIKE, drive, rms, row, simulation
from support_maneuvers import stop_and_go

from benchmarks.rough_simulation import AbsolutePoseModel, RangeModel, RelativePoseModel
from modelserver.estimation.filter import heading_step, output
from modelserver.estimation.filter.gnss_monitor import OutputOffset
from modelserver.estimation.filter.heading_alignment import Rotation
from modelserver.estimation.filter.localizer import FilterLocalizer
from modelserver.estimation.filter.measurements.gnss import LATENCY
from modelserver.estimation.filter.settings import FilterSettings
from modelserver.estimation.filter.state import Aligned, Setup
from modelserver.messages import GpsSample, Invalid, Mode, Verdict
from modelserver.simulation import DrivePhase, Event, GpsModel, figure_eight

pytestmark = pytest.mark.slow

EIGHT = figure_eight(speed=3.0, radius=8.0, stationary=4.0, laps=3)
BEACONS = {"a": (40.0, 40.0, 3.0), "b": (-40.0, 40.0, 3.0), "c": (-40.0, -40.0, 3.0), "d": (40.0, -40.0, 3.0)}
FOREVER = 1e9


@pytest.mark.parametrize(
    ("model", "far"), [(PLAIN_GPS, 700.0), (PLAIN_GPS, 20.0), (RTK_LIKE, 5.0)], ids=["700m", "20m", "5m_rtk"]
)
def test_given_fixes_that_jump_for_ten_seconds_then_the_pose_does_not_follow(model, far):
    gps = replace(model, jumps=((40.0, 50.0, far * 0.8, far * 0.6),))

    found = drive(simulation(EIGHT, gps_model=gps), 65.0, every=0.1)
    plain = drive(simulation(EIGHT, gps_model=model), 65.0, every=0.1)

    pairs = list(zip(found.between(40.0), plain.between(40.0), strict=True))
    assert max(math.dist(a.estimate.enu.xyz[:2], b.estimate.enu.xyz[:2]) for a, b in pairs) < 1.0
    words = [found.decisions("gps_position", Verdict.REJECTED, word) for word in ("gate", "inconsistent")]
    rejected = [found.seconds(decision) for decisions in words for decision in decisions]
    assert len([t for t in rejected if 40.0 <= t < 50.0]) >= 38
    # then they must agree for a while
    assert not [t for t in rejected if t >= 62.0]
    assert len({row.estimate.pose_epoch for row in found.between(20.0)}) == 1
    assert max(found.odom_steps) < 0.05


def test_given_a_permanent_jump_of_fixes_while_stationary_then_the_pose_is_that_of_dead_reckoning():
    stationary_until = 110.0
    ahead = figure_eight(speed=3.0, radius=8.0, stationary=4.0)
    driven = sum(phase.duration for phase in ahead)
    phases = (
        *ahead,
        DrivePhase(stationary_until - driven),
        *figure_eight(speed=3.0, radius=8.0, stationary=1.0, laps=5),
    )
    gps = replace(PLAIN_GPS, jumps=((driven + 3.0, FOREVER, 30.0, 0.0),))

    found = drive(simulation(phases, gps_model=gps), stationary_until + 130.0, every=0.1)

    assert any("jumped" in each.reason for each in found.decisions("consistency", Verdict.RESET))
    rows = found.between(driven + 3.0)
    assert all(row.valid and row.off < 2.0 for row in rows)
    assert all(row.off < row.estimate.horizontal_level for row in rows)
    assert max(found.odom_steps) < 0.05


def test_given_an_outage_of_a_minute_then_the_protection_level_grows_covers_the_error_and_shrinks_again():
    gps = replace(RTK_LIKE, outages=((40.0, 100.0),))

    found = drive(simulation(figure_eight(speed=3.0, radius=8.0, laps=4), gps_model=gps), 120.0)

    silent = found.between(41.0, 100.0)
    bounds = [row.estimate.horizontal_protection_level for row in silent]
    assert bounds[-1] > 3.0 * bounds[0]
    # not at every step: on the return path a heading error cancels its own effect
    assert np.mean(bounds[-40:]) > 1.5 * np.mean(bounds[:40])
    assert all(row.off < row.estimate.horizontal_protection_level for row in found.between(30.0))
    assert all(row.valid for row in silent)
    assert found.last.off < 0.3
    assert found.last.estimate.horizontal_protection_level < 0.5 * bounds[-1]


def test_given_fixes_delayed_by_half_a_second_and_out_of_sequence_then_the_pose_is_that_of_punctual_ones():
    phases = figure_eight(speed=3.0, radius=8.0)
    seconds = sum(phase.duration for phase in phases)

    punctual = drive(simulation(phases), seconds + 3.0)
    late = drive(simulation(phases), seconds + 3.0, transform=lambda events: faults.delay(events, 2, "gps", 0.5))

    assert not late.decisions("gps_position", Verdict.REJECTED)
    assert math.dist(late.last.estimate.enu.xyz, punctual.last.estimate.enu.xyz) < 0.02
    assert rms(row.off for row in late.between(20.0)) < 1.2 * rms(row.off for row in punctual.between(20.0)) + 0.05


def test_given_fixes_older_than_the_horizon_then_they_are_rejected_as_too_old():
    found = drive(simulation(EIGHT), 40.0, transform=lambda events: faults.delay(events, 2, "gps", 1.8, min_delay=1.5))

    assert found.decisions("gps_position", Verdict.REJECTED, "too_old")
    assert not found.decisions("gps_position", Verdict.USED)


def test_given_delayed_velocities_with_their_latency_then_they_fit_the_drive():
    phases = stop_and_go(speed=4.0, go=2.0, ramp=1.5, times=6, curvature=0.1)
    gps = GpsModel(GPS_TIMING, correlated_sigma=0.3, white_sigma=0.05, velocity_latency=0.3)
    seconds = sum(phase.duration for phase in phases)

    stated = drive(simulation(phases, gps_model=gps), seconds)
    unstated = drive(simulation(phases, gps_model=gps), seconds, transform=_drop_latency)

    fits = [word.statistic / word.dof for word in stated.decisions("gps_velocity") if word.dof]
    misfits = [word.statistic / word.dof for word in unstated.decisions("gps_velocity") if word.dof]
    assert np.mean(fits) < 2.0
    assert np.mean(misfits) > 5.0 * np.mean(fits)
    assert len(stated.decisions("gps_velocity", Verdict.REJECTED)) < 0.02 * len(fits)


def _drop_latency(events):
    for event in events:
        yield replace(event, velocity_latency=0.0) if event.header.source == "gps" else event


def _drift_with_velocity(begin, *, east=0.0, north=0.0):
    """Return a transform that moves fixes at a rate from `begin` on, and their velocity by it, m/s."""

    def drift(events: Iterable[Event]) -> Iterable[Event]:
        for event in events:
            since = (event.header.utime - begin) * 1e-6
            if isinstance(event, GpsSample) and since > 0.0 and event.velocity is not None:
                x, y, z = event.velocity
                latitude, longitude = event.latitude_deg, event.longitude_deg
                event = replace(
                    event,
                    latitude_deg=latitude + math.degrees(north * since / 6.37e6),
                    longitude_deg=longitude + math.degrees(east * since / 6.37e6) / math.cos(math.radians(latitude)),
                    velocity=(x + east, y + north, z),
                )
            yield event

    return drift


def test_given_fixes_that_drift_with_their_velocity_then_it_does_not_bend_the_path_that_judges_them():
    run = simulation(EIGHT)

    found = drive(run, 75.0, transform=_drift_with_velocity(run.start_utime + 40_000_000, north=0.8))

    suspect = [each for each in found.decisions("consistency", Verdict.RESET) if found.seconds(each) > 40.0]
    assert suspect
    refused = found.decisions("gps_velocity", Verdict.MONITORED, "inconsistent")
    assert len(refused) > 20
    assert min(each.utime for each in refused) >= suspect[0].utime
    outside = [row for row in found.rows if row.valid and row.off > row.estimate.horizontal_protection_level]
    assert len(outside) <= 2


def test_given_fixes_that_drift_ahead_with_their_velocity_then_the_level_covers_them():
    phases = (DrivePhase(3.0, 0.0), DrivePhase(6.0, 12.0), DrivePhase(50.0, 12.0), DrivePhase(9.0, 0.0))
    run = simulation(phases, gps_model=PLAIN_GPS, yaw=0.0)
    begin, rate = run.start_utime + 20_000_000, 0.3

    found = drive(run, 50.0, transform=_drift_with_velocity(begin, east=rate))

    # a fortieth of the speed is within what the wheels' scale may be off
    assert all(row.off < row.estimate.horizontal_level for row in found.between(20.0))


def test_given_no_fixes_but_a_pose_then_it_is_used_and_ranges_to_beacons_maintain_it():
    phases = figure_eight(speed=2.0, radius=8.0, laps=2)
    once = AbsolutePoseModel(outages=((6.0, 200.0),))
    without_fixes = {"gps_frame": None, "pose_frame": "Car:Camera", "pose_model": once, "imu_model": QUICK_IMU}

    alone = drive(simulation(phases, **without_fixes), 100.0)
    held = drive(
        simulation(phases, **without_fixes, range_frame="Car:Antenna", beacons=BEACONS, range_model=RangeModel()), 100.0
    )

    assert len(held.decisions("absolute_pose", Verdict.RESET)) == 1
    assert all(row.valid for row in held.between(8.0))
    assert max(row.off for row in held.between(8.0)) < 0.5
    assert all(row.off < row.estimate.horizontal_protection_level for row in alone.between(8.0, 60.0))
    assert held.last.estimate.horizontal_protection_level < 0.3 * alone.last.estimate.horizontal_protection_level


def test_given_an_outage_without_wheels_but_with_visual_odometry_then_the_error_is_far_smaller():
    gps = replace(RTK_LIKE, outages=((40.0, 70.0),))
    phases = figure_eight(speed=2.0, radius=8.0, laps=2)
    bare = {"gps_model": gps, "wheel_frames": None}

    blind = drive(simulation(phases, **bare), 70.0, mode=Mode.NO_WHEELS)
    seeing = drive(
        simulation(phases, **bare, odometry_frame="Car:Camera", odometry_model=RelativePoseModel()),
        70.0,
        mode=Mode.NO_WHEELS,
    )

    assert len(seeing.decisions("relative_pose", Verdict.USED)) > 200
    assert seeing.last.off < 1.0
    assert seeing.last.off < seeing.last.estimate.horizontal_protection_level
    assert seeing.last.estimate.horizontal_protection_level < 0.5 * blind.last.estimate.horizontal_protection_level
    assert blind.last.off < blind.last.estimate.horizontal_protection_level


def test_given_a_position_set_from_fixes_then_the_offset_of_the_former_one_is_not_added_to_it():
    localizer = drive(simulation(EIGHT), 30.0).localizer
    state = localizer.head
    assert isinstance(state, Aligned)
    assert state.gnss.last_fix is not None
    drifted = state._replace(gnss=state.gnss._replace(offset=OutputOffset((100.0, -50.0, 0.0))))

    after = heading_step.initialize(localizer.setup, drifted, drifted.nav, Rotation(0.0, 0.0), state.gnss.last_fix)

    found = output.estimate(localizer.setup, after, localizer.odom, localizer.utime, localizer.utime)
    before = localizer.estimate(localizer.utime)
    assert math.dist(found.enu.xyz[:2], before.enu.xyz[:2]) < 2.0


def test_given_a_vehicle_that_moves_beside_its_own_axis_then_its_pose_is_not_valid_beyond_its_limit():
    localizer = drive(simulation(EIGHT), 30.0).localizer
    state = localizer.head
    assert isinstance(state, Aligned)

    def find_invalid(turned: float) -> Invalid:
        nodes = state.turns.newest
        turns = state.turns._replace(suspect=nodes[0], allowance=turned)
        judged = state._replace(turns=turns, bank=None, bounds=None)
        return output.estimate(localizer.setup, judged, localizer.odom, localizer.utime, localizer.utime).invalid

    assert not localizer.estimate(localizer.utime).invalid
    assert not find_invalid(math.radians(5.0))  # within its limit
    assert find_invalid(math.radians(40.0)) is Invalid.GNSS_INCONSISTENT | Invalid.LIMIT_EXCEEDED


def test_given_a_heading_known_to_ten_degrees_then_a_pose_is_valid_while_wheels_measure_or_where_it_is_configured():
    localizer = drive(simulation(EIGHT), 30.0).localizer
    state = localizer.head
    assert isinstance(state, Aligned)
    P = state.nav.covariance.copy()
    P[8, 8] = math.radians(10.0) ** 2
    vague = state._replace(nav=state.nav._replace(covariance=P))
    stuck = vague._replace(common=vague.common._replace(wheels=vague.common.wheels.suspect()))
    configured = Setup(RIG, FilterSettings(heading_limit=0.6))

    def find_invalid(setup: Setup, judged: Aligned) -> Invalid:
        found = output.estimate(setup, judged, localizer.odom, localizer.utime, localizer.utime)
        # beyond 0.6 rad with a probability of 0.0006, beyond 0.35 with 0.045
        assert (found.limit_risk > 0.01) is bool(found.invalid)
        return found.invalid

    assert not find_invalid(localizer.setup, vague)
    assert find_invalid(localizer.setup, stuck) is Invalid.LIMIT_EXCEEDED
    assert not find_invalid(configured, stuck)


def test_given_a_steady_circle_then_wheels_correct_the_heading_and_not_the_latency_that_goes_with_it():
    circle = 1.0 / 8.0
    phases = (
        *(DrivePhase(4.0, 0.0), DrivePhase(3.0, 2.5), DrivePhase(8.0, 2.5), DrivePhase(3.0, 2.5, circle)),
        *(DrivePhase(50.0, 2.5, circle), DrivePhase(3.0, 0.0, 0.0)),
    )
    run = simulation(phases, gps_model=replace(PLAIN_GPS, unstated_latency=0.2))
    localizer = FilterLocalizer.start(Setup(RIG), ORIGIN)
    silent = run.start_utime + 55_000_000
    before = 0.0
    for sample in run.events(58.0):
        if isinstance(sample, GpsSample) and sample.header.utime > silent:
            continue
        localizer, _ = localizer.process(sample)
        if localizer.utime <= silent + 500_000:  # the last fix has arrived
            before = get_latency(localizer)

    assert isinstance(localizer.head, Aligned)
    assert get_latency(localizer) == pytest.approx(before, abs=5e-5)
    assert abs(row(run, localizer.estimate(localizer.utime)).heading) < math.radians(4.0)


def get_latency(localizer: FilterLocalizer) -> float:
    """The latency of fixes in the state, s."""
    head = localizer.head
    return head.nav.extras[localizer.setup.layout.extra_index(LATENCY)] if isinstance(head, Aligned) else 0.0
