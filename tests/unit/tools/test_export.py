"""`modelserver export`: what an MCAP file has of a log, read by Foxglove's own reader."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support_recordings import write_log
from support_view import record_drive

pytest.importorskip("foxglove", reason="the extra foxglove is not installed: pip install -e '.[foxglove]'")

from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from modelserver.transforms.pose import Pose
from modelserver.wire.codec import decode
from modelserver.wire.eventlog import LogFile
from mstools.cli import main
from mstools.recordings.log_platform import LogPlatform

SECONDS = 12.0


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_drive(tmp_path_factory.mktemp("export"), SECONDS)


@pytest.fixture(scope="module")
def mcap(log: Path) -> Path:
    out = log.with_suffix(".mcap")
    with pytest.raises(SystemExit) as ended:
        main(["export", str(log), str(out)])
    assert not ended.value.code
    return out


def read(path: Path, topic: str) -> Iterator[tuple[int, Any]]:
    """Yield the log time, microseconds, and the message of a topic; bytes for those of LCM."""
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        if topic.startswith("/lcm/"):
            for _, _, message in reader.iter_messages(topics=[topic]):
                yield message.log_time // 1000, message.data
        elif topic == "/diagnostics":
            for _, _, message in reader.iter_messages(topics=[topic]):
                yield message.log_time // 1000, json.loads(message.data)
        else:
            for found in reader.iter_decoded_messages(topics=[topic]):
                yield found.message.log_time // 1000, found.decoded_message


def utime_of(stamp: Any) -> int:
    return int(stamp.seconds) * 1_000_000 + int(stamp.nanos) // 1000


def pose_of(transform: Any) -> Pose:
    p, q = transform.translation, transform.rotation
    return Pose((p.x, p.y, p.z), (q.w, q.x, q.y, q.z))


@pytest.mark.slow
def test_given_a_log_then_the_frames_are_where_a_query_of_the_log_places_them(log: Path, mcap: Path) -> None:
    platform = LogPlatform(log)
    world: dict[int, Pose] = {}
    laser: dict[int, Pose] = {}
    frames: dict[str, Pose] = {}
    for now, message in read(mcap, "/tf"):
        for transform in message.transforms:
            if transform.parent_frame_id == "utm":
                assert transform.child_frame_id == "Raptor:CG"
                world[utime_of(transform.timestamp)] = pose_of(transform)
                continue
            assert transform.parent_frame_id == "Raptor:CG"
            frames[transform.child_frame_id] = pose_of(transform)
            if transform.child_frame_id == "FrontSICKLaser:Scan":
                laser[now] = pose_of(transform)
    assert len(world) == len(list(read(mcap, "/pose")))
    # the history of a client begins with the first known pose
    for utime in list(world)[250::67]:
        assert world[utime].is_close(platform.get_pose("Raptor:CG", "World:UTM", at=utime).transformation.pose)
    fixed = platform.get_pose("Digiclops:ImagePlane", "Raptor:CG").transformation.pose
    assert frames["Digiclops:ImagePlane"].is_close(fixed)
    # the laser nods, and each message has the angle of that time
    pitches = [float(pose.rpy[1]) for pose in laser.values()]
    assert np.ptp(pitches) > 0.7
    assert len(frames) > 40


def test_given_a_log_then_fixes_health_and_events_are_in_their_schemas(log: Path, mcap: Path) -> None:
    with LogFile(log) as events:
        fixes = [decode("gps_t", event.data) for event in events if event.channel == "GPS"]
    exported = [message for _, message in read(mcap, f"/fix/{fixes[0].header.source}")]
    assert [(each.latitude, each.longitude) for each in exported] == [(f.latitude_deg, f.longitude_deg) for f in fixes]
    assert [utime_of(each.timestamp) for each in exported] == [each.header.utime for each in fixes]
    places = [message for _, message in read(mcap, "/pose/fix")]
    assert 0.8 * 5 * SECONDS <= len(places) <= 5 * SECONDS + 1
    assert places[-1].latitude == pytest.approx(fixes[-1].latitude_deg, abs=1e-4)
    reports = [message for _, message in read(mcap, "/diagnostics")]
    pose = reports[-1]["status"][0]
    assert (pose["name"], pose["level"], pose["message"]) == ("pose", 0, "the pose is valid")
    assert reports[0]["status"][0]["level"] == 1
    texts = [message.message for _, message in read(mcap, "/events")]
    assert "the pose is valid" in texts


def test_given_a_log_then_its_messages_are_in_it_bit_for_bit_with_their_definition(log: Path, mcap: Path) -> None:
    with LogFile(log) as events:
        expected = [(event.utime, event.data) for event in events if event.channel == "WHEELS"]
    assert list(read(mcap, "/lcm/WHEELS")) == expected
    with mcap.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    schemas = {each.name: each for each in summary.schemas.values()}
    assert b"struct wheels_t" in schemas["mslcm.wheels_t"].data


def run(*arguments: object) -> int:
    with pytest.raises(SystemExit) as ended:
        main(["export", *map(str, arguments)])
    return int(ended.value.code or 0)


def test_given_no_raw_messages_then_the_file_is_without_them(log: Path, tmp_path: Path, mcap: Path) -> None:
    out = tmp_path / "small.mcap"
    assert run(log, out, "--no-raw") == 0
    assert list(read(out, "/lcm/WHEELS")) == []
    assert len(list(read(out, "/pose"))) == len(list(read(mcap, "/pose")))


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (lambda path: path.write_bytes(b"no log at all"), "not an LCM event log"),
        (lambda path: write_log(path, [(1, "POSE", b"damaged")]), "no complete geometry on MODEL_SNAPSHOT"),
    ],
)
def test_given_a_log_that_cannot_be_exported_then_nothing_is_written_and_the_reason_is_shown(
    make: Callable[[Path], object], reason: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, out = tmp_path / "drive.lcm", tmp_path / "drive.mcap"
    make(log)
    assert run(log, out) == 1
    assert reason in capsys.readouterr().err
    assert [each.name for each in tmp_path.iterdir()] == ["drive.lcm"]


def test_given_a_file_that_exists_then_it_stays_unless_forced(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "drive.mcap"
    out.write_text("mine")
    assert run(log, out) == 1
    assert "--force" in capsys.readouterr().err
    assert out.read_text() == "mine"
    assert run(log, out, "--force") == 0
    assert out.stat().st_size > 1000


def run_import(mcap: Path, out: Path, *options: str) -> int:
    with pytest.raises(SystemExit) as ended:
        main(["import-bag", str(mcap), str(out), *options])
    return int(ended.value.code or 0)


def test_given_an_exported_file_then_import_bag_makes_the_log_again(log: Path, mcap: Path, tmp_path: Path) -> None:
    again = tmp_path / "again.lcm"
    assert run_import(mcap, again) == 0
    with LogFile(log) as first, LogFile(again) as second:
        assert [(e.utime, e.channel, e.data) for e in second] == [(e.utime, e.channel, e.data) for e in first]


def test_given_a_file_without_lcm_messages_or_a_damaged_one_then_import_bag_ends_with_the_reason(
    log: Path, mcap: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plain, cut, out = tmp_path / "plain.mcap", tmp_path / "cut.mcap", tmp_path / "out.lcm"
    with pytest.raises(SystemExit):
        main(["export", str(log), str(plain), "--no-raw"])
    assert run_import(plain, out) != 0
    assert "without --no-raw" in capsys.readouterr().err
    cut.write_bytes(mcap.read_bytes()[:20_000])
    assert run_import(cut, out) != 0
    assert "cut.mcap: the MCAP file" in capsys.readouterr().err
    assert run_import(mcap, out, "--topic", "gps=/lcm/GPS") != 0
    assert "--topic goes with a ROS bag" in capsys.readouterr().err
    assert not out.exists()
