"""A burst of 20,000 sensor messages within a second; 15,000 a second of a second publisher, beside the sensors."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import lcm

from benchmarks import flood
from benchmarks.support import RAPTOR, daemon, free_url, process, verdict
from modelserver.messages import Health, ImuSample, SensorHeader, WheelSample, WheelsSample
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


IGNORED_HZ, IGNORED_S = 15_000.0, 10.0
MOST_US = 20.0
"""Processor time of an ignored message, of the whole daemon: 13 us measured, with LCM's two receiving threads."""


def ignored() -> bool:
    """Send samples of a second publisher on IMU beside the sensors; print what they cost, return whether that holds."""
    url = resolve_url(free_url())
    with tempfile.TemporaryDirectory() as folder:
        config = Path(folder) / "vehicle.yaml"
        config.write_text(flood.VEHICLE)
        (Path(folder) / "geometry.yaml").write_text(flood.GEOMETRY)
        run = ("-c", "from mstools.cli import main; main()", "run", "-c", str(config), "--log-level", "error")
        with process(*run, url=url) as served, process("-m", "benchmarks.flood", "sensors", url=url):
            ear = flood.Ear(url)
            time.sleep(6.0)
            before, cpu = _next_report(ear), flood.cpu_seconds(served.pid)
            time.sleep(3.0)
            idle = (flood.cpu_seconds(served.pid) - cpu) / 3.0
            ear.late.clear()
            cpu, begin, sent = flood.cpu_seconds(served.pid), time.monotonic(), 0
            bus = lcm.LCM(url)
            header = SensorHeader(time.time_ns() // 1000, "other", 5)
            data = encode(ImuSample(header, (0.1, 0.0, 0.0), (0.0, 0.0, 9.8)))
            while (now := time.monotonic()) < begin + IGNORED_S:
                while sent < (now - begin) * IGNORED_HZ:
                    bus.publish("IMU", data)
                    sent += 1
                time.sleep(0.001)
            spent = flood.cpu_seconds(served.pid) - cpu - idle * IGNORED_S
            late = flood.p99(ear.late)
            time.sleep(2.0)
            after = _next_report(ear)
            ear.close()
    counted = next((count for name, why, count in after.rejected if (name, why) == ("IMU", "second_writer")), 0)
    lost = after.ticks_missed - before.ticks_missed
    print(f"  {sent} ignored in {IGNORED_S:g} s, {counted} counted")
    print(f"  ticks missed {lost}, POSE p99 {late * 1e3:.1f} ms late")
    return verdict("processor time of an ignored message", spent / sent * 1e6, MOST_US, "us")


def _next_report(ear: flood.Ear) -> Health:
    count, end = len(ear.health), time.monotonic() + 10.0
    while len(ear.health) == count:
        if time.monotonic() > end:
            raise TimeoutError("the daemon sends no health report")
        time.sleep(0.02)
    return ear.health[-1]


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
    return 0 if ignored() and complete else 1
