"""ROS bags, through the library rosbags: opened, listed and read, with one clear error for all that can be wrong."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from modelserver.errors import RecordingError

INSTALL = "pip install 'modelserver[bags]'"


@dataclass(frozen=True, slots=True)
class Topic:
    """One topic of a bag: its name, its type as ROS 2 writes it (sensor_msgs/msg/Imu), how many messages."""

    name: str
    type_name: str
    count: int


@dataclass(frozen=True, slots=True)
class Received:
    """One message of a bag: its topic, when the recorder received it (nanoseconds), what it says."""

    topic: str
    received_ns: int
    message: Any


class Bag:
    """An open bag."""

    def __init__(self, path: Path, reader: Any):
        self._path = path
        self._reader = reader
        counts: dict[tuple[str, str], int] = {}
        for connection in reader.connections:
            key = (connection.topic, connection.msgtype)
            counts[key] = counts.get(key, 0) + connection.msgcount
        self.topics = tuple(Topic(name, type_name, count) for (name, type_name), count in sorted(counts.items()))

    def messages(self, topics: set[str]) -> Iterator[Received]:
        """Yield the messages of some topics in the order they were received. Raises RecordingError."""
        connections = [each for each in self._reader.connections if each.topic in topics]
        stream = iter(self._reader.messages(connections=connections)) if connections else iter(())
        count = 0
        while True:
            with _explained(self._path, f"after {count} messages"):
                try:
                    connection, received_ns, raw = next(stream)
                except StopIteration:
                    return
                message = self._reader.deserialize(raw, connection.msgtype)
            count += 1
            yield Received(connection.topic, received_ns, message)


@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """Open a bag: a ROS 1 file, or the folder of a ROS 2 recording. Raises RecordingError, OSError."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise RecordingError(f"reading bags needs the library rosbags ({error}): {INSTALL}") from None
    if path.is_file():
        with path.open("rb") as file:
            if path.suffix == ".bag" and not file.read(9).startswith(b"#ROSBAG V"):
                raise RecordingError(f"{path}: not a ROS bag: it does not begin with #ROSBAG")
    elif not path.is_dir():
        # a FIFO or a device would be waited for
        raise RecordingError(f"{path}: {'neither a file nor a folder' if path.exists() else 'no such file'}")
    reader = None
    with _explained(path, "on opening it"):
        # ROS 2 bags may come without their type definitions; those of ROS itself have been stable
        reader = AnyReader([path], default_typestore=get_typestore(Stores.LATEST))
        reader.open()
    try:
        yield Bag(path, reader)
    finally:
        reader.close()


@contextmanager
def _explained(path: Path, place: str) -> Iterator[None]:
    """Turn whatever the library raises on a damaged bag into one readable error."""
    try:
        yield
    except (RecordingError, OSError, MemoryError):
        raise
    except Exception as error:  # the library promises no set of exceptions for damaged bytes
        what = str(error).strip() or type(error).__name__
        raise RecordingError(
            f"{path}: the bag cannot be read {place}: {what.rstrip('.')}. It may be cut short or never have been "
            "closed; `rosbag reindex` mends such bags of ROS 1, `ros2 bag reindex` those of ROS 2"
        ) from None
