"""Platform, PlatformMirror and a log, asked the same of the running daemon."""

from __future__ import annotations

import json
import math
import subprocess
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import lcm
import numpy as np
import pytest
from conftest import Daemon, daemon_at
from support_lcm import MODELSERVER, TIMEOUT_S, reserved_url, wait_until
from support_samples import GEOMETRY, VEHICLE, gps, imu

import modelserver as ms
from modelserver.client.remote import PlatformClient
from modelserver.messages import JointSample, JointsSample, Quality, SensorHeader
from modelserver.wire.codec import encode

NODDING = GEOMETRY.replace(
    "xyz: [0, 0, 0.1]}", "xyz: [0, 0, 0.1], joint: {type: revolute, axis: [0, 1, 0], sigma_deg: 0.1}}"
)
VOCAL = VEHICLE + "publish: {mode: event, health_hz: 20, snapshot_s: 0.5}\n"
SECONDS = 8.0
CAMERA, BASE, UTM, ENU, ODOM = "Camera:Origin", "Cart:Base", "World:UTM", "World:ENU", "Odom:Origin"
PAIRS = [(BASE, UTM), (CAMERA, UTM), (UTM, CAMERA), (CAMERA, ENU), (CAMERA, ODOM), (CAMERA, BASE), ("Cart:Imu", BASE)]


@dataclass
class Drive:
    """A daemon that has seen a drive, a mirror that listened, and a log of it."""

    platform: ms.Platform
    mirror: ms.PlatformMirror
    log: Path
    begin: int
    instants: list[int] = field(default_factory=list)
    """Times of samples."""


def publish_drive(daemon: Daemon, settle: Callable[[], None]) -> list[int]:
    """Publish a drive with a nodding camera that ends now, settling often; return the times of its IMU samples."""
    begin = time.time_ns() // 1000 - round(SECONDS * 1e6)
    times = [begin + n * 20_000 for n in range(round(SECONDS * 50))]
    with ms.Platform(daemon.url, name="feeder", timeout=TIMEOUT_S, retries=0) as platform:
        for n, utime in enumerate(times):
            t = n / 50
            nod = JointSample("Mounted", 0.3 * math.sin(2.0 * t), 0.001, 0.6 * math.cos(2.0 * t), 0.002)
            daemon.publish("JOINTS", encode(JointsSample(SensorHeader(utime, "arm", n), (nod,))))
            daemon.publish("IMU", encode(imu(utime)))
            if n % 5 == 0:
                daemon.publish("GPS", encode(gps(utime, 2.0 * t)))
                platform.get_transformation(CAMERA, BASE, at=utime, wait_ms=2000)
                settle()
        platform.get_transformation(CAMERA, UTM, at=times[-1], wait_ms=2000)
    settle()
    return times


class Recorder:
    """Writes all messages into a log, like lcm-logger, which loses some while it waits for the processor."""

    def __init__(self, url: str, path: Path):
        self._log = log = lcm.EventLog(str(path), "w", overwrite=True)
        self._bus = lcm.LCM(url)
        self._last = last = dict[str, bytes]()

        # not self: a handler that refers to its bus keeps it open
        def write(channel: str, data: bytes) -> None:
            last[channel] = data
            log.write_event(time.time_ns() // 1000, channel, data)

        self._bus.subscribe(".*", write).set_queue_capacity(0)

    def settle(self) -> None:
        """Write all that was published before; called often, since its buffer is small."""
        mark = b"%d" % time.monotonic_ns()
        self._bus.publish("MARK", mark)
        assert wait_until(self._bus, lambda: self._last.get("MARK") == mark)

    def finish(self) -> None:
        """Write all that was published, the model too, and close the log."""
        self.settle()
        assert wait_until(self._bus, lambda: "JOINTS_HELD" in self._last)
        self._log.close()


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Drive]:
    folder = tmp_path_factory.mktemp("mirror")
    log = folder / "drive.lcm"
    with (
        reserved_url() as url,
        daemon_at(url, folder, VOCAL, NODDING) as daemon,
        ms.PlatformMirror(url, limit=600.0) as mirror,
    ):
        mirror.wait(TIMEOUT_S, pose=False)
        recorder = Recorder(url, log)
        times = publish_drive(daemon, recorder.settle)
        mirror.get_transformation(CAMERA, UTM, at=times[-1], wait_ms=10_000)
        recorder.finish()
        yield Drive(daemon.platform(), mirror, log, times[0], times[260::40])


def assert_same(mine: object, theirs: object, rtol: float = 1e-6, atol: float = 1e-12) -> None:
    """Compare covariances, None where a part states none."""
    assert (mine is None) == (theirs is None)
    if theirs is not None:
        np.testing.assert_allclose(mine, theirs, rtol=rtol, atol=atol)


@pytest.mark.parametrize(("interest", "reference"), PAIRS)
def test_given_held_times_then_platform_and_mirror_agree(drive: Drive, interest: str, reference: str) -> None:
    for at in drive.instants:
        theirs, mine = (each.get_pose(interest, reference, at=at) for each in (drive.platform, drive.mirror))
        there, here = theirs.transformation, mine.transformation
        # the service works World:ENU out by itself, the mirror from World:UTM
        near = 1e-5 if ENU in (interest, reference) else 1e-9
        assert here.pose.is_close(there.pose, near, near)
        assert_same(here.covariance, there.covariance, rtol=near * 1e3, atol=near * 1e-3)
        assert (here.utime, here.is_valid, here.pose_epoch) == (there.utime, there.is_valid, there.pose_epoch)
        assert (here.origin_id, here.model_revision) == (there.origin_id, there.model_revision)
        assert (mine.origin, mine.quality) == (theirs.origin, theirs.quality)
    assert there.is_valid, ms.Invalid(there.invalid_reasons).explain()


def test_given_a_demand_then_platform_and_mirror_agree(drive: Drive) -> None:
    at = drive.instants[-1]
    for pair, horizontal, expected in (
        ((BASE, UTM), 1e-3, ms.Unmet.HORIZONTAL),
        ((CAMERA, UTM), 0.1, ms.Unmet.HORIZONTAL),
        ((CAMERA, UTM), 50.0, ms.Unmet(0)),
        (("Cart:Imu", BASE), 1e-6, ms.Unmet.HORIZONTAL),
    ):
        for client in (drive.platform, drive.mirror):
            assert client.get_pose(*pair, at=at).unmet == 0
            answer = client.get_pose(*pair, at=at, max_horizontal=horizontal)
            assert answer.unmet is expected
            assert bool(answer.unmet_reason) is bool(expected)
    levels = [client.get_pose(BASE, UTM, at=at) for client in (drive.platform, drive.mirror)]
    assert levels[0].horizontal_level > levels[0].horizontal_allowance >= 0.0
    assert levels[1].horizontal_level == pytest.approx(levels[0].horizontal_level)


def test_given_other_questions_then_platform_and_mirror_agree(drive: Drive) -> None:
    platform, mirror, at = drive.platform, drive.mirror, drive.instants[-1]
    assert mirror.get_body_list() == platform.get_body_list()
    assert mirror.get_body_frame_list("Cart") == platform.get_body_frame_list("Cart")
    for ask in (
        lambda p: [p.get_state_vector(at=at), p.get_h_transform(inverse=True, at=at)],
        lambda p: p.get_history(at - 2_000_000, at, 5.0),
        lambda p: [p.get_transformation(CAMERA, UTM, at=at + 7)],
        lambda p: [p.get_transformation(CAMERA, BASE)],
    ):
        for here, there in zip(ask(mirror), ask(platform), strict=True):
            assert here.pose.is_close(there.pose, 1e-9, 1e-9)
            assert (here.utime, here.frame_of_interest) == (there.utime, there.frame_of_interest)
    times = np.arange(at - 1_000_000, at, 13_000)
    (mine,), (theirs,) = (
        p.get_transformations([(BASE, BASE)], times, fixed_frame=ODOM, reference_at=at) for p in (mirror, platform)
    )
    np.testing.assert_allclose(mine.vectors, theirs.vectors, atol=1e-9)
    # without LOCALIZATION_STATE the mirror assumes the faster growth of drift, unlike the server
    assert mine.covariances is not None
    assert theirs.covariances is not None
    assert (mine.covariances[:, ::7] > theirs.covariances[:, ::7] - 1e-12).all()
    here, there = (p.get_motion(BASE, UTM, at=at, expressed_in=BASE) for p in (mirror, platform))
    assert here.covariance is not None
    assert np.hypot(*np.subtract(here.velocity, there.velocity)[:2]) < 3.0 * math.sqrt(here.covariance[0])
    nodding, nods = (p.get_motion(CAMERA, BASE, at=at) for p in (mirror, platform))
    np.testing.assert_allclose(nodding.angular_velocity, nods.angular_velocity, atol=1e-9)
    reports, edges = (p.explain(CAMERA, UTM, at=at).edges for p in (mirror, platform))
    assert [(a.kind, a.name, a.provenance) for a in reports] == [(b.kind, b.name, b.provenance) for b in edges]


@pytest.mark.parametrize(
    "ask",
    [
        lambda p: p.get_transformation("Camrea:Origin", BASE),
        lambda p: p.get_transformation(CAMERA, "World:UTN"),
        lambda p: p.get_transformation(CAMERA, UTM, at=1),
        lambda p: p.get_transformation(CAMERA, BASE, at=1),
        lambda p: p.get_transformation(BASE, UTM, at=1 << 60),
        lambda p: p.get_body_frame_list("Crat"),
        lambda p: p.get_history(2, 1, 1.0),
    ],
)
def test_given_a_question_without_an_answer_then_both_raise_the_same(
    drive: Drive, ask: Callable[[PlatformClient], object]
) -> None:
    raised = []
    for client in (drive.platform, drive.mirror):
        with pytest.raises(ms.QueryError) as caught:
            ask(client)
        raised.append((caught.type, caught.value.nearest))
    assert raised[0] == raised[1]


@pytest.mark.parametrize(("interest", "reference"), [(BASE, UTM), (CAMERA, UTM), (CAMERA, BASE)])
def test_given_a_log_of_it_then_query_reports_what_the_daemon_did(drive: Drive, interest: str, reference: str) -> None:
    at = drive.instants[2]
    done = subprocess.run(
        [*MODELSERVER, "query", interest, reference, "--log", drive.log, "--at", str(at), "--json"],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert (done.returncode, done.stderr) == (0, "")
    output = json.loads(done.stdout)
    answer = drive.platform.get_pose(interest, reference, at=at)
    there = answer.transformation
    np.testing.assert_allclose(output["position"], there.position, atol=1e-9)
    np.testing.assert_allclose(output["quaternion"], there.quaternion, atol=1e-9)
    assert_same(output["covariance"], there.covariance)
    assert (output["utime"], output["valid"], output["pose_epoch"]) == (at, there.is_valid, there.pose_epoch)
    assert output["model_revision"] == there.model_revision
    assert output["flags"] == [flag.name for flag in Quality if flag in answer.quality]


# --- a mirror by itself -------------------------------------------------------------------------------------


def test_given_a_clock_that_runs_on_then_the_mirror_refuses_and_knows_again(
    start_daemon: Callable[..., Daemon],
) -> None:
    daemon = start_daemon(VOCAL)
    now = [time.monotonic_ns() // 1000]
    with ms.PlatformMirror(daemon.url, limit=5.0, clock=lambda: now[0]) as mirror:
        mirror.wait(TIMEOUT_S, pose=False)
        assert mirror.age.geometry == 0.0
        assert math.isinf(mirror.age.pose)
        assert mirror.get_transformation("Camera:Origin", "Cart:Base").is_valid
        assert mirror.get_transformation("Camera:Origin", "Cart:Base") is mirror.get_transformation(
            "Camera:Origin", "Cart:Base"
        )
        daemon.end()
        now[0] += 6_000_000

        def ask_on() -> None:
            # what does not move goes when the listening thread looks at the clock
            while True:
                mirror.get_transformation("Camera:Origin", "Cart:Base", wait_ms=1)

        with pytest.raises(ms.OutOfDateError, match=r"confirmed \d+\.0 s ago, and the limit is 5 s"):
            ask_on()
        with pytest.raises(ms.OutOfDateError):
            mirror.wait(0.01)
    with pytest.raises(ValueError, match="closed"):
        mirror.get_transformation("Camera:Origin", "Cart:Base")


def test_given_nobody_then_the_mirror_reports_what_is_missing_and_closes(lcm_url: str) -> None:
    with (
        ms.PlatformMirror(lcm_url) as mirror,
        pytest.raises(ms.NoServerError, match=rf"no complete MODEL_SNAPSHOT.*{lcm_url[:20]}"),
    ):
        mirror.wait(0.01)
    with pytest.raises(ValueError, match="limit"):
        ms.PlatformMirror(lcm_url, limit=0.0)


def test_given_a_mirror_that_is_forgotten_then_its_thread_ends(lcm_url: str) -> None:
    mirror = ms.PlatformMirror(lcm_url)
    thread = mirror._thread
    del mirror
    thread.join(TIMEOUT_S)
    assert not thread.is_alive()
