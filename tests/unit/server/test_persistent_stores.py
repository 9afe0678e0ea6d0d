"""One state directory, two services: the second one serves without persistence until the first has ended."""

from __future__ import annotations

import errno
import logging
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from support_persistence import PERSISTED
from support_samples import VEHICLE, write_vehicle

from modelserver.config.vehicle_file import VehicleConfig, load_config
from modelserver.core import Instant
from modelserver.earth.geodesy import make_origin
from modelserver.server.persistence import FileLock, LockHeldError, PersistentStores, describe_error, open_stores

ORIGIN = make_origin(500_000.0, 5_500_000.0, 700.0, 12, True)
NOW = Instant(PERSISTED.monotonic_ns, PERSISTED.utime)


@pytest.fixture
def config(tmp_path: Path) -> VehicleConfig:
    return load_config(write_vehicle(tmp_path, VEHICLE))


@pytest.fixture
def first(config: VehicleConfig) -> Iterator[PersistentStores]:
    store = open_stores(config, localizes=True)
    yield store
    store.close()


def restore_reason(store: PersistentStores) -> str:
    assert store.state is not None
    return store.state.restore(NOW, 1e9, 1e9).reason


# --- the lock -------------------------------------------------------------------------------------------------------


def test_given_a_held_lock_then_the_next_attempt_names_its_holder(tmp_path: Path) -> None:
    lock, other = FileLock(tmp_path / "lock"), FileLock(tmp_path / "lock")
    lock.acquire()
    lock.acquire()
    assert lock.path.read_text() == f"{os.getpid()}\n"
    assert lock.path.stat().st_mode & 0o777 == 0o640
    with pytest.raises(LockHeldError, match=f"process {os.getpid()}") as caught:
        other.acquire()
    assert caught.value.pid == os.getpid()
    lock.release()
    lock.release()
    other.acquire()
    other.release()


@pytest.mark.parametrize("content", ["", "x", "-1\n", "9" * 30, "\0" * 8])
def test_given_a_lock_file_without_a_pid_then_the_holder_is_another_service(tmp_path: Path, content: str) -> None:
    lock = FileLock(tmp_path / "lock")
    lock.acquire()
    lock.path.write_text(content)
    with pytest.raises(LockHeldError, match="another service") as caught:
        FileLock(lock.path).acquire()
    assert (caught.value.pid == 0) == (not content.startswith("9"))
    lock.release()


def test_given_a_recreated_directory_then_its_own_lock_counts(tmp_path: Path) -> None:
    lock = FileLock(tmp_path / "state" / "lock")
    lock.claim()
    shutil.rmtree(tmp_path / "state")
    with pytest.raises(FileNotFoundError):
        lock.acquire()
    lock.claim()
    with pytest.raises(LockHeldError):
        FileLock(lock.path).acquire()
    lock.release()


def test_given_a_directory_that_cannot_be_used_then_no_lock_keeps_anybody_off(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    lock = FileLock(tmp_path / "file" / "lock")
    lock.claim()
    with pytest.raises(NotADirectoryError):
        lock.acquire()


HOLDING = """
import sys
from pathlib import Path
from modelserver.server.persistence import FileLock
FileLock(Path(sys.argv[1])).acquire()
print("held", flush=True)
sys.stdin.read()
"""


def test_given_a_holder_that_is_killed_then_its_lock_is_gone(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    with subprocess.Popen(
        [sys.executable, "-c", HOLDING, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "held\n"
        with pytest.raises(LockHeldError) as caught:
            FileLock(path).acquire()
        assert caught.value.pid == process.pid
        process.send_signal(signal.SIGKILL)
    lock = FileLock(path)
    lock.acquire()
    lock.release()


# --- origin, state and journal --------------------------------------------------------------------------------------


def test_given_one_service_then_it_persists_without_a_warning(first: PersistentStores, tmp_path: Path) -> None:
    assert first.warning == ""
    assert first.origin is not None
    assert first.state is not None
    first.origin.save(ORIGIN)
    first.state.close(PERSISTED)
    assert sorted(path.name for path in (tmp_path / "state").iterdir()) == [
        "lock-cart",
        "origin-cart.json",
        "state-cart.json",
    ]


def test_given_a_second_service_then_it_names_the_holder_of_the_directory_and_writes_nothing_there(
    first: PersistentStores, config: VehicleConfig, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    state = tmp_path / "state"
    assert first.origin is not None
    assert first.state is not None
    first.origin.save(ORIGIN)
    first.state.close(PERSISTED)
    (state / "state-cart.jsonhalf").write_bytes(b"the first one is writing it")
    before = {path: path.read_bytes() for path in state.iterdir()}
    second = open_stores(config, localizes=True)
    assert second.warning == (
        f"no state is stored for a warm start in {state}: another service (process {os.getpid()}) writes there "
        "already; stop one of the two, or set another state_directory in the vehicle file of this one"
    )
    assert [each.levelname for each in caplog.records] == ["WARNING"]
    assert second.origin is not None
    assert second.state is not None
    # it may read the origin, but restores no pose of the other service
    assert second.origin.load() == ORIGIN
    assert "which is running" in restore_reason(second)
    second.origin.save(make_origin(400_000.0, 5_400_000.0, 7.0, 12, True))
    second.state.close(PERSISTED._replace(vehicle="another"))
    # logged once, and a warning for as long as it lasts
    assert second.state.save(PERSISTED) == second.warning
    assert sum("no state is stored" in each.getMessage() for each in caplog.records) == 1
    assert {path: path.read_bytes() for path in state.iterdir()} == before


def test_given_the_first_ended_then_the_second_keeps_from_then_on(
    first: PersistentStores, config: VehicleConfig, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    second = open_stores(config, localizes=True)
    assert second.state is not None
    first.close()
    second.state.save(PERSISTED)
    second.state.close()
    assert second.state.save(PERSISTED) == ""
    assert "stored again" in caplog.records[-1].getMessage()
    assert restore_reason(second) == ""
    second.close()


@pytest.mark.parametrize(
    ("more", "localizes", "keeps"),
    [
        ("", True, (True, True)),
        ("", False, (True, False)),
        ("warm_start: {persist: false}\n", True, (True, False)),
        ("origin: {persist: false}\n", True, (False, True)),
        ("origin: {persist: false}\nwarm_start: {persist: false}\n", True, (False, False)),
    ],
)
def test_given_a_vehicle_file_then_the_configured_stores_are_opened_and_no_unused_directory_is_created(
    tmp_path: Path, more: str, localizes: bool, keeps: tuple[bool, bool]
) -> None:
    store = open_stores(load_config(write_vehicle(tmp_path, VEHICLE + more)), localizes)
    assert (store.origin is not None, store.state is not None) == keeps
    assert (tmp_path / "state").exists() == any(keeps)
    store.close()


def test_given_two_vehicles_then_they_share_a_directory(first: PersistentStores, tmp_path: Path) -> None:
    other = open_stores(load_config(write_vehicle(tmp_path, VEHICLE.replace("cart", "van"))), localizes=True)
    assert (first.warning, other.warning) == ("", "")
    other.close()


def test_given_a_user_without_a_home_then_nothing_is_persisted_and_that_is_logged(
    config: VehicleConfig, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    from dataclasses import replace

    from modelserver.server import persistence as stores

    monkeypatch.setattr(stores, "get_state_directory", lambda named: None)
    open_stores(replace(config, state_directory=""), localizes=True).close()
    assert "no home directory" in caplog.text


# --- messages -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("number", "remedy"),
    [
        (errno.ENOSPC, "df -h '/x y'"),
        (errno.EACCES, f"sudo chown -R {os.geteuid()} '/x y'"),
        (errno.EROFS, "set a writable journal.directory in the vehicle file"),
        (errno.ENOTDIR, "ls -ld '/x y'"),
        (errno.EIO, "dmesg"),
    ],
)
def test_given_a_disk_error_then_its_description_has_a_remedy(number: int, remedy: str) -> None:
    text = describe_error(OSError(number, os.strerror(number), "/x\n"), Path("/x y"), "journal.directory")
    assert text.startswith(f"{os.strerror(number)} (/x\\n); ")
    # the temporary name differs each time, and would be logged each time
    same = describe_error(
        OSError(number, os.strerror(number), "/x y/state.jsonab12"), Path("/x y"), "journal.directory"
    )
    assert same == text.replace(" (/x\\n)", "")
    assert remedy in text
    assert text.isprintable()
