"""When a vehicle stood, told by its inertial unit alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from modelserver.localization.calibration.even import Stretch, period, stretches
from modelserver.spatial.so3 import Array

BLOCK = 1.0
"""Seconds over which rates and forces are averaged; who turns or sets off shows it in a second."""

LEAST_SAMPLES = 10
"""Least samples in a block: of fewer the spread tells nothing."""


@dataclass(frozen=True, slots=True)
class StandingLimits:
    """What a standing unit may feel. A block of a second counts as standing when every limit holds on every axis."""

    spread_factor: float = 3.0
    """Spread of a block, as a multiple of the quietest tenth's: engines, wind and steps come and go. The spread of
    ten samples is itself unsure by a quarter, so of many blocks one shows twice the least by chance."""
    rate_spread: float = 0.05
    """Largest spread of the rates in a block, rad/s: five times the noise of a 3DM-GX1 at 100 Hz (1e-3 rad/sqrt(s))."""
    force_spread: float = 0.3
    """Largest spread of the specific force in a block, m/s2: seven times the noise of a 3DM-GX1 at 100 Hz (0.4 mg per
    sqrt(Hz)); driving on a road shakes by more."""
    rate_step: float = 0.01
    """How far a block's mean rate may be off that of the standing blocks, rad/s: 0.6 deg/s is a bias' change with
    temperature (3DM-GX1: 0.7 deg/s over its whole range), and a slow turn."""
    force_step: float = 0.2
    """The same of the specific force, m/s2: a fiftieth of g is a tilt of one degree."""
    rate: float = 0.1
    """Largest mean rate, rad/s: no unit's bias is as large as 6 deg/s, so the vehicle turns."""


def standing(
    utimes: npt.ArrayLike,
    rates: npt.ArrayLike,
    forces: npt.ArrayLike,
    limits: StandingLimits | None = None,
) -> tuple[Stretch, ...]:
    """Return the stretches without a gap in which the vehicle stood, in order; empty where it never did.

    `utimes`: (n,) microseconds; `rates`: (n, 3) rad/s; `forces`: (n, 3) m/s2, along the unit's axes, all finite. A
    steady drive straight ahead that shakes no more than a standing engine cannot be told from standing.
    Raises CalibrationError where the stamps tell no rate.
    """
    limits = limits or StandingLimits()
    stamps = np.asarray(utimes, dtype=np.int64)
    values = np.column_stack((np.asarray(rates, dtype=float), np.asarray(forces, dtype=float)))
    size = max(round(BLOCK / period(stamps)), LEAST_SAMPLES)
    found: list[Stretch] = []
    blocks = [(each, *_blocks(values[each.start : each.stop], size)) for each in stretches(stamps)]
    if not any(len(means) for _, means, _ in blocks):
        return ()
    all_means = np.concatenate([means for _, means, _ in blocks])
    all_spreads = np.concatenate([spreads for _, _, spreads in blocks])
    quietest = np.quantile(all_spreads, 0.1, axis=0)
    largest = np.minimum(limits.spread_factor * quietest + 1e-12, _of_both(limits.rate_spread, limits.force_spread))
    quiet = _quiet(all_means, all_spreads, largest, limits)
    if not quiet.any():
        return ()
    usual = np.median(all_means[quiet], axis=0)
    step = _of_both(limits.rate_step, limits.force_step)
    # a vehicle that parked on another slope stands as well, so only the rates are compared with all other blocks'
    step[3:] = np.inf
    for stretch, means, spreads in blocks:
        still = _quiet(means, spreads, largest, limits) & (np.abs(means - usual) <= step).all(axis=1)
        # a setting-off too soft for the spread shows as a step from one block to the next
        still[1:] &= np.abs(np.diff(means[:, 3:], axis=0)).max(axis=1, initial=0.0) <= limits.force_step
        for a, b in _runs(still):
            start, stop = stretch.start + a * size, stretch.start + b * size
            found.append(Stretch(start, stop, float(stamps[stop - 1] - stamps[start]) * 1e-6))
    return tuple(found)


def _blocks(values: Array, size: int) -> tuple[Array, Array]:
    """Return means and spreads, (blocks, 6) each, of whole blocks."""
    count = len(values) // size
    cut = values[: count * size].reshape(count, size, values.shape[1])
    return cut.mean(axis=1), cut.std(axis=1)


def _quiet(means: Array, spreads: Array, largest: Array, limits: StandingLimits) -> npt.NDArray[np.bool_]:
    turning = np.abs(means[:, :3]).max(axis=1, initial=0.0) > limits.rate
    quiet: npt.NDArray[np.bool_] = (spreads <= largest).all(axis=1) & ~turning
    return quiet


def _of_both(rate: float, force: float) -> Array:
    return np.array([rate] * 3 + [force] * 3)


def _runs(flags: npt.NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return begin and end of the runs of true flags."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], flags, [False])).astype(np.int8)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]
