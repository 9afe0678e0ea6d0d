"""`modelserver demo` as a person runs it: service, drivers and devices as processes, and nothing left behind."""

from __future__ import annotations

import contextlib
import os
import re
import select
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from support_daemon import write_raptor
from support_lcm import MODELSERVER, TIMEOUT_S

from mstools.commands import demo
from mstools.launch.processes import ChildProcesses, LaunchError

SMALLER_DEMO = """
import os
from pathlib import Path
from mstools.cli import main
from mstools.commands import demo
demo.find_vehicle_file = lambda: Path(os.environ["VEHICLE_FILE"])
main()
"""
"""The `modelserver` command whose demo is that of another vehicle file."""

TWO_DRIVERS = """\
drivers:
  gps: {device: novatel, port: /dev/ttyUSB0, rate_hz: 4}
  imu: {device: gx1, port: /dev/ttyUSB1}
"""


def start(*arguments: str, program: Sequence[str] = MODELSERVER, **environment: str) -> subprocess.Popen[str]:
    # unbuffered: what it prints is waited for line by line
    return subprocess.Popen(
        [*program, "demo", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | environment | {"PYTHONUNBUFFERED": "1"},
    )


@pytest.fixture
def smaller(tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """A running demo of the Raptor with two drivers: what is tested of its processes is the same for five."""
    file = write_raptor(tmp_path, TWO_DRIVERS)
    process = start("--seconds", "60", program=[sys.executable, "-c", SMALLER_DEMO], VEHICLE_FILE=str(file))
    yield process
    close(process)


def close(process: subprocess.Popen[str]) -> None:
    """End the demo if it runs; leave no pipe open, of which a later test would be warned."""
    process.kill()
    with process:
        pass


def vehicle_in(text: str) -> str:
    found = re.search(r" -c (\S+)", text)
    assert found, text
    return found[1]


def list_running(vehicle: str) -> dict[str, int]:
    """Return the processes that were given this vehicle file, which is the demo's alone: their ids by their names."""
    running = {}
    for place in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            words = place.read_text(errors="replace").split("\0")
        except OSError:
            continue  # it ended meanwhile
        if vehicle in words:
            running[" ".join(words[3 : words.index("-c", 3)])] = int(place.parent.name)
    return running


def text_until(process: subprocess.Popen[str], pattern: str) -> str:
    """Return what the demo prints until a line begins with a pattern."""
    assert process.stdout is not None
    lines = []
    for line in process.stdout:
        lines.append(line)
        if re.match(pattern, line):
            break
    return "".join(lines)


PROCESSES = {"run", "driver gps", "driver imu", "emulate gps", "emulate imu"}
"""Of the demo of two drivers."""

ALL_STARTED = "modelserver emulate imu"
"""What it prints when the last of its processes has been started."""


def all_started(process: subprocess.Popen[str]) -> tuple[str, dict[str, int]]:
    """Return the demo's vehicle file and its processes once they are all there: ids by names.

    What a process was given can be seen a little later than that it was started.
    """
    vehicle = vehicle_in(text_until(process, ALL_STARTED))
    deadline = time.monotonic() + TIMEOUT_S
    while set(running := list_running(vehicle)) != PROCESSES:
        assert time.monotonic() < deadline, f"missing: {PROCESSES - set(running)}"
    return vehicle, running


def test_given_a_pose_that_is_valid_late_then_the_demo_receives_more() -> None:
    start_utime = round(time.time() * 1e6) - 60_000_000
    listener = SimpleNamespace(poses=[])

    def listen(_: float, __: object) -> None:
        listener.poses.append(SimpleNamespace(transformation=SimpleNamespace(utime=start_utime + 30_000_000)))

    listener.listen = listen
    received: list[Any] = []
    # the drive of 55 s is over, and its first pose has not become valid
    poses = demo.iter_poses(
        cast(demo.PoseListener, listener),
        start_utime,
        55.0,
        cast(ChildProcesses, SimpleNamespace(check=lambda: None)),
        lambda: len(received) > 2,
    )
    for pose in poses:
        received.append(pose)  # noqa: PERF402 - iter_poses asks how many there are
    assert len(received) == 3


def test_given_nothing_else_when_the_demo_runs_then_it_shows_a_valid_pose_and_ends_by_itself():
    process = start("--seconds", "8")
    try:
        out, err = process.communicate(timeout=2 * TIMEOUT_S)
    finally:
        close(process)
    assert process.returncode == 0, err
    assert re.search(r"all 5 devices are streaming: gps \d\.\d Hz, imu \d+\.\d Hz, wheels \d+\.\d Hz, raptor", out)
    assert "Raptor, FrontNoddingSICK, BackNoddingSICK, Digiclops" in out
    assert "0.2990  -0.0560  0.4330  m" in out
    assert re.search(r"^ +\d+\.\d\d s .* valid$", out, re.MULTILINE)
    # which reason comes first depends on when a busy machine receives the first fix
    assert re.search(r"^ +\d\.\d\d s .* not valid: (no usable GPS fix yet|heading is not known)", out, re.MULTILINE)
    assert "Digiclops:ImagePlane in World:UTM" in out
    assert err == ""
    assert list_running(vehicle_in(out)) == {}


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_given_a_running_demo_when_it_is_sent_a_signal_then_its_children_end_too(smaller, number, code):
    vehicle, _ = all_started(smaller)
    smaller.send_signal(number)
    _, err = smaller.communicate(timeout=TIMEOUT_S)
    assert smaller.returncode == code, err
    assert list_running(vehicle) == {}


def test_given_a_demo_that_is_being_started_when_it_is_sent_a_signal_then_its_children_end_too(smaller):
    vehicle = vehicle_in(text_until(smaller, "modelserver run"))
    smaller.send_signal(signal.SIGTERM)
    _, err = smaller.communicate(timeout=TIMEOUT_S)
    assert smaller.returncode == 143, err
    assert list_running(vehicle) == {}


def test_given_a_running_demo_when_one_of_its_processes_dies_then_it_reports_which_and_ends_the_others(smaller):
    vehicle, running = all_started(smaller)
    os.kill(running["driver imu"], signal.SIGKILL)
    _, err = smaller.communicate(timeout=TIMEOUT_S)
    assert smaller.returncode == 1
    assert "process imu was killed by SIGKILL. Its output:" in err
    assert "(nothing)" in err  # it had no warning
    assert list_running(vehicle) == {}


def test_given_a_running_demo_when_it_is_killed_then_nothing_is_left_running(smaller):
    vehicle, running = all_started(smaller)
    with contextlib.ExitStack() as stack:
        ends = select.poll()
        for number in running.values():
            end = os.pidfd_open(number)
            stack.callback(os.close, end)
            ends.register(end, select.POLLIN)
        smaller.kill()
        smaller.communicate(timeout=TIMEOUT_S)
        deadline = time.monotonic() + TIMEOUT_S
        for _ in running:
            ((ended, _),) = ends.poll(max(0.0, deadline - time.monotonic()) * 1e3)[:1] or pytest.fail(
                f"still running: {sorted(list_running(vehicle))}"
            )
            ends.unregister(ended)
    assert list_running(vehicle) == {}
    # a killed demo cannot take its folder away
    shutil.rmtree(Path(vehicle).parent)


def test_given_a_daemon_that_fails_when_its_report_is_waited_for_then_what_it_reported_is_reported(tmp_path):
    def listen(_: float, is_done: Callable[[], bool]) -> bool:
        children._started[0].process.wait()
        return is_done()

    listener = cast(demo.PoseListener, SimpleNamespace(listen=listen, health=None, drivers={}))
    with ChildProcesses() as children:
        children.start("daemon", "-c", "import sys; sys.exit('the geometry is wrong')")
        with pytest.raises(LaunchError, match=r"process daemon ended with exit code 1(.|\n)*the geometry is wrong"):
            demo.wait_for_reports(listener, (), children)


def test_given_an_error_in_the_demo_when_it_leaves_then_its_children_are_ended(tmp_path):
    children = ChildProcesses()

    def fail() -> None:
        with children:
            children.start("patient child", "-c", "import signal; signal.pause()")
            raise RuntimeError("failure")

    with pytest.raises(RuntimeError, match="failure"):
        fail()
    assert [child.process.poll() for child in children._started] == [-signal.SIGTERM]


def test_the_vehicle_file_is_found():
    assert demo.find_vehicle_file().read_text().startswith("# The DRDC Raptor")
