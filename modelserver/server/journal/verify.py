"""Verification of a journal by replay: every record is processed again, and what is published is compared bit for bit.

The same loop and core process the records, on a fake bus and clock (`ReplayLoop`). Outputs that are published are
compared per record; the effects of others (a reloaded geometry, a persisted state) are records of their own.

A run is the life of one service process. Its segments follow each other, and the replay continues from one into the
next. After a gap (dropped by the ring, lost records, damaged bytes) it restarts from the state in the head of the next
segment. That state has only the last seconds of the pose history: until the history is as long as in the recorded run,
a differing reply counts as `unverifiable`, not as a difference.

Another numpy, Python or processor may sum in another order, so that the last bits of a float differ: a journal is
verified with the build that wrote it, on a machine of the same kind.

`ChainVerifier` checks by the heads and seals that the segments are complete, in order and authentic.
"""

from __future__ import annotations

import hmac
from collections import Counter
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from enum import IntEnum
from functools import cache
from itertools import zip_longest
from pathlib import Path
from typing import Any, Final, NamedTuple

import mslcm
from modelserver import core, messages
from modelserver.core import AllOutputs, Instant
from modelserver.errors import RecordingError, Status, WireError
from modelserver.messages import HealthWarning, Rejected
from modelserver.server.bus import FakeBus
from modelserver.server.clock import FakeClock
from modelserver.server.ingress import SensorChannel
from modelserver.server.journal import encoding, writer
from modelserver.server.loop import Hooks, Loop, LoopSettings
from modelserver.server.requests import REQUEST_TYPES
from modelserver.server.vehicle import Vehicle
from modelserver.signing import Key
from modelserver.wire import journal
from modelserver.wire.channels import BY_NAME
from modelserver.wire.codec import decode, read_request_header
from modelserver.wire.journal import JournalRecord, RecordKind


def files_of(path: Path) -> list[Path]:
    """Return the segments of a journal: those of a directory, or the one file. Raises RecordingError, OSError."""
    if path.is_dir():
        found = writer.list_segments(path)
    else:
        with writer.open_mapped(path) as data:
            # a damaged segment is one
            found = (
                [path] if data.find(journal.MAGIC) >= 0 or (writer.SEGMENT_NAME.fullmatch(path.name) and data) else []
            )
    if not found:
        raise RecordingError(
            f"{path}: is no journal, which is a folder of files journal-*.lcm (/var/lib/modelserver/journal-NAME); to "
            "play an LCM log: modelserver replay LOG, without --verify"
        )
    return found


class FieldChange(NamedTuple):
    """A field that differs: its full name with indices, and both values."""

    name: str
    recorded: Any
    replayed: Any


@cache
def _types_by_fingerprint() -> dict[bytes, Any]:
    return {
        kind._get_packed_fingerprint(): kind
        for kind in vars(mslcm).values()
        if isinstance(kind, type) and hasattr(kind, "_get_packed_fingerprint")
    }


def diff_messages(was: bytes, now: bytes) -> list[FieldChange] | None:
    """Return the fields in which two messages differ; None where they are not of one known type."""
    message_type = _types_by_fingerprint().get(was[:8])
    if message_type is None or was[:8] != now[:8]:
        return None
    try:
        return list(_diff_fields("", message_type.decode(was), message_type.decode(now)))
    except Exception:  # the generated classes raise exceptions of many types
        return None


def _diff_fields(name: str, was: Any, now: Any) -> Iterator[FieldChange]:
    if hasattr(was, "_get_packed_fingerprint") and type(was) is type(now):
        for slot in was.__slots__:
            yield from _diff_fields(f"{name}.{slot}" if name else slot, getattr(was, slot), getattr(now, slot))
    elif isinstance(was, (list, tuple)) and isinstance(now, (list, tuple)) and len(was) == len(now):
        for index, pair in enumerate(zip(was, now, strict=True)):
            yield from _diff_fields(f"{name}[{index}]", *pair)
    elif repr(was) != repr(now):
        yield FieldChange(name, was, now)


PublishedMessage = tuple[str, bytes]

UNPUBLISHED_OUTPUTS = (messages.LoadModel, messages.PersistOrigin, messages.PersistState, messages.ReportStart)


class _ContainsAll(Container[object]):
    def __contains__(self, thing: object) -> bool:
        return True


class ReplayLoop(Loop):
    """A loop that processes journal records and returns what it publishes."""

    def __init__(self, state: bytes):
        """Continue from the state of a segment. Raises RecordingError."""
        config, known = encoding.decode_run(state)
        self.config = config
        self._fake_clock = FakeClock()
        self._fake_bus = FakeBus(self._fake_clock)
        vehicle = Vehicle(config, known.model, None)
        settings = LoopSettings(period_ns=1, channel_prefix=config.lcm.channel_prefix)
        super().__init__(self._fake_bus, self._fake_clock, known, settings, Hooks(snapshot=vehicle.encode_snapshot))
        joints = config.sensors.joints
        self._replayed_channels: Mapping[str, SensorChannel] = {
            # stays subscribed after a reload from a geometry with joints to one without
            f"{config.lcm.channel_prefix}{joints.channel}": SensorChannel("joints_t", round(joints.latency * 1e6)),
            **vehicle.sensor_channels(),
        }
        # errors were logged by the recorded run
        self._logged = _ContainsAll()  # type: ignore[assignment]

    def handle(self, record: JournalRecord) -> list[PublishedMessage]:
        """Process a record; return what is published. Raises RecordingError for an invalid record."""
        published = self._fake_bus.published = []
        now = Instant(record.monotonic_ns, record.utime)
        self._fake_clock.set(now)
        if record.kind is RecordKind.EVENT:
            self._replay_event(encoding.decode_value(record.data), now)
        elif record.kind is RecordKind.SAMPLE:
            channel = self._replayed_channels.get(record.channel)
            if channel is None:
                raise RecordingError(f"{record.channel} is no sensor channel of the vehicle file")
            self._replay_event(channel.decode(record.data), now)
        elif record.kind is RecordKind.DEFERRED_PART:
            self._requests.send_deferred(int.from_bytes(record.data, "big"))
        elif record.kind not in (RecordKind.UNDECODABLE, RecordKind.DROPPED):
            self._replay_request(record, now)
        return published

    def _replay_request(self, record: JournalRecord, now: Instant) -> None:
        channel = BY_NAME.get(record.channel.removeprefix(self.config.lcm.channel_prefix))
        if channel is None:
            raise RecordingError(f"{record.channel} is no request channel")
        try:
            request: messages.Request = decode(channel.type_name, record.data)
        except WireError as error:
            header = read_request_header(record.data)
            if record.kind is RecordKind.MALFORMED and header is not None:
                self.send(
                    core.reply_error(
                        self.state, REQUEST_TYPES[channel.type_name], header, Status.MALFORMED, str(error), now
                    )
                )
                return
            raise RecordingError(f"a request on {record.channel} cannot be decoded: {error}") from error
        if record.kind is RecordKind.REQUEST:
            self._replay_event(request, now)
        elif record.kind is RecordKind.CACHED:
            # a static answer of the core equals the cached one; the state that counts it is discarded
            self.send(core.step(self.state, request, now)[1])
        elif record.kind is RecordKind.OVERLOAD:
            self.send(core.reply_overloaded(self.state, request, now))
        elif record.kind is RecordKind.FAILED:
            self._requests.drop_deferred()
            self.send(core.reply_internal_error(self.state, request, now))

    def _replay_event(self, event: object, now: Instant) -> None:
        try:
            self.step(event, now)  # type: ignore[arg-type]
        except Exception as error:
            self.handle_error("", error)

    def send(self, outputs: AllOutputs) -> None:
        """Publish outputs; ignore the others."""
        super().send(tuple(each for each in outputs if not isinstance(each, UNPUBLISHED_OUTPUTS)))

    def handle_error(self, channel: str, error: Exception, data: bytes = b"") -> None:
        """Do nothing: the error is the next record of the journal."""


def list_differences(then: Mapping[str, Any]) -> list[str]:
    """Return the differences between the facts of a journal and those here, in words.

    An unknown processor counts as equal: a unit with a restricted /proc cannot read it.
    """
    now = writer.collect_facts()
    changed = [key for key in now if key not in writer.INFORMATIVE_FACTS and then.get(key) != now[key]]
    if not (then.get("processor") and now["processor"]):
        changed = [key for key in changed if key != "processor"]
    return [f"{key} was {then.get(key)}, is {now[key]}" for key in changed]


class _Link(NamedTuple):
    path: Path
    number: int
    seal: str
    """Hexadecimal; empty = the segment is not closed."""


class ChainVerifier:
    """Verifies segments in the given order. `genuine` counts those with a valid keyed seal.

    `report` gets each finding about the current segment, and whether it is damage: segments that are missing, replaced,
    or not authentic.
    """

    def __init__(self, report: Callable[[str, bool], object], keys: Sequence[Key] = ()):
        self.genuine = 0
        self.unsealed: list[Path] = []
        """Segments without a verifiable seal: not closed, without a key, or the key is not given."""
        self._report = report
        self._keys = keys
        self._before: _Link | None = None
        self._places: dict[int, Path] = {}

    def begin(self, path: Path, facts: dict[str, Any]) -> None:
        """Check the position of a segment in the chain, by its head."""
        number, previous = facts["number"], str(facts["previous"])
        if writer.get_number(path) not in (None, number):
            self._report(f"is segment {number} by its own head: renamed, or put in place of another", True)
        first = self._places.setdefault(number, path)
        before = self._before
        if first != path:
            self._report(f"is a copy of {first.name}", True)
        elif before is None:
            if number > 0 or previous:
                count = f"{number} earlier segments" if number > 0 else "earlier segments"
                self._report(f"{count} were dropped by the ring, or removed", False)
        elif number <= before.number:
            self._report(f"is older than {before.path.name} before it: out of order", True)
        elif number > before.number + 1:
            missing = number - before.number - 1
            self._report(f"{missing} segments before it are missing, after {before.path.name}: removed, or lost", True)
        elif previous and not before.seal:
            self._report(f"follows {before.path.name}, whose end was cut off after it was written", True)
        elif previous != before.seal:
            self._report(f"does not match {before.path.name} before it: one of the two was replaced", True)
        self._before = _Link(path, number, "")

    def end(self, facts: dict[str, Any], end: journal.SegmentEnd | None) -> None:
        """Check the seal of the current segment; `end` None: it is not closed."""
        before = self._before
        assert before is not None
        name = str(facts["key"])
        if end is None:
            self.unsealed.append(before.path)
            return
        self._before = before._replace(seal=end.seal.hex())
        if not name or not self._keys:
            self.unsealed.append(before.path)
            if name or not end.mac:
                return
        try:
            key = writer.find_key(name, self._keys)
        except RecordingError as error:
            self._report(f"cannot be verified: {error}", True)
            return
        if not hmac.compare_digest(writer.seal_segment(key, end.digest), end.mac):
            self._report("its seal is wrong: it was not written with the key", True)
            return
        self.genuine += key is not None

    def skip(self, path: Path) -> None:
        """Skip a segment with an unreadable head, which counts as not closed."""
        self.unsealed.append(path)
        number = writer.get_number(path)
        if self._before is not None and number is not None:
            self._before = _Link(path, number, "")

    def finish(self, newest: writer.NewestMarker | None) -> None:
        """Check that the last segment is the one in `newest`; None: not known."""
        before = self._before
        if newest is None or before is None:
            return
        name = before.path.name
        if newest.number > before.number:
            count = newest.number - before.number
            self._report(f"{count} segments after {name} are missing at the end: removed, or lost", True)
        elif newest.number < before.number:
            # a stop between creating a segment and updating the marker is normal
            if newest.number != before.number - 1 or before.seal:
                self._report(f"the file {writer.NEWEST_NAME} is older than {name}: restored", True)
        elif newest.seal and newest.seal != before.seal:
            why = "was replaced" if before.seal else "was cut off after it was closed"
            self._report(f"{name}, the last segment, {why}", True)


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
    genuine: int = 0
    unsealed: int = 0
    is_complete: bool = False

    @property
    def reproduced_poses(self) -> int:
        return sum(self.reproduced[name] for name in POSES)

    @property
    def is_reproduced(self) -> bool:
        """Whether something was verified, nothing differs, and nothing is damaged or missing."""
        return bool(self.reproduced) and self.difference is None and not any(each.is_damage for each in self.findings)

    @property
    def is_authentic(self) -> bool:
        """Whether the seals prove that the service wrote everything and that nothing is missing."""
        return self.is_reproduced and self.is_complete and 0 < self.segments == self.genuine and not self.unsealed

    @property
    def result(self) -> VerificationResult:
        if not self.is_reproduced:
            return VerificationResult.DIFFERS
        return VerificationResult.AUTHENTIC if self.is_authentic else VerificationResult.REPRODUCED


@dataclass(slots=True)
class _Group:
    """A record, or several records with interleaved outputs, and what was published."""

    segment: Path
    record: JournalRecord
    replayed: list[PublishedMessage]
    recorded: list[JournalRecord] = field(default_factory=list)


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
        with writer.open_mapped(path) as data:
            size = len(data)
            report.bytes += size
            for item in journal.read_segment(data):
                if report.difference is not None:
                    return
                if isinstance(item, JournalRecord):
                    if report.handled % 512 == 0:
                        self._on_progress(before + item.at)
                    self._process(item)
                elif isinstance(item, journal.SegmentHead):
                    facts = item.facts
                    continues = self._read_head(facts)
                elif isinstance(item, journal.SegmentState):
                    if not continues:
                        self._begin(item)
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
        for each in list_differences(facts):
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

    def _begin(self, state: journal.SegmentState) -> None:
        self.close()
        self._replay, self._at_ns = None, 0
        try:
            replay = ReplayLoop(state.data)
            if len(history := replay.state.history):
                self._held_until = history.last + round(replay.state.settings.history_s * 1e6)
        except Exception as error:
            # a forged state may contain anything
            self._add_finding(f"cannot be replayed: {error}", is_damage=True)
            return
        self._replay = replay

    def _process(self, record: JournalRecord) -> None:
        report, replay = self.report, self._replay
        report.first_utime = report.first_utime or record.utime
        report.last_utime = record.utime
        if replay is None:
            if record.kind is RecordKind.PUBLISHED:
                report.skipped[record.channel] += 1
            return
        if record.kind is RecordKind.PUBLISHED:
            self._group = self._group or _Group(self._path, record, [])
            self._group.recorded.append(record)
            return
        report.handled += 1
        if self._at_ns:
            report.seconds += max(record.monotonic_ns - self._at_ns, 0) * 1e-9
        self._at_ns = record.monotonic_ns
        if self._group is not None and not self._is_interleaved(record):
            self._compare()
            if report.difference is not None or self._replay is None:
                return
        try:
            published = replay.handle(record)
        except Exception as error:
            # a forged state may contain anything
            self._add_finding(f"at byte {record.at}: {error}", is_damage=True)
            self._stop()
            return
        self._group = self._group or _Group(self._path, record, [])
        self._group.replayed += published

    @staticmethod
    def _is_interleaved(record: JournalRecord) -> bool:
        """Return whether a record may come between outputs of one step: a publishing or persisting error."""
        with suppress(RecordingError):
            is_event = record.kind is RecordKind.EVENT
            return is_event and isinstance(encoding.decode_value(record.data), (Rejected, HealthWarning))
        return False

    def _compare(self) -> None:
        """Compare the recorded and the replayed outputs of the group, and count them by channel."""
        try:
            self._compare_group()
        except Exception as error:
            # a forged state may contain anything
            self._add_finding(f"cannot be compared: {error}", is_damage=True)
            self._replay = self._follows = None

    def _compare_group(self) -> None:
        group, self._group = self._group, None
        assert group is not None
        assert self._replay is not None
        report, lcm = self.report, self._replay.config.lcm
        for recorded, replayed in zip_longest(group.recorded, group.replayed):
            channel = replayed[0] if recorded is None else recorded.channel
            is_reply = channel.startswith(lcm.reply_prefix)
            label = "replies" if is_reply else channel.removeprefix(lcm.channel_prefix)
            if recorded is not None and replayed == (channel, recorded.data):
                report.reproduced[label] += 1
                continue
            if is_reply and len(history := self._replay.state.history) and history.last < self._held_until:
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
            newest = writer.read_newest(directory, self._keys)
        except RecordingError as error:
            self._add_finding(str(error), is_damage=True)
            return
        self._chain.finish(newest)
        report.is_complete = newest is not None
        if newest is None:
            self._add_finding(f"the file {writer.NEWEST_NAME} is missing, so segments after it may be missing too")

    def _add_finding(self, text: str, is_damage: bool = False) -> None:
        self.report.findings.append(JournalFinding(self._path, text, is_damage))
