"""Ingress: decode samples, correct their latency, detect publisher conflicts, verify commands, count what is rejected.

For each message on a sensor's channel the loop

1. reads source, seq and utime from the header at a fixed offset (`peek_sample_id`), without decoding the message;
2. drops it if it is from a second publisher, unless configured otherwise (`PublisherConflictMonitor`);
3. decodes it and subtracts the configured latency of the sensor (`SensorChannel.decode`).

A signed command needs a known key, a valid signature, a permitted channel and a fresh time stamp, and must be decodable
(`CommandVerifier`). Each check that fails has a reason that is counted. Until the signature is verified, the sender
gets no reply. A replay attack fails by its time stamp and counter.

A flood of messages that are not used (undecodable bytes, a second publisher, unsigned commands) must not displace the
vehicle's data in the journal, nor load the core. So `RejectionCounter` limits both by rate: `MAX_PER_SECOND` messages
of a channel are recorded and counted one by one, the others are counted together once a second.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Container, Hashable, Iterable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Final

from modelserver.core import COMMANDS as SIGNED_KINDS
from modelserver.core import Instant
from modelserver.core.publisher_conflict import CONFLICT_TIMEOUT_NS, PublisherConflictDetector, SampleId
from modelserver.errors import WireError, quote
from modelserver.messages import (
    CHANNEL_OF,
    Denied,
    Envelope,
    Event,
    HealthWarning,
    JointsSample,
    Rejected,
    RelativePoseSample,
    Request,
    Sample,
    SignedCommand,
    SwitchMode,
)
from modelserver.named_tuples import new_tuple
from modelserver.server.journal import JournalQueue
from modelserver.server.log import RateLimitedLog
from modelserver.signing import Freshness, Key, check_freshness, has_valid_signature
from modelserver.wire.channels import BY_NAME, SIGNED
from modelserver.wire.codec import decode, encode, read_request_header
from modelserver.wire.fields import MAX_NAME, MAX_UTIME
from modelserver.wire.journal import RecordKind
from modelserver.wire.receiver import Sender

_HEADER: Final = struct.Struct(">8sq24xqi")
"""Start of every sensor message: fingerprint, header.utime, header.seq, length of header.source, which follows.

Between utime and seq are utime_sigma, host_utime and device_utime (sensor_header_t.lcm).
"""


@dataclass(frozen=True, slots=True)
class SensorChannel:
    """Wire type of a subscribed channel, and the latency that is subtracted from its stamps, microseconds."""

    type_name: str
    latency_us: int = 0

    def decode(self, data: bytes) -> Sample | SwitchMode:
        """Decode a sample or a mode command. Raises WireError."""
        value: Sample | SwitchMode = decode(self.type_name, data)
        return subtract_latency(value, self.latency_us) if self.latency_us else value


def peek_sample_id(data: bytes, fingerprint: bytes) -> SampleId | None:
    """Read the identity of a sample at a tenth of the cost of decoding; None if the header is invalid.

    `fingerprint` is that of the channel's type. The message may still be damaged behind its header.
    """
    if len(data) <= _HEADER.size:
        return None
    found, utime, seq, length = _HEADER.unpack_from(data)
    end = _HEADER.size + length
    if found != fingerprint or not 0 < utime < MAX_UTIME or not 0 < length <= MAX_NAME + 1 or end > len(data):
        return None
    return new_tuple(SampleId, (utime, data[_HEADER.size : end - 1].decode("utf-8", "replace"), seq))


def subtract_latency(sample: Sample | SwitchMode, microseconds: int) -> Sample | SwitchMode:
    """Subtract a latency from the measurement times of a sample; its host_utime stays."""
    header = replace(sample.header, utime=max(1, sample.header.utime - microseconds))
    if isinstance(sample, RelativePoseSample):
        return replace(sample, header=header, since_utime=max(1, sample.since_utime - microseconds))
    return replace(sample, header=header)


MAX_PER_SECOND: Final = 8
"""Messages of a channel that are recorded, and rejections of one cause that are counted one by one, per second."""

MAX_RECORDED_BYTES: Final = 512
"""Bytes that the journal records of a message that is not used."""

SECOND_NS: Final = 1_000_000_000


class RateLimiter:
    """Limits events by name: `per_second` in each window of a second, which starts with the first event."""

    def __init__(self, per_second: int = MAX_PER_SECOND):
        self._per_second = per_second
        self._windows: dict[Hashable, tuple[int, int]] = {}

    def try_acquire(self, name: Hashable, now_ns: int) -> bool:
        """Count an event at an instant (monotonic, ns); return whether it is within the limit."""
        begin, used = self._windows.get(name, (now_ns, 0))
        if now_ns - begin >= SECOND_NS:
            begin, used = now_ns, 0
        if used >= self._per_second:
            return False
        self._windows[name] = (begin, used + 1)
        return True


class RejectionCounter:
    """Counts rejected messages and records some of them, within rate limits. `step` passes an event to the core.

    Channels and reasons are the server's own, so memory is bounded.
    """

    def __init__(self, step: Callable[[Rejected, Instant], None], journal: JournalQueue):
        self._step = step
        self._journal = journal
        self._records, self._events = RateLimiter(), RateLimiter()
        self._waiting: dict[tuple[str, str], int] = {}
        self._flushed_ns = 0

    def record(self, kind: RecordKind, channel: str, data: bytes, now: Instant) -> None:
        """Record the start of a message in the journal, within the channel's rate limit."""
        if self._records.try_acquire(channel, now.monotonic_ns):
            self._journal.record_message(kind, (channel, data[:MAX_RECORDED_BYTES]), now)

    def count(self, channel: str, reason: str, now: Instant) -> bool:
        """Count a message in the core, at once or with the next `flush`; return whether at once."""
        key = (channel, reason)
        if self._events.try_acquire(key, now.monotonic_ns):
            self._step(Rejected(channel, reason), now)
            return True
        self._waiting[key] = self._waiting.get(key, 0) + 1
        return False

    def drop(self, kind: RecordKind, channel: str, reason: str, data: bytes, now: Instant) -> None:
        """Count a message and record it, within the rate limits; beyond them this costs a microsecond."""
        if self.count(channel, reason, now):
            self.record(kind, channel, data, now)

    def flush(self, now: Instant, at_once: bool = False) -> None:
        """Count the waiting rejections in the core, once a second or `at_once`."""
        if not self._waiting or not (at_once or now.monotonic_ns - self._flushed_ns >= SECOND_NS):
            return
        waiting, self._waiting, self._flushed_ns = self._waiting, {}, now.monotonic_ns
        for (channel, reason), count in waiting.items():
            self._step(Rejected(channel, reason, count), now)


MAX_JOINTS: Final = 4096
"""Joints with a detector of their own."""

MAX_WARNINGS: Final = 16
"""Conflicts that are reported at once."""

PUBLISHER_CONFLICT: Final = "publisher_conflict"
"""Reason under which samples of a second publisher are counted."""

RECORDING_AGE_S: Final = 5.0
"""A second publisher whose stamps are this old plays a recording."""


class PublisherConflictMonitor:
    """Reports publisher conflicts as health warnings and in the log, and decides whether their samples are ignored.

    Parameters
    ----------
    step: passes an event to the core.
    count: counts a sample that is used all the same, by channel and reason; an ignored one is counted by the caller.
    rule: `ignore`, `use`, or empty for no detection (`LoopSettings.publisher_conflict`).
    names: the sources that the vehicle file names, by channel.
    """

    def __init__(
        self,
        step: Callable[[Event, Instant], None],
        count: Callable[[str, str, Instant], object],
        log: RateLimitedLog,
        rule: str,
        names: Mapping[str, Container[str]] = MappingProxyType({}),
    ):
        self._names = names
        self._step = step
        self._count = count
        self._log = log
        self.is_enabled, self._ignore = bool(rule), rule == "ignore"
        self._detectors: dict[tuple[str, str], PublisherConflictDetector] = {}
        self._active: dict[str, PublisherConflictDetector] = {}

    def make_detector(self, channel: str) -> PublisherConflictDetector:
        """Return a detector for a channel, which prefers the sources that the vehicle file names for it."""
        return PublisherConflictDetector(self._names.get(channel, ()))

    def is_ignored(
        self,
        channel: str,
        detector: PublisherConflictDetector,
        sample_id: SampleId,
        now: Instant,
        sender: Sender,
        subject: str = "",
    ) -> bool:
        """Process a sample; return whether it is from a second publisher and to be ignored.

        `subject`: what the warning names; empty: the channel.
        """
        is_second = detector.is_conflicting(sample_id, now.monotonic_ns, sender)
        if not is_second and detector.conflict_ns != now.monotonic_ns:
            return False
        if is_second and not self._ignore:
            self._count(channel, PUBLISHER_CONFLICT, now)
        self._warn(subject or channel, channel, detector, sample_id, now)
        return is_second and self._ignore

    def select_joints(self, channel: str, data: bytes, sample_id: SampleId, now: Instant, sender: Sender) -> bytes:
        """Process a message of joints, of which several drivers on one channel publish some each.

        Returns the message without the joints that another publisher has; empty if it has them all. Raises WireError.
        """
        sample: JointsSample = decode("joints_t", data)
        joints = tuple([each for each in sample.joints if self._has_joint(channel, each.name, sample_id, now, sender)])
        if len(joints) == len(sample.joints):
            return data
        return encode(replace(sample, joints=joints)) if joints else b""

    def _has_joint(self, channel: str, name: str, sample_id: SampleId, now: Instant, sender: Sender) -> bool:
        """Process a joint of a message; return whether it is used."""
        key = (channel, name)
        detector = self._detectors.get(key)
        if detector is None:
            if len(self._detectors) >= MAX_JOINTS:
                return True
            detector = self._detectors[key] = self.make_detector(channel)
        return not self.is_ignored(channel, detector, sample_id, now, sender, f"{channel} {name}")

    def _warn(
        self, subject: str, channel: str, detector: PublisherConflictDetector, sample_id: SampleId, now: Instant
    ) -> None:
        if subject in self._active or len(self._active) >= MAX_WARNINGS:
            return
        self._active[subject] = detector
        text = self._format_warning(subject, detector, (now.utime - sample_id.utime) * 1e-6)
        self._step(HealthWarning(f"channel {subject}", text), now)
        self._log.warning(f"{channel}:publisher_conflict", "%s", text)

    def clear_expired(self, now: Instant) -> None:
        """Clear the warnings on conflicts that have ended."""
        for subject, detector in list(self._active.items()):
            if now.monotonic_ns - detector.conflict_ns > CONFLICT_TIMEOUT_NS:
                del self._active[subject]
                self._step(HealthWarning(f"channel {subject}"), now)

    def _format_warning(self, subject: str, detector: PublisherConflictDetector, age: float) -> str:
        first, second = quote(detector.source, 40), quote(detector.other_source, 40)
        who = f"two publishers with source {first}" if first == second else f"sources {first} and {second}"
        done = "the second one is ignored" if self._ignore else "both are used (sensors.publisher_conflict)"
        old = (
            f" (its stamps are {age:,.0f} s old: a recording is played onto the bus?)" if age > RECORDING_AGE_S else ""
        )
        return f"{who} publish on {subject} at once, and {done}{old}: stop one of them"


COMMANDS: Final[Mapping[str, type[Request]]] = {CHANNEL_OF[kind]: kind for kind in SIGNED_KINDS}
"""Request types that must be signed, by channel."""

MODE_TYPE: Final = "localization_mode_t"


class CommandVerifier:
    """Verifies signed envelopes. `prefix` is that of the vehicle's channels; mode commands name `mode_channel`."""

    def __init__(self, keys: Iterable[Key], prefix: str, window_s: float, mode_channel: str, started_ns: int):
        self._keys = {key.name: key for key in keys}
        self._prefix = prefix
        self._window_us = round(window_s * 1e6)
        self._mode_channel = mode_channel
        self._started_ns = started_ns
        self._freshness = Freshness()

    def verify(self, data: bytes, now: Instant) -> SignedCommand | Denied:
        """Return the command in an envelope, or why it is denied. Raises WireError if `data` is no envelope."""
        envelope: Envelope = decode("signed_t", data)
        key = self._keys.get(envelope.key_name)
        if key is None:
            return Denied(f"{self._prefix}{SIGNED}", "unknown_key")
        if not has_valid_signature(key, self._prefix, envelope):
            return Denied(f"{self._prefix}{SIGNED}", "bad_signature")
        # from here on the sender knows the key
        kind = COMMANDS.get(envelope.channel)
        if kind is None and (not self._mode_channel or envelope.channel != self._mode_channel):
            return Denied(f"{self._prefix}{SIGNED}", "channel")
        source = f"{self._prefix}{envelope.channel}"
        header = read_request_header(envelope.payload) if kind is not None else None
        uptime_us = (now.monotonic_ns - self._started_ns) // 1000
        check = check_freshness(self._freshness, envelope, now.utime, uptime_us, self._window_us)
        self._freshness = check.freshness
        if check.reason:
            return Denied(source, check.reason, check.message, kind, header)
        try:
            command = decode(MODE_TYPE if kind is None else BY_NAME[envelope.channel].type_name, envelope.payload)
        except WireError as error:
            return Denied(source, error.reason, str(error), kind, header, is_malformed=True)
        return SignedCommand(command, envelope.sender)
