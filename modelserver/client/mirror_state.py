"""The replica of a vehicle's geometry, poses and joints that a mirror builds from messages. No socket, no clock.

`MirrorReceiver.feed` processes one message and replaces `state`, an immutable `MirrorState` that queries read.

- Geometry: MODEL_SNAPSHOT, assembled from its parts. POSE carries the model revision, which confirms it or shows that
  another one is in force.
- Poses: POSE and POSE_ODOM of one time form an estimate in the history (`extrapolation`).
- Joints: JOINTS as the server receives it; JOINTS_HELD for positions from before this client listened.

Clocks: `now` is the receive time on a monotonic clock, microseconds; ages are measured with it. Stamps are in the
server's clock. Its offset is exact when a snapshot arrives (stamped when sent), and else the largest seen (a pose may
be stamped in the past).

A restart of the server resets Odom. It is detected by a lower pose epoch, an impossible speed in Odom, or, after a
pause of `MIN_RESTART_S`, an Odom covariance that shrank.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import numpy as np

from modelserver.client.extrapolation import MAX_SPAN_US, MIN_SPAN_US, OdomSample, PoseExtrapolator, PublishedEstimate
from modelserver.errors import WireError, quote
from modelserver.estimation.history import History
from modelserver.formats.yaml_geometry import ModelSnapshot, decode_snapshot
from modelserver.geometry import names
from modelserver.joints.history import NO_JOINTS, JointHistory
from modelserver.messages import JointsSample, PoseAnswer, SnapshotPart
from modelserver.query import PlatformView
from modelserver.transforms.transformation import Transformation
from modelserver.wire.codec import decode
from modelserver.wire.snapshot import SnapshotAssembler

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
