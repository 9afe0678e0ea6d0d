"""SensorPublisher, PoseStream and times: what a program of one's own publishes and receives."""

from __future__ import annotations

import asyncio
import math
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta, timezone
from typing import Any

import lcm
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support_lcm import Listener

import modelserver as ms
from modelserver.client.remote import MAX_WAITING, PoseStream, check_batch, to_utime
from modelserver.earth.geodesy import origin_at
from modelserver.errors import MalformedRequestError
from modelserver.messages import Direction, FixType, PoseAnswer
from modelserver.transforms import Pose, Transformation
from modelserver.wire.codec import decode, encode

AT = 1_800_000_000_000_000
WHEN = datetime(2027, 1, 15, 8, 0, tzinfo=UTC)


@contextmanager
def publishing(url: str, channel: str, **more: Any) -> Iterator[tuple[ms.SensorPublisher, Callable[[str], Any]]]:
    listener = Listener(url, channel)
    with ms.SensorPublisher("mine", url=url, **more) as publisher:

        def receive(type_name: str) -> Any:
            assert listener.wait()
            return decode(type_name, listener.received.pop())

        yield publisher, receive


def test_given_each_kind_of_sample_then_it_is_received_as_it_was_given(lcm_url: str) -> None:
    with publishing(lcm_url, "IMU") as (publisher, receive):
        sent = publisher.imu((0.0, 0.1, 0.2), [0, 0, 9.81], quaternion=(1, 0, 0, 0), at=WHEN)
        assert repr(receive("imu_t")) == repr(sent)
        assert (sent.header.utime, sent.header.source, sent.header.seq) == (AT, "mine", 0)
        assert sent.orientation == (1.0, 0.0, 0.0, 0.0)
        assert publisher.imu((0.0, 0.0, 0.0)).header.seq == 1
    with publishing(lcm_url, "GPS") as (publisher, receive):
        sent = publisher.gps(
            50.27, -111.18, 700.0, fix_type=FixType.RTK_FIXED, sigma=(0.1, 0.2, 0.3), velocity=(1, 2, 0)
        )
        assert repr(receive("gps_t")) == repr(sent)
        assert sent.position_covariance == pytest.approx((0.01, 0, 0, 0, 0.04, 0, 0, 0, 0.09))
        assert abs(sent.header.utime - sent.header.host_utime) == 0
    with publishing(lcm_url, "WHEELS") as (publisher, receive):
        sent = publisher.wheels({"left": 1.0, "right": 1.5}, travel={"left": 7.0}, steering={"right": 0.1})
        assert repr(receive("wheels_t")) == repr(sent)
        assert [each.name for each in sent.wheels] == ["left", "right"]
        assert publisher.wheels({"left": 1.0}, is_signed=False).wheels[0].direction is Direction.UNSIGNED
    with publishing(lcm_url, "robot/JOINTS", channel_prefix="robot/") as (publisher, receive):
        sent = publisher.joints({"Pan": 0.3, "Tilt": -0.1}, rates={"Pan": 0.1}, sigmas={"Tilt": 0.01})
        assert repr(receive("joints_t")) == repr(sent)
    with publishing(lcm_url, "MEASUREMENT") as (publisher, receive):
        sent = publisher.measurement([1.5, 2.0], sigma=(0.5, 2.0), frame="Cart:Radar")
        assert repr(receive("measurement_t")) == repr(sent)
        assert (sent.values, sent.covariance) == ((1.5, 2.0), (0.25, 0.0, 0.0, 4.0))
        assert publisher.measurement((0.0,)).covariance == ()
    with publishing(lcm_url, "DRIVE", channels={"status": "DRIVE"}) as (publisher, receive):
        sent = publisher.status(forward_speed=2.0, steering_angle=0.1)
        assert repr(receive("vehicle_status_t")) == repr(sent)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda p: p.imu((180.0, 0, 0)), "is it in degrees per second"),
        (lambda p: p.imu((1, 2)), "angular_velocity has 3 numbers, got 2"),
        (lambda p: p.imu((1, 2, math.nan)), "leave it out"),
        (lambda p: p.imu(), "needs angular_velocity"),
        (lambda p: p.imu((0, 0, 0), quaternion=(2, 0, 0, 0)), "unit quaternion"),
        (lambda p: p.imu((0, 0, 0), magnetic_field=(50, 0, 0)), "microtesla"),
        (lambda p: p.gps(91, 0), "latitude -90 to 90"),
        (lambda p: p.gps(0, 0, sigma=(1, 1, 0)), "above 0"),
        (lambda p: p.wheels({}), "needs speeds or travel"),
        (lambda p: p.wheels({"left": 500.0}), "is in m/s"),
        (lambda p: p.joints({}), "needs positions"),
        (lambda p: p.joints({"Pan": 0.0}, rates={"Tilt": 0.0}), "Tilt"),
        (lambda p: p.status(steering_angle=20.0), "degrees"),
        (lambda p: p.imu((0, 0, 0), at=1.5e9), "write int"),
        (lambda p: p.measurement(()), "values has 1 numbers, got 0"),
        (lambda p: p.measurement(range(17)), "values has 16 numbers, got 17"),
        (lambda p: p.measurement([math.nan]), "finite"),
        (lambda p: p.measurement([1.0, 2.0], sigma=[1.0]), "sigma has 2 numbers"),
        (lambda p: p.measurement([1.0], sigma=[0.0]), "above 0"),
    ],
)
def test_given_what_cannot_be_then_it_is_rejected_with_the_reason(
    call: Callable[[ms.SensorPublisher], object], words: str, lcm_url: str
) -> None:
    with (
        ms.SensorPublisher("mine", url=lcm_url) as publisher,
        pytest.raises((ValueError, MalformedRequestError), match=words),
    ):
        call(publisher)


def test_given_a_closed_publisher_or_a_wrong_name_then_it_is_rejected(lcm_url: str) -> None:
    publisher = ms.SensorPublisher("mine", url=lcm_url)
    publisher.close()
    with pytest.raises(ValueError, match="closed"):
        publisher.imu((0, 0, 0))
    with pytest.raises(ValueError, match="name of the device"):
        ms.SensorPublisher("", url=lcm_url)
    with pytest.raises(ValueError, match="kinds gps, imu"):
        ms.SensorPublisher("mine", url=lcm_url, channels={"sonar": "SONAR"})


# --- times ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "time",
    [
        AT, WHEN, np.int64(AT), WHEN.astimezone(timezone(timedelta(hours=-7))), np.datetime64("2027-01-15T08:00:00"),
        np.datetime64("2027-01-15T08:00:00.000000000", "ns"),
    ],
)  # fmt: skip
def test_given_a_time_then_it_is_that_instant(time: Any) -> None:
    assert to_utime(time) == AT


@pytest.mark.parametrize("time", [datetime(2027, 1, 15), 1.8e9, True, "2027", None, np.datetime64("NaT", "us")])
def test_given_what_is_no_instant_then_it_is_rejected(time: Any) -> None:
    with pytest.raises(MalformedRequestError):
        to_utime(time)


def test_given_times_of_a_batch_then_they_may_be_of_each_kind() -> None:
    pair = [("A:a", "B:b")]
    later = WHEN + timedelta(seconds=1)
    for times in (
        [AT, AT + 1_000_000],
        [WHEN, later],
        np.array([WHEN.replace(tzinfo=None), later.replace(tzinfo=None)], "datetime64[us]"),
    ):
        assert check_batch(pair, times)[1].tolist() == [AT, AT + 1_000_000]
    with pytest.raises(MalformedRequestError):
        check_batch(pair, [datetime(2027, 1, 1)])


# --- rotations of scipy and ROS -------------------------------------------------------------------------------


def test_given_a_rotation_then_it_is_the_same_in_scipy() -> None:
    rotation = Rotation.from_euler("xyz", (0.1, -0.2, 2.5))
    pose = Pose.from_scipy((1, 2, 3), rotation)
    assert np.allclose(pose.rotation, rotation.as_matrix())
    assert np.allclose(pose.to_scipy().as_matrix(), rotation.as_matrix())
    assert Pose.from_xyzw((1, 2, 3), pose.xyzw) == pose
    found = Transformation("A:a", "B:b", pose)
    assert found.xyzw == pose.xyzw
    assert np.allclose(found.to_scipy().as_matrix(), rotation.as_matrix())
    assert Pose.from_matrix(found.matrix).is_close(pose, 1e-12, 1e-12)


# --- poses ----------------------------------------------------------------------------------------------------


def make_pose(number: int) -> PoseAnswer:
    return PoseAnswer(
        Transformation("Cart:Base", "World:UTM", Pose((float(number), 0.0, 0.0), (1, 0, 0, 0)), utime=AT + number)
    )


def publish_poses(url: str, numbers: range, channel: str = "POSE") -> None:
    bus = lcm.LCM(url)
    for number in numbers:
        bus.publish(channel, encode(make_pose(number)))


def read_numbers(poses: Iterator[PoseAnswer], count: int) -> list[int]:
    return [next(poses).transformation.utime - AT for _ in range(count)]


def test_given_a_stream_then_poses_are_iterated_in_order_until_it_is_closed(lcm_url: str) -> None:
    with ms.Platform(lcm_url) as platform, platform.subscribe_pose() as poses:
        publish_poses(lcm_url, range(5))
        assert read_numbers(poses, 5) == [0, 1, 2, 3, 4]
        with pytest.raises(TimeoutError, match="is the daemon running"):
            poses.get(0.01)
        lcm.LCM(lcm_url).publish("POSE", b"no pose")
        publish_poses(lcm_url, range(5, 6))
        assert poses.get(10.0).transformation.utime == AT + 5
        threading.Timer(0.05, poses.close).start()
        assert list(poses) == []


def test_given_a_callback_then_it_gets_each_pose_and_its_errors_end_nothing(
    lcm_url: str, caplog: pytest.LogCaptureFixture
) -> None:
    received: list[int] = []
    done = threading.Event()

    def handle(pose: PoseAnswer) -> None:
        received.append(pose.transformation.utime - AT)
        if len(received) == 1:
            raise RuntimeError("mine")
        if len(received) == 3:
            done.set()

    stream = PoseStream(lcm_url, "POSE", handle)
    publish_poses(lcm_url, range(3))
    assert done.wait(30.0)
    stream.close()
    assert received == [0, 1, 2]
    assert "the callback of subscribe_pose failed" in caplog.text


def test_given_an_asynchronous_loop_then_it_gets_poses_and_ends_when_closed(lcm_url: str) -> None:
    async def collect() -> list[int]:
        found = []
        with PoseStream(lcm_url, "POSE") as poses:
            asyncio.get_running_loop().call_later(0.05, publish_poses, lcm_url, range(4))
            async for pose in poses:
                found.append(pose.transformation.utime - AT)
                if len(found) == 4:
                    threading.Timer(0.05, poses.close).start()
        return found

    assert asyncio.run(asyncio.wait_for(collect(), 30.0)) == [0, 1, 2, 3]


def test_given_a_reader_that_is_too_slow_then_the_oldest_poses_are_lost_and_counted(lcm_url: str) -> None:
    stream = PoseStream(lcm_url, "NONE")
    for number in range(MAX_WAITING + 3):
        stream._receive("", encode(make_pose(number)))
    assert stream.lost == 3
    assert stream.get(1.0).transformation.utime == AT + 3
    stream.close()


def test_given_a_pose_in_the_world_then_it_has_a_place() -> None:
    assert make_pose(0).geodetic is None
    pose = make_pose(0)._replace(origin=origin_at(50.27, -111.18, 700.0))
    assert pose.geodetic is not None
    assert pose.geodetic.latitude_deg == pytest.approx(50.27, abs=1e-6)
