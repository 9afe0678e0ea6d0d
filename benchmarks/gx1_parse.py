"""Replies of the 3DM-GX1 per second in one process: parsed alone, within noise, and converted by the driver."""

from __future__ import annotations

import math
import random
import resource
import time
from collections.abc import Callable

from benchmarks.support import print_verdict
from msdrivers.devices.gx1 import MEASUREMENTS, CommandByte, Gx1Driver, Gx1Packet, Gx1Settings, Gx1Stream
from msdrivers.emulate.imu import make_eeprom
from msdrivers.endpoint import HostTime, MeasuredSample, Send

REPLIES = 50_000
ROUNDS = 3
CHUNK = 64
"""Bytes that a serial port brings at a time."""

REQUIRED = 10_000.0
"""Replies a second."""

FUZZ_BYTES = 10_000_000


def _reply(number: int) -> bytes:
    return Gx1Packet(CommandByte.EULER_VECTORS, (number % 1000, 2, 3, 4, 5, 6, 7, 8, -4681), number % 65_536).to_bytes()


def make_parser() -> Gx1Stream:
    """Return the most permissive parser: it accepts every measurement by its checksum alone."""
    made = Gx1Stream()
    made.set_commands(*MEASUREMENTS)
    return made


def expected_false_replies(count: int) -> float:
    """Return the expected number of false replies in so many random bytes."""
    return count * len(MEASUREMENTS) / 256 / 65_536


def _chunks(data: bytes) -> list[bytes]:
    return [data[at : at + CHUNK] for at in range(0, len(data), CHUNK)]


def _measure_fastest(run: Callable[[], int]) -> float:
    """Return replies per second of the fastest round."""
    best = 0.0
    for _ in range(ROUNDS):
        begin = time.perf_counter()
        count = run()
        best = max(best, count / (time.perf_counter() - begin))
        assert count >= 0.99 * REPLIES
    return best


def _count_parsed(chunks: list[bytes]) -> int:
    made = make_parser()
    return sum(len(made.feed(chunk)) for chunk in chunks)


def _count_samples(chunks: list[bytes], per_chunk: float) -> int:
    """Start a driver, feed it the stream, and return the number of samples."""
    driver, now = Gx1Driver(Gx1Settings("imu")), HostTime(0, 1)
    eeprom, streamed = make_eeprom(), 0
    outputs = driver.on_open(now)
    while streamed == 0:
        replies = b""
        for output in outputs:
            if not isinstance(output, Send):
                continue
            command = output.unit[0]
            words: tuple[int, ...] = (1234,)
            if command == CommandByte.CONTINUOUS:
                streamed = output.unit[2]
                words = (streamed, 0)
            elif command == CommandByte.READ_EEPROM:
                words = (eeprom.get(output.unit[2], 0),)
            ticks = 65_535 if command == CommandByte.READ_EEPROM else None
            replies += Gx1Packet(command, words, ticks).to_bytes()
        due = driver.get_deadline()
        now = HostTime(max(now.monotonic_ns, due or 0), 1)
        outputs = driver.on_receive(replies, now) if replies else driver.on_timer(now)
    count, at_ns = 0, float(now.monotonic_ns)
    for chunk in chunks:
        at_ns += per_chunk * 1e7
        count += sum(
            isinstance(output, MeasuredSample) for output in driver.on_receive(chunk, HostTime(round(at_ns), 1))
        )
    return count


def main() -> int:
    rng = random.Random(1)
    replies = [_reply(number) for number in range(REPLIES)]
    clean = _chunks(b"".join(replies))
    noisy = _chunks(b"".join(reply + rng.randbytes(rng.randrange(20)) for reply in replies))
    holds = True
    for name, run in (
        ("parser, good bytes", lambda: _count_parsed(clean)),
        ("parser, 10 bytes of noise between two replies", lambda: _count_parsed(noisy)),
        ("driver, from bytes to samples", lambda: _count_samples(clean, CHUNK / len(replies[0]))),
    ):
        rate = _measure_fastest(run)
        print(f"  {name}: {rate:,.0f} replies/s")
        holds &= print_verdict(f"{name}: required rate to its own", REQUIRED / rate, 1.0, "x")

    made, found, before = make_parser(), 0, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for _ in range(FUZZ_BYTES // 10_000):
        found += len(made.feed(rng.randbytes(10_000)))
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    mean = expected_false_replies(FUZZ_BYTES)
    print(f"  {FUZZ_BYTES:,} random bytes: {found} pass for replies, {mean:.1f} expected of a 16-bit checksum")
    holds &= print_verdict("false replies in them", found, mean + 4 * math.sqrt(mean), "")
    holds &= print_verdict("memory that they took", grown, 1024, "kB")
    return 0 if holds else 1
