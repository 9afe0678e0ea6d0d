"""Verification of a journal by replay: every record is processed again, and what is published is compared bit for bit.

Messages that differ within `comparison.TOLERANCE`, as on another build or machine, are a result of their own.
`segments` checks that they are complete, in order and authentic.

A run is the life of one service process. Its segments follow each other, and the replay continues from one into the
next. After a gap (dropped by the ring, lost records, damaged bytes) it restarts from the state in the head of the next
segment. That state has only the last seconds of the pose history: until the history is as long as in the recorded run,
a differing reply about the past counts as `unverifiable`, not as a difference.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from itertools import zip_longest
from pathlib import Path
from typing import Any, Final

from modelserver.errors import RecordingError, WireError
from modelserver.messages import GetHistory, GetTransformations, HealthWarning, Rejected
from modelserver.server.journal import environment
from modelserver.server.journal import state as journal_state
from modelserver.server.journal.comparison import Deviation, compute_deviation
from modelserver.server.journal.replay import PublishedMessage, ReplayLoop
from modelserver.server.journal.segments import NEWEST_NAME, ChainVerifier, open_mapped, read_newest
from modelserver.signing import Key
from modelserver.wire import journal
from modelserver.wire.channels import BY_NAME
from modelserver.wire.codec import decode

POSES: Final = ("POSE", "POSE_VECTOR", "POSE_ODOM")


class VerificationResult(IntEnum):
    """Result of a verification; the value is the exit code of `modelserver replay --verify`.

    Without a key the command exits with 0 for REPRODUCED too.
    """

    AUTHENTIC = 0
    """Everything is reproduced bit for bit, and the seals prove that it is authentic and complete."""
    DIFFERS = 1
    """Something is not reproduced, damaged, missing or not authentic."""
    REPRODUCED = 3
    """Everything is reproduced bit for bit; authenticity is not proven."""
    WITHIN_TOLERANCE = 4
    """Everything is reproduced, some of it only within the tolerance."""


@dataclass(frozen=True, slots=True)
class Difference:
    """The first message that differs: as recorded and as replayed (None = not published)."""

    segment: Path
    at: int
    utime: int
    channel: str
    recorded: bytes | None
    replayed: bytes | None


@dataclass(frozen=True, slots=True)
class JournalFinding:
    """A finding about a segment. `is_damage`: its bytes are corrupt, or segments are missing."""

    segment: Path
    text: str
    is_damage: bool = False

    def __str__(self) -> str:
        return f"{self.segment}: {self.text}"


@dataclass(slots=True)
class VerificationReport:
    """Report of a verification.

    Attributes
    ----------
    reproduced: messages that were published again bit for bit, by channel without prefix.
    skipped: messages of gaps, for which the state is not known.
    unverifiable: see the module.
    seconds: replayed time of the span from first_utime to last_utime.
    environment_differences: of build and machine, in words.
    within_tolerance: messages that differ within the tolerance, by channel; max_deviation: their maximum difference.
    genuine, unsealed: segments with a valid keyed seal, and without a verifiable one.
    is_complete: whether it is known that no segment is missing at the end.
    """

    segments: int = 0
    runs: int = 0
    handled: int = 0
    reproduced: Counter[str] = field(default_factory=Counter)
    skipped: Counter[str] = field(default_factory=Counter)
    unverifiable: int = 0
    lost: int = 0
    first_utime: int = 0
    last_utime: int = 0
    bytes: int = 0
    seconds: float = 0.0
    findings: list[JournalFinding] = field(default_factory=list)
    environment_differences: list[str] = field(default_factory=list)
    difference: Difference | None = None
    within_tolerance: Counter[str] = field(default_factory=Counter)
    max_deviation: Deviation = field(default_factory=Deviation)
    max_deviation_channels: tuple[str, str] = ("", "")
    """Channels of the maximum difference of a position, and of an orientation."""
    genuine: int = 0
    unsealed: int = 0
    is_complete: bool = False

    @property
    def reproduced_poses(self) -> int:
        return sum(self.reproduced[name] for name in POSES)

    @property
    def is_reproduced(self) -> bool:
        """Whether something was verified, everything within tolerance, and nothing is damaged or missing."""
        something = bool(self.reproduced) or bool(self.within_tolerance)
        return something and self.difference is None and not any(each.is_damage for each in self.findings)

    @property
    def is_authentic(self) -> bool:
        """Whether the seals prove that the service wrote everything and that nothing is missing."""
        return self.is_reproduced and self.is_complete and 0 < self.segments == self.genuine and not self.unsealed

    @property
    def result(self) -> VerificationResult:
        """The result."""
        if not self.is_reproduced:
            return VerificationResult.DIFFERS
        if self.within_tolerance:
            return VerificationResult.WITHIN_TOLERANCE
        return VerificationResult.AUTHENTIC if self.is_authentic else VerificationResult.REPRODUCED


@dataclass(slots=True)
class _Group:
    """A record, or several records with interleaved outputs, and what was published."""

    segment: Path
    record: journal.JournalRecord
    replayed: list[PublishedMessage]
    recorded: list[journal.JournalRecord] = field(default_factory=list)


def verify(
    files: Sequence[Path],
    on_progress: Callable[[int], object] = lambda done: None,
    keys: Sequence[Key] = (),
    directory: Path | None = None,
) -> VerificationReport:
    """Replay a journal, its segments `files` in order, up to the first difference.

    `on_progress` is called with the number of bytes done. `keys` of the vehicle verify the seals. `directory`: that of
    which `files` are all segments; None: single files. Raises RecordingError if a file is no journal; OSError.
    """
    verifier = _Verifier(on_progress, keys)
    for path in files:
        verifier.verify_segment(path)
        if verifier.report.difference is not None:
            break
    verifier.close()
    verifier.finish(directory)
    return verifier.report


class _Verifier:
    def __init__(self, show: Callable[[int], object], keys: Sequence[Key] = ()):
        self.report = VerificationReport()
        self._chain = ChainVerifier(self._add_finding, keys)
        self._keys = keys
        self._on_progress = show
        self._replay: ReplayLoop | None = None
        self._group: _Group | None = None
        self._follows: tuple[str, int] | None = None
        """Run and part number of the segment that would continue from here."""
        self._held_until = 0
        """Sensor time from which the pose history is as long as in the recorded run."""
        self._at_ns = 0
        self._path = Path()
        self._run = ""
        self._is_closed = False

    def verify_segment(self, path: Path) -> None:
        self._path, self._is_closed, continues = path, False, False
        end: journal.SegmentEnd | None = None
        report, before = self.report, self.report.bytes
        facts: dict[str, Any] | None = None
        with open_mapped(path) as data:
            size = len(data)
            report.bytes += size
            for item in journal.read_segment(data):
                if report.difference is not None:
                    return
                if isinstance(item, journal.JournalRecord):
                    if report.handled % 512 == 0:
                        self._on_progress(before + item.at)
                    self._process(item)
                elif isinstance(item, journal.SegmentHead):
                    facts = item.facts
                    continues = self._read_head(facts)
                elif isinstance(item, journal.SegmentState):
                    if not continues:
                        self._begin(item, facts)
                elif isinstance(item, journal.CorruptRegion):
                    self._report_corruption(item)
                elif isinstance(item, journal.SegmentEnd):
                    self._is_closed, end = True, item
                    if not item.is_intact:
                        self._add_finding("the checksum over the whole segment is wrong", is_damage=True)
        if facts is None:
            if size == 0 or any(each.segment == path for each in report.findings):
                self._stop()
                self._chain.skip(path)
                if size == 0:
                    self._add_finding("is empty: the machine stopped while it was created")
                return
            raise RecordingError(f"{path}: is no journal of a modelserver")
        report.segments += 1
        self._chain.end(facts, end)
        if not self._is_closed:
            if not any(each.segment == path for each in report.findings):
                self._add_finding("is not closed: it is being written, or the process or machine stopped")
            self.close()
            self._replay = self._follows = None

    def _read_head(self, facts: dict[str, Any]) -> bool:
        """Process the head of a segment; return whether it continues the one before."""
        run, part, lost = str(facts.get("run")), facts.get("part"), facts.get("lost")
        numbers = (part, lost, facts.get("number"), facts.get("run_number"))
        if facts.get("format") != journal.FORMAT or not all(type(each) is int for each in numbers):
            raise RecordingError(
                f"{self._path}: is a journal of format {facts.get('format')}; this build reads {journal.FORMAT}; "
                "verify it with the build that wrote it"
            )
        part, lost = facts["part"], facts["lost"]
        self._chain.begin(self._path, facts)
        for each in environment.list_differences(facts):
            if each not in self.report.environment_differences:
                self.report.environment_differences.append(each)
        if run != self._run:
            self._run = run
            self.report.runs += 1
        continues = self._replay is not None and self._follows == (run, part) and not lost
        if not continues:
            self.close()
            self._replay = None
        self._follows = (run, part + 1)
        if lost:
            self.report.lost += lost
            self._add_finding(f"{lost} records before it are lost: disk error, or the disk was too slow")
        return continues

    def _begin(self, state: journal.SegmentState, facts: dict[str, Any] | None) -> None:
        self.close()
        self._replay, self._at_ns = None, 0
        try:
            self._replay = replay = ReplayLoop(state.data)
        except Exception as error:
            self._add_finding(f"cannot be replayed: {error}", is_damage=True)
            return
        if facts is not None and facts.get("history_s") is not None:
            history = replay.state.history
            if len(history):
                self._held_until = history.last + round(replay.state.settings.history_s * 1e6)

    def _process(self, record: journal.JournalRecord) -> None:
        report, replay = self.report, self._replay
        report.first_utime = report.first_utime or record.utime
        report.last_utime = record.utime
        if replay is None:
            if record.kind is journal.RecordKind.PUBLISHED:
                report.skipped[record.channel] += 1
            return
        if record.kind is journal.RecordKind.PUBLISHED:
            if self._group is None:
                self._group = _Group(self._path, record, [])
            self._group.recorded.append(record)
            return
        report.handled += 1
        if self._at_ns:
            report.seconds += max(record.monotonic_ns - self._at_ns, 0) * 1e-9
        self._at_ns = record.monotonic_ns
        if self._group is not None and not self._is_interleaved(record):
            self._compare()
            if report.difference is not None:
                return
        try:
            published = replay.handle(record)
        except Exception as error:
            # a forged state may contain anything
            self._add_finding(f"at byte {record.at}: {error}", is_damage=True)
            self._stop()
            return
        if self._group is None:
            self._group = _Group(self._path, record, published)
        else:
            self._group.replayed += published

    @staticmethod
    def _is_interleaved(record: journal.JournalRecord) -> bool:
        """Return whether a record may come between outputs of one step: a publishing or persisting error."""
        if record.kind is not journal.RecordKind.EVENT:
            return False
        try:
            return isinstance(journal_state.decode_event(record.data), (Rejected, HealthWarning))
        except RecordingError:
            return False

    def _compare(self) -> None:
        """Compare the recorded and the replayed outputs of the group, and count them by channel."""
        group, self._group = self._group, None
        assert group is not None
        assert self._replay is not None
        report, lcm = self.report, self._replay.config.lcm
        needs_history: bool | None = None
        for recorded, replayed in zip_longest(group.recorded, group.replayed):
            channel = replayed[0] if recorded is None else recorded.channel
            is_reply = channel.startswith(lcm.reply_prefix)
            label = "replies" if is_reply else channel.removeprefix(lcm.channel_prefix)
            if recorded is not None and replayed == (channel, recorded.data):
                report.reproduced[label] += 1
                continue
            if recorded is not None and replayed is not None and self._is_close(recorded, replayed):
                report.within_tolerance[label] += 1
                continue
            if is_reply:
                needs_history = self._needs_history(group.record) if needs_history is None else needs_history
                if needs_history:
                    report.unverifiable += recorded is not None
                    continue
            report.difference = Difference(
                group.segment,
                group.record.at if recorded is None else recorded.at,
                group.record.utime,
                channel,
                None if recorded is None else recorded.data,
                None if replayed is None else replayed[1],
            )
            return

    def _is_close(self, recorded: journal.JournalRecord, replayed: PublishedMessage) -> bool:
        """Return whether a message is equal within the tolerance, and update the maximum deviation."""
        report = self.report
        off = compute_deviation(recorded.data, replayed[1]) if replayed[0] == recorded.channel else None
        if off is None or not off.is_tolerable:
            return False
        meters, radians = report.max_deviation_channels
        report.max_deviation_channels = (
            recorded.channel if off.meters > report.max_deviation.meters else meters,
            recorded.channel if off.radians > report.max_deviation.radians else radians,
        )
        report.max_deviation = report.max_deviation.elementwise_max(off)
        return True

    def _needs_history(self, record: journal.JournalRecord) -> bool:
        """Return whether a reply may depend on poses before the restart of the replay."""
        replay = self._replay
        if replay is None or not len(replay.state.history) or replay.state.history.last >= self._held_until:
            return False
        if record.kind not in (
            journal.RecordKind.REQUEST,
            journal.RecordKind.CACHED,
            journal.RecordKind.MALFORMED,
            journal.RecordKind.OVERLOAD,
            journal.RecordKind.FAILED,
        ):
            # a deferred request is answered later
            return True
        channel = BY_NAME.get(record.channel.removeprefix(replay.config.lcm.channel_prefix))
        try:
            request = None if channel is None else decode(channel.type_name, record.data)
        except WireError:
            return False
        if isinstance(request, (GetHistory, GetTransformations)):
            return True
        return bool(getattr(getattr(request, "time", None), "at", 0))

    def _report_corruption(self, broken: journal.CorruptRegion) -> None:
        if broken.tail:
            self._add_finding(
                f"is truncated at byte {broken.start}: the last {broken.length} bytes are not sealed and not used "
                "(it is being written, or the process or machine stopped)"
            )
        else:
            self._add_finding(f"{broken}; verification continues with the next segment", is_damage=True)
        self._stop()

    def _stop(self) -> None:
        """Compare what is there and stop the replay: the following records have an unknown state."""
        if self._group is not None:
            # the missing batch may contain the rest of its outputs
            self._group.replayed = self._group.replayed[: len(self._group.recorded)]
        self.close()
        self._replay = self._follows = None

    def close(self) -> None:
        """Compare the last outputs, as far as they were written."""
        if self._group is not None and self._replay is not None and self.report.difference is None:
            if not self._is_closed:
                self._group.replayed = self._group.replayed[: len(self._group.recorded)]
            self._compare()
        self._group = None

    def finish(self, directory: Path | None) -> None:
        """Check that nothing is missing at the end, as far as possible."""
        report = self.report
        report.genuine, report.unsealed = self._chain.genuine, len(self._chain.unsealed)
        report.is_complete = directory is None
        if directory is None or report.difference is not None:
            return
        try:
            newest = read_newest(directory, self._keys)
        except RecordingError as error:
            self._add_finding(str(error), is_damage=True)
            return
        self._chain.finish(newest)
        report.is_complete = newest is not None
        if newest is None:
            self._add_finding(f"the file {NEWEST_NAME} is missing, so segments after it may be missing too")

    def _add_finding(self, text: str, is_damage: bool = False) -> None:
        self.report.findings.append(JournalFinding(self._path, text, is_damage))
