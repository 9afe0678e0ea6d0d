"""Rotation vectors of ball joints by time: three coordinates that are one orientation, and are interpolated as one.

Between two readings the orientation turns at a constant rate about one axis (slerp). v and v + 2 pi k v/|v| are the
same orientation: the result is the rotation vector nearest to the readings. With the left Jacobian J of SO(3) the
angular velocity is w = J(v) v' (Sola, "Quaternion kinematics", 2017, eq. 183); v' and v'' are computed from w and its
change, with J differenced along v'. Assumption: the three coordinates have readings of the same instants; otherwise
each is interpolated by itself. Pure.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from modelserver.geometry.joint import JointType
from modelserver.joints.track import MIN_SPAN_S, JointTrack, Provenance, Reading, ReadingBrackets, ReadingPair
from modelserver.transforms import pose_array, so3
from modelserver.transforms.so3 import Array, Vector3

ROTATION_VECTOR_TYPES: Final = (JointType.SPHERICAL, JointType.FLOATING)
"""The joint types whose last three coordinates are a rotation vector."""

_STEP: Final = 1e-4
"""Seconds over which the Jacobian is differenced."""

_UNKNOWN: Final[Vector3] = (math.nan, math.nan, math.nan)


class _Ends(NamedTuple):
    """A rotation vector and its rate at two instants, and the seconds between."""

    v0: Vector3
    rate0: Vector3
    v1: Vector3
    rate1: Vector3
    span: float

    @classmethod
    def of(cls, pairs: Sequence[ReadingPair | None]) -> _Ends | None:
        """Return them from the readings of the three coordinates; None where their times differ, or there are none."""
        x, y, z = pairs
        if x is None or y is None or z is None or not (x.t0 == y.t0 == z.t0 and x.t1 == y.t1 == z.t1):
            return None
        return cls(
            (x.low[0], y.low[0], z.low[0]),
            (x.low[2], y.low[2], z.low[2]),
            (x.high[0], y.high[0], z.high[0]),
            (x.high[2], y.high[2], z.high[2]),
            x.span,
        )

    @property
    def rotation(self) -> Vector3:
        """The rotation vector from the first orientation to the second."""
        q = so3.multiply(so3.exponential(self.v1), so3.conjugate(so3.exponential(self.v0)))
        return so3.logarithm(so3.normalize(q))

    @property
    def angular_velocity(self) -> Array:
        """The angular velocity between the two; nan where they are too near for one."""
        return np.array(self.rotation if self.span >= MIN_SPAN_S else _UNKNOWN) / self.span


def combine(
    tracks: Sequence[JointTrack | None], readings: tuple[Reading, ...], rate_limits: Sequence[float]
) -> tuple[Reading, ...]:
    """Return the readings of a rotation vector's three coordinates, corrected from those of the single coordinates.

    Unchanged where the readings are of different instants or held.
    """
    x, y, z = tracks
    provenance = readings[0].provenance
    if (
        x is None
        or y is None
        or z is None
        or provenance is Provenance.HELD
        or any(each.provenance is not provenance for each in readings)
    ):
        return readings
    utime = readings[0].utime
    if provenance is Provenance.PREDICTED:
        return _predict((x, y, z), utime, rate_limits, readings)
    ends = _Ends.of((x.find_pair(utime), y.find_pair(utime), z.find_pair(utime)))
    if ends is None:
        return readings
    w0, w1 = so3.left_jacobian(ends.v0) @ ends.rate0, so3.left_jacobian(ends.v1) @ ends.rate1
    change = (w1 - w0) / ends.span if ends.span >= MIN_SPAN_S else np.array(_UNKNOWN)
    v = so3.to_vector3([each.position for each in readings])
    if provenance is Provenance.MEASURED:
        rates = np.array([each.rate for each in readings])
        has_rates = not np.isnan(rates).any()
        w = so3.left_jacobian(v) @ rates if has_rates else ends.angular_velocity
    else:
        pair = x.find_pair(utime)
        fraction = (utime - pair.t0) / (pair.t1 - pair.t0) if pair is not None else 0.0
        a, b, c = ends.rotation
        turned = so3.multiply(so3.exponential((a * fraction, b * fraction, c * fraction)), so3.exponential(ends.v0))
        v = find_nearest_equivalent(so3.logarithm(so3.normalize(turned)), ends.v0 if fraction < 0.5 else ends.v1)
        w = w0 + (w1 - w0) * fraction
        if np.isnan(w).any():
            w = ends.angular_velocity
    rate, second = _to_vector_rates(v, w, change)
    if provenance is Provenance.MEASURED and has_rates:
        rate = rates
    return tuple(
        [
            each._replace(position=v[n], rate=float(rate[n]), acceleration=float(second[n]))
            for n, each in enumerate(readings)
        ]
    )


def _predict(
    tracks: tuple[JointTrack, JointTrack, JointTrack],
    utime: int,
    rate_limits: Sequence[float],
    readings: tuple[Reading, ...],
) -> tuple[Reading, ...]:
    if not tracks[0].last == tracks[1].last == tracks[2].last:
        return readings
    v1 = so3.to_vector3([track.newest.position for track in tracks])
    ends = _Ends.of([track.find_last_pair() for track in tracks])
    if ends is not None:
        slopes, _ = _to_vector_rates(v1, ends.angular_velocity, np.array(_UNKNOWN))
        readings = tuple(
            [
                track.predict(utime, limit, float(slope))
                for track, limit, slope in zip(tracks, rate_limits, slopes, strict=True)
            ]
        )
    w = so3.left_jacobian(v1) @ [each.rate for each in readings]
    dt = readings[0].gap
    turned = so3.multiply(so3.exponential(so3.to_vector3(w * dt)), so3.exponential(v1))
    v = find_nearest_equivalent(so3.logarithm(so3.normalize(turned)), v1)
    rate, _ = _to_vector_rates(v, w, np.array(_UNKNOWN))
    return tuple([each._replace(position=v[n], rate=float(rate[n])) for n, each in enumerate(readings)])


def _to_vector_rates(v: Vector3, w: Array, change: Array) -> tuple[Array, Array]:
    """Return v' and v'' from an angular velocity and its change; nan near full turns, where J is singular."""
    J = so3.left_jacobian(v)
    if abs(np.linalg.det(J)) < 1e-6:
        return np.array(_UNKNOWN), np.array(_UNKNOWN)
    rate = np.asarray(np.linalg.solve(J, w), dtype=float)
    after, before = (
        so3.left_jacobian(so3.to_vector3(v + _STEP * rate)),
        so3.left_jacobian(so3.to_vector3(v - _STEP * rate)),
    )
    return rate, np.asarray(np.linalg.solve(J, change - (after - before) @ rate / (2.0 * _STEP)), dtype=float)


def find_nearest_equivalent(v: Vector3, other: Vector3) -> Vector3:
    """Return the rotation vector of the same orientation as `v` that is nearest to another."""
    angle = math.hypot(*v)
    axis = v
    if angle < 1e-9:
        # any axis is valid
        angle, axis = 0.0, other
    length = math.hypot(*axis)
    if length < 1e-9:
        return v
    x, y, z = axis[0] / length, axis[1] / length, axis[2] / length
    turns = round((x * other[0] + y * other[1] + z * other[2] - angle) / math.tau)
    if not turns:
        return v
    angle += math.tau * turns
    return (x * angle, y * angle, z * angle)


def interpolate_batch(
    tracks: tuple[JointTrack, JointTrack, JointTrack], utimes: npt.NDArray[np.int64]
) -> tuple[Array, Array, Array]:
    """Return positions, sigmas and gaps between readings, (n, 3) each, at times within the time covered.

    As `combine` for each time.
    """
    if not len(utimes):
        return np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 3))
    brackets = [track.bracket(utimes) for track in tracks]
    each = [track.interpolate_brackets(bracket) for track, bracket in zip(tracks, brackets, strict=True)]
    positions, sigmas, gaps = (np.stack(some, axis=1) for some in zip(*each, strict=True))
    turned = _slerp_brackets(brackets)
    first = brackets[0]
    same = np.all([(other.t0 == first.t0) & (other.t1 == first.t1) for other in brackets[1:]], axis=0)
    between = same & (first.fraction > 0.0)
    return np.where(between[:, None], turned, positions), sigmas, gaps


def _slerp_brackets(brackets: Sequence[ReadingBrackets]) -> Array:
    """Return the rotation vectors (n, 3) between readings of the same instants."""
    fraction = brackets[0].fraction
    low = np.stack([bracket.low[:, 0] for bracket in brackets], axis=1)
    high = np.stack([bracket.high[:, 0] for bracket in brackets], axis=1)
    q = pose_array.slerp(pose_array.exponential(low), pose_array.exponential(high), fraction)
    q = np.where(q[:, :1] < 0.0, -q, q)
    other = np.where(fraction[:, None] < 0.5, low, high)
    sines = np.linalg.norm(q[:, 1:], axis=1)
    angles = 2.0 * np.arctan2(sines, q[:, 0])
    none = angles < 1e-9
    lengths = np.where(none, np.linalg.norm(other, axis=1), sines)
    axes = np.where(none[:, None], other, q[:, 1:]) / np.where(lengths < 1e-12, 1.0, lengths)[:, None]
    angles = np.where(none, 0.0, angles)
    turns = np.round((np.einsum("ij,ij->i", axes, other) - angles) / math.tau)
    return np.asarray(axes * (angles + math.tau * turns)[:, None])
