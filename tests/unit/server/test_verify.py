"""Verification by replay: all behavior of a service is reproduced, and manipulations are found."""

from __future__ import annotations

import itertools
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from support_journal import OPEN, SMALL, START, JournalRig
from support_samples import GEOMETRY, ME, VEHICLE, imu
from support_signing import KEY

from modelserver.errors import RecordingError
from modelserver.messages import (
    GetBodyList,
    GetExplanation,
    GetHistory,
    GetMotion,
    GetStateVector,
    GetTransformation,
    GetTransformations,
    JointSample,
    JointsSample,
    LoadModel,
    Mode,
    Policy,
    ReloadModel,
    RequestHeader,
    SensorHeader,
    SwitchMode,
    TimeQuery,
)
from modelserver.server.bus import Inboxes
from modelserver.server.journal import encoding
from modelserver.server.journal.verify import VerificationReport, files_of, verify
from modelserver.server.journal.writer import list_segments
from modelserver.server.requests import DeferredReply
from modelserver.wire.codec import encode
from modelserver.wire.eventlog import encode_event
from modelserver.wire.journal import (
    JournalRecord,
    SegmentState,
    encode_batch,
    encode_head,
    encode_state,
    read_segment,
)

pytestmark = pytest.mark.slow

S = 1_000_000
NODDING = GEOMETRY.replace("xyz: [0, 0, 0.1]", "xyz: [0, 0, 0.1], joint: {type: revolute, axis: [0, 1, 0]}")


@pytest.fixture(scope="module")
def recorded_ring(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record a drive in small segments, once for all tests."""
    rig = JournalRig(tmp_path_factory.mktemp("ring"), SMALL, segment_bytes=150_000)
    rig.drive(7.0)
    assert len(rig.finish()) > 3
    return rig.directory


@pytest.fixture
def ring(recorded_ring: Path, tmp_path: Path) -> list[Path]:
    """Return a copy of those segments."""
    return list_segments(shutil.copytree(recorded_ring, tmp_path / "journal"))


@pytest.fixture(scope="module")
def recorded_segment(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record a drive in one segment, once for all tests."""
    rig = JournalRig(tmp_path_factory.mktemp("one"))
    rig.drive(6.0)
    (path,) = rig.finish()
    return path


@pytest.fixture
def segment(recorded_segment: Path, tmp_path: Path) -> Path:
    """Return a copy of that segment."""
    return Path(shutil.copy(recorded_segment, tmp_path))


def again(rig: JournalRig) -> VerificationReport:
    return verify(rig.finish())


def is_reproduced(found: VerificationReport) -> bool:
    assert found.difference is None, found.difference
    assert not found.findings, [str(each) for each in found.findings]
    return found.is_reproduced and not found.skipped and not found.unverifiable


@pytest.mark.parametrize(
    "more", ["", "localization: {mode: raw}\n", "publish: {mode: event}\n"], ids=["timer", "raw", "event"]
)
def test_given_a_drive_when_verified_then_every_pose_is_reproduced(tmp_path: Path, more: str) -> None:
    rig = JournalRig(tmp_path, VEHICLE + more)
    rig.drive(7.0)
    found = again(rig)
    assert is_reproduced(found)
    assert found.reproduced["POSE"] == len(rig.bus.get_published("POSE")) > 100
    assert found.reproduced["POSE_ODOM"] == found.reproduced["POSE_VECTOR"] == found.reproduced["POSE"]
    assert sum(found.reproduced.values()) + 420 == len(rig.bus.published)
    assert (found.segments, found.runs, found.lost, found.environment_differences) == (1, 1, 0, [])


def ask_everything(rig: JournalRig) -> None:
    """Send all types of requests: answered at once, deferred, from the cache, and dropped."""
    now = rig.clock.utime()
    mast = ("Cart:Mast", "Cart:Base")
    for request in (
        GetBodyList(ME),
        GetTransformation(ME, *mast, TimeQuery()),
        GetTransformation(ME, *mast, TimeQuery()),
        GetTransformation(ME, "Cart:Mist", "Cart:Base", TimeQuery()),
        GetTransformation(ME, "Cart:Base", "World:UTM", TimeQuery(now - S)),
        GetStateVector(ME, TimeQuery(now + 100_000, Policy.INTERPOLATED, 500)),
        GetStateVector(ME, TimeQuery(now + 60 * S, Policy.INTERPOLATED, 100)),
        GetHistory(ME, now - 3 * S, now, 5.0),
        GetMotion(ME, *mast),
        GetExplanation(ME, *mast, TimeQuery()),
        GetBodyList(RequestHeader(3, "POSE")),
    ):
        rig.send(request)
        rig.run_cycles(2)
    whole = encode(GetTransformation(ME, *mast, TimeQuery()))
    rig.bus.publish("PLATFORM_GET_TRANSFORMATION", whole[:-13] + b"\xff" * 13)
    rig.bus.publish("PLATFORM_GET_BODY_LIST", b"stranger")
    rig.bus.publish("GPS", b"\0" * 40)
    rig.bus.publish("IMU", encode(imu(now))[:-3])
    rig.run_cycles(2)
    for _ in range(20):
        rig.send(GetBodyList(ME))
    rig.run_cycles(30)


def test_given_all_requests_when_verified_then_every_reply_is_reproduced(tmp_path: Path) -> None:
    rig = JournalRig(tmp_path)
    rig.drive(6.0)
    ask_everything(rig)
    rig.drive(0.5)
    replies = len(rig.bus.get_published("REPLY_TEST"))
    rejected = dict(rig.loop.state.rejected)
    assert {("GPS", "fingerprint"), ("IMU", "truncated"), ("PLATFORM_GET_BODY_LIST", "overload")} <= rejected.keys()
    found = again(rig)
    assert is_reproduced(found)
    assert found.reproduced["replies"] == replies > 12


def test_given_commands_and_a_reload_when_verified_then_their_effects_are_reproduced(
    tmp_path: Path,
) -> None:
    rig = JournalRig(tmp_path)
    rig.drive(6.0)
    revision = rig.loop.state.model.revision
    for number, mode in enumerate((Mode.RAW, Mode.NO_GPS, Mode.FULL), start=1):
        rig.send_command(SwitchMode(SensorHeader(rig.clock.utime(), "operator", number), mode))
        rig.drive(1.0)
    (tmp_path / "geometry.yaml").write_text(NODDING)
    rig.send_command(ReloadModel(ME, dry_run=False))
    rig.drive(0.2)
    assert rig.loop.state.model.revision != revision
    joint = JointSample("Mounted", 0.2)
    rig.send(JointsSample(SensorHeader(rig.clock.utime(), "axis", 1), (joint,)))
    rig.send(GetTransformation(ME, "Camera:Origin", "Cart:Base", TimeQuery()))
    rig.drive(0.2)
    (tmp_path / "geometry.yaml").write_text("nonsense")
    rig.loop.reload()
    rig.drive(0.2)
    (tmp_path / "geometry.yaml").write_text(GEOMETRY)
    rig.loop.send((LoadModel(),))
    rig.send(JointsSample(SensorHeader(rig.clock.utime(), "axis", 2), (joint,)))
    rig.drive(0.2)
    assert is_reproduced(again(rig))


def test_given_denied_commands_when_verified_then_their_replies_are_reproduced(
    tmp_path: Path,
) -> None:
    rig = JournalRig(tmp_path)
    rig.drive(6.0)
    command = SwitchMode(SensorHeader(rig.clock.utime(), "operator", 1), Mode.RAW)
    rig.send(command)
    rig.send(ReloadModel(ME, dry_run=False))
    rig.send_command(ReloadModel(ME, dry_run=False), key=replace(KEY, secret=bytes(32)))
    rig.send_command(ReloadModel(ME, dry_run=False), key=replace(KEY, name="stranger"))
    rig.send_command(ReloadModel(ME, dry_run=False), age=3600.0)
    rig.run_cycles()  # four requests may wait
    rig.send_command(GetBodyList(ME))
    rig.bus.publish("MODELSERVER_SIGNED", b"none")
    rig.run_cycles(20)
    rig.drive(0.5)
    reasons = {reason for _, reason in rig.loop.state.rejected}
    assert {"unsigned", "bad_signature", "unknown_key", "stale", "channel"} <= reasons
    found = again(rig)
    assert is_reproduced(found)
    assert found.reproduced["replies"] == len(rig.bus.get_published("REPLY_TEST")) >= 2


def test_given_a_clock_that_steps_and_ticks_that_are_missed_when_verified_then_all_is_reproduced(
    tmp_path: Path,
) -> None:
    rig = JournalRig(tmp_path)
    rig.drive(5.0)
    rig.clock.advance(0.7)
    rig.drive(0.5)
    for hour in (-3600.0, 7200.0):
        rig.clock.step_utime(hour)
        rig.drive(0.5)
    assert rig.loop.state.ticks_missed
    assert is_reproduced(again(rig))


def test_given_an_error_of_the_core_and_one_of_the_bus_when_verified_then_all_is_reproduced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = JournalRig(tmp_path)
    rig.drive(5.0)
    publish = rig.bus.publish

    def breaking(channel: str, data: bytes) -> None:
        if channel == "POSE_VECTOR":
            raise OSError("too long")
        publish(channel, data)

    with monkeypatch.context() as patch:
        patch.setattr(rig.bus, "publish", breaking)
        rig.run_cycles(5)
    assert rig.loop.state.handler_errors == 5
    rig.drive(0.5)
    found = verify(rig.finish())
    # a message that cannot be sent does not affect the others, in the run and in the replay
    assert is_reproduced(found)


@pytest.mark.parametrize("number", [1, 2])
def test_given_a_segment_taken_out_of_the_middle_when_verified_then_that_is_damage(
    ring: list[Path], number: int
) -> None:
    ring[number].unlink()
    found = verify(list_segments(ring[0].parent))
    assert not found.is_reproduced
    assert found.difference is None
    assert f"1 segments before it are missing, after {ring[number - 1].name}" in str(found.findings[0])
    whole = (found.last_utime - found.first_utime) * 1e-6
    assert 1.0 < found.seconds < whole - 0.1


def test_given_a_segment_cut_off_in_the_middle_when_verified_then_that_is_damage(ring: list[Path]) -> None:
    ring[1].write_bytes(ring[1].read_bytes()[:100_000])
    found = verify(ring)
    assert not found.is_reproduced
    assert any("whose end was cut off after it was written" in str(each) for each in found.findings)


def tamper(path: Path, channel: str, number: int, change: Callable[[bytes], bytes]) -> int:
    """Change one published message, with valid checksums; return its utime."""
    data = path.read_bytes()
    items = list(read_segment(data))
    records = [each for each in items if isinstance(each, JournalRecord)]
    indices = [n for n, each in enumerate(records) if each.channel == channel]
    chosen = records[indices[number]]
    records[indices[number]] = chosen._replace(data=change(chosen.data))
    begin = records[0].at
    path.write_bytes(data[:begin] + encode_batch(0, records))
    return chosen.utime


def test_given_a_bit_of_one_pose_that_was_changed_when_verified_then_that_pose_is_named(segment: Path) -> None:
    utime = tamper(segment, "POSE", 200, lambda data: data[:-1] + bytes([data[-1] ^ 1]))
    found = verify([segment])
    assert not found.is_reproduced
    assert found.difference is not None
    assert (found.difference.channel, found.difference.utime) == ("POSE", utime)
    assert found.reproduced["POSE"] == 200
    event = segment.read_bytes()[found.difference.at :]
    assert event[:4] == b"\xed\xa1\xda\x01"
    assert b"POSE" in event[:40]


@pytest.mark.parametrize("value", [None, 7, "text", (), START], ids=repr)
@pytest.mark.parametrize("where", ["lcm", "sensors", "vehicle", "limits", "history", "joints", "model", "settings"])
def test_given_a_forged_state_of_other_types_when_verified_then_it_is_damage_at_most(
    segment: Path, where: str, value: object
) -> None:
    data = segment.read_bytes()
    items = list(read_segment(data))
    (state,) = [each.data for each in items if isinstance(each, SegmentState)]
    config, known = encoding.decode_run(state)
    if where in ("history", "joints", "model", "settings"):
        known = (
            known._replace(view=known.view._replace(**{where: value}))
            if where != "settings"
            else known._replace(
                settings=value  # type: ignore[arg-type]
            )
        )
    else:
        object.__setattr__(config, where, value)
    begin = next(each.at for each in items if isinstance(each, JournalRecord))
    head = next(each.facts for each in items if hasattr(each, "facts"))
    forged = encode_head(head, START) + encode_state(encoding.encode_value((config, known)), START) + data[begin:]
    segment.write_bytes(forged)
    assert not verify([segment]).is_reproduced


def test_given_a_sample_that_was_changed_when_verified_then_a_pose_after_it_differs(segment: Path) -> None:
    other = encode(replace(imu(START + 5 * S), angular_velocity=(0.0, 0.0, 0.01)))
    utime = tamper(segment, "IMU", 250, lambda data: other)
    found = verify([segment])
    assert found.difference is not None
    assert found.difference.utime >= utime


def test_given_a_ring_that_lost_its_beginning_when_verified_then_replay_starts_from_a_later_state(
    tmp_path: Path,
) -> None:
    rig = JournalRig(tmp_path, SMALL, segment_bytes=200_000, max_bytes=700_000)
    rig.drive(9.0)
    files = rig.finish()
    assert files[0].name != "journal-00000000.lcm"
    assert sum(path.stat().st_size for path in files) < 700_000
    found = verify(files)
    assert found.difference is None
    assert found.is_reproduced
    assert not found.skipped
    assert found.reproduced["POSE"] > 20


@pytest.mark.parametrize("text", [OPEN, SMALL], ids=["filter", "raw"])
def test_given_each_segment_by_itself_when_verified_then_its_poses_are_reproduced(tmp_path: Path, text: str) -> None:
    rig = JournalRig(tmp_path, text, segment_bytes=700_000 if text is OPEN else 150_000)
    for _ in range(4):
        rig.drive(3.0)
        rig.send(GetHistory(ME, rig.clock.utime() - 9 * S, rig.clock.utime(), 5.0))
    files = rig.finish()
    assert len(files) > 1
    alone = [verify([path]) for path in files]
    assert all(each.is_reproduced and not each.skipped for each in alone)
    together = verify(files)
    assert is_reproduced(together)
    assert sum(each.reproduced["POSE"] for each in alone) == together.reproduced["POSE"]
    # replies about the time before a segment cannot be reproduced from it alone: unverifiable
    assert text is OPEN or any(each.unverifiable for each in alone)


def test_given_a_segment_that_is_missing_when_verified_then_replay_restarts_after_it(ring: list[Path]) -> None:
    found = verify([*ring[:1], *ring[2:]])
    # the rest is reproduced, but the journal is incomplete
    assert found.difference is None
    assert not found.is_reproduced
    assert found.segments == len(ring) - 1


def test_given_a_second_start_when_verified_then_both_runs_are_and_nothing_is_overwritten(tmp_path: Path) -> None:
    first = JournalRig(tmp_path, run="one")
    first.drive(6.0)
    before = {path.name: path.read_bytes() for path in first.finish()}
    second = JournalRig(tmp_path, run="two", clock=first.clock)
    second.drive(6.0)
    files = second.finish()
    assert all((tmp_path / "journal" / name).read_bytes() == data for name, data in before.items())
    found = verify(files)
    assert is_reproduced(found)
    assert (found.runs, found.segments) == (2, 2)


def test_given_a_journal_that_breaks_off_anywhere_when_verified_then_what_is_sealed_holds(tmp_path: Path) -> None:
    rig = JournalRig(tmp_path)
    rig.drive(2.0)
    (path,) = rig.finish()
    data, torn = path.read_bytes(), tmp_path / "torn.lcm"
    begin = next(each.at for each in read_segment(data) if isinstance(each, JournalRecord))
    poses = []
    for cut in range(begin, len(data), (len(data) - begin) // 40):
        torn.write_bytes(data[:cut])
        found = verify([torn])
        assert found.difference is None
        assert not any(each.is_damage for each in found.findings)
        poses.append(found.reproduced["POSE"])
    assert poses == sorted(poses)
    assert poses[-1] > 90


def test_given_damage_in_the_middle_when_verified_then_it_is_located_and_what_follows_is_skipped(
    ring: list[Path],
) -> None:
    whole = verify(ring)
    data = bytearray(ring[1].read_bytes())
    data[len(data) // 2] ^= 0x10
    ring[1].write_bytes(data)
    found = verify(ring)
    assert found.difference is None
    assert not found.is_reproduced
    assert found.skipped["POSE"]
    assert found.reproduced["POSE"] < whole.reproduced["POSE"]
    damage = [each for each in found.findings if each.is_damage]
    assert damage[0].segment == ring[1]
    assert re.search("checksum|no events", damage[0].text)


def test_given_an_empty_last_segment_when_verified_then_it_is_a_finding_and_the_rest_is_reproduced(
    tmp_path: Path,
) -> None:
    rig = JournalRig(tmp_path)
    rig.drive(2.0)
    (path,) = rig.finish()
    empty = path.with_name("journal-00000001.lcm")
    empty.touch()
    found = verify([path, empty])
    assert found.is_reproduced
    assert [each.segment for each in found.findings] == [empty]


def test_given_another_build_then_the_differences_are_listed(tmp_path: Path) -> None:
    rig = JournalRig(tmp_path, facts={"numpy": "0.1"})
    rig.drive(1.0)
    found = again(rig)
    assert len(found.environment_differences) == 1
    assert "numpy was 0.1" in found.environment_differences[0]


def test_given_another_file_than_a_journal_then_the_error_has_a_hint(tmp_path: Path) -> None:
    def check_rejected(path: Path, words: str) -> None:
        with pytest.raises(RecordingError) as raised:
            files_of(path)
        assert words in str(raised.value)
        assert str(raised.value).startswith(f"{path}: ")

    check_rejected(tmp_path, "is no journal, which is a folder of files journal-*.lcm")
    empty = tmp_path / "empty.lcm"
    empty.touch()
    check_rejected(empty, "is no journal")
    text = tmp_path / "README.md"
    shutil.copy(__file__, text)
    check_rejected(text, "is no journal")
    log = tmp_path / "drive.lcm"
    log.write_bytes(b"".join(encode_event(n, START, b"IMU", encode(imu(START))) for n in range(3)))
    check_rejected(log, "to play an LCM log: modelserver replay LOG, without --verify")
    rig = tmp_path / "journal-rover"
    rig.mkdir()
    (rig / "journal-00000000.lcm").touch()
    assert files_of(rig) == [rig / "journal-00000000.lcm"]


def test_given_a_segment_with_a_damaged_or_missing_head_then_it_is_accepted_as_one(tmp_path: Path) -> None:
    rig = JournalRig(tmp_path, SMALL)
    rig.drive(0.5)
    (path,) = rig.finish()
    data = path.read_bytes()
    other = tmp_path / "copy.lcm"
    other.write_bytes(b"\0" * 100 + data[100:])
    assert files_of(other) == [other]
    path.write_bytes(data[:20])
    assert files_of(path) == [path]
    assert not verify([path]).is_reproduced


# --- long answers -------------------------------------------------------------------------------------------


def ask_long(rig: JournalRig, number: int = 1) -> None:
    """Request many poses of the last two seconds: a deferred reply."""
    newest = rig.clock.utime() - 200_000
    at = tuple(newest - n * 60_000 for n in range(31))
    rig.send(GetTransformations(RequestHeader(number, "REPLY_LONG"), (("Camera:Origin", "World:UTM"),) * 20, at))


def slow_steps(monkeypatch: pytest.MonkeyPatch, rig: JournalRig, seconds: float = 0.002) -> None:
    """Make each part of a deferred reply take time."""
    step = DeferredReply.step

    def slow(reply: DeferredReply) -> None:
        rig.clock.advance(seconds)
        step(reply)

    monkeypatch.setattr(DeferredReply, "step", slow)


@pytest.mark.parametrize("segment_bytes", [1 << 20, 2_000])
def test_given_long_answers_between_ticks_when_verified_then_each_part_is_reproduced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, segment_bytes: int
) -> None:
    rig = JournalRig(tmp_path, vehicle=SMALL)
    rig.drive(6.0)
    # small ones only where they begin within a reply
    rig.ring.segment_bytes = segment_bytes
    slow_steps(monkeypatch, rig)
    for number in range(4):
        ask_long(rig, number)
        rig.send(GetHistory(ME, rig.clock.utime() - 4 * S, rig.clock.utime(), 50.0))
        rig.drive(0.7)
        rig.send(GetStateVector(ME))
        rig.drive(0.3)
        if not number:
            # parts of the first reply are in segments of their own; those of the others in the same as what follows
            rig.ring.segment_bytes = max(segment_bytes, 20_000)
    rig.run_cycles(100)
    assert len(rig.bus.get_published("REPLY_LONG")) == 4 * 20
    # poses and other replies were sent between the parts
    channels = [channel for channel, _ in rig.bus.published]
    first = channels.index("REPLY_LONG")
    assert "POSE" in channels[first : first + 60]
    if segment_bytes < 1 << 20:
        assert len(rig.segments) > 4
    assert is_reproduced(again(rig))


def test_given_requests_while_poses_wait_for_their_deadlines_when_verified_then_all_is_reproduced(
    tmp_path: Path,
) -> None:
    rig = JournalRig(tmp_path)
    rig.drive(3.0)
    fixed = GetTransformation(ME, "Cart:Mast", "Cart:Base", TimeQuery())
    rig.send(fixed)
    rig.loop._timer.lead.ns = 1_500_000
    wait, asked = rig.bus.wait, itertools.count()

    def wait_for_requests(seconds: float, inboxes: Inboxes = "both") -> None:
        if inboxes == "requests" and not rig.bus.requests.pending:
            rig.clock.advance(0.0004)
            rig.send(fixed if next(asked) % 3 else GetStateVector(ME))
        wait(seconds, inboxes)

    rig.bus.wait = wait_for_requests  # type: ignore[method-assign]
    rig.drive(1.0)
    replies = rig.bus.get_published(ME.reply_channel)
    assert len(replies) > 100  # two a tick at least
    assert is_reproduced(again(rig))


def test_given_a_long_answer_that_is_not_finished_when_verified_then_what_was_sent_is_reproduced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = JournalRig(tmp_path)
    rig.drive(6.0)
    slow_steps(monkeypatch, rig, 0.02)
    ask_long(rig)
    rig.run_cycles(10)
    assert rig.loop._requests.waiting == 1
    assert is_reproduced(again(rig))


def test_given_a_long_answer_that_fails_when_verified_then_its_reply_is_reproduced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = JournalRig(tmp_path)
    rig.drive(6.0)
    steps = 0

    def fail(reply: DeferredReply) -> None:
        nonlocal steps
        steps += 1
        if steps == 3:
            raise ArithmeticError("no number")

    with monkeypatch.context() as patched:
        patched.setattr(DeferredReply, "step", fail)
        ask_long(rig)
        rig.run_cycles(5)
    assert len(rig.bus.get_published("REPLY_LONG")) == 1
    ask_long(rig, 2)
    rig.drive(0.5)
    assert len(rig.bus.get_published("REPLY_LONG")) == 1 + 20
    assert is_reproduced(again(rig))
