"""Positions of the joints of a path at a time, from their readings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from modelserver.errors import TooNewError, TooOldError
from modelserver.geometry.joint import Coordinates
from modelserver.geometry.kinematic_path import KinematicPath
from modelserver.geometry.model import Model
from modelserver.geometry.parts import JointDrive
from modelserver.joints.history import MAX_CLOCK_LEAD_S, JointHistory
from modelserver.joints.track import MAX_GAP_S, ROTATION_VECTOR_TYPES, JointTrack, Provenance, Reading, combine
from modelserver.messages import NAN, NO_FLAGS, VALID, Invalid, Policy, Quality

_QUALITY_OF: Mapping[Provenance, int] = {
    Provenance.MEASURED: 0,
    Provenance.INTERPOLATED: Quality.INTERPOLATED.value,
    Provenance.HELD: Quality.HELD.value,
    Provenance.PREDICTED: Quality.PREDICTED.value,
    Provenance.DEFAULT: Quality.JOINT_DEFAULT.value,
}

# looked up once: accessing an enumeration member costs more than the arithmetic around it
_DEFAULT, _OUT_OF_LIMITS = Provenance.DEFAULT, Quality.OUT_OF_LIMITS.value
_UNKNOWN, _STALE = Invalid.JOINT_UNKNOWN.value, Invalid.STALE_JOINT.value


class JointReadings(NamedTuple):
    """The joints of a path at an instant: a reading for each coordinate, and reasons and flags for them all."""

    positions: tuple[Coordinates, ...]
    readings: tuple[tuple[Reading, ...], ...]
    invalid: Invalid = VALID
    quality: Quality = NO_FLAGS

    @property
    def sigmas(self) -> list[Coordinates]:
        """The sigmas of the coordinates, nan where unknown."""
        return [tuple([reading.sigma for reading in joint]) for joint in self.readings]


NO_READINGS = JointReadings((), ())
"""The joints of a path that has none."""


def find_tracks(path: KinematicPath, model: Model, joints: JointHistory) -> list[tuple[str, JointTrack]]:
    """Return the tracks of a path's joints or their leaders, by name, of those that were ever received."""
    tracks = joints.tracks
    found = []
    for item in path.joints:
        for name in model.drives[item.name].names:
            track = tracks.get(name)
            if track is not None:
                found.append((name, track))
    return found


def lookup_joints(
    path: KinematicPath, model: Model, joints: JointHistory, utime: int, policy: Policy, now: int = 0
) -> JointReadings:
    """Return the positions of the joints of a path at a time. Raises TooOldError, TooNewError, naming the joint.

    `now`, where given, is when the latest is queried: a joint that timed out is then stale, and so is one whose newest
    reading is in the future, from before the clock was set back.
    """
    if not path.joints:
        return NO_READINGS
    invalid = quality = 0
    positions, readings = [], []
    drives, tracks = model.drives, joints.tracks
    # fast path: interpolation of a joint with one coordinate, nearly always the case
    interpolates = policy is not Policy.HELD and policy is not Policy.PREDICTED
    for item in path.joints:
        drive = drives[item.name]

        if len(drive.names) == 1:
            (name,) = drive.names
            found: tuple[Reading, ...]
            track = tracks.get(name) if interpolates else None
            try:
                found = () if track is None else (track.interpolate(utime),)
            except (TooOldError, TooNewError):
                found = ()
            if not found:
                found = (_reading(name, drive, model, joints, utime, policy),)
        else:
            found = tuple([_reading(name, drive, model, joints, utime, policy) for name in drive.names])
            if item.joint.type in ROTATION_VECTOR_TYPES:
                found = _combine_rotation_vector(found, drive.names, joints)
        if drive.leader != item.name:
            found = tuple([_apply_mimic(each, drive) for each in found])
        for each in found:
            how = each.provenance
            if how is _DEFAULT:
                if not model.joints[drive.leader].joint.default:
                    invalid |= _UNKNOWN
            elif each.gap > MAX_GAP_S or (now and not -MAX_CLOCK_LEAD_S <= (now - each.stamp) * 1e-6 <= MAX_GAP_S):
                invalid |= _STALE
            quality |= _QUALITY_OF[how]
        position: Coordinates
        if item.limits is not None:
            low, high = item.limits
            position = (found[0].position,)
            beyond = not low <= position[0] <= high
        else:
            position = tuple([each.position for each in found])
            beyond = item.joint.is_out_of_limits(position)
        if beyond:
            quality |= _OUT_OF_LIMITS
        positions.append(position)
        readings.append(found)
    return JointReadings(
        tuple(positions),
        tuple(readings),
        Invalid(invalid) if invalid else VALID,
        Quality(quality) if quality else NO_FLAGS,
    )


def _reading(name: str, drive: JointDrive, model: Model, joints: JointHistory, utime: int, policy: Policy) -> Reading:
    track = joints.tracks.get(name)
    if track is None:
        leader = model.joints[drive.leader].joint
        number = drive.names.index(name)
        sigma = leader.sigma[number] if leader.sigma else NAN
        return Reading(utime, leader.default_position[number], sigma, 0.0, 0.0, Provenance.DEFAULT)
    try:
        if policy is Policy.HELD:
            return track.hold(utime)
        if policy is Policy.PREDICTED and utime > track.last:
            return track.predict(utime, joints.coordinate(name).rate_limit)
        return track.interpolate(utime)
    except (TooOldError, TooNewError) as error:
        raise type(error)(f"joint {name}: {error}") from None


def _combine_rotation_vector(
    found: tuple[Reading, ...], names: tuple[str, ...], joints: JointHistory
) -> tuple[Reading, ...]:
    """Return the readings of a joint whose last three coordinates are a rotation vector, interpolated as one."""
    tracks = [joints.tracks.get(name) for name in names[-3:]]
    limits = [joints.coordinate(name).rate_limit for name in names[-3:]]
    return (*found[:-3], *combine(tracks, found[-3:], limits))


def _apply_mimic(reading: Reading, drive: JointDrive) -> Reading:
    """Return the reading of a mimic joint from its leader's; sigmas have the multiplier's sign, as the errors do."""
    factor = drive.multiplier
    return reading._replace(
        position=factor * reading.position + drive.offset,
        sigma=factor * reading.sigma,
        rate=factor * reading.rate,
        rate_sigma=factor * reading.rate_sigma,
    )
