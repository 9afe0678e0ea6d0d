"""The kept state's file: whole and right or not used, and never a reason not to start or to wait."""

from __future__ import annotations

import json
import logging
import os
import threading
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from modelserver.core import Instant
from modelserver.messages import Kept, Recalled
from modelserver.service.keeping import state as restart
from modelserver.service.keeping.form import (
    MAX_BYTES,
    KeptError,
    kept_from_bytes,
    kept_to_bytes,
)
from modelserver.service.keeping.form import _sealed as sealed
from modelserver.service.keeping.origin import write_whole
from modelserver.service.keeping.state import StateKeeper, boot_id
from tests.support_kept import KEPT, POSE, UTIME

NOW = Instant(KEPT.monotonic_ns + 7_000_000_000, UTIME + 7_000_000)


@pytest.fixture
def keeper(tmp_path: Path) -> StateKeeper:
    return StateKeeper(tmp_path, "cart", boot="b1")


def saved(keeper: StateKeeper, kept: Kept = KEPT) -> None:
    keeper.close(kept)
    assert keeper.path.is_file()


def recalled(keeper: StateKeeper, now: Instant = NOW) -> Recalled:
    return keeper.recall(now, 20.0, 86400.0)


def test_given_a_state_that_was_kept_then_it_comes_back_to_the_bit_with_its_age(keeper: StateKeeper) -> None:
    saved(keeper)
    assert recalled(keeper) == Recalled(KEPT._replace(boot="b1"), 7.0, "", 20.0, 86400.0)
    assert [path.name for path in keeper.path.parent.iterdir()] == ["state-cart.json"]


numbers = st.floats(-1e9, 1e9)
vectors = st.tuples(numbers, numbers, numbers)


@given(vectors, vectors, st.lists(st.tuples(st.text(max_size=20), numbers), max_size=8), st.text(max_size=64))
def test_given_any_finite_numbers_then_bytes_give_them_back_to_the_bit(gyro, place, wheels, vehicle) -> None:
    pose = POSE._replace(position=place, wheels=tuple(wheels))
    kept = KEPT._replace(vehicle=vehicle, gyro_bias=gyro, pose=pose)
    assert kept_from_bytes(kept_to_bytes(kept)) == kept
    assert kept_from_bytes(kept_to_bytes(kept._replace(pose=None))).pose is None


def test_given_nothing_kept_then_the_start_is_cold_and_says_so(keeper: StateKeeper) -> None:
    assert recalled(keeper) == Recalled(why="nothing is kept of an earlier run")


def test_given_a_file_torn_at_any_byte_then_it_is_refused() -> None:
    whole = kept_to_bytes(KEPT)
    for length in range(len(whole)):
        with pytest.raises(KeptError):
            kept_from_bytes(whole[:length])


@given(st.integers(0, len(kept_to_bytes(KEPT)) - 1), st.integers(1, 255))
def test_given_any_byte_changed_then_it_is_refused(at: int, change: int) -> None:
    data = bytearray(kept_to_bytes(KEPT))
    data[at] ^= change
    with pytest.raises(KeptError):
        kept_from_bytes(bytes(data))


@given(st.binary(max_size=300))
def test_given_any_bytes_then_nothing_but_a_refusal_comes_of_them(data: bytes) -> None:
    with pytest.raises(KeptError):
        kept_from_bytes(data)


def _content(**change: Any) -> bytes:
    return sealed({**KEPT._asdict(), "pose": POSE._asdict(), **change})


def _pose(**change: Any) -> bytes:
    return _content(pose={**POSE._asdict(), **change})


def _nan() -> bytes:
    text = json.dumps({**KEPT._asdict(), "pose": None, "gyro_bias": [float("nan"), 0, 0]}).encode()
    import hashlib

    return b"modelserver-kept 1 " + hashlib.sha256(text).hexdigest().encode() + b"\n" + text + b"\n"


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"", "it is empty"),
        (b"\0" * 300, "it is no kept state"),
        (b"modelserver-kept 1\n{}\n", "it is no kept state"),
        (kept_to_bytes(KEPT).replace(b" 1 ", b" 2 ", 1), "its format is version '2', not 1"),
        (kept_to_bytes(KEPT).replace(b"56.25", b"56.26", 1), "its checksum is another"),
        (kept_to_bytes(KEPT) + b"x", "its checksum is another"),
        (b"x" * (MAX_BYTES + 1), f"it is larger than {MAX_BYTES} bytes"),
        (_nan(), "it holds NaN"),
        (sealed({}), "its keys are others"),
        (_content(more=1), "its keys are others"),
        (_content(names=["a"] * 3), "names are 15 to 100"),
        (_content(names=[7] * 21), "names are words"),
        (_content(gyro_bias=[0, 0]), "gyro_bias has to be 3 numbers"),
        (_content(gyro_bias=[0, 0, True]), "gyro_bias has to be 3 numbers"),
        (_content(gyro_bias=[0, 0, 1e300]), "gyro_bias has to be 3 numbers"),
        (_content(gyro_bias=[0, 0, 10**400]), "gyro_bias has to be 3 numbers"),
        (_content(covariance=[0.0] * 5), "covariance has to be 441 numbers"),
        (_content(covariance=[-1.0] * 441), "covariance has a variance below 0"),
        (_content(utime=-1), "utime is no count"),
        (_content(utime=1.5), "utime is no count"),
        (_content(vehicle=7), "vehicle is no text"),
        (_content(vehicle="x" * 300), "vehicle is no text"),
        (_content(pose=[]), "its keys are others"),
        (_pose(latitude_deg=91.0), "is no place"),
        (_pose(attitude=[1.0, 1.0, 0.0, 0.0]), "attitude is no unit quaternion"),
        (_pose(doubt=[-1.0, 0.0, 0.0]), "is out of range"),
        (_pose(wheels=[["left"]]), "wheels are pairs"),
        (_pose(wheels=[["left", "1"]]), "wheels are pairs"),
        (_pose(wheels={}), "wheels are 64 pairs at most"),
    ],
)
def test_given_a_file_that_is_not_right_then_the_start_is_cold_and_says_why(
    keeper: StateKeeper, data: bytes, why: str
) -> None:
    keeper.path.write_bytes(data)
    found = recalled(keeper)
    assert found.kept is None
    assert why in found.why
    assert found.why.isprintable()
    saved(keeper)
    assert recalled(keeper).kept is not None


def test_given_a_directory_or_a_pipe_in_its_place_then_the_start_is_cold(tmp_path: Path) -> None:
    (tmp_path / "state-cart.json").mkdir()
    os.mkfifo(tmp_path / "state-van.json")
    assert "cannot be read: this is a directory" in recalled(StateKeeper(tmp_path, "cart")).why
    assert "cannot be read: this is a FIFO" in recalled(StateKeeper(tmp_path, "van")).why


@pytest.mark.parametrize(
    ("now", "boot", "why", "age"),
    [
        (Instant(NOW.monotonic_ns, UTIME - 3_600_000_000), "b1", "3600 s ahead of the clock", 0.0),
        (Instant(5, UTIME - 86_400_000_000_000), "b2", "ahead of the clock", 0.0),
        (Instant(KEPT.monotonic_ns + 7_200 * 10**9, UTIME + 3_600_000_000), "b1", "was set back by 3600 s", 0.0),
        (Instant(KEPT.monotonic_ns - 1, UTIME + 7_000_000), "b1", "was set back", 0.0),
        (Instant(KEPT.monotonic_ns + 10**9, UTIME + 3_600_000_000), "b1", "", 3600.0),
        (Instant(KEPT.monotonic_ns + 8 * 10**9, UTIME + 7_000_000), "b1", "", 8.0),
        (Instant(5, UTIME + 7_000_000), "b2", "", 7.0),
        (Instant(KEPT.monotonic_ns, UTIME - 500_000), "b1", "", 0.0),
    ],
)
def test_given_a_clock_then_the_age_is_the_greater_of_two_or_nothing_is_used(
    tmp_path: Path, now: Instant, boot: str, why: str, age: float
) -> None:
    saved(StateKeeper(tmp_path, "cart", boot="b1"))
    found = recalled(StateKeeper(tmp_path, "cart", boot=boot), now)
    assert (found.kept is None) == bool(why)
    assert why in found.why
    assert found.age == pytest.approx(age)


def test_given_a_disk_that_refuses_then_it_is_said_once_and_taken_back(
    keeper: StateKeeper, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(28, "No space left on device")

    caplog.set_level(logging.INFO)
    with monkeypatch.context() as patched:
        patched.setattr(restart, "write_whole", refuse)
        keeper._write(KEPT)
        keeper._write(KEPT)
        trouble = keeper.keep(KEPT)
    assert "No space left on device" in trouble
    assert "A restart will be a cold one" in trouble
    assert [record.levelno for record in caplog.records].count(logging.WARNING) == 1
    saved(keeper)
    assert "kept again" in caplog.records[-1].getMessage()


def test_given_a_disk_that_hangs_then_the_loop_does_not_wait_and_the_newest_is_written(
    keeper: StateKeeper, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, go_on, written = threading.Event(), threading.Event(), []

    def slow(path: Path, data: bytes) -> None:
        begun.set()
        go_on.wait(60)
        written.append(kept_from_bytes(data).utime)

    monkeypatch.setattr(restart, "write_whole", slow)
    keeper.keep(KEPT)
    assert begun.wait(60)
    for utime in range(1, 100):
        assert keeper.keep(KEPT._replace(utime=utime)) == ""
    go_on.set()
    keeper.close(KEPT._replace(utime=100))
    assert written in ([UTIME, 100], [UTIME, 99, 100])


def test_given_files_of_runs_that_were_killed_while_writing_then_they_are_removed(keeper: StateKeeper) -> None:
    saved(keeper)
    (keeper.path.parent / "state-cart.jsonabcd1234").write_bytes(b"torn")
    (keeper.path.parent / "state-cartel.json").write_bytes(b"another vehicle's")
    assert recalled(keeper).kept is not None
    assert sorted(path.name for path in keeper.path.parent.iterdir()) == ["state-cart.json", "state-cartel.json"]


@pytest.mark.skipif(os.geteuid() == 0, reason="root writes into read-only directories")
def test_given_a_read_only_directory_then_the_state_is_not_kept_and_nothing_raises(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    try:
        keeper = StateKeeper(tmp_path, "cart")
        keeper.close(KEPT)
        assert recalled(keeper).kept is None
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
    write_whole(tmp_path / "a" / "file", b"data")
    assert synced[-1] == str(tmp_path / "a")
    assert len(synced) == 2


def test_given_this_machine_then_its_boot_has_a_name_or_none() -> None:
    assert len(boot_id()) in (0, 36)


def test_given_a_unit_that_does_not_see_the_boots_name_then_its_environment_has_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As systemd's specifier %b writes it, without hyphens; the same name as a service outside of the unit reads."""
    monkeypatch.setattr("modelserver.service.keeping.state.BOOT_ID", tmp_path / "hidden")
    for named, found in (
        ("143ed63e8a1544ff9db3048c46529278", "143ed63e-8a15-44ff-9db3-048c46529278"),
        ("", ""),
        ("no name", ""),
    ):
        monkeypatch.setenv("MODELSERVER_BOOT_ID", named)
        assert boot_id() == found
