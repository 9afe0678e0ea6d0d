"""Transformation: a pose with its two frames, time, validity and covariance; transport of pose covariances.

A covariance is ordered x, y, z, about x, about y, about z; the perturbation is `X = (p + dp, exp(dtheta) R)` with dp
and dtheta along the fixed axes of the frame of reference. For a chain A-B-C, to first order,
`J_AB = [[I, -[R_AB p_BC]x], [0, I]]` and `J_BC = diag(R_AB, R_AB)`: from p_AC = p_AB + R_AB p_BC follows
dp_AC = dp_AB + dtheta_AB x (R_AB p_BC) + R_AB dp_BC.

Large-angle lever-arm covariance: the error of an uncertain rotation, also where the angle is large. A lever arm r that
is rotated by an error theta ends `d = (exp(theta) - 1) r` from its nominal end. To first order that is `theta x r`, on
the tangent. At tens of degrees the end lies on an arc, off the tangent by

    b = theta x (theta x r) / 2       along the lever arm, even in theta
    c = -|theta|^2 (theta x r) / 6    across it, odd in theta

Theta is normal with covariance S, of trace t. By Isserlis' theorem

    4 E[b b'] = S (r' S r) + 2 S r r' S - (t S + 2 S^2) r r' - r r' (t S + 2 S^2) + (t^2 + 2 tr S^2) r r'
    E[c theta'] = [r]x (t S + 2 S^2) / 6
    36 E[c c'] = [r]x ((t^2 + 2 tr S^2) S + 4 t S^2 + 8 S^3) [r]x'

b is uncorrelated with theta. The part of c that is correlated shortens the lever arm, `(M theta) x r`; the remainder,
of covariance `[r]x (2 tr(S^2) S + 4 S^3) [r]x' / 36`, is an independent error, as b is.

Limits: for a rotation about one axis the moments of sine and cosine are known at any angle, and each of the three terms
is scaled by a function of t that makes it exact. For rotations about all axes they hold to the fourth order: at 30
degrees about each, the variance along the lever arm is 30 % too small. A leveled vehicle has only a large yaw error.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np

from modelserver.errors import FrameMismatchError
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Array

_IDENTITY = np.eye(6)


def compose_covariance(X_AB: Pose, cov_AB: Array, X_BC: Pose, cov_BC: Array) -> Array:
    """Return the covariance (6, 6) of `X_AB @ X_BC`, for independent errors."""
    R = np.array(so3.matrix_rows(X_AB.wxyz))
    J = np.eye(6)
    J[:3, 3:] = -so3.skew(R @ X_BC.xyz)
    K = np.zeros((6, 6))
    K[:3, :3] = R
    K[3:, 3:] = R
    return _symmetric(J @ cov_AB @ J.T + K @ cov_BC @ K.T)


def invert_covariance(X_AB: Pose, cov_AB: Array) -> Array:
    """Return the covariance (6, 6) of `X_AB.inverse()`, along the axes of B.

    R_BA = R' exp(-dtheta) = exp(-R' dtheta) R', and p_BA = -R' exp(-dtheta) (p + dp), so
    dtheta_BA = -R' dtheta and dp_BA = -R' dp - R' [p]x dtheta.
    """
    Rt = np.array(so3.matrix_rows(X_AB.wxyz)).T
    J = np.zeros((6, 6))
    J[:3, :3] = -Rt
    J[:3, 3:] = -Rt @ so3.skew(X_AB.xyz)
    J[3:, 3:] = -Rt
    return _symmetric(J @ cov_AB @ J.T)


def apply_lever_arm(cov: Array, r: Array) -> Array:
    """Return the covariance (6, 6) at the end of the lever arm `r` (3,), also for large angles (see the module).

    `cov` is that of the pose at the start of the lever arm; both and `r` are along the same axes.
    """
    M, more = large_angle_lever_arm(cov[3:, 3:], r)
    J = _IDENTITY.copy()
    x, y, z = r.tolist()
    # -[r]x
    J[:3, 3:] = np.array(((-0.0, z, -y), (-z, -0.0, x), (y, -x, -0.0))) @ M
    found = J @ cov @ J.T
    found[:3, :3] += more
    return _symmetric(found)


def rotate_covariance(R: Array, cov: Array) -> Array:
    """Return `cov` (6, 6) along axes rotated by the matrix `R` (3, 3)."""
    K = np.zeros((6, 6))
    K[:3, :3] = R
    K[3:, 3:] = R
    return _symmetric(K @ cov @ K.T)


def make_covariance(position: tuple[float, float, float], rotation: tuple[float, float, float]) -> Array:
    """Return the diagonal covariance (6, 6) of standard deviations in meters and radians."""
    return np.diag(np.square(np.array(position + rotation, dtype=float)))


def find_covariance_problem(cov: Array) -> str:
    """Return why a matrix (6, 6) is no covariance, "" if it is one.

    The tolerance covers rounding on the wire: matrices are symmetric and positive semidefinite to 1e-9 of their
    variances.
    """
    if not np.isfinite(cov).all():
        return "it has numbers that are not finite"
    variances = np.diag(cov)
    if float(variances.min()) < 0.0:
        return "a variance in it is negative"
    # meters and radians differ in size: normalize to correlations
    scale = np.sqrt(variances) + 1e-150
    correlation = cov / np.outer(scale, scale)
    if float(np.abs(correlation - correlation.T).max()) > 1e-9:
        return "it is not symmetric"
    if float(np.linalg.eigvalsh(correlation).min()) < -1e-9:
        return "a variance in it is negative along some direction"
    return ""


def _symmetric(cov: Array) -> Array:
    return np.asarray((cov + cov.T) / 2)


def chi_square_survival(value: float, dof: int) -> float:
    """Return the probability that a chi-square variable of `dof` degrees of freedom exceeds `value`.

    In closed form: Abramowitz and Stegun (1964), 26.4.4 for odd `dof`, 26.4.5 for even.
    """
    half = 0.5 * value
    found = math.erfc(math.sqrt(half)) if dof % 2 else 0.0
    exponents = (n + 0.5 * (dof % 2) for n in range(dof // 2))
    return found + math.exp(-half) * math.fsum(half**each / math.gamma(each + 1.0) for each in exponents)


_SERIES_LIMIT: Final = 1e-2
"""Square radians below which the closed forms lose digits and three terms of their series are used."""


class _Symmetric(NamedTuple):
    """The entries of a symmetric matrix; floats, or arrays with an entry for each of many matrices."""

    xx: Any
    xy: Any
    xz: Any
    yy: Any
    yz: Any
    zz: Any


def large_angle_lever_arm(S: Array, r: Array) -> tuple[Array, Array]:
    """Return the matrix M (3, 3) and the covariance (3, 3) to be added to that of the position.

    `S` (3, 3) is the covariance of the rotation and `r` (3,) the lever arm, along the same axes. The error of the end
    is `(M theta) x r`, plus an independent error of the second covariance.
    """
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = S.tolist()
    t = xx + yy + zz
    scales = _series(t) if t < _SERIES_LIMIT else _exact(t, math.exp, math.expm1)
    M, more = _evaluate(_Symmetric(xx, xy, xz, yy, yz, zz), r.tolist(), scales)
    return np.array(_rows(M)), np.array(_rows(more))


def large_angle_lever_arm_batch(S: Array, r: Array) -> tuple[Array, Array]:
    """Return `large_angle_lever_arm` for rotations (n, 3, 3) or (1, 3, 3) and lever arms (n, 3): (n, 3, 3) each."""
    xx, xy, xz = S[:, 0, 0], S[:, 0, 1], S[:, 0, 2]
    yy, yz, zz = S[:, 1, 1], S[:, 1, 2], S[:, 2, 2]
    found = _evaluate(_Symmetric(xx, xy, xz, yy, yz, zz), r.T, _scales_batch(xx + yy + zz))
    M, more = (np.empty((len(r), 3, 3)) for _ in range(2))
    for matrix, entries in zip((M, more), found, strict=True):
        for row, values in enumerate(_rows(entries)):
            for column, value in enumerate(values):
                matrix[:, row, column] = value
    return M, more


def _rows(m: _Symmetric) -> tuple[tuple[Any, Any, Any], ...]:
    return ((m.xx, m.xy, m.xz), (m.xy, m.yy, m.yz), (m.xz, m.yz, m.zz))


def _evaluate(S: _Symmetric, r: Any, scales: Any) -> tuple[_Symmetric, _Symmetric]:
    """Return M and the added covariance, entry by entry: the same code serves floats and arrays."""
    xx, xy, xz, yy, yz, zz = S
    x, y, z = r
    shorter, along, across = scales
    t = xx + yy + zz
    # S^2
    sxx, sxy, sxz = xx * xx + xy * xy + xz * xz, xx * xy + xy * yy + xz * yz, xx * xz + xy * yz + xz * zz
    syy, syz, szz = xy * xy + yy * yy + yz * yz, xy * xz + yy * yz + yz * zz, xz * xz + yz * yz + zz * zz
    whole = sxx + syy + szz
    # S r and S S r
    a, b, c = xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z
    d, e, f = sxx * x + sxy * y + sxz * z, sxy * x + syy * y + syz * z, sxz * x + syz * y + szz * z
    q = x * a + y * b + z * c
    size = 0.5 * t * t + whole
    h, i, j = size * x - t * a - 2.0 * d, size * y - t * b - 2.0 * e, size * z - t * c - 2.0 * f
    # E[c c'] without the part correlated with theta: [r]x Q [r]x', Q = 2 tr(S^2) S + 4 S^3
    w = 2.0 * whole
    Qxx = w * xx + 4.0 * (sxx * xx + sxy * xy + sxz * xz)
    Qxy = w * xy + 4.0 * (sxx * xy + sxy * yy + sxz * yz)
    Qxz = w * xz + 4.0 * (sxx * xz + sxy * yz + sxz * zz)
    Qyy = w * yy + 4.0 * (sxy * xy + syy * yy + syz * yz)
    Qyz = w * yz + 4.0 * (sxy * xz + syy * yz + syz * zz)
    Qzz = w * zz + 4.0 * (sxz * xz + syz * yz + szz * zz)
    across = across / 36.0
    along = 0.25 * along
    more = _Symmetric(
        along * (xx * q + 2.0 * (a * a + h * x)) + across * (y * y * Qzz - 2.0 * y * z * Qyz + z * z * Qyy),
        along * (xy * q + 2.0 * a * b + h * y + i * x) + across * (z * (x * Qyz + y * Qxz - z * Qxy) - x * y * Qzz),
        along * (xz * q + 2.0 * a * c + h * z + j * x) + across * (y * (x * Qyz + z * Qxy - y * Qxz) - x * z * Qyy),
        along * (yy * q + 2.0 * (b * b + i * y)) + across * (z * z * Qxx - 2.0 * x * z * Qxz + x * x * Qzz),
        along * (yz * q + 2.0 * b * c + i * z + j * y) + across * (x * (y * Qxz + z * Qxy - x * Qyz) - y * z * Qxx),
        along * (zz * q + 2.0 * (c * c + j * z)) + across * (x * x * Qyy - 2.0 * x * y * Qxy + y * y * Qxx),
    )
    g = shorter / 6.0
    rest, s = 1.0 - g * t, -2.0 * g
    return _Symmetric(rest + s * xx, s * xy, s * xz, rest + s * yy, s * yz, rest + s * zz), more


def _scales_batch(t: Array) -> tuple[Any, ...]:
    small = t < _SERIES_LIMIT
    large = np.where(small, 1.0, t)
    pairs = zip(_series(t), _exact(large, np.exp, np.expm1), strict=True)
    return tuple([np.where(small, series, exact) for series, exact in pairs])


def _exact(t: Any, exp: Callable[[Any], Any], expm1: Callable[[Any], Any]) -> tuple[Any, Any, Any]:
    """Return the scale factors of the lever arm's shortening and of the moments of b and c.

    For theta about one axis, of variance t: `E[theta sin theta] = t exp(-t/2)`,
    `E[(1 - cos theta)^2] = 3/2 - 2 exp(-t/2) + exp(-2t)/2` and `E[sin^2 theta] = (1 - exp(-2t))/2`.
    """
    return (
        -2.0 * expm1(-0.5 * t) / t,
        (1.5 - 2.0 * exp(-0.5 * t) + 0.5 * exp(-2.0 * t)) / (0.75 * t * t),
        (-0.5 * expm1(-2.0 * t) - t * exp(-t)) * 6.0 / (t * t * t),
    )


def _series(t: Any) -> tuple[Any, Any, Any]:
    """Return the first three terms of the series of `_exact`; each is 1 at 0."""
    return 1.0 - t / 4.0 + t * t / 24.0, 1.0 - t * (5.0 / 6.0) + t * t * (7.0 / 16.0), 1.0 - t + t * t * 0.55


# --- the transformation -----------------------------------------------------------------------------------------------

Numbers: TypeAlias = tuple[float, ...]


def _freeze_covariance(covariance: Array) -> Array:
    """Return a read-only copy (6, 6), which the caller's later changes do not reach."""
    copy = np.array(covariance, dtype=float)
    if copy.shape != (6, 6):
        raise ValueError(f"a covariance has shape (6, 6), got {copy.shape}")
    copy.flags.writeable = False
    return copy


class Transformation:
    """The pose of `frame_of_interest` in `frame_of_reference`: `X_RI` for interest I and reference R.

    Immutable; arrays returned are read-only.

    Parameters
    ----------
    frame_of_interest, frame_of_reference : names, `Body:Frame`
    pose : X_RI
    covariance : (6, 6) along the axes of the frame of reference, None where it is unknown, or a function that returns
        it, or its 36 numbers, at first access
    utime : microseconds since the Unix epoch, 0 for a relation that does not change with time
    invalid_reasons : bits of `modelserver.messages.Invalid`, 0 where it is valid
    pose_epoch, origin_id : 0 where no world frame is involved
    model_revision : revision of the geometry model
    """

    __slots__ = (
        "_covariance",
        "frame_of_interest",
        "frame_of_reference",
        "invalid_reasons",
        "model_revision",
        "origin_id",
        "pose",
        "pose_epoch",
        "utime",
    )

    frame_of_interest: str
    frame_of_reference: str
    pose: Pose
    utime: int
    invalid_reasons: int
    pose_epoch: int
    origin_id: int
    model_revision: str
    _covariance: Array | Numbers | Callable[[], Array | Numbers | None] | None

    def __init__(
        self,
        frame_of_interest: str,
        frame_of_reference: str,
        pose: Pose,
        covariance: Array | Callable[[], Array | Numbers | None] | None = None,
        utime: int = 0,
        invalid_reasons: int = 0,
        pose_epoch: int = 0,
        origin_id: int = 0,
        model_revision: str = "",
    ):
        if covariance is not None and not callable(covariance):
            covariance = _freeze_covariance(covariance)
        _put_interest(self, frame_of_interest)
        _put_reference(self, frame_of_reference)
        _put_pose(self, pose)
        _put_covariance(self, covariance)
        _put_utime(self, utime)
        _put_invalid(self, invalid_reasons)
        _put_epoch(self, pose_epoch)
        _put_origin(self, origin_id)
        _put_revision(self, model_revision)

    @property
    def covariance(self) -> Array | None:
        """The covariance (6, 6): x, y, z, about x, about y, about z, along the axes of the reference."""
        found = self._covariance
        if found is None or isinstance(found, np.ndarray):
            return found
        if callable(found):
            found = found()
        if isinstance(found, tuple):
            found = np.array(found).reshape(6, 6)
            found.flags.writeable = False
        elif found is not None:
            found = _freeze_covariance(found)
        _put_covariance(self, found)
        return found

    @property
    def covariance_numbers(self) -> Numbers | None:
        """The 36 numbers of `covariance`, row by row, as plain floats, without making an array where possible."""
        found = self._covariance
        if callable(found):
            found = found()
            if isinstance(found, np.ndarray):
                found = tuple(found.ravel().tolist())
            _put_covariance(self, found)
        return tuple(found.ravel().tolist()) if isinstance(found, np.ndarray) else found

    @property
    def is_valid(self) -> bool:
        """Whether there is no reason against using it."""
        return self.invalid_reasons == 0

    @property
    def matrix(self) -> Array:
        """The homogeneous transform (4, 4)."""
        return self.pose.matrix

    @property
    def position(self) -> Array:
        """The position (3) in meters."""
        return self.pose.position

    @property
    def quaternion(self) -> Array:
        """The unit quaternion (4), scalar first, w >= 0."""
        return self.pose.quaternion

    @property
    def xyzw(self) -> tuple[float, float, float, float]:
        """The unit quaternion x, y, z, w, scalar last, as in scipy and ROS."""
        return self.pose.xyzw

    def to_scipy(self) -> Any:
        """Return the rotation as a scipy.spatial.transform.Rotation. Raises ImportError without scipy."""
        return self.pose.to_scipy()

    @property
    def rotation(self) -> Array:
        """The rotation matrix (3, 3)."""
        return self.pose.rotation

    @property
    def rpy(self) -> Array:
        """Fixed-axis roll, pitch, yaw (3) in radians."""
        return self.pose.rpy

    @property
    def state_vector(self) -> Array:
        """The 7-vector `px py pz qs qx qy qz`."""
        return self.pose.state_vector

    def with_invalid_reasons(self, reasons: int) -> Transformation:
        """Return the same with more reasons against using it."""
        if not reasons & ~self.invalid_reasons:
            return self
        covariance = self.covariance if isinstance(self._covariance, tuple) else self._covariance
        found = Transformation(
            self.frame_of_interest, self.frame_of_reference, self.pose, covariance, *self._validity()
        )
        _put_invalid(found, self.invalid_reasons | reasons)
        return found

    def inverse(self) -> Transformation:
        """Return the pose of the frame of reference in the frame of interest."""

        def covariance() -> Array | None:
            mine = self.covariance
            return None if mine is None else invert_covariance(self.pose, mine)

        return Transformation(
            self.frame_of_reference, self.frame_of_interest, self.pose.inverse(), covariance, *self._validity()
        )

    def __matmul__(self, other: Transformation) -> Transformation:
        """Return `X_AB @ X_BC = X_AC`, with covariances taken as independent.

        Raises FrameMismatchError where the frames in the middle differ, or where the two are of different times, pose
        epochs or origins.
        """
        if not isinstance(other, Transformation):
            return NotImplemented
        if self.frame_of_interest != other.frame_of_reference:
            raise FrameMismatchError(
                f"cannot chain: the left side ends at {self.frame_of_interest} but the right side starts at "
                f"{other.frame_of_reference}. Ask for the right side in {self.frame_of_interest}, or invert one."
            )
        for what, mine, theirs in (
            ("utime", self.utime, other.utime),
            ("pose_epoch", self.pose_epoch, other.pose_epoch),
            ("origin_id", self.origin_id, other.origin_id),
        ):
            if mine and theirs and mine != theirs:
                raise FrameMismatchError(
                    f"cannot chain: the left side has {what} {mine}, the right side {theirs}. Ask for both at one time."
                )

        def covariance() -> Array | None:
            first, second = self.covariance, other.covariance
            if first is None or second is None:
                return None
            return compose_covariance(self.pose, first, other.pose, second)

        return Transformation(
            other.frame_of_interest,
            self.frame_of_reference,
            self.pose @ other.pose,
            covariance,
            self.utime or other.utime,
            self.invalid_reasons | other.invalid_reasons,
            self.pose_epoch or other.pose_epoch,
            self.origin_id or other.origin_id,
            self.model_revision if self.model_revision == other.model_revision else "",
        )

    def _validity(self) -> tuple[int, int, int, int, str]:
        return self.utime, self.invalid_reasons, self.pose_epoch, self.origin_id, self.model_revision

    def _values(self) -> tuple[object, ...]:
        numbers = None if self.covariance is None else self.covariance.tobytes()
        return self.frame_of_interest, self.frame_of_reference, self.pose, numbers, *self._validity()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Transformation) and self._values() == other._values()

    def __hash__(self) -> int:
        return hash((self.frame_of_interest, self.frame_of_reference, self.pose, self.utime))

    def __reduce__(self) -> tuple[type[Transformation], tuple[object, ...]]:
        values = (self.frame_of_interest, self.frame_of_reference, self.pose, self.covariance, *self._validity())
        return Transformation, values

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError("a Transformation is immutable; make a new one")

    def __delattr__(self, name: str) -> None:
        raise AttributeError("a Transformation is immutable; make a new one")

    def __repr__(self) -> str:
        return f"<Transformation {self}>"

    def __str__(self) -> str:
        invalid = "" if self.is_valid else f" (invalid: reasons {self.invalid_reasons:#x})"
        return f"{self.frame_of_interest} in {self.frame_of_reference}: {self.pose}{invalid}"


# Setting a slot by its descriptor bypasses the guard above, at half the cost of object.__setattr__.
(
    _put_covariance, _put_interest, _put_reference, _put_invalid, _put_revision, _put_origin, _put_pose, _put_epoch,
    _put_utime,
) = (Transformation.__dict__[name].__set__ for name in Transformation.__slots__)  # fmt: skip
