"""Verification of a journal by replay: every record is processed again, and what is published is compared bit for bit.

The same loop and core process the records, on a fake bus and clock (`ReplayLoop`). Outputs that are published are
compared per record; the effects of others (a reloaded geometry, a persisted state) are records of their own.

A run is the life of one service process. Its segments follow each other, and the replay continues from one into the
next. After a gap (dropped by the ring, lost records, damaged bytes) it restarts from the state in the head of the next
segment. That state has only the last seconds of the pose history: until the history is as long as in the recorded run,
a differing reply about the past counts as `unverifiable`, not as a difference.

Another numpy or Python may sum in another order, so that the last bits of a float differ. Two messages are equal within
the tolerance if positions differ by at most 1e-9 m, orientations by 1e-9 rad, and other floats by 1e-9 of their
magnitude (absolute below 1). Counts, texts, flags and non-finite numbers have to be equal. Such messages are a result
of their own.

`ChainVerifier` checks by the heads and seals that the segments are complete, in order and authentic.
"""

from __future__ import annotations

import hmac
import math
from collections import Counter
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from functools import cache
from itertools import islice, zip_longest
from pathlib import Path
from typing import Any, Final, NamedTuple

import mslcm
from modelserver import core, messages
from modelserver.core import AllOutputs, Instant
from modelserver.errors import RecordingError, Status, WireError
from modelserver.messages import GetHistory, GetTransformations, HealthWarning, Rejected
from modelserver.server.bus import FakeBus
from modelserver.server.clock import FakeClock
from modelserver.server.ingress import SensorChannel
from modelserver.server.journal import encoding
from modelserver.server.journal.writer import (
    INFORMATIVE_FACTS,
    NEWEST_NAME,
    SEGMENT_NAME,
    NewestMarker,
    collect_facts,
    find_key,
    get_number,
    list_segments,
    open_mapped,
    read_newest,
    seal_segment,
)
from modelserver.server.loop import Hooks, Loop, LoopSettings
from modelserver.server.requests import REQUEST_TYPES
from modelserver.server.vehicle import Vehicle
from modelserver.signing import Key
from modelserver.wire import journal
from modelserver.wire.channels import BY_NAME
from modelserver.wire.codec import decode, read_request_header
from modelserver.wire.eventlog import LogEvent, scan
from modelserver.wire.journal import JournalRecord, RecordKind

MAX_SEARCHED_ENTRIES: Final = 1000
"""Entries of a folder without segments that are searched for a journal."""


def files_of(path: Path) -> list[Path]:
    """Return the segments of a journal: those of a directory, or the one file.

    Raises RecordingError with a hint for anything else; OSError.
    """
    if not path.is_dir():
        _check_journal_file(path)
        return [path]
    found = list_segments(path)
    if not found:
        raise RecordingError(f"{path}: {_describe_missing_segments(path)}")
    return found


def _check_journal_file(path: Path) -> None:
    """Raise RecordingError for a file that is no segment. A damaged segment is one."""
    with open_mapped(path) as data:
        if not data:
            raise RecordingError(
                f"{path}: the file is empty, so there is nothing to verify; give the folder of the journal"
            )
        if data.find(journal.MAGIC) >= 0 or SEGMENT_NAME.fullmatch(path.name):
            return
        is_log = isinstance(next(iter(scan(data)), None), LogEvent)
    if is_log:
        raise RecordingError(
            f"{path}: is an LCM log, not a journal, so it has no output to verify; to play it: "
            f"modelserver replay {path} (without --verify)"
        )
    raise RecordingError(
        f"{path}: is neither a journal nor an LCM log; a journal is a folder of files journal-*.lcm, such as "
        "/var/lib/modelserver/journal-NAME"
    )


def _describe_missing_segments(folder: Path) -> str:
    """Return the message for a folder without segments, with a hint."""
    entries = sorted(islice(folder.iterdir(), MAX_SEARCHED_ENTRIES))
    if not entries:
        return "the folder is empty; a journal is a folder of files journal-*.lcm"
    for each in entries:
        try:
            if each.is_dir() and list_segments(each):
                return f"contains no segment of a journal (journal-*.lcm); did you mean {each}?"
        except OSError:
            continue  # not readable
    text = "contains no segment of a journal (journal-*.lcm)"
    if any(each.suffix == ".lcm" for each in entries):
        text += "; to play its LCM logs: modelserver replay LOG, without --verify"
    return text


TOLERANCE: Final = 1e-9
"""Meters, radians, and relative difference of other numbers."""


class FieldChange(NamedTuple):
    """A field that differs: its full name with indices, and both values."""

    name: str
    recorded: Any
    replayed: Any


class Deviation(NamedTuple):
    """Maximum differences in a message: meters, radians, and relative difference of other numbers."""

    meters: float = 0.0
    radians: float = 0.0
    share: float = 0.0

    @property
    def is_tolerable(self) -> bool:
        """Whether all differences are within the tolerance."""
        return max(self) <= TOLERANCE

    def elementwise_max(self, other: Deviation) -> Deviation:
        return Deviation(*map(max, self, other))


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


def compute_deviation(was: bytes, now: bytes) -> Deviation | None:
    """Return the maximum differences of two messages; None where more than numbers differ."""
    found = diff_messages(was, now)
    if not found:
        # not of one type, or different only in the bits of a nan
        return None
    total = Deviation()
    for change in found:
        if not (isinstance(change.recorded, float) and isinstance(change.replayed, float)):
            return None
        off = abs(change.recorded - change.replayed)
        if not math.isfinite(off):
            return None
        total = total.elementwise_max(_to_deviation(change, off))
    return total


def _to_deviation(change: FieldChange, off: float) -> Deviation:
    field, *indices = change.name.rpartition(".")[2].replace("]", "").split("[")
    place = int(indices[-1]) if indices else 0
    if field in ("vec", "vector", "vectors"):  # a position in meters, then a quaternion
        # a component changes by at most half the angle, in up to three components
        return Deviation(meters=off) if place < 3 else Deviation(radians=4.0 * off)
    if field == "position":
        return Deviation(meters=off)
    if field == "orientation":
        return Deviation(radians=4.0 * off)
    if field == "h_transform":
        return Deviation(meters=off) if place == 3 else Deviation(radians=2.0 * off)
    return Deviation(share=off / max(1.0, abs(change.recorded)))


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
            self._replay_event(encoding.decode_event(record.data), now)
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
    now = collect_facts()
    changed = [key for key in now if key not in INFORMATIVE_FACTS and then.get(key) != now[key]]
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
        if get_number(path) not in (None, number):
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
            key = find_key(name, self._keys)
        except RecordingError as error:
            self._report(f"cannot be verified: {error}", True)
            return
        if not hmac.compare_digest(seal_segment(key, end.digest), end.mac):
            self._report("its seal is wrong: it was not written with the key", True)
            return
        self.genuine += key is not None

    def skip(self, path: Path) -> None:
        """Skip a segment with an unreadable head, which counts as not closed."""
        self.unsealed.append(path)
        number = get_number(path)
        if self._before is not None and number is not None:
            self._before = _Link(path, number, "")

    def finish(self, newest: NewestMarker | None) -> None:
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
                self._report(f"the file {NEWEST_NAME} is older than {name}: restored", True)
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
        with open_mapped(path) as data:
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

    def _begin(self, state: journal.SegmentState, facts: dict[str, Any] | None) -> None:
        self.close()
        self._replay, self._at_ns = None, 0
        try:
            replay = ReplayLoop(state.data)
            if facts is not None and facts.get("history_s") is not None and len(history := replay.state.history):
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
            if report.difference is not None or self._replay is None:
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
    def _is_interleaved(record: JournalRecord) -> bool:
        """Return whether a record may come between outputs of one step: a publishing or persisting error."""
        if record.kind is not RecordKind.EVENT:
            return False
        try:
            return isinstance(encoding.decode_event(record.data), (Rejected, HealthWarning))
        except RecordingError:
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

    def _is_close(self, recorded: JournalRecord, replayed: PublishedMessage) -> bool:
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

    def _needs_history(self, record: JournalRecord) -> bool:
        """Return whether a reply may depend on poses before the restart of the replay."""
        replay = self._replay
        if replay is None or not len(replay.state.history) or replay.state.history.last >= self._held_until:
            return False
        if record.kind not in (
            RecordKind.REQUEST,
            RecordKind.CACHED,
            RecordKind.MALFORMED,
            RecordKind.OVERLOAD,
            RecordKind.FAILED,
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
