"""Heading check of a warm start: the restored heading against the first meters driven and the fixes there.

Wheels that stood know that the vehicle did not turn by itself, not that nobody lifted it. A state with a wrong heading
that it is sure of takes fixes for such that wander, and does not find out by itself.
"""

from __future__ import annotations

import cmath
import math

from modelserver.estimation.filter import fixes
from modelserver.estimation.filter.alignment import Passed, Turn
from modelserver.estimation.filter.items import NOTHING, Fused
from modelserver.estimation.filter.persistence import KEPT
from modelserver.estimation.filter.setup import Setup
from modelserver.estimation.filter.state import FilterState, Proving
from modelserver.messages import Decision, Verdict

LEAST_WAY = 3.0
"""Metres from end to end that tell a direction, and as many again for each metre that the antenna is off the middle."""

LONGEST_GAP = 2.0
"""Seconds between two fixes beyond which the stretch begins anew."""

MOUNTS = 0.05
"""Radians by which the way driven and heading may differ on a sound vehicle: side slip, and the frames' survey."""


def proved(setup: Setup, state: FilterState, newest: Passed) -> Fused:
    """Return the state with a fix more: its heading proved, put right, or still neither."""
    stretch, nav = state.proving, state.nav
    if stretch is None or nav is None:
        return state, NOTHING
    velocity = cmath.rect(nav.body_velocity(setup.rig.base)[0], nav.yaw)
    place = newest.place - newest.arm
    dt = (newest.utime - stretch.utime) * 1e-6
    if not stretch.utime or dt > LONGEST_GAP:
        return state._replace(proving=Proving(newest.utime, newest.utime, place, 0j, velocity)), NOTHING
    way = stretch.way + 0.5 * dt * (stretch.velocity + velocity)
    state = state._replace(proving=stretch._replace(utime=newest.utime, way=way, velocity=velocity))
    arm, moved = abs(newest.arm), place - stretch.place
    # wheels that spin, or fixes that jump, tell no direction
    if abs(way) < LEAST_WAY * (1.0 + arm) or not 0.5 < abs(moved) / abs(way) < 2.0:
        return state, NOTHING
    seconds = (newest.utime - stretch.begin) * 1e-6
    changed = newest.lingering * math.sqrt(2.0 * (1.0 - math.exp(-seconds / setup.settings.gps_correlation_time)))
    sigma = math.hypot(1.5 * newest.white, changed, 0.2 * arm) / abs(way)
    if sigma > setup.settings.align_sigma:
        return state, NOTHING
    turn = cmath.phase(moved / way)
    doubt = math.hypot(sigma, MOUNTS, math.sqrt(max(nav.covariance[8, 8], 0.0)))
    state = state._replace(proving=None)
    if abs(turn) <= 4.0 * doubt:
        return state, (
            _word(state, Verdict.USED, f"the resumed heading is right: {abs(way):.1f} m driven agree with it"),
        )
    state = fixes.into_world(setup, state, nav, Turn(turn, sigma), newest)
    state = state._replace(epoch=state.epoch + 1, allowance=0.0)
    off = f"the kept heading was off by {abs(math.degrees(turn)):.0f} deg: the vehicle was turned while nobody watched"
    return state, (_word(state, Verdict.RESET, f"cold start of the pose after all, {off}"),)


def _word(state: FilterState, verdict: Verdict, text: str) -> Decision:
    assert state.nav is not None
    return Decision(state.nav.utime, "filter", 0, KEPT, verdict, text)
