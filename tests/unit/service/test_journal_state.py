"""States and events as bytes: what comes back goes on as if nothing had been, and nothing foreign is run."""

from __future__ import annotations

import os
import pickle
import subprocess
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from support_journal import OPEN, SMALL, START, Kept
from support_samples import GEOMETRY, ME, drive, imu

from modelserver import core
from modelserver.config import load_config
from modelserver.core import Instant
from modelserver.errors import RecordingError
from modelserver.messages import (
    GetStateVector,
    JointSample,
    JointsSample,
    Noticed,
    Rejected,
    ReloadModel,
    SensorHeader,
    Tick,
    TimeQuery,
)
from modelserver.reload import ModelLoaded
from modelserver.service.journal import events as journal_events
from modelserver.service.journal import state as journal_state
from modelserver.wire.journal import Kind

NODDING = GEOMETRY.replace("xyz: [0, 0, 0.1]", "xyz: [0, 0, 0.1], joint: {type: revolute, axis: [0, 1, 0]}")


@pytest.mark.parametrize("text", [OPEN, SMALL], ids=["filter", "raw"])
def test_given_a_state_when_read_back_then_it_goes_on_to_the_same_bits(tmp_path: Path, text: str) -> None:
    kept = Kept(tmp_path, text, NODDING)
    for sample in drive(7.0, kept.clock.utime()):
        if sample.header.utime % 200_000 == 0:
            joint = JointSample("Mounted", 0.1 * (sample.header.utime % 7))
            kept.send(JointsSample(SensorHeader(sample.header.utime, "axis"), (joint,)))
        kept.send(sample)
        kept.turns()
    kept.send(GetStateVector(ME, TimeQuery(kept.clock.utime() + 900_000, wait_ms=2000)))
    kept.turns()
    state = kept.loop.state
    assert state.parked
    assert len(state.view.joints.tracks["Mounted"]) > 10
    back = journal_state.read(journal_state.written(journal_state.apart(state)))
    assert 0 < len(back.history) <= len(state.history)
    for sample in drive(1.5, kept.clock.utime()):
        now = Instant(kept.clock.monotonic_ns(), sample.header.utime)
        for event in (sample, Tick(0.001)):
            state, said = core.step(state, event, now)
            back, again = core.step(back, event, now)
            assert repr(again) == repr(said)


def test_given_a_state_that_is_written_while_its_successors_grow_then_only_what_it_holds_is_written(
    tmp_path: Path,
) -> None:
    kept = Kept(tmp_path, SMALL, NODDING)
    kept.drive(1.0)
    kept.send(JointsSample(SensorHeader(kept.clock.utime(), "axis"), (JointSample("Mounted", 0.1),)))
    kept.turns(2)
    state = kept.loop.state
    before = journal_state.written(journal_state.apart(state))
    kept.send(JointsSample(SensorHeader(kept.clock.utime(), "axis"), (JointSample("Mounted", 0.2),)))
    kept.drive(0.5)
    assert journal_state.written(journal_state.apart(state)) == before


def test_given_work_that_takes_long_then_it_pauses_again_and_again(tmp_path: Path) -> None:
    kept = Kept(tmp_path)
    kept.drive(6.0)
    pauses: list[int] = []
    journal_state.written(journal_state.apart(kept.loop.state), lambda: pauses.append(1))
    assert len(pauses) > 20


class Evil:
    def __init__(self, what: Any, *arguments: object):
        self._does = what, arguments

    def __reduce__(self) -> Any:
        return self._does


@pytest.mark.parametrize(
    "value",
    [
        Evil(os.system, "true"),
        Evil(subprocess.Popen, ["true"]),
        Evil(eval, "1"),
        Evil(getattr, "x", "join"),
        Evil(load_config, "/etc/passwd"),
        Evil(Path, "/"),
        partial(os.system, "true"),
        os.system,
    ],
    ids=["system", "popen", "eval", "getattr", "load_config", "path", "partial", "function"],
)
def test_given_a_file_that_names_anything_foreign_then_it_is_refused_and_not_run(value: object) -> None:
    with pytest.raises(RecordingError, match="has no place in a journal"):
        journal_state.read(pickle.dumps(value))


@pytest.mark.parametrize("data", [b"", b"\x80\x05", b"garbage", pickle.dumps(3)[:-1]])
def test_given_bytes_that_are_no_state_then_that_is_said(data: bytes) -> None:
    with pytest.raises(RecordingError, match="cannot be read"):
        journal_state.read(data)


@pytest.mark.parametrize(
    "event",
    [
        Tick(0.1 + 0.2, 3, 7),
        Tick(5e-324),
        Rejected("GPS", 'a "word"\n\x1b'),
        Noticed("clock", "Ä is not set"),
        ModelLoaded(ReloadModel(ME), why="the file is gone"),
        imu(START),
        Tick(float("inf")),
    ],
)
def test_given_an_event_of_the_services_own_when_read_back_then_it_is_the_same(event: object) -> None:
    kind, data = journal_events.written(event)
    assert kind is (
        Kind.EVENT if type(event) in (Tick, Rejected, Noticed) and "inf" not in repr(event) else Kind.PICKLED
    )
    assert repr(journal_events.read(kind, data)) == repr(event)


@pytest.mark.parametrize(
    "data", [b"", b"{}", b"[]", b"3", b'["Tock", 1]', b'["Policy", 1]', b'["Tick", 1, 2, 3, 4, 5, 6, 7, 8, 9]']
)
def test_given_bytes_that_are_no_event_then_that_is_said(data: bytes) -> None:
    with pytest.raises(RecordingError):
        journal_events.read(Kind.EVENT, data)
