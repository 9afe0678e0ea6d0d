"""Five clients that do not wait for replies beside a sequential sixth; and POSE beside batch replies.

The five and the service share the machine, so it is loaded. The sequential client sends ten requests per second and
waits for each reply: it must get all of them within 50 ms, and the service must recover within a second after the
flood.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import lcm

from benchmarks.flood import GEOMETRY, POSE_HZ, VEHICLE, PoseDelayRecorder, p99
from benchmarks.support import free_url, print_verdict, run_process
from modelserver.client.remote import Platform
from modelserver.errors import NoPoseError, NoServerError, OverloadedError
from modelserver.messages import GetTransformation, GetTransformations, RequestHeader
from modelserver.wire.codec import encode
from modelserver.wire.provider import resolve_url

CLIENTS = 5
RATES_HZ = (500.0, 2000.0)
BATCH_HZ = (1.0, 5.0)
SECONDS = float(sys.argv[2]) if sys.argv[1:2] == ["seconds"] else 5.0
BOUND_S = 0.05
RECOVERY_S = 1.0
BASELINE_S = 0.01
"""Reply time without load, at most."""

FRAMES = ("Cart:Base", "Cart:Antenna", "Cart:Imu", "Cart:Left", "Cart:Right", "World:UTM", "Odom:Origin")


START_S = 4.0
"""Start-up time of the clients' processes, which is no part of the flood."""


def run_client(name: str, hz: float, seconds: float, start: float) -> None:
    """Send requests at a rate without waiting for replies, static and moving pairs in turn, from a start time on."""
    bus = lcm.LCM(resolve_url())
    header = RequestHeader(1, f"REPLY_{name}")
    requests = [encode(GetTransformation(header, a, b)) for a in FRAMES for b in FRAMES]
    begin, sent = start, 0
    time.sleep(max(0.0, start - time.monotonic()))
    while (now := time.monotonic()) < begin + seconds:
        due = round((now - begin) * hz)
        while sent < due:
            bus.publish("PLATFORM_GET_TRANSFORMATION", requests[sent % len(requests)])
            sent += 1
        time.sleep(0.001)


def run_batch_client(hz: float, seconds: float) -> None:
    """Request 64 pairs at 31 instants of the last seconds, at a rate, without waiting for replies."""
    bus = lcm.LCM(resolve_url())
    begin, sent = time.monotonic(), 0
    while (now := time.monotonic()) < begin + seconds:
        if sent < (now - begin) * hz:
            newest = time.time_ns() // 1000 - 200_000
            at = tuple(newest - n * 100_000 for n in range(31))
            pairs = tuple((FRAMES[n % 5], "World:UTM") for n in range(64))
            bus.publish(
                "PLATFORM_GET_TRANSFORMATIONS",
                encode(GetTransformations(RequestHeader(sent, "REPLY_LONG"), pairs, at)),
            )
            sent += 1
        time.sleep(0.005)


class SequentialClient:
    """A client that waits for each reply, and records start and duration of each request."""

    def __init__(self, url: str, pause_s: float):
        self.replies: list[tuple[float, float]] = []
        self.lost = 0
        self._pause_s = pause_s
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._ask, args=(url,))

    def __enter__(self) -> SequentialClient:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join()

    def _ask(self, url: str) -> None:
        with Platform(url, timeout=2.0, retries=0, name="sequential") as platform:
            while not self._end.wait(self._pause_s):
                begin = time.monotonic()
                try:
                    with suppress(NoPoseError):
                        platform.get_pose("Cart:Base", "World:UTM")
                    self.replies.append((begin, time.monotonic() - begin))
                except (NoServerError, OverloadedError):
                    self.lost += 1


@contextmanager
def run_service(url: str, folder: Path) -> Iterator[None]:
    """Run the service with sensors at 200, 100 and 5 Hz."""
    config = folder / "vehicle.yaml"
    config.write_text(VEHICLE)
    (folder / "geometry.yaml").write_text(GEOMETRY)
    run = ("-c", "from mstools.cli import main; main()", "run", "-c", str(config), "--log-level", "error")
    with run_process(*run, url=url), run_process("-m", "benchmarks.flood", "sensors", url=url):
        with Platform(url, timeout=1.0, retries=30) as platform:
            platform.get_body_list()
        time.sleep(5.0)
        yield


def measure_beside_five(url: str, hz: float) -> tuple[list[float], int, float]:
    """Return the sequential client's reply times beside five others, lost replies, and the recovery time."""
    arguments = ("-m", "benchmarks.fairness", "client")
    with SequentialClient(url, 0.1) as sequential, ExitStack() as stack:
        start = time.monotonic() + START_S
        each = [
            stack.enter_context(run_process(*arguments, f"FAST{n}", str(hz), str(SECONDS), str(start), url=url))
            for n in range(CLIENTS)
        ]
        for child in each:
            child.wait()
        ended = time.monotonic()
        with SequentialClient(url, 0.01) as after:
            time.sleep(3.0)
    during = [took for begin, took in sequential.replies if start < begin < ended]
    slow = [begin + took - ended for begin, took in after.replies if took > BASELINE_S]
    return during, sequential.lost + after.lost, max(slow, default=0.0)


def measure_batch_replies(url: str, hz: float, listener: PoseDelayRecorder) -> tuple[list[float], float, int]:
    """Return the delays of poses, the percentage of lost ones, and the number of reply parts received."""
    bus = lcm.LCM(resolve_url(url))
    parts: list[int] = []
    bus.subscribe("REPLY_LONG", lambda _, data: parts.append(len(data))).set_queue_capacity(0)
    arguments = ("-m", "benchmarks.fairness", "long", str(hz), str(SECONDS + START_S))
    with run_process(*arguments, url=url) if hz else ExitStack():
        time.sleep(START_S)
        listener.delays.clear()
        begin = time.monotonic()
        while time.monotonic() < begin + SECONDS:
            bus.handle_timeout(10)
        late, took = list(listener.delays), time.monotonic() - begin
    time.sleep(1.0)
    return late, 100.0 * (1.0 - len(late) / (took * POSE_HZ)), len(parts)


def main() -> int:
    url = free_url()
    holds = True
    with tempfile.TemporaryDirectory() as folder, run_service(url, Path(folder)):
        with SequentialClient(url, 0.1) as alone:
            time.sleep(SECONDS)
        quiet = [took for _, took in alone.replies]
        print(f"  alone: {len(quiet)} answers, p50 {statistics.median(quiet) * 1e3:.2f} ms, "
              f"most {max(quiet) * 1e3:.2f} ms")  # fmt: skip
        for hz in RATES_HZ:
            during, lost, back = measure_beside_five(url, hz)
            print(
                f"  beside {CLIENTS} x {hz:g}/s: {len(during)} answers, p50 {statistics.median(during) * 1e3:.2f} ms, "
                f"p90 {statistics.quantiles(during, n=10)[8] * 1e3:.2f} ms, {lost} not answered"
            )
            holds &= print_verdict("  the sequential client's slowest reply", max(during) * 1e3, BOUND_S * 1e3, "ms")
            holds &= print_verdict("  not answered", lost, 0, "")
            holds &= print_verdict("  last slow answer after the flood's end", back, RECOVERY_S, "s")
        recorder = PoseDelayRecorder(url)
        lost_alone = 0.0
        for hz in (0.0, *BATCH_HZ):
            late, missing, parts = measure_batch_replies(url, hz, recorder)
            lost_alone = lost_alone if hz else missing
            print(
                f"  beside {hz:g} batch requests/s: {len(late)} poses, delay p50 "
                f"{statistics.median(late) * 1e3:.2f} ms, p99 {p99(late) * 1e3:.2f} ms; {parts} parts of replies came"
            )
            if hz:
                holds &= print_verdict("  poses lost, percent more than without", missing - lost_alone, 2.0, "%")
        recorder.close()
    return 0 if holds else 1


if __name__ == "__main__":
    if sys.argv[1:2] == ["client"]:
        run_client(sys.argv[2], *map(float, sys.argv[3:6]))
    elif sys.argv[1:2] == ["long"]:
        run_batch_client(float(sys.argv[2]), float(sys.argv[3]))
    else:
        sys.exit(main())
