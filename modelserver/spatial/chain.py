"""How sure a chain of poses is: the covariance of the far end from those of its links.

A link leads from its frame F to its frame T by the pose X_FT; a chain may pass it either way. A perturbation of X_FT,
dp and dtheta along the axes of F, turns all that comes behind T about T's origin: seen from the chain's first frame it
moves the far end by `R_F (dp + dtheta x ...)`, in sum

    J = +-[[R_F, -[p_N - p_T]x R_F], [0, R_F]]

with R_F the orientation of F, p_T the place of T and p_N that of the far end, all in the first frame; the sign is minus
where the link is passed backwards. A link whose errors are the same at several places of a chain, as where it goes to
another time and back, is one source: its contributions are added before they are squared, so what is shared cancels.

That is first order. Where a link's turn may be large, as the vehicle's heading before it has moved, the arc on which
the far end swings is not its tangent: see `swing`.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import Final, NamedTuple

import numpy as np

from modelserver.spatial import so3
from modelserver.spatial.pose import Pose
from modelserver.spatial.so3 import Array
from modelserver.spatial.swing import swing

BEND: Final = "bend"


class ChainLink(NamedTuple):
    """One link of a chain: `X_FT`, passed from F to T where `forward`.

    `factor` (6, n) times its transpose is the covariance of its perturbation; None: nobody stated one. `source` names
    where its errors come from: links of one source have the same errors, column by column. `bends`: whether its turn
    may be so large that the second order counts.
    """

    X_FT: Pose
    forward: bool
    factor: Array | None
    source: tuple[Hashable, ...]
    bends: bool = False


def product(links: Sequence[ChainLink]) -> Pose:
    """Return the pose of a chain's last frame in its first."""
    pose = Pose.identity()
    for link in links:
        pose = pose @ (link.X_FT if link.forward else link.X_FT.inverse())
    return pose


def contributions(links: Sequence[ChainLink]) -> dict[tuple[Hashable, ...], Array] | None:
    """Return for each source the (6, n) matrix whose square is its share of the covariance of `product(links)`.

    None where a link that is there states no covariance. What a link bends is a source of its own, `(*source, BEND)`.
    """
    places: list[Pose] = [Pose.identity()]
    for link in links:
        places.append(places[-1] @ (link.X_FT if link.forward else link.X_FT.inverse()))
    far = places[-1].xyz
    shares: dict[tuple[Hashable, ...], Array] = {}
    for number, link in enumerate(links):
        if link.factor is None:
            return None
        before, behind = places[number], places[number + 1]
        X_F, X_T = (before, behind) if link.forward else (behind, before)
        share = _carried(X_F, X_T, far) @ link.factor
        if not link.forward:
            share = -share
        if link.bends:
            r, turn = np.array(far) - X_T.xyz, share[3:]
            M, more = swing(turn @ turn.T, r)
            share[:3] -= so3.skew(r) @ (M @ turn - turn)
            shares[(*link.source, BEND)] = np.vstack((factor(more), np.zeros((3, 3))))
        known = shares.get(link.source)
        shares[link.source] = share if known is None else known + share
    return shares


def covariance(links: Sequence[ChainLink]) -> Array | None:
    """Return the covariance (6, 6) of `product(links)` along the axes of its first frame; None where it is unknown."""
    shares = contributions(links)
    if shares is None:
        return None
    if not shares:
        return np.zeros((6, 6))
    root = np.hstack(list(shares.values()))
    return np.asarray(root @ root.T)


def _carried(X_F: Pose, X_T: Pose, far: so3.Vector3) -> Array:
    """Return J (6, 6), without its sign; see the module."""
    x, y, z = X_T.xyz
    return np.array(carried_rows(X_F.wxyz, (far[0] - x, far[1] - y, far[2] - z)))


def carried_rows(q: so3.Quaternion, r: so3.Vector3) -> tuple[tuple[float, ...], ...]:
    """Return the rows of [[R, -[r]x R], [0, R]] as plain floats: J for R(q), and the far end r from T."""
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
    """Return a factor (n, n) of a covariance (n, n), which need not have full rank."""
    try:
        return np.asarray(np.linalg.cholesky(covariance))
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(covariance)
        return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))
