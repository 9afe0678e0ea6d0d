"""Signed commands: the signature over an envelope, and the check that a command is fresh. Pure.

Signature: HMAC (RFC 2104) with SHA-256 (FIPS 180-4). The signed bytes begin with a line that no other use of the key
has, then the vehicle's channel prefix, so that a command to one vehicle is invalid for another; each field of variable
length follows its length, so the encoding is unambiguous.

Freshness (protection against replayed commands): an envelope has the sender's time and a counter. A command is accepted
once, within a window around the vehicle's clock, and only if its (time, counter) is greater than the last accepted one
of the same key and sender. This state is lost at a restart, so a command that an earlier run of the service could have
accepted is rejected. Only the newest senders are stored one by one; all others share a floor, the greatest stamp that
was removed.
"""

from __future__ import annotations

import hashlib
import hmac
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Final, NamedTuple

from modelserver.errors import quote
from modelserver.messages import Envelope

DOMAIN: Final = b"modelserver signed command, version 1\n"
"""Beginning of the signed bytes (domain separation)."""

MIN_KEY_BYTES: Final = 16
"""A shorter secret can be guessed."""

MAX_SENDERS: Final = 64
"""Senders whose last command is stored one by one."""

MAX_CLOCK_LEAD_S: Final = 1.0
"""Greatest lead of the sender's clock over the vehicle's, seconds; less with a shorter window."""

_LENGTH = struct.Struct(">I")
_STAMP = struct.Struct(">qq")


@dataclass(frozen=True, slots=True)
class Key:
    """A shared secret, and the name that identifies it in messages."""

    name: str
    secret: bytes = field(repr=False)


def encode_signed_bytes(prefix: str, envelope: Envelope) -> bytes:
    """Return the bytes over which the signature is computed; `prefix` is the vehicle's channel prefix."""
    texts = [_add_length(text.encode("utf-8", "replace")) for text in (prefix, envelope.key_name, envelope.sender)]
    when = _STAMP.pack(envelope.utime, envelope.counter)
    return b"".join(
        (DOMAIN, *texts, when, _add_length(envelope.channel.encode("utf-8", "replace")), _add_length(envelope.payload))
    )


def compute_signature(key: Key, prefix: str, envelope: Envelope) -> bytes:
    """Return the HMAC-SHA256 of an envelope, 32 bytes."""
    return hmac.digest(key.secret, encode_signed_bytes(prefix, envelope), hashlib.sha256)


def sign(key: Key, prefix: str, envelope: Envelope) -> Envelope:
    """Return the envelope with the key's name and signature."""
    envelope = envelope._replace(key_name=key.name)
    return envelope._replace(mac=compute_signature(key, prefix, envelope))


def has_valid_signature(key: Key, prefix: str, envelope: Envelope) -> bool:
    """Return whether the signature is valid, in a time that does not depend on its bytes."""
    return hmac.compare_digest(compute_signature(key, prefix, envelope), envelope.mac)


def _add_length(data: bytes) -> bytes:
    return _LENGTH.pack(len(data)) + data


class Freshness(NamedTuple):
    """The newest accepted commands, so that none is accepted twice."""

    last: Mapping[tuple[str, str], tuple[int, int]] = MappingProxyType({})
    """utime and counter of the newest command of each (key's name, sender)."""
    floor: tuple[int, int] = (0, 0)
    """What the stamps of all other senders must exceed."""


class FreshnessResult(NamedTuple):
    """Whether a command with a valid signature is fresh (`reason` is empty), and the freshness state after it."""

    freshness: Freshness
    reason: str = ""
    message: str = ""


def check_freshness(
    known: Freshness, envelope: Envelope, utime: int, uptime_us: int, window_us: int
) -> FreshnessResult:
    """Check whether a command with a valid signature may be applied.

    Parameters
    ----------
    known : state after the last accepted command
    utime : the vehicle's clock, microseconds
    uptime_us : time since the start of the service, which is a difference: a clock that was set after the start has no
        influence
    window_us : greatest age of a command

    Returns
    -------
    The reason of a rejection (`stale` or `replayed`) with a message, and the new state.
    """
    lead_us = min(round(MAX_CLOCK_LEAD_S * 1e6), window_us)
    age = utime - envelope.utime
    if age > window_us or age < -lead_us:
        return FreshnessResult(known, "stale", _explain_stale(age, window_us, lead_us))
    if age > uptime_us - lead_us:
        wait = max(0.0, (age - uptime_us + lead_us) * 1e-6)
        why = f"the service has just started and might have accepted it before the start; send it again in {wait:.1f} s"
        return FreshnessResult(known, "stale", why)
    sender = (envelope.key_name, envelope.sender)
    stamp = (envelope.utime, envelope.counter)
    newest = known.last.get(sender, known.floor)
    if stamp <= newest:
        lead = (newest[0] - utime) * 1e-6
        why = f"it is not newer than the last command accepted from {quote(envelope.sender)}"
        if lead > MAX_CLOCK_LEAD_S:
            why += (
                f", whose stamp is {lead:.1f} s ahead of the vehicle's clock: a clock was set back since. Restart "
                "the service, or sign as another sender"
            )
        else:
            why += ": the same message arrived twice, or two programs share the name; send a new one"
        return FreshnessResult(known, "replayed", why)
    last = {**known.last, sender: stamp}
    floor = known.floor
    if len(last) > MAX_SENDERS:
        oldest = min(last, key=lambda each: last[each])
        floor = max(floor, last.pop(oldest))
    return FreshnessResult(Freshness(last, floor))


def _explain_stale(age: int, window_us: int, lead_us: int) -> str:
    side = "before" if age > 0 else "after"
    return (
        f"it was signed {abs(age) * 1e-6:.1f} s {side} the time of the vehicle's clock, and may be "
        f"{window_us * 1e-6:g} s old (commands.window_s) or {lead_us * 1e-6:g} s ahead: set both clocks by the same "
        "time server (chronyc tracking shows the error of each)"
    )
