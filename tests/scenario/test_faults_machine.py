"""Faults of the machine: disk full, read-only file system, clock step, network loss. Some tests need root."""

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
from support_daemon import CLOCK_STEP_PROGRAM, trial
from support_lcm import MODELSERVER, reserved_url

from modelserver.messages import Invalid

CLONE_NEWNET = 0x40000000

DISTRUST_S = 180.0
"""Seconds until a valid pose, at most: fixes that seem to have jumped while nothing was received must move as the
vehicle does for two minutes."""


def _is_allowed(*command: str) -> bool:
    return shutil.which(command[0]) is not None and not subprocess.run(command, capture_output=True).returncode


needs_mounts = pytest.mark.skipif(
    not _is_allowed("unshare", "-m", "true"), reason="mount namespaces are not permitted: run it as root"
)
needs_network = pytest.mark.skipif(
    not _is_allowed("unshare", "-n", "ip", "link", "set", "lo", "up"),
    reason="network namespaces are not permitted: run it as root, with iproute2",
)


def unshare_mounts(script: str) -> tuple[str, ...]:
    """Return the prefix of a command that runs it in a mount namespace of its own, after a script."""
    return ("unshare", "-m", "sh", "-ec", f'{script}; exec "$@"', "sh")


@needs_mounts
def test_given_a_full_disk_then_the_daemon_reports_what_it_cannot_store_and_serves(
    lcm_url: str, tmp_path: Path
) -> None:
    state = tmp_path / "state"
    state.mkdir()
    full = unshare_mounts(
        f"mount -t tmpfs -o size=16k modelserver {state}; "
        f"dd if=/dev/zero of={state}/rest bs=1k count=64 2>/dev/null || true"
    )
    with trial(lcm_url, tmp_path, before=full) as run:
        run.wait_until(lambda: "No space left on device" in run.log, "a message about the disk")
        assert str(state) in run.log
        run.assert_consistent()
        assert run.health.handler_errors == 0


@needs_mounts
def test_given_nothing_that_may_be_written_then_the_daemon_reports_it_and_serves(lcm_url: str, tmp_path: Path) -> None:
    (tmp_path / "state").mkdir()
    bound = unshare_mounts(f"mount --bind {tmp_path} {tmp_path}; mount -o remount,bind,ro {tmp_path}; cd /")
    with trial(lcm_url, tmp_path, before=bound) as run:
        run.wait_until(lambda: "Read-only file system" in run.log, "a message about the file system")
        assert not any((tmp_path / "state").iterdir())
        run.process.send_signal(signal.SIGHUP)
        run.wait_until(lambda: "the geometry is the same" in run.log, "a reload of the geometry")
        run.assert_consistent()
        assert run.health.handler_errors == 0


@pytest.mark.parametrize("hours", [-1, 1], ids=["back", "ahead"])
def test_given_the_clock_set_by_an_hour_then_the_pose_is_not_valid_until_it_is_right_again(
    hours: int, lcm_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    step = tmp_path / "step"
    monkeypatch.setenv("CLOCK_STEP", str(step))
    with trial(lcm_url, tmp_path, program=(sys.executable, "-c", CLOCK_STEP_PROGRAM)) as run:
        step.write_text(str(hours * 3_600_000_000_000))
        stepped = len(run.received.poses)
        run.process.send_signal(signal.SIGUSR1)
        run.step_us = hours * 3_600_000_000
        stepped_at = run.received.poses[-1][0]
        run.wait_until(lambda: not run.last.transformation.is_valid, "an invalid pose")
        invalid = run.received.poses[-1][0]
        valid = run.wait_until(lambda: run.is_valid_since(invalid), "a valid pose")
        run.wait(0.5)
        reasons = {
            reason
            for _, pose in run.received.poses[stepped:]
            for reason in Invalid(pose.transformation.invalid_reasons)
        }
        # ahead: the old samples are stale, unless the first new one, which restarts the filter, came before a tick
        assert reasons & ({Invalid.CLOCK_STEPPED} if hours < 0 else {Invalid.STALE_IMU, Invalid.NO_IMU})
        run.assert_consistent()
        assert run.longest_gap(stepped_at) < valid - stepped_at + 2.0
        print(f"not valid after {invalid - stepped_at:.2f} s, valid after {valid - stepped_at:.2f} s: {reasons}")


def ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True)


@contextmanager
def network_of_its_own() -> Iterator[None]:
    """Move this thread and its child processes to a network namespace of their own, with only an idle loopback."""
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
        with reserved_url() as url, trial(url, tmp_path, program=MODELSERVER) as run:
            ip("link", "set", "usb0", "down")
            run.wait(1.0)
            up("usb0")
            back = run.received.poses[-1][0]
            served = run.wait_until(lambda: run.is_answered_since(back), "an answer")
            run.wait_until(lambda: run.is_valid_since(served), "a valid pose", DISTRUST_S)
            # as an adapter that is unplugged and plugged in again: its multicast memberships are lost
            ip("link", "del", "usb0")
            run.wait(1.0)
            ip("link", "add", "usb0", "type", "veth", "peer", "name", "far0")
            ip("link", "set", "far0", "up")
            ip("addr", "add", "10.9.9.1/24", "dev", "usb0")
            up("usb0")
            again = run.received.poses[-1][0]
            served = run.wait_until(lambda: run.is_answered_since(again + 0.5), "an answer")
            run.wait_until(lambda: run.is_valid_since(served), "a valid pose", DISTRUST_S)
            run.assert_consistent()
            assert "the bus is reachable again" in run.log
            assert "Traceback" not in run.log
