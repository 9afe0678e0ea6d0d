"""The replica of a vehicle's geometry, poses and joints that a mirror builds from messages. No socket, no clock.

`MirrorReceiver.feed` processes one message and replaces `state`, an immutable `MirrorState` that queries read.

- Geometry: MODEL_SNAPSHOT, assembled from its parts. POSE carries the model revision, which confirms it or shows that
  another one is in force.
- Poses: POSE and POSE_ODOM of one time form an estimate in the history.
- Joints: JOINTS as the server receives it; JOINTS_HELD for positions from before this client listened.

Clocks: `now` is the receive time on a monotonic clock, microseconds; ages are measured with it. Stamps are in the
server's clock. Its offset is exact when a snapshot arrives (stamped when sent), and else the largest seen (a pose may
be stamped in the past).

A restart of the server resets Odom. It is detected by a lower pose epoch, an impossible speed in Odom, or, after a
pause of `MIN_RESTART_S`, an Odom covariance that shrank.

A client without the filter's state knows the base frame from POSE (World:UTM) and POSE_ODOM (Odom) only:

Velocity: X_AB between two poses in Odom, `MIN_SPAN_US` to `MAX_SPAN_US` apart, is taken for a constant twist
(v, w): w dt = log R_AB, v dt = J_l(w dt)^-1 p_AB, J_l the left Jacobian of SO(3) (Lynch & Park 2017, eq. 3.88; Sola
2018, eq. 145). Its sigma is half of the change that `ACCELERATION_SIGMA` makes in dt: the mean velocity is used for the
end of the interval. Acceleration stays unknown.

Extrapolation by dt: X <- X D with D = exp((v, w) dt), covariance by `compose_covariance` with Q = diag(s_p^2, s_a^2),
s_a = s_w dt + a_w dt^2 / 2, s_p = s_v dt + a_v dt^2 / 2 + |v| dt s_a / 3. The last term is the lateral drift from a
heading error that grows as t^2. Protection levels become unknown (nan).

Limits: constant velocity and turn rate; an estimate without a new pose for `POSE_TIMEOUT_S` is flagged stale.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import numpy as np

from modelserver.earth.geodesy import GeodesyError, geodesy_of
from modelserver.errors import WireError, quote
from modelserver.estimation.history import DeferredEstimate, History
from modelserver.formats.yaml_geometry import ModelSnapshot, decode_snapshot
from modelserver.geometry import names
from modelserver.joints import NO_JOINTS, JointHistory
from modelserver.messages import (
    NAN,
    STALE_SENSORS,
    VALID,
    Estimate,
    Invalid,
    JointsSample,
    LocalizerSummary,
    Mode,
    NavigationState,
    Origin,
    PoseAnswer,
    Quality,
    Sample,
    SnapshotPart,
    SwitchMode,
    VehicleMotion,
)
from modelserver.query.view import PlatformView
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Vector3
from modelserver.transforms.transformation import Transformation, compose_covariance
from modelserver.wire.codec import SnapshotAssembler, decode

MIN_SPAN_US: Final = 50_000
MAX_SPAN_US: Final = 500_000
"""Time between the two poses of a velocity, microseconds: long against their noise, short against maneuvers."""

ACCELERATION_SIGMA: Final = 2.0
ANGULAR_ACCELERATION_SIGMA: Final = 1.0
"""Unobserved acceleration of the vehicle, m/s2 and rad/s2, one sigma."""

SPEED_SIGMA: Final = 10.0
TURN_RATE_SIGMA: Final = 1.0
"""Velocity of a vehicle whose motion is unknown, m/s and rad/s, one sigma."""

MAX_ANGLE_SIGMA: Final = math.pi / math.sqrt(3.0)
"""Sigma of an angle that is uniform in (-pi, pi], radians: an upper limit."""

POSE_TIMEOUT_S: Final = 1.0
POSE_TIMEOUT_PERIODS: Final = 3.0
"""Poses are missing after this time without one, and after this many publishing periods."""


class OdomSample(NamedTuple):
    """Pose of the base frame in Odom at a time."""

    utime: int
    odom: Pose


class PublishedEstimate(NamedTuple):
    """The estimate of the base frame in a POSE (`world`) and a POSE_ODOM of one time, computed when it is needed.

    `previous` is an earlier pose in Odom to compute the velocity with, None if there is none; `is_random_walk` is
    whether Odom's covariance grows as a random walk.
    """

    utime: int
    world: PoseAnswer
    odom: PoseAnswer
    previous: OdomSample | None
    is_random_walk: bool

    def resolve(self) -> Estimate:
        """Return the estimate."""
        world, odom = self.world.transformation, self.odom.transformation
        origin = self.world.origin
        utm = enu = None
        # without a pose in the world the server publishes the identity, with reasons and no covariance
        if origin is not None and (world.covariance is not None or world.pose != Pose.identity()):
            utm, enu = world.pose, to_enu(origin, world.pose)
        return Estimate(
            self.utime,
            odom.pose,
            enu,
            utm,
            None if world.covariance is None else tuple(world.covariance.ravel().tolist()),
            None if odom.covariance is None else tuple(odom.covariance.ravel().tolist()),
            Invalid(world.invalid_reasons),
            self.world.quality,
            world.pose_epoch,
            origin,
            self.world.horizontal_protection_level,
            self.world.heading_protection_level,
            self.world.seconds_to_limit,
            None if self.previous is None else estimate_motion(self.previous, OdomSample(self.utime, odom.pose)),
            self.is_random_walk,
            self.world.horizontal_level,
            self.world.heading_level,
            self.world.limit_risk,
            self.world.horizontal_allowance,
        )


def to_enu(origin: Origin, X_utm: Pose) -> Pose | None:
    """Convert a pose from World:UTM to World:ENU; None if it is too far from the origin, or the origin is invalid."""
    try:
        return geodesy_of(origin).pose_in_enu(X_utm)
    except GeodesyError:
        return None


def estimate_motion(before: OdomSample, after: OdomSample) -> VehicleMotion:
    """Return the constant twist between two poses in Odom, along the vehicle's axes; see the module."""
    seconds = (after.utime - before.utime) * 1e-6
    X_AB = before.odom.inverse() @ after.odom
    rotation = so3.logarithm(X_AB.wxyz)
    travel = so3.to_vector3(np.linalg.solve(so3.left_jacobian(rotation), np.array(X_AB.xyz)).tolist())
    sigmas = (0.5 * ACCELERATION_SIGMA * seconds,) * 3 + (0.5 * ANGULAR_ACCELERATION_SIGMA * seconds,) * 3
    covariance = tuple(np.diag([sigma * sigma for sigma in sigmas]).ravel().tolist())
    return VehicleMotion(_scale(travel, 1.0 / seconds), _scale(rotation, 1.0 / seconds), covariance=lambda: covariance)


def _scale(vector: Vector3, factor: float) -> Vector3:
    return (vector[0] * factor, vector[1] * factor, vector[2] * factor)


@dataclass(frozen=True, slots=True)
class PoseExtrapolator:
    """A `Localizer` for clients: it extrapolates the newest published pose.

    `last` is the newest estimate, None before the first; `period` the time between the last two, seconds.
    """

    last: Estimate | DeferredEstimate | None = None
    period: float = 0.0

    @property
    def utime(self) -> int:
        """Time of the newest estimate, 0 before the first."""
        return 0 if self.last is None else self.last.utime

    def estimate(self, utime: int) -> Estimate:
        """Extrapolate the newest estimate to a time; not valid after a pose timeout."""
        if self.last is None:
            return Estimate(utime, Pose.identity(), invalid=Invalid.NO_FIX | Invalid.NO_IMU)
        last = self.last if isinstance(self.last, Estimate) else self.last.resolve()
        seconds = (utime - last.utime) * 1e-6
        return last if seconds <= 0.0 else _extrapolate(last, utime, seconds, seconds > self._timeout)

    @property
    def _timeout(self) -> float:
        return max(POSE_TIMEOUT_S, POSE_TIMEOUT_PERIODS * self.period)

    def process(self, sample: Sample | SwitchMode) -> tuple[PoseExtrapolator, tuple[()]]:
        return self, ()

    def defer_estimate(self, utime: int) -> Estimate:
        return self.estimate(utime)

    def navigation(self, utime: int) -> NavigationState | None:
        """Return None: there is no filter."""
        return None

    def find_stale_sensors(self, utime: int) -> Invalid:
        """Return the STALE_SENSORS flags of an estimate at `utime`."""
        if self.last is None:
            return VALID
        last = self.last if isinstance(self.last, Estimate) else self.last.resolve()
        is_stale = (utime - last.utime) * 1e-6 > self._timeout
        return STALE_SENSORS if is_stale else last.invalid & STALE_SENSORS

    def summary(self, utime: int) -> LocalizerSummary:
        """Return an empty summary: the server reports the health of its localization itself."""
        return LocalizerSummary(Mode.FULL)


def _extrapolate(last: Estimate, utime: int, dt: float, is_stale: bool) -> Estimate:
    motion = last.motion
    velocity, rate, speed_sigma, rate_sigma = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), SPEED_SIGMA, TURN_RATE_SIGMA
    if motion is not None:
        velocity, rate = motion.velocity, motion.angular_velocity
        numbers = motion.covariance() if motion.covariance is not None else (0.0,) * 36
        speed_sigma, rate_sigma = math.sqrt(numbers[0]), math.sqrt(numbers[-1])
    rotation = _scale(rate, dt)
    travel = so3.left_jacobian(rotation) @ np.array(_scale(velocity, dt))
    D = Pose(so3.to_vector3(travel.tolist()), so3.exponential(rotation))
    angle = min(rate_sigma * dt + 0.5 * ANGULAR_ACCELERATION_SIGMA * dt * dt, MAX_ANGLE_SIGMA)
    lateral = math.sqrt(sum(value * value for value in velocity)) * dt * angle / 3.0
    position = speed_sigma * dt + 0.5 * ACCELERATION_SIGMA * dt * dt + lateral
    Q = np.diag([position * position] * 3 + [angle * angle] * 3)

    def inflate(X: Pose, numbers: tuple[float, ...] | None) -> tuple[float, ...] | None:
        if numbers is None:
            return None
        return tuple(compose_covariance(X, np.array(numbers).reshape(6, 6), D, Q).ravel().tolist())

    invalid = Invalid.STALE_GPS | Invalid.STALE_IMU if is_stale else VALID
    left = last.seconds_to_limit - dt
    if left <= 0.0:
        invalid |= Invalid.LIMIT_EXCEEDED
    return replace(
        last,
        utime=utime,
        odom=last.odom @ D,
        enu=None if last.enu is None else last.enu @ D,
        utm=None if last.utm is None else last.utm @ D,
        covariance=None if last.utm is None else inflate(last.utm, last.covariance),
        odom_covariance=inflate(last.odom, last.odom_covariance),
        invalid=last.invalid | invalid,
        quality=last.quality | Quality.PREDICTED,
        horizontal_protection_level=NAN,
        heading_protection_level=NAN,
        horizontal_level=NAN,
        heading_level=NAN,
        limit_risk=NAN,
        horizontal_allowance=NAN,
        seconds_to_limit=max(left, 0.0) if left == left else NAN,
    )


# --- the replica ------------------------------------------------------------------------------------------------------

HISTORY_S: Final = 60.0
"""Duration of the pose history until the first snapshot states the server's."""

FUTURE_TOLERANCE_US: Final = 1_000_000
"""A joint further ahead of the server's clock is rejected; a snapshot less far behind is out of sequence."""

FILTER_TIMEOUT_US: Final = 2_000_000
"""The filter counts as running for this time after LOCALIZATION_STATE."""

MAX_SPEED: Final = 200.0
"""m/s; a larger speed in Odom is a reset of Odom by a restart of the server."""

MIN_RESTART_S: Final = 0.3
"""A restart of the server takes longer than this."""

MAX_COUNTERS: Final = 256
"""Distinct (channel, reason) pairs that are counted; others are counted together."""

NEVER: Final = -1
"""Receive time of what was never received."""


class Ages(NamedTuple):
    """Seconds since the geometry was confirmed, and a pose and a joint were received; infinite for never."""

    geometry: float
    pose: float
    joints: float


@dataclass(frozen=True, slots=True, eq=False)
class MirrorState:
    """The replica at one time. Immutable, except for the caches `static_transforms` and `static_answers`.

    view: answers queries, None before the first complete snapshot. `*_received`: receive time, or NEVER.
    clock_offset: the server's clock minus the receive clock, microseconds. other_revision: the revision in the
    newest pose where it is not that of the snapshot. static_*: answers without a world and without a moving joint.
    """

    view: PlatformView | None = None
    snapshot: ModelSnapshot | None = None
    history: History = field(default_factory=lambda: History(HISTORY_S))
    extrapolator: PoseExtrapolator = field(default_factory=PoseExtrapolator)
    joints: JointHistory = NO_JOINTS
    geometry_received: int = NEVER
    pose_received: int = NEVER
    joints_received: int = NEVER
    clock_offset: int = 0
    other_revision: str = ""
    static_transforms: dict[tuple[str, str], Transformation] = field(default_factory=dict)
    static_answers: dict[tuple[str, str], PoseAnswer] = field(default_factory=dict)

    def get_ages(self, now: int) -> Ages:
        """Return the age of each part at a time of the receive clock."""
        received = (self.geometry_received, self.pose_received, self.joints_received)
        return Ages(*(math.inf if at == NEVER else (now - at) * 1e-6 for at in received))

    def get_service_time(self, now: int) -> int:
        """Return the server's utime at a time of the receive clock."""
        return now + self.clock_offset


class MirrorReceiver:
    """Update `state` from received messages; count what cannot be used in `rejected`.

    `snapshot` gives the geometry beforehand; with `keep_geometry` it stays, whatever revision the poses carry.
    """

    def __init__(self, channel_prefix: str = "", snapshot: ModelSnapshot | None = None, keep_geometry: bool = False):
        self.state = MirrorState()
        self._worlds = {f"{channel_prefix}POSE": names.WORLD_UTM, f"{channel_prefix}POSE_ODOM": names.ODOM}
        self._snapshot_channel = f"{channel_prefix}MODEL_SNAPSHOT"
        self._held_joints_channel = f"{channel_prefix}JOINTS_HELD"
        self._state_channel = f"{channel_prefix}LOCALIZATION_STATE"
        self._keep_geometry = keep_geometry
        self._rejected: dict[tuple[str, str], int] = {}
        self._assembler = SnapshotAssembler()
        self._snapshot_utime = 0
        self._snapshot_bytes = b""
        self._poses: dict[str, PoseAnswer] = {}
        self._odom_samples: deque[OdomSample] = deque()
        self._last_odom: Transformation | None = None
        self._epoch = 0
        self._filter_received = NEVER
        self._has_clock = False
        self._has_snapshot_clock = False
        if snapshot is not None:
            self._set_geometry(snapshot)

    @property
    def channels(self) -> tuple[str, ...]:
        """The channels to subscribe to; the channel of the joints is known from the first snapshot on."""
        always = (self._snapshot_channel, self._held_joints_channel, *self._worlds, self._state_channel)
        snapshot = self.state.snapshot
        return (*always, snapshot.joints_channel) if snapshot is not None else always

    @property
    def rejected(self) -> Mapping[tuple[str, str], int]:
        """Number of rejected messages by channel and reason."""
        return MappingProxyType(self._rejected)

    def feed(self, channel: str, data: bytes, now: int) -> bool:
        """Process a message received at `now`; return whether the state changed. Raises nothing."""
        before = self.state
        try:
            if channel in self._worlds:
                self._process_pose(channel, decode("pose_transform_t", data), now)
            elif channel == self._snapshot_channel:
                self._process_snapshot_part(decode("model_snapshot_t", data), now)
            elif channel == self._state_channel:
                self._filter_received = now
            elif before.snapshot is not None and channel == before.snapshot.joints_channel:
                self._process_joints(decode("joints_t", data), now, before.snapshot)
            elif before.snapshot is not None and channel == self._held_joints_channel:
                self._process_held_joints(decode("joints_t", data), now)
        except WireError as error:
            self._reject(channel, error.reason)
        return self.state is not before

    def _reject(self, channel: str, reason: str) -> None:
        key = (channel, reason)
        if key not in self._rejected and len(self._rejected) >= MAX_COUNTERS:
            key = ("*", "other")
        self._rejected[key] = self._rejected.get(key, 0) + 1

    def _estimate_clock_offset(self, utime: int, now: int) -> int:
        """Return the offset of the server's clock from a stamp that may lie in its past, as that of a pose may."""
        had_clock, self._has_clock = self._has_clock, True
        return max(utime - now, self.state.clock_offset) if had_clock else utime - now

    # --- geometry

    def _process_snapshot_part(self, part: SnapshotPart, now: int) -> None:
        state = self.state
        # stamped when sent, so it is the server's clock, also after that was set back
        offset, self._has_clock, self._has_snapshot_clock = part.utime - now, True, True
        is_confirmed = state.snapshot is not None and part.model_revision == state.snapshot.model.revision
        received = now if is_confirmed else state.geometry_received
        self.state = replace(state, clock_offset=offset, geometry_received=received)
        if 0 < self._snapshot_utime - part.utime < FUTURE_TOLERANCE_US:
            return  # out of sequence
        data = self._assembler.add(part)
        if data is None:
            return
        self._snapshot_utime = part.utime
        if data != self._snapshot_bytes:
            snapshot = decode_snapshot(data)
            self._snapshot_bytes = data
            if not self._keep_geometry:
                self._set_geometry(snapshot)
        self.state = replace(self.state, geometry_received=now)

    def _set_geometry(self, snapshot: ModelSnapshot) -> None:
        state = self.state
        if state.snapshot is None:
            joints = JointHistory(snapshot.model.joints.values(), snapshot.history_s)
        else:
            joints = state.joints.for_model(snapshot.model)
        history = state.history.with_duration(snapshot.history_s)
        self._replace(
            snapshot=snapshot,
            history=history,
            joints=joints,
            other_revision="",
            static_transforms={},
            static_answers={},
        )

    def _replace(self, **changes: Any) -> None:
        """Change the state, and with it the view."""
        state = replace(self.state, **changes)
        if state.snapshot is not None:
            # published poses are of the base frame, so it also takes the place of the rolling frame
            model, base = state.snapshot.model, state.snapshot.base_frame
            view = PlatformView(model, base, state.extrapolator, state.history, base, joints=state.joints)
            state = replace(state, view=view)
        self.state = state

    # --- poses

    def _process_pose(self, channel: str, pose: PoseAnswer, now: int) -> None:
        world = self._worlds[channel]
        if self._is_foreign(pose, world):
            self._reject(channel, "other frames")
            return
        self._poses[world] = pose
        if len({each.transformation.utime for each in self._poses.values()}) == 1 < len(self._poses):
            self._process_pose_pair(self._poses.pop(names.WORLD_UTM), self._poses.pop(names.ODOM), now)

    def _is_foreign(self, pose: PoseAnswer, world: str) -> bool:
        """Return whether a pose is not of this vehicle's base frame in `world`."""
        transformation, snapshot = pose.transformation, self.state.snapshot
        if transformation.frame_of_reference != world:
            return True
        # another revision may have another base frame
        return (
            snapshot is not None
            and transformation.model_revision == snapshot.model.revision
            and transformation.frame_of_interest != snapshot.base_frame
        )

    def _process_pose_pair(self, world: PoseAnswer, odom: PoseAnswer, now: int) -> None:
        state, transformation, utime = self.state, world.transformation, world.transformation.utime
        history = state.history
        sample = OdomSample(utime, odom.transformation.pose)
        if self._is_restarted(transformation.pose_epoch, odom):
            history = History(HISTORY_S if state.snapshot is None else state.snapshot.history_s)
            self._odom_samples.clear()
        period = (
            (utime - state.extrapolator.utime) * 1e-6
            if 0 < state.extrapolator.utime < utime
            else state.extrapolator.period
        )
        is_random_walk = self._filter_received == NEVER or now - self._filter_received > FILTER_TIMEOUT_US
        estimate = PublishedEstimate(utime, world, odom, self._find_velocity_baseline(sample), is_random_walk)
        # before the first motion sample the server publishes Odom without a covariance, and answers no vehicle query
        is_known = odom.transformation.covariance is not None
        if is_known and not history.is_too_soon(utime):
            history = history.append(estimate)
        snapshot, received, other = state.snapshot, state.geometry_received, ""
        if snapshot is not None:
            if transformation.model_revision == snapshot.model.revision:
                received = now
            elif not self._keep_geometry:
                other = transformation.model_revision or "(unnamed)"
        self._replace(
            history=history,
            extrapolator=PoseExtrapolator(estimate, period),
            pose_received=now if is_known else state.pose_received,
            geometry_received=received,
            clock_offset=self._estimate_clock_offset(utime, now),
            other_revision=other,
        )

    def _find_velocity_baseline(self, sample: OdomSample) -> OdomSample | None:
        """Return the earlier pose in Odom for the velocity at this one, which is stored."""
        samples = self._odom_samples
        while samples and samples[-1].utime >= sample.utime:
            samples.pop()  # superseded, or the clock was set back
        while len(samples) > 1 and samples[1].utime <= sample.utime - MIN_SPAN_US:
            samples.popleft()
        found = samples[0] if samples else None
        samples.append(sample)
        if found is None or not MIN_SPAN_US <= sample.utime - found.utime <= MAX_SPAN_US:
            return None
        return found

    def _is_restarted(self, epoch: int, odom: PoseAnswer) -> bool:
        """Return whether the server was restarted since the last pose; see the module."""
        last, self._last_odom = self._last_odom, odom.transformation
        epoch, self._epoch = self._epoch, epoch
        if last is None:
            return False
        seconds = (odom.transformation.utime - last.utime) * 1e-6
        far = last.pose.distance(odom.transformation.pose)[0]
        if self._epoch < epoch or far > MAX_SPEED * max(seconds, MIN_SPAN_US * 1e-6):
            return True
        if seconds < MIN_RESTART_S or last.covariance is None or odom.transformation.covariance is None:
            return False
        # within one run it only grows
        before, after = np.trace(last.covariance[:3, :3]), np.trace(odom.transformation.covariance[:3, :3])
        return bool(after < 0.5 * before)

    # --- joints

    def _process_joints(self, sample: JointsSample, now: int, snapshot: ModelSnapshot) -> None:
        state = self.state
        if snapshot.joints_latency_us:
            utime = max(1, sample.header.utime - snapshot.joints_latency_us)
            sample = replace(sample, header=replace(sample.header, utime=utime))
        service = state.get_service_time(now)
        if self._has_snapshot_clock and sample.header.utime > service + FUTURE_TOLERANCE_US:
            self._reject(snapshot.joints_channel, "future")
            return
        # the server accepted it, and its clock is known only roughly here
        joints, reasons = state.joints.update(sample, max(service, sample.header.utime))
        for reason in reasons:
            self._reject(snapshot.joints_channel, quote(reason, 120))
        if joints is not state.joints:
            self._replace(joints=joints, joints_received=now)

    def _process_held_joints(self, sample: JointsSample, now: int) -> None:
        """Restore joint positions from before this client listened; they do not count as received now."""
        state = self.state
        if sample.header.utime > state.get_service_time(now) + FUTURE_TOLERANCE_US:
            self._reject(self._held_joints_channel, "future")
            return
        joints = state.joints.restore(sample)
        if joints is not state.joints:
            self._replace(joints=joints)
