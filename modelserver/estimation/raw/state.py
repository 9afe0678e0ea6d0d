"""What raw mode knows: all that has been concluded from the samples so far."""

from __future__ import annotations

import cmath
from dataclasses import dataclass, field

from modelserver.estimation.origin import OriginCapture, OriginProjection
from modelserver.estimation.raw.fixes import Fixes
from modelserver.estimation.raw.heading import Heading
from modelserver.estimation.raw.motion import Motion, between
from modelserver.estimation.raw.settings import RawSettings
from modelserver.estimation.raw.stamps import Stamps
from modelserver.estimation.raw.still import Stillness
from modelserver.estimation.sensor_rig import Mounts
from modelserver.messages import Origin


@dataclass(frozen=True, slots=True)
class RawState:
    """The state of raw mode, immutable; `RawLocalizer` leads from one to the next."""

    mounts: Mounts
    settings: RawSettings
    projected: OriginProjection | None = None
    motion: Motion | None = None
    history: tuple[Motion, ...] = field(default=(), repr=False)
    heading: Heading = field(default_factory=Heading)
    stillness: Stillness = field(default_factory=Stillness)
    tilt_bias: tuple[float, float] = (0.0, 0.0)
    fixes: Fixes = field(default_factory=Fixes)
    capture: OriginCapture = field(default_factory=OriginCapture)
    imu_stamps: Stamps = field(default_factory=Stamps)
    gps_stamps: Stamps = field(default_factory=Stamps)
    imu_utime: int | None = None
    pose_epoch: int = 0
    stepped: bool = False
    newest: int = 0

    @property
    def origin(self) -> Origin | None:
        """The origin of World:UTM, None before it is set."""
        return None if self.projected is None else self.projected.geodesy.origin

    def motion_at(self, utime: int, newest: Motion) -> Motion:
        """Return the motion at `utime`: predicted from `newest`, or looked up in what is kept."""
        if utime >= newest.utime or not self.history:
            return newest.advanced(utime, newest.rate, self.settings)
        after = newest
        for motion in reversed(self.history):
            if motion.utime <= utime:
                return between(motion, after, utime)
            after = motion
        return after

    @property
    def direction(self) -> complex:
        """exp(i offset): turns Odom's horizontal axes to east and north; 1 before heading is known."""
        return cmath.rect(1.0, self.heading.offset) if self.heading.known else 1.0 + 0j
