"""`modelserver set-pose` against the real daemon: fused, rejected by a gate, set outright, denied."""

from __future__ import annotations

import math
import re
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import lcm
import pytest
from conftest import FAST_HEALTH, Daemon
from support_samples import GEODESY, ORIGIN, drive, imu
from support_signing import ALLOWED

from modelserver.messages import GpsSample
from modelserver.wire.codec import encode
from mstools.cli import main
from mstools.commands.control import SetPoseListener

Run = Callable[..., tuple[int, str, str]]
KNOWN_ORIGIN = (
    f"origin: {{initial_utm: [{ORIGIN.easting}, {ORIGIN.northing}, {ORIGIN.height}], zone: {ORIGIN.zone}, "
    f"hemisphere: {'north' if ORIGIN.north else 'south'}}}\n"
)


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """Run the command; return its exit code, standard output and error."""

    def set_pose(daemon: Daemon, *arguments: object) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as end:
            main(["set-pose", *map(str, arguments), "--url", daemon.url, "--timeout", "20"])
        out, err = capsys.readouterr()
        return int(end.value.code or 0), out, err

    return set_pose


@contextmanager
def feeding(daemon: Daemon, only_imu: bool = False) -> Iterator[None]:
    """Publish samples in real time until the block ends: the drive east, or an inertial unit alone."""
    ended, known = threading.Event(), threading.Event()

    def publish() -> None:
        bus = lcm.LCM(daemon.url)
        begin = time.time_ns() // 1000 - 10_000_000
        samples = iter(drive(600.0, begin)) if not only_imu else (imu(begin + n * 20_000) for n in range(30_000))
        for sample in samples:
            ahead = sample.header.utime * 1e-6 - time.time()
            if ahead > 0.0:
                known.set()
                if ended.wait(ahead):
                    return
            bus.publish("GPS" if isinstance(sample, GpsSample) else "IMU", encode(sample))

    feeder = threading.Thread(target=publish)
    feeder.start()
    try:
        assert known.wait(60.0)
        yield
    finally:
        ended.set()
        feeder.join()


def test_given_a_pose_near_the_estimate_then_it_is_used_and_one_far_off_is_rejected(
    start_signed: Callable[..., Daemon], run: Run
) -> None:
    daemon = start_signed()
    with feeding(daemon):
        platform = daemon.platform()
        daemon.health(lambda health: health.invalid_reasons == 0)
        here = platform.get_state_vector()
        x, y, z = here.position
        # driving on at 2 m/s meanwhile, which 10 m allows for
        code, out, err = run(daemon, "--xyz", x, y, z, "--yaw", math.degrees(here.rpy[2]), "--sigma", 10)
        assert (code, err) == (0, "")
        assert f"Cart:Base in World:UTM: position ({x:.3f}, {y:.3f}, {z:.3f}) m" in out
        statistic, limit = map(float, re.findall(r"decision: used \(chi-square ([\d.]+) of ([\d.]+) allowed", out)[0])
        assert statistic < limit
        assert re.search("^now: .*; valid$", out, re.MULTILINE)

        code, out, err = run(daemon, "--xyz", x + 500, y, z, "--yaw", 0, "--sigma", 0.05)
        assert code == 1
        assert "decision: rejected" in out
        assert "localization rejected the pose" in err
        assert abs(platform.get_state_vector().position[0] - x) < 250.0


def test_given_no_heading_yet_then_latitude_longitude_and_heading_set_the_pose_outright(
    start_signed: Callable[..., Daemon], run: Run
) -> None:
    daemon = start_signed(FAST_HEALTH + ALLOWED + KNOWN_ORIGIN)
    latitude, longitude, height = GEODESY.geodetic_from_enu((300.0, 200.0, 5.0))
    listener = SetPoseListener(lcm.LCM(daemon.url), "")
    for each in listener.subscriptions:
        each.set_queue_capacity(0)
    with feeding(daemon, only_imu=True):
        code, out, err = run(
            daemon, "--latlon", latitude, longitude, "--height", height, "--heading", 60, "--sigma", 0.05
        )
        assert (code, err) == (0, "")
        assert listener.listen(20.0, lambda: bool(listener.decisions))
        set_then = daemon.platform().get_state_vector(at=min(listener.decisions) + 40_000)
    assert "decision: set: position and heading were set" in out
    wanted = GEODESY.to_relative_utm(GEODESY.utm_from_geodetic(latitude, longitude, height))
    x, y, z = wanted
    assert f"position ({x:.3f}, {y:.3f}, {z:.3f}) m" in out
    assert set_then.position == pytest.approx(wanted, abs=0.5)
    yaw = math.pi / 2 - math.radians(60) + GEODESY.convergence(latitude, longitude)
    assert set_then.rpy[2] == pytest.approx(yaw, abs=math.radians(2.0))


def test_given_no_permission_then_the_setting_is_named_and_nothing_is_set(daemon: Daemon, run: Run) -> None:
    code, out, err = run(daemon, "--xyz", 0, 0, 0, "--yaw", 0)
    assert (code, out) == (1, "")
    assert "the pose was not set: the vehicle file does not permit it" in err
    assert "commands: {set_pose: true}" in err
    assert "key_file" in err


def test_given_no_key_or_no_origin_then_the_error_reports_what_to_do(
    start_signed: Callable[..., Daemon], run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    daemon = start_signed()
    code, out, err = run(daemon, "--xyz", 0, 0, 0, "--yaw", 0)
    assert (code, out) == (1, "")
    assert "the origin of World:UTM is not known yet" in err
    assert "initial_utm" in err
    daemon.feed()
    monkeypatch.delenv("MODELSERVER_KEY_FILE")
    code, out, err = run(daemon, "--xyz", 0, 0, 0, "--yaw", 0)
    assert (code, out) == (1, "")
    assert "the command is not signed" in err
    assert "--key FILE" in err
