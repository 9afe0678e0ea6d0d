"""What tests of the viewer show: a log of the Raptor's service on a fake bus, and the service itself."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import lcm
from support_daemon import Trial, trial, write_raptor

from modelserver.config.vehicle_file import load_config
from modelserver.messages import GpsSample, ImuSample, JointSample, JointsSample, SensorHeader, WheelsSample
from modelserver.server.bus import FakeBus
from modelserver.server.clock import FakeClock
from modelserver.server.loop import Hooks, Loop, LoopSettings
from modelserver.server.vehicle import load_vehicle
from modelserver.wire.codec import encode
from mstools.launch.drive import make_simulation

if TYPE_CHECKING:
    from mstools.view.sources import Source

START = 1_750_000_000_000_000
JOINTS_PERIOD_US = 20_000
TICK_NS = 20_000_000
"""50 poses a second."""

NOD = 0.4
"""Amplitude of the front laser, radians; it nods once in two seconds."""


class RecordingBus(FakeBus):
    """A fake bus that writes what is published to a log."""

    def __init__(self, clock: FakeClock, path: Path):
        super().__init__(clock)
        self._time = clock
        self.log = lcm.EventLog(str(path), "w", overwrite=True)

    def publish(self, channel: str, data: bytes) -> None:
        """Publish a message and write it."""
        self.log.write_event(self._time.utime(), channel, data)
        self.sensors.put(channel, data)
        self.requests.put(channel, data)


def record_drive(folder: Path, seconds: float) -> Path:
    """Write a log of the Raptor's service on a simulated drive with a nodding laser, and return its path."""
    vehicle_file = write_raptor(folder)
    config = load_config(vehicle_file)
    vehicle = load_vehicle(config, str(vehicle_file))
    clock = FakeClock(START, 10_000_000_000)
    path = folder / "drive.lcm"
    bus = RecordingBus(clock, path)
    loop = Loop(
        bus,
        clock,
        vehicle.start_core(clock.now()),
        LoopSettings(TICK_NS, vehicle.sensor_channels()),
        Hooks(snapshot=vehicle.encode_snapshot, channels=lambda state: vehicle.sensor_channels(state.model)),
    )
    channels = {GpsSample: "GPS", ImuSample: "IMU", WheelsSample: "WHEELS"}
    next_joints = START
    sensors = (GpsSample, ImuSample, WheelsSample)
    for event in make_simulation(config, START, seconds, sensors=sensors).events(seconds):
        while clock.utime() < event.header.utime:
            loop.run_once()
            if clock.utime() >= next_joints:
                bus.publish("JOINTS", encode(make_joints(clock.utime())))
                next_joints += JOINTS_PERIOD_US
        bus.publish(channels[type(event)], encode(event))
    bus.log.close()
    return path


@contextmanager
def follow_drive(url: str, folder: Path) -> Iterator[Source]:
    """Run the Raptor's service on a drive while its laser nods, and yield it as a source of the viewer."""
    from mstools.view.sources import open_live

    with trial(url, folder) as found:
        found.spawn(publish_nodding, found)
        yield open_live(url, "", 2.0)


def publish_nodding(found: Trial) -> None:
    """Publish the front laser's angle until the trial ends."""
    while not found.is_stopped:
        found.publish("JOINTS", encode(make_joints(time.time_ns() // 1000)))
        found.wait(JOINTS_PERIOD_US * 1e-6)


def make_joints(utime: int) -> JointsSample:
    """Return the front laser's angle while it nods."""
    angle = NOD * math.sin(math.pi * (utime - START) * 1e-6)
    return JointsSample(SensorHeader(utime, "front_axis", 0, utime), (JointSample("FrontNoddingSICKAxis", angle),))
