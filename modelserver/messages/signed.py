"""What changes the service, and the proof that its sender knows the vehicle's key."""

from __future__ import annotations

from typing import Final, NamedTuple

MAX_PAYLOAD: Final = 4096
"""Bytes of the message in an envelope: four times the largest that there is."""

MAC_BYTES: Final = 32


class Envelope(NamedTuple):
    """A message in its bytes, who signed it and when; see signed_t."""

    key_name: str
    sender: str
    utime: int
    counter: int
    channel: str
    payload: bytes
    mac: bytes = bytes(MAC_BYTES)
