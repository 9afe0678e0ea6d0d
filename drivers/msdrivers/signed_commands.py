"""Verification of signed commands to the vehicle controller: a stranger on the bus cannot drive."""

from __future__ import annotations

from collections.abc import Iterable

from modelserver.errors import WireError
from modelserver.messages import Envelope, VehicleCommand
from modelserver.signing import Freshness, Key, check_freshness, has_valid_signature
from modelserver.wire.codec import decode
from msdrivers.endpoint import HostTime

COMMAND_TYPE = "vehicle_command_t"


class CommandDeniedError(Exception):
    """A denied command: the name of its counter, and why."""

    def __init__(self, reason: str, text: str):
        super().__init__(text)
        self.reason = reason


class DriveVerifier:
    """Verifies envelopes with commands for `channel` (without the vehicle's `prefix`).

    `started_ns`: when the driver started, monotonic; a command that an earlier run could have accepted is denied.
    """

    def __init__(self, keys: Iterable[Key], prefix: str, channel: str, window_s: float, started_ns: int):
        self._keys = {key.name: key for key in keys}
        self._prefix, self._channel = prefix, channel
        self._window_us = round(window_s * 1e6)
        self._started_ns = started_ns
        self._freshness = Freshness()

    def verify(self, data: bytes, now: HostTime) -> VehicleCommand:
        """Return the command in an envelope. Raises CommandDeniedError."""
        try:
            envelope: Envelope = decode("signed_t", data)
        except WireError as error:
            raise CommandDeniedError(error.reason, f"no signed message: {error}") from None
        key = self._keys.get(envelope.key_name)
        if key is None:
            raise CommandDeniedError("unknown_key", "signed with a key that is not in the vehicle's key file")
        if not has_valid_signature(key, self._prefix, envelope):
            raise CommandDeniedError("bad_signature", "its signature is wrong: another key, or another vehicle")
        if envelope.channel != self._channel:
            raise CommandDeniedError("channel", f"it was signed for another channel than {self._channel}")
        uptime_us = (now.monotonic_ns - self._started_ns) // 1000
        check = check_freshness(self._freshness, envelope, now.utime, uptime_us, self._window_us)
        self._freshness = check.freshness
        if check.reason:
            raise CommandDeniedError(check.reason, check.message)
        try:
            command: VehicleCommand = decode(COMMAND_TYPE, envelope.payload)
        except WireError as error:
            raise CommandDeniedError(error.reason, str(error)) from None
        return command
