"""What an unsure turn does at the end of a lever, where the angle may be large.

A lever r that turns by theta ends `d = (exp(theta) - 1) r` from where it should. To first order that is `theta x r`,
on the tangent; at tens of degrees the end lies on an arc, off the tangent by

    b = theta x (theta x r) / 2       along the lever, even in theta
    c = -|theta|^2 (theta x r) / 6    across it, odd in theta

Theta is normal with covariance S, of trace t. By Isserlis' theorem

    4 E[b b'] = S (r' S r) + 2 S r r' S - (t S + 2 S^2) r r' - r r' (t S + 2 S^2) + (t^2 + 2 tr S^2) r r'
    E[c theta'] = [r]x (t S + 2 S^2) / 6
    36 E[c c'] = [r]x ((t^2 + 2 tr S^2) S + 4 t S^2 + 8 S^3) [r]x'

b does not correlate with theta. What of c does makes the lever shorter, `(M theta) x r`; the rest, of covariance
`[r]x (2 tr(S^2) S + 4 S^3) [r]x' / 36`, is an error of its own, as b is. For a turn about one axis the moments of sine
and cosine are known at any angle: each of the three is scaled by a function of t that makes it exact there.
"""

from __future__ import annotations

import numpy as np

from modelserver.spatial.so3 import Array

_SMALL = 1e-2
"""Square radians below which the functions' own formulas would lose their digits, and three terms do."""


def swing(S: Array, r: Array) -> tuple[Array, Array]:
    """Return M (..., 3, 3) and what is to be added to the position's covariance (..., 3, 3).

    `S` (..., 3, 3) is the covariance of the turn and `r` (..., 3) the lever, along the same axes. The end errs by
    `(M theta) x r` and, apart from that, by the second.
    """
    t = np.trace(S, axis1=-2, axis2=-1)[..., None, None]
    shorter, along, across = _scales(t)
    eye = np.eye(3)
    square = S @ S
    whole = np.trace(square, axis1=-2, axis2=-1)[..., None, None]
    column = r[..., :, None]
    row = r[..., None, :]
    Sr = S @ column
    # half of what is of r on both sides, with all that is on one
    half = ((0.5 * t * t + whole) * column - t * Sr - 2.0 * (S @ Sr)) @ row + Sr @ np.swapaxes(Sr, -1, -2)
    b = S * (row @ Sr) + half + np.swapaxes(half, -1, -2)
    K = _skew(r)
    c = K @ (2.0 * whole * S + 4.0 * (square @ S)) @ np.swapaxes(K, -1, -2)
    return eye - shorter * (t * eye + 2.0 * S) / 6.0, (0.25 * along) * b + (across / 36.0) * c


def _scales(t: Array) -> tuple[Array, Array, Array]:
    """Return by what M's shortening, b's and c's moments are scaled; each is 1 at 0.

    For theta about one axis and normal, of variance t: `E[theta sin theta] = t exp(-t/2)`,
    `E[(1 - cos theta)^2] = 3/2 - 2 exp(-t/2) + exp(-2t)/2` and `E[sin^2 theta] = (1 - exp(-2t))/2`.
    """
    small = t < _SMALL
    s = np.where(small, 1.0, t)
    shorter = np.where(small, 1.0 - t / 4.0 + t * t / 24.0, -2.0 * np.expm1(-0.5 * s) / s)
    along = (1.5 - 2.0 * np.exp(-0.5 * s) + 0.5 * np.exp(-2.0 * s)) / (0.75 * s * s)
    across = (-0.5 * np.expm1(-2.0 * s) - s * np.exp(-s)) * 6.0 / (s * s * s)
    return (
        shorter,
        np.where(small, 1.0 - t * (5.0 / 6.0) + t * t * (7.0 / 16.0), along),
        np.where(small, 1.0 - t + t * t * 0.55, across),
    )


def _skew(r: Array) -> Array:
    K = np.zeros((*r.shape, 3))
    x, y, z = np.moveaxis(r, -1, 0)
    K[..., 0, 1], K[..., 0, 2] = -z, y
    K[..., 1, 0], K[..., 1, 2] = z, -x
    K[..., 2, 0], K[..., 2, 1] = -y, x
    return K
