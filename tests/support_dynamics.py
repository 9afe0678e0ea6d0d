"""Models with masses, and the same in MuJoCo, an engine that shares nothing with what is tested.

`MujocoTwin` builds bodies from the graph of constraints by itself. Its joints are hinges, slides and balls in a row, so
that lengths and angles are coordinates there too; only a ball has an angular velocity, which it gets here from the
rotation vector by a complex step.
"""

from __future__ import annotations

import random

import numpy as np
import pytest
from support_geometry import random_pose

from modelserver.geometry import Body, Joint, JointType, Mimic, Model, ModelBuilder
from modelserver.geometry.parts import RigidInertia, from_spatial_inertia
from modelserver.transforms import Pose, so3

CART = """\
modelserver: geometry/1
name: cart
bodies:
  Cart:
    inertia: {mass: 80, center: [0, 0, 0.5], moments: [5, 8, 10]}
    frames:
      Base:
      Antenna: {xyz: [-0.4, 0.2, 1.2]}
      Imu: {xyz: [0.1, 0, 0.3]}
      Mast: {xyz: [0.5, 0.1, 1.0]}
      FL: {xyz: [0.5, 0.4, 0]}
      FR: {xyz: [0.5, -0.4, 0]}
      RL: {xyz: [-0.5, 0.4, 0]}
      RR: {xyz: [-0.5, -0.4, 0]}
  Arm:
    inertia: {mass: 20, center: [0, 0, 1], moments: [1, 1, 1]}
    frames:
      Foot:
constraints:
  Slide: {from: Cart:Base, to: Arm:Foot, joint: {type: prismatic, axis: [0, 1, 0], default: 0, sigma: 0.01}}
"""
"""A cart of 80 kg with an arm of 20 kg that slides sideways; its contacts are 1 m and 0.8 m apart."""

MOVING = tuple(each for each in JointType if each is not JointType.FIXED)


def random_inertia(rng: random.Random) -> RigidInertia:
    """Return the inertia of some points of random mass."""
    points = np.array([[rng.gauss(0, 0.3) for _ in range(3)] for _ in range(6)])
    masses = np.array([rng.uniform(0.2, 2.0) for _ in range(6)])
    center = masses @ points / masses.sum()
    about = -sum(m * so3.skew(p) @ so3.skew(p) for m, p in zip(masses, points - center, strict=True))
    rows = tuple(so3.to_vector3(row) for row in about)
    return RigidInertia(float(masses.sum()), so3.to_vector3(center), rows)  # type: ignore[arg-type]


def random_model(rng: random.Random, bodies: int, types=MOVING, mimics: bool = True) -> Model:
    """Return a random tree of bodies with masses, joined by joints of the types, passed in either sense."""
    builder = ModelBuilder("random")
    frames: dict[int, list[str]] = {body: ["Base"] for body in range(bodies)}
    ends = []
    for body in range(1, bodies):
        a, b = rng.randrange(body), body
        if rng.random() < 0.5:
            a, b = b, a
        frames[a].append(f"F{body}")
        frames[b].append(f"T{body}")
        ends.append((f"B{a}:F{body}", f"B{b}:T{body}"))
    for body in range(bodies):
        draft = builder.add_body(f"B{body}", inertia=random_inertia(rng).matrix())
        for frame in frames[body]:
            draft.add_frame(frame, random_pose(rng))
    leaders: list[str] = []
    order = list(enumerate(ends))
    rng.shuffle(order)  # the order of the coordinates is that of the file
    for number, (start, end) in order:
        kind = rng.choice(types)
        single = Joint(kind).count == 1
        mimic = None
        if mimics and single and leaders and rng.random() < 0.4:
            mimic = Mimic(rng.choice(leaders), rng.uniform(-2, 2), rng.uniform(-1, 1))
        elif single:
            leaders.append(f"C{number}")
        axis = rng.choice([(1.0, 0.0, 0.0), (0.0, 0.0, -1.0), tuple(rng.gauss(0, 1) for _ in range(3))])
        builder.add_constraint(f"C{number}", start, end, random_pose(rng), joint=Joint(kind, axis, mimic=mimic))
    return builder.build()


def random_state(rng: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return rng.uniform(-1.5, 1.5, n), rng.uniform(-2, 2, n), rng.uniform(-20, 20, n)


def rotation(phi: np.ndarray) -> np.ndarray:
    """Return exp([phi]x), also for complex numbers."""
    square = phi @ phi
    angle = np.sqrt(square)
    x, y, z = phi
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) / angle * K + (1 - np.cos(angle)) / square * K @ K


def body_rate(phi: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """Return the angular velocity along the axes of the rotated frame: R' dR/dt, by a complex step."""
    W = rotation(phi).T @ (rotation(phi + 1e-30j * rate).imag / 1e-30)
    return np.array([W[2, 1], W[0, 2], W[1, 0]])


def body_rate_bias(phi: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """Return the derivative of `body_rate` at a constant rate."""
    h = 2e-3
    at = [body_rate(phi + n * h * rate, rate) for n in (-3, -2, -1, 1, 2, 3)]
    return np.array(np.array([-1, 9, -45, 45, -9, 1]) @ np.array(at) / (60 * h))


class MujocoTwin:
    """A model in MuJoCo; `coordinates` are those of Dynamics with that base."""

    def __init__(self, model: Model, coordinates: tuple[str, ...], root: str, floating: bool, gravity: float = 9.80665):
        mujoco = self.mujoco = pytest.importorskip("mujoco", reason="mujoco has no wheel for this Python")
        self.column = {name: n for n, name in enumerate(coordinates)}
        self.n = len(coordinates)
        # for each joint in MuJoCo: columns, factor, offset; three columns for a ball
        self.rows: list[tuple[list[int], float, float]] = []
        spec = mujoco.MjSpec()
        spec.option.gravity = [0.0, 0.0, -gravity]
        spec.option.disableflags = int(mujoco.mjtDisableBit.mjDSBL_CONTACT) | int(
            mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
        )
        spec.compiler.autolimits = False
        spec.compiler.degree = False
        self._add(model, spec.worldbody, None, root.partition(":")[0], root, Pose.identity(), floating)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)

    def _add(self, model: Model, parent, arrived, name: str, by: str, X_parent: Pose, floating: bool = False) -> None:
        """Add a body that is entered by a frame: its MuJoCo body is at that frame."""
        body: Body = model.body(name)
        at = parent.add_body(name=name, pos=X_parent.xyz, quat=X_parent.wxyz)
        X_frame = model.frame(by).pose.inverse()  # of the body's origin in the frame
        if floating:
            self._joint(
                at,
                Joint(JointType.FLOATING),
                True,
                [self.column[f"{by}{s}"] for s in (".x", ".y", ".z", ".rx", ".ry", ".rz")],
            )
        elif arrived is not None and arrived.joint.is_movable:
            forward = arrived.to == by
            drive = model.drives[arrived.name]
            columns = [self.column[each] for each in drive.names]
            self._joint(at, arrived.joint, forward, columns, drive.multiplier, drive.offset)
            if not forward:
                X_frame = arrived.pose.inverse() @ X_frame
        if body.inertia is not None:
            found = from_spatial_inertia(body.inertia)
            assert found is not None
            center = X_frame.transform(np.array(found.center))
            about = X_frame.rotation @ np.array(found.about_center) @ X_frame.rotation.T
            at.explicitinertial = True
            at.mass, at.ipos = found.mass, center
            at.fullinertia = about[np.array([0, 1, 2, 0, 0, 1]), np.array([0, 1, 2, 1, 2, 2])]
        for frame in body:
            for each in model.constraints_of(frame.full_name):
                if each is arrived:
                    continue
                other = each.other_end(frame.full_name)
                X = X_frame @ frame.pose
                if each.from_ == frame.full_name:
                    X = X @ each.pose
                elif not each.joint.is_movable:
                    X = X @ each.pose.inverse()
                self._add(model, at, each, other.partition(":")[0], other, X)

    def _joint(
        self, at, joint: Joint, forward: bool, columns: list[int], factor: float = 1.0, offset: float = 0.0
    ) -> None:
        types = self.mujoco.mjtJoint
        sign = 1.0 if forward else -1.0

        def add(kind, axis, column, pos=(0.0, 0.0, 0.0)):
            at.add_joint(type=kind, axis=axis, pos=pos)
            self.rows.append((column, factor * sign, offset * sign))

        slide, hinge, ball = types.mjJNT_SLIDE, types.mjJNT_HINGE, types.mjJNT_BALL
        J = joint.jacobian([0.0] * joint.count)
        match joint.type:
            case JointType.REVOLUTE:
                add(hinge, joint.axis, columns)
            case JointType.PRISMATIC:
                add(slide, joint.axis, columns)
            case JointType.SPHERICAL:
                add(ball, (1, 0, 0), columns)
            case JointType.PLANAR:
                steps = [
                    (slide, J[:3, 0], columns[:1]),
                    (slide, J[:3, 1], columns[1:2]),
                    (hinge, J[3:, 2], columns[2:]),
                ]
                for step in steps if forward else steps[-1:] + steps[:-1]:
                    add(*step)
            case JointType.FLOATING:
                slides = [(slide, axis, [column]) for axis, column in zip(np.eye(3), columns[:3], strict=True)]
                turn = [(ball, (1, 0, 0), columns[3:])]
                for step in slides + turn if forward else turn + slides:
                    add(*step)

    def set(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Set the state; return the map S of rates (nv, n) and S' q' (nv)."""
        S, bias = np.zeros((self.model.nv, self.n)), np.zeros(self.model.nv)
        for number, (columns, factor, offset) in enumerate(self.rows):
            at, row = self.model.jnt_qposadr[number], self.model.jnt_dofadr[number]
            if len(columns) == 1:
                self.data.qpos[at] = factor * q[columns[0]] + offset
                S[row, columns[0]] = factor
                continue
            phi, rate = factor * q[columns], factor * v[columns]
            self.data.qpos[at : at + 4] = so3.exponential(so3.to_vector3(phi))
            for axis, column in zip(np.eye(3), columns, strict=True):
                S[row : row + 3, column] = body_rate(phi, factor * axis)
            bias[row : row + 3] = body_rate_bias(phi, rate)
        self.data.qvel[:] = S @ v
        self.mujoco.mj_forward(self.model, self.data)
        return S, bias

    def equations(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return mass matrix and bias vector."""
        S, change = self.set(q, v)
        M = np.zeros((self.model.nv, self.model.nv))
        for column, unit in enumerate(np.eye(self.model.nv)):
            self.mujoco.mj_mulM(self.model, self.data, M[column], unit)
        return S.T @ M @ S, S.T @ (self.data.qfrc_bias + M @ change)


def is_close(a: np.ndarray, b: np.ndarray, tolerance: float = 1e-8) -> bool:
    """Return whether two arrays agree, relative to the largest entry."""
    return bool(np.abs(a - b).max() <= tolerance * max(np.abs(b).max(), 1.0))


def ball(mass: float, *at: float):
    small = 1e-9 * mass
    return RigidInertia(mass, at, ((small, 0, 0), (0, small, 0), (0, 0, small))).matrix()  # type: ignore[arg-type]


def cart_with_mast() -> Model:
    """Return a cart of 80 kg with a mast that slides sideways, and 20 kg at its top."""
    builder = ModelBuilder("cart")
    cart = builder.add_body("Cart", inertia=ball(80.0, 0.0, 0.0, 0.5))
    cart.add_frame("Origin")
    for name, x, y in (
        ("front_left", 0.5, 0.4),
        ("front_right", 0.5, -0.4),
        ("rear_left", -0.5, 0.4),
        ("rear_right", -0.5, -0.4),
    ):
        cart.add_frame(name, Pose((x, y, 0.0)))
    builder.add_body("Mast", inertia=ball(20.0, 0.0, 0.0, 1.0)).add_frame("Foot")
    builder.add_constraint(
        "Slide", "Cart:Origin", "Mast:Foot", joint=Joint(JointType.PRISMATIC, (0, 1, 0), sigma=(0.01,))
    )
    return builder.build()
