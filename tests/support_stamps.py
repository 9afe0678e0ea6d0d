"""A stranger's messages with stamps that cannot be believed, beside a simulated drive, through the whole loop."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from support_daemon import write_raptor
from support_ride import CHANNELS, Ride, judged

from modelserver.config import load_config
from modelserver.messages import (
    AbsolutePoseSample,
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
from modelserver.messages.flags import FixType
from modelserver.service.clock import FakeClock
from modelserver.service.daemon import load_vehicle
from modelserver.service.fake_bus import FakeBus
from modelserver.service.loop import Loop, LoopSettings
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
"""A message that a stranger can make, for each channel that a sensor or a controller writes."""


@dataclass
class Attack:
    """Forged messages on a channel: their name for themselves, how they are stamped (seconds from now), how often."""

    channel: str
    source: str
    stamps: Sequence[float]
    hz: float = 100.0
    seq_ahead: int | None = None
    """With a number: the true sensor's number and so much more; else numbers of the attack's own, from `first` on."""
    first: int = 1_000_000
    since: float = 10.0
    count: int = 1 << 62

    def events(self, ride: Ride, until: float) -> Iterator[tuple[int, bytes]]:
        """Yield the instants of arrival (utime) and the messages."""
        true: list[Event] = []
        if self.seq_ahead is not None:
            true = [each for each in ride.events() if CHANNELS.get(type(each)) == self.channel]
        stamps = itertools.cycle(self.stamps)
        for n in range(min(self.count, int((until - self.since) * self.hz))):
            at = ride.start_utime + round((self.since + (n + 0.37) / self.hz) * 1e6)
            seq = self.first + n
            if self.seq_ahead is not None:
                seq = max((e.header.seq for e in true if e.header.host_utime <= at), default=0) + self.seq_ahead
            utime = max(1, at + round(next(stamps) * 1e6))
            yield at, encode(FORGED[self.channel](SensorHeader(utime, self.source, seq, at)))


@dataclass
class Outcome:
    """What the loop published during an attack."""

    ride: Ride
    loop: Loop
    poses: list[tuple[int, PoseAnswer]] = field(default_factory=list)

    def invalid(self, since: float) -> list[tuple[float, str]]:
        """Poses that were not valid: seconds since the start, and why."""
        begin = self.ride.start_utime
        return [
            ((at - begin) * 1e-6, str(Invalid(pose.transformation.invalid_reasons)))
            for at, pose in self.poses
            if at >= begin + since * 1e6 and not pose.transformation.valid
        ]

    def lies(self, since: float) -> int:
        """Return how many valid poses are farther from the truth than the bounds that they state."""
        begin = self.ride.start_utime + since * 1e6
        return sum(judged(pose, self.ride.truth(at)).lies for at, pose in self.poses if at >= begin)


class Drive:
    """A drive through the loop, second by second; time is simulated."""

    def __init__(self, ride: Ride, folder: Path):
        config = load_config(write_raptor(folder, "", AIDING))
        vehicle = load_vehicle(config)
        self._clock = FakeClock(ride.start_utime)
        self._bus = FakeBus(self._clock)
        settings = LoopSettings(
            round(1e9 / vehicle.tick_hz()),
            vehicle.sensor_channels(),
            second_writer=config.sensors.second_writer,
            shared=frozenset({config.sensors.joints.channel}),
        )
        self.loop = Loop(self._bus, self._clock, vehicle.core(self._clock.now()), settings)
        self.outcome = Outcome(ride, self.loop)
        self._step_us = 0
        self._sensors = [(each.header.host_utime, CHANNELS[type(each)], encode(each)) for each in ride.events()]

    def step_clock(self, seconds: float) -> None:
        """Set the host's time of day; the sensors, on another computer, stamp on as before."""
        self._clock.step_utime(seconds)
        self._step_us += round(seconds * 1e6)

    def run(self, until: float, attacks: Sequence[Attack] = ()) -> Outcome:
        """Drive on until a second of the ride, with the attacks beside the sensors."""
        ride = self.outcome.ride
        end = ride.start_utime + round(until * 1e6)
        arrivals = [each for each in self._sensors if self._clock.utime() - self._step_us < each[0] <= end]
        for attack in attacks:
            arrivals += [(at, attack.channel, data) for at, data in attack.events(ride, until)]
        for at, channel, data in sorted(arrivals, key=lambda each: each[0]):
            while at + self._step_us > self._clock.utime():
                self.loop.turn()
                _collect(self._bus, self.outcome)
            self._bus.sensors.put(channel, data)
        return self.outcome


def _collect(bus: FakeBus, outcome: Outcome) -> None:
    for name, data in bus.published:
        if name == "POSE":
            pose: PoseAnswer = decode("pose_transform_t", data)
            outcome.poses.append((pose.transformation.utime, pose))
    bus.published.clear()
