"""Recordings of other formats: ROS bags (library rosbags) as samples, and MCAP files of `modelserver export`.

A file has one clear error for all that can be wrong with it. ROS messages are read by their fields, as any ROS library
presents them; ROS 1 and 2 are alike in all fields used. What a message leaves open (height reference, orientation
reference, track width) is a `BagOptions`. The LCM messages in an MCAP file (/lcm/CHANNEL) are read as they are: the
reverse of the export.

Frames (/tf, /tf_static): a frame is a body with the frame `Origin`. A transform that stays as it is becomes a fixed
constraint; one that moves is a joint with six coordinates, which are the transform itself. So nothing is guessed about
axes and zero positions: a URDF has those. What a localization publishes (map or odom to the vehicle) is the pose, and
no part of the vehicle.
"""

from __future__ import annotations

import errno
import itertools
import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import IO, Any, Final, NamedTuple, TypeVar

import numpy as np

from modelserver.errors import RecordingError
from modelserver.extras import make_install_command
from modelserver.geometry import Joint, JointType, Model, ModelBuilder, names
from modelserver.geometry.joint import Coordinates, coordinate_names
from modelserver.messages import (
    NAN,
    Direction,
    FixType,
    GpsSample,
    ImuSample,
    JointSample,
    JointsSample,
    OrientationReference,
    Sample,
    SensorHeader,
    WheelSample,
    WheelsSample,
    YawSource,
)
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Array, Matrix3, Quaternion

BAG_REMEDY: Final = "`rosbag reindex` repairs such bags of ROS 1, `ros2 bag reindex` those of ROS 2"
M = TypeVar("M")

MAGIC: Final = b"\x89MCAP0\r\n"
ENCODING: Final = "lcm"
ROS_ENCODING: Final = "cdr"
TOPIC_PREFIX: Final = "/lcm/"
MCAP_REMEDY: Final = "`mcap recover` repairs such files"

STATIONARY_SPEED = 1e-3
"""Speed in m/s below which a wheel is stationary: averaging controllers leave residues of 1e-15."""


ODOMETRY: Final = "nav_msgs/msg/Odometry"

ESTIMATOR_WORDS: Final = (
    *("filtered", "fused", "fusion", "ekf", "ukf", "localization", "estimate", "estimated", "estimator", "navsat"),
    *("amcl", "slam", "rtabmap", "map", "global", "icp", "rf2o", "laser", "lidar", "visual", "vio", "vo", "rgbd"),
)


# --- bags ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Topic:
    """One topic of a bag: its name, its type in ROS 2 notation (sensor_msgs/msg/Imu), number of messages.

    publisher: the name of the node that published it, where the bag has it (ROS 1).
    """

    name: str
    type_name: str
    count: int
    publisher: str = ""

    @property
    def estimator(self) -> str:
        """The word by which it looks like the output of an estimator instead of a sensor; "" if nothing does.

        The words are those of the nodes that do it: robot_localization (ekf, ukf, navsat_transform; its topics are
        odometry/filtered, gps/filtered and odometry/gps), amcl, slam_toolbox, rtabmap, rf2o, visual odometry.
        """
        words = re.findall(r"[a-z0-9]+", f"{self.name} {self.publisher}".lower())
        known = (*ESTIMATOR_WORDS, "gps") if self.type_name == ODOMETRY else ESTIMATOR_WORDS
        return next((word for word in words if word in known), "")


class Bag:
    """An open bag."""

    def __init__(self, path: Path, reader: Any):
        self._path = path
        self._reader = reader
        counts: Counter[tuple[str, str]] = Counter()
        publishers: dict[tuple[str, str], str] = {}
        for each in reader.connections:
            counts[each.topic, each.msgtype] += each.msgcount
            publishers[each.topic, each.msgtype] = getattr(each.ext, "callerid", None) or ""
        self.topics = tuple(Topic(*names, count, publishers[names]) for names, count in sorted(counts.items()))

    def messages(self, topics: set[str]) -> Iterator[tuple[str, int, Any]]:
        """Yield topic, receive time (ns) and message of some topics in the order received. Raises RecordingError."""
        connections = [each for each in self._reader.connections if each.topic in topics]
        if not connections:
            return
        yield from explain_each(
            (
                (connection.topic, received_ns, self._reader.deserialize(raw, connection.msgtype))
                for connection, received_ns, raw in self._reader.messages(connections=connections)
            ),
            self._path,
        )


@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """Open a bag: a ROS 1 file, or the file or folder of a ROS 2 recording. Raises RecordingError, OSError."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise RecordingError(
            f"reading bags needs the library rosbags ({error}): {make_install_command('bags')}"
        ) from None
    if path.is_file():
        with path.open("rb") as file:
            if path.suffix == ".bag" and not file.read(9).startswith(b"#ROSBAG V"):
                raise RecordingError(f"{path}: not a ROS bag: it does not begin with #ROSBAG")
    elif not path.is_dir():
        # reading a FIFO or a device would block
        raise RecordingError(f"{path}: {'neither a file nor a folder' if path.exists() else 'no such file'}")
    reader = None
    with explain_errors(path, "on opening it"):
        # ROS 2 bags may lack their type definitions; those of ROS itself have been stable
        reader = AnyReader(_list_files(path), default_typestore=get_typestore(Stores.LATEST))
        reader.open()
    try:
        yield Bag(path, reader)
    finally:
        reader.close()


def _list_files(path: Path) -> list[Path]:
    """Return what to read of a bag: itself, or the files of a folder that has lost its metadata.yaml."""
    if path.is_file() or (path / "metadata.yaml").exists():
        return [path]
    for suffix in (".mcap", ".db3"):
        if found := sorted(each for each in path.iterdir() if each.suffix == suffix and each.is_file()):
            return found
    raise RecordingError(f"{path}: no bag: there is no metadata.yaml, no .mcap and no .db3 file in it")


def explain_each(messages: Iterable[M], path: Path, kind: str = "bag", remedy: str = BAG_REMEDY) -> Iterator[M]:
    """Yield what a library reads from a file, with `explain_errors`."""
    stream = iter(messages)
    for count in itertools.count():
        with explain_errors(path, f"after {count} messages", kind, remedy):
            found = next(stream, None)
        if found is None:
            return
        yield found


@contextmanager
def explain_errors(path: Path, place: str, kind: str = "bag", remedy: str = BAG_REMEDY) -> Iterator[None]:
    """Convert any exception of a library on a damaged file to one readable error; OSError of the disk stays."""
    try:
        yield
    except RecordingError:
        raise
    except MemoryError:
        what = "it states a length that exceeds the memory"
    except Exception as error:  # the libraries document no exceptions for damaged files
        # EINVAL: a seek to before the begin of a file that is too short
        if isinstance(error, OSError) and error.errno != errno.EINVAL:
            raise
        what = str(error).strip() or type(error).__name__
    else:
        return
    raise RecordingError(
        f"{path}: the {kind} cannot be read {place}: {what.rstrip('.')}. It may be cut short or never have been "
        f"closed; {remedy}"
    )


# --- MCAP files ---------------------------------------------------------------------------------------------


class McapLog:
    """An MCAP file: `channels` has the LCM channels with their types and counts of messages.

    has_ros: whether it has messages of ROS 2.
    """

    def __init__(self, path: Path, file: IO[bytes]):
        from mcap.reader import make_reader

        self._path = path
        with explain_errors(path, "on opening it", "MCAP file", MCAP_REMEDY):
            self._reader = make_reader(file)
            summary = self._reader.get_summary()
        if summary is None:
            raise RecordingError(f"{path}: the MCAP file has no summary: it was not closed; `mcap recover` repairs it")
        counts = summary.statistics.channel_message_counts if summary.statistics is not None else {}
        self.has_ros = any(each.message_encoding == ROS_ENCODING for each in summary.channels.values())
        self.channels: dict[str, tuple[str, int]] = {}
        for number, each in summary.channels.items():
            if each.message_encoding == ENCODING and each.topic.startswith(TOPIC_PREFIX):
                schema = summary.schemas.get(each.schema_id)
                name = schema.name if schema is not None else "unknown"
                self.channels[each.topic.removeprefix(TOPIC_PREFIX)] = (name, counts.get(number, 0))

    def read(self) -> Iterator[tuple[int, str, bytes]]:
        """Yield receive time (us), channel and bytes of the messages in the order of the file."""
        topics = [f"{TOPIC_PREFIX}{each}" for each in self.channels]
        stream = self._reader.iter_messages(topics=topics, log_time_order=False)
        for _, channel, message in explain_each(stream, self._path, "MCAP file", MCAP_REMEDY):
            yield message.log_time // 1000, channel.topic.removeprefix(TOPIC_PREFIX), message.data


def is_lcm_mcap(path: Path) -> bool:
    """Return whether a path is an MCAP file, and not one of ROS 2, also one whose end is missing. Raises OSError."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            return False
    try:
        with open_mcap(path) as mcap:
            return bool(mcap.channels) or not mcap.has_ros
    except RecordingError:
        # the reader of bags reads one that was not closed
        with suppress(RecordingError), open_bag(path) as bag:
            return not bag.topics
    return True


@contextmanager
def open_mcap(path: Path) -> Iterator[McapLog]:
    """Open an MCAP file. Raises RecordingError for one that is damaged, or without the library; OSError."""
    try:
        import mcap  # noqa: F401
    except ImportError:
        text = f"reading MCAP files needs the library mcap: {make_install_command('bags')}"
        raise RecordingError(text) from None
    with path.open("rb") as file:
        yield McapLog(path, file)


# --- samples of ROS messages --------------------------------------------------------------------------------


class TopicKind(StrEnum):
    """Kind of samples of a topic: also the source's name, and in capitals the channel's."""

    GPS = "gps"
    IMU = "imu"
    WHEELS = "wheels"
    JOINTS = "joints"


ROS_TYPES = {
    "sensor_msgs/msg/NavSatFix": TopicKind.GPS,
    "sensor_msgs/msg/Imu": TopicKind.IMU,
    ODOMETRY: TopicKind.WHEELS,
    "sensor_msgs/msg/JointState": TopicKind.JOINTS,
}


class Altitude(StrEnum):
    """What NavSatFix.altitude is measured from."""

    ELLIPSOIDAL = "ellipsoidal"
    MSL = "msl"


class ImuOrientation(StrEnum):
    """What Imu.orientation is measured against; none leaves it out."""

    NONE = "none"
    ENU = "enu"
    NED = "ned"


@dataclass(frozen=True, slots=True)
class BagOptions:
    """What a bag leaves open."""

    altitude: Altitude = Altitude.ELLIPSOIDAL
    undulation: float = NAN
    imu_orientation: ImuOrientation = ImuOrientation.NONE
    track_width: float = 0.555


DEFAULT_OPTIONS = BagOptions()


class Converter:
    """Converts the messages of one topic to samples, in their order."""

    def __init__(self, options: BagOptions):
        self._options = options

    def convert(self, header: SensorHeader, message: Any) -> Sample:
        raise NotImplementedError

    def notes(self) -> list[str]:
        """Return notes on the converted messages for the user, one line each."""
        return []


# --- fixes --------------------------------------------------------------------------------------------------

_FIX_TYPES = {
    0: FixType.FIX_3D,
    1: FixType.DIFFERENTIAL,  # satellite-based augmentation
    # Ground-based augmentation: at least a differential fix. Drivers report RTK as this too; the covariance has
    # their quality.
    2: FixType.DIFFERENTIAL,
}


class GpsConverter(Converter):
    """NavSatFix. The altitude is ellipsoidal or MSL by option; the other height needs the undulation."""

    _unknown_covariances = 0

    def convert(self, header: SensorHeader, message: Any) -> GpsSample:
        is_msl, undulation = self._options.altitude is Altitude.MSL, self._options.undulation
        latitude, longitude, height = float(message.latitude), float(message.longitude), float(message.altitude)
        fix_type = _FIX_TYPES.get(int(message.status.status), FixType.NONE)
        if not (math.isfinite(latitude) and math.isfinite(longitude)):
            fix_type = FixType.NONE
        elif fix_type is FixType.FIX_3D and not math.isfinite(height):
            fix_type = FixType.FIX_2D
        covariance = None if int(message.position_covariance_type) == 0 else _covariance(message.position_covariance)
        self._unknown_covariances += covariance is None
        return GpsSample(
            header,
            fix_type,
            latitude,
            longitude,
            height_ellipsoidal=height + undulation if is_msl else height,
            height_msl=height if is_msl else NAN,
            undulation=undulation,
            position_covariance=covariance,
        )

    def notes(self) -> list[str]:
        lines = []
        if self._unknown_covariances:
            lines.append(f"{self._unknown_covariances} fixes have no covariance")
        if self._options.altitude is Altitude.MSL and not math.isfinite(self._options.undulation):
            lines.append("ellipsoidal heights are unknown: give --undulation with --altitude msl")
        return lines


# --- inertial -----------------------------------------------------------------------------------------------


class ImuConverter(Converter):
    """Imu. A first covariance element of -1 marks a missing value (the message's definition)."""

    _count = 0
    _force = 0.0
    _up = 0.0
    _oriented = 0

    def convert(self, header: SensorHeader, message: Any) -> ImuSample:
        rate = _vector(message.angular_velocity, message.angular_velocity_covariance)
        force = _vector(message.linear_acceleration, message.linear_acceleration_covariance)
        quaternion = _unit_quaternion(message)
        if force is not None:
            self._count += 1
            self._force += math.hypot(*force)
            if quaternion is not None:
                self._oriented += 1
                self._up += so3.rotate(quaternion, force)[2]
        reference = OrientationReference[self._options.imu_orientation.name]
        wanted = quaternion is not None and reference is not OrientationReference.NONE
        return ImuSample(
            header,
            angular_velocity=rate,
            specific_force=force,
            orientation=quaternion if wanted else None,
            orientation_reference=reference if wanted else OrientationReference.NONE,
            # the message does not define the zero of yaw
            yaw_source=YawSource.NONE,
            angular_velocity_covariance=_covariance(message.angular_velocity_covariance),
            specific_force_covariance=_covariance(message.linear_acceleration_covariance),
            orientation_covariance=_covariance(message.orientation_covariance) if wanted else None,
        )

    def notes(self) -> list[str]:
        lines = []
        if self._count and not 8.5 < (mean := self._force / self._count) < 11.5:
            lines.append(f"the mean specific force is {mean:.2f} m/s2, not 9.81: wrong unit, or gravity removed?")
        if self._oriented:
            up = self._up / self._oriented
            likely = "enu" if up > 8.0 else "ned" if up < -8.0 else ""
            stated = self._options.imu_orientation
            if stated is ImuOrientation.NONE:
                hint = f"; by gravity it is {likely}" if likely else ""
                lines.append(f"the IMU's own orientation is dropped (--imu-orientation){hint}")
            elif likely != stated:
                lines.append(
                    f"the IMU's orientation gives {up:+.1f} m/s2 of gravity's reaction along z: this does not look "
                    f"like {stated}"
                )
        return lines


# --- wheels -------------------------------------------------------------------------------------------------


class WheelsConverter(Converter):
    """Odometry, as two virtual wheels `left` and `right` at half the track width to either side of the base.

    Speed: that of two points of the base by the published twist, v -+ w track/2. Travel: from the steps of the
    published pose. The two differ in latency: controllers average the twist (the Husky's over ten cycles, 0.5 s) and
    not the pose. The encoder counts of a skidding wheel are not in the message.
    """

    _previous: tuple[int, Array, Array] | None = None
    _travel = (0.0, 0.0)
    _jumps = 0
    _sideways = 0.0

    def convert(self, header: SensorHeader, message: Any) -> WheelsSample:
        twist = message.twist.twist
        speed, turn = float(twist.linear.x), float(twist.angular.z)
        self._sideways = max(self._sideways, abs(float(twist.linear.y)))
        distance, angle = self._step(header.utime, message.pose.pose, speed, turn)
        covariance = np.asarray(message.twist.covariance, float).reshape(6, 6)
        arms = (-self._options.track_width / 2, self._options.track_width / 2)
        self._travel = (self._travel[0] + distance + arms[0] * angle, self._travel[1] + distance + arms[1] * angle)
        wheels = []
        for name, arm, travel in zip(("left", "right"), arms, self._travel, strict=True):
            rolled = speed + arm * turn
            spread = covariance[0, 0] + 2 * arm * covariance[0, 5] + arm * arm * covariance[5, 5]
            known = covariance[0, 0] > 0 and covariance[5, 5] > 0 and spread > 0
            sigma, direction = math.sqrt(spread) if known else NAN, _direction(rolled)
            wheels.append(WheelSample(name, travel=travel, speed=rolled, speed_sigma=sigma, direction=direction))
        return WheelsSample(header, tuple(wheels))

    def _step(self, utime: int, pose: Any, speed: float, turn: float) -> tuple[float, float]:
        """Return the forward distance, meters, and the turn, radians, since the previous message."""
        position = np.array([pose.position.x, pose.position.y, pose.position.z], float)
        forward = np.array(so3.rotate(_quaternion(pose.orientation), (1.0, 0.0, 0.0)))
        good = bool(np.isfinite(position).all()) and 0.9 < float(np.linalg.norm(forward)) < 1.1
        before, self._previous = self._previous, (utime, position, forward) if good else None
        if before is None:
            return (0.0, 0.0)
        seconds = max(0.0, (utime - before[0]) * 1e-6)
        by_twist = (speed * seconds, turn * seconds)
        if not good:
            return by_twist
        middle = forward + before[2]
        length = float(np.linalg.norm(middle))
        distance = float((position - before[1]) @ middle) / length if length > 1e-6 else math.inf
        if abs(distance - by_twist[0]) > 1.0 + 5.0 * seconds:
            self._jumps += 1  # the odometry was reset: use the twist for this step
            return by_twist
        cross = before[2][0] * forward[1] - before[2][1] * forward[0]
        return (distance, math.atan2(cross, float(before[2][:2] @ forward[:2])))

    def notes(self) -> list[str]:
        lines = []
        if self._jumps:
            lines.append(f"the odometry's pose jumped {self._jumps} times; there the travel is that of its twist")
        if self._sideways > 0.01:
            lines.append(f"the base moves sideways at up to {self._sideways:.2f} m/s, which wheels do not measure")
        return lines


def _direction(speed: float) -> Direction:
    if not math.isfinite(speed):
        return Direction.UNKNOWN
    if abs(speed) < STATIONARY_SPEED:
        return Direction.STOPPED
    return Direction.FORWARD if speed > 0 else Direction.BACKWARD


# --- joints -------------------------------------------------------------------------------------------------


class JointsConverter(Converter):
    """JointState: names, positions and rates; efforts are dropped."""

    def convert(self, header: SensorHeader, message: Any) -> JointsSample:
        # each of the other arrays may be empty
        positions, rates = (
            itertools.chain(each, itertools.repeat(NAN)) for each in (message.position, message.velocity)
        )
        rows = zip(message.name, positions, rates, strict=False)
        return JointsSample(header, tuple(JointSample(str(n), float(p), rate=float(v)) for n, p, v in rows))


CONVERTERS: dict[TopicKind, type[Converter]] = {
    TopicKind.GPS: GpsConverter,
    TopicKind.IMU: ImuConverter,
    TopicKind.WHEELS: WheelsConverter,
    TopicKind.JOINTS: JointsConverter,
}


# --- parts --------------------------------------------------------------------------------------------------


def read_stamp(message: Any) -> int:
    """Return the time of measurement of a message with a header, microseconds since 1970; 0 for none."""
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000 + int(stamp.nanosec) // 1000


def _covariance(values: Sequence[float]) -> Matrix3 | None:
    """Return nine numbers, or None for an unknown covariance: first element -1, all zero, or not finite."""
    a, b, c, d, e, f, g, h, i = found = tuple(float(value) for value in values)
    if not all(map(math.isfinite, found)) or not (a > 0 and e > 0 and i > 0):
        return None
    return (a, b, c, d, e, f, g, h, i)


def _vector(vector: Any, covariance: Sequence[float]) -> tuple[float, float, float] | None:
    if float(covariance[0]) == -1.0:
        return None
    return (float(vector.x), float(vector.y), float(vector.z))


def _quaternion(q: Any) -> Quaternion:
    return (float(q.w), float(q.x), float(q.y), float(q.z))


def _unit_quaternion(message: Any) -> Quaternion | None:
    values = _quaternion(message.orientation)
    length = math.hypot(*values)
    # drivers without orientation send zeros
    if float(message.orientation_covariance[0]) == -1.0 or not abs(length - 1.0) <= 0.05:
        return None
    w, x, y, z = (value / length for value in values)
    return (w, x, y, z)


# --- frames -------------------------------------------------------------------------------------------------

TF_TYPES: Final = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")

WORLD_FRAMES: Final = ("map", "odom", "utm", "earth", "world")
"""Frames of REP-105, of navsat_transform and of simulators that are fixed in the world."""

ROUNDING: Final = 1e-6
"""Change of a transform, m and rad, that is rounding: a driver computes it again from single precision."""


class TfEdge(NamedTuple):
    """A transform: the pose of a frame in its parent as first seen, and whether it has moved since."""

    parent: str
    pose: Pose
    is_moving: bool = False


class TfTree:
    """The transforms of a bag, by the child's name; `conflicts` are frames that had two parents."""

    def __init__(self) -> None:
        self.edges: dict[str, TfEdge] = {}
        self.conflicts: set[str] = set()

    def add(self, message: Any) -> None:
        for child, parent, pose in filter(None, map(_read_transform, message.transforms)):
            known = self.edges.get(child)
            if known is None:
                self.edges[child] = TfEdge(parent, pose)
            elif known.parent != parent:
                self.conflicts.add(child)
                self.edges[child] = TfEdge(parent, pose)
            elif not known.is_moving and not pose.is_close(known.pose, ROUNDING, ROUNDING):
                self.edges[child] = known._replace(is_moving=True)

    def find_root(self) -> str:
        """Return the frame of the vehicle with the most frames below it. Raises RecordingError for none."""
        sizes: dict[str, int] = {}
        for child in self.edges:
            seen = {child}
            top = child
            while (edge := self.edges.get(top)) is not None and edge.parent not in seen:
                top = edge.parent
                seen.add(top)
            sizes[top] = sizes.get(top, 0) + 1
        if not sizes:
            raise RecordingError("the bag has no transforms between frames of the vehicle (/tf, /tf_static)")
        return max(sizes, key=lambda each: (sizes[each], each))

    def build_model(self, name: str) -> Model:
        """Return the geometry. Raises RecordingError, GeometryError."""
        root = self.find_root()
        builder = ModelBuilder(name)
        parents = (edge.parent for edge in self.edges.values())
        for frame in dict.fromkeys((root, *parents, *self.edges)):
            builder.add_body(frame).add_frame(names.ORIGIN)
        for child, edge in self.edges.items():
            ends = names.join(edge.parent, names.ORIGIN), names.join(child, names.ORIGIN)
            if edge.is_moving:
                joint = Joint(JointType.FLOATING, default=_to_coordinates(edge.pose))
                builder.add_constraint(_name_joint(child, edge), *ends, joint=joint)
            else:
                builder.add_constraint(_name_joint(child, edge), *ends, edge.pose)
        return builder.build()

    @property
    def has_joints(self) -> bool:
        return any(edge.is_moving for edge in self.edges.values())

    def read_joints(self, message: Any) -> Iterator[tuple[int, tuple[JointSample, ...]]]:
        """Yield the stamp, us, and the coordinates of each joint that a message moves."""
        for each in message.transforms:
            child, parent, pose = _read_transform(each) or ("", "", Pose.identity())
            edge = self.edges.get(child)
            if edge is not None and edge.is_moving and edge.parent == parent:
                coordinates = coordinate_names(_name_joint(child, edge), Joint(JointType.FLOATING))
                values = zip(coordinates, _to_coordinates(pose), strict=True)
                yield read_stamp(each), tuple([JointSample(name, value) for name, value in values])


def _name_joint(child: str, edge: TfEdge) -> str:
    return f"{edge.parent}_to_{child}"


def _to_coordinates(pose: Pose) -> Coordinates:
    return (*pose.xyz, *so3.logarithm(pose.wxyz))


def _read_transform(transform: Any) -> tuple[str, str, Pose] | None:
    """Return child, parent and pose of a transform; None for one that is no pose, or not within the vehicle."""
    parent, child = transform.header.frame_id.lstrip("/"), transform.child_frame_id.lstrip("/")
    if parent in WORLD_FRAMES or child in WORLD_FRAMES or not parent or parent == child:
        return None
    shift, turn = transform.transform.translation, transform.transform.rotation
    try:
        return child, parent, Pose((shift.x, shift.y, shift.z), (turn.w, turn.x, turn.y, turn.z))
    except ValueError:
        return None
