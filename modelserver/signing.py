"""Signed commands: over which bytes, whether a signature is genuine, and whether a command is fresh. Pure.

HMAC as in RFC 2104 with SHA-256 (FIPS 180-4), from Python's own library. The signed bytes are unambiguous: each field
that has no fixed length stands behind its length, and before all stand a line that no other use of the key has and the
vehicle's channel prefix, so that what was said to one vehicle means nothing to another.
"""

from __future__ import annotations

import hashlib
import hmac
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Final, NamedTuple

from modelserver.errors import shown
from modelserver.messages.signed import Envelope

DOMAIN: Final = b"modelserver signed command, version 1\n"
"""What the signed bytes begin with."""

SHORTEST_KEY: Final = 16
"""Bytes; a shorter secret can be guessed."""

MAX_SENDERS: Final = 64
"""Senders whose last command is remembered one by one."""

AHEAD_S: Final = 1.0
"""How far the sender's clock may be ahead of the vehicle's, seconds; less where the window is shorter."""

_LENGTH = struct.Struct(">I")
_WHEN = struct.Struct(">qq")


@dataclass(frozen=True, slots=True)
class Key:
    """A shared secret, and the name by which messages tell which one they were signed with."""

    name: str
    secret: bytes = field(repr=False)


def signed_bytes(prefix: str, envelope: Envelope) -> bytes:
    """Return the bytes that a signature is worked out over; `prefix` is the vehicle's channel prefix."""
    texts = [_sized(text.encode("utf-8", "replace")) for text in (prefix, envelope.key_name, envelope.sender)]
    when = _WHEN.pack(envelope.utime, envelope.counter)
    return b"".join(
        (DOMAIN, *texts, when, _sized(envelope.channel.encode("utf-8", "replace")), _sized(envelope.payload))
    )


def signature(key: Key, prefix: str, envelope: Envelope) -> bytes:
    """Return the 32 bytes that prove that who wrote an envelope knows the key."""
    return hmac.digest(key.secret, signed_bytes(prefix, envelope), hashlib.sha256)


def sealed(key: Key, prefix: str, envelope: Envelope) -> Envelope:
    """Return an envelope with the key's name and signature."""
    envelope = envelope._replace(key_name=key.name)
    return envelope._replace(mac=signature(key, prefix, envelope))


def is_genuine(key: Key, prefix: str, envelope: Envelope) -> bool:
    """Return whether the signature is right; takes as long for any that is wrong."""
    return hmac.compare_digest(signature(key, prefix, envelope), envelope.mac)


def _sized(data: bytes) -> bytes:
    return _LENGTH.pack(len(data)) + data


class Freshness(NamedTuple):
    """What was taken last from whom, so that nothing is taken twice.

    `last`: utime and counter of the newest command of each (key's name, sender). `floor`: what others must be above:
    the newest of those who are not told apart any more.
    """

    last: Mapping[tuple[str, str], tuple[int, int]] = MappingProxyType({})
    floor: tuple[int, int] = (0, 0)


class Judgement(NamedTuple):
    """Whether a genuine command is fresh: why not, by a word and a sentence; and what is known after it."""

    known: Freshness
    reason: str = ""
    why: str = ""


def judged(known: Freshness, envelope: Envelope, utime: int, uptime_us: int, window_us: int) -> Judgement:
    """Return whether a genuine command may be obeyed at `utime`, the vehicle's clock, microseconds.

    It must be of the last `window_us`, and newer than all that its sender had taken. What was taken before the service
    started `uptime_us` ago is forgotten, so nothing that could have been taken then is taken now; that goes by
    differences to the clock as it is, so that a clock that was set right after the start makes no odds.
    """
    ahead_us = min(round(AHEAD_S * 1e6), window_us)
    age = utime - envelope.utime
    if age > window_us or age < -ahead_us:
        return Judgement(known, "stale", _stale(age, window_us, ahead_us))
    if age > uptime_us - ahead_us:
        wait = max(0.0, (age - uptime_us + ahead_us) * 1e-6)
        why = (
            f"the service has just started and takes nothing that it might have taken before; ask again in {wait:.1f} s"
        )
        return Judgement(known, "stale", why)
    sender = (envelope.key_name, envelope.sender)
    stamp = (envelope.utime, envelope.counter)
    newest = known.last.get(sender, known.floor)
    if stamp <= newest:
        lead = (newest[0] - utime) * 1e-6
        why = f"it is not newer than the last one taken from {shown(envelope.sender)}"
        if lead > AHEAD_S:
            why += (
                f", whose stamp is {lead:.1f} s ahead of the vehicle's clock: a clock was set back since. Start the "
                "service anew, or sign as another sender"
            )
        else:
            why += ": the same message came twice, or two programs share the name; send it anew"
        return Judgement(known, "replayed", why)
    last = {**known.last, sender: stamp}
    floor = known.floor
    if len(last) > MAX_SENDERS:
        oldest = min(last, key=lambda each: last[each])
        floor = max(floor, last.pop(oldest))
    return Judgement(Freshness(last, floor))


def _stale(age: int, window_us: int, ahead_us: int) -> str:
    side = "before" if age > 0 else "after"
    return (
        f"it was signed {abs(age) * 1e-6:.1f} s {side} what the vehicle's clock says, and may be "
        f"{window_us * 1e-6:g} s old (commands.window_s) or {ahead_us * 1e-6:g} s ahead: set both clocks by the same "
        "time server (chronyc tracking shows how far one is off)"
    )
