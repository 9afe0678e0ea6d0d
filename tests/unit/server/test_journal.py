"""The journal's writer: limits, disk errors, and its warnings."""

from __future__ import annotations

import errno
import logging
import os
import shutil
from pathlib import Path

import pytest
from support_journal import SMALL, JournalRig

from modelserver.config.vehicle_file import JournalConfig, VehicleConfig
from modelserver.core import Instant
from modelserver.messages import GetBodyList, HealthWarning, Rejected, RequestHeader, Tick
from modelserver.server import journal
from modelserver.server.journal import JournalQueue
from modelserver.server.journal import writer as journal_writer
from modelserver.server.journal.verify import verify
from modelserver.server.journal.writer import RETRY_S, Ring, Segment, get_journal_directory, make_writer
from modelserver.server.loop import Loop
from modelserver.wire.journal import JournalRecord, RecordKind, SegmentHead, read_segment

NOW = Instant(1, 2)


def heads(files: list[Path]) -> list[dict[str, object]]:
    return [each.facts for path in files for each in read_segment(path.read_bytes()) if isinstance(each, SegmentHead)]


class Refusing(Ring):
    """A ring whose disk raises `error` while it is set."""

    error: OSError | None = None

    def create_segment(self, min_number: int = 0) -> Segment:
        if self.error is not None:
            raise self.error
        return super().create_segment(min_number)


def get_warnings(rig: JournalRig) -> dict[str, str]:
    return dict(rig.loop.state.warnings)


# --- contents -----------------------------------------------------------------------------------------------------


def test_given_a_running_service_then_all_received_and_published_messages_are_in_the_log_in_order(
    tmp_path: Path,
) -> None:
    rig = JournalRig(tmp_path, SMALL)
    rig.drive(0.2)
    rig.send(GetBodyList(RequestHeader(1, "REPLY_ME")))
    rig.run_cycles(3)
    (path,) = rig.finish()
    found = [each for each in read_segment(path.read_bytes()) if isinstance(each, JournalRecord)]
    recorded = [(each.channel, each.data) for each in found if each.channel]
    assert sorted(recorded) == sorted(rig.bus.published)
    assert [each.kind for each in found if each.channel in ("PLATFORM_GET_BODY_LIST", "REPLY_ME")] == [
        RecordKind.REQUEST,
        RecordKind.PUBLISHED,
    ]
    assert {each.kind for each in found} == {
        RecordKind.SAMPLE,
        RecordKind.EVENT,
        RecordKind.PUBLISHED,
        RecordKind.REQUEST,
    }
    assert (heads([path])[0]["run"], heads([path])[0]["part"], heads([path])[0]["lost"]) == ("one", 0, 0)
    assert [path.stat().st_mode & 0o777] == [0o640]


def test_given_no_journal_then_no_state_is_requested_and_no_warning_published(tmp_path: Path) -> None:
    none = JournalQueue()
    none.record_event(Tick(), NOW)
    none.record_message(RecordKind.UNDECODABLE, ("GPS", b""), NOW)
    none.record_published("POSE", b"")
    assert (none.wants_state, list(none.poll_warnings())) == (False, [])


# --- bounds ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_given_a_full_ring_then_the_oldest_segments_are_deleted(tmp_path: Path) -> None:
    rig = JournalRig(tmp_path, SMALL, segment_bytes=160_000, max_bytes=660_000)
    most = 0
    for _ in range(10):
        rig.drive(1.0)
        most = max(most, sum(path.stat().st_size for path in rig.segments))
    files = rig.finish()
    assert most < 660_000
    assert 2 <= len(files) < 5
    parts = [each["part"] for each in heads(files)]
    assert parts == list(range(int(str(parts[0])), int(str(parts[0])) + len(parts)))
    assert parts[0] != 0


def test_given_a_loop_that_is_faster_than_the_disk_then_what_is_lost_is_counted_and_a_new_start_is_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = JournalRig(tmp_path, SMALL)
    rig.drive(1.0)
    with monkeypatch.context() as patch:
        patch.setattr(journal, "MAX_QUEUED_RECORDS", 30)
        for _ in range(40):
            rig.loop.run_once()
    assert not rig.queue.is_open
    lost = rig.queue.lost
    assert lost > 50
    rig.drive(1.0)
    files = rig.finish()
    found = verify(files)
    assert found.is_reproduced
    assert [each["lost"] for each in heads(files)] == [0, found.lost]
    # records until the requested state are lost too
    assert lost <= found.lost < lost + 20
    assert sum(found.reproduced.values()) + found.lost > len(rig.bus.published) - 120
    assert "are lost" in str(found.findings[0])


def test_given_messages_larger_than_the_memory_for_them_then_the_queue_closes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(journal, "MAX_QUEUED_BYTES", 1000)
    queue = JournalQueue()
    queue.record_published("POSE", b"early")
    assert queue.lost == 0
    queue.begin(None, NOW)  # type: ignore[arg-type]
    for _ in range(5):
        queue.record_published("POSE", bytes(300))
    assert (len(queue), queue.lost, queue.is_open) == (4, 2, False)
    assert len(queue.pop(10)) == 4
    queue.begin(None, NOW)  # type: ignore[arg-type]
    queue.record_published("POSE", bytes(300))
    assert (len(queue), queue.lost, queue.is_open) == (2, 0, True)


# --- disk errors ----------------------------------------------------------------------------------------------------


def test_given_a_directory_that_cannot_be_created_then_the_service_warns_and_retries(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    (tmp_path / "journal").write_text("in the way")
    rig = JournalRig(tmp_path, SMALL)
    rig.drive(1.0)
    assert get_warnings(rig)["journal"] == (
        f"nothing is recorded: the journal cannot be written in {rig.directory}: File exists; move the file at this "
        f"path away (ls -ld {rig.directory}), or set another journal.directory. It retries every 5 s"
    )
    assert len(rig.bus.get_published("POSE")) > 45
    (tmp_path / "journal").unlink()
    rig.drive(RETRY_S + 1.0)
    assert get_warnings(rig) == {}
    files = rig.finish()
    assert heads(files)[0]["lost"] > 50  # type: ignore[operator]
    assert verify(files).is_reproduced
    assert [each.levelname for each in caplog.records if each.name == journal_writer.log.name] == ["WARNING", "INFO"]


@pytest.mark.slow
def test_given_a_disk_that_is_full_then_the_oldest_segment_is_deleted_and_the_service_continues(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = JournalRig(tmp_path, SMALL, segment_bytes=120_000)
    rig.drive(4.0)
    before = rig.segments
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
        rig.drive(1.0)
    assert "No space left" in get_warnings(rig)["journal"]
    assert rig.segments[0] != before[0]
    rig.drive(RETRY_S + 1.0)
    assert get_warnings(rig) == {}
    found = verify(rig.finish())
    assert found.is_reproduced
    assert any("breaks off" in str(each) or "not closed" in str(each) for each in found.findings)
    assert found.lost > 0


def test_given_a_directory_that_is_removed_while_it_is_written_then_it_is_created_again(tmp_path: Path) -> None:
    rig = JournalRig(tmp_path, SMALL)
    rig.drive(3.0)
    shutil.rmtree(rig.directory)
    rig.drive(3.0)
    assert "removed" in get_warnings(rig)["journal"]
    rig.drive(RETRY_S + 1.0)
    assert get_warnings(rig) == {}
    files = rig.finish()
    assert [path.name for path in files] == ["journal-00000000.lcm"]
    assert verify(files).is_reproduced


def test_given_two_services_on_one_directory_then_the_second_keeps_off_until_the_first_has_ended(
    tmp_path: Path,
) -> None:
    first, second = JournalRig(tmp_path, SMALL, run="one"), JournalRig(tmp_path, SMALL, run="two")
    first.drive(0.5)
    second.drive(0.5)
    assert f"another service (process {os.getpid()}) writes there already; stop one" in get_warnings(second)["journal"]
    assert get_warnings(first) == {}
    first.finish()
    second.drive(RETRY_S + 1.0)
    assert get_warnings(second) == {}
    files = second.finish()
    assert [each["run"] for each in heads(files)] == ["one", "two"]
    assert verify(files).is_reproduced


def test_given_an_internal_error_in_the_thread_then_it_continues_with_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    rig = JournalRig(tmp_path, SMALL)
    rig.drive(0.5)
    rounds = iter([False, False])

    class Rounds:
        def wait(self, seconds: float) -> bool:
            return next(rounds, True)

    def fail() -> None:
        raise ZeroDivisionError("oh")

    monkeypatch.setattr(rig.writer, "_ending", Rounds())
    monkeypatch.setattr(rig.writer, "run_once", fail)
    with caplog.at_level(logging.ERROR):
        rig.writer._run()
    (warning,) = rig.queue.poll_warnings()
    assert warning == HealthWarning("journal", warning.text)
    assert f"cannot be written in {rig.directory}: internal error: oh; the log has its traceback" in warning.text


def test_given_a_thread_when_closed_then_all_is_written_and_sealed(tmp_path: Path) -> None:
    rig = JournalRig(tmp_path, SMALL)
    rig.writer.start()
    for _ in range(20):
        rig.loop.run_once()
    rig.writer.close()
    found = verify(rig.segments)
    assert found.is_reproduced
    assert not found.findings
    assert found.reproduced["POSE"] == len(rig.bus.get_published("POSE")) > 10


# --- directory ------------------------------------------------------------------------------------------------------


def vehicle(**settings: object) -> VehicleConfig:
    return VehicleConfig("my cart/1", "geometry.yaml", "Cart:Base", journal=JournalConfig(**settings))  # type: ignore[arg-type]


def test_given_a_developer_machine_then_a_journal_is_written_only_under_systemd_or_where_configured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    assert get_journal_directory(vehicle()) is None
    assert make_writer(vehicle(), None) is None  # type: ignore[arg-type]
    assert get_journal_directory(vehicle(directory="/x/y")) == Path("/x/y")
    assert get_journal_directory(vehicle(directory="/x/y", megabytes=0)) is None
    assert get_journal_directory(vehicle(megabytes=100)) == tmp_path / "modelserver" / "journal-my_cart_1"
    monkeypatch.setenv("STATE_DIRECTORY", "/var/lib/modelserver")
    assert get_journal_directory(vehicle()) == Path("/var/lib/modelserver/journal-my_cart_1")
    assert get_journal_directory(vehicle(megabytes=0)) is None


def test_given_a_vehicle_file_when_the_writer_is_made_then_it_has_its_bounds(tmp_path: Path) -> None:
    rig = JournalRig(tmp_path, SMALL + "journal: {directory: box, megabytes: 64}\n")
    made = make_writer(rig.vehicle.config, rig.clock)
    assert made is not None
    _, writer = made
    assert writer._ring.directory == tmp_path / "box"
    assert (writer._ring.max_bytes, writer._ring.segment_bytes) == (64 << 20, 8 << 20)
    assert writer._facts["vehicle"] == "cart"


def test_given_a_default_loop_then_it_writes_no_journal(tmp_path: Path) -> None:
    rig = JournalRig(tmp_path)
    loop = Loop(rig.bus, rig.clock, rig.loop.state, rig.loop._settings)
    loop.step(Rejected("GPS", "truncated"), rig.clock.now())
    loop.run_once()
    assert not rig.directory.exists()
