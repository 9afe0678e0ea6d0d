"""Rotation vectors of ball joints by time: their three coordinates are one orientation, and are interpolated as one.

Between two orientations it turns at a constant rate about one axis. Its rotation vector v, and how v changes, are those
nearest to the readings: v and v + 2 pi k v/|v| are one orientation. With the left Jacobian J of SO(3) the angular
velocity is w = J(v) v' (Sola, "Quaternion kinematics", 2017, eq. 183). Pure.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from modelserver.geometry.joint import JointType, left_jacobian
from modelserver.joints.reading import How, Pair, Reading
from modelserver.joints.track import LEAST_SPAN_S, Around, JointTrack
from modelserver.spatial import arrays, so3
from modelserver.spatial.so3 import Array, Vector3

VECTORS: Final = (JointType.SPHERICAL, JointType.FLOATING)
"""The types whose last three coordinates are a rotation vector."""

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
    def of(cls, pairs: Sequence[Pair | None]) -> _Ends | None:
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
    def turn(self) -> Vector3:
        """The rotation vector from the first orientation to the second."""
        q = so3.multiply(so3.exponential(self.v1), so3.conjugate(so3.exponential(self.v0)))
        return so3.logarithm(so3.normalized(q))

    @property
    def slope(self) -> Array:
        """The angular velocity between the two; nan where they are too near for one."""
        return np.array(self.turn if self.span >= LEAST_SPAN_S else _UNKNOWN) / self.span


def together(
    tracks: Sequence[JointTrack | None], readings: tuple[Reading, ...], rate_limits: Sequence[float]
) -> tuple[Reading, ...]:
    """Return the readings of a rotation vector's three coordinates, put right from what each tells by itself.

    Where their readings are not of the same instants each stays as it is; so does what is held.
    """
    x, y, z = tracks
    how = readings[0].how
    if x is None or y is None or z is None or how is How.HELD or any(each.how is not how for each in readings):
        return readings
    utime = readings[0].utime
    if how is How.PREDICTED:
        return _predicted((x, y, z), utime, rate_limits, readings)
    ends = _Ends.of((x.pair(utime), y.pair(utime), z.pair(utime)))
    if ends is None:
        return readings
    told0, told1 = left_jacobian(ends.v0) @ ends.rate0, left_jacobian(ends.v1) @ ends.rate1
    change = (told1 - told0) / ends.span if ends.span >= LEAST_SPAN_S else np.array(_UNKNOWN)
    v = _vector([each.position for each in readings])
    if how is How.MEASURED:
        told = np.array([each.rate for each in readings])
        is_told = not np.isnan(told).any()
        w = left_jacobian(v) @ told if is_told else ends.slope
    else:
        pair = x.pair(utime)
        part = (utime - pair.t0) / (pair.t1 - pair.t0) if pair is not None else 0.0
        a, b, c = ends.turn
        turned = so3.multiply(so3.exponential((a * part, b * part, c * part)), so3.exponential(ends.v0))
        v = nearest(so3.logarithm(so3.normalized(turned)), ends.v0 if part < 0.5 else ends.v1)
        w = told0 + (told1 - told0) * part
        if np.isnan(w).any():
            w = ends.slope
    rate, second = _rates(v, w, change)
    if how is How.MEASURED and is_told:
        rate = told
    return tuple(
        [each._replace(position=v[n], rate=float(rate[n]), change=float(second[n])) for n, each in enumerate(readings)]
    )


def _predicted(
    tracks: tuple[JointTrack, JointTrack, JointTrack],
    utime: int,
    rate_limits: Sequence[float],
    readings: tuple[Reading, ...],
) -> tuple[Reading, ...]:
    if not tracks[0].last == tracks[1].last == tracks[2].last:
        return readings
    v1 = _vector([track.newest.position for track in tracks])
    ends = _Ends.of([track.last_pair() for track in tracks])
    if ends is not None:
        slopes, _ = _rates(v1, ends.slope, np.array(_UNKNOWN))
        readings = tuple(
            [
                track.predicted(utime, limit, float(slope))
                for track, limit, slope in zip(tracks, rate_limits, slopes, strict=True)
            ]
        )
    w = left_jacobian(v1) @ [each.rate for each in readings]
    ahead = readings[0].apart
    turned = so3.multiply(so3.exponential(_vector(w * ahead)), so3.exponential(v1))
    v = nearest(so3.logarithm(so3.normalized(turned)), v1)
    rate, _ = _rates(v, w, np.array(_UNKNOWN))
    return tuple([each._replace(position=v[n], rate=float(rate[n])) for n, each in enumerate(readings)])


def _rates(v: Vector3, w: Array, change: Array) -> tuple[Array, Array]:
    """Return v' and v'' of an angular velocity and its change; nan near whole turns, where v tells no axis but one."""
    J = left_jacobian(v)
    if abs(np.linalg.det(J)) < 1e-6:
        return np.array(_UNKNOWN), np.array(_UNKNOWN)
    rate = np.asarray(np.linalg.solve(J, w), dtype=float)
    ahead, behind = left_jacobian(_vector(v + _STEP * rate)), left_jacobian(_vector(v - _STEP * rate))
    return rate, np.asarray(np.linalg.solve(J, change - (ahead - behind) @ rate / (2.0 * _STEP)), dtype=float)


def nearest(v: Vector3, other: Vector3) -> Vector3:
    """Return the rotation vector of the same orientation as `v` that is nearest to another."""
    angle = math.hypot(*v)
    axis = v
    if angle < 1e-9:
        # any axis will do
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


def columns(
    tracks: tuple[JointTrack, JointTrack, JointTrack], utimes: npt.NDArray[np.int64]
) -> tuple[Array, Array, Array]:
    """Return positions, sigmas and how far apart the readings are, (n, 3) each, at times within what is held.

    As `together` tells them one by one.
    """
    if not len(utimes):
        return np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 3))
    arounds = [track.around(utimes) for track in tracks]
    each = [track.columns_of(around) for track, around in zip(tracks, arounds, strict=True)]
    positions, sigmas, apart = (np.stack(some, axis=1) for some in zip(*each, strict=True))
    turned = _turned(arounds)
    first = arounds[0]
    same = np.all([(other.t0 == first.t0) & (other.t1 == first.t1) for other in arounds[1:]], axis=0)
    between = same & (first.part > 0.0)
    return np.where(between[:, None], turned, positions), sigmas, apart


def _turned(arounds: Sequence[Around]) -> Array:
    """Return the rotation vectors (n, 3) between readings that are of the same instants."""
    part = arounds[0].part
    low = np.stack([around.low[:, 0] for around in arounds], axis=1)
    high = np.stack([around.high[:, 0] for around in arounds], axis=1)
    q = arrays.slerped(arrays.exponentials(low), arrays.exponentials(high), part)
    q = np.where(q[:, :1] < 0.0, -q, q)
    other = np.where(part[:, None] < 0.5, low, high)
    sines = np.linalg.norm(q[:, 1:], axis=1)
    angles = 2.0 * np.arctan2(sines, q[:, 0])
    none = angles < 1e-9
    lengths = np.where(none, np.linalg.norm(other, axis=1), sines)
    axes = np.where(none[:, None], other, q[:, 1:]) / np.where(lengths < 1e-12, 1.0, lengths)[:, None]
    angles = np.where(none, 0.0, angles)
    turns = np.round((np.einsum("ij,ij->i", axes, other) - angles) / math.tau)
    return np.asarray(axes * (angles + math.tau * turns)[:, None])


def _vector(values: Sequence[float] | Array) -> Vector3:
    x, y, z = values
    return (float(x), float(y), float(z))
