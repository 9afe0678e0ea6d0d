"""Wheel monitor: wheels that are stuck, and trusted again."""

from __future__ import annotations

import pytest

from modelserver.estimation.filter.sensor_monitors import WheelMonitor


def compare(
    monitor: WheelMonitor,
    ratio: float,
    times: int,
    *,
    are_stationary: bool,
    is_moving: bool,
    is_used: bool = True,
) -> WheelMonitor:
    for _ in range(times):
        monitor = monitor.compare(ratio, is_used=is_used, are_stationary=are_stationary, is_moving=is_moving)
    return monitor


def test_given_stationary_wheels_of_a_vehicle_that_moves_then_they_are_soon_suspect_and_measure_no_speed() -> None:
    used = WheelMonitor(used_utime=1_000_000)
    assert used.measures_speed(1_100_000)
    stuck = compare(used, 8.0, 3, are_stationary=True, is_moving=True)
    assert stuck.is_suspect
    assert not stuck.measures_speed(1_100_000)


@pytest.mark.parametrize("ratio", [0.1, 0.8])
def test_given_wheels_within_their_gate_then_they_are_never_suspect(ratio: float) -> None:
    assert not compare(WheelMonitor(), ratio, 1000, are_stationary=True, is_moving=False).is_suspect


def test_given_wheels_that_slip_while_they_turn_then_they_are_not_stuck() -> None:
    assert not compare(WheelMonitor(), 50.0, 100, are_stationary=False, is_moving=True).is_suspect


def test_given_stuck_wheels_of_a_vehicle_at_rest_then_they_stay_suspect_until_it_moves_with_them() -> None:
    stuck = compare(WheelMonitor(), 10.0, 5, are_stationary=True, is_moving=True)
    resting = compare(stuck, 0.0, 500, are_stationary=True, is_moving=False)
    assert resting.is_suspect
    assert not compare(resting, 0.05, 1, are_stationary=False, is_moving=True).is_suspect
    assert compare(resting, 10.0, 50, are_stationary=True, is_moving=True).is_suspect
    # what it knows of its speed may be vague, and agree with any
    assert compare(resting, 0.05, 50, are_stationary=True, is_moving=True).is_suspect


def test_given_stuck_wheels_that_were_never_used_then_they_have_not_held_the_state() -> None:
    driving = compare(WheelMonitor(), 0.1, 10, are_stationary=False, is_moving=True)
    stuck = compare(driving, 100.0, 3, are_stationary=True, is_moving=True, is_used=False)
    assert stuck.is_suspect
    assert not stuck.has_held
    used = compare(driving, 8.0, 1, are_stationary=True, is_moving=True)
    assert compare(used, 100.0, 3, are_stationary=True, is_moving=True, is_used=False).has_held
