"""The covariance of many chains at once: `chain`, row by row, for links whose poses are `Poses`."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import NamedTuple

import numpy as np

from modelserver.spatial.arrays import Poses, crossed, matrices
from modelserver.spatial.so3 import Array


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
    poses = Poses(np.zeros((1, 3)), np.array([[1.0, 0.0, 0.0, 0.0]]))
    for link in links:
        poses = poses @ (link.X_FT if link.forward else link.X_FT.inverse())
    return poses.canonical()


def covariances(links: Sequence[Links], count: int) -> Array | None:
    """Return the covariances (n, 6, 6) of the chains, along the axes of their first frames; None where unknown."""
    if not count:
        return np.zeros((0, 6, 6))
    places = [Poses(np.zeros((1, 3)), np.array([[1.0, 0.0, 0.0, 0.0]]))]
    for link in links:
        places.append(places[-1] @ (link.X_FT if link.forward else link.X_FT.inverse()))
    far = places[-1].p
    turns = [matrices(place.q) for place in places]
    shares: dict[tuple[Hashable, ...], Array] = {}
    total = np.zeros((count, 6, 6))
    for number, link in enumerate(links):
        if link.factor is None:
            return None
        if not link.factor.any():
            continue
        F, T = (number, number + 1) if link.forward else (number + 1, number)
        # J = +-[[R, -[r]x R], [0, R]] in two steps, as `chain` has it: turned first, then swung
        turned = _turned(turns[F], link.factor) if F else link.factor.reshape(-1, *link.factor.shape[-2:])
        moved, swung = turned[:, :3], turned[:, 3:]
        r = (far - places[T].p)[:, :, None]
        share = np.concatenate(np.broadcast_arrays(moved + crossed(swung, r), swung), axis=1)
        share = share if link.forward else -share
        if link.bends:
            total[:, :3, :3] += _bends(swung @ np.swapaxes(swung, 1, 2), r)
        known = shares.get(link.source)
        shares[link.source] = share if known is None else known + share
    constant = [share for share in shares.values() if len(share) == 1]
    varying = [share for share in shares.values() if len(share) > 1]
    for some in (constant, varying):
        if some:
            root = np.concatenate(some, axis=2)
            total += root @ np.swapaxes(root, 1, 2)
    return total


def _bends(S: Array, r: Array) -> Array:
    """Return `covariance.bend` row by row: of turns (m, 3, 3) and levers (n, 3, 1)."""
    Sr, rt = S @ r, np.swapaxes(r, 1, 2)
    t = np.trace(S, axis1=1, axis2=2)[:, None, None]
    squares = np.sum(S * S, axis=(1, 2))[:, None, None]
    across = (t * Sr + 2.0 * (S @ Sr)) @ rt
    rest = S * (rt @ Sr) + 2.0 * Sr @ np.swapaxes(Sr, 1, 2) + (t * t + 2.0 * squares) * (r @ rt)
    return np.asarray((rest - across - np.swapaxes(across, 1, 2)) / 4.0)


def _turned(R: Array, factor: Array) -> Array:
    """Return both halves of a factor, (6, k) or (n, 6, k), turned by rotations (m, 3, 3)."""
    stack = factor if factor.ndim == 3 else factor[None]
    rows, columns = len(stack), stack.shape[2]
    halves = stack.reshape(rows, 2, 3, columns).swapaxes(1, 2).reshape(rows, 3, 2 * columns)
    # one product of tall matrices where the factor is one for all: much the faster
    turned = (R.reshape(-1, 3) @ halves[0]).reshape(-1, 3, 2 * columns) if rows == 1 else R @ halves
    return np.concatenate((turned[:, :, :columns], turned[:, :, columns:]), axis=1)
