"""Sensors that tell what is not so, told to the real daemon: its pose is right, or says that it is not.

Event mode gives a pose with each sample, at its instant: so a whole drive is told as fast as the daemon takes it, and
each pose is compared with the truth all the same. Each fault by itself is told to the core, in
tests/unit/test_faults_core.py.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from pathlib import Path

import pytest
from support_daemon import Trial, trial
from support_faults import FAULTS, FROM_S, INERTIAL, clock_off, looped, twice_and_mixed, without_numbers
from support_lcm import PATIENCE_S
from support_ride import Judged, Ride

from modelserver.simulation import Event

SECONDS = 20.0
LONG_ENOUGH = FROM_S + 2.0 * PATIENCE_S
"""A drive in real time must last as long as a busy machine may take to wait for what happens in it."""
EVENT = {
    "  mode: timer ": "  mode: event ",
    "  state_hz: 5 ": "  state_hz: 0 ",
    "  decisions: true ": "  decisions: false ",
}
USED = {"\nsensors:\n": "\nsensors:\n  second_writer: use\n"}
IGNORED = frozenset((channel, "second_writer") for channel in ("IMU", "WHEELS"))
"""A fix that is told again within its last 64 passes for a message that came twice, and is refused as one."""
Way = Callable[[Iterable[Event], int], Iterable[Event]]


def told(run: Trial, models: dict[str, object], transform: Way) -> list[Judged]:
    begin = time.time_ns() // 1000 - round((SECONDS + 5.0) * 1e6)
    run.ride = Ride.at(begin, SECONDS, **{"imu_model": INERTIAL, **models})
    run.tell_all(run.ride.events(lambda events: transform(events, begin)))
    assert run.health.handler_errors == 0
    return run.assert_right()


@pytest.mark.parametrize(
    ("name", "counted", "transform", "changes"),
    [
        ("gps_jumps_700_m", FAULTS["duplicated_and_reordered"].counted, twice_and_mixed, {}),
        ("both_wheels_stuck", FAULTS["looped_log"].counted, looped, USED),
        ("both_wheels_stuck", IGNORED, looped, {}),
    ],
    ids=["mixed", "looped-used", "looped-ignored"],
)
def test_given_messages_again_and_a_sensor_that_fails_then_the_pose_stays_right(
    name: str,
    counted: frozenset[tuple[str, str]],
    transform: Way,
    changes: dict[str, str],
    lcm_url: str,
    tmp_path: Path,
) -> None:
    fault = FAULTS[name]
    with trial(lcm_url, tmp_path, feeding=False, changes=EVENT | changes) as run:
        found = told(run, fault.models, transform)
        assert all(each.valid for each in found if each.utime > run.ride.start_utime + (FROM_S - 3.0) * 1e6)
        assert fault.counted | counted <= run.rejected.keys(), run.rejected


@pytest.mark.parametrize(("name", "transform"), [("imu_frozen", clock_off(-1.0)), ("imu_nan", without_numbers)])
def test_given_an_inertial_unit_that_fails_then_the_pose_is_not_valid(
    name: str, transform: Way, lcm_url: str, tmp_path: Path
) -> None:
    fault = FAULTS[name]
    with trial(lcm_url, tmp_path, feeding=False, changes=EVENT) as run:
        found = told(run, fault.models, transform)
        start = run.ride.start_utime
        assert [each.valid for each in found if each.utime < start + FROM_S * 1e6][-1]
        assert not any(each.valid for each in found if each.utime > start + (FROM_S + 2.0) * 1e6)
        assert fault.counted <= run.rejected.keys(), run.rejected


AHEAD_S = 10.0
"""By how much the receiver's clock goes ahead: by more than messages may come late on a busy machine, where a stamp
that is 1 s ahead is of the past when it arrives. The core is given 1 s, in tests/unit/test_faults_core.py.
"""


def test_given_a_receiver_whose_clock_goes_ahead_then_its_fixes_are_refused_and_the_pose_stays_right(
    lcm_url: str, tmp_path: Path
) -> None:
    with trial(lcm_url, tmp_path, feeding=False) as run:
        begin = time.time_ns() // 1000 - round((FROM_S + 0.5) * 1e6)
        run.ride = Ride.at(begin, LONG_ENOUGH)
        run.feed(run.ride.stream(lambda events: clock_off(AHEAD_S)(events, begin)))
        run.until_health(lambda health: ("sensor:gps", "future") in {each[:2] for each in health.rejected}, "a refusal")
        since = time.monotonic()
        run.until(lambda: run.valid_since(since + 0.5), "a valid pose")
        run.assert_right()
