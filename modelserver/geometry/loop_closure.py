"""Loop misclosure: the error around a loop, and its significance given the uncertainty of the surveys.

A loop of exactly surveyed constraints closes. The misclosure, a pose error (6), is tested against the covariance of the
path around the loop: the squared Mahalanobis distance is chi-square distributed, with as many degrees of freedom as the
covariance has uncertain directions. It is reported as the number of standard deviations at which a single normal
variable is equally improbable, so that 3 means the same for every loop.

Assumption: joints are exactly at their default positions; what is tested is the survey. First-order covariance.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from modelserver.geometry.parts import BodyFrame
from modelserver.geometry.topology import Crossing, list_edges
from modelserver.transforms import chain, so3
from modelserver.transforms.chain import ChainLink
from modelserver.transforms.covariance import chi_square_survival
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Array

EXACT_TOLERANCE = 1e-6
"""Meters and radians below which a loop counts as closed."""

FIRST_ORDER = 0.1
"""Radians; up to this angle the second-order terms that the covariance neglects are tolerated."""

MAX_SIGMAS = 30.0
"""Limit of the significance: the probability itself is near the smallest float there."""

_ROUNDING = 1e-12
"""Eigenvalues this much smaller than the largest are rounding."""


class LoopMisclosure(NamedTuple):
    """The misclosure of a loop, with movable joints at their default positions.

    `meters` and `radians` are its size; `sigmas` its significance: inf where it has a component in a direction stated
    as exact, None where `missing_sigmas`, names of frames and constraints, is not empty. `joints` are the movable
    joints.
    """

    meters: float
    radians: float
    sigmas: float | None
    missing_sigmas: tuple[str, ...]
    joints: tuple[str, ...]

    @property
    def is_exact(self) -> bool:
        """Whether it closes within rounding."""
        return self.meters < EXACT_TOLERANCE and self.radians < EXACT_TOLERANCE


def compute_misclosure(path: Sequence[Crossing], frame: Callable[[str], BodyFrame]) -> LoopMisclosure:
    """Return the misclosure of a path that ends in the body that it starts from.

    `frame` returns a frame by its full name.
    """
    start = path[0].near_frame
    links: list[ChainLink] = []
    missing: list[str] = []
    joints: list[str] = []
    for edge in list_edges(path, frame, start, start):
        source = (edge.kind, edge.name)
        if edge.joint is not None:
            joints.append(edge.name)
            links.append(ChainLink(edge.joint.compute_pose(edge.joint.default_position), edge.forward, _EXACT, source))
            continue
        factor = edge.survey_factor
        if factor is None:
            missing.append(edge.name)
        links.append(ChainLink(edge.pose, edge.forward, factor, source))
    places = chain.frame_poses(links)
    around = places[-1]
    meters, radians = around.distance(Pose.identity())
    with np.errstate(over="ignore", invalid="ignore"):
        covariance = chain.covariance(links)
    # the covariance neglects the second order in the rotation, lever arm times square of the angle: tolerate as much
    second = 2.0 * min(radians, FIRST_ORDER) ** 2
    farthest = max(math.hypot(*place.xyz) for place in places)
    tolerance = np.repeat((second * farthest, second), 3)
    residual = np.array((*around.xyz, *so3.logarithm(around.wxyz)))
    sigmas = None if covariance is None else residual_significance(residual, covariance, tolerance)
    return LoopMisclosure(meters, radians, sigmas, tuple(missing), tuple(joints))


def residual_significance(residual: Array, covariance: Array, tolerance: Array | float = 0.0) -> float:
    """Return the significance of a residual (6), in standard deviations of a single normal variable.

    `covariance` (6, 6) may be singular: a direction with a sigma below `EXACT_TOLERANCE` counts as exact. `tolerance`,
    meters and radians, is allowed in exact directions and is added to the variance in the others. inf where the
    residual in an exact direction is larger; at most `MAX_SIGMAS` otherwise.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        scaled = covariance / EXACT_TOLERANCE**2
    if not np.isfinite(scaled).all():
        # sigmas whose squares overflow exclude nothing
        return 0.0
    values, vectors = np.linalg.eigh(scaled)
    along = vectors.T @ residual / EXACT_TOLERANCE
    allowed = (vectors.T * np.broadcast_to(np.asarray(tolerance, dtype=float), 6) / EXACT_TOLERANCE) ** 2
    slack = allowed.sum(axis=1)
    exact = values <= max(1.0, _ROUNDING * float(values[-1]))
    if (np.abs(along[exact]) > 1.0 + np.sqrt(slack[exact])).any():
        return math.inf
    uncertain = ~exact
    squares = along[uncertain] ** 2 / (values[uncertain] + slack[uncertain])
    return chi_square_to_sigmas(float(np.sum(squares)), int(np.sum(uncertain)))


def chi_square_to_sigmas(square: float, degrees: int) -> float:
    """Return the standard deviations at which a normal variable is as improbable as a chi-square value.

    For one degree of freedom that is the square root.
    """
    if degrees < 1:
        return 0.0
    if square > 1.5 * MAX_SIGMAS**2:
        # more than MAX_SIGMAS for up to six degrees of freedom; the probability underflows from 1480 on
        return MAX_SIGMAS
    probability = chi_square_survival(square, degrees)
    return min(MAX_SIGMAS, max(0.0, -NormalDist().inv_cdf(probability / 2.0)))


_EXACT = np.zeros((6, 1))
