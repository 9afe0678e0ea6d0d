from __future__ import annotations

import math
import random
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from support_dynamics import MOVING, MujocoTwin, is_close, random_inertia, random_model, random_state

from modelserver import load_model
from modelserver.dynamics import Dynamics, MassUncertainty
from modelserver.errors import LimitError, MalformedRequestError, UnknownFrameError
from modelserver.geometry import Joint, JointType, Mimic, Model, ModelBuilder, Sigma
from modelserver.geometry.parts import RigidInertia
from modelserver.transforms import Pose, so3
from modelserver.transforms.pose import compute_turn_motion, compute_turn_rate

pytest.importorskip("pinocchio", reason="pin has no wheel for this Python")


def point(mass: float, *at: float) -> RigidInertia:
    """Return the inertia of a small ball."""
    small = 1e-9 * mass
    return RigidInertia(mass, at, ((small, 0, 0), (0, small, 0), (0, 0, small)))  # type: ignore[arg-type]


def pendulum(mass: float = 2.0, length: float = 0.5, **joint) -> ModelBuilder:
    builder = ModelBuilder("pendulum")
    builder.add_body("Base", inertia=point(10.0, 0, 0, 0).matrix()).add_frame("Origin")
    builder.add_body("Arm", inertia=point(mass, 0, 0, -length).matrix()).add_frame("Pivot")
    builder.add_constraint("Hinge", "Base:Origin", "Arm:Pivot", joint=Joint(JointType.REVOLUTE, (0, 1, 0), **joint))
    return builder


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(25))
def test_given_random_trees_of_all_joints_then_equations_agree_with_mujoco(seed):
    # 25 trees with 40 states each
    floating = seed % 2 == 0
    model = random_model(random.Random(seed), 3 + seed % 6)
    dynamics = model.dynamics("floating" if floating else "fixed")
    twin = MujocoTwin(model, dynamics.coordinates, dynamics.tree.root, floating)
    states = np.random.default_rng(seed)
    for _ in range(40):
        q, v, tau = random_state(states, len(dynamics.coordinates))
        D, b = twin.equations(q, v)
        own = dynamics.mass_matrix(q)
        assert is_close(own, D)
        assert (own == own.T).all()
        assert np.linalg.eigvalsh(own).min() > 0.0
        assert is_close(dynamics.bias(q, v), b)
        a = dynamics.forward(q, v, tau)
        assert is_close(a, np.linalg.solve(D, tau - b))
        assert is_close(dynamics.inverse(q, v, a), tau)


@pytest.mark.realdata
@pytest.mark.slow
@pytest.mark.parametrize("name", ["clearpath_a200", "clearpath_j100"])
@pytest.mark.parametrize("base", ["floating", "fixed"])
def test_given_public_urdf_then_equations_agree_with_mujoco(data_dir, name, base):
    model = load_model(data_dir / "geometry/urdf" / f"{name}.urdf")
    dynamics = model.dynamics(base, allow_massless=True)
    assert dynamics.mass == pytest.approx({"clearpath_a200": 46.034 + 4 * 2.637, "clearpath_j100": 18.432}[name])
    twin = MujocoTwin(model, dynamics.coordinates, dynamics.tree.root, base == "floating")
    states = np.random.default_rng(3)
    for _ in range(250):
        q, v, tau = random_state(states, len(dynamics.coordinates))
        D, b = twin.equations(q, v)
        assert is_close(dynamics.mass_matrix(q), D)
        assert is_close(dynamics.bias(q, v), b)
        assert is_close(dynamics.forward(q, v, tau), np.linalg.solve(D, tau - b))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "types", "base"),
    [
        (1, (JointType.REVOLUTE,), "fixed"),
        (4, (JointType.REVOLUTE, JointType.PLANAR), "fixed"),
        (2, MOVING, "floating"),
    ],
)
def test_given_free_motion_of_ten_seconds_then_energy_is_conserved(seed, types, base):
    model = random_model(random.Random(seed), 4, types)
    dynamics = model.dynamics(base, gravity=9.80665 if base == "fixed" else 0.0)
    n = len(dynamics.coordinates)
    start = np.concatenate((np.zeros(n), 0.3 * np.random.default_rng(seed).uniform(-1, 1, n)))

    def rate(_, y):
        return np.concatenate((y[n:], dynamics.forward(y[:n], y[n:], np.zeros(n))))

    found = solve_ivp(rate, (0.0, 10.0), start, method="DOP853", rtol=1e-11, atol=1e-12, t_eval=np.linspace(0, 10, 50))
    assert found.success
    kinetic = np.array([dynamics.kinetic_energy(y[:n], y[n:]) for y in found.y.T])
    total = kinetic + [dynamics.potential_energy(y[:n]) for y in found.y.T]
    assert np.abs(total - total[0]).max() < 1e-6 * kinetic.max()


def test_given_pendulum_then_equations_are_those_of_the_textbook():
    m, length, g = 2.0, 0.5, 9.80665
    dynamics = pendulum(m, length).build().dynamics("fixed")
    assert dynamics.coordinates == ("Hinge",)
    q = {"Hinge": 0.3}
    assert dynamics.mass_matrix(q)[0, 0] == pytest.approx(m * length**2)
    assert dynamics.gravity(q)[0] == pytest.approx(m * g * length * math.sin(0.3))
    assert dynamics.bias(q, {"Hinge": 5.0})[0] == pytest.approx(m * g * length * math.sin(0.3))
    assert dynamics.forward(q, {}, {})[0] == pytest.approx(-g / length * math.sin(0.3))
    assert dynamics.kinetic_energy(q, [2.0]) == pytest.approx(0.5 * m * length**2 * 4.0)
    assert dynamics.potential_energy(q) == pytest.approx(-m * g * length * math.cos(0.3))
    assert dynamics.by_name([0.3]) == {"Hinge": 0.3}


def test_given_joint_passed_backward_then_the_coordinate_keeps_its_sense():
    forward = pendulum().build().dynamics("fixed", "Base:Origin")
    backward = pendulum().build().dynamics("floating", "Arm:Pivot")
    # the arm held, the base moves the other way: D of the joint is that of the base about the pivot, nothing here
    assert backward.coordinates == ("Arm:Pivot.x", "Arm:Pivot.y", "Arm:Pivot.z", "Arm:Pivot.rx", "Arm:Pivot.ry",
                                    "Arm:Pivot.rz", "Hinge")  # fmt: skip
    X = backward.frame_pose({"Hinge": 0.3}, "Base:Origin")
    assert X.is_close(Pose.from_rpy((0, 0, 0), pitch=-0.3))
    assert forward.frame_pose({"Hinge": 0.3}, "Arm:Pivot").is_close(X.inverse())


def test_given_force_on_surroundings_then_it_enters_the_bias_with_its_jacobian():
    dynamics = pendulum().build().dynamics("fixed")
    tip = {"Arm:Pivot": [0, 0, 0, 0, 3.0, 0]}
    assert dynamics.bias([0.3], [0.0], tip)[0] == pytest.approx(dynamics.gravity([0.3])[0] + 3.0)
    assert dynamics.inverse([0.3], [0.0], [0.0], tip)[0] == pytest.approx(dynamics.gravity([0.3])[0] + 3.0)
    rest = dynamics.forward([0.3], [0.0], dynamics.bias([0.3], [0.0], tip), tip)
    assert rest == pytest.approx([0.0], abs=1e-12)
    with pytest.raises(MalformedRequestError, match="has shape"):
        dynamics.bias([0.3], [0.0], {"Arm:Pivot": [1.0]})


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("size", [1e-6, 0.05, 0.099, 0.101, 1.0, 3.5])
def test_given_rate_of_rotation_vector_then_motion_and_inverse_are_those_of_its_jacobian(sign, size):
    rng = np.random.default_rng(5)
    phi, (rate, change) = size * rng.uniform(-1, 1, 3), rng.uniform(-1, 1, (2, 3))
    h = 1e-4
    ahead, at, behind = (so3.left_jacobian(sign * (phi + step * rate)) for step in (h, 0.0, -h))
    velocity, acceleration = compute_turn_motion(tuple(phi), tuple(rate), tuple(change), sign)
    assert velocity == pytest.approx(at @ rate, abs=1e-11)
    assert acceleration == pytest.approx(at @ change + (ahead - behind) @ rate / (2 * h), abs=1e-7)
    assert compute_turn_rate(tuple(phi), velocity, sign) == pytest.approx(rate, abs=1e-14)


@pytest.mark.parametrize("seed", [7, 12, 4], ids=["permutation", "backward vectors", "mimics"])
def test_given_other_states_between_then_results_stay_and_repeat(seed):
    dynamics = random_model(random.Random(seed), 3 + seed % 6).dynamics()
    states = np.random.default_rng(seed)
    (q, v, tau), other = (random_state(states, len(dynamics.coordinates)) for _ in range(2))

    def compute(q, v, tau):
        frame = f"{list(dynamics.tree.links)[-1]}:Base"
        results = dynamics.mass_matrix(q), dynamics.gravity(q), dynamics.bias(q, v), dynamics.forward(q, v, tau)
        return *results, dynamics.inverse(q, v, tau), *dynamics.momentum(q, v, tau), dynamics.jacobian(q, frame)

    given = q.copy(), v.copy(), tau.copy()
    first = compute(q, v, tau)
    stored = [each.copy() for each in first]
    compute(*other)
    assert all(np.array_equal(a, b) for a, b in zip(first, stored, strict=True))
    assert all(np.array_equal(a, b) for a, b in zip(compute(q, v, tau), stored, strict=True))
    assert all(np.array_equal(a, b) for a, b in zip((q, v, tau), given, strict=True))
    # a state that is changed in place is another one
    q[:] = other[0]
    assert np.array_equal(dynamics.mass_matrix(q), dynamics.mass_matrix(other[0]))


@pytest.mark.parametrize("value", [math.nan, math.inf, 1e200])
def test_given_rotation_vector_that_is_not_finite_then_neither_are_the_results(value):
    dynamics = pendulum().build().dynamics()
    q = np.zeros(7)
    q[4] = value
    with np.errstate(all="ignore"):
        assert not np.isfinite(dynamics.mass_matrix(q)).all()
        assert not np.isfinite(dynamics.bias(q, np.ones(7))).all()


def test_given_jacobian_then_it_is_the_derivative_of_the_pose():
    model = random_model(random.Random(3), 6)
    dynamics = model.dynamics()
    q, v, a = random_state(np.random.default_rng(1), len(dynamics.coordinates))
    h = 1e-6
    for body in model.bodies:
        frame = f"{body.name}:Base"
        ahead, behind = (dynamics.frame_pose(q + sign * h * v, frame) for sign in (1, -1))
        moved = dynamics.jacobian(q, frame) @ v
        assert moved[:3] == pytest.approx((ahead.position - behind.position) / (2 * h), abs=1e-6)
        W = (ahead.rotation - behind.rotation) / (2 * h) @ dynamics.frame_pose(q, frame).rotation.T
        assert moved[3:] == pytest.approx([W[2, 1], W[0, 2], W[1, 0]], abs=1e-6)
    center = dynamics.center_of_mass(q, v)
    assert center.velocity == pytest.approx(
        (dynamics.center_of_mass(q + h * v).position - dynamics.center_of_mass(q - h * v).position) / (2 * h), abs=1e-6
    )
    within = dynamics.center_of_mass(q, v, "B2:Base")
    assert within.velocity == pytest.approx(
        (dynamics.center_of_mass(q + h * v, frame="B2:Base").position
         - dynamics.center_of_mass(q - h * v, frame="B2:Base").position) / (2 * h), abs=1e-6
    )  # fmt: skip
    h_now, rate = dynamics.momentum(q, v, a)
    assert h_now[:3] == pytest.approx(dynamics.mass * center.velocity)
    # the base of a floating vehicle: force on it is the rate of linear momentum and the weight
    tau = dynamics.inverse(q, v, a)
    assert tau[:3] == pytest.approx(rate[:3] + np.array([0, 0, dynamics.mass * 9.80665]))


def test_given_poses_of_the_model_then_frames_of_the_dynamics_are_the_same():
    model = random_model(random.Random(8), 7)
    dynamics = model.dynamics("fixed")
    for body in model.bodies:
        frame = f"{body.name}:Base"
        expected = model.get_transformation(frame, dynamics.tree.root).pose
        assert dynamics.frame_pose(dynamics.default_position, frame).is_close(expected)


def test_given_point_masses_then_center_and_inertia_are_those_of_a_hand_calculation():
    dynamics = pendulum(2.0, 0.5).build().dynamics("fixed", payload={"Base:Origin": 6.0})
    found = dynamics.center_of_mass([math.pi / 2], [1.0])
    # 16 kg at the pivot, 2 kg at half a meter to -x
    assert found.mass == pytest.approx(18.0)
    assert found.position == pytest.approx([-1.0 / 18.0, 0.0, 0.0], abs=1e-9)
    assert found.velocity == pytest.approx([0.0, 0.0, 2.0 * 0.5 / 18.0], abs=1e-9)
    about = dynamics.inertia([math.pi / 2], "Base:Origin")
    assert np.diag(about) == pytest.approx([18.0, 18.0, 18.0, 0.0, 0.5, 0.5], abs=1e-6)
    assert dynamics.potential_energy([math.pi]) == pytest.approx(9.80665)
    in_arm = dynamics.center_of_mass([math.pi / 2], frame="Arm:Pivot")
    assert in_arm.position == pytest.approx([0.0, 0.0, -1.0 / 18.0], abs=1e-9)


def test_given_other_mass_of_a_body_then_its_inertia_changes_in_proportion():
    model = random_model(random.Random(5), 4)
    before = model.dynamics("fixed")
    after = model.dynamics("fixed", masses={body.name: 2.0 * body.mass for body in model.bodies})
    q = before.default_position
    assert after.mass_matrix(q) == pytest.approx(2.0 * before.mass_matrix(q))
    with pytest.raises(MalformedRequestError, match="must be positive"):
        model.dynamics(masses={"B1": 0.0})


def draw_errors(count: int, size: int) -> list[list[float]]:
    """Return standard normal errors (2 count, size) whose sample mean is 0 and whose sample covariance is exactly I."""
    draws, _ = np.linalg.qr(np.random.default_rng(4).normal(size=(count, size)))
    return [*(math.sqrt(count) * draws).tolist(), *(-math.sqrt(count) * draws).tolist()]


def with_errors(model: Model, errors: Iterator[float], relative: float) -> Dynamics:
    """Return the dynamics of a model with errors in its surveys and masses."""

    def perturb(pose: Pose, sigma: Sigma | None) -> Pose:
        if sigma is None:
            return pose
        # dp and dtheta along the axes of the parent
        error = np.array([next(errors) for _ in range(6)]) * (*sigma.position, *sigma.rotation)
        return Pose(pose.position + error[:3], so3.multiply(so3.exponential(so3.to_vector3(error[3:])), pose.wxyz))

    bodies = tuple(
        replace(body, frames=tuple(replace(each, pose=perturb(each.pose, each.sigma)) for each in body))
        for body in model.bodies
    )
    constraints = tuple(replace(each, pose=perturb(each.pose, each.sigma)) for each in model.constraints)
    changed = Model(bodies, constraints)
    masses = {body.name: body.mass * (1 + relative * next(errors)) for body in model.bodies}
    return changed.dynamics("fixed", masses=masses)


@pytest.mark.slow
def test_given_sigmas_then_covariance_of_the_center_is_that_of_samples():
    rng = random.Random(11)
    builder = ModelBuilder("tree")
    for body in range(5):
        draft = builder.add_body(f"B{body}", inertia=random_inertia(rng).matrix())
        for name in ("Base", "A", "B"):
            draft.add_frame(
                name, Pose([rng.uniform(-1, 1) for _ in range(3)]), sigma=Sigma((2e-3,) * 3, (1e-3, 2e-3, 3e-3))
            )
    kinds = [JointType.REVOLUTE, JointType.SPHERICAL, JointType.REVOLUTE, JointType.PLANAR]
    ends = [("B0:A", "B1:Base"), ("B1:A", "B2:A"), ("B3:A", "B1:A"), ("B3:B", "B4:A")]
    for number, (kind, (start, end)) in enumerate(zip(kinds, ends, strict=True)):
        mimic = Mimic("C0", -1.5, 0.2) if number == 2 else None
        joint = Joint(kind, (0.3, 0.2, 0.9), mimic=mimic)
        builder.add_constraint(
            f"C{number}", start, end, Pose((0.1, 0.2, 0.3)), sigma=Sigma((1e-3,) * 3, (2e-3,) * 3), joint=joint
        )
    model = builder.build()
    dynamics = model.dynamics("fixed", uncertainty=MassUncertainty(mass=0.02))
    n = len(dynamics.coordinates)
    q = np.random.default_rng(2).uniform(-1, 1, n)
    sigma = np.full(n, 3e-3)
    frames = ("B0:Base", "B4:Base")
    num_poses = sum(len(list(body)) for body in model.bodies) + len(model.constraints)
    centers: dict[str, list[so3.Array]] = {frame: [] for frame in frames}
    for row in draw_errors(150, n + 6 * num_poses + len(model.bodies)):
        errors = iter(row)
        at = q + sigma * [next(errors) for _ in range(n)]
        sampled = with_errors(model, errors, 0.02)
        assert next(errors, None) is None
        for frame in frames:
            centers[frame].append(sampled.center_of_mass(at, frame=frame).position)
    for frame in frames:
        P = dynamics.center_of_mass(q, frame=frame, sigma=sigma).covariance
        assert P is not None
        assert np.cov(np.array(centers[frame]).T) == pytest.approx(P, abs=0.03 * np.trace(P) / 3), frame


def test_given_survey_of_the_frame_itself_then_it_counts_unless_it_is_exact():
    builder = ModelBuilder("box")
    box = builder.add_body("Box", inertia=point(10.0, 1.0, 0, 0).matrix())
    box.add_frame("Origin").add_frame("Corner", Pose((0, 0, 1.0)), sigma=Sigma((0.01, 0.02, 0.03), (0.1, 0, 0)))
    dynamics = builder.build().dynamics("fixed")
    P = dynamics.center_of_mass([], frame="Box:Corner", sigma=[]).covariance
    # the center is 1 m ahead and 1 m below: a roll of 0.1 rad moves it by 0.1 m to the side
    assert P is not None
    assert np.diag(P) == pytest.approx([0.01**2, 0.02**2 + 0.1**2, 0.03**2])
    assert dynamics.center_covariance([], [], "Box:Corner", is_frame_exact=True) == pytest.approx(np.zeros((3, 3)))


def test_given_missing_sigma_then_the_covariance_is_not_known():
    model = pendulum().build()
    dynamics = model.dynamics("fixed")
    assert dynamics.center_of_mass([0.1], sigma=[math.nan]).covariance is None
    assert dynamics.center_of_mass([0.1]).covariance is None
    P = dynamics.center_of_mass([0.0], sigma=[0.01]).covariance
    assert P is not None
    assert np.sqrt(np.diag(P)) == pytest.approx([0.01 * 0.5 * 2.0 / 12.0, 0.0, 0.0], abs=1e-12)
    builder = pendulum()
    builder.add_body("Box", inertia=point(1.0, 0, 0, 0).matrix()).add_frame("Origin")
    builder.add_constraint("BoxFixed", "Base:Origin", "Box:Origin", Pose((1.0, 0, 0)))
    model = builder.build()
    assert model.dynamics("fixed").center_of_mass([0.0], sigma=[0.01]).covariance is None
    exact = model.dynamics("fixed", uncertainty=MassUncertainty(unstated_is_exact=True, center=0.1))
    assert exact.center_of_mass([0.0], sigma=[0.0]).covariance == pytest.approx(np.eye(3) * 0.01 * 105 / 169)


def test_given_body_without_mass_then_the_error_names_it_or_it_counts_as_massless():
    builder = pendulum()
    builder.add_body("Camera").add_frame("Lens")
    builder.add_constraint("CameraFixed", "Arm:Pivot", "Camera:Lens", Pose((0.1, 0, 0)))
    model = builder.build()
    with pytest.raises(MalformedRequestError, match="no mass is stated for Camera"):
        model.dynamics()
    dynamics = model.dynamics("fixed", allow_massless=True)
    assert dynamics.massless == ("Camera",)
    assert model.dynamics(payload={"Camera:Lens": 0.5}).mass == pytest.approx(12.5)
    assert dynamics.mass_matrix([0.2]) == pytest.approx(pendulum().build().dynamics("fixed").mass_matrix([0.2]))


def test_given_coordinate_that_moves_no_mass_then_forward_names_it():
    builder = pendulum()
    builder.add_body("Vane").add_frame("Axle")
    builder.add_constraint("Spin", "Arm:Pivot", "Vane:Axle", joint=Joint(JointType.REVOLUTE))
    dynamics = builder.build().dynamics("fixed", allow_massless=True)
    with pytest.raises(MalformedRequestError, match="singular: Spin moves no mass"):
        dynamics.forward([0.1, 0.2], [0.0, 0.0], [0.0, 0.0])


def test_given_loop_then_the_error_names_its_constraint_or_it_is_cut():
    builder = pendulum()
    builder.add_body("Rod", inertia=point(1.0, 0, 0, 0.1).matrix()).add_frame("End")
    builder.add_constraint("RodPin", "Arm:Pivot", "Rod:End", joint=Joint(JointType.REVOLUTE, (0, 1, 0)))
    builder.add_constraint("RodSlide", "Base:Origin", "Rod:End", joint=Joint(JointType.PRISMATIC))
    model = builder.build()
    with pytest.raises(MalformedRequestError, match="closed loop is not computed, and RodPin closes one"):
        model.dynamics()
    dynamics = model.dynamics("fixed", cut_loops=True)
    assert dynamics.cut == ("RodPin",)
    assert dynamics.coordinates == ("Hinge", "RodSlide")


def test_given_rigid_loop_then_it_changes_nothing():
    builder = pendulum()
    builder.add_body("Box", inertia=point(1.0, 0, 0, 0).matrix()).add_frame("Origin")
    builder.add_constraint("BoxFixed", "Base:Origin", "Box:Origin")
    builder.add_constraint("BoxSurveyed", "Base:Origin", "Box:Origin")
    assert builder.build().dynamics().cut == ()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"base": "bolted"}, "the base is 'bolted'"),
        ({"gravity": math.nan}, "gravity is nan"),
        ({"payload": {"Arm:Pivot": -1.0}}, "must be positive"),
    ],
)
def test_given_impossible_options_then_the_error_states_what_is_expected(options, message):
    with pytest.raises(MalformedRequestError, match=message):
        pendulum().build().dynamics(**options)


def test_given_unknown_names_then_the_nearest_is_suggested():
    dynamics = pendulum().build().dynamics("fixed")
    with pytest.raises(MalformedRequestError, match="Hunge") as error:
        dynamics.mass_matrix({"Hunge": 0.0})
    assert error.value.nearest == ("Hinge",)
    with pytest.raises(MalformedRequestError, match=r"q has shape \(2,\); expected \(1,\)"):
        dynamics.mass_matrix([0.0, 0.0])
    with pytest.raises(UnknownFrameError):
        dynamics.frame_pose([0.0], "Arm:Tip")


def test_given_orphan_then_it_takes_no_part():
    builder = pendulum()
    builder.add_body("Spare").add_frame("Origin")
    dynamics = builder.build().dynamics("fixed")
    assert dynamics.mass == pytest.approx(12.0)
    with pytest.raises(MalformedRequestError, match="not joined to Base:Origin"):
        dynamics.jacobian([0.0], "Spare:Origin")


def test_given_nothing_that_moves_then_there_are_no_coordinates():
    builder = ModelBuilder("rigid")
    builder.add_body("Base", inertia=point(10.0, 0, 0, 1).matrix()).add_frame("Origin")
    builder.add_body("Box", inertia=point(10.0, 0, 0, 0).matrix()).add_frame("Origin")
    builder.add_constraint("BoxFixed", "Base:Origin", "Box:Origin", Pose((1.0, 0, 0)))
    dynamics = builder.build().dynamics("fixed")
    assert dynamics.mass_matrix([]).shape == (0, 0)
    assert dynamics.forward([], [], []).shape == dynamics.bias([], []).shape == dynamics.gravity([]).shape == (0,)
    assert dynamics.center_of_mass([], []).position == pytest.approx([0.5, 0.0, 0.5])
    assert dynamics.inertia([])[0, 0] == pytest.approx(20.0)
    assert dynamics.jacobian([], "Box:Origin").shape == (6, 0)


def test_given_too_many_joints_then_the_limit_is_named():
    model = random_model(random.Random(1), 202, (JointType.PRISMATIC,), mimics=False)
    with pytest.raises(LimitError, match="have 201 velocities; dynamics takes 200 at most"):
        model.dynamics("fixed")


def test_given_many_bodies_then_the_covariance_comes_in_steps():
    dynamics = random_model(random.Random(1), 60, (JointType.REVOLUTE,)).dynamics(
        uncertainty=MassUncertainty(unstated_is_exact=True)
    )
    q, sigma = dynamics.default_position, np.full(len(dynamics.coordinates), 0.01)
    found = []

    def work():
        found.append((yield from dynamics.iterate_center_covariance(q, sigma, "B1:Base")))

    assert sum(1 for _ in work()) > 10
    assert found[0] == pytest.approx(dynamics.center_covariance(q, sigma, "B1:Base"))


@pytest.mark.slow
def test_given_import_of_the_package_then_pinocchio_is_not_loaded():
    code = "import sys, modelserver.dynamics, modelserver.server.daemon; print('pinocchio' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"


def test_dynamics_of_a_model_is_that_class():
    assert isinstance(pendulum().build().dynamics(), Dynamics)
