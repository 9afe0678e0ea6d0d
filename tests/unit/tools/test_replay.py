from __future__ import annotations

import itertools
import json
import math
import os
import re
import struct
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import lcm
import pytest
from support_lcm import reserved_url
from support_recordings import (
    EASTING,
    HEIGHT,
    HUSKY,
    LATENCY,
    NORTHING,
    SPEED,
    START,
    drive,
    write_forward_vehicle,
    write_log,
)
from support_samples import ScriptedLocalizer
from support_tuning import write_vehicle

from modelserver import core
from modelserver.core import CoreSettings, CoreState, Instant
from modelserver.earth.geodesy import origin_at
from modelserver.messages import Decision, GetBodyList, GpsSample, PoseAnswer, RequestHeader, Verdict
from modelserver.server import recordings as playback
from modelserver.server.vehicle import Vehicle
from modelserver.transforms import Pose, Transformation
from modelserver.wire.codec import decode, encode
from modelserver.wire.eventlog import LogEvent, LogFile
from mstools import cli
from mstools.commands.replay import _exclude_service_messages, read_times

pytestmark = pytest.mark.slow

HEADER = (
    "utime,easting,northing,up,qw,qx,qy,qz,pose_valid,invalid_reasons,"
    "horizontal_bound,heading_bound,sigma_east,sigma_north,sigma_up,sigma_yaw,latitude_deg,longitude_deg,heading_deg,"
    "horizontal_level,heading_level,limit_risk"
)

SHORT_S = 15.0

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """Run the command; return its exit code, standard output and error."""

    def replay(*arguments: object) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as end:
            cli.main(["replay", *(str(each) for each in arguments)])
        out, err = capsys.readouterr()
        return int(end.value.code or 0), out, err

    return replay


@pytest.fixture(scope="session")
def recorded_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_log(tmp_path_factory.mktemp("recordings") / "drive.lcm", drive(40.0))


@pytest.fixture(scope="session")
def short_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_log(tmp_path_factory.mktemp("short") / "drive.lcm", drive(SHORT_S))


@pytest.fixture(scope="session")
def forward(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_forward_vehicle(tmp_path_factory.mktemp("husky"))


@pytest.fixture(scope="session")
def base_poses(recorded_log: Path, forward: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Replay the drive at 10 Hz, once for all tests; return the poses of the base frame."""
    out = tmp_path_factory.mktemp("base") / "base.csv"
    with pytest.raises(SystemExit) as end:
        cli.main(["replay", str(recorded_log), "-c", str(forward), "--poses", str(out), "--rate", "10"])
    assert not end.value.code
    return out


def rows(path: Path) -> list[list[float]]:
    lines = path.read_text().splitlines()
    assert lines[0] == HEADER
    return [[float(value or "nan") for value in line.split(",")] for line in lines[1:]]


# --- offline ------------------------------------------------------------------------------------------------


def test_given_a_drive_when_replayed_then_the_antenna_is_where_it_was(
    recorded_log: Path, forward: Path, tmp_path: Path, run: Run
) -> None:
    out = tmp_path / "poses.csv"
    code, words, err = run(recorded_log, "-c", forward, "--poses", out, "--frame", "Antenna:PhaseCenter", "--rate", 10)
    assert (code, err) == (0, "")
    assert "times real time" in words
    found = rows(out)
    assert [row[0] for row in found[:3]] == [START + LATENCY + n * 100_000 for n in range(3)]
    assert len(found) == 400
    assert math.isnan(found[0][1])
    assert found[0][8:10] == [0, 15]
    utime, easting, northing, up, w, x, y, z, valid, reasons = found[-1][:10]
    assert (valid, reasons) == (1, 0)
    assert easting == pytest.approx(EASTING + SPEED * (utime - START) * 1e-6, abs=0.1)
    assert northing == pytest.approx(NORTHING, abs=0.1)
    assert up == pytest.approx(HEIGHT, abs=0.1)
    assert abs(2 * math.atan2(z, w)) < 0.03  # to the east
    assert math.hypot(x, y) < 0.01


def test_given_no_frame_when_replayed_then_it_is_the_base_frame(
    recorded_log: Path, forward: Path, base_poses: Path, tmp_path: Path, run: Run
) -> None:
    out = tmp_path / "antenna.csv"
    assert run(recorded_log, "-c", forward, "--poses", out, "--frame", "Antenna:PhaseCenter", "--rate", 10)[0] == 0
    base, antenna = rows(base_poses)[-1], rows(out)[-1]
    assert base[0] == antenna[0]
    # the protection levels are those of the base frame
    horizontal, heading, east, north, up, yaw, latitude, longitude, ahead, *levels, risk = base[10:]
    assert horizontal > 3.0 * max(east, north) > 0.0
    assert heading > 3.0 * yaw > 0.0
    assert up > 0.0
    # and so are the levels of an instant, which are exceeded more often
    assert 3.0 * max(east, north) < levels[0] < horizontal
    assert 3.0 * yaw < levels[1] < heading
    assert 0.0 <= risk < 0.01
    there = origin_at(latitude, longitude, base[3])
    assert (there.easting, there.northing) == pytest.approx((base[1], base[2]), abs=1e-3)
    assert [math.isnan(value) for value in antenna[10:]] == [True] * 2 + [False] * 7 + [True] * 3
    assert ahead == pytest.approx(88.6, abs=1.5)  # grid east, which points 1.4 degrees north of true east there
    assert antenna[1] - base[1] == pytest.approx(0.2475, abs=0.01)
    assert antenna[3] - base[3] == pytest.approx(0.2231, abs=0.01)


def test_given_the_same_log_when_replayed_twice_then_the_same_bytes(
    recorded_log: Path, forward: Path, base_poses: Path, tmp_path: Path, run: Run
) -> None:
    assert run(recorded_log, "-c", forward, "--poses", tmp_path / "two.csv", "--rate", 10)[0] == 0
    assert (tmp_path / "two.csv").read_bytes() == base_poses.read_bytes()


def test_given_times_when_replayed_then_a_row_for_each_whatever_comes_after(
    recorded_log: Path, tmp_path: Path, run: Run
) -> None:
    at = START + 20_000_000
    times = tmp_path / "times.txt"
    times.write_text(f"# two of them\n\n{at}\n{at + 12_345}  # not on a sample\n")
    shorter = write_log(tmp_path / "short.lcm", [each for each in drive(20.1) if each[0] < at + 12_345])
    for log, name in ((recorded_log, "whole.csv"), (shorter, "short.csv")):
        assert run(log, "-c", HUSKY, "--poses", tmp_path / name, "--at-times", times)[0] == 0
    assert [row[0] for row in rows(tmp_path / "whole.csv")] == [at, at + 12_345]
    # what arrived later cannot have been used: without it the answer is the same to the bit
    assert (tmp_path / "whole.csv").read_bytes() == (tmp_path / "short.csv").read_bytes()


@pytest.mark.parametrize(
    ("factor", "words"),
    [(1e-6, "these look like seconds"), (1e3, "these look like nanoseconds"), (2.0, "the log lasts")],
)
def test_given_times_that_lie_outside_the_log_then_that_is_reported(
    short_log: Path, tmp_path: Path, run: Run, factor: float, words: str
) -> None:
    times = tmp_path / "times.txt"
    times.write_text(f"{round((START + 10_000_000) * factor)}\n")
    code, _, err = run(short_log, "-c", HUSKY, "--poses", tmp_path / "p.csv", "--at-times", times)
    assert code == 0
    assert "none of 1 time lies within the log" in err
    assert words in err


def test_given_poses_that_are_not_valid_then_the_summary_reports_how_many_and_why(
    short_log: Path, tmp_path: Path, run: Run
) -> None:
    code, out, _ = run(short_log, "-c", HUSKY, "--poses", tmp_path / "p.csv", "--rate", 10)
    assert code == 0
    bad = sum(row[8] == 0 for row in rows(tmp_path / "p.csv"))
    assert f"(not valid: {bad}, mostly NO" in out
    code, out, _ = run(short_log, "-c", HUSKY, "--poses", tmp_path / "p.csv", "--rate", 10, "--json")
    assert json.loads(out)["invalid_reasons"]["NOT_MOVED_YET"] <= bad


def test_given_fixes_that_are_refused_then_the_kinds_of_measurement_are_named(tmp_path: Path, run: Run) -> None:
    def spoil(event: tuple[int, str, bytes]) -> tuple[int, str, bytes]:
        if event[1] != "GPS" or event[0] < START + 5_000_000:
            return event
        fix: GpsSample = decode("gps_t", event[2])
        return (*event[:2], encode(replace(fix, latitude_deg=math.nan)))

    log = write_log(tmp_path / "a.lcm", map(spoil, drive(8.0)))
    code, out, _ = run(log, "-c", HUSKY, "--poses", tmp_path / "p.csv")
    assert code == 0
    assert re.search(r"not used: \d+ of sensor:gps, nan \(.*gps_position.*\)", out)


def test_given_a_folder_that_is_not_there_then_it_is_reported_before_the_run(
    recorded_log: Path, tmp_path: Path, run: Run
) -> None:
    target = tmp_path / "none" / "report.html"
    code, out, err = run(recorded_log, "-c", HUSKY, "--poses", tmp_path / "p.csv", "--report", target)
    assert (code, out) == (1, "")
    assert f"{target} cannot be written: folder" in err
    assert not (tmp_path / "p.csv").exists()


def test_given_help_then_it_reports_that_files_are_replaced(run: Run) -> None:
    assert "Existing files of --poses, --decisions, --report and --log are replaced" in " ".join(
        run("--help")[1].split()
    )


def test_given_standard_output_when_replayed_then_only_the_poses_go_there(short_log: Path, run: Run) -> None:
    code, out, err = run(short_log, "-c", HUSKY, "--poses", "-", "--rate", 1)
    assert code == 0
    assert out.splitlines()[0] == HEADER
    assert len(out.splitlines()) == 16
    assert "times real time" in err


def test_given_json_when_replayed_then_the_counts_are_for_scripts(tmp_path: Path, run: Run) -> None:
    events = [*drive(5.0), (START + 6_000_000, "IMU", b"junk"), (START + 6_000_001, "OTHER", b"junk")]
    log = write_log(tmp_path / "a.lcm", events)
    code, out, _ = run(log, "-c", HUSKY, "--poses", tmp_path / "p.csv", "--json")
    report = json.loads(out)
    assert code == 0
    assert report["rejected"] == [{"source": "IMU", "reason": "fingerprint", "count": 1, "kinds": {}}]
    assert (report["events"], report["samples"]) == (277, 276)
    assert report["real_time_factor"] > 0


def test_given_a_channel_when_replayed_offline_then_the_others_are_left_out(
    recorded_log: Path, tmp_path: Path, run: Run
) -> None:
    out = tmp_path / "p.csv"
    assert run(recorded_log, "-c", HUSKY, "--poses", out, "--channel", "IMU", "--rate", 1)[0] == 0
    assert all(not row[8] for row in rows(out))


# --- what became of measurements ----------------------------------------------------------------------------


class Deciding(ScriptedLocalizer):
    """A localizer that decides on each fix."""

    def process(self, sample: Any) -> Any:
        taken, notes = super().process(sample)
        if not isinstance(sample, GpsSample):
            return taken, notes
        utime, seq = sample.header.utime, sample.header.seq
        if seq % 2:
            return taken, (Decision(utime, "gps", seq, "gps_position", Verdict.REJECTED, "satellites"),)
        matrix = (4.0, 0.5, 0.5, 4.0)
        decision = Decision(
            utime, "gps", seq, "gps_position", Verdict.USED, "", (1.5, -0.5), matrix, matrix, 0.75, math.inf
        )
        return taken, (decision,)


@pytest.fixture
def deciding(monkeypatch: pytest.MonkeyPatch) -> None:
    def start(vehicle: Vehicle, now: Instant) -> CoreState:
        settings = CoreSettings(vehicle.config.base_frame, publish_decisions=False)
        return core.start(settings, vehicle.model, Deciding(), now)

    monkeypatch.setattr(Vehicle, "start_core", start)


@pytest.mark.usefixtures("deciding")
def test_given_a_ledger_when_replayed_then_each_decision_is_a_line_of_json(
    recorded_log: Path, tmp_path: Path, run: Run
) -> None:
    ledger = tmp_path / "ledger.jsonl"
    code, _, err = run(recorded_log, "-c", HUSKY, "--poses", tmp_path / "p.csv", "--decisions", ledger, "--rate", 1)
    assert (code, err) == (0, "")
    text = ledger.read_text()
    assert "NaN" not in text
    assert "Infinity" not in text
    lines = [json.loads(line) for line in text.splitlines()]
    assert [line["seq"] for line in lines] == list(range(200))
    assert lines[0] == {
        "utime": START, "source": "gps", "seq": 0, "kind": "gps_position", "verdict": "used", "reason": "",
        "residual": [1.5, -0.5], "innovation_covariance": [4.0, 0.5, 0.5, 4.0], "noise": [4.0, 0.5, 0.5, 4.0],
        "statistic": 0.75, "limit": None,
    }  # fmt: skip
    assert (lines[1]["verdict"], lines[1]["reason"], lines[1]["residual"]) == ("rejected", "satellites", [])
    assert lines[1]["statistic"] is None
    assert len(rows(tmp_path / "p.csv")) == 40


@pytest.mark.usefixtures("deciding")
def test_given_a_ledger_on_standard_output_then_only_that_goes_there(
    recorded_log: Path, tmp_path: Path, run: Run
) -> None:
    code, out, err = run(recorded_log, "-c", HUSKY, "--poses", tmp_path / "p.csv", "--decisions", "-", "--rate", 1)
    assert code == 0
    assert len([json.loads(line) for line in out.splitlines()]) == 200
    assert "times real time" in err


def test_given_raw_mode_then_the_ledger_is_empty_and_the_poses_are_the_same(
    short_log: Path, tmp_path: Path, run: Run
) -> None:
    config = write_vehicle(HUSKY, tmp_path, {"mode": "raw"})
    for name, options in (("one.csv", ("--decisions", tmp_path / "ledger.jsonl")), ("two.csv", ())):
        assert run(short_log, "-c", config, "--poses", tmp_path / name, *options)[0] == 0
    assert (tmp_path / "ledger.jsonl").read_text() == ""
    assert (tmp_path / "one.csv").read_bytes() == (tmp_path / "two.csv").read_bytes()


def test_given_a_ledger_over_a_file_that_is_needed_then_it_is_refused(
    recorded_log: Path, tmp_path: Path, run: Run
) -> None:
    log, poses = tmp_path / "drive.lcm", tmp_path / "p.csv"
    log.write_bytes(recorded_log.read_bytes())
    for target, words in ((log, "is an input of this command"), (poses, "already the file of the poses")):
        code, _, err = run(log, "-c", HUSKY, "--poses", poses, "--decisions", target)
        assert code == 1
        assert words in err
    assert log.read_bytes() == recorded_log.read_bytes()
    assert not poses.exists()


# --- bad input ----------------------------------------------------------------------------------------------


def test_given_a_log_that_breaks_off_when_replayed_then_the_rest_counts_and_it_is_reported(
    short_log: Path, tmp_path: Path, run: Run
) -> None:
    log = tmp_path / "cut.lcm"
    log.write_bytes(short_log.read_bytes()[:-5])
    code, _, err = run(log, "-c", HUSKY, "--poses", tmp_path / "p.csv")
    assert code == 0
    assert "truncated after event 824" in err
    assert len(rows(tmp_path / "p.csv")) > 700


def test_given_damage_within_when_replayed_then_what_is_good_is_used_and_the_exit_code_reports(
    recorded_log: Path, forward: Path, tmp_path: Path, run: Run
) -> None:
    whole = recorded_log.read_bytes()
    broken = bytearray(whole)
    broken[24:28] = struct.pack(">i", 0x7FFFFFFF)  # the first event's length: lcm's own reader dies of it
    log = tmp_path / "broken.lcm"
    log.write_bytes(broken)
    code, words, err = run(log, "-c", forward, "--poses", tmp_path / "p.csv")
    assert code == 1
    assert "bytes after event 0, at byte 0, are no event and were skipped" in err
    assert "of 2199 messages" in words
    assert rows(tmp_path / "p.csv")[-1][8] == 1


def test_given_a_log_of_another_vehicle_when_replayed_then_both_sides_channels_are_reported(
    tmp_path: Path, run: Run
) -> None:
    log = write_log(tmp_path / "a.lcm", drive(1.0, prefix="NORTH_"))
    code, _, err = run(log, "-c", HUSKY, "--poses", tmp_path / "p.csv")
    assert code == 1
    assert "no message on the vehicle's channels (GPS, IMU, WHEELS); the log has: NORTH_GPS, NORTH_IMU" in err


def test_given_a_vehicle_without_sensors_when_replayed_then_it_reports_what_is_missing(
    recorded_log: Path, tmp_path: Path, run: Run
) -> None:
    config = tmp_path / "v.yaml"
    config.write_text(f"vehicle: V\ngeometry: {HUSKY.with_name('geometry.yaml')}\nbase_frame: Husky:Base\n")
    code, _, err = run(recorded_log, "-c", config, "--poses", tmp_path / "p.csv")
    assert code == 1
    assert "no localization sensor is configured" in err


@pytest.mark.parametrize("content", [b"", os.urandom(100_000), b"<Model/>"])
def test_given_no_log_when_replayed_then_one_clear_error_and_no_poses(tmp_path: Path, run: Run, content: bytes) -> None:
    log = tmp_path / "junk.lcm"
    log.write_bytes(content)
    code, out, err = run(log, "-c", HUSKY, "--poses", tmp_path / "p.csv")
    assert (code, out, err.count("\n")) == (1, "", 1)
    assert "junk.lcm" in err
    assert not (tmp_path / "p.csv").exists()


def test_given_an_unknown_frame_when_replayed_then_the_nearest_is_offered_and_no_file_is_touched(
    recorded_log: Path, tmp_path: Path, run: Run
) -> None:
    out = tmp_path / "p.csv"
    out.write_text("precious")
    code, _, err = run(recorded_log, "-c", HUSKY, "--poses", out, "--frame", "Antenna:PhaseCentar")
    assert code == 1
    assert "Antenna:PhaseCenter" in err
    assert out.read_text() == "precious"


def test_given_an_unknown_channel_when_replayed_then_the_nearest_is_offered(
    recorded_log: Path, tmp_path: Path, run: Run
) -> None:
    code, _, err = run(recorded_log, "-c", HUSKY, "--poses", tmp_path / "p.csv", "--channel", "IMUU")
    assert code == 1
    assert "Nearest: IMU" in err


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1\n2\nthree\n", ":3: 'three' is not a time"),
        ("5\n4\n", ":2: 4 is before 5"),
        ("-1\n", ":1: '-1' is not a time"),
        ("0\n", ":1: '0' is not a time"),
        ("1.5\n", ":1: '1.5' is not a time"),
        ("9" * 30 + "\n", ":1: "),
        ("\n# nothing\n", "has no times"),
        ("\x00\xff", ":1: "),
    ],
)
def test_given_a_wrong_file_of_times_when_replayed_then_the_line_is_reported(
    recorded_log: Path, tmp_path: Path, run: Run, text: str, words: str
) -> None:
    times = tmp_path / "times.txt"
    times.write_text(text, encoding="latin-1")
    code, _, err = run(recorded_log, "-c", HUSKY, "--poses", tmp_path / "p.csv", "--at-times", times)
    assert code == 1
    assert words in err


def test_given_times_with_comments_when_read_then_they_are_numbers(tmp_path: Path) -> None:
    path = tmp_path / "times.txt"
    path.write_text("# utime\n1\n 2 # second\n2\n\n30")
    assert read_times(path) == [1, 2, 2, 30]


@pytest.mark.parametrize(
    "options",
    [
        ["--poses", "p.csv"],
        ["--frame", "A:B"],
        ["--at-times", "t"],
        ["--decisions", "d.jsonl"],
        ["-c", "v.yaml", "--poses", "-", "--decisions", "-"],
        ["--speed", "fast"],
        ["--speed", "-1"],
        ["--speed", "nan"],
        ["-c", "v.yaml", "--poses", "p.csv", "--rate", "0"],
        ["-c", "v.yaml", "--rate", "10"],
        ["-c", "v.yaml", "--report", "r.html", "--rate", "10"],
        ["-c", "v.yaml", "--poses", "p.csv", "--rate", "10", "--at-times", "t"],
    ],
)
def test_given_wrong_options_when_replayed_then_usage(recorded_log: Path, run: Run, options: list[str]) -> None:
    assert run(recorded_log, *options)[0] == 2


# --- onto the bus -------------------------------------------------------------------------------------------


def test_given_a_log_when_played_on_a_bus_then_the_same_bytes_arrive(
    tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    port = 20_000 + os.getpid() % 20_000
    url = f"udpm://239.255.76.67:{port}?ttl=0&recv_buf_size=4194304"
    sent = [*drive(1.0), (START + 2_000_000, "OTHER", b"no message of ours")]
    got: list[tuple[str, bytes]] = []
    listener = lcm.LCM(url)
    listener.subscribe(".*", lambda channel, data: got.append((channel, data))).set_queue_capacity(0)
    code, words, _ = run(write_log(tmp_path / "a.lcm", sent), "--url", url, "--speed", "max")
    end = time.monotonic() + 5.0
    while len(got) < len(sent) and time.monotonic() < end:
        listener.handle_timeout(100)
    assert code == 0
    assert f"{len(sent)} messages sent, 2.0 s of the log" in words
    assert got == [(channel, data) for _, channel, data in sent]


def test_given_an_interrupt_when_played_then_it_ends_with_the_count(
    recorded_log: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(player: playback.Player, *arguments: object) -> None:
        player.sent = 3
        raise KeyboardInterrupt

    monkeypatch.setattr(playback.Player, "play", interrupt)
    with reserved_url() as url:
        code, words, _ = run(recorded_log, "--url", url)
    assert code == 130
    assert "3 messages sent" in words


def test_given_an_input_as_output_when_replayed_then_it_is_refused_and_not_touched(
    recorded_log: Path, tmp_path: Path, run: Run
) -> None:
    log = tmp_path / "drive.lcm"
    log.write_bytes(recorded_log.read_bytes())
    link = tmp_path / "poses.csv"
    link.symlink_to(log)
    for target in (log, link):
        code, _, err = run(log, "-c", HUSKY, "--poses", target)
        assert code == 1
        assert "is an input of this command" in err
        assert log.read_bytes() == recorded_log.read_bytes()


def test_given_a_log_of_a_running_daemon_then_what_it_reported_is_not_sent_again(recorded_log: Path) -> None:
    pose = encode(PoseAnswer(Transformation("Cart:Base", "World:UTM", Pose.identity(), None, 5)))
    request = encode(GetBodyList(RequestHeader(1, "REPLY_X")))
    events = [
        LogEvent(0, 1, "POSE", pose, 0),
        LogEvent(1, 2, "PLATFORM_GET_BODY_LIST", request, 0),
        LogEvent(2, 3, "CAMERA", b"of another program", 0),
    ]
    with LogFile(recorded_log) as recording:
        sensors = list(itertools.islice(recording, 3))
    assert list(_exclude_service_messages([*events, *sensors])) == [events[2], *sensors]
