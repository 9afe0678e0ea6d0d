"""Codec: bytes of a wire type, and the values that the core exchanges."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import Any, Final

from modelserver.errors import WireError
from modelserver.wire.fields import Codec, check_end
from modelserver.wire.generated import CODECS

_BY_TYPE_NAME: Final[Mapping[str, Codec]] = {codec.type_name: codec for codec in CODECS}
_BY_VALUE: Final[Mapping[type, Codec]] = {codec.value: codec for codec in reversed(CODECS)}


def get_type_names() -> tuple[str, ...]:
    """Return the names of the wire types that can be decoded."""
    return tuple(_BY_TYPE_NAME)


def get_type_name(value_type: type) -> str:
    """Return the name of the wire type that a class of values is encoded as; see `encode`."""
    return _BY_VALUE[value_type].type_name


def fingerprint_of(type_name: str) -> bytes:
    """Return the eight bytes that a message of a wire type begins with."""
    return _BY_TYPE_NAME[type_name].fingerprint


def decode(type_name: str, data: bytes) -> Any:
    """Return the value in `data`, which should hold a message of the wire type `type_name`.

    Raises WireError with reason `fingerprint` (another type, or no message at all), `truncated` or `malformed`.
    """
    codec = _BY_TYPE_NAME[type_name]
    if data[:8] != codec.fingerprint:
        raise WireError("fingerprint", f"{len(data)} bytes are no {type_name}: the fingerprint differs")
    try:
        value, end = codec.unpack(data, 8)
        check_end(data, end)
        return value
    except WireError:
        raise
    except (struct.error, ValueError, IndexError, OverflowError, MemoryError) as error:
        raise WireError("truncated", f"{len(data)} bytes are no whole {type_name}: {error}") from None


def encode(value: Any, type_name: str = "") -> bytes:
    """Return the bytes of a value; a pose becomes a pose_transform_t unless `type_name` is another."""
    codec = _BY_TYPE_NAME[type_name] if type_name else _BY_VALUE[type(value)]
    return codec.fingerprint + codec.pack(value)
