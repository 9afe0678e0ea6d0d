"""Switching between the filter and raw mode while running: Odom goes on without a step, and the pose is handed over."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from modelserver.localization.filter.localizer import Deferred, FilterLocalizer
from modelserver.localization.filter.setup import Setup
from modelserver.localization.interface import Note
from modelserver.localization.mounts import Mounts
from modelserver.localization.raw.heading import Heading
from modelserver.localization.raw.localizer import RawLocalizer
from modelserver.localization.raw.settings import RawSettings
from modelserver.messages import (
    Decision,
    Estimate,
    Invalid,
    Kept,
    LocalizerSummary,
    Mode,
    NavigationState,
    Origin,
    Recalled,
    Rejected,
    Sample,
    SwitchMode,
    Verdict,
)
from modelserver.spatial import so3
from modelserver.spatial.pose import Pose

SPEED_SPAN_US = 100_000
"""Microseconds of Odom from which the speed is read that the filter begins with."""


@dataclass(frozen=True, slots=True)
class Makings:
    """What each localizer is made of; `mounts` is None where raw mode lacks a GPS or an inertial unit."""

    setup: Setup
    raw: RawSettings
    mounts: Mounts | None


@dataclass(frozen=True, slots=True)
class ModeLocalizer:
    """One localizer for all modes: an immutable value. Make the first with `start`.

    `active` is the filter or raw mode. `X_odom` leads from its Odom to the one that has been spoken of since the start,
    `epochs` are those counted by the localizers before it, and `drift` the 36 numbers that Odom's covariance had
    reached with them.
    """

    makings: Makings
    active: FilterLocalizer | RawLocalizer
    X_odom: Pose
    epochs: int = 0
    drift: tuple[float, ...] = ()

    @classmethod
    def start(
        cls, makings: Makings, mode: Mode, origin: Origin | None = None, recalled: Recalled | None = None
    ) -> ModeLocalizer:
        """Return a localizer that has seen nothing yet; `recalled` is what an earlier run kept, where it may be used.

        Raises GeodesyError for an origin that is no place, ValueError for raw mode without GPS or inertial unit.
        """
        if mode is Mode.RAW:
            if makings.mounts is None:
                raise ValueError("raw mode takes a GPS and an inertial unit")
            return cls(makings, RawLocalizer.start(makings.mounts, makings.raw, origin), Pose.identity())
        return cls(makings, FilterLocalizer.start(makings.setup, origin, mode, recalled), Pose.identity())

    @property
    def utime(self) -> int:
        """The instant of the newest sample taken, 0 before the first."""
        return self.active.utime

    def take(self, sample: Sample | SwitchMode) -> tuple[ModeLocalizer, tuple[Note, ...]]:
        """Return what is concluded with one sample more, and what there is to say about it."""
        raw = isinstance(self.active, RawLocalizer)
        if isinstance(sample, SwitchMode) and (raw or sample.mode is Mode.RAW):
            return self._switched(sample)
        active, notes = self.active.take(sample)
        if active is self.active:
            return self, notes
        return ModeLocalizer(self.makings, active, self.X_odom, self.epochs, self.drift), notes

    def estimate(self, utime: int) -> Estimate:
        """Return the pose at `utime`, in the Odom that has been spoken of since the start."""
        return self._continued(self.active.estimate(utime))

    def deferred(self, utime: int) -> Estimate | Deferred:
        """Return `estimate(utime)`, to be worked out when it is looked at where that saves work."""
        if isinstance(self.active, FilterLocalizer) and not self.epochs:
            return self.active.deferred(utime)
        return self.estimate(utime)

    def navigation(self, utime: int) -> NavigationState | None:
        """Return the filter's whole state; None in raw mode."""
        return self.active.navigation(utime)

    def kept(self) -> Kept | None:
        """Return what the next run should know; None where it is no better than what was kept before."""
        return self.active.kept() if isinstance(self.active, FilterLocalizer) else None

    def silence(self, utime: int) -> Invalid:
        """Return what of SILENCE speaks against an estimate at `utime`."""
        return self.active.silence(utime)

    def summary(self, utime: int) -> LocalizerSummary:
        """Return what the localizer at work is about."""
        found = self.active.summary(utime)
        if isinstance(self.active, RawLocalizer):
            found = found._replace(findings=self.makings.setup.findings[Mode.RAW])
        return found

    def _continued(self, estimate: Estimate) -> Estimate:
        if not self.epochs:
            return estimate
        return replace(
            estimate,
            odom=self.X_odom @ estimate.odom,
            odom_covariance=_grown(self.drift, estimate),
            pose_epoch=estimate.pose_epoch + self.epochs,
        )

    def _switched(self, wish: SwitchMode) -> tuple[ModeLocalizer, tuple[Note, ...]]:
        """Return the localizer with the other one at work, begun from what this one knows."""
        raw = isinstance(self.active, RawLocalizer)
        if raw == (wish.mode is Mode.RAW):
            return self, ()
        if wish.mode is Mode.RAW and self.makings.mounts is None:
            return self, (Rejected(f"command:{wish.header.source}", "no_raw_mode"),)
        word = Decision(
            self.active.utime,
            wish.header.source,
            wish.header.seq,
            "mode",
            Verdict.TOOK_UP,
            f"mode {wish.mode.name.lower()}",
        )
        return self._begun(self.makings, wish.mode), (word,)

    def remade(self, makings: Makings) -> ModeLocalizer:
        """Return the localizer of a vehicle whose geometry has changed.

        Where nothing that localization rests on has moved it goes on; else it begins anew from what is known, in a new
        pose epoch: Odom goes on without a step.
        """
        old, active = self.makings, self.active
        if old.mounts == makings.mounts and old.setup.rig.places() == makings.setup.rig.places():
            if isinstance(active, FilterLocalizer):
                active = replace(active, setup=makings.setup)
            return replace(self, makings=makings, active=active)
        if not active.utime:
            mode = active.mode if isinstance(active, FilterLocalizer) else Mode.RAW
            fresh = ModeLocalizer.start(makings, mode, self.estimate(0).origin)
            return replace(fresh, X_odom=self.X_odom, epochs=self.epochs, drift=self.drift)
        return self._begun(makings, active.mode if isinstance(active, FilterLocalizer) else Mode.RAW)

    def _begun(self, makings: Makings, mode: Mode) -> ModeLocalizer:
        """Return the localizer of a mode, begun from what is known."""
        utime = self.active.utime
        last = self.estimate(utime)
        active: FilterLocalizer | RawLocalizer
        if mode is Mode.RAW:
            assert makings.mounts is not None
            active = _raw_from(RawLocalizer.start(makings.mounts, makings.raw, last.origin), last)
            # raw mode's Odom begins level at its first sample: tilt is the unit's own
            yaw = math.atan2(*_heading(last.odom))
            X_odom = Pose.from_rpy(last.odom.xyz, 0.0, 0.0, yaw)
        else:
            before = self.estimate(utime - SPEED_SPAN_US)
            active = FilterLocalizer.start(makings.setup, last.origin, mode).begun_from(last, before)
            if active.odom.started:
                X_odom = last.odom @ active.odom.pose(utime).inverse()
            else:
                # its Odom will begin with the vehicle's tilt and yaw 0
                X_odom = Pose.from_rpy(last.odom.xyz, 0.0, 0.0, math.atan2(*_heading(last.odom)))
        return ModeLocalizer(makings, active, X_odom, last.pose_epoch + 1, last.odom_covariance or self.drift)


def _grown(drift: tuple[float, ...], estimate: Estimate) -> tuple[float, ...] | None:
    """Return Odom's covariance with what it had drifted before: sigmas add up, or variances where it walks.

    Tilt does not drift: it is that of the localizer at work.
    """
    own = estimate.odom_covariance
    if own is None or not drift:
        return own
    numbers = list(own)
    for place in (0, 7, 14, 35):
        if estimate.odom_walks:
            numbers[place] = drift[place] + own[place]
        else:
            numbers[place] = (math.sqrt(drift[place]) + math.sqrt(own[place])) ** 2
    return tuple(numbers)


def _heading(pose: Pose) -> tuple[float, float]:
    """Return sine and cosine (times its level part) of a pose's yaw."""
    x, y, _ = so3.rotate(pose.wxyz, (1.0, 0.0, 0.0))
    return y, x


def _raw_from(fresh: RawLocalizer, last: Estimate) -> RawLocalizer:
    """Return raw mode knowing the heading that the filter knew, where that was good; its Odom's yaw begins with 0."""
    if last.enu is None or last.covariance is None or last.invalid:
        return fresh
    heading = Heading(
        known=True,
        offset=math.atan2(*_heading(last.enu)),
        variance=last.covariance[35],
        bias_variance=fresh.heading.bias_variance,
    )
    return replace(fresh, heading=heading)
