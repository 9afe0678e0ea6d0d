"""Stream of scalar tokens, the lowest layer of the encoding: every value is flattened to it.

The stream is a sequence of blocks, each a length (4 bytes, big-endian) and a MessagePack array of None, bool, int,
float, str and bytes. The array is never nested: the schema defines which tokens belong together (see `nodes`). A float
is its 8 bytes, so that NaN payloads and signed zeros survive. What MessagePack cannot represent (an int beyond 64 bits,
text with lone surrogates) is a bytes token, which the declared type converts back.
"""

from __future__ import annotations

import struct
import sys
from collections.abc import Callable, Iterator
from itertools import islice
from typing import Any, Final

import msgspec

from modelserver.errors import RecordingError

BLOCK_TOKENS: Final = 500
"""Approximate number of tokens in a block: 0.2 ms of work, after which the writer pauses."""

MAX_BLOCK_BYTES: Final = 32 << 20
"""Greater than the longest array or text of a state."""

SCALARS: Final = frozenset({type(None), bool, int, float, str, bytes})

_LENGTH: Final = struct.Struct(">I")
_INT64: Final = range(-(1 << 63), 1 << 64)

_encode: Final = msgspec.msgpack.Encoder().encode
_decode: Final = msgspec.msgpack.Decoder().decode


class EncodingError(TypeError):
    """A value does not have its declared type; the message names type and field."""


class TokenWriter:
    """Collects the tokens of one value. `pause` is called after each block.

    `records` and `others` map the identity of each written value to its number, by which later occurrences refer to it:
    shared values are written once, and shared again when read.
    """

    __slots__ = ("_alive", "_blocks", "_pause", "others", "records", "tokens")

    def __init__(self, pause: Callable[[], object] = lambda: None):
        self.tokens: list[Any] = []
        self.records: dict[int, int] = {}
        self.others: dict[object, dict[int, int]] = {}
        self._alive: list[object] = []
        self._blocks: list[bytes] = []
        self._pause = pause

    def remember(self, places: dict[int, int], value: object) -> None:
        """Number a written value, and keep it alive so that its identity stays unique."""
        places[id(value)] = len(places)
        self._alive.append(value)

    def flush(self) -> None:
        """Write the tokens as a block."""
        tokens = self.tokens
        if not tokens:
            return
        try:
            data = _encode(tokens)
        except (OverflowError, UnicodeEncodeError):
            data = _encode([_convert_token(token) for token in tokens])
        self._blocks += (_LENGTH.pack(len(data)), data)
        tokens.clear()
        self._pause()

    def close(self) -> bytes:
        self.flush()
        return b"".join(self._blocks)


def _convert_token(token: Any) -> Any:
    if type(token) is int and token not in _INT64:
        return token.to_bytes(token.bit_length() // 8 + 1, "little", signed=True)
    if type(token) is str and any("\ud800" <= each <= "\udfff" for each in token):
        return token.encode("utf-8", "surrogatepass")
    return token


class TokenReader:
    """Reads the tokens of a stream. Memory is bounded by the size of the input.

    `records` and `others` hold the values read so far, numbered as by `TokenWriter`, each with its weight: the number
    of values in it, references counted in full. `weight` is the total so far.
    """

    __slots__ = ("_tokens", "others", "records", "take", "weight")

    def __init__(self, data: bytes):
        self._tokens = _iterate_tokens(memoryview(data))
        self.take: Callable[[], Any] = self._tokens.__next__
        """Return the next token. Raises StopIteration at the end."""
        self.weight = 0
        self.records: list[tuple[Any, int]] = []
        self.others: dict[object, list[tuple[Any, int]]] = {}

    def many(self, count: int) -> list[Any]:
        """Return the next `count` tokens. Raises StopIteration where there are fewer."""
        found = list(islice(self._tokens, min(count, sys.maxsize)))
        if len(found) != count:
            raise StopIteration
        return found

    def close(self) -> None:
        """Raise RecordingError for excess tokens."""
        if next(self._tokens, self) is not self:
            raise RecordingError("excess data after the value")


def _iterate_tokens(data: memoryview) -> Iterator[Any]:
    at = 0
    while at < len(data):
        if len(data) - at < _LENGTH.size:
            raise RecordingError("it ends within the length of a block")
        (size,) = _LENGTH.unpack_from(data, at)
        at += _LENGTH.size
        if not 0 < size <= min(len(data) - at, MAX_BLOCK_BYTES):
            raise RecordingError(f"a block of {size} bytes, of which {len(data) - at} are there")
        block = data[at : at + size]
        if not _holds_array(block):
            raise RecordingError("a block is no array of scalars")
        tokens = _decode(block)
        if not SCALARS.issuperset(map(type, tokens)):
            raise RecordingError("a block holds more than scalars")
        yield from tokens
        at += size


def _holds_array(block: memoryview) -> bool:
    """Return whether a block is a MessagePack array that is not longer than its bytes: each element takes one."""
    head = block[0]
    if 0x90 <= head <= 0x9F:
        return (head & 0x0F) < len(block)
    if head in (0xDC, 0xDD):
        size = 2 if head == 0xDC else 4
        return len(block) > size and int.from_bytes(block[1 : 1 + size], "big") <= len(block) - 1 - size
    return False
