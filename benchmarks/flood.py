"""POSE beside 10,000 queries per second from one client, relative to the same without; and another client's replies."""

from __future__ import annotations

import itertools
import json
import os
import random
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import lcm

from benchmarks.support import free_url, print_verdict, run_process
from modelserver.client.remote import Platform
from modelserver.errors import NoPoseError, NoServerError, OverloadedError
from modelserver.messages import (
    FixType,
    GetTransformation,
    GpsSample,
    Health,
    ImuSample,
    RequestHeader,
    SensorHeader,
    WheelSample,
    WheelsSample,
)
from modelserver.wire.codec import decode, encode
from modelserver.wire.provider import resolve_url

ROUNDS = 3
SECONDS = float(sys.argv[2]) if sys.argv[1:2] == ["seconds"] else 10.0
"""Of each of the rounds' two parts: 30 s of flood in all."""

POSE_HZ = 100.0
FLOOD_HZ = 10_000.0
WARM_UP_S = 0.5
"""Seconds at the start of a part that are not measured: processes start."""

GEOMETRY = """\
modelserver: geometry/1
name: cart
bodies:
  Cart: {frames: {Base: , Antenna: {xyz: [-0.4, 0.2, 1.2]}, Imu: {xyz: [0.1, 0, 0.3]}, Left: {xyz: [0, 0.3, 0]},
    Right: {xyz: [0, -0.3, 0]}}}
"""
VEHICLE = f"""\
vehicle: cart
geometry: geometry.yaml
base_frame: Cart:Base
state_directory: state
publish: {{rate_hz: {POSE_HZ:g}}}
sensors:
  gps: {{channel: GPS, frame: Cart:Antenna}}
  imu: {{channel: IMU, frame: Cart:Imu}}
  wheels: {{channel: WHEELS, frames: {{left: Cart:Left, right: Cart:Right}}}}
"""


def publish_sensors(hz: float = 200.0, wheel_names: tuple[str, ...] = ("left", "right"), up: float = 1.0) -> None:
    """Publish an IMU at `hz`, wheels at half of it and a receiver at 5 Hz, on a level drive.

    `up` is 1 where the IMU's z axis points up, -1 where it points down.
    """
    bus = lcm.LCM(resolve_url())
    begin, shaken = time.monotonic(), random.Random(1).gauss
    for n in itertools.count():
        time.sleep(max(0.0, begin + n / hz - time.monotonic()))
        utime = time.time_ns() // 1000
        rate = (shaken(0.0, 0.02), shaken(0.0, 0.02), shaken(0.0, 0.02))
        force = (shaken(0.0, 0.3), shaken(0.0, 0.3), up * 9.80665 + shaken(0.0, 0.3))
        bus.publish("IMU", encode(ImuSample(SensorHeader(utime, "imu", n), rate, force)))
        if n % 2 == 0:
            wheels = tuple(WheelSample(name, 2.0 * n / hz, speed=2.0) for name in wheel_names)
            bus.publish("WHEELS", encode(WheelsSample(SensorHeader(utime, "wheels", n // 2), wheels)))
        if n % round(hz / 5.0) == 0:
            east = 2.0 * n / hz
            fix = GpsSample(
                SensorHeader(utime, "gps", n),
                FixType.FIX_3D,
                50.27,
                -111.1 + east / 71_200.0,
                700.0,
                position_covariance=(0.25, 0.0, 0.0, 0.0, 0.25, 0.0, 0.0, 0.0, 1.0),
                velocity=(2.0, 0.0, 0.0),
                velocity_covariance=(0.01, 0.0, 0.0, 0.0, 0.01, 0.0, 0.0, 0.0, 0.01),
            )
            bus.publish("GPS", encode(fix))


def run_flood(seconds: float) -> None:
    """Send requests at the flood's rate without waiting for replies; write their number."""
    bus = lcm.LCM(resolve_url())
    requests = [
        encode(GetTransformation(RequestHeader(n, "REPLY_FLOOD"), "Cart:Base", "World:UTM")) for n in range(1000)
    ]
    begin, sent = time.monotonic(), 0
    while (now := time.monotonic()) < begin + seconds:
        due = round((now - begin) * FLOOD_HZ)
        while sent < due:
            bus.publish("PLATFORM_GET_TRANSFORMATION", requests[sent % 1000])
            sent += 1
        time.sleep(0.001)
    Path(sys.argv[3]).write_text(str(sent))


def run_baseline(seconds: float) -> None:
    """Write the delays of a bare loop that sleeps until absolute deadlines at the rate of POSE."""
    late, begin = [], time.monotonic()
    for n in range(1, round(seconds * POSE_HZ)):
        due = begin + n / POSE_HZ
        time.sleep(max(0.0, due - time.monotonic()))
        late.append(time.monotonic() - due)
    Path(sys.argv[3]).write_text(json.dumps(late))


class PoseDelayRecorder:
    """Receives POSE and health in a thread, and records the delay of each pose."""

    def __init__(self, url: str):
        self.delays: list[float] = []
        self.health: list[Health] = []
        self._bus = lcm.LCM(resolve_url(url))
        self._bus.subscribe("POSE", self._pose)
        self._bus.subscribe("MODELSERVER_HEALTH", lambda _, data: self.health.append(decode("health_t", data)))
        self._end = threading.Event()
        self._last = 0.0
        threading.Thread(target=self._listen, daemon=True).start()

    def _pose(self, _: str, data: bytes) -> None:
        # in timer mode a pose is stamped with its deadline: the delay includes the transport over the bus
        arrived = time.time()
        self.delays.append(arrived - decode("pose_transform_t", data).transformation.utime * 1e-6)

    def _listen(self) -> None:
        while not self._end.is_set():
            self._bus.handle_timeout(100)

    def close(self) -> None:
        """Stop receiving."""
        self._end.set()


def cpu_seconds(pid: int) -> float:
    """Return the CPU time of a process."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def p99(values: list[float]) -> float:
    return statistics.quantiles(values, n=100)[98]


@contextmanager
def query_sequentially(url: str, replies: list[float], lost: list[str]) -> Iterator[None]:
    """Query ten times per second in a thread, recording reply times and losses."""
    end = threading.Event()

    def ask() -> None:
        with Platform(url, timeout=0.5, retries=0, name="sequential") as platform:
            while not end.wait(0.1):
                begin = time.perf_counter()
                try:
                    with suppress(NoPoseError):
                        platform.get_pose("Cart:Base", "World:UTM")
                    replies.append(time.perf_counter() - begin)
                except (NoServerError, OverloadedError) as error:
                    lost.append(type(error).__name__)

    thread = threading.Thread(target=ask)
    thread.start()
    try:
        yield
    finally:
        end.set()
        thread.join()


def main() -> int:
    url = free_url()
    late: dict[bool, list[float]] = {False: [], True: []}
    replies: dict[bool, list[float]] = {False: [], True: []}
    lost: dict[bool, list[str]] = {False: [], True: []}
    bare: dict[bool, list[float]] = {False: [], True: []}
    busy = {False: 0.0, True: 0.0}
    sent = 0
    with tempfile.TemporaryDirectory() as folder:
        config = Path(folder) / "vehicle.yaml"
        config.write_text(VEHICLE)
        (Path(folder) / "geometry.yaml").write_text(GEOMETRY)
        count, bare_file = Path(folder) / "sent", Path(folder) / "bare"
        run = ("-c", "from mstools.cli import main; main()", "run", "-c", str(config), "--log-level", "error")
        with run_process(*run, url=url) as served, run_process("-m", "benchmarks.flood", "sensors", url=url):
            recorder = PoseDelayRecorder(url)
            time.sleep(5.0)
            for number in range(2 * ROUNDS):
                flooded = bool(number % 2)
                count.write_text("0")
                before = cpu_seconds(served.pid)
                with (
                    query_sequentially(url, replies[flooded], lost[flooded]),
                    run_process(
                        "-m", "benchmarks.flood", "baseline", str(SECONDS), str(bare_file), url=url
                    ) as bare_loop,
                ):
                    if flooded:
                        with run_process("-m", "benchmarks.flood", "flood", str(SECONDS), str(count), url=url):
                            time.sleep(WARM_UP_S)
                            recorder.delays.clear()
                            time.sleep(SECONDS)
                            delays = list(recorder.delays)
                            time.sleep(WARM_UP_S)
                    else:
                        recorder.delays.clear()
                        time.sleep(SECONDS)
                        delays = list(recorder.delays)
                    bare_loop.wait()
                bare[flooded] += json.loads(bare_file.read_text())
                busy[flooded] += cpu_seconds(served.pid) - before
                sent += int(count.read_text())
                late[flooded] += delays
                time.sleep(2.0)
            health = recorder.health[-1]
            recorder.close()
    rejected = sum(each for _, why, each in health.rejected if why == "overload")
    warnings = sorted({text for each in recorder.health for subject, text in each.warnings if subject == "requests"})
    for flooded, name in ((False, "quiet"), (True, "flood")):
        times, asked = late[flooded], replies[flooded]
        print(
            f"  {name}: {len(times)} poses, delay p50 {statistics.median(times) * 1e3:.2f} ms, "
            f"p99 {p99(times) * 1e3:.2f} ms, max {max(times) * 1e3:.2f} ms; sequential client at 10 Hz: "
            f"{len(asked)} answers, p50 {statistics.median(asked) * 1e3:.2f} ms, p99 {p99(asked) * 1e3:.2f} ms, "
            f"{len(lost[flooded])} not answered; the daemon's CPU {busy[flooded] / ROUNDS / SECONDS:.0%} of a core"
        )
    print(
        f"  a bare loop at the same rate beside it: p99 {p99(bare[False]) * 1e3:.2f} ms quiet, "
        f"{p99(bare[True]) * 1e3:.2f} ms with the flood: the machine's own jitter"
    )
    print(f"  sent {sent}; answered {health.requests_answered}, rejected and counted {rejected}")
    print(f"  ticks missed {health.ticks_missed}; last warning: {warnings[-1] if warnings else 'none'}")
    unaccounted = sent - rejected - health.requests_answered
    print(f"  neither answered nor counted (lost before; includes the sequential client's): {unaccounted}")
    more = (p99(late[True]) - p99(late[False])) * 1e3
    holds = print_verdict("POSE's p99 delay with the flood, more than without", more, 2.0, "ms")
    holds &= print_verdict("requests of the sequential client not answered", len(lost[True]), 0, "")
    return 0 if holds and rejected else 1


if __name__ == "__main__":
    if sys.argv[1:2] == ["sensors"]:
        publish_sensors()
    elif sys.argv[1:2] == ["baseline"]:
        run_baseline(float(sys.argv[2]))
    elif sys.argv[1:2] == ["flood"]:
        run_flood(float(sys.argv[2]))
    else:
        sys.exit(main())
