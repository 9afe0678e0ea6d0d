"""Confidence intervals of ratios by resampling: a drive is the unit, since errors within one are not independent."""

from __future__ import annotations

from typing import Final

import numpy as np

from modelserver.transforms.so3 import Array

RESAMPLES: Final = 2000
"""Resamples of an interval: the percentiles then have a standard error of 0.3 % of the probability."""


def compute_ratio_interval(numerators: Array, denominators: Array, level: float = 0.95) -> tuple[float, float]:
    """Return the percentile bootstrap interval of sum(numerators) / sum(denominators) over their pairs.

    Numerators and denominators: (n,), of each drive. Deterministic. Efron and Tibshirani (1993) 13.3.
    """
    drawn = np.random.default_rng(0).integers(0, len(numerators), (RESAMPLES, len(numerators)))
    ratios = numerators[drawn].sum(axis=1) / denominators[drawn].sum(axis=1)
    low, high = np.percentile(ratios, (50.0 * (1.0 - level), 50.0 * (1.0 + level)))
    return float(low), float(high)
