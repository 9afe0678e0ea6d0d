"""Memory and CPU of each process of `modelserver up --emulate`, and the time until it serves and the pose is valid.

    python -m benchmarks up_cost

The vehicle is the one that `modelserver new` writes: GPS 4 Hz, IMU and wheels 100 Hz, poses at 50 Hz. Memory is the
proportional set size, which counts pages that processes share in parts. CPU is that of `SECONDS` of driving.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from benchmarks.support import MODELSERVER, cpu_seconds, free_url, run_process
from modelserver.client.remote import Platform
from modelserver.errors import ModelServerError

SECONDS = 20.0
TIMEOUT_S = 60.0
DEVICES = ("--vehicle", "skid", "--gps", "ublox", "--imu", "gx1", "--wheels", "can0")


def main() -> int:
    """Print a row for each process, and the sums."""
    if sys.platform != "linux":
        print("skipped: it reads /proc")
        return 77
    url = free_url()
    with tempfile.TemporaryDirectory() as folder:
        rover = str(Path(folder) / "rover")
        with run_process("-c", MODELSERVER, "new", rover, "--yes", *DEVICES, url=url) as made:
            made.wait(TIMEOUT_S)
        began = time.monotonic()
        with run_process("-c", MODELSERVER, "up", "-c", f"{rover}/vehicle.yaml", "--emulate", url=url) as up:
            served = wait_until(url, began, lambda platform: bool(platform.get_body_list()))
            valid = wait_until(
                url, began, lambda platform: platform.get_transformation("Rover:Base", "World:UTM").is_valid
            )
            processes = {up.pid: "up", **{pid: name_of(pid) for pid in list_children(up.pid)}}
            before = {pid: cpu_seconds(pid) for pid in processes}
            start = time.monotonic()
            time.sleep(SECONDS)
            seconds = time.monotonic() - start
            rows = [
                (name, read_memory_mb(pid), 100.0 * (cpu_seconds(pid) - before[pid]) / seconds)
                for pid, name in processes.items()
            ]
    for name, memory, share in (*rows, ("all", sum(row[1] for row in rows), sum(row[2] for row in rows))):
        print(f"  {name:24} {memory:4.0f} MB  {share:5.1f} % of a core")
    print(f"  serves after {served:.1f} s, valid after {valid:.1f} s (the vehicle rests for 3 s)")
    return 0


def wait_until(url: str, began: float, is_reached: Callable[[Platform], bool]) -> float:
    """Return the seconds since `began` when the service's answer satisfies. Raises TimeoutError."""
    with Platform(url, timeout=0.1, retries=0) as platform:
        while time.monotonic() < began + TIMEOUT_S:
            try:
                if is_reached(platform):
                    return time.monotonic() - began
            except ModelServerError:
                pass
            time.sleep(0.02)
    raise TimeoutError(f"no such answer within {TIMEOUT_S:g} s")


def list_children(parent: int) -> list[int]:
    found = []
    for each in filter(str.isdigit, os.listdir("/proc")):
        try:
            if int(Path(f"/proc/{each}/stat").read_text().rpartition(")")[2].split()[1]) == parent:
                found.append(int(each))
        except OSError:
            continue
    return found


def name_of(pid: int) -> str:
    """Return the command of a child: `run`, `driver NAME` or `emulate NAME`."""
    words = Path(f"/proc/{pid}/cmdline").read_text(encoding="utf-8").split("\0")[3:5]
    return " ".join(word for word in words if not word.startswith("-"))


def read_memory_mb(pid: int) -> float:
    lines = Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="utf-8").splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("Pss:")) / 1024.0
