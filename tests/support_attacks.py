"""Forged messages with implausible stamps beside a simulated drive, through the whole loop."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self

from support_daemon import write_raptor
from support_drive import CHANNELS, SimulatedDrive, compare_pose

from modelserver.config.vehicle_file import load_config
from modelserver.core import CoreState
from modelserver.messages import (
    AbsolutePoseSample,
    FixType,
    GpsSample,
    ImuSample,
    Invalid,
    JointSample,
    JointsSample,
    PoseAnswer,
    RangeSample,
    RelativePoseSample,
    Sample,
    SensorHeader,
    VehicleStatusSample,
    WheelSample,
    WheelsSample,
)
from modelserver.server.bus import FakeBus
from modelserver.server.clock import FakeClock
from modelserver.server.loop import Loop, LoopSettings
from modelserver.server.vehicle import load_vehicle
from modelserver.simulation import Event
from modelserver.wire.codec import decode, encode

AIDING = {
    "\nsensors:\n": """
sensors:
  aiding:
    map: {type: absolute_pose, channel: ABSOLUTE_POSE}
    eyes: {type: relative_pose, channel: RELATIVE_POSE}
    radio: {type: range, channel: RANGE}
"""
}
"""The Raptor with a channel for each kind of aiding."""

QUATERNION = (1.0, 0.0, 0.0, 0.0)

FORGED: dict[str, Callable[[SensorHeader], Sample | VehicleStatusSample]] = {
    "GPS": lambda header: GpsSample(header, FixType.FIX_3D, 50.27, -111.1, 700.0, satellites=9, hdop=1.0),
    "IMU": lambda header: ImuSample(header, (0.0, 0.0, 0.0), (0.0, 0.0, -9.81)),
    "WHEELS": lambda header: WheelsSample(header, (WheelSample("front_left", travel=1.0, speed=3.0),)),
    "JOINTS": lambda header: JointsSample(header, (JointSample("Pan", 0.1),)),
    "RANGE": lambda header: RangeSample(header, "Raptor:CG", "gate", (12.5, -40.0, 3.0), "World:ENU", 41.25, 1e3),
    "ABSOLUTE_POSE": lambda header: AbsolutePoseSample(header, "Raptor:CG", "World:UTM", (900.0, 0.0, 0.0)),
    "RELATIVE_POSE": lambda header: RelativePoseSample(
        header, "Raptor:CG", max(1, header.utime - 100_000), (0.0, 0.0, 0.0), QUATERNION
    ),
    "VEHICLE_STATUS": lambda header: VehicleStatusSample(header),
}
"""A forged message for each channel of a sensor or controller."""


@dataclass
class Attack:
    """Forged messages on a channel: their source name, their stamps (seconds from now) and their rate."""

    channel: str
    source: str
    stamps: Sequence[float]
    hz: float = 100.0
    seq_offset: int | None = None
    """Sequence numbers are those of the true sensor plus this; without it they count up from `first`."""
    first: int = 1_000_000
    since: float = 10.0
    count: int = 1 << 62

    def events(self, drive: SimulatedDrive, until: float) -> Iterator[tuple[int, bytes]]:
        """Yield time of arrival (utime) and message."""
        true: list[Event] = []
        if self.seq_offset is not None:
            true = [each for each in drive.events() if CHANNELS.get(type(each)) == self.channel]
        stamps = itertools.cycle(self.stamps)
        for n in range(min(self.count, int((until - self.since) * self.hz))):
            at = drive.start_utime + round((self.since + (n + 0.37) / self.hz) * 1e6)
            seq = self.first + n
            if self.seq_offset is not None:
                seq = max((e.header.seq for e in true if e.header.host_utime <= at), default=0) + self.seq_offset
            utime = max(1, at + round(next(stamps) * 1e6))
            yield at, encode(FORGED[self.channel](SensorHeader(utime, self.source, seq, at)))


@dataclass
class AttackResult:
    """What the loop published during an attack."""

    drive: SimulatedDrive
    loop: Loop
    poses: list[tuple[int, PoseAnswer]] = field(default_factory=list)

    def invalid(self, since: float) -> list[tuple[float, str]]:
        """Return the invalid poses: seconds since the start, and the reasons."""
        begin = self.drive.start_utime
        return [
            ((at - begin) * 1e-6, str(Invalid(pose.transformation.invalid_reasons)))
            for at, pose in self.poses
            if at >= begin + since * 1e6 and not pose.transformation.is_valid
        ]

    def count_misleading(self, since: float) -> int:
        """Count the valid poses whose error exceeds their protection level."""
        begin = self.drive.start_utime + since * 1e6
        return sum(compare_pose(pose, self.drive.truth(at)).is_misleading for at, pose in self.poses if at >= begin)


class LoopRun:
    """A drive through the loop with simulated time."""

    def __init__(self, drive: SimulatedDrive, folder: Path):
        config = load_config(write_raptor(folder, "", AIDING))
        vehicle = load_vehicle(config)
        self._settings = LoopSettings(
            round(1e9 / vehicle.tick_hz()),
            vehicle.sensor_channels(),
            publisher_conflict=config.sensors.publisher_conflict,
            shared_channels=frozenset({config.sensors.joints.channel}),
        )
        clock = FakeClock(drive.start_utime)
        self._start_loop(drive, clock, vehicle.start_core(clock.now()))
        self._sensors = [(each.header.host_utime, CHANNELS[type(each)], encode(each)) for each in drive.events()]

    def _start_loop(self, drive: SimulatedDrive, clock: FakeClock, state: CoreState) -> None:
        self._clock, self._bus = clock, FakeBus(clock)
        self.loop = Loop(self._bus, clock, state, self._settings)
        self.outcome = AttackResult(drive, self.loop)
        self._step_us = 0

    def copy(self) -> Self:
        """Return a run of the same drive whose own loop starts now, with the state of the core so far."""
        other = copy.copy(self)
        clock = FakeClock(self._clock.utime(), self._clock.monotonic_ns())
        other._start_loop(self.outcome.drive, clock, self.loop.state)
        return other

    def step_clock(self, seconds: float) -> None:
        """Step the host's clock; the sensors, on another computer, keep theirs."""
        self._clock.step_utime(seconds)
        self._step_us += round(seconds * 1e6)

    def run(self, until: float, attacks: Sequence[Attack] = ()) -> AttackResult:
        """Run until a second of the drive, with the attacks beside the sensors."""
        drive = self.outcome.drive
        end = drive.start_utime + round(until * 1e6)
        arrivals = [each for each in self._sensors if self._clock.utime() - self._step_us < each[0] <= end]
        for attack in attacks:
            arrivals += [(at, attack.channel, data) for at, data in attack.events(drive, until)]
        for at, channel, data in sorted(arrivals, key=lambda each: each[0]):
            while at + self._step_us > self._clock.utime():
                self.loop.run_once()
                _collect(self._bus, self.outcome)
            self._bus.sensors.put(channel, data)
        return self.outcome


def _collect(bus: FakeBus, outcome: AttackResult) -> None:
    for name, data in bus.published:
        if name == "POSE":
            pose: PoseAnswer = decode("pose_transform_t", data)
            outcome.poses.append((pose.transformation.utime, pose))
    bus.published.clear()
