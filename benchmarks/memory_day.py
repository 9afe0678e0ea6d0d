"""Memory of the daemon over a day of traffic at full speed, and the cost of foreign channels.

The whole loop, codec and core, on a fake bus and clock: sensors at modest rates, poses, some queries, and every kind of
rejected message. Default is an hour of traffic: `python -m benchmarks.memory_day HOURS`. Memory is compared from a
quarter of the way on, when history and all tables are full. Then damaged messages, sent to a daemon as fast as one
program can: the growth over a million after the first quarter. liblcm retains each channel name that it has ever
received: the cost per name is measured on a real bus.
"""

from __future__ import annotations

import gc
import logging
import os
import random
import sys
import time
from pathlib import Path

import lcm

from benchmarks.support import RAPTOR, free_url, print_verdict, run_process, wait_until_answered
from modelserver.client.remote import Platform
from modelserver.config.vehicle_file import load_config
from modelserver.messages import (
    FixType,
    GetStateVector,
    GetTransformation,
    GpsSample,
    ImuSample,
    JointSample,
    JointsSample,
    RequestHeader,
    SensorHeader,
    TimeQuery,
    WheelSample,
    WheelsSample,
)
from modelserver.server.bus import FakeBus
from modelserver.server.clock import FakeClock
from modelserver.server.diagnostics import read_resident_bytes
from modelserver.server.loop import Loop, LoopSettings
from modelserver.server.vehicle import load_vehicle
from modelserver.simulation import GpsModel, ImuModel, Timing, WheelsModel
from modelserver.wire.codec import encode
from modelserver.wire.provider import resolve_url
from mstools.launch.drive import make_simulation

START = 1_700_000_000_000_000
IMU_HZ, WHEELS_HZ, GPS_HZ, MALFORMED_PERIOD = 20.0, 5.0, 1.0, 50
CHANNELS = {GpsSample: "GPS", ImuSample: "IMU", WheelsSample: "WHEELS"}
NAMES = 100_000
DAMAGED = 1_000_000
MAX_GROWTH_MB = 30.0
"""Growth from a million damaged messages: the queues of liblcm fill by chance, and are not released."""
MAX_GROWTH_KB = 1024
"""Growth per hour: pages of the allocator; a leak of a byte per message is 90 kB."""


def get_resident_kb() -> int:
    """Return the resident memory of this process, kB."""
    gc.collect()
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") // 1024


def run_day(hours: float) -> tuple[int, float, int]:
    """Return the samples, and the growth of memory in the last three quarters: kB per hour, and the largest."""
    logging.disable()
    config = load_config(RAPTOR / "vehicle.yaml")
    vehicle = load_vehicle(config)
    clock = FakeClock(START)
    bus = FakeBus(clock)
    settings = LoopSettings(round(1e9 / vehicle.tick_hz()), vehicle.sensor_channels())
    loop = Loop(bus, clock, vehicle.start_core(clock.now()), settings)
    seconds = hours * 3600.0
    run = make_simulation(
        config,
        START,
        seconds,
        sensors=tuple(CHANNELS),
        imu_model=ImuModel(Timing(IMU_HZ)),
        wheels_model=WheelsModel(Timing(WHEELS_HZ)),
        gps_model=GpsModel(Timing(GPS_HZ)),
    )
    question = GetTransformation(RequestHeader(1, "REPLY_DAY"), "Digiclops:ImagePlane", "World:UTM")
    count, next_check, held = 0, 0.0, []
    for sample in run.events(seconds):
        while sample.header.host_utime > clock.utime():
            loop.run_once()
        data = encode(sample)
        bus.sensors.put(CHANNELS[type(sample)], data)
        count += 1
        if count % MALFORMED_PERIOD == 0:
            # a truncated message, one on a foreign channel, and a query
            bus.sensors.put("IMU", data[: count % len(data)])
            stranger = sample.header.__class__(sample.header.utime, f"stranger{count}")
            bus.sensors.put("IMU", encode(ImuSample(stranger)))
            bus.requests.put("PLATFORM_GET_TRANSFORMATION", encode(question))
            bus.published.clear()
        since = (clock.utime() - START) * 1e-6
        if since >= next_check:
            next_check += seconds / 40.0
            if since >= seconds / 4.0:
                held.append(get_resident_kb())
            if sys.stderr.isatty() or hours > 1.0:
                print(f"    {since / 3600.0:.1f} of {hours:g} h, {get_resident_kb()} kB", file=sys.stderr, flush=True)
    assert loop.state.handler_errors == 0, dict(loop.state.rejected)
    return count, (held[-1] - held[0]) / (0.75 * hours), max(held) - held[0]


def measure_damaged_mb(count: int) -> tuple[float, float]:
    """Send a daemon damaged samples and requests; return its memory after a quarter of them and at the end, MB."""
    chance = random.Random(11)
    header, utime = SensorHeader(1, "imu"), time.time_ns() // 1000
    whole = {
        "IMU": encode(ImuSample(header, (0.0, 0.0, 0.0), (0.0, 0.0, 9.8))),
        "GPS": encode(GpsSample(header, FixType.FIX_3D, 50.27, -111.1, 700.0)),
        "WHEELS": encode(WheelsSample(header, (WheelSample("front_left", speed=1.0),) * 4)),
        "JOINTS": encode(JointsSample(header, (JointSample("Nod", 0.1),))),
        "PLATFORM_GET_TRANSFORMATION": encode(GetTransformation(RequestHeader(1, "REPLY_X"), "A:B", "World:UTM")),
        "PLATFORM_GET_STATE_VECTOR": encode(GetStateVector(RequestHeader(1, "REPLY_X"), TimeQuery(utime))),
    }
    pool = []
    for _ in range(2000):
        channel, data = chance.choice(list(whole.items()))
        cut = bytearray(data[: chance.randrange(8, len(data) + 1)] + chance.randbytes(chance.choice((0, 0, 30, 3000))))
        for _ in range(chance.randrange(4)):
            cut[chance.randrange(8, len(cut)) if len(cut) > 8 else 0] = chance.randrange(256)
        pool.append((channel, bytes(cut)))
    url = resolve_url(free_url())
    run = ("-c", "from mstools.cli import main; main()", "run", "-c", str(RAPTOR / "vehicle.yaml"))
    with run_process(*run, "--log-level", "error", url=url) as served, Platform(url, timeout=0.5) as platform:
        wait_until_answered(platform)
        bus, quarter = lcm.LCM(url), 0.0
        for number in range(count):
            bus.publish(*pool[number % len(pool)])
            if number == count // 4:
                quarter = read_resident_bytes(Path(f"/proc/{served.pid}/statm")) / 1e6
        time.sleep(2.0)
        return quarter, read_resident_bytes(Path(f"/proc/{served.pid}/statm")) / 1e6


def measure_name_bytes() -> float:
    """Return the bytes that liblcm retains per received channel name without a subscriber."""
    url = resolve_url(free_url())
    speaker, receiver = lcm.LCM(url), lcm.LCM(url)
    received: list[bytes] = []
    receiver.subscribe("LAST", lambda _, data: received.append(data))
    before = get_resident_kb()
    for number in range(NAMES):
        speaker.publish(f"STRANGER_{number:011d}", b"")
        if number % 100 == 0:
            received.clear()
            speaker.publish("LAST", b"")
            while not received:
                if not receiver.handle_timeout(2000):
                    raise TimeoutError("the bus does not deliver")
    return (get_resident_kb() - before) * 1024 / NAMES


def main(hours: float = 1.0) -> int:
    print(f"  a channel name of 20 characters without a subscriber: {measure_name_bytes():.0f} bytes in each liblcm")
    begin = time.monotonic()
    count, growth, most = run_day(hours)
    print(f"  {hours:g} h of traffic, {count} samples, in {time.monotonic() - begin:.0f} s; at most {most} kB more")
    quarter, end = measure_damaged_mb(DAMAGED)
    print(f"  {DAMAGED} damaged messages: {quarter:.0f} MB after a quarter of them, {end:.0f} MB at the end")
    holds = print_verdict("growth an hour", growth, MAX_GROWTH_KB, "kB")
    holds &= print_verdict(
        "growth a million damaged messages", (end - quarter) / (0.75e-6 * DAMAGED), MAX_GROWTH_MB, "MB"
    )
    return 0 if holds else 1


if __name__ == "__main__":
    sys.exit(main(*map(float, sys.argv[1:2])))
