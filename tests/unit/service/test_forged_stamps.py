"""Forged stamps on every channel, through the whole loop: they speak for their own source, and no pose is the worse."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from support_faults import INERTIAL
from support_ride import CHANNELS, Ride
from support_stamps import FORGED, Attack, Drive

from modelserver.localization.filter import engine
from modelserver.localization.filter.clocks import REPLAY_BURST, REPLAY_RATE

pytestmark = pytest.mark.slow

START = 1_700_000_000_000_000
WARM_S, PHASE_S = 9.0, 0.2

STAMPS = {
    "ahead": (1.0,),
    "just ahead": (0.2,),
    "behind": (-0.5,),
    "far behind": (-1e6,),
    "alternating": (0.2, -0.2, -5.0, 1e8),
}
"""Seconds from now of a stranger's stamps, in turn."""

ATTACK_HZ = 300.0


def check_attacks(folder: Path, attacks: list[tuple[str, Attack]]) -> Drive:
    """Drive until the pose is valid, then run the attacks in turn; assert that no pose is worse for any."""
    ride = Ride.at(START, WARM_S + PHASE_S * len(attacks) + 1.0, imu_model=INERTIAL)
    drive = Drive(ride, folder)
    outcome = drive.run(WARM_S)
    at = WARM_S
    for name, attack in attacks:
        attack.since = at
        attack.first += round((at - WARM_S) * attack.hz)
        # and a little without it: what it left behind shows as well
        drive.run(at + 0.8 * PHASE_S, [attack])
        drive.run(at + PHASE_S)
        assert outcome.invalid(at) == [], name
        assert outcome.lies(at) == 0, name
        at += PHASE_S
    published = sum(utime >= START + WARM_S * 1e6 for utime, _ in outcome.poses)
    assert published >= (at - WARM_S) * 100.0 - 2.0
    assert drive.loop.state.handler_errors == 0
    return drive


@pytest.mark.parametrize("source", ["stranger", "imu"])
def test_given_stamps_of_a_stranger_on_any_channel_then_every_pose_stays_valid(source: str, tmp_path: Path) -> None:
    attacks = [
        (f"{channel} {name}", Attack(channel, source, stamps, hz=ATTACK_HZ))
        for channel in FORGED
        if source == "stranger" or channel not in CHANNELS.values()
        for name, stamps in STAMPS.items()
    ]
    drive = check_attacks(tmp_path, attacks)
    # they are counted as what they are
    assert drive.loop.state.rejected[f"sensor:{source}", "future"] > 30


@pytest.mark.parametrize("channel", sorted(CHANNELS.values()))
def test_given_stamps_in_the_name_of_the_sensor_itself_then_every_pose_stays_valid(
    channel: str, tmp_path: Path
) -> None:
    attacks = [
        (f"{channel} {name} {row}", Attack(channel, channel.lower(), stamps, **how))
        for name, stamps in STAMPS.items()
        for row, how in (
            ("own numbers", {"hz": ATTACK_HZ}),
            ("its next number", {"seq_ahead": 1, "count": 1}),
            ("a number that may follow lost ones", {"seq_ahead": 3000, "count": 1}),
        )
    ]
    check_attacks(tmp_path, attacks)


def test_given_the_hosts_clock_set_back_then_no_pose_is_valid_until_the_sensors_have_the_new_time(
    tmp_path: Path,
) -> None:
    """By half a second: what is held seems to be of now, and is of half a second ago."""
    ride = Ride.at(START, 12.0, imu_model=INERTIAL)
    drive = Drive(ride, tmp_path)
    drive.run(WARM_S)
    drive.step_clock(-0.5)
    outcome = drive.run(10.0)
    # all but the first, whose tick was at the instant of the step
    assert len(outcome.invalid(WARM_S - 0.5)) >= 98


def test_given_a_stranger_that_stamps_half_a_second_back_1000_times_a_second_then_little_is_fused_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each delayed measurement has all after it fused again: unbounded that is more work than there is time."""
    ride = Ride.at(START, 12.0, imu_model=INERTIAL)
    drive = Drive(ride, tmp_path)
    outcome = drive.run(WARM_S)
    count = 0
    fused = engine.fused

    def counting(*arguments: Any) -> Any:
        nonlocal count
        count += 1
        return fused(*arguments)

    monkeypatch.setattr(engine, "fused", counting)
    drive.run(11.0, [Attack("RANGE", "stranger", (-0.5,), hz=1000.0, since=WARM_S)])
    assert count < 2.0 * REPLAY_RATE + REPLAY_BURST + 1000
    assert outcome.invalid(WARM_S) == []
    assert outcome.lies(WARM_S) == 0
    assert drive.loop.state.rejected["sensor:stranger", "load"] > 1000
