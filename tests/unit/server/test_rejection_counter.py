"""Rejected messages: all are counted, few are recorded in the journal, and replay reproduces them."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support_journal import SMALL, JournalRig
from support_samples import ME, imu

from modelserver import core
from modelserver.core import Instant
from modelserver.messages import GetTransformations, Rejected
from modelserver.server.ingress import MAX_PER_SECOND, MAX_RECORDED_BYTES, RejectionCounter
from modelserver.server.journal import JournalQueue
from modelserver.server.journal.verify import verify
from modelserver.server.log import RateLimiter
from modelserver.wire.codec import encode
from modelserver.wire.journal import JournalRecord, RecordKind, read_segment

FLOOD = 10_000
RECORD_BYTES = MAX_RECORDED_BYTES + 100
"""Bytes of a record, at most: with the overhead of the log event, the seal and the count."""


def records(rig: JournalRig) -> list[JournalRecord]:
    return [
        each for path in rig.segments for each in read_segment(path.read_bytes()) if isinstance(each, JournalRecord)
    ]


@pytest.mark.slow
def test_given_a_flood_of_rubbish_then_the_journal_grows_by_little_and_is_reproduced(tmp_path: Path) -> None:
    sizes = []
    for rubbish in (0, FLOOD // 50):
        folder = tmp_path / str(rubbish)
        folder.mkdir()
        rig = JournalRig(folder, SMALL)
        for _ in range(50):
            for _ in range(rubbish):
                rig.bus.publish("GPS", b"\xff" * 1000)
            rig.drive(0.1)
        rig.run_cycles(60)
        rig.finish()
        sizes.append(sum(path.stat().st_size for path in rig.segments))
    assert rig.loop.state.rejected["GPS", "fingerprint"] == FLOOD
    recorded = Counter(each.kind for each in records(rig))[RecordKind.UNDECODABLE]
    assert 2 * MAX_PER_SECOND <= recorded <= 8 * MAX_PER_SECOND
    assert sizes[1] - sizes[0] < 2 * recorded * RECORD_BYTES < FLOOD * 10
    found = verify(rig.segments)
    assert found.difference is None, found.difference
    assert found.is_reproduced
    assert not found.findings
    # the health reports with the counts are reproduced too
    assert found.reproduced["MODELSERVER_HEALTH"] >= 6


def test_given_a_lasting_publisher_conflict_then_few_of_its_samples_are_recorded(tmp_path: Path) -> None:
    rig = JournalRig(tmp_path, SMALL, publisher_conflict="ignore")
    begin = rig.clock.utime()
    for _ in range(300):
        rig.send(imu(rig.clock.utime(), "imu"))
        rig.send(imu(rig.clock.utime(), "stranger"))
        rig.run_cycles()
    seconds = (rig.clock.utime() - begin) * 1e-6
    rig.clock.advance(1.0)
    rig.run_cycles(2)
    assert rig.loop.state.rejected["IMU", "publisher_conflict"] > 250
    rig.finish()
    recorded = Counter(each.kind for each in records(rig))[RecordKind.DROPPED]
    assert MAX_PER_SECOND <= recorded <= MAX_PER_SECOND * (seconds + 1) < 100
    assert verify(rig.segments).is_reproduced


def test_given_a_long_request_that_fails_then_all_of_it_is_noted_and_the_reply_is_reproduced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = JournalRig(tmp_path, SMALL)
    rig.drive(0.5)
    request = GetTransformations(ME, (("Cart:Mast", "Cart:Base"),) * 40, (rig.clock.utime(),))
    assert len(encode(request)) > 2 * MAX_RECORDED_BYTES
    step = core.step

    def failing(state: object, event: object, now: object) -> object:
        if isinstance(event, GetTransformations):
            raise RuntimeError("an error of the core's own")
        return step(state, event, now)  # type: ignore[arg-type]

    monkeypatch.setattr(core, "step", failing)
    rig.send(request)
    rig.run_cycles(5)
    rig.finish()
    found = verify(rig.segments)
    assert not found.findings, [str(each) for each in found.findings]
    assert found.reproduced["replies"] == 1
    assert found.is_reproduced


@given(st.lists(st.tuples(st.sampled_from("AB"), st.integers(0, 400_000_000)), max_size=300))
def test_given_any_messages_then_each_is_counted_once_and_few_of_a_second_singly(
    steps: list[tuple[str, int]],
) -> None:
    events: list[tuple[Rejected, Instant]] = []
    counter = RejectionCounter(lambda event, now: events.append((event, now)), JournalQueue())
    at = 5
    for channel, pause in steps:
        at += pause
        counter.count(channel, "truncated", Instant(at, at))
        counter.flush(Instant(at, at))
    counter.flush(Instant(at, at), at_once=True)
    counted: Counter[str] = Counter()
    for event, _ in events:
        counted[event.channel] += event.count
    assert counted == Counter(channel for channel, _ in steps)
    seconds = (at - 5) / 1e9 + 1
    assert len(events) <= 2 * (MAX_PER_SECOND + 1) * (seconds + 1) + 2


def test_given_a_budget_then_each_name_has_its_own_and_it_comes_back_after_a_second() -> None:
    budget = RateLimiter(2)
    assert [budget.try_acquire("GPS", 7) for _ in range(3)] == [True, True, False]
    assert budget.try_acquire("IMU", 7)
    assert not budget.try_acquire("GPS", 7 + 999_999_999)
    assert budget.try_acquire("GPS", 7 + 1_000_000_000)
