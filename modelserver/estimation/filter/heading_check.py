"""Heading check of a warm start: the restored heading against the first meters driven and the fixes there.

Stationary wheels show that the vehicle did not turn by itself, not that nobody lifted it. A state with a wrong heading
and a small uncertainty would explain the fixes by their time-correlated error, and never find out.
"""

from __future__ import annotations

import cmath
import math
from typing import Final

from modelserver.estimation.filter.fusion import report_event
from modelserver.estimation.filter.heading_alignment import PathFix, Rotation
from modelserver.estimation.filter.persistence import WARM_START
from modelserver.estimation.filter.setup import Setup
from modelserver.estimation.filter.state import Aligned, HeadingCheck
from modelserver.messages import Decision, Verdict

MIN_DISTANCE: Final = 3.0
"""Meters from end to end that give a direction, and as many again per meter of the antenna from the middle."""

MAX_GAP: Final = 2.0
"""Seconds between two fixes beyond which the segment restarts."""

MOUNT_SIGMA: Final = 0.05
"""Radians by which path and heading may differ on a sound vehicle: side slip, and the survey of the frames."""


def update(
    setup: Setup, state: Aligned, newest: PathFix
) -> tuple[HeadingCheck | None, Rotation | None, Decision | None]:
    """Return the check after a fix: None once it is decided, with the rotation of N if the heading is wrong."""
    check, nav = state.heading_check, state.nav
    assert check is not None
    velocity = cmath.rect(nav.body_velocity(setup.rig.base)[0], nav.yaw)
    position = newest.position - newest.arm
    dt = (newest.utime - check.utime) * 1e-6
    if not check.utime or dt > MAX_GAP:
        return HeadingCheck(newest.utime, newest.utime, position, 0j, velocity), None, None
    travel = check.travel + 0.5 * dt * (check.velocity + velocity)
    check = check._replace(utime=newest.utime, travel=travel, velocity=velocity)
    arm, moved = abs(newest.arm), position - check.position
    # wheels that spin, or fixes that jump, give no direction
    if abs(travel) < MIN_DISTANCE * (1.0 + arm) or not 0.5 < abs(moved) / abs(travel) < 2.0:
        return check, None, None
    seconds = (newest.utime - check.begin) * 1e-6
    changed = newest.correlated * math.sqrt(2.0 * (1.0 - math.exp(-seconds / setup.settings.gps_correlation_time)))
    sigma = math.hypot(1.5 * newest.white, changed, 0.2 * arm) / abs(travel)
    if sigma > setup.settings.align_sigma:
        return check, None, None
    angle = cmath.phase(moved / travel)
    if abs(angle) <= 4.0 * math.hypot(sigma, MOUNT_SIGMA, math.sqrt(max(nav.covariance[8, 8], 0.0))):
        text = f"the restored heading is right: {abs(travel):.1f} m driven agree with it"
        return None, None, report_event(state, WARM_START, Verdict.USED, text)
    degrees = abs(math.degrees(angle))
    text = (
        f"cold start of the pose: the restored heading was off by {degrees:.0f} deg, the vehicle was turned meanwhile"
    )
    return None, Rotation(angle, sigma), report_event(state, WARM_START, Verdict.RESET, text)
