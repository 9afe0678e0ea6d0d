"""The messages that a server would publish for the vehicle in support_moving, as input for mirrors."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

from support_moving import BASE, ODOM, T0, UTM, S, estimate, joints_at, rover
from support_moving import view as exact_view

from modelserver.client.mirror import LocalPlatform
from modelserver.client.mirror_state import MirrorReceiver, MirrorState
from modelserver.formats.yaml_geometry import ModelSnapshot, encode_snapshot
from modelserver.geometry.model import Model
from modelserver.messages import Estimate, SnapshotPart
from modelserver.query.view import PlatformView
from modelserver.wire.codec import PART_BYTES, encode

Message = tuple[str, bytes]
Event = tuple[int, str, bytes]
"""When it arrived, on which channel, its bytes."""

DELAY = 1_500
"""Microseconds from a stamp to the arrival."""


def snapshot(model: Model | None = None, latency_us: int = 0, channel: str = "JOINTS") -> ModelSnapshot:
    return ModelSnapshot("rover", rover() if model is None else model, BASE, BASE, 60.0, channel, latency_us)


def parts(of: ModelSnapshot, utime: int = T0, size: int = PART_BYTES) -> list[Message]:
    data, revision = encode_snapshot(of), of.model.revision
    pieces = [data[start : start + size] for start in range(0, len(data), size)]
    return [
        ("MODEL_SNAPSHOT", encode(SnapshotPart(utime, revision, number, len(pieces), piece)))
        for number, piece in enumerate(pieces)
    ]


def pose(published: Estimate, model: Model | None = None) -> list[Message]:
    """POSE and POSE_ODOM of an estimate."""
    view = PlatformView(rover() if model is None else model, BASE, None, exact_view(0.0).history)
    return [
        ("POSE", encode(view.get_published_pose(published, UTM))),
        ("POSE_ODOM", encode(view.get_published_pose(published, ODOM))),
    ]


def joints(seconds: float, latency_us: int = 0) -> Message:
    sample = joints_at(seconds)
    return "JOINTS", encode(replace(sample, header=replace(sample.header, utime=sample.header.utime + latency_us)))


def drive(
    seconds: float = 4.0, start: float = 0.0, pose_hz: float = 100.0, joint_hz: float = 50.0, every_s: float = 1.0
) -> Iterator[Event]:
    """Yield the messages from `start` on, the snapshot first and then every `every_s` seconds."""
    model = rover()
    geometry = snapshot(model)
    view = PlatformView(model, BASE, None, exact_view(0.0).history)
    for n in range(round(start * pose_hz), round((start + seconds) * pose_hz) + 1):
        t = n / pose_hz
        at = T0 + round(t * S)
        if n % round(every_s * pose_hz) == 0:
            for number, (channel, data) in enumerate(parts(geometry, at)):
                yield at + number, channel, data
        published = estimate(t)
        yield at + DELAY, "POSE", encode(view.get_published_pose(published, UTM))
        yield at + DELAY + 1, "POSE_ODOM", encode(view.get_published_pose(published, ODOM))
        if n % round(pose_hz / joint_hz) == 0:
            yield at + DELAY + 2, *joints(t)


def feed_messages(events: Iterable[Event], receiver: MirrorReceiver | None = None) -> MirrorReceiver:
    """Feed all messages to a receiver and return it."""
    receiver = MirrorReceiver() if receiver is None else receiver
    for at, channel, data in events:
        receiver.feed(channel, data, at)
    return receiver


class FedPlatform(LocalPlatform):
    """A platform with a receiver and a time that the test sets."""

    def __init__(self, receiver: MirrorReceiver, now: int, limit: float = 10.0):
        self.receiver = receiver
        self.now = now
        self.limit = limit

    def read_state(self) -> tuple[MirrorState, int]:
        return self.receiver.state, self.now
