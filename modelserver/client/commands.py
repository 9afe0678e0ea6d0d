"""Commands of a client: requests that change the server's state. They are signed where the client has the key."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable

from modelserver.messages import (
    Envelope,
    ReloadModel,
    SetHTransform,
    SetStateVector,
)
from modelserver.signing.key_files import KEY_FILE_VARIABLE, read_keys
from modelserver.signing.signatures import Key, sign
from modelserver.wire.channels import SIGNED
from modelserver.wire.codec import encode

COMMANDS = (ReloadModel, SetStateVector, SetHTransform)
"""Requests that are not retried: a lost reply does not mean that the command was not executed."""


MAX_SENDER_LENGTH = 64


class Signer:
    """Sign the commands of one program to one vehicle. `clock` returns microseconds since the Unix epoch."""

    def __init__(self, key: Key, prefix: str, sender: str, clock: Callable[[], int] = lambda: time.time_ns() // 1000):
        self.channel = f"{prefix}{SIGNED}"
        self._key = key
        self._prefix = prefix
        self._sender = sender[:MAX_SENDER_LENGTH]
        self._clock = clock
        self._counter = 0

    def seal(self, channel: str, payload: bytes) -> bytes:
        """Return an encoded envelope with the message for `channel` (without the prefix)."""
        self._counter += 1
        envelope = Envelope("", self._sender, self._clock(), self._counter, channel, payload)
        return encode(sign(self._key, self._prefix, envelope))


def load_signer(key_file: str, prefix: str, program: str) -> Signer | None:
    """Return a signer with the first key of a file, default $MODELSERVER_KEY_FILE; None if neither is given.

    Raises KeyFileError.
    """
    path = key_file or os.environ.get(KEY_FILE_VARIABLE, "")
    if not path:
        return None
    return Signer(read_keys(path)[0], prefix, f"{program}@{socket.gethostname()}")
