"""What an emulated inertial unit feels at an instant, from samples in the order of their stamps."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

from modelserver.messages import ImuSample, OrientationReference
from modelserver.spatial import so3
from modelserver.spatial.so3 import Quaternion, Vector3

_ZERO: Vector3 = (0.0, 0.0, 0.0)
_NED_FROM_ENU: Quaternion = (0.0, 0.5**0.5, 0.5**0.5, 0.0)
"""Half a turn about the line between east and north."""


class SensedState(NamedTuple):
    """What is felt, along the sensor's axes in SI units; the orientation in north, east, down."""

    rate: Vector3
    force: Vector3
    field: Vector3
    orientation: Quaternion


class Samples:
    """Samples by their stamps: linear between two of them; before the first as the first, after the last nothing.

    What a sample does not say is taken for zero, and its orientation for level and north.
    """

    __slots__ = ("_after", "_before", "_rest")

    def __init__(self, samples: Iterable[ImuSample]):
        """Take the samples, whose stamps rise."""
        self._rest: Iterator[ImuSample] = iter(samples)
        self._before: tuple[int, SensedState] | None = None
        self._after = self._next()

    def at(self, utime: int) -> SensedState | None:
        """Return what is felt at an instant; None after the last sample. Instants may not go back."""
        while self._after is not None and self._after[0] <= utime:
            self._before, self._after = self._after, self._next()
        if self._after is None:
            return self._before[1] if self._before is not None and self._before[0] == utime else None
        if self._before is None:
            return self._after[1]
        (begin, a), (end, b) = self._before, self._after
        return _between(a, b, (utime - begin) / (end - begin)) if utime > begin else a

    def _next(self) -> tuple[int, SensedState] | None:
        sample = next(self._rest, None)
        return None if sample is None else (sample.header.utime, _felt(sample))


def _felt(sample: ImuSample) -> SensedState:
    orientation = so3.IDENTITY if sample.orientation is None else sample.orientation
    if sample.orientation_reference is OrientationReference.ENU:
        orientation = so3.normalized(so3.multiply(_NED_FROM_ENU, orientation))
    return SensedState(
        sample.angular_velocity or _ZERO, sample.specific_force or _ZERO, sample.magnetic_field or _ZERO, orientation
    )


def _between(a: SensedState, b: SensedState, share: float) -> SensedState:
    return SensedState(
        _mixed(a.rate, b.rate, share),
        _mixed(a.force, b.force, share),
        _mixed(a.field, b.field, share),
        so3.slerp(a.orientation, b.orientation, share),
    )


def _mixed(a: Vector3, b: Vector3, share: float) -> Vector3:
    return (a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1]), a[2] + share * (b[2] - a[2]))
