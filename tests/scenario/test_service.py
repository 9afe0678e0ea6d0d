"""The daemon as a process of its own, asked and attacked over the real bus."""

from __future__ import annotations

import itertools
import math
import os
import random
import re
import signal
import statistics
import subprocess
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import lcm
import pytest
from conftest import FAST_HEALTH, Daemon
from support_lcm import MODELSERVER, TIMEOUT_S, Listener, wait_until
from support_samples import GEOMETRY, VEHICLE, gps, imu, write_vehicle

import modelserver as ms
from modelserver.client.remote import Platform
from modelserver.messages import (
    CHANNEL_OF,
    GetBodyFrameList,
    GetBodyList,
    GetDynamics,
    GetExplanation,
    GetHistory,
    GetHTransform,
    GetMotion,
    GetStateVector,
    GetTransformation,
    GetTransformations,
    Invalid,
    PoseAnswer,
    ReloadModel,
    RequestHeader,
    SetFrame,
    SetHTransform,
    SetStateVector,
    TimeQuery,
)
from modelserver.transforms import Pose, Transformation
from modelserver.wire.channels import REQUESTS
from modelserver.wire.codec import decode, encode
from modelserver.wire.provider import resolve_url

ME = RequestHeader(5, "REPLY_RAW")
THERE = PoseAnswer(Transformation("Cart:Base", "World:UTM", Pose()))
REQUEST_OF: dict[str, Any] = {
    CHANNEL_OF[type(each)]: each
    for each in (
        GetTransformation(ME, "Camera:Origin", "World:UTM"),
        GetBodyList(ME),
        GetBodyFrameList(ME, "Cart"),
        GetStateVector(ME),
        GetHTransform(ME),
        GetHistory(ME, 1, 2, 1.0),
        GetTransformations(ME, (("Camera:Origin", "Cart:Base"),), (1, 2)),
        GetMotion(ME, "Camera:Origin", "Cart:Base"),
        GetExplanation(ME, "Camera:Origin", "Cart:Base"),
        GetDynamics(ME),
        ReloadModel(ME),
        SetFrame(ME, "Camera:Marker"),
        SetStateVector(ME, THERE),
        SetHTransform(ME, THERE),
    )
}
StartDaemon = Callable[..., Daemon]


def answers_well(daemon: Daemon) -> bool:
    """Whether the next good request is answered."""
    return daemon.platform().get_body_list() == ["Cart", "Camera"]


# --- the client: every operation ----------------------------------------------------------------------------


def test_given_a_drive_then_every_operation_of_the_client_answers(daemon: Daemon) -> None:
    at = daemon.last_utime
    platform = daemon.platform()
    assert platform.get_body_list() == ["Cart", "Camera"]
    assert platform.get_body_frame_list("Cart") == ["Base", "Antenna", "Imu", "Mast"]
    static = platform.get_transformation("Camera:Origin", "Cart:Base")
    assert static.position.tolist() == pytest.approx([0.5, 0.1, 1.1])
    assert static.utime == 0

    pose = platform.get_transformation("Cart:Base", "World:UTM", at=at)
    assert pose.is_valid, Invalid(pose.invalid_reasons).explain()
    assert pose.utime == at
    assert pose.origin_id != 0
    assert pose.covariance is not None
    assert pose.rpy[2] == pytest.approx(0.0, abs=0.1)  # it drives east
    vector = platform.get_state_vector(at=at)
    matrix = platform.get_h_transform(at=at)
    inverse = platform.get_h_transform(inverse=True, at=at)
    for each in (vector, matrix, inverse.inverse()):
        assert each.pose.is_close(pose.pose, 1e-6, 1e-9)
        assert (each.frame_of_interest, each.frame_of_reference) == ("Cart:Base", "World:UTM")

    camera = platform.get_transformation("Camera:Origin", "World:UTM", at=at)
    assert camera.pose.is_close((pose @ static).pose, 1e-6, 1e-9)
    answer = platform.get_pose("Cart:Base", "World:UTM", at=at)
    assert answer.origin is not None
    assert answer.origin.zone == 12
    assert answer.horizontal_protection_level > 0

    poses = platform.get_history(at - 2_000_000, at, 10.0)
    assert [each.utime for each in poses] == [at - 2_000_000 + n * 100_000 for n in range(21)]
    steps = [math.dist(a.position, b.position) for a, b in itertools.pairwise(poses)]
    assert statistics.median(steps) == pytest.approx(0.2, abs=0.05)  # 2 m/s at 10 Hz


def test_given_policies_then_the_client_gets_what_each_accepts(daemon: Daemon) -> None:
    at, platform = daemon.last_utime, daemon.platform()
    assert platform.get_state_vector(at=at - 5).utime == at - 5
    assert platform.get_state_vector(at=at + 10**9, policy=ms.Policy.LATEST).utime == at
    assert platform.get_state_vector(at=at + 500_000, policy=ms.Policy.PREDICTED).utime == at + 500_000
    held = platform.get_state_vector(at=at + 10**9, policy=ms.Policy.HELD)
    assert Invalid.STALE_GPS & held.invalid_reasons
    with pytest.raises(ms.TooNewError):
        platform.get_state_vector(at=at + 6_000_000, policy=ms.Policy.PREDICTED)


@pytest.mark.parametrize(
    ("ask", "error", "near"),
    [
        (lambda p: p.get_transformation("Camrea:Origin", "Cart:Base"), ms.UnknownBodyError, "Camera:Origin"),
        (lambda p: p.get_transformation("Camera:Orign", "Cart:Base"), ms.UnknownFrameError, "Camera:Origin"),
        (lambda p: p.get_transformation("Cart:Base", "World:UTN"), ms.UnknownFrameError, "World:UTM"),
        (lambda p: p.get_transformation("", ""), ms.UnknownFrameError, ""),
        (lambda p: p.get_transformation("x" * 60_000, "Cart:Base"), ms.UnknownBodyError, ""),
        (lambda p: p.get_transformation("Cart:\x00\x1b[2J\n", "Cart:Base"), ms.UnknownFrameError, ""),
        (lambda p: p.get_body_frame_list("Crat"), ms.UnknownBodyError, "Cart"),
        (lambda p: p.get_state_vector(at=1), ms.TooOldError, ""),
        (lambda p: p.get_h_transform(at=(1 << 61) - 1), ms.TooNewError, ""),
        (lambda p: p.get_h_transform(at=-1), ms.MalformedRequestError, ""),
        (lambda p: p.get_state_vector(at=1, wait_ms=-1), ms.MalformedRequestError, ""),
        (lambda p: p.get_transformation("Cart:Base", "World:UTM", at=1 << 62), ms.MalformedRequestError, ""),
        (lambda p: p.get_transformation("Cart:Base", "World:UTM", policy=9), ms.MalformedRequestError, ""),
        (lambda p: p.get_transformation("Cart:Base", "World:UTM", at=1 << 70), ms.MalformedRequestError, ""),
        (lambda p: p.get_transformation("Cart:Base", "World:UTM", wait_ms=1 << 40), ms.MalformedRequestError, ""),
        (lambda p: p.get_transformation("\ud800", "World:UTM"), ms.MalformedRequestError, ""),
        (lambda p: p.get_transformation(None, "World:UTM"), ms.MalformedRequestError, ""),
        (lambda p: p.get_history(1, 2, math.nan), ms.MalformedRequestError, ""),
        (lambda p: p.get_history(2, 1, 1.0), ms.MalformedRequestError, ""),
        (lambda p: p.get_history(0, 10**9, 50.0), ms.LimitError, ""),
    ],
)
def test_given_a_question_without_answer_then_the_client_raises_what_the_server_meant(
    daemon: Daemon, ask: Callable[[Platform], object], error: type[Exception], near: str
) -> None:
    platform = daemon.platform()
    with pytest.raises(error) as caught:
        ask(platform)
    assert type(caught.value) is error
    assert near in ("", *caught.value.nearest)  # type: ignore[attr-defined]
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 500
    assert platform.get_body_list()


def test_given_no_pose_and_frames_not_joined_then_the_client_reports_it(start_daemon: StartDaemon) -> None:
    geometry = GEOMETRY.replace("constraints:", "  Lamp:\n    frames:\n      Origin:\nconstraints:")
    daemon = start_daemon(geometry=geometry)
    platform = daemon.platform()
    with pytest.raises(ms.NoPoseError, match="no usable GPS fix yet"):
        platform.get_transformation("Camera:Origin", "World:UTM")
    with pytest.raises(ms.NotConnectedError, match="no constraints lead from Lamp to Camera"):
        platform.get_transformation("Camera:Origin", "Lamp:Origin")
    assert "orphan" in daemon.log


def test_given_a_time_to_come_and_a_wait_then_the_reply_comes_with_the_sample(start_daemon: StartDaemon) -> None:
    daemon = start_daemon()
    at = daemon.feed() + 20_000
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(daemon.platform().get_state_vector, at=at, wait_ms=60_000)
        daemon.health(lambda health: health.requests_waiting == 1)
        daemon.publish("IMU", encode(imu(at)))
        assert waiting.result(TIMEOUT_S).utime == at
    assert daemon.health(lambda health: health.requests_waiting == 0)


# --- the client: no server, many clients --------------------------------------------------------------------


def test_given_nobody_answers_then_the_error_reports_url_channel_and_what_to_do(lcm_url: str) -> None:
    with Platform(lcm_url, timeout=0.05, retries=2, name="lonely") as platform:
        started = time.monotonic()
        with pytest.raises(ms.NoServerError) as caught:
            platform.get_body_list()
        assert 0.15 <= time.monotonic() - started < 5.0
    text = str(caught.value)
    for part in (lcm_url, "PLATFORM_GET_BODY_LIST", "REPLY_LONELY", "3 tries of 0.05 s", "modelserver run -c"):
        assert part in text
    assert isinstance(caught.value, TimeoutError)


def test_given_a_server_that_appears_late_then_a_retry_reaches_it(start_daemon: StartDaemon, lcm_url: str) -> None:
    with Platform(lcm_url, timeout=0.1, retries=600, name="early") as platform, ThreadPoolExecutor(1) as pool:
        asked = pool.submit(platform.get_body_list)
        start_daemon()
        assert asked.result(TIMEOUT_S) == ["Cart", "Camera"]


def test_given_another_instances_handler_then_the_client_may_be_used_in_it(daemon: Daemon) -> None:
    bus, platform, received = lcm.LCM(daemon.url), daemon.platform(), []

    def handle(channel: str, data: bytes) -> None:
        received.append(platform.get_transformation("Camera:Origin", "Cart:Base").position[2])

    bus.subscribe("TRIGGER", handle)
    for _ in range(3):
        daemon.publish("TRIGGER", b"")
    assert wait_until(bus, lambda: len(received) == 3)
    assert received == pytest.approx([1.1] * 3)


def test_given_threads_on_one_client_then_each_gets_its_own_answer(daemon: Daemon) -> None:
    platform = daemon.platform()

    def ask(frame: str) -> bool:
        return all(platform.get_transformation(frame, "Cart:Base").frame_of_interest == frame for _ in range(25))

    with ThreadPoolExecutor(8) as pool:
        frames = ["Cart:Base", "Cart:Antenna", "Cart:Imu", "Cart:Mast", "Camera:Origin"] * 2
        assert all(pool.map(ask, frames))


def test_given_clients_of_one_program_then_their_replies_do_not_mix(daemon: Daemon) -> None:
    def ask(frame: str) -> bool:
        with daemon.platform(name="same") as platform:
            assert platform.reply_channel == "REPLY_SAME"
            return all(platform.get_transformation(frame, "Cart:Base").frame_of_interest == frame for _ in range(25))

    with ThreadPoolExecutor(5) as pool:
        assert all(pool.map(ask, ["Cart:Base", "Cart:Antenna", "Cart:Imu", "Cart:Mast", "Camera:Origin"]))


def test_given_an_idle_client_then_replies_to_its_namesake_do_not_pile_up_nor_block_it(daemon: Daemon) -> None:
    idle, busy = daemon.platform(name="same"), daemon.platform(name="same")
    assert idle.get_body_list()
    for _ in range(200):
        busy.get_body_list()
    assert idle.get_body_frame_list("Camera") == ["Origin"]
    assert idle._receiver.receive() is None


def test_given_clients_that_are_dropped_or_closed_then_nothing_of_them_stays(lcm_url: str) -> None:
    def tasks() -> int:
        return len(os.listdir("/proc/self/task"))

    before = tasks()
    for n in range(10):
        platform = Platform(lcm_url, name="gone")
        if n % 2:
            platform.close()
            platform.close()
            with pytest.raises(ValueError, match="closed"):
                platform.get_body_list()
    del platform
    assert tasks() <= before + 1


@pytest.mark.parametrize("options", [{"timeout": 0}, {"timeout": -1}, {"timeout": math.nan}, {"retries": -1}])
def test_given_options_that_make_no_sense_then_the_client_is_not_made(lcm_url: str, options: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"timeout|retries"):
        Platform(lcm_url, **options)


@pytest.mark.parametrize(
    ("name", "channel"),
    [("a b/c.py", "REPLY_A_B_C_PY"), ("", "REPLY_"), ("éé", "REPLY_CLIENT"), ("x" * 200, "REPLY_" + "X" * 57)],
)
def test_given_any_program_name_then_the_reply_channel_is_plain_and_stable(
    lcm_url: str, name: str, channel: str
) -> None:
    made = {Platform(lcm_url, name=name).reply_channel for _ in range(2)}
    assert len(made) == 1
    assert made.pop().startswith(channel)


def test_given_another_prefix_then_nobody_answers_and_the_reply_channel_is_counted(daemon: Daemon) -> None:
    for options in ({"channel_prefix": "V2_"}, {"reply_prefix": "ANSWER_"}):
        with pytest.raises(ms.NoServerError):
            daemon.platform(timeout=0.05, **options).get_body_list()
    assert daemon.wait_for_rejections(lambda found: found.get(("PLATFORM_GET_BODY_LIST", "reply_channel"), 0) >= 1)


def test_given_a_vehicle_with_prefixes_then_clients_with_the_same_ones_are_served(start_daemon: StartDaemon) -> None:
    daemon = start_daemon(FAST_HEALTH + "lcm: {channel_prefix: V1_, reply_prefix: ANSWER_}\n", prefix="V1_")
    platform = daemon.platform(channel_prefix="V1_", reply_prefix="ANSWER_")
    assert platform.reply_channel == "ANSWER_TEST"
    assert platform.get_body_list() == ["Cart", "Camera"]
    with pytest.raises(ms.NoServerError):
        daemon.platform(timeout=0.05, reply_prefix="ANSWER_").get_body_list()


# --- life and death -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_given_a_signal_then_the_daemon_ends_at_once_with_0(start_daemon: StartDaemon, number: signal.Signals) -> None:
    daemon = start_daemon(VEHICLE + "publish: {rate_hz: 0.1}\n")
    started = time.monotonic()
    assert daemon.end(number) == 0
    assert time.monotonic() - started < 5.0
    assert "stopped" in daemon.log
    assert "Traceback" not in daemon.log


def test_given_a_restart_then_the_origin_is_retained_and_a_client_goes_on(start_daemon: StartDaemon) -> None:
    first = start_daemon()
    platform = first.platform()
    at = first.feed()
    before = platform.get_pose("Cart:Base", "World:UTM", at=at)
    assert first.end() == 0
    with pytest.raises(ms.NoServerError):
        Platform(first.url, timeout=0.05, retries=0, name="x").get_body_list()

    second = start_daemon()
    assert second.health().origin_id == before.transformation.origin_id
    with pytest.raises(ms.NoPoseError):
        platform.get_state_vector()
    at = second.feed()
    for client in (platform, second.platform()):
        after = client.get_pose("Cart:Base", "World:UTM", at=at)
        assert after.origin == before.origin
        assert after.transformation.origin_id == before.transformation.origin_id
    assert "using the persisted origin" in second.log


def test_given_a_damaged_retained_origin_then_the_daemon_starts_and_captures_again(
    start_daemon: StartDaemon, tmp_path: Path
) -> None:
    (tmp_path / "state").mkdir()
    (tmp_path / "state" / "origin-cart.json").write_text('{"version": 1, "easting": 1e7')
    daemon = start_daemon()
    daemon.feed()
    assert daemon.health(lambda health: health.origin_id != 0)
    assert "is damaged" in daemon.log


def test_given_broken_files_then_it_exits_1_with_every_problem_and_no_trace(tmp_path: Path, lcm_url: str) -> None:
    def run(vehicle: str, geometry: str = GEOMETRY, url: str = lcm_url) -> str:
        path = write_vehicle(tmp_path, vehicle, geometry)
        done = subprocess.run(
            [*MODELSERVER, "run", "-c", path, f"--url={url}"], capture_output=True, text=True, timeout=60
        )
        assert done.returncode == 1
        assert done.stdout == ""
        assert "Traceback" not in done.stderr
        return done.stderr

    text = run(VEHICLE.replace("base_frame", "base_fram") + "publish: {rate_hz: 0, modus: timer}\n")
    for part in ("'base_fram'", "write base_frame", "'modus'", "vehicle.yaml:"):
        assert part in text
    assert "is missing" not in text
    text = run(VEHICLE.replace("Cart:Antenna", "Cart:Antena").replace("Cart:Imu", "Cart:Imo"))
    assert "sensors.gps.frame" in text
    assert "sensors.imu.frame" in text
    assert "Cart:Antenna" in text
    assert "Camrea" in run(VEHICLE, GEOMETRY.replace("to: Camera", "to: Camrea"))
    assert "nowhere.yaml" in run(VEHICLE.replace("geometry.yaml", "nowhere.yaml"))
    assert "cannot join the bus" in run(VEHICLE, url="nonsense://")


def test_given_two_daemons_on_a_bus_then_a_client_takes_one_reply_to_each_question(
    start_daemon: StartDaemon, tmp_path: Path
) -> None:
    first, second = start_daemon(), start_daemon(folder=tmp_path / "second")
    first.feed()
    platform = first.platform()
    for frame in ["Cart:Base", "Cart:Antenna", "Cart:Imu", "Cart:Mast", "Camera:Origin"] * 10:
        assert platform.get_transformation(frame, "Cart:Base").frame_of_interest == frame
    assert second.end() == 0
    assert answers_well(first)


# --- broadcasts ---------------------------------------------------------------------------------------------


def are_of_fixed_deadlines(utimes: Sequence[int]) -> bool:
    """Return whether poses at 50 Hz have fixed deadlines.

    A late tick and the next may be close, but from one to the next but one is a period.
    """
    return all(b - a >= 19_000 for a, b in zip(utimes, utimes[2:], strict=False))


def test_given_timer_mode_then_poses_come_at_50_hz_on_three_channels(daemon: Daemon) -> None:
    names = ("POSE", "POSE_VECTOR", "POSE_ODOM")
    received: dict[str, list[PoseAnswer]] = {name: [] for name in names}
    arrivals: list[float] = []
    bus = lcm.LCM(daemon.url)

    def handle(channel: str, data: bytes) -> None:
        received[channel].append(decode("pose_vector_t" if channel == "POSE_VECTOR" else "pose_transform_t", data))
        if channel == "POSE":
            arrivals.append(time.monotonic())

    for name in names:
        bus.subscribe(name, handle)
    assert wait_until(bus, lambda: all(len(each) >= 50 for each in received.values()))
    utimes = [each.transformation.utime for each in received["POSE"]]
    assert are_of_fixed_deadlines(utimes)
    # on a busy machine ticks are left out or late, and the next is on time: more than 50 a second there never are
    steps = [b - a for a, b in itertools.pairwise(utimes)]
    assert statistics.mean(steps) >= 19_000
    assert statistics.quantiles(steps)[0] <= 22_000
    assert statistics.quantiles([b - a for a, b in itertools.pairwise(arrivals)])[0] <= 0.024
    vectors = {each.transformation.utime: each.transformation for each in received["POSE_VECTOR"]}
    odoms = {each.transformation.utime: each.transformation for each in received["POSE_ODOM"]}
    common = [
        each.transformation for each in received["POSE"] if each.transformation.utime in vectors.keys() & odoms.keys()
    ]
    assert len(common) >= 40
    for pose in common:
        assert vectors[pose.utime].pose.is_close(pose.pose, 1e-9, 1e-9)
        assert (pose.frame_of_interest, pose.frame_of_reference) == ("Cart:Base", "World:UTM")
        assert odoms[pose.utime].frame_of_reference == "Odom:Origin"


def test_given_event_mode_then_a_pose_comes_with_each_sample_and_its_stamp(start_daemon: StartDaemon) -> None:
    daemon = start_daemon(FAST_HEALTH.replace("rate_hz: 50", "mode: event"))
    at = daemon.feed()
    listener = Listener(daemon.url, "POSE")
    for n in range(1, 21):
        sample = imu(at + n * 5_000) if n % 4 else gps(at + n * 5_000, 10.0 + n * 0.01)
        daemon.publish("IMU" if n % 4 else "GPS", encode(sample))
        daemon.publish("IMU" if n % 4 else "GPS", encode(sample))  # the same once more is no event
    assert listener.wait(20)
    daemon.health()
    assert not listener.bus.handle_timeout(0)
    utimes = [decode("pose_transform_t", data).transformation.utime for data in listener.received]
    assert utimes == [at + n * 5_000 for n in range(1, 21)]


def test_given_a_daemon_that_was_stopped_then_missed_ticks_are_counted_and_no_poses_burst(
    start_daemon: StartDaemon,
) -> None:
    daemon = start_daemon()
    before = daemon.health()
    daemon.process.send_signal(signal.SIGSTOP)
    with pytest.raises(ms.NoServerError):
        # while it stands, time passes: 0.6 s are 30 ticks
        daemon.platform(timeout=0.6).get_body_list()
    listener = Listener(daemon.url, "POSE")
    reports = Listener(daemon.url, "MODELSERVER_HEALTH")
    continued = time.monotonic()
    daemon.process.send_signal(signal.SIGCONT)
    daemon.health(lambda health: health.ticks_missed >= before.ticks_missed + 25)
    # one report has the tick that was late, not always the first that is waited for, nor has it always arrived here
    while all(decode("health_t", data).tick_latency_max < 0.5 for data in reports.received):
        assert reports.bus.handle_timeout(5000), "no report has the tick that was late"
    while listener.bus.handle_timeout(0):
        pass
    utimes = [decode("pose_transform_t", data).transformation.utime for data in listener.received]
    assert len(utimes) <= 2 + (time.monotonic() - continued) / 0.02
    assert are_of_fixed_deadlines(utimes)
    assert answers_well(daemon)


# --- bad input ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("channel", [*(each.name for each in REQUESTS), "GPS", "IMU"])
def test_given_bytes_that_are_no_message_then_they_are_counted_and_the_next_request_is_answered(
    daemon: Daemon, channel: str
) -> None:
    rng = random.Random(6)
    value = REQUEST_OF.get(channel) or (gps(1) if channel == "GPS" else imu(1))
    good = encode(value)
    wrong = encode(gps(1)) if channel != "GPS" else encode(imu(1))
    before = daemon.wait_for_rejections(lambda found: True)
    bad = {
        "fingerprint": [b"", b"\0" * 7, rng.randbytes(100), rng.randbytes(60_000), wrong, b"\xff" * 300],
        "truncated": [good[: 8 + n * (len(good) - 8) // 8] for n in range(1, 8)],
        "malformed": [good + b"\0"],
    }
    for data in itertools.chain.from_iterable(bad.values()):
        daemon.publish(channel, data)
    want = {(channel, reason): before.get((channel, reason), 0) + len(data) for reason, data in bad.items()}
    found = daemon.wait_for_rejections(lambda found: all(found.get(key, 0) >= count for key, count in want.items()))
    assert {key: found[key] for key in want} == want
    assert answers_well(daemon)
    assert daemon.health().handler_errors == 0


def test_given_a_reply_channel_outside_the_rules_then_nothing_is_reported_on_it(daemon: Daemon) -> None:
    channels = ["POSE", "GPS", "MODELSERVER_HEALTH", "REPLY_", "REPLY_" + "A" * 194, "REPLY_A B", "REPLY_\n", ""]
    before = daemon.wait_for_rejections(lambda found: True)
    spoken = Listener(daemon.url, "GPS")
    poses = Listener(daemon.url, "POSE")
    for channel, request in itertools.product(channels, REQUEST_OF.values()):
        values = list(request)
        daemon.publish(CHANNEL_OF[type(request)], encode(type(request)(RequestHeader(1, channel), *values[1:])))

    def count(found: dict[tuple[str, str], int]) -> list[int]:
        # they are all of one program: of its long requests few may wait
        return [sum(found.get((name, why), 0) for why in ("reply_channel", "overload")) for name in REQUEST_OF]

    want = [known + len(channels) for known in count(before)]
    found = daemon.wait_for_rejections(lambda found: all(a >= b for a, b in zip(count(found), want, strict=True)))
    assert count(found) == want
    assert found["PLATFORM_GET_TRANSFORMATION", "reply_channel"] >= len(channels)
    while spoken.bus.handle_timeout(0) or poses.bus.handle_timeout(0):
        pass
    assert spoken.received == []
    assert poses.received
    assert all(decode("pose_transform_t", data) for data in poses.received)
    assert answers_well(daemon)


def test_given_a_frame_name_of_60_kb_on_the_raw_bus_then_the_reply_is_short(daemon: Daemon) -> None:
    replies = Listener(daemon.url, "REPLY_RAW")
    daemon.publish("PLATFORM_GET_TRANSFORMATION", encode(GetTransformation(ME, "A:" + "x" * 60_000, "y" * 60_000)))
    daemon.publish("PLATFORM_GET_BODY_FRAME_LIST", encode(GetBodyFrameList(ME, "x" * 60_000)))
    assert replies.wait(2)
    assert all(len(data) < 2_000 for data in replies.received)
    assert answers_well(daemon)


def test_given_a_burst_of_1000_requests_then_each_is_answered_or_counted_as_rejected(start_daemon: StartDaemon) -> None:
    daemon = start_daemon()
    replies = lcm.LCM(resolve_url(daemon.url))
    received: list[bytes] = []
    replies.subscribe("REPLY_RAW", lambda _, data: received.append(data)).set_queue_capacity(0)
    requests = [
        encode(GetTransformation(RequestHeader(n, "REPLY_RAW"), "Camera:Origin", "Cart:Base")) for n in range(1000)
    ]
    for data in requests:
        daemon.publish("PLATFORM_GET_TRANSFORMATION", data)

    def count_rejected(found: dict[tuple[str, str], int]) -> int:
        return found.get(("PLATFORM_GET_TRANSFORMATION", "overload"), 0)

    health = daemon.health(
        lambda h: h.requests_answered + count_rejected({(name, why): count for name, why, count in h.rejected}) == 1000
    )
    load = count_rejected({(name, why): count for name, why, count in health.rejected})
    assert health.requests_answered >= 256
    while replies.handle_timeout(200):
        pass
    answers = [decode("get_transformation_reply_t", data) for data in received]
    ok = [each for each in answers if each.answer is not None]
    assert len(ok) == health.requests_answered
    assert all(each.header.status is ms.Status.OVERLOADED for each in answers if each.answer is None)
    assert len(answers) - len(ok) <= load
    assert answers_well(daemon)


def test_given_numbers_that_cannot_be_in_samples_then_they_are_counted_and_poses_stay_sound(
    start_daemon: StartDaemon,
) -> None:
    daemon = start_daemon()
    at = daemon.feed()
    bad: list[tuple[str, Any]] = []
    for n, number in enumerate((math.nan, math.inf, 1e300, -1e300)):
        bad += [
            ("IMU", replace(imu(at + n + 1), angular_velocity=(number,) * 3)),
            ("GPS", replace(gps(at + n + 1), latitude_deg=number)),
            ("GPS", replace(gps(at + n + 101), velocity=(number,) * 3, height_ellipsoidal=number)),
        ]
    far = time.time_ns() // 1000 + 3600 * 1_000_000
    bad += [("IMU", imu(far)), ("GPS", gps(far))]
    for channel, sample in bad:
        daemon.publish(channel, encode(sample))
    last = {("sensor:imu", "future"), ("sensor:gps", "future")}
    found = daemon.wait_for_rejections(lambda found: last <= found.keys())
    assert found["sensor:imu", "future"] == 1
    assert found["sensor:gps", "future"] == 1
    assert all(name in ("sensor:imu", "sensor:gps") for name, _ in found)
    poses = Listener(daemon.url, "POSE")
    assert poses.wait(3)
    for data in poses.received:
        assert all(map(math.isfinite, decode("pose_transform_t", data).transformation.pose.xyz))
    platform = daemon.platform()
    platform.get_state_vector()
    platform.get_state_vector(at=at)
    assert daemon.health().handler_errors == 0


def test_given_a_flood_of_samples_then_requests_are_answered_and_poses_go_on(start_daemon: StartDaemon) -> None:
    daemon = start_daemon()
    at = daemon.feed()
    samples = [encode(imu(at + n)) for n in range(1, 5001)]

    def publish_all() -> None:
        for data in samples:
            daemon.publish("IMU", data)

    flood = threading.Thread(target=publish_all)
    flood.start()
    platform = daemon.platform()
    answered = [platform.get_body_list() for _ in range(20)]
    flood.join(TIMEOUT_S)
    assert len(answered) == 20
    health = daemon.health(lambda h: any(each.count >= 5000 for each in h.channels))
    assert health.handler_errors == 0
    assert answers_well(daemon)


def test_given_text_from_untrusted_senders_then_the_log_holds_none_of_it_raw(start_daemon: StartDaemon) -> None:
    daemon = start_daemon()
    evil = "x\nERROR root: FORGED\x1b[31m\r"
    good = encode(gps(1, source=evil))
    daemon.publish("GPS", good)
    daemon.publish("GPS", encode(gps(1, source=evil * 10)))
    daemon.publish("GPS", good[:-3])
    daemon.publish("PLATFORM_GET_TRANSFORMATION", encode(GetTransformation(ME, evil, evil, TimeQuery(-1))))
    daemon.publish("PLATFORM_GET_BODY_LIST", encode(GetBodyList(RequestHeader(1, evil))))
    daemon.wait_for_rejections(lambda found: len(found) >= 4)
    daemon.end()
    assert "rejected a message on GPS" in daemon.log
    assert not re.search(r"(?m)^ERROR root: FORGED", daemon.log)
    assert all(line.isprintable() for line in daemon.log.split("\n"))
