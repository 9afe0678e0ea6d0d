"""Persisted state: what the filter stores for a warm start, and whether a stored state may be used."""

from __future__ import annotations

import hashlib
import math
from functools import lru_cache
from typing import Final

from modelserver.earth.geodesy import geodetic_from_ecef
from modelserver.errors import quote
from modelserver.estimation.filter import output, propagation, protection_levels
from modelserver.estimation.filter.eskf import NavState
from modelserver.estimation.filter.setup import Setup
from modelserver.estimation.filter.state import Aligned, FilterState, Leveling
from modelserver.estimation.filter.wheel_monitor import RECEIVED
from modelserver.messages import Mode, PersistedPose, PersistedState, RestoredState, WheelsSample

WARM_START: Final = "warm_start"
"""Kind of the ledger's decisions on a warm start."""


@lru_cache(maxsize=8)
def get_setup_hash(setup: Setup) -> str:
    """Return a hash of all that a stored state depends on: equal where it may be used."""
    rig = setup.rig
    words = repr((rig.geometry_key(), rig.kinematics, rig.steering, setup.layout.names))
    return hashlib.sha256(words.encode()).hexdigest()[:16]


def get_persisted_state(setup: Setup, state: FilterState, invalid: int) -> PersistedState | None:
    """Return what to store of a state; None if what was stored before is better.

    `invalid` are the reasons of the present pose: an invalid pose is not stored, its biases are.
    """
    if isinstance(state, Leveling) or state.common.warm_start is not None:
        return None
    state = propagation.propagate_covariance(setup, state)
    nav = state.nav
    P = nav.covariance
    if isinstance(state, Aligned):
        # neither bank nor monitor are stored: their level of the heading is
        bound = output.get_heading_protection(setup, state)
        P = P.copy()
        P[8, 8] = max(float(P[8, 8]), protection_levels.invert_heading(bound, setup.settings))
    numbers = tuple(P.ravel().tolist())
    if not all(map(math.isfinite, (*numbers, *nav.gyro_bias, *nav.accelerometer_bias, *nav.extras))):
        return None
    pose = None
    if isinstance(state, Aligned) and state.is_stationary and not invalid:
        pose = _get_persisted_pose(state, nav)
    return PersistedState(
        "",
        0,
        0,
        "",
        get_setup_hash(setup),
        nav.utime,
        setup.layout.names,
        nav.gyro_bias,
        nav.accelerometer_bias,
        tuple(map(float, nav.extras)),
        numbers,
        pose,
    )


def _get_persisted_pose(state: Aligned, nav: NavState) -> PersistedPose | None:
    gnss, common = state.gnss, state.common
    offset = gnss.offset
    numbers = (*offset.value, *offset.variance, gnss.outlier_allowance, gnss.noise_inflation)
    if not all(map(math.isfinite, (*nav.position, *nav.attitude, *numbers))):
        return None
    source, seq = "", 0
    travel: tuple[tuple[str, float], ...] = ()
    received = common.previous.get((common.wheels.source, RECEIVED))
    if received is not None and isinstance(received.sample, WheelsSample):
        source, seq = common.wheels.source, received.sample.header.seq
        travel = get_travel(received.sample)
    return PersistedPose(
        *geodetic_from_ecef(state.site.ecef),
        nav.position,
        nav.attitude,
        offset.value,
        offset.variance,
        gnss.outlier_allowance,
        gnss.noise_inflation,
        gnss.used_utime,
        gnss.num_confirmed,
        common.epoch,
        source,
        seq,
        travel,
    )


def get_travel(sample: WheelsSample) -> tuple[tuple[str, float], ...]:
    """Return the travel of each wheel that measures it, by name, m."""
    return tuple((wheel.name, wheel.travel) for wheel in sample.wheels if math.isfinite(wheel.travel))


def check_restored(restored: RestoredState, vehicle: str, setup: Setup) -> RestoredState:
    """Return what was restored, without a state of another vehicle, of other mounts, or too old; with the reason."""
    state = restored.state
    if state is None:
        return restored
    reason = ""
    if state.vehicle != vehicle:
        reason = f"it is of vehicle {quote(state.vehicle)}, not of {quote(vehicle)}"
    elif state.setup != get_setup_hash(setup):
        reason = "mounts, wheels or measurements of the vehicle have changed since"
    elif state.names != setup.layout.names or len(state.covariance) != setup.layout.size**2:
        reason = "its error states are others"
    elif restored.age > restored.max_age:
        reason = "it is older than warm_start.max_age_s"
    if not reason:
        return restored
    text = f"the state stored {format_age(restored.age)} is not used: {reason}"
    return restored._replace(state=None, reason=text)


def prepare_warm_start(
    restored: RestoredState | None, vehicle: str, setup: Setup, mode: Mode
) -> tuple[RestoredState | None, str]:
    """Return the state to start from, None for a cold start; and the message, empty if no state was asked for."""
    if restored is None:
        return None, ""
    if mode is Mode.RAW:
        restored = restored._replace(state=None, reason="raw mode restores only the origin")
    restored = check_restored(restored, vehicle, setup)
    if restored.state is None:
        return None, f"cold start: {restored.reason}"
    return restored, f"warm start: the state stored {format_age(restored.age)} waits for the sensors"


def format_age(seconds: float) -> str:
    """Return an age in words, e.g. `5 min ago`."""
    for size, unit in ((86400.0, "days"), (3600.0, "h"), (60.0, "min")):
        if seconds >= 2.0 * size:
            return f"{seconds / size:.0f} {unit} ago"
    return f"{seconds:.0f} s ago"
