"""The stored origin: valid or not used, and never a reason not to start."""

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

from modelserver.server.persistence import OriginStore, get_state_directory

GOOD = {"version": 1, **dataclasses.asdict(ORIGIN)}


@pytest.fixture
def store(tmp_path: Path) -> OriginStore:
    return OriginStore(tmp_path, "cart")


def test_given_a_saved_origin_then_it_is_loaded_bit_for_bit(store: OriginStore) -> None:
    store.save(ORIGIN)
    assert store.load() == ORIGIN
    other = dataclasses.replace(ORIGIN, easting=ORIGIN.easting + 0.1, origin_id=5)
    store.save(other)
    assert store.load() == other
    assert [path.name for path in store.path.parent.iterdir()] == ["origin-cart.json"]


def test_given_no_file_then_there_is_no_origin_and_no_log_entry(
    store: OriginStore, caplog: pytest.LogCaptureFixture
) -> None:
    assert store.load() is None
    assert not caplog.records


def test_given_directories_that_are_not_there_then_they_are_made(tmp_path: Path) -> None:
    store = OriginStore(tmp_path / "a" / "b", "cart")
    store.save(ORIGIN)
    assert store.load() == ORIGIN


@pytest.mark.parametrize("name", ["../../etc/passwd", "a/b", "..", "", "a\0b", "a b", "Ä\n"])
def test_given_any_vehicle_name_then_the_file_stays_in_its_directory(tmp_path: Path, name: str) -> None:
    store = OriginStore(tmp_path, name)
    store.save(ORIGIN)
    assert store.load() == ORIGIN
    assert store.path.parent == tmp_path
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
    store: OriginStore, caplog: pytest.LogCaptureFixture, content: bytes
) -> None:
    store.path.write_bytes(content)
    assert store.load() is None
    (record,) = caplog.records
    assert str(store.path) in record.getMessage()
    assert "a new one will be captured" in record.getMessage()
    assert record.getMessage().isprintable()
    assert len(record.getMessage()) < 1000
    # and the next one replaces it
    store.save(ORIGIN)
    assert store.load() == ORIGIN


def test_given_a_directory_in_its_place_then_neither_reading_nor_writing_raises(
    store: OriginStore, caplog: pytest.LogCaptureFixture
) -> None:
    store.path.mkdir()
    assert store.load() is None
    store.save(ORIGIN)
    assert len(caplog.records) == 2
    assert [path.name for path in store.path.parent.iterdir()] == ["origin-cart.json"]


def test_given_a_directory_that_cannot_be_created_then_the_daemon_continues(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").write_text("")
    store = OriginStore(tmp_path / "file", "cart")
    store.save(ORIGIN)
    assert store.load() is None
    assert "The next start will capture a new one" in caplog.records[0].getMessage()


@pytest.mark.skipif(os.geteuid() == 0, reason="root writes into read-only directories")
def test_given_a_read_only_directory_then_the_daemon_continues(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    tmp_path.chmod(0o500)
    try:
        OriginStore(tmp_path, "cart").save(ORIGIN)
    finally:
        tmp_path.chmod(0o700)
    assert len(caplog.records) == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("failing", ["os.fsync", "pathlib.Path.replace"])
def test_given_a_disk_that_refuses_half_way_then_the_old_origin_stays_and_nothing_is_left_over(
    store: OriginStore, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, failing: str
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(28, "No space left on device")

    store.save(ORIGIN)
    with monkeypatch.context() as patched:
        patched.setattr(failing, refuse)
        store.save(dataclasses.replace(ORIGIN, origin_id=9))
    assert "No space left on device" in caplog.records[0].getMessage()
    assert caplog.records[0].levelno == logging.WARNING
    assert store.load() == ORIGIN
    assert [path.name for path in store.path.parent.iterdir()] == ["origin-cart.json"]


KILLED = """
import os, signal, sys
from pathlib import Path
from modelserver.earth.geodesy import make_origin
from modelserver.server.persistence import OriginStore
def kill(*_): os.kill(os.getpid(), signal.SIGKILL)
if sys.argv[2] == "sync": os.fsync = kill
else: Path.replace = kill
OriginStore(Path(sys.argv[1]), "cart").save(make_origin(500000.0, 5000000.0, 0.0, 12, True))
"""


@pytest.mark.slow
@pytest.mark.parametrize("when", ["sync", "rename"])
def test_given_a_kill_half_way_then_the_old_origin_is_intact(store: OriginStore, when: str) -> None:
    store.save(ORIGIN)
    done = subprocess.run([sys.executable, "-c", KILLED, store.path.parent, when], timeout=60)
    assert done.returncode == -signal.SIGKILL
    assert store.load() == ORIGIN
    store.save(dataclasses.replace(ORIGIN, origin_id=9))
    assert store.load() == dataclasses.replace(ORIGIN, origin_id=9)


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
    assert get_state_directory("") == Path(expected)
