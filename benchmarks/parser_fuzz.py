"""Ten million bytes of noise into each parser: no exception, constant memory, no false message.

    python -m benchmarks parser_fuzz
    python -m benchmarks.parser_fuzz gps --bytes 1000000

Good messages after the noise must be parsed again. Four kinds of noise: random bytes; random bytes rich in frame
preambles; good messages with damaged bytes; good messages cut and joined anywhere. In the last two, only undamaged
messages may be parsed. Parsers are registered in PARSERS.
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
from msdrivers.devices.gps.driver import GpsStream
from msdrivers.devices.gps.nmea import NmeaEpoch
from msdrivers.devices.gps.novatel import NovatelLog

SIZE = 10_000_000
CHUNK = 4096
MAX_GROWTH = 262_144
"""Bytes by which memory may grow from the first tenth of the noise to its end."""


NOISE = ("random", "beginnings")
CORRUPTED = ("damaged", "cut")


@dataclass(frozen=True)
class ParserCase:
    """A parser under test.

    Attributes
    ----------
    make : returns the feed function of a new parser
    messages : good messages, all different
    key : identity of a message, None for one without a checksum, which may come from noise
    preambles : first bytes of its frames
    weak : whether a message's checksum is so short that damage may pass it: such messages are not counted in damaged
        and cut
        messages. Random noise may make none of them
    """

    make: Callable[[], Callable[[bytes], Sequence[Any]]]
    messages: Sequence[bytes]
    key: Callable[[Any], object]
    preambles: Sequence[bytes]
    weak: Callable[[Any], bool] = lambda message: False


def _gps_key(message: object) -> object:
    if isinstance(message, NovatelLog):
        return message.header, message.body
    return (message.time_of_day, message.latitude) if isinstance(message, NmeaEpoch) else None


def _split_messages(name: str, number: int = 400) -> list[bytes]:
    whole = stream_of((name,), number)
    if name.endswith("b"):
        size = len(whole) // number
        return [whole[n * size : (n + 1) * size] for n in range(number)]
    return [line + b"\r\n" for line in whole.split(b"\r\n")[:-1]]


PARSERS: dict[str, ParserCase] = {
    "gps": ParserCase(
        lambda: GpsStream().feed,
        [each for name in ("bestposb", "bestvelb", "bestposa", "gpgga") for each in _split_messages(name)],
        _gps_key,
        (b"\xaa\x44\x12\x1c", b"\xaa\x44\x13", b"#BESTPOSA,", b"%INSPVASA,", b"$GPGGA,", b"<", b"[COM", b"*"),
        # two flips of one bit cancel out in NMEA's checksum, and an epoch may lack a lost sentence
        weak=lambda message: isinstance(message, NmeaEpoch),
    ),
}


def collect_keys(parser: ParserCase, messages: Sequence[Any]) -> list[object]:
    return [key for key in map(parser.key, messages) if key is not None]


def make_noise(parser: ParserCase, kind: str, chance: random.Random) -> bytes:
    """Return some thousand bytes of noise."""
    if kind == "random":
        return chance.randbytes(CHUNK)
    if kind == "beginnings":
        return b"".join(chance.choice(parser.preambles) + chance.randbytes(chance.randrange(40)) for _ in range(150))
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


def fuzz(name: str, parser: ParserCase, kind: str, size: int) -> list[str]:
    """Feed noise, then good messages; return the errors."""
    chance = random.Random(f"{name} {kind}")
    good = {key for message in parser.messages for key in collect_keys(parser, parser.make()(message))}
    feed = parser.make()
    false = 0
    fed = 0
    early = None
    start = time.perf_counter()
    tracemalloc.start()
    while fed < size:
        data = make_noise(parser, kind, chance)
        fed += len(data)
        messages = [each for each in feed(data) if kind in NOISE or not parser.weak(each)]
        false += sum(key not in good for key in collect_keys(parser, messages))
        if early is None and fed >= size // 10:
            early = tracemalloc.get_traced_memory()[0]
    grown = tracemalloc.get_traced_memory()[0] - (early or 0)
    tracemalloc.stop()
    after = collect_keys(parser, feed(b"".join(parser.messages[:100])))
    took = time.perf_counter() - start
    problems = []
    if false:
        problems.append(f"{false} false messages")
    if grown > MAX_GROWTH:
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
        for kind in (*NOISE, *CORRUPTED)
        for problem in fuzz(name, PARSERS[name], kind, given.bytes)
    ]
    print("\n".join(problems) or "no exception, no false message, memory constant, good messages parsed")
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
