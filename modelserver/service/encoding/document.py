"""A stored value as one piece of bytes that says by itself which types it is made of.

magic (8) | fingerprint of the schema (32) | length of the description (4) | description, deflated | tokens
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from functools import lru_cache
from typing import Any, Final

from modelserver.errors import RecordingError
from modelserver.service.encoding.schema import Schema

MAGIC: Final = b"MSvalue1"

LONGEST_DESCRIPTION: Final = 1 << 20
"""Bytes, inflated; this build's has some 20,000."""

_HEAD: Final = struct.Struct(">8s32sI")


@lru_cache(maxsize=4)
def _deflated(description: str) -> bytes:
    return zlib.compress(description.encode(), 9)


def write_document(schema: Schema, root: str, value: object, pause: Callable[[], object] = lambda: None) -> bytes:
    """Return a value with the description of its types. Raises EncodingError; `pause`: see `Schema.encode`."""
    description = _deflated(schema.description)
    head = _HEAD.pack(MAGIC, schema.fingerprint, len(description))
    return b"".join((head, description, schema.encode(root, value, pause)))


def read_document(schema: Schema, root: str, data: bytes) -> Any:
    """Return the value in what `write_document` wrote.

    Raises RecordingError, which names type and field where the schema of the writer differs from this build's.
    """
    if len(data) < _HEAD.size:
        raise RecordingError("it ends early")
    magic, fingerprint, length = _HEAD.unpack_from(data)
    if magic != MAGIC:
        raise RecordingError("it is no stored value of this format")
    if length > len(data) - _HEAD.size:
        raise RecordingError("it ends early")
    if fingerprint != schema.fingerprint:
        schema.check_same(fingerprint, _inflated(data[_HEAD.size : _HEAD.size + length]))
    return schema.decode(root, data[_HEAD.size + length :])


def _inflated(data: bytes) -> str:
    reader = zlib.decompressobj()
    try:
        text = reader.decompress(data, LONGEST_DESCRIPTION)
        return "" if reader.unconsumed_tail else text.decode()
    except (zlib.error, UnicodeDecodeError):
        return ""
