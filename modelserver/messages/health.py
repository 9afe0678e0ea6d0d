"""How the daemon is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from modelserver.messages.flags import NAN, Invalid
from modelserver.messages.navigation import Mode, Phase


class Gauges(NamedTuple):
    """What is read off the process and its loop, not concluded: it enters the core with a tick.

    `host` and `pid` say which process. `queued`: requests that were not looked at yet. `memory` is resident, bytes;
    0 = not known. `cpu_s`: processor time taken since the process began, seconds; nan = not known.
    """

    host: str = ""
    pid: int = 0
    queued: int = 0
    memory: int = 0
    cpu_s: float = NAN


@dataclass(frozen=True, slots=True)
class ChannelHealth:
    """Traffic of one source, or of a sensor that was never heard; see channel_health_t."""

    channel: str
    count: int
    rate_hz: float
    age: float
    delay_max: float = NAN
    silent: bool = False
    measured: int = 0
    used: int = 0


@dataclass(frozen=True, slots=True)
class LocalizationHealth:
    """How localization is, in few words; see health_t. `mode` None: nothing localizes; `phase` None: no filter does."""

    mode: Mode | None = None
    phase: Phase | None = None
    standing: bool = False
    horizontal_bound: float = NAN
    heading_bound: float = NAN
    seconds_to_limit: float = NAN
    fix_age: float = NAN


@dataclass(frozen=True, slots=True)
class Health:
    """How the daemon is; see health_t."""

    utime: int
    uptime: float
    version: str
    vehicle: str
    model_revision: str
    state: int
    invalid_reasons: Invalid
    pose_epoch: int
    origin_id: int
    poses_published: int
    requests_answered: int
    requests_parked: int
    ticks_missed: int
    handler_errors: int
    tick_lateness_p50: float
    tick_lateness_max: float
    channels: tuple[ChannelHealth, ...] = ()
    rejected: tuple[tuple[str, str, int], ...] = ()
    notices: tuple[tuple[str, str], ...] = ()
    tick_lateness_p90: float = 0.0
    tick_lateness_p99: float = 0.0
    host: str = ""
    pid: int = 0
    requests_queued: int = 0
    memory: int = 0
    cpu_share: float = NAN
    localization: LocalizationHealth = LocalizationHealth()
