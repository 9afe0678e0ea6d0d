"""Where the joints were: the readings of every coordinate. Bounded, immutable to their holder. Pure."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Final, NamedTuple

from modelserver.errors import nearest_names, shown
from modelserver.geometry.joint import Joint, JointType, coordinate_names
from modelserver.geometry.model import Model
from modelserver.geometry.parts import Constraint
from modelserver.joints.reading import LONGEST_GAP_S, How, Reading
from modelserver.joints.track import MOST_READINGS, PREDICTION_LIMIT_S, JointTrack
from modelserver.messages import NAN, JointSample, JointsSample, SensorHeader

AHEAD_S: Final = 0.1
"""So far may a driver's clock be ahead of this one's. What is held of later was told before this was set back."""

ABSURD: Final = 1e4
"""Radians or metres, and a second; no joint of a vehicle stands there, nor moves so fast."""


MOST_EXPLAINED: Final = 4
"""Unknown joints of one message whose nearest name is searched: that takes 0.1 ms, and a message may have 1024."""

LEAST_UTIME: Final = 10**15
"""In 2001; a lesser stamp counts seconds or milliseconds, and is taken for microseconds by mistake."""


class Coordinate(NamedTuple):
    """What a name in JOINTS means: coordinate `number` of a joint."""

    name: str
    joint: Joint
    number: int

    @property
    def turns(self) -> bool:
        """Whether it is an angle without limits, which may go round and round."""
        joint, number = self.joint, self.number
        return (
            joint.type in (JointType.REVOLUTE, JointType.PLANAR)
            and joint.is_angle[number]
            and not (joint.lower and math.isfinite(joint.lower[number]))
            and not (joint.upper and math.isfinite(joint.upper[number]))
        )

    @property
    def rate_limit(self) -> float:
        """The greatest rate, radians or metres a second; infinite where none is stated."""
        return self.joint.rate_limit[self.number] if self.joint.rate_limit else math.inf


class Joints:
    """What is known of every joint of a model, for so many seconds. Immutable: `taken` returns what is known then."""

    __slots__ = ("_coordinates", "_seconds", "tracks")

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
        """Return what a name means. Raises KeyError."""
        return self._coordinates[name]

    def taken(self, sample: JointsSample, now: int) -> tuple[Joints, tuple[str, ...]]:
        """Return what is known with a sample more that came at `now`, and why what of it was refused, in words.

        What was not measured, nan, is passed over: nobody said anything. Of a name told twice in one message the
        first counts. Of more than `MOST_EXPLAINED` unknown names the nearest is not searched. A sample more than
        `AHEAD_S` ahead is refused, "future", one older than what is held, "late".
        Where what is held is as far ahead the clock was set back, and it is forgotten: two times are not mixed.
        """
        if sample.header.utime > now + AHEAD_S * 1e6:
            return self, ("future",)
        if sample.header.utime < now - self._seconds * 1e6:
            return self, ("stamped in seconds or milliseconds" if sample.header.utime < LEAST_UTIME else "late",)
        refused: list[str] = []
        seen: set[str] = set()
        tracks: dict[str, JointTrack] | None = None
        newest = now + AHEAD_S * 1e6
        if any(track.last > newest for track in self.tracks.values()):
            tracks = {name: track for name, track in self.tracks.items() if track.last <= newest}
        for joint in sample.joints:
            if joint.position != joint.position:
                continue
            why = self._fault(joint, in_words=len(refused) < MOST_EXPLAINED)
            if why:
                refused.append(why)
                continue
            if joint.name in seen:
                refused.append(f"{joint.name} twice")
                continue
            seen.add(joint.name)
            held = self.tracks if tracks is None else tracks
            track = held.get(joint.name)
            if track is None:
                track = JointTrack(self._seconds, self._coordinates[joint.name].turns)
            values = (joint.position, self._sigma(joint), joint.rate, joint.rate_sigma)
            longer = track.extended(sample.header.utime, values)
            if longer is track:
                # or it tells nothing new
                if track.is_late(sample.header.utime):
                    refused.append("late")
                continue
            if sample.header.utime >= longer.last:
                longer.source = sample.header.source
            tracks = dict(self.tracks) if tracks is None else tracks
            tracks[joint.name] = longer
        return (self if tracks is None else self._with(tracks)), tuple(refused)

    def _with(self, tracks: dict[str, JointTrack]) -> Joints:
        known = Joints.__new__(Joints)
        known._coordinates, known._seconds, known.tracks = self._coordinates, self._seconds, MappingProxyType(tracks)
        return known

    def newest(self, utime: int) -> list[JointsSample]:
        """Return the newest reading of every joint, as samples that were sent at `utime`: one for each instant."""
        found: dict[tuple[int, str], list[JointSample]] = {}
        for name, track in self.tracks.items():
            reading = track.newest
            joint = JointSample(name, reading.position, reading.sigma, reading.rate, reading.rate_sigma)
            found.setdefault((reading.utime, track.source), []).append(joint)
        return [
            JointsSample(SensorHeader(stamp, source, 0, utime), tuple(joints))
            for (stamp, source), joints in sorted(found.items())
        ]

    def recalled(self, sample: JointsSample) -> Joints:
        """Return what is known with what another one held: of any age, where nothing newer is known here.

        What of it cannot be is passed over.
        """
        utime = sample.header.utime
        tracks = dict(self.tracks)
        for joint in sample.joints:
            known = tracks.get(joint.name)
            if joint.position != joint.position or (known is not None and known.last >= utime) or self._fault(joint):
                continue
            track = known or JointTrack(self._seconds, self._coordinates[joint.name].turns)
            longer = track.extended(utime, (joint.position, self._sigma(joint), joint.rate, joint.rate_sigma))
            longer.source = sample.header.source
            tracks[joint.name] = longer
        return self._with(tracks) if any(track is not self.tracks.get(name) for name, track in tracks.items()) else self

    def _sigma(self, joint: JointSample) -> float:
        if joint.position_sigma == joint.position_sigma:
            return joint.position_sigma
        known = self._coordinates[joint.name]
        return known.joint.sigma[known.number] if known.joint.sigma else NAN

    def _fault(self, joint: JointSample, in_words: bool = True) -> str:
        if joint.name not in self._coordinates:
            if not in_words:
                return "unknown joint"
            near = nearest_names(joint.name, self._coordinates)
            return f"unknown joint {shown(joint.name, 60)}" + (f"; nearest {near[0]}" if near else "")
        if not abs(joint.position) < ABSURD:
            return f"absurd position of {joint.name}"
        # what is nan nobody measured, and passes
        if joint.position_sigma < 0.0 or joint.position_sigma >= ABSURD:
            return f"bad sigma of {joint.name}"
        if abs(joint.rate) >= ABSURD or joint.rate_sigma < 0.0 or joint.rate_sigma >= ABSURD:
            return f"bad rate of {joint.name}"
        return ""

    def apart(self) -> Joints:
        """Return the same knowledge in lists that no successor extends."""
        other = Joints.__new__(Joints)
        other._coordinates, other._seconds = self._coordinates, self._seconds
        other.tracks = MappingProxyType({name: track.apart() for name, track in self.tracks.items()})
        return other

    def for_model(self, model: Model) -> Joints:
        """Return what of this is known of the joints of another model: of those that are of the same type there."""
        other = Joints(model.joints.values(), self._seconds)
        tracks = {}
        for name, track in self.tracks.items():
            new, old = other._coordinates.get(name), self._coordinates[name]
            if new is not None and (new.joint.type, new.number) == (old.joint.type, old.number):
                tracks[name] = track.turning(new.turns)
        other.tracks = MappingProxyType(tracks)
        return other


NO_JOINTS: Final = Joints((), 0.0)

__all__ = [
    "ABSURD",
    "AHEAD_S",
    "LONGEST_GAP_S",
    "MOST_READINGS",
    "NO_JOINTS",
    "PREDICTION_LIMIT_S",
    "Coordinate",
    "How",
    "JointTrack",
    "Joints",
    "Reading",
]
