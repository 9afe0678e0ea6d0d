"""The daemon starts from what it kept: warm or cold it says so, keeps on, and no disk that fails stops it."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import pytest
from support_samples import GEOMETRY, START, VEHICLE, Scripted, now_at, started, write_vehicle

from modelserver import core
from modelserver.config import load_config
from modelserver.localization.filter.keeping import ago, judged, named
from modelserver.localization.modes import ModeLocalizer
from modelserver.messages import Decision, Health, KeepState, Kept, Recalled, StartTold, Tick, Verdict
from modelserver.service.clock import FakeClock
from modelserver.service.daemon import Vehicle, load_vehicle
from modelserver.service.fake_bus import FakeBus
from modelserver.service.hooks import Hooks
from modelserver.service.keeping.state import StateKeeper
from modelserver.service.loop import Loop, LoopSettings
from modelserver.wire.codec import decode
from tests.support_kept import KEPT, SETUP

EVERY_S = 5


def vehicle(folder: Path, text: str = VEHICLE) -> Vehicle:
    return load_vehicle(load_config(write_vehicle(folder, text, GEOMETRY)))


@dataclass(frozen=True)
class Keeping(Scripted):
    """A localizer that always has something to keep."""

    def kept(self) -> Kept | None:
        return KEPT if self.newest else None


def of(loaded: Vehicle) -> Kept:
    """What the vehicle's own localizer would have kept."""
    makings = loaded.makings()
    assert makings is not None
    layout = makings.setup.layout
    n = layout.size
    identity = tuple(1e-4 if k % (n + 1) == 0 else 0.0 for k in range(n * n))
    return KEPT._replace(
        setup=named(makings.setup), names=layout.names, extras=(0.0,) * (n - 15), covariance=identity, pose=None
    )


@pytest.mark.parametrize(
    ("change", "age", "why"),
    [
        ({}, 7.0, ""),
        ({"vehicle": "van"}, 7.0, "it is of vehicle 'van', not of 'cart'"),
        ({"setup": "0" * 16}, 7.0, "mounts, wheels or measurements of the vehicle have changed since"),
        ({"names": ("a",) * 21}, 7.0, "its error states are others"),
        ({"covariance": (0.0,) * 9}, 7.0, "its error states are others"),
        ({}, 3 * 86400.0, "3 days ago is not used: it is older than restart.max_age_s"),
    ],
)
def test_given_a_kept_state_then_it_is_used_only_where_it_is_of_this_vehicle_and_not_too_old(change, age, why) -> None:
    found = judged(Recalled(KEPT._replace(**change), age), "cart", SETUP)
    assert (found.kept is None) == bool(why)
    assert why in found.why


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.4, "0 s ago"), (119.0, "119 s ago"), (7200.0, "2 h ago"), (3e5, "3 days ago")]
)
def test_given_an_age_then_it_is_told_in_words(seconds: float, text: str) -> None:
    assert ago(seconds) == text


def test_given_what_was_kept_then_the_start_is_warm_and_says_so(tmp_path: Path) -> None:
    loaded = vehicle(tmp_path)
    state = loaded.core(now_at(START), None, Recalled(of(loaded), 4.0))
    assert state.notices == {"start": "warm start: what was kept 4 s ago waits for the sensors"}
    assert isinstance(state.localizer, ModeLocalizer)
    assert state.localizer.active.head.resuming is not None
    assert state.settings.keep_period_ns == EVERY_S * 10**9


@pytest.mark.parametrize(
    ("text", "recalled", "said"),
    [
        (VEHICLE, None, {}),
        (VEHICLE, Recalled(why="nothing is kept of an earlier run"), "nothing is kept of an earlier run"),
        (VEHICLE, Recalled(KEPT._replace(vehicle="van"), 4.0), "it is of vehicle 'van'"),
        (VEHICLE + "localization: {mode: raw}\n", Recalled(KEPT, 4.0), "raw mode goes on from nothing but the origin"),
    ],
)
def test_given_nothing_that_may_be_used_then_the_start_is_cold_and_says_why(
    tmp_path: Path, text, recalled, said
) -> None:
    state = vehicle(tmp_path, text).core(now_at(START), None, recalled)
    if said:
        assert state.notices["start"].startswith("cold start: ")
        assert said in state.notices["start"]
    else:
        assert state.notices == {}
    assert isinstance(state.localizer, ModeLocalizer)
    assert getattr(getattr(state.localizer.active, "head", None), "resuming", None) is None


def test_given_a_vehicle_file_that_keeps_nothing_then_nothing_is_kept(tmp_path: Path) -> None:
    assert vehicle(tmp_path, VEHICLE + "restart: {keep: false}\n").core(now_at(START)).settings.keep_period_ns == 0


def test_given_ticks_then_the_state_is_to_be_kept_every_few_seconds_with_name_and_clocks() -> None:
    state, kept = started(Keeping(newest=START), keep_period_ns=EVERY_S * 10**9), []
    for n in range(1000):
        now = now_at(START + n * 20_000)
        state, outputs = core.step(state, Tick(), now)
        kept += [each.kept for each in outputs if isinstance(each, KeepState)]
    assert [each.utime - START for each in kept] == [0, 5_000_000, 10_000_000, 15_000_000]
    assert {each.vehicle for each in kept} == {"cart"}
    assert kept[1].monotonic_ns - kept[0].monotonic_ns == 5_000_000_000
    assert core.kept(state, now) == KEPT._replace(vehicle="cart", utime=now.utime, monotonic_ns=now.monotonic_ns)


@pytest.mark.parametrize("localizer", [None, Scripted(newest=START), Keeping()])
def test_given_nothing_to_keep_then_nothing_is_said_of_it(localizer) -> None:
    state = started(localizer, keep_period_ns=EVERY_S * 10**9)
    for n in range(300):
        state, outputs = core.step(state, Tick(), now_at(START + n * 20_000))
        assert not any(isinstance(each, KeepState) for each in outputs)


def test_given_a_word_on_the_start_then_it_is_told_for_ten_minutes_and_taken_back() -> None:
    state = started(Keeping(newest=START), keep_period_ns=EVERY_S * 10**9)
    word = Decision(START, "filter", 0, "kept", Verdict.TOOK_UP, "warm start: all of it")
    state, outputs = core.start_told(state, word, now_at(START))
    assert outputs == (StartTold("warm start: all of it"),)
    assert state.notices == {"start": "warm start: all of it"}
    state, _ = core.step(state, Tick(), now_at(START + 599_000_000))
    assert state.notices
    state, _ = core.step(state, Tick(), now_at(START + 601_000_000))
    assert state.notices == {}
    # one that comes later than that is for the log alone
    state, outputs = core.start_told(state, word, now_at(START + 700_000_000))
    assert (len(outputs), state.notices) == (1, {})


def test_given_a_disk_that_fails_then_health_says_so_and_poses_go_on(tmp_path: Path, caplog) -> None:
    (tmp_path / "file").write_text("")
    keeper = StateKeeper(tmp_path / "file", "cart")
    clock = FakeClock(START, 10_000_000_000)
    bus = FakeBus(clock)
    state = started(Keeping(newest=START), keep_period_ns=EVERY_S * 10**9)
    loop = Loop(bus, clock, state, LoopSettings(20_000_000), Hooks(on_keep=keeper.keep))
    caplog.set_level(logging.INFO)
    loop.turn()
    keeper.close()
    for _ in range(600):
        loop.turn()
    health = [decode("health_t", data) for data in bus.said("MODELSERVER_HEALTH")][-1]
    assert isinstance(health, Health)
    assert "the state cannot be kept in" in dict(health.notices)["restart"]
    assert len(bus.said("POSE")) == 601
    assert sum("cannot be kept" in record.getMessage() for record in caplog.records) == 1
