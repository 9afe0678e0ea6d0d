"""Signing at the client: what changes the service goes out in an envelope, where the client has the vehicle's key."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable

from modelserver.keys import ENVIRONMENT, read_keys
from modelserver.messages import Envelope
from modelserver.signing import Key, sealed
from modelserver.wire.codec import encode
from modelserver.wire.signed import SIGNED

LONGEST_SENDER = 64


class Signer:
    """Signs what one program says to one vehicle. `clock` gives microseconds since the Unix epoch."""

    def __init__(self, key: Key, prefix: str, sender: str, clock: Callable[[], int] = lambda: time.time_ns() // 1000):
        self.channel = f"{prefix}{SIGNED}"
        self._key = key
        self._prefix = prefix
        self._sender = sender[:LONGEST_SENDER]
        self._clock = clock
        self._counter = 0

    def sealed(self, channel: str, payload: bytes) -> bytes:
        """Return the bytes of an envelope with a message that would go out on `channel`, without the prefix."""
        self._counter += 1
        envelope = Envelope("", self._sender, self._clock(), self._counter, channel, payload)
        return encode(sealed(self._key, self._prefix, envelope))


def signer(key_file: str, prefix: str, program: str) -> Signer | None:
    """Return what signs with the first key of a file, by default of $MODELSERVER_KEY_FILE; None where neither is given.

    Raises KeyFileError.
    """
    path = key_file or os.environ.get(ENVIRONMENT, "")
    if not path:
        return None
    return Signer(read_keys(path)[0], prefix, f"{program}@{socket.gethostname()}")
