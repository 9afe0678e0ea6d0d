"""The daemon as a process of its own: moving joints, reloaded geometry, a pose that is set."""

from __future__ import annotations

import json
import math
import re
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from conftest import FAST_HEALTH, Daemon
from support_lcm import MODELSERVER, Listener, invoke, wait_until
from support_samples import GEOMETRY, write_vehicle

import modelserver as ms
from modelserver.formats.yaml_geometry import decode_snapshot
from modelserver.geometry import Sigma
from modelserver.messages import Invalid, JointSample, JointsSample, Quality, SensorHeader
from modelserver.transforms import Pose, Transformation
from modelserver.wire.codec import SnapshotAssembler, decode, encode

DOCUMENT = Path(__file__).resolve().parents[2] / "docs" / "moving-geometry.md"
StartDaemon = Callable[..., Daemon]
HIGHER_CAMERA = GEOMETRY.replace("xyz: [0, 0, 0.1]", "xyz: [0, 0, 0.2]")
NODDING = GEOMETRY.replace(
    "xyz: [0, 0, 0.1]}",
    "xyz: [0, 0, 0.1], joint: {type: revolute, axis: [0, 1, 0], limits_deg: [-30, 20], sigma_deg: 0.1}}",
)


def receive_model(daemon: Daemon, revision: str) -> ms.Model:
    """Return the geometry that the daemon broadcasts under a revision."""
    listener, assembler = Listener(daemon.url, "MODEL_SNAPSHOT"), SnapshotAssembler()
    found: list[ms.Model] = []

    def is_received() -> bool:
        for data in listener.received:
            content = assembler.add(decode("model_snapshot_t", data))
            if content is not None:
                found.append(decode_snapshot(content).model)
        listener.received.clear()
        return any(model.revision == revision for model in found)

    assert wait_until(listener.bus, is_received)
    return found[-1]


def is_count(key: tuple[str, str], number: int) -> Callable[[dict[tuple[str, str], int]], bool]:
    return lambda found: found.get(key) == number


def wait_for_log(daemon: Daemon, words: str) -> str:
    """Wait until the daemon's log contains a text; return the log."""
    assert wait_until(daemon.listener.bus, lambda: words in daemon.log), daemon.log
    return daemon.log


def run_tool(daemon: Daemon, *arguments: str) -> tuple[int, str, str]:
    done = invoke("", *arguments, "--url", daemon.url)
    assert "Traceback" not in done.stderr
    return done.returncode, done.stdout, done.stderr


# --- reload ---------------------------------------------------------------------------------------------------------


def test_given_hangup_then_a_good_file_counts_at_once_and_a_bad_one_changes_nothing(
    start_daemon: StartDaemon, tmp_path: Path
) -> None:
    daemon = start_daemon(FAST_HEALTH.replace("rate_hz: 50", "rate_hz: 50, snapshot_s: 0.5"))
    platform = daemon.platform()
    old = daemon.health().model_revision
    geometry = tmp_path / "geometry.yaml"
    geometry.write_text(HIGHER_CAMERA)
    daemon.process.send_signal(signal.SIGHUP)
    new = daemon.health(lambda health: health.model_revision != old).model_revision
    assert platform.get_transformation("Camera:Origin", "Cart:Base").position[2] == pytest.approx(1.2)
    assert platform.get_transformation("Camera:Origin", "Cart:Base").model_revision == new
    model = receive_model(daemon, new)
    assert model.get_transformation("Camera:Origin", "Cart:Base").position[2] == pytest.approx(1.2)
    wait_for_log(daemon, f"the geometry was changed: revision {new}, before {old}")

    # mistyped; half written; without the base frame; with a frame less that a sensor stands at; gone
    for number, (text, why) in enumerate(
        (
            (HIGHER_CAMERA.replace("to: Camera", "to: Camrea"), "Camrea"),
            (HIGHER_CAMERA.partition("0.5, 0.1")[0], "geometry.yaml:"),
            (HIGHER_CAMERA.replace("Base:", "Bsae:"), "base_frame"),
            (HIGHER_CAMERA.replace("Antenna:", "Aerial:"), "sensors.gps.frame"),
            (None, "cannot be read"),
        ),
        1,
    ):
        geometry.unlink() if text is None else geometry.write_text(text)
        daemon.process.send_signal(signal.SIGHUP)
        key = ("PLATFORM_RELOAD_MODEL", "rejected")
        daemon.wait_for_rejections(is_count(key, number))
        assert daemon.health().model_revision == new
        assert platform.get_body_list() == ["Cart", "Camera"]
        assert why in wait_for_log(daemon, why).rpartition(f"revision {new} stays in use")[2]
    assert daemon.log.count(f"could not be changed, revision {new} stays in use: ") == 5
    assert daemon.health().handler_errors == 0


def test_given_a_large_file_then_poses_and_old_answers_come_until_it_is_whole(
    start_daemon: StartDaemon, tmp_path: Path
) -> None:
    daemon = start_daemon()
    platform = daemon.platform()
    old = daemon.health().model_revision
    extra = "".join(f"      Point{n}: {{xyz: [{n % 10}, 0, 0.1]}}\n" for n in range(2000))
    (tmp_path / "geometry.yaml").write_text(HIGHER_CAMERA.replace("    frames:\n", f"    frames:\n{extra}", 1))
    with platform.subscribe_pose() as poses:
        daemon.process.send_signal(signal.SIGHUP)
        revisions = [next(poses).transformation.model_revision for _ in range(10)]
        # reading takes a fifth of a second at least: a process has to start
        assert set(revisions) == {old}
        assert platform.get_transformation("Camera:Origin", "Cart:Base").model_revision == old
        new = daemon.health(lambda health: health.model_revision != old).model_revision
        found = platform.get_transformation("Cart:Point7", "Cart:Base")
    assert (found.model_revision, found.position[0]) == (new, 7.0)


def test_given_no_permission_then_neither_reload_nor_a_pose_is_taken_and_the_setting_is_named(daemon: Daemon) -> None:
    platform = daemon.platform()
    revision = daemon.health().model_revision
    with pytest.raises(ms.ForbiddenError, match=r"commands: \{reload: true\}"):
        platform.reload_model()
    with pytest.raises(ms.ForbiddenError, match=r"commands: \{frames: true\}"):
        platform.add_frame("Camera:Marker", Pose())
    here = Transformation("Cart:Base", "World:UTM", Pose())
    for setting in (platform.set_state_vector, platform.set_h_transform):
        with pytest.raises(ms.ForbiddenError, match=r"commands: \{set_pose: true\}"):
            setting(here)
    code, out, err = run_tool(daemon, "reload")
    assert (code, out) == (1, "")
    assert "kill -HUP" in err
    assert "commands: {reload: true}" in err
    assert daemon.health().model_revision == revision


def test_given_permission_then_reload_is_tried_dry_done_and_refused(start_signed: StartDaemon, tmp_path: Path) -> None:
    daemon = start_signed()
    platform = daemon.platform()
    old = daemon.health().model_revision
    write_vehicle(tmp_path, (tmp_path / "vehicle.yaml").read_text(), HIGHER_CAMERA)
    dry = platform.reload_model(dry_run=True)
    assert dry.changes == ("constraint Mounted moves by 100 mm and 0 deg",)
    assert dry.revision != dry.header.model_revision == old
    assert platform.get_transformation("Camera:Origin", "Cart:Base").position[2] == pytest.approx(1.1)
    code, out, _ = run_tool(daemon, "reload", "--dry-run")
    assert code == 0
    assert out.splitlines()[1:] == ["  constraint Mounted moves by 100 mm and 0 deg"]

    code, out, _ = run_tool(daemon, "reload")
    assert code == 0
    assert f"the geometry in force is now revision {dry.revision}" in out
    assert platform.get_transformation("Camera:Origin", "Cart:Base").position[2] == pytest.approx(1.2)
    assert platform.reload_model().changes == ()

    (tmp_path / "geometry.yaml").write_text(HIGHER_CAMERA.replace("to: Camera", "to: Camrea"))
    with pytest.raises(ms.RejectedError, match="Camrea"):
        platform.reload_model()
    code, out, err = run_tool(daemon, "reload")
    assert (code, out) == (1, "")
    assert "Camrea" in err
    assert "the geometry in force stays" in err
    assert platform.get_transformation("Camera:Origin", "Cart:Base").model_revision == dry.revision


def test_given_permission_then_a_program_adds_frames_which_a_restart_and_a_reload_keep_as_asked(
    start_signed: StartDaemon, tmp_path: Path
) -> None:
    daemon = start_signed()
    daemon.feed()
    platform = daemon.platform()
    with ms.PlatformMirror(daemon.url) as mirror:
        mirror.wait(10.0)
        platform.add_frame("Camera:Gone", Pose((0.0, 0.0, 0.1)))
        added = platform.add_frame("Camera:Marker", Pose((0.0, 0.0, 0.5)), Sigma((0.1, 0.1, 0.1)), is_permanent=True)
        assert added.changes == ("frame Camera:Marker is new",)
        found = platform.get_transformation("Camera:Marker", "Cart:Base")
        assert (found.position[2], found.model_revision) == (pytest.approx(1.6), added.revision)
        assert platform.get_body_frame_list("Camera") == ["Origin", "Gone", "Marker"]
        receive_model(daemon, added.revision)
        assert mirror.wait_for(lambda: "Marker" in mirror.get_body_frame_list("Camera"), 10.0)
        assert mirror.get_transformation("Camera:Marker", "Camera:Origin").covariance is not None
    with pytest.raises(ms.RejectedError, match="the geometry file has a frame 'Cart:Base'"):
        platform.add_frame("Cart:Base", Pose())
    write_vehicle(tmp_path, (tmp_path / "vehicle.yaml").read_text(), HIGHER_CAMERA)
    platform.reload_model()
    assert platform.get_transformation("Camera:Marker", "Cart:Base").position[2] == pytest.approx(1.7)
    daemon.process.terminate()
    assert daemon.process.wait(20) == 0
    daemon = start_signed(geometry=HIGHER_CAMERA)
    platform = daemon.platform()
    assert platform.get_transformation("Camera:Marker", "Cart:Base").position[2] == pytest.approx(1.7)
    with pytest.raises(ms.UnknownFrameError, match="Gone"):
        platform.get_transformation("Camera:Gone", "Cart:Base")
    platform.remove_frame("Camera:Marker")
    assert platform.get_body_frame_list("Camera") == ["Origin"]
    assert daemon.health().handler_errors == 0


# --- setting the pose -----------------------------------------------------------------------------------------------


def test_given_permission_then_a_pose_is_taken_and_one_that_cannot_be_is_rejected(start_signed: StartDaemon) -> None:
    daemon = start_signed()
    at = daemon.feed()
    platform = daemon.platform()
    here = platform.get_state_vector(at=at)
    sure = np.diag([0.01] * 3 + [1e-4] * 3)
    platform.set_state_vector(Transformation("Cart:Base", "World:UTM", here.pose, sure, at, origin_id=here.origin_id))
    platform.set_h_transform(Transformation("Cart:Base", "World:UTM", here.pose, sure, at + 1000))
    for pose, why in (
        (Transformation("Camera:Origin", "World:UTM", here.pose), "Cart:Base"),
        (Transformation("Cart:Base", "World:UTM", here.pose, origin_id=here.origin_id + 1), "another origin"),
        (Transformation("Cart:Base", "World:UTM", here.pose, utime=at - 60_000_000), "stamp it with 0"),
        (Transformation("Cart:Base", "World:UTM", here.pose, utime=at + 3600_000_000), "clock"),
    ):
        with pytest.raises(ms.RejectedError, match=why):
            platform.set_state_vector(pose)
    assert platform.get_state_vector(at=at).pose.distance(here.pose)[0] < 1.0
    assert daemon.wait_for_rejections(lambda found: ("sensor:operator", "out_of_sequence") in found)
    assert daemon.health().handler_errors == 0


# --- joints ---------------------------------------------------------------------------------------------------------


def nod(daemon: Daemon, utime: int, angle: float, name: str = "Mounted", rate: float = math.nan) -> None:
    joint = JointSample(name, angle, math.radians(0.1), rate, math.radians(0.5))
    daemon.publish("JOINTS", encode(JointsSample(SensorHeader(utime, "axis"), (joint,))))


def test_given_joints_then_the_nodding_frame_moves_and_an_unknown_name_is_counted_with_the_nearest(
    start_daemon: StartDaemon,
) -> None:
    daemon = start_daemon(FAST_HEALTH.replace("rate_hz: 50", "rate_hz: 50, snapshot_s: 0.5"), geometry=NODDING)
    platform = daemon.platform()
    rest = platform.get_pose("Camera:Origin", "Cart:Base")
    assert rest.quality & Quality.JOINT_DEFAULT
    assert rest.transformation.invalid_reasons & Invalid.JOINT_UNKNOWN

    # stamps in the future are rejected
    begin = time.time_ns() // 1000 - 300_000
    for n in range(11):
        nod(daemon, begin + n * 20_000, 0.02 * n, rate=1.0)
    last = begin + 200_000
    daemon.health(lambda health: sum(each.count for each in health.channels) == 11)
    answer = platform.get_pose("Camera:Origin", "Cart:Base", at=last, wait_ms=2000)
    assert answer.transformation.is_valid
    assert answer.transformation.rpy[1] == pytest.approx(0.2)
    between = platform.get_pose("Camera:Origin", "Cart:Base", at=begin + 30_000)
    assert between.transformation.rpy[1] == pytest.approx(0.03)
    assert between.quality & Quality.INTERPOLATED
    with pytest.raises(ms.TooNewError, match="Mounted"):
        platform.get_transformation("Camera:Origin", "Cart:Base", at=last + 10_000_000)
    motion = platform.get_motion("Camera:Origin", "Cart:Base", at=last)
    assert motion.angular_velocity == pytest.approx((0.0, 1.0, 0.0))

    nod(daemon, last + 20_000, 0.1, name="Monted")
    found = daemon.wait_for_rejections(lambda found: any(name == "sensor:axis" for name, _ in found))
    assert found == {("sensor:axis", "unknown joint 'Monted'; nearest Mounted"): 1}

    pair = ("Camera:Origin", "Cart:Base", "--at", str(last))
    code, out, err = run_tool(daemon, "query", *pair, "--explain")
    assert (code, err) == (0, "")
    row = next(line for line in out.splitlines() if line.split()[:2] == ["joint", "Mounted"])
    for part in ("measured", "axis", "11.459 deg"):
        assert part in row
    code, out, _ = run_tool(daemon, "query", *pair, "--motion", "--json")
    assert code == 0
    assert json.loads(out)["angular_velocity"] == pytest.approx([0.0, 1.0, 0.0])
    code, out, _ = run_tool(daemon, "tree", "--live")
    assert code == 0
    assert re.search(r"└─ Camera  \(Mounted: revolute, -30 to 20 deg, \d+\.\d\d s ago by axis\)", out)
    assert daemon.end() == 0


def test_given_query_watch_then_it_answers_until_it_is_interrupted(start_daemon: StartDaemon) -> None:
    daemon = start_daemon(FAST_HEALTH)
    arguments = ("query", "Camera", "Cart:Base", "--watch", "100", "--json", "--url", daemon.url)
    with subprocess.Popen([*MODELSERVER, *arguments], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        answers = [json.loads(process.stdout.readline()) for _ in range(5)]
        process.send_signal(signal.SIGINT)
        assert process.wait(30.0) == 0
    assert {(each["frame_of_interest"], each["valid"]) for each in answers} == {("Camera:Origin", True)}
    code, _, err = run_tool(daemon, "query", "Camera", "map", "--watch", "1", "--at", "1")
    assert code == 2
    assert "--watch" in err
    assert daemon.end() == 0


def test_the_examples_in_the_documentation_do_what_they_report(start_signed: StartDaemon) -> None:
    text = DOCUMENT.read_text(encoding="utf-8")
    geometry, allowed = (block.split("```")[0] for block in text.split("```yaml\n")[1:])
    daemon = start_signed(FAST_HEALTH + allowed, geometry=geometry)
    utime = daemon.feed()
    for n in range(121):
        nod(daemon, utime - 1_200_000 + n * 10_000, 0.01 * n - 0.9, name="Nod", rate=1.0)
    daemon.health(lambda health: any(each.channel == "sensor:axis" and each.count == 121 for each in health.channels))
    known = {"ms": ms, "platform": daemon.platform(), "utime": utime}
    blocks = [block.split("```")[0] for block in text.split("```python\n")[1:]]
    assert len(blocks) == 8
    for block in blocks:
        exec(block, known)
    assert known["T"].rpy[1] == pytest.approx(0.27)
    assert known["later"].rpy[1] == pytest.approx(0.32)
    assert known["worst"].kind == "frame"
    assert daemon.health().handler_errors == 0
