"""Child processes of one terminal: their output line by line, and their end with the parent's, however that ends.

`modelserver demo` fails with the first child that ends; `modelserver up` restarts it, later each time.
"""

from __future__ import annotations

import contextlib
import os
import shlex
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType, MappingProxyType
from typing import Any, Final

import yaml

from modelserver.errors import ModelServerError
from mstools.terminal.output import write_file

STOP_TIMEOUT_S: Final = 3.0
"""Time between SIGTERM and SIGKILL for a child, seconds."""

FIRST_DELAY_S: Final = 1.0
LONGEST_DELAY_S: Final = 30.0
"""Delays before a restart, seconds: doubled with each one, until a child has run for `STABLE_S`."""

STABLE_S: Final = 60.0

TAIL_LINES: Final = 8
"""Last lines of output that explain an end."""

MAX_LINE_BYTES: Final = 4096
"""A longer line of output is split."""

MODELSERVER: Final = (
    "-c",
    "from mstools.launch.processes import end_with_parent; end_with_parent(); from mstools.cli import main; main()",
)
"""Arguments of Python that run the `modelserver` command of this installation until its parent ends."""


def end_with_parent() -> None:
    """End this process with SIGTERM when its standard input closes, whose other end `ChildProcesses` holds.

    The kernel closes it however the parent ends, SIGKILL included.
    """
    main = threading.main_thread().ident
    assert main is not None

    def watch() -> None:
        while os.read(0, 1):
            pass
        # to the main thread, to interrupt a blocking call there
        signal.pthread_kill(main, signal.SIGTERM)

    threading.Thread(target=watch, daemon=True).start()


class LaunchError(ModelServerError):
    """The processes cannot run; the message is what is missing."""


@dataclass(slots=True)
class ChildProcess:
    """A child process: its arguments, its last output, and when it is restarted if it has ended."""

    name: str
    arguments: tuple[str, ...]
    is_last: bool
    process: subprocess.Popen[bytes]
    started_s: float
    reader: threading.Thread | None = None
    tail: deque[str] = field(default_factory=lambda: deque(maxlen=TAIL_LINES))
    delay_s: float = FIRST_DELAY_S
    restart_s: float = 0.0

    def describe_end(self, code: int) -> str:
        return f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"


class ChildProcesses:
    """A group of child processes; leaving the block ends them, also on an error, SIGTERM or Ctrl-C.

    `on_line` gets each line that a child prints, with the child's name; it is called by a thread for each child.
    """

    def __init__(self, on_line: Callable[[str, str], object] | None = None):
        self._on_line = on_line
        self._started: list[ChildProcess] = []
        self._before: dict[int, Callable[[int, FrameType | None], object] | int | None] = {}
        self._signal = 0
        self._is_starting = False

    def __enter__(self) -> ChildProcesses:
        def end(number: int, frame: FrameType | None) -> None:
            # Python drops what is raised in a destructor or a callback of its import system, and makes another error of
            # what is raised in __set_name__: `check` and the end of the block raise it again
            self._signal = number
            # a process that is being started is not in the list yet, and would go on
            if not self._is_starting:
                raise SystemExit(128 + number)

        self._before[signal.SIGTERM] = signal.signal(signal.SIGTERM, end)
        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            self._before[signal.SIGINT] = signal.signal(signal.SIGINT, end)
        return self

    def __exit__(self, *_: object) -> None:
        # a second Ctrl-C must not skip the rest
        self._before.setdefault(signal.SIGINT, signal.getsignal(signal.SIGINT))
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        try:
            # a driver restores its device's state, for which the emulated device must still be there
            for is_last in (False, True):
                self._stop([child for child in self._started if child.is_last is is_last])
        finally:
            for number, before in self._before.items():
                signal.signal(number, before)
        if self._signal:
            raise SystemExit(128 + self._signal) from None

    def start(self, name: str, *arguments: str, is_last: bool = False) -> None:
        """Start a Python process with these arguments; `is_last`: it ends after those that need it."""
        self._is_starting = True
        child = ChildProcess(name, arguments, is_last, self._spawn(arguments), time.monotonic())
        self._started.append(child)
        self._is_starting = False
        if self._signal:
            raise SystemExit(128 + self._signal)
        self._read(child)

    def check(self) -> None:
        """Raise LaunchError with the last output of a process that has ended: all must run."""
        for child, code in self._list_ended():
            self._finish(child)
            tail = "\n  ".join(child.tail) or "(nothing)"
            raise LaunchError(f"process {child.name} {child.describe_end(code)}. Its output:\n  {tail}")

    def restart_ended(self) -> Iterator[tuple[str, str]]:
        """Restart the processes that have ended, after a delay; yield the name and what happened to each, once."""
        now = time.monotonic()
        for child, code in self._list_ended():
            if child.restart_s == 0.0:
                child.delay_s = FIRST_DELAY_S if now - child.started_s > STABLE_S else child.delay_s
                child.restart_s = now + child.delay_s
                yield child.name, f"{child.describe_end(code)}; it is restarted in {child.delay_s:.0f} s"
            elif now >= child.restart_s:
                child.delay_s = min(2.0 * child.delay_s, LONGEST_DELAY_S)
                child.restart_s, child.started_s = 0.0, now
                self._finish(child)
                child.process = self._spawn(child.arguments)
                self._read(child)

    def _list_ended(self) -> list[tuple[ChildProcess, int]]:
        if self._signal:
            raise SystemExit(128 + self._signal)
        ended = ((child, child.process.poll()) for child in self._started)
        return [(child, code) for child, code in ended if code is not None]

    def _spawn(self, arguments: tuple[str, ...]) -> subprocess.Popen[bytes]:
        # a session of its own: Ctrl-C reaches only the parent, which ends them in order; nothing is written to its
        # standard input, which closes when the parent ends
        return subprocess.Popen(
            [sys.executable, *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env={**os.environ, "PYTHONUNBUFFERED": "1"},
            start_new_session=True,
        )

    def _read(self, child: ChildProcess) -> None:
        child.reader = threading.Thread(target=self._forward, args=(child, child.process), daemon=True)
        child.reader.start()

    def _forward(self, child: ChildProcess, process: subprocess.Popen[bytes]) -> None:
        """Pass each line that a process prints on, until it ends."""
        assert process.stdout is not None
        with process.stdout as output:
            while line := output.readline(MAX_LINE_BYTES):
                text = line.decode(errors="replace").rstrip("\r\n")
                child.tail.append(text)
                if self._on_line is not None:
                    self._on_line(child.name, text)

    def _finish(self, child: ChildProcess) -> None:
        """Read the rest of the output of an ended process, and close its pipes."""
        assert child.process.stdin is not None
        child.process.stdin.close()
        if child.reader is not None:
            child.reader.join(STOP_TIMEOUT_S)

    def _stop(self, children: list[ChildProcess]) -> None:
        for child in children:
            child.process.terminate()
        deadline = time.monotonic() + STOP_TIMEOUT_S
        for child in children:
            try:
                child.process.wait(max(0.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                child.process.kill()
                child.process.wait()
            self._finish(child)


BUS_GROUP = "239.255.76.67"
"""LCM's multicast group."""

CAN_GROUP = "239.74.163.2"
"""Multicast group of python-can's bus over UDP."""

STATE_FOLDER = "state"
"""Folder of the state, below that of the copied vehicle file."""


@dataclass(frozen=True, slots=True)
class EmulatedConnections:
    """LCM provider, vehicle file, and the options of `modelserver emulate` for each of its drivers.

    `url` is empty if the vehicle file has it.
    """

    url: str
    vehicle: Path
    devices: Mapping[str, tuple[str, ...]]


LOADING: Final = 1.3
"""Time that a process takes to load by that which this one has taken so far: 0.5 and 0.38 s of the processor."""

MOST_LEAD_S: Final = 10.0
"""Longest time from the start of the processes to the drive; what is slower misses its beginning."""

SERVICE: Final = "service"
"""Name of the daemon among the processes; a driver has its own, and its emulated device that name and " device"."""


def start_programs(
    children: ChildProcesses, vehicle: Path, drivers: Iterable[str], options: Sequence[str] = ()
) -> list[str]:
    """Start the service of a vehicle file and its drivers, a process each; return their command lines."""
    # a driver may be named as the service is
    programs = [(SERVICE, ("run",)), *((name, ("driver", name)) for name in drivers)]
    return [_start(children, name, (*words, "-c", str(vehicle), *options)) for name, words in programs]


def start_devices(
    children: ChildProcesses,
    lines: EmulatedConnections,
    start_utime: int,
    options: Sequence[str] = (),
    faults: Mapping[str, tuple[str, ...]] = MappingProxyType({}),
) -> list[str]:
    """Start an emulator for each device, a process each, on one drive; return their command lines.

    `start_utime` is that of the drive, `faults` has more options for some devices.
    """
    together = ("--start", str(start_utime), *options)
    words = {
        name: ("emulate", name, "-c", str(lines.vehicle), *line, *together, *faults.get(name, ()))
        for name, line in lines.devices.items()
    }
    return [_start(children, f"{name} device", each, is_last=True) for name, each in words.items()]


def get_start_utime(devices: int) -> int:
    """Return when a drive may begin whose processes start now, by the time that this one has taken to load.

    The vehicle is stationary at first: a device that is half a second late misses nothing.
    """
    started_ticks = int(Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19])
    age = time.clock_gettime(time.CLOCK_BOOTTIME) - started_ticks / os.sysconf("SC_CLK_TCK")
    count = 1 + 2 * devices  # the service, and for each device a driver and an emulator
    lead = LOADING * age * count / (os.cpu_count() or 1)
    return round((time.time() + min(lead, MOST_LEAD_S)) * 10) * 100_000


def _start(children: ChildProcesses, name: str, words: tuple[str, ...], *, is_last: bool = False) -> str:
    children.start(name, *MODELSERVER, *words, is_last=is_last)
    return shlex.join(("modelserver", *words))


def make_connections(vehicle: Path, folder: Path, *, own_bus: bool) -> EmulatedConnections:
    """Write a copy of a vehicle file into `folder` whose drivers use free local connections.

    Serial ports become pseudo-terminals, CAN buses one bus over UDP, TCP servers those of loopback. Paths of files that
    are read become absolute; state and journal are below `folder`. `own_bus`: LCM on a free port of loopback, so that a
    running vehicle is not disturbed. Raises OSError.
    """
    content = yaml.safe_load(vehicle.read_text(encoding="utf-8"))

    def make_absolute(section: Any, key: str) -> None:
        if isinstance(section, dict) and section.get(key):
            section[key] = str((vehicle.parent / Path(section[key]).expanduser()).resolve())

    make_absolute(content, "geometry")
    make_absolute(content.get("commands"), "key_file")
    content["state_directory"] = STATE_FOLDER
    if isinstance(journal := content.get("journal"), dict) and journal.get("directory"):
        journal["directory"] = Path(journal["directory"]).name
    devices: dict[str, tuple[str, ...]] = {}
    with contextlib.ExitStack() as held:
        url = f"udpm://{BUS_GROUP}:{_reserve_port(socket.SOCK_DGRAM, held)}?ttl=0" if own_bus else ""
        drivers = content.get("drivers") or {}
        bus = ""
        if any("can" in driver for driver in drivers.values()):
            bus = f"{CAN_GROUP}:{_reserve_port(socket.SOCK_DGRAM, held)}"
        for name, driver in drivers.items():
            devices[name] = _redirect_driver(driver, (folder / name).resolve(), bus, held)
            make_absolute(driver, "dbc")
    path = folder / "vehicle.yaml"
    write_file(str(path), yaml.safe_dump(content, sort_keys=False), replace=True)
    return EmulatedConnections(url, path, devices)


def _redirect_driver(driver: dict[str, Any], port: Path, bus: str, held: contextlib.ExitStack) -> tuple[str, ...]:
    """Change a driver's connection; return the options of its emulator."""
    # no corrections from a network for an emulated receiver
    driver.pop("ntrip", None)
    if "can" in driver:
        driver |= {"can": bus, "interface": "udp_multicast"}
        return ("--can", bus)
    if "port" in driver:
        driver["port"] = str(port)
        return ("--pty", "--link", str(port))
    number = _reserve_port(socket.SOCK_STREAM, held)
    driver["address"] = f"127.0.0.1:{number}"
    return ("--tcp", str(number))


def _reserve_port(kind: socket.SocketKind, held: contextlib.ExitStack) -> int:
    """Return a free port, so that two demos, or a demo and a vehicle, do not share a bus.

    It is reserved until `held` is closed, so that the next call returns another.
    """
    probe = held.enter_context(socket.socket(socket.AF_INET, kind))
    probe.bind(("127.0.0.1", 0))
    return int(probe.getsockname()[1])
