"""Packing by hand: the pieces of messages that go over the bus with every query and every tick.

The generated classes read and write field by field, which costs more than the question itself. The functions of
this module, `poses` and `queries` produce and take the very same bytes; a test compares them with the generated
classes for all kinds of values.
"""

from __future__ import annotations

import struct

from modelserver.errors import WireError

LENGTH = struct.Struct(">I")


def text(value: str) -> bytes:
    """Return the bytes of a string: length with the closing zero, text, zero."""
    raw = value.encode()
    return b"%b%b\0" % (LENGTH.pack(len(raw) + 1), raw)


def read_text(data: bytes, at: int) -> tuple[str, int]:
    """Return the string that begins at `at`, and where it ends. Raises WireError, struct.error."""
    (length,) = LENGTH.unpack_from(data, at)
    end = at + 4 + length
    if length < 1 or end > len(data) or data[end - 1]:
        raise WireError("truncated", f"{len(data)} bytes end within a text")
    return data[at + 4 : end - 1].decode("utf-8", "replace"), end


def check_end(data: bytes, end: int) -> None:
    """Raise WireError where a message does not end where its bytes do."""
    if end != len(data):
        raise WireError("malformed", f"{len(data) - end} bytes too many at the end of a message")
