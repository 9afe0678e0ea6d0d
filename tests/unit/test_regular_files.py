"""Files are read with their limit before anything else; what is no regular file is rejected at once."""

from __future__ import annotations

import os
import signal
import socket
import stat
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from modelserver.config.vehicle_file import load_config
from modelserver.errors import ConfigError, GeometryError, KeyFileError, RecordingError
from modelserver.files import (
    FileTooLargeError,
    NotRegularFileError,
    open_regular,
    read_regular,
    read_start,
)
from modelserver.formats import load_model
from modelserver.key_files import read_keys
from modelserver.server.journal.verify import files_of
from modelserver.server.journal.writer import Ring
from modelserver.server.persistence import write_atomically
from modelserver.wire.eventlog import LogFile
from msdrivers.raw_log import open_for_reading, open_for_writing
from msdrivers.settings import SourceMap, make_driver, read_driver
from mstools.commands.replay import read_times
from mstools.recordings.bag_log import import_bag
from mstools.terminal.output import write_file


@contextmanager
def deadline(seconds: float = 20.0) -> Iterator[None]:
    """Fail a block that waits for a file, rather than hang."""

    def expire(*_: object) -> None:
        raise AssertionError(f"still reading after {seconds:g} s")

    before = signal.signal(signal.SIGALRM, expire)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def open_log(path: Path) -> None:
    with LogFile(path):
        pass


def read_dbc(path: Path) -> None:
    wheel = {"speed": {"signal": "Wheels.left"}}
    section = {"device": "wheels", "can": "vcan0", "dbc": str(path), "wheels": {"left": wheel}}
    make_driver(read_driver("wheels", section, SourceMap()), Path("/"))


def play(path: Path) -> None:
    open_for_reading(path, "gps", "novatel")


def record(path: Path) -> None:
    open_for_writing(path)


READERS = [
    load_model,
    load_config,
    read_keys,
    open_log,
    read_dbc,
    play,
    record,
    files_of,
    read_times,
]
REJECTED = (OSError, GeometryError, ConfigError, KeyFileError, RecordingError)


@pytest.mark.parametrize("read", READERS, ids=lambda each: each.__name__)
def test_given_a_fifo_when_it_is_to_be_read_then_it_is_rejected_and_nobody_waits(
    tmp_path: Path, read: Callable[[Path], object]
) -> None:
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)
    # where one would wait for a writer, the alarm ends the test
    with deadline(), pytest.raises(REJECTED, match=r"FIFO|is there already"):
        read(fifo)


@pytest.mark.parametrize("read", [each for each in READERS if each is not record], ids=lambda each: each.__name__)
def test_given_a_device_when_it_is_to_be_read_then_it_is_rejected(read: Callable[[Path], object]) -> None:
    with deadline(), pytest.raises(REJECTED, match="character device"):
        read(Path("/dev/zero"))


@pytest.mark.parametrize(
    "read", [each for each in READERS if each not in (record, files_of)], ids=lambda each: each.__name__
)
def test_given_a_directory_when_it_is_to_be_read_then_it_is_rejected(
    tmp_path: Path, read: Callable[[Path], object]
) -> None:
    with deadline(), pytest.raises(REJECTED, match="directory"):
        read(tmp_path)


@pytest.mark.parametrize("read", [load_model, load_config, read_keys, read_dbc, read_times])
def test_given_a_file_beyond_its_limit_when_it_is_to_be_read_then_it_is_rejected_unread(
    tmp_path: Path, read: Callable[[Path], object]
) -> None:
    huge = tmp_path / "huge"
    huge.touch(mode=0o600)
    # sparse: reading it all would take the memory
    os.truncate(huge, 1 << 40)
    with deadline(), pytest.raises((*REJECTED,), match=r"larger|too large|longer|not text"):
        read(huge)


def test_given_a_socket_then_it_is_named_as_such(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as held:
        held.bind(str(tmp_path / "socket"))
        with pytest.raises(NotRegularFileError, match="socket"):
            open_regular(tmp_path / "socket")


def test_given_a_file_of_proc_then_its_content_is_read_though_its_size_is_0() -> None:
    path = Path("/proc/self/status")
    assert path.stat().st_size == 0
    assert read_regular(path, 1 << 20).startswith(b"Name:")
    assert read_start(path, 5) == b"Name:"
    with pytest.raises(FileTooLargeError):
        read_regular(path, 10)


def test_given_a_link_then_what_it_names_is_read_or_rejected(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"content")
    (tmp_path / "link").symlink_to("file")
    assert read_regular(tmp_path / "link", 7) == b"content"
    (tmp_path / "device").symlink_to("/dev/zero")
    with pytest.raises(NotRegularFileError):
        read_regular(tmp_path / "device", 7)


def test_given_a_file_of_exactly_the_limit_then_it_is_read(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"12345678")
    assert read_regular(tmp_path / "file", 8) == b"12345678"
    with pytest.raises(FileTooLargeError, match="limit is 7 bytes"):
        read_regular(tmp_path / "file", 7)


def test_given_a_fifo_when_checked_then_check_ends_with_what_is_wrong(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo.yaml")
    command = [sys.executable, "-c", "from mstools.cli import main; main()", "check", str(tmp_path / "fifo.yaml")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 1
    assert "this is a FIFO (named pipe), not a geometry file" in done.stdout + done.stderr


# --- symbolic links of other users ----------------------------------------------------------------------------------


def plant_link(link: Path, target: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Make a symbolic link that belongs to another user than the test's."""
    link.symlink_to(target)
    if os.geteuid() == 0:
        os.lchown(link, 4242, -1)
    else:
        monkeypatch.setattr(os, "geteuid", lambda: 4242)


@pytest.mark.parametrize(
    "write",
    [
        lambda path: write_file(str(path), "text", replace=True),
        lambda path: write_atomically(path / "state", b"text"),
        lambda path: Ring(path / "journal", 1_000_000, 100_000).acquire(),
        lambda path: import_bag(Path("any.bag"), path),
    ],
    ids=["text", "state", "journal", "log"],
)
def test_given_a_link_of_another_user_when_something_is_written_then_the_link_is_named_and_not_followed(
    write: Callable[[Path], object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    chosen, link = tmp_path / "chosen", tmp_path / "link"
    plant_link(link, chosen, monkeypatch)
    with pytest.raises(OSError, match="symbolic link of another user") as caught:
        write(link)
    assert caught.value.filename == str(link)
    assert not chosen.exists()


def test_given_an_own_link_when_something_is_written_then_it_is_followed(tmp_path: Path) -> None:
    chosen, link = tmp_path / "chosen", tmp_path / "link"
    link.symlink_to(chosen)
    write_file(str(link), "text", replace=True)
    assert chosen.read_text() == "text"


def test_given_any_umask_when_the_state_directory_is_created_then_others_cannot_write_it(tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        write_atomically(tmp_path / "a" / "b" / "state", b"text")
    finally:
        os.umask(before)
    modes = [stat.S_IMODE((tmp_path / each).stat().st_mode) for each in ("a", "a/b", "a/b/state")]
    assert modes == [0o750, 0o750, 0o600]
