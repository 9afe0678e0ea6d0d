"""Overlapping Allan deviation of a gyro or an accelerometer at rest, and the noise figures read from it.

Sources: IEEE Std 952-1997, annex C: Allan variance from averages over clusters (C.1), angle random walk, the slope of
-1/2 (C.1.1), bias instability, the flat floor at 0.664 B (C.1.3), rate random walk, the slope of +1/2 (C.1.4), the
error of an estimate (C.1, 1 / sqrt(2 (N/n - 1))). W. Riley and D. Howe, NIST Special Publication 1065, 2008, 5.2.4:
overlapping clusters.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from modelserver.localization.calibration.errors import CalibrationError
from modelserver.spatial.so3 import Array

FLOOR = math.sqrt(2.0 * math.log(2.0) / math.pi)
"""Allan deviation of bias instability B, as a share of B: 0.664."""

POINTS_PER_DECADE = 10
"""Averaging times in a factor of ten."""

LEAST_CLUSTERS = 5
"""Averaging times reach to this part of the record: beyond, a deviation is unsure by half."""

SLOPE_TOLERANCE = 0.1
"""How far from -1/2 the slope may be for white noise: it then holds nine tenths of the variance."""

SLOPE_FLAT = 0.25
"""A floor is reached where the deviation falls less steeply than this, half of what white noise does."""

WALK_SLOPES = (0.25, 0.75)
"""Slopes between which the rise counts as a random walk: flatter is instability, steeper a ramp (slope 1)."""


@dataclass(frozen=True, slots=True)
class AllanCurve:
    """Allan deviations over averaging times.

    taus: seconds, rising. deviations: in the unit of the series. clusters: how many clusters of that length the series
    holds, not counting overlap. seconds: length of the series.
    """

    taus: tuple[float, ...]
    deviations: tuple[float, ...]
    clusters: tuple[float, ...]
    seconds: float

    @property
    def relative_errors(self) -> tuple[float, ...]:
        """Standard deviation of each deviation as a share of it (IEEE 952 C.1); overlapping makes it smaller still."""
        return tuple(1.0 / math.sqrt(2.0 * (count - 1.0)) for count in self.clusters)


@dataclass(frozen=True, slots=True)
class Figure:
    """A noise figure: its value, its standard deviation, the averaging time it was read at, clusters of that length."""

    value: float
    sigma: float
    tau: float
    clusters: float


@dataclass(frozen=True, slots=True)
class NoiseFigures:
    """What an Allan deviation tells of an axis; u is the unit of the series, rad/s or m/s2.

    white: N, u/sqrt(Hz), angle or velocity random walk. instability: B, u. walk: K, u/sqrt(s), the bias' random walk.
    None where the record does not determine it; `missing` says why and what to do, one sentence each, and the
    limits say what it is at most, with 99 % confidence: NaN where even that is open.
    """

    white: Figure | None
    instability: Figure | None
    walk: Figure | None
    instability_limit: float
    walk_limit: float
    missing: tuple[str, ...]


def allan_deviation(values: npt.ArrayLike, rate_hz: float) -> AllanCurve:
    """Return the overlapping Allan deviation of a series at a logarithmic choice of averaging times.

    `values`: (n,) samples of a rate or an acceleration, evenly spaced at `rate_hz`. The cost is n for each averaging
    time, of which there are at most ten in a decade. Raises CalibrationError for a series too short or not finite.
    """
    series = np.asarray(values, dtype=float)
    if series.ndim != 1 or series.size < 2 * LEAST_CLUSTERS or not rate_hz > 0.0:
        raise CalibrationError(
            f"an Allan deviation takes {2 * LEAST_CLUSTERS} samples in a row or more, got {series.size}: record longer"
        )
    if not np.isfinite(series).all():
        raise CalibrationError("an Allan deviation takes finite samples: leave out what the unit did not say")
    # the mean is nothing to the variance, but it would eat the digits of the running sum
    angle = np.concatenate(([0.0], np.cumsum(series - series.mean())))
    sizes = cluster_sizes(series.size)
    deviations = []
    for n in sizes:
        second = angle[2 * n :] - 2.0 * angle[n:-n] + angle[: -2 * n]
        deviations.append(math.sqrt(float(second @ second) / second.size / 2.0) / n)
    return AllanCurve(
        taus=tuple(n / rate_hz for n in sizes),
        deviations=tuple(deviations),
        clusters=tuple(series.size / n for n in sizes),
        seconds=series.size / rate_hz,
    )


def cluster_sizes(count: int) -> list[int]:
    """Return the lengths of clusters, in samples, for a series of `count`: even steps of the logarithm, no repeats."""
    longest = count // LEAST_CLUSTERS
    steps = math.floor(math.log10(longest) * POINTS_PER_DECADE + 1e-9) + 1
    return sorted({round(10.0 ** (step / POINTS_PER_DECADE)) for step in range(steps)})


def noise_figures(curve: AllanCurve) -> NoiseFigures:
    """Read the noise figures from an Allan deviation.

    Where noise is no noise at all, all deviations 0, nothing is determined.
    """
    taus, deviations = np.array(curve.taus), np.array(curve.deviations)
    if not (deviations > 0.0).all():
        words = "the values repeat themselves exactly: a unit that is frozen, or coarser than its noise"
        return NoiseFigures(None, None, None, math.nan, math.nan, (words,))
    missing: list[str] = []
    white = _white(curve, taus, deviations)
    if white is None:
        missing.append("white noise: no averaging time shows the slope of -1/2; vibration or coarse steps cover it")
    instability, instability_limit = _instability(curve, deviations)
    longer = f"stand for {max(3.0 * curve.seconds, 600.0) / 60.0:.0f} minutes or more"
    walk, walk_limit, why = _walk(curve, taus, deviations, white, longer)
    if instability is None:
        missing.append(f"bias instability: no minimum up to {curve.taus[-1]:.3g} s; {longer}")
    if walk is None:
        missing.append(f"bias random walk: {why}")
    return NoiseFigures(white, instability, walk, instability_limit, walk_limit, tuple(missing))


def _white(curve: AllanCurve, taus: Array, deviations: Array) -> Figure | None:
    """Return N: the mean of sigma sqrt(tau), weighted by its errors, over the longest run with the slope of -1/2."""
    slopes = _slopes(taus, deviations)
    good = np.abs(slopes + 0.5) <= SLOPE_TOLERANCE
    best: list[int] = []
    run: list[int] = []
    for index, each in enumerate(good):
        run = [*run, index] if each else []
        if len(run) > len(best):
            best = run
    # three points that happen to fall so are no slope
    if len(best) < POINTS_PER_DECADE // 3:
        return None
    errors = np.array(curve.relative_errors)[best]
    weights = errors**-2
    value = float(np.average(deviations[best] * np.sqrt(taus[best]), weights=weights))
    # neighbouring averaging times see the same noise: together they are hardly better than the best of them
    first = best[int(np.argmin(errors))]
    return Figure(value, value * float(errors.min()), curve.taus[first], curve.clusters[first])


def _instability(curve: AllanCurve, deviations: Array) -> tuple[Figure | None, float]:
    """Return B from the minimum, None where the deviation falls to the end; and what it is at most."""
    errors = curve.relative_errors
    at = int(np.argmin(deviations))
    least = float(deviations[at])
    limit = math.sqrt(float(_upper(curve, deviations**2)[at])) / FLOOR
    # past the minimum the curve must have risen by more than chance, or stay flat over the last decade
    half_decade = curve.taus[-1] >= 3.0 * curve.taus[at]
    risen = half_decade and any(
        deviations[index] * (1.0 - errors[index]) > least for index in range(at + 1, len(deviations))
    )
    last = slice(max(len(deviations) - POINTS_PER_DECADE, 0), None)
    slope, unsure = _slope(np.log(curve.taus[last]), np.log(deviations[last]), np.array(errors[last]))
    if not (risen or slope - unsure > -SLOPE_FLAT):
        return None, limit
    return Figure(least / FLOOR, least / FLOOR * errors[at], curve.taus[at], curve.clusters[at]), limit


def _walk(
    curve: AllanCurve, taus: Array, deviations: Array, white: Figure | None, longer: str
) -> tuple[Figure | None, float, str]:
    """Return K from the slope of +1/2 with the share of white noise taken away; what it is at most; why it is None."""
    variances = deviations**2
    errors = 2.0 * variances * np.array(curve.relative_errors)
    rest = variances - (white.value**2 / taus if white else 0.0)
    # at each time K explains at most all that is not white
    most = np.maximum(_upper(curve, variances) - (variances - rest), 2.0 * errors)
    limit = math.sqrt(float(np.min(most * 3.0 / taus)))
    start = int(np.argmin(deviations))
    chosen = np.array([i for i in range(start, len(taus)) if rest[i] > variances[i] / 2.0], dtype=int)
    if chosen.size == 0 or taus[chosen[-1]] < 3.0 * taus[chosen[0]]:
        return None, limit, f"no rise over a factor of 3 in time up to {curve.taus[-1]:.3g} s; {longer}"
    relative = errors[chosen] / rest[chosen]
    slope, unsure = _slope(np.log(taus[chosen]), np.log(rest[chosen]) / 2.0, relative / 2.0)
    if slope < WALK_SLOPES[0] - unsure:
        words = f"the deviation stays flat up to {curve.taus[-1]:.3g} s (slope {slope:.2f}, a walk has 0.5); {longer}"
        return None, limit, words
    if slope > WALK_SLOPES[1] + unsure:
        words = f"the bias ramps (slope {slope:.2f}, a walk has 0.5); let the unit warm up before recording"
        return None, limit, words
    squared = float(np.average(rest[chosen] * 3.0 / taus[chosen], weights=relative**-2))
    first = int(np.argmin(relative))
    value = math.sqrt(squared)
    at = int(chosen[first])
    return Figure(value, value * float(relative[first]) / 2.0, curve.taus[at], curve.clusters[at]), limit, ""


def _upper(curve: AllanCurve, variances: Array) -> Array:
    """Return what the variances are at most, with 99 % confidence.

    A variance from c clusters is spread as chi-square with c - 1 degrees of freedom; its quantile by E. Wilson and
    M. Hilferty, "The distribution of chi-square", 1931.
    """
    a = 2.0 / (9.0 * (np.array(curve.clusters) - 1.0))
    upper: Array = variances / np.maximum(1.0 - a - 2.326 * np.sqrt(a), 0.1) ** 3
    return upper


def _slopes(taus: Array, deviations: Array) -> Array:
    """Return the slope of the logarithms at each point, between its neighbours."""
    x, y = np.log(taus), np.log(deviations)
    between = np.array([(b[1] - a[1]) / (b[0] - a[0]) for a, b in pairwise(zip(x, y, strict=True))])
    if between.size == 0:
        return np.zeros(1)
    return np.concatenate((between[:1], (between[1:] + between[:-1]) / 2.0, between[-1:]))


def _slope(x: Array, y: Array, errors: Array) -> tuple[float, float]:
    """Return the slope of the line through points, weighted by their errors, and its own error."""
    weights = errors**-2
    dx = x - np.average(x, weights=weights)
    squares = float((weights * dx * dx).sum())
    return float((weights * dx * y).sum()) / squares, 1.0 / math.sqrt(squares)
