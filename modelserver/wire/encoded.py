"""Inspect and restamp encoded messages, without decoding them."""

from __future__ import annotations

import struct
from typing import Final

from modelserver.errors import WireError
from modelserver.wire.channels import CHANNELS, ChannelUse
from modelserver.wire.fields import read_text
from modelserver.wire.generated import CODECS, FINGERPRINTS
from modelserver.wire.journal import MAGIC

_INPUTS: Final = frozenset(
    FINGERPRINTS[channel.type_name]
    for channel in CHANNELS
    # signed commands are no inputs for playback: signatures protect against replayed commands
    if channel.use in (ChannelUse.SENSOR, ChannelUse.COMMAND) and channel.type_name != "signed_t"
)
_SERVICE: Final = frozenset(codec.fingerprint for codec in CODECS) - _INPUTS | {MAGIC}
_STAMPED: Final = frozenset(
    codec.fingerprint for codec in CODECS if codec.value.__annotations__.get("header") == "SensorHeader"
)
_TYPES: Final = {fingerprint: name for name, fingerprint in FINGERPRINTS.items()}


def type_name_of(data: bytes) -> str:
    """Return the name of the wire type of a message, empty for a foreign type."""
    return _TYPES.get(data[:8], "")


def is_stamped(data: bytes) -> bool:
    """Return whether a message begins with a sensor header: a sample, or a localization mode command."""
    return data[:8] in _STAMPED


def is_of_service(data: bytes) -> bool:
    """Return whether a message is a report, request, signed command or reply of the service, or a journal section."""
    return data[:8] in _SERVICE


_STAMPS = struct.Struct(">qdq")
"""First fields of the sensor header, behind the fingerprint: utime, utime_sigma, host_utime."""

_SINCE = struct.Struct(">q")
_SOURCE_AT: Final = 48
"""Offset of the source, the last field of the sensor header."""

_RELATIVE: Final = FINGERPRINTS["relative_pose_t"]


def restamp(data: bytes, shift: int) -> bytes:
    """Return a stamped message with its stamps shifted by `shift` microseconds; other messages are returned unchanged.

    The stamps are utime, host_utime, and since_utime of a relative pose.
    """
    if not is_stamped(data) or len(data) < 8 + _STAMPS.size:
        return data
    utime, sigma, host_utime = _STAMPS.unpack_from(data, 8)
    restamped = bytearray(data)
    try:
        _STAMPS.pack_into(restamped, 8, utime + shift, sigma, host_utime + shift if host_utime else 0)
        if data[:8] == _RELATIVE:
            # since_utime is the first field behind the header
            _, at = read_text(data, _SOURCE_AT)
            (since,) = _SINCE.unpack_from(data, at)
            _SINCE.pack_into(restamped, at, since + shift)
    except (WireError, struct.error):
        return data  # damaged: the receiver counts it
    return bytes(restamped)
