"""Robust fit of an ellipse or ellipsoid to points.

Found are a center b and a symmetric positive definite matrix A, so that |A (p - b)| = 1 for the points p. First an
algebraic fit: the quadric p'Qp + 2 q'p + c = 0 with trace Q = dimension, which is linear in the unknowns and invariant
to rotation of the axes; refitted a few times to the nearest points (least trimmed squares). Then Gauss-Newton on the
lengths |A (p - b)| - 1 with Tukey's weights. Points are weighted so that each direction counts equally.

Sources: V. Renaudin, M. Afzal and G. Lachapelle, "Complete triaxis magnetometer calibration in the magnetic domain",
2010 (quadric, and A and b from it); J. Vasconcelos et al., "Geometric approach to strapdown magnetometer calibration in
sensor frame", 2011 (refinement on lengths); P. Rousseeuw and K. Van Driessen, "Computing LTS regression for large data
sets", 2006 (refitting to the nearest); P. Holland and R. Welsch, "Robust regression using iteratively reweighted
least-squares", 1977 (Tukey's weights, 4.685; spread from the median, 1.4826).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np
import numpy.typing as npt

from modelserver.transforms.so3 import Array
from mstools.calibration import CalibrationError

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


def fit(points: Array) -> Quadric:
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
