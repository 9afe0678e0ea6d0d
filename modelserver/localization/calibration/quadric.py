"""The ellipse or ellipsoid through points, fitted so that stray points do not count.

A centre b and a symmetric positive matrix A are found so that |A (p - b)| = 1 for the points p. First by algebra: the
quadric p'Qp + 2 q'p + c = 0 with trace Q = dimension, which is linear in what is sought and does not depend on how the
axes are laid; refitted a few times to the points nearest to it. Then by Gauss-Newton on the lengths |A (p - b)| - 1,
points far off weighted down.

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

from modelserver.localization.calibration.errors import CalibrationError
from modelserver.spatial.so3 import Array

TUKEY = 4.685
SPREAD = 1.4826
KEPT = 0.75
"""Share of the points that the algebraic fit is refitted to: a quarter may be strays."""

SECTORS = 36
"""Directions about the centre, in which points are counted: each counts as little as its sector is full."""

_ROUNDS = 8
_STEPS = 50
_FLOOR = 1e-6
"""Smallest spread of lengths that weights are made from: noise-free points are not strays of one another."""


@dataclass(frozen=True, slots=True)
class Quadric:
    """|matrix (p - centre)| = 1, in the unit of the points. `used` flags the points that were no strays, (n,).

    weights: (n,), what each point counted for its sector, without the strays' discount.
    """

    centre: Array
    matrix: Array
    used: npt.NDArray[np.bool_]
    weights: Array

    def normalized(self, points: Array) -> Array:
        """Return A (p - b), (n, d): on the unit circle or sphere but for noise."""
        mapped: Array = (points - self.centre) @ self.matrix
        return mapped


def fit(points: Array) -> Quadric:
    """Return the ellipse (n, 2) or ellipsoid (n, 3) through finite points.

    Raises CalibrationError where no ellipse goes through them: too few, on a line, or another curve.
    """
    count, dimension = points.shape
    unknown = dimension * (dimension + 3) // 2
    if count < 4 * unknown:
        raise CalibrationError(
            f"{count} samples are too few to fit a field to; {4 * unknown} are the least: record longer"
        )
    # near 1 in size and about the middle, for the sake of the arithmetic
    middle = (points.max(axis=0) + points.min(axis=0)) / 2.0
    size = float(np.abs(points - middle).max())
    if not size > 0.0:
        raise CalibrationError("all samples are equal: the unit was not turned, or its magnetometer is frozen")
    scaled = (points - middle) / size
    weights = _evened(scaled)
    centre, matrix = _algebraic(scaled, weights)
    for _ in range(_ROUNDS):
        mapped = (scaled - centre) @ matrix
        weights = _evened(mapped)
        off = np.abs(np.linalg.norm(mapped, axis=1) - 1.0)
        near = off <= _weighted_quantile(off, weights, KEPT)
        if near.sum() < 2 * unknown:
            break
        centre, matrix = _algebraic(scaled[near], weights[near])
    centre, matrix, used = _refined(scaled, weights, centre, matrix)
    return Quadric(centre * size + middle, matrix / size, used, weights)


def circle(points: Array) -> tuple[Array, float]:
    """Return centre and radius of the circle through points (n, 2), by algebra (I. Kasa, 1976); radius 0 for none."""
    middle = points.mean(axis=0) if len(points) else np.zeros(2)
    away = points - middle
    design = np.column_stack((2.0 * away, np.ones(len(away))))
    found, _, rank, _ = np.linalg.lstsq(design, (away**2).sum(axis=1), rcond=None)
    squared = float(found[2] + found[:2] @ found[:2])
    return found[:2] + middle, float(np.sqrt(max(squared, 0.0))) if rank == 3 else 0.0


def _algebraic(points: Array, weights: Array) -> tuple[Array, Array]:
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
    centre = -np.linalg.solve(Q, q)
    radius = float(centre @ Q @ centre) - c
    if radius <= 0.0:
        raise _no_ellipse(dimension)
    matrix: Array = vectors @ np.diag(np.sqrt(values / radius)) @ vectors.T
    return centre, matrix


def _refined(points: Array, weights: Array, centre: Array, matrix: Array) -> tuple[Array, Array, npt.NDArray[np.bool_]]:
    dimension = points.shape[1]
    pairs = list(combinations_with_replacement(range(dimension), 2))
    used = np.ones(len(points), dtype=bool)
    for _ in range(_STEPS):
        away = points - centre
        mapped = away @ matrix
        lengths = np.maximum(np.linalg.norm(mapped, axis=1), 1e-12)
        residuals = lengths - 1.0
        spread = max(SPREAD * _weighted_quantile(np.abs(residuals), weights, 0.5), _FLOOR)
        share = residuals / (TUKEY * spread)
        used = np.abs(share) < 1.0
        discount = np.where(used, (1.0 - share**2) ** 2, 0.0) * weights
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
        centre = centre + step[len(pairs) :]
        if not np.isfinite(step).all() or np.linalg.eigvalsh(matrix)[0] <= 0.0:
            raise _no_ellipse(dimension)
        if float(np.abs(step).max()) < 1e-10:
            break
    return centre, matrix, used


def _evened(points: Array) -> Array:
    """Return weights, mean 1, that let each direction about the origin count alike, however long one stood in it."""
    azimuth = np.floor((np.arctan2(points[:, 1], points[:, 0]) / (2.0 * np.pi) + 0.5) * SECTORS).astype(int) % SECTORS
    cells = azimuth
    if points.shape[1] == 3:
        # bands of equal area on the sphere
        height = points[:, 2] / np.maximum(np.linalg.norm(points, axis=1), 1e-12)
        cells = azimuth + SECTORS * np.clip(np.floor((height + 1.0) * 6.0).astype(int), 0, 11)
    weights = 1.0 / np.bincount(cells)[cells]
    evened: Array = weights * (len(weights) / weights.sum())
    return evened


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
