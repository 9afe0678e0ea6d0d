"""Motion of a frame in another: velocity and acceleration, from the joints' rates and the vehicle's own motion.

The rigid motion of each edge is composed along the path (`transforms.pose`). A joint moves by J q' and
J q'' + J' q', with its Jacobian J differenced along q'. The vehicle's acceleration is measured at the inertial unit and
transferred by the lever arm: a + dw x r + w x (w x r). The covariance of the velocities is first order in the chain.
Accelerations are linear in those of the vehicle, which gives their covariance; that of a measured joint is not known.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from modelserver.errors import NoPoseError
from modelserver.geometry.joint import Joint
from modelserver.geometry.topology import EdgeKind
from modelserver.joints.track import Provenance
from modelserver.messages import NAN, Estimate, MotionAnswer, Policy, TimeQuery
from modelserver.query.path import PathStep, lookup_path
from modelserver.query.view import PlatformView
from modelserver.transforms import chain, so3
from modelserver.transforms.chain import ChainLink
from modelserver.transforms.pose import UNKNOWN, ZERO, Pose, RigidMotion
from modelserver.transforms.so3 import Array, add, cross, to_vector3

_STEP = 1e-4
"""Seconds over which the Jacobian of a joint is differenced."""


def compute_motion(
    view: PlatformView, interest: str, reference: str, expressed_in: str, time: TimeQuery, now: int = 0
) -> MotionAnswer:
    """Return the velocity and acceleration of `interest` relative to `reference`, as observed in `reference`.

    Vectors are along the axes of `expressed_in`, empty for the frame of reference. Raises QueryError as
    `PlatformView.transformation`; NoPoseError where the vehicle's velocity is unknown.
    """
    answer = view.transformation(interest, reference, time, now)
    path = lookup_path(view, interest, reference, time, now)
    motions: list[RigidMotion] = []
    uncertain: list[ChainLink] = []
    for step in path.steps:
        each, factor = _step_motion(view, step)
        motions.append(each)
        # the vehicle has one motion, in whichever world it is expressed
        source = step.source if step.estimate is None else (EdgeKind.VEHICLE,)
        uncertain.append(ChainLink(step.X_FT, step.edge.forward, factor, source))
    moved = _compose(path.steps, motions)
    second = _get_acceleration_covariance(view, path.steps, motions)
    R = so3.IDENTITY
    axes = expressed_in or reference
    if axes != reference:
        has_time = bool(time.at) and time.policy is not Policy.LATEST
        at = TimeQuery(path.utime, time.policy if has_time else Policy.PREDICTED)
        turned = view.transformation(reference, axes, at, now)
        R = turned.transformation.pose.wxyz
        # an invalid rotation makes the vectors invalid
        answer = answer._replace(
            transformation=answer.transformation.with_invalid_reasons(turned.transformation.invalid_reasons),
            quality=answer.quality | turned.quality,
        )
    covariance = chain.covariance(uncertain)
    if covariance is not None and axes != reference:
        turn = np.kron(np.eye(2), np.array(so3.matrix_rows(R)))
        covariance = turn @ covariance @ turn.T
    if second is not None and axes != reference:
        turn = np.kron(np.eye(2), np.array(so3.matrix_rows(R)))
        second = turn @ second @ turn.T
    return MotionAnswer(
        answer,
        axes,
        so3.rotate(R, moved.velocity),
        so3.rotate(R, moved.angular_velocity),
        so3.rotate(R, moved.acceleration),
        so3.rotate(R, moved.angular_acceleration),
        None if covariance is None else tuple(covariance.ravel().tolist()),
        None if second is None else tuple(second.ravel().tolist()),
    )


def _compose(steps: Sequence[PathStep], motions: list[RigidMotion]) -> RigidMotion:
    moved = RigidMotion(Pose.identity())
    for step, each in zip(steps, motions, strict=True):
        moved = moved.compose(each if step.edge.forward else each.inverse())
    return moved


def _get_acceleration_covariance(
    view: PlatformView, steps: Sequence[PathStep], motions: list[RigidMotion]
) -> Array | None:
    """Return the covariance (6, 6) of the accelerations along a path; None where it is not known."""
    if any(reading.provenance is not Provenance.DEFAULT for step in steps for reading in step.readings):
        return None
    at = [n for n, step in enumerate(steps) if step.estimate is not None]
    if not at:
        return np.zeros((6, 6))
    if len(at) > 1:
        return None
    (n,) = at
    estimate = steps[n].estimate
    assert estimate is not None
    own = _get_vehicle_covariance(view, steps[n].X_FT, estimate)
    if own is None:
        return None
    columns = []
    for axis in np.eye(6):
        each = motions[n]._replace(acceleration=to_vector3(axis[:3]), angular_acceleration=to_vector3(axis[3:]))
        columns.append(_compose(steps, [*motions[:n], each, *motions[n + 1 :]]))
    none = motions[n]._replace(acceleration=ZERO, angular_acceleration=ZERO)
    rest = _compose(steps, [*motions[:n], none, *motions[n + 1 :]])
    J = np.array([(*each.acceleration, *each.angular_acceleration) for each in columns])
    J -= np.array((*rest.acceleration, *rest.angular_acceleration))
    return np.asarray(J.T @ own @ J)


def _get_vehicle_covariance(view: PlatformView, X_WB: Pose, estimate: Estimate) -> Array | None:
    """Return the covariance of the vehicle's own accelerations along the world's axes; None where it is not known."""
    own, turning = estimate.motion, view.history.angular_acceleration(estimate.utime)
    if own is None or turning is None or math.isnan(own.acceleration_sigma + turning[1]):
        return None
    # a = a_imu + dw x r: an error of dw moves it by -[r]x
    arm = np.array(so3.skew((-own.imu_position[0], -own.imu_position[1], -own.imu_position[2])))
    J = np.block([[np.eye(3), -arm], [np.zeros((3, 3)), np.eye(3)]])
    C = np.diag([own.acceleration_sigma**2] * 3 + [turning[1]] * 3)
    turn = np.kron(np.eye(2), np.array(so3.matrix_rows(X_WB.wxyz))) @ J
    return np.asarray(turn @ C @ turn.T)


def _step_motion(view: PlatformView, step: PathStep) -> tuple[RigidMotion, Array | None]:
    """Return the motion of a step's far end in its near end, and the factor of that velocity's covariance."""
    if step.estimate is not None:
        return _vehicle_motion(view, step.X_FT, step.estimate)
    if step.edge.joint is None:
        return RigidMotion(step.X_FT), _EXACT
    return _joint_motion(view, step, step.edge.joint)


def _joint_motion(view: PlatformView, step: PathStep, joint: Joint) -> tuple[RigidMotion, Array | None]:
    drive = view.model.drives[step.edge.name]
    position, rates, changes, sigmas = [], [], [], []
    for name, reading in zip(drive.names, step.readings, strict=True):
        track = view.joints.tracks.get(name)
        rate, change = reading.rate, NAN
        if reading.provenance is Provenance.DEFAULT:
            rate = change = 0.0
        elif track is not None:
            # the track is that of the leader
            read = reading._replace(rate=reading.rate / drive.multiplier if drive.multiplier else 0.0)
            rate, change = track.estimate_derivatives(read)
            rate, change = rate * drive.multiplier, change * drive.multiplier
        position.append(reading.position)
        rates.append(rate)
        changes.append(change)
        # a joint and its followers have common errors
        sigmas.append(reading.rate_sigma)
    J = joint.jacobian(position)
    qd = np.array(rates)
    twist = _multiply_known(J, qd)
    after = joint.jacobian([q + _STEP * r for q, r in zip(position, rates, strict=True)])
    before = joint.jacobian([q - _STEP * r for q, r in zip(position, rates, strict=True)])
    second = _multiply_known(J, np.array(changes)) + _multiply_known((after - before) / (2.0 * _STEP), qd)
    factor = None if any(map(np.isnan, sigmas)) else J * np.array(sigmas)
    moved = RigidMotion(
        step.X_FT, to_vector3(twist[:3]), to_vector3(twist[3:]), to_vector3(second[:3]), to_vector3(second[3:])
    )
    return moved, factor


def _multiply_known(J: Array, rates: Array) -> Array:
    """Return J @ rates, where an unknown rate affects only what it moves."""
    return np.asarray(np.where(J == 0.0, 0.0, J * rates).sum(axis=1))


def _vehicle_motion(view: PlatformView, X_WB: Pose, estimate: Estimate) -> tuple[RigidMotion, Array | None]:
    own = estimate.motion
    if own is None:
        raise NoPoseError(
            "the vehicle's velocity is not known: localization has none for this time"
            + (f" ({estimate.invalid.explain()})" if estimate.invalid else "")
        )
    q = X_WB.wxyz
    turning = view.history.angular_acceleration(estimate.utime)
    w = own.angular_velocity
    acceleration, change = UNKNOWN, UNKNOWN if turning is None else turning[0]
    if turning is not None:
        x, y, z = own.imu_position
        arm = (-x, -y, -z)
        acceleration = add(own.acceleration, cross(change, arm), cross(w, cross(w, arm)))
    factor = None
    if own.covariance is not None:
        turn = np.kron(np.eye(2), np.array(so3.matrix_rows(q)))
        factor = turn @ chain.factor(np.array(own.covariance()).reshape(6, 6))
    return RigidMotion(
        X_WB, so3.rotate(q, own.velocity), so3.rotate(q, w), so3.rotate(q, acceleration), so3.rotate(q, change)
    ), factor


_EXACT = np.zeros((6, 1))
