"""Every mode, every switch between two of them on the move, and a filter that has diverged."""

from __future__ import annotations

import math
from itertools import pairwise, permutations

import numpy as np
import pytest
from support_filter import ORIGIN, RIG, drive, simulation

from modelserver.estimation.filter.localizer import FilterLocalizer, Timeline
from modelserver.estimation.filter.state import Setup
from modelserver.estimation.modes import LocalizerConfig, ModeLocalizer
from modelserver.estimation.raw.settings import RawSettings
from modelserver.estimation.sensor_rig import Mounts
from modelserver.messages import AbsolutePoseSample, Invalid, Mode, SensorHeader, SwitchMode, Verdict
from modelserver.simulation import START_UTIME, Simulation, city, figure_eight

pytestmark = pytest.mark.slow

WITH_FIXES = (Mode.FULL, Mode.RAW, Mode.NO_IMU, Mode.NO_WHEELS)
WITHOUT_FIXES = (Mode.NO_GPS, Mode.DEAD_RECKONING)


def simulate_town() -> Simulation:
    """Drive through a town for 80 s."""
    return simulation(city(5, 80.0, speed=5.0))


def _start_localizer(mode: Mode = Mode.FULL) -> ModeLocalizer:
    mounts = Mounts.from_model(RIG.model, "Car:Base", "Car:Antenna", "Car:Imu")
    return ModeLocalizer.start(LocalizerConfig(Setup(RIG), RawSettings(), mounts), mode, ORIGIN)


def _create_switch(t: float, number: int, mode: Mode) -> tuple[float, SwitchMode]:
    return t, SwitchMode(SensorHeader(START_UTIME + round(t * 1e6), "operator", number), mode)


@pytest.mark.parametrize("mode", WITH_FIXES, ids=lambda mode: mode.name.lower())
def test_given_a_mode_with_fixes_when_driven_through_a_town_then_the_pose_is_valid_and_right(mode):
    found = drive(simulate_town(), 80.0, localizer=_start_localizer(mode), every=0.02)

    known = found.between(30.0)
    assert np.mean([row.valid for row in known]) > 0.95
    assert all(row.off < row.estimate.horizontal_protection_level for row in known if row.valid)
    assert max(row.off for row in known if row.valid) < 3.0
    assert max(found.odom_steps) < 0.05


@pytest.mark.parametrize("mode", WITHOUT_FIXES, ids=lambda mode: mode.name.lower())
def test_given_a_mode_without_fixes_when_driven_through_a_town_then_odom_alone_is_good(mode):
    found = drive(simulate_town(), 80.0, localizer=_start_localizer(mode), every=0.02)

    first, last = found.at(8.0), found.last
    true = [found.simulation.truth(row.estimate.utime).enu for row in (first, last)]
    moved = (first.estimate.odom.inverse() @ last.estimate.odom).xyz
    distance = sum(math.dist(a.estimate.odom.xyz, b.estimate.odom.xyz) for a, b in pairwise(found.between(8.0)))
    assert all(Invalid.NOT_MOVED_YET in row.estimate.invalid for row in found.rows)
    assert math.dist(moved, (true[0].inverse() @ true[1]).xyz) < 0.03 * distance
    assert max(found.odom_steps) < 0.05


def _list_switches() -> list[Mode]:
    """Return modes in a row, FULL first, so that each is followed once by each other one (Hierholzer)."""
    left = {mode: [to for frm, to in permutations(Mode, 2) if frm is mode] for mode in Mode}
    stack, found = [Mode.FULL], []
    while stack:
        if left[stack[-1]]:
            stack.append(left[stack[-1]].pop())
        else:
            found.append(stack.pop())
    return found[::-1]


def test_given_every_switch_of_modes_when_driven_through_a_town_then_odom_and_pose_continue():
    modes = _list_switches()
    assert len(set(pairwise(modes))) == 30
    begin, stay = 30.0, 4.0
    switches = [_create_switch(begin + stay * number, number, mode) for number, mode in enumerate(modes[1:])]
    seconds = begin + stay * len(modes)

    found = drive(
        simulation(city(7, seconds, speed=5.0)), seconds, localizer=_start_localizer(), every=0.02, switches=switches
    )

    assert max(found.odom_steps) < 0.05
    known = found.between(25.0)
    assert np.mean([row.valid for row in known]) > 0.9
    assert all(row.off < row.estimate.horizontal_protection_level for row in known if row.valid)
    for a, b in pairwise(row for row in known if row.estimate.enu is not None):
        step = math.dist(a.estimate.enu.xyz[:2], b.estimate.enu.xyz[:2]) - max(a.speed, b.speed) * (b.t - a.t)
        assert step < 0.05 + a.estimate.horizontal_protection_level
    words = [word for word in found.ledger if word.kind == "mode"]
    assert len(words) == 30
    assert {word.verdict for word in words} == {Verdict.RESET}


def _corrupt(localizer: FilterLocalizer, **changes) -> FilterLocalizer:
    bad = localizer.head._replace(nav=localizer.head.nav._replace(**changes))
    return localizer._replace(timeline=Timeline(bad), head=bad)


@pytest.mark.parametrize(
    "changes",
    [
        {"velocity": (1e5, 0.0, 0.0)},
        {"position": (math.nan, 0.0, 0.0)},
        {"gyro_bias": (0.0, 0.0, 30.0)},
        {"covariance": np.full((1, 1), math.nan)},
    ],
    ids=["speed", "nan", "bias", "covariance"],
)
def test_given_a_filter_that_diverged_then_it_restarts_with_its_biases(changes):
    run = simulation(figure_eight(speed=2.5, radius=8.0, stationary=8.0, laps=2))
    before = drive(run, 30.0)
    good = before.localizer.head
    if "covariance" in changes:
        changes = {"covariance": np.full_like(good.nav.covariance, math.nan)}
    restarted = drive(run, 30.0, localizer=_corrupt(before.localizer, **changes), every=0.1)

    resets = [word for word in restarted.ledger if word.reason == "the filter had diverged"]
    assert len(resets) == 1
    assert resets[0].verdict is Verdict.RESET
    assert any(not row.valid for row in restarted.rows)
    assert restarted.last.valid
    assert restarted.last.off < 1.5
    assert abs(restarted.last.heading) < math.radians(6.0)
    assert restarted.last.estimate.pose_epoch > before.last.estimate.pose_epoch
    bias, sigma = good.common.gyro_biases
    assert math.dist(restarted.localizer.head.nav.gyro_bias, bias) < 5.0 * sigma
    assert max(restarted.odom_steps) < 0.05


def test_given_a_pose_in_outer_space_once_the_heading_is_known_then_it_is_rejected():
    found = drive(simulation(figure_eight(speed=2.5, radius=8.0)), 30.0)
    pose = AbsolutePoseSample(
        SensorHeader(found.localizer.utime, "operator", 1),
        "Car:Base",
        "World:ENU",
        position=(1e12, 0.0, 0.0),
        orientation=(1.0, 0.0, 0.0, 0.0),
    )

    localizer, _ = found.localizer.process(pose)

    estimate = localizer.estimate(localizer.utime)
    assert not estimate.invalid
    assert math.dist(estimate.enu.xyz, found.localizer.estimate(localizer.utime).enu.xyz) < 1.0
