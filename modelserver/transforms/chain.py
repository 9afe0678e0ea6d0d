"""Covariance of a chain of uncertain poses, by first-order propagation.

A link is the pose X_FT of its frame T in its frame F; a chain passes it forward (F to T) or backward. A perturbation
(dp, dtheta) of X_FT along the axes of F moves everything behind T. In the chain's first frame the far end N moves by

    J = +-[[R_F, -[p_N - p_T]x R_F], [0, R_F]]

with R_F the orientation of F, p_T and p_N the positions of T and N; minus where the link is passed backward. J is the
adjoint of SE(3) for the rotation R_F and the lever arm p_N - p_T. The covariance is sum (J L) (J L)' over the links,
L being a factor of the link's covariance.

Links with the same `source` have the same errors, column by column: their J L are added before they are squared, so
that shared errors cancel where a chain passes the same link forth and back. Links of different sources are independent.

First order is not enough where the rotation of a link is very uncertain, as the vehicle's heading before it has moved:
such a link is marked `is_large_angle` and gets the large-angle lever-arm covariance (`covariance`).

`ChainLinkBatch` and the `*_batch` functions compute the same for many chains at once: poses and factors with one row
for each chain, or a single row where they are equal in all.
"""

from __future__ import annotations

import itertools
import operator
from collections.abc import Hashable, Sequence
from typing import Final, NamedTuple

import numpy as np

from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.pose_array import PoseArray, to_matrices
from modelserver.transforms.so3 import Array
from modelserver.transforms.transformation import large_angle_lever_arm, large_angle_lever_arm_batch

LARGE_ANGLE: Final = "large_angle"
"""Last element of the source of a large-angle link's additional covariance."""


class ChainLink(NamedTuple):
    """A link of a chain: the pose `X_FT`, passed from F to T where `forward`.

    factor: (6, n), with factor @ factor' the covariance of its perturbation; None where no covariance is stated.
    source: identifies the origin of its errors. is_large_angle: whether the rotation needs the second order.
    """

    X_FT: Pose
    forward: bool
    factor: Array | None
    source: tuple[Hashable, ...]
    is_large_angle: bool = False


def frame_poses(links: Sequence[ChainLink]) -> list[Pose]:
    steps = (link.X_FT if link.forward else link.X_FT.inverse() for link in links)
    return list(itertools.accumulate(steps, operator.matmul, initial=Pose.identity()))


def compose(links: Sequence[ChainLink]) -> Pose:
    """Return the pose of a chain's last frame in its first."""
    return frame_poses(links)[-1]


def contributions(links: Sequence[ChainLink]) -> dict[tuple[Hashable, ...], Array] | None:
    """Return for each source the (6, n) factor of its share of the covariance of `compose(links)`.

    None where a link states no covariance. The additional covariance of a large-angle link has a source of its own,
    `(*source, LARGE_ANGLE)`.
    """
    places = frame_poses(links)
    far = places[-1].xyz
    shares: dict[tuple[Hashable, ...], Array] = {}
    for number, link in enumerate(links):
        if link.factor is None:
            return None
        before, behind = places[number], places[number + 1]
        X_F, X_T = (before, behind) if link.forward else (behind, before)
        x, y, z = X_T.xyz
        share = np.array(adjoint_rows(X_F.wxyz, (far[0] - x, far[1] - y, far[2] - z))) @ link.factor
        if not link.forward:
            share = -share
        if link.is_large_angle:
            r, turn = np.array(far) - X_T.xyz, share[3:]
            M, more = large_angle_lever_arm(turn @ turn.T, r)
            share[:3] -= so3.skew(r) @ (M @ turn - turn)
            shares[(*link.source, LARGE_ANGLE)] = np.vstack((factor(more), np.zeros((3, 3))))
        known = shares.get(link.source)
        shares[link.source] = share if known is None else known + share
    return shares


def covariance(links: Sequence[ChainLink]) -> Array | None:
    """Return the covariance (6, 6) of `compose(links)` along the axes of its first frame; None where it is unknown."""
    shares = contributions(links)
    if shares is None:
        return None
    if not shares:
        return np.zeros((6, 6))
    root = np.hstack(list(shares.values()))
    return np.asarray(root @ root.T)


def adjoint_rows(q: so3.Quaternion, r: so3.Vector3) -> tuple[tuple[float, ...], ...]:
    """Return the rows of [[R, -[r]x R], [0, R]] as plain floats: J for the rotation R(q) and the lever arm r from T."""
    (a, b, c), (d, e, f), (g, h, i) = so3.matrix_rows(q)
    x, y, z = r
    # the upper right block is -[r]x R: the columns of R crossed with r
    return (
        (a, b, c, z * d - y * g, z * e - y * h, z * f - y * i),
        (d, e, f, x * g - z * a, x * h - z * b, x * i - z * c),
        (g, h, i, y * a - x * d, y * b - x * e, y * c - x * f),
        (0.0, 0.0, 0.0, a, b, c),
        (0.0, 0.0, 0.0, d, e, f),
        (0.0, 0.0, 0.0, g, h, i),
    )


def factor(covariance: Array) -> Array:
    """Return a factor L, L @ L' = covariance, of one covariance (n, n) or a stack (m, n, n); any rank is allowed."""
    try:
        return np.asarray(np.linalg.cholesky(covariance))
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(covariance)
        return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :])


class ChainLinkBatch(NamedTuple):
    """A link of many chains: `ChainLink` with one pose for each chain, or a single one for all.

    factor: (6, k) where it is the same in all chains, else (n, 6, k); None where no covariance is stated.
    """

    X_FT: PoseArray
    forward: bool
    factor: Array | None
    source: tuple[Hashable, ...]
    is_large_angle: bool = False


def compose_batch(links: Sequence[ChainLinkBatch]) -> PoseArray:
    """Return the poses of the chains' last frames in their first frames."""
    return frame_pose_batch(links)[-1].canonical()


def frame_pose_batch(links: Sequence[ChainLinkBatch]) -> list[PoseArray]:
    """Return the poses of all frames of the chains in their first frames, the first frame included."""
    steps = (link.X_FT if link.forward else link.X_FT.inverse() for link in links)
    return list(itertools.accumulate(steps, operator.matmul, initial=PoseArray.of(Pose.identity())))


def covariance_batch(
    links: Sequence[ChainLinkBatch], count: int, frame_poses: list[PoseArray] | None = None
) -> Array | None:
    """Return the covariances (n, 6, 6) of the chains along the axes of their first frames; None where unknown.

    `frame_poses` is the result of `frame_pose_batch(links)`, where the caller has it already.
    """
    if not count:
        return np.zeros((0, 6, 6))
    stated = [(number, link, link.factor) for number, link in enumerate(links) if link.factor is not None]
    if len(stated) < len(links):
        return None
    where = frame_poses or frame_pose_batch(links)
    far = where[-1].p
    turns = [to_matrices(place.q) for place in where]
    # each source has its own columns; links of one source are added in them
    columns: dict[tuple[Hashable, ...], slice] = {}
    width = 0
    for _, link, factor in stated:
        if link.source not in columns:
            columns[link.source] = slice(width, width + factor.shape[-1])
            width += factor.shape[-1]
    one = all(len(place.p) == len(place.q) == 1 for place in where) and all(f.ndim == 2 for _, _, f in stated)
    rows = 1 if one else count
    root = np.zeros((rows, 6, width))
    total = np.zeros((rows, 6, 6))
    for number, link, factor in stated:
        if not factor.any():
            continue
        F, T = (number, number + 1) if link.forward else (number + 1, number)
        # J in two steps: rotate by R, then add the lever-arm term -[r]x R
        moved, turned = _rotate_factor(turns[F], factor) if F else (factor[..., :3, :], factor[..., 3:, :])
        r = (far - where[T].p)[:, :, None]
        sign = 1.0 if link.forward else -1.0
        share = root[:, :, columns[link.source]]
        share[:, :3] += sign * moved
        share[:, 3:] += sign * turned
        if link.is_large_angle:
            M, more = large_angle_lever_arm_batch((turned @ np.swapaxes(turned, -1, -2)).reshape(-1, 3, 3), r[..., 0])
            total[:, :3, :3] += more
            turned = M @ turned
        _add_cross_product(share[:, :3], sign * turned, r)
    total += root @ np.swapaxes(root, 1, 2)
    return np.broadcast_to(total, (count, 6, 6)).copy() if one else total


def _add_cross_product(to: Array, a: Array, b: Array) -> None:
    """Add a x b, for vectors along the last axis but one."""
    ax, ay, az = a[..., 0, :], a[..., 1, :], a[..., 2, :]
    bx, by, bz = b[..., 0, :], b[..., 1, :], b[..., 2, :]
    to[:, 0] += ay * bz - az * by
    to[:, 1] += az * bx - ax * bz
    to[:, 2] += ax * by - ay * bx


def _rotate_factor(R: Array, factor: Array) -> tuple[Array, Array]:
    """Return both halves of a factor, (6, k) or (n, 6, k), rotated by R (m, 3, 3)."""
    if factor.ndim == 3:
        return R @ factor[:, :3], R @ factor[:, 3:]
    # one product of tall matrices is much faster where all chains have the same factor
    tall = R.reshape(-1, 3)
    return (tall @ factor[:3]).reshape(len(R), 3, -1), (tall @ factor[3:]).reshape(len(R), 3, -1)
