"""Loops: how far going round one misses, and whether the surveys of what it goes by let expect that.

A loop that is surveyed without error comes back to where it began. What it misses by is weighed against the covariance
of the way round: the squared Mahalanobis distance is distributed as chi-squared, with as many degrees of freedom as the
covariance has directions in which anything is uncertain at all. It is told as the number of standard deviations that a
single normal number would be as improbable at, so that 3 means the same for every loop.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from modelserver.geometry.edges import edges_along
from modelserver.geometry.parts import BodyFrame
from modelserver.geometry.topology import Crossing
from modelserver.spatial import chain, so3
from modelserver.spatial.chain import ChainLink
from modelserver.spatial.pose import Pose
from modelserver.spatial.so3 import Array

EXACT = 1e-6
"""Metres and radians: what misses by less closes within rounding."""

FIRST_ORDER = 0.1
"""Radians; turns are looked at to first order, and what is left out of larger ones excuses nothing more."""

MOST_SIGMAS = 30.0
"""What is less probable than this is not told apart: the probability itself comes near the least float there is."""

_ROUNDING = 1e-12
"""Eigenvalues this much smaller than the largest are rounding."""


class Closure(NamedTuple):
    """What going round a loop comes to, with joints that move where they rest.

    `metres` and `radians` is what it misses by; `sigmas` how improbable that is by what the surveys state: inf where
    they state that there is no error at all in its direction, None where `unstated`, names of frames and constraints,
    is not empty. `joints` are the joints that move on the way.
    """

    metres: float
    radians: float
    sigmas: float | None
    unstated: tuple[str, ...]
    joints: tuple[str, ...]

    @property
    def is_exact(self) -> bool:
        """Whether it closes within rounding."""
        return self.metres < EXACT and self.radians < EXACT


def closure(path: Sequence[Crossing], frame: Callable[[str], BodyFrame]) -> Closure:
    """Return what a way round comes to; it ends in the body that it begins in. `frame` gives a frame by its full name.

    Joints are taken to stand exactly where they rest: what is weighed is the survey.
    """
    start = path[0].enters
    links: list[ChainLink] = []
    unstated: list[str] = []
    joints: list[str] = []
    for edge in edges_along(path, frame, start, start):
        source = (edge.kind, edge.name)
        if edge.joint is not None:
            joints.append(edge.name)
            links.append(ChainLink(edge.joint.motion(edge.joint.rest), edge.forward, _CERTAIN, source))
            continue
        factor = edge.survey_factor
        if factor is None:
            unstated.append(edge.name)
        links.append(ChainLink(edge.pose, edge.forward, factor, source))
    round_ = chain.product(links)
    metres, radians = round_.distance(Pose.identity())
    with np.errstate(over="ignore", invalid="ignore"):
        covariance = chain.covariance(links)
    # the covariance is first order in the turns, and taken where they are measured; what second order makes of either,
    # an arm times the square of the turn and half of that, is no contradiction; a turn by a quarter is one all the same
    second = 2.0 * min(radians, FIRST_ORDER) ** 2
    tolerance = np.repeat((second * _reach(links), second), 3)
    sigmas = None if covariance is None else improbable(_residual(round_), covariance, tolerance)
    return Closure(metres, radians, sigmas, tuple(unstated), tuple(joints))


def _residual(pose: Pose) -> Array:
    return np.array((*pose.xyz, *so3.logarithm(pose.wxyz)))


def _reach(links: Sequence[ChainLink]) -> float:
    """Return how far from its start a way round comes at most, metres."""
    place, farthest = Pose.identity(), 0.0
    for link in links:
        place = place @ (link.X_FT if link.forward else link.X_FT.inverse())
        farthest = max(farthest, math.hypot(*place.xyz))
    return farthest


def improbable(residual: Array, covariance: Array, tolerance: Array | float = 0.0) -> float:
    """Return how many standard deviations of one normal number a residual (6) is as improbable as.

    `covariance` (6, 6) may be singular: a direction in which it is surer than `EXACT` counts as certain. `tolerance`,
    metres and radians, excuses: in a certain direction what is less, in the others as a sigma more. inf where the
    residual has more than that in a certain direction; at most `MOST_SIGMAS` otherwise.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        scaled = covariance / EXACT**2
    if not np.isfinite(scaled).all():
        # sigmas so large that their squares are out of reach exclude nothing
        return 0.0
    values, vectors = np.linalg.eigh(scaled)
    along = vectors.T @ residual / EXACT
    excused = (vectors.T * np.broadcast_to(np.asarray(tolerance, dtype=float), 6) / EXACT) ** 2
    slack = excused.sum(axis=1)
    certain = values <= max(1.0, _ROUNDING * float(values[-1]))
    if (np.abs(along[certain]) > 1.0 + np.sqrt(slack[certain])).any():
        return math.inf
    uncertain = ~certain
    weighed = along[uncertain] ** 2 / (values[uncertain] + slack[uncertain])
    return as_sigmas(float(np.sum(weighed)), int(np.sum(uncertain)))


def as_sigmas(square: float, degrees: int) -> float:
    """Return the standard deviations at which one normal number is as improbable as a chi-squared of that many degrees.

    For one degree that is the square root.
    """
    if degrees < 1:
        return 0.0
    if square > 2.0 * MOST_SIGMAS**2:
        # farther than six coordinates need to be; the probability itself would run out of floats
        return MOST_SIGMAS
    beyond = _chi_squared_beyond(square, degrees)
    return min(MOST_SIGMAS, max(0.0, -NormalDist().inv_cdf(beyond / 2.0)))


def _chi_squared_beyond(square: float, degrees: int) -> float:
    """Return the probability that chi-squared passes `square` (Abramowitz and Stegun, 26.4.4 and 26.4.5)."""
    half = square / 2.0
    if degrees % 2:
        total, power = math.erfc(math.sqrt(half)), 0.5
        term = math.exp(-half) * math.sqrt(half) / math.gamma(1.5)
    else:
        total, power = math.exp(-half), 1.0
        term = math.exp(-half) * half
    while power < degrees / 2.0:
        total += term
        power += 1.0
        term *= half / power
    return min(1.0, total)


_CERTAIN = np.zeros((6, 1))
