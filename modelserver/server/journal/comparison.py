"""Field-by-field comparison of two messages of one type: as recorded, and as replayed.

Another numpy or Python may sum in another order, so that the last bits of a float differ. Two messages are equal within
the tolerance if positions differ by at most 1e-9 m, orientations by 1e-9 rad, and other floats by 1e-9 of their
magnitude (absolute below 1). Counts, texts, flags and non-finite numbers have to be equal.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cache
from typing import Any, Final, NamedTuple

import mslcm

TOLERANCE: Final = 1e-9
"""Meters, radians, and relative difference of other numbers."""


class FieldChange(NamedTuple):
    """A field that differs: its full name with indices, and both values."""

    name: str
    recorded: Any
    replayed: Any


class Deviation(NamedTuple):
    """Maximum differences in a message: meters, radians, and relative difference of other numbers."""

    meters: float = 0.0
    radians: float = 0.0
    share: float = 0.0

    @property
    def is_tolerable(self) -> bool:
        """Whether all differences are within the tolerance."""
        return max(self) <= TOLERANCE

    def elementwise_max(self, other: Deviation) -> Deviation:
        return Deviation(*map(max, self, other))


@cache
def _types_by_fingerprint() -> dict[bytes, Any]:
    return {
        kind._get_packed_fingerprint(): kind
        for kind in vars(mslcm).values()
        if isinstance(kind, type) and hasattr(kind, "_get_packed_fingerprint")
    }


def diff_messages(was: bytes, now: bytes) -> list[FieldChange] | None:
    """Return the fields in which two messages differ; None where they are not of one known type."""
    message_type = _types_by_fingerprint().get(was[:8])
    if message_type is None or was[:8] != now[:8]:
        return None
    try:
        return list(_diff_fields("", message_type.decode(was), message_type.decode(now)))
    except Exception:  # the generated classes raise exceptions of many types
        return None


def _diff_fields(name: str, was: Any, now: Any) -> Iterator[FieldChange]:
    if hasattr(was, "_get_packed_fingerprint") and type(was) is type(now):
        for slot in was.__slots__:
            yield from _diff_fields(f"{name}.{slot}" if name else slot, getattr(was, slot), getattr(now, slot))
    elif isinstance(was, (list, tuple)) and isinstance(now, (list, tuple)) and len(was) == len(now):
        for index, pair in enumerate(zip(was, now, strict=True)):
            yield from _diff_fields(f"{name}[{index}]", *pair)
    elif repr(was) != repr(now):
        yield FieldChange(name, was, now)


def compute_deviation(was: bytes, now: bytes) -> Deviation | None:
    """Return the maximum differences of two messages; None where more than numbers differ."""
    found = diff_messages(was, now)
    if not found:
        # not of one type, or different only in the bits of a nan
        return None
    total = Deviation()
    for change in found:
        if not (isinstance(change.recorded, float) and isinstance(change.replayed, float)):
            return None
        off = abs(change.recorded - change.replayed)
        if not math.isfinite(off):
            return None
        total = total.elementwise_max(_to_deviation(change, off))
    return total


def _to_deviation(change: FieldChange, off: float) -> Deviation:
    field, *indices = change.name.rpartition(".")[2].replace("]", "").split("[")
    place = int(indices[-1]) if indices else 0
    if field in ("vec", "vector", "vectors"):  # a position in meters, then a quaternion
        # a component changes by at most half the angle, in up to three components
        return Deviation(meters=off) if place < 3 else Deviation(radians=4.0 * off)
    if field == "position":
        return Deviation(meters=off)
    if field == "orientation":
        return Deviation(radians=4.0 * off)
    if field == "h_transform":
        return Deviation(meters=off) if place == 3 else Deviation(radians=2.0 * off)
    return Deviation(share=off / max(1.0, abs(change.recorded)))
