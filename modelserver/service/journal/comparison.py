"""Two messages of one type compared, field by field: what was sent, and what a run again sends.

Another numpy or Python may sum in another order, so that the last bits of a float differ. Such a message is the same to
within a tolerance: positions 1e-9 m, orientations 1e-9 rad, all other numbers 1e-9 of themselves, or 1e-9 where they
are below 1. Counts, texts, flags and what is not a number have to be equal.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cache
from typing import Any, Final, NamedTuple

import mslcm

TOLERANCE: Final = 1e-9
"""Meters, radians, and share of any other number."""

_VECTORS: Final = ("vec", "vector", "vectors")
"""Fields of three meters and a quaternion."""

_POSITIONS: Final = ("position",)
_ORIENTATIONS: Final = ("orientation",)
_MATRICES: Final = ("h_transform",)


class Change(NamedTuple):
    """A field that differs: its full name with indices, and both values."""

    name: str
    was: Any
    now: Any


class Deviation(NamedTuple):
    """The largest differences within a message: meters, radians, and share of other numbers."""

    meters: float = 0.0
    radians: float = 0.0
    share: float = 0.0

    @property
    def is_tolerable(self) -> bool:
        """Whether all of it is within the tolerance."""
        return max(self) <= TOLERANCE

    def largest(self, other: Deviation) -> Deviation:
        """Return the larger of each."""
        return Deviation(*map(max, self, other))


@cache
def _kinds() -> dict[bytes, Any]:
    return {
        kind._get_packed_fingerprint(): kind
        for kind in vars(mslcm).values()
        if isinstance(kind, type) and hasattr(kind, "_get_packed_fingerprint")
    }


def changes(was: bytes, now: bytes) -> list[Change] | None:
    """Return the fields in which two messages differ; None where they are not of one type that can be read."""
    kind = _kinds().get(was[:8])
    if kind is None or was[:8] != now[:8]:
        return None
    try:
        return list(_changes("", kind.decode(was), kind.decode(now)))
    except Exception:  # the generated classes raise whatever they run into
        return None


def _changes(name: str, was: Any, now: Any) -> Iterator[Change]:
    if hasattr(was, "_get_packed_fingerprint") and type(was) is type(now):
        for slot in was.__slots__:
            yield from _changes(f"{name}.{slot}" if name else slot, getattr(was, slot), getattr(now, slot))
    elif isinstance(was, (list, tuple)) and isinstance(now, (list, tuple)) and len(was) == len(now):
        for index, pair in enumerate(zip(was, now, strict=True)):
            yield from _changes(f"{name}[{index}]", *pair)
    elif repr(was) != repr(now):
        yield Change(name, was, now)


def deviation(was: bytes, now: bytes) -> Deviation | None:
    """Return by how much two messages differ; None where more than numbers differ."""
    found = changes(was, now)
    if not found:
        # not of one type, or equal in all but the bits of a nan
        return None
    total = Deviation()
    for change in found:
        if not (isinstance(change.was, float) and isinstance(change.now, float)):
            return None
        off = abs(change.was - change.now)
        if not math.isfinite(off):
            return None
        total = total.largest(_measured(change, off))
    return total


def _measured(change: Change, off: float) -> Deviation:
    field, *indices = change.name.rpartition(".")[2].replace("]", "").split("[")
    place = int(indices[-1]) if indices else 0
    if field in _VECTORS:
        # a quaternion's component changes by half the angle at most; three of them may
        return Deviation(meters=off) if place < 3 else Deviation(radians=4.0 * off)
    if field in _POSITIONS:
        return Deviation(meters=off)
    if field in _ORIENTATIONS:
        return Deviation(radians=4.0 * off)
    if field in _MATRICES:
        return Deviation(meters=off) if place == 3 else Deviation(radians=2.0 * off)
    return Deviation(share=off / max(1.0, abs(change.was)))
