"""The health report on the wire."""

from __future__ import annotations

from modelserver.messages import ChannelHealth, Health, Invalid
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
    "state",
    "pose_epoch",
    "origin_id",
    "poses_published",
    "requests_answered",
    "requests_parked",
    "ticks_missed",
    "handler_errors",
    "tick_lateness_p50",
    "tick_lateness_max",
)


def write_health(health: Health) -> health_t:
    """Return the message of a health report."""
    message = health_t()
    for name in _PLAIN:
        setattr(message, name, getattr(health, name))
    message.invalid_reasons = int(health.invalid_reasons)
    message.invalid_text = health.invalid_reasons.explain()
    message.num_channels = len(health.channels)
    message.channels = []
    for each in health.channels:
        channel = channel_health_t()
        channel.channel, channel.count, channel.rate_hz, channel.age = each.channel, each.count, each.rate_hz, each.age
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
    return Health(
        invalid_reasons=Invalid(message.invalid_reasons),
        channels=tuple(ChannelHealth(each.channel, each.count, each.rate_hz, each.age) for each in message.channels),
        rejected=tuple((each.channel, each.reason, each.count) for each in message.rejected),
        notices=tuple(zip(message.notice_subjects, message.notice_texts, strict=True)),
        **{name: getattr(message, name) for name in _PLAIN},
    )
