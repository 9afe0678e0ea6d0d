"""What strangers send: all of it is counted, little of it goes into the journal, and that is run again all the same."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support_journal import SMALL, Kept
from support_samples import ME, imu

from modelserver import core
from modelserver.core import Instant
from modelserver.messages import GetTransformations, Rejected
from modelserver.service.journal.queue import NoJournal
from modelserver.service.journal.verify import verify
from modelserver.service.unused import A_SECOND, MOST_NOTED, Budget, Unused
from modelserver.wire.codec import encode
from modelserver.wire.journal import JournalRecord, RecordKind, read

FLOOD = 10_000
A_NOTE = MOST_NOTED + 100
"""Bytes of a note, at most: with what an event of a log, its record in the seal and its count take."""


def records(kept: Kept) -> list[JournalRecord]:
    return [each for path in kept.segments for each in read(path.read_bytes()) if isinstance(each, JournalRecord)]


@pytest.mark.slow
def test_given_a_flood_of_rubbish_then_the_journal_grows_by_little_and_is_reproduced(tmp_path: Path) -> None:
    sizes = []
    for rubbish in (0, FLOOD // 50):
        folder = tmp_path / str(rubbish)
        folder.mkdir()
        kept = Kept(folder, SMALL)
        for _ in range(50):
            for _ in range(rubbish):
                kept.bus.publish("GPS", b"\xff" * 1000)
            kept.drive(0.1)
        kept.turns(60)
        kept.finish()
        sizes.append(sum(path.stat().st_size for path in kept.segments))
    assert kept.loop.state.rejected["GPS", "fingerprint"] == FLOOD
    noted = Counter(each.kind for each in records(kept))[RecordKind.UNREAD]
    assert 2 * A_SECOND <= noted <= 8 * A_SECOND
    assert sizes[1] - sizes[0] < 2 * noted * A_NOTE < FLOOD * 10
    found = verify(kept.segments)
    assert found.difference is None, found.difference
    assert found.proved
    assert not found.remarks
    # the counts go out with the health reports, and those are reproduced too
    assert found.said["MODELSERVER_HEALTH"] >= 6


def test_given_a_second_writer_who_speaks_on_and_on_then_few_of_its_samples_are_noted(tmp_path: Path) -> None:
    kept = Kept(tmp_path, SMALL, second_writer="ignore")
    begin = kept.clock.utime()
    for _ in range(300):
        kept.send(imu(kept.clock.utime(), "imu"))
        kept.send(imu(kept.clock.utime(), "stranger"))
        kept.turns()
    seconds = (kept.clock.utime() - begin) * 1e-6
    kept.clock.advance(1.0)
    kept.turns(2)
    assert kept.loop.state.rejected["IMU", "second_writer"] > 250
    kept.finish()
    noted = Counter(each.kind for each in records(kept))[RecordKind.IGNORED]
    assert A_SECOND <= noted <= A_SECOND * (seconds + 1) < 100
    assert verify(kept.segments).proved


def test_given_a_long_request_that_fails_then_all_of_it_is_noted_and_the_reply_is_reproduced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = Kept(tmp_path, SMALL)
    kept.drive(0.5)
    request = GetTransformations(ME, (("Cart:Mast", "Cart:Base"),) * 40, (kept.clock.utime(),))
    assert len(encode(request)) > 2 * MOST_NOTED
    step = core.step

    def failing(state: object, event: object, now: object) -> object:
        if isinstance(event, GetTransformations):
            raise RuntimeError("an error of the core's own")
        return step(state, event, now)  # type: ignore[arg-type]

    monkeypatch.setattr(core, "step", failing)
    kept.send(request)
    kept.turns(5)
    kept.finish()
    found = verify(kept.segments)
    assert not found.remarks, [str(each) for each in found.remarks]
    assert found.said["replies"] == 1
    assert found.proved


@given(st.lists(st.tuples(st.sampled_from("AB"), st.integers(0, 400_000_000)), max_size=300))
def test_given_any_messages_then_each_is_counted_once_and_few_of_a_second_singly(
    steps: list[tuple[str, int]],
) -> None:
    told: list[tuple[Rejected, Instant]] = []
    unused = Unused(lambda event, now: told.append((event, now)), NoJournal())
    at = 5
    for channel, pause in steps:
        at += pause
        unused.count(channel, "truncated", Instant(at, at))
        unused.tell(Instant(at, at))
    unused.tell(Instant(at, at), at_once=True)
    counted: Counter[str] = Counter()
    for event, _ in told:
        counted[event.channel] += event.count
    assert counted == Counter(channel for channel, _ in steps)
    seconds = (at - 5) / 1e9 + 1
    assert len(told) <= 2 * (A_SECOND + 1) * (seconds + 1) + 2


def test_given_a_budget_then_each_name_has_its_own_and_it_comes_back_after_a_second() -> None:
    budget = Budget(2)
    assert [budget.grants("GPS", 7) for _ in range(3)] == [True, True, False]
    assert budget.grants("IMU", 7)
    assert not budget.grants("GPS", 7 + 999_999_999)
    assert budget.grants("GPS", 7 + 1_000_000_000)
