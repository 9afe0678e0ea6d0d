"""Measurement model: residual, Jacobian H and measurement noise R of a sample, for the update of the filter.

A kind of measurement is a class with `@register`; `GpsPosition` in gnss.py is an example. Installed packages add theirs
as own.py describes. Jacobians of points of the body for R_true = exp([theta]x) R:

    position        p + R l          by position I, by attitude -[R l]x
    velocity        v + R (w x l)    by velocity I, by attitude -[R (w x l)]x, by gyro bias R [l]x
    body velocity   R' v + w x l     by velocity R', by attitude R' [v]x, by gyro bias [l]x

with w = measured rate - bias: an error of the bias changes w x l by l x error.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar, Final, NamedTuple, Protocol, Self, TypeVar

import numpy as np

from modelserver.earth.geodesy import Geodesy, LocalFrame
from modelserver.estimation.filter.error_layout import ATTITUDE, GYRO_BIAS, VELOCITY, ErrorLayout, ErrorState
from modelserver.estimation.filter.eskf import ZERO, Innovation, NavState
from modelserver.estimation.filter.settings import FilterSettings
from modelserver.estimation.sensor_rig import SensorRig
from modelserver.transforms import so3
from modelserver.transforms.so3 import Array, Vector3, cross

IMU_AVERAGING: Final = 0.02
"""Seconds over which the angular rate of one IMU sample is a mean: a bandwidth of about 50 Hz."""


class MeasurementContext(NamedTuple):
    """What a measurement is compared with.

    Attributes
    ----------
    nav: the state at the measurement's instant, with its covariance there.
    site: tangent plane that N is east, north, up of; None before the filter is aligned, while N has no place on earth.
    geodesy: of the origin, None before it is known.
    is_stationary: whether the vehicle is stationary.
    age: seconds since the previous measurement of the kind and source; infinite for the first.
    previous: its sample.
    steering: steering angle that the vehicle controller measures, rad; nan without a fresh one.
    """

    nav: NavState
    layout: ErrorLayout
    settings: FilterSettings
    rig: SensorRig
    site: LocalFrame | None = None
    geodesy: Geodesy | None = None
    is_stationary: bool = False
    age: float = math.inf
    previous: Any = None
    steering: float = math.nan

    def zero_jacobian(self, rows: int) -> Array:
        return np.zeros((rows, self.layout.size))

    def extra(self, name: str) -> float:
        """Return the estimate of an additional state; 0 if it is not declared."""
        return self.nav.extras[self.layout.extra_index(name)] if name in self.layout else 0.0


class Measurement(Protocol):
    """One kind of measurement of a vehicle.

    Attributes
    ----------
    kind: its name in the ledger.
    sample: the type of sample that it reads.
    states: the additional error states that it needs.
    """

    kind: ClassVar[str]
    sample: ClassVar[type]
    states: ClassVar[tuple[ErrorState, ...]]

    @classmethod
    def create(cls, rig: SensorRig, settings: FilterSettings) -> Self | None:
        """Return the measurement of a vehicle; None if the vehicle lacks what it needs."""
        ...

    def get_utime(self, sample: Any) -> int | None:
        """Return the instant of the measurement in a sample; None if the sample does not contain it."""
        ...

    def evaluate(self, context: MeasurementContext, sample: Any) -> Innovation | str:
        """Return the innovation, or in one word why there is none; an empty word is not counted."""
        ...


M = TypeVar("M", bound=type[Measurement])

REGISTRY: dict[str, type[Measurement]] = {}
"""Every kind of measurement that a new filter uses, by name; those of one sample are fused in this order."""


def register(kind: M) -> M:
    """Add a kind of measurement to those that every new filter uses (decorator)."""
    REGISTRY[kind.kind] = kind
    return kind


def choose_covariance(stated: Array | None, size: int, sigma: float) -> Array:
    """Return a stated covariance (size, size), made symmetric, if it is positive definite, else that of `sigma`."""
    if stated is not None:
        stated = 0.5 * (stated + stated.T)
        if np.isfinite(stated).all() and np.linalg.eigvalsh(stated)[0] > 0.0:
            return stated
    return np.eye(size) * sigma * sigma


def point_jacobian(nav: NavState, lever: Vector3, size: int) -> Array:
    """Return H (3, n) of the position of a point of the body in N; `lever` leads to it from the IMU, body axes, m."""
    H = np.zeros((3, size))
    x, y, z = so3.rotate(nav.attitude, lever)
    H[0, 0] = H[1, 1] = H[2, 2] = 1.0
    H[0, 7], H[0, 8] = z, -y
    H[1, 6], H[1, 8] = -z, x
    H[2, 6], H[2, 7] = y, -x
    return H


def point_velocity_jacobian(nav: NavState, lever: Vector3, size: int) -> Array:
    """Return H (3, n) of the velocity of a point of the body along N."""
    H = np.zeros((3, size))
    x, y, z = so3.rotate(nav.attitude, cross(nav.angular_rate, lever))
    H[0, 3] = H[1, 4] = H[2, 5] = 1.0
    H[0, 7], H[0, 8] = z, -y
    H[1, 6], H[1, 8] = -z, x
    H[2, 6], H[2, 7] = y, -x
    if lever != ZERO:
        H[:, GYRO_BIAS] = np.array(so3.matrix_rows(nav.attitude)) @ so3.skew(lever)
    return H


def body_velocity_jacobian(nav: NavState, lever: Vector3, size: int) -> Array:
    """Return H (3, n) of the velocity of a point of the body along the body axes."""
    H = np.zeros((3, size))
    Rt = np.array(so3.matrix_rows(so3.conjugate(nav.attitude)))
    H[:, VELOCITY] = Rt
    H[:, ATTITUDE] = Rt @ so3.skew(nav.velocity)
    if lever != ZERO:
        H[:, GYRO_BIAS] = so3.skew(lever)
    return H


def compute_azimuth(u: Vector3, size: int) -> tuple[float, Array]:
    """Return the azimuth of a vector along N's axes, rad from x, and its Jacobian (1, n) by the attitude.

    With du = theta x u: d(azimuth) = (u_x du_y - u_y du_x) / (u_x^2 + u_y^2).
    """
    x, y, z = u
    square = x * x + y * y
    H = np.zeros((1, size))
    H[0, 6:9] = (-z * x / square, -z * y / square, 1.0)
    return math.atan2(y, x), H


def wrap_angle(angle: float) -> float:
    """Return an angle within -pi to pi, rad."""
    return math.remainder(angle, math.tau)
