"""A burst of 20,000 sensor messages within a second; a second publisher of 15,000 messages per second on IMU."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import lcm

from benchmarks import flood
from benchmarks.support import RAPTOR, free_url, print_verdict, run_daemon, run_process
from modelserver.messages import Health, ImuSample, SensorHeader, WheelSample, WheelsSample
from modelserver.wire.codec import decode, encode
from modelserver.wire.provider import resolve_url

COUNT = 20_000
SOURCE = "burst"


def count_received(bus: lcm.LCM, received: list[bytes]) -> int:
    """Return the number of messages of the source in the daemon's next health report."""
    received.clear()
    while not received:
        if not bus.handle_timeout(3000):
            raise TimeoutError("the daemon sends no health report")
    health = decode("health_t", received[-1])
    return next((each.count for each in health.channels if each.channel == f"sensor:{SOURCE}"), 0)


CONFLICT_HZ, CONFLICT_S = 15_000.0, 10.0
MAX_US = 10.0
"""Processor time per ignored message, of the whole daemon: 5 to 6 us measured."""


def measure_publisher_conflict() -> bool:
    """Publish IMU samples of a second publisher; print their cost, return whether it is within bounds."""
    url = resolve_url(free_url())
    with tempfile.TemporaryDirectory() as folder:
        config = Path(folder) / "vehicle.yaml"
        config.write_text(flood.VEHICLE)
        (Path(folder) / "geometry.yaml").write_text(flood.GEOMETRY)
        run = ("-c", "from mstools.cli import main; main()", "run", "-c", str(config), "--log-level", "error")
        with run_process(*run, url=url) as served, run_process("-m", "benchmarks.flood", "sensors", url=url):
            recorder = flood.PoseDelayRecorder(url)
            time.sleep(6.0)
            before, cpu = _next_report(recorder), flood.cpu_seconds(served.pid)
            time.sleep(3.0)
            idle = (flood.cpu_seconds(served.pid) - cpu) / 3.0
            recorder.delays.clear()
            cpu, begin, sent = flood.cpu_seconds(served.pid), time.monotonic(), 0
            bus = lcm.LCM(url)
            header = SensorHeader(time.time_ns() // 1000, "other", 5)
            data = encode(ImuSample(header, (0.1, 0.0, 0.0), (0.0, 0.0, 9.8)))
            while (now := time.monotonic()) < begin + CONFLICT_S:
                while sent < (now - begin) * CONFLICT_HZ:
                    bus.publish("IMU", data)
                    sent += 1
                time.sleep(0.001)
            spent = flood.cpu_seconds(served.pid) - cpu - idle * CONFLICT_S
            late = flood.p99(recorder.delays)
            time.sleep(2.0)
            after = _next_report(recorder)
            recorder.close()
    counted = next((count for name, why, count in after.rejected if (name, why) == ("IMU", "publisher_conflict")), 0)
    lost = after.ticks_missed - before.ticks_missed
    print(f"  {sent} ignored in {CONFLICT_S:g} s, {counted} counted")
    print(f"  ticks missed {lost}, POSE p99 {late * 1e3:.1f} ms late")
    return print_verdict("processor time of an ignored message", spent / sent * 1e6, MAX_US, "us")


def _next_report(listener: flood.PoseDelayRecorder) -> Health:
    count, end = len(listener.health), time.monotonic() + 10.0
    while len(listener.health) == count:
        if time.monotonic() > end:
            raise TimeoutError("the daemon sends no health report")
        time.sleep(0.02)
    return listener.health[-1]


def main() -> int:
    url = free_url()
    with run_daemon(url, RAPTOR / "vehicle.yaml"):
        bus = lcm.LCM(resolve_url(url))
        received: list[bytes] = []
        bus.subscribe("MODELSERVER_HEALTH", lambda channel, data: received.append(data))
        now = time.time_ns() // 1000
        burst = [
            encode(WheelsSample(SensorHeader(now + n, SOURCE, n), (WheelSample("front_left", travel=0.01 * n),)))
            for n in range(COUNT)
        ]
        begin = time.monotonic()
        for n, data in enumerate(burst):
            bus.publish("WHEELS", data)
            # evenly over one second, in chunks of a millisecond
            if n % 20 == 19 and (early := begin + (n + 1) / COUNT - time.monotonic()) > 0:
                time.sleep(early)
        took = time.monotonic() - begin
        deadline = time.monotonic() + 10.0
        while (count := count_received(bus, received)) < COUNT and time.monotonic() < deadline:
            pass
    print(f"  {COUNT} messages sent in {took:.2f} s ({COUNT / took:.0f}/s)")
    complete = count == COUNT
    print(f"  received by the daemon: {count} of {COUNT} {'' if complete else '  <-- INCOMPLETE'}")
    return 0 if measure_publisher_conflict() and complete else 1
