"""Faulty sensors and the real daemon: its pose is within its protection level, or marked invalid.

Event mode publishes a pose with each sample, at its instant: so a whole drive is published as fast as the daemon
processes it, and each pose is compared with the truth. tests/unit/test_faults_core.py tests each fault by itself.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from pathlib import Path

import pytest
from support_daemon import Trial, trial
from support_drive import ComparedPose, SimulatedDrive
from support_faults import FAULTS, FROM_S, INERTIAL, clock_off, loop_log, twice_and_mixed, without_numbers
from support_lcm import TIMEOUT_S

from modelserver.simulation import Event

SECONDS = 20.0
LONG_ENOUGH = FROM_S + 2.0 * TIMEOUT_S
"""A drive in real time must outlast the waits of a test on a busy machine."""
EVENT = {
    "  mode: timer ": "  mode: event ",
    "  state_hz: 5 ": "  state_hz: 0 ",
    "  decisions: true ": "  decisions: false ",
}
USED = {"\nsensors:\n": "\nsensors:\n  publisher_conflict: use\n"}
IGNORED = frozenset((channel, "publisher_conflict") for channel in ("IMU", "WHEELS"))
"""Rejections of a repeated log: the repeated fixes count as duplicates, the other samples as a second publisher."""
Transform = Callable[[Iterable[Event], int], Iterable[Event]]


def publish_drive(run: Trial, models: dict[str, object], transform: Transform) -> list[ComparedPose]:
    begin = time.time_ns() // 1000 - round((SECONDS + 5.0) * 1e6)
    run.ride = SimulatedDrive.create(begin, SECONDS, **{"imu_model": INERTIAL, **models})
    run.publish_all(run.ride.events(lambda events: transform(events, begin)))
    assert run.health.handler_errors == 0
    return run.assert_consistent()


@pytest.mark.parametrize(
    ("name", "counted", "transform", "changes"),
    [
        ("gps_jumps_700_m", FAULTS["duplicated_and_reordered"].counted, twice_and_mixed, {}),
        ("both_wheels_stuck", FAULTS["looped_log"].counted, loop_log, USED),
        ("both_wheels_stuck", IGNORED, loop_log, {}),
    ],
    ids=["mixed", "loop_log-used", "loop_log-ignored"],
)
def test_given_repeated_messages_and_a_sensor_that_fails_then_the_pose_stays_right(
    name: str,
    counted: frozenset[tuple[str, str]],
    transform: Transform,
    changes: dict[str, str],
    lcm_url: str,
    tmp_path: Path,
) -> None:
    fault = FAULTS[name]
    with trial(lcm_url, tmp_path, feeding=False, changes=EVENT | changes) as run:
        found = publish_drive(run, fault.models, transform)
        assert all(each.is_valid for each in found if each.utime > run.ride.start_utime + (FROM_S - 3.0) * 1e6)
        assert fault.counted | counted <= run.rejected.keys(), run.rejected


@pytest.mark.parametrize(("name", "transform"), [("imu_frozen", clock_off(-1.0)), ("imu_nan", without_numbers)])
def test_given_an_inertial_unit_that_fails_then_the_pose_is_not_valid(
    name: str, transform: Transform, lcm_url: str, tmp_path: Path
) -> None:
    fault = FAULTS[name]
    with trial(lcm_url, tmp_path, feeding=False, changes=EVENT) as run:
        found = publish_drive(run, fault.models, transform)
        start = run.ride.start_utime
        assert [each.is_valid for each in found if each.utime < start + FROM_S * 1e6][-1]
        assert not any(each.is_valid for each in found if each.utime > start + (FROM_S + 2.0) * 1e6)
        assert fault.counted <= run.rejected.keys(), run.rejected


AHEAD_S = 10.0
"""Lead of the receiver's clock, more than the latency of messages on a busy machine, which would hide 1 s. The core is
tested with 1 s, in tests/unit/test_faults_core.py.
"""


def test_given_a_receiver_whose_clock_goes_ahead_then_its_fixes_are_rejected_and_the_pose_stays_right(
    lcm_url: str, tmp_path: Path
) -> None:
    with trial(lcm_url, tmp_path, feeding=False) as run:
        begin = time.time_ns() // 1000 - round((FROM_S + 0.5) * 1e6)
        run.ride = SimulatedDrive.create(begin, LONG_ENOUGH)
        run.feed(run.ride.stream(lambda events: clock_off(AHEAD_S)(events, begin)))
        run.wait_for_health(
            lambda health: ("sensor:gps", "future") in {each[:2] for each in health.rejected}, "a rejection"
        )
        since = time.monotonic()
        run.wait_until(lambda: run.is_valid_since(since + 0.5), "a valid pose")
        run.assert_consistent()
