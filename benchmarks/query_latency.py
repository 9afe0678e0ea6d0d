"""A query over LCM, reply decoded, beside a bare LCM echo of as many bytes: one pair, and random pairs of all frames.

Echo and query take turns call by call, so that a machine that is busy with something else slows both. Between the two
stands the least service that Python could be (`least_server`): two inboxes as the daemon has, and a look into a
dictionary, asked by the same client. What it takes more than the echo no daemon in Python can save.
"""

from __future__ import annotations

import itertools
import random
import select
import statistics
import struct
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import lcm

from benchmarks.flood import sensors
from benchmarks.query_cost import loaded
from benchmarks.support import RAPTOR, daemon, free_url, interleaved, process, ratio, verdict
from modelserver import core
from modelserver.client.remote import Platform
from modelserver.messages import CHANNEL_OF, GetTransformation
from modelserver.wire.channels import literal
from modelserver.wire.codec import decode, encode
from modelserver.wire.provider import resolve_url
from modelserver.wire.queries import write_question

INTEREST, REFERENCE = "Digiclops:ImagePlane", "Raptor:CG"
ROUNDS, CALLS = 40, 100
REPEATS = 3
"""How often each pair is asked again."""

DRIVING_PAIRS = 1000
WHEELS = ("front_left", "front_right")

LEAST = "LEAST_"
"""Channel prefix of the least service."""

_REQUEST = "get_transformation_request_t"
_NAMES_AT = 21
"""Where the names begin in a request whose reply channel is empty; the channel begins one byte before."""
_UTIME = struct.Struct(">q")


def echo_server(reply_file: str) -> None:
    """Answer every message on ECHO with the bytes of a file: the least that a Python server can do."""
    reply = Path(reply_file).read_bytes()
    bus = lcm.LCM(resolve_url())
    bus.subscribe("ECHO", lambda channel, data: bus.publish("REPLY_ECHO", reply)).set_queue_capacity(0)
    while True:
        bus.handle()


def least_server() -> None:
    """Answer each question for a transformation from a dictionary, and do nothing else."""
    state, names, now = loaded(moving=False)
    replies = {}
    for pair in itertools.product(names, repeat=2):
        question = write_question(0, "", *pair, 0, 0, 0)
        (output,) = core.step(state, decode(_REQUEST, write_question(0, "REPLY_LEAST", *pair, 0, 0, 0)), now)[1]
        replies[question[_NAMES_AT:]] = encode(output.reply)
    requests, sensors = lcm.LCM(resolve_url()), lcm.LCM(resolve_url())
    sensors.subscribe("NOTHING", lambda channel, data: None)

    def answer(channel: str, data: bytes) -> None:
        client, _, names = data[_NAMES_AT - 1 :].partition(b"\0")
        reply = replies[names]
        requests.publish(client.decode(), reply[:8] + data[8:16] + _UTIME.pack(time.time_ns() // 1000) + reply[24:])

    requests.subscribe(literal(f"{LEAST}{CHANNEL_OF[GetTransformation]}"), answer)
    poll = select.poll()
    poll.register(requests.fileno(), select.POLLIN)
    poll.register(sensors.fileno(), select.POLLIN)
    while True:
        if poll.poll(20):
            requests.handle()


@contextmanager
def least_service(url: str) -> Iterator[Platform]:
    """Run the least service, and return a client that it has answered."""
    with (
        process("-m", "benchmarks.query_latency", "least", url=url),
        Platform(url, channel_prefix=LEAST, name="least", retries=40, timeout=0.5) as platform,
    ):
        platform.get_transformation(INTEREST, REFERENCE)
        yield platform


class EchoClient:
    """Asks the echo server, as `Platform` asks the daemon."""

    def __init__(self, url: str, request: bytes):
        self._request = request
        self._bus = lcm.LCM(resolve_url(url))
        self._got: list[bytes] = []
        self._bus.subscribe("REPLY_ECHO", self._take)

    def _take(self, channel: str, data: bytes) -> None:
        self._got.append(data)

    def ask(self, patience_ms: int = 2000) -> bytes:
        """Send the request and return the reply. Raises TimeoutError."""
        self._bus.publish("ECHO", self._request)
        while not self._got:
            if not self._bus.handle_timeout(patience_ms):
                raise TimeoutError("the echo server does not answer")
        return self._got.pop()


def captured(url: str, platform: Platform) -> tuple[bytes, bytes]:
    """Return the bytes of a request and its reply as they go over the bus."""
    seen: dict[str, bytes] = {}
    tap = lcm.LCM(resolve_url(url))
    for channel in (CHANNEL_OF[GetTransformation], platform.reply_channel):
        tap.subscribe(literal(channel), lambda channel, data: seen.__setitem__(channel, data))
    platform.get_transformation(INTEREST, REFERENCE)
    while len(seen) < 2:
        if not tap.handle_timeout(2000):
            raise TimeoutError("no request or reply was heard")
    return seen[CHANNEL_OF[GetTransformation]], seen[platform.reply_channel]


@contextmanager
def echoing(url: str, request: bytes, reply: bytes) -> Iterator[EchoClient]:
    """Run an echo server, and return a client that it has answered."""
    with tempfile.TemporaryDirectory() as folder:
        reply_file = Path(folder) / "reply"
        reply_file.write_bytes(reply)
        with process("-m", "benchmarks.query_latency", "echo", str(reply_file), url=url):
            echo = EchoClient(url, request)
            deadline = time.monotonic() + 20.0
            while True:
                try:
                    echo.ask(200)
                    break
                except TimeoutError:
                    if time.monotonic() > deadline:
                        raise
            yield echo


def frames_of(platform: Platform) -> list[str]:
    """Return all frames of the vehicle."""
    bodies = platform.get_body_list()
    return [f"{body}:{frame}" for body in bodies for frame in platform.get_body_frame_list(body)]


def in_turns(
    platform: Platform, echo: EchoClient, least: Platform, pairs: Sequence[tuple[str, str]]
) -> dict[str, list[float]]:
    """Return the seconds of an echo, of a query, and of one to the least service, for each pair in random order."""
    actions: dict[str, Callable[[str, str], object]] = {
        "echo": lambda interest, reference: echo.ask(),
        "query": platform.get_transformation,
        "least service": least.get_transformation,
    }
    times: dict[str, list[float]] = {name: [] for name in actions}
    order = random.Random(2)
    for pair in pairs:
        for name in order.sample(list(actions), len(actions)):
            begin = time.perf_counter()
            actions[name](*pair)
            times[name].append(time.perf_counter() - begin)
    return times


def compare(what: str, times: dict[str, list[float]], p50: float, p99: float = 0.0) -> bool:
    """Print both distributions and their ratios beside the bounds; return whether they hold."""
    of = {name: statistics.quantiles(values, n=100) for name, values in times.items()}
    print(
        f"  {what}: {len(times['query'])} calls; "
        + "; ".join(
            f"{name} p50 {each[49] * 1e6:.0f} us, p90 {each[89] * 1e6:.0f} us, p99 {each[98] * 1e6:.0f} us"
            for name, each in of.items()
        )
    )
    print(f"  {what}: the least service takes {of['least service'][49] / of['echo'][49]:.2f} times the echo")
    holds = verdict(f"{what}: p50 to the echo's", of["query"][49] / of["echo"][49], p50, "x")
    if p99:
        holds &= verdict(f"{what}: p99 to the echo's", of["query"][98] / of["echo"][98], p99, "x")
    return holds


def driving(folder: Path) -> Path:
    """Return a vehicle file of the Raptor that publishes POSE at 100 Hz and keeps nothing."""
    text = (RAPTOR / "vehicle.yaml").read_text()
    text = text.replace("geometry: geometry.yaml", f"geometry: {RAPTOR / 'geometry.yaml'}\nstate_directory: {folder}")
    file = folder / "vehicle.yaml"
    file.write_text(text.replace("rate_hz: 50", "rate_hz: 100"))
    return file


def main() -> int:
    url = free_url()
    times_asked = itertools.count(1_700_000_000_000_000)
    with daemon(url, RAPTOR / "vehicle.yaml") as platform:
        request, reply = captured(url, platform)
        frames = frames_of(platform)
        pairs = list(itertools.product(frames, frames))
        random.Random(1).shuffle(pairs)
        with echoing(url, request, reply) as echo, least_service(free_url()) as least:
            actions = {
                "echo": echo.ask,
                "query": lambda: platform.get_transformation(INTEREST, REFERENCE),
                "query at": lambda: platform.get_transformation(INTEREST, REFERENCE, at=next(times_asked)),
            }
            interleaved(5, CALLS, actions)  # warm up: the interpreter specializes what runs often
            first = in_turns(platform, echo, least, pairs)
            again = in_turns(platform, echo, least, pairs * REPEATS)
            times = interleaved(ROUNDS, CALLS, actions)
    print(f"  request {len(request)} bytes, reply {len(reply)} bytes; {len(frames)} frames, {len(pairs)} pairs")
    holds = compare("random pairs, first time", first, 1.6, 4.0)
    holds &= compare("random pairs, repeated", again, 1.25)
    url = free_url()
    with (
        tempfile.TemporaryDirectory() as folder,
        daemon(url, driving(Path(folder))) as platform,
        process("-m", "benchmarks.query_latency", "sensors", url=url),
        echoing(url, request, reply) as echo,
        least_service(free_url()) as least,
    ):
        time.sleep(5.0)
        some = in_turns(platform, echo, least, pairs[:DRIVING_PAIRS] * 2)
        some = {name: values[DRIVING_PAIRS:] for name, values in some.items()}
    holds &= compare("random pairs, beside POSE and IMU at 100 Hz", some, 2.0)
    print(f"  one pair, p50, median of {ROUNDS} rounds:")
    for name, values in times.items():
        print(f"  {name:10} {statistics.median(values) * 1e6:7.1f} us")
    holds &= verdict("query to echo", ratio(times["query"], times["echo"]), 1.25, "x")
    holds &= verdict("query with its own `at` each time, to echo", ratio(times["query at"], times["echo"]), 1.5, "x")
    return 0 if holds else 1


if __name__ == "__main__":
    if sys.argv[1:2] == ["echo"]:
        echo_server(sys.argv[2])
    elif sys.argv[1:2] == ["least"]:
        least_server()
    elif sys.argv[1:2] == ["sensors"]:
        sensors(100.0, WHEELS, -1.0)
    else:
        sys.exit(main())
