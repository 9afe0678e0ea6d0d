"""A failed start waits for a change of its files."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from modelserver.server.supervision import MAX_WAIT_S, POLL_S, FileWatcher


class Sleeper:
    """A clock that advances by sleeping; `act` is called at the `at`-th sleep."""

    def __init__(self, at: int = 0, happens: Callable[[], object] = lambda: None):
        self.now_ns = 7 * 10**9
        self.slept: list[float] = []
        self._at, self._happens = at, happens

    def sleep(self, seconds: float) -> None:
        self.slept.append(seconds)
        self.now_ns += round(seconds * 1e9)
        if len(self.slept) == self._at:
            self._happens()

    def waits(self, files: FileWatcher) -> bool:
        return files.wait_for_change(monotonic_ns=lambda: self.now_ns, sleep=self.sleep)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "vehicle.yaml"
    path.write_text("vehicle: cart\n")
    return path


def moved_in(path: Path) -> None:
    """Replace a file by another one of the same size and time."""
    status = path.stat()
    fresh = path.with_name("fresh")
    fresh.write_text(path.read_text())
    os.utime(fresh, ns=(status.st_atime_ns, status.st_mtime_ns))
    fresh.replace(path)


@pytest.mark.parametrize(
    "change",
    [
        lambda path: path.write_text("vehicle: carts\n"),
        lambda path: os.utime(path, ns=(1, 1)),
        lambda path: path.unlink(),
        moved_in,
        lambda path: path.with_name("geometry.yaml").write_text(""),
    ],
    ids=["size", "time", "gone", "another", "come"],
)
def test_given_a_file_that_changes_then_the_wait_is_over_at_the_next_look(
    file: Path, change: Callable[[Path], object]
) -> None:
    sleeper = Sleeper(8, lambda: change(file))
    assert sleeper.waits(FileWatcher(file, file.with_name("geometry.yaml")))
    assert sleeper.slept == [POLL_S] * 8


def test_given_files_that_stay_as_they_are_then_the_wait_ends_all_the_same(file: Path) -> None:
    sleeper = Sleeper()
    assert not sleeper.waits(FileWatcher(file, str(file.parent / "not there"), "\0", file / "below"))
    assert sum(sleeper.slept) == pytest.approx(MAX_WAIT_S)
    assert max(sleeper.slept) == POLL_S


def test_given_a_file_that_changed_since_it_was_first_named_then_nothing_is_waited_for(file: Path) -> None:
    files = FileWatcher(file)
    file.write_text("fixed\n")
    files.add(file)
    sleeper = Sleeper()
    assert sleeper.waits(files)
    assert sleeper.slept == []
