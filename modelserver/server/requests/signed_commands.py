"""Verify signed commands: known key, valid signature, permitted channel, fresh time stamp, decodable command.

Each check that fails has a reason that is counted. Until the signature is verified, the sender gets no reply. A
replay attack fails by its time stamp and counter.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Final

from modelserver import messages
from modelserver.core import Instant, commands
from modelserver.errors import WireError
from modelserver.signing import Freshness, Key, check_freshness, has_valid_signature
from modelserver.wire.channels import BY_NAME, SIGNED
from modelserver.wire.codec import decode, read_request_header

COMMANDS: Final[Mapping[str, type[messages.Request]]] = {messages.CHANNEL_OF[kind]: kind for kind in commands.COMMANDS}
"""Request types that must be signed, by channel."""

MODE_TYPE: Final = "localization_mode_t"


class CommandVerifier:
    """Verifies signed envelopes. `prefix` is that of the vehicle's channels; mode commands name `mode_channel`."""

    def __init__(self, keys: Iterable[Key], prefix: str, window_s: float, mode_channel: str, started_ns: int):
        self._keys = {key.name: key for key in keys}
        self._prefix = prefix
        self._window_us = round(window_s * 1e6)
        self._mode_channel = mode_channel
        self._started_ns = started_ns
        self._freshness = Freshness()

    def verify(self, data: bytes, now: Instant) -> messages.SignedCommand | messages.Denied:
        """Return the command in an envelope, or why it is denied. Raises WireError if `data` is no envelope."""
        envelope: messages.Envelope = decode("signed_t", data)
        key = self._keys.get(envelope.key_name)
        if key is None:
            return messages.Denied(f"{self._prefix}{SIGNED}", "unknown_key")
        if not has_valid_signature(key, self._prefix, envelope):
            return messages.Denied(f"{self._prefix}{SIGNED}", "bad_signature")
        # from here on the sender knows the key
        kind = COMMANDS.get(envelope.channel)
        if kind is None and (not self._mode_channel or envelope.channel != self._mode_channel):
            return messages.Denied(f"{self._prefix}{SIGNED}", "channel")
        source = f"{self._prefix}{envelope.channel}"
        header = read_request_header(envelope.payload) if kind is not None else None
        uptime_us = (now.monotonic_ns - self._started_ns) // 1000
        check = check_freshness(self._freshness, envelope, now.utime, uptime_us, self._window_us)
        self._freshness = check.freshness
        if check.reason:
            return messages.Denied(source, check.reason, check.message, kind, header)
        try:
            command = decode(MODE_TYPE if kind is None else BY_NAME[envelope.channel].type_name, envelope.payload)
        except WireError as error:
            return messages.Denied(source, error.reason, str(error), kind, header, is_malformed=True)
        return messages.SignedCommand(command, envelope.sender)
