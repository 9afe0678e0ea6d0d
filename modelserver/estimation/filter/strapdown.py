"""Strapdown propagation: mechanization in a local level frame, and the covariance of its error.

In a frame N that is fixed to the earth, level at its origin (P. Groves, "Principles of GNSS, inertial, and multisensor
integrated navigation systems", 2013, 5.4 in a local tangent frame):

    p' = v,   v' = R (f - b_a) + g(p) - 2 w_E x v,   R' = R [w - b_g - R' w_E]x

with f the specific force, w the turn rate felt, w_E the earth's rotation; g holds the centrifugal part and leans with
the vertical of the place. The errors (R_true = exp(theta) R) follow (J. Sola 2017, 7, global angular error):

    dp' = dv,   dv' = -[R f]x theta - R db_a + noise,   theta' = -R db_g + noise
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from modelserver.earth import gravity as earth_model
from modelserver.estimation.filter import kalman
from modelserver.estimation.filter.layout import STRAPDOWN, Layout
from modelserver.estimation.filter.nav import ZERO, Nav
from modelserver.transforms import so3
from modelserver.transforms.so3 import Array, Vector3

STANDARD_GRAVITY = 9.80665
EARTH_RADIUS = 6_371_000.0
"""Metres, mean (IUGG): only the lean of the vertical away from N's origin needs it."""

COVARIANCE_STEP = 0.05
"""Seconds between two steps of the covariance, at least: errors change slowly, and most of the work is here."""


class Earth(NamedTuple):
    """Gravity at N's origin, m/s2, and the earth's rotation along N's axes, rad/s."""

    gravity: float = STANDARD_GRAVITY
    rotation: Vector3 = ZERO

    @classmethod
    def at(cls, latitude_deg: float, height: float) -> Earth:
        """Return what is felt where N is east, north, up at a place."""
        return cls(earth_model.gravity(latitude_deg, height), earth_model.earth_rate(latitude_deg))


class Noise(NamedTuple):
    """Spectral densities of what drives the errors: (rad/s)2/Hz, (m/s2)2/Hz, and of the biases' walks.

    `by_gyros` is whether the gyros carry the attitude. That of a standing vehicle stays, whatever they feel: an error
    of their bias turns nothing then, and what is learnt of it must not turn anything either.
    """

    gyro: float
    accelerometer: float
    gyro_bias: float
    accelerometer_bias: float
    by_gyros: bool = True


def carried(nav: Nav, utime: int, rate: Vector3, force: Vector3, earth: Earth, base: Vector3) -> Nav:
    """Return the state at a later `utime`, at which `rate` and `force` are felt (body axes, biases not taken off).

    Between the two instants what is felt goes from the one to the other evenly. `base` leads from the inertial unit to
    the rolling frame's origin, body axes, metres. Covariance waits for `caught_up`.
    """
    dt = (utime - nav.utime) * 1e-6
    gx, gy, gz = nav.gyro_bias
    r, s = nav.rate, nav.force
    wx, wy, wz = 0.5 * (r[0] + rate[0]) - gx, 0.5 * (r[1] + rate[1]) - gy, 0.5 * (r[2] + rate[2]) - gz
    q = nav.attitude
    ex, ey, ez = earth.rotation
    if ez:
        a, b, c = so3.rotate((q[0], -q[1], -q[2], -q[3]), earth.rotation)
        wx, wy, wz = wx - a, wy - b, wz - c
    ax, ay, az = nav.accelerometer_bias
    felt = (0.5 * (s[0] + force[0]) - ax, 0.5 * (s[1] + force[1]) - ay, 0.5 * (s[2] + force[2]) - az)

    h = 0.5 * dt
    tx, ty, tz = wx * h, wy * h, wz * h
    half = so3.small_angle_exponential((tx, ty, tz))
    whole = so3.small_angle_exponential((wx * dt, wy * dt, wz * dt))
    middle = so3.multiply(q, half)
    fx, fy, fz = so3.rotate(middle, felt)
    px, py, pz = nav.position
    vx, vy, vz = nav.velocity
    g = earth.gravity
    lean = g / EARTH_RADIUS
    accx = fx - lean * px - 2.0 * (ey * vz - ez * vy)
    accy = fy - lean * py - 2.0 * (ez * vx - ex * vz)
    accz = fz - g + 2.0 * lean * pz - 2.0 * (ex * vy - ey * vx)
    ux, uy, uz = vx + accx * dt, vy + accy * dt, vz + accz * dt
    mx, my, mz = 0.5 * (vx + ux), 0.5 * (vy + uy), 0.5 * (vz + uz)
    bx, by, bz = so3.rotate((middle[0], -middle[1], -middle[2], -middle[3]), (mx, my, mz))
    rx, ry, rz = nav.rolled
    ox, oy, oz = nav.turned
    ix, iy, iz = nav.impulse
    lx, ly, lz = base
    return Nav(
        utime,
        (px + mx * dt, py + my * dt, pz + mz * dt),
        (ux, uy, uz),
        so3.normalize(so3.multiply(q, whole)),
        nav.gyro_bias,
        nav.accelerometer_bias,
        nav.extras,
        nav.covariance,
        nav.lag + dt,
        (ix + fx * dt, iy + fy * dt, iz + fz * dt),
        rate,
        force,
        (
            rx + (bx + wy * lz - wz * ly) * dt,
            ry + (by + wz * lx - wx * lz) * dt,
            rz + (bz + wx * ly - wy * lx) * dt,
        ),
        (ox + wx * dt, oy + wy * dt, oz + wz * dt),
    )


def coasted(nav: Nav, utime: int, rate: Vector3, base: Vector3) -> Nav:
    """Return the state at a later `utime` where no inertial unit tells: it turns at `rate` and keeps its speed.

    `rate` is relative to N. The velocity turns with the body.
    """
    dt = (utime - nav.utime) * 1e-6
    gx, gy, gz = nav.gyro_bias
    angle = (rate[0] * dt, rate[1] * dt, rate[2] * dt)
    attitude = so3.normalize(so3.multiply(nav.attitude, so3.exponential(angle)))
    bx, by, bz = so3.rotate(so3.conjugate(nav.attitude), nav.velocity)
    ux, uy, uz = velocity = so3.rotate(attitude, (bx, by, bz))
    px, py, pz = nav.position
    vx, vy, vz = nav.velocity
    rx, ry, rz = nav.rolled
    ox, oy, oz = nav.turned
    lx, ly, lz = base
    wx, wy, wz = rate
    return nav._replace(
        utime=utime,
        position=(px + 0.5 * (vx + ux) * dt, py + 0.5 * (vy + uy) * dt, pz + 0.5 * (vz + uz) * dt),
        velocity=velocity,
        attitude=attitude,
        lag=nav.lag + dt,
        rate=(wx + gx, wy + gy, wz + gz),
        rolled=(
            rx + (bx + wy * lz - wz * ly) * dt,
            ry + (by + wz * lx - wx * lz) * dt,
            rz + (bz + wx * ly - wy * lx) * dt,
        ),
        turned=(ox + angle[0], oy + angle[1], oz + angle[2]),
    )


def caught_up(nav: Nav, noise: Noise, layout: Layout) -> Nav:
    """Return the state with its covariance carried on to its instant."""
    dt = nav.lag
    if dt <= 0.0:
        return nav
    extras = nav.extras
    decays = _decay(layout, dt)
    P = kalman.predicted(
        nav.covariance, _transition(nav, dt, layout, decays, noise.by_gyros), _driven(noise, dt, layout, decays)
    )
    if decays is not None:
        extras = tuple(value * keep for value, keep in zip(extras, decays.tolist(), strict=True))
    return nav._replace(covariance=P, lag=0.0, impulse=ZERO, extras=extras)


def _decay(layout: Layout, dt: float) -> Array | None:
    return np.exp(-dt * layout.decays) if len(layout.extra_names) else None


def _transition(nav: Nav, dt: float, layout: Layout, decays: Array | None, by_gyros: bool = True) -> Array:
    """Return F (n, n) over the lag: the errors' equations to second order in it."""
    n = layout.size
    F = np.zeros((n, n))
    ix, iy, iz = nav.impulse
    (a, b, c), (d, e, f), (g, h, i) = so3.matrix_rows(nav.attitude)
    t, u = -dt, -0.5 * dt * dt
    k = 0.5 * dt
    w = t if by_gyros else 0.0
    F.put(
        _entries(n),
        (
            # position by velocity, attitude and accelerometer bias
            *(dt, dt, dt),
            *(k * iz, -k * iy, -k * iz, k * ix, k * iy, -k * ix),
            *(u * a, u * b, u * c, u * d, u * e, u * f, u * g, u * h, u * i),
            # velocity by attitude and accelerometer bias
            *(iz, -iy, -iz, ix, iy, -ix),
            *(t * a, t * b, t * c, t * d, t * e, t * f, t * g, t * h, t * i),
            # attitude by gyro bias
            *(w * a, w * b, w * c, w * d, w * e, w * f, w * g, w * h, w * i),
        ),
    )
    diagonal = F.reshape(-1)[:: n + 1]
    diagonal[:STRAPDOWN] = 1.0
    if decays is not None:
        diagonal[STRAPDOWN:] = decays
    return F


def _driven(noise: Noise, dt: float, layout: Layout, decays: Array | None) -> Array:
    """Return Q (n, n): what drives the errors over the lag; the noises are alike along all axes."""
    n = layout.size
    Q = np.zeros((n, n))
    v = noise.accelerometer * dt
    p, pv = v * dt * dt / 3.0, v * dt / 2.0
    w, bg, ba = noise.gyro * dt, noise.gyro_bias * dt, noise.accelerometer_bias * dt
    diagonal = Q.reshape(-1)[:: n + 1]
    diagonal[:STRAPDOWN] = (p, p, p, v, v, v, w, w, w, bg, bg, bg, ba, ba, ba)
    Q[0, 3] = Q[3, 0] = Q[1, 4] = Q[4, 1] = Q[2, 5] = Q[5, 2] = pv
    if decays is not None:
        # exact for a Gauss-Markov process, the limit dt for a walk
        rates = layout.decays
        share = np.where(rates > 0.0, (1.0 - decays * decays) / np.maximum(2.0 * rates, 1e-300), dt)
        diagonal[STRAPDOWN:] = layout.drives * share
    return Q


@lru_cache(maxsize=16)
def _entries(n: int) -> npt.NDArray[np.intp]:
    """Return the flat places in an (n, n) matrix of the entries that `_transition` writes, in its order."""
    skew = [(0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1)]
    full = [(r, c) for r in range(3) for c in range(3)]
    places = [(k, 3 + k) for k in range(3)]
    places += [(r, 6 + c) for r, c in skew]
    places += [(r, 12 + c) for r, c in full]
    places += [(3 + r, 6 + c) for r, c in skew]
    places += [(3 + r, 12 + c) for r, c in full]
    places += [(6 + r, 9 + c) for r, c in full]
    return np.array([r * n + c for r, c in places])


def widened(nav: Nav, **sigmas: float) -> Nav:
    """Return the state with variances added: `position`, `velocity`, `attitude`, `yaw`, each the sigma of each axis."""
    P = nav.covariance.copy()
    diagonal = P.reshape(-1)[:: len(P) + 1]
    for name, sigma in sigmas.items():
        diagonal[_BLOCKS[name]] += sigma * sigma
    return nav._replace(covariance=P)


_BLOCKS = {"position": slice(0, 3), "velocity": slice(3, 6), "attitude": slice(6, 9), "yaw": slice(8, 9)}


def level_attitude(up: Vector3) -> so3.Quaternion:
    """Return the attitude with yaw 0 of a body that feels up along `up` (body axes, any length)."""
    x, y, z = up
    roll = math.atan2(y, z)
    pitch = math.atan2(-x, math.hypot(y, z))
    return so3.from_rpy(roll, pitch, 0.0)
