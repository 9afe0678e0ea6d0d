"""Encoded states and events: a decoded run continues bit for bit, in a build with the same types."""

from __future__ import annotations

import dataclasses
import os
import pickle
from pathlib import Path

import pytest
from support_journal import OPEN, SMALL, START, JournalRig
from support_samples import GEOMETRY, ME, drive, imu

from modelserver import core
from modelserver.core import CoreState, Instant, ModelLoaded
from modelserver.errors import RecordingError
from modelserver.messages import (
    Denied,
    GetBodyList,
    GetStateVector,
    HealthWarning,
    JointSample,
    JointsSample,
    PoseAnswer,
    Rejected,
    ReloadModel,
    SensorHeader,
    SetStateVector,
    SignedCommand,
    Tick,
    TimeQuery,
)
from modelserver.server.journal import encoding as journal_state
from modelserver.server.journal.encoding import RunState
from modelserver.transforms.pose import Pose
from modelserver.transforms.transformation import Transformation

pytestmark = pytest.mark.slow

NODDING = GEOMETRY.replace("xyz: [0, 0, 0.1]", "xyz: [0, 0, 0.1], joint: {type: revolute, axis: [0, 1, 0]}")


@pytest.mark.parametrize("text", [OPEN, SMALL], ids=["filter", "raw"])
def test_given_a_state_when_decoded_then_it_continues_bit_for_bit(tmp_path: Path, text: str) -> None:
    rig = JournalRig(tmp_path, text, NODDING)
    for sample in drive(7.0, rig.clock.utime()):
        if sample.header.utime % 200_000 == 0:
            joint = JointSample("Mounted", 0.1 * (sample.header.utime % 7))
            rig.send(JointsSample(SensorHeader(sample.header.utime, "axis"), (joint,)))
        rig.send(sample)
        rig.run_cycles()
    rig.send(GetStateVector(ME, TimeQuery(rig.clock.utime() + 900_000, wait_ms=2000)))
    rig.run_cycles()
    state = rig.loop.state
    assert state.waiting
    assert len(state.view.joints.tracks["Mounted"]) > 10
    run = RunState(rig.vehicle.config, journal_state.detach(state))
    data = journal_state.encode_run(run)
    config, back = journal_state.decode_run(data)
    assert config == rig.vehicle.config
    # a decoded state is encoded to the same bytes
    assert journal_state.encode_run(RunState(config, back)) == data
    assert 0 < len(back.history) <= len(state.history)
    for sample in drive(1.5, rig.clock.utime()):
        now = Instant(rig.clock.monotonic_ns(), sample.header.utime)
        for event in (sample, Tick(0.001)):
            state, published = core.step(state, event, now)
            back, again = core.step(back, event, now)
            assert repr(again) == repr(published)


def test_given_a_state_when_read_back_then_values_are_shared_as_they_were(tmp_path: Path) -> None:
    rig = JournalRig(tmp_path, OPEN)
    rig.drive(6.0)
    state = journal_state.detach(rig.loop.state)
    _, back = journal_state.decode_run(journal_state.encode_run(RunState(rig.vehicle.config, state)))

    def counts(state: CoreState) -> tuple[int, int, int, bool]:
        held = [each for block in state.history._blocks for each in block.estimates]
        rig = state.localizer.config.setup.rig  # type: ignore[union-attr]
        setups, states = {id(each.setup) for each in held}, {id(each.state) for each in held}  # type: ignore[union-attr]
        covariances = {id(each.state.nav.covariance) for each in held}  # type: ignore[union-attr]
        return len(setups), len(states), len(covariances), rig.model is state.model

    assert counts(back) == counts(state)
    assert counts(back)[0] == 1
    assert counts(back)[2] < len(back.history) / 2


def test_given_a_state_that_is_written_while_its_successors_grow_then_only_what_it_holds_is_written(
    tmp_path: Path,
) -> None:
    rig = JournalRig(tmp_path, SMALL, NODDING)
    rig.drive(1.0)
    rig.send(JointsSample(SensorHeader(rig.clock.utime(), "axis"), (JointSample("Mounted", 0.1),)))
    rig.run_cycles(2)
    state = rig.loop.state
    run = RunState(rig.vehicle.config, journal_state.detach(state))
    before = journal_state.encode_run(run)
    rig.send(JointsSample(SensorHeader(rig.clock.utime(), "axis"), (JointSample("Mounted", 0.2),)))
    rig.drive(0.5)
    assert journal_state.encode_run(run._replace(state=journal_state.detach(state))) == before


def test_given_work_that_takes_long_then_it_pauses_again_and_again(tmp_path: Path) -> None:
    rig = JournalRig(tmp_path)
    rig.drive(6.0)
    pauses: list[int] = []
    run = RunState(rig.vehicle.config, journal_state.detach(rig.loop.state))
    journal_state.encode_run(run, lambda: pauses.append(1))
    assert len(pauses) > 20


@pytest.mark.parametrize("data", [b"", b"\x80\x05", b"garbage" * 9, pickle.dumps(3), pickle.dumps([os.system] * 9)])
def test_given_bytes_that_are_no_state_then_that_is_reported(data: bytes) -> None:
    with pytest.raises(RecordingError):
        journal_state.decode_run(data)


def test_given_sections_of_drivers_then_they_are_not_written(tmp_path: Path) -> None:
    rig = JournalRig(tmp_path, SMALL)
    config = dataclasses.replace(rig.vehicle.config, drivers={"wheels": {"port": Path("/dev/ttyS0")}})
    run = RunState(config, journal_state.detach(rig.loop.state))
    assert journal_state.decode_run(journal_state.encode_run(run)).config == rig.vehicle.config


POSE = Transformation("Cart:Base", "World:UTM", Pose.from_rpy((1.0, 2.0, 3.0), 0.1, 0.2, 0.3), utime=7)


@pytest.mark.parametrize(
    "event",
    [
        Tick(0.1 + 0.2, 3, 7),
        Tick(5e-324),
        Tick(-0.0),
        Tick(1, 1 << 80, -(1 << 90)),
        Rejected("GPS", 'a "word"\n\x1b'),
        Rejected("GPS", "\udc80"),
        HealthWarning("clock", "Ä is not set"),
        ModelLoaded(ReloadModel(ME), why="the file is gone"),
        imu(START),
        Tick(float("inf")),
        Denied("MODELSERVER_SIGNED", "window", "too old", GetBodyList, ME),
        SignedCommand(SetStateVector(ME, PoseAnswer(POSE)), "operator"),
    ],
)
def test_given_an_event_of_the_services_own_when_read_back_then_it_is_the_same(event: object) -> None:
    data = journal_state.encode_value(event, is_described=False)
    back = journal_state.decode_value(data)
    assert repr(back) == repr(event)
    assert journal_state.encode_value(back, is_described=False) == data


@pytest.mark.parametrize("data", [b"", b"{}", b"[]", b"3", b"\0\0\0\1\x90", b"\0\0\0\2\x91\x00", b'["Tick", 1]'])
def test_given_bytes_that_are_no_event_then_that_is_reported(data: bytes) -> None:
    with pytest.raises(RecordingError):
        journal_state.decode_value(data)
