"""Serving leaves no cyclic garbage, so the daemon restricts the collector to the youngest generation."""

from __future__ import annotations

import gc
import itertools
import random
from collections.abc import Iterator
from contextlib import contextmanager

from support_cart import drive, localizer, process_all
from support_samples import START, ScriptedLocalizer, imu, start_core

from modelserver.messages import GetExplanation, GetTransformation, GetTransformations, RequestHeader
from modelserver.server.bus import FakeBus
from modelserver.server.clock import FakeClock
from modelserver.server.ingress import SensorChannel
from modelserver.server.loop import Hooks, Loop, LoopSettings
from modelserver.wire.codec import encode

FRAMES = ("Cart:Base", "Cart:Antenna", "Camera:Origin", "Cart:Nothing")


@contextmanager
def count_garbage() -> Iterator[list[int]]:
    """Disable the collector; afterwards the list has the number of unreachable objects."""
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
    loop = Loop(
        bus, clock, start_core(ScriptedLocalizer()), LoopSettings(20_000_000, {"IMU": SensorChannel("imu_t")}), Hooks()
    )
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
                loop.run_once()

    serve()
    published = len(bus.published)
    with count_garbage() as found:
        serve()
    assert len(bus.published) > published + 3 * len(FRAMES) ** 2
    assert found == [0]


def test_given_a_drive_then_the_filter_leaves_no_cyclic_garbage() -> None:
    _, events = drive(6.0)
    middle = len(events) // 2
    warm = process_all(localizer(), events[:middle])
    with count_garbage() as found:
        process_all(warm, events[middle:])
    assert found == [0]
