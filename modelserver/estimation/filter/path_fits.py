"""Fits over windows of the path: what explains fixes that do not agree with it, and whether fixes drift.

A gyro whose bias has changed bends the path, e_j = i b m_j; wheels that slip scale it, e_j = s d_j; a latency that has
changed displaces it, e_j = -l (v_j - v_k); an antenna that is elsewhere turns with the vehicle,
e_j = (exp(i psi_j) - exp(i psi_k)) a. None explains fixes that drift, e_j = v (t_j - t_k), in turns and changes of
speed, or that jump. Each fit has the covariance of (1) in `path_windows` over the window, and the errors u of the state
as parameters with their sigmas; what it explains is its evidence, so a cause with more parameters does not win by that.
The path is replayed with bias and scale as they were at the start of the window, since a state that follows the fixes
hides what has changed. A turn by half a radian is not linear, so fits are repeated about the path that they have turned
(Gauss-Newton). Evidence is comparable over the same fixes only: a drift that began within the window of another cause
has to explain all of that window.

All windows end at the newest node. They are fitted together, as arrays over windows and nodes, since most of the work
for one would be overhead: shorter windows are filled up in front by nodes without error and of unit variance.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence
from enum import Enum
from types import MappingProxyType
from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from modelserver.estimation.filter.path_windows import (
    MAX_INFLATION,
    Discrepancy,
    PathNode,
    PathNoise,
    compare_window,
    get_fix_variance,
    is_direction_known,
    shift_fix,
)
from modelserver.estimation.filter.protection_levels import compute_longest_axis
from modelserver.estimation.filter.settings import FilterSettings

Array: TypeAlias = npt.NDArray[Any]

MODEL_ERROR: Final = 0.05
"""Meters that no cause explains, as slip that comes and goes: with fixes of centimeters."""

LARGEST_REST: Final = 2.0
"""Mean square, over each axis, that a cause may leave unexplained, relative to the variance of the fixes, and so may a
drift, of those that are trusted again."""

LARGEST_FIX_SIGMA: Final = 0.2
"""Standard deviation of fixes, m, that show an error of the lever arm: others err by more than any lever arm."""

STEADY_SIGMA: Final = 0.03
"""Largest standard deviation of the drift of fixes, m/s, that are trusted again wherever they are."""

EXCLUDING_SIGMAS: Final = 3.0
"""Standard deviations by which the drift of fixes that are trusted again is less than the one that was found."""


class Cause(Enum):
    """What explains fixes that do not agree with the path."""

    GNSS = "gnss"
    HEADING = "heading"
    GYRO = "gyro"
    WHEELS = "wheels"
    LATENCY = "latency"
    LEVER_ARM = "lever_arm"


TYPICAL_CHANGE: Final = MappingProxyType({Cause.GYRO: 0.01, Cause.WHEELS: 0.1, Cause.LATENCY: 0.4})
"""Sigma of a change of the gyro's bias (rad/s), of the wheels' scale, and of the latency (s), that is a fault."""

TYPICAL_DRIFT: Final = 0.3
TYPICAL_JUMP: Final = 10.0
TYPICAL_LEVER_ARM: Final = 0.5
"""Sigma of a drift of fixes, m/s, of a jump, m, and of an error of the lever arm, m, that are a fault."""


class Inconsistency(NamedTuple):
    """What explains fixes that do not agree with the path, over the window with the largest discrepancy.

    `change` is that of the heading (rad), of the gyro's bias (rad/s), of the wheels' scale, or of the latency (s);
    `explained` is twice the logarithm of its evidence beside that of no cause. `turned`: by which the
    state has turned beside a gyro of the former bias, rad. `is_jump`: the fixes left the path at once, as no error of
    dead reckoning does. `lever_arm`: the antenna beside its place in the geometry, forward + i left, m.
    """

    cause: Cause
    discrepancy: Discrepancy
    change: float = 0.0
    explained: float = 0.0
    turned: float = 0.0
    lever_arm: complex = 0j
    is_jump: bool = False


class CauseModel(NamedTuple):
    """Errors that a cause adds: its columns in `find_causes`, and the standard deviation of their factors."""

    cause: Cause
    columns: tuple[int, ...]
    sigma: float


MEASURED: Final = 0
USUAL: Final = (1, 2, 3)
RATE: Final = 2
"""Columns of `find_causes`: errors of the fixes, and errors that the state knows of the path; which of them is that of
its turn rate."""

ALONG_BOTH_AXES: Final = (
    CauseModel(Cause.GNSS, (4, 5), TYPICAL_DRIFT),
    CauseModel(Cause.GNSS, (6, 7), TYPICAL_JUMP),
    CauseModel(Cause.LEVER_ARM, (8, 9), TYPICAL_LEVER_ARM),
)
OF_THE_PATH: Final = (
    CauseModel(Cause.WHEELS, (2,), TYPICAL_CHANGE[Cause.WHEELS]),
    # a latency that has changed before the window too, and from its start on
    CauseModel(Cause.LATENCY, (10,), TYPICAL_CHANGE[Cause.LATENCY]),
    CauseModel(Cause.LATENCY, (11,), TYPICAL_CHANGE[Cause.LATENCY]),
)
"""Models with two parameters, and with one."""

NO_CAUSE: Final = (CauseModel(Cause.GNSS, (), 1.0),)
OF_THE_GYRO: Final = (CauseModel(Cause.GYRO, (3,), TYPICAL_CHANGE[Cause.GYRO]),)
BENDS: Final = 3
"""Models of no fault and of a gyro's bias, and how often their fits are repeated about the path that the last one bent:
see the module's theory."""


def find_causes(
    nodes: Sequence[PathNode], newest: PathNode, noise: PathNoise, settings: FilterSettings
) -> dict[Cause, Inconsistency]:
    """Return each cause over the window with its largest evidence, of those from one of the nodes to the newest.

    Only windows in which the path's direction is known, and causes other than GNSS that leave about the noise of fixes.
    """
    starts = [k for k, start in enumerate(nodes) if is_direction_known(start, newest)]
    if not starts:
        return {}
    nodes = (*nodes[starts[0] :], newest)
    first = np.array(starts) - starts[0]
    replayed = replay_paths(nodes, first)
    inside = replayed.is_inside
    weights = np.linalg.inv(_get_covariances(nodes, first, inside, noise, settings))
    begins = [nodes[k] for k in first]
    usual = np.sqrt([(each.heading_variance, each.scale_variance, each.rate_variance) for each in begins])
    is_precise = np.array([each.correlated < LARGEST_FIX_SIGMA for each in begins])
    largest = 2.0 * LARGEST_REST * inside.sum(axis=1)

    straight = _weight(_find_errors(nodes, first, np.zeros(len(first))), weights)

    def bend(models: Sequence[CauseModel]) -> tuple[Array, Array]:
        """Return the turn rates of the fits of one model, and the products about the paths that they turn."""
        products = straight
        for _ in range(BENDS):
            factors, _, _ = _fit(products, usual, models)
            rates = factors[:, 0, RATE] + factors[:, 0, len(USUAL) :].sum(axis=1)
            products = _weight(_find_errors(nodes, first, rates), weights)
        return rates, products

    # by the errors that the state knows alone
    rates, bent = bend(NO_CAUSE)
    _, _, none = _fit(bent, usual, NO_CAUSE)
    _, of_the_gyro = bend(OF_THE_GYRO)
    drifts = np.full(len(first), -math.inf)
    found: dict[Cause, Inconsistency] = {}
    for models, products in ((ALONG_BOTH_AXES, bent), (OF_THE_PATH, bent), (OF_THE_GYRO, of_the_gyro)):
        factors, rest, evidence = _fit(products, usual, models)
        explained = none - evidence
        for n, (cause, _, _) in enumerate(models):
            if cause is Cause.LATENCY and not newest.shows_latency:
                continue
            if cause is Cause.GNSS:
                drifts = np.maximum(drifts, explained[:, n])
            else:
                explained[rest[:, n] > largest, n] = -math.inf
            if cause is Cause.LEVER_ARM:
                explained[~is_precise, n] = -math.inf
            k = int(np.argmax(explained[:, n]))
            size = float(explained[k, n])
            if size == -math.inf or (cause in found and size <= found[cause].explained):
                continue
            start, (path, moment, turned) = begins[k], replayed.get_last(k)
            end = newest._replace(
                path=start.path + path,
                moment=start.moment + moment,
                rotation=newest.rotation - turned,
                latency=start.latency,
            )
            change, *more = factors[k, n, len(USUAL) :].tolist()
            found[cause] = Inconsistency(
                cause,
                compare_window(start, end, noise, settings),
                math.hypot(change, *more) if more else change,
                size,
                end.rotation - start.rotation,
                complex(change, *more),
            )
    if others := [each for cause, each in found.items() if cause is not Cause.GNSS]:
        k = begins.index(max(others, key=lambda each: each.explained).discrepancy.node)
        columns = _delay(_find_errors(nodes, first[k : k + 1], rates[k : k + 1])[0], nodes, first[k:])
        _, _, evidence = _fit(_weight(columns, weights[k]), usual[k : k + 1], ALONG_BOTH_AXES[:2])
        drifted = max(float(drifts[:k].max(initial=-math.inf)), float(none[k, 0] - evidence.min()))
        found[Cause.GNSS] = found[Cause.GNSS]._replace(explained=drifted)
    return found


class WindowPaths(NamedTuple):
    """The paths of some windows (K) at the nodes (N) after the first one, 0 before the start of each.

    Attributes
    ----------
    is_inside: which nodes are after the start.
    paths, moments: path and moment (see `PathNode`) since the start, along the path's axes, complex.
    turned: angle by which the path was turned back, rad.
    """

    is_inside: Array
    paths: Array
    moments: Array
    turned: Array

    def get_last(self, k: int) -> tuple[complex, complex, float]:
        """Return path, moment and angle of a window at the last node."""
        return complex(self.paths[k, -1]), complex(self.moments[k, -1]), float(self.turned[k, -1])


def replay_paths(nodes: Sequence[PathNode], first: Array, turn_rates: Array | float = 0.0) -> WindowPaths:
    """Return the paths since the nodes with the indices `first`, with the gyro's bias and the wheels' scale of then.

    `turn_rates` (K): at which they turn besides, rad/s.
    """
    seconds, biases, scales = np.array([(each.seconds, each.rate_bias, each.scale) for each in nodes]).T
    path, moment = np.array([(each.path, each.moment) for each in nodes]).T
    is_inside = np.arange(1, len(nodes)) > first[:, None]
    turns = (
        is_inside
        * (0.5 * (biases[1:] + biases[:-1]) - biases[first, None] + np.reshape(turn_rates, (-1, 1)))
        * np.diff(seconds)
    )
    turned = np.cumsum(turns, axis=1)
    lengths = is_inside * (1.0 + 0.5 * (scales[1:] + scales[:-1]) - scales[first, None])
    factors = lengths * np.exp(1j * (turned - 0.5 * turns))
    paths = np.cumsum(factors * np.diff(path), axis=1)
    return WindowPaths(is_inside, paths, np.cumsum(factors * np.diff(moment), axis=1), turned)


def _find_errors(nodes: Sequence[PathNode], first: Array, turn_rates: Array) -> Array:
    """Return the columns of the fits (K x N x C): the errors of the fixes, and what one unit of each parameter adds.

    They are linear about paths that turn by `turn_rates` (K), rad/s.
    """
    replayed = replay_paths(nodes, first, turn_rates)
    seconds, rotations, yaws, rates, latencies = np.array(
        [(n.seconds, n.rotation, n.rotation + n.own_heading, n.turn_rate, n.latency) for n in nodes]
    ).T
    fixes, velocities = np.array([(each.fix, each.velocity) for each in nodes]).T
    # errors, paths and moments of each node as `compare_window` has them
    spin = np.exp(1j * rotations[first])[:, None]
    paths = spin * replayed.paths
    moments = spin * (replayed.moments - seconds[first, None] * replayed.paths)
    latency = latencies[first, None]
    shifted = fixes + latency * velocities * (1.0 - 0.5j * latency * rates)
    errors = shifted[:, 1:] - np.take_along_axis(shifted, first[:, None], axis=1) - paths
    t = seconds[1:] - seconds[first, None]
    ones = np.ones(t.shape)
    arms = np.exp(1j * (yaws[1:] - replayed.turned)) - np.exp(1j * yaws[first, None])
    late = -velocities[1:] * ones
    usual = (1j * paths, paths, 1j * moments)
    errors += turn_rates[:, None] * usual[RATE]
    planar = (t, 1j * t, ones, 1j * ones, arms, 1j * arms)
    columns = np.stack((errors, *usual, *planar, velocities[first, None] + late, late), axis=2)
    return np.asarray(columns * replayed.is_inside[:, :, None])


def _delay(columns: Array, nodes: Sequence[PathNode], begins: Array) -> Array:
    """Return the columns of a window (N x C) with errors of the fixes that begin at the nodes `begins` (K x N x 8)."""
    seconds = np.array([each.seconds for each in nodes])
    t = seconds[1:] - seconds[begins, None]
    since = np.maximum(t, 0.0), (t > 0.0).astype(float)
    delayed = np.repeat(columns[None, :, :8], len(begins), axis=0)
    delayed[:, :, 4:] = np.stack([axis * each for each in since for axis in (1.0, 1j)], axis=2)
    return delayed


def _get_covariances(
    nodes: Sequence[PathNode], first: Array, inside: Array, noise: PathNoise, settings: FilterSettings
) -> Array:
    """Return the covariances (K x N x N) of the errors of fixes along one axis, m2: of the fixes and of slip."""
    seconds, distances, unmeasured, white, correlated = np.array(
        [(n.seconds, n.distance, n.unmeasured, n.white, n.correlated) for n in nodes]
    ).T
    tau = settings.gps_correlation_time
    t = inside * (seconds[1:] - seconds[first, None])
    near = np.exp(-np.abs(seconds[1:, None] - seconds[1:]) / tau)
    old = np.exp(-t / tau)
    C = near - old[:, :, None] - old[:, None, :] + 1.0
    C *= (min(noise.inflation, MAX_INFLATION) * correlated[first] * correlated[-1])[:, None, None]
    speed = (distances[-1] - distances[first]) / t[:, -1]
    slip = settings.slip_time * ((settings.slip_ratio * speed) ** 2 + settings.side_sigma**2)
    C += (white[first] ** 2)[:, None, None] + slip[:, None, None] * np.minimum(t[:, :, None], t[:, None, :])
    way = unmeasured[1:] - unmeasured[first, None]
    C += way[:, :, None] * way[:, None, :]
    C *= inside[:, :, None] & inside[:, None, :]
    diagonal = np.arange(len(nodes) - 1)
    C[:, diagonal, diagonal] += np.where(inside, white[1:] ** 2 + MODEL_ERROR**2, 1.0)
    return np.asarray(C)


def _weight(columns: Array, weights: Array) -> Array:
    """Return the products (K x C x C) of all columns with each other, weighted by the inverse covariances (K x N x N).

    They are real: a parameter is real, and adds its complex column along both axes.
    """
    num_columns = columns.shape[2]
    parts = np.concatenate((columns.real, columns.imag), axis=2)
    weighted = weights @ parts
    transposed = parts.transpose(0, 2, 1)
    along_x = transposed[:, :num_columns] @ weighted[:, :, :num_columns]
    return np.asarray(along_x + transposed[:, num_columns:] @ weighted[:, :, num_columns:])


def _fit(products: Array, usual: Array, models: Sequence[CauseModel]) -> tuple[Array, Array, Array]:
    """Return least-squares fits of the errors: factors, squares that remain, -2 log of the evidence.

    `products` are those of `_weight`, `usual` the standard deviations (K x 3) of the parameters of the path that each
    fit has; all models have equally many columns. The factors are K x models x parameters, the others K x models.
    """
    chosen = np.array([(*USUAL, *each.columns) for each in models])
    sigmas = np.empty((len(usual), *chosen.shape))
    sigmas[:, :, : len(USUAL)] = usual[:, None]
    sigmas[:, :, len(USUAL) :] = np.array([each.sigma for each in models])[:, None]
    information = products[:, chosen[:, :, None], chosen[:, None, :]]
    diagonal = np.arange(chosen.shape[1])
    information[:, :, diagonal, diagonal] += sigmas**-2
    shown = products[:, chosen, MEASURED]
    factors = np.linalg.solve(information, shown[..., None])[..., 0]
    rest = products[:, MEASURED, MEASURED, None] - (shown * factors).sum(axis=2)
    size = np.linalg.slogdet(information)[1] + 2.0 * np.log(sigmas).sum(axis=2)
    return factors, rest, rest + size


class DriftFit(NamedTuple):
    """How fixes have moved beside dead reckoning.

    Attributes
    ----------
    turn, turn_sigma: rotation of the path to the fixes, rad.
    drift, drift_sigma: of the fixes from the first to the last, and its largest standard deviation, m.
    tolerance: standard deviation of the difference of two fixes at that interval, m.
    seconds: from the first to the last.
    rest: mean square that the fit leaves, over each axis, relative to the variance of the fixes.
    """

    turn: float
    turn_sigma: float
    drift: float
    drift_sigma: float
    tolerance: float
    seconds: float
    rest: float

    @property
    def largest(self) -> float:
        """Largest drift that is not excluded by the noise, m."""
        return 2.0 * math.hypot(self.tolerance, self.drift_sigma)

    @property
    def is_steady(self) -> bool:
        """Whether fixes are known to have moved as the path, whatever its heading, all the time."""
        is_known = self.drift_sigma <= STEADY_SIGMA * self.seconds
        return is_known and self.drift <= self.largest and self.rest <= LARGEST_REST

    def excludes(self, rate: float) -> bool:
        """Return whether fixes are known not to drift at a rate any more, m/s; 0 needs no proof."""
        sigma = math.hypot(self.tolerance, self.drift_sigma)
        return not rate or rate * self.seconds - self.drift > EXCLUDING_SIGMAS * sigma


def fit_drift(nodes: tuple[PathNode, ...], rotation: float, noise: PathNoise, settings: FilterSettings) -> DriftFit:
    """Fit an offset, a drift, a rotation, a scale and a turn rate to the fixes of some nodes.

    `rotation` is that from the path's axes to N now. A path that is straight does not show a drift: its standard
    deviation is large then.
    """
    first, last = nodes[0], nodes[-1]
    seconds = last.seconds - first.seconds
    t = np.array([each.seconds - first.seconds for each in nodes]) / seconds
    begin = shift_fix(first, last.latency)
    fixes = np.array([shift_fix(each, last.latency) - begin for each in nodes])
    paths = cmath.rect(1.0, rotation) * np.array([each.path - first.path for each in nodes])
    moments = cmath.rect(1.0, rotation) * np.array(
        [each.moment - first.moment - first.seconds * (each.path - first.path) for each in nodes]
    )
    # neighboring fixes share their time-correlated error
    share = min((seconds / settings.gps_correlation_time + 1.0) / len(nodes), 1.0)
    weights = np.sqrt([share / (each.white**2 + each.correlated**2) for each in nodes])
    turn = cmath.phase(complex(np.vdot(paths - paths.mean(), fixes - fixes.mean())))
    for _ in range(3):
        spin = cmath.rect(1.0, turn)
        columns = (np.ones(len(nodes)), 1j * np.ones(len(nodes)), t, 1j * t, 1j * spin * paths)
        A = np.column_stack((*columns, spin * paths, 1j * spin * moments)) * weights[:, None]
        b = (fixes - spin * paths) * weights
        prior = np.diag((0.0, 0.0, 0.0, 0.0, 0.0, 1.0 / first.scale_variance, 1.0 / first.rate_variance))
        information = (A.conj().T @ A).real + prior
        x = np.linalg.solve(information, (A.conj().T @ b).real)
        turn += float(x[4])
    P = np.linalg.inv(information)
    rest = float(np.mean(np.abs(b - A @ x) ** 2)) / (2.0 * share)
    longest = compute_longest_axis(P[2, 2], P[3, 3], P[2, 3])
    tolerance = math.sqrt(get_fix_variance(first, last, noise._replace(inflation=1.0), settings))
    return DriftFit(turn, math.sqrt(P[4, 4]), math.hypot(x[2], x[3]), math.sqrt(longest), tolerance, seconds, rest)
