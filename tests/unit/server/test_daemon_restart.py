"""Warm start of the daemon: its report, later persistence, and a failing disk."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import pytest
from support_persistence import PERSISTED, SETUP
from support_samples import GEOMETRY, START, VEHICLE, ScriptedLocalizer, instant_at, start_core, write_vehicle

from modelserver import core
from modelserver.config.vehicle_file import load_config
from modelserver.core import report_start
from modelserver.estimation.filter.warm_start import check_restored, format_age, get_setup_hash
from modelserver.estimation.modes import ModeLocalizer
from modelserver.messages import (
    Decision,
    Health,
    PersistedState,
    PersistState,
    ReportStart,
    RestoredState,
    Tick,
    Verdict,
)
from modelserver.server.bus import FakeBus
from modelserver.server.clock import FakeClock
from modelserver.server.loop import Hooks, Loop, LoopSettings
from modelserver.server.persistence import StateStore
from modelserver.server.vehicle import Vehicle, load_vehicle
from modelserver.wire.codec import decode

EVERY_S = 5


def vehicle(folder: Path, text: str = VEHICLE) -> Vehicle:
    return load_vehicle(load_config(write_vehicle(folder, text, GEOMETRY)))


@dataclass(frozen=True)
class PersistentScriptedLocalizer(ScriptedLocalizer):
    """A localizer that always has a state to persist."""

    def get_state_to_persist(self) -> PersistedState | None:
        return PERSISTED if self.newest else None


def of(loaded: Vehicle) -> PersistedState:
    """Make a persisted state of the vehicle's own localizer."""
    makings = loaded.make_localizer_setup()
    assert makings is not None
    layout = makings.setup.layout
    n = layout.size
    identity = tuple(1e-4 if k % (n + 1) == 0 else 0.0 for k in range(n * n))
    return PERSISTED._replace(
        setup=get_setup_hash(makings.setup),
        names=layout.names,
        extras=(0.0,) * (n - 15),
        covariance=identity,
        pose=None,
    )


@pytest.mark.parametrize(
    ("change", "age", "reason"),
    [
        ({}, 7.0, ""),
        ({"vehicle": "van"}, 7.0, "it is of vehicle 'van', not of 'cart'"),
        ({"setup": "0" * 16}, 7.0, "mounts, wheels or measurements of the vehicle have changed since"),
        ({"names": ("a",) * 21}, 7.0, "its error states are others"),
        ({"covariance": (0.0,) * 9}, 7.0, "its error states are others"),
        ({}, 3 * 86400.0, "3 days ago is not used: it is older than warm_start.max_age_s"),
    ],
)
def test_given_a_persisted_state_then_it_is_used_only_if_it_is_of_this_vehicle_and_not_too_old(
    change, age, reason
) -> None:
    found = check_restored(RestoredState(PERSISTED._replace(**change), age), "cart", SETUP)
    assert (found.state is None) == bool(reason)
    assert reason in found.reason


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.4, "0 s ago"), (119.0, "119 s ago"), (7200.0, "2 h ago"), (3e5, "3 days ago")]
)
def test_given_an_age_then_it_is_formatted_in_words(seconds: float, text: str) -> None:
    assert format_age(seconds) == text


def test_given_a_persisted_state_then_the_start_is_warm_and_reported(tmp_path: Path) -> None:
    loaded = vehicle(tmp_path)
    state = loaded.start_core(instant_at(START), None, RestoredState(of(loaded), 4.0))
    assert state.warnings == {"start": "warm start: the state stored 4 s ago waits for the sensors"}
    assert isinstance(state.localizer, ModeLocalizer)
    assert state.localizer.active.head.common.warm_start is not None
    assert state.settings.persist_period_ns == EVERY_S * 10**9


@pytest.mark.parametrize(
    ("text", "restored", "report"),
    [
        (VEHICLE, None, {}),
        (VEHICLE, RestoredState(reason="no state of an earlier run is stored"), "no state of an earlier run is stored"),
        (VEHICLE, RestoredState(PERSISTED._replace(vehicle="van"), 4.0), "it is of vehicle 'van'"),
        (
            VEHICLE + "localization: {mode: raw}\n",
            RestoredState(PERSISTED, 4.0),
            "raw mode restores only the origin",
        ),
    ],
)
def test_given_no_usable_persisted_state_then_the_start_is_cold_and_the_reason_is_reported(
    tmp_path: Path, text, restored, report
) -> None:
    state = vehicle(tmp_path, text).start_core(instant_at(START), None, restored)
    if report:
        assert state.warnings["start"].startswith("cold start: ")
        assert report in state.warnings["start"]
    else:
        assert state.warnings == {}
    assert isinstance(state.localizer, ModeLocalizer)
    head = getattr(state.localizer.active, "head", None)
    assert getattr(getattr(head, "common", None), "warm_start", None) is None


def test_given_a_vehicle_file_without_persistence_then_nothing_is_persisted(tmp_path: Path) -> None:
    assert (
        vehicle(tmp_path, VEHICLE + "warm_start: {persist: false}\n")
        .start_core(instant_at(START))
        .settings.persist_period_ns
        == 0
    )


def test_given_ticks_then_the_state_is_persisted_every_few_seconds_with_name_and_clocks() -> None:
    state, persisted = start_core(PersistentScriptedLocalizer(newest=START), persist_period_ns=EVERY_S * 10**9), []
    for n in range(1000):
        now = instant_at(START + n * 20_000)
        state, outputs = core.step(state, Tick(), now)
        persisted += [each.state for each in outputs if isinstance(each, PersistState)]
    assert [each.utime - START for each in persisted] == [0, 5_000_000, 10_000_000, 15_000_000]
    assert {each.vehicle for each in persisted} == {"cart"}
    assert persisted[1].monotonic_ns - persisted[0].monotonic_ns == 5_000_000_000
    assert core.get_state_to_persist(state, now) == PERSISTED._replace(
        vehicle="cart", utime=now.utime, monotonic_ns=now.monotonic_ns
    )


@pytest.mark.parametrize("localizer", [None, ScriptedLocalizer(newest=START), PersistentScriptedLocalizer()])
def test_given_nothing_to_persist_then_there_is_no_output(localizer) -> None:
    state = start_core(localizer, persist_period_ns=EVERY_S * 10**9)
    for n in range(300):
        state, outputs = core.step(state, Tick(), instant_at(START + n * 20_000))
        assert not any(isinstance(each, PersistState) for each in outputs)


def test_given_a_report_on_the_start_then_it_is_shown_for_ten_minutes_and_cleared() -> None:
    state = start_core(PersistentScriptedLocalizer(newest=START), persist_period_ns=EVERY_S * 10**9)
    word = Decision(START, "filter", 0, "warm_start", Verdict.RESET, "warm start: all of it")
    state, outputs = report_start(state, word, instant_at(START))
    assert outputs == (ReportStart("warm start: all of it"),)
    assert state.warnings == {"start": "warm start: all of it"}
    state, _ = core.step(state, Tick(), instant_at(START + 599_000_000))
    assert state.warnings
    state, _ = core.step(state, Tick(), instant_at(START + 601_000_000))
    assert state.warnings == {}
    # a later one is only logged
    state, outputs = report_start(state, word, instant_at(START + 700_000_000))
    assert (len(outputs), state.warnings) == (1, {})


def test_given_a_disk_that_fails_then_health_warns_and_poses_continue(tmp_path: Path, caplog) -> None:
    (tmp_path / "file").write_text("")
    keeper = StateStore(tmp_path / "file", "cart")
    clock = FakeClock(START, 10_000_000_000)
    bus = FakeBus(clock)
    state = start_core(PersistentScriptedLocalizer(newest=START), persist_period_ns=EVERY_S * 10**9)
    loop = Loop(bus, clock, state, LoopSettings(20_000_000), Hooks(on_persist=keeper.save))
    caplog.set_level(logging.INFO)
    loop.run_once()
    keeper.close()
    for _ in range(600):
        loop.run_once()
    health = [decode("health_t", data) for data in bus.get_published("MODELSERVER_HEALTH")][-1]
    assert isinstance(health, Health)
    assert "the state cannot be stored in" in dict(health.warnings)["restart"]
    assert len(bus.get_published("POSE")) == 601
    assert sum("cannot be stored" in record.getMessage() for record in caplog.records) == 1
