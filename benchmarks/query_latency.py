"""A query over LCM, reply decoded, relative to a bare LCM echo of as many bytes: one pair, and random pairs.

Echo and query alternate call by call, so that other load slows both. The echo has liblcm on both sides. The minimal
Python server (`run_minimal_server`) has the receivers of the daemon and a dictionary lookup, and is queried by the same
client: no daemon in Python can be faster on the same receivers.
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

from benchmarks.flood import publish_sensors
from benchmarks.query_cost import load_core
from benchmarks.support import RAPTOR, free_url, measure_interleaved, print_verdict, ratio, run_daemon, run_process
from modelserver import core
from modelserver.client.remote import Platform
from modelserver.messages import CHANNEL_OF, GetTransformation
from modelserver.wire.channels import to_subscription_pattern
from modelserver.wire.codec import decode, encode, pack_get_transformation
from modelserver.wire.provider import open_receiver, resolve_url

INTEREST, REFERENCE = "Digiclops:ImagePlane", "Raptor:CG"
ROUNDS, CALLS = 40, 100
REPEATS = 3
"""How often each pair is asked again."""

DRIVING_PAIRS = 1000
WHEELS = ("front_left", "front_right")

MINIMAL = "LEAST_"
"""Channel prefix of the least service."""

_REQUEST = "get_transformation_request_t"
_NAMES_AT = 21
"""Where the names begin in a request whose reply channel is empty; the channel begins one byte before."""
_UTIME = struct.Struct(">q")


def run_echo_server(reply_file: str) -> None:
    """Answer every message on ECHO with the bytes of a file."""
    reply = Path(reply_file).read_bytes()
    bus = lcm.LCM(resolve_url())
    bus.subscribe("ECHO", lambda channel, data: bus.publish("REPLY_ECHO", reply)).set_queue_capacity(0)
    while True:
        bus.handle()


def run_minimal_server() -> None:
    """Answer each get_transformation from a dictionary, and do nothing else."""
    state, names, now = load_core(moving=False)
    replies = {}
    for pair in itertools.product(names, repeat=2):
        question = pack_get_transformation(0, "", *pair, 0, 0, 0)
        (output,) = core.step(state, decode(_REQUEST, pack_get_transformation(0, "REPLY_LEAST", *pair, 0, 0, 0)), now)[
            1
        ]
        replies[question[_NAMES_AT:]] = encode(output.reply)
    requests, sensors = open_receiver(resolve_url()), open_receiver(resolve_url())
    requests.subscribe(f"{MINIMAL}{CHANNEL_OF[GetTransformation]}")
    publish = lcm.LCM(resolve_url()).publish
    poll = select.poll()
    poll.register(requests.fileno, select.POLLIN)
    poll.register(sensors.fileno, select.POLLIN)
    while True:
        if not poll.poll(20) or (message := requests.receive()) is None:
            continue
        data = message[1]
        client, _, names = data[_NAMES_AT - 1 :].partition(b"\0")
        reply = replies[names]
        publish(client.decode(), reply[:8] + data[8:16] + _UTIME.pack(time.time_ns() // 1000) + reply[24:])


@contextmanager
def start_minimal_server(url: str) -> Iterator[Platform]:
    """Run the minimal server, and return a client that it has answered."""
    with (
        run_process("-m", "benchmarks.query_latency", "least", url=url),
        Platform(url, channel_prefix=MINIMAL, name="least", retries=40, timeout=0.5) as platform,
    ):
        platform.get_transformation(INTEREST, REFERENCE)
        yield platform


class EchoClient:
    """Queries the echo server, as `Platform` queries the daemon."""

    def __init__(self, url: str, request: bytes):
        self._request = request
        self._bus = lcm.LCM(resolve_url(url))
        self._reply: list[bytes] = []
        self._bus.subscribe("REPLY_ECHO", self._on_reply)

    def _on_reply(self, channel: str, data: bytes) -> None:
        self._reply.append(data)

    def ask(self, timeout_ms: int = 2000) -> bytes:
        """Send the request and return the reply. Raises TimeoutError."""
        self._bus.publish("ECHO", self._request)
        while not self._reply:
            if not self._bus.handle_timeout(timeout_ms):
                raise TimeoutError("the echo server does not answer")
        return self._reply.pop()


def capture(url: str, platform: Platform) -> tuple[bytes, bytes]:
    """Return the bytes of a request and its reply as they are sent over the bus."""
    seen: dict[str, bytes] = {}
    tap = lcm.LCM(resolve_url(url))
    for channel in (CHANNEL_OF[GetTransformation], platform.reply_channel):
        tap.subscribe(to_subscription_pattern(channel), lambda channel, data: seen.__setitem__(channel, data))
    platform.get_transformation(INTEREST, REFERENCE)
    while len(seen) < 2:
        if not tap.handle_timeout(2000):
            raise TimeoutError("no request or reply was received")
    return seen[CHANNEL_OF[GetTransformation]], seen[platform.reply_channel]


@contextmanager
def start_echo(url: str, request: bytes, reply: bytes) -> Iterator[EchoClient]:
    """Run an echo server, and return a client that it has answered."""
    with tempfile.TemporaryDirectory() as folder:
        reply_file = Path(folder) / "reply"
        reply_file.write_bytes(reply)
        with run_process("-m", "benchmarks.query_latency", "echo", str(reply_file), url=url):
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


def measure_pairs(
    platform: Platform, echo: EchoClient, least: Platform, pairs: Sequence[tuple[str, str]]
) -> dict[str, list[float]]:
    """Return the seconds of an echo, of a query, and of one to the minimal server, for each pair in random order."""
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
    """Print both distributions and their ratios beside the bounds; return whether they are met."""
    of = {name: statistics.quantiles(values, n=100) for name, values in times.items()}
    print(
        f"  {what}: {len(times['query'])} calls; "
        + "; ".join(
            f"{name} p50 {each[49] * 1e6:.0f} us, p90 {each[89] * 1e6:.0f} us, p99 {each[98] * 1e6:.0f} us"
            for name, each in of.items()
        )
    )
    print(f"  {what}: the minimal server takes {of['least service'][49] / of['echo'][49]:.2f} times the echo")
    holds = print_verdict(f"{what}: p50 to the echo's", of["query"][49] / of["echo"][49], p50, "x")
    if p99:
        holds &= print_verdict(f"{what}: p99 to the echo's", of["query"][98] / of["echo"][98], p99, "x")
    return holds


def write_driving_vehicle(folder: Path) -> Path:
    """Return a vehicle file of the Raptor that publishes POSE at 100 Hz and stores nothing."""
    text = (RAPTOR / "vehicle.yaml").read_text()
    text = text.replace("geometry: geometry.yaml", f"geometry: {RAPTOR / 'geometry.yaml'}\nstate_directory: {folder}")
    file = folder / "vehicle.yaml"
    file.write_text(text.replace("rate_hz: 50", "rate_hz: 100"))
    return file


def main() -> int:
    url = free_url()
    times_asked = itertools.count(1_700_000_000_000_000)
    with run_daemon(url, RAPTOR / "vehicle.yaml") as platform:
        request, reply = capture(url, platform)
        frames = frames_of(platform)
        pairs = list(itertools.product(frames, frames))
        random.Random(1).shuffle(pairs)
        with start_echo(url, request, reply) as echo, start_minimal_server(free_url()) as least:
            actions = {
                "echo": echo.ask,
                "query": lambda: platform.get_transformation(INTEREST, REFERENCE),
                "query at": lambda: platform.get_transformation(INTEREST, REFERENCE, at=next(times_asked)),
            }
            measure_interleaved(5, CALLS, actions)  # warm up: the interpreter specializes what runs often
            first = measure_pairs(platform, echo, least, pairs)
            again = measure_pairs(platform, echo, least, pairs * REPEATS)
            times = measure_interleaved(ROUNDS, CALLS, actions)
    print(f"  request {len(request)} bytes, reply {len(reply)} bytes; {len(frames)} frames, {len(pairs)} pairs")
    holds = compare("random pairs, first time", first, 1.6, 4.0)
    holds &= compare("random pairs, repeated", again, 1.25)
    url = free_url()
    with (
        tempfile.TemporaryDirectory() as folder,
        run_daemon(url, write_driving_vehicle(Path(folder))) as platform,
        run_process("-m", "benchmarks.query_latency", "sensors", url=url),
        start_echo(url, request, reply) as echo,
        start_minimal_server(free_url()) as least,
    ):
        time.sleep(5.0)
        some = measure_pairs(platform, echo, least, pairs[:DRIVING_PAIRS] * 2)
        some = {name: values[DRIVING_PAIRS:] for name, values in some.items()}
    holds &= compare("random pairs, beside POSE and IMU at 100 Hz", some, 2.0)
    print(f"  one pair, p50, median of {ROUNDS} rounds:")
    for name, values in times.items():
        print(f"  {name:10} {statistics.median(values) * 1e6:7.1f} us")
    holds &= print_verdict("query to echo", ratio(times["query"], times["echo"]), 1.25, "x")
    holds &= print_verdict(
        "query with its own `at` each time, to echo", ratio(times["query at"], times["echo"]), 1.5, "x"
    )
    return 0 if holds else 1


if __name__ == "__main__":
    if sys.argv[1:2] == ["echo"]:
        run_echo_server(sys.argv[2])
    elif sys.argv[1:2] == ["least"]:
        run_minimal_server()
    elif sys.argv[1:2] == ["sensors"]:
        publish_sensors(100.0, WHEELS, -1.0)
    else:
        sys.exit(main())
