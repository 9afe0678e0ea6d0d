"""The last good fix as an anchor for the pose, and the test whether the next one is a jump."""

from __future__ import annotations

import math
from dataclasses import dataclass

from modelserver.estimation.fix_quality import AcceptedFix
from modelserver.estimation.raw.motion import Motion, levelled
from modelserver.estimation.raw.settings import RawSettings
from modelserver.transforms.so3 import Vector3


@dataclass(frozen=True, slots=True)
class Anchor:
    """The antenna at the last good fix, in the working frame, and the base frame's motion then.

    `lever` is the antenna's lever arm along Odom's axes at that instant: horizontal part and height.
    """

    utime: int
    place: complex
    up: float
    fix: AcceptedFix
    motion: Motion
    lever: complex
    lever_up: float

    def base(self, motion: Motion, direction: complex) -> tuple[complex, float, complex]:
        """Return the base frame's place and height in the working frame as carried to `motion`.

        p_base = p_antenna + exp(ib) (Odom's way since the fix - lever arm at the fix); the third value is that
        arm, which an error of heading turns.
        """
        then = self.motion
        arm = direction * (complex(motion.x - then.x, motion.y - then.y) - self.lever)
        return self.place + arm, self.up - self.lever_up + motion.z - then.z, arm


def lever_arm(motion: Motion, lever: Vector3) -> tuple[complex, float]:
    """Return a lever arm of the base frame along Odom's axes: horizontal, and up."""
    x, y, z = levelled(motion.up, lever)
    return complex(x, y) * complex(math.cos(motion.yaw), math.sin(motion.yaw)), z


@dataclass(frozen=True, slots=True)
class Jumps:
    """A run of refused fixes that agree: `count` of them, the first at `since`, the last at `utime` and `place`."""

    count: int = 0
    utime: int = 0
    place: complex = 0j
    since: int = 0

    def refused(self, utime: int, place: complex, sigma: float, settings: RawSettings) -> Jumps:
        """Return the run with one more refused fix: longer where it agrees with the last, else begun anew."""
        dt = abs(utime - self.utime) * 1e-6
        reach = settings.maximum_speed * dt + settings.jump_sigmas * math.sqrt(2.0) * sigma
        agrees = self.count > 0 and abs(place - self.place) <= reach
        return Jumps(self.count + 1, utime, place, self.since) if agrees else Jumps(1, utime, place, utime)

    def believed(self, settings: RawSettings) -> bool:
        """Return whether the run is long enough, in fixes and in time, to be right against the prediction."""
        return self.count >= settings.jump_fixes and (self.utime - self.since) * 1e-6 >= settings.jump_time


def jump_limit(dt: float, sigma_before: float, sigma: float, speed_sigma: float | None, settings: RawSettings) -> float:
    """Return how far a fix may be off its prediction, metres, `dt` seconds after the last good one.

    `speed_sigma` is that of the speed the prediction was made with, None where there was none: then the
    vehicle may have gone anywhere at its maximum speed.
    """
    noise = settings.jump_sigmas * math.hypot(sigma_before, sigma)
    anywhere = settings.maximum_speed * dt
    if speed_sigma is None:
        return noise + anywhere
    carried = 0.5 * settings.maximum_acceleration * dt * dt + settings.jump_sigmas * speed_sigma * dt
    return noise + min(anywhere, carried)
