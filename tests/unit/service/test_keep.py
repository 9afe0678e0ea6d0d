"""The kept origin: whole or not at all, and never a reason not to start."""

from __future__ import annotations

import dataclasses
import json
import logging
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from support_samples import ORIGIN

from modelserver.service.keeping.origin import OriginKeeper, default_directory

GOOD = {"version": 1, **dataclasses.asdict(ORIGIN)}


@pytest.fixture
def keeper(tmp_path: Path) -> OriginKeeper:
    return OriginKeeper(tmp_path, "cart")


def test_given_an_origin_that_was_kept_then_it_comes_back_to_the_bit(keeper: OriginKeeper) -> None:
    keeper.save(ORIGIN)
    assert keeper.load() == ORIGIN
    other = dataclasses.replace(ORIGIN, easting=ORIGIN.easting + 0.1, origin_id=5)
    keeper.save(other)
    assert keeper.load() == other
    assert [path.name for path in keeper.path.parent.iterdir()] == ["origin-cart.json"]


def test_given_nothing_kept_then_there_is_none_and_no_word_about_it(
    keeper: OriginKeeper, caplog: pytest.LogCaptureFixture
) -> None:
    assert keeper.load() is None
    assert not caplog.records


def test_given_directories_that_are_not_there_then_they_are_made(tmp_path: Path) -> None:
    keeper = OriginKeeper(tmp_path / "a" / "b", "cart")
    keeper.save(ORIGIN)
    assert keeper.load() == ORIGIN


@pytest.mark.parametrize("name", ["../../etc/passwd", "a/b", "..", "", "a\0b", "a b", "Ä\n"])
def test_given_any_vehicle_name_then_the_file_stays_in_its_directory(tmp_path: Path, name: str) -> None:
    keeper = OriginKeeper(tmp_path, name)
    keeper.save(ORIGIN)
    assert keeper.load() == ORIGIN
    assert keeper.path.parent == tmp_path
    assert len(list(tmp_path.iterdir())) == 1


def _without(key: str) -> dict[str, Any]:
    return {name: value for name, value in GOOD.items() if name != key}


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\0" * 300,
        b"\xff\xfe",
        b"{",
        json.dumps(GOOD).encode()[:-20],
        b"[" * 3000,
        b"[" * 1_000_000,
        b"null",
        b"[]",
        b"7",
        b'"text"',
        *(json.dumps(_without(key)).encode() for key in GOOD),
        *(
            json.dumps(GOOD | change).encode()
            for change in (
                {"version": 2},
                {"version": "1"},
                {"zone": 0},
                {"zone": 61},
                {"zone": 12.0},
                {"zone": True},
                {"north": 1},
                {"north": None},
                {"easting": None},
                {"easting": "east"},
                {"easting": 1e7},
                {"northing": -1.0},
                {"northing": 1.1e7},
                {"height": float("nan")},
                {"height": float("inf")},
                {"height": 10**400},
                {"origin_id": 0},
                {"origin_id": -1},
                {"origin_id": 1 << 63},
                {"origin_id": 1.5},
                {"origin_id": None},
            )
        ),
    ],
)
def test_given_a_damaged_file_then_it_is_logged_and_a_new_origin_is_captured(
    keeper: OriginKeeper, caplog: pytest.LogCaptureFixture, content: bytes
) -> None:
    keeper.path.write_bytes(content)
    assert keeper.load() is None
    (record,) = caplog.records
    assert str(keeper.path) in record.getMessage()
    assert "a new one will be captured" in record.getMessage()
    assert record.getMessage().isprintable()
    assert len(record.getMessage()) < 1000
    # and the next one replaces it
    keeper.save(ORIGIN)
    assert keeper.load() == ORIGIN


def test_given_a_directory_in_its_place_then_neither_reading_nor_writing_raises(
    keeper: OriginKeeper, caplog: pytest.LogCaptureFixture
) -> None:
    keeper.path.mkdir()
    assert keeper.load() is None
    keeper.save(ORIGIN)
    assert len(caplog.records) == 2
    assert [path.name for path in keeper.path.parent.iterdir()] == ["origin-cart.json"]


def test_given_a_directory_that_cannot_be_made_then_the_daemon_goes_on(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").write_text("")
    keeper = OriginKeeper(tmp_path / "file", "cart")
    keeper.save(ORIGIN)
    assert keeper.load() is None
    assert "A restart will capture a new one" in caplog.records[0].getMessage()


@pytest.mark.skipif(os.geteuid() == 0, reason="root writes into read-only directories")
def test_given_a_read_only_directory_then_the_daemon_goes_on(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    tmp_path.chmod(0o500)
    try:
        OriginKeeper(tmp_path, "cart").save(ORIGIN)
    finally:
        tmp_path.chmod(0o700)
    assert len(caplog.records) == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("failing", ["os.fsync", "pathlib.Path.replace"])
def test_given_a_disk_that_refuses_half_way_then_the_old_origin_stays_and_nothing_is_left_over(
    keeper: OriginKeeper, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, failing: str
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(28, "No space left on device")

    keeper.save(ORIGIN)
    with monkeypatch.context() as patched:
        patched.setattr(failing, refuse)
        keeper.save(dataclasses.replace(ORIGIN, origin_id=9))
    assert "No space left on device" in caplog.records[0].getMessage()
    assert caplog.records[0].levelno == logging.WARNING
    assert keeper.load() == ORIGIN
    assert [path.name for path in keeper.path.parent.iterdir()] == ["origin-cart.json"]


KILLED = """
import os, signal, sys
from pathlib import Path
from modelserver.earth.geodesy import make_origin
from modelserver.service.keeping.origin import OriginKeeper
def kill(*_): os.kill(os.getpid(), signal.SIGKILL)
if sys.argv[2] == "sync": os.fsync = kill
else: Path.replace = kill
OriginKeeper(Path(sys.argv[1]), "cart").save(make_origin(500000.0, 5000000.0, 0.0, 12, True))
"""


@pytest.mark.parametrize("when", ["sync", "rename"])
def test_given_a_kill_half_way_then_the_old_origin_is_whole(keeper: OriginKeeper, when: str) -> None:
    keeper.save(ORIGIN)
    done = subprocess.run([sys.executable, "-c", KILLED, keeper.path.parent, when], timeout=60)
    assert done.returncode == -signal.SIGKILL
    assert keeper.load() == ORIGIN
    keeper.save(dataclasses.replace(ORIGIN, origin_id=9))
    assert keeper.load() == dataclasses.replace(ORIGIN, origin_id=9)


@pytest.mark.parametrize(
    ("environment", "expected"),
    [
        ({"STATE_DIRECTORY": "/var/lib/modelserver"}, "/var/lib/modelserver"),
        ({"STATE_DIRECTORY": "/var/lib/a:/var/lib/b"}, "/var/lib/a"),
        ({"XDG_STATE_HOME": "/x"}, "/x/modelserver"),
        ({"HOME": "/home/me"}, "/home/me/.local/state/modelserver"),
        ({"STATE_DIRECTORY": "", "XDG_STATE_HOME": "", "HOME": "/home/me"}, "/home/me/.local/state/modelserver"),
    ],
)
def test_given_the_environment_then_the_state_directory_follows_it(
    monkeypatch: pytest.MonkeyPatch, environment: dict[str, str], expected: str
) -> None:
    for name in ("STATE_DIRECTORY", "XDG_STATE_HOME"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    assert default_directory() == Path(expected)
