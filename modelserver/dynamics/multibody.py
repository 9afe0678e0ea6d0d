"""Dynamics of a model: mass matrix, bias vector, forward dynamics (report 3.2, eq. 7 to 10).

With generalized coordinates q, the mass matrix D, joint forces tau, and forces f_e of the vehicle on its surroundings:

    D(q) q'' + C(q, q') q' + G(q) + J' f_e = tau      (7)
    D(q) q'' = tau - b                                (8)
    b = C(q, q') q' + G(q) + J' f_e                   (9)   by recursive Newton-Euler with q'' = 0
    q'' = D(q)^-1 (tau - b)                           (10)

The coordinates are those of the geometry's joints, in the order of the file and with their names; mimic joints have
none of their own. A floating base adds six before them, as of a joint of type `floating` from the world to the root
frame: position x y z, then rotation vector rx ry rz, in a world whose z axis points up. tau of a rotation vector is
the force that does work on it: with the map S below, S' times the torque along the axes of the far frame.

Pinocchio computes in its own velocities w = S(q) q' (`rates`), where a mimic joint adds a row with its multiplier. The
equations above follow by the principle of virtual work:

    D = S' D_w S,   tau = S' RNEA(q, S q', S q'' + S' q'),   S q'' = ABA(q, S q', S^-T tau) - S' q'

Forward dynamics uses ABA where S is square, else (mimic joints) solves (8) with D, which is positive definite
unless a coordinate moves no mass. Algorithms: Featherstone (2008), ch. 5 to 7 (RNEA, CRBA, ABA); centroidal
momentum: Orin, Goswami, Lee (2013).

Limits: rigid bodies, no friction, damping or springs (they enter as tau); a rotation vector is singular at 2 pi; loops
as in `tree`. Numbers that are not finite give results that are not.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Iterable, Mapping
from typing import Any, Final, Literal, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from modelserver.dynamics.mass_covariance import MassUncertainty, iterate_center_covariance
from modelserver.dynamics.rates import compute_configuration, compute_rate_bias, compute_rate_map
from modelserver.dynamics.tree import GROUND, Tree, TreeJoint, TreeLink, build_tree
from modelserver.errors import LimitError, MalformedRequestError, ModelServerError, find_nearest_names, quote
from modelserver.geometry.inertia import RigidInertia
from modelserver.geometry.joint import JointType
from modelserver.geometry.model import Model
from modelserver.geometry.names import format_names
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
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
        self.uncertainty = uncertainty
        self.gravitational_acceleration = gravity
        self.mass = math.fsum(link.inertia.mass for link in self.tree.links.values() if link.inertia is not None)
        self._pin, self._model, self._turns = _build_pinocchio(self.tree, gravity)
        self._data = self._model.createData()
        # what stands on a fixed base: Pinocchio leaves it out of its sums
        fixed = [each for each in self.tree.links.values() if each.joint == GROUND and each.inertia is not None]
        self._ground = _combine(*(_transform(each.X_FB, each.inertia) for each in fixed if each.inertia is not None))
        self._moving_mass = math.fsum(each.mass for each in self._model.inertias.tolist()[1:])
        self._ground_share = np.array(self._ground.center) * (self._ground.mass / (self.mass or 1.0))
        self._columns = {name: number for number, name in enumerate(tree.coordinates)}
        self._default = np.array(tree.defaults)
        self._configured: tuple[bytes, Array, Array] = (b"none", self._default, self._default)
        # rows of Pinocchio's velocity, and numbers of its configuration, of each joint
        self._rows = [slice(each.idx_v, each.idx_v + each.nv) for each in self._model.joints[1:]]
        self._numbers = [slice(each.idx_q, each.idx_q + each.nq) for each in self._model.joints[1:]]
        self._several = [n for n, each in enumerate(tree.joints) if each.joint.count > 1]
        self._S = np.zeros((self._model.nv, len(tree.coordinates)))
        self._q_offset = np.zeros(self._model.nq)
        self._Q = np.zeros((self._model.nq, len(tree.coordinates)))
        for each, rows, numbers in zip(tree.joints, self._rows, self._numbers, strict=True):
            if each.joint.count == 1:
                self._S[rows, each.columns[0]] = self._Q[numbers, each.columns[0]] = each.multiplier
                self._q_offset[numbers] = each.offset
        n = len(tree.coordinates)
        self._is_square = self._model.nv == n
        # where Pinocchio's coordinates are ours, maybe in another order
        self._is_direct = (
            self._is_square and not self._several and not self._q_offset.any() and _is_permutation(self._S)
        )
        self._order = self._inverse_order = None
        if self._is_direct and not np.array_equal(self._S, np.eye(n)):
            self._order, self._inverse_order = self._S.argmax(axis=1), self._S.argmax(axis=0)

    @property
    def coordinates(self) -> tuple[str, ...]:
        """The names of the generalized coordinates, in the order of all arrays."""
        return self.tree.coordinates

    @property
    def cut(self) -> tuple[str, ...]:
        """The constraints that are left out because they close loops."""
        return self.tree.cut

    @property
    def massless(self) -> tuple[str, ...]:
        """The bodies that count as massless."""
        return self.tree.massless

    @property
    def default_position(self) -> Array:
        """The default positions of the joints (n,); 0 for a floating base."""
        return self._default.copy()

    def by_name(self, values: npt.ArrayLike) -> dict[str, float]:
        """Return numbers (n,), one for each coordinate, by name."""
        return dict(zip(self.coordinates, np.asarray(values, dtype=float).tolist(), strict=True))

    def mass_matrix(self, q: Values) -> Array:
        """Return the mass matrix D(q) (n, n), symmetric (eq. 7)."""
        q, q_pin, S = self._configure(q)
        D = self._pin.crba(self._model, self._data, q_pin).reshape((self._model.nv,) * 2)
        if self._is_direct:
            return np.array(D) if self._inverse_order is None else D[self._inverse_order][:, self._inverse_order]
        D = S.T @ D @ S
        return np.asarray((D + D.T) / 2.0)

    def bias(self, q: Values, v: Values, forces: Forces | None = None) -> Array:
        """Return the bias vector b(q, q') (n,) with the forces `forces` on the surroundings (eq. 9)."""
        q, q_pin, S = self._configure(q)
        v = self._read(v, "v")
        if self._is_direct:
            tau = self._restore(self._pin.nonLinearEffects(self._model, self._data, q_pin, self._arrange(v)))
        else:
            tau = S.T @ self._pin.rnea(self._model, self._data, q_pin, S @ v, self._rate_bias(q, v))
        return tau if forces is None else tau + self._project(q, forces)

    def gravity(self, q: Values) -> Array:
        """Return the gravity vector G(q) (n,): the joint forces that hold the vehicle still."""
        _, q_pin, S = self._configure(q)
        tau = self._pin.computeGeneralizedGravity(self._model, self._data, q_pin)
        return self._restore(tau) if self._is_direct else np.asarray(S.T @ tau)

    def inverse(self, q: Values, v: Values, a: Values, forces: Forces | None = None) -> Array:
        """Return the joint forces tau (n,) that cause the accelerations a = q'' (eq. 7)."""
        q, q_pin, S = self._configure(q)
        v, a = self._read(v, "v"), self._read(a, "a")
        if self._is_direct:
            v, a = self._arrange(v), self._arrange(a)
            tau = self._restore(self._pin.rnea(self._model, self._data, q_pin, v, a))
        else:
            tau = S.T @ self._pin.rnea(self._model, self._data, q_pin, S @ v, S @ a + self._rate_bias(q, v))
        return tau if forces is None else tau + self._project(q, forces)

    def forward(self, q: Values, v: Values, tau: Values, forces: Forces | None = None) -> Array:
        """Return the accelerations q'' (n,) that joint forces cause (eq. 10).

        Raises MalformedRequestError, naming the coordinate, where one moves no mass.
        """
        q, q_pin, S = self._configure(q)
        v, tau = self._read(v, "v"), self._read(tau, "tau")
        if forces is not None:
            tau = tau - self._project(q, forces)
        try:
            if self._is_direct:
                a_pin = self._pin.aba(self._model, self._data, q_pin, self._arrange(v), self._arrange(tau))
                a = self._restore(a_pin)
            elif self._is_square:
                a_pin = self._pin.aba(self._model, self._data, q_pin, S @ v, np.linalg.solve(S.T, tau))
                a = np.asarray(np.linalg.solve(S, a_pin - self._rate_bias(q, v)))
            else:
                D = self.mass_matrix(q)
                np.linalg.cholesky(D)  # raises where D is not positive definite
                a = np.asarray(np.linalg.solve(D, tau - self.bias(q, v)))
        except np.linalg.LinAlgError:
            a = np.full(len(q), math.nan)
        if not np.isfinite(a).all() and np.isfinite(q).all() and np.isfinite(v).all() and np.isfinite(tau).all():
            raise self._singular_error(q)
        return a

    def kinetic_energy(self, q: Values, v: Values) -> float:
        """Return the kinetic energy, J."""
        _, q_pin, S = self._configure(q)
        return float(self._pin.computeKineticEnergy(self._model, self._data, q_pin, S @ self._read(v, "v")))

    def potential_energy(self, q: Values) -> float:
        """Return the potential energy, J; 0 with all mass at the height of the world's origin."""
        moving = float(self._pin.computePotentialEnergy(self._model, self._data, self._configure(q)[1]))
        return moving + self._ground.mass * self.gravitational_acceleration * self._ground.center[2]

    def momentum(self, q: Values, v: Values, a: Values | None = None) -> tuple[Array, Array]:
        """Return linear and angular momentum (6,) about the center of mass along the world's axes, and its rate (6,).

        The rate is nan without accelerations `a`.
        """
        q, q_pin, S = self._configure(q)
        v = self._read(v, "v")
        if a is None:
            h = self._pin.computeCentroidalMomentum(self._model, self._data, q_pin, S @ v)
            return np.array(h.vector), np.full(6, math.nan)
        a_pin = S @ self._read(a, "a") + self._rate_bias(q, v)
        self._pin.computeCentroidalMomentumTimeVariation(self._model, self._data, q_pin, S @ v, a_pin)
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
        q, q_pin, S = self._configure(q)
        velocity, share = None, self._moving_mass / self.mass
        c = self._ground_share
        if share:  # else Pinocchio divides by no mass
            c = c + share * self._pin.centerOfMass(self._model, self._data, q_pin)
        if v is not None:
            v, velocity = self._read(v, "v"), np.zeros(3)
            if share:
                self._pin.centerOfMass(self._model, self._data, q_pin, S @ v)
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
        positions = {each.name: self._position_of(each, q) for each in self.tree.joints}
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
            center, about = so3.to_vector3(self._data.com[0]), _to_rows(self._data.Ig.inertia)
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
                M = self._data.oMi[link.joint + 1]
                X_FP = Pose(M.translation.tolist(), so3.from_matrix(M.rotation)) @ X_FP
            found.append(X_FP)
        return found

    def jacobian(self, q: Values, frame: str) -> Array:
        """Return the Jacobian (6, n) of a frame: J q' is its velocity and angular velocity along the world's axes."""
        link, X_FP = self._locate(frame)
        q, q_pin, S = self._configure(q)
        if link.joint == GROUND:
            return np.zeros((6, len(q)))
        pin = self._pin
        pin.computeJointJacobians(self._model, self._data, q_pin)
        J = pin.getJointJacobian(self._model, self._data, link.joint + 1, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
        J = np.array(J).reshape(6, self._model.nv)  # one column comes as a vector
        arm = self._data.oMi[link.joint + 1].rotation @ X_FP.position
        J[:3] -= so3.skew(arm) @ J[3:]
        return np.asarray(J @ S)

    def _locate(self, frame: str) -> tuple[TreeLink, Pose]:
        """Return the link of a frame's body, and the frame's pose in Pinocchio's frame of the link's joint."""
        found = self.model.frame(frame)
        link = self.tree.links.get(found.body)
        if link is None:
            raise MalformedRequestError(
                f"frame {frame} is not joined to {self.tree.root}; its dynamics is not computed"
            )
        X_FP = link.X_FB @ found.pose
        return link, X_FP if link.joint == GROUND else self._turns[link.joint].inverse() @ X_FP

    def _read(self, values: Values, what: str) -> Array:
        """Return the number of each coordinate (n,). Raises MalformedRequestError."""
        if isinstance(values, Mapping):
            found = self._default.copy() if what == "q" else np.zeros(len(self._default))
            for name, value in values.items():
                if name not in self._columns:
                    near = find_nearest_names(name, self._columns)
                    raise MalformedRequestError(f"{what} names the coordinate {quote(name)}, which there is not", near)
                found[self._columns[name]] = value
            return found
        found = np.asarray(values, dtype=float)
        if found.shape != self._default.shape:
            raise MalformedRequestError(
                f"{what} has shape {found.shape}; expected {self._default.shape}, a number for each coordinate: "
                f"{format_names(self.coordinates)}"
            )
        return found

    def _position_of(self, joint: TreeJoint, q: Array) -> tuple[float, ...]:
        values = q[list(joint.columns)].tolist()
        return tuple([joint.multiplier * value + joint.offset for value in values])

    def _configure(self, values: Values) -> tuple[Array, Array, Array]:
        """Return the coordinates (n,), Pinocchio's configuration, and the map S of rates (see the module)."""
        q = self._read(values, "q")
        if self._is_direct:
            return q, self._arrange(q), self._S
        # several quantities are usually wanted of one state
        key = q.tobytes()
        if key == self._configured[0]:
            return q, *self._configured[1:]
        q_pin = self._Q @ q + self._q_offset
        S = self._S.copy() if self._several else self._S
        for n in self._several:
            each = self.tree.joints[n]
            position = q[each.columns[0] : each.columns[-1] + 1].tolist()
            q_pin[self._numbers[n]] = compute_configuration(each.joint, each.forward, position)
            S[self._rows[n], each.columns[0] : each.columns[-1] + 1] = compute_rate_map(
                each.joint, each.forward, position
            )
        self._configured = (key, q_pin, S)
        return q, q_pin, S

    def _arrange(self, values: Array) -> Array:
        """Return numbers of the coordinates in Pinocchio's order, where they are the same."""
        return values if self._order is None else values[self._order]

    def _restore(self, values: Any) -> Array:
        """Return a copy of numbers in Pinocchio's order in that of the coordinates."""
        return np.array(values) if self._inverse_order is None else np.asarray(values[self._inverse_order])

    def _rate_bias(self, q: Array, v: Array) -> Array:
        """Return S' q', the acceleration of Pinocchio's velocities at q'' = 0."""
        found = np.zeros(self._model.nv)
        for n in self._several:
            each = self.tree.joints[n]
            columns = slice(each.columns[0], each.columns[-1] + 1)
            found[self._rows[n]] = compute_rate_bias(each.joint, each.forward, q[columns].tolist(), v[columns].tolist())
        return found

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


def _is_permutation(S: Array) -> bool:
    return bool(((S == 0.0) | (S == 1.0)).all() and (S.sum(axis=0) == 1.0).all() and (S.sum(axis=1) == 1.0).all())


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
                point = RigidInertia(mass, model.frame(name).pose.xyz, _to_rows(np.zeros((3, 3))))
                found = point if known is None else _combine(known, point)
            elif known is None:
                raise MalformedRequestError(f"body {body} has no inertia to change; state one in the geometry file")
            else:
                about = np.array(known.about_center) * (mass / known.mass)
                found = RigidInertia(mass, known.center, _to_rows(about))
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
    return RigidInertia(total, so3.to_vector3(center), _to_rows(about))


def _transform(X_AB: Pose, inertia: RigidInertia) -> RigidInertia:
    """Return an inertia along the axes of A from that along those of B."""
    R = X_AB.rotation
    center = X_AB.transform(inertia.center)
    return RigidInertia(inertia.mass, so3.to_vector3(center), _to_rows(R @ np.array(inertia.about_center) @ R.T))


def _to_rows(M: Array) -> Any:
    return tuple([so3.to_vector3(row) for row in M])


def _build_pinocchio(tree: Tree, gravity: float) -> tuple[Any, Any, list[Pose]]:
    """Return the module pinocchio, its model of a tree, and the pose of each of its joints in ours (see `_make_joint`).

    Raises ModelServerError if it is not installed."""
    try:
        import pinocchio as pin
    except ImportError as error:
        raise ModelServerError(
            f"dynamics needs Pinocchio ({error}); install it with pip install 'modelserver[dynamics]'"
        ) from None
    model = pin.Model()
    model.gravity.linear = np.array([0.0, 0.0, -gravity])
    turns: list[Pose] = []
    for each in tree.joints:
        joint, turn = _make_joint(pin, each)
        before = Pose.identity() if each.parent == GROUND else turns[each.parent].inverse()
        model.addJoint(each.parent + 1, joint, _to_se3(pin, before @ each.X_PN @ turn), each.name)
        turns.append(turn)
    for link in tree.links.values():
        if link.inertia is not None:
            mass, center, about = link.inertia
            X = link.X_FB if link.joint == GROUND else turns[link.joint].inverse() @ link.X_FB
            inertia = pin.Inertia(mass, np.array(center), np.array(about))
            model.appendBodyToJoint(link.joint + 1, inertia, _to_se3(pin, X))
    return pin, model, turns


def _make_joint(pin: Any, each: TreeJoint) -> tuple[Any, Pose]:
    """Return Pinocchio's joint, and the pose of its axes in the joint's frames: a planar one moves in x and y."""
    kind, none = each.joint.type, Pose.identity()
    axis = np.array(each.joint.axis) * (1.0 if each.forward else -1.0)
    if kind in (JointType.REVOLUTE, JointType.PRISMATIC):
        letter = "R" if kind is JointType.REVOLUTE else "P"
        for name, unit in zip("XYZ", np.eye(3), strict=True):
            if np.array_equal(axis, unit):
                return getattr(pin, f"JointModel{letter}{name}")(), none
        make = pin.JointModelRevoluteUnaligned if letter == "R" else pin.JointModelPrismaticUnaligned
        return make(axis), none
    if kind is JointType.PLANAR:
        J = each.joint.jacobian((0.0, 0.0, 0.0))
        return pin.JointModelPlanar(), Pose(
            (0.0, 0.0, 0.0), so3.from_matrix(np.column_stack((J[:3, 0], J[:3, 1], J[3:, 2])))
        )
    return pin.JointModelSpherical() if kind is JointType.SPHERICAL else pin.JointModelFreeFlyer(), none


def _to_se3(pin: Any, X: Pose) -> Any:
    return pin.SE3(np.array(so3.matrix_rows(X.wxyz)), np.array(X.xyz))
