"""A burst of 20,000 sensor messages within a second, and how many of them the daemon has taken."""

from __future__ import annotations

import time

import lcm

from benchmarks.support import RAPTOR, daemon, free_url
from modelserver.messages import SensorHeader, WheelSample, WheelsSample
from modelserver.wire.codec import decode, encode
from modelserver.wire.provider import resolve_url

COUNT = 20_000
SOURCE = "burst"


def taken(bus: lcm.LCM, heard: list[bytes]) -> int:
    """Return how many messages of the source the daemon's next health report counts."""
    heard.clear()
    while not heard:
        if not bus.handle_timeout(3000):
            raise TimeoutError("the daemon sends no health report")
    health = decode("health_t", heard[-1])
    return next((each.count for each in health.channels if each.channel == f"sensor:{SOURCE}"), 0)


def main() -> int:
    url = free_url()
    with daemon(url, RAPTOR / "vehicle.yaml"):
        bus = lcm.LCM(resolve_url(url))
        heard: list[bytes] = []
        bus.subscribe("MODELSERVER_HEALTH", lambda channel, data: heard.append(data))
        now = time.time_ns() // 1000
        burst = [
            encode(WheelsSample(SensorHeader(now + n, SOURCE, n), (WheelSample("front_left", travel=0.01 * n),)))
            for n in range(COUNT)
        ]
        begin = time.monotonic()
        for n, data in enumerate(burst):
            bus.publish("WHEELS", data)
            # evenly over one second, in portions of a millisecond
            if n % 20 == 19 and (early := begin + (n + 1) / COUNT - time.monotonic()) > 0:
                time.sleep(early)
        took = time.monotonic() - begin
        deadline = time.monotonic() + 10.0
        while (count := taken(bus, heard)) < COUNT and time.monotonic() < deadline:
            pass
    print(f"  {COUNT} messages sent in {took:.2f} s ({COUNT / took:.0f} a second)")
    complete = count == COUNT
    print(f"  taken by the daemon: {count} of {COUNT} {'' if complete else '  <-- INCOMPLETE'}")
    return 0 if complete else 1
