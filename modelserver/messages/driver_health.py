"""How a driver is."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

from modelserver.messages.flags import NAN


class DriverPhase(IntEnum):
    """How far a driver has come with its device; the numbers are those of the wire."""

    CLOSED = 0
    WAITING = 1
    CONFIGURING = 2
    STREAMING = 3
    SILENT = 4


@dataclass(frozen=True, slots=True)
class DriverHealth:
    """How a driver is; see driver_health_t. `counters` holds names and counts."""

    utime: int
    source: str
    device: str
    phase: DriverPhase
    text: str = ""
    link: str = ""
    baud: int = 0
    reconnects: int = 0
    samples: int = 0
    rate_hz: float = 0.0
    age: float = NAN
    clock_offset: float = NAN
    clock_drift: float = NAN
    clock_sigma: float = NAN
    clock_restarts: int = 0
    counters: tuple[tuple[str, int], ...] = ()
