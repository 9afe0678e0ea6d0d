"""Reader of ROS bags (library rosbags), with one clear error for all that can be wrong."""

from __future__ import annotations

import errno
import itertools
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeVar

from modelserver.errors import RecordingError

INSTALL = "pip install 'modelserver[bags]'"
REMEDY: Final = "`rosbag reindex` repairs such bags of ROS 1, `ros2 bag reindex` those of ROS 2"


M = TypeVar("M")


@dataclass(frozen=True, slots=True)
class Topic:
    """One topic of a bag: its name, its type in ROS 2 notation (sensor_msgs/msg/Imu), number of messages."""

    name: str
    type_name: str
    count: int


class Bag:
    """An open bag."""

    def __init__(self, path: Path, reader: Any):
        self._path = path
        self._reader = reader
        counts: Counter[tuple[str, str]] = Counter()
        for each in reader.connections:
            counts[each.topic, each.msgtype] += each.msgcount
        self.topics = tuple(Topic(*names, count) for names, count in sorted(counts.items()))

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
        raise RecordingError(f"reading bags needs the library rosbags ({error}): {INSTALL}") from None
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


def explain_each(messages: Iterable[M], path: Path, kind: str = "bag", remedy: str = REMEDY) -> Iterator[M]:
    """Yield what a library reads from a file, with `explain_errors`."""
    stream = iter(messages)
    for count in itertools.count():
        with explain_errors(path, f"after {count} messages", kind, remedy):
            found = next(stream, None)
        if found is None:
            return
        yield found


@contextmanager
def explain_errors(path: Path, place: str, kind: str = "bag", remedy: str = REMEDY) -> Iterator[None]:
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
