"""Forged stamps on every channel of a whole loop: each affects its own source only, and no pose is worse."""

from __future__ import annotations

from typing import Any

import pytest
from support_attacks import FORGED, Attack, LoopRun
from support_drive import CHANNELS, SimulatedDrive
from support_faults import INERTIAL

from modelserver.estimation.filter import localizer
from modelserver.estimation.inputs import REPLAY_BURST, REPLAY_RATE

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
"""Forged stamps, seconds from now, in turn."""

ATTACK_HZ = 300.0


MAX_ATTACKS = len(FORGED) * len(STAMPS)


@pytest.fixture(scope="module")
def warm(tmp_path_factory: pytest.TempPathFactory) -> LoopRun:
    """Drive until shortly before the attacks, once for all tests."""
    drive = SimulatedDrive.create(START, WARM_S + PHASE_S * MAX_ATTACKS + 1.0, imu_model=INERTIAL)
    loop_run = LoopRun(drive, tmp_path_factory.mktemp("warm"))
    loop_run.run(WARM_S - 1.0)
    return loop_run


@pytest.fixture
def loop_run(warm: LoopRun) -> LoopRun:
    """Return the loop of the test itself, which has received all sensors and whose pose is valid."""
    loop_run = warm.copy()
    loop_run.run(WARM_S)
    return loop_run


def check_attacks(loop_run: LoopRun, attacks: list[tuple[str, Attack]]) -> None:
    """Run the attacks in turn; assert that no pose is worse for any."""
    outcome, at = loop_run.outcome, WARM_S
    for name, attack in attacks:
        attack.since = at
        attack.first += round((at - WARM_S) * attack.hz)
        # and a little without it, for its after-effects
        loop_run.run(at + 0.8 * PHASE_S, [attack])
        loop_run.run(at + PHASE_S)
        assert outcome.invalid(at) == [], name
        assert outcome.count_misleading(at) == 0, name
        at += PHASE_S
    published = sum(utime >= START + WARM_S * 1e6 for utime, _ in outcome.poses)
    assert published >= (at - WARM_S) * 100.0 - 2.0
    assert loop_run.loop.state.handler_errors == 0


@pytest.mark.parametrize("source", ["stranger", "imu"])
def test_given_forged_stamps_on_any_channel_then_every_pose_stays_valid(source: str, loop_run: LoopRun) -> None:
    attacks = [
        (f"{channel} {name}", Attack(channel, source, stamps, hz=ATTACK_HZ))
        for channel in FORGED
        if source == "stranger" or channel not in CHANNELS.values()
        for name, stamps in STAMPS.items()
    ]
    check_attacks(loop_run, attacks)
    # counted under their reasons
    assert loop_run.loop.state.rejected[f"sensor:{source}", "future"] > 30


@pytest.mark.parametrize("channel", sorted(CHANNELS.values()))
def test_given_forged_stamps_with_the_source_of_the_sensor_then_every_pose_stays_valid(
    channel: str, loop_run: LoopRun
) -> None:
    attacks = [
        (f"{channel} {name} {row}", Attack(channel, channel.lower(), stamps, **options))
        for name, stamps in STAMPS.items()
        for row, options in (
            ("own numbers", {"hz": ATTACK_HZ}),
            ("its next number", {"seq_offset": 1, "count": 1}),
            ("a number that may follow lost ones", {"seq_offset": 3000, "count": 1}),
        )
    ]
    check_attacks(loop_run, attacks)


def test_given_the_hosts_clock_set_back_then_no_pose_is_valid_until_the_sensors_have_the_new_time(
    loop_run: LoopRun,
) -> None:
    """By half a second: stored estimates seem current, and are half a second old."""
    loop_run.step_clock(-0.5)
    outcome = loop_run.run(10.0)
    # all but the first, whose tick was at the instant of the step
    assert len(outcome.invalid(WARM_S - 0.5)) >= 98


def test_given_forged_stamps_half_a_second_back_1000_times_a_second_then_little_is_fused_again(
    loop_run: LoopRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each out-of-sequence measurement has all later ones fused again: unbounded, that exceeds the available time."""
    outcome = loop_run.outcome
    count = 0
    fuse = localizer.step

    def counting(*arguments: Any) -> Any:
        nonlocal count
        count += 1
        return fuse(*arguments)

    monkeypatch.setattr(localizer, "step", counting)
    loop_run.run(11.0, [Attack("RANGE", "stranger", (-0.5,), hz=1000.0, since=WARM_S)])
    assert count < 2.0 * REPLAY_RATE + REPLAY_BURST + 1000
    assert outcome.invalid(WARM_S) == []
    assert outcome.count_misleading(WARM_S) == 0
    assert loop_run.loop.state.rejected["sensor:stranger", "overload"] > 1000
