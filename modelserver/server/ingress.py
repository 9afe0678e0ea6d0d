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

Duplicate publisher (`PublisherConflictDetector`, pure of clocks; one mutable detector per channel):

A channel has one publisher, named by header.source and counting its messages in header.seq. A conflict (a driver that
was started twice, a recording played onto the live bus, a stranger) shows as

- another source, or another sender's address, while the first one still publishes: a conflict at once;
- outliers of the sequence: a seq far off the last one, or one already received with another utime. A single outlier may
  be a restarted driver, a log that starts again, or a stray message. If the old sequence stays silent after it, the new
  one owns the channel (restart). If the old sequence continues between outliers more than `MAX_OUTLIERS` times, two
  publishers have the same source.

Not a conflict: the same seq with the same utime (duplicate), a slightly lower seq not received yet (reordering), a
slightly higher one (loss). A source with a constant seq does not count; a counting one beside it is a conflict. The
first publisher keeps the channel until it has been silent for `PUBLISHER_TIMEOUT_NS`, and against its own source for
`RESTART_GAP_INTERVALS` of its intervals. Two exceptions: a source named in the vehicle file takes the channel from one
that is not; and a first one that is slower than any sensor loses it to a steady one (`CONTEST_NS`).

Limits: without addresses, two publishers of the same source that count in step within the reordering window look like
one. A stranger with the source of the sensor, that is first and as fast as one, keeps the channel.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Container, Iterable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Final, NamedTuple

from modelserver import messages
from modelserver.core import COMMANDS as SIGNED_KINDS
from modelserver.core import Instant
from modelserver.errors import WireError, quote
from modelserver.named_tuples import new_tuple
from modelserver.server.journal import JournalQueue
from modelserver.server.log import SECOND_NS, RateLimitedLog, RateLimiter
from modelserver.signing import Freshness, Key, check_freshness, has_valid_signature
from modelserver.wire.channels import BY_NAME, SIGNED
from modelserver.wire.codec import decode, encode, read_request_header
from modelserver.wire.fields import MAX_NAME, MAX_UTIME
from modelserver.wire.journal import RecordKind
from modelserver.wire.provider import Sender

_HEADER: Final = struct.Struct(">8sq24xqi")
"""Start of every sensor message: fingerprint, header.utime, header.seq, length of header.source, which follows.

Between utime and seq are utime_sigma, host_utime and device_utime (sensor_header_t.lcm).
"""


@dataclass(frozen=True, slots=True)
class SensorChannel:
    """Wire type of a subscribed channel, and the latency that is subtracted from its stamps, microseconds."""

    type_name: str
    latency_us: int = 0

    def decode(self, data: bytes) -> messages.Sample | messages.SwitchMode:
        """Decode a sample or a mode command. Raises WireError."""
        value: messages.Sample | messages.SwitchMode = decode(self.type_name, data)
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


def subtract_latency(
    sample: messages.Sample | messages.SwitchMode, microseconds: int
) -> messages.Sample | messages.SwitchMode:
    """Subtract a latency from the measurement times of a sample; its host_utime stays."""
    header = replace(sample.header, utime=max(1, sample.header.utime - microseconds))
    if isinstance(sample, messages.RelativePoseSample):
        return replace(sample, header=header, since_utime=max(1, sample.since_utime - microseconds))
    return replace(sample, header=header)


MAX_PER_SECOND: Final = 8
"""Messages of a channel that are recorded, and rejections of one cause that are counted one by one, per second."""

MAX_RECORDED_BYTES: Final = 512
"""Bytes that the journal records of a message that is not used."""


class RejectionCounter:
    """Counts rejected messages and records some of them, within rate limits. `step` passes an event to the core.

    Channels and reasons are the server's own, so memory is bounded.
    """

    def __init__(self, step: Callable[[messages.Rejected, Instant], None], journal: JournalQueue):
        self._step = step
        self._journal = journal
        self._records, self._events = RateLimiter(MAX_PER_SECOND), RateLimiter(MAX_PER_SECOND)
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
            self._step(messages.Rejected(channel, reason), now)
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
            self._step(messages.Rejected(channel, reason, count), now)


PUBLISHER_TIMEOUT_NS: Final = 3_000_000_000
"""A publisher that is silent for so long has left: three times the period of the slowest sensor."""

REORDER_WINDOW: Final = 64
"""How far below the last seq a message may be out of sequence; so many headers are stored. A power of two."""

LOSS_WINDOW: Final = 4096
"""How far above the last seq a message may be after losses: more than the fastest sensor sends in the timeout."""

CONFLICT_TIMEOUT_NS: Final = 10_000_000_000
"""A conflict without another sample for so long has ended."""

RESTART_GAP_NS: Final = 200_000_000
RESTART_GAP_INTERVALS: Final = 5
"""A sequence that is silent for so long, and for so many of its intervals, is replaced by another of its source."""

MAX_OUTLIERS: Final = 2
"""Outliers within `PUBLISHER_TIMEOUT_NS` between which the sequence may continue; more are another publisher's."""

MAX_LOSS_FACTOR: Final = 8
"""A seq that is ahead by more than this multiple of the messages expected in the elapsed time is an outlier."""

SLOWEST_PERIOD_NS: Final = 1_500_000_000
"""A longer gap has no sensor that works: receivers send once a second."""

CONTEST_NS: Final = 5_000_000_000
"""A publisher that has sent for so long without such a gap takes the channel from one with such gaps."""

CONSTANT_SEQ_SAMPLES: Final = 3
"""After so many samples with a constant seq a source does not count."""


class SampleId(NamedTuple):
    """The header fields that identify a sample and its publisher; they can be read without decoding the message."""

    utime: int
    source: str
    seq: int


_MASK: Final = REORDER_WINDOW - 1
_NO_SAMPLE: Final = messages.SensorHeader(0, seq=-1 << 64)


class PublisherConflictDetector:
    """Detects a second publisher on one channel. Mutable: a new value per sample would cost more than the detection."""

    __slots__ = (
        "_continued", "_interval_ns", "_is_counting", "_last", "_last_ns", "_names", "_outlier_ns", "_outliers",
        "_received", "_repeats", "_second", "_second_ns", "_second_since_ns", "_sender", "_slow_ns", "conflict_ns",
        "other_source", "source",
    )  # fmt: skip

    def __init__(self, names: Container[str] = ()) -> None:
        """`names`: the sources that the vehicle file names."""
        self._names = names
        self._sender: object = None
        self._second: object = None
        self._second_ns = self._second_since_ns = 0
        self._slow_ns = -CONTEST_NS
        self.source = ""
        """Source that owns the channel."""
        self.other_source = ""
        """Source of the last conflicting sample; empty without one."""
        self.conflict_ns = 0
        """Receipt of the last conflicting sample, monotonic nanoseconds."""
        self._received: list[messages.SensorHeader | SampleId] = []
        self._last = self._last_ns = self._interval_ns = self._outlier_ns = self._repeats = self._outliers = 0
        self._is_counting = self._continued = False
        self._restart(_NO_SAMPLE, -PUBLISHER_TIMEOUT_NS - 1, None)

    def is_conflicting(self, header: messages.SensorHeader | SampleId, now_ns: int, sender: object = None) -> bool:
        """Process a sample; return whether it is from a second publisher. `sender`: its address, where it is known."""
        seq = header.seq
        ahead = seq - self._last
        passed = now_ns - self._last_ns
        if passed > PUBLISHER_TIMEOUT_NS:
            self._restart(header, now_ns, sender)
            return False
        if header.source != self.source or sender != self._sender:
            return self._check_other(header, now_ns, sender)
        if passed > SLOWEST_PERIOD_NS:
            self._slow_ns = now_ns
        if 0 < ahead <= LOSS_WINDOW and self._repeats < CONSTANT_SEQ_SAMPLES:
            if ahead > REORDER_WINDOW and ahead * self._interval_ns > MAX_LOSS_FACTOR * passed:
                return self._check_outlier(header, now_ns)
            self._is_counting = True
        elif -REORDER_WINDOW < ahead <= 0 and self._is_counting:
            known = self._received[seq & _MASK]
            if known.seq == seq:
                return known.utime != header.utime and self._check_outlier(header, now_ns)
            # out of sequence: the last one stays the last
            self._received[seq & _MASK] = header
            return False
        elif ahead:
            return self._check_outlier(header, now_ns)
        else:
            self._repeats += 1
        self._last = seq
        self._last_ns = now_ns
        self._interval_ns += (passed - self._interval_ns) >> 3
        self._continued = True
        self._received[seq & _MASK] = header
        return False

    def _check_outlier(self, header: messages.SensorHeader | SampleId, now_ns: int) -> bool:
        """Process a sample that does not continue the sequence; return whether it is from a second publisher."""
        if self._may_be_restarted(now_ns):
            self._restart(header, now_ns, self._sender)
            return False
        if now_ns - self._outlier_ns > PUBLISHER_TIMEOUT_NS:
            self._outliers = 0
        # sooner than the next sample of any driver, restarted or not
        early = 2 * (now_ns - max(self._last_ns, self._outlier_ns)) < self._interval_ns
        self._outlier_ns = now_ns
        if self._continued or early:
            self._outliers += 1
            self._continued = False
        return self._outliers > MAX_OUTLIERS and self._set_conflict(header.source, now_ns)

    def _check_other(self, header: messages.SensorHeader | SampleId, now_ns: int, sender: object) -> bool:
        """Process a sample of another publisher; return whether it stays the second one."""
        is_restarted = header.source == self.source and self._may_be_restarted(now_ns)
        is_named = header.source in self._names and self.source not in self._names
        if is_restarted or is_named or self._wins_contest((header.source, sender), now_ns):
            if not is_restarted:
                self._set_conflict(self.source, now_ns)
            self._restart(header, now_ns, sender)
            return False
        return self._set_conflict(header.source, now_ns)

    def _may_be_restarted(self, now_ns: int) -> bool:
        return now_ns - self._last_ns > max(RESTART_GAP_NS, RESTART_GAP_INTERVALS * self._interval_ns)

    def _wins_contest(self, second: object, now_ns: int) -> bool:
        """Return whether a second publisher is steady where the first one is not."""
        if second != self._second or now_ns - self._second_ns > SLOWEST_PERIOD_NS:
            if self._second is not None and now_ns - self._second_ns <= SLOWEST_PERIOD_NS:
                return False  # a third one
            self._second, self._second_since_ns = second, now_ns
        self._second_ns = now_ns
        if now_ns - self._last_ns > SLOWEST_PERIOD_NS:
            self._slow_ns = now_ns
        return now_ns - self._second_since_ns >= CONTEST_NS and now_ns - self._slow_ns < CONTEST_NS

    def _set_conflict(self, source: str, now_ns: int) -> bool:
        self.other_source, self.conflict_ns = source, now_ns
        return True

    def _restart(self, header: messages.SensorHeader | SampleId, now_ns: int, sender: object) -> None:
        self._sender, self._second, self._slow_ns = sender, None, now_ns - CONTEST_NS
        self.source, self._last, self._last_ns = header.source, header.seq, now_ns
        self._is_counting, self._repeats, self._outliers, self._continued = False, 0, 0, True
        self._interval_ns = self._outlier_ns = 0
        self._received = [_NO_SAMPLE] * REORDER_WINDOW
        self._received[header.seq & _MASK] = header


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
        step: Callable[[messages.Event, Instant], None],
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
        sample: messages.JointsSample = decode("joints_t", data)
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
        self._step(messages.HealthWarning(f"channel {subject}", text), now)
        self._log.warning(f"{channel}:publisher_conflict", "%s", text)

    def clear_expired(self, now: Instant) -> None:
        """Clear the warnings on conflicts that have ended."""
        for subject, detector in list(self._active.items()):
            if now.monotonic_ns - detector.conflict_ns > CONFLICT_TIMEOUT_NS:
                del self._active[subject]
                self._step(messages.HealthWarning(f"channel {subject}"), now)

    def _format_warning(self, subject: str, detector: PublisherConflictDetector, age: float) -> str:
        first, second = quote(detector.source, 40), quote(detector.other_source, 40)
        who = f"two publishers with source {first}" if first == second else f"sources {first} and {second}"
        done = "the second one is ignored" if self._ignore else "both are used (sensors.publisher_conflict)"
        old = (
            f" (its stamps are {age:,.0f} s old: a recording is played onto the bus?)" if age > RECORDING_AGE_S else ""
        )
        return f"{who} publish on {subject} at once, and {done}{old}: stop one of them"


COMMANDS: Final[Mapping[str, type[messages.Request]]] = {messages.CHANNEL_OF[kind]: kind for kind in SIGNED_KINDS}
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

    def verify(self, data: bytes, now: Instant) -> messages.SignedCommand | messages.Denied:
        """Return the command in an envelope, or why it is denied. Raises WireError if `data` is no envelope."""
        envelope: messages.Envelope = decode("signed_t", data)
        key = self._keys.get(envelope.key_name)
        if key is None:
            return messages.Denied(f"{self._prefix}{SIGNED}", "unknown_key")
        if not has_valid_signature(key, self._prefix, envelope):
            return messages.Denied(f"{self._prefix}{SIGNED}", "bad_signature")
        # from here on the sender knows the key
        kind = COMMANDS.get(envelope.channel)
        if kind is None and (not self._mode_channel or envelope.channel != self._mode_channel):
            return messages.Denied(f"{self._prefix}{SIGNED}", "channel")
        source = f"{self._prefix}{envelope.channel}"
        header = read_request_header(envelope.payload) if kind is not None else None
        uptime_us = (now.monotonic_ns - self._started_ns) // 1000
        check = check_freshness(self._freshness, envelope, now.utime, uptime_us, self._window_us)
        self._freshness = check.freshness
        if check.reason:
            return messages.Denied(source, check.reason, check.message, kind, header)
        try:
            command = decode(MODE_TYPE if kind is None else BY_NAME[envelope.channel].type_name, envelope.payload)
        except WireError as error:
            return messages.Denied(source, error.reason, str(error), kind, header, is_malformed=True)
        return messages.SignedCommand(command, envelope.sender)
