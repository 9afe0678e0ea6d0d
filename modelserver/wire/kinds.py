"""Telling by its first bytes what kind of message one is, without decoding it."""

from __future__ import annotations

from typing import Final

import mslcm
from modelserver.wire.channels import CHANNELS, ChannelUse
from modelserver.wire.codec import type_names
from modelserver.wire.journal import MAGIC
from modelserver.wire.signed import SIGNED

_INPUTS: Final = frozenset(
    getattr(mslcm, channel.type_name)._get_packed_fingerprint()
    for channel in CHANNELS
    # what was signed once is not to be said again: to play it from a recording is what signatures guard against
    if channel.way in (ChannelUse.SENSOR, ChannelUse.COMMAND) and channel.name != SIGNED
)
_SERVICE: Final = frozenset(getattr(mslcm, name)._get_packed_fingerprint() for name in type_names()) - _INPUTS | {MAGIC}


def _is_stamped(type_name: str) -> bool:
    return isinstance(getattr(getattr(mslcm, type_name)(), "header", None), mslcm.sensor_header_t)


_STAMPED: Final = frozenset(
    getattr(mslcm, channel.type_name)._get_packed_fingerprint()
    for channel in CHANNELS
    if _is_stamped(channel.type_name)
)


_TYPES: Final = {getattr(mslcm, name)._get_packed_fingerprint(): name for name in dir(mslcm) if name.endswith("_t")}


def type_name_of(data: bytes) -> str:
    """Return the type of this package that a message is of, empty for another's."""
    return _TYPES.get(data[:8], "")


def is_stamped(data: bytes) -> bool:
    """Return whether a message begins with a sensor's header: a sample, or a wish to the localization."""
    return data[:8] in _STAMPED


def is_of_service(data: bytes) -> bool:
    """Return whether a message is one between the service and its clients: pose, health, request, signed or not, reply.

    Or one of a journal's own, which nobody listens to.
    """
    return data[:8] in _SERVICE
