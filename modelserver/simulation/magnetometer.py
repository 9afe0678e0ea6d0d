"""A magnetometer: the field of the earth and of iron, carried along and driven past."""

from __future__ import annotations

from dataclasses import dataclass

from modelserver.simulation.noise import NoiseSource
from modelserver.spatial import so3
from modelserver.spatial.so3 import Quaternion, Vector3

Rows = tuple[Vector3, Vector3, Vector3]

FIELD: Vector3 = (0.0, 18e-6, -50e-6)
"""Along east, north, up, tesla: about what it is in the middle north, its declination left out."""

_UNIT: Rows = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@dataclass(frozen=True, slots=True)
class MagnetometerModel:
    """How good the magnetometer is. Tesla.

    field: the earth's, along east, north, up. hard_iron: what the vehicle adds, along the sensor's axes. soft_iron:
    rows of the matrix (3, 3), along the sensor's axes, by which the vehicle bends the field outside it.
    noise: standard deviation of each axis in each sample. disturbances: seconds since the start, from and to, and
    the field along east, north, up that iron at the roadside adds then.
    """

    field: Vector3 = FIELD
    hard_iron: Vector3 = (0.0, 0.0, 0.0)
    soft_iron: Rows = _UNIT
    noise: float = 0.0
    disturbances: tuple[tuple[float, float, Vector3], ...] = ()


class SimulatedMagnetometer:
    """A magnetometer at work."""

    __slots__ = ("_model", "_noise")

    def __init__(self, model: MagnetometerModel, noise: NoiseSource):
        """Take the model and a source of noise of its own."""
        self._model = model
        self._noise = noise.draw_ahead()

    def outside(self, t: float) -> Vector3:
        """Return the field around the vehicle along east, north, up at `t` seconds."""
        e, n, u = self._model.field
        for begin, end, (de, dn, du) in self._model.disturbances:
            if begin <= t < end:
                e, n, u = e + de, n + dn, u + du
        return (e, n, u)

    def seen(self, t: float, q_SE: Quaternion) -> Vector3:
        """Return the sample along the sensor's axes; `q_SE` turns east, north, up to them."""
        x, y, z = so3.rotate(q_SE, self.outside(t))
        a, b, c = self._model.soft_iron
        hx, hy, hz = self._model.hard_iron
        nx, ny, nz = self._noise.vector(self._model.noise)
        return (
            a[0] * x + a[1] * y + a[2] * z + hx + nx,
            b[0] * x + b[1] * y + b[2] * z + hy + ny,
            c[0] * x + c[1] * y + c[2] * z + hz + nz,
        )
