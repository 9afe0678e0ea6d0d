"""Where a frame is at one time in another at another time: `platform.many` for one instant, step by step.

Written for itself, from links and their covariances, so that the rows of `many` have something to be held against.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from modelserver.errors import NoPoseError
from modelserver.geometry import names
from modelserver.geometry.topology import Edge, EdgeKind
from modelserver.messages import NO_FLAGS, Estimate, Invalid, Policy, PoseAnswer, Quality, TimeQuery
from modelserver.query.path import PathState, PathStep, lookup_path
from modelserver.query.view import PlatformView, is_absolute
from modelserver.transforms import chain, so3
from modelserver.transforms.so3 import Array
from modelserver.transforms.transformation import Transformation

TILT_TIME_S: Final = 1.0
"""Time over which the tilt of a pose in Odom may change by its own uncertainty."""


def lookup_between(
    view: PlatformView,
    interest: str,
    at: int,
    reference: str,
    reference_at: int,
    fixed: str = names.ODOM,
    policy: Policy = Policy.INTERPOLATED,
    now: int = 0,
) -> PoseAnswer:
    """Return the pose of `interest` at `at` in `reference` at `reference_at`; 0 is the latest time for each.

    `fixed` is the frame assumed not to move between the two times. Odom drifts and does not jump: between near times it
    is far more certain than the world, whose correlation between two times is unknown: the covariance is then an upper
    bound, and flagged. Raises QueryError as `PlatformView.transformation`, and
    NoPoseError where the world pose was reset between the two times.
    """
    there = lookup_path(view, fixed, reference, TimeQuery(reference_at, policy), now)
    here = lookup_path(view, interest, fixed, TimeQuery(at, policy), now)
    steps, quality = _join_steps(there, here, fixed)
    links = [step.link for step in steps]
    invalid = int(view.invalid & Invalid.CLOCK_STEPPED | there.invalid | here.invalid)
    origins = {step.estimate.origin for step in steps if step.estimate is not None and is_absolute(step.edge.name)}
    origin = origins.pop() if origins else None
    epochs = [step.estimate.pose_epoch for step in (*here.steps, *there.steps) if step.estimate is not None]
    return PoseAnswer(
        Transformation(
            interest,
            reference,
            chain.compose(links),
            lambda: chain.covariance(links),
            here.utime,
            invalid,
            epochs[0] if epochs else 0,
            0 if origin is None else origin.origin_id,
            view.model.revision,
        ),
        origin,
        there.quality | here.quality | quality,
    )


def _join_steps(there: PathState, here: PathState, fixed: str) -> tuple[list[PathStep], Quality]:
    """Return the steps of both paths as one, with the vehicle's at the two times combined where they meet."""
    if not (there.steps and here.steps):
        return [*there.steps, *here.steps], NO_FLAGS
    last, first = there.steps[-1], here.steps[0]
    if last.estimate is None or first.estimate is None or not last.edge.name == fixed == first.edge.name:
        # they meet in a frame of the vehicle
        return [*there.steps, *here.steps], NO_FLAGS
    rest = (there.steps[:-1], here.steps[1:])
    if last.estimate.utime == first.estimate.utime:
        # out to the fixed frame and back at one time: both cancel
        return [*rest[0], *rest[1]], NO_FLAGS
    if last.edge.name == names.ODOM:
        return [*rest[0], _odom_step(last.estimate, first.estimate), *rest[1]], NO_FLAGS
    _check_same_world(last.estimate, first.estimate, last.edge.name)
    # |a + b|^2 <= 2 |a|^2 + 2 |b|^2, whatever the correlation of the two times
    doubled = [
        step._replace(factor=None if step.factor is None else step.factor * math.sqrt(2.0)) for step in (last, first)
    ]
    return [*rest[0], *doubled, *rest[1]], Quality.CORRELATION_UNKNOWN


def _odom_step(before: Estimate, after: Estimate) -> PathStep:
    """Return the step from the vehicle at one time to itself at another, by Odom."""
    X_FT = before.odom.inverse() @ after.odom
    edge = Edge(EdgeKind.VEHICLE, names.ODOM, True, X_FT)
    source = (EdgeKind.VEHICLE, names.ODOM, before.utime, after.utime)
    return PathStep(edge, X_FT, _drift(before, after), source, estimate=after)


def _drift(before: Estimate, after: Estimate) -> Array | None:
    """Return the factor (6, 6) of what Odom drifts from one estimate to another, along the vehicle's axes at the first.

    Errors that add up in proportion to time grow by the difference of their sigmas, those of a random walk by that of
    their variances. Tilt is bounded, not drifting.
    """
    if before.odom_covariance is None or after.odom_covariance is None:
        return None
    variances = np.array(before.odom_covariance)[::7], np.array(after.odom_covariance)[::7]
    if before.is_odom_random_walk or after.is_odom_random_walk:
        sigma = np.sqrt(np.abs(variances[1] - variances[0]))
    else:
        sigma = np.abs(np.sqrt(variances[1]) - np.sqrt(variances[0]))
    apart = abs(after.utime - before.utime) * 1e-6
    tilt = np.sqrt(np.maximum(variances[0][3:5], variances[1][3:5]))
    sigma[3:5] = tilt * min(math.sqrt(2.0), apart / TILT_TIME_S)
    turn = np.kron(np.eye(2), np.array(so3.matrix_rows(so3.conjugate(before.odom.wxyz))))
    return np.asarray(turn * sigma)


def _check_same_world(before: Estimate, after: Estimate, world: str) -> None:
    if before.pose_epoch != after.pose_epoch or before.origin != after.origin:
        raise NoPoseError(
            f"the pose in {world} was reset between {before.utime} and {after.utime} (epoch "
            f"{before.pose_epoch} and {after.pose_epoch}), so the two do not compare; ask through {names.ODOM}"
        )
