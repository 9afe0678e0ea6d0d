"""Stretches of samples without a gap: what an Allan deviation may be taken over."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from modelserver.localization.calibration.errors import CalibrationError

GAP_PERIODS = 5.0
"""A step of more periods than this between stamps is a gap. Serial lines deliver unevenly and lose single samples;
five in a row are an interruption."""


@dataclass(frozen=True, slots=True)
class Stretch:
    """Samples `start` to before `stop`, `seconds` long by their stamps."""

    start: int
    stop: int
    seconds: float

    @property
    def rate_hz(self) -> float:
        """Mean sampling rate; 0 for less than two samples or no time."""
        return (self.stop - self.start - 1) / self.seconds if self.seconds > 0.0 else 0.0


def period(utimes: npt.ArrayLike) -> float:
    """Return the usual step between stamps, seconds: the median, so that gaps do not count.

    `utimes`: (n,) microseconds. Raises CalibrationError where there is none.
    """
    steps = np.diff(np.asarray(utimes, dtype=np.int64))
    usual = float(np.median(steps)) * 1e-6 if steps.size else 0.0
    if usual <= 0.0:
        raise CalibrationError(
            f"{steps.size + 1} samples whose stamps do not rise tell no sampling rate: look at the source's clock"
        )
    return usual


def stretches(utimes: npt.ArrayLike, gap: float = 0.0) -> tuple[Stretch, ...]:
    """Return the stretches of two samples or more between which no step is longer than `gap` seconds or goes back.

    `utimes`: (n,) microseconds; a `gap` of 0 is five times the usual step. Within a stretch the samples count as even,
    at its mean rate: the jitter of stamps is the transport's, and filling in the lost ones from their neighbours would
    take noise away. Raises CalibrationError as `period`.
    """
    stamps = np.asarray(utimes, dtype=np.int64)
    limit = gap or GAP_PERIODS * period(stamps)
    steps = np.diff(stamps) * 1e-6
    ends = np.flatnonzero((steps > limit) | (steps < 0.0)) + 1
    bounds = [0, *ends.tolist(), stamps.size]
    return tuple(
        Stretch(a, b, float(stamps[b - 1] - stamps[a]) * 1e-6)
        for a, b in pairwise(bounds)
        if b - a >= 2 and stamps[b - 1] > stamps[a]
    )
