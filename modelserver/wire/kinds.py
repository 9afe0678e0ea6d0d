"""Telling by its first bytes what kind of message one is, without decoding it."""

from __future__ import annotations

from typing import Final

import mslcm
from modelserver.wire.channels import CHANNELS, Way
from modelserver.wire.codec import type_names

_INPUTS: Final = frozenset(
    getattr(mslcm, channel.type_name)._get_packed_fingerprint()
    for channel in CHANNELS
    if channel.way in (Way.SENSOR, Way.COMMAND)
)
_SERVICE: Final = frozenset(getattr(mslcm, name)._get_packed_fingerprint() for name in type_names()) - _INPUTS


def _is_stamped(type_name: str) -> bool:
    return isinstance(getattr(getattr(mslcm, type_name)(), "header", None), mslcm.sensor_header_t)


_STAMPED: Final = frozenset(
    getattr(mslcm, channel.type_name)._get_packed_fingerprint()
    for channel in CHANNELS
    if _is_stamped(channel.type_name)
)


def is_stamped(data: bytes) -> bool:
    """Return whether a message begins with a sensor's header: a sample, or a wish to the localization."""
    return data[:8] in _STAMPED


def is_of_service(data: bytes) -> bool:
    """Return whether a message is one between the service and its clients: a pose, health, a request, a reply."""
    return data[:8] in _SERVICE
