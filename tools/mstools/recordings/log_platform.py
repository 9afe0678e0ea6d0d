"""`Platform` queries answered from an LCM log alone: the knowledge of a client that received all its messages.

The log's POSE, JOINTS and MODEL_SNAPSHOT messages are fed to the client's `Knowledge` up to the instant of the query.
Reading stops once later samples cover the instant plus a correction window; delayed samples may change it until then.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final, NamedTuple

from modelserver.client.mirror import LocalPlatform
from modelserver.client.mirror_state import HISTORY_S, MirrorReceiver, MirrorState
from modelserver.errors import QueryError, RecordingError, WireError
from modelserver.formats.yaml_geometry import ModelSnapshot, decode_snapshot
from modelserver.geometry import names
from modelserver.geometry.model import Model
from modelserver.messages import Policy, PoseAnswer, SnapshotPart, TimeQuery
from modelserver.query.view import PlatformView
from modelserver.wire.codec import SnapshotAssembler, decode
from modelserver.wire.eventlog import LogEvent, LogFile
from mstools.recordings.drive import read_stamp
from mstools.terminal.output import guess_time_unit

CORRECTION_WINDOW_US: Final = 2_000_000
"""Time after an instant in which delayed samples may still change its pose."""

MAX_OUTSIDE_US: Final = 1_000_000
"""Time by which an instant may lie outside the log."""

OFFSET_PERIOD_US: Final = 5_000_000
"""Time between two stored offsets of poses."""

OFFSET_MARGIN_US: Final = 20_000_000
"""Time before a query's history from which a log is read: JOINTS_HELD and the geometry come every 5 s by default."""


class LogContents(NamedTuple):
    """Contents of a log: the first complete snapshot, and its time range in microseconds.

    `begin` and `end` are the first and last stamp of a pose, without poses of the joints, without these the times of
    receipt; `base_frame` and `revision` are those of the first pose; `parts` describes an incomplete snapshot.
    `offsets` has the stamp of a pose and its offset in the file about every `OFFSET_PERIOD_US`.
    """

    snapshot: ModelSnapshot | None
    begin: int
    end: int
    base_frame: str
    revision: str
    parts: str
    offsets: tuple[tuple[int, int], ...] = ()


class LogPlatform(LocalPlatform):
    """`Platform` on a log. `prefix` is that of the channels.

    `model` replaces the log's own geometry; its base frame is the log's, without poses its first one. `contents` are
    those of `scan_log`, if it was read already. Raises RecordingError where geometry is missing, OSError.
    """

    def __init__(self, path: Path, prefix: str = "", model: Model | None = None, contents: LogContents | None = None):
        self.where = f"in {path}"
        self._path = path
        self._prefix = prefix
        self._given: ModelSnapshot | None = None
        if contents is None:
            with LogFile(path) as log:
                contents = scan_log(log, prefix, with_geometry=model is None)
        self._contents = contents
        if model is not None:
            base = contents.base_frame or names.join(model.root.name, model.root.frames[0].name)
            self._given = ModelSnapshot("", model, base, base, HISTORY_S, f"{prefix}JOINTS")
        elif contents.snapshot is None:
            raise RecordingError(
                f"{path}: no complete geometry on {prefix}MODEL_SNAPSHOT ({contents.parts or 'none'}), which queries "
                "need. The service publishes it since version 0.1.0, at its start and every few seconds: record all "
                "its channels for some seconds (modelserver record FILE); for a channel prefix use --prefix. Or give "
                "the geometry with --model FILE"
            )
        self._read: tuple[MirrorState, int] = (MirrorState(), 0)

    @property
    def revision(self) -> str:
        """Geometry revision of the first pose, empty without poses."""
        return self._contents.revision

    @property
    def base_frame(self) -> str:
        """The frame whose pose the log has, without poses that of its geometry."""
        return self._contents.base_frame or (self._given.base_frame if self._given is not None else "")

    def read_state(self) -> tuple[MirrorState, int]:
        """Return what was known at the time that was read up to."""
        return self._read

    def parse_time(self, text: str) -> int | None:
        """Return the utime of a time like `+12.5`, seconds from the log's start; None for other texts."""
        if not text.startswith("+"):
            return None
        try:
            return self._contents.begin + round(float(text[1:]) * 1e6)
        except (ValueError, OverflowError):
            return None

    def _wait_until_ready(self, time: TimeQuery, *ends: str) -> tuple[MirrorState, PlatformView, int]:
        self.read_for(time.at, time.policy, ends)
        return super()._wait_until_ready(time._replace(wait_ms=0), *ends)

    def read_for(self, at: int, policy: Policy, ends: Sequence[str]) -> None:
        """Read the messages that a query at a time needs. Raises RecordingError for a time outside the log."""
        begin, end = self._contents.begin, self._contents.end
        if at and not begin - MAX_OUTSIDE_US <= at <= end + MAX_OUTSIDE_US:
            raise RecordingError(self._describe_outside(at, begin, end))
        snapshot = self._given or self._contents.snapshot
        knowledge = MirrorReceiver(self._prefix, snapshot, self._given is not None)
        channels = set(knowledge.channels)
        # messages on these channels may be of any age
        any_age = (f"{self._prefix}MODEL_SNAPSHOT", f"{self._prefix}JOINTS_HELD")
        history_us = round((HISTORY_S if snapshot is None else snapshot.history_s) * 1e6)
        oldest = (at or end) - history_us
        now = 0
        with LogFile(self._path) as log:
            earlier = [offset for stamp, offset in self._contents.offsets if stamp < oldest - OFFSET_MARGIN_US]
            for event in log.read_from(earlier[-1] if earlier else 0):
                if event.channel not in channels:
                    continue
                stamp = read_stamp(event.data)
                if event.channel not in any_age and stamp < oldest:
                    continue
                if at and policy is Policy.LATEST and stamp > at:
                    continue
                if at and stamp > at:
                    known = knowledge.state
                    if self._is_of_other_geometry(event, known) or self._is_complete(known, at, ends, history_us):
                        break
                now = event.utime
                knowledge.feed(event.channel, event.data, now)
                channels.update(knowledge.channels)
        self._read = (knowledge.state, now)

    def _is_of_other_geometry(self, event: LogEvent, known: MirrorState) -> bool:
        """Return whether a pose or snapshot is of another geometry: after a reload, or of a service started later."""
        if known.view is None or self._given is not None:
            return False
        try:
            if event.channel == f"{self._prefix}MODEL_SNAPSHOT":
                part: SnapshotPart = decode("model_snapshot_t", event.data)
                return part.model_revision != known.view.model.revision
            if event.channel == f"{self._prefix}POSE":
                answer: PoseAnswer = decode("pose_transform_t", event.data)
                return answer.transformation.model_revision not in ("", known.view.model.revision)
        except WireError:
            pass
        return False

    def _is_complete(self, known: MirrorState, at: int, ends: Sequence[str], history_us: int) -> bool:
        """Return whether later messages cannot change the result at a time."""
        view = known.view
        if view is None:
            return False
        newest = max([track.last for track in view.joints.tracks.values()], default=0)
        newest = max(newest, view.history.last if len(view.history) else 0)
        try:
            covered = view.is_covered(at + CORRECTION_WINDOW_US, *ends)
        except QueryError:
            covered = True
        return (covered and newest > at + CORRECTION_WINDOW_US) or newest > at + history_us // 2

    def _describe_outside(self, at: int, begin: int, end: int) -> str:
        away = f"{(begin - at) * 1e-6:.3f} s before" if at < begin else f"{(at - end) * 1e-6:.3f} s after"
        text = (
            f"{at} is {away} the log {self._path}, which extends from {begin} to {end}, in microseconds since 1970 "
            f"({(end - begin) * 1e-6:.1f} s)"
        )
        unit = guess_time_unit([at], begin, end)
        return f"{text}; this looks like {unit}" if unit else f"{text}; +SECONDS counts from its start"


def scan_log(log: Iterable[LogEvent], prefix: str, with_geometry: bool = True) -> LogContents:
    """Return the contents of a log; `with_geometry` includes the snapshot."""
    offsets: list[tuple[int, int]] = []
    first: PoseAnswer | None = None
    spans: dict[str, list[int]] = {}
    parts = ""
    snapshot: ModelSnapshot | None = None
    assembler, received = SnapshotAssembler(), set[tuple[str, int]]()
    poses, snapshots = f"{prefix}POSE", f"{prefix}MODEL_SNAPSHOT"

    # written out: an hour of log has two million events
    for event in log:
        for what, stamp in (("", event.utime), (event.channel, read_stamp(event.data))):
            span = spans.get(what)
            if span is None:
                spans[what] = [stamp, stamp]
            elif stamp > span[1]:
                span[1] = stamp
            elif stamp < span[0]:
                span[0] = stamp
        try:
            if event.channel == poses:
                first = first or decode("pose_transform_t", event.data)
                if not offsets or stamp - offsets[-1][0] >= OFFSET_PERIOD_US:
                    offsets.append((stamp, event.end))
            elif event.channel == snapshots:
                if not with_geometry or snapshot is not None:
                    continue
                part: SnapshotPart = decode("model_snapshot_t", event.data)
                received.add((part.model_revision, part.part))
                count = sum(revision == part.model_revision for revision, _ in received)
                parts = f"only {count} of {part.parts} parts of revision {part.model_revision}"
                whole = assembler.add(part)
                snapshot = None if whole is None else decode_snapshot(whole)
        except WireError:
            continue
    joints = f"{prefix}JOINTS" if snapshot is None else snapshot.joints_channel
    begin, end = spans.get(poses) or spans.get(joints) or spans.get("") or (0, 0)
    base_frame = revision = ""
    if first is not None:
        base_frame, revision = first.transformation.frame_of_interest, first.transformation.model_revision
    return LogContents(snapshot, begin, end, base_frame, revision, parts, tuple(offsets))
