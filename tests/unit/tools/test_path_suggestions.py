"""A file that is not there: the nearest name beside it is offered."""

from __future__ import annotations

import errno
from pathlib import Path

import pytest

from mstools.cli import main
from mstools.terminal.output import find_nearest_path, suggest_path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "vehicle.yaml").write_text("")
    (tmp_path / "other.txt").write_text("")
    return tmp_path


def test_given_a_mistyped_name_then_the_path_beside_it_is_offered(folder: Path) -> None:
    assert find_nearest_path(folder / "vehicl.yaml") == str(folder / "vehicle.yaml")
    error = FileNotFoundError(errno.ENOENT, "gone", str(folder / "vehicl.yaml"))
    assert suggest_path(error) == f"; did you mean {folder / 'vehicle.yaml'}?"


def test_given_nothing_near_or_no_folder_then_nothing_is_offered(folder: Path) -> None:
    assert find_nearest_path(folder / "zzzzzz") == ""
    assert find_nearest_path(folder / "nowhere" / "vehicle.yaml") == ""
    assert find_nearest_path(folder / "vehicle.yaml" / "vehicle.yaml") == ""
    assert suggest_path(FileNotFoundError(errno.ENOENT, "gone")) == ""
    assert suggest_path(PermissionError(errno.EACCES, "closed", str(folder / "vehicl.yaml"))) == ""


def test_given_commands_with_a_mistyped_file_then_they_offer_the_nearest(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["tree", str(folder / "vehicl.yaml")])
    assert ended.value.code == 1
    assert f"did you mean {folder / 'vehicle.yaml'}?" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["check", str(folder / "vehicl.yaml")])
    output = capsys.readouterr()
    assert f"did you mean {folder / 'vehicle.yaml'}?" in output.out + output.err
