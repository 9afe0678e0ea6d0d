"""A journal verified: every record is run again, and what is sent is compared with what was sent, bit for bit.

Where another build or machine sums in another order, messages may be the same to within `comparison.TOLERANCE`; that is
a result of its own. Whether the segments are whole, in order and genuine is checked by `chain`.

A run is the life of one service: its segments follow each other, and each is gone on into with what is known from the
one before. Where that is missing (the ring has dropped it, records were lost, bytes are damaged) the run is taken up
again with the state that the next segment begins with.

That state holds the last seconds of the history of poses only. Until as much is known again as then, a reply about the
past may rest on poses that are gone: where such a reply differs it is counted as `old`, and as no difference.
"""

from __future__ import annotations

import mmap
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from pathlib import Path
from typing import Any, Final

from modelserver.errors import RecordingError, WireError
from modelserver.messages import GetHistory, GetTransformations, Noticed, Rejected
from modelserver.regular_files import open_regular
from modelserver.service.journal import build as journal_build
from modelserver.service.journal import state as journal_state
from modelserver.service.journal.chain import NEWEST_NAME, Chain, ChainFinding, read_newest
from modelserver.service.journal.comparison import Deviation, deviation
from modelserver.service.journal.rerun import Rerun, Said
from modelserver.signing import Key
from modelserver.wire.channels import BY_NAME
from modelserver.wire.codec import decode
from modelserver.wire.journal import FORMAT, Broken, End, Head, JournalRecord, RecordKind, State, read

POSES: Final = ("POSE", "POSE_VECTOR", "POSE_ODOM")


class VerificationResult(IntEnum):
    """What a verification found; the value is the exit code of `modelserver replay --verify`.

    REPRODUCED ends with 0 where no key is given: then nobody asks for more.
    """

    AUTHENTIC = 0
    """All is reproduced bit for bit, and the key proves that it is genuine and whole."""
    DIFFERS = 1
    """Something is not reproduced, damaged, missing or not genuine."""
    REPRODUCED = 3
    """All is reproduced bit for bit; nothing proves that it is genuine."""
    CLOSE = 4
    """All is reproduced, some of it only to within the tolerance."""


@dataclass(frozen=True, slots=True)
class Difference:
    """The first thing that was not said again as it was: where, what was said, and what is said now (None: nothing)."""

    segment: Path
    at: int
    utime: int
    channel: str
    was: bytes | None
    now: bytes | None


@dataclass(frozen=True, slots=True)
class Remark:
    """Something that is to be known of a place in the journal. `damage`: bytes are wrong that were right once."""

    segment: Path
    text: str
    damage: bool = False

    def __str__(self) -> str:
        return f"{self.segment}: {self.text}"


@dataclass(slots=True)
class Verified:
    """What was found. `said` counts the messages that were said again, bit for bit, by channel without prefix.

    skipped: messages that were said where it is not known from what. old: see the module. difference: the first.
    seconds: how long of it was run again, of the span from first_utime to last_utime.
    other: what is other with build or machine than it was then, in words. close: messages that are the same to within
    the tolerance, by channel; largest: their largest difference, with the channel. genuine: segments whose keyed seal
    is right. unsealed: segments whose seal proves nothing. complete: whether it is known that none is missing at the
    end.
    """

    segments: int = 0
    runs: int = 0
    handled: int = 0
    said: Counter[str] = field(default_factory=Counter)
    skipped: Counter[str] = field(default_factory=Counter)
    old: int = 0
    lost: int = 0
    first_utime: int = 0
    last_utime: int = 0
    bytes: int = 0
    seconds: float = 0.0
    remarks: list[Remark] = field(default_factory=list)
    other: list[str] = field(default_factory=list)
    difference: Difference | None = None
    close: Counter[str] = field(default_factory=Counter)
    largest: Deviation = field(default_factory=Deviation)
    largest_at: tuple[str, str] = ("", "")
    """Channels of the largest difference of a position, and of an orientation."""
    genuine: int = 0
    unsealed: int = 0
    complete: bool = False

    @property
    def poses(self) -> int:
        """The poses that are reproduced."""
        return sum(self.said[name] for name in POSES)

    @property
    def proved(self) -> bool:
        """Whether something was verified, all of it holds, bit for bit or nearly, and nothing is damaged or missing."""
        something = bool(self.said) or bool(self.close)
        return something and self.difference is None and not any(each.damage for each in self.remarks)

    @property
    def authentic(self) -> bool:
        """Whether the key proves that all of it was written by the service, and that nothing is missing at the end."""
        return self.proved and self.complete and 0 < self.segments == self.genuine and not self.unsealed

    @property
    def result(self) -> VerificationResult:
        """What was found, in a word."""
        if not self.proved:
            return VerificationResult.DIFFERS
        if self.close:
            return VerificationResult.CLOSE
        return VerificationResult.AUTHENTIC if self.authentic else VerificationResult.REPRODUCED


@dataclass(slots=True)
class _Group:
    """What was handled at a time, with everything that was said to it, then and now."""

    segment: Path
    record: JournalRecord
    now: list[Said]
    was: list[JournalRecord] = field(default_factory=list)


def verify(
    files: Sequence[Path],
    show: Callable[[int], object] = lambda done: None,
    keys: Sequence[Key] = (),
    directory: Path | None = None,
) -> Verified:
    """Run a journal again up to the first difference. `show` is called with how many bytes are done.

    `keys`: the vehicle's, to prove that it is genuine. `directory`: whose segments the files are, all of them; None:
    they are looked at by themselves.
    Raises RecordingError for a file that is no journal, OSError where one cannot be read.
    """
    verifier = _Verifier(show, keys)
    for path in files:
        verifier.segment(path)
        if verifier.found.difference is not None:
            break
    verifier.close()
    verifier.finish(directory)
    return verifier.found


class _Verifier:
    def __init__(self, show: Callable[[int], object], keys: Sequence[Key] = ()):
        self.found = Verified()
        self._chain = Chain(keys)
        self._keys = keys
        self._show = show
        self._rerun: Rerun | None = None
        self._group: _Group | None = None
        self._follows: tuple[str, int] | None = None
        """Run and number of the segment that would go on from here."""
        self._held_until = 0
        """When as much is known again as when a state was written, by the sensors' time."""
        self._at_ns = 0
        self._path = Path()
        self._run = ""
        self._ended = False

    def segment(self, path: Path) -> None:
        """Verify a segment more."""
        self._path, self._ended, going_on = path, False, False
        end: End | None = None
        found, before = self.found, self.found.bytes
        facts: dict[str, Any] | None = None
        with open_regular(path) as file:
            size = file.seek(0, 2)
            data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) if size else b""
        try:
            for item in read(data):
                if found.difference is not None:
                    return
                if isinstance(item, JournalRecord):
                    if found.handled % 512 == 0:
                        self._show(before + item.at)
                    self._take(item)
                elif isinstance(item, Head):
                    facts = item.facts
                    going_on = self._headed(facts)
                elif isinstance(item, State):
                    if not going_on:
                        self._begin(item, facts)
                elif isinstance(item, Broken):
                    self._broken(item)
                elif isinstance(item, End):
                    self._ended, end = True, item
                    if not item.intact:
                        self._remark("the checksum over the whole segment is wrong", damage=True)
        finally:
            found.bytes = before + size
            if not isinstance(data, bytes):
                data.close()
        if facts is None:
            if size == 0 or any(each.segment == path for each in found.remarks):
                self._stop()
                self._chain.skip(path)
                if size == 0:
                    self._remark("is empty: the machine stopped as it was made")
                return
            raise RecordingError(f"{path}: is no journal of a modelserver")
        found.segments += 1
        self._remark_all(self._chain.end(facts, end))
        if not self._ended:
            if not any(each.segment == path for each in found.remarks):
                self._remark("is not closed: it is being written, or process or machine were stopped")
            self.close()
            self._rerun = self._follows = None

    def _headed(self, facts: dict[str, Any]) -> bool:
        """Take note of who wrote a segment; return whether it goes on from the one before."""
        run, part, lost = str(facts.get("run")), facts.get("part"), facts.get("lost")
        numbers = (part, lost, facts.get("number"), facts.get("run_number"))
        if facts.get("format") != FORMAT or not all(type(each) is int for each in numbers):
            raise RecordingError(
                f"{self._path}: is a journal of format {facts.get('format')}, this build reads {FORMAT}; "
                "take the build that wrote it"
            )
        assert isinstance(part, int)
        assert isinstance(lost, int)
        self._remark_all(self._chain.begin(self._path, facts))
        for each in journal_build.differences(facts):
            if each not in self.found.other:
                self.found.other.append(each)
        if run != self._run:
            self._run = run
            self.found.runs += 1
        going_on = self._rerun is not None and self._follows == (run, part) and not lost
        if not going_on:
            self.close()
            self._rerun = None
        self._follows = (run, part + 1)
        if lost:
            self.found.lost += lost
            self._remark(f"{lost} records before it are lost: the disk refused them, or was too slow")
        return going_on

    def _begin(self, state: State, facts: dict[str, Any] | None) -> None:
        self.close()
        self._rerun, self._at_ns = None, 0
        try:
            self._rerun = rerun = Rerun(state.data)
        except Exception as error:
            self._remark(f"cannot be run again: {error}", damage=True)
            return
        if facts is not None and facts.get("kept_s") is not None:
            history = rerun.state.history
            if len(history):
                self._held_until = history.last + round(rerun.state.settings.history_s * 1e6)

    def _take(self, record: JournalRecord) -> None:
        found, rerun = self.found, self._rerun
        found.first_utime = found.first_utime or record.utime
        found.last_utime = record.utime
        if rerun is None:
            if record.kind is RecordKind.SAID:
                found.skipped[record.channel] += 1
            return
        if record.kind is RecordKind.SAID:
            if self._group is None:
                self._group = _Group(self._path, record, [])
            self._group.was.append(record)
            return
        found.handled += 1
        if self._at_ns:
            found.seconds += max(record.monotonic_ns - self._at_ns, 0) * 1e-9
        self._at_ns = record.monotonic_ns
        if self._group is not None and not self._is_refusal(record):
            self._compare()
            if found.difference is not None:
                return
        try:
            said = rerun.handle(record)
        except Exception as error:
            # a state that was made up may hold what no service ever had
            self._remark(f"at byte {record.at}: {error}", damage=True)
            self._stop()
            return
        if self._group is None:
            self._group = _Group(self._path, record, said)
        else:
            self._group.now += said

    @staticmethod
    def _is_refusal(record: JournalRecord) -> bool:
        """Return whether it may stand between two things that are said at once: one could not be sent, or kept."""
        if record.kind is not RecordKind.EVENT:
            return False
        try:
            return isinstance(journal_state.decode_event(record.data), (Rejected, Noticed))
        except RecordingError:
            return False

    def _compare(self) -> None:
        group, self._group = self._group, None
        assert group is not None
        assert self._rerun is not None
        found = self.found
        prefix, replies = self._rerun.config.lcm.channel_prefix, self._rerun.config.lcm.reply_prefix
        if [(each.channel, each.data) for each in group.was] == group.now:
            for each in group.was:
                found.said["replies" if each.channel.startswith(replies) else each.channel.removeprefix(prefix)] += 1
            return
        old = self._asks_for_the_past(group.record)
        for was, now in _paired(group.was, group.now):
            if was is not None and now == (was.channel, was.data):
                found.said["replies" if was.channel.startswith(replies) else was.channel.removeprefix(prefix)] += 1
                continue
            if was is not None and now is not None and self._is_close(was, now):
                found.close["replies" if was.channel.startswith(replies) else was.channel.removeprefix(prefix)] += 1
                continue
            channel = was.channel if was is not None else now[0] if now is not None else ""
            if old and channel.startswith(replies):
                found.old += was is not None
                continue
            found.difference = Difference(
                group.segment,
                group.record.at if was is None else was.at,
                group.record.utime,
                channel,
                None if was is None else was.data,
                None if now is None else now[1],
            )
            return

    def _is_close(self, was: JournalRecord, now: Said) -> bool:
        """Return whether a message is the same to within the tolerance, and take note of how near it is."""
        found = self.found
        off = deviation(was.data, now[1]) if now[0] == was.channel else None
        if off is None or not off.is_tolerable:
            return False
        meters, radians = found.largest_at
        found.largest_at = (
            was.channel if off.meters > found.largest.meters else meters,
            was.channel if off.radians > found.largest.radians else radians,
        )
        found.largest = found.largest.largest(off)
        return True

    def _asks_for_the_past(self, record: JournalRecord) -> bool:
        """Return whether a reply to a record may rest on poses that the state no longer held, when it was taken up."""
        rerun = self._rerun
        if rerun is None or not len(rerun.state.history) or rerun.state.history.last >= self._held_until:
            return False
        if record.kind not in (
            RecordKind.REQUEST,
            RecordKind.REMEMBERED,
            RecordKind.MALFORMED,
            RecordKind.REFUSED,
            RecordKind.FAILED,
        ):
            # one that waited is answered later
            return True
        channel = BY_NAME.get(record.channel.removeprefix(rerun.config.lcm.channel_prefix))
        try:
            request = None if channel is None else decode(channel.type_name, record.data)
        except WireError:
            return False
        if isinstance(request, (GetHistory, GetTransformations)):
            return True
        return bool(getattr(getattr(request, "time", None), "at", 0))

    def _broken(self, broken: Broken) -> None:
        if broken.tail:
            self._remark(
                f"breaks off at byte {broken.start}: the last {broken.length} bytes are not sealed and not used "
                "(it is being written, or process or machine were stopped)"
            )
        else:
            self._remark(f"{broken}; what follows is verified from the next segment on", damage=True)
        self._stop()

    def _stop(self) -> None:
        """Compare what is there; what comes then does not follow from what is known."""
        if self._group is not None:
            # the batch that is missing may hold the rest of what was said to it
            self._group.now = self._group.now[: len(self._group.was)]
        self.close()
        self._rerun = self._follows = None

    def close(self) -> None:
        """Compare what was said last, as far as that was written."""
        if self._group is not None and self._rerun is not None and self.found.difference is None:
            if not self._ended:
                self._group.now = self._group.now[: len(self._group.was)]
            self._compare()
        self._group = None

    def finish(self, directory: Path | None) -> None:
        """Check that nothing is missing at the end, as far as that can be known."""
        found = self.found
        found.genuine, found.unsealed = self._chain.genuine, len(self._chain.unsealed)
        found.complete = directory is None
        if directory is None or found.difference is not None:
            return
        try:
            newest = read_newest(directory, self._keys)
        except RecordingError as error:
            self._remark(str(error), damage=True)
            return
        findings = self._chain.finish(newest)
        self._remark_all(findings)
        found.complete = newest is not None
        if newest is None:
            self._remark(f"the file {NEWEST_NAME} is not there, so nobody knows whether segments after it are missing")

    def _remark_all(self, findings: Iterable[ChainFinding]) -> None:
        for each in findings:
            self._remark(each.text, each.damage)

    def _remark(self, text: str, damage: bool = False) -> None:
        self.found.remarks.append(Remark(self._path, text, damage))


def _paired(was: Sequence[JournalRecord], now: Sequence[Said]) -> Iterator[tuple[JournalRecord | None, Said | None]]:
    for number in range(max(len(was), len(now))):
        yield was[number] if number < len(was) else None, now[number] if number < len(now) else None
