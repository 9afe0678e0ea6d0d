"""Files that are written whole or not at all, and what is never written over."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest

from modelserver.errors import ModelServerError
from mstools.terminal.output import check_writable, open_atomic, write_file


def test_given_an_error_half_way_then_the_file_is_as_it_was(tmp_path: Path) -> None:
    target = tmp_path / "poses.csv"
    target.write_text("old")
    with pytest.raises(ZeroDivisionError), open_atomic(str(target), replace=True) as stream:
        stream.write(f"half{1 / 0}")
    assert target.read_text() == "old"
    assert os.listdir(tmp_path) == ["poses.csv"]


def test_given_a_good_end_then_the_file_is_there_whole(tmp_path: Path) -> None:
    target = tmp_path / "poses.csv"
    with open_atomic(str(target), replace=True) as stream:
        stream.write("new\n")
    assert target.read_bytes() == b"new\n"


def test_given_a_file_that_exists_then_it_is_replaced_only_with_force(tmp_path: Path) -> None:
    target = tmp_path / "a.yaml"
    write_file(str(target), "one", replace=False)
    with pytest.raises(ModelServerError, match="already exists"):
        write_file(str(target), "two", replace=False)
    assert target.read_text() == "one"
    write_file(str(target), "two", replace=True)
    assert target.read_text() == "two"


def test_given_a_pipe_then_it_is_written_to_and_stays_a_pipe(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    try:
        write_file(str(pipe), "through", replace=True)
        assert os.read(reader, 100) == b"through"
        assert stat.S_ISFIFO(pipe.stat().st_mode)
    finally:
        os.close(reader)


def test_given_a_folder_that_is_not_there_then_the_target_is_named_and_not_a_draft(tmp_path: Path) -> None:
    target = tmp_path / "none" / "a.txt"
    with pytest.raises(ModelServerError, match=f"{target} cannot be written: folder {target.parent}"):
        check_writable(str(target))
    with pytest.raises(OSError, match="No such file") as caught:
        write_file(str(target), "text", replace=True)
    assert caught.value.filename == str(target)


def test_given_targets_that_can_be_written_then_there_is_no_objection(tmp_path: Path) -> None:
    (tmp_path / "there.txt").write_text("old")
    for target in ("", "-", tmp_path / "new.txt", tmp_path / "there.txt", os.devnull):
        check_writable(str(target))
    with pytest.raises(ModelServerError, match="is a directory"):
        check_writable(str(tmp_path))
