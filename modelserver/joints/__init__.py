"""History of the joints of a model: the received readings of every coordinate, each in a `JointTrack` (`track`), which
interpolates, holds or predicts them. Bounded, immutable. Pure.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Final, NamedTuple

from modelserver.errors import find_nearest_names, quote
from modelserver.geometry.joint import Joint, JointType, coordinate_names
from modelserver.geometry.model import Model
from modelserver.geometry.parts import Constraint
from modelserver.joints.track import JointTrack, ReadingValues
from modelserver.messages import NAN, JointSample, JointsSample, SensorHeader

MAX_CLOCK_LEAD_S: Final = 0.1
"""Largest lead of a driver's clock over this one. Later readings in the history precede a step of this clock backward.
"""

MAX_PLAUSIBLE: Final = 1e4
"""Radians or meters (per second); no joint of a vehicle reaches such a position or rate."""


MAX_SUGGESTIONS: Final = 4
"""Unknown joints of one message whose nearest name is searched: that takes 0.1 ms, and a message may have 1024."""

MIN_UTIME: Final = 10**15
"""In 2001; a smaller stamp is probably in seconds or milliseconds instead of microseconds."""


class Coordinate(NamedTuple):
    """What a name in JOINTS refers to: coordinate `number` of a joint."""

    name: str
    joint: Joint
    number: int

    @property
    def is_continuous(self) -> bool:
        """Whether it is an angle without limits, which may pass full turns."""
        joint, number = self.joint, self.number
        return (
            joint.type in (JointType.REVOLUTE, JointType.PLANAR)
            and joint.angle_flags[number]
            and not (joint.lower and math.isfinite(joint.lower[number]))
            and not (joint.upper and math.isfinite(joint.upper[number]))
        )

    @property
    def rate_limit(self) -> float:
        """The greatest rate, radians or meters per second; infinite where none is stated."""
        return self.joint.rate_limit[self.number] if self.joint.rate_limit else math.inf


class JointHistory:
    """The readings of all joints of a model for some seconds. Immutable: `update` returns the next state."""

    __slots__ = ("_coordinates", "_seconds", "tracks")

    # declared for the journal, which stores them
    _coordinates: Mapping[str, Coordinate]
    _seconds: float
    tracks: Mapping[str, JointTrack]

    def __init__(self, constraints: Iterable[Constraint], seconds: float):
        self._coordinates = MappingProxyType(
            {
                name: Coordinate(name, constraint.joint, number)
                for constraint in constraints
                if constraint.joint.mimic is None
                for number, name in enumerate(coordinate_names(constraint.name, constraint.joint))
            }
        )
        self._seconds = seconds
        self.tracks = MappingProxyType({})

    @property
    def names(self) -> tuple[str, ...]:
        """The coordinates that JOINTS can drive."""
        return tuple(self._coordinates)

    def coordinate(self, name: str) -> Coordinate:
        return self._coordinates[name]

    def update(self, sample: JointsSample, now: int) -> tuple[JointHistory, tuple[str, ...]]:
        """Return the history with a sample that was received at `now`, and why parts of it were rejected.

        A position of nan was not measured and is skipped. Of a name that occurs twice in a message the first counts.
        For more than `MAX_SUGGESTIONS` unknown names no nearest name is searched. A sample more than `MAX_CLOCK_LEAD_S`
        ahead is rejected ("future"), and one older than the history ("too_old"). Where the history itself is that far
        ahead, the clock was set back: those readings are dropped, so that two time scales do not mix.
        """
        if sample.header.utime > now + MAX_CLOCK_LEAD_S * 1e6:
            return self, ("future",)
        if sample.header.utime < now - self._seconds * 1e6:
            return self, ("stamped in seconds or milliseconds" if sample.header.utime < MIN_UTIME else "too_old",)
        rejected: list[str] = []
        seen: set[str] = set()
        tracks: dict[str, JointTrack] | None = None
        newest = now + MAX_CLOCK_LEAD_S * 1e6
        if any(track.last > newest for track in self.tracks.values()):
            tracks = {name: track for name, track in self.tracks.items() if track.last <= newest}
        for joint in sample.joints:
            if joint.position != joint.position:
                continue
            problem = self._find_problem(joint, with_suggestion=len(rejected) < MAX_SUGGESTIONS)
            if problem or joint.name in seen:
                rejected.append(problem or f"duplicate {joint.name}")
                continue
            seen.add(joint.name)
            track = self._get_track(joint.name, self.tracks if tracks is None else tracks)
            extended = track.insert(sample.header.utime, self._get_values(joint))
            if extended is track:
                # or it brings nothing new
                if track.is_too_old(sample.header.utime):
                    rejected.append("too_old")
                continue
            if sample.header.utime >= extended.last:
                extended.source = sample.header.source
            tracks = dict(self.tracks) if tracks is None else tracks
            tracks[joint.name] = extended
        return (self if tracks is None else self._replace_tracks(tracks)), tuple(rejected)

    def _replace_tracks(self, tracks: dict[str, JointTrack]) -> JointHistory:
        known = JointHistory.__new__(JointHistory)
        known._coordinates, known._seconds, known.tracks = self._coordinates, self._seconds, MappingProxyType(tracks)
        return known

    def _get_track(self, name: str, tracks: Mapping[str, JointTrack]) -> JointTrack:
        return tracks.get(name) or JointTrack(self._seconds, self._coordinates[name].is_continuous)

    def get_newest_samples(self, utime: int) -> list[JointsSample]:
        """Return the newest reading of every joint, as samples sent at `utime`: one for each instant."""
        found: dict[tuple[int, str], list[JointSample]] = {}
        for name, track in self.tracks.items():
            reading = track.newest
            joint = JointSample(name, reading.position, reading.sigma, reading.rate, reading.rate_sigma)
            found.setdefault((reading.utime, track.source), []).append(joint)
        return [
            JointsSample(SensorHeader(stamp, source, 0, utime), tuple(joints))
            for (stamp, source), joints in sorted(found.items())
        ]

    def restore(self, sample: JointsSample) -> JointHistory:
        """Return the history with readings of a persisted sample, of any age, where this one has nothing newer.

        Invalid readings are skipped.
        """
        utime = sample.header.utime
        tracks = dict(self.tracks)
        for joint in sample.joints:
            known = tracks.get(joint.name)
            is_older = known is not None and known.last >= utime
            if joint.position != joint.position or is_older or self._find_problem(joint):
                continue
            track = tracks[joint.name] = self._get_track(joint.name, tracks).insert(utime, self._get_values(joint))
            track.source = sample.header.source
        return self if tracks == self.tracks else self._replace_tracks(tracks)

    def _get_values(self, joint: JointSample) -> ReadingValues:
        """Return a measurement; a sigma that it does not state is that of the joint."""
        sigma, known = joint.position_sigma, self._coordinates[joint.name]
        if sigma != sigma:
            sigma = known.joint.sigma[known.number] if known.joint.sigma else NAN
        return joint.position, sigma, joint.rate, joint.rate_sigma

    def _find_problem(self, joint: JointSample, with_suggestion: bool = True) -> str:
        if joint.name not in self._coordinates:
            if not with_suggestion:
                return "unknown joint"
            near = find_nearest_names(joint.name, self._coordinates)
            return f"unknown joint {quote(joint.name, 60)}" + (f"; nearest {near[0]}" if near else "")
        if not abs(joint.position) < MAX_PLAUSIBLE:
            return f"implausible position of {joint.name}"
        # nan was not measured, and passes
        if joint.position_sigma < 0.0 or joint.position_sigma >= MAX_PLAUSIBLE:
            return f"invalid sigma of {joint.name}"
        if abs(joint.rate) >= MAX_PLAUSIBLE or joint.rate_sigma < 0.0 or joint.rate_sigma >= MAX_PLAUSIBLE:
            return f"invalid rate of {joint.name}"
        return ""

    def detach(self) -> JointHistory:
        """Return a copy whose lists no successor extends."""
        return self._replace_tracks({name: track.detach() for name, track in self.tracks.items()})

    def for_model(self, model: Model) -> JointHistory:
        """Return the history for another model, with the readings of the joints that have the same type there."""
        other = JointHistory(model.joints.values(), self._seconds)
        tracks = {}
        for name, track in self.tracks.items():
            new, old = other._coordinates.get(name), self._coordinates[name]
            if new is not None and (new.joint.type, new.number) == (old.joint.type, old.number):
                tracks[name] = track.with_continuous(new.is_continuous)
        return other._replace_tracks(tracks)


NO_JOINTS: Final = JointHistory((), 0.0)
