"""A query over LCM, reply decoded, beside a bare LCM echo of the same request and reply bytes."""

from __future__ import annotations

import itertools
import statistics
import sys
import tempfile
import time
from pathlib import Path

import lcm

from benchmarks.support import RAPTOR, daemon, free_url, interleaved, process, ratio, verdict
from modelserver.client.remote import Platform
from modelserver.messages import CHANNEL_OF, GetTransformation
from modelserver.wire.channels import literal
from modelserver.wire.provider import resolve_url

INTEREST, REFERENCE = "Digiclops:ImagePlane", "Raptor:CG"
ROUNDS, CALLS = 40, 100


def echo_server(reply_file: str) -> None:
    """Answer every message on ECHO with the bytes of a file: the least that a Python server can do."""
    reply = Path(reply_file).read_bytes()
    bus = lcm.LCM(resolve_url())
    bus.subscribe("ECHO", lambda channel, data: bus.publish("REPLY_ECHO", reply)).set_queue_capacity(0)
    while True:
        bus.handle()


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


def main() -> int:
    url = free_url()
    times_asked = itertools.count(1_700_000_000_000_000)
    with daemon(url, RAPTOR / "vehicle.yaml") as platform, tempfile.TemporaryDirectory() as folder:
        request, reply = captured(url, platform)
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
            actions = {
                "echo": echo.ask,
                "query": lambda: platform.get_transformation(INTEREST, REFERENCE),
                "query at": lambda: platform.get_transformation(INTEREST, REFERENCE, at=next(times_asked)),
            }
            interleaved(5, CALLS, actions)  # warm up: the interpreter specializes what runs often
            times = interleaved(ROUNDS, CALLS, actions)
    print(f"  request {len(request)} bytes, reply {len(reply)} bytes; p50, median of {ROUNDS} rounds:")
    for name, values in times.items():
        print(f"  {name:10} {statistics.median(values) * 1e6:7.1f} us")
    holds = verdict("query to echo", ratio(times["query"], times["echo"]), 1.25, "x")
    holds &= verdict("query with its own `at` each time, to echo", ratio(times["query at"], times["echo"]), 1.5, "x")
    return 0 if holds else 1


if __name__ == "__main__" and sys.argv[1:2] == ["echo"]:
    echo_server(sys.argv[2])
