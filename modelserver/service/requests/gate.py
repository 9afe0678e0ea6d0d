"""The gate for signed commands: what is genuine and fresh is opened, everything else has a reason that is counted."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Final

from modelserver.core import Instant
from modelserver.errors import WireError
from modelserver.messages import (
    CHANNEL_OF,
    Denied,
    Envelope,
    ReloadModel,
    Request,
    SetHTransform,
    SetStateVector,
    SignedCommand,
)
from modelserver.signing import Freshness, Key, is_genuine, judged
from modelserver.wire.channels import BY_NAME
from modelserver.wire.codec import decode
from modelserver.wire.requests import request_header
from modelserver.wire.signed import SIGNED

COMMANDS: Final[Mapping[str, type[Request]]] = {
    CHANNEL_OF[kind]: kind for kind in (ReloadModel, SetStateVector, SetHTransform)
}
"""The channels of requests that count only when they are signed."""

MODE_TYPE: Final = "localization_mode_t"


class Gate:
    """Opens envelopes. `prefix` is that of the vehicle's channels; wishes for modes name `mode_channel`."""

    def __init__(self, keys: Iterable[Key], prefix: str, window_s: float, mode_channel: str, started_ns: int):
        self._keys = {key.name: key for key in keys}
        self._prefix = prefix
        self._window_us = round(window_s * 1e6)
        self._mode_channel = mode_channel
        self._started_ns = started_ns
        self._known = Freshness()

    def opened(self, data: bytes, now: Instant) -> SignedCommand | Denied:
        """Return what an envelope orders, or why it is refused. Raises WireError for what is no envelope."""
        envelope: Envelope = decode("signed_t", data)
        key = self._keys.get(envelope.key_name)
        if key is None:
            return Denied(f"{self._prefix}{SIGNED}", "unknown_key")
        if not is_genuine(key, self._prefix, envelope):
            return Denied(f"{self._prefix}{SIGNED}", "bad_signature")
        # from here on it is someone who knows the key
        kind = COMMANDS.get(envelope.channel)
        if kind is None and (not self._mode_channel or envelope.channel != self._mode_channel):
            return Denied(f"{self._prefix}{SIGNED}", "channel")
        source = f"{self._prefix}{envelope.channel}"
        header = request_header(envelope.payload) if kind is not None else None
        uptime_us = (now.monotonic_ns - self._started_ns) // 1000
        judgement = judged(self._known, envelope, now.utime, uptime_us, self._window_us)
        self._known = judgement.known
        if judgement.reason:
            return Denied(source, judgement.reason, judgement.why, kind, header)
        try:
            order = decode(MODE_TYPE if kind is None else BY_NAME[envelope.channel].type_name, envelope.payload)
        except WireError as error:
            return Denied(source, error.reason, str(error), kind, header, malformed=True)
        return SignedCommand(order, envelope.sender)
