"""`modelserver record`: what is on the bus is in the log, in parts that stay within a limit."""

from __future__ import annotations

import json
import threading
from pathlib import Path
from typing import Any

import lcm
import pytest
from support_lcm import reserved_url
from support_samples import START

from modelserver.errors import ModelServerError
from modelserver.messages import JointSample, JointsSample, SensorHeader
from modelserver.wire.codec import encode
from modelserver.wire.eventlog import LogFile
from mstools import cli
from mstools.commands.record import Recorder

JOINTS = encode(JointsSample(SensorHeader(START, "head"), (JointSample("Pan", 0.1),)))
TYPE = JOINTS[:8]


class Publisher:
    """A program that publishes three channels until it is left."""

    def __init__(self, url: str):
        self.bus = lcm.LCM(url)
        self.ended = threading.Event()
        self.thread = threading.Thread(target=self.run)

    def run(self) -> None:
        while not self.ended.wait(0.01):
            self.bus.publish("JOINTS", JOINTS)
            self.bus.publish("BROKEN", TYPE + b"too short")
            self.bus.publish("CAMERA", b"foreign" + bytes(1000))

    def __enter__(self) -> Publisher:
        self.thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.ended.set()
        self.thread.join()


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as end:
        cli.main(["record", *map(str, arguments)])
    out, err = capsys.readouterr()
    return int(end.value.code or 0), out, err


def read(path: Path) -> list[tuple[str, bytes]]:
    with LogFile(path) as log:
        found = [(event.channel, event.data) for event in log]
    assert log.damage == []
    return found


def test_given_a_bus_then_every_message_is_recorded_with_its_type_and_damage_is_counted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "drive.lcm"
    with reserved_url() as url, Publisher(url):
        code, out, err = run(capsys, path, "--seconds", "0.5", "--url", url, "--json")
    assert (code, err) == (0, "")
    report: dict[str, Any] = json.loads(out)
    events = read(path)
    assert report["files"] == [str(path)]
    assert report["messages"] == len(events) > 0
    assert {name: each["type"] for name, each in report["channels"].items()} == {
        "JOINTS": "joints_t",
        "BROKEN": "joints_t",
        "CAMERA": "",
    }
    assert report["channels"]["BROKEN"]["damaged"] == report["channels"]["BROKEN"]["messages"]
    assert report["channels"]["JOINTS"]["damaged"] == 0
    assert ("JOINTS", JOINTS) in events


def test_given_channels_then_only_they_are_recorded_and_one_without_messages_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "drive.lcm"
    with reserved_url() as url, Publisher(url):
        arguments = ("--seconds", "0.5", "--url", url, "--channel", "JOINTS", "--channel", "CAMRA")
        code, out, err = run(capsys, path, *arguments)
    assert code == 0
    assert {channel for channel, _ in read(path)} == {"JOINTS"}
    assert "nothing was received on CAMRA; did you mean CAMERA?" in err
    assert "joints_t" in out


def test_given_a_silent_bus_then_the_exit_code_is_1_and_the_bus_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with reserved_url() as url:
        code, _, err = run(capsys, tmp_path / "drive.lcm", "--seconds", "0.1", "--url", url)
    assert code == 1
    assert url in err


@pytest.mark.parametrize("limit", [0, 1])
def test_given_a_size_of_parts_then_all_messages_are_in_them_in_order_within_the_limit(
    tmp_path: Path, limit: int
) -> None:
    """Parts of 4 messages; with a limit of two parts the oldest are deleted."""
    size = 28 + 6 + 100
    recorder = Recorder(tmp_path / "drive.lcm", 4 * size, 8 * size if limit else float("inf"))
    sent = [bytes([n]) * 100 for n in range(22)]
    for n, data in enumerate(sent):
        recorder.feed("CAMERA", data, START + n)
    recorder.close()
    paths = sorted(tmp_path.iterdir())
    first = 4 if limit else 0
    assert [each.name for each in paths] == [f"drive-{n:04d}.lcm" for n in range(first, 6)]
    assert [data for path in paths for _, data in read(path)] == sent[4 * first :]
    assert sum(each.stat().st_size for each in paths) <= 8 * size or not limit
    assert [path for path, _ in recorder.parts] == paths
    with pytest.raises(ModelServerError, match="--force"):
        Recorder(tmp_path / "drive.lcm", 4 * size, 8 * size).check_target(force=False)
    Recorder(tmp_path / "drive.lcm", 4 * size, 8 * size).check_target(force=True)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "options", [["--split-mb", "0.1"], ["--max-mb", "1"], ["--split-mb", "9", "--max-mb", "10"], ["--seconds", "0"]]
)
def test_given_wrong_options_then_usage(tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str]) -> None:
    assert run(capsys, tmp_path / "a.lcm", *options)[0] == 2
