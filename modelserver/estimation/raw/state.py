"""State of raw mode at the newest sample."""

from __future__ import annotations

from typing import NamedTuple

from modelserver.estimation.origin import OriginCapture, OriginProjection
from modelserver.estimation.raw.fixes import FixMonitor
from modelserver.estimation.raw.heading import Heading
from modelserver.estimation.raw.motion import RawMotion, interpolate_motion
from modelserver.estimation.raw.settings import RawSettings
from modelserver.estimation.raw.stamps import StampMonitor
from modelserver.estimation.raw.stationary import QuietDetector
from modelserver.estimation.sensor_rig import Mounts
from modelserver.messages import Origin


class RawState(NamedTuple):
    """State of raw mode. A NamedTuple, because a new one is made for every sample.

    Attributes
    ----------
    projection, capture: of the origin; None until it is set, and the fixes collected for it.
    motion, history: newest motion, and those of the last seconds for delayed fixes.
    tilt_bias: biases of the roll and pitch gyros, rad/s.
    imu_utime: of the last IMU sample.
    is_clock_stepped: whether the clock was set back and the heading has not been found since.
    newest: instant of the newest sample, 0 before the first.
    """

    mounts: Mounts
    settings: RawSettings
    projection: OriginProjection | None = None
    motion: RawMotion | None = None
    history: tuple[RawMotion, ...] = ()
    heading: Heading = Heading()
    quiet: QuietDetector = QuietDetector()
    tilt_bias: tuple[float, float] = (0.0, 0.0)
    fixes: FixMonitor = FixMonitor()
    capture: OriginCapture = OriginCapture()
    imu_stamps: StampMonitor = StampMonitor()
    gps_stamps: StampMonitor = StampMonitor()
    imu_utime: int | None = None
    pose_epoch: int = 0
    is_clock_stepped: bool = False
    newest: int = 0

    @property
    def origin(self) -> Origin | None:
        """The origin of World:UTM, None before it is set."""
        return None if self.projection is None else self.projection.geodesy.origin

    def get_motion_at(self, utime: int, newest: RawMotion) -> RawMotion:
        """Return the motion at an instant: predicted from the newest, or from the history."""
        if utime >= newest.utime or not self.history:
            return newest.propagate(utime, newest.rate, self.settings)
        after = newest
        for motion in reversed(self.history):
            if motion.utime <= utime:
                return interpolate_motion(motion, after, utime)
            after = motion
        return after
