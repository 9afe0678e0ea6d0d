"""The chain of segments: manipulations with access to the disk, and their detection."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from support_journal import SMALL, JournalRig

from modelserver.errors import RecordingError
from modelserver.server.journal.verify import VerificationReport, VerificationResult, verify
from modelserver.server.journal.writer import NEWEST_NAME, NewestMarker, read_newest, seal_segment
from modelserver.signing import Key
from modelserver.wire.journal import (
    JournalRecord,
    RecordKind,
    SegmentEnd,
    SegmentHead,
    encode_batch,
    encode_end,
    encode_head,
    read_segment,
)

pytestmark = pytest.mark.slow

KEY = Key("rover", bytes(range(32)))
OTHER = Key("rover", bytes(range(1, 33)))
STRANGE = Key("boat", bytes(range(32)))


@pytest.fixture(scope="module", params=["keyed", "plain"])
def journal(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Key | None]:
    """A journal of five segments or more and two runs, and its key."""
    folder = tmp_path_factory.mktemp(request.param)
    key = KEY if request.param == "keyed" else None
    first = JournalRig(folder, SMALL, segment_bytes=75_000, run="one", key=key)
    first.drive(0.85)
    first.finish()
    second = JournalRig(folder, SMALL, segment_bytes=75_000, run="two", key=key, clock=first.clock)
    second.drive(0.6)
    assert 5 <= len(second.finish()) <= 14
    return second.directory, key


@pytest.fixture
def copy_journal(journal: tuple[Path, Key | None], tmp_path: Path) -> tuple[Path, Key | None]:
    """Return a copy of the journal, to be changed."""
    directory = tmp_path / "journal"
    shutil.copytree(journal[0], directory)
    return directory, journal[1]


def looked_at(directory: Path, *keys: Key) -> VerificationReport:
    return verify(sorted(directory.glob("journal-*.lcm")), keys=keys, directory=directory)


def damages(found: VerificationReport) -> str:
    return "; ".join(str(each) for each in found.findings if each.is_damage)


def heads(directory: Path) -> list[dict[str, object]]:
    files = sorted(directory.glob("journal-*.lcm"))
    return [
        next(each.facts for each in read_segment(path.read_bytes()) if isinstance(each, SegmentHead)) for path in files
    ]


def test_given_a_complete_journal_then_it_is_authentic_by_its_key_and_reproduced_without_one(
    journal: tuple[Path, Key | None],
) -> None:
    directory, key = journal
    found = looked_at(directory)
    assert (found.result, found.genuine, damages(found)) == (VerificationResult.REPRODUCED, 0, "")
    found = looked_at(directory, STRANGE, KEY) if key else looked_at(directory, KEY)
    assert damages(found) == ""
    assert found.result is (VerificationResult.AUTHENTIC if key else VerificationResult.REPRODUCED)
    assert found.genuine == (found.segments if key else 0)


def test_given_two_runs_then_heads_number_runs_and_segments_and_hold_the_seal_before(
    journal: tuple[Path, Key | None],
) -> None:
    directory, key = journal
    found = heads(directory)
    assert [each["number"] for each in found] == list(range(len(found)))
    assert [each["run_number"] for each in found] == sorted(0 if each["run"] == "one" else 1 for each in found)
    assert {each["key"] for each in found} == {"rover" if key else ""}
    files = sorted(directory.glob("journal-*.lcm"))
    ends = [next(each for each in read_segment(path.read_bytes()) if isinstance(each, SegmentEnd)) for path in files]
    assert [each["previous"] for each in found] == ["", *(end.seal.hex() for end in ends[:-1])]
    newest = read_newest(directory, [KEY])
    assert newest == NewestMarker(1, len(found) - 1, ends[-1].seal.hex())


def delete(number: int) -> Callable[[list[Path]], None]:
    return lambda files: files[number].unlink()


def duplicate(files: list[Path]) -> None:
    shutil.copy(files[1], files[-1].with_name(f"journal-{len(files):08d}.lcm"))


def swap(files: list[Path]) -> None:
    first, second = files[1].read_bytes(), files[2].read_bytes()
    files[1].write_bytes(second)
    files[2].write_bytes(first)


def cut_end(number: int) -> Callable[[list[Path]], None]:
    def cut(files: list[Path]) -> None:
        files[number].write_bytes(files[number].read_bytes()[:-10])

    return cut


def cut_half(number: int) -> Callable[[list[Path]], None]:
    def cut(files: list[Path]) -> None:
        data = files[number].read_bytes()
        files[number].write_bytes(data[: len(data) - 9_000])

    return cut


def empty(files: list[Path]) -> None:
    files[1].write_bytes(b"")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (delete(2), "1 segments before it are missing"),
        (delete(-1), "1 segments after journal-"),
        (duplicate, "is a copy of"),
        (swap, "is segment 2 by its own head"),
        (cut_end(1), "whose end was cut off after it was written"),
        (cut_half(1), "whose end was cut off after it was written"),
        (cut_end(-1), "was cut off after it was closed"),
        (cut_half(-1), "was cut off after it was closed"),
        (empty, "whose end was cut off after it was written"),
    ],
    ids=["middle", "last", "duplicate", "swap", "end", "half", "end of last", "half of last", "empty"],
)
def test_given_segments_that_were_tampered_with_then_it_is_damage_with_and_without_the_key(
    copy_journal: tuple[Path, Key | None], change: Callable[[list[Path]], None], words: str
) -> None:
    directory, _ = copy_journal
    change(sorted(directory.glob("journal-*.lcm")))
    for keys in ((), (KEY,)):
        found = looked_at(directory, *keys)
        assert words in damages(found)
        assert found.result is VerificationResult.DIFFERS


def test_given_earlier_segments_that_are_gone_then_that_is_reported_as_the_ring_does_it_too(
    copy_journal: tuple[Path, Key | None],
) -> None:
    directory, key = copy_journal
    files = sorted(directory.glob("journal-*.lcm"))
    for path in files[:2]:
        path.unlink()
    found = looked_at(directory, KEY)
    assert found.result is (VerificationResult.AUTHENTIC if key else VerificationResult.REPRODUCED)
    assert "2 earlier segments were dropped by the ring, or removed" in str(found.findings[0])


def test_given_a_segment_of_another_journal_of_the_same_key_then_it_is_found(
    copy_journal: tuple[Path, Key | None], tmp_path: Path
) -> None:
    directory, key = copy_journal
    other = JournalRig(tmp_path, SMALL, segment_bytes=75_000, run="one", key=key)
    other.directory, other.ring.directory = tmp_path / "other", tmp_path / "other"
    other.drive(0.85)
    shutil.copy(other.finish()[2], sorted(directory.glob("journal-*.lcm"))[2])
    found = looked_at(directory, *([key] if key else []))
    assert found.result is VerificationResult.DIFFERS
    assert "does not match" in damages(found)


def without_newest_record(path: Path, key: Key | None, facts: dict[str, object]) -> None:
    """Forge a segment: remove its last batches, recompute all checksums, and seal it with `key`."""
    data = path.read_bytes()
    items = list(read_segment(data))
    records = [each for each in items if isinstance(each, JournalRecord)]
    head = next(each for each in items if isinstance(each, SegmentHead))
    begin = len(encode_head(head.facts, 0))
    body = encode_head({**head.facts, **facts}, 0) + data[begin : records[0].at]
    keep = max(n for n in range(len(records) * 3 // 4) if records[n].kind is not RecordKind.PUBLISHED)
    body += encode_batch(0, records[:keep])
    digest = hashlib.sha256(body).digest()
    path.write_bytes(body + encode_end(digest, 0, seal_segment(key, digest)))


def test_given_a_forged_last_segment_then_only_the_key_detects_it(copy_journal: tuple[Path, Key | None]) -> None:
    directory, key = copy_journal
    last = sorted(directory.glob("journal-*.lcm"))[-1]
    # plain checksums can be recomputed without the key, also that of the file `newest`
    forger = OTHER if key else None
    without_newest_record(last, forger, {})
    end = next(each for each in read_segment(last.read_bytes()) if isinstance(each, SegmentEnd))
    newest = NewestMarker(1, len(heads(directory)) - 1, end.seal.hex())
    (directory / NEWEST_NAME).write_bytes(newest.encode(forger))
    found = looked_at(directory)
    assert (found.result, damages(found)) == (VerificationResult.REPRODUCED, "")
    found = looked_at(directory, KEY)
    if key:
        assert found.result is VerificationResult.DIFFERS
        assert "its seal is wrong: it was not written with the key" in damages(found)
        assert "the file newest is damaged or not authentic" in damages(found)
    else:
        assert found.result is VerificationResult.REPRODUCED
        assert not found.is_authentic


def test_given_a_keyed_journal_whose_keys_were_stripped_then_it_is_not_authentic(tmp_path: Path) -> None:
    rig = JournalRig(tmp_path, SMALL, key=KEY)
    rig.drive(0.5)
    (path,) = rig.finish()
    without_newest_record(path, None, {"key": ""})
    end = next(each for each in read_segment(path.read_bytes()) if isinstance(each, SegmentEnd))
    (rig.directory / NEWEST_NAME).write_bytes(NewestMarker(0, 0, end.seal.hex()).encode(None))
    found = looked_at(rig.directory, KEY)
    assert (found.result, found.genuine, found.unsealed) == (VerificationResult.REPRODUCED, 0, 1)


@pytest.mark.parametrize("key", [OTHER, STRANGE], ids=["same name", "other name"])
def test_given_another_key_then_nothing_is_authentic(tmp_path: Path, key: Key) -> None:
    rig = JournalRig(tmp_path, SMALL, key=KEY)
    rig.drive(0.5)
    rig.finish()
    found = looked_at(rig.directory, key)
    assert found.result is VerificationResult.DIFFERS
    assert ("its seal is wrong" if key is OTHER else "which is not in the key file") in damages(found)


def test_given_a_service_that_was_killed_then_what_is_not_closed_is_reproduced_and_not_authentic(
    tmp_path: Path,
) -> None:
    rig = JournalRig(tmp_path, SMALL, segment_bytes=75_000, key=KEY)
    rig.drive(0.9)
    rig.ring.release()
    found = looked_at(rig.directory, KEY)
    assert damages(found) == ""
    assert (found.result, found.unsealed, found.genuine) == (VerificationResult.REPRODUCED, 1, found.segments - 1)
    # the next run continues behind it, without the missing seal
    second = JournalRig(tmp_path, SMALL, segment_bytes=75_000, run="two", key=KEY, clock=rig.clock)
    second.drive(0.2)
    second.finish()
    found = looked_at(second.directory, KEY)
    assert damages(found) == ""
    assert (found.result, found.unsealed) == (VerificationResult.REPRODUCED, 1)


def test_given_the_last_segments_deleted_before_the_next_run_then_they_are_reported_missing(
    copy_journal: tuple[Path, Key | None], tmp_path: Path
) -> None:
    directory, key = copy_journal
    files = sorted(directory.glob("journal-*.lcm"))
    for path in files[-2:]:
        path.unlink()
    third = JournalRig(tmp_path, SMALL, run="three", key=key)
    third.drive(0.2)
    third.finish()
    assert heads(directory)[-1]["run_number"] == 2
    found = looked_at(directory, KEY)
    assert found.result is VerificationResult.DIFFERS
    assert "2 segments before it are missing" in damages(found)


def test_given_no_newest_file_then_completeness_is_not_claimed(
    copy_journal: tuple[Path, Key | None],
) -> None:
    directory, _ = copy_journal
    (directory / NEWEST_NAME).unlink()
    found = looked_at(directory, KEY)
    assert found.result is VerificationResult.REPRODUCED
    assert "segments after it may be missing" in str(found.findings[-1])


def test_given_a_single_segment_then_it_is_authentic_by_itself(journal: tuple[Path, Key | None]) -> None:
    directory, key = journal
    found = verify([sorted(directory.glob("journal-*.lcm"))[1]], keys=[KEY])
    assert found.result is (VerificationResult.AUTHENTIC if key else VerificationResult.REPRODUCED)


@pytest.mark.parametrize(
    "data", [b"", b"{}", b"[]\n", b"\xff\n", b'{"key": 3}\n\n', b'{"key": "", "run": 1}\n', b"[" * 1000]
)
def test_given_a_damaged_file_of_the_last_segment_then_that_is_reported(tmp_path: Path, data: bytes) -> None:
    (tmp_path / NEWEST_NAME).write_bytes(data)
    with pytest.raises(RecordingError, match="damaged or not authentic"):
        read_newest(tmp_path, [KEY])
    assert read_newest(tmp_path, [KEY], verify=False) is None


def test_given_numbers_of_the_wrong_type_then_the_file_is_damaged(tmp_path: Path) -> None:
    (tmp_path / NEWEST_NAME).write_bytes(NewestMarker("x", 2.5).encode(None))  # type: ignore[arg-type]
    with pytest.raises(RecordingError, match="its fields have wrong types"):
        read_newest(tmp_path, ())
    assert json.loads(NewestMarker(1, 2, "ab").encode(None).split(b"\n")[0]) == {
        "key": "", "run": 1, "number": 2, "seal": "ab",
    }  # fmt: skip
