"""Envelopes of commands between Python and wire, both ways."""

from __future__ import annotations

import struct
from typing import Final

from modelserver.errors import WireError
from modelserver.messages.signed import MAC_BYTES, MAX_PAYLOAD, Envelope
from modelserver.wire.fields import checked_utime, name
from modelserver.wire.packed import LENGTH, check_end, read_text, text
from mslcm.signed_t import signed_t

SIGNED: Final = "MODELSERVER_SIGNED"
"""The channel of envelopes, without the vehicle's prefix."""

_FINGERPRINT: Final[bytes] = signed_t._get_packed_fingerprint()
_WHEN = struct.Struct(">qq")


def write_signed(envelope: Envelope) -> bytes:
    """Return the bytes of a signed_t."""
    return b"".join(
        (
            _FINGERPRINT,
            text(envelope.key_name),
            text(envelope.sender),
            _WHEN.pack(envelope.utime, envelope.counter),
            text(envelope.channel),
            LENGTH.pack(len(envelope.payload)),
            envelope.payload,
            envelope.mac,
        )
    )


def read_signed(data: bytes) -> Envelope:
    """Return the envelope in the bytes of a signed_t. Raises WireError, struct.error."""
    # the terminating zeros are looked at too: not one bit of an envelope may differ from what was signed
    key_name, at = read_text(data, 8)
    sender, at = read_text(data, at)
    utime, counter = _WHEN.unpack_from(data, at)
    channel, at = read_text(data, at + _WHEN.size)
    (size,) = LENGTH.unpack_from(data, at)
    at += LENGTH.size
    if size > MAX_PAYLOAD:
        raise WireError("malformed", f"a message of {size} bytes is too long to be signed; {MAX_PAYLOAD} at most")
    if at + size + MAC_BYTES > len(data):
        raise WireError("truncated", f"{len(data)} bytes are no whole signed_t: the end is cut")
    check_end(data, at + size + MAC_BYTES)
    return Envelope(
        name(key_name, "key_name"),
        name(sender, "sender"),
        checked_utime(utime),
        counter,
        name(channel, "channel"),
        data[at : at + size],
        data[at + size :],
    )
