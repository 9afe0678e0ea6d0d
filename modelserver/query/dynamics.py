"""Dynamics of the vehicle at a time: mass, center of mass, inertia, equations of motion, tip-over stability.

The joints are where their readings put them, and move at their rates; their accelerations are taken as 0. A floating
base is the base frame in World:ENU, with the position and rotation vector of its pose, and rates from its motion:

    x' = v,   phi' = J_l(phi)^-1 w,   x'' = a,   phi'' = J_l^-1 (w' - J_l' phi')

What is not known is nan, and so is what follows from it. The `Dynamics` of a geometry are made once (`prepare`).
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np

from modelserver import messages
from modelserver.dynamics import Dynamics, MassUncertainty, Stability, assess_stability
from modelserver.dynamics.stability import DynamicsSettings
from modelserver.errors import ForbiddenError, LimitError, ModelServerError, NoPoseError
from modelserver.geometry import names
from modelserver.geometry.kinematic_path import KinematicPath
from modelserver.geometry.model import Model
from modelserver.geometry.topology import Edge, EdgeKind
from modelserver.query.path import compute_motion
from modelserver.query.view import JointReadings, PlatformView, Steps
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose, compute_turn_motion, compute_turn_rate
from modelserver.transforms.so3 import Array

MAX_COORDINATES: Final = 100
"""In one answer: its mass matrix takes 40 kB."""

MAX_BODIES_WITH_SIGMA: Final = 50
"""Bodies with which health reports have the sigma of the margin: it takes some 25 us for each, ten times a second."""

BASE_COORDINATES: Final = 6


class VehicleDynamics(NamedTuple):
    """The dynamics of a geometry on a floating base, with the path of all joints that take part.

    With the base at rest, its rows and columns of the joints are those of a fixed and level base.
    """

    dynamics: Dynamics
    joints: KinematicPath


class MotionState(NamedTuple):
    """Coordinates, rates, accelerations and sigmas (n,) at an instant; `motion` is that of a floating base."""

    utime: int
    q: Array
    v: Array
    a: Array
    sigma: Array
    invalid: messages.Invalid
    motion: messages.MotionAnswer | None = None


@lru_cache(maxsize=4)
def prepare(model: Model, base_frame: str, settings: DynamicsSettings) -> VehicleDynamics:
    """Return the dynamics of a geometry, made once. Raises as `Dynamics`."""
    dynamics = Dynamics(
        model,
        "floating",
        base_frame,
        allow_massless=settings.allow_massless,
        cut_loops=settings.cut_loops,
        uncertainty=MassUncertainty(settings.mass_sigma, settings.center_sigma, unstated_is_exact=True),
    )
    # the first joint is the base
    joints = dynamics.tree.joints[1:]
    edges = [Edge(EdgeKind.JOINT, each.name, True, Pose.identity(), joint=each.joint) for each in joints]
    return VehicleDynamics(dynamics, KinematicPath.from_edges(edges))


def check_dynamics(model: Model, base_frame: str, settings: DynamicsSettings) -> None:
    """Compute the dynamics of a geometry once. Raises as `Dynamics` and `assess_stability`."""
    dynamics = prepare(model, base_frame, settings).dynamics
    dynamics.center_of_mass(dynamics.default_position)
    if settings.contacts:
        assess_stability(dynamics, dynamics.default_position, settings.contacts)


def compute_dynamics(view: PlatformView, request: messages.GetDynamics, now: int) -> Steps[messages.DynamicsAnswer]:
    """Return in steps the dynamics at a time. Raises a QueryError for each cause."""
    if view.dynamics is None:
        raise ForbiddenError(
            "the dynamics is not configured; write a section dynamics in the vehicle file, e.g. dynamics: {}, and "
            "restart the service"
        )
    known = prepare(view.model, view.base_frame, view.dynamics)
    yield
    dynamics = known.dynamics
    shown = slice(0 if request.is_floating else BASE_COORDINATES, None)
    n = len(dynamics.coordinates[shown])
    if request.with_equations and n > MAX_COORDINATES:
        raise LimitError(f"the equations have {n} coordinates; at most {MAX_COORDINATES} are sent in one reply")
    state = _lookup_floating(view, known, request.time, now) if request.is_floating else None
    state = state or _lookup_fixed(view, known, request.time, now)
    yield
    frame = request.frame or view.base_frame
    center = dynamics.center_of_mass(state.q, frame=frame)
    P = yield from dynamics.iterate_center_covariance(state.q, state.sigma, frame)
    inertia = dynamics.inertia(state.q, frame)
    equations: tuple[tuple[float, ...], ...] = ((),) * 5
    coordinates: tuple[str, ...] = ()
    if request.with_equations:
        coordinates = dynamics.coordinates[shown]
        vectors = (state.q, state.v, dynamics.gravity(state.q), dynamics.bias(state.q, state.v))
        D = dynamics.mass_matrix(state.q)[shown, shown]
        equations = (*(tuple(each[shown].tolist()) for each in vectors), tuple(D.ravel().tolist()))
    position, rate, gravity_row, bias_row, mass_matrix = equations
    covariance = None if P is None or not np.isfinite(P).all() else tuple(P.ravel().tolist())
    return messages.DynamicsAnswer(
        state.utime,
        state.invalid,
        frame,
        center.mass,
        so3.to_vector3(center.position.tolist()),
        tuple(inertia.ravel().tolist()),
        coordinates,
        position,
        rate,
        gravity_row,
        bias_row,
        mass_matrix,
        covariance,  # type: ignore[arg-type]  # nine numbers
    )


def compute_stability(view: PlatformView, now: int) -> messages.StabilityHealth:
    """Return the tip-over stability now; without a localizer as on level ground. Raises QueryError for each cause."""
    settings = view.dynamics
    if settings is None or not settings.contacts:
        return messages.StabilityHealth()
    known = prepare(view.model, view.base_frame, settings)
    latest = messages.TimeQuery()
    tilt = acceleration = None
    if view.localizer is None:
        state = _lookup_fixed(view, known, latest, now)
    else:
        P = None
        try:
            state = _lookup_floating(view, known, latest, now)
            if state.motion is not None:
                P = state.motion.pose.transformation.covariance
        except NoPoseError:
            # Odom is level too, and needs no fix; how level, it does not state
            state = _lookup_floating(view, known, latest, now, names.ODOM)
        tilt = np.full((3, 3), math.nan) if P is None else P[3:, 3:]
        second = None if state.motion is None else state.motion.acceleration_covariance
        acceleration = np.full((3, 3), math.nan) if second is None else np.array(second).reshape(6, 6)[:3, :3]
    moves = bool(np.isfinite(state.v).all() and np.isfinite(state.a).all()) and view.localizer is not None
    found: Stability = assess_stability(
        known.dynamics,
        state.q,
        settings.contacts,
        state.v if moves else None,
        state.a if moves else None,
        sigma=state.sigma if len(known.dynamics.tree.links) <= MAX_BODIES_WITH_SIGMA else None,
        tilt_covariance=tilt,
        acceleration_covariance=acceleration,
    )
    static, moving = found.static, found.dynamic
    return messages.StabilityHealth(
        static.margin,
        static.sigma,
        math.nan if moving is None else moving.margin,
        math.nan if moving is None else moving.sigma,
        settings.margin_limit,
        settings.contacts,
        tuple((moving or static).loads.values()),
    )


def find_stability(view: PlatformView, now: int) -> tuple[messages.StabilityHealth, str]:
    """Return the tip-over stability now, and the warning about it; empty for none. An error becomes the warning."""
    try:
        found = compute_stability(view, now)
    except NoPoseError:
        # the report has the reason already
        return messages.StabilityHealth(), ""
    except ModelServerError as error:
        return messages.StabilityHealth(), f"the tip-over margin is not known: {error}"
    except Exception as error:
        # a fault of the engine must not stop the ticks
        return messages.StabilityHealth(), f"the tip-over margin cannot be computed: {type(error).__name__}: {error}"
    for name, margin in (("static", found.margin), ("dynamic", found.dynamic_margin)):
        if margin < found.limit:
            text = "the vehicle tips" if margin < 0.0 else "it is close to tipping"
            degrees, limit = math.degrees(margin), math.degrees(found.limit)
            return found, f"{name} tip-over margin {degrees:.1f} deg, below the limit of {limit:.1f} deg: {text}"
    return found, ""


def _lookup_fixed(view: PlatformView, known: VehicleDynamics, time: messages.TimeQuery, now: int) -> MotionState:
    utime, joints = view.lookup_joints(known.joints, time, now)
    return _collect(view, known, utime, joints)


def _lookup_floating(
    view: PlatformView, known: VehicleDynamics, time: messages.TimeQuery, now: int, world: str = names.WORLD_ENU
) -> MotionState:
    estimate, joints = view.lookup_vehicle_and_joints(known.joints, time, now)
    has_time = bool(time.at) and time.policy is not messages.Policy.LATEST
    at = messages.TimeQuery(estimate.utime, time.policy if has_time else messages.Policy.PREDICTED)
    motion = compute_motion(view, view.base_frame, world, "", at, now)
    state = _collect(view, known, estimate.utime, joints)
    X = motion.pose.transformation.pose
    phi = so3.logarithm(X.wxyz)
    rate = compute_turn_rate(phi, motion.angular_velocity)
    _, bias = compute_turn_motion(phi, rate)
    change = so3.add(motion.angular_acceleration, so3.scale(-1.0, bias))
    state.q[:6] = (*X.xyz, *phi)
    state.v[:6] = (*motion.velocity, *rate)
    state.a[:6] = (*motion.acceleration, *compute_turn_rate(phi, change))
    invalid = state.invalid | messages.Invalid(motion.pose.transformation.invalid_reasons) | estimate.invalid
    return state._replace(invalid=invalid, motion=motion)


def _collect(view: PlatformView, known: VehicleDynamics, utime: int, joints: JointReadings) -> MotionState:
    """Return the coordinates of the joints; those of the base are 0, and exact."""
    dynamics = known.dynamics
    q = dynamics.default_position
    v, a, sigma = np.zeros(len(q)), np.zeros(len(q)), np.zeros(len(q))
    column = {name: number for number, name in enumerate(dynamics.coordinates)}
    for item, readings in zip(known.joints.joints, joints.readings, strict=True):
        drive = view.model.drives[item.name]
        if drive.leader == item.name:
            for name, reading in zip(drive.names, readings, strict=True):
                at = column[name]
                q[at], v[at], sigma[at] = reading.position, reading.rate, reading.sigma
    return MotionState(utime, q, v, a, sigma, joints.invalid | (view.invalid & messages.Invalid.CLOCK_STEPPED))
