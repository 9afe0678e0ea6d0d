"""Magnetometer calibration: hard and soft iron from samples recorded while turning.

The unit measures m = W h + b: the earth's field h distorted by soft iron, W, and the vehicle's own field b, hard iron.
A symmetric A and b are fitted so that |A (m - b)| is the strength of the earth's field in every orientation. A rotation
common to all samples cannot be determined from lengths; a symmetric A is the choice with the smallest.

A ground vehicle turns about the vertical alone: the horizontal part of m moves on an ellipse, which A maps to a circle;
the vertical, which such a turn does not determine, is left as it is. Limit: hard iron found so holds for level ground;
on a slope, soft iron's share of the vertical field returns.

Found are a center b and a symmetric positive definite matrix A, so that |A (p - b)| = 1 for the points p. First
an algebraic fit: the conic p'Qp + 2 q'p + c = 0 with trace Q = 2, which is linear in the unknowns and invariant to
rotation of the axes; refitted a few times to the nearest points (least trimmed squares). Then Gauss-Newton on the
lengths |A (p - b)| - 1 with Tukey's weights. Points are weighted so that each direction counts equally.

Sources: V. Renaudin, M. Afzal and G. Lachapelle, "Complete triaxis magnetometer calibration in the magnetic domain",
2010 (the whole; A and b from a quadric); J. Vasconcelos et al., "Geometric approach to strapdown magnetometer
calibration in sensor frame", 2011 (refinement on lengths); P. Rousseeuw and K. Van Driessen, "Computing LTS regression
for large data sets", 2006 (refitting to the nearest); P. Holland and R. Welsch, "Robust regression using iteratively
reweighted least-squares", 1977 (Tukey's weights, 4.685; spread from the median, 1.4826).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from modelserver.transforms.so3 import Array, Matrix3, Vector3, to_vector3
from mstools.calibration import CalibrationError

SECTORS = 12
"""Sectors of 30 degrees in which the directions are counted."""

MIN_SECTORS = 10
"""Sectors that must be covered: elsewhere the ellipse is extrapolated, and disturbances of the field would not show."""

MAX_RESIDUAL = 0.1
"""Largest residual as a share of the strength: beyond, the samples are on no ellipse (6 degrees of heading)."""

MAX_AXIS_RATIO = 3.0
"""Largest ratio of the axes of the ellipse, and of its size and the known field's: soft iron distorts by a few tens of
percent; beyond, the unit's scale is wrong or the turn was incomplete.
"""


@dataclass(frozen=True, slots=True)
class MagnetometerFit:
    """A magnetometer's calibration: the field is `soft_iron` (m - `hard_iron`).

    hard_iron: along the sensor's axes, tesla. soft_iron: 3 x 3, symmetric, row-major. strength: of the horizontal
    field, tesla; is_strength_known: whether it was given, or is the mean radius. rms: of the residuals of the inliers,
    tesla; heading_rms: the resulting error of heading, radians. sectors: SECTORS flags of the directions that the
    samples cover, counter-clockwise about the unit vector `up`. samples: number of finite ones; outliers: those not
    used.
    """

    hard_iron: Vector3
    soft_iron: Matrix3
    strength: float
    is_strength_known: bool
    rms: float
    heading_rms: float
    sectors: tuple[bool, ...]
    up: Vector3
    samples: int
    outliers: int

    @property
    def hard_iron_sigma(self) -> float:
        """Standard deviation of a horizontal component of the hard iron, tesla, for residuals without correlation.

        Each sample's residual changes by -n with the center, n the direction of the field; over a circle the mean of
        n n' is half the unit matrix.
        """
        return self.rms * math.sqrt(2.0 / max(self.samples - self.outliers, 1))

    @property
    def soft_iron_sigma(self) -> float:
        """Largest standard deviation of a horizontal element of the soft iron, as `hard_iron_sigma`.

        The residual, relative to the strength, changes by (c^2, 2 c s, s^2) with the elements, for a direction (c, s);
        over a circle their normal matrix is 1/8 (3 0 1; 0 4 0; 1 0 3), whose inverse has 3, 2 and 3 on its diagonal.
        """
        return self.heading_rms * math.sqrt(3.0 / max(self.samples - self.outliers, 1))

    def apply(self, fields: npt.ArrayLike) -> Array:
        """Return the corrected fields (n, 3), along the sensor's axes, tesla."""
        away = np.asarray(fields, dtype=float) - np.array(self.hard_iron)
        corrected: Array = away @ np.array(self.soft_iron).reshape(3, 3).T
        return corrected


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
    points = np.asarray(fields, dtype=float).reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    E = _level_axes(up)
    level, height = points @ E[:, :2], points @ E[:, 2]
    found = fit_ellipse(level)
    used, weights = found.is_inlier, found.weights[found.is_inlier]
    unit = found.normalize(level[used])
    # a single outlier does not cover 30 degrees
    sectors = tuple((np.bincount(_find_sectors(unit, SECTORS), minlength=SECTORS) >= 3).tolist())
    if sum(sectors) < MIN_SECTORS:
        raise CalibrationError(
            f"the samples cover {sum(sectors)} of {SECTORS} sectors of 30 degrees, {MIN_SECTORS} are needed: turn the "
            "vehicle slowly through a full circle twice, on level ground and away from iron, and record again"
        )
    known = math.isfinite(horizontal)
    target = horizontal if known else float(np.linalg.det(found.matrix)) ** -0.5
    A = np.eye(3)
    A[:2, :2] = found.matrix * target
    _check_axis_ratio(A[:2, :2], known)
    rms = math.sqrt(float(np.average((np.linalg.norm(unit, axis=1) - 1.0) ** 2, weights=weights))) * target
    if rms > MAX_RESIDUAL * target:
        raise CalibrationError(
            f"the samples scatter by {rms / target:.0%} of the field about the fit, {MAX_RESIDUAL:.0%} are "
            "allowed: the vehicle was not turned, or something else moved the field; turn in one place, away from iron"
        )
    offset = float(np.average(height[used], weights=weights)) - vertical if math.isfinite(vertical) else 0.0
    A = E @ A @ E.T
    a, b, c, d, e, f, g, h, i = (float(each) for each in ((A + A.T) / 2.0).ravel())
    return MagnetometerFit(
        hard_iron=to_vector3(E @ np.array([*found.center, offset])),
        soft_iron=(a, b, c, d, e, f, g, h, i),
        strength=target,
        is_strength_known=known,
        rms=rms,
        heading_rms=rms / target,
        sectors=sectors,
        up=to_vector3(E[:, 2]),
        samples=len(points),
        outliers=int((~used).sum()),
    )


def project_to_level(fields: npt.ArrayLike, up: Vector3) -> Array:
    """Return the horizontal parts (n, 2) of vectors (n, 3) along the sensor's axes, as in `fit_level`."""
    plane: Array = np.asarray(fields, dtype=float) @ _level_axes(up)[:, :2]
    return plane


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


def _find_sectors(points: Array, count: int) -> npt.NDArray[np.int64]:
    """Return the sector about the origin, of so many, in which each point (n, 2) is."""
    turns = np.arctan2(points[:, 1], points[:, 0]) / (2.0 * np.pi)
    return np.floor(turns * count).astype(np.int64) % count


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


# --- robust fit of an ellipse -------------------------------------------------------------------------------

TUKEY = 4.685
SPREAD = 1.4826
TRIM_SHARE = 0.75
"""Share of the points that the algebraic fit is refitted to: a quarter may be outliers."""

WEIGHT_SECTORS = 36
"""Sectors about the center in which points are counted; a point's weight is inverse to the count of its sector."""

MIN_SAMPLES = 20
"""Four for each of the five unknowns of an ellipse."""

_ROUNDS = 8
_STEPS = 50
_FLOOR = 1e-6
"""Smallest spread of lengths for the weights: noise-free points are no outliers."""


@dataclass(frozen=True, slots=True)
class Ellipse:
    """|matrix (p - center)| = 1, in the unit of the points.

    is_inlier: (n,), the points that are no outliers. weights: (n,), of each point by its sector, without Tukey's
    weight.
    """

    center: Array
    matrix: Array
    is_inlier: npt.NDArray[np.bool_]
    weights: Array

    def normalize(self, points: Array) -> Array:
        """Return A (p - b), (n, 2): on the unit circle except for noise."""
        mapped: Array = (points - self.center) @ self.matrix
        return mapped


_NO_ELLIPSE: Final = (
    "no ellipse goes through the samples: turn the vehicle through a full circle twice, on level ground, away from "
    "iron, and record again"
)


def fit_ellipse(points: Array) -> Ellipse:
    """Return the ellipse through finite points (n, 2).

    Raises CalibrationError where none fits: too few points, on a line, or on another curve.
    """
    if len(points) < MIN_SAMPLES:
        raise CalibrationError(
            f"{len(points)} samples are too few for a fit; at least {MIN_SAMPLES} are needed: record longer"
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
        if near.sum() < MIN_SAMPLES // 2:
            break
        center, matrix = _fit_algebraic(scaled[near], weights[near])
    center, matrix, is_inlier = _refine(scaled, weights, center, matrix)
    return Ellipse(center * size + middle, matrix / size, is_inlier, weights)


def _fit_algebraic(points: Array, weights: Array) -> tuple[Array, Array]:
    x, y = points.T
    # Q = [[1 + a, b], [b, 1 - a]]
    design = np.column_stack((x * x - y * y, 2.0 * x * y, 2.0 * x, 2.0 * y, np.ones(len(x))))
    root = np.sqrt(weights)
    found, _, rank, _ = np.linalg.lstsq(design * root[:, None], -(x * x + y * y) * root, rcond=1e-10)
    a, b, *q, c = found
    Q = np.array([[1.0 + a, b], [b, 1.0 - a]])
    values, vectors = np.linalg.eigh(Q)
    if rank < 5 or values[0] <= 1e-6 * values[-1]:
        raise CalibrationError(_NO_ELLIPSE)
    center = -np.linalg.solve(Q, q)
    radius = float(center @ Q @ center - c)
    if radius <= 0.0:
        raise CalibrationError(_NO_ELLIPSE)
    matrix: Array = vectors @ np.diag(np.sqrt(values / radius)) @ vectors.T
    return center, matrix


def _refine(points: Array, weights: Array, center: Array, matrix: Array) -> tuple[Array, Array, npt.NDArray[np.bool_]]:
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
        (n, m), (x, y) = directions.T, away.T
        jacobian = np.column_stack((n * x, n * y + m * x, m * y, -directions @ matrix))
        root = np.sqrt(discount)
        step, *_ = np.linalg.lstsq(jacobian * root[:, None], -residuals * root, rcond=1e-10)
        matrix = matrix + step[[0, 1, 1, 2]].reshape(2, 2)
        center = center + step[3:]
        if not np.isfinite(step).all() or np.linalg.eigvalsh(matrix)[0] <= 0.0:
            raise CalibrationError(_NO_ELLIPSE)
        if float(np.abs(step).max()) < 1e-10:
            break
    return center, matrix, is_inlier


def _balance_weights(points: Array) -> Array:
    """Return weights, mean 1, with equal sums in all directions about the origin, however many samples each has."""
    sectors = _find_sectors(points, WEIGHT_SECTORS)
    weights = 1.0 / np.bincount(sectors)[sectors]
    balanced: Array = weights * (len(weights) / weights.sum())
    return balanced


def _weighted_quantile(values: Array, weights: Array, share: float) -> float:
    order = np.argsort(values, kind="stable")
    running = np.cumsum(weights[order])
    return float(values[order][min(int(np.searchsorted(running, share * running[-1])), len(order) - 1)])
