"""`modelserver query --log`: a log answers by itself, since the geometry is in it."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

import numpy as np
import pytest
from support_mirror import DELAY, drive, joints, parts, pose, snapshot
from support_moving import BASE, ODOM, SCAN, T0, UTM, S, estimate, joints_at, rover, truth, vehicle
from support_recordings import write_log

from modelserver.formats import save_model
from modelserver.geometry.parts import Sigma
from modelserver.joints import JointHistory
from modelserver.transforms import Pose
from modelserver.wire.codec import encode
from mstools.cli import main

Command: TypeAlias = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Command:
    """A function that runs the command line; returns exit code, output and errors."""

    def run(*arguments: object) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as ended:
            main([str(each) for each in arguments])
        out, err = capsys.readouterr()
        assert "Traceback" not in err
        code = ended.value.code
        return code if isinstance(code, int) else 0, out, err

    return run


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log in which the first snapshot comes after three quarters of a second."""
    events = (event for event in drive(4.0) if event[1] != "MODEL_SNAPSHOT" or event[0] > T0 + 750_000)
    return write_log(tmp_path_factory.mktemp("log") / "drive.lcm", sorted(events))


def output(out: str) -> Pose:
    answer = json.loads(out)
    return Pose(answer["position"], answer["quaternion"])


@pytest.mark.slow
@pytest.mark.parametrize("at", [0.0, 0.5, 1.005, 3.99])
@pytest.mark.parametrize("pair", [(BASE, UTM), (SCAN, UTM), (SCAN, BASE), (BASE, ODOM)])
def test_given_a_time_in_the_log_then_the_answer_is_the_truth_of_then(
    run: Command, log: Path, at: float, pair: tuple[str, str]
) -> None:
    if at == 0.0:
        code, out, err = run("query", *pair, "--log", log, "--json")
        at = 4.0
    else:
        code, out, err = run("query", *pair, "--log", log, "--at", T0 + round(at * S), "--json")
    assert (code, err) == (0, "")
    expected = truth(*pair, at) if ODOM not in pair else estimate(at).odom
    assert output(out).is_close(expected, 1e-3, 1e-3)
    assert json.loads(out)["utime"] == T0 + round(at * S)
    assert json.loads(out)["covariance"] is not None


def test_given_a_log_then_it_is_reported_as_the_daemon_would_report_it(run: Command, log: Path) -> None:
    code, out, _ = run("query", SCAN, UTM, "--log", log, "--at", "+1.0")
    lines = out.splitlines()
    assert code == 0
    assert lines[0] == f"{SCAN} in {UTM}"
    assert lines[1].split()[0] == "position"
    assert "origin 000000000000004d" in out
    np.testing.assert_allclose(list(map(float, lines[1].split()[1:4])), truth(SCAN, UTM, 1.0).position, atol=1e-3)


def test_given_a_demand_then_it_is_judged_at_the_end_of_what_was_read(run: Command, log: Path) -> None:
    code, out, _ = run("query", BASE, UTM, "--log", log, "--max-age", 0.5)
    assert (code, out.splitlines()[-1]) == (0, "  demand          met")
    code, out, _ = run("query", BASE, UTM, "--log", log, "--at", "+1", "--policy", "latest", "--max-age", 0.5)
    assert (code, out.splitlines()[-1]) == (0, "  demand          met")
    code, out, _ = run("query", BASE, UTM, "--log", log, "--at", "+1", "--max-age", 0.5)
    assert code == 3
    assert "s old, asked for: at most 0.5 s" in out.splitlines()[-1]


def test_given_policies_then_each_is_as_of_then(run: Command, log: Path) -> None:
    at = T0 + 2_004_000
    for policy, expected in (("latest", 2_000_000), ("held", 2_004_000), ("predicted", 2_004_000)):
        code, out, _ = run("query", BASE, UTM, "--log", log, "--at", at, "--policy", policy, "--json")
        assert code == 0
        assert json.loads(out)["utime"] == T0 + expected
    code, _, err = run("query", BASE, UTM, "--log", log, "--at", T0 + 4_500_000)
    assert code == 1
    assert "0.500 s after the time covered" in err


def test_given_a_correction_after_the_time_then_it_counts(run: Command, tmp_path: Path) -> None:
    events = list(drive(4.0))
    for channel, data in pose(estimate(2.0)):
        # published again, as after a delayed sample: everything from there on is republished
        events.append((T0 + 2_505_000, channel, data))
    later = [event for event in events if not (event[1].startswith("POSE") and T0 + 2 * S < event[0] < T0 + 2_500_000)]
    path = write_log(tmp_path / "late.lcm", sorted(later))
    code, out, _ = run("query", BASE, UTM, "--log", path, "--at", T0 + 2 * S, "--json")
    assert code == 0
    assert output(out).is_close(vehicle(2.0), 1e-9, 1e-9)


@pytest.mark.slow
def test_given_another_geometry_later_then_each_time_has_its_own(run: Command, tmp_path: Path) -> None:
    other = rover(Sigma((0.5, 0.5, 0.5)))
    events = list(drive(2.0))
    for n in range(250, 500):
        at = T0 + n * S // 100
        events += [(at, *each) for each in parts(snapshot(other), at)] if n % 100 == 50 else []
        events += [(at + DELAY, *each) for each in (*pose(estimate(n / 100), other), joints(n / 100))]
    path = write_log(tmp_path / "two.lcm", sorted(events))
    revisions = {}
    for seconds in (0.5, 1.9, 1.99, 2.51, 4.0):
        code, out, _ = run("query", SCAN, BASE, "--log", path, "--at", f"+{seconds}", "--json")
        assert code == 0
        revisions[seconds] = json.loads(out)["model_revision"]
    first, second = rover().revision, other.revision
    assert revisions == {0.5: first, 1.9: first, 1.99: first, 2.51: second, 4.0: second}


@pytest.mark.parametrize(
    ("at", "why"),
    [
        (T0 - 60 * S, "60.000 s before the log"),
        (T0 + 64 * S, "after the log"),
        ((T0 + 2 * S) // 1000, "this looks like milliseconds"),
        ((T0 + 2 * S) // 1_000_000, "this looks like seconds"),
        ("+90", "after the log"),
    ],
)
def test_given_a_time_outside_the_log_then_its_span_is_reported(run: Command, log: Path, at: object, why: str) -> None:
    code, out, err = run("query", BASE, UTM, "--log", log, "--at", at)
    assert (code, out) == (1, "")
    assert why in err
    assert f"extends from {T0}" in err


@pytest.mark.parametrize("given", [False, True], ids=["own geometry", "given geometry"])
@pytest.mark.parametrize("at", [0.5, 1.005, 3.9])
def test_given_a_log_without_poses_then_joints_and_geometry_answer_at_a_time(
    run: Command, tmp_path: Path, at: float, given: bool
) -> None:
    without = {"POSE", "POSE_ENU", "POSE_ODOM", *(["MODEL_SNAPSHOT"] if given else [])}
    path = write_log(tmp_path / "joints.lcm", [event for event in sorted(drive(4.0)) if event[1] not in without])
    options = []
    if given:
        (tmp_path / "rover.yaml").write_text(save_model(rover(), "yaml").text)
        options = ["--model", tmp_path / "rover.yaml"]
    code, out, err = run("query", SCAN, BASE, "--log", path, "--at", f"+{at}", *options, "--json")
    assert code == 0, err
    assert output(out).is_close(truth(SCAN, BASE, at), 1e-3, 1e-3)


def test_given_a_log_without_poses_and_joints_then_a_fixed_geometry_answers_at_a_time(
    run: Command, tmp_path: Path
) -> None:
    path = write_log(tmp_path / "fixed.lcm", [(T0 + n * S, "GPS", b"raw") for n in range(10)])
    (tmp_path / "rover.yaml").write_text(save_model(rover(), "yaml").text)
    code, out, _ = run(
        "query", "Rover:Mast", BASE, "--log", path, "--at", "+5", "--model", tmp_path / "rover.yaml", "--json"
    )
    assert code == 0
    assert output(out).is_close(rover().get_transformation("Rover:Mast", BASE).pose, 1e-9, 1e-9)
    code, _, err = run("query", "Rover:Mast", BASE, "--log", path, "--at", "+50", "--model", tmp_path / "rover.yaml")
    assert code == 1
    assert f"extends from {T0} to {T0 + 9 * S}" in err


@pytest.mark.parametrize("text", ["+", "+x", "+nan", "+inf", "yesterday"])
def test_given_no_time_at_all_then_it_is_wrong_usage(run: Command, log: Path, text: str) -> None:
    code, _, err = run("query", BASE, UTM, "--log", log, "--at", text)
    assert code == 2
    assert "+12.5" in err


def test_given_a_log_without_a_snapshot_then_it_reports_how_to_get_one_and_takes_a_file(
    run: Command, tmp_path: Path
) -> None:
    events = [event for event in drive(2.0) if event[1] != "MODEL_SNAPSHOT"]
    path = write_log(tmp_path / "old.lcm", events)
    code, _, err = run("query", SCAN, UTM, "--log", path)
    assert code == 1
    assert "no complete geometry on MODEL_SNAPSHOT (none)" in err
    assert "--model FILE" in err
    geometry = tmp_path / "rover.yaml"
    geometry.write_text(save_model(rover(), "yaml").text)
    code, out, err = run("query", SCAN, UTM, "--log", path, "--model", geometry, "--json")
    assert code == 0
    # degrees in the file are rounded, so it is another revision: it is used, with a note
    assert "the poses in" in err
    assert output(out).is_close(truth(SCAN, UTM, 2.0), 1e-9, 1e-9)


def test_given_a_snapshot_that_is_not_whole_then_it_reports_how_much_there_is(run: Command, tmp_path: Path) -> None:
    pieces = parts(snapshot(), size=200)[:-1]
    events = [(T0 + number, *message) for number, message in enumerate(pieces)]
    path = write_log(tmp_path / "part.lcm", [*events, (T0 + 100, *joints(0.0))])
    code, _, err = run("query", SCAN, BASE, "--log", path)
    assert code == 1
    assert f"only {len(pieces)} of {len(pieces) + 1} parts" in err


def test_given_a_log_with_a_prefix_then_it_has_to_be_reported(run: Command, tmp_path: Path) -> None:
    geometry = snapshot(channel="V1_JOINTS")
    events = [(T0 + n, f"V1_{channel}", data) for n, (channel, data) in enumerate(parts(geometry))]
    for n in range(20):
        t = n / 10
        events += [
            (T0 + round(t * S) + DELAY, f"V1_{channel}", data) for channel, data in (*pose(estimate(t)), joints(t))
        ]
    path = write_log(tmp_path / "prefixed.lcm", events)
    assert run("query", SCAN, UTM, "--log", path)[0] == 1
    code, out, _ = run("query", SCAN, UTM, "--log", path, "--prefix", "V1_", "--at", T0 + S, "--json")
    assert code == 0
    assert output(out).is_close(truth(SCAN, UTM, 1.0), 1e-9, 1e-9)


def test_given_a_log_that_begins_after_a_joint_was_reported_then_it_has_where_it_was_held(
    run: Command, tmp_path: Path
) -> None:
    now = T0 + 3600 * S
    held = JointHistory(rover().joints.values(), 60.0).update(joints_at(0.0), T0)[0].get_newest_samples(now)
    events = [(now + n, *message) for n, message in enumerate(parts(snapshot(), now))]
    events += [(now + 50 + n, "JOINTS_HELD", encode(each)) for n, each in enumerate(held)]
    events += [
        (now + 10_000 * n, channel, data)
        for n in range(20)
        for channel, data in pose(replace(estimate(0.0), utime=now + 10_000 * n))
    ]
    path = write_log(tmp_path / "late.lcm", events)
    code, out, _ = run("query", SCAN, BASE, "--log", path, "--at", now + S // 10, "--policy", "held", "--json")
    assert code == 0
    assert output(out).is_close(truth(SCAN, BASE, 0.0), 1e-9, 1e-9)


def test_given_a_mistyped_frame_then_the_nearest_is_reported(run: Command, log: Path) -> None:
    code, _, err = run("query", "Laser:Scna", UTM, "--log", log)
    assert code == 1
    assert "Laser:Scan" in err


def test_given_no_log_then_that_is_reported(run: Command, tmp_path: Path) -> None:
    (tmp_path / "empty.lcm").touch()
    for name in ("empty.lcm", "missing.lcm"):
        code, _, err = run("query", SCAN, UTM, "--log", tmp_path / name)
        assert code == 1
        assert name in err
