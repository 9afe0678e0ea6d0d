"""A log without poses as it is with the service running: written by replay --log, shown by status, view and export."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from support_recordings import HUSKY, drive, write_forward_vehicle, write_log

from modelserver.wire.codec import decode
from modelserver.wire.eventlog import LogFile
from mstools import cli
from mstools.commands.replay import open_localized
from mstools.recordings.log_platform import LogPlatform

SECONDS = 15.0


@pytest.fixture(scope="module")
def raw(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_log(tmp_path_factory.mktemp("raw") / "drive.lcm", drive(SECONDS))


@pytest.fixture(scope="module")
def vehicle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_forward_vehicle(tmp_path_factory.mktemp("husky"))


@pytest.fixture(scope="module")
def whole(raw: Path, vehicle: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("localized") / "drive.lcm"
    assert run("replay", raw, "-c", vehicle, "--log", out) == 0
    return out


def run(*words: object) -> int:
    with pytest.raises(SystemExit) as end:
        cli.main([str(each) for each in words])
    return int(end.value.code or 0)


def test_given_a_log_of_samples_then_it_has_what_the_service_publishes_at_its_rates(raw: Path, whole: Path) -> None:
    with LogFile(raw) as log:
        samples = [(event.utime, event.channel, event.data) for event in log]
    with LogFile(whole) as log:
        events = list(log)
    assert [(each.utime, each.channel, each.data) for each in events if each.channel in ("GPS", "IMU")] == samples
    assert [each.utime for each in events] == sorted(each.utime for each in events)
    poses = [each for each in events if each.channel == "POSE"]
    assert len(poses) == pytest.approx(50 * SECONDS, abs=2)
    # a pose is for the instant at which it is published, as on the bus
    assert {each.utime - decode("pose_transform_t", each.data).transformation.utime for each in poses[200:]} == {0}
    # one a second, and one at each change of the state
    assert SECONDS - 2 <= len([each for each in events if each.channel == "MODELSERVER_HEALTH"]) <= 2 * SECONDS


def test_given_the_written_log_then_it_answers_queries_and_is_written_again_the_same(
    vehicle: Path, whole: Path, tmp_path: Path
) -> None:
    answers = LogPlatform(whole)
    assert answers.get_pose("Husky:Base", "utm").transformation.frame_of_reference == "World:UTM"
    again = tmp_path / "again.lcm"
    assert run("replay", whole, "-c", vehicle, "--log", again) == 0
    assert again.read_bytes() == whole.read_bytes()


def test_given_status_then_the_last_report_of_a_log_is_shown_and_without_one_it_names_the_way(
    raw: Path, vehicle: Path, whole: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("status", whole, "--json") in (0, 3)
    report = json.loads(capsys.readouterr().out)
    assert (report["vehicle"], report["uptime"]) == ("Husky", pytest.approx(SECONDS, abs=1.5))
    assert run("status", raw) == 1
    assert "with -c and the vehicle file" in capsys.readouterr().err
    assert run("status", raw, "-c", vehicle, "--json") in (0, 3)
    assert json.loads(capsys.readouterr().out)["uptime"] == report["uptime"]
    assert run("status", raw, "--watch") == 2


def test_given_a_vehicle_file_then_a_log_is_opened_as_localized_and_leaves_no_file(raw: Path) -> None:
    with open_localized(raw, HUSKY) as shown:
        assert LogPlatform(shown).base_frame == "Husky:Base"
        folder = shown.parent
    assert not folder.exists()
    with open_localized(raw, None) as shown:
        assert shown == raw


def test_given_options_that_do_not_go_together_then_usage_and_no_file(raw: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.lcm"
    assert run("replay", raw, "--log", out) == 2
    assert run("replay", raw, "-c", HUSKY, "--log", out, "--poses", "-") == 2
    assert run("replay", raw, "-c", HUSKY, "--log", raw) == 1
    assert run("replay", tmp_path / "missing.lcm", "-c", HUSKY, "--log", out) == 1
    assert list(tmp_path.iterdir()) == []
