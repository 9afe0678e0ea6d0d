"""Small ROS bags, written for a test."""

from __future__ import annotations

import cmath
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from modelserver.earth.geodesy import origin_at
from modelserver.formats import load_model
from modelserver.geometry import ModelBuilder
from modelserver.messages import GpsSample, ImuSample, WheelsSample
from modelserver.simulation import Simulation, Trajectory, figure_eight
from modelserver.transforms import Pose

TYPES = {
    "fix": "sensor_msgs/msg/NavSatFix",
    "imu": "sensor_msgs/msg/Imu",
    "odom": "nav_msgs/msg/Odometry",
    "joints": "sensor_msgs/msg/JointState",
    "text": "std_msgs/msg/String",
    "tf": "tf2_msgs/msg/TFMessage",
}

START_NS = 1_700_000_000_000_000_000


class Ros:
    """Makes messages of one version of ROS, and writes them into a bag."""

    def __init__(self, version: int = 1):
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self.version = version
        self.store = get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.ROS2_HUMBLE)
        if version == 1:
            self.store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TYPES["tf"]))

    def make(self, type_name: str, /, **fields: Any) -> Any:
        return self.store.types[type_name](**fields)

    def header(self, stamp_ns: int, frame: str = "x") -> Any:
        time = self.make("builtin_interfaces/msg/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
        more = {"seq": 0} if self.version == 1 else {}
        return self.make("std_msgs/msg/Header", stamp=time, frame_id=frame, **more)

    def vector(self, values: Sequence[float], name: str = "Vector3") -> Any:
        return self.make(f"geometry_msgs/msg/{name}", **dict(zip("xyz", map(float, values), strict=True)))

    def quaternion(self, wxyz: Sequence[float]) -> Any:
        return self.make("geometry_msgs/msg/Quaternion", **dict(zip("wxyz", map(float, wxyz), strict=True)))

    def fix(
        self,
        stamp_ns: int = START_NS,
        position: tuple[float, float, float] = (42.0, -71.0, -20.0),
        status: int = 1,
        covariance: Sequence[float] = (0.81, 0, 0, 0, 0.81, 0, 0, 0, 3.24),
        covariance_type: int = 1,
    ) -> Any:
        state = self.make("sensor_msgs/msg/NavSatStatus", status=status, service=1)
        return self.make(
            TYPES["fix"],
            header=self.header(stamp_ns),
            status=state,
            latitude=position[0],
            longitude=position[1],
            altitude=position[2],
            position_covariance=np.array(covariance, float),
            position_covariance_type=covariance_type,
        )

    def imu(
        self,
        stamp_ns: int = START_NS,
        rate: Sequence[float] = (0.0, 0.1, 0.0),
        force: Sequence[float] = (0.0, 9.81, 0.0),
        wxyz: Sequence[float] = (1, 0, 0, 0),
        first_covariances: Sequence[float] = (1.0, 1.0, 1.0),
    ) -> Any:
        """Return an Imu; the first covariances are those of orientation, rate and force."""

        def covariance(first: float) -> Any:
            return np.array([first, 0, 0, 0, 1, 0, 0, 0, 1], float)

        orientation, turn, push = map(covariance, first_covariances)
        return self.make(
            TYPES["imu"],
            header=self.header(stamp_ns),
            orientation=self.quaternion(wxyz),
            orientation_covariance=orientation,
            angular_velocity=self.vector(rate),
            angular_velocity_covariance=turn,
            linear_acceleration=self.vector(force),
            linear_acceleration_covariance=push,
        )

    def odom(
        self,
        stamp_ns: int = START_NS,
        position: tuple[float, float, float] = (0.0, 0.0, 0.0),
        yaw: float = 0.0,
        speed: float = 0.0,
        turn: float = 0.0,
        sideways: float = 0.0,
        variances: tuple[float, float] = (0.0, 0.0),
    ) -> Any:
        covariance = np.zeros(36)
        covariance[0], covariance[35] = variances
        pose = self.make(
            "geometry_msgs/msg/Pose",
            position=self.vector(position, "Point"),
            orientation=self.quaternion((np.cos(yaw / 2), 0, 0, np.sin(yaw / 2))),
        )
        twist = self.make(
            "geometry_msgs/msg/Twist",
            linear=self.vector((speed, sideways, 0.0)),
            angular=self.vector((0.0, 0.0, turn)),
        )
        return self.make(
            TYPES["odom"],
            header=self.header(stamp_ns),
            child_frame_id="base_link",
            pose=self.make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=covariance),
            twist=self.make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=covariance),
        )

    def joints(self, stamp_ns: int, names: list[str], position: list[float], velocity: list[float]) -> Any:
        return self.make(
            TYPES["joints"],
            header=self.header(stamp_ns),
            name=names,
            position=np.array(position, float),
            velocity=np.array(velocity, float),
            effort=np.array([], float),
        )

    def transforms(
        self, stamp_ns: int, parent: str, children: Mapping[str, tuple[Sequence[float], Sequence[float]]]
    ) -> Any:
        """Return a TFMessage: position and quaternion, scalar first, of each child in the parent."""
        found = []
        for child, (xyz, wxyz) in children.items():
            pose = self.make(
                "geometry_msgs/msg/Transform", translation=self.vector(xyz), rotation=self.quaternion(wxyz)
            )
            header = self.header(stamp_ns, parent)
            found.append(
                self.make("geometry_msgs/msg/TransformStamped", header=header, child_frame_id=child, transform=pose)
            )
        return self.make(TYPES["tf"], transforms=found)

    def text(self, words: str) -> Any:
        return self.make(TYPES["text"], data=words)

    def write(self, path: Path, messages: Iterable[tuple[str, int, Any]], *, in_mcap: bool = False) -> Path:
        """Write a bag of messages (topic, receive time in ns, message) and return its path."""
        if self.version == 1:
            from rosbags.rosbag1 import Writer as Writer1

            writer: Any = Writer1(path)
            serialize = self.store.serialize_ros1
        else:
            from rosbags.rosbag2 import StoragePlugin
            from rosbags.rosbag2 import Writer as Writer2

            writer = Writer2(path, version=9, storage_plugin=StoragePlugin.MCAP if in_mcap else StoragePlugin.SQLITE3)
            serialize = self.store.serialize_cdr
        with writer:
            topics: dict[str, Any] = {}
            for topic, received_ns, message in messages:
                kind = message.__msgtype__
                if topic not in topics:
                    topics[topic] = writer.add_connection(topic, kind, typestore=self.store)
                writer.write(topics[topic], received_ns, serialize(message, kind))
        return path


ROBOT = """<robot name="rover">
  <link name="base_link"/><link name="gps_link"/><link name="imu_link"/>
  <joint name="gps" type="fixed"><parent link="base_link"/><child link="gps_link"/><origin xyz="0.1 0 0.9"/></joint>
  <joint name="imu" type="fixed"><parent link="base_link"/><child link="imu_link"/><origin xyz="0.2 0 0.1"/></joint>
</robot>
"""
TRACK = 0.6


def write_drive(path: Path, urdf: Path, seconds: float = 90.0) -> Path:
    """Write a ROS 1 bag of a simulated drive of the robot in a URDF: its sensors, and an estimator's busier output."""
    ros = Ros()
    builder = ModelBuilder.from_model(load_model(urdf))
    for name, side in (("Left", 0.5), ("Right", -0.5)):
        builder.bodies[0].add_frame(name, Pose((0.0, side * TRACK, 0.0)))
    drive = Simulation(
        builder.build(),
        "base_link:Origin",
        Trajectory(figure_eight(radius=8.0, speed=2.0, laps=2), yaw=0.7),
        origin_at(42.38, -71.14, 0.0),
        gps_frame="gps_link:Origin",
        imu_frame="imu_link:Origin",
        wheel_frames={"left": "base_link:Left", "right": "base_link:Right"},
    )
    messages: list[tuple[str, int, Any]] = []
    place, yaw, before = 0j, 0.0, (0.0, 0.0)
    for sample in drive.events(seconds):
        stamp, arrival = sample.header.utime * 1000, sample.header.host_utime * 1000
        if isinstance(sample, GpsSample):
            position = (sample.latitude_deg, sample.longitude_deg, sample.height_ellipsoidal)
            messages.append(("/fix", arrival, ros.fix(stamp, position)))
            messages += [("/gps/filtered", arrival + n, ros.fix(stamp, position)) for n in range(2)]
        elif isinstance(sample, ImuSample) and sample.angular_velocity and sample.specific_force:
            messages.append(("/imu/data", arrival, ros.imu(stamp, sample.angular_velocity, sample.specific_force)))
        elif isinstance(sample, WheelsSample):
            left, right = (each.travel for each in sample.wheels)
            forward, turn = 0.5 * (left - before[0] + right - before[1]), (right - before[1] - left + before[0]) / TRACK
            place, yaw, before = place + cmath.rect(forward, yaw + 0.5 * turn), yaw + turn, (left, right)
            speeds = [each.speed for each in sample.wheels]
            moving = {"speed": 0.5 * sum(speeds), "turn": (speeds[1] - speeds[0]) / TRACK}
            messages.append(("/odom", arrival, ros.odom(stamp, (place.real, place.imag, 0.0), yaw, **moving)))
    return ros.write(path, sorted(messages, key=lambda each: each[1]))
