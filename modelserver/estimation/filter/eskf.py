"""Error-state Kalman filter: state, propagation, update, reset.

Nominal state (`NavState`), in the local level frame N of its origin, fixed to the earth, with axes east, north and up
once the filter is aligned: position p and velocity v of the IMU, attitude R of the body axes (rolling frame: x forward,
y left, z up), gyro bias b_g, accelerometer bias b_a, and the additional states of `ErrorLayout`.

Propagation, with specific force f, angular rate w and earth rate w_E (P. Groves, "Principles of GNSS, Inertial, and
Multisensor Integrated Navigation Systems", 2013, 5.4 in a local tangent frame):

    p' = v,   v' = R (f - b_a) + g(p) - 2 w_E x v,   R' = R [w - b_g - R' w_E]x                                  (1)

g includes the centrifugal acceleration and follows the vertical of the place. Each IMU interval is integrated with the
mean of the samples at its ends, R at its middle.

Error state, R_true = exp([theta]x) R (J. Sola, "Quaternion kinematics for the error-state Kalman filter", 2017, 7,
global angular error):

    dp' = dv,   dv' = -[R f]x theta - R db_a + noise,   theta' = -R db_g + noise                                 (2)

The covariance P <- F P F' + Q (Groves 14.2) is propagated every COVARIANCE_STEP, not with each sample: errors change
slowly, and it is most of the work. `lag` and `impulse` of the state hold what F needs over that time.

Update, with residual y, Jacobian H, noise R (Groves 3.2, Joseph form; filterpy's KalmanFilter holds the error state):

    S = H P H' + R,   gate: y' S^-1 y <= chi2(1 - risk, m),   K = P H' S^-1                                      (3)

Reset: the error K y is injected into the nominal state and is 0 again; P is rotated by half of it (Sola 7.3).

Limits: one IMU; rates below 1 rad per interval; within 200 km of N's origin.
Read top-down: `ErrorLayout` -> `NavState` -> `propagate` -> `propagate_covariance` -> `update` -> `NavState.inject`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from struct import Struct
from typing import Any, Final, NamedTuple

import numpy as np

from modelserver import earth as earth_model
from modelserver.estimation.filter.settings import FilterSettings
from modelserver.estimation.filterpy_import import import_kalman_filter
from modelserver.estimation.inputs import EARTH_RADIUS
from modelserver.messages import Decision, Verdict
from modelserver.named_tuples import new_tuple
from modelserver.transforms import so3
from modelserver.transforms.so3 import Array, Quaternion, Vector3, cross
from modelserver.transforms.transformation import chi_square_survival

POSITION, VELOCITY, ATTITUDE, GYRO_BIAS, ACCELEROMETER_BIAS = (slice(n, n + 3) for n in (0, 3, 6, 9, 12))
"""Indices of the strapdown states: errors along the axes of N, biases along the body axes."""

STRAPDOWN: Final = 15
"""Number of the strapdown states; the additional states follow them."""

_STRAPDOWN_NAMES = (
    *("position_east", "position_north", "position_up"),
    *("velocity_east", "velocity_north", "velocity_up"),
    *("attitude_east", "attitude_north", "attitude_up"),
    *("gyro_bias_x", "gyro_bias_y", "gyro_bias_z"),
    *("accelerometer_bias_x", "accelerometer_bias_y", "accelerometer_bias_z"),
)


@dataclass(frozen=True, slots=True)
class ErrorState:
    """An additional state: a parameter that a measurement needs and that is estimated with the strapdown states.

    Attributes
    ----------
    names: one for each number.
    sigma: initial standard deviation of each number.
    walk: density of a random walk, unit per square root of a second.
    time_constant: of a Gauss-Markov process with steady standard deviation `sigma`, seconds; infinite: a random walk.
    """

    names: tuple[str, ...]
    sigma: float
    walk: float = 0.0
    time_constant: float = math.inf


class ErrorLayout:
    """The error vector: the 15 strapdown states, then the additional ones in their order. Immutable."""

    def __init__(self, extras: Iterable[ErrorState] = ()):
        """Lay out the additional states. Raises ValueError for a name that is declared twice."""
        self.extras = tuple(dict.fromkeys(extras))
        self.extra_names = tuple(name for extra in self.extras for name in extra.names)
        self.names = _STRAPDOWN_NAMES + self.extra_names
        self.size = len(self.names)
        twice = {name for name in self.names if self.names.count(name) > 1}
        if twice:
            raise ValueError(f"an error state is declared twice: {min(twice)}")
        self._index = {name: index for index, name in enumerate(self.names)}

    def __contains__(self, name: str) -> bool:
        return name in self._index

    def index(self, name: str) -> int:
        """Return the index of a state. Raises KeyError for one that is not declared."""
        return self._index[name]

    def extra_index(self, name: str) -> int:
        """Return the index of an additional state among the additional ones. Raises KeyError."""
        return self._index[name] - STRAPDOWN

    @cached_property
    def extra_sigmas(self) -> tuple[float, ...]:
        """Initial standard deviation of each additional state."""
        return tuple(extra.sigma for extra in self.extras for _ in extra.names)

    @cached_property
    def decay_rates(self) -> Array:
        """1 / time constant of each additional state, 1/s; 0 for a random walk."""
        rates = [0.0 if math.isinf(e.time_constant) else 1.0 / e.time_constant for e in self.extras for _ in e.names]
        return np.array(rates)

    @cached_property
    def growth_rates(self) -> Array:
        """The decay rates with their sign, -1 / time constant, 1/s."""
        return -self.decay_rates

    @cached_property
    def densities_and_rates(self) -> tuple[tuple[float, float], ...]:
        """Noise density and decay rate of each additional state, as plain numbers."""
        return tuple(zip(self.noise_densities.tolist(), self.decay_rates.tolist(), strict=True))

    @cached_property
    def noise_densities(self) -> Array:
        """Spectral density of the process noise of each additional state, its unit squared per second."""
        found = [
            e.walk**2 if math.isinf(e.time_constant) else 2.0 * e.sigma**2 / e.time_constant
            for e in self.extras
            for _ in e.names
        ]
        return np.array(found)


KalmanFilter: Final = import_kalman_filter()

ZERO: Final[Vector3] = (0.0, 0.0, 0.0)

STANDARD_GRAVITY: Final = 9.80665
COVARIANCE_STEP: Final = 0.05
"""Seconds between two steps of the covariance, at least."""


# --- state --------------------------------------------------------------------------------------------------


class NavState(NamedTuple):
    """Nominal state at `utime`, the covariance of its error, and the last IMU sample.

    A NamedTuple, because a new one is made for every IMU sample.

    Attributes
    ----------
    utime: microseconds.
    position, velocity: of the IMU in N, m and m/s.
    attitude: rotation from the body axes to N.
    gyro_bias, accelerometer_bias: along the body axes, rad/s and m/s2.
    extras: the additional states, in the order of the layout.
    covariance: (n, n) of the error (position, velocity, attitude, biases, additional states). It holds for the instant
        `utime - 1e6 lag`.
    lag: seconds since the covariance was propagated.
    impulse: integral of R f over the lag, m/s along N.
    rate, force: last IMU sample, rad/s and m/s2 along the body axes, with its biases.
    travel: integral of the rolling frame's velocity along the body axes since the last wheel sample, m.
    rotation: integral of the angular rate since then, rad.
    """

    utime: int
    position: Vector3
    velocity: Vector3
    attitude: Quaternion
    gyro_bias: Vector3
    accelerometer_bias: Vector3
    extras: tuple[float, ...]
    covariance: Array
    lag: float = 0.0
    impulse: Vector3 = ZERO
    rate: Vector3 = ZERO
    force: Vector3 = ZERO
    travel: Vector3 = ZERO
    rotation: Vector3 = ZERO

    @property
    def angular_rate(self) -> Vector3:
        """Angular rate of the body relative to N along the body axes, rad/s; it includes the earth rate."""
        (a, b, c), (d, e, f) = self.rate, self.gyro_bias
        return (a - d, b - e, c - f)

    def point(self, lever: Vector3) -> Vector3:
        """Return the position of a point of the body in N; `lever` leads to it from the IMU, body axes, m."""
        x, y, z = so3.rotate(self.attitude, lever)
        px, py, pz = self.position
        return (px + x, py + y, pz + z)

    def point_velocity(self, lever: Vector3) -> Vector3:
        """Return the velocity of a point of the body along N: v + R (w x lever)."""
        x, y, z = so3.rotate(self.attitude, cross(self.angular_rate, lever))
        vx, vy, vz = self.velocity
        return (vx + x, vy + y, vz + z)

    def body_velocity(self, lever: Vector3) -> Vector3:
        """Return the velocity of a point of the body along the body axes."""
        x, y, z = so3.rotate_back(self.attitude, self.velocity)
        (a, b, c), (d, e, f), (lx, ly, lz) = self.rate, self.gyro_bias, lever
        wx, wy, wz = a - d, b - e, c - f
        return (x + (wy * lz - wz * ly), y + (wz * lx - wx * lz), z + (wx * ly - wy * lx))

    @property
    def yaw(self) -> float:
        """Yaw of the body in N, rad."""
        w, x, y, z = self.attitude
        return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))

    @property
    def up(self) -> Vector3:
        """N's up along the body axes."""
        return so3.rotate_back(self.attitude, (0.0, 0.0, 1.0))

    def with_covariance(self, covariance: Array, extras: tuple[float, ...]) -> NavState:
        """Return the state with its covariance at its instant, and the additional states there."""
        return new_tuple(NavState, (*self[:6], extras, covariance, 0.0, ZERO, *self[10:]))

    def inject(self, error: Array, covariance: Array) -> NavState:
        """Return the state with an error (n) injected, and the covariance (n, n) after the reset (Sola 7.3)."""
        e = error.tolist()
        angle = (e[6], e[7], e[8])
        size = abs(e[6]) + abs(e[7]) + abs(e[8])
        attitude = so3.normalize(so3.multiply(so3.exponential(angle), self.attitude)) if size else self.attitude
        if size > 1e-3:
            G = np.eye(len(covariance))
            G[ATTITUDE, ATTITUDE] += so3.skew((0.5 * e[6], 0.5 * e[7], 0.5 * e[8]))
            covariance = G @ covariance @ G.T
        px, py, pz = self.position
        vx, vy, vz = self.velocity
        gx, gy, gz = self.gyro_bias
        ax, ay, az = self.accelerometer_bias
        return new_tuple(
            NavState,
            (
                self.utime,
                (px + e[0], py + e[1], pz + e[2]),
                (vx + e[3], vy + e[4], vz + e[5]),
                attitude,
                (gx + e[9], gy + e[10], gz + e[11]),
                (ax + e[12], ay + e[13], az + e[14]),
                tuple([value + delta for value, delta in zip(self.extras, e[15:], strict=True)]),
                covariance,
                *self[8:],
            ),
        )

    def widen(self, variances: Mapping[int, float]) -> NavState:
        """Return the state with independent errors added: their variances by the index of the element."""
        P = self.covariance.copy()
        for at, variance in variances.items():
            P[at, at] += variance
        return self._replace(covariance=P)

    def forget(self, elements: slice | Sequence[int], covariance: Array | Sequence[float] = ()) -> NavState:
        """Return the state with m elements of the error independent of the others.

        Their `covariance` is (m, m), or the variances (m); empty: they are certain.
        """
        P = self.covariance.copy()
        P[elements, :] = P[:, elements] = 0.0
        if len(covariance):
            at = np.arange(len(P))[elements]
            given = np.asarray(covariance)
            P[np.ix_(at, at)] = np.diag(given) if given.ndim == 1 else given
        return self._replace(covariance=P)

    def transform(self, T: Array) -> NavState:
        """Return the state with T (n, n) times its error as the error."""
        P = T @ self.covariance @ T.T
        return self._replace(covariance=0.5 * (P + P.T))

    def change(self, index: int, amount: float) -> NavState:
        """Return the state with one element of the error changed by an amount, and the others as is expected with it.

        That is P[:, index] / P[index, index] times the amount; the covariance stays.
        """
        if not amount:
            return self  # an element that is certain never changes
        P = self.covariance
        return self.inject(P[:, index] * (amount / P[index, index]), P)


class Earth(NamedTuple):
    """Gravity at N's origin, m/s2, and the earth rate along N's axes, rad/s."""

    gravity: float = STANDARD_GRAVITY
    rotation: Vector3 = ZERO

    @classmethod
    def at(cls, latitude_deg: float, height: float) -> Earth:
        """Return the values of a place where N is east, north, up."""
        return cls(earth_model.gravity(latitude_deg, height), earth_model.earth_rate(latitude_deg))

    def without_heading(self) -> Earth:
        """Return the values where N is rotated about up by an unknown angle: what is horizontal has no direction."""
        return Earth(self.gravity, (0.0, 0.0, self.rotation[2]))


class ProcessNoise(NamedTuple):
    """Spectral densities of the process noise: (rad/s)2/Hz, (m/s2)2/Hz, and of the random walks of the biases.

    `tilt` and `yaw` are those of the attitude. `gyros_drive_attitude` is False where it is constant, or not measured by
    gyros: a correction of their bias must not rotate it. `is_stationary`: the vehicle's place is constant too, whatever
    velocity the accelerometers make up.
    """

    tilt: float
    yaw: float
    accelerometer: float
    gyro_bias: float
    accelerometer_bias: float
    gyros_drive_attitude: bool = True
    is_stationary: bool = False


def compute_tilt(up: Vector3) -> float:
    """Return the angle between a direction of the body and its up, rad."""
    x, y, z = up
    return math.atan2(math.hypot(x, y), z)


def level_attitude(up: Vector3) -> Quaternion:
    """Return the attitude with yaw 0 of a body that measures up along `up` (body axes, any length)."""
    x, y, z = up
    roll = math.atan2(y, z)
    pitch = math.atan2(-x, math.hypot(y, z))
    return so3.from_rpy(roll, pitch, 0.0)


# --- propagation --------------------------------------------------------------------------------------------


def propagate(nav: NavState, utime: int, rate: Vector3, force: Vector3, earth: Earth, base: Vector3) -> NavState:
    """Propagate the nominal state over one IMU interval, equations (1); the covariance lags behind.

    Parameters
    ----------
    utime: end of the interval, not before the state.
    rate, force: IMU sample at `utime`, rad/s and m/s2 along the body axes, with its biases.
    base: from the IMU to the rolling frame's origin, body axes, m.
    """
    # unpacked at once, and a call less for each product of rotations: an eighth of the work for every IMU sample
    since, p, v, q, gyro_bias, accelerometer_bias, extras, P, lag, impulse, r, s, travel, rotation = nav
    dt = (utime - since) * 1e-6
    (r1, r2, r3), (r4, r5, r6), (gx, gy, gz) = r, rate, gyro_bias
    wx, wy, wz = 0.5 * (r1 + r4) - gx, 0.5 * (r2 + r5) - gy, 0.5 * (r3 + r6) - gz
    g, earth_rotation = earth
    ex, ey, ez = earth_rotation
    if ez:
        a, b, c = so3.rotate_back(q, earth_rotation)
        wx, wy, wz = wx - a, wy - b, wz - c
    (s1, s2, s3), (s4, s5, s6), (ax, ay, az) = s, force, accelerometer_bias

    h = 0.5 * dt
    middle = so3.turn(q, (wx * h, wy * h, wz * h))
    fx, fy, fz = so3.rotate(middle, (0.5 * (s1 + s4) - ax, 0.5 * (s2 + s5) - ay, 0.5 * (s3 + s6) - az))
    px, py, pz = p
    vx, vy, vz = v
    # the vertical turns by 1 / radius for each meter from N's origin
    lean = g / EARTH_RADIUS
    ux = vx + (fx - lean * px - 2.0 * (ey * vz - ez * vy)) * dt
    uy = vy + (fy - lean * py - 2.0 * (ez * vx - ex * vz)) * dt
    uz = vz + (fz - g + 2.0 * lean * pz - 2.0 * (ex * vy - ey * vx)) * dt
    mx, my, mz = 0.5 * (vx + ux), 0.5 * (vy + uy), 0.5 * (vz + uz)
    bx, by, bz = so3.rotate_back(middle, (mx, my, mz))
    turn = ox, oy, oz = (wx * dt, wy * dt, wz * dt)
    (rx, ry, rz), (tx, ty, tz), (ix, iy, iz), (lx, ly, lz) = travel, rotation, impulse, base
    return new_tuple(
        NavState,
        (
            utime,
            (px + mx * dt, py + my * dt, pz + mz * dt),
            (ux, uy, uz),
            so3.normalize(so3.turn(q, turn)),
            gyro_bias,
            accelerometer_bias,
            extras,
            P,
            lag + dt,
            (ix + fx * dt, iy + fy * dt, iz + fz * dt),
            rate,
            force,
            (
                rx + (bx + wy * lz - wz * ly) * dt,
                ry + (by + wz * lx - wx * lz) * dt,
                rz + (bz + wx * ly - wy * lx) * dt,
            ),
            (tx + ox, ty + oy, tz + oz),
        ),
    )


def propagate_without_imu(nav: NavState, utime: int, rate: Vector3, base: Vector3) -> NavState:
    """Propagate the nominal state at constant speed and the angular rate `rate` (rad/s, body axes, relative to N)."""
    dt = (utime - nav.utime) * 1e-6
    gx, gy, gz = nav.gyro_bias
    angle = (rate[0] * dt, rate[1] * dt, rate[2] * dt)
    attitude = so3.normalize(so3.multiply(nav.attitude, so3.exponential(angle)))
    bx, by, bz = so3.rotate(so3.conjugate(nav.attitude), nav.velocity)
    # the velocity turns with the body
    ux, uy, uz = velocity = so3.rotate(attitude, (bx, by, bz))
    px, py, pz = nav.position
    vx, vy, vz = nav.velocity
    rx, ry, rz = nav.travel
    ox, oy, oz = nav.rotation
    lx, ly, lz = base
    wx, wy, wz = rate
    return nav._replace(
        utime=utime,
        position=(px + 0.5 * (vx + ux) * dt, py + 0.5 * (vy + uy) * dt, pz + 0.5 * (vz + uz) * dt),
        velocity=velocity,
        attitude=attitude,
        lag=nav.lag + dt,
        rate=(wx + gx, wy + gy, wz + gz),
        travel=(
            rx + (bx + wy * lz - wz * ly) * dt,
            ry + (by + wz * lx - wx * lz) * dt,
            rz + (bz + wx * ly - wy * lx) * dt,
        ),
        rotation=(ox + angle[0], oy + angle[1], oz + angle[2]),
    )


def propagate_covariance(nav: NavState, noise: ProcessNoise, layout: ErrorLayout) -> NavState:
    """Return the state with its covariance propagated to its instant: P <- F P F' + Q."""
    dt = nav.lag
    if dt <= 0.0:
        return nav
    decays: list[float] = np.exp(dt * layout.growth_rates).tolist()
    workspace, zero = _workspace(layout.size, 1)
    workspace.x, workspace.P = zero, nav.covariance
    workspace.predict(
        F=_transition_matrix(nav, dt, layout, decays, noise),
        Q=_process_noise_matrix(noise, dt, layout, decays),
    )
    extras = tuple([value * keep for value, keep in zip(nav.extras, decays, strict=True)])
    return nav.with_covariance(workspace.P, extras)


def _transition_matrix(
    nav: NavState, dt: float, layout: ErrorLayout, decays: Sequence[float], noise: ProcessNoise
) -> Array:
    """Return F (n, n) over the lag: equations (2) to second order in dt. `decays` are those of the additional states.

    The array is valid until the next call.
    """
    ix, iy, iz = nav.impulse
    (a, b, c), (d, e, f), (g, h, i) = so3.matrix_rows(nav.attitude)
    t, u, k, m = -dt, -0.5 * dt * dt, 0.5 * dt, dt
    if noise.is_stationary:
        # what shakes it has no direction, and does not move it
        ix = iy = u = k = m = 0.0
    w = t if noise.gyros_drive_attitude else 0.0
    return _transition_buffer(layout.size).fill(
        # position by velocity, attitude and accelerometer bias
        *(m, m, m),
        *(k * iz, -k * iy, -k * iz, k * ix, k * iy, -k * ix),
        *(u * a, u * b, u * c, u * d, u * e, u * f, u * g, u * h, u * i),
        # velocity by attitude and accelerometer bias
        *(iz, -iy, -iz, ix, iy, -ix),
        *(t * a, t * b, t * c, t * d, t * e, t * f, t * g, t * h, t * i),
        # attitude by gyro bias
        *(w * a, w * b, w * c, w * d, w * e, w * f, w * g, w * h, w * i),
        *decays,
    )


def _process_noise_matrix(noise: ProcessNoise, dt: float, layout: ErrorLayout, decays: Sequence[float]) -> Array:
    """Return Q (n, n) over the lag; the array is valid until the next call."""
    v = noise.accelerometer * dt
    p, pv = (0.0, 0.0) if noise.is_stationary else (v * dt * dt / 3.0, v * dt / 2.0)
    tilt, yaw = noise.tilt * dt, noise.yaw * dt
    bg, ba = noise.gyro_bias * dt, noise.accelerometer_bias * dt
    # exact for a Gauss-Markov process; dt, its limit, for a random walk
    extras = [
        density * ((1.0 - keep * keep) / (2.0 * rate) if rate > 0.0 else dt)
        for (density, rate), keep in zip(layout.densities_and_rates, decays, strict=True)
    ]
    return _process_noise_buffer(layout.size).fill(
        *(p, p, p, v, v, v, tilt, tilt, yaw, bg, bg, bg, ba, ba, ba, *extras),
        *(pv, pv, pv, pv, pv, pv),
    )


class MatrixBuffer:
    """A matrix with constant places for changing numbers; the other entries stay.

    It is reused, and filled by way of `struct`: both are faster than a new array of a tuple.
    """

    def __init__(self, matrix: Array, places: Iterable[tuple[int, int]]):
        """Reuse a matrix, with `places` (row, column) in the order of the numbers."""
        n = matrix.shape[1]
        self._matrix, self._flat = matrix, matrix.reshape(-1)
        self._indices = np.array([row * n + column for row, column in places])
        self._values = np.zeros(len(self._indices))
        self._pack = partial(Struct(f"{len(self._indices)}d").pack_into, self._values.data, 0)

    def fill(self, *numbers: float) -> Array:
        """Return the matrix with these numbers at its places; it is valid until the next call."""
        self._pack(*numbers)
        self._flat[self._indices] = self._values
        return self._matrix


@lru_cache(maxsize=16)
def _transition_buffer(n: int) -> MatrixBuffer:
    """Return the buffer of an (n, n) F with the entries of `_transition_matrix`, in its order."""
    skew = [(0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1)]
    full = [(r, c) for r in range(3) for c in range(3)]
    places = [(k, 3 + k) for k in range(3)]
    places += [(r, 6 + c) for r, c in skew]
    places += [(r, 12 + c) for r, c in full]
    places += [(3 + r, 6 + c) for r, c in skew]
    places += [(3 + r, 12 + c) for r, c in full]
    places += [(6 + r, 9 + c) for r, c in full]
    places += [(k, k) for k in range(STRAPDOWN, n)]
    return MatrixBuffer(np.eye(n), places)


@lru_cache(maxsize=16)
def _process_noise_buffer(n: int) -> MatrixBuffer:
    """Return the buffer of an (n, n) Q with the entries of `_process_noise_matrix`, in its order."""
    places = [(k, k) for k in range(n)] + [(k, k + 3) for k in range(3)] + [(k + 3, k) for k in range(3)]
    return MatrixBuffer(np.zeros((n, n)), places)


# --- update and reset ---------------------------------------------------------------------------------------


class Innovation(NamedTuple):
    """A measurement against the state: residual (m) = measured - predicted = jacobian (m, n) error + noise.

    Attributes
    ----------
    noise: covariance (m, m) of the measurement noise.
    monitored: why the measurement is only compared for the ledger and not used, in a word; empty: it is used.
    is_separable: if all components together fail the gate, those that pass it alone may be used.
    inflation_limit: a NIS up to this many times the gate is used with its noise inflated until it passes (P. Huber's
        weighting) instead of being rejected: for measurements with occasional large errors, which must not be shut out
        when the state has drifted.
    """

    residual: Array
    jacobian: Array
    noise: Array
    monitored: str = ""
    is_separable: bool = False
    inflation_limit: float = 1.0


def update(
    nav: NavState, innovation: Innovation, settings: FilterSettings, utime: int, source: str, seq: int, kind: str
) -> tuple[NavState, Decision]:
    """Fuse a measurement behind its chi-square gate, equations (3).

    `utime`, `source`, `seq` and `kind` identify it in the decision. A rejected one leaves the state as it was.
    """
    y, H, R, monitored, is_separable, inflation_limit = innovation
    S = innovation_covariance(nav.covariance, H, R)
    residual, covariance, noise = y.tolist(), S.ravel().tolist(), R.ravel().tolist()
    # a number that is not finite makes the sum so, one of H that of S
    is_finite = math.isfinite(sum(residual) + sum(covariance) + sum(noise))
    if not is_finite and not (np.isfinite(y).all() and np.isfinite(H).all() and np.isfinite(R).all()):
        return nav, Decision(utime, source, seq, kind, Verdict.REJECTED, "nan")
    nis = normalized_innovation_squared(y, S)
    limit = chi_square_gate(len(y), settings.gate_risk)
    verdict, reason = Verdict.USED, ""
    if monitored:
        verdict, reason = Verdict.MONITORED, monitored
    elif not nis <= limit:
        verdict, reason = Verdict.REJECTED, "gate"
        if nis <= inflation_limit * limit:
            # S' = S nis / limit: the NIS becomes the limit
            verdict, reason = Verdict.USED, "eased"
            R = R + (nis / limit - 1.0) * S
            noise = R.ravel().tolist()
            is_separable = False
        if is_separable and len(y) > 1:
            single = chi_square_gate(1, settings.gate_risk)
            fits = y * y <= single * np.diagonal(S)
            if fits.any() and not fits.all():
                y_, S_ = y[fits], S[np.ix_(fits, fits)]
                if normalized_innovation_squared(y_, S_) <= chi_square_gate(len(y_), settings.gate_risk):
                    verdict, reason = Verdict.USED, "part"
                    part = fits
    decision = Decision(
        utime,
        source,
        seq,
        kind,
        verdict,
        reason,
        tuple(residual),
        tuple(covariance),
        tuple(noise),
        nis,
        limit,
    )
    if verdict is not Verdict.USED:
        return nav, decision
    if reason == "part":
        y, H, R = y[part], H[part], R[np.ix_(part, part)]
    try:
        error, P = correct(nav.covariance, y, H, R)
    except np.linalg.LinAlgError:
        return nav, decision._replace(verdict=Verdict.REJECTED, reason="singular")
    return nav.inject(error, P), decision


def innovation_covariance(P: Array, H: Array, R: Array) -> Array:
    """Return S = H P H' + R, (m, m), symmetric."""
    S: Array = np.dot(np.dot(H, P), H.T) + R
    return 0.5 * (S + S.T)


def normalized_innovation_squared(residual: Array, S: Array) -> float:
    """Return the NIS, residual' S^-1 residual: chi-square distributed for a consistent filter; infinite if S is
    singular.
    """
    if len(residual) == 1:
        y, s = float(residual[0]), float(S[0, 0])
        return y * y / s if s > 0.0 else math.inf
    try:
        return float(residual @ np.linalg.solve(S, residual))
    except np.linalg.LinAlgError:
        return math.inf


def correct(P: Array, residual: Array, H: Array, R: Array) -> tuple[Array, Array]:
    """Return the error K y (n) and the covariance (n, n) after an update in Joseph form.

    `P` is (n, n), `residual` (m), `H` (m, n), `R` (m, m). Raises numpy.linalg.LinAlgError if S is singular.
    """
    n, m = len(P), len(residual)
    assert H.shape == (m, n), (H.shape, m, n)
    assert R.shape == (m, m), R.shape
    workspace, zero = _workspace(n, m)
    workspace.x, workspace.P = zero, P
    workspace.update(residual, R=R, H=H)
    error: Array = workspace.x
    after: Array = workspace.P
    workspace.x = zero
    return error, 0.5 * (after + after.T)


@lru_cache(maxsize=64)
def _workspace(n: int, m: int) -> tuple[Any, Array]:
    """Return filterpy's KalmanFilter of n states and m measurements, and its zero error state.

    It is a workspace: each call sets all that it reads, so the functions here are pure. x is one-dimensional; H, R, F
    and Q are two-dimensional and always given, because its defaults broadcast silently.
    """
    workspace = KalmanFilter(dim_x=n, dim_z=m)
    if m == 1:
        workspace.inv = _invert_scalar
    zero = np.zeros(n)
    zero.flags.writeable = False
    workspace.x = zero
    return workspace, zero


def _invert_scalar(S: Array) -> Array:
    """Return the inverse of a (1, 1) matrix, as numpy.linalg.inv does at ten times the cost."""
    s = float(S[0, 0])
    if s == 0.0:
        raise np.linalg.LinAlgError("singular")
    return np.array(((1.0 / s,),))


@lru_cache(maxsize=256)
def chi_square_gate(dof: int, risk: float) -> float:
    """Return the value that a chi-square variable of `dof` degrees of freedom exceeds with probability `risk`."""
    low, high = 0.0, 1.0
    while chi_square_survival(high, dof) > risk:
        low, high = high, 2.0 * high
    while low < (middle := 0.5 * (low + high)) < high:
        low, high = (middle, high) if chi_square_survival(middle, dof) > risk else (low, middle)
    return high


# --- divergence ---------------------------------------------------------------------------------------------


def is_plausible(nav: NavState, settings: FilterSettings) -> bool:
    """Return whether position and speed are finite and those of a vehicle: the cheap part of `is_sound`."""
    # a comparison with nan is false
    return math.isfinite(sum(nav.position)) and math.hypot(*nav.velocity) <= 2.0 * settings.maximum_speed


def is_sound(nav: NavState, settings: FilterSettings) -> bool:
    """Return whether the state is finite and within its limits; otherwise the filter has diverged."""
    P = nav.covariance
    # one number that is not finite makes the sum of squares so
    if not (math.isfinite(np.vdot(P, P)) and min(P.diagonal().tolist()) >= 0.0):
        return False
    numbers = (*nav.position, *nav.velocity, *nav.gyro_bias, *nav.accelerometer_bias, *nav.extras)
    if not math.isfinite(sum(numbers)):
        return False
    return (
        math.hypot(*nav.velocity) <= 2.0 * settings.maximum_speed
        and math.hypot(*nav.gyro_bias) <= 20.0 * settings.gyro_bias_sigma
        and math.hypot(*nav.accelerometer_bias) <= 20.0 * settings.accelerometer_bias_sigma
    )
