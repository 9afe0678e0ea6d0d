"""Initialization in the world: attitude rotated by the aligned heading, antenna placed at a fix."""

from __future__ import annotations

import numpy as np

from modelserver.earth.geodesy import rotation_about_up
from modelserver.estimation.filter import kalman
from modelserver.estimation.filter.alignment import Passed, Turn
from modelserver.estimation.filter.layout import Layout
from modelserver.estimation.filter.measurements.gps import LATENCY, WANDER
from modelserver.estimation.filter.nav import Nav
from modelserver.transforms import so3
from modelserver.transforms.so3 import Vector3


def turned(nav: Nav, turn: Turn, layout: Layout) -> Nav:
    """Return the state with N turned about up: everything in N turns with it.

    An error of the turn is one of yaw, and turns the velocity with it. Where late fixes told too little, as much more
    is turned as is known of their lateness; what is not known of it is an error that the two share.
    """
    late = nav.extras[layout.extra(LATENCY)] if turn.turning else 0.0
    spin = rotation_about_up(turn.angle + turn.turning * late)
    velocity = so3.rotate(spin, nav.velocity)
    n = len(nav.covariance)
    T = np.eye(n)
    R = np.array(so3.matrix_rows(spin))
    for at in (0, 3, 6):
        T[at : at + 3, at : at + 3] = R
    P = T @ nav.covariance @ T.T
    G = np.zeros(n)
    G[3], G[4], G[8] = -velocity[1], velocity[0], 1.0
    P += np.outer(G, G) * turn.sigma**2
    if turn.turning:
        L = np.eye(n)
        L[:, layout.index(LATENCY)] += turn.turning * G
        P = L @ P @ L.T
    return nav._replace(
        position=so3.rotate(spin, nav.position),
        velocity=velocity,
        attitude=so3.normalize(so3.multiply(spin, nav.attitude)),
        impulse=so3.rotate(spin, nav.impulse),
        covariance=0.5 * (P + P.T),
    )


def placed(nav: Nav, fix: Passed, moved: complex, lever: Vector3, layout: Layout) -> Nav:
    """Return the state with the antenna at a fix, `moved` metres along N since then; `lever` leads to it.

    What lingers in the fix, and how late it is, is the position's error from now on: all are tied as
    p = fix - lingering - white + latency v.
    """
    arm = so3.rotate(nav.attitude, lever)
    vx, vy, _ = nav.point_velocity(lever)
    late = nav.extras[layout.extra(LATENCY)]
    place = fix.place + moved + late * complex(vx, vy)
    position = (place.real - arm[0], place.imag - arm[1], fix.up - arm[2])
    P = nav.covariance.copy()
    n = len(P)
    late_at = layout.index(LATENCY)
    # latency times speed, both unknown: what a first order leaves out
    second = [P[late_at, late_at] * P[k, k] for k in (3, 4)]
    P[0:3, :] = 0.0
    P[:, 0:3] = 0.0
    at = layout.index(WANDER[0])
    P[at : at + 3, :] = 0.0
    P[:, at : at + 3] = 0.0
    # p = place - R lever + latency v: an error of attitude moves p by -theta x (R lever) = [arm]x theta
    L = np.zeros((3, n))
    L[:, 6:9] = so3.skew(arm)
    L[:2, late_at] = vx, vy
    P[0:3, :] += L @ P
    P[:, 0:3] += P @ L.T
    lingering = (fix.lingering, fix.lingering, fix.up_sigma)
    white = (fix.white, fix.white, 0.5 * fix.up_sigma)
    for axis in range(3):
        P[axis, axis] += lingering[axis] ** 2 + white[axis] ** 2
        P[axis, at + axis] = P[at + axis, axis] = -lingering[axis]
        P[at + axis, at + axis] = 1.0
    P[0, 0] += second[0]
    P[1, 1] += second[1]
    extras = list(nav.extras)
    for name in WANDER:
        extras[layout.extra(name)] = 0.0
    return nav._replace(position=position, covariance=0.5 * (P + P.T), extras=tuple(extras))


def at_speed(nav: Nav, speed: float, sigma: float) -> Nav:
    """Return the state with a speed along the body's x axis that was found from fixes."""
    n = len(nav.covariance)
    forward = so3.rotate(nav.attitude, (1.0, 0.0, 0.0))
    along = sum(a * b for a, b in zip(forward, nav.velocity, strict=True))
    H = np.zeros((1, n))
    H[0, 3:6] = forward
    # the mean over the stretch is not the speed now: a tenth of it may have changed
    variance = sigma * sigma + (0.1 * speed) ** 2 + 0.04
    error, P = kalman.corrected(nav.covariance, np.array((speed - along,)), H, np.array(((variance,),)))
    return nav.injected(error, P)
