"""Telling by its first bytes what kind of message one is, without decoding it."""

from __future__ import annotations

from typing import Final

import mslcm
from modelserver.wire.channels import CHANNELS, Way
from modelserver.wire.codec import type_names

_SAMPLES: Final = frozenset(
    getattr(mslcm, channel.type_name)._get_packed_fingerprint() for channel in CHANNELS if channel.way is Way.SENSOR
)
_SERVICE: Final = frozenset(getattr(mslcm, name)._get_packed_fingerprint() for name in type_names()) - _SAMPLES


def is_sample(data: bytes) -> bool:
    """Return whether a message is a sensor's."""
    return data[:8] in _SAMPLES


def is_of_service(data: bytes) -> bool:
    """Return whether a message is one between the service and its clients: a pose, health, a request, a reply."""
    return data[:8] in _SERVICE
