"""One state directory, two services: the second serves and keeps nothing, until the first has ended however it did."""

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
from typing import Any

import pytest
from support_journal import SMALL
from support_journal import Kept as Journalled
from support_samples import VEHICLE, write_vehicle
from support_signing import write_test_key

from modelserver.config import VehicleConfig, load_config
from modelserver.core import Instant
from modelserver.earth.geodesy import make_origin
from modelserver.service.clock import SystemClock
from modelserver.service.journal.place import make_writer
from modelserver.service.journal.ring import Ring
from modelserver.service.keeping.lock import HeldError, Lock
from modelserver.service.keeping.store import Store, open_store
from modelserver.service.keeping.trouble import words_on
from tests.support_kept import KEPT

ORIGIN = make_origin(500_000.0, 5_500_000.0, 700.0, 12, True)
NOW = Instant(KEPT.monotonic_ns, KEPT.utime)


@pytest.fixture
def config(tmp_path: Path) -> VehicleConfig:
    return load_config(write_vehicle(tmp_path, VEHICLE))


@pytest.fixture
def first(config: VehicleConfig) -> Iterator[Store]:
    store = open_store(config, localizes=True)
    yield store
    store.close()


def recalled_why(store: Store) -> str:
    assert store.state is not None
    return store.state.recall(NOW, 1e9, 1e9).why


# --- the lock -------------------------------------------------------------------------------------------------------


def test_given_a_lock_then_one_holds_it_and_who_asks_next_is_told_who(tmp_path: Path) -> None:
    lock, other = Lock(tmp_path / "lock"), Lock(tmp_path / "lock")
    lock.hold()
    lock.hold()
    assert lock.path.read_text() == f"{os.getpid()}\n"
    assert lock.path.stat().st_mode & 0o777 == 0o640
    with pytest.raises(HeldError, match=f"process {os.getpid()}") as caught:
        other.hold()
    assert caught.value.pid == os.getpid()
    lock.release()
    lock.release()
    other.hold()
    other.release()


@pytest.mark.parametrize("content", ["", "x", "-1\n", "9" * 30, "\0" * 8])
def test_given_a_lock_file_that_tells_nothing_then_the_holder_is_another_service(tmp_path: Path, content: str) -> None:
    lock = Lock(tmp_path / "lock")
    lock.hold()
    lock.path.write_text(content)
    with pytest.raises(HeldError, match="another service") as caught:
        Lock(lock.path).hold()
    assert (caught.value.pid == 0) == (not content.startswith("9"))
    lock.release()


def test_given_a_directory_that_was_made_anew_then_its_own_lock_counts(tmp_path: Path) -> None:
    lock = Lock(tmp_path / "state" / "lock")
    lock.claim()
    shutil.rmtree(tmp_path / "state")
    with pytest.raises(FileNotFoundError):
        lock.hold()
    lock.claim()
    with pytest.raises(HeldError):
        Lock(lock.path).hold()
    lock.release()


def test_given_a_directory_that_cannot_be_used_then_no_lock_keeps_anybody_off(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    lock = Lock(tmp_path / "file" / "lock")
    lock.claim()
    with pytest.raises(NotADirectoryError):
        lock.hold()


HOLDING = """
import sys
from pathlib import Path
from modelserver.service.keeping.lock import Lock
Lock(Path(sys.argv[1])).hold()
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
        with pytest.raises(HeldError) as caught:
            Lock(path).hold()
        assert caught.value.pid == process.pid
        process.send_signal(signal.SIGKILL)
    lock = Lock(path)
    lock.hold()
    lock.release()


# --- origin, state and journal --------------------------------------------------------------------------------------


def test_given_a_service_alone_then_it_keeps_and_nothing_is_said(first: Store, tmp_path: Path) -> None:
    assert first.trouble == ""
    assert first.origin is not None
    assert first.state is not None
    first.origin.save(ORIGIN)
    first.state.close(KEPT)
    assert sorted(path.name for path in (tmp_path / "state").iterdir()) == [
        "lock-cart",
        "origin-cart.json",
        "state-cart.json",
    ]


def test_given_a_second_service_then_it_says_whose_the_directory_is_and_writes_nothing_there(
    first: Store, config: VehicleConfig, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    state = tmp_path / "state"
    assert first.origin is not None
    assert first.state is not None
    first.origin.save(ORIGIN)
    first.state.close(KEPT)
    (state / "state-cart.jsonhalf").write_bytes(b"the first one is writing it")
    before = {path: path.read_bytes() for path in state.iterdir()}
    second = open_store(config, localizes=True)
    assert second.trouble == (
        f"nothing is kept for a restart in {state}: another service (process {os.getpid()}) writes there already; end "
        "one of the two, or name a state_directory of its own in this one's vehicle file"
    )
    assert [each.levelname for each in caplog.records] == ["WARNING"]
    assert second.origin is not None
    assert second.state is not None
    # it may read where the world's origin is, and takes no pose from the other
    assert second.origin.load() == ORIGIN
    assert "which is running" in recalled_why(second)
    second.origin.save(make_origin(400_000.0, 5_400_000.0, 7.0, 12, True))
    second.state.close(KEPT._replace(vehicle="another"))
    # said once, and for as long as it is so
    assert second.state.keep(KEPT) == second.trouble
    assert sum("nothing is kept" in each.getMessage() for each in caplog.records) == 1
    assert {path: path.read_bytes() for path in state.iterdir()} == before


def test_given_the_first_ended_then_the_second_keeps_from_then_on(
    first: Store, config: VehicleConfig, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    second = open_store(config, localizes=True)
    assert second.state is not None
    first.close()
    second.state.keep(KEPT)
    second.state.close()
    assert second.state.keep(KEPT) == ""
    assert "kept again" in caplog.records[-1].getMessage()
    assert recalled_why(second) == ""
    second.close()


@pytest.mark.parametrize(
    ("more", "localizes", "keeps"),
    [
        ("", True, (True, True)),
        ("", False, (True, False)),
        ("restart: {keep: false}\n", True, (True, False)),
        ("origin: {keep: false}\n", True, (False, True)),
        ("origin: {keep: false}\nrestart: {keep: false}\n", True, (False, False)),
    ],
)
def test_given_a_vehicle_file_then_it_keeps_what_that_says_and_makes_no_directory_for_nothing(
    tmp_path: Path, more: str, localizes: bool, keeps: tuple[bool, bool]
) -> None:
    store = open_store(load_config(write_vehicle(tmp_path, VEHICLE + more)), localizes)
    assert (store.origin is not None, store.state is not None) == keeps
    assert (tmp_path / "state").exists() == any(keeps)
    store.close()


def test_given_two_vehicles_then_they_share_a_directory(first: Store, tmp_path: Path) -> None:
    other = open_store(load_config(write_vehicle(tmp_path, VEHICLE.replace("cart", "van"))), localizes=True)
    assert (first.trouble, other.trouble) == ("", "")
    other.close()


def test_given_a_user_without_a_home_then_nothing_is_kept_and_that_is_said(
    config: VehicleConfig, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    from dataclasses import replace

    from modelserver.service.keeping import store

    monkeypatch.setattr(store, "state_directory", lambda named: None)
    open_store(replace(config, state_directory=""), localizes=True).close()
    assert "no home directory" in caplog.text


def test_given_a_state_directory_of_anothers_then_no_journal_is_kept_in_it(tmp_path: Path) -> None:
    holder = Lock(tmp_path / "lock-cart")
    holder.hold()
    within = Lock(tmp_path / "lock-cart")

    def ring(directory: Path, *bounds: Any) -> Ring:
        return Ring(directory, *bounds, within)

    kept = Journalled(tmp_path, SMALL, ring=ring)
    kept.drive(0.2)
    assert f"(process {os.getpid()}) writes there already" in kept.loop.state.notices["journal"]
    assert not kept.directory.exists()
    holder.release()
    kept.drive(6.0)
    assert "journal" not in kept.loop.state.notices
    assert kept.finish()
    within.release()


@pytest.mark.parametrize(("directory", "within"), [("state/box", True), ("box", False)])
def test_given_a_journal_elsewhere_then_the_state_directory_is_no_matter(
    tmp_path: Path, directory: str, within: bool
) -> None:
    write_test_key(tmp_path)
    config = load_config(write_vehicle(tmp_path, f"{VEHICLE}journal: {{directory: {directory}}}\n"))
    store = open_store(config, localizes=False)
    made = make_writer(config, "", SystemClock(), store.lock)
    assert made is not None
    assert (made[1]._ring._within is store.lock) == within
    store.close()


# --- what is said ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("number", "says"),
    [
        (errno.ENOSPC, "df -h '/x y'"),
        (errno.EACCES, f"sudo chown -R {os.geteuid()} '/x y'"),
        (errno.EROFS, "name a journal.directory in the vehicle file where writing is allowed"),
        (errno.ENOTDIR, "ls -ld '/x y'"),
        (errno.EIO, "dmesg"),
    ],
)
def test_given_what_a_disk_says_then_it_is_told_with_what_to_do(number: int, says: str) -> None:
    words = words_on(OSError(number, os.strerror(number), "/x\n"), Path("/x y"), "journal.directory")
    assert words.startswith(f"{os.strerror(number)} (/x\\n); ")
    # the name of a draft is another each time, and would be told each time
    same = words_on(OSError(number, os.strerror(number), "/x y/state.jsonab12"), Path("/x y"), "journal.directory")
    assert same == words.replace(" (/x\\n)", "")
    assert says in words
    assert words.isprintable()
