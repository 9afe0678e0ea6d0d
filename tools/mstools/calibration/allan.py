"""Overlapping Allan deviation of a stationary gyro or accelerometer, and the noise parameters fitted to it.

White noise N (angle or velocity random walk) has the slope -1/2, sigma = N / sqrt(tau); bias instability B a flat
floor, sigma = 0.664 B; a random walk K of the bias (rate random walk) the slope +1/2, sigma = K sqrt(tau / 3). Each is
fitted where the curve has its slope, weighted by the errors of the deviations. Limits: averaging times reach to a fifth
of the record, and steady noise is assumed: vibration or temperature drift changes the slopes.

Sources: IEEE Std 952-1997, annex C: Allan variance from averages over clusters (C.1), angle random walk (C.1.1), bias
instability (C.1.3), rate random walk (C.1.4), the error of an estimate (C.1, 1 / sqrt(2 (N/n - 1))). W. Riley and
D. Howe, NIST Special Publication 1065, 2008, 5.2.4: overlapping clusters.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import groupby

import numpy as np
import numpy.typing as npt

from modelserver.transforms.so3 import Array
from mstools.calibration import CalibrationError

INSTABILITY_FLOOR = math.sqrt(2.0 * math.log(2.0) / math.pi)
"""Allan deviation of bias instability B, divided by B: 0.664."""

POINTS_PER_DECADE = 10
"""Averaging times in a factor of ten."""

MIN_CLUSTERS = 5
"""Averaging times reach to this part of the record: beyond, a deviation has a standard error of half its value."""

SLOPE_TOLERANCE = 0.1
"""Largest deviation of the slope from -1/2 for white noise, which then has nine tenths of the variance."""

FLAT_SLOPE = 0.25
"""A floor is reached where the deviation decreases less steeply than this, half of the slope of white noise."""

RANDOM_WALK_SLOPES = (0.25, 0.75)
"""Slopes between which the rise counts as a random walk: flatter is instability, steeper a ramp (slope 1)."""


@dataclass(frozen=True, slots=True)
class AllanCurve:
    """Allan deviations over averaging times.

    taus: seconds, ascending. deviations: in the unit of the series. clusters: number of clusters of that length in the
    series, not counting overlap. seconds: length of the series.
    """

    taus: tuple[float, ...]
    deviations: tuple[float, ...]
    clusters: tuple[float, ...]
    seconds: float

    @property
    def relative_errors(self) -> tuple[float, ...]:
        """Relative standard deviation of each deviation (IEEE 952 C.1); overlapping makes it smaller still."""
        return tuple(1.0 / math.sqrt(2.0 * (count - 1.0)) for count in self.clusters)


@dataclass(frozen=True, slots=True)
class NoiseParameter:
    """A noise parameter: value, standard deviation, averaging time, and number of clusters of that length."""

    value: float
    sigma: float
    tau: float
    clusters: float


@dataclass(frozen=True, slots=True)
class NoiseParameters:
    """The noise parameters of an axis; u is the unit of the series, rad/s or m/s2.

    white: N, u/sqrt(Hz), angle or velocity random walk. instability: B, u. random_walk: K, u/sqrt(s), of the bias. None
    where the record does not determine it: `missing` states why and what to do.
    """

    white: NoiseParameter | None
    instability: NoiseParameter | None
    random_walk: NoiseParameter | None
    missing: tuple[str, ...]


def allan_deviation(values: npt.ArrayLike, rate_hz: float) -> AllanCurve:
    """Return the overlapping Allan deviation of a series at logarithmically spaced averaging times.

    Parameters
    ----------
    values : (n,) samples of a rate or an acceleration, evenly spaced
    rate_hz : their rate

    Raises
    ------
    CalibrationError
        For a series that is too short or not finite.
    """
    series = np.asarray(values, dtype=float)
    if series.ndim != 1 or series.size < 2 * MIN_CLUSTERS or not rate_hz > 0.0:
        raise CalibrationError(
            f"an Allan deviation takes {2 * MIN_CLUSTERS} samples in a row or more, got {series.size}: record longer"
        )
    if not np.isfinite(series).all():
        raise CalibrationError("an Allan deviation takes finite samples: remove missing samples")
    # the mean does not affect the variance; removing it preserves the precision of the sum
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
    """Return the lengths of clusters, in samples, for a series of `count`: logarithmically spaced, without repeats."""
    longest = count // MIN_CLUSTERS
    steps = math.floor(math.log10(longest) * POINTS_PER_DECADE + 1e-9) + 1
    return sorted({round(10.0 ** (step / POINTS_PER_DECADE)) for step in range(steps)})


def fit_noise_parameters(curve: AllanCurve) -> NoiseParameters:
    """Return the noise parameters of an Allan deviation; none is determined where a deviation is 0."""
    taus, deviations = np.array(curve.taus), np.array(curve.deviations)
    if not (deviations > 0.0).all():
        text = "all values are equal: the unit is frozen, or its resolution is coarser than its noise"
        return NoiseParameters(None, None, None, (text,))
    missing: list[str] = []
    white = _fit_white(curve, taus, deviations)
    if white is None:
        missing.append("white noise: no averaging time shows the slope of -1/2; vibration or quantization hides it")
    instability = _fit_instability(curve, deviations)
    longer = f"record {max(3.0 * curve.seconds, 600.0) / 60.0:.0f} minutes or more while stationary"
    walk, why = _fit_random_walk(curve, taus, deviations, white, longer)
    if instability is None:
        missing.append(f"bias instability: no minimum up to {curve.taus[-1]:.3g} s; {longer}")
    if walk is None:
        missing.append(f"bias random walk: {why}")
    return NoiseParameters(white, instability, walk, tuple(missing))


def _fit_white(curve: AllanCurve, taus: Array, deviations: Array) -> NoiseParameter | None:
    """Return N: the mean of sigma sqrt(tau), weighted by its errors, over the longest run with the slope -1/2."""
    slopes = _slopes(taus, deviations)
    good = np.abs(slopes + 0.5) <= SLOPE_TOLERANCE
    runs = (list(run) for is_good, run in groupby(range(len(good)), key=lambda index: bool(good[index])) if is_good)
    best = max(runs, key=len, default=[])
    # fewer points may have the slope by chance
    if len(best) < POINTS_PER_DECADE // 3:
        return None
    errors = np.array(curve.relative_errors)[best]
    weights = errors**-2
    value = float(np.average(deviations[best] * np.sqrt(taus[best]), weights=weights))
    # neighboring averaging times contain the same noise: together they are hardly better than the best of them
    first = best[int(np.argmin(errors))]
    return NoiseParameter(value, value * float(errors.min()), curve.taus[first], curve.clusters[first])


def _fit_instability(curve: AllanCurve, deviations: Array) -> NoiseParameter | None:
    """Return B from the minimum, None where the deviation decreases to the end."""
    errors = curve.relative_errors
    at = int(np.argmin(deviations))
    least = float(deviations[at])
    # after the minimum the curve must rise significantly, or stay flat over the last decade
    half_decade = curve.taus[-1] >= 3.0 * curve.taus[at]
    risen = half_decade and any(
        deviations[index] * (1.0 - errors[index]) > least for index in range(at + 1, len(deviations))
    )
    last = slice(max(len(deviations) - POINTS_PER_DECADE, 0), None)
    slope, slope_error = _slope(np.log(curve.taus[last]), np.log(deviations[last]), np.array(errors[last]))
    if not (risen or slope - slope_error > -FLAT_SLOPE):
        return None
    floor = least / INSTABILITY_FLOOR
    return NoiseParameter(floor, floor * errors[at], curve.taus[at], curve.clusters[at])


def _fit_random_walk(
    curve: AllanCurve, taus: Array, deviations: Array, white: NoiseParameter | None, longer: str
) -> tuple[NoiseParameter | None, str]:
    """Return K from the slope +1/2 after subtracting white noise, and the reason where it is None."""
    variances = deviations**2
    errors = 2.0 * variances * np.array(curve.relative_errors)
    rest = variances - (white.value**2 / taus if white else 0.0)
    start = int(np.argmin(deviations))
    chosen = np.array([i for i in range(start, len(taus)) if rest[i] > variances[i] / 2.0], dtype=int)
    if chosen.size == 0 or taus[chosen[-1]] < 3.0 * taus[chosen[0]]:
        return None, f"no rise over a factor of 3 in time up to {curve.taus[-1]:.3g} s; {longer}"
    relative = errors[chosen] / rest[chosen]
    slope, slope_error = _slope(np.log(taus[chosen]), np.log(rest[chosen]) / 2.0, relative / 2.0)
    if slope < RANDOM_WALK_SLOPES[0] - slope_error:
        text = f"the deviation stays flat up to {curve.taus[-1]:.3g} s (slope {slope:.2f}, a walk has 0.5); {longer}"
        return None, text
    if slope > RANDOM_WALK_SLOPES[1] + slope_error:
        text = f"the bias ramps (slope {slope:.2f}, a walk has 0.5): let the unit warm up before recording"
        return None, text
    squared = float(np.average(rest[chosen] * 3.0 / taus[chosen], weights=relative**-2))
    first = int(np.argmin(relative))
    value = math.sqrt(squared)
    at = int(chosen[first])
    return NoiseParameter(value, value * float(relative[first]) / 2.0, curve.taus[at], curve.clusters[at]), ""


def _slopes(taus: Array, deviations: Array) -> Array:
    x, y = np.log(taus), np.log(deviations)
    between = np.diff(y) / np.diff(x)
    if between.size == 0:
        return np.zeros(1)
    return np.concatenate((between[:1], (between[1:] + between[:-1]) / 2.0, between[-1:]))


def _slope(x: Array, y: Array, errors: Array) -> tuple[float, float]:
    """Return the slope of the line through points, weighted by their errors, and its standard error."""
    weights = errors**-2
    dx = x - np.average(x, weights=weights)
    squares = float((weights * dx * dx).sum())
    return float((weights * dx * y).sum()) / squares, 1.0 / math.sqrt(squares)
