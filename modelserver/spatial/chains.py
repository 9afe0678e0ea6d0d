"""The covariance of many chains at once: `chain`, row by row, for links whose poses are `Poses`."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import NamedTuple

import numpy as np

from modelserver.spatial.arrays import Poses, matrices
from modelserver.spatial.so3 import Array
from modelserver.spatial.swing import swings


class Links(NamedTuple):
    """A link of many chains: poses X_FT, one a row or one for all; see `chain.Link`.

    `factor` is (6, k) where it is the same in every row, else (n, 6, k); None: nobody stated one.
    """

    X_FT: Poses
    forward: bool
    factor: Array | None
    source: tuple[Hashable, ...]
    bends: bool = False


def product(links: Sequence[Links]) -> Poses:
    """Return the poses of the chains' last frames in their first."""
    return places(links)[-1].canonical()


def places(links: Sequence[Links]) -> list[Poses]:
    """Return the poses of all frames of the chains in their first: of that itself, and behind each link."""
    found = [Poses(np.zeros((1, 3)), np.array([[1.0, 0.0, 0.0, 0.0]]))]
    for link in links:
        found.append(found[-1] @ (link.X_FT if link.forward else link.X_FT.inverse()))
    return found


def covariances(links: Sequence[Links], count: int, known: list[Poses] | None = None) -> Array | None:
    """Return the covariances (n, 6, 6) of the chains, along the axes of their first frames; None where unknown.

    `known` are the links' `places`, where they have been worked out already.
    """
    if not count:
        return np.zeros((0, 6, 6))
    stated = [(number, link, link.factor) for number, link in enumerate(links) if link.factor is not None]
    if len(stated) < len(links):
        return None
    where = known or places(links)
    far = where[-1].p
    turns = [matrices(place.q) for place in where]
    # the columns of each source stand side by side, and what shares a source is added
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
        # J = +-[[R, -[r]x R], [0, R]] in two steps, as `chain` has it: turned first, then swung
        moved, swung = _turned(turns[F], factor) if F else (factor[..., :3, :], factor[..., 3:, :])
        r = (far - where[T].p)[:, :, None]
        sign = 1.0 if link.forward else -1.0
        share = root[:, :, columns[link.source]]
        share[:, :3] += sign * moved
        share[:, 3:] += sign * swung
        if link.bends:
            M, more = swings((swung @ np.swapaxes(swung, -1, -2)).reshape(-1, 3, 3), r[..., 0])
            total[:, :3, :3] += more
            swung = M @ swung
        _add_crossed(share[:, :3], sign * swung, r)
    total += root @ np.swapaxes(root, 1, 2)
    return np.broadcast_to(total, (count, 6, 6)).copy() if one else total


def _add_crossed(to: Array, a: Array, b: Array) -> None:
    """Add a x b of vectors along the last axis but one."""
    ax, ay, az = a[..., 0, :], a[..., 1, :], a[..., 2, :]
    bx, by, bz = b[..., 0, :], b[..., 1, :], b[..., 2, :]
    to[:, 0] += ay * bz - az * by
    to[:, 1] += az * bx - ax * bz
    to[:, 2] += ax * by - ay * bx


def _turned(R: Array, factor: Array) -> tuple[Array, Array]:
    """Return both halves of a factor, (6, k) or (n, 6, k), turned by rotations (m, 3, 3)."""
    if factor.ndim == 3:
        return R @ factor[:, :3], R @ factor[:, 3:]
    # one product of tall matrices where the factor is one for all: much the faster
    tall = R.reshape(-1, 3)
    return (tall @ factor[:3]).reshape(len(R), 3, -1), (tall @ factor[3:]).reshape(len(R), 3, -1)
