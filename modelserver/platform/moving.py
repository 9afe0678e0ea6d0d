"""How a frame moves in another: velocity and acceleration, from joints' rates and the vehicle's own motion."""

from __future__ import annotations

import numpy as np

from modelserver.errors import NoPoseError
from modelserver.geometry.edges import EdgeKind
from modelserver.geometry.joint import Joint
from modelserver.joints.joints import How
from modelserver.messages import NAN, Estimate, MotionAnswer, Policy, TimeQuery
from modelserver.platform.path import PathStep, way
from modelserver.platform.view import PlatformView
from modelserver.spatial import chain, so3
from modelserver.spatial.chain import ChainLink
from modelserver.spatial.kinematics import UNKNOWN, RigidMotion
from modelserver.spatial.pose import Pose
from modelserver.spatial.so3 import Array, Vector3, cross

_STEP = 1e-4
"""Seconds over which the Jacobian of a joint is differenced."""


def motion(
    view: PlatformView, interest: str, reference: str, expressed_in: str, time: TimeQuery, now: int = 0
) -> MotionAnswer:
    """Return how `interest` moves relative to `reference`, as seen by one who rides on it, along other axes.

    Vectors are along the axes of `expressed_in`, empty for the frame of reference. Raises QueryError as
    `PlatformView.transformation`; NoPoseError where the vehicle's velocity is not known.
    """
    answer = view.transformation(interest, reference, time, now)
    path = way(view, interest, reference, time, now)
    moved = RigidMotion(Pose.identity())
    uncertain: list[ChainLink] = []
    for step in path.steps:
        each, factor = _moved(view, step)
        moved = moved.then(each if step.edge.forward else each.inverse())
        # the vehicle has one motion, whichever world it is told in
        source = step.source if step.estimate is None else (EdgeKind.VEHICLE,)
        uncertain.append(ChainLink(step.X_FT, step.edge.forward, factor, source))
    R = so3.IDENTITY
    axes = expressed_in or reference
    if axes != reference:
        asked = bool(time.at) and time.policy is not Policy.LATEST
        at = TimeQuery(path.utime, time.policy if asked else Policy.PREDICTED)
        turned = view.transformation(reference, axes, at, now)
        R = turned.transformation.pose.wxyz
        # vectors along axes that are guessed are a guess
        answer = answer._replace(
            transformation=answer.transformation.doubted(turned.transformation.invalid_reasons),
            quality=answer.quality | turned.quality,
        )
    covariance = chain.covariance(uncertain)
    if covariance is not None and axes != reference:
        turn = np.kron(np.eye(2), np.array(so3.matrix_rows(R)))
        covariance = turn @ covariance @ turn.T
    return MotionAnswer(
        answer,
        axes,
        so3.rotate(R, moved.velocity),
        so3.rotate(R, moved.rate),
        so3.rotate(R, moved.acceleration),
        so3.rotate(R, moved.turn_acceleration),
        None if covariance is None else tuple(covariance.ravel().tolist()),
    )


def _moved(view: PlatformView, step: PathStep) -> tuple[RigidMotion, Array | None]:
    """Return how a step's far end moves in its near one, and the factor of that velocity's covariance."""
    if step.estimate is not None:
        return _vehicle(view, step.X_FT, step.estimate)
    if step.edge.joint is None:
        return RigidMotion(step.X_FT), _STILL
    return _joint(view, step, step.edge.joint)


def _joint(view: PlatformView, step: PathStep, joint: Joint) -> tuple[RigidMotion, Array | None]:
    drive = view.model.drives[step.edge.name]
    position, rates, changes, sigmas = [], [], [], []
    for name, reading in zip(drive.names, step.readings, strict=True):
        track = view.joints.tracks.get(name)
        rate, change = reading.rate, NAN
        if reading.how is How.AT_REST:
            rate = change = 0.0
        elif track is not None:
            # of the joint itself, in the numbers of the one that it follows
            read = reading._replace(rate=reading.rate / drive.multiplier if drive.multiplier else 0.0)
            rate, change = track.changes(read)
            rate, change = rate * drive.multiplier, change * drive.multiplier
        position.append(reading.position)
        rates.append(rate)
        changes.append(change)
        # a joint and one that follows it share their errors
        sigmas.append(reading.rate_sigma)
    J = joint.jacobian(position)
    qd = np.array(rates)
    twist = _times(J, qd)
    ahead = joint.jacobian([q + _STEP * r for q, r in zip(position, rates, strict=True)])
    behind = joint.jacobian([q - _STEP * r for q, r in zip(position, rates, strict=True)])
    second = _times(J, np.array(changes)) + _times((ahead - behind) / (2.0 * _STEP), qd)
    factor = None if any(map(np.isnan, sigmas)) else J * np.array(sigmas)
    moved = RigidMotion(step.X_FT, _vector(twist[:3]), _vector(twist[3:]), _vector(second[:3]), _vector(second[3:]))
    return moved, factor


def _times(J: Array, rates: Array) -> Array:
    """Return J @ rates, where a rate that nobody knows spoils only what it moves."""
    return np.asarray(np.where(J == 0.0, 0.0, J * rates).sum(axis=1))


def _vehicle(view: PlatformView, X_WB: Pose, estimate: Estimate) -> tuple[RigidMotion, Array | None]:
    own = estimate.motion
    if own is None:
        raise NoPoseError(
            "the vehicle's velocity is not known: localization has told none for this time"
            + (f" ({estimate.invalid.explain()})" if estimate.invalid else "")
        )
    q = X_WB.wxyz
    turning = view.history.turn_acceleration(estimate.utime)
    w = own.rate
    acceleration, change = UNKNOWN, UNKNOWN if turning is None else turning
    if turning is not None:
        x, y, z = own.felt_at
        arm = (-x, -y, -z)
        acceleration = _plus(own.acceleration, _plus(cross(turning, arm), cross(w, cross(w, arm))))
    factor = None
    if own.covariance is not None:
        turn = np.kron(np.eye(2), np.array(so3.matrix_rows(q)))
        factor = turn @ chain.factor(np.array(own.covariance()).reshape(6, 6))
    return RigidMotion(
        X_WB, so3.rotate(q, own.velocity), so3.rotate(q, w), so3.rotate(q, acceleration), so3.rotate(q, change)
    ), factor


def _plus(a: Vector3, b: Vector3) -> Vector3:
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


def _vector(values: Array) -> Vector3:
    x, y, z = values.tolist()
    return (x, y, z)


_STILL = np.zeros((6, 1))
