"""Ranges of samples: without a gap, for an Allan deviation, and in which the vehicle was stationary.

Stationary ranges are found from the inertial unit alone: in blocks of a second, the spread of rates and specific forces
is near that of the quietest blocks, and their means are near those of the other stationary blocks. Limit: a steady
drive straight ahead with no more vibration than a running engine cannot be distinguished from standing.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from modelserver.transforms.so3 import Array
from mstools.calibration import CalibrationError

MAX_GAP_PERIODS = 5.0
"""A step of more periods between stamps is a gap. Serial lines deliver unevenly and lose single samples; five in a row
are an interruption.
"""


@dataclass(frozen=True, slots=True)
class SampleRange:
    """Samples `start` to before `stop`, `seconds` long by their stamps."""

    start: int
    stop: int
    seconds: float

    @property
    def rate_hz(self) -> float:
        """Mean sampling rate; 0 for less than two samples or no time."""
        return (self.stop - self.start - 1) / self.seconds if self.seconds > 0.0 else 0.0


def median_period(utimes: npt.ArrayLike) -> float:
    """Return the median step between stamps (n,), microseconds, in seconds.

    Raises CalibrationError where there is none.
    """
    steps = np.diff(np.asarray(utimes, dtype=np.int64))
    usual = float(np.median(steps)) * 1e-6 if steps.size else 0.0
    if usual <= 0.0:
        raise CalibrationError(
            f"{steps.size + 1} samples without increasing stamps have no sampling rate: check the source's clock"
        )
    return usual


def find_gap_free_ranges(utimes: npt.ArrayLike) -> tuple[SampleRange, ...]:
    """Return the ranges of two samples or more without a gap or a step backward. `utimes`: (n,) microseconds.

    Within a range the samples count as evenly spaced at its mean rate: the jitter of stamps is the transport's, and
    interpolating lost samples would reduce the noise. Raises CalibrationError as `median_period`.
    """
    stamps = np.asarray(utimes, dtype=np.int64)
    limit = MAX_GAP_PERIODS * median_period(stamps)
    steps = np.diff(stamps) * 1e-6
    ends = np.flatnonzero((steps > limit) | (steps < 0.0)) + 1
    bounds = [0, *ends.tolist(), stamps.size]
    return tuple(
        SampleRange(a, b, float(stamps[b - 1] - stamps[a]) * 1e-6)
        for a, b in pairwise(bounds)
        if b - a >= 2 and stamps[b - 1] > stamps[a]
    )


BLOCK_S = 1.0
"""Seconds over which rates and forces are averaged."""

MIN_BLOCK_SAMPLES = 10
"""Least samples in a block: of fewer the spread is too uncertain."""


SPREAD_FACTOR = 3.0
"""Largest spread of a stationary block, as a multiple of the quietest tenth's: engines, wind and steps come and go. The
spread of ten samples has a standard error of a quarter, so of many blocks one has twice the least by chance.
"""
MAX_SPREADS = np.array([0.05] * 3 + [0.3] * 3)
"""Largest spreads in a block: of the rates, rad/s, five times the noise of a 3DM-GX1 at 100 Hz (1e-3 rad/sqrt(s)); of
the specific force, m/s2, seven times its noise (0.4 mg per sqrt(Hz)): driving on a road vibrates more.
"""
RATE_STEP = 0.01
"""Largest difference of a block's mean rate from that of the stationary blocks, rad/s: 0.6 deg/s is a bias' change with
temperature (3DM-GX1: 0.7 deg/s over its whole range), and a slow turn.
"""
FORCE_STEP = 0.2
"""Largest step of the mean specific force between blocks, m/s2: a fiftieth of g is a tilt of one degree."""
MAX_RATE = 0.1
"""Largest mean rate, rad/s: no unit's bias is as large as 6 deg/s, so the vehicle turns."""


def find_stationary_ranges(
    utimes: npt.ArrayLike, rates: npt.ArrayLike, forces: npt.ArrayLike
) -> tuple[SampleRange, ...]:
    """Return the ranges without a gap in which the vehicle was stationary, in order.

    `utimes`: (n,) microseconds; `rates`: (n, 3) rad/s; `forces`: (n, 3) m/s2, along the unit's axes, all finite. Raises
    CalibrationError as `median_period`.
    """
    stamps = np.asarray(utimes, dtype=np.int64)
    values = np.column_stack((np.asarray(rates, dtype=float), np.asarray(forces, dtype=float)))
    size = max(round(BLOCK_S / median_period(stamps)), MIN_BLOCK_SAMPLES)
    found: list[SampleRange] = []
    blocks = [(each, *_blocks(values[each.start : each.stop], size)) for each in find_gap_free_ranges(stamps)]
    if not any(len(means) for _, means, _ in blocks):
        return ()
    all_means = np.concatenate([means for _, means, _ in blocks])
    all_spreads = np.concatenate([spreads for _, _, spreads in blocks])
    quietest = np.quantile(all_spreads, 0.1, axis=0)
    largest = np.minimum(SPREAD_FACTOR * quietest + 1e-12, MAX_SPREADS)
    quiet = _is_quiet(all_means, all_spreads, largest)
    if not quiet.any():
        return ()
    usual = np.median(all_means[quiet, :3], axis=0)
    for stretch, means, spreads in blocks:
        # a vehicle that parks on another slope is stationary as well: compare only the rates with the other blocks
        near = (np.abs(means[:, :3] - usual) <= RATE_STEP).all(axis=1)
        stationary = _is_quiet(means, spreads, largest) & near
        # a gentle start does not increase the spread: it is a step from one block to the next
        stationary[1:] &= np.abs(np.diff(means[:, 3:], axis=0)).max(axis=1, initial=0.0) <= FORCE_STEP
        for a, b in _runs(stationary):
            start, stop = stretch.start + a * size, stretch.start + b * size
            found.append(SampleRange(start, stop, float(stamps[stop - 1] - stamps[start]) * 1e-6))
    return tuple(found)


def _blocks(values: Array, size: int) -> tuple[Array, Array]:
    """Return means and spreads, (blocks, 6) each, of whole blocks."""
    count = len(values) // size
    cut = values[: count * size].reshape(count, size, values.shape[1])
    return cut.mean(axis=1), cut.std(axis=1)


def _is_quiet(means: Array, spreads: Array, largest: Array) -> npt.NDArray[np.bool_]:
    turning = np.abs(means[:, :3]).max(axis=1, initial=0.0) > MAX_RATE
    quiet: npt.NDArray[np.bool_] = (spreads <= largest).all(axis=1) & ~turning
    return quiet


def _runs(flags: npt.NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return start and end of the runs of true flags."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], flags, [False])).astype(np.int8)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]
