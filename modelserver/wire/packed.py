"""Packing by hand: the pieces of messages that go over the bus with every query and every tick.

The generated classes read and write field by field, which costs more than the question itself. The functions of
this module, `poses` and `queries` produce and take the very same bytes; a test compares them with the generated
classes for all kinds of values.
"""

from __future__ import annotations

import struct
from functools import lru_cache
from typing import Final

from modelserver.errors import WireError

LENGTH = struct.Struct(">I")
_read_length = LENGTH.unpack_from

_LONGEST_KEPT: Final = 200
"""Characters; longer texts come from strangers and are packed each time."""


def text(value: str) -> bytes:
    """Return the bytes of a string: length with the closing zero, text, zero."""
    return _kept_text(value) if len(value) <= _LONGEST_KEPT else _packed_text(value)


def _packed_text(value: str) -> bytes:
    raw = value.encode()
    return b"%b%b\0" % (LENGTH.pack(len(raw) + 1), raw)


_kept_text = lru_cache(maxsize=4096)(_packed_text)
"""Names of frames, of channels, of revisions: single ones, never pairs. One that is not kept costs 0.3 us more."""


def read_text(data: bytes, at: int) -> tuple[str, int]:
    """Return the string that begins at `at`, and where it ends. Raises WireError, struct.error."""
    (length,) = _read_length(data, at)
    end = at + 4 + length
    if length < 1 or end > len(data) or data[end - 1]:
        raise WireError("truncated", f"{len(data)} bytes end within a text")
    return data[at + 4 : end - 1].decode("utf-8", "replace"), end


def check_end(data: bytes, end: int) -> None:
    """Raise WireError where a message does not end where its bytes do."""
    if end != len(data):
        raise WireError("malformed", f"{len(data) - end} bytes too many at the end of a message")
