"""A joint at many instants: how far it has moved, and how sure that is."""

from __future__ import annotations

import math

import numpy as np

from modelserver.geometry.edges import EdgeKind
from modelserver.geometry.joint import ROUNDING, Joint, JointType
from modelserver.geometry.route import Leg
from modelserver.joints.joints import LONGEST_GAP_S
from modelserver.joints.vector import VECTORS
from modelserver.joints.vector import columns as vector_columns
from modelserver.messages import Invalid, Quality
from modelserver.platform.rows import Rows
from modelserver.platform.view import PlatformView
from modelserver.spatial import arrays
from modelserver.spatial.arrays import Poses
from modelserver.spatial.chains import Links
from modelserver.spatial.so3 import Array


def joint_moved(view: PlatformView, leg: Leg, rows: Rows) -> tuple[Links, Rows]:
    """Return how far a joint has moved at every row's time."""
    model, joint = view.model, leg.joint
    drive = model.drives[leg.name]
    count = len(rows.utimes)
    tracks = [view.joints.tracks.get(name) for name in drive.names]
    for track in tracks:
        if track is not None:
            rows = rows.within(track.first, track.last)
    rest = model.joints[drive.leader].joint
    positions, sigmas = np.empty((count, len(tracks))), np.empty((count, len(tracks)))
    vector = None
    if joint.type in VECTORS:
        x, y, z = tracks[-3:]
        if x is not None and y is not None and z is not None:
            vector = vector_columns((x, y, z), rows.utimes)
    for number, track in enumerate(tracks):
        if track is None:
            positions[:, number] = rest.rest[number]
            sigmas[:, number] = rest.sigma[number] if rest.sigma else math.nan
            rows = rows.told(0 if rest.default else int(Invalid.JOINT_UNKNOWN), int(Quality.AT_REST))
            continue
        if vector is not None and number >= len(tracks) - 3:
            positions[:, number], sigmas[:, number], apart = (each[:, number - len(tracks)] for each in vector)
        else:
            positions[:, number], sigmas[:, number], apart = track.columns(rows.utimes)
        stale = np.where(apart > LONGEST_GAP_S, int(Invalid.STALE_JOINT), 0).astype(np.int32)
        rows = rows.told(stale, np.where(apart > 0.0, int(Quality.INTERPOLATED), 0).astype(np.int32))
    positions = drive.multiplier * positions + drive.offset
    # with the multiplier's sign: what follows errs with its leader
    sigmas = drive.multiplier * sigmas
    beyond = np.zeros(count, dtype=bool)
    if joint.lower:
        beyond |= (positions < np.array(joint.lower) - ROUNDING).any(axis=1)
    if joint.upper:
        beyond |= (positions > np.array(joint.upper) + ROUNDING).any(axis=1)
    rows = rows.told(0, np.where(beyond, int(Quality.OUT_OF_LIMITS), 0).astype(np.int32))
    axis = np.array(joint.axis)
    if joint.type is JointType.REVOLUTE:
        moved = Poses(np.zeros((1, 3)), arrays.about(axis, positions[:, 0]))
    elif joint.type is JointType.PRISMATIC:
        moved = Poses(positions * axis, np.array([[1.0, 0.0, 0.0, 0.0]]))
    else:
        moved = _moved(joint, positions)
    factor = None
    if not np.isnan(sigmas).all():
        factor = _jacobians(joint, positions) * sigmas[:, None, :]
    return Links(moved, leg.forward, factor, (EdgeKind.JOINT, drive.leader, "rows")), rows


def _moved(joint: Joint, positions: Array) -> Poses:
    """Return `Joint.motion` row by row, of a joint with several coordinates."""
    if joint.type is JointType.PLANAR:
        x, y = joint.jacobian((0.0, 0.0, 0.0))[:3, :2].T
        return Poses(positions[:, :1] * x + positions[:, 1:2] * y, arrays.about(np.array(joint.axis), positions[:, 2]))
    turned = arrays.exponentials(positions[:, -3:])
    return Poses(positions[:, :3] if joint.type is JointType.FLOATING else np.zeros((1, 3)), turned)


def _jacobians(joint: Joint, positions: Array) -> Array:
    """Return `Joint.jacobian` row by row; in one row where it is the same in all."""
    if joint.type not in (JointType.SPHERICAL, JointType.FLOATING):
        return joint.jacobian((0.0,) * joint.count)[None]
    J = np.zeros((len(positions), 6, joint.count))
    J[:, 3:, -3:] = arrays.left_jacobians(positions[:, -3:])
    if joint.type is JointType.FLOATING:
        J[:, :3, :3] = np.eye(3)
    return J
