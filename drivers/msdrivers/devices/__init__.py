"""Drivers of devices: each an `Endpoint` at the host's end of a line, with its protocol and settings in one module.

Protocols are parsers and encoders without clock, socket, file, thread or log.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, ClassVar

from modelserver.messages import OrientationReference, YawSource


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


def make_orientation(
    quaternion: Sequence[float] | None, reference: OrientationReference, yaw_source: YawSource
) -> dict[str, Any]:
    """Return a sample's fields of a unit's own orientation, scalar first; none for numbers that are no rotation."""
    norm = math.hypot(*(quaternion or ()))
    if quaternion is None or not abs(norm - 1.0) < 0.01:
        return {}
    orientation = tuple(each / norm for each in quaternion)
    return {"orientation": orientation, "orientation_reference": reference, "yaw_source": yaw_source}


def check_factor(value: float, key: str) -> None:
    """Raise ValueError for a factor that is 0 or not finite."""
    if not math.isfinite(value) or value == 0.0:
        raise ValueError(f"{key} is a number and not 0, got {value:g}")


def check_signal(signal: str, key: str = "signal") -> None:
    """Raise ValueError unless the text is a signal path."""
    message, dot, name = signal.partition(".")
    if not (message and dot and name) or "." in name:
        raise ValueError(f"{key} is written Message.Signal as the DBC file names them, got {signal!r}")
