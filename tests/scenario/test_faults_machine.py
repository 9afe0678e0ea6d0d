"""The machine under the daemon fails: disk full, nothing to write on, clock set, network gone. Some needs root."""

from __future__ import annotations

import ctypes
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from support_daemon import STEPPED, trial
from support_lcm import reserved_url

from modelserver.messages import Invalid

CLONE_NEWNET = 0x40000000


def _allowed(*command: str) -> bool:
    return shutil.which(command[0]) is not None and not subprocess.run(command, capture_output=True).returncode


needs_mounts = pytest.mark.skipif(
    not _allowed("unshare", "-m", "true"), reason="this user may not have mounts of its own: run it as root"
)
needs_network = pytest.mark.skipif(
    not _allowed("unshare", "-n", "ip", "link", "set", "lo", "up"),
    reason="this user may not have a network of its own: run it as root, with iproute2",
)


def mounted(script: str) -> tuple[str, ...]:
    """What a command is put behind to run among mounts of its own; they end with it."""
    return ("unshare", "-m", "sh", "-ec", f'{script}; exec "$@"', "sh")


@needs_mounts
def test_given_a_full_disk_then_the_daemon_says_what_it_cannot_keep_and_serves(lcm_url: str, tmp_path: Path) -> None:
    state = tmp_path / "state"
    state.mkdir()
    full = mounted(
        f"mount -t tmpfs -o size=16k modelserver {state}; "
        f"dd if=/dev/zero of={state}/rest bs=1k count=64 2>/dev/null || true"
    )
    with trial(lcm_url, tmp_path, before=full) as run:
        run.until(lambda: "No space left on device" in run.log, "a word about the disk")
        assert str(state) in run.log
        run.assert_right()
        assert run.health.handler_errors == 0


@needs_mounts
def test_given_nothing_that_may_be_written_then_the_daemon_says_so_and_serves(lcm_url: str, tmp_path: Path) -> None:
    (tmp_path / "state").mkdir()
    bound = mounted(f"mount --bind {tmp_path} {tmp_path}; mount -o remount,bind,ro {tmp_path}; cd /")
    with trial(lcm_url, tmp_path, before=bound) as run:
        run.until(lambda: "Read-only file system" in run.log, "a word about the file system")
        assert not any((tmp_path / "state").iterdir())
        run.process.send_signal(signal.SIGHUP)
        run.until(lambda: "the geometry was read anew" in run.log, "the geometry read anew")
        run.assert_right()
        assert run.health.handler_errors == 0


@pytest.mark.parametrize("hours", [-1, 1], ids=["back", "ahead"])
def test_given_the_clock_set_by_an_hour_then_the_pose_is_not_valid_until_it_is_right_again(
    hours: int, lcm_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    step = tmp_path / "step"
    monkeypatch.setenv("CLOCK_STEP", str(step))
    with trial(lcm_url, tmp_path, command=(sys.executable, "-c", STEPPED)) as run:
        step.write_text(str(hours * 3_600_000_000_000))
        stepped = len(run.heard.poses)
        run.process.send_signal(signal.SIGUSR1)
        run.step_us = hours * 3_600_000_000
        begun = run.heard.poses[-1][0]
        run.until(lambda: not run.last.transformation.valid, "a pose that says that it is not valid")
        invalid = run.heard.poses[-1][0]
        valid = run.until(lambda: run.valid_since(invalid), "a valid pose")
        run.elapse(0.5)
        reasons = {
            reason for _, pose in run.heard.poses[stepped:] for reason in Invalid(pose.transformation.invalid_reasons)
        }
        assert (Invalid.CLOCK_STEPPED if hours < 0 else Invalid.STALE_IMU) in reasons
        run.assert_right()
        assert run.longest_silence(begun) < valid - begun + 2.0
        print(f"not valid after {invalid - begun:.2f} s, valid after {valid - begun:.2f} s: {reasons}")


def ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True)


@contextmanager
def network_of_its_own() -> Iterator[None]:
    """Move this thread, and whatever it starts, into a network of its own, with nothing but an idle loopback in it."""
    libc = ctypes.CDLL(None, use_errno=True)
    before = os.open("/proc/thread-self/ns/net", os.O_RDONLY)
    try:
        assert libc.unshare(CLONE_NEWNET) == 0, os.strerror(ctypes.get_errno())
        try:
            yield
        finally:
            assert libc.setns(before, CLONE_NEWNET) == 0, os.strerror(ctypes.get_errno())
    finally:
        os.close(before)


def up(device: str) -> None:
    ip("link", "set", device, "multicast", "on", "up")
    ip("route", "add", "224.0.0.0/4", "dev", device)


@needs_network
def test_given_the_network_down_and_up_or_taken_away_and_back_then_the_daemon_serves_again(tmp_path: Path) -> None:
    with network_of_its_own():
        ip("link", "set", "lo", "up")
        ip("link", "add", "usb0", "type", "veth", "peer", "name", "far0")
        ip("link", "set", "far0", "up")
        ip("addr", "add", "10.9.9.1/24", "dev", "usb0")
        up("usb0")
        with reserved_url() as url, trial(url, tmp_path) as run:
            ip("link", "set", "usb0", "down")
            run.elapse(1.0)
            up("usb0")
            back = run.heard.poses[-1][0]
            served = run.until(lambda: run.answered_since(back), "an answer")
            run.until(lambda: run.valid_since(served), "a valid pose")
            # as an adapter that is pulled out and put in again: memberships of the old one are gone
            ip("link", "del", "usb0")
            run.elapse(1.0)
            ip("link", "add", "usb0", "type", "veth", "peer", "name", "far0")
            ip("link", "set", "far0", "up")
            ip("addr", "add", "10.9.9.1/24", "dev", "usb0")
            up("usb0")
            again = run.heard.poses[-1][0]
            served = run.until(lambda: run.answered_since(again + 0.5), "an answer")
            run.until(lambda: run.valid_since(served), "a valid pose")
            run.assert_right()
            assert "the bus has a way again" in run.log
            assert "Traceback" not in run.log
