"""A driver's report of itself between Python and wire, both ways."""

from __future__ import annotations

from typing import Final

from modelserver.errors import WireError
from modelserver.messages import DriverHealth, DriverPhase
from modelserver.wire import fields
from mslcm.driver_health_t import driver_health_t

MAX_COUNTERS: Final = 256
"""Counters in one message; more is taken for a damaged message."""

_PLAIN = (
    "text",
    "link",
    "baud",
    "reconnects",
    "samples",
    "rate_hz",
    "age",
    "clock_offset",
    "clock_drift",
    "clock_sigma",
    "clock_restarts",
)


def write_driver_health(health: DriverHealth) -> driver_health_t:
    """Return the message of a report. Raises ValueError for more than `MAX_COUNTERS`."""
    if len(health.counters) > MAX_COUNTERS:
        raise ValueError(f"{len(health.counters)} counters in one message; at most {MAX_COUNTERS} go out")
    message = driver_health_t()
    for name in _PLAIN:
        setattr(message, name, getattr(health, name))
    message.utime = health.utime
    message.source, message.device = health.source, health.device
    message.phase = int(health.phase)
    message.num_counters = len(health.counters)
    message.counter_names = [name for name, _ in health.counters]
    message.counter_values = [value for _, value in health.counters]
    return message


def read_driver_health(message: driver_health_t) -> DriverHealth:
    """Return the report of a message. Raises WireError."""
    if not 0 <= message.num_counters <= MAX_COUNTERS:
        raise WireError("malformed", f"{message.num_counters} counters in one message; 0 to {MAX_COUNTERS} are taken")
    return DriverHealth(
        utime=fields.checked_utime(message.utime),
        source=fields.name(message.source, "source"),
        device=fields.name(message.device, "device"),
        phase=fields.member(DriverPhase, message.phase, "phase"),
        counters=tuple(zip(message.counter_names, message.counter_values, strict=True)),
        **{name: getattr(message, name) for name in _PLAIN},
    )
