"""Pose: a position and an orientation, as one immutable value (report 3.1 and Annex F), and its motion.

Rigid-body kinematics: pose, velocity and acceleration are composed along a chain. All vectors of `RigidMotion` X_FT are
of T's origin relative to F, along the axes of F, as observed in F. Composition and inversion are the kinematics of
rigid bodies (R. Featherstone, "Rigid Body Dynamics Algorithms", 2008, ch. 2).

Rates of a rotation vector and angular velocities are converted in plain floats. With the left Jacobian J_l(v) = 1 + a
[v]x + b [v]x [v]x of SO(3) (Sola 2017, eq. 183), a rotation vector that changes at the rate v' has the angular velocity
J_l(v) v' along the axes of the near frame, J_r(v) v' = J_l(-v) v' along those of the far one. a and b are functions of
v.v, so the derivative of J_l needs only theirs, da and db by v.v / 2. All are taken from series at small angles, where
their quotients lose digits. A rotation vector is singular at a length of 2 pi, as every three numbers of a rotation are
somewhere.
"""

from __future__ import annotations

import math
import reprlib
from collections.abc import Iterable
from typing import Any, NamedTuple, Protocol, Self

import numpy as np
import numpy.typing as npt

from modelserver.transforms import so3
from modelserver.transforms.so3 import Array, Quaternion, Vector3, add, cross, scale


def _freeze(values: object) -> Array:
    array = np.array(values, dtype=float)
    array.flags.writeable = False
    return array


def _floats(values: Iterable[float], expected: str) -> tuple[float, ...]:
    """Return the values as floats. Raises ValueError with what was `expected` where they are no flat row."""
    try:
        # + 0.0 turns a negative zero into zero, so that equal poses have equal bits
        found = tuple([float(value) + 0.0 for value in values])
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{expected}, got {reprlib.repr(values)}") from None
    if isinstance(values, np.ndarray) and values.ndim != 1:
        raise ValueError(f"{expected}, got an array of shape {values.shape}")
    return found


class SupportsAsQuaternion(Protocol):
    """A rotation of scipy.spatial.transform."""

    def as_quat(self) -> Any:
        """Return the quaternion x, y, z, w."""


class Pose:
    """The position and orientation of a frame in another: `X_AB` maps points of B to A by `p_A = R p_B + p`.

    Orientation is stored as a unit quaternion from which every other representation derives, so there is no gimbal
    lock. Immutable and hashable; arrays returned are read-only.

    Create one by `Pose(position, quaternion)`, or by `from_matrix`, `from_rpy`, `from_state_vector`.
    """

    __slots__ = ("_p", "_q")
    __array_ufunc__ = None  # keep numpy out of products: array @ Pose is a TypeError

    _p: Vector3
    _q: Quaternion

    def __init__(
        self,
        position: Iterable[float] = (0.0, 0.0, 0.0),
        quaternion: Iterable[float] = so3.IDENTITY,
    ):
        """Create a pose at a position (3), meters; the quaternion (4), scalar first, is normalized, with w >= 0.

        Raises ValueError for a wrong count, a number that is not finite, or a zero quaternion.
        """
        p = _floats(position, "a position is 3 finite numbers in meters")
        q = _floats(quaternion, "a quaternion is 4 numbers, scalar first")
        if len(p) != 3 or not all(map(math.isfinite, p)):
            raise ValueError(f"a position is 3 finite numbers in meters, got {reprlib.repr(p)}")
        if len(q) != 4:
            raise ValueError(f"a quaternion is 4 numbers, scalar first, got {reprlib.repr(q)}")
        _put_p(self, p)
        _put_q(self, so3.normalize((q[0], q[1], q[2], q[3])))

    @classmethod
    def _of(cls, p: Vector3, q: Quaternion) -> Self:
        """Build from values that are already floats and a quaternion that is already unit, w >= 0."""
        self = object.__new__(cls)
        _put_p(self, p)
        _put_q(self, q)
        return self

    @classmethod
    def of_floats(cls, position: Vector3, quaternion: Quaternion) -> Self:
        """Return `Pose(position, quaternion)` of plain floats, at a third of its cost. Raises what it raises."""
        (x, y, z), (a, b, c, d) = position, quaternion
        if not math.isfinite(x + y + z):
            return cls(position, quaternion)
        return cls._of((x + 0.0, y + 0.0, z + 0.0), so3.normalize((a + 0.0, b + 0.0, c + 0.0, d + 0.0)))

    @classmethod
    def identity(cls) -> Self:
        return cls._of((0.0, 0.0, 0.0), so3.IDENTITY)

    @classmethod
    def from_matrix(cls, matrix: npt.ArrayLike, tolerance: float = 0.05) -> Self:
        """Return the pose of a homogeneous transform, (4, 4) or its upper rows (3, 4), with the nearest rotation.

        Raises ValueError where |R'R - I| exceeds `tolerance`, where the matrix is singular or a reflection, or where
        the last row is not 0 0 0 1.
        """
        m = np.asarray(matrix, dtype=float)
        if m.shape not in ((3, 4), (4, 4)):
            raise ValueError(f"a homogeneous transform is a (4, 4) or (3, 4) matrix, got shape {m.shape}")
        if not np.isfinite(m).all():
            raise ValueError(f"a homogeneous transform has finite numbers only, got {m.tolist()}")
        if m.shape == (4, 4) and not np.allclose(m[3], (0.0, 0.0, 0.0, 1.0), rtol=0, atol=1e-9):
            raise ValueError(f"the last row of a homogeneous transform is 0 0 0 1, got {m[3].tolist()}")
        rotation, deviation = so3.nearest_rotation(m[:3, :3])
        if deviation > tolerance:
            raise ValueError(f"not a rotation: |R'R - I| is {deviation:.3g}, more than {tolerance:g}")
        return cls(m[:3, 3].tolist(), so3.from_matrix(rotation))

    @classmethod
    def from_xyzw(cls, position: Iterable[float], quaternion: Iterable[float]) -> Self:
        """Return the pose of a position and a quaternion x, y, z, w, scalar last, as in scipy and ROS."""
        x, y, z, w = _floats(quaternion, "a quaternion is 4 numbers, here scalar last")
        return cls(position, (w, x, y, z))

    @classmethod
    def from_scipy(cls, position: Iterable[float], rotation: SupportsAsQuaternion) -> Self:
        return cls.from_xyzw(position, rotation.as_quat())

    @classmethod
    def from_rpy(cls, position: Iterable[float], roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0) -> Self:
        """Return the pose at `position` rotated by fixed-axis roll, pitch, yaw in radians (REP-103)."""
        if not (math.isfinite(roll) and math.isfinite(pitch) and math.isfinite(yaw)):
            raise ValueError(f"roll, pitch and yaw must be finite, got {roll}, {pitch}, {yaw}")
        return cls(position, so3.from_rpy(roll, pitch, yaw))

    @classmethod
    def from_state_vector(cls, vector: Iterable[float]) -> Self:
        """Return the pose of a 7-vector `px py pz qs qx qy qz` (report eq. 4)."""
        values = _floats(vector, "a state vector is 7 numbers, px py pz qs qx qy qz")
        if len(values) != 7:
            raise ValueError(f"a state vector is 7 numbers, px py pz qs qx qy qz, got {len(values)}")
        return cls(values[:3], values[3:])

    @property
    def xyz(self) -> Vector3:
        """The position in meters, as plain floats."""
        return self._p

    @property
    def wxyz(self) -> Quaternion:
        """The unit quaternion, scalar first, w >= 0, as plain floats."""
        return self._q

    @property
    def xyzw(self) -> Quaternion:
        """The unit quaternion x, y, z, w, scalar last, as in scipy and ROS."""
        w, x, y, z = self._q
        return (x, y, z, w)

    def to_scipy(self) -> Any:
        """Return the rotation as a scipy.spatial.transform.Rotation. Raises ImportError without scipy."""
        from scipy.spatial.transform import Rotation

        return Rotation.from_quat(self.xyzw)

    @property
    def position(self) -> Array:
        """The position (3) in meters."""
        return _freeze(self._p)

    @property
    def quaternion(self) -> Array:
        """The unit quaternion (4), scalar first, w >= 0."""
        return _freeze(self._q)

    @property
    def rpy(self) -> Array:
        """Fixed-axis roll, pitch, yaw (3) in radians."""
        return _freeze(so3.to_rpy(self._q))

    @property
    def rotation(self) -> Array:
        """The rotation matrix (3, 3)."""
        return _freeze(so3.matrix_rows(self._q))

    @property
    def matrix(self) -> Array:
        """The homogeneous transform (4, 4)."""
        return _freeze(self.matrix_rows())

    def matrix_rows(self) -> tuple[tuple[float, float, float, float], ...]:
        """Return the four rows of the homogeneous transform as plain floats."""
        (a, b, c), (d, e, f), (g, h, i) = so3.matrix_rows(self._q)
        x, y, z = self._p
        return ((a, b, c, x), (d, e, f, y), (g, h, i, z), (0.0, 0.0, 0.0, 1.0))

    @property
    def state_vector(self) -> Array:
        """The 7-vector `px py pz qs qx qy qz` (report eq. 4)."""
        return _freeze(self._p + self._q)

    def inverse(self) -> Pose:
        """Return the pose of the other frame in this one: `[R' -R'p]`."""
        q = so3.conjugate(self._q)
        x, y, z = so3.rotate(q, self._p)
        return Pose._of((-x + 0.0, -y + 0.0, -z + 0.0), so3.normalize(q))

    def __matmul__(self, other: Pose) -> Pose:
        """Return `X_AB @ X_BC = X_AC` (report eq. 5)."""
        if not isinstance(other, Pose):
            return NotImplemented
        x, y, z = so3.rotate(self._q, other._p)
        px, py, pz = self._p
        return Pose._of((px + x, py + y, pz + z), so3.normalize(so3.multiply(self._q, other._q)))

    def transform(self, points: npt.ArrayLike) -> Array:
        """Return the points, (3) or (n, 3) in B, in A: `p_A = X_AB p_B`."""
        p = np.asarray(points, dtype=float)
        if p.shape[-1:] != (3,) or p.ndim > 2:
            raise ValueError(f"points have shape (3,) or (n, 3), got {p.shape}")
        return np.asarray(p @ np.array(so3.matrix_rows(self._q)).T + self._p)

    def interpolate(self, other: Pose, fraction: float) -> Pose:
        """Return the pose at `fraction` between this and `other`: position linear, rotation by slerp."""
        p = so3.to_vector3(a + (b - a) * fraction for a, b in zip(self._p, other._p, strict=True))
        return Pose._of(p, so3.slerp(self._q, other._q, fraction))

    def distance(self, other: Pose) -> tuple[float, float]:
        """Return the distance to `other`: meters, and radians."""
        angle = so3.logarithm(so3.normalize(so3.multiply(so3.conjugate(self._q), other._q)))
        return math.dist(self._p, other._p), math.hypot(*angle)

    def is_close(self, other: Pose, meters: float = 1e-9, radians: float = 1e-9) -> bool:
        """Return whether `other` is the same pose within the tolerances."""
        moved, turned = self.distance(other)
        return moved <= meters and turned <= radians

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Pose) and self._p == other._p and self._q == other._q

    def __hash__(self) -> int:
        return hash((self._p, self._q))

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError("a Pose is immutable; make a new one")

    def __delattr__(self, name: str) -> None:
        raise AttributeError("a Pose is immutable; make a new one")

    def __reduce__(self) -> tuple[type[Pose], tuple[Vector3, Quaternion]]:
        return (Pose, (self._p, self._q))

    def __repr__(self) -> str:
        return f"Pose(position={list(self._p)}, quaternion={list(self._q)})"

    def __str__(self) -> str:
        x, y, z = self._p
        roll, pitch, yaw = (math.degrees(angle) for angle in so3.to_rpy(self._q))
        return f"position ({x:.3f}, {y:.3f}, {z:.3f}) m, roll {roll:.2f} pitch {pitch:.2f} yaw {yaw:.2f} deg"


# Setting a slot by its descriptor bypasses the guard above, at half the cost of object.__setattr__.
_put_p = Pose.__dict__["_p"].__set__
_put_q = Pose.__dict__["_q"].__set__


ZERO: Vector3 = (0.0, 0.0, 0.0)
UNKNOWN: Vector3 = (math.nan, math.nan, math.nan)


class RigidMotion(NamedTuple):
    """The pose of T in F and its derivatives: m/s, rad/s, m/s2, rad/s2; nan where unknown."""

    pose: Pose
    velocity: Vector3 = ZERO
    angular_velocity: Vector3 = ZERO
    acceleration: Vector3 = ZERO
    angular_acceleration: Vector3 = ZERO

    def compose(self, other: RigidMotion) -> RigidMotion:
        """Return X_FT @ X_TU with its motion."""
        q = self.pose.wxyz
        r = so3.rotate(q, other.pose.xyz)
        v, w = so3.rotate(q, other.velocity), so3.rotate(q, other.angular_velocity)
        a, t = so3.rotate(q, other.acceleration), so3.rotate(q, other.angular_acceleration)
        omega = self.angular_velocity
        tangential = cross(omega, r)
        return RigidMotion(
            self.pose @ other.pose,
            add(self.velocity, tangential, v),
            add(omega, w),
            add(
                self.acceleration,
                cross(self.angular_acceleration, r),
                cross(omega, tangential),
                scale(2.0, cross(omega, v)),
                a,
            ),
            add(self.angular_acceleration, t, cross(omega, w)),
        )

    def inverse(self) -> RigidMotion:
        """Return X_TF with its motion: the motion of F as observed in T.

        p_TF = -R' p and d(R')/dt = -R' [w]x. With u = -v + w x p the velocity is R' u, the acceleration R' (du/dt - w x
        u).
        """
        q = so3.conjugate(self.pose.wxyz)
        p, w = self.pose.xyz, self.angular_velocity
        u = add(scale(-1.0, self.velocity), cross(w, p))
        du = add(scale(-1.0, self.acceleration), cross(self.angular_acceleration, p), cross(w, self.velocity))
        return RigidMotion(
            self.pose.inverse(),
            so3.rotate(q, u),
            so3.rotate(q, scale(-1.0, w)),
            so3.rotate(q, add(du, scale(-1.0, cross(w, u)))),
            so3.rotate(q, scale(-1.0, self.angular_acceleration)),
        )


SMALL_ANGLE = 0.1
"""Radians below which the functions of the angle are taken from their series: the quotients lose digits there."""


def compute_turn_motion(
    v: Vector3, rate: Vector3, change: Vector3 = (0.0, 0.0, 0.0), sign: float = 1.0
) -> tuple[Vector3, Vector3]:
    """Return angular velocity J_l v' and acceleration of a rotation vector, with v' and v''. `sign` -1: of J_r.

    The acceleration is J_l v'' + (v.v') (da v x v' + db v x (v x v')) + b v' x (v x v').
    """
    x, y, z = v
    dx, dy, dz = rate
    ddx, ddy, ddz = change
    square = x * x + y * y + z * z
    along = x * dx + y * dy + z * dz
    a, b, da, db = _get_coefficients(square)
    # sums of multiples: of crosses, of v, of v' and v''
    c, n = sign * a, 1.0 - b * square
    m = b * along
    cx, cy, cz = y * dz - z * dy, z * dx - x * dz, x * dy - y * dx
    k = sign * along * da
    dm = along * along * db + b * (dx * dx + dy * dy + dz * dz + x * ddx + y * ddy + z * ddz)
    dn = -along * (square * db + b)
    return (
        (c * cx + m * x + n * dx, c * cy + m * y + n * dy, c * cz + m * z + n * dz),
        (
            k * cx + c * (y * ddz - z * ddy) + dm * x + dn * dx + n * ddx,
            k * cy + c * (z * ddx - x * ddz) + dm * y + dn * dy + n * ddy,
            k * cz + c * (x * ddy - y * ddx) + dm * z + dn * dz + n * ddz,
        ),
    )


def compute_turn_rate(v: Vector3, velocity: Vector3, sign: float = 1.0) -> Vector3:
    """Return the rate at which a rotation vector changes with an angular velocity: the inverse of J_l, times that.

    It is 1 - [v]x / 2 + c [v]x [v]x, c = (1 - h cot h) / v.v with half the angle h. With `sign` -1 it is that of J_r.
    """
    x, y, z = v
    dx, dy, dz = velocity
    square = x * x + y * y + z * z
    if square < SMALL_ANGLE * SMALL_ANGLE:
        c = 1.0 / 12.0 + square * (1.0 / 720.0 + square * (1.0 / 30240.0 + square / 1209600.0))
    elif square < math.inf:
        half = 0.5 * math.sqrt(square)
        c = (1.0 - half / math.tan(half)) / square
    else:
        c = math.nan
    m = c * (x * dx + y * dy + z * dz)
    n = 1.0 - c * square
    k = -0.5 * sign
    return (
        k * (y * dz - z * dy) + m * x + n * dx,
        k * (z * dx - x * dz) + m * y + n * dy,
        k * (x * dy - y * dx) + m * z + n * dz,
    )


def _get_coefficients(square: float) -> tuple[float, float, float, float]:
    """Return a, b, da and db of the squared angle."""
    if square < SMALL_ANGLE * SMALL_ANGLE:
        return (
            1.0 / 2.0 - square * (1.0 / 24.0 - square * (1.0 / 720.0 - square / 40320.0)),
            1.0 / 6.0 - square * (1.0 / 120.0 - square * (1.0 / 5040.0 - square / 362880.0)),
            -1.0 / 12.0 + square * (1.0 / 180.0 - square * (1.0 / 6720.0 - square / 453600.0)),
            -1.0 / 60.0 + square * (1.0 / 1260.0 - square * (1.0 / 60480.0 - square / 4989600.0)),
        )
    if not square < math.inf:
        return (math.nan,) * 4
    angle = math.sqrt(square)
    sine, versine = math.sin(angle), 2.0 * math.sin(angle / 2.0) ** 2
    return (
        versine / square,
        (angle - sine) / (square * angle),
        (angle * sine - 2.0 * versine) / (square * square),
        (angle * versine - 3.0 * (angle - sine)) / (square * square * angle),
    )
