"""Replies of the 3DM-GX1 a second in one process: parsed alone, amid noise, and made into samples by the driver."""

from __future__ import annotations

import math
import random
import resource
import time
from collections.abc import Callable

from benchmarks.support import verdict
from msdrivers.devices.gx1 import Gx1Driver, Gx1Settings
from msdrivers.emulate.gx1_unit import Eeprom
from msdrivers.protocol.gx1 import DATA, CommandByte, Gx1Parser, Packet, RequestParser
from msdrivers.station import Measured, Now, Send

REPLIES = 50_000
ROUNDS = 3
CHUNK = 64
"""Bytes that a serial port brings at a time."""

REQUIRED = 10_000.0
"""Replies a second."""

FUZZ_BYTES = 10_000_000


def _reply(number: int) -> bytes:
    return Packet(CommandByte.EULER_VECTORS, (number % 1000, 2, 3, 4, 5, 6, 7, 8, -4681), number % 65_536).to_bytes()


def parser() -> Gx1Parser:
    """Return a parser that lets through as much as it ever may: every measurement, by the checksum alone."""
    made = Gx1Parser()
    made.stream(*DATA)
    return made


def expected_false(count: int) -> float:
    """Return how many of so many random bytes begin what passes for a reply to `parser`."""
    return count * len(DATA) / 256 / 65_536


def _chunks(data: bytes) -> list[bytes]:
    return [data[at : at + CHUNK] for at in range(0, len(data), CHUNK)]


def _fastest(run: Callable[[], int]) -> float:
    """Return replies a second of the fastest round."""
    best = 0.0
    for _ in range(ROUNDS):
        begin = time.perf_counter()
        count = run()
        best = max(best, count / (time.perf_counter() - begin))
        assert count >= 0.99 * REPLIES
    return best


def _parsed(chunks: list[bytes]) -> int:
    made = parser()
    return sum(len(made.feed(chunk)) for chunk in chunks)


def _driven(chunks: list[bytes], per_chunk: float) -> int:
    """Set a driver up by hand, then give it the stream; return the number of samples."""
    driver, now = Gx1Driver(Gx1Settings("imu")), Now(0, 1)
    requests, eeprom, streamed = RequestParser(), Eeprom.factory(), 0
    outputs = driver.opened(now)
    while streamed == 0:
        replies = b""
        for output in outputs:
            for request in requests.feed(output.unit) if isinstance(output, Send) else ():
                words: tuple[int, ...] = (1234,)
                if request.command == CommandByte.CONTINUOUS:
                    streamed = request.data[0]
                    words = (streamed, 0)
                elif request.command == CommandByte.READ_EEPROM:
                    words = (eeprom.word(request.data[1]),)
                ticks = 65_535 if request.command == CommandByte.READ_EEPROM else None
                replies += Packet(request.command, words, ticks).to_bytes()
        due = driver.due()
        now = Now(max(now.monotonic_ns, due or 0), 1)
        outputs = driver.received(replies, now) if replies else driver.woken(now)
    count, at_ns = 0, float(now.monotonic_ns)
    for chunk in chunks:
        at_ns += per_chunk * 1e7
        count += sum(isinstance(output, Measured) for output in driver.received(chunk, Now(round(at_ns), 1)))
    return count


def main() -> int:
    rng = random.Random(1)
    replies = [_reply(number) for number in range(REPLIES)]
    clean = _chunks(b"".join(replies))
    noisy = _chunks(b"".join(reply + rng.randbytes(rng.randrange(20)) for reply in replies))
    holds = True
    for name, run in (
        ("parser, good bytes", lambda: _parsed(clean)),
        ("parser, 10 bytes of noise between two replies", lambda: _parsed(noisy)),
        ("driver, from bytes to samples", lambda: _driven(clean, CHUNK / len(replies[0]))),
    ):
        rate = _fastest(run)
        print(f"  {name}: {rate:,.0f} replies/s")
        holds &= verdict(f"{name}: required rate to its own", REQUIRED / rate, 1.0, "x")

    made, found, before = parser(), 0, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for _ in range(FUZZ_BYTES // 10_000):
        found += len(made.feed(rng.randbytes(10_000)))
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    mean = expected_false(FUZZ_BYTES)
    print(f"  {FUZZ_BYTES:,} random bytes: {found} pass for replies, {mean:.1f} expected of a 16-bit checksum")
    holds &= verdict("false replies in them", found, mean + 4 * math.sqrt(mean), "")
    holds &= verdict("memory that they took", grown, 1024, "kB")
    return 0 if holds else 1
