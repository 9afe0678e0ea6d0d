"""Ten million bytes of noise into each parser: no exception, flat memory, no false message, and good ones afterwards.

    python -m benchmarks parser_fuzz
    python -m benchmarks.parser_fuzz gps --bytes 1000000

Four kinds of noise: random bytes; random bytes rich in the beginnings of frames; good messages with damaged bytes;
good messages cut and joined anywhere. In the last two messages may come that are left whole, and no other.
A parser is registered in PARSERS.
"""

from __future__ import annotations

import argparse
import random
import sys
import time
import tracemalloc
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from benchmarks.gps_parse import stream_of
from msdrivers.protocol.gps_stream import GpsStream
from msdrivers.protocol.nmea import NmeaEpoch
from msdrivers.protocol.novatel import NovatelLog

SIZE = 10_000_000
CHUNK = 4096
FLAT = 262_144
"""Bytes by which memory may grow from the first tenth of the noise to its end."""


NOISE = ("random", "beginnings")
MADE_OF_MESSAGES = ("damaged", "cut")


@dataclass(frozen=True)
class Parser:
    """A parser under test.

    make: a fresh one, as its feed function. messages: good bytes, one message each, all different.
    key: what a message says, None for what carries no checksum and may come out of noise.
    leads: what its frames begin with.
    weak: whether a message's checksum is so short that damage now and then passes it: such are not counted among
    what damaged and cut messages may not make. Noise may make none of them either.
    """

    make: Callable[[], Callable[[bytes], Sequence[Any]]]
    messages: Sequence[bytes]
    key: Callable[[Any], object]
    leads: Sequence[bytes]
    weak: Callable[[Any], bool] = lambda message: False


def _gps_key(message: object) -> object:
    if isinstance(message, NovatelLog):
        return message.header, message.body
    return (message.time_of_day, message.latitude) if isinstance(message, NmeaEpoch) else None


def _each(name: str, number: int = 400) -> list[bytes]:
    whole = stream_of((name,), number)
    if name.endswith("b"):
        size = len(whole) // number
        return [whole[n * size : (n + 1) * size] for n in range(number)]
    return [line + b"\r\n" for line in whole.split(b"\r\n")[:-1]]


PARSERS: dict[str, Parser] = {
    "gps": Parser(
        lambda: GpsStream().feed,
        [each for name in ("bestposb", "bestvelb", "bestposa", "gpgga") for each in _each(name)],
        _gps_key,
        (b"\xaa\x44\x12\x1c", b"\xaa\x44\x13", b"#BESTPOSA,", b"%INSPVASA,", b"$GPGGA,", b"<", b"[COM", b"*"),
        # two flips of one bit cancel out in NMEA's sum, and an epoch may lack a sentence that was lost
        weak=lambda message: isinstance(message, NmeaEpoch),
    ),
}


def said(parser: Parser, messages: Sequence[Any]) -> list[object]:
    return [key for key in map(parser.key, messages) if key is not None]


def noise(parser: Parser, kind: str, chance: random.Random) -> bytes:
    """Return some thousand bytes of noise."""
    if kind == "random":
        return chance.randbytes(CHUNK)
    if kind == "beginnings":
        return b"".join(chance.choice(parser.leads) + chance.randbytes(chance.randrange(40)) for _ in range(150))
    if kind == "damaged":
        data = bytearray(b"".join(chance.choices(parser.messages, k=20)))
        for _ in range(40):
            data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
        return bytes(data)
    pieces = []
    for message in chance.choices(parser.messages, k=30):
        at = chance.randrange(len(message))
        pieces.append(message[at:] if chance.random() < 0.5 else message[:at])
    return b"".join(pieces)


def fuzz(name: str, parser: Parser, kind: str, size: int) -> list[str]:
    """Feed noise, then good messages; return what is wrong."""
    chance = random.Random(f"{name} {kind}")
    good = {key for message in parser.messages for key in said(parser, parser.make()(message))}
    feed = parser.make()
    false = 0
    fed = 0
    early = None
    begun = time.perf_counter()
    tracemalloc.start()
    while fed < size:
        data = noise(parser, kind, chance)
        fed += len(data)
        messages = [each for each in feed(data) if kind in NOISE or not parser.weak(each)]
        false += sum(key not in good for key in said(parser, messages))
        if early is None and fed >= size // 10:
            early = tracemalloc.get_traced_memory()[0]
    grown = tracemalloc.get_traced_memory()[0] - (early or 0)
    tracemalloc.stop()
    after = said(parser, feed(b"".join(parser.messages[:100])))
    took = time.perf_counter() - begun
    problems = []
    if false:
        problems.append(f"{false} false messages")
    if grown > FLAT:
        problems.append(f"memory grew by {grown:,} bytes")
    followed = sum(key in good for key in after)
    if followed < 99:
        problems.append(f"only {followed} of 100 good messages after the noise")
    print(
        f"{name:8} {kind:11} {fed:12,} bytes {took:6.1f} s  false {false}  memory {grown:+,}  after {followed}/100",
        flush=True,
    )
    return problems


def main(arguments: Sequence[str] = ()) -> int:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("parser", nargs="*", choices=[*PARSERS, []], help="all, if none is named")
    options.add_argument("--bytes", type=int, default=SIZE, help="of each kind of noise")
    given = options.parse_args(arguments)
    problems = [
        f"{name}, {kind}: {problem}"
        for name in given.parser or PARSERS
        for kind in (*NOISE, *MADE_OF_MESSAGES)
        for problem in fuzz(name, PARSERS[name], kind, given.bytes)
    ]
    print("\n".join(problems) or "no exception, no false message, memory flat, good streams followed")
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
