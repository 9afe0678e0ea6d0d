"""Serving leaves no cyclic garbage: the daemon lets the collector look at the youngest objects only."""

from __future__ import annotations

import gc
import itertools
import random
from collections.abc import Iterator
from contextlib import contextmanager

from support_cart import drive, localizer, taken
from support_samples import START, Scripted, imu, started

from modelserver.messages import GetExplanation, GetTransformation, GetTransformations, RequestHeader
from modelserver.service.clock import FakeClock
from modelserver.service.fake_bus import FakeBus
from modelserver.service.heard import SensorChannel
from modelserver.service.hooks import Hooks
from modelserver.service.loop import Loop, LoopSettings
from modelserver.wire.codec import encode

FRAMES = ("Cart:Base", "Cart:Antenna", "Camera:Origin", "Cart:Nothing")


@contextmanager
def uncollected() -> Iterator[list[int]]:
    """Work without the collector; then the list holds how many unreachable objects it finds."""
    found: list[int] = []
    gc.collect()
    gc.disable()
    try:
        yield found
        found.append(gc.collect())
    finally:
        gc.enable()


def test_given_questions_samples_and_malformed_messages_then_the_loop_leaves_no_cyclic_garbage() -> None:
    clock = FakeClock(START, 10_000_000_000)
    bus = FakeBus(clock)
    loop = Loop(bus, clock, started(Scripted()), LoopSettings(20_000_000, {"IMU": SensorChannel("imu_t")}), Hooks())
    numbers = random.Random(5)

    def serve() -> None:
        header = RequestHeader(7, "REPLY_TEST")
        for n, (a, b) in enumerate(itertools.product(FRAMES, repeat=2)):
            bus.sensors.put("IMU", encode(imu(START + n)))
            bus.sensors.put("IMU", numbers.randbytes(40))
            bus.requests.put("PLATFORM_GET_TRANSFORMATION", encode(GetTransformation(header, a, b)))
            bus.requests.put("PLATFORM_GET_TRANSFORMATION", numbers.randbytes(60))
            bus.requests.put("PLATFORM_GET_EXPLANATION", encode(GetExplanation(header, a, b)))
            bus.requests.put("PLATFORM_GET_TRANSFORMATIONS", encode(GetTransformations(header, ((a, b),), (START,))))
            for _ in range(20):
                loop.turn()

    serve()
    published = len(bus.published)
    with uncollected() as found:
        serve()
    assert len(bus.published) > published + 3 * len(FRAMES) ** 2
    assert found == [0]


def test_given_a_drive_then_the_filter_leaves_no_cyclic_garbage() -> None:
    _, events = drive(6.0)
    middle = len(events) // 2
    warm = taken(localizer(), events[:middle])
    with uncollected() as found:
        taken(warm, events[middle:])
    assert found == [0]
