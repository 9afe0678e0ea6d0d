"""The health report on the wire."""

from __future__ import annotations

from modelserver.messages import ChannelHealth, Health, Invalid, LocalizationHealth, Mode, Phase
from modelserver.wire import fields
from mslcm.channel_health_t import channel_health_t
from mslcm.health_t import health_t
from mslcm.rejected_count_t import rejected_count_t

_PLAIN = (
    "utime",
    "uptime",
    "version",
    "vehicle",
    "model_revision",
    "host",
    "pid",
    "state",
    "pose_epoch",
    "origin_id",
    "poses_published",
    "requests_answered",
    "requests_parked",
    "requests_queued",
    "ticks_missed",
    "handler_errors",
    "tick_lateness_p50",
    "tick_lateness_p90",
    "tick_lateness_p99",
    "tick_lateness_max",
    "memory",
    "cpu_share",
)

_LOCALIZATION = ("standing", "horizontal_bound", "heading_bound", "seconds_to_limit", "fix_age")

_CHANNEL = ("channel", "count", "rate_hz", "age", "delay_max", "silent", "measured", "used")

NONE = -1
"""On the wire: no mode, no phase."""


def write_health(health: Health) -> health_t:
    """Return the message of a health report."""
    message = health_t()
    for name in _PLAIN:
        setattr(message, name, getattr(health, name))
    message.invalid_reasons = int(health.invalid_reasons)
    message.invalid_text = health.invalid_reasons.explain()
    localization = health.localization
    message.mode = NONE if localization.mode is None else int(localization.mode)
    message.phase = NONE if localization.phase is None else int(localization.phase)
    for name in _LOCALIZATION:
        setattr(message, name, getattr(localization, name))
    message.num_channels = len(health.channels)
    message.channels = []
    for each in health.channels:
        channel = channel_health_t()
        for name in _CHANNEL:
            setattr(channel, name, getattr(each, name))
        message.channels.append(channel)
    message.num_rejected = len(health.rejected)
    message.rejected = []
    for name, reason, count in health.rejected:
        rejected = rejected_count_t()
        rejected.channel, rejected.reason, rejected.count = name, reason, count
        message.rejected.append(rejected)
    message.num_notices = len(health.notices)
    message.notice_subjects = [subject for subject, _ in health.notices]
    message.notice_texts = [text for _, text in health.notices]
    return message


def read_health(message: health_t) -> Health:
    """Return the report of a message. Raises WireError."""
    fields.checked_count(message.num_channels, message.channels, "num_channels")
    fields.checked_count(message.num_rejected, message.rejected, "num_rejected")
    fields.checked_count(message.num_notices, message.notice_subjects, "num_notices")
    fields.checked_count(message.num_notices, message.notice_texts, "num_notices")
    mode = None if message.mode == NONE else fields.member(Mode, message.mode, "mode")
    phase = None if message.phase == NONE else fields.member(Phase, message.phase, "phase")
    return Health(
        invalid_reasons=Invalid(message.invalid_reasons),
        channels=tuple(ChannelHealth(*(getattr(each, name) for name in _CHANNEL)) for each in message.channels),
        rejected=tuple((each.channel, each.reason, each.count) for each in message.rejected),
        notices=tuple(zip(message.notice_subjects, message.notice_texts, strict=True)),
        localization=LocalizationHealth(mode, phase, *(getattr(message, name) for name in _LOCALIZATION)),
        **{name: getattr(message, name) for name in _PLAIN},
    )
