"""A key for tests, in a file beside the vehicle file, and envelopes signed with it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from modelserver.key_files import write_key
from modelserver.messages import CHANNEL_OF, Envelope
from modelserver.signing import Key, sign
from modelserver.wire.codec import encode

KEY = Key("test", bytes(range(32)))
ALLOWED = "commands: {reload: true, frames: true, set_pose: true, key_file: commands.key}\n"
"""For a vehicle file: everything is allowed to who has the key of `write_test_key`."""


def write_test_key(folder: Path, key: Key = KEY, name: str = "commands.key") -> Path:
    """Write the key's file unless it is there; return its path."""
    path = folder / name
    if not path.exists():
        write_key(path, key)
    return path


def envelope(
    payload: Any,
    utime: int,
    key: Key = KEY,
    prefix: str = "",
    sender: str = "me",
    counter: int = 1,
    channel: str = "",
) -> Envelope:
    """Return a signed envelope with a message."""
    channel = channel or CHANNEL_OF.get(type(payload), "LOCALIZATION_MODE")
    data = payload if isinstance(payload, bytes) else encode(payload)
    return sign(key, prefix, Envelope("", sender, utime, counter, channel, data))
