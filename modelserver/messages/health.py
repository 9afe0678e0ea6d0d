"""How the daemon is."""

from __future__ import annotations

from dataclasses import dataclass

from modelserver.messages.flags import Invalid


@dataclass(frozen=True, slots=True)
class ChannelHealth:
    """Traffic of one channel; see channel_health_t."""

    channel: str
    count: int
    rate_hz: float
    age: float


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
