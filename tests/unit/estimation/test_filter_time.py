"""Time in the filter: one state for any order of arrival, Odom without jumps, switches of mode, past estimates."""

from __future__ import annotations

import dataclasses
import itertools
import math
import random
from dataclasses import replace
from functools import lru_cache

import pytest
from hypothesis import Phase as Step
from hypothesis import given, settings
from hypothesis import strategies as st
from support_cart import MOUNTS, ORIGIN, drive, localizer, process_all, rig, same

from modelserver.estimation.filter.fusion import split_sample
from modelserver.estimation.filter.localizer import Deferred, FilterLocalizer, Timeline
from modelserver.estimation.filter.settings import FilterSettings
from modelserver.estimation.filter.state import FilterState, Leveling, Setup
from modelserver.estimation.history import History
from modelserver.estimation.modes import LocalizerConfig, ModeLocalizer
from modelserver.estimation.raw.localizer import RawLocalizer
from modelserver.estimation.raw.settings import RawSettings
from modelserver.messages import (
    Decision,
    Estimate,
    GpsSample,
    ImuSample,
    Invalid,
    Mode,
    Phase,
    Rejected,
    SensorHeader,
    SwitchMode,
    Verdict,
    WheelsSample,
)
from modelserver.simulation import START_UTIME, Event, GpsModel, Timing

IMU_HZ = 20.0
WARM, CHUNK, AFTER = 12.0, 0.9, 1.5


@lru_cache
def simulate_events() -> tuple[Event, ...]:
    gps = GpsModel(Timing(5.0, latency=0.05), velocity_latency=0.1)
    return tuple(sorted(drive(20.0, imu_hz=IMU_HZ, gps_model=gps)[1], key=lambda each: each.header.utime))


def select_events(start: float, end: float) -> list[Event]:
    return [each for each in simulate_events() if start <= (each.header.utime - START_UTIME) * 1e-6 < end]


@lru_cache
def drive_until_aligned() -> FilterLocalizer:
    found = process_all(localizer(), select_events(0.0, WARM))
    assert found.head.phase is Phase.ALIGNED
    return found


@lru_cache
def drive_in_order() -> FilterLocalizer:
    return process_all(drive_until_aligned(), select_events(WARM, WARM + CHUNK))


# --- one state, whatever the order --------------------------------------------------------------------------


def drop_pending(state: FilterState) -> FilterState:
    """Return the state without its pending decisions."""
    return state._replace(common=state.common._replace(pending=()))


@pytest.mark.slow
@settings(max_examples=20, phases=(Step.explicit, Step.reuse, Step.generate), deadline=None)
@given(st.randoms(use_true_random=False), st.integers(0, 12))
def test_given_any_order_of_arrival_within_the_horizon_then_the_state_is_the_same_to_the_bit(rng, twice):
    samples = select_events(WARM, WARM + CHUNK)
    samples += rng.sample(samples, twice)
    rng.shuffle(samples)
    found = process_all(drive_until_aligned(), samples)
    assert found.timeline.is_fused(found.clocks.get_complete_utime())
    assert same(found.head, drive_in_order().head)
    assert [each.item.key for each in found.timeline.entries] == [
        each.item.key for each in drive_in_order().timeline.entries
    ]
    utime = drive_in_order().utime + 50_000
    assert same(
        *(
            dataclasses.astuple(replace(each.estimate(utime), odom=None, odom_covariance=None))
            for each in (found, drive_in_order())
        )
    )


def test_given_any_order_of_arrival_when_later_samples_follow_then_the_states_remain_the_same():
    samples = select_events(WARM, WARM + CHUNK)
    random.Random(1).shuffle(samples)
    after = select_events(WARM + CHUNK, WARM + CHUNK + AFTER)
    one, other = process_all(process_all(drive_until_aligned(), samples), after), process_all(drive_in_order(), after)
    assert same(one.head, other.head)
    assert same(one.timeline.base, other.timeline.base)


def test_given_a_small_budget_then_the_final_state_is_the_same_and_estimates_continue_meanwhile():
    small = localizer(FilterSettings(replay_budget=16))
    small = process_all(small, select_events(0.0, WARM))
    chunk = select_events(WARM, WARM + CHUNK)
    late = next(each for each in chunk if isinstance(each, GpsSample))
    rest = [each for each in chunk if each is not late]
    found = process_all(process_all(small, rest), [late])
    assert not found.timeline.is_fused(found.clocks.get_complete_utime())
    assert found.utime == drive_in_order().utime
    assert found.estimate(found.utime).invalid == Invalid(0)
    after = select_events(WARM + CHUNK, WARM + CHUNK + AFTER)
    found, other = process_all(found, after), process_all(drive_in_order(), after)
    assert found.timeline.is_fused(found.clocks.get_complete_utime())
    assert same(drop_pending(found.head), drop_pending(other.head))


def test_given_a_sample_older_than_the_horizon_then_it_is_rejected_with_the_reason():
    chunk = select_events(WARM, WARM + CHUNK + AFTER)
    late = next(each for each in chunk if isinstance(each, GpsSample))
    done = process_all(drive_until_aligned(), [each for each in chunk if each is not late])
    after, notes = done.process(late)
    # its source has published since
    assert {(note.verdict, note.reason) for note in notes if isinstance(note, Decision)} == {
        (Verdict.REJECTED, "out_of_sequence")
    }
    assert same(after.head, done.head)
    done = process_all(drive_until_aligned(), [each for each in chunk if not isinstance(each, GpsSample)])
    after, notes = done.process(late)
    assert {(note.verdict, note.reason) for note in notes if isinstance(note, Decision)} == {
        (Verdict.REJECTED, "too_old")
    }
    assert same(after.head, done.head)


def test_given_a_sample_twice_then_the_second_is_rejected_whatever_its_sequence_number():
    samples = select_events(WARM, WARM + CHUNK)
    done = process_all(drive_until_aligned(), samples)
    for again in [each for each in samples if isinstance(each, GpsSample)]:
        renumbered = replace(again, header=replace(again.header, seq=again.header.seq + 1))
        for each in (again, renumbered):
            after, notes = done.process(each)
            assert notes
            assert {note.reason for note in notes if isinstance(note, Decision)} <= {"duplicate", "too_old"}
            assert same(after.head, done.head)


def test_given_more_items_than_a_horizon_can_hold_then_delayed_ones_are_rejected(monkeypatch):
    monkeypatch.setattr("modelserver.estimation.filter.localizer.MAX_ITEMS", 10)
    samples = select_events(WARM, WARM + CHUNK)
    done = process_all(drive_until_aligned(), [each for each in samples if isinstance(each, ImuSample)])
    _, notes = done.process(next(each for each in samples if isinstance(each, GpsSample)))
    assert {note.reason for note in notes if isinstance(note, Decision)} == {"overload"}


def test_given_items_when_settled_then_the_decisions_on_each_are_reported_once_in_order():
    setup = drive_until_aligned().setup
    timeline = Timeline(drive_until_aligned().head)
    samples = select_events(WARM, WARM + CHUNK)
    for sample in reversed(samples):
        for item in split_sample(setup, sample):
            longer = timeline.insert(item)
            assert not isinstance(longer, str)
            timeline = longer[0]
    assert timeline.newest is drive_until_aligned().head
    timeline = timeline.fuse(setup, 10_000, samples[-1].header.utime)
    middle = timeline.entries[len(timeline.entries) // 2].item.utime
    first, decisions = timeline.settle(middle)
    rest, more = first.settle(middle + 10**9)
    assert rest.entries == ()
    assert same(rest.base, timeline.newest)
    assert (*decisions, *more) == tuple(decision for entry in timeline.entries for decision in entry.decisions)
    assert first.settle(middle) == (first, ())
    assert timeline.get_state_at(0) is timeline.base
    assert not isinstance(timeline.get_state_at(timeline.entries[3].item.utime), Leveling)


# --- Odom ---------------------------------------------------------------------------------------------------


def list_steps(asked: list[tuple[int, Estimate]]) -> list[tuple[float, float, float]]:
    """Return seconds, meters and radians from each pose in Odom to the next."""
    found = []
    for (_, a), (_, b) in itertools.pairwise(asked):
        moved = a.odom.inverse() @ b.odom
        w, x, y, z = moved.wxyz
        found.append(
            ((b.utime - a.utime) * 1e-6, math.hypot(*moved.xyz), 2.0 * math.atan2(math.hypot(x, y, z), abs(w)))
        )
    return found


def estimate_after_each(found: FilterLocalizer | ModeLocalizer, samples: list[Event | SwitchMode]):
    estimates = []
    for sample in samples:
        found, _ = found.process(sample)
        if found.utime:
            estimates.append((found.utime, found.estimate(found.utime)))
    return found, estimates


def check_smooth(estimates: list[tuple[int, Estimate]], most: float = 3.3) -> None:
    assert len(estimates) > 100
    for seconds, meters, radians in list_steps(estimates):
        assert meters <= most * abs(seconds) + 0.01
        assert radians <= 1.5 * abs(seconds) + 0.02


def shift_fix(sample: GpsSample, degrees: float) -> GpsSample:
    return replace(sample, latitude_deg=sample.latitude_deg + degrees)


def test_given_fixes_that_jump_and_are_delayed_then_odom_continues_without_a_step():
    rng = random.Random(4)
    late = [
        (each.header.utime + (rng.randrange(700_000) if isinstance(each, GpsSample) else 0), each)
        for each in simulate_events()
    ]
    samples: list[Event | SwitchMode] = []
    for _, each in sorted(late, key=lambda pair: pair[0]):
        jump = isinstance(each, GpsSample) and (each.header.utime - START_UTIME) > 13_000_000
        samples.append(shift_fix(each, 3e-4) if jump and isinstance(each, GpsSample) else each)
    done, estimates = estimate_after_each(localizer(), samples)
    check_smooth(estimates)
    assert done.head.phase is Phase.ALIGNED


def test_given_a_lasting_jump_that_starts_an_epoch_then_odom_does_not_change():
    quick = FilterSettings(recovery_time=2.0, recovery_fixes=5)
    # wheels would contradict the jump
    samples = [
        shift_fix(each, 3e-4) if isinstance(each, GpsSample) and each.header.utime > START_UTIME + 10_000_000 else each
        for each in drive(22.0, imu_hz=IMU_HZ)[1]
        if not (isinstance(each, WheelsSample) and each.header.utime > START_UTIME + 9_000_000)
    ]
    done, estimates = estimate_after_each(localizer(quick), samples)
    assert done.head.common.epoch > 0
    check_smooth(estimates)
    worlds = [estimate.enu.xyz for _, estimate in estimates if estimate.enu is not None]
    assert max(math.dist(a, b) for a, b in itertools.pairwise(worlds)) > 20.0


def test_given_a_clock_that_is_set_back_then_odom_stops_until_the_motion_is_known_again():
    back = 3_000_000_000
    moved = [
        replace(each, header=replace(each.header, utime=each.header.utime - back)) for each in select_events(WARM, 20.0)
    ]
    before = drive_until_aligned()
    where = before.estimate(before.utime).odom
    done, asked = before, []
    for sample in moved:
        done, _ = done.process(sample)
        asked.append(done.estimate(sample.header.utime))
    restarted = [each for each in asked if each.pose_epoch > before.head.common.epoch]
    assert len(restarted) > 50
    assert restarted[0].invalid & Invalid.CLOCK_STEPPED
    assert math.dist(restarted[0].odom.xyz, where.xyz) < 0.2
    for a, b in itertools.pairwise(restarted):
        assert math.dist(a.odom.xyz, b.odom.xyz) <= 3.3 * abs(b.utime - a.utime) * 1e-6 + 0.02
    assert done.utime > 0
    covariance = done.estimate(done.utime).odom_covariance
    assert covariance is not None
    # the unobserved seconds, at any speed of a vehicle, and no more
    assert 0.01 < math.sqrt(covariance[0]) < 1000.0


# --- modes --------------------------------------------------------------------------------------------------


def create_switch(utime: int, mode: Mode) -> SwitchMode:
    return SwitchMode(SensorHeader(utime, "console"), mode)


def start_modes(mode: Mode = Mode.FULL) -> ModeLocalizer:
    return ModeLocalizer.start(LocalizerConfig(Setup(rig()), RawSettings(), MOUNTS), mode, ORIGIN)


@pytest.mark.slow
@pytest.mark.parametrize("first", [Mode.FULL, Mode.RAW])
def test_given_switches_between_filter_and_raw_mode_then_odom_continues_and_epochs_increase(first):
    found, seen = start_modes(first), []
    samples = drive(24.0)[1]
    at = {round(len(samples) * share): mode for share, mode in ((0.5, Mode.RAW), (0.75, Mode.FULL))}
    if first is Mode.RAW:
        at = {round(len(samples) * share): mode for share, mode in ((0.5, Mode.FULL), (0.75, Mode.RAW))}
    for n, sample in enumerate(samples):
        if n in at:
            utime = found.utime
            before = found.estimate(utime)
            assert before.invalid == Invalid(0)
            found, notes = found.process(create_switch(utime, at[n]))
            (note,) = notes
            assert isinstance(note, Decision)
            assert (note.verdict, note.kind) == (Verdict.RESET, "mode")
            after = found.estimate(utime)
            assert math.dist(before.odom.xyz, after.odom.xyz) < 0.01
            assert abs(math.remainder(float(before.odom.rpy[2] - after.odom.rpy[2]), math.tau)) < 0.01
            assert after.pose_epoch > before.pose_epoch
            assert isinstance(found.active, RawLocalizer) == (at[n] is Mode.RAW)
        found, _ = found.process(sample)
        seen.append((found.utime, found.estimate(found.utime)))
    known = [pair for pair in seen if pair[0]]
    for seconds, meters, _ in list_steps(known):
        assert meters <= 3.3 * abs(seconds) + 0.03
    epochs = [estimate.pose_epoch for _, estimate in known]
    assert epochs == sorted(epochs)
    assert known[-1][1].invalid == Invalid(0)


def test_given_a_filter_started_from_raw_mode_then_older_samples_are_rejected_and_time_does_not_go_back():
    samples = drive(14.0)[1]
    found = start_modes(Mode.RAW)
    for sample in samples:
        found, _ = found.process(sample)
    utime = found.utime
    found, _ = found.process(create_switch(utime, Mode.FULL))
    assert isinstance(found.active, FilterLocalizer)
    assert found.active.head.phase is Phase.ALIGNED
    old = next(
        each for each in reversed(samples) if isinstance(each, ImuSample) and each.header.utime < utime - 100_000
    )
    after, notes = found.process(old)
    assert after.utime == utime
    assert {note.reason for note in notes if isinstance(note, Decision)} == {"too_old"}


@pytest.mark.slow
@pytest.mark.parametrize("mode", [Mode.NO_WHEELS, Mode.NO_GPS, Mode.NO_IMU, Mode.DEAD_RECKONING])
def test_given_a_command_for_another_mode_of_the_filter_then_nothing_jumps_and_the_mode_is_reported(mode):
    found = process_all(localizer(), select_events(0.0, WARM))
    utime = found.utime
    before = found.estimate(utime)
    found, _ = found.process(create_switch(utime + 1, mode))
    assert found.mode is mode
    found, estimates = estimate_after_each(found, select_events(WARM, 16.0))
    check_smooth([(utime, before), *estimates])
    assert found.mode is mode
    state = found.navigation(found.utime)
    assert state is not None
    assert state.mode is mode
    assert found.estimate(found.utime).pose_epoch == before.pose_epoch


def test_given_a_command_for_the_present_or_an_impossible_mode_then_nothing_changes():
    found = start_modes(Mode.RAW)
    assert found.process(create_switch(START_UTIME, Mode.RAW)) == (found, ())
    bare = ModeLocalizer.start(LocalizerConfig(Setup(rig(gps=False)), RawSettings(), None), Mode.FULL)
    after, notes = bare.process(create_switch(START_UTIME, Mode.RAW))
    assert after is bare
    assert notes == (Rejected("command:console", "no_raw_mode"),)
    with pytest.raises(ValueError, match="raw mode needs a GPS and an inertial unit"):
        ModeLocalizer.start(LocalizerConfig(Setup(rig(gps=False)), RawSettings(), None), Mode.RAW)


# --- past estimates -----------------------------------------------------------------------------------------


def test_given_deferred_estimates_in_a_history_then_they_are_those_of_their_time():
    found, history = drive_until_aligned(), History(60.0)
    estimates: list[Estimate] = []
    for sample in select_events(WARM, 16.0):
        found, _ = found.process(sample)
        if not estimates or found.utime > estimates[-1].utime:
            deferred = found.defer_estimate(found.utime)
            assert isinstance(deferred, Deferred)
            history = history.append(deferred)
            estimates.append(found.estimate(found.utime))
    assert len(estimates) > 50
    for each in estimates:
        assert same(dataclasses.astuple(history.at(each.utime)), dataclasses.astuple(each))
    between = history.at((estimates[5].utime + estimates[6].utime) // 2)
    assert between.enu is not None
    assert estimates[5].enu is not None
    assert math.dist(between.enu.xyz, estimates[5].enu.xyz) < 0.2


def test_given_a_time_within_the_horizon_then_the_estimate_is_by_the_state_of_that_time():
    found = drive_in_order()
    for back in (0, 100_000, 400_000, 800_000):
        utime = found.utime - back
        truth = drive(0.1)[0].truth(utime)
        estimate = found.estimate(utime)
        assert estimate.utime == utime
        assert estimate.enu is not None
        assert math.dist(estimate.enu.xyz, truth.enu.xyz) < 0.5
        assert (estimate.odom.inverse() @ found.estimate(found.utime).odom).xyz[0] == pytest.approx(
            3.0 * back * 1e-6, abs=0.15
        )


def test_given_a_first_stamp_of_a_far_future_then_a_better_source_sets_the_time_and_the_pose_comes():
    stray = WheelsSample(SensorHeader(START_UTIME + 10**15, "stray"), ())
    found = process_all(localizer(), (stray, *select_events(0.0, WARM)))
    assert not found.estimate(found.utime).invalid
    assert found.utime == select_events(0.0, WARM)[-1].header.utime


def test_given_a_first_stamp_of_a_far_future_then_a_lesser_source_cannot_set_the_time():
    stray = ImuSample(SensorHeader(START_UTIME + 10**15, "stray"))
    found = process_all(
        localizer(), (stray, *(each for each in select_events(0.0, WARM) if isinstance(each, GpsSample)))
    )
    assert found.clocks.newest == START_UTIME + 10**15
