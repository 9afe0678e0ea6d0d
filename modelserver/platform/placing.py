"""Where the joints of a route stand at a time."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from modelserver.errors import TooNewError, TooOldError
from modelserver.geometry.drives import JointDrive
from modelserver.geometry.joint import Coordinates
from modelserver.geometry.model import Model
from modelserver.geometry.route import Route
from modelserver.joints.joints import AHEAD_S, LONGEST_GAP_S, How, Joints, JointTrack, Reading
from modelserver.joints.vector import VECTORS, together
from modelserver.messages import NAN, NO_FLAGS, VALID, Invalid, Policy, Quality

_FLAG_OF: Mapping[How, int] = {
    How.MEASURED: 0,
    How.INTERPOLATED: Quality.INTERPOLATED.value,
    How.HELD: Quality.HELD.value,
    How.PREDICTED: Quality.PREDICTED.value,
    How.AT_REST: Quality.AT_REST.value,
}

# looked up once: the member of an enumeration costs more than the arithmetic around it
_AT_REST, _BEYOND = How.AT_REST, Quality.OUT_OF_LIMITS.value
_UNKNOWN, _STALE = Invalid.JOINT_UNKNOWN.value, Invalid.STALE_JOINT.value


class Placed(NamedTuple):
    """The joints of a route at an instant: a reading for each coordinate of each leg, and what to know of them all."""

    positions: tuple[Coordinates, ...]
    readings: tuple[tuple[Reading, ...], ...]
    invalid: Invalid = VALID
    quality: Quality = NO_FLAGS

    @property
    def sigmas(self) -> list[Coordinates]:
        """The sigmas of the coordinates, nan where nobody told."""
        return [tuple([reading.sigma for reading in leg]) for leg in self.readings]

    @property
    def rates(self) -> list[Coordinates]:
        """The rates of the coordinates, nan where nobody told."""
        return [tuple([reading.rate for reading in leg]) for leg in self.readings]


NOTHING = Placed((), ())
"""The joints of a route that has none."""


def heard(route: Route, model: Model, joints: Joints) -> list[tuple[str, JointTrack]]:
    """Return the tracks of what drives a route's joints, by name, of those that were ever heard."""
    tracks = joints.tracks
    found = []
    for leg in route.legs:
        for name in model.drives[leg.name].names:
            track = tracks.get(name)
            if track is not None:
                found.append((name, track))
    return found


def placed(route: Route, model: Model, joints: Joints, utime: int, policy: Policy, now: int = 0) -> Placed:
    """Return where the joints of a route stand at a time. Raises TooOldError, TooNewError, naming the joint.

    `now`, where it is given, is when it is asked for the latest: a joint that is silent since long is no good then.
    Nor is one whose newest reading is of the future: the clock was set back, and it was not heard since.
    """
    if not route.legs:
        return NOTHING
    invalid = quality = 0
    positions, readings = [], []
    drives, tracks = model.drives, joints.tracks
    # a policy is looked at once, and a track that may be interpolated is asked without a detour: it is nearly always so
    plainly = policy is not Policy.HELD and policy is not Policy.PREDICTED
    for leg in route.legs:
        drive = drives[leg.name]
        # one by one where there is but one, which is nearly always
        if len(drive.names) == 1:
            (name,) = drive.names
            found: tuple[Reading, ...]
            track = tracks.get(name) if plainly else None
            try:
                found = () if track is None else (track.interpolated(utime),)
            except (TooOldError, TooNewError):
                found = ()
            if not found:
                found = (_reading(name, drive, model, joints, utime, policy),)
        else:
            found = tuple([_reading(name, drive, model, joints, utime, policy) for name in drive.names])
            if leg.joint.type in VECTORS:
                found = _as_one(found, drive.names, joints)
        if drive.leader != leg.name:
            found = tuple([_following(each, drive) for each in found])
        for each in found:
            how = each.how
            if how is _AT_REST:
                if not model.joints[drive.leader].joint.default:
                    invalid |= _UNKNOWN
            elif each.apart > LONGEST_GAP_S or (now and not -AHEAD_S <= (now - each.stamp) * 1e-6 <= LONGEST_GAP_S):
                invalid |= _STALE
            quality |= _FLAG_OF[how]
        position: Coordinates
        if leg.span is not None:
            low, high = leg.span
            position = (found[0].position,)
            beyond = not low <= position[0] <= high
        else:
            position = tuple([each.position for each in found])
            beyond = leg.joint.out_of_limits(position)
        if beyond:
            quality |= _BEYOND
        positions.append(position)
        readings.append(found)
    return Placed(
        tuple(positions),
        tuple(readings),
        Invalid(invalid) if invalid else VALID,
        Quality(quality) if quality else NO_FLAGS,
    )


def _reading(name: str, drive: JointDrive, model: Model, joints: Joints, utime: int, policy: Policy) -> Reading:
    track = joints.tracks.get(name)
    if track is None:
        leader = model.joints[drive.leader].joint
        number = drive.names.index(name)
        sigma = leader.sigma[number] if leader.sigma else NAN
        return Reading(utime, leader.rest[number], sigma, 0.0, 0.0, How.AT_REST)
    try:
        if policy is Policy.HELD:
            return track.held(utime)
        if policy is Policy.PREDICTED and utime > track.last:
            return track.predicted(utime, joints.coordinate(name).rate_limit)
        return track.interpolated(utime)
    except (TooOldError, TooNewError) as error:
        raise type(error)(f"joint {name}: {error}") from None


def _as_one(found: tuple[Reading, ...], names: tuple[str, ...], joints: Joints) -> tuple[Reading, ...]:
    """Return the readings of a joint whose last three coordinates are a rotation vector, those put together."""
    tracks = [joints.tracks.get(name) for name in names[-3:]]
    limits = [joints.coordinate(name).rate_limit for name in names[-3:]]
    return (*found[:-3], *together(tracks, found[-3:], limits))


def _following(reading: Reading, drive: JointDrive) -> Reading:
    """Return the reading of a joint that follows the one read: its sigmas have the multiplier's sign, as errors do."""
    factor = drive.multiplier
    return reading._replace(
        position=factor * reading.position + drive.offset,
        sigma=factor * reading.sigma,
        rate=factor * reading.rate,
        rate_sigma=factor * reading.rate_sigma,
    )
