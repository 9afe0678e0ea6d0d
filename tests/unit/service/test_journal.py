"""The journal's writer on the test's folder: bounds, faults of the disk, and what the loop and people are told."""

from __future__ import annotations

import errno
import logging
import os
import shutil
from pathlib import Path

import pytest
from support_journal import SMALL, Kept

from modelserver.config import JournalConfig, VehicleConfig
from modelserver.core import Instant
from modelserver.messages import GetBodyList, Noticed, Rejected, RequestHeader, Tick
from modelserver.service.journal import queue as journal
from modelserver.service.journal import writer as journal_writer
from modelserver.service.journal.place import journal_directory, make_writer
from modelserver.service.journal.queue import JournalQueue, NoJournal
from modelserver.service.journal.ring import Ring, Segment
from modelserver.service.journal.verify import verify
from modelserver.service.journal.writer import RETRY_S
from modelserver.service.loop import Loop
from modelserver.wire.journal import Head, JournalRecord, RecordKind, read

NOW = Instant(1, 2)


def heads(files: list[Path]) -> list[dict[str, object]]:
    return [each.facts for path in files for each in read(path.read_bytes()) if isinstance(each, Head)]


class Refusing(Ring):
    """A ring whose disk refuses with `error` while that is set."""

    error: OSError | None = None

    def fresh(self, least: int = 0) -> Segment:
        if self.error is not None:
            raise self.error
        return super().fresh(least)


def notices(kept: Kept) -> dict[str, str]:
    return dict(kept.loop.state.notices)


# --- what is kept ---------------------------------------------------------------------------------------------------


def test_given_a_service_when_it_turns_then_everything_heard_and_said_stands_in_the_log_in_order(
    tmp_path: Path,
) -> None:
    kept = Kept(tmp_path, SMALL)
    kept.drive(0.2)
    kept.send(GetBodyList(RequestHeader(1, "REPLY_ME")))
    kept.turns(3)
    (path,) = kept.finish()
    found = [each for each in read(path.read_bytes()) if isinstance(each, JournalRecord)]
    heard = [(each.channel, each.data) for each in found if each.channel]
    assert sorted(heard) == sorted(kept.bus.published)
    assert [each.kind for each in found if each.channel in ("PLATFORM_GET_BODY_LIST", "REPLY_ME")] == [
        RecordKind.REQUEST,
        RecordKind.SAID,
    ]
    assert {each.kind for each in found} == {RecordKind.SAMPLE, RecordKind.EVENT, RecordKind.SAID, RecordKind.REQUEST}
    assert (heads([path])[0]["run"], heads([path])[0]["part"], heads([path])[0]["lost"]) == ("one", 0, 0)
    assert [path.stat().st_mode & 0o777] == [0o640]


def test_given_no_journal_then_nothing_is_asked_for_and_nothing_told(tmp_path: Path) -> None:
    none = NoJournal()
    none.step(Tick(), NOW)
    none.note(RecordKind.UNREAD, ("GPS", b""), NOW)
    none.said("POSE", b"")
    assert (none.wants_state, list(none.news())) == (False, [])


# --- bounds ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_given_more_than_may_be_kept_then_the_oldest_segments_go(tmp_path: Path) -> None:
    kept = Kept(tmp_path, SMALL, segment_bytes=160_000, most_bytes=660_000)
    most = 0
    for _ in range(10):
        kept.drive(1.0)
        most = max(most, sum(path.stat().st_size for path in kept.segments))
    files = kept.finish()
    assert most < 660_000
    assert 2 <= len(files) < 5
    parts = [each["part"] for each in heads(files)]
    assert parts == list(range(int(str(parts[0])), int(str(parts[0])) + len(parts)))
    assert parts[0] != 0


def test_given_a_loop_that_is_faster_than_the_disk_then_what_is_lost_is_counted_and_a_new_start_is_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = Kept(tmp_path, SMALL)
    kept.drive(1.0)
    with monkeypatch.context() as patch:
        patch.setattr(journal, "MOST_WAITING", 30)
        for _ in range(40):
            kept.loop.turn()
    assert not kept.queue.is_open
    lost = kept.queue.lost
    assert lost > 50
    kept.drive(1.0)
    files = kept.finish()
    found = verify(files)
    assert found.proved
    assert [each["lost"] for each in heads(files)] == [0, found.lost]
    # what the loop did until it was asked for a new beginning is lost too
    assert lost <= found.lost < lost + 20
    assert sum(found.said.values()) + found.lost > len(kept.bus.published) - 120
    assert "are lost" in str(found.remarks[0])


def test_given_messages_larger_than_the_memory_for_them_then_the_queue_closes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(journal, "MOST_BYTES", 1000)
    queue = JournalQueue()
    queue.said("POSE", b"early")
    assert queue.lost == 0
    queue.begin(None, NOW)  # type: ignore[arg-type]
    for _ in range(5):
        queue.said("POSE", bytes(300))
    assert (len(queue), queue.lost, queue.is_open) == (4, 2, False)
    assert len(queue.take(10)) == 4
    queue.begin(None, NOW)  # type: ignore[arg-type]
    queue.said("POSE", bytes(300))
    assert (len(queue), queue.lost, queue.is_open) == (2, 0, True)


# --- faults of the disk ---------------------------------------------------------------------------------------------


def test_given_a_directory_that_cannot_be_made_then_the_service_says_so_and_tries_again(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    (tmp_path / "journal").write_text("in the way")
    kept = Kept(tmp_path, SMALL)
    kept.drive(1.0)
    assert notices(kept)["journal"] == (
        f"nothing is recorded: the journal cannot be kept in {kept.directory}: File exists; move away what is there "
        f"and is no folder (ls -ld {kept.directory}), or name another journal.directory. It is tried again every 5 s"
    )
    assert len(kept.bus.said("POSE")) > 45
    (tmp_path / "journal").unlink()
    kept.drive(RETRY_S + 1.0)
    assert notices(kept) == {}
    files = kept.finish()
    assert heads(files)[0]["lost"] > 50  # type: ignore[operator]
    assert verify(files).proved
    assert [each.levelname for each in caplog.records if each.name == journal_writer.log.name] == ["WARNING", "INFO"]


@pytest.mark.slow
def test_given_a_disk_that_is_full_then_the_oldest_segment_makes_room_and_the_service_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = Kept(tmp_path, SMALL, segment_bytes=120_000)
    kept.drive(4.0)
    before = kept.segments
    assert len(before) > 2
    full = OSError(errno.ENOSPC, "No space left on device")
    write = os.write
    written = [0]

    def refusing(file: int, data: bytes) -> int:
        written[0] += 1
        if written[0] % 3 == 0:
            raise full
        return write(file, bytes(data)[:1000])

    with monkeypatch.context() as patch:
        patch.setattr(os, "write", refusing)
        kept.drive(1.0)
    assert "No space left" in notices(kept)["journal"]
    assert kept.segments[0] != before[0]
    kept.drive(RETRY_S + 1.0)
    assert notices(kept) == {}
    found = verify(kept.finish())
    assert found.proved
    assert any("breaks off" in str(each) or "not closed" in str(each) for each in found.remarks)
    assert found.lost > 0


def test_given_a_directory_that_is_removed_while_it_is_written_then_it_is_made_anew(tmp_path: Path) -> None:
    kept = Kept(tmp_path, SMALL)
    kept.drive(3.0)
    shutil.rmtree(kept.directory)
    kept.drive(3.0)
    assert "removed" in notices(kept)["journal"]
    kept.drive(RETRY_S + 1.0)
    assert notices(kept) == {}
    files = kept.finish()
    assert [path.name for path in files] == ["journal-00000000.lcm"]
    assert verify(files).proved


def test_given_two_services_on_one_directory_then_the_second_keeps_off_until_the_first_has_ended(
    tmp_path: Path,
) -> None:
    first, second = Kept(tmp_path, SMALL, run="one"), Kept(tmp_path, SMALL, run="two")
    first.drive(0.5)
    second.drive(0.5)
    assert f"another service (process {os.getpid()}) writes there already; end one" in notices(second)["journal"]
    assert notices(first) == {}
    first.finish()
    second.drive(RETRY_S + 1.0)
    assert notices(second) == {}
    files = second.finish()
    assert [each["run"] for each in heads(files)] == ["one", "two"]
    assert verify(files).proved


def test_given_an_error_of_the_servers_own_in_the_thread_then_it_goes_on_and_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    kept = Kept(tmp_path, SMALL)
    kept.drive(0.5)
    rounds = iter([False, False])

    class Rounds:
        def wait(self, seconds: float) -> bool:
            return next(rounds, True)

    def broken() -> None:
        raise ZeroDivisionError("oh")

    monkeypatch.setattr(kept.writer, "_ending", Rounds())
    monkeypatch.setattr(kept.writer, "work", broken)
    with caplog.at_level(logging.ERROR):
        kept.writer._run()
    (notice,) = kept.queue.news()
    assert notice == Noticed("journal", notice.text)
    assert f"cannot be kept in {kept.directory}: an error of the server's own: oh; the log has its trace" in notice.text


def test_given_a_thread_when_closed_then_all_is_written_and_sealed(tmp_path: Path) -> None:
    kept = Kept(tmp_path, SMALL)
    kept.writer.start()
    for _ in range(20):
        kept.loop.turn()
    kept.writer.close()
    found = verify(kept.segments)
    assert found.proved
    assert not found.remarks
    assert found.said["POSE"] == len(kept.bus.said("POSE")) > 10


# --- where it is kept -----------------------------------------------------------------------------------------------


def vehicle(**settings: object) -> VehicleConfig:
    return VehicleConfig("my cart/1", "geometry.yaml", "Cart:Base", journal=JournalConfig(**settings))  # type: ignore[arg-type]


def test_given_a_desk_then_no_journal_is_kept_and_under_systemd_or_where_named_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    assert journal_directory(vehicle()) is None
    assert make_writer(vehicle(), "", None) is None  # type: ignore[arg-type]
    assert journal_directory(vehicle(directory="/x/y")) == Path("/x/y")
    assert journal_directory(vehicle(directory="/x/y", megabytes=0)) is None
    assert journal_directory(vehicle(megabytes=100)) == tmp_path / "modelserver" / "journal-my_cart_1"
    monkeypatch.setenv("STATE_DIRECTORY", "/var/lib/modelserver")
    assert journal_directory(vehicle()) == Path("/var/lib/modelserver/journal-my_cart_1")
    assert journal_directory(vehicle(megabytes=0)) is None


def test_given_a_vehicle_file_when_the_writer_is_made_then_it_holds_the_files_and_bounds(tmp_path: Path) -> None:
    kept = Kept(tmp_path, SMALL + "journal: {directory: box, megabytes: 64}\n")
    made = make_writer(kept.vehicle.config, str(tmp_path / "vehicle.yaml"), kept.clock)
    assert made is not None
    _, writer = made
    assert writer._ring.directory == tmp_path / "box"
    assert (writer._ring.most_bytes, writer._ring.segment_bytes) == (64 << 20, 8 << 20)
    assert [Path(name).name for name, _ in writer._origins.files] == ["vehicle.yaml", "geometry.yaml"]
    assert writer._origins.facts["vehicle"] == "cart"


def test_given_a_loop_without_a_word_on_it_then_it_keeps_no_journal(tmp_path: Path) -> None:
    kept = Kept(tmp_path)
    loop = Loop(kept.bus, kept.clock, kept.loop.state, kept.loop._settings)
    loop.step(Rejected("GPS", "truncated"), kept.clock.now())
    loop.turn()
    assert not kept.directory.exists()
