"""The path between two frames at one time, edge by edge: the data, the motion and the share of uncertainty of each.

Motion: the rigid motion of each edge is composed along the path (`transforms.pose`). A joint moves by J q' and
J q'' + J' q', with its Jacobian J differenced along q'. The vehicle's acceleration is measured at the inertial unit and
transferred by the lever arm: a + dw x r + w x (w x r). The covariance of the velocities is first order in the chain.
Accelerations are linear in those of the vehicle, which gives their covariance; that of a measured joint is not known.

Explanation: the provenance of each edge's data, and its share of the covariance's trace.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from typing import NamedTuple

import numpy as np

from modelserver import messages
from modelserver.errors import NoPoseError
from modelserver.geometry import names
from modelserver.geometry.joint import Joint
from modelserver.geometry.kinematic_path import KinematicPath
from modelserver.geometry.topology import Edge, EdgeKind
from modelserver.joints import MAX_CLOCK_LEAD_S
from modelserver.joints.track import MAX_GAP_S, Provenance, Reading
from modelserver.query.view import (
    ODOM_INVALID,
    WORLD_FRAMES,
    JointReadings,
    PlatformView,
    check_not_reserved,
    get_vehicle_pose,
    is_absolute,
)
from modelserver.transforms import chain, so3
from modelserver.transforms.chain import ChainLink
from modelserver.transforms.pose import UNKNOWN, ZERO, Pose, RigidMotion
from modelserver.transforms.so3 import Array, add, cross, to_vector3


class PathStep(NamedTuple):
    """One edge of a path: its pose `X_FT` at a time, its covariance factor and the data used.

    `readings` are those of a joint's coordinates, `estimate` the vehicle's.
    """

    edge: Edge
    X_FT: Pose
    factor: Array | None
    source: tuple[Hashable, ...]
    readings: tuple[Reading, ...] = ()
    estimate: messages.Estimate | None = None

    @property
    def link(self) -> ChainLink:
        is_large_angle = self.edge.kind is EdgeKind.VEHICLE
        return ChainLink(self.X_FT, self.edge.forward, self.factor, self.source, is_large_angle)


class PathState(NamedTuple):
    """The steps from the frame of reference to the frame of interest at `utime`, with reasons and flags."""

    utime: int
    steps: tuple[PathStep, ...]
    invalid: messages.Invalid = messages.VALID
    quality: messages.Quality = messages.NO_FLAGS

    @property
    def links(self) -> list[ChainLink]:
        return [step.link for step in self.steps]


_PROVENANCE_OF_FLAG = (
    (messages.Quality.PREDICTED, Provenance.PREDICTED),
    (messages.Quality.HELD, Provenance.HELD),
    (messages.Quality.INTERPOLATED, Provenance.INTERPOLATED),
)


def find_provenance(view: PlatformView, step: PathStep) -> tuple[Provenance, int] | None:
    """Return the provenance of a step's data and the stamp of the newest of them, 0 for none; None for a fixed edge."""
    if (estimate := step.estimate) is not None:
        how = next((each for flag, each in _PROVENANCE_OF_FLAG if flag in estimate.quality), Provenance.MEASURED)
        following = view.history.next_after(estimate.utime) if how is Provenance.INTERPOLATED else None
        return how, (following or view.history.hold(estimate.utime)).utime
    if not step.readings:
        return None
    return max(each.provenance for each in step.readings), min(each.stamp for each in step.readings)


def lookup_path(view: PlatformView, interest: str, reference: str, time: messages.TimeQuery, now: int) -> PathState:
    """Return the path from one frame to another at a time. Raises QueryError as `PlatformView.transformation`."""
    of_world = [frame for frame in (interest, reference) if frame in WORLD_FRAMES]
    if not of_world:
        for frame in (interest, reference):
            check_not_reserved(frame)
        path = view.model.get_kinematic_path(interest, reference)
        utime, joints = view.lookup_joints(path, time, now)
        return _build_path_state(utime if path.joints else 0, _path_steps(path, joints, utime), path, joints)
    if interest == reference:
        return PathState(0, ())
    if len(of_world) == 2:
        estimate = view.estimate(time, now)
        # the correlation of the vehicle's two poses is unknown
        ends = [
            _vehicle_step(world, estimate, world == reference)._replace(factor=None) for world in (reference, interest)
        ]
        return PathState(estimate.utime, tuple(ends), estimate.invalid, estimate.quality)
    (world,) = of_world
    frame = interest if world == reference else reference
    path = view.get_path_from_vehicle(frame)
    estimate, joints = view.lookup_vehicle_and_joints(path, time, now)
    if world == reference:
        steps = [_vehicle_step(world, estimate, forward=True), *_path_steps(path, joints, estimate.utime)]
    else:
        # the same path, reversed
        back = [_reverse(step) for step in reversed(_path_steps(path, joints, estimate.utime))]
        steps = [*back, _vehicle_step(world, estimate, forward=False)]
    return _build_path_state(estimate.utime, steps, path, joints)


def _build_path_state(utime: int, steps: list[PathStep], path: KinematicPath, joints: JointReadings) -> PathState:
    invalid = joints.invalid
    quality = joints.quality | (messages.Quality.LOOP if path.is_in_loop else messages.NO_FLAGS)
    for step in steps:
        if step.estimate is not None:
            invalid |= step.estimate.invalid if is_absolute(step.edge.name) else step.estimate.invalid & ODOM_INVALID
            quality |= step.estimate.quality
    return PathState(utime, tuple(steps), invalid, quality)


def _vehicle_step(world: str, estimate: messages.Estimate, forward: bool) -> PathStep:
    X_WB = get_vehicle_pose(world, estimate)
    numbers = estimate.odom_covariance if world == names.ODOM else estimate.covariance
    factor = None if numbers is None else chain.factor(np.array(numbers).reshape(6, 6))
    source = (EdgeKind.VEHICLE, world, estimate.utime)
    return PathStep(Edge(EdgeKind.VEHICLE, world, forward, X_WB), X_WB, factor, source, estimate=estimate)


def _path_steps(path: KinematicPath, joints: JointReadings, utime: int) -> list[PathStep]:
    steps = []
    readings = iter(joints.readings)
    links = path.build_links(joints.positions, joints.sigmas, utime)
    for edge, link in zip(path.edges, links, strict=True):
        read = next(readings) if edge.joint is not None else ()
        steps.append(PathStep(edge, link.X_FT, link.factor, link.source, read))
    return steps


def _reverse(step: PathStep) -> PathStep:
    return step._replace(edge=step.edge._replace(forward=not step.edge.forward))


# --- motion -----------------------------------------------------------------------------------------------------------

_STEP = 1e-4
"""Seconds over which the Jacobian of a joint is differenced."""


def compute_motion(
    view: PlatformView, interest: str, reference: str, expressed_in: str, time: messages.TimeQuery, now: int = 0
) -> messages.MotionAnswer:
    """Return the velocity and acceleration of `interest` relative to `reference`, as observed in `reference`.

    Vectors are along the axes of `expressed_in`, empty for the frame of reference. Raises QueryError as
    `PlatformView.transformation`; NoPoseError where the vehicle's velocity is unknown.
    """
    answer = view.transformation(interest, reference, time, now)
    path = lookup_path(view, interest, reference, time, now)
    motions: list[RigidMotion] = []
    uncertain: list[ChainLink] = []
    for step in path.steps:
        if step.estimate is not None:
            each, factor = _vehicle_motion(view, step.X_FT, step.estimate)
        elif step.edge.joint is not None:
            each, factor = _joint_motion(view, step, step.edge.joint)
        else:
            each, factor = RigidMotion(step.X_FT), _EXACT
        motions.append(each)
        # the vehicle has one motion, in whichever world it is expressed
        source = step.source if step.estimate is None else (EdgeKind.VEHICLE,)
        uncertain.append(ChainLink(step.X_FT, step.edge.forward, factor, source))
    moved = _compose(path.steps, motions)
    second = _get_acceleration_covariance(view, path.steps, motions)
    R = so3.IDENTITY
    axes = expressed_in or reference
    if axes != reference:
        has_time = bool(time.at) and time.policy is not messages.Policy.LATEST
        at = messages.TimeQuery(path.utime, time.policy if has_time else messages.Policy.PREDICTED)
        turned = view.transformation(reference, axes, at, now)
        R = turned.transformation.pose.wxyz
        # an invalid rotation makes the vectors invalid
        answer = answer._replace(
            transformation=answer.transformation.with_invalid_reasons(turned.transformation.invalid_reasons),
            quality=answer.quality | turned.quality,
        )
    covariances = [chain.covariance(uncertain), second]
    if axes != reference:
        turn = np.kron(np.eye(2), np.array(so3.matrix_rows(R)))
        covariances = [None if P is None else turn @ P @ turn.T for P in covariances]
    return messages.MotionAnswer(
        answer,
        axes,
        so3.rotate(R, moved.velocity),
        so3.rotate(R, moved.angular_velocity),
        so3.rotate(R, moved.acceleration),
        so3.rotate(R, moved.angular_acceleration),
        *(None if P is None else tuple(P.ravel().tolist()) for P in covariances),
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


def _get_vehicle_covariance(view: PlatformView, X_WB: Pose, estimate: messages.Estimate) -> Array | None:
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


def _joint_motion(view: PlatformView, step: PathStep, joint: Joint) -> tuple[RigidMotion, Array | None]:
    drive = view.model.drives[step.edge.name]
    position, rates, changes, sigmas = [], [], [], []
    for name, reading in zip(drive.names, step.readings, strict=True):
        track = view.joints.tracks.get(name)
        rate, change = reading.rate, messages.NAN
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


def _vehicle_motion(view: PlatformView, X_WB: Pose, estimate: messages.Estimate) -> tuple[RigidMotion, Array | None]:
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


# --- explanation ------------------------------------------------------------------------------------------------------


def explain(
    view: PlatformView, interest: str, reference: str, time: messages.TimeQuery, now: int
) -> messages.Explanation:
    """Return where a frame is in another, with each edge of the path.

    A share is that of the trace of the position's, and of the rotation's, covariance. An edge without a sigma has none,
    and counts as exact for the others. Raises QueryError as `PlatformView.transformation`.
    """
    answer = view.transformation(interest, reference, time, now)
    path = lookup_path(view, interest, reference, time, now)
    known = [
        link._replace(factor=_EXACT if link.factor is None else link.factor, source=(number,))
        for number, link in enumerate(path.links)
    ]
    shares = chain.contributions(known) or {}
    traces = []
    for link in known:
        share = shares[link.source]
        large_angle = shares.get((*link.source, chain.LARGE_ANGLE), _EXACT)
        traces.append((float(np.sum(share[:3] ** 2) + np.sum(large_angle**2)), float(np.sum(share[3:] ** 2))))
    of_edges = np.array(traces).reshape(-1, 2)
    whole = of_edges.sum(axis=0)
    of_edges /= np.where(whole > 0.0, whole, 1.0)
    of_edges[[step.factor is None for step in path.steps]] = messages.NAN
    edges = zip(path.steps, of_edges.tolist(), strict=True)
    return messages.Explanation(
        answer, tuple(_build_edge_report(view, step, share, time, now) for step, share in edges)
    )


def _describe_warning(view: PlatformView, step: PathStep, time: messages.TimeQuery, now: int) -> str:
    """Return the warnings of a joint's position as text; see `lookup_joints` for the flags."""
    edge = step.edge
    assert edge.joint is not None
    leader = view.model.drives[edge.name].leader
    warnings = []
    if any(each.provenance is Provenance.DEFAULT for each in step.readings):
        stated = view.model.joints[leader].joint.default
        warnings.append("not received: at its default" if stated else "not received, and no default is stated")
    received = [each for each in step.readings if each.provenance is not Provenance.DEFAULT]
    latest = now and (not time.at or time.policy is messages.Policy.LATEST)
    gap = max((max(each.gap, (now - each.stamp) * 1e-6 if latest else 0.0) for each in received), default=0.0)
    if gap > MAX_GAP_S:
        warnings.append(f"silent for {gap:.1f} s")
    elif latest and any((each.stamp - now) * 1e-6 > MAX_CLOCK_LEAD_S for each in received):
        warnings.append("stamped in the future: the clock was set back")
    if edge.joint.is_out_of_limits(tuple(each.position for each in step.readings)):
        warnings.append("beyond its limits")
    return ", ".join(warnings)


def _describe_source(view: PlatformView, leader: str, step: PathStep) -> str:
    """Return the sources of a joint's coordinates, in their order, each once."""
    tracks = view.joints.tracks
    names = view.model.drives[step.edge.name].names
    found = dict.fromkeys(tracks[name].source or "joints" for name in names if name in tracks)
    source = ", ".join(found)
    return source if leader == step.edge.name else f"{source} of {leader}".strip()


def _build_edge_report(
    view: PlatformView, step: PathStep, shares: list[float], time: messages.TimeQuery, now: int
) -> messages.EdgeReport:
    edge = step.edge
    X = step.X_FT if edge.forward else step.X_FT.inverse()
    provenance, stamp, source, warning = "fixed", 0, "", ""
    if (found := find_provenance(view, step)) is not None:
        provenance, stamp = found[0].name.lower(), found[1]
    if step.estimate is not None:
        source = "localization"
    elif step.readings:
        source = _describe_source(view, view.model.drives[edge.name].leader, step)
        warning = _describe_warning(view, step, time, now)
    ends = (edge.name.partition(":")[0], edge.name)
    if edge.kind is EdgeKind.VEHICLE:
        ends = (edge.name, view.rolling_frame)
    elif edge.kind is not EdgeKind.FRAME:
        ends = next((each.from_, each.to) for each in view.model.constraints if each.name == edge.name)
    return messages.EdgeReport(
        kind=edge.kind.value,
        name=edge.name,
        forward=edge.forward,
        ends=ends,
        pose=X,
        provenance=provenance,
        stamp=stamp,
        age=(now - stamp) * 1e-6 if stamp and now else messages.NAN,
        source=source,
        coordinates=tuple(reading.position for reading in step.readings),
        position_share=shares[0],
        rotation_share=shares[1],
        warning=warning,
    )
