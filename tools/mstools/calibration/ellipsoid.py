"""Magnetometer calibration: hard and soft iron from samples recorded while turning.

The unit measures m = W h + b: the earth's field h distorted by soft iron, W, and the vehicle's own field b, hard iron.
A symmetric A and b are fitted so that |A (m - b)| is the strength of the earth's field in every orientation. A rotation
common to all samples cannot be determined from lengths; a symmetric A is the choice with the smallest.

A ground vehicle turns about the vertical alone. Then the horizontal part of m moves on an ellipse, and the planar mode
finds what maps it to a circle; the vertical, which such a turn does not determine, is left as it is. Limit: hard iron
found so holds for level ground; on a slope, soft iron's share of the vertical field returns.

Found are a center b and a symmetric positive definite matrix A, so that |A (p - b)| = 1 for the points p. First
an algebraic fit: the quadric p'Qp + 2 q'p + c = 0 with trace Q = dimension, which is linear in the unknowns and
invariant to rotation of the axes; refitted a few times to the nearest points (least trimmed squares). Then Gauss-Newton
on the lengths |A (p - b)| - 1 with Tukey's weights. Points are weighted so that each direction counts equally.

Sources: V. Renaudin, M. Afzal and G. Lachapelle, "Complete triaxis magnetometer calibration in the magnetic domain",
2010 (the whole; quadric, and A and b from it); J. Vasconcelos et al., "Geometric approach to strapdown magnetometer
calibration in sensor frame", 2011 (refinement on lengths); P. Rousseeuw and K. Van Driessen, "Computing LTS regression
for large data sets", 2006 (refitting to the nearest); P. Holland and R. Welsch, "Robust regression using iteratively
reweighted least-squares", 1977 (Tukey's weights, 4.685; spread from the median, 1.4826).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np
import numpy.typing as npt

from modelserver.transforms.so3 import Array, Matrix3, Vector3, to_vector3
from mstools.calibration import CalibrationError

SECTORS = 12
"""Sectors of 30 degrees in which the directions are counted."""

MIN_SECTORS = 10
"""Sectors that must be covered: elsewhere the ellipse is extrapolated, and disturbances of the field would not show."""

MIN_SPREAD = 0.3
"""For calibration about all axes: share of the sphere's height that the directions must cover along their least covered
axis: 17 degrees of elevation to both sides.
"""

MAX_RESIDUAL = 0.1
"""Largest residual as a share of the strength: beyond, the samples are on no ellipse (6 degrees of heading)."""

MAX_AXIS_RATIO = 3.0
"""Largest ratio of the axes of the ellipse, and of its size and the known field's: soft iron distorts by a few tens of
percent; beyond, the unit's scale is wrong or the turn was incomplete.
"""


@dataclass(frozen=True, slots=True)
class Coverage:
    """Directions that the samples cover.

    sectors: SECTORS flags, counter-clockwise about `axis` (unit vector along the sensor's axes). spread: share of the
    sphere's height covered along `axis`; NaN in planar mode.
    """

    sectors: tuple[bool, ...]
    axis: Vector3
    spread: float


@dataclass(frozen=True, slots=True)
class MagnetometerFit:
    """A magnetometer's calibration: the field is `soft_iron` (m - `hard_iron`).

    hard_iron: along the sensor's axes, tesla. soft_iron: 3 x 3, symmetric, row-major. is_planar: whether only the
    horizontal was fitted. strength: of the horizontal field in planar mode, else of the whole, tesla;
    is_strength_known: whether it was given, or is the mean radius. rms: of the residuals of the inliers, tesla;
    heading_rms: the resulting error of heading, radians, NaN where the horizontal field is unknown. samples: number of
    finite ones; outliers: those not used.
    """

    hard_iron: Vector3
    soft_iron: Matrix3
    is_planar: bool
    strength: float
    is_strength_known: bool
    rms: float
    heading_rms: float
    coverage: Coverage
    samples: int
    outliers: int

    def apply(self, fields: npt.ArrayLike) -> Array:
        """Return the corrected fields (n, 3), along the sensor's axes, tesla."""
        away = np.asarray(fields, dtype=float) - np.array(self.hard_iron)
        corrected: Array = away @ np.array(self.soft_iron).reshape(3, 3).T
        return corrected


def fit_all_axes(fields: npt.ArrayLike, strength: float = math.nan, horizontal: float = math.nan) -> MagnetometerFit:
    """Return the calibration of a unit that was turned about all of its axes.

    Parameters
    ----------
    fields : (n, 3) along the sensor's axes, tesla; rows that are not finite are ignored
    strength : of the earth's field at the place, tesla (`magnetism.field_at`); NaN for the mean radius
    horizontal : its horizontal part, for the error of heading

    Raises
    ------
    CalibrationError
        Where the turn was insufficient, with the directions covered.
    """
    points = _select_finite(fields)
    found = fit_quadric(points)
    coverage = _sphere_coverage(found.normalize(points[found.is_inlier]))
    return _make_fit(found, points, np.eye(3), 0.0, strength, horizontal, coverage)


def fit_level(
    fields: npt.ArrayLike, up: Vector3, horizontal: float = math.nan, vertical: float = math.nan
) -> MagnetometerFit:
    """Return the calibration of a unit on a vehicle that turned about the vertical alone, on level ground.

    Without `vertical` the hard iron along the vertical is 0, and the strength of the corrected field is not comparable
    with the earth's.

    Parameters
    ----------
    fields : (n, 3) along the sensor's axes, tesla; rows that are not finite are ignored
    up : direction of the mean specific force, along the sensor's axes
    horizontal, vertical : the earth's field along magnetic north and up, tesla; NaN where unknown (mean radius)

    Raises
    ------
    CalibrationError
        Where the turn was insufficient, with the directions covered.
    """
    points = _select_finite(fields)
    E = _level_axes(up)
    level, height = points @ E[:, :2], points @ E[:, 2]
    try:
        found = fit_quadric(level)
    except CalibrationError as error:
        raise _add_coverage(error, level) from None
    unit = found.normalize(level[found.is_inlier])
    coverage = Coverage(_covered_sectors(unit[:, 0], unit[:, 1]), to_vector3(E[:, 2]), math.nan)
    offset = 0.0
    if math.isfinite(vertical):
        offset = float(np.average(height[found.is_inlier], weights=found.weights[found.is_inlier])) - vertical
    return _make_fit(found, level, E, offset, horizontal, math.nan, coverage)


def _make_fit(
    found: Quadric,
    points: Array,
    E: Array,
    offset: float,
    strength: float,
    horizontal: float,
    coverage: Coverage,
) -> MagnetometerFit:
    """Scale a quadric to the field's strength, NaN for the mean radius, and check it. Raises CalibrationError.

    `points` are along the first columns of `E`, axes along the sensor's; `offset` is the hard iron along the last.
    """
    dimension = points.shape[1]
    known = math.isfinite(strength)
    target = strength if known else float(np.linalg.det(found.matrix)) ** (-1.0 / dimension)
    _check_coverage(coverage)
    scaled = found.matrix * target
    _check_axis_ratio(scaled, known)
    off = np.linalg.norm(found.normalize(points[found.is_inlier]), axis=1) - 1.0
    rms = math.sqrt(float(np.average(off**2, weights=found.weights[found.is_inlier]))) * target
    if rms > MAX_RESIDUAL * target:
        raise CalibrationError(
            f"the samples scatter by {rms / target:.0%} of the field about the fit, {MAX_RESIDUAL:.0%} are "
            "allowed: the vehicle was not turned, or something else moved the field; turn in one place, away from iron"
        )
    A = np.eye(3)
    A[:dimension, :dimension] = scaled
    A = E @ A @ E.T
    a, b, c, d, e, f, g, h, i = (float(each) for each in ((A + A.T) / 2.0).ravel())
    return MagnetometerFit(
        hard_iron=to_vector3(E @ np.array([*found.center, offset])[:3]),
        soft_iron=(a, b, c, d, e, f, g, h, i),
        is_planar=dimension == 2,
        strength=target,
        is_strength_known=known,
        rms=rms,
        heading_rms=rms / (target if dimension == 2 else horizontal),
        coverage=coverage,
        samples=len(points),
        outliers=int((~found.is_inlier).sum()),
    )


def project_to_level(fields: npt.ArrayLike, up: Vector3) -> Array:
    """Return the horizontal parts (n, 2) of vectors (n, 3) along the sensor's axes, as in `fit_level`."""
    plane: Array = np.asarray(fields, dtype=float) @ _level_axes(up)[:, :2]
    return plane


def _select_finite(fields: npt.ArrayLike) -> Array:
    points = np.asarray(fields, dtype=float).reshape(-1, 3)
    finite: Array = points[np.isfinite(points).all(axis=1)]
    return finite


def _level_axes(up: Vector3) -> Array:
    """Return, as columns, two axes of the horizontal plane and up, right-handed, along the sensor's axes."""
    length = math.hypot(*up)
    if not (math.isfinite(length) and length > 0.0):
        raise CalibrationError(f"up must be a direction, got {up}: the unit measures no specific force")
    z = np.array(up) / length
    # the most level axis of the sensor is the first
    x = np.zeros(3)
    x[int(np.argmin(np.abs(z)))] = 1.0
    x = x - (x @ z) * z
    x /= np.linalg.norm(x)
    return np.column_stack((x, np.cross(z, x), z))


def _sphere_coverage(unit: Array) -> Coverage:
    """Return the coverage of directions on the sphere, about the axis along which they spread least."""
    _, vectors = np.linalg.eigh(np.cov(unit.T))
    E = _level_axes(to_vector3(vectors[:, 0]))
    heights = unit @ E[:, 2]
    low, high = np.quantile(heights, (0.02, 0.98))
    return Coverage(_covered_sectors(unit @ E[:, 0], unit @ E[:, 1]), to_vector3(E[:, 2]), float(high - low) / 2.0)


def _covered_sectors(x: Array, y: Array) -> tuple[bool, ...]:
    sectors = np.floor(np.arctan2(y, x) / (2.0 * np.pi) * SECTORS).astype(int) % SECTORS
    counts = np.bincount(sectors, minlength=SECTORS)
    # a single outlier does not cover 30 degrees
    return tuple(bool(count >= 3) for count in counts)


def _add_coverage(error: CalibrationError, level: Array) -> CalibrationError:
    """Return the error of a fit that found no ellipse with the coverage, where a circle fits roughly."""
    center, radius = fit_circle(level)
    if not radius > 0.0:
        return error
    away = level - center
    off = np.linalg.norm(away, axis=1) / radius - 1.0
    if not float(np.sqrt(np.mean(off**2))) <= MAX_RESIDUAL:
        return error
    seen = sum(_covered_sectors(away[:, 0], away[:, 1]))
    return CalibrationError(f"{error}; the samples lie on about {seen} of {SECTORS} sectors of 30 degrees")


def _check_coverage(coverage: Coverage) -> None:
    seen = sum(coverage.sectors)
    if seen < MIN_SECTORS:
        raise CalibrationError(
            f"the samples cover {seen} of {SECTORS} sectors of 30 degrees, {MIN_SECTORS} are needed: turn the "
            "vehicle slowly through a full circle twice, on level ground and away from iron, and record again"
        )
    if coverage.spread < MIN_SPREAD:
        raise CalibrationError(
            f"the directions reach over {coverage.spread:.0%} of the sphere's height along the sensor's axis "
            f"({', '.join(f'{each:.2f}' for each in coverage.axis)}), {MIN_SPREAD:.0%} are needed: roll and pitch "
            "the unit more; use the level mode for a vehicle that stays level"
        )


def _check_axis_ratio(A: Array, known: bool) -> None:
    values = np.linalg.eigvalsh(A)
    if values[-1] > MAX_AXIS_RATIO * values[0]:
        raise CalibrationError(
            f"the samples are on an ellipse {values[-1] / values[0]:.1f} times as long as wide, and iron distorts a "
            "field by less: turn through full circles in one place, away from iron, and record again"
        )
    if known and not 1.0 / MAX_AXIS_RATIO < float(np.mean(values)) < MAX_AXIS_RATIO:
        raise CalibrationError(
            f"the measured field is {1.0 / float(np.mean(values)):.2g} times the earth's at the place: check its "
            "scale (tesla; 1 gauss is 1e-4 tesla), or whether it turned at all"
        )


# --- robust fit of an ellipse or ellipsoid ------------------------------------------------------------------

TUKEY = 4.685
SPREAD = 1.4826
TRIM_SHARE = 0.75
"""Share of the points that the algebraic fit is refitted to: a quarter may be outliers."""

WEIGHT_SECTORS = 36
"""Sectors about the center in which points are counted; a point's weight is inverse to the count of its sector."""

_ROUNDS = 8
_STEPS = 50
_FLOOR = 1e-6
"""Smallest spread of lengths for the weights: noise-free points are no outliers."""


@dataclass(frozen=True, slots=True)
class Quadric:
    """|matrix (p - center)| = 1, in the unit of the points.

    is_inlier: (n,), the points that are no outliers. weights: (n,), of each point by its sector, without Tukey's
    weight.
    """

    center: Array
    matrix: Array
    is_inlier: npt.NDArray[np.bool_]
    weights: Array

    def normalize(self, points: Array) -> Array:
        """Return A (p - b), (n, d): on the unit circle or sphere except for noise."""
        mapped: Array = (points - self.center) @ self.matrix
        return mapped


def fit_quadric(points: Array) -> Quadric:
    """Return the ellipse (n, 2) or ellipsoid (n, 3) through finite points.

    Raises CalibrationError where no ellipse fits: too few points, on a line, or on another curve.
    """
    count, dimension = points.shape
    unknown = dimension * (dimension + 3) // 2
    if count < 4 * unknown:
        raise CalibrationError(
            f"{count} samples are too few for a fit; at least {4 * unknown} are needed: record longer"
        )
    # scaled and centered, for numerical conditioning
    middle = (points.max(axis=0) + points.min(axis=0)) / 2.0
    size = float(np.abs(points - middle).max())
    if not size > 0.0:
        raise CalibrationError("all samples are equal: turn the unit, or check whether its magnetometer is frozen")
    scaled = (points - middle) / size
    weights = _balance_weights(scaled)
    center, matrix = _fit_algebraic(scaled, weights)
    for _ in range(_ROUNDS):
        mapped = (scaled - center) @ matrix
        weights = _balance_weights(mapped)
        off = np.abs(np.linalg.norm(mapped, axis=1) - 1.0)
        near = off <= _weighted_quantile(off, weights, TRIM_SHARE)
        if near.sum() < 2 * unknown:
            break
        center, matrix = _fit_algebraic(scaled[near], weights[near])
    center, matrix, is_inlier = _refine(scaled, weights, center, matrix)
    return Quadric(center * size + middle, matrix / size, is_inlier, weights)


def fit_circle(points: Array) -> tuple[Array, float]:
    """Return center and radius of the circle through points (n, 2), by algebraic fit (I. Kasa, 1976), or radius 0."""
    middle = points.mean(axis=0) if len(points) else np.zeros(2)
    away = points - middle
    design = np.column_stack((2.0 * away, np.ones(len(away))))
    found, _, rank, _ = np.linalg.lstsq(design, (away**2).sum(axis=1), rcond=None)
    squared = float(found[2] + found[:2] @ found[:2])
    return found[:2] + middle, float(np.sqrt(max(squared, 0.0))) if rank == 3 else 0.0


def _fit_algebraic(points: Array, weights: Array) -> tuple[Array, Array]:
    dimension = points.shape[1]
    pairs = [pair for pair in combinations_with_replacement(range(dimension), 2) if pair != (0, 0)]
    first = points[:, 0] ** 2
    columns = []
    for i, j in pairs:
        # Q00 = d - the other diagonal entries
        columns.append(points[:, i] ** 2 - first if i == j else 2.0 * points[:, i] * points[:, j])
    design = np.column_stack((*columns, 2.0 * points, np.ones(len(points))))
    root = np.sqrt(weights)
    found, _, rank, _ = np.linalg.lstsq(design * root[:, None], -dimension * first * root, rcond=1e-10)
    Q = np.zeros((dimension, dimension))
    for (i, j), value in zip(pairs, found, strict=False):
        Q[i, j] = Q[j, i] = value
    Q[0, 0] = dimension - np.trace(Q)
    q, c = found[len(pairs) : -1], float(found[-1])
    values, vectors = np.linalg.eigh(Q)
    if rank < design.shape[1] or values[0] <= 1e-6 * values[-1]:
        raise _no_ellipse(dimension)
    center = -np.linalg.solve(Q, q)
    radius = float(center @ Q @ center) - c
    if radius <= 0.0:
        raise _no_ellipse(dimension)
    matrix: Array = vectors @ np.diag(np.sqrt(values / radius)) @ vectors.T
    return center, matrix


def _refine(points: Array, weights: Array, center: Array, matrix: Array) -> tuple[Array, Array, npt.NDArray[np.bool_]]:
    dimension = points.shape[1]
    pairs = list(combinations_with_replacement(range(dimension), 2))
    is_inlier = np.ones(len(points), dtype=bool)
    for _ in range(_STEPS):
        away = points - center
        mapped = away @ matrix
        lengths = np.maximum(np.linalg.norm(mapped, axis=1), 1e-12)
        residuals = lengths - 1.0
        spread = max(SPREAD * _weighted_quantile(np.abs(residuals), weights, 0.5), _FLOOR)
        share = residuals / (TUKEY * spread)
        is_inlier = np.abs(share) < 1.0
        discount = np.where(is_inlier, (1.0 - share**2) ** 2, 0.0) * weights
        directions = mapped / lengths[:, None]
        # d|A(p-b)| = n' (dA (p-b) - A db)
        columns = [directions[:, i] * away[:, j] + (directions[:, j] * away[:, i] if i != j else 0.0) for i, j in pairs]
        jacobian = np.column_stack((*columns, -directions @ matrix))
        root = np.sqrt(discount)
        step, *_ = np.linalg.lstsq(jacobian * root[:, None], -residuals * root, rcond=1e-10)
        for (i, j), value in zip(pairs, step, strict=False):
            matrix[i, j] += value
            if i != j:
                matrix[j, i] += value
        center = center + step[len(pairs) :]
        if not np.isfinite(step).all() or np.linalg.eigvalsh(matrix)[0] <= 0.0:
            raise _no_ellipse(dimension)
        if float(np.abs(step).max()) < 1e-10:
            break
    return center, matrix, is_inlier


def _balance_weights(points: Array) -> Array:
    """Return weights, mean 1, with equal sums in all directions about the origin, however many samples each has."""
    azimuth = (
        np.floor((np.arctan2(points[:, 1], points[:, 0]) / (2.0 * np.pi) + 0.5) * WEIGHT_SECTORS).astype(int)
        % WEIGHT_SECTORS
    )
    cells = azimuth
    if points.shape[1] == 3:
        # bands of equal area on the sphere
        height = points[:, 2] / np.maximum(np.linalg.norm(points, axis=1), 1e-12)
        cells = azimuth + WEIGHT_SECTORS * np.clip(np.floor((height + 1.0) * 6.0).astype(int), 0, 11)
    weights = 1.0 / np.bincount(cells)[cells]
    balanced: Array = weights * (len(weights) / weights.sum())
    return balanced


def _weighted_quantile(values: Array, weights: Array, share: float) -> float:
    order = np.argsort(values, kind="stable")
    running = np.cumsum(weights[order])
    return float(values[order][min(int(np.searchsorted(running, share * running[-1])), len(order) - 1)])


def _no_ellipse(dimension: int) -> CalibrationError:
    shape, turn = (
        ("ellipse", "turn the vehicle through a full circle twice, on level ground")
        if dimension == 2
        else ("ellipsoid", "turn the unit about all of its axes; a vehicle that stays level has its own mode")
    )
    return CalibrationError(f"no {shape} goes through the samples: {turn}, away from iron, and record again")
