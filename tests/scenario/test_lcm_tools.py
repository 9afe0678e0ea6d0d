"""The tools of the lcm wheel on the running daemon: its log records, decodes and plays back."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import lcm
import pytest
from support_lcm import Listener, run_process, running_daemon, wait_until

from modelserver.messages import Health, PoseAnswer
from modelserver.wire.channels import BY_NAME
from modelserver.wire.codec import decode
from mstools.commands.status import find_binary

RAPTOR = Path(__file__).resolve().parents[2] / "config" / "raptor" / "vehicle.yaml"
POSES = 20

SELF_TEST = "LCM_SELF_TEST"
"""What liblcm sends itself when it opens a bus, sometimes while the logger listens."""


@pytest.fixture(scope="module")
def daemon_url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with running_daemon(RAPTOR, tmp_path_factory.mktemp("daemon")) as url:
        yield url


@pytest.fixture(scope="module")
def recording(daemon_url: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log that lcm-logger wrote of the running daemon."""
    folder = tmp_path_factory.mktemp("log")
    path = folder / "run.lcmlog"
    with (
        (folder / "errors").open("w+") as errors,
        run_process(
            [find_binary("lcm-logger"), "--quiet", "--flush-interval=50", path],
            daemon_url,
            stdout=errors,
            stderr=errors,
        ) as logger,
    ):
        # the logger does not report when it listens; its file grows once it does
        listener = Listener(daemon_url, "POSE")
        assert wait_until(listener.bus, lambda: _size(path) > 40_000 or logger.poll() is not None)
        assert logger.poll() is None, (folder / "errors").read_text()
    return path


def _size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0


def _events(path: Path) -> list[lcm.Event]:
    log = lcm.EventLog(path)
    try:
        return list(log)
    finally:
        log.close()


def test_given_a_running_daemon_when_lcm_logger_records_then_every_event_decodes(recording: Path) -> None:
    events = _events(recording)
    by_channel: dict[str, list[object]] = {}
    for event in events:
        if event.channel == SELF_TEST:
            continue
        by_channel.setdefault(event.channel, []).append(decode(BY_NAME[event.channel].type_name, event.data))
    assert {"POSE", "POSE_VECTOR", "POSE_ODOM"} <= by_channel.keys() <= BY_NAME.keys()
    poses = by_channel["POSE"]
    assert len(poses) >= POSES
    for pose in poses:
        assert isinstance(pose, PoseAnswer)
        assert pose.transformation.frame_of_interest == "Raptor:CG"
        assert pose.transformation.frame_of_reference == "World:UTM"
        assert not pose.transformation.is_valid  # no sensor has spoken
    utimes = [pose.transformation.utime for pose in poses if isinstance(pose, PoseAnswer)]
    assert utimes == sorted(utimes)
    assert all(isinstance(each, Health) for each in by_channel.get("MODELSERVER_HEALTH", []))


def test_given_a_log_when_lcm_logplayer_plays_it_then_a_subscriber_receives_the_same_poses(
    recording: Path, lcm_url: str
) -> None:
    recorded = [event.data for event in _events(recording) if event.channel == "POSE"]
    listener = Listener(lcm_url, "POSE")
    with run_process([find_binary("lcm-logplayer"), recording], lcm_url, stdout=subprocess.DEVNULL) as player:
        assert listener.wait(POSES)
        assert player.wait(60) == 0
    assert listener.received[:POSES] == recorded[:POSES]


def test_given_the_daemon_when_reported_to_end_then_it_ends_in_time_with_0(tmp_path: Path) -> None:
    with running_daemon(RAPTOR, tmp_path) as url:
        listener = Listener(url, "POSE")
        assert listener.wait()
        begin = time.monotonic()
    assert time.monotonic() - begin < 10
    assert "Traceback" not in (tmp_path / "daemon.log").read_text()
