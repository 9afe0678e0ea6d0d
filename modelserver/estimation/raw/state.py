"""What raw mode knows: all that has been concluded from the samples so far."""

from __future__ import annotations

import cmath
from dataclasses import dataclass, field

from modelserver.estimation.origin import OriginCapture, OriginProjection
from modelserver.estimation.raw.fixes import FixMonitor
from modelserver.estimation.raw.heading import Heading
from modelserver.estimation.raw.motion import RawMotion, interpolate_motion
from modelserver.estimation.raw.settings import RawSettings
from modelserver.estimation.raw.stamps import StampMonitor
from modelserver.estimation.raw.stationary import QuietDetector
from modelserver.estimation.sensor_rig import Mounts
from modelserver.messages import Origin


@dataclass(frozen=True, slots=True)
class RawState:
    """The state of raw mode, immutable; `RawLocalizer` leads from one to the next."""

    mounts: Mounts
    settings: RawSettings
    projection: OriginProjection | None = None
    motion: RawMotion | None = None
    history: tuple[RawMotion, ...] = field(default=(), repr=False)
    heading: Heading = field(default_factory=Heading)
    quiet: QuietDetector = field(default_factory=QuietDetector)
    tilt_bias: tuple[float, float] = (0.0, 0.0)
    fixes: FixMonitor = field(default_factory=FixMonitor)
    capture: OriginCapture = field(default_factory=OriginCapture)
    imu_stamps: StampMonitor = field(default_factory=StampMonitor)
    gps_stamps: StampMonitor = field(default_factory=StampMonitor)
    imu_utime: int | None = None
    pose_epoch: int = 0
    is_clock_stepped: bool = False
    newest: int = 0

    @property
    def origin(self) -> Origin | None:
        """The origin of World:UTM, None before it is set."""
        return None if self.projection is None else self.projection.geodesy.origin

    def get_motion_at(self, utime: int, newest: RawMotion) -> RawMotion:
        """Return the motion at `utime`: predicted from `newest`, or looked up in what is kept."""
        if utime >= newest.utime or not self.history:
            return newest.advance(utime, newest.rate, self.settings)
        after = newest
        for motion in reversed(self.history):
            if motion.utime <= utime:
                return interpolate_motion(motion, after, utime)
            after = motion
        return after

    @property
    def direction(self) -> complex:
        """exp(i offset): turns Odom's horizontal axes to east and north; 1 before heading is known."""
        return cmath.rect(1.0, self.heading.offset) if self.heading.is_known else 1.0 + 0j
