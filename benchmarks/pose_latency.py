"""POSE at 100 Hz beside 200 Hz IMU, 100 Hz wheels, GPS and 500 queries/s: delay, relative to a bare sleep loop.

The delay is the time of the publish call minus the tick's deadline. The daemon is a process of its own with a few lines
of instrumentation, which record for each POSE both times, and for each sample its age since `host_utime`. The floor
sleeps to absolute deadlines (clock_nanosleep, TIMER_ABSTIME) at the same rate, half a period apart, and publishes a
message of the same size, under the same load. `python -m benchmarks.pose_latency SECONDS` runs longer.
"""

from __future__ import annotations

import ctypes
import json
import os
import signal
import statistics
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import lcm

from benchmarks.support import RAPTOR, free_url, print_verdict, run_process, wait_until_answered
from modelserver.client.remote import Platform
from modelserver.config.vehicle_file import load_config
from modelserver.errors import NoServerError, QueryError
from modelserver.messages import GpsSample, ImuSample, WheelsSample
from modelserver.simulation import ImuModel, Timing, WheelsModel
from modelserver.wire.codec import encode
from modelserver.wire.provider import resolve_url
from mstools.launch.drive import make_simulation

RATE_HZ = 100
PERIOD_NS = 1_000_000_000 // RATE_HZ
CLIENTS, QUERIES_HZ = 2, 250
SECONDS, WARM_UP_S = 20.0, 8.0
"""How long is measured; and before that until the pose is valid and the interpreters have warmed up."""

POSE_BYTES = 700
CHANNELS = {GpsSample: "GPS", ImuSample: "IMU", WheelsSample: "WHEELS"}
MODULE = "benchmarks.pose_latency"


# --- what runs in processes of its own ----------------------------------------------------------------------


def run_observed_daemon(config: str, found: str) -> None:
    """Run the daemon with instrumentation, and write its records at the end."""
    from modelserver.server import daemon, ingress, loop
    from modelserver.server.vehicle import load_vehicle

    late: list[tuple[int, int]] = []
    ages: list[tuple[int, int]] = []
    made: list[loop.Loop] = []

    class ObservedBus(daemon.LcmBus):
        def __init__(self, url: str = ""):
            super().__init__(url)
            publish = self.publish

            def record(channel: str, data: bytes) -> None:
                if channel == "POSE":
                    now = time.monotonic_ns()
                    # the current deadline is one period before the next
                    late.append((now, now - (made[0]._timer.due_ns - PERIOD_NS)))
                publish(channel, data)

            self.publish = record

    class ObservedLoop(loop.Loop):
        def run(self) -> None:
            made.append(self)
            super().run()

    earlier = ingress.SensorChannel.decode

    def read(self: ingress.SensorChannel, data: bytes) -> object:
        sample = earlier(self, data)
        ages.append((time.monotonic_ns(), time.time_ns() - sample.header.host_utime * 1000))
        return sample

    daemon.LcmBus = ObservedBus  # type: ignore[misc]
    daemon.Loop = ObservedLoop  # type: ignore[misc]
    ingress.SensorChannel.decode = read  # type: ignore[assignment, method-assign]
    daemon.run(load_vehicle(load_config(Path(config)), config), file=config)
    Path(found).write_text(json.dumps({"late": late, "ages": ages, "missed": made[0].state.ticks_missed}))


def run_floor(found: str) -> None:
    """Sleep to absolute deadlines and publish; write the delays at SIGTERM."""
    bus, data = lcm.LCM(resolve_url()), bytes(POSE_BYTES)
    late: list[tuple[int, int]] = []
    ending = []
    signal.signal(signal.SIGTERM, lambda *_: ending.append(True))
    due = time.monotonic_ns() // PERIOD_NS * PERIOD_NS + PERIOD_NS // 2
    while not ending:
        due += PERIOD_NS
        sleep_until(due)
        now = time.monotonic_ns()
        late.append((now, now - due))
        bus.publish("FLOOR", data)
    Path(found).write_text(json.dumps({"late": late}))


class _Timespec(ctypes.Structure):
    _fields_ = (("seconds", ctypes.c_long), ("nanoseconds", ctypes.c_long))


_LIBC = ctypes.CDLL(None, use_errno=True)
_TIMER_ABSTIME = 1


def sleep_until(monotonic_ns: int) -> None:
    """Sleep until an instant of the monotonic clock."""
    until = _Timespec(*divmod(monotonic_ns, 1_000_000_000))
    _LIBC.clock_nanosleep(time.CLOCK_MONOTONIC, _TIMER_ABSTIME, ctypes.byref(until), None)


def run_feeder(seconds: str) -> None:
    """Publish a drive that began five seconds ago, each sample when it arrives, stamped when it is published."""
    bus = lcm.LCM(resolve_url())
    start = time.time_ns() // 1000 - 5_000_000
    config = load_config(RAPTOR / "vehicle.yaml")
    run = make_simulation(
        config,
        start,
        float(seconds),
        sensors=tuple(CHANNELS),
        imu_model=ImuModel(Timing(200.0, latency=0.002)),
        wheels_model=WheelsModel(Timing(100.0, latency=0.002)),
    )
    for sample in run.events(float(seconds)):
        early = sample.header.host_utime - time.time_ns() // 1000
        if early > 0:
            sleep_until(time.monotonic_ns() + early * 1000)
        header = replace(sample.header, host_utime=time.time_ns() // 1000)
        bus.publish(CHANNELS[type(sample)], encode(replace(sample, header=header)))


def run_client(number: str) -> None:
    """Query the daemon at a constant rate."""
    with Platform(name=f"client{number}", timeout=1.0, retries=0) as platform:
        due = time.monotonic_ns() + int(number) * 1_000_000
        while True:
            due += 1_000_000_000 // QUERIES_HZ
            sleep_until(due)
            try:
                platform.get_transformation("Digiclops:ImagePlane", "World:UTM")
            except (QueryError, NoServerError):
                continue  # no pose yet, or overload: only the service's cost counts


# --- the measurement ----------------------------------------------------------------------------------------


def cpu_seconds(pid: int) -> float:
    """Return the CPU time of a process, with its threads, in user and kernel mode."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def quantile(values: Sequence[float], share: float) -> float:
    """Return the `share` quantile of the values."""
    return sorted(values)[min(len(values) - 1, int(share * len(values)))]


def main(seconds: float = SECONDS) -> int:
    url = free_url()
    with tempfile.TemporaryDirectory() as folder:
        config = Path(folder) / "vehicle.yaml"
        text = (RAPTOR / "vehicle.yaml").read_text().partition("\ndrivers:")[0]
        text = text.replace("geometry: geometry.yaml", f"geometry: {RAPTOR / 'geometry.yaml'}\nstate_directory: state")
        config.write_text(text.replace("rate_hz: 50 ", f"rate_hz: {RATE_HZ} "))
        served, bare = Path(folder) / "served.json", Path(folder) / "bare.json"
        with run_process("-m", MODULE, "daemon", str(config), str(served), url=url) as server:
            with Platform(url) as platform:
                wait_until_answered(platform)
            lasting = seconds + WARM_UP_S + 10.0
            with (
                run_process("-m", MODULE, "feeder", f"{lasting:g}", url=url),
                run_process("-m", MODULE, "client", "0", url=url),
                run_process("-m", MODULE, "client", "1", url=url),
                run_process("-m", MODULE, "floor", str(bare), url=url) as other,
            ):
                time.sleep(WARM_UP_S)
                begin, used = time.monotonic_ns(), cpu_seconds(server.pid)
                answered = _count_answered(url)
                time.sleep(seconds)
                end, used = time.monotonic_ns(), cpu_seconds(server.pid) - used
                answered = _count_answered(url) - answered
                other.send_signal(signal.SIGTERM)
                other.wait(10)
            server.send_signal(signal.SIGTERM)
            server.wait(10)
        record, floors = json.loads(served.read_text()), json.loads(bare.read_text())

    def within(pairs: list[list[int]]) -> list[float]:
        return [value * 1e-6 for at, value in pairs if begin <= at < end]

    late, ages, bounds = within(record["late"]), within(record["ages"]), within(floors["late"])
    spent = (end - begin) * 1e-9
    print(
        f"  {len(late)} poses, {len(ages)} samples, {answered / spent:.0f} answers/s in {spent:.1f} s; "
        f"load {os.getloadavg()[0]:.1f}"
    )
    for name, values in (("POSE", late), ("floor", bounds), ("sample's age", ages)):
        print(
            f"  {name:13} p50 {statistics.median(values):7.3f}  p90 {quantile(values, 0.9):7.3f}  "
            f"p99 {quantile(values, 0.99):7.3f}  most {max(values):7.3f} ms"
        )
    lost = round(spent * RATE_HZ) - len(late)
    holds = print_verdict("POSE's p50 to the floor's", statistics.median(late) / statistics.median(bounds), 1.5, "x")
    holds &= print_verdict("POSE's p99 beyond the floor's", quantile(late, 0.99) - quantile(bounds, 0.99), 3.0, "ms")
    holds &= print_verdict("age of samples when handled, p99", quantile(ages, 0.99), 5.0, "ms")
    holds &= print_verdict("ticks lost", max(lost, 0), 1.0, "")
    holds &= print_verdict("CPU of one core", 100.0 * used / spent, 35.0, "%")
    return 0 if holds else 1


def _count_answered(url: str) -> int:
    """Return the number of answered requests in the daemon's next health report."""
    from modelserver.wire.codec import decode

    bus, received = lcm.LCM(resolve_url(url)), []
    bus.subscribe("MODELSERVER_HEALTH", lambda _, data: received.append(data))
    while not received:
        if not bus.handle_timeout(5000):
            raise TimeoutError("the daemon sends no health report")
    return int(decode("health_t", received[-1]).requests_answered)


PARTS = {"daemon": run_observed_daemon, "floor": run_floor, "feeder": run_feeder, "client": run_client}

if __name__ == "__main__":
    if sys.argv[1:2] and sys.argv[1] in PARTS:
        PARTS[sys.argv[1]](*sys.argv[2:])
    else:
        sys.exit(main(*map(float, sys.argv[1:2])))
