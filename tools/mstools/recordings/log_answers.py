"""Answers from an LCM log alone: what one would know who had listened while it was recorded."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

from modelserver.client.knowledge import HISTORY_S, Knowledge, Known
from modelserver.client.local import LocalPlatform
from modelserver.errors import QueryError, RecordingError, WireError
from modelserver.formats.snapshot import ModelSnapshot, read
from modelserver.messages import Explanation, MotionAnswer, Policy, PoseAnswer, SnapshotPart
from modelserver.wire.codec import decode
from modelserver.wire.eventlog import LogEvent, LogFile
from modelserver.wire.snapshot import SnapshotAssembler

CORRECTED_US: Final = 2_000_000
"""So long after an instant what is told of it may still be bettered: by samples that come late."""

BEYOND_US: Final = 1_000_000
"""A time so far outside the log is none of it."""

UNITS: Final = (("seconds", 1_000_000.0), ("milliseconds", 1_000.0), ("nanoseconds", 0.001))
"""What a time may be in by mistake, and what makes microseconds of it."""


class Contents(NamedTuple):
    """What a log holds: the first whole snapshot, and from when to when; microseconds.

    `begin` and `end` are the first and the last stamp of a pose, where there is none of a snapshot; `base_frame` and
    `revision` are what the first pose says; `parts` tells of a snapshot that is not whole.
    """

    snapshot: ModelSnapshot | None
    begin: int
    end: int
    base_frame: str
    revision: str
    parts: str


class LogAnswers(LocalPlatform):
    """The questions of `Platform`, answered from a log. `prefix` is that of the channels.

    `model` is taken for the geometry instead of the log's own. Raises RecordingError that says what is
    missing, OSError.
    """

    def __init__(self, path: Path, prefix: str = "", model: ModelSnapshot | None = None):
        self.where = f"in {path}"
        self._path = path
        self._prefix = prefix
        self._given = model
        with LogFile(path) as log:
            self._contents = contents(log, prefix, wanted=model is None)
        if model is not None and self._contents.base_frame:
            base = self._contents.base_frame
            self._given = ModelSnapshot(model.vehicle, model.model, base, base, model.history_s, model.joints_channel)
        elif model is None and self._contents.snapshot is None:
            raise RecordingError(self._no_geometry())
        self._read: tuple[Known, int] = (Known(), 0)

    def _no_geometry(self) -> str:
        channel = f"{self._prefix}MODEL_SNAPSHOT"
        found = f"only {self._contents.parts}" if self._contents.parts else "none"
        return (
            f"{self._path}: no whole geometry on {channel} ({found}), and without it poses say nothing of frames. The "
            "service sends it since version 0.1.0, at its start and every few seconds: record all its channels for "
            "some seconds (lcm-logger FILE); with a channel prefix, say --prefix. Or give the geometry: --model FILE"
        )

    @property
    def revision(self) -> str:
        """The revision of the geometry that the first pose rests on, empty where there is none."""
        return self._contents.revision

    def known(self) -> tuple[Known, int]:
        """Return what was known at the time that was read up to."""
        return self._read

    def time(self, text: str) -> int | None:
        """Return the utime of a time like `+12.5`, seconds from the log's start; None where the text is none."""
        if not text.startswith("+"):
            return None
        try:
            return self._contents.begin + round(float(text[1:]) * 1e6)
        except (ValueError, OverflowError):
            return None

    def get_pose(
        self,
        frame_of_interest: str,
        frame_of_reference: str,
        *,
        at: int = 0,
        policy: Policy = Policy.INTERPOLATED,
        wait_ms: int = 0,
    ) -> PoseAnswer:
        """Return where one frame is in another; `at` 0 is the latest in the log, with LATEST that as of `at`."""
        self.read_for(at, policy, (frame_of_interest, frame_of_reference))
        return super().get_pose(frame_of_interest, frame_of_reference, at=at, policy=policy)

    def get_motion(
        self,
        frame_of_interest: str,
        frame_of_reference: str,
        *,
        expressed_in: str = "",
        at: int = 0,
        policy: Policy = Policy.INTERPOLATED,
        wait_ms: int = 0,
    ) -> MotionAnswer:
        """Return how one frame moves in another; as `get_pose`."""
        self.read_for(at, policy, (frame_of_interest, frame_of_reference))
        return super().get_motion(
            frame_of_interest, frame_of_reference, expressed_in=expressed_in, at=at, policy=policy
        )

    def explain(
        self,
        frame_of_interest: str,
        frame_of_reference: str,
        *,
        at: int = 0,
        policy: Policy = Policy.INTERPOLATED,
        wait_ms: int = 0,
    ) -> Explanation:
        """Return where one frame is in another and what that rests on; as `get_pose`."""
        self.read_for(at, policy, (frame_of_interest, frame_of_reference))
        return super().explain(frame_of_interest, frame_of_reference, at=at, policy=policy)

    def read_for(self, at: int, policy: Policy, ends: Sequence[str]) -> None:
        """Read what an answer at a time rests on. Raises RecordingError for a time outside the log."""
        begin, end = self._contents.begin, self._contents.end
        if at and not begin - BEYOND_US <= at <= end + BEYOND_US:
            raise RecordingError(self._outside(at, begin, end))
        snapshot = self._given or self._contents.snapshot
        knowledge = Knowledge(self._prefix, snapshot, self._given is not None)
        channels = set(knowledge.channels)
        # what these tell of may be of any age
        ageless = (f"{self._prefix}MODEL_SNAPSHOT", f"{self._prefix}JOINTS_HELD")
        history_us = round((HISTORY_S if snapshot is None else snapshot.history_s) * 1e6)
        oldest = (at or end) - history_us
        now = 0
        with LogFile(self._path) as log:
            for event in log:
                if event.channel not in channels:
                    continue
                stamp = _stamp(event)
                if event.channel not in ageless and stamp < oldest:
                    continue
                if at and policy is Policy.LATEST and stamp > at:
                    continue
                if at and stamp > at and self._is_enough(knowledge.known, at, ends, history_us):
                    break
                now = event.utime
                knowledge.feed(event.channel, event.data, now)
                channels.update(knowledge.channels)
        self._read = (knowledge.known, now)

    def _is_enough(self, known: Known, at: int, ends: Sequence[str], history_us: int) -> bool:
        """Whether no more need be read for an answer at a time."""
        view = known.view
        if view is None:
            return False
        newest = max([track.last for track in view.joints.tracks.values()], default=0)
        newest = max(newest, view.history.last if len(view.history) else 0)
        try:
            covered = view.covers(at + CORRECTED_US, *ends)
        except QueryError:
            covered = True
        return (covered and newest > at + CORRECTED_US) or newest > at + history_us // 2

    def _outside(self, at: int, begin: int, end: int) -> str:
        away = f"{(begin - at) * 1e-6:.3f} s before" if at < begin else f"{(at - end) * 1e-6:.3f} s after"
        text = (
            f"{at} is {away} the log {self._path}, which lasts from {begin} to {end}, in microseconds since 1970 "
            f"({(end - begin) * 1e-6:.1f} s)"
        )
        for unit, factor in UNITS:
            if begin <= at * factor <= end + BEYOND_US:
                return f"{text}; this looks like {unit}"
        return f"{text}; +SECONDS counts from its start"


def _stamp(event: LogEvent) -> int:
    """Return the stamp of a pose, a snapshot's part or joints, 0 for what is too short: it follows the fingerprint."""
    return int.from_bytes(event.data[8:16], "big", signed=True) if len(event.data) >= 16 else 0


def contents(log: LogFile, prefix: str, wanted: bool = True) -> Contents:
    """Return what a log holds; with `wanted` the geometry too."""
    first: PoseAnswer | None = None
    poses: list[int] = []
    sent: list[int] = []
    parts = ""
    snapshot: ModelSnapshot | None = None
    assembler, heard = SnapshotAssembler(), set[tuple[str, int]]()
    for event in log:
        try:
            if event.channel == f"{prefix}POSE":
                first = first or decode("pose_transform_t", event.data)
                _widen(poses, _stamp(event))
            elif event.channel == f"{prefix}MODEL_SNAPSHOT":
                _widen(sent, _stamp(event))
                if not wanted or snapshot is not None:
                    continue
                part: SnapshotPart = decode("model_snapshot_t", event.data)
                heard.add((part.model_revision, part.part))
                count = sum(revision == part.model_revision for revision, _ in heard)
                parts = f"{count} of {part.parts} parts of revision {part.model_revision}"
                whole = assembler.add(part)
                snapshot = None if whole is None else read(whole)
        except WireError:
            continue
    begin, end = poses or sent or [0, 0]
    told = None if first is None else first.transformation
    base_frame, revision = ("", "") if told is None else (told.frame_of_interest, told.model_revision)
    return Contents(snapshot, begin, end, base_frame, revision, parts)


def _widen(span: list[int], stamp: int) -> None:
    """Have a span, empty or of two, hold a stamp too."""
    span[:] = [min(span[0], stamp), max(span[1], stamp)] if span else [stamp, stamp]
