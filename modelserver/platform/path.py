"""The whole way between two frames at one time, step by step: for those who ask how it moves, or what it rests on."""

from __future__ import annotations

from collections.abc import Hashable
from typing import NamedTuple

import numpy as np

from modelserver.geometry import names
from modelserver.geometry.edges import Edge, EdgeKind
from modelserver.geometry.route import Route
from modelserver.joints.joints import Reading
from modelserver.messages import NO_FLAGS, VALID, Estimate, Invalid, Quality, TimeQuery
from modelserver.platform.placing import Placed
from modelserver.platform.view import ODOM_INVALID, PlatformView
from modelserver.platform.worlds import WORLD_FRAMES, check_not_reserved, is_absolute, pose_in
from modelserver.spatial import chain
from modelserver.spatial.chain import ChainLink
from modelserver.spatial.pose import Pose
from modelserver.spatial.so3 import Array


class PathStep(NamedTuple):
    """One edge of a way: its pose `X_FT` now, what it is unsure of, and what it rests on.

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
        """The step as a link of a chain."""
        bends = self.edge.kind is EdgeKind.VEHICLE
        return ChainLink(self.X_FT, self.edge.forward, self.factor, self.source, bends)


class PathState(NamedTuple):
    """The steps from the frame of reference to the frame of interest, at `utime`; what speaks against them all."""

    utime: int
    steps: tuple[PathStep, ...]
    invalid: Invalid = VALID
    quality: Quality = NO_FLAGS

    @property
    def links(self) -> list[ChainLink]:
        """The steps as links of a chain."""
        return [step.link for step in self.steps]


def way(view: PlatformView, interest: str, reference: str, time: TimeQuery, now: int) -> PathState:
    """Return the way from one frame to another at a time. Raises QueryError as `PlatformView.transformation`."""
    of_world = [frame for frame in (interest, reference) if frame in WORLD_FRAMES]
    if not of_world:
        for frame in (interest, reference):
            check_not_reserved(frame)
        route = view.model.route(interest, reference)
        utime, mounted = view.place(route, time, now)
        return _way(utime if route.legs else 0, _steps(route, mounted, utime), route, mounted)
    if interest == reference:
        return PathState(0, ())
    if len(of_world) == 2:
        estimate = view.estimate(time, now)
        # how the errors of the vehicle's two poses hang together nobody knows
        ends = [_vehicle(world, estimate, world == reference)._replace(factor=None) for world in (reference, interest)]
        return PathState(estimate.utime, tuple(ends), estimate.invalid, estimate.quality)
    (world,) = of_world
    frame = interest if world == reference else reference
    check_not_reserved(frame)
    view.check_carried(frame)
    route = view.route_from_vehicle(frame)
    estimate, mounted = view.moment(route, time, now)
    if world == reference:
        steps = [_vehicle(world, estimate, forward=True), *_steps(route, mounted, estimate.utime)]
    else:
        # the same way back
        back = [_turned(step) for step in reversed(_steps(route, mounted, estimate.utime))]
        steps = [*back, _vehicle(world, estimate, forward=False)]
    return _way(estimate.utime, steps, route, mounted)


def _way(utime: int, steps: list[PathStep], route: Route, mounted: Placed) -> PathState:
    invalid = mounted.invalid
    quality = mounted.quality | (Quality.LOOP if route.closes_loop else NO_FLAGS)
    for step in steps:
        if step.estimate is not None:
            invalid |= step.estimate.invalid if is_absolute(step.edge.name) else step.estimate.invalid & ODOM_INVALID
            quality |= step.estimate.quality
    return PathState(utime, tuple(steps), invalid, quality)


def _vehicle(world: str, estimate: Estimate, forward: bool) -> PathStep:
    X_WB = pose_in(world, estimate)
    numbers = estimate.odom_covariance if world == names.ODOM else estimate.covariance
    factor = None if numbers is None else chain.factor(np.array(numbers).reshape(6, 6))
    source = (EdgeKind.VEHICLE, world, estimate.utime)
    return PathStep(Edge(EdgeKind.VEHICLE, world, forward, X_WB), X_WB, factor, source, estimate=estimate)


def _steps(route: Route, mounted: Placed, utime: int) -> list[PathStep]:
    steps = []
    readings = iter(mounted.readings)
    links = route.links(mounted.positions, mounted.sigmas, utime)
    for edge, link in zip(route.edges, links, strict=True):
        read = next(readings) if edge.joint is not None else ()
        steps.append(PathStep(edge, link.X_FT, link.factor, link.source, read))
    return steps


def _turned(step: PathStep) -> PathStep:
    return step._replace(edge=step.edge._replace(forward=not step.edge.forward))
