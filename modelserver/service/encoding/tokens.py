"""A stream of scalar tokens as bytes: what every stored value is flattened to.

The stream is a sequence of blocks, each a length (4 bytes, big-endian) and a MessagePack array of None, bool, int,
float, str and bytes. The array is never nested: the schema says which tokens belong together (see `nodes`). A float is
its 8 bytes, so that NaN payloads and signed zeros survive. What MessagePack cannot hold (an int beyond 64 bits, text
with lone surrogates) is a bytes token, which the declared type turns back.
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
"""Tokens in a block, about: a fifth of a millisecond of work, after which the writer pauses."""

LONGEST_BLOCK: Final = 32 << 20
"""Bytes; the largest token is the longest array or text of a state."""

LONGEST_INT: Final = 4096
"""Bytes of an integer."""

SCALARS: Final = frozenset({type(None), bool, int, float, str, bytes})

_LENGTH: Final = struct.Struct(">I")
_INT64: Final = range(-(1 << 63), 1 << 64)

_encode: Final = msgspec.msgpack.Encoder().encode
_decode: Final = msgspec.msgpack.Decoder().decode


class EncodingError(TypeError):
    """A value is not of its declared type, so it cannot be stored; the message names the type and the field."""


class TokenWriter:
    """Collects the tokens of one value. `pause` is called after each block.

    `records` and `others` map the identity of what is written already to its number, by which it is referred to from
    then on: values share much, and what is shared is written once and shared again when it is read.
    """

    __slots__ = ("_blocks", "_kept", "_pause", "others", "records", "tokens")

    def __init__(self, pause: Callable[[], object] = lambda: None):
        self.tokens: list[Any] = []
        self.records: dict[int, int] = {}
        self.others: dict[object, dict[int, int]] = {}
        self._kept: list[object] = []
        self._blocks: list[bytes] = []
        self._pause = pause

    def remember(self, places: dict[int, int], value: object) -> None:
        """Number a value that was written; it is kept alive, for its identity counts as long as this does."""
        places[id(value)] = len(places)
        self._kept.append(value)

    def flush(self) -> None:
        """Close a block."""
        tokens = self.tokens
        if not tokens:
            return
        try:
            data = _encode(tokens)
        except (OverflowError, UnicodeEncodeError):
            data = _encode([_fitting(token) for token in tokens])
        self._blocks += (_LENGTH.pack(len(data)), data)
        tokens.clear()
        self._pause()

    def close(self) -> bytes:
        """Return all blocks."""
        self.flush()
        return b"".join(self._blocks)


def _fitting(token: Any) -> Any:
    if type(token) is int and token not in _INT64:
        return token.to_bytes(token.bit_length() // 8 + 1, "little", signed=True)
    return token.encode("utf-8", "surrogatepass") if type(token) is str and not _is_plain(token) else token


def _is_plain(text: str) -> bool:
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def int_of(token: bytes) -> int:
    """Return the integer that a bytes token holds. Raises ValueError."""
    if len(token) > LONGEST_INT:
        raise ValueError(f"an integer of {len(token)} bytes")
    return int.from_bytes(token, "little", signed=True)


def text_of(token: bytes) -> str:
    """Return the text that a bytes token holds. Raises ValueError."""
    return token.decode("utf-8", "surrogatepass")


class TokenReader:
    """Hands out the tokens of a stream, one after the other. Memory is bounded by the bytes that there are.

    `records` and `others` hold what was read so far, in the order in which `TokenWriter` numbered it, each with its
    weight: the values in it, counted as often as they are referred to. `weight` is that of all so far.
    """

    __slots__ = ("_tokens", "others", "records", "take", "weight")

    def __init__(self, data: bytes):
        self._tokens = _tokens(memoryview(data))
        self.take: Callable[[], Any] = self._tokens.__next__
        """Return the next token. Raises StopIteration where there is none."""
        self.weight = 0
        self.records: list[tuple[Any, int]] = []
        self.others: dict[object, list[tuple[Any, int]]] = {}

    def many(self, count: int) -> list[Any]:
        """Return so many tokens. Raises StopIteration where there are fewer."""
        found = list(islice(self._tokens, min(count, sys.maxsize)))
        if len(found) != count:
            raise StopIteration
        return found

    def close(self) -> None:
        """Raise RecordingError where tokens are left."""
        if next(self._tokens, self) is not self:
            raise RecordingError("there is more in it than belongs to the value")


def _tokens(data: memoryview) -> Iterator[Any]:
    at = 0
    while at < len(data):
        if len(data) - at < _LENGTH.size:
            raise RecordingError("it ends within the length of a block")
        (size,) = _LENGTH.unpack_from(data, at)
        at += _LENGTH.size
        if not 0 < size <= min(len(data) - at, LONGEST_BLOCK):
            raise RecordingError(f"a block of {size} bytes, of which {len(data) - at} are there")
        block = data[at : at + size]
        if not _holds_array(block):
            raise RecordingError("a block is no array of values")
        tokens = _decode(block)
        if not SCALARS.issuperset(map(type, tokens)):
            raise RecordingError("a block holds more than scalars")
        yield from tokens
        at += size


def _holds_array(block: memoryview) -> bool:
    """Return whether a MessagePack array begins here that is no longer than its bytes: each element takes one."""
    head = block[0]
    if 0x90 <= head <= 0x9F:
        return (head & 0x0F) < len(block)
    if head in (0xDC, 0xDD):
        size = 2 if head == 0xDC else 4
        return len(block) > size and int.from_bytes(block[1 : 1 + size], "big") <= len(block) - 1 - size
    return False
