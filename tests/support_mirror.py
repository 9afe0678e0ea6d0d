"""What the service would say on the bus of the vehicle in support_moving: for those who only listen."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

from support_moving import BASE, ODOM, T0, UTM, S, estimate, joints_at, rover
from support_moving import view as exact_view

from modelserver.client.knowledge import Knowledge, Known
from modelserver.client.local import LocalPlatform
from modelserver.formats.snapshot import ModelSnapshot, written
from modelserver.geometry.model import Model
from modelserver.messages import Estimate, SnapshotPart
from modelserver.platform import PlatformView
from modelserver.wire.codec import encode
from modelserver.wire.snapshot import PART_BYTES

Message = tuple[str, bytes]
Event = tuple[int, str, bytes]
"""When it arrived, on which channel, its bytes."""

DELAY = 1_500
"""Microseconds from a stamp to the arrival."""


def snapshot(model: Model | None = None, latency_us: int = 0, channel: str = "JOINTS") -> ModelSnapshot:
    return ModelSnapshot("rover", rover() if model is None else model, BASE, BASE, 60.0, channel, latency_us)


def parts(of: ModelSnapshot, utime: int = T0, size: int = PART_BYTES) -> list[Message]:
    data, revision = written(of), of.model.revision
    pieces = [data[start : start + size] for start in range(0, len(data), size)]
    return [
        ("MODEL_SNAPSHOT", encode(SnapshotPart(utime, revision, number, len(pieces), piece)))
        for number, piece in enumerate(pieces)
    ]


def pose(told: Estimate, model: Model | None = None) -> list[Message]:
    """POSE and POSE_ODOM of an estimate."""
    view = PlatformView(rover() if model is None else model, BASE, None, exact_view(0.0).history)
    return [
        ("POSE", encode(view.broadcast(told, UTM))),
        ("POSE_ODOM", encode(view.broadcast(told, ODOM))),
    ]


def joints(seconds: float, latency_us: int = 0) -> Message:
    sample = joints_at(seconds)
    return "JOINTS", encode(replace(sample, header=replace(sample.header, utime=sample.header.utime + latency_us)))


def drive(
    seconds: float = 4.0, start: float = 0.0, pose_hz: float = 100.0, joint_hz: float = 50.0, every_s: float = 1.0
) -> Iterator[Event]:
    """Yield what is said from `start` on, the snapshot first and then every so often."""
    model = rover()
    geometry = snapshot(model)
    view = PlatformView(model, BASE, None, exact_view(0.0).history)
    for n in range(round(start * pose_hz), round((start + seconds) * pose_hz) + 1):
        t = n / pose_hz
        at = T0 + round(t * S)
        if n % round(every_s * pose_hz) == 0:
            for number, (channel, data) in enumerate(parts(geometry, at)):
                yield at + number, channel, data
        told = estimate(t)
        yield at + DELAY, "POSE", encode(view.broadcast(told, UTM))
        yield at + DELAY + 1, "POSE_ODOM", encode(view.broadcast(told, ODOM))
        if n % round(pose_hz / joint_hz) == 0:
            yield at + DELAY + 2, *joints(t)


def fed(events: Iterable[Event], knowledge: Knowledge | None = None) -> Knowledge:
    """Return who has heard them all."""
    knowledge = Knowledge() if knowledge is None else knowledge
    for at, channel, data in events:
        knowledge.feed(channel, data, at)
    return knowledge


class Told(LocalPlatform):
    """Answers from a knowledge at an instant that a test sets."""

    def __init__(self, knowledge: Knowledge, now: int, limit: float = 10.0):
        self.knowledge = knowledge
        self.now = now
        self.limit = limit

    def known(self) -> tuple[Known, int]:
        return self.knowledge.known, self.now
