"""What one knows of a vehicle who only listens: geometry, poses and joints as the bus tells them. No socket, no clock.

Two clocks meet here. `now` is when a message was received, microseconds on any clock that goes evenly: it tells how old
knowledge is. The stamps in the messages are the service's; what its clock says now follows from the newest of them.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Final, NamedTuple

import numpy as np

from modelserver.client.told import LONGEST_SPAN_US, SHORTEST_SPAN_US, Carried, PublishedEstimate, Stand
from modelserver.errors import WireError, shown
from modelserver.formats.snapshot import ModelSnapshot, read
from modelserver.geometry import names
from modelserver.history import History
from modelserver.joints.joints import NO_JOINTS, Joints
from modelserver.messages import JointsSample, PoseAnswer, SnapshotPart
from modelserver.platform import PlatformView
from modelserver.spatial.transformation import Transformation
from modelserver.wire.codec import decode
from modelserver.wire.snapshot import SnapshotAssembler

HISTORY_S: Final = 60.0
"""Poses held until the snapshot says for how long the service holds them."""

AHEAD_US: Final = 1_000_000
"""A joint stamped this far ahead of the service's clock is refused; a snapshot no farther behind was overtaken."""

FILTER_US: Final = 2_000_000
"""So long after a state of the filter it is taken to be at work."""

FASTEST: Final = 200.0
"""m/s; who moves faster in Odom did not move: another run of the service counts from another place."""

RESTART_S: Final = 0.3
"""A service that is started anew is silent for longer."""

MAX_COUNTERS: Final = 256
"""Distinct causes of refusal that are told apart; further ones are counted together."""

NEVER: Final = -1
"""When a thing was heard of that never was."""


class Ages(NamedTuple):
    """Seconds since the geometry was confirmed, a pose came, a joint was told of; infinite for never."""

    geometry: float
    pose: float
    joints: float


@dataclass(frozen=True, slots=True, eq=False)
class Known:
    """What is known at one instant. Immutable, but for `still` and `answers`, which are filled as they are asked for.

    view: what answers, None before a whole snapshot has come. `*_heard`: when, on the clock of reception; NEVER.
    offset: what the service's clock is ahead of that of reception, microseconds. other_revision: of the geometry that
    the newest pose rests on, where that is not the one known. still, answers: what does not move within the vehicle.
    """

    view: PlatformView | None = None
    snapshot: ModelSnapshot | None = None
    history: History = field(default_factory=lambda: History(HISTORY_S))
    carried: Carried = field(default_factory=Carried)
    joints: Joints = NO_JOINTS
    geometry_heard: int = NEVER
    pose_heard: int = NEVER
    joints_heard: int = NEVER
    offset: int = 0
    other_revision: str = ""
    still: dict[tuple[str, str], Transformation] = field(default_factory=dict)
    answers: dict[tuple[str, str], PoseAnswer] = field(default_factory=dict)

    def ages(self, now: int) -> Ages:
        """Return how old each part of the knowledge is at an instant on the clock of reception."""
        heard = (self.geometry_heard, self.pose_heard, self.joints_heard)
        return Ages(*(math.inf if at == NEVER else (now - at) * 1e-6 for at in heard))

    def service_time(self, now: int) -> int:
        """Return the service's utime at an instant on the clock of reception."""
        return now + self.offset


class Knowledge:
    """Takes messages and holds what follows from them in `known`. What cannot be used is counted in `rejected`.

    With `given` the geometry is known beforehand; with `keeping` it stays, whatever poses say they rest on.
    """

    def __init__(self, channel_prefix: str = "", given: ModelSnapshot | None = None, keeping: bool = False):
        self.known = Known()
        self._pose = f"{channel_prefix}POSE"
        self._odom = f"{channel_prefix}POSE_ODOM"
        self._model = f"{channel_prefix}MODEL_SNAPSHOT"
        self._held = f"{channel_prefix}JOINTS_HELD"
        self._state = f"{channel_prefix}LOCALIZATION_STATE"
        self._keeping = keeping
        self._rejected: dict[tuple[str, str], int] = {}
        self._assembler = SnapshotAssembler()
        self._sent = 0  # stamp of the snapshot in hand
        self._bytes = b""
        self._world: PoseAnswer | None = None
        self._in_odom: PoseAnswer | None = None
        self._stands: deque[Stand] = deque()
        self._last: Transformation | None = None  # in Odom
        self._epoch = 0
        self._filter_heard = NEVER
        self._clock_read = False
        self._clock_sure = False
        if given is not None:
            self._learn(given)

    @property
    def channels(self) -> tuple[str, ...]:
        """The channels to listen to; that of the joints comes with the first snapshot."""
        always = (self._model, self._held, self._pose, self._odom, self._state)
        snapshot = self.known.snapshot
        return (*always, snapshot.joints_channel) if snapshot is not None else always

    @property
    def rejected(self) -> Mapping[tuple[str, str], int]:
        """What could not be used: how often, by channel and reason."""
        return MappingProxyType(self._rejected)

    def feed(self, channel: str, data: bytes, now: int) -> bool:
        """Take a message that was received at `now`; return whether more is known. Raises nothing."""
        before = self.known
        try:
            if channel == self._pose:
                self._take_pose(decode("pose_transform_t", data), now)
            elif channel == self._odom:
                self._take_odom(decode("pose_transform_t", data), now)
            elif channel == self._model:
                self._take_part(decode("model_snapshot_t", data), now)
            elif channel == self._state:
                # that there is one is all that matters: the filter is at work
                self._filter_heard = now
            elif before.snapshot is not None and channel == before.snapshot.joints_channel:
                self._take_joints(decode("joints_t", data), now, before.snapshot)
            elif before.snapshot is not None and channel == self._held:
                self._take_held(decode("joints_t", data), now, before.snapshot)
        except WireError as error:
            self._reject(channel, error.reason)
        return self.known is not before

    def _reject(self, channel: str, reason: str) -> None:
        key = (channel, reason)
        if key not in self._rejected and len(self._rejected) >= MAX_COUNTERS:
            key = ("*", "other")
        self._rejected[key] = self._rejected.get(key, 0) + 1

    def _offset(self, utime: int, now: int) -> int:
        """Return what the service's clock is ahead, told a stamp of it that may be behind it, as a pose's may."""
        told = utime - now
        if not self._clock_read:
            self._clock_read = True
            return told
        return max(told, self.known.offset)

    # --- geometry

    def _take_part(self, part: SnapshotPart, now: int) -> None:
        known = self.known
        # stamped when it was sent: this is what the service's clock said, also where it was set back
        offset, self._clock_read, self._clock_sure = part.utime - now, True, True
        confirmed = known.snapshot is not None and part.model_revision == known.snapshot.model.revision
        heard = now if confirmed else known.geometry_heard
        self.known = replace(known, offset=offset, geometry_heard=heard)
        if 0 < self._sent - part.utime < AHEAD_US:
            return  # overtaken on its way by a later one
        whole = self._assembler.add(part)
        if whole is None:
            return
        self._sent = part.utime
        if whole != self._bytes:
            snapshot = read(whole)
            self._bytes = whole
            if not self._keeping:
                self._learn(snapshot)
        self.known = replace(self.known, geometry_heard=now)

    def _learn(self, snapshot: ModelSnapshot) -> None:
        known = self.known
        if known.snapshot is None:
            joints = Joints(snapshot.model.joints.values(), snapshot.history_s)
        else:
            joints = known.joints.for_model(snapshot.model)
        history = known.history.lasting(snapshot.history_s)
        self.known = replace(
            known,
            snapshot=snapshot,
            history=history,
            joints=joints,
            view=_view(snapshot, known.carried, history, joints),
            other_revision="",
            still={},
            answers={},
        )

    # --- poses

    def _take_pose(self, pose: PoseAnswer, now: int) -> None:
        if self._is_foreign(pose, names.WORLD_UTM):
            self._reject(self._pose, "other frames")
            return
        self._world = pose
        self._pair(now)

    def _take_odom(self, pose: PoseAnswer, now: int) -> None:
        if self._is_foreign(pose, names.ODOM):
            self._reject(self._odom, "other frames")
            return
        self._in_odom = pose
        self._pair(now)

    def _is_foreign(self, pose: PoseAnswer, world: str) -> bool:
        """Whether a pose is not of this vehicle in that world. Of another revision the base frame may be another."""
        told, snapshot = pose.transformation, self.known.snapshot
        if told.frame_of_reference != world:
            return True
        return (
            snapshot is not None
            and told.model_revision == snapshot.model.revision
            and told.frame_of_interest != snapshot.base_frame
        )

    def _pair(self, now: int) -> None:
        """Take the poses in the world and in Odom that were sent together."""
        world, odom = self._world, self._in_odom
        if world is None or odom is None or world.transformation.utime != odom.transformation.utime:
            return
        self._world = self._in_odom = None
        known, told, utime = self.known, world.transformation, world.transformation.utime
        history = known.history
        stand = Stand(utime, odom.transformation.pose)
        if self._is_another_run(told.pose_epoch, odom):
            history = History(HISTORY_S if known.snapshot is None else known.snapshot.history_s)
            self._stands.clear()
        period = (utime - known.carried.utime) * 1e-6 if 0 < known.carried.utime < utime else known.carried.period
        walks = self._filter_heard == NEVER or now - self._filter_heard > FILTER_US
        estimate = PublishedEstimate(world, odom, self._earlier(stand), walks)
        # before it has heard of any motion the service answers no question about the vehicle, and broadcasts Odom's
        # beginning without a covariance
        is_known = odom.transformation.covariance is not None
        if is_known and not history.holds_enough(utime):
            history = history.extended(estimate)
        carried = Carried(estimate, period)
        snapshot, heard, other = known.snapshot, known.geometry_heard, ""
        if snapshot is not None:
            if told.model_revision == snapshot.model.revision:
                heard = now
            elif not self._keeping:
                other = told.model_revision or "that it does not name"
        self.known = replace(
            known,
            history=history,
            carried=carried,
            view=None if snapshot is None else _view(snapshot, carried, history, known.joints),
            pose_heard=now if is_known else known.pose_heard,
            geometry_heard=heard,
            offset=self._offset(utime, now),
            other_revision=other,
        )

    def _earlier(self, stand: Stand) -> Stand | None:
        """Return a pose in Odom to tell the velocity from, and keep this one for later."""
        stands = self._stands
        while stands and stands[-1].utime >= stand.utime:
            stands.pop()  # known better now, or the clock was set back
        while len(stands) > 1 and stands[1].utime <= stand.utime - SHORTEST_SPAN_US:
            stands.popleft()
        found = stands[0] if stands else None
        stands.append(stand)
        if found is None or not SHORTEST_SPAN_US <= stand.utime - found.utime <= LONGEST_SPAN_US:
            return None
        return found

    def _is_another_run(self, epoch: int, odom: PoseAnswer) -> bool:
        """Whether the service was started anew since the last pose: its Odom begins elsewhere."""
        last, self._last = self._last, odom.transformation
        epoch, self._epoch = self._epoch, epoch
        if last is None:
            return False
        seconds = (odom.transformation.utime - last.utime) * 1e-6
        far = last.pose.distance(odom.transformation.pose)[0]
        if self._epoch < epoch or far > FASTEST * max(seconds, SHORTEST_SPAN_US * 1e-6):
            return True
        if seconds < RESTART_S or last.covariance is None or odom.transformation.covariance is None:
            return False
        # within one run it only grows
        before, after = np.trace(last.covariance[:3, :3]), np.trace(odom.transformation.covariance[:3, :3])
        return bool(after < 0.5 * before)

    # --- joints

    def _take_joints(self, sample: JointsSample, now: int, snapshot: ModelSnapshot) -> None:
        known = self.known
        if snapshot.joints_latency_us:
            utime = max(1, sample.header.utime - snapshot.joints_latency_us)
            sample = replace(sample, header=replace(sample.header, utime=utime))
        service = known.service_time(now)
        if self._clock_sure and sample.header.utime > service + AHEAD_US:
            self._reject(snapshot.joints_channel, "future")
            return
        # the service took it, and its clock is known here but roughly
        joints, refused = known.joints.taken(sample, max(service, sample.header.utime))
        for why in refused:
            self._reject(snapshot.joints_channel, shown(why, 120))
        if joints is not known.joints:
            view = _view(snapshot, known.carried, known.history, joints)
            self.known = replace(known, joints=joints, view=view, joints_heard=now)

    def _take_held(self, sample: JointsSample, now: int, snapshot: ModelSnapshot) -> None:
        """Take what the service holds of joints: told before this listened. It does not make them heard of now."""
        known = self.known
        if sample.header.utime > known.service_time(now) + AHEAD_US:
            self._reject(self._held, "future")
            return
        joints = known.joints.recalled(sample)
        if joints is not known.joints:
            self.known = replace(known, joints=joints, view=_view(snapshot, known.carried, known.history, joints))


def _view(snapshot: ModelSnapshot, carried: Carried, history: History, joints: Joints) -> PlatformView:
    # the poses that are told are of the base frame: from there on all is the same, whatever frame rolls
    return PlatformView(snapshot.model, snapshot.base_frame, carried, history, snapshot.base_frame, joints=joints)
