"""Calibration of a magnetometer: hard and soft iron from samples taken while turning.

The unit feels m = W h + b: the earth's field h bent by soft iron, W, and the vehicle's own field b, hard iron, both
turning with it. Sought are b and a symmetric A, so that |A (m - b)| is the strength of the earth's field whatever way
the vehicle stands; a rotation common to all samples stays unknown, for lengths do not show it (A is W's inverse but for
that), and a symmetric A is the choice with the least of it.

A ground vehicle turns about the vertical alone. Then the horizontal part of m runs round an ellipse, and the planar
mode finds what levels it into a circle; what turning does not show, the vertical, is left as it is. Hard iron found so
holds for level ground: on a slope, soft iron's share of the vertical field comes back.

Source: V. Renaudin, M. Afzal and G. Lachapelle, "Complete triaxis magnetometer calibration in the magnetic domain",
2010; the fit itself is in quadric.py.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from modelserver.localization.calibration import quadric
from modelserver.localization.calibration.errors import CalibrationError
from modelserver.messages.samples import Matrix3
from modelserver.spatial.so3 import Array, Vector3

SECTORS = 12
"""Sectors of 30 degrees in which the directions are counted."""

NEEDED_SECTORS = 10
"""Sectors that must have been seen: over what is missing the ellipse is extrapolated, and nothing would show there that
something else moved the field."""

NEEDED_SPREAD = 0.3
"""For the mode of all axes: how much of the sphere's height the directions must reach over on its least-seen axis:
17 degrees of elevation to both sides."""

LARGEST_RESIDUAL = 0.1
"""Largest residual as a share of the strength: beyond, the samples lie on no ellipse (6 degrees of heading)."""

BEND = 3.0
"""Largest ratio of the axes of the ellipse, and of its size and the known field's: soft iron bends by a few tens of
percent; beyond, the unit's scale is wrong or the turn was no turn."""


@dataclass(frozen=True, slots=True)
class Coverage:
    """Which directions the samples cover. sectors: SECTORS flags, counter-clockwise about `axis` (unit vector along
    the sensor's axes). spread: share of the sphere's height reached along `axis`; NaN in planar mode.
    """

    sectors: tuple[bool, ...]
    axis: Vector3
    spread: float

    @property
    def share(self) -> float:
        """Share of the sectors that were seen."""
        return sum(self.sectors) / len(self.sectors)


@dataclass(frozen=True, slots=True)
class MagnetometerFit:
    """A magnetometer's calibration: the field is `soft_iron` (m - `hard_iron`).

    hard_iron: along the sensor's axes, tesla. soft_iron: 3 x 3, symmetric, row-major. planar: whether only the
    horizontal was found. strength: what lengths were fitted to, tesla: of the horizontal field in planar mode, else of
    the whole; strength_known: whether it was given, or is the mean radius. rms: of the lengths' residuals without the
    strays, tesla; heading_rms: what it does to a heading, radians, NaN where the horizontal field is unknown.
    samples: how many finite ones there were; strays: how many of them the fit left out.
    """

    hard_iron: Vector3
    soft_iron: Matrix3
    planar: bool
    strength: float
    strength_known: bool
    rms: float
    heading_rms: float
    coverage: Coverage
    samples: int
    strays: int

    def applied(self, fields: npt.ArrayLike) -> Array:
        """Return the fields (n, 3) without the vehicle's share, along the sensor's axes, tesla."""
        away = np.asarray(fields, dtype=float) - np.array(self.hard_iron)
        corrected: Array = away @ np.array(self.soft_iron).reshape(3, 3).T
        return corrected


def fit_all_axes(fields: npt.ArrayLike, strength: float = math.nan, horizontal: float = math.nan) -> MagnetometerFit:
    """Return the calibration of a unit that was turned about all of its axes.

    `fields`: (n, 3) along the sensor's axes, tesla; rows that are not finite are left out. `strength`: of the earth's
    field at the place, tesla (`magnetism.field_at`), NaN where unknown: then the mean radius. `horizontal`: of its
    horizontal part, for the error of heading alone.
    Raises CalibrationError where the turn was not enough, saying what was covered.
    """
    points = _finite(fields)
    found = quadric.fit(points)
    known = math.isfinite(strength)
    radius = float(np.linalg.det(found.matrix)) ** (-1.0 / 3.0)
    target = strength if known else radius
    unit = found.normalized(points[found.used])
    coverage = _all_round(unit)
    _check_coverage(coverage)
    A = found.matrix * target
    _check_bend(A, known)
    rms = _rms(unit, found.weights[found.used]) * target
    return MagnetometerFit(
        hard_iron=_vector(found.centre),
        soft_iron=_matrix(A),
        planar=False,
        strength=target,
        strength_known=known,
        rms=_checked(rms, target),
        heading_rms=rms / horizontal,
        coverage=coverage,
        samples=len(points),
        strays=int((~found.used).sum()),
    )


def fit_level(
    fields: npt.ArrayLike, up: Vector3, horizontal: float = math.nan, vertical: float = math.nan
) -> MagnetometerFit:
    """Return the calibration of a unit on a vehicle that turned about the vertical alone, on level ground.

    `fields`: (n, 3) along the sensor's axes, tesla; rows that are not finite are left out. `up`: the direction of the
    mean specific force, along the sensor's axes. `horizontal`, `vertical`: the earth's field at the place, along
    magnetic north and up, tesla; NaN where unknown. Without the first the mean radius is taken; without the second the
    hard iron along the vertical is 0, and the strength of the corrected field is not to be compared with the earth's.
    Raises CalibrationError where the turn was not enough, saying what was covered.
    """
    points = _finite(fields)
    E = _level_axes(up)
    level, height = points @ E[:, :2], points @ E[:, 2]
    try:
        found = quadric.fit(level)
    except CalibrationError as error:
        raise _with_coverage(error, level) from None
    known = math.isfinite(horizontal)
    radius = float(np.linalg.det(found.matrix)) ** -0.5
    target = horizontal if known else radius
    unit = found.normalized(level[found.used])
    coverage = Coverage(_seen(unit[:, 0], unit[:, 1]), _vector(E[:, 2]), math.nan)
    _check_coverage(coverage)
    A = np.eye(3)
    A[:2, :2] = found.matrix * target
    _check_bend(A[:2, :2], known)
    weights = found.weights[found.used]
    rms = _rms(unit, weights) * target
    offset = 0.0
    if math.isfinite(vertical):
        offset = float(np.average(height[found.used], weights=weights)) - vertical
    return MagnetometerFit(
        hard_iron=_vector(E @ np.array([*found.centre, offset])),
        soft_iron=_matrix(E @ A @ E.T),
        planar=True,
        strength=target,
        strength_known=known,
        rms=_checked(rms, target),
        heading_rms=rms / target,
        coverage=coverage,
        samples=len(points),
        strays=int((~found.used).sum()),
    )


def level_plane(fields: npt.ArrayLike, up: Vector3) -> Array:
    """Return the horizontal parts (n, 2) of vectors (n, 3) along the sensor's axes, as `fit_level` sees them."""
    plane: Array = np.asarray(fields, dtype=float) @ _level_axes(up)[:, :2]
    return plane


def _finite(fields: npt.ArrayLike) -> Array:
    points = np.asarray(fields, dtype=float).reshape(-1, 3)
    finite: Array = points[np.isfinite(points).all(axis=1)]
    return finite


def _level_axes(up: Vector3) -> Array:
    """Return, as columns, two axes of the horizontal plane and up, right-handed, along the sensor's axes."""
    length = math.hypot(*up)
    if not (math.isfinite(length) and length > 0.0):
        raise CalibrationError(f"up must be a direction, got {up}: the unit gives no specific force")
    z = np.array(up) / length
    # the sensor's axis that lies most level starts the plane
    x = np.zeros(3)
    x[int(np.argmin(np.abs(z)))] = 1.0
    x = x - (x @ z) * z
    x /= np.linalg.norm(x)
    return np.column_stack((x, np.cross(z, x), z))


def _all_round(unit: Array) -> Coverage:
    """Return the coverage of directions on the sphere about the axis along which they spread least."""
    _, vectors = np.linalg.eigh(np.cov(unit.T))
    E = _level_axes(_vector(vectors[:, 0]))
    heights = unit @ E[:, 2]
    low, high = np.quantile(heights, (0.02, 0.98))
    return Coverage(_seen(unit @ E[:, 0], unit @ E[:, 1]), _vector(E[:, 2]), float(high - low) / 2.0)


def _seen(x: Array, y: Array) -> tuple[bool, ...]:
    sectors = np.floor(np.arctan2(y, x) / (2.0 * np.pi) * SECTORS).astype(int) % SECTORS
    counts = np.bincount(sectors, minlength=SECTORS)
    # a single stray sample does not cover 30 degrees
    return tuple(bool(count >= 3) for count in counts)


def _with_coverage(error: CalibrationError, level: Array) -> CalibrationError:
    """Return the error of a fit that found no ellipse, with what was covered, where a circle shows it roughly."""
    centre, radius = quadric.circle(level)
    if not radius > 0.0:
        return error
    away = level - centre
    off = np.linalg.norm(away, axis=1) / radius - 1.0
    if not float(np.sqrt(np.mean(off**2))) <= LARGEST_RESIDUAL:
        return error
    seen = sum(_seen(away[:, 0], away[:, 1]))
    return CalibrationError(f"{error}; the samples lie on about {seen} of {SECTORS} sectors of 30 degrees")


def _check_coverage(coverage: Coverage) -> None:
    seen = sum(coverage.sectors)
    if seen < NEEDED_SECTORS:
        raise CalibrationError(
            f"the field was seen from {seen} of {SECTORS} sectors of 30 degrees, {NEEDED_SECTORS} are needed: turn the "
            "vehicle slowly through a full circle twice, on level ground and away from iron, and record again"
        )
    if coverage.spread < NEEDED_SPREAD:
        raise CalibrationError(
            f"the directions reach over {coverage.spread:.0%} of the sphere's height along the sensor's axis "
            f"({', '.join(f'{each:.2f}' for each in coverage.axis)}), {NEEDED_SPREAD:.0%} are needed: roll and pitch "
            "the unit more; a vehicle that stays level is calibrated in the level mode"
        )


def _check_bend(A: Array, known: bool) -> None:
    values = np.linalg.eigvalsh(A)
    if values[-1] > BEND * values[0]:
        raise CalibrationError(
            f"the samples lie on an ellipse {values[-1] / values[0]:.1f} times as long as wide, and iron bends a "
            "field by less: turn through full circles in one place, away from iron, and record again"
        )
    if known and not 1.0 / BEND < float(np.mean(values)) < BEND:
        raise CalibrationError(
            f"the felt field is {1.0 / float(np.mean(values)):.2g} times the earth's at the place: look at the unit's "
            "scale (tesla; 1 gauss is 1e-4 tesla), or whether it turned at all"
        )


def _rms(unit: Array, weights: Array) -> float:
    off = np.linalg.norm(unit, axis=1) - 1.0
    return math.sqrt(float(np.average(off**2, weights=weights)))


def _checked(rms: float, strength: float) -> float:
    if rms > LARGEST_RESIDUAL * strength:
        raise CalibrationError(
            f"the samples scatter by {rms / strength:.0%} of the field about the fit, {LARGEST_RESIDUAL:.0%} are "
            "allowed: the vehicle was not turned, or something else moved the field; turn in one place, away from iron"
        )
    return rms


def _vector(values: Array) -> Vector3:
    x, y, z = (float(each) for each in values)
    return (x, y, z)


def _matrix(values: Array) -> Matrix3:
    a, b, c, d, e, f, g, h, i = (float(each) for each in ((values + values.T) / 2.0).ravel())
    return (a, b, c, d, e, f, g, h, i)
