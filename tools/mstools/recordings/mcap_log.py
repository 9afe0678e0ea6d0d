"""The LCM messages in an MCAP file, as `modelserver export` writes them (/lcm/CHANNEL): the reverse of the export."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Final, NamedTuple

from modelserver.errors import RecordingError
from mstools.recordings.bag_reader import explain_each, explain_errors, open_bag

MAGIC: Final = b"\x89MCAP0\r\n"
ENCODING: Final = "lcm"
ROS_ENCODING: Final = "cdr"
TOPIC_PREFIX: Final = "/lcm/"
REMEDY: Final = "`mcap recover` repairs such files"


class RecordedMessage(NamedTuple):
    """A message of a channel, received at `utime`, microseconds."""

    utime: int
    channel: str
    data: bytes


class McapLog:
    """An MCAP file: `channels` has the LCM channels with their types and counts of messages.

    has_ros: whether it has messages of ROS 2.
    """

    def __init__(self, path: Path, file: IO[bytes]):
        from mcap.reader import make_reader

        self._path = path
        with explain_errors(path, "on opening it", "MCAP file", REMEDY):
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

    def read(self) -> Iterator[RecordedMessage]:
        """Yield the messages in the order of the file."""
        topics = [f"{TOPIC_PREFIX}{each}" for each in self.channels]
        stream = self._reader.iter_messages(topics=topics, log_time_order=False)
        for _, channel, message in explain_each(stream, self._path, "MCAP file", REMEDY):
            yield RecordedMessage(message.log_time // 1000, channel.topic.removeprefix(TOPIC_PREFIX), message.data)


def is_mcap(path: Path) -> bool:
    """Return whether a path is an MCAP file, by its first bytes. Raises OSError."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(MAGIC)) == MAGIC


def is_ros_mcap(path: Path) -> bool:
    """Return whether a path is an MCAP file of ROS 2, also one whose end is missing. Raises OSError."""
    if not is_mcap(path):
        return False
    try:
        with open_mcap(path) as mcap:
            return mcap.has_ros and not mcap.channels
    except RecordingError:
        # the reader of bags reads one that was not closed
        with suppress(RecordingError), open_bag(path) as bag:
            return bool(bag.topics)
    return False


@contextmanager
def open_mcap(path: Path) -> Iterator[McapLog]:
    """Open an MCAP file. Raises RecordingError for one that is damaged, or without the library; OSError."""
    try:
        import mcap  # noqa: F401
    except ImportError:
        raise RecordingError("reading MCAP files needs the library mcap: pip install 'modelserver[bags]'") from None
    with path.open("rb") as file:
        yield McapLog(path, file)
