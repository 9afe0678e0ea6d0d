"""A journal run again: everything that a service can do is reproduced, and what was tampered with is found."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from support_journal import OPEN, SMALL, START, Kept
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
from modelserver.service.journal.files import files_of
from modelserver.service.journal.verify import Verified, verify
from modelserver.service.requests.deferred import DeferredReply
from modelserver.wire.codec import encode
from modelserver.wire.eventlog import written
from modelserver.wire.journal import JournalRecord, batch_written, read

pytestmark = pytest.mark.slow

S = 1_000_000
NODDING = GEOMETRY.replace("xyz: [0, 0, 0.1]", "xyz: [0, 0, 0.1], joint: {type: revolute, axis: [0, 1, 0]}")


def again(kept: Kept) -> Verified:
    return verify(kept.finish())


def proved(found: Verified) -> bool:
    assert found.difference is None, found.difference
    assert not found.remarks, [str(each) for each in found.remarks]
    return found.proved and not found.skipped and not found.old


@pytest.mark.parametrize(
    "more", ["", "localization: {mode: raw}\n", "publish: {mode: event}\n"], ids=["timer", "raw", "event"]
)
def test_given_a_drive_when_verified_then_every_pose_is_reproduced(tmp_path: Path, more: str) -> None:
    kept = Kept(tmp_path, VEHICLE + more)
    kept.drive(7.0)
    found = again(kept)
    assert proved(found)
    assert found.said["POSE"] == len(kept.bus.said("POSE")) > 100
    assert found.said["POSE_ODOM"] == found.said["POSE_VECTOR"] == found.said["POSE"]
    assert sum(found.said.values()) + 420 == len(kept.bus.published)
    assert (found.segments, found.runs, found.lost, found.other) == (1, 1, 0, [])


def ask_everything(kept: Kept) -> None:
    """All kinds of questions, of the sort that is answered at once, later, from memory, and not at all."""
    now = kept.clock.utime()
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
        kept.send(request)
        kept.turns(2)
    whole = encode(GetTransformation(ME, *mast, TimeQuery()))
    kept.bus.publish("PLATFORM_GET_TRANSFORMATION", whole[:-13] + b"\xff" * 13)
    kept.bus.publish("PLATFORM_GET_BODY_LIST", b"stranger")
    kept.bus.publish("GPS", b"\0" * 40)
    kept.bus.publish("IMU", encode(imu(now))[:-3])
    kept.turns(2)
    for _ in range(20):
        kept.send(GetBodyList(ME))
    kept.turns(30)


def test_given_everything_that_can_be_asked_when_verified_then_every_reply_is_reproduced(tmp_path: Path) -> None:
    kept = Kept(tmp_path)
    kept.drive(6.0)
    ask_everything(kept)
    kept.drive(0.5)
    replies = len(kept.bus.said("REPLY_TEST"))
    rejected = dict(kept.loop.state.rejected)
    assert {("GPS", "fingerprint"), ("IMU", "truncated"), ("PLATFORM_GET_BODY_LIST", "load")} <= rejected.keys()
    found = again(kept)
    assert proved(found)
    assert found.said["replies"] == replies > 12


def test_given_wishes_and_a_geometry_read_anew_when_verified_then_what_comes_of_them_is_reproduced(
    tmp_path: Path,
) -> None:
    kept = Kept(tmp_path)
    kept.drive(6.0)
    revision = kept.loop.state.model.revision
    for number, mode in enumerate((Mode.RAW, Mode.NO_GPS, Mode.FULL), start=1):
        kept.order(SwitchMode(SensorHeader(kept.clock.utime(), "operator", number), mode))
        kept.drive(1.0)
    (tmp_path / "geometry.yaml").write_text(NODDING)
    kept.order(ReloadModel(ME, dry_run=False))
    kept.drive(0.2)
    assert kept.loop.state.model.revision != revision
    joint = JointSample("Mounted", 0.2)
    kept.send(JointsSample(SensorHeader(kept.clock.utime(), "axis", 1), (joint,)))
    kept.send(GetTransformation(ME, "Camera:Origin", "Cart:Base", TimeQuery()))
    kept.drive(0.2)
    (tmp_path / "geometry.yaml").write_text("nonsense")
    kept.loop.reload()
    kept.drive(0.2)
    (tmp_path / "geometry.yaml").write_text(GEOMETRY)
    kept.loop.send((LoadModel(),))
    kept.send(JointsSample(SensorHeader(kept.clock.utime(), "axis", 2), (joint,)))
    kept.drive(0.2)
    assert proved(again(kept))


def test_given_commands_that_are_not_obeyed_when_verified_then_what_is_said_of_them_is_reproduced(
    tmp_path: Path,
) -> None:
    kept = Kept(tmp_path)
    kept.drive(6.0)
    wish = SwitchMode(SensorHeader(kept.clock.utime(), "operator", 1), Mode.RAW)
    kept.send(wish)
    kept.send(ReloadModel(ME, dry_run=False))
    kept.order(ReloadModel(ME, dry_run=False), key=replace(KEY, secret=bytes(32)))
    kept.order(ReloadModel(ME, dry_run=False), key=replace(KEY, name="stranger"))
    kept.order(ReloadModel(ME, dry_run=False), late=3600.0)
    kept.turns()  # four requests may wait
    kept.order(GetBodyList(ME))
    kept.bus.publish("MODELSERVER_SIGNED", b"none")
    kept.turns(20)
    kept.drive(0.5)
    reasons = {reason for _, reason in kept.loop.state.rejected}
    assert {"unsigned", "bad_signature", "unknown_key", "stale", "channel"} <= reasons
    found = again(kept)
    assert proved(found)
    assert found.said["replies"] == len(kept.bus.said("REPLY_TEST")) >= 2


def test_given_a_clock_that_steps_and_ticks_that_are_missed_when_verified_then_all_is_reproduced(
    tmp_path: Path,
) -> None:
    kept = Kept(tmp_path)
    kept.drive(5.0)
    kept.clock.advance(0.7)
    kept.drive(0.5)
    for hour in (-3600.0, 7200.0):
        kept.clock.step_utime(hour)
        kept.drive(0.5)
    assert kept.loop.state.ticks_missed
    assert proved(again(kept))


def test_given_an_error_of_the_core_and_one_of_the_bus_when_verified_then_all_is_reproduced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = Kept(tmp_path)
    kept.drive(5.0)
    publish = kept.bus.publish

    def breaking(channel: str, data: bytes) -> None:
        if channel == "POSE_VECTOR":
            raise OSError("too long")
        publish(channel, data)

    with monkeypatch.context() as patch:
        patch.setattr(kept.bus, "publish", breaking)
        kept.turns(5)
    assert kept.loop.state.handler_errors == 5
    kept.drive(0.5)
    found = verify(kept.finish())
    # one that could not be sent takes no other with it, neither then nor now
    assert proved(found)


@pytest.mark.parametrize("number", [1, 2])
def test_given_a_segment_taken_out_of_the_middle_when_verified_then_that_is_damage(tmp_path: Path, number: int) -> None:
    kept = Kept(tmp_path, SMALL, segment_bytes=150_000)
    kept.drive(12.0)
    segments = kept.finish()
    assert len(segments) > 3
    segments[number].unlink()
    found = verify(kept.segments)
    assert not found.proved
    assert found.difference is None
    assert f"1 segments before it are missing, behind {segments[number - 1].name}" in str(found.remarks[0])
    whole = (found.last_utime - found.first_utime) * 1e-6
    assert 1.0 < found.seconds < whole - 0.1


def test_given_a_segment_cut_off_in_the_middle_when_verified_then_that_is_damage(tmp_path: Path) -> None:
    kept = Kept(tmp_path, SMALL, segment_bytes=150_000)
    kept.drive(12.0)
    segments = kept.finish()
    segments[1].write_bytes(segments[1].read_bytes()[:100_000])
    found = verify(segments)
    assert not found.proved
    assert any("whose end was cut off after it was written" in str(each) for each in found.remarks)


def tampered(path: Path, channel: str, number: int, change: Callable[[bytes], bytes]) -> int:
    """Change one message that was said, with all checksums made right again; return the utime of it."""
    data = path.read_bytes()
    items = list(read(data))
    records = [each for each in items if isinstance(each, JournalRecord)]
    said = [n for n, each in enumerate(records) if each.channel == channel]
    chosen = records[said[number]]
    records[said[number]] = chosen._replace(data=change(chosen.data))
    begin = records[0].at
    path.write_bytes(data[:begin] + batch_written(0, records))
    return chosen.utime


def test_given_a_bit_of_one_pose_that_was_changed_when_verified_then_that_pose_is_named(tmp_path: Path) -> None:
    kept = Kept(tmp_path)
    kept.drive(6.0)
    (path,) = kept.finish()
    utime = tampered(path, "POSE", 200, lambda data: data[:-1] + bytes([data[-1] ^ 1]))
    found = verify([path])
    assert not found.proved
    assert found.difference is not None
    assert (found.difference.channel, found.difference.utime) == ("POSE", utime)
    assert found.said["POSE"] == 200
    event = path.read_bytes()[found.difference.at :]
    assert event[:4] == b"\xed\xa1\xda\x01"
    assert b"POSE" in event[:40]


def test_given_a_sample_that_was_changed_when_verified_then_a_pose_after_it_differs(tmp_path: Path) -> None:
    kept = Kept(tmp_path)
    kept.drive(6.0)
    (path,) = kept.finish()
    other = encode(replace(imu(START + 5 * S), angular_velocity=(0.0, 0.0, 0.01)))
    utime = tampered(path, "IMU", 250, lambda data: other)
    found = verify([path])
    assert found.difference is not None
    assert found.difference.utime >= utime


def test_given_a_ring_that_lost_its_beginning_when_verified_then_it_is_taken_up_from_a_later_state(
    tmp_path: Path,
) -> None:
    kept = Kept(tmp_path, SMALL, segment_bytes=200_000, most_bytes=700_000)
    kept.drive(9.0)
    files = kept.finish()
    assert files[0].name != "journal-00000000.lcm"
    assert sum(path.stat().st_size for path in files) < 700_000
    found = verify(files)
    assert found.difference is None
    assert found.proved
    assert not found.skipped
    assert found.said["POSE"] > 20


@pytest.mark.parametrize("text", [OPEN, SMALL], ids=["filter", "raw"])
def test_given_each_segment_by_itself_when_verified_then_its_poses_are_reproduced(tmp_path: Path, text: str) -> None:
    kept = Kept(tmp_path, text, segment_bytes=700_000 if text is OPEN else 150_000)
    for _ in range(4):
        kept.drive(3.0)
        kept.send(GetHistory(ME, kept.clock.utime() - 9 * S, kept.clock.utime(), 5.0))
    files = kept.finish()
    assert len(files) > 1
    alone = [verify([path]) for path in files]
    assert all(each.proved and not each.skipped for each in alone)
    together = verify(files)
    assert proved(together)
    assert sum(each.said["POSE"] for each in alone) == together.said["POSE"]
    # replies about what was before a segment cannot be made again from it alone, and that is said
    assert text is OPEN or any(each.old for each in alone)


def test_given_a_segment_that_is_missing_when_verified_then_the_run_is_taken_up_after_it(tmp_path: Path) -> None:
    kept = Kept(tmp_path, SMALL, segment_bytes=150_000)
    kept.drive(7.0)
    files = kept.finish()
    assert len(files) > 3
    found = verify([*files[:1], *files[2:]])
    # what is there is reproduced, and yet not all that there was
    assert found.difference is None
    assert not found.proved
    assert found.segments == len(files) - 1


def test_given_a_second_start_when_verified_then_both_runs_are_and_nothing_is_overwritten(tmp_path: Path) -> None:
    first = Kept(tmp_path, run="one")
    first.drive(6.0)
    before = {path.name: path.read_bytes() for path in first.finish()}
    second = Kept(tmp_path, run="two", clock=first.clock)
    second.drive(6.0)
    files = second.finish()
    assert all((tmp_path / "journal" / name).read_bytes() == data for name, data in before.items())
    found = verify(files)
    assert proved(found)
    assert (found.runs, found.segments) == (2, 2)


def test_given_a_journal_that_breaks_off_anywhere_when_verified_then_what_is_sealed_holds(tmp_path: Path) -> None:
    kept = Kept(tmp_path)
    kept.drive(2.0)
    (path,) = kept.finish()
    data, torn = path.read_bytes(), tmp_path / "torn.lcm"
    begin = next(each.at for each in read(data) if isinstance(each, JournalRecord))
    poses = []
    for cut in range(begin, len(data), (len(data) - begin) // 40):
        torn.write_bytes(data[:cut])
        found = verify([torn])
        assert found.difference is None
        assert not any(each.damage for each in found.remarks)
        poses.append(found.said["POSE"])
    assert poses == sorted(poses)
    assert poses[-1] > 90


def test_given_damage_in_the_middle_when_verified_then_its_place_is_told_and_what_follows_is_not_guessed(
    tmp_path: Path,
) -> None:
    kept = Kept(tmp_path, SMALL, segment_bytes=150_000)
    kept.drive(6.0)
    files = kept.finish()
    whole = verify(files)
    data = bytearray(files[1].read_bytes())
    data[len(data) // 2] ^= 0x10
    files[1].write_bytes(data)
    found = verify(files)
    assert found.difference is None
    assert not found.proved
    assert found.skipped["POSE"]
    assert found.said["POSE"] < whole.said["POSE"]
    damage = [each for each in found.remarks if each.damage]
    assert damage[0].segment == files[1]
    assert "checksum" in damage[0].text


def test_given_an_empty_segment_at_the_end_when_verified_then_it_is_told_and_the_rest_holds(tmp_path: Path) -> None:
    kept = Kept(tmp_path)
    kept.drive(2.0)
    (path,) = kept.finish()
    empty = path.with_name("journal-00000001.lcm")
    empty.touch()
    found = verify([path, empty])
    assert found.proved
    assert [each.segment for each in found.remarks] == [empty]


def test_given_another_build_then_it_is_told_what_is_other(tmp_path: Path) -> None:
    kept = Kept(tmp_path, facts={"numpy": "0.1"})
    kept.drive(1.0)
    found = again(kept)
    assert len(found.other) == 1
    assert "numpy was 0.1" in found.other[0]


def test_given_what_is_no_journal_then_it_is_said_what_it_is_and_what_to_do(tmp_path: Path) -> None:
    def refused(path: Path, words: str) -> None:
        with pytest.raises(RecordingError) as raised:
            files_of(path)
        assert words in str(raised.value)
        assert str(raised.value).startswith(f"{path}: ")

    refused(tmp_path, "the folder is empty")
    empty = tmp_path / "empty.lcm"
    empty.touch()
    refused(empty, "the file is empty, so there is nothing to verify")
    refused(
        tmp_path, "holds no segment of a journal (journal-*.lcm); its LCM logs are played by modelserver replay LOG"
    )
    text = tmp_path / "README.md"
    shutil.copy(__file__, text)
    refused(text, "is no journal, and no LCM log either")
    log = tmp_path / "drive.lcm"
    log.write_bytes(b"".join(written(n, START, b"IMU", encode(imu(START))) for n in range(3)))
    refused(log, "is an LCM log, but no journal of a modelserver, so it does not say what is to be reproduced")
    refused(log, f"modelserver replay {log} (without --verify) plays it")
    kept = tmp_path / "journal-rover"
    kept.mkdir()
    (kept / "journal-00000000.lcm").touch()
    refused(tmp_path, f"did you mean {kept}?")
    assert files_of(kept) == [kept / "journal-00000000.lcm"]


def test_given_a_segment_whose_head_is_damaged_or_cut_off_then_it_is_still_one(tmp_path: Path) -> None:
    kept = Kept(tmp_path, SMALL)
    kept.drive(0.5)
    (path,) = kept.finish()
    data = path.read_bytes()
    other = tmp_path / "copy.lcm"
    other.write_bytes(b"\0" * 100 + data[100:])
    assert files_of(other) == [other]
    path.write_bytes(data[:20])
    assert files_of(path) == [path]
    assert not verify([path]).proved


# --- long answers -------------------------------------------------------------------------------------------


def ask_long(kept: Kept, number: int = 1) -> None:
    """Ask for many poses of the last two seconds: an answer that is worked out in steps."""
    newest = kept.clock.utime() - 200_000
    at = tuple(newest - n * 60_000 for n in range(31))
    kept.send(GetTransformations(RequestHeader(number, "REPLY_LONG"), (("Camera:Origin", "World:UTM"),) * 20, at))


def slow_steps(monkeypatch: pytest.MonkeyPatch, kept: Kept, seconds: float = 0.002) -> None:
    """Have each step of a long answer take time."""
    step = DeferredReply.step

    def slow(reply: DeferredReply) -> None:
        kept.clock.advance(seconds)
        step(reply)

    monkeypatch.setattr(DeferredReply, "step", slow)


@pytest.mark.parametrize("segment_bytes", [1 << 20, 2_000])
def test_given_long_answers_between_ticks_when_verified_then_each_part_is_reproduced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, segment_bytes: int
) -> None:
    kept = Kept(tmp_path, vehicle=SMALL, segment_bytes=segment_bytes)
    kept.drive(6.0)
    slow_steps(monkeypatch, kept)
    for number in range(4):
        ask_long(kept, number)
        kept.send(GetHistory(ME, kept.clock.utime() - 4 * S, kept.clock.utime(), 50.0))
        kept.drive(0.7)
        kept.send(GetStateVector(ME))
        kept.drive(0.3)
    kept.turns(100)
    assert len(kept.bus.said("REPLY_LONG")) == 4 * 20
    # poses and other replies went out between the parts
    channels = [channel for channel, _ in kept.bus.published]
    first = channels.index("REPLY_LONG")
    assert "POSE" in channels[first : first + 60]
    if segment_bytes < 1 << 20:
        assert len(kept.segments) > 4
    assert proved(again(kept))


def test_given_a_long_answer_that_is_not_finished_when_verified_then_what_was_sent_is_reproduced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = Kept(tmp_path)
    kept.drive(6.0)
    slow_steps(monkeypatch, kept, 0.02)
    ask_long(kept)
    kept.turns(10)
    assert kept.loop.requests_waiting == 1
    assert proved(again(kept))


def test_given_a_long_answer_that_fails_when_verified_then_its_reply_is_reproduced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = Kept(tmp_path)
    kept.drive(6.0)
    steps = 0

    def broken(reply: DeferredReply) -> None:
        nonlocal steps
        steps += 1
        if steps == 3:
            raise ArithmeticError("no number")

    with monkeypatch.context() as patched:
        patched.setattr(DeferredReply, "step", broken)
        ask_long(kept)
        kept.turns(5)
    assert len(kept.bus.said("REPLY_LONG")) == 1
    ask_long(kept, 2)
    kept.drive(0.5)
    assert len(kept.bus.said("REPLY_LONG")) == 1 + 20
    assert proved(again(kept))
