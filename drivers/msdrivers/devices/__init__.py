"""Drivers of devices: each an `Endpoint` at the host's end of a line, with its protocol and settings in one module.

Protocols are parsers and encoders without clock, socket, file, thread or log.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import ClassVar

from modelserver.transforms.so3 import Quaternion


def check_ranges(settings: object, **ranges: tuple[float, float]) -> None:
    """Raise ValueError for the first attribute that is outside its range."""
    for key, (low, high) in ranges.items():
        value: float = getattr(settings, key)
        if not low <= value <= high:
            raise ValueError(f"{key} is between {low:g} and {high:g}, got {value:g}")


def check_choice(settings: object, **choices: Iterable[object]) -> None:
    """Raise ValueError for the first attribute that is none of its choices."""
    for key, known in choices.items():
        if (value := getattr(settings, key)) not in known:
            raise ValueError(f"{key} is one of {', '.join(map(str, filter(None, known)))}, got {value!r}")


class Strict:
    """Base of settings that pydantic reads without conversions and without further keys."""

    __slots__ = ()
    __pydantic_config__: ClassVar[dict[str, object]] = {"extra": "forbid", "strict": True, "allow_inf_nan": False}


def to_rotation(w: float, x: float, y: float, z: float) -> Quaternion | None:
    """Return a unit's own orientation, normalized; None for numbers that are no rotation."""
    norm = math.hypot(w, x, y, z)
    return (w / norm, x / norm, y / norm, z / norm) if abs(norm - 1.0) < 0.01 else None


def check_factor(value: float, key: str) -> None:
    """Raise ValueError for a factor that is 0 or not finite."""
    if not math.isfinite(value) or value == 0.0:
        raise ValueError(f"{key} is a number and not 0, got {value:g}")
