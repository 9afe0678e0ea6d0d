"""The path between two frames at one time, step by step, with the readings and estimates that each step uses."""

from __future__ import annotations

from collections.abc import Hashable
from typing import NamedTuple

import numpy as np

from modelserver.geometry import names
from modelserver.geometry.kinematic_path import KinematicPath
from modelserver.geometry.topology import Edge, EdgeKind
from modelserver.joints.track import Provenance, Reading
from modelserver.messages import NO_FLAGS, VALID, Estimate, Invalid, Quality, TimeQuery
from modelserver.query.joint_lookup import JointReadings
from modelserver.query.view import (
    ODOM_INVALID,
    WORLD_FRAMES,
    PlatformView,
    check_not_reserved,
    get_vehicle_pose,
    is_absolute,
)
from modelserver.transforms import chain
from modelserver.transforms.chain import ChainLink
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Array


class PathStep(NamedTuple):
    """One edge of a path: its pose `X_FT` at a time, its covariance factor and the data used.

    `readings` are those of a joint's coordinates, `estimate` the vehicle's.
    """

    edge: Edge
    X_FT: Pose
    factor: Array | None
    source: tuple[Hashable, ...]
    readings: tuple[Reading, ...] = ()
    estimate: Estimate | None = None

    @property
    def link(self) -> ChainLink:
        is_large_angle = self.edge.kind is EdgeKind.VEHICLE
        return ChainLink(self.X_FT, self.edge.forward, self.factor, self.source, is_large_angle)


class PathState(NamedTuple):
    """The steps from the frame of reference to the frame of interest at `utime`, with reasons and flags."""

    utime: int
    steps: tuple[PathStep, ...]
    invalid: Invalid = VALID
    quality: Quality = NO_FLAGS

    @property
    def links(self) -> list[ChainLink]:
        return [step.link for step in self.steps]


_PROVENANCE_OF_FLAG = (
    (Quality.PREDICTED, Provenance.PREDICTED),
    (Quality.HELD, Provenance.HELD),
    (Quality.INTERPOLATED, Provenance.INTERPOLATED),
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


def lookup_path(view: PlatformView, interest: str, reference: str, time: TimeQuery, now: int) -> PathState:
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
    quality = joints.quality | (Quality.LOOP if path.is_in_loop else NO_FLAGS)
    for step in steps:
        if step.estimate is not None:
            invalid |= step.estimate.invalid if is_absolute(step.edge.name) else step.estimate.invalid & ODOM_INVALID
            quality |= step.estimate.quality
    return PathState(utime, tuple(steps), invalid, quality)


def _vehicle_step(world: str, estimate: Estimate, forward: bool) -> PathStep:
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
