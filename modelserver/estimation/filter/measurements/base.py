"""Measurement model: residual, Jacobian H and measurement noise R of a sample."""

from __future__ import annotations

import math
from typing import Any, ClassVar, NamedTuple, Protocol, Self, TypeVar

import numpy as np

from modelserver.earth.geodesy import Geodesy, LocalFrame
from modelserver.estimation.filter.layout import ErrorState, Layout
from modelserver.estimation.filter.nav import Nav
from modelserver.estimation.filter.settings import FilterSettings
from modelserver.estimation.sensor_rig import SensorRig
from modelserver.transforms.so3 import Array, Vector3

INSTANT = 0.02
"""Seconds over which an inertial unit's rate of an instant is a mean: its bandwidth of about 50 Hz."""


class Compared(NamedTuple):
    """A measurement against the state: `residual` (m) = measured - expected = `jacobian` (m, n) error + noise.

    `noise` (m, m) is the noise's covariance. `monitored`: compared for the ledger only, not used on purpose, in a
    word. `separable`: where all together do not fit, those that do alone may be used. `eased`: a statistic up to so
    many times its limit is used with its noise widened until it fits (Huber's way), instead of being refused: for
    what errs by more than usual now and then, and must not be lost for good when the state has drifted off it.
    """

    residual: Array
    jacobian: Array
    noise: Array
    monitored: str = ""
    separable: bool = False
    eased: float = 1.0


class Scene(NamedTuple):
    """What a measurement is compared with.

    `nav` is the state at the measurement's instant, its covariance caught up. `site` is the tangent plane that N is
    east, north and up of; None before the filter is aligned, when N has no place in the world. `geodesy` is that of the
    origin, None before it is known. `age` is the time since the last measurement of the same kind from the same source
    that was compared, seconds (infinite: none was); `before` is the sample it came from. `steering` is the steering
    angle that the vehicle controller measures, rad; nan where there is none that is fresh.
    """

    nav: Nav
    layout: Layout
    settings: FilterSettings
    rig: SensorRig
    site: LocalFrame | None = None
    geodesy: Geodesy | None = None
    standing: bool = False
    age: float = math.inf
    before: Any = None
    steering: float = math.nan

    def jacobian(self, rows: int) -> Array:
        """Return zeros (rows, n) to fill in."""
        return np.zeros((rows, self.layout.size))

    def extra(self, name: str) -> float:
        """Return the estimate of a further state; 0 where it is not declared."""
        return self.nav.extras[self.layout.extra(name)] if name in self.layout else 0.0


class Measurement(Protocol):
    """One kind of measurement. Make your own with `@register`; see examples/python/own_measurement.py.

    `kind` names it in the ledger, `sample` is the type of sample it reads, `states` the further error states that it
    needs. An instance is made once for a vehicle, with its geometry.
    """

    kind: ClassVar[str]
    sample: ClassVar[type]
    states: ClassVar[tuple[ErrorState, ...]]

    @classmethod
    def of(cls, rig: SensorRig, settings: FilterSettings) -> Self | None:
        """Return the measurement for a vehicle; None where the vehicle does not have what it takes."""
        ...

    def instant(self, sample: Any) -> int | None:
        """Return the utime at which a sample measured this; None where it says nothing of it."""
        ...

    def compare(self, scene: Scene, sample: Any) -> Compared | str:
        """Return the comparison, or in one word why there is none. A word that is empty is not counted."""
        ...


M = TypeVar("M", bound=type[Measurement])

REGISTRY: dict[str, type[Measurement]] = {}
"""Every kind of measurement that a new filter uses, by its name; those of one sample are fused in this order."""


def register(kind: M) -> M:
    """Add a kind of measurement to those that every new filter uses; for use as a decorator."""
    REGISTRY[kind.kind] = kind
    return kind


def azimuth(u: Vector3, size: int) -> tuple[float, Array]:
    """Return the azimuth of a vector along N's axes, radians from x, and its Jacobian (1, n) for attitude errors.

    With du = theta x u: d(azimuth) = (u_x du_y - u_y du_x) / (u_x^2 + u_y^2).
    """
    x, y, z = u
    square = x * x + y * y
    H = np.zeros((1, size))
    H[0, 6:9] = (-z * x / square, -z * y / square, 1.0)
    return math.atan2(y, x), H


def wrapped(angle: float) -> float:
    """Return an angle within -pi to pi."""
    return math.remainder(angle, math.tau)
