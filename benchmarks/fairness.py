"""Five clients that do not wait for replies beside a polite sixth; and POSE beside long answers.

The five and the service share the machine, so it is loaded. The polite client asks ten times a second and waits for
each
reply: it is to get all of them within 50 ms, and the service is to be back within a second after the flood.
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

from benchmarks.flood import GEOMETRY, POSE_HZ, VEHICLE, Ear, p99
from benchmarks.support import free_url, process, verdict
from modelserver.client.remote import Platform
from modelserver.errors import NoPoseError, NoServerError, RefusedError
from modelserver.messages import GetTransformation, GetTransformations, RequestHeader
from modelserver.wire.codec import encode
from modelserver.wire.provider import resolve_url

CLIENTS = 5
RATES_HZ = (500.0, 2000.0)
LONG_HZ = (1.0, 5.0)
SECONDS = float(sys.argv[2]) if sys.argv[1:2] == ["seconds"] else 5.0
BOUND_S = 0.05
BACK_S = 1.0
USUAL_S = 0.01
"""A reply within this is as usual."""

FRAMES = ("Cart:Base", "Cart:Antenna", "Cart:Imu", "Cart:Left", "Cart:Right", "World:UTM", "Odom:Origin")


START_S = 4.0
"""How long the clients' processes have to start: loading a program is no part of the flood."""


def client(name: str, hz: float, seconds: float, start: float) -> None:
    """Ask at a rate without waiting for replies, static and moving pairs in turns, from a monotonic time on."""
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


def long_client(hz: float, seconds: float) -> None:
    """Ask for 64 pairs at 31 instants of the last seconds, at a rate, without waiting for replies."""
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


class Polite:
    """A client that asks, waits for the reply, and keeps how long it took, with the instant."""

    def __init__(self, url: str, pause_s: float):
        self.replies: list[tuple[float, float]] = []
        self.lost = 0
        self._pause_s = pause_s
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._ask, args=(url,))

    def __enter__(self) -> Polite:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join()

    def _ask(self, url: str) -> None:
        with Platform(url, timeout=2.0, retries=0, name="polite") as platform:
            while not self._end.wait(self._pause_s):
                begin = time.monotonic()
                try:
                    with suppress(NoPoseError):
                        platform.get_pose("Cart:Base", "World:UTM")
                    self.replies.append((begin, time.monotonic() - begin))
                except (NoServerError, RefusedError):
                    self.lost += 1


@contextmanager
def service(url: str, folder: Path) -> Iterator[None]:
    """Run the service with sensors at 200, 100 and 5 Hz."""
    config = folder / "vehicle.yaml"
    config.write_text(VEHICLE)
    (folder / "geometry.yaml").write_text(GEOMETRY)
    run = ("-c", "from mstools.cli import main; main()", "run", "-c", str(config), "--log-level", "error")
    with process(*run, url=url), process("-m", "benchmarks.flood", "sensors", url=url):
        with Platform(url, timeout=1.0, retries=30) as platform:
            platform.get_body_list()
        time.sleep(5.0)
        yield


def five(url: str, hz: float) -> tuple[list[float], int, float]:
    """Return how long the polite client waited beside five others, replies lost, and when the service was back."""
    arguments = ("-m", "benchmarks.fairness", "client")
    with Polite(url, 0.1) as polite, ExitStack() as stack:
        start = time.monotonic() + START_S
        each = [
            stack.enter_context(process(*arguments, f"FAST{n}", str(hz), str(SECONDS), str(start), url=url))
            for n in range(CLIENTS)
        ]
        for child in each:
            child.wait()
        ended = time.monotonic()
        with Polite(url, 0.01) as after:
            time.sleep(3.0)
    during = [took for begin, took in polite.replies if start < begin < ended]
    slow = [begin + took - ended for begin, took in after.replies if took > USUAL_S]
    return during, polite.lost + after.lost, max(slow, default=0.0)


def long_answers(url: str, hz: float, ear: Ear) -> tuple[list[float], float, int]:
    """Return the lateness of poses, how many of a hundred did not come, and the parts of long replies that came."""
    bus = lcm.LCM(resolve_url(url))
    parts: list[int] = []
    bus.subscribe("REPLY_LONG", lambda _, data: parts.append(len(data))).set_queue_capacity(0)
    arguments = ("-m", "benchmarks.fairness", "long", str(hz), str(SECONDS + START_S))
    with process(*arguments, url=url) if hz else ExitStack():
        time.sleep(START_S)
        ear.late.clear()
        begin = time.monotonic()
        while time.monotonic() < begin + SECONDS:
            bus.handle_timeout(10)
        late, took = list(ear.late), time.monotonic() - begin
    time.sleep(1.0)
    return late, 100.0 * (1.0 - len(late) / (took * POSE_HZ)), len(parts)


def main() -> int:
    url = free_url()
    holds = True
    with tempfile.TemporaryDirectory() as folder, service(url, Path(folder)):
        with Polite(url, 0.1) as alone:
            time.sleep(SECONDS)
        quiet = [took for _, took in alone.replies]
        print(f"  alone: {len(quiet)} answers, p50 {statistics.median(quiet) * 1e3:.2f} ms, "
              f"most {max(quiet) * 1e3:.2f} ms")  # fmt: skip
        for hz in RATES_HZ:
            during, lost, back = five(url, hz)
            print(
                f"  beside {CLIENTS} x {hz:g}/s: {len(during)} answers, p50 {statistics.median(during) * 1e3:.2f} ms, "
                f"p90 {statistics.quantiles(during, n=10)[8] * 1e3:.2f} ms, {lost} not answered"
            )
            holds &= verdict("  the polite client's slowest answer", max(during) * 1e3, BOUND_S * 1e3, "ms")
            holds &= verdict("  not answered", lost, 0, "")
            holds &= verdict("  last slow answer after the flood's end", back, BACK_S, "s")
        ear = Ear(url)
        lost_alone = 0.0
        for hz in (0.0, *LONG_HZ):
            late, missing, parts = long_answers(url, hz, ear)
            lost_alone = lost_alone if hz else missing
            print(
                f"  beside {hz:g} long answers a second: {len(late)} poses, lateness p50 "
                f"{statistics.median(late) * 1e3:.2f} ms, p99 {p99(late) * 1e3:.2f} ms; {parts} parts of replies came"
            )
            if hz:
                holds &= verdict("  poses lost, percent more than without", missing - lost_alone, 2.0, "%")
        ear.close()
    return 0 if holds else 1


if __name__ == "__main__":
    if sys.argv[1:2] == ["client"]:
        client(sys.argv[2], *map(float, sys.argv[3:6]))
    elif sys.argv[1:2] == ["long"]:
        long_client(float(sys.argv[2]), float(sys.argv[3]))
    else:
        sys.exit(main())
