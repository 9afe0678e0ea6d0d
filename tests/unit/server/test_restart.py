"""The state file: valid or not used, and never a reason not to start or to wait."""

from __future__ import annotations

import hashlib
import logging
import math
import os
import threading
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support_lcm import TIMEOUT_S
from support_persistence import PERSISTED, POSE, UTIME

from modelserver.core import Instant
from modelserver.messages import PersistedState, RestoredState
from modelserver.server import persistence as restart
from modelserver.server.persistence import (
    MAX_BYTES,
    PersistedStateError,
    StateStore,
    decode_state,
    encode_state,
    read_boot_id,
    write_atomically,
)

NOW = Instant(PERSISTED.monotonic_ns + 7_000_000_000, UTIME + 7_000_000)


@pytest.fixture
def store(tmp_path: Path) -> StateStore:
    return StateStore(tmp_path, "cart", boot="b1")


def save(store: StateStore, state: PersistedState = PERSISTED) -> None:
    store.close(state)
    if store._thread is not None:
        # a disk may take longer than a service that ends waits for it
        store._thread.join(TIMEOUT_S)
    assert store.path.is_file()


def restore(store: StateStore, now: Instant = NOW) -> RestoredState:
    return store.restore(now, 20.0, 86400.0)


def test_given_a_saved_state_then_it_is_restored_bit_for_bit_with_its_age(store: StateStore) -> None:
    save(store)
    assert restore(store) == RestoredState(PERSISTED._replace(boot="b1"), 7.0, "", 20.0, 86400.0)
    assert [path.name for path in store.path.parent.iterdir()] == ["state-cart.json"]


numbers = st.floats(-1e9, 1e9)
vectors = st.tuples(numbers, numbers, numbers)


@given(vectors, vectors, st.lists(st.tuples(st.text(max_size=20), numbers), max_size=8), st.text(max_size=64))
def test_given_any_finite_numbers_then_they_survive_encoding_bit_for_bit(gyro, place, wheels, vehicle) -> None:
    pose = POSE._replace(position=place, wheels=tuple(wheels))
    state = PERSISTED._replace(vehicle=vehicle, gyro_bias=gyro, pose=pose)
    assert decode_state(encode_state(state)) == state
    assert decode_state(encode_state(state._replace(pose=None))).pose is None


def test_given_no_file_then_the_start_is_cold_with_a_reason(store: StateStore) -> None:
    assert restore(store) == RestoredState(reason="no state of an earlier run is stored")


def test_given_a_file_truncated_at_any_byte_then_it_is_rejected() -> None:
    whole = encode_state(PERSISTED)
    for length in range(len(whole)):
        with pytest.raises(PersistedStateError):
            decode_state(whole[:length])


@given(st.integers(0, len(encode_state(PERSISTED)) - 1), st.integers(1, 255))
def test_given_any_byte_changed_then_it_is_rejected(at: int, change: int) -> None:
    data = bytearray(encode_state(PERSISTED))
    data[at] ^= change
    with pytest.raises(PersistedStateError):
        decode_state(bytes(data))


@given(st.binary(max_size=300))
def test_given_any_bytes_then_they_are_rejected(data: bytes) -> None:
    with pytest.raises(PersistedStateError):
        decode_state(data)


def _with(part: bytes, other: bytes) -> bytes:
    """Return the bytes of a state file with a part of its JSON replaced, and the checksum of that."""
    head, _, text = encode_state(PERSISTED).partition(b"\n")
    assert part in text
    text = text.replace(part, other, 1)
    return head.rpartition(b" ")[0] + b" " + hashlib.sha256(text).hexdigest().encode() + b"\n" + text


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"", "it is no state file"),
        (b"\0" * 300, "it is no state file"),
        (b"modelserver-state 2\n[]\n", "it is no state file"),
        (encode_state(PERSISTED).replace(b" 2 ", b" 1 ", 1), "it is no state file of this version"),
        (encode_state(PERSISTED).replace(b"56.25", b"56.26", 1), "the checksum is wrong"),
        (encode_state(PERSISTED) + b"x", "the checksum is wrong"),
        (encode_state(PERSISTED) + b"x" * MAX_BYTES, "the checksum is wrong"),
        (encode_state(PERSISTED._replace(gyro_bias=(math.nan, 0.0, 0.0))), "Expected `float`, got `null`"),
        (_with(str(UTIME).encode(), b"1.5"), "Expected `int`, got `float`"),
        (_with(b"56.25", b'"56.25"'), "Expected `float`, got `str`"),
    ],
)
def test_given_an_invalid_file_then_the_start_is_cold_with_a_reason(store: StateStore, data: bytes, why: str) -> None:
    store.path.write_bytes(data)
    found = restore(store)
    assert found.state is None
    assert why in found.reason
    assert found.reason.isprintable()
    save(store)
    assert restore(store).state is not None


def test_given_a_directory_or_a_pipe_in_its_place_then_the_start_is_cold(tmp_path: Path) -> None:
    (tmp_path / "state-cart.json").mkdir()
    os.mkfifo(tmp_path / "state-van.json")
    assert "cannot be read: this is a directory" in restore(StateStore(tmp_path, "cart")).reason
    assert "cannot be read: this is a FIFO" in restore(StateStore(tmp_path, "van")).reason


@pytest.mark.parametrize(
    ("now", "boot", "why", "age"),
    [
        (Instant(NOW.monotonic_ns, UTIME - 3_600_000_000), "b1", "3600 s ahead of the clock", 0.0),
        (Instant(5, UTIME - 86_400_000_000_000), "b2", "ahead of the clock", 0.0),
        (Instant(PERSISTED.monotonic_ns + 7_200 * 10**9, UTIME + 3_600_000_000), "b1", "was set back by 3600 s", 0.0),
        (Instant(PERSISTED.monotonic_ns - 1, UTIME + 7_000_000), "b1", "was set back", 0.0),
        (Instant(PERSISTED.monotonic_ns + 10**9, UTIME + 3_600_000_000), "b1", "", 3600.0),
        (Instant(PERSISTED.monotonic_ns + 8 * 10**9, UTIME + 7_000_000), "b1", "", 8.0),
        (Instant(5, UTIME + 7_000_000), "b2", "", 7.0),
        (Instant(PERSISTED.monotonic_ns, UTIME - 500_000), "b1", "", 0.0),
    ],
)
def test_given_a_clock_then_the_age_is_the_greater_of_two_or_nothing_is_used(
    tmp_path: Path, now: Instant, boot: str, why: str, age: float
) -> None:
    save(StateStore(tmp_path, "cart", boot="b1"))
    found = restore(StateStore(tmp_path, "cart", boot=boot), now)
    assert (found.state is None) == bool(why)
    assert why in found.reason
    assert found.age == pytest.approx(age)


def test_given_a_disk_error_then_it_is_logged_once_and_cleared(
    store: StateStore, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    caplog.set_level(logging.INFO)
    with monkeypatch.context() as patched:
        patched.setattr(restart, "write_atomically", fail)
        store._write(PERSISTED)
        store._write(PERSISTED)
        warning = store.save(PERSISTED)
    assert "No space left on device" in warning
    assert "The next start will be cold" in warning
    assert [record.levelno for record in caplog.records].count(logging.WARNING) == 1
    save(store)
    assert "stored again" in caplog.records[-1].getMessage()


def test_given_a_disk_that_hangs_then_the_loop_does_not_wait_and_the_newest_is_written(
    store: StateStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    started, go_on, written = threading.Event(), threading.Event(), []

    def slow(path: Path, data: bytes) -> None:
        started.set()
        go_on.wait(60)
        written.append(decode_state(data).utime)

    monkeypatch.setattr(restart, "write_atomically", slow)
    store.save(PERSISTED)
    assert started.wait(60)
    for utime in range(1, 100):
        assert store.save(PERSISTED._replace(utime=utime)) == ""
    go_on.set()
    store.close(PERSISTED._replace(utime=100))
    assert written in ([UTIME, 100], [UTIME, 99, 100])


def test_given_files_of_runs_that_were_killed_while_writing_then_they_are_removed(store: StateStore) -> None:
    save(store)
    (store.path.parent / "state-cart.jsonabcd1234").write_bytes(b"torn")
    (store.path.parent / "state-cartel.json").write_bytes(b"another vehicle's")
    assert restore(store).state is not None
    assert sorted(path.name for path in store.path.parent.iterdir()) == ["state-cart.json", "state-cartel.json"]


@pytest.mark.skipif(os.geteuid() == 0, reason="root writes into read-only directories")
def test_given_a_read_only_directory_then_the_state_is_not_saved_and_nothing_raises(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    try:
        store = StateStore(tmp_path, "cart")
        store.close(PERSISTED)
        assert restore(store).state is None
    finally:
        tmp_path.chmod(0o700)


def test_given_a_new_name_then_the_directory_is_on_the_disk_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced: list[str] = []
    fsync = os.fsync

    def watch(number: int) -> None:
        synced.append(os.readlink(f"/proc/self/fd/{number}"))
        fsync(number)

    monkeypatch.setattr(os, "fsync", watch)
    write_atomically(tmp_path / "a" / "file", b"data")
    assert synced[-1] == str(tmp_path / "a")
    assert len(synced) == 2


def test_given_this_machine_then_it_has_a_boot_id_or_none() -> None:
    assert len(read_boot_id()) in (0, 36)


def test_given_a_unit_without_proc_sys_then_the_boot_id_comes_from_its_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As systemd's specifier %b writes it, without hyphens; the same id as outside of the unit."""
    monkeypatch.setattr("modelserver.server.persistence.BOOT_ID", tmp_path / "hidden")
    for named, found in (
        ("143ed63e8a1544ff9db3048c46529278", "143ed63e-8a15-44ff-9db3-048c46529278"),
        ("", ""),
        ("no name", ""),
    ):
        monkeypatch.setenv("MODELSERVER_BOOT_ID", named)
        assert read_boot_id() == found
