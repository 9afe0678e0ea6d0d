"""Dynamics of a model: mass matrix, bias vector, forward dynamics (report 3.2, eq. 7 to 10).

With generalized coordinates q, the mass matrix D, joint forces tau, and forces f_e of the vehicle on its surroundings:

    D(q) q'' + C(q, q') q' + G(q) + J' f_e = tau      (7)
    D(q) q'' = tau - b                                (8)
    b = C(q, q') q' + G(q) + J' f_e                   (9)   by recursive Newton-Euler with q'' = 0
    q'' = D(q)^-1 (tau - b)                           (10)

The coordinates are those of the geometry's joints, in the order of the file and with their names; mimic joints have
none of their own. A floating base adds six before them, as of a joint of type `floating` from the world to the root
frame: position x y z, then rotation vector rx ry rz, in a world whose z axis points up. tau of a rotation vector is
the force that does work on it: with the map S below, S^T times the torque along the axes of the far frame.

Pinocchio computes in its own velocities w = S(q) q'. A joint is there a row of prismatic, revolute and spherical ones
without mass between them, so that S = T(q) C. Each row of the constant C has one coordinate: C is a permutation, with
signs where a rotation vector is passed backward, and further rows, with multipliers, for mimic joints. T is the
identity but for a block J_r(v) on the rows of each rotation vector v (`compute_turn_motion`). The equations above
follow by the principle of virtual work, with dS the derivative of S by time and ^T the transpose:

    D = S^T D_w S,   tau = S^T RNEA(q, S q', S q'' + dS q'),   S q'' = ABA(q, S q', S^-T tau) - dS q'

Forward dynamics uses ABA where C has an inverse, its transpose; else (mimic joints) it solves (8) with D, which is
positive definite unless a coordinate moves no mass. Algorithms: Featherstone (2008), ch. 5 to 7 (RNEA, CRBA, ABA);
centroidal momentum: Orin, Goswami, Lee (2013).

A call of Pinocchio takes 1 to 8 us, as long as a few of numpy. So S is never formed: a permutation is an index, and the
blocks are multiplied in place.

Limits: rigid bodies, no friction, damping or springs (they enter as tau); a rotation vector is singular at 2 pi; loops
as in `tree`. Numbers that are not finite give results that are not.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Iterable, Mapping
from typing import Any, Final, Literal, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from modelserver.dynamics.tree import (
    GROUND,
    MassUncertainty,
    Tree,
    TreeJoint,
    TreeLink,
    build_tree,
    iterate_center_covariance,
)
from modelserver.errors import LimitError, MalformedRequestError, ModelServerError, find_nearest_names, quote
from modelserver.extras import make_install_command
from modelserver.geometry.joint import JointType
from modelserver.geometry.model import Model
from modelserver.geometry.names import format_names
from modelserver.geometry.parts import RigidInertia, to_rows
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose, compute_turn_motion, compute_turn_rate
from modelserver.transforms.so3 import Array

STANDARD_GRAVITY: Final = 9.80665
"""m/s2."""

MAX_VELOCITIES: Final = 200
"""Velocities of all joints and the base: Pinocchio's work space grows with the third power, 0.5 GB for so many."""

Values: TypeAlias = npt.ArrayLike | Mapping[str, float]
"""A number for each coordinate: an array (n,), or by name; coordinates that are not named have their default, 0."""

Forces: TypeAlias = Mapping[str, npt.ArrayLike]
"""By the name of a frame the force and moment (6,) of the vehicle on its surroundings at the frame's origin, along the
axes of the world: N, N m."""

_FLOAT: Final = np.dtype(float)

_Turn: TypeAlias = tuple[slice, Array, so3.Vector3]
"""The rows of a rotation vector in Pinocchio's velocity, its block J_r (3, 3) of the map S, and the vector."""


class CenterOfMass(NamedTuple):
    """Mass, kg, and center of mass in a frame, m, its velocity, m/s, and covariance (3, 3), m2; None: not known."""

    mass: float
    position: Array
    velocity: Array | None = None
    covariance: Array | None = None


class Dynamics:
    """The dynamics of the bodies that are joined to a root frame; see the module for the equations.

    Parameters
    ----------
    model
        The geometry, with inertias in its bodies.
    base
        `floating`: the root frame moves freely in the world; `fixed`: it is the world.
    root
        The frame, `Body:Frame`; by default the first one of the model's root body.
    gravity
        Gravitational acceleration along -z of the world, m/s2.
    allow_massless
        Whether bodies without inertia count as massless. Otherwise they are an error.
    cut_loops
        Whether constraints that close a loop are left out (`cut`). Otherwise they are an error.
    masses
        Other masses by body, kg; its inertia changes in proportion.
    payload
        Point masses by frame, kg.
    uncertainty
        That of the bodies' masses and centers of mass, for the covariance of the center of mass.

    Raises
    ------
    MalformedRequestError
        A body without mass, a loop, or arguments as above that cannot be.
    UnknownBodyError, UnknownFrameError
        With the nearest names.
    LimitError
        More than `MAX_VELOCITIES`.
    ModelServerError
        The extra `dynamics` is not installed.

    One object serves one thread at a time: Pinocchio's work space is in it, and the configuration of the last state.
    """

    def __init__(
        self,
        model: Model,
        base: Literal["floating", "fixed"] = "floating",
        root: str = "",
        *,
        gravity: float = STANDARD_GRAVITY,
        allow_massless: bool = False,
        cut_loops: bool = False,
        masses: Mapping[str, float] | None = None,
        payload: Mapping[str, float] | None = None,
        uncertainty: MassUncertainty = MassUncertainty(),  # noqa: B008 - immutable
    ):
        if base not in ("floating", "fixed"):
            raise MalformedRequestError(f"the base is {quote(str(base))}; it is 'floating' or 'fixed'")
        if not math.isfinite(gravity):
            raise MalformedRequestError(f"gravity is {gravity}; it is a finite number of m/s2, e.g. {STANDARD_GRAVITY}")
        tree = build_tree(model, root, base == "floating", cut_loops)
        tree = _with_masses(model, tree, masses or {}, payload or {})
        if tree.massless and not allow_massless:
            raise MalformedRequestError(
                f"no mass is stated for {format_names(tree.massless)}; state the inertia in the geometry file, or "
                "count such bodies as massless (allow_massless)"
            )
        count = sum(each.joint.count for each in tree.joints)
        if count > MAX_VELOCITIES:
            raise LimitError(
                f"the joints around {tree.root} have {count} velocities; dynamics takes {MAX_VELOCITIES} at most"
            )
        self.model = model
        self.tree = tree
        self.coordinates = tree.coordinates
        """The names of the generalized coordinates, in the order of all arrays."""
        self.cut = tree.cut
        """The constraints that are left out because they close loops."""
        self.massless = tree.massless
        self.uncertainty = uncertainty
        self.gravitational_acceleration = gravity
        self.mass = math.fsum(link.inertia.mass for link in self.tree.links.values() if link.inertia is not None)
        # Pinocchio's number of the last joint of each in the tree
        self._pin, self._model, self._last, C, offset, vectors = _build_pinocchio(tree, gravity)
        self._data = self._model.createData()
        # what stands on a fixed base: Pinocchio leaves it out of its sums
        fixed = [each for each in self.tree.links.values() if each.joint == GROUND and each.inertia is not None]
        self._ground = _combine(*(_transform(each.X_FB, each.inertia) for each in fixed if each.inertia is not None))
        self._moving_mass = math.fsum(each.mass for each in self._model.inertias.tolist()[1:])
        self._ground_share = np.array(self._ground.center) * (self._ground.mass / (self.mass or 1.0))
        self._columns = {name: number for number, name in enumerate(tree.coordinates)}
        self._default = np.array(tree.defaults)
        self._shape = self._default.shape
        self._configured: tuple[bytes, Array, list[_Turn]] = (b"none", self._default, [])
        nv = self._model.nv
        self._C, self._offset = C, offset if offset.any() else None
        self._is_invertible = np.array_equal(C @ C.T, np.eye(nv))
        self._is_permutation = self._is_invertible and bool((C >= 0.0).all())
        # the coordinate of each row of Pinocchio's, and the row of each coordinate
        self._order, self._rows = np.nonzero(C)[1], np.nonzero(C.T)[1]
        rows = self._rows if self._is_permutation else np.arange(nv)
        # the entries of D in the upper triangle of D_w: so D is symmetric to the last bit
        self._entries = np.minimum.outer(rows, rows) * nv + np.maximum.outer(rows, rows)
        # a quaternion has one number more than a rotation vector
        self._numbers = np.insert(np.arange(nv), [row + 3 for row in vectors], 0)
        self._vectors = [(slice(row, row + 3), slice(row + n, row + n + 4)) for n, row in enumerate(vectors)]
        # their rows and columns in the upper triangle
        self._blocks = [((rows, slice(rows.start, nv)), (slice(rows.stop), rows)) for rows, _ in self._vectors]
        self._zeros = np.zeros(nv)

    @property
    def default_position(self) -> Array:
        """The default positions of the joints (n,); 0 for a floating base."""
        return self._default.copy()

    @property
    def stated_sigmas(self) -> dict[str, float]:
        """Standard deviations of the coordinates of the joints that the geometry states; nan where it does not.

        A joint without one makes the covariance of what it moves unknown.
        """
        moving = {joint.name for joint in self.tree.joints}
        return {
            name: sigma
            for each in self.model.joints.values()
            if each.joint.mimic is None and each.name in moving
            for name, sigma in zip(
                self.model.drives[each.name].names, each.joint.sigma or (math.nan,) * each.joint.count, strict=True
            )
        }

    def by_name(self, values: npt.ArrayLike) -> dict[str, float]:
        """Return numbers (n,), one for each coordinate, by name."""
        return dict(zip(self.coordinates, np.asarray(values, dtype=float).tolist(), strict=True))

    def mass_matrix(self, q: Values) -> Array:
        """Return the mass matrix D(q) (n, n), symmetric (eq. 7)."""
        _, q_pin, turns = self._configure(q)
        D = self._pin.crba(self._model, self._data, q_pin)
        # S^T D S, in the upper triangle
        for (right, above), (_, J, _) in zip(self._blocks, turns, strict=True):
            D[right] = J.T.dot(D[right])
            D[above] = D[above].dot(J)
        found: Array = D.take(self._entries)
        if not self._is_permutation:
            found = self._C.T @ found @ self._C
            found = (found + found.T) / 2.0
        return found

    def bias(self, q: Values, v: Values, forces: Forces | None = None) -> Array:
        """Return the bias vector b(q, q') (n,) with the forces `forces` on the surroundings (eq. 9)."""
        return self._compute_forces(q, v, None, forces)

    def gravity(self, q: Values) -> Array:
        """Return the gravity vector G(q) (n,): the joint forces that hold the vehicle still."""
        _, q_pin, turns = self._configure(q)
        return self._pull_back(self._pin.computeGeneralizedGravity(self._model, self._data, q_pin), turns)

    def inverse(self, q: Values, v: Values, a: Values, forces: Forces | None = None) -> Array:
        """Return the joint forces tau (n,) that cause the accelerations a = q'' (eq. 7)."""
        return self._compute_forces(q, v, self._read(a, "a"), forces)

    def forward(self, q: Values, v: Values, tau: Values, forces: Forces | None = None) -> Array:
        """Return the accelerations q'' (n,) that joint forces cause (eq. 10).

        Raises MalformedRequestError, naming the coordinate, where one moves no mass.
        """
        q, q_pin, turns = self._configure(q)
        v, tau = self._read(v, "v"), self._read(tau, "tau")
        if forces is not None:
            tau = tau - self._project(q, forces)
        if self._is_invertible:
            w, dw = self._move(v, None, turns)
            tau_pin = self._arrange(tau)
            for rows, _, phi in turns:
                tau_pin[rows] = compute_turn_rate(phi, tau_pin[rows].tolist())
            a_pin = self._pin.aba(self._model, self._data, q_pin, w, tau_pin)
            for rows, _, phi in turns:
                a_pin[rows] = compute_turn_rate(phi, (a_pin[rows] - dw[rows]).tolist(), -1.0)
            a = self._pull_back(a_pin, [])
        else:
            D = self.mass_matrix(q)
            try:
                np.linalg.cholesky(D)  # raises where D is not positive definite
                a = np.asarray(np.linalg.solve(D, tau - self.bias(q, v)))
            except np.linalg.LinAlgError:
                a = np.full(len(q), math.nan)
        # plain floats: a sum that overflows is no warning
        if not math.isfinite(sum(a.tolist())) and np.isfinite((q, v, tau)).all() and not np.isfinite(a).all():
            raise self._singular_error(q)
        return a

    def kinetic_energy(self, q: Values, v: Values) -> float:
        """Return the kinetic energy, J."""
        _, q_pin, turns = self._configure(q)
        w, _ = self._move(self._read(v, "v"), None, turns)
        return float(self._pin.computeKineticEnergy(self._model, self._data, q_pin, w))

    def potential_energy(self, q: Values) -> float:
        """Return the potential energy, J; 0 with all mass at the height of the world's origin."""
        moving = float(self._pin.computePotentialEnergy(self._model, self._data, self._configure(q)[1]))
        return moving + self._ground.mass * self.gravitational_acceleration * self._ground.center[2]

    def momentum(self, q: Values, v: Values, a: Values | None = None) -> tuple[Array, Array]:
        """Return linear and angular momentum (6,) about the center of mass along the world's axes, and its rate (6,).

        The rate is nan without accelerations `a`.
        """
        _, q_pin, turns = self._configure(q)
        w, dw = self._move(self._read(v, "v"), None if a is None else self._read(a, "a"), turns)
        if a is None:
            h = self._pin.computeCentroidalMomentum(self._model, self._data, q_pin, w)
            return np.array(h.vector), np.full(6, math.nan)
        self._pin.computeCentroidalMomentumTimeVariation(self._model, self._data, q_pin, w, dw)
        return np.array(self._data.hg.vector), np.array(self._data.dhg.vector)

    def center_of_mass(
        self, q: Values, v: Values | None = None, frame: str = "", sigma: Values | None = None
    ) -> CenterOfMass:
        """Return the center of mass in a frame, by default the world; its velocity is relative to that frame.

        With the `sigma` of each coordinate, its covariance comes from them, the surveys between the bodies and
        `uncertainty`, along the axes of `frame` (default: of the root frame, in it); None where a sigma is missing.
        Raises MalformedRequestError for a model without mass.
        """
        if not self.mass > 0.0:
            raise MalformedRequestError(
                "there is no center of mass: no body has a mass; state one in the geometry file"
            )
        q, q_pin, turns = self._configure(q)
        velocity, share = None, self._moving_mass / self.mass
        c = self._ground_share
        if share:  # else Pinocchio divides by no mass
            c = c + share * self._pin.centerOfMass(self._model, self._data, q_pin)
        if v is not None:
            v, velocity = self._read(v, "v"), np.zeros(3)
            if share:
                self._pin.centerOfMass(self._model, self._data, q_pin, self._move(v, None, turns)[0])
                velocity = share * self._data.vcom[0]
        if frame:
            X = self.frame_pose(q, frame)
            R = X.rotation
            c = c - X.position
            if velocity is not None and v is not None:
                own = self.jacobian(q, frame) @ v
                velocity = R.T @ (velocity - own[:3] - np.cross(own[3:], c))
            c = R.T @ c
        covariance = None if sigma is None else self.center_covariance(q, sigma, frame or self.tree.root)
        return CenterOfMass(self.mass, c, velocity, covariance)

    def center_covariance(self, q: Values, sigma: Values, frame: str, is_frame_exact: bool = False) -> Array | None:
        """Return the covariance (3, 3) of the center of mass in a frame, m2, as `center_of_mass` does.

        With `is_frame_exact` the survey of the frame itself counts as exact.
        """
        work = self.iterate_center_covariance(q, sigma, frame, is_frame_exact)
        while True:
            try:
                next(work)
            except StopIteration as end:
                found: Array | None = end.value
                return found

    def iterate_center_covariance(
        self, q: Values, sigma: Values, frame: str, is_frame_exact: bool = False
    ) -> Generator[None, None, Array | None]:
        """Return in steps what `center_covariance` does: with many bodies it takes milliseconds."""
        q, sigmas = self._read(q, "q"), self.by_name(self._read(sigma, "sigma"))
        positions = {
            each.name: tuple((each.multiplier * q[list(each.columns)] + each.offset).tolist())
            for each in self.tree.joints
        }
        return iterate_center_covariance(
            self.model, self.tree, frame, positions, sigmas, self.uncertainty, is_frame_exact
        )

    def inertia(self, q: Values, frame: str = "") -> Array:
        """Return the inertia of the whole (6, 6) about a frame, as `Body.inertia`; by default about the world's origin.

        Rows and columns are x, y, z, then about x, about y, about z.
        """
        _, q_pin, _ = self._configure(q)
        whole = self._ground
        if self._moving_mass:
            self._pin.ccrba(self._model, self._data, q_pin, np.zeros(self._model.nv))
            center, about = so3.to_vector3(self._data.com[0]), to_rows(self._data.Ig.inertia)
            whole = _combine(RigidInertia(self._moving_mass, center, about), whole)
        return np.array((_transform(self.frame_pose(q, frame).inverse(), whole) if frame else whole).matrix())

    def frame_pose(self, q: Values, frame: str) -> Pose:
        """Return the pose of a frame in the world. Raises UnknownBodyError, UnknownFrameError."""
        (found,) = self.frame_poses(q, (frame,))
        return found

    def frame_poses(self, q: Values, frames: Iterable[str]) -> list[Pose]:
        """Return the poses of frames in the world. Raises as `frame_pose`."""
        located = [self._locate(frame) for frame in frames]
        self._pin.forwardKinematics(self._model, self._data, self._configure(q)[1])
        found = []
        for link, X_FP in located:
            if link.joint != GROUND:
                M = self._data.oMi[self._last[link.joint]]
                X_FP = Pose(M.translation.tolist(), so3.from_matrix(M.rotation)) @ X_FP
            found.append(X_FP)
        return found

    def jacobian(self, q: Values, frame: str) -> Array:
        """Return the Jacobian (6, n) of a frame: J q' is its velocity and angular velocity along the world's axes."""
        link, X_FP = self._locate(frame)
        q, q_pin, turns = self._configure(q)
        if link.joint == GROUND:
            return np.zeros((6, len(q)))
        pin, number = self._pin, self._last[link.joint]
        pin.computeJointJacobians(self._model, self._data, q_pin)
        J = pin.getJointJacobian(self._model, self._data, number, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
        J = np.array(J).reshape(6, self._model.nv)  # one column comes as a vector
        arm = self._data.oMi[number].rotation @ X_FP.position
        J[:3] -= so3.skew(arm) @ J[3:]
        return self._pull_back(J.T, turns).T

    def _locate(self, frame: str) -> tuple[TreeLink, Pose]:
        """Return the link of a frame's body, and the frame's pose in the far frame of the link's joint."""
        found = self.model.frame(frame)
        link = self.tree.links.get(found.body)
        if link is None:
            raise MalformedRequestError(
                f"frame {frame} is not joined to {self.tree.root}; its dynamics is not computed"
            )
        return link, link.X_FB @ found.pose

    def _read(self, values: Values, what: str) -> Array:
        """Return the number of each coordinate (n,). Raises MalformedRequestError."""
        if type(values) is np.ndarray and values.dtype is _FLOAT and values.shape == self._shape:
            return values
        if isinstance(values, Mapping):
            found = self._default.copy() if what == "q" else np.zeros(len(self._default))
            for name, value in values.items():
                if name not in self._columns:
                    near = find_nearest_names(name, self._columns)
                    raise MalformedRequestError(f"{what} names the coordinate {quote(name)}, which there is not", near)
                found[self._columns[name]] = value
            return found
        found = np.asarray(values, dtype=float)
        if found.shape != self._shape:
            raise MalformedRequestError(
                f"{what} has shape {found.shape}; expected {self._shape}, a number for each coordinate: "
                f"{format_names(self.coordinates)}"
            )
        return found

    def _configure(self, values: Values) -> tuple[Array, Array, list[_Turn]]:
        """Return the coordinates (n,), Pinocchio's configuration, and the blocks of S."""
        q = self._read(values, "q")
        u = self._arrange(q)
        if self._offset is not None:
            u += self._offset
        if not self._vectors:
            return q, u, []
        # several quantities are usually wanted of one state
        key = u.tobytes()
        if key != self._configured[0]:
            q_pin, turns = u[self._numbers], []
            for rows, numbers in self._vectors:
                phi = u[rows]
                q_pin[numbers] = self._pin.exp3_quat(phi)
                turns.append((rows, self._pin.Jexp3(phi), phi.tolist()))
            self._configured = (key, q_pin, turns)
        _, q_pin, turns = self._configured
        return q, q_pin, turns

    def _arrange(self, values: Array) -> Array:
        """Return C times numbers of the coordinates (n,): a new array in the order of Pinocchio."""
        return values[self._order] if self._is_permutation else self._C.dot(values)

    def _move(self, v: Array, a: Array | None, turns: list[_Turn]) -> tuple[Array, Array]:
        """Return Pinocchio's velocity S q' and its derivative S q'' + dS q' (None: q'' = 0)."""
        w, dw = self._arrange(v), self._zeros.copy() if a is None else self._arrange(a)
        for rows, _, phi in turns:
            w[rows], dw[rows] = compute_turn_motion(phi, w[rows].tolist(), dw[rows].tolist(), -1.0)
        return w, dw

    def _pull_back(self, values: Any, turns: list[_Turn]) -> Array:
        """Return S^T values (nv, ...): from one for each velocity to one for each coordinate. Changes them."""
        for rows, J, _ in turns:
            values[rows] = J.T.dot(values[rows])
        found: Array = values[self._rows] if self._is_permutation else self._C.T.dot(values)
        return found

    def _compute_forces(self, q: Values, v: Values, a: Array | None, forces: Forces | None) -> Array:
        """Return the joint forces of eq. 7; None: q'' = 0."""
        q, q_pin, turns = self._configure(q)
        w, dw = self._move(self._read(v, "v"), a, turns)
        tau = self._pull_back(self._pin.rnea(self._model, self._data, q_pin, w, dw), turns)
        return tau if forces is None else tau + self._project(q, forces)

    def _project(self, q: Array, forces: Forces) -> Array:
        """Return J' f_e (n,)."""
        found = np.zeros(len(q))
        for frame, force in forces.items():
            f = np.asarray(force, dtype=float)
            if f.shape != (6,):
                raise MalformedRequestError(f"the force at {frame} has shape {f.shape}; expected force and moment (6,)")
            found += self.jacobian(q, frame).T @ f
        return found

    def _singular_error(self, q: Array) -> MalformedRequestError:
        diagonal = np.diag(self.mass_matrix(q))
        idle = [name for name, value in self.by_name(diagonal).items() if not value > 0.0]
        what = (
            f"{format_names(idle)} {'moves' if len(idle) == 1 else 'move'} no mass" if idle else "a motion has no mass"
        )
        return MalformedRequestError(
            f"the mass matrix is singular: {what}; state the inertia of what moves, or a rotation vector short of 2 pi"
        )


def _with_masses(model: Model, tree: Tree, masses: Mapping[str, float], payload: Mapping[str, float]) -> Tree:
    """Return the tree with other masses of bodies, and with point masses at frames."""
    links = dict(tree.links)
    for what, given in (("mass", masses), ("payload", payload)):
        for name, mass in given.items():
            if not (math.isfinite(mass) and mass > 0.0):
                raise MalformedRequestError(f"the {what} of {name} is {mass:g} kg; it must be positive")
            body = name.partition(":")[0]
            model.body(body)
            if body not in links:
                raise MalformedRequestError(f"{name} is not joined to {tree.root}; its {what} has no effect")
            known = links[body].inertia
            if what == "payload":
                point = RigidInertia(mass, model.frame(name).pose.xyz, to_rows(np.zeros((3, 3))))
                found = point if known is None else _combine(known, point)
            elif known is None:
                raise MalformedRequestError(f"body {body} has no inertia to change; state one in the geometry file")
            else:
                about = np.array(known.about_center) * (mass / known.mass)
                found = RigidInertia(mass, known.center, to_rows(about))
            links[body] = links[body]._replace(inertia=found)
    return tree._replace(links=links)


def _combine(*parts: RigidInertia) -> RigidInertia:
    """Return the inertia of bodies that move as one, all in the same axes."""
    total = math.fsum(each.mass for each in parts)
    center = sum((each.mass * np.array(each.center) for each in parts), np.zeros(3)) / (total or 1.0)
    about = np.zeros((3, 3))
    for each in parts:
        K = so3.skew(np.array(each.center) - center)
        about += np.array(each.about_center) - each.mass * K @ K
    return RigidInertia(total, so3.to_vector3(center), to_rows(about))


def _transform(X_AB: Pose, inertia: RigidInertia) -> RigidInertia:
    """Return an inertia along the axes of A from that along those of B."""
    return RigidInertia.from_moments(inertia.mass, X_AB @ Pose(inertia.center), inertia.about_center)


def _build_pinocchio(tree: Tree, gravity: float) -> tuple[Any, Any, list[int], Array, Array, list[int]]:
    """Return the module pinocchio and its model of a tree, with how the model's joints belong to those of the tree.

    These are: the number of the last one for each joint of the tree; the map C and the offsets of the coordinates; the
    first row of each rotation vector. Raises ModelServerError if it is not installed.
    """
    try:
        import pinocchio as pin
    except ImportError as error:
        raise ModelServerError(f"dynamics needs Pinocchio ({error}); {make_install_command('dynamics')}") from None
    model = pin.Model()
    model.gravity.linear = np.array([0.0, 0.0, -gravity])
    last: list[int] = []
    vectors: list[int] = []
    nv = sum(each.joint.count for each in tree.joints)
    C, offset = np.zeros((nv, len(tree.coordinates))), np.zeros(nv)
    for each in tree.joints:
        number, X = 0 if each.parent == GROUND else last[each.parent], each.X_PN
        for joint, columns, factor in _make_joints(pin, each):
            if joint.nq > joint.nv:
                vectors.append(model.nv)
            rows = range(model.nv, model.nv + joint.nv)
            C[rows, columns], offset[rows] = factor, each.offset
            number, X = model.addJoint(number, joint, _to_se3(pin, X), f"{each.name} {rows[0]}"), Pose.identity()
        last.append(number)
    for link in tree.links.values():
        if link.inertia is not None:
            mass, center, about = link.inertia
            number = 0 if link.joint == GROUND else last[link.joint]
            inertia = pin.Inertia(mass, np.array(center), np.array(about))
            model.appendBodyToJoint(number, inertia, _to_se3(pin, link.X_FB))
    return pin, model, last, C, offset, vectors


def _make_joints(pin: Any, each: TreeJoint) -> list[tuple[Any, tuple[int, ...], float]]:
    """Return Pinocchio's joints that in a row move as one of the tree does, with their coordinates and a factor."""
    kind, columns, sign = each.joint.type, each.columns, 1.0 if each.forward else -1.0
    joints: list[tuple[Any, tuple[int, ...], float]] = []
    if kind is JointType.FLOATING:
        joints.append((pin.JointModelTranslation(), columns[:3], sign))
    if kind in (JointType.FLOATING, JointType.SPHERICAL):
        joints.append((pin.JointModelSpherical(), columns[-3:], sign))
    else:
        for column, twist in zip(columns, sign * each.joint.jacobian((0.0,) * each.joint.count).T, strict=True):
            joints.append((_make_axis_joint(pin, twist), (column,), each.multiplier))
    return joints if each.forward else joints[::-1]


def _make_axis_joint(pin: Any, twist: Array) -> Any:
    """Return Pinocchio's joint with one coordinate, of the velocity and angular velocity (6,) at its rate 1."""
    letter, name = ("P", "Prismatic") if twist[:3].any() else ("R", "Revolute")
    axis = twist[:3] if letter == "P" else twist[3:]
    for along, unit in zip("XYZ", np.eye(3), strict=True):
        if np.array_equal(axis, unit):
            return getattr(pin, f"JointModel{letter}{along}")()
    return getattr(pin, f"JointModel{name}Unaligned")(axis)


def _to_se3(pin: Any, X: Pose) -> Any:
    return pin.SE3(np.array(so3.matrix_rows(X.wxyz)), np.array(X.xyz))
