"""Persisted state: what the filter stores for a warm start, and whether a stored state may be used."""

from __future__ import annotations

import hashlib
import math
from functools import lru_cache

from modelserver.earth.geodesy import geodetic_from_ecef
from modelserver.errors import quote
from modelserver.estimation.filter import motion
from modelserver.estimation.filter.nav import Nav
from modelserver.estimation.filter.setup import Setup
from modelserver.estimation.filter.state import FilterState
from modelserver.messages import Mode, PersistedPose, PersistedState, Phase, RestoredState, WheelsSample

KEPT = "warm_start"
"""The kind of the ledger's words on what was kept."""


@lru_cache(maxsize=8)
def named(setup: Setup) -> str:
    """Return a word that stands for all that a kept state rests on: equal where it may be gone on from."""
    rig = setup.rig
    words = repr((rig.geometry_key(), rig.kinematics, rig.steering, setup.layout.names))
    return hashlib.sha256(words.encode()).hexdigest()[:16]


def kept(setup: Setup, state: FilterState, invalid: int) -> PersistedState | None:
    """Return what is worth keeping of a state; None where there is nothing better than what was kept before.

    `invalid` are the reasons of the pose now: one that is not valid is not kept, its biases are.
    """
    nav = state.nav
    if nav is None or state.warm_start is not None:
        return None
    state = motion.caught_up(setup, state)
    nav = state.nav
    assert nav is not None
    numbers = tuple(nav.covariance.ravel().tolist())
    if not all(map(math.isfinite, (*numbers, *nav.gyro_bias, *nav.accelerometer_bias, *nav.extras))):
        return None
    return PersistedState(
        "",
        0,
        0,
        "",
        named(setup),
        nav.utime,
        setup.layout.names,
        nav.gyro_bias,
        nav.accelerometer_bias,
        tuple(map(float, nav.extras)),
        numbers,
        None if invalid or not state.standing else _kept_pose(state, nav),
    )


def _kept_pose(state: FilterState, nav: Nav) -> PersistedPose | None:
    site = state.site
    if site is None or state.phase is not Phase.ALIGNED:
        return None
    place = (*nav.position, *nav.attitude, *state.shown, *state.doubt, state.allowance, state.restless)
    if not all(map(math.isfinite, place)):
        return None
    source, seq = "", 0
    told: tuple[tuple[str, float], ...] = ()
    seen = state.last.get((state.wheels_source, "seen"))
    if seen is not None and isinstance(seen.sample, WheelsSample):
        source, seq = state.wheels_source, seen.sample.header.seq
        told = ways(seen.sample)
    return PersistedPose(
        *geodetic_from_ecef(site.ecef),
        nav.position,
        nav.attitude,
        state.shown,
        state.doubt,
        state.allowance,
        state.restless,
        state.fix_utime,
        state.confirmed,
        state.epoch,
        source,
        seq,
        told,
    )


def ways(sample: WheelsSample) -> tuple[tuple[str, float], ...]:
    """Return the way that each wheel of a sample tells, metres."""
    return tuple((wheel.name, wheel.travel) for wheel in sample.wheels if math.isfinite(wheel.travel))


def judged(recalled: RestoredState, vehicle: str, setup: Setup) -> RestoredState:
    """Return what was recalled, without what is kept of another vehicle, other mounts, or too long ago; it says why."""
    kept = recalled.state
    if kept is None:
        return recalled
    why = ""
    if kept.vehicle != vehicle:
        why = f"it is of vehicle {quote(kept.vehicle)}, not of {quote(vehicle)}"
    elif kept.setup != named(setup):
        why = "mounts, wheels or measurements of the vehicle have changed since"
    elif kept.names != setup.layout.names or len(kept.covariance) != setup.layout.size**2:
        why = "its error states are others"
    elif recalled.age > recalled.max_age:
        why = "it is older than warm_start.max_age_s"
    if not why:
        return recalled
    return recalled._replace(state=None, reason=f"what was kept {ago(recalled.age)} is not used: {why}")


def opened(recalled: RestoredState | None, vehicle: str, setup: Setup, mode: Mode) -> tuple[RestoredState | None, str]:
    """Return what a start goes on from, None where it is cold; and what is said about it, empty where nobody asked."""
    if recalled is None:
        return None, ""
    if mode is Mode.RAW:
        recalled = recalled._replace(state=None, reason="raw mode goes on from nothing but the origin")
    recalled = judged(recalled, vehicle, setup)
    if recalled.state is None:
        return None, f"cold start: {recalled.reason}"
    return recalled, f"warm start: what was kept {ago(recalled.age)} waits for the sensors"


def ago(seconds: float) -> str:
    """Return an age in words that people read at a glance."""
    for size, unit in ((86400.0, "days"), (3600.0, "h"), (60.0, "min")):
        if seconds >= 2.0 * size:
            return f"{seconds / size:.0f} {unit} ago"
    return f"{seconds:.0f} s ago"
