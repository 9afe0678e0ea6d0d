"""Track: speed and course from recent fixes, the last good fix as anchor of the position, and the jump gate.

Let u be the integral of the unit vector along Odom's heading (`RawMotion.path`), as a complex number. A vehicle of
constant speed v, whose heading is Odom's plus b, is at p = p_0 + v exp(ib) u. So c = v exp(ib) is the straight-line fit

    c = sum conj(u_i - mean u) (p_i - mean p) / sum |u_i - mean u|^2,   variance s^2 / sum |u_i - mean u|^2     (1)

of fixes p_i with noise s, on curves as on straights. The lever arm of the antenna, exp(ib) w_i, is subtracted first.
`filter.heading_alignment` fits the same line once per fix; here running sums give the fits of all segments that end
at the newest fix, of which the best is used.

Speed: noise falls with the length T of the segment. But a fit gives the speed T/2 ago, which has changed by about
`usual_acceleration` T/2 since: the segment with the smallest sum of both is used.
Course: beside the noise of the fit, sigma includes the time-correlated part of the error of a fix, which changes by
sigma sqrt(2 (1 - exp(-T / tau))) over the segment, and the turn, in which speed is not constant.

Anchor: p_base = p_antenna + exp(ib) (travel in Odom since the fix - lever arm at the fix)                      (2)

Jump gate: a fix is off its prediction by no more than noise and what the vehicle can do, `compute_jump_limit`.
`jump_fixes` that agree for `jump_time` confirm a jump: multipath on a moving vehicle changes within a few seconds.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

from modelserver.estimation.fix_quality import AcceptedFix
from modelserver.estimation.raw.motion import RawMotion, to_level_axes
from modelserver.estimation.raw.settings import RawSettings
from modelserver.transforms.so3 import Vector3

MAX_TRACK_FIXES: Final = 32
"""Fixes stored: of a longer segment every second one is dropped."""

MAX_AGE: Final = 1e4
"""Seconds of the age of a fix that count: a stamp may be wrong by years."""


class TrackFix(NamedTuple):
    """A fix of the antenna, all horizontal and complex (east + i north of the working frame), meters.

    Attributes
    ----------
    position, sigma: of the fix, and of each of its axes.
    path: `RawMotion.path` at its instant, seconds.
    lever: lever arm of the antenna along Odom's axes.
    yaw: in Odom, rad.
    """

    utime: int
    position: complex
    sigma: float
    path: complex
    lever: complex
    yaw: float


class SpeedFit(NamedTuple):
    """A fit of equation (1).

    Attributes
    ----------
    velocity, sigma: c and the sigma of each of its components, m/s.
    seconds, length, turned: duration of the segment, distance travelled (m) and angle turned (rad).
    """

    velocity: complex
    sigma: float
    seconds: float
    length: float
    turned: float


# --- fits ---------------------------------------------------------------------------------------------------


def append_fix(fixes: tuple[TrackFix, ...], fix: TrackFix, window: float) -> tuple[TrackFix, ...]:
    """Return a segment with one fix more, no longer than `window` seconds, and thinned if it has too many."""
    oldest = fix.utime - int(window * 1e6)
    segment = tuple(each for each in fixes if each.utime >= oldest)
    return (*(segment[::2] if len(segment) >= MAX_TRACK_FIXES else segment), fix)


def fit_speeds(fixes: Sequence[TrackFix], direction: complex, settings: RawSettings) -> Iterator[SpeedFit]:
    """Yield the fits of the last 2, 3, ... fixes; `direction` is exp(ib), or 0 to leave the lever arm in."""
    if len(fixes) < 2:
        return
    newest = fixes[-1]
    n, su, sp, suu, sup, ss = 0, 0j, 0j, 0.0, 0j, 0.0
    turned, yaw = 0.0, newest.yaw
    last_position = newest.position - direction * newest.lever
    for fix in reversed(fixes):
        u = fix.path - newest.path
        p = fix.position - direction * fix.lever - last_position
        n += 1
        su += u
        sp += p
        suu += u.real * u.real + u.imag * u.imag
        sup += u.conjugate() * p
        ss += fix.sigma
        turned += abs(fix.yaw - yaw)
        yaw = fix.yaw
        spread = suu - (su.real * su.real + su.imag * su.imag) / n
        if n < 2 or spread < 1e-6:
            continue
        velocity = (sup - su.conjugate() * sp / n) / spread
        noise = settings.fix_noise_share * ss / n
        seconds = (newest.utime - fix.utime) * 1e-6
        yield SpeedFit(velocity, noise / math.sqrt(spread), seconds, abs(velocity) * abs(u), turned)


def fit_best_speed(fixes: Sequence[TrackFix], direction: complex, settings: RawSettings) -> SpeedFit | None:
    """Return the fit with the smallest error of the present speed; its sigma includes the change of speed since."""
    best: SpeedFit | None = None
    for fit in fit_speeds(fixes, direction, settings):
        if fit.seconds > settings.speed_window:
            break
        sigma = math.hypot(fit.sigma, 0.5 * settings.usual_acceleration * fit.seconds)
        if best is None or sigma < best.sigma:
            best = fit._replace(sigma=sigma)
    return best


def fit_course(
    fixes: Sequence[TrackFix], direction: complex | None, settings: RawSettings
) -> tuple[float, float] | None:
    """Return the heading offset b of the whole segment and its sigma, rad; None if it does not show one."""
    fit = _fit_whole(fixes, direction or 0j, settings)
    if direction is None:
        # the lever arm turns with the heading to be found: two iterations converge
        for _ in range(2):
            if fit is None or abs(fit.velocity) < 1e-9:
                return None
            fit = _fit_whole(fixes, fit.velocity / abs(fit.velocity), settings)
    if fit is None or fit.length < 1e-9:
        return None
    correlated = math.sqrt(max(1.0 - settings.fix_noise_share**2, 0.0)) * fixes[-1].sigma
    changed = correlated * math.sqrt(-2.0 * math.expm1(-fit.seconds / settings.fix_correlation_time))
    turn = settings.course_turn_share * fit.turned
    return cmath.phase(fit.velocity), math.hypot(fit.sigma / abs(fit.velocity), changed / fit.length, turn)


def _fit_whole(fixes: Sequence[TrackFix], direction: complex, settings: RawSettings) -> SpeedFit | None:
    fit = None
    for fit in fit_speeds(fixes, direction, settings):  # noqa: B007
        pass
    return fit


def is_slow(fixes: Sequence[TrackFix], settings: RawSettings) -> bool:
    """Return whether by its fixes the vehicle may be stationary.

    The segment is the shortest that resolves a third of `stationary_speed`, or else all fixes if they resolve that.
    """
    found: SpeedFit | None = None
    for fit in fit_speeds(fixes, 0j, settings):
        # the path of a stationary vehicle is straight at 1 m/s, thus time: the fit is its velocity
        if fit.seconds >= settings.stationary_time and fit.sigma <= settings.stationary_speed:
            found = fit
            if fit.sigma <= settings.stationary_speed / 3.0:
                break
    return found is not None and abs(found.velocity) <= 2.0 * settings.stationary_speed


# --- anchor -------------------------------------------------------------------------------------------------


class FixAnchor(NamedTuple):
    """The last good fix, and the motion of the base frame at its instant.

    Attributes
    ----------
    position, up: of the antenna in the working frame, east + i north and height, m.
    lever, lever_up: lever arm of the antenna along Odom's axes, horizontal and up, m.
    """

    utime: int
    position: complex
    up: float
    fix: AcceptedFix
    motion: RawMotion
    lever: complex
    lever_up: float

    def propagate_base(self, motion: RawMotion, direction: complex) -> tuple[complex, float, complex]:
        """Propagate the base frame to `motion` by equation (2): position and height in the working frame.

        The third value is the arm from the antenna at the fix to the base frame, which an error of heading turns.
        """
        then = self.motion
        arm = direction * (complex(motion.x - then.x, motion.y - then.y) - self.lever)
        return self.position + arm, self.up - self.lever_up + motion.z - then.z, arm


def compute_lever_arm(motion: RawMotion, lever: Vector3) -> tuple[complex, float]:
    """Return a vector of the base axes along Odom's axes: horizontal, and up."""
    x, y, z = to_level_axes(motion.up, lever)
    return complex(x, y) * complex(math.cos(motion.yaw), math.sin(motion.yaw)), z


def compute_growth(age: float, speed_sigma: float, settings: RawSettings) -> float:
    """Return the variance of each axis that a prediction over `age` seconds adds, m2: (s_v t)^2 + (a t^2 / 2)^2."""
    t = min(age, MAX_AGE)
    return (speed_sigma * t) ** 2 + (0.5 * settings.usual_acceleration * t * t) ** 2


# --- jump gate ----------------------------------------------------------------------------------------------


class JumpMonitor(NamedTuple):
    """A run of `num_fixes` rejected fixes that agree, the first at `since`, the last at `utime` and `position`."""

    num_fixes: int = 0
    utime: int = 0
    position: complex = 0j
    since: int = 0

    def reject(self, fix: FixAnchor, settings: RawSettings) -> JumpMonitor:
        """Return the monitor after a rejected fix: a longer run if it agrees with the last one, else a new run."""
        dt = abs(fix.utime - self.utime) * 1e-6
        reach = settings.maximum_speed * dt + settings.jump_sigmas * math.sqrt(2.0) * fix.fix.sigma
        agrees = self.num_fixes > 0 and abs(fix.position - self.position) <= reach
        return JumpMonitor(
            self.num_fixes + 1 if agrees else 1, fix.utime, fix.position, self.since if agrees else fix.utime
        )

    def is_confirmed(self, settings: RawSettings) -> bool:
        """Return whether the run is long enough, in fixes and in time, to be right against the prediction."""
        return self.num_fixes >= settings.jump_fixes and (self.utime - self.since) * 1e-6 >= settings.jump_time


def compute_jump_limit(
    dt: float, sigma_before: float, sigma: float, speed_sigma: float | None, settings: RawSettings
) -> float:
    """Return how far a fix may be off its prediction `dt` seconds after the last good one, m.

    `speed_sigma` is that of the predicted speed; None: the speed is unknown, up to the maximum.
    """
    noise = settings.jump_sigmas * math.hypot(sigma_before, sigma)
    reach = settings.maximum_speed * dt
    if speed_sigma is None:
        return noise + reach
    return noise + min(reach, 0.5 * settings.maximum_acceleration * dt * dt + settings.jump_sigmas * speed_sigma * dt)
