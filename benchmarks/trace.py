"""Files and functions of the product that a GPS sample and a query pass, in one process on a fake bus.

The sample passes from the bytes of a NovAtel receiver to POSE, in a drive of the simulated Raptor and without a
journal; of the fixes traced, that with the fewest files counts, since a tick may also have to send a report. A query
passes from the call of `Platform` to its answer: of two rigidly connected frames at the first time, and of the vehicle
in the world now. A profile function records each Python function that is called. Import statements, and C code below
a call, are no part of a way. docs/architecture.md draws both ways. `--functions` lists the functions, too.
"""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import CodeType, FrameType
from typing import Any, Final, TypeAlias
from unittest import mock

from benchmarks.support import RAPTOR, print_verdict
from modelserver.client import remote
from modelserver.config.vehicle_file import load_config
from modelserver.messages import GpsSample, ImuSample, Sample, WheelsSample
from modelserver.server.bus import FakeBus, Inboxes
from modelserver.server.clock import FakeClock
from modelserver.server.loop import Loop, LoopSettings
from modelserver.server.vehicle import load_vehicle
from modelserver.wire.codec import encode
from msdrivers.emulate.gps import encode_sample
from msdrivers.links.fake import FakeLink, FakeTimeSource
from msdrivers.registry import KINDS
from msdrivers.runner import Runner, RunnerSettings
from mstools.launch.drive import make_simulation

ROOT: Final = Path(__file__).resolve().parents[1]
PRODUCT: Final = tuple(str(ROOT / name) + os.sep for name in ("modelserver", "drivers"))
DOUBLES: Final = ("links/fake.py", "server/bus.py", "server/clock.py")
"""Ends of the paths of link, bus and clocks, whose doubles run here."""

START: Final = 1_700_000_000_000_000
SECONDS: Final = 25.0
"""Of the drive: the pose is valid, and the heading is aligned, after 15 s."""

TRACED_S: Final = 2.0
"""End of the drive in which fixes are traced: some of them are not beside the report of each second."""

MOST_PASSES: Final = 10_000
"""Passes of the loop within which a sample or a query has been passed on: a hundred times what they take."""

CHANNELS: Final = {GpsSample: "GPS", ImuSample: "IMU", WheelsSample: "WHEELS"}
FIX_FILES, QUERY_FILES = 40, 20
"""Bounds of the files of a way: what one can read in a day, and in half of one."""

Way: TypeAlias = Mapping[str, Sequence[str]]
"""Functions by file, in the order of their first calls."""


def trace(action: Callable[[], object]) -> Way:
    """Return the functions of the product that an action calls."""
    found: dict[CodeType, None] = {}

    def record(frame: FrameType, event: str, _: Any) -> None:
        if event == "call":
            found.setdefault(frame.f_code)

    sys.setprofile(record)
    try:
        action()
    finally:
        sys.setprofile(None)
    way: dict[str, list[str]] = {}
    for code in found:
        path, name = Path(code.co_filename), code.co_qualname.replace(".<locals>", "")
        if code.co_filename.startswith(PRODUCT) and not code.co_filename.endswith(DOUBLES) and "<" not in name:
            way.setdefault(path.relative_to(ROOT).as_posix(), []).append(name)
    return way


class PausableBus(FakeBus):
    """A fake bus on which no time passes while it is paused."""

    is_paused = False

    def wait(self, seconds: float, inboxes: Inboxes = "both") -> None:
        if not self.is_paused:
            super().wait(seconds, inboxes)


class Rig:
    """The loop of the Raptor on a fake bus, with the driver of its satellite receiver on a fake line."""

    def __init__(self) -> None:
        self.config = load_config(RAPTOR / "vehicle.yaml")
        vehicle = load_vehicle(self.config)
        self.clock = FakeClock(START)
        self.bus = PausableBus(self.clock)
        settings = LoopSettings(round(1e9 / vehicle.tick_hz()), vehicle.sensor_channels())
        self.loop = Loop(self.bus, self.clock, vehicle.start_core(self.clock.now()), settings)
        self.time = FakeTimeSource(START, self.clock.monotonic_ns())
        self.line = FakeLink[bytes](self.time)
        modules = KINDS["novatel"].load()
        driver = modules.make_driver(modules.settings("gps"), RAPTOR)
        settings_of_runner = RunnerSettings("gps", "novatel", poll_timeout=0.0)
        self.runner = Runner[bytes](driver, self.line, settings_of_runner, self.time, self.publish)

    def publish(self, sample: Sample) -> None:
        self.bus.sensors.put(CHANNELS[type(sample)], encode(sample))

    def send_bytes(self, sample: GpsSample) -> None:
        """Put a fix on the receiver's line."""
        at = self.clock.now()
        self.time.utime_ns, self.time.monotonic_ns = at.utime * 1000, at.monotonic_ns
        for name in ("bestposb", "bestvelb"):
            self.line.incoming.append((0.0, encode_sample(name, sample, sample.header.utime)))

    def read_line(self) -> None:
        """Pass what is on the line to the loop's queue."""
        while self.line.incoming:
            self.runner.run_once()

    def run_until(self, is_done: Callable[[], bool]) -> None:
        """Run the loop until something is done. Raises RuntimeError if it is not after MOST_PASSES."""
        for _ in range(MOST_PASSES):
            if is_done():
                return
            self.loop.run_once()
        raise RuntimeError(f"not done after {MOST_PASSES} passes of the loop; its log says why")

    def pass_fix(self) -> None:
        """Pass a fix from the line to POSE."""
        self.read_line()
        self.bus.published.clear()
        self.run_until(lambda: bool(self.bus.get_published("POSE")))

    def drive(self) -> Way:
        """Drive, and return the shortest way of a fix at the end."""
        ways = []
        run = make_simulation(self.config, START, SECONDS, sensors=tuple(CHANNELS))
        for event in run.events(SECONDS):
            self.run_until(lambda utime=event.header.host_utime: self.clock.utime() >= utime)
            if not isinstance(event, GpsSample):
                self.publish(event)
                continue
            self.send_bytes(event)
            if event.header.utime < START + (SECONDS - TRACED_S) * 1e6:
                self.read_line()
            else:
                ways.append(trace(self.pass_fix))
        return min(ways, key=len)


class ClientBus:
    """Bus and receiver of a `Platform` whose requests the loop of a rig answers while they are published."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.fileno, self._wake = os.pipe()
        self._replies: list[bytes] = []
        self._channel = ""

    def subscribe(self, channel: str) -> None:
        self._channel = channel

    def publish(self, channel: str, data: bytes) -> None:
        bus = self.rig.bus
        bus.published.clear()
        bus.requests.put(channel, data, ("127.0.0.1", 1))
        self.rig.run_until(lambda: bool(bus.get_published(self._channel)))
        self._replies += bus.get_published(self._channel)
        os.write(self._wake, b"1")

    def receive(self) -> tuple[bytes, bytes, None] | None:
        if not self._replies:
            return None
        os.read(self.fileno, 1)
        return self._channel.encode(), self._replies.pop(0), None

    def close(self) -> None:
        os.close(self._wake)
        os.close(self.fileno)


def trace_queries(rig: Rig) -> dict[str, Way]:
    """Return the way of a query of two rigidly connected frames, seen first, and of one of the vehicle in the world."""
    bus = ClientBus(rig)
    with mock.patch.multiple(remote, open_lcm=lambda url: bus, open_receiver=lambda url: bus):
        platform = remote.Platform(name="TRACE")
    # after the tick that is due, and until the next, passes serve requests only
    rig.bus.is_paused = True
    rig.loop.run_once()
    with platform:
        platform.get_transformation("BackSICKLaser:Scan", "World:UTM")  # after it, the modules are loaded
        static = partial(platform.get_transformation, "Digiclops:ImagePlane", "Raptor:CG")
        world = partial(platform.get_transformation, "Digiclops:ImagePlane", "World:UTM")
        return {"query, static, first seen": trace(static), "query, World now": trace(world)}


def trace_ways() -> dict[str, Way]:
    """Return the ways by name."""
    rig = Rig()
    return {"GPS sample, bytes to POSE": rig.drive(), **trace_queries(rig)}


def main(options: Sequence[str] = ()) -> int:
    logging.disable()
    holds = True
    for name, way in trace_ways().items():
        print(f"  {name}: {len(way)} files, {sum(map(len, way.values()))} functions")
        packages: dict[str, list[str]] = {}
        for path in way:
            packages.setdefault(path.rpartition("/")[0], []).append(path)
        for package, paths in packages.items():
            print(f"    {package}: {', '.join(f'{Path(path).stem} {len(way[path])}' for path in paths)}")
            if "--functions" in options:
                for path in paths:
                    print(f"      {Path(path).name}: {', '.join(way[path])}")
        bound = QUERY_FILES if name.startswith("query") else FIX_FILES
        holds &= print_verdict(f"files of the way of a {name}", len(way), bound, "files")
    return 0 if holds else 1
