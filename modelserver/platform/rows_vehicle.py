"""The vehicle at many instants: its poses in a world, how sure they are, and how far Odom drifts meanwhile."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from itertools import pairwise
from typing import Final

import numpy as np
import numpy.typing as npt

from modelserver.errors import NoPoseError, Status
from modelserver.geometry import names
from modelserver.geometry.edges import EdgeKind
from modelserver.messages import Estimate, Origin, Quality
from modelserver.platform.rows import STEP_ROWS, Rows
from modelserver.platform.steps import Steps
from modelserver.platform.view import ODOM_INVALID, PlatformView
from modelserver.platform.worlds import known_in
from modelserver.spatial import arrays
from modelserver.spatial.arrays import Poses
from modelserver.spatial.chains import Links
from modelserver.spatial.so3 import Array

TILT_TIME_S: Final = 1.0
"""Over which the tilt of a pose in Odom may change by as much as it is unsure."""

_NOWHERE = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
_NOTHING = (0.0,) * 36


def vehicle(view: PlatformView, world: str, rows: Rows) -> Steps[tuple[Links, Rows]]:
    """Return, in steps, the vehicle's poses in a world at every row's time. Raises NoPoseError where there is none."""
    history = view.history
    if view.localizer is None or not len(history):
        raise view.no_pose()
    rows = rows.within(history.first, history.last)
    yield from history.resolve(rows.utimes)
    held, before = history.around(rows.utimes)
    yield
    found = [known_in(world, each) for each in held]
    known = np.array([pose is not None for pose in found])
    if not known.any():
        raise NoPoseError(f"the vehicle's pose in {world} was not known then: {held[0].invalid.explain()}")
    told = itertools.chain.from_iterable([_NOWHERE if pose is None else pose.xyz + pose.wxyz for pose in found])
    vectors = np.fromiter(told, float, 7 * len(found)).reshape(-1, 7)
    p, q = vectors[:, :3], vectors[:, 3:]
    yield
    times = np.array([each.utime for each in held])
    epochs = np.array([each.pose_epoch for each in held], dtype=np.int32)
    after = np.minimum(before + 1, len(held) - 1)
    apart = np.maximum(times[after] - times[before], 1)
    part = (rows.utimes - times[before]) / apart
    jump = _jumps(held)[before]
    exact = part == 0.0
    part = np.where(jump, 0.0, part)
    end = np.where(exact | jump, before, after)
    poses = Poses(p[before] + (p[after] - p[before]) * part[:, None], arrays.slerped(q[before], q[after], part))
    yield
    keep = int(ODOM_INVALID) if world == names.ODOM else -1
    invalid = np.array([int(each.invalid) for each in held], dtype=np.int32) & keep
    quality = np.array([int(each.quality) for each in held], dtype=np.int32)
    between = np.where(exact, 0, np.where(jump, int(Quality.HELD), int(Quality.INTERPOLATED))).astype(np.int32)
    status = np.where((known[before] & known[end]) | (rows.status != 0), rows.status, int(Status.NO_POSE))
    rows = replace(rows, status=status.astype(np.int32), epochs=epochs[end], around=(held, before))
    rows = rows.told(invalid[before] | invalid[end], quality[before] | quality[end] | between)
    yield
    factor = (yield from _vehicle_factor(world, held, end)) if rows.with_covariance else None
    return Links(poses, True, factor, (EdgeKind.VEHICLE, world), bends=True), rows


def _vehicle_factor(world: str, held: list[Estimate], which: npt.NDArray[np.intp]) -> Steps[Array | None]:
    """Return factors (n, 6, 6) of the covariances of those estimates of `held` that `which` (n,) names."""
    used, row = np.unique(which, return_inverse=True)
    of_use = [held[index] for index in used.tolist()]
    numbers = [each.odom_covariance if world == names.ODOM else each.covariance for each in of_use]
    unsure = np.array([each is None for each in numbers])
    if unsure.all():
        return None
    stacks = []
    for start in range(0, len(numbers), STEP_ROWS):
        part = [_NOTHING if each is None else each for each in numbers[start : start + STEP_ROWS]]
        flat = np.fromiter(itertools.chain.from_iterable(part), float, 36 * len(part))
        stacks.append(_factors(flat.reshape(-1, 6, 6)))
        yield
    factors = np.concatenate(stacks)
    factors[unsure] = math.nan
    return np.asarray(factors[row])


def _jumps(held: list[Estimate]) -> npt.NDArray[np.bool_]:
    """Return for each estimate whether the next is of another epoch: then what lies between is held, as in `History`.

    What lies between two epochs was nobody's pose.
    """
    return np.array([a.pose_epoch != b.pose_epoch or differ(a.origin, b.origin) for a, b in pairwise(held)] + [False])


def _factors(stack: Array) -> Array:
    """Return factors (m, 6, 6) of covariances, which need not have full rank."""
    try:
        return np.asarray(np.linalg.cholesky(stack))
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(stack)
        return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :])


def drifts(view: PlatformView, since: Estimate, rows: Rows) -> Array | None:
    """Return the factors (n, 6, 6) of what Odom drifts from an estimate to every row's time.

    They are along the vehicle's axes at the estimate. Errors that add up in proportion to time grow by the difference
    of their sigmas, those of a random walk by that of their variances. Tilt is bounded, not drifting.
    """
    held, before = view.history.around(rows.utimes)
    times = np.array([each.utime for each in held])
    of_one = (times[before] == rows.utimes) | _jumps(held)[before]
    after = np.where(of_one, before, np.minimum(before + 1, len(held) - 1))
    if since.odom_covariance is None or any(each.odom_covariance is None for each in held):
        return None
    first = np.array(since.odom_covariance)[::7]
    # the diagonals alone: all of the matrices would take most of the time
    then = np.array([each.odom_covariance[::7] for each in held if each.odom_covariance is not None])[after]
    if since.odom_walks or held[-1].odom_walks:
        sigma = np.sqrt(np.abs(then - first))
    else:
        sigma = np.abs(np.sqrt(then) - np.sqrt(first))
    apart = np.abs(rows.utimes - since.utime) * 1e-6
    tilt = np.sqrt(np.maximum(first[3:5], then[:, 3:5]))
    sigma[:, 3:5] = tilt * np.minimum(math.sqrt(2.0), apart / TILT_TIME_S)[:, None]
    turn = np.kron(np.eye(2), arrays.matrices(np.array([since.odom.inverse().wxyz]))[0])
    return np.asarray(turn[None] * sigma[:, None, :])


def differ(a: Origin | None, b: Origin | None) -> bool:
    """Return whether two origins are not the same."""
    # nearly always the very same, which is told at a tenth of the cost
    return a is not b and a != b
