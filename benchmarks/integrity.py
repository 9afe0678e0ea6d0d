"""Integrity of the filter: time valid and misleading, per fault, over drives with errors that it does not model.

    python -m benchmarks integrity
    python -m benchmarks integrity --quick
    python -m benchmarks integrity --faults spoof_02 --vehicles car --seeds 1 --minutes 30 --events

A valid pose with an error beyond its limit is misleading (HMI), here "wrong"; the time with an error beyond the level
and beyond the protection level is counted whether it is valid or not. The pose is looked at five times a second, for
the present. Faults come as events, with healthy stretches between. "Detected" is from the start of an event to the
first invalid pose; "healed" from the first pose that is wrong or invalid to the first of 5 s of right and valid ones.
Drives and sensors: `integrity_drives`.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import os
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, NamedTuple

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # small matrices: threads only wait for each other

import numpy as np

from benchmarks.integrity_drives import (
    GPS_HZ,
    ORIGIN,
    RATE,
    START,
    VEHICLES,
    Array,
    Mask,
    Receiver,
    Scenario,
    Segment,
    Window,
    compute_truth,
    measure,
    wander,
)
from benchmarks.requirements import FAULT, GAPS, HEALTHY, MILD_FAULT, Required
from modelserver.earth.geodesy import Geodesy
from modelserver.errors import ModelServerError
from modelserver.estimation.filter.localizer import FilterLocalizer
from modelserver.estimation.filter.state import Setup
from modelserver.messages import GpsSample, Invalid
from mstools.archive.cluster import open_cluster

LOOK_PERIOD: Final = 0.2
"""Seconds between two looks at the pose."""
HEALED_TIME: Final = 5.0
MERGED_GAP: Final = 2.0
"""Seconds right between two times wrong that are shown as one."""
FINDINGS_PERIOD: Final = 10.0
FIRST_EVENT: Final = (170.0, 220.0)
"""When the first event begins, seconds: after heading alignment, and after the filter has settled."""
PARKED: Final = 600.0
SETTLE: Final = 20.0
"""How long the vehicle stands before its movement is measured, seconds."""


# --- faults -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Fault:
    """A fault: how it changes a drive, what was measured of the filter before, and what is required.

    `session` is the length of a drive, which starts with a new localizer, seconds: None, one drive for the whole time.
    `quick` is the vehicle and the minutes of a quick run. `has_velocity`: whether fixes have one; None, in every other
    drive.
    """

    name: str
    inject: Callable[[Scenario], None]
    before: str
    required: Required
    session: float | None = None
    quick: tuple[str, float] = ("rover", 15.0)
    has_wheels: bool = True
    has_velocity: bool | None = False
    receiver: Receiver = Receiver.STATED


def _schedule(
    s: Scenario, lasting: tuple[float, float], pause: tuple[float, float], first: tuple[float, float] = FIRST_EVENT
) -> list[Window]:
    """Set and return the events of a drive: as many as end before it."""
    begin = float(s.rng.uniform(*first))
    while True:
        end = begin + float(s.rng.uniform(*lasting))
        if end > s.seconds - 15.0:
            return s.events
        s.events.append((begin, end))
        begin = end + float(s.rng.uniform(*pause))


def _add_outages(s: Scenario) -> None:
    """Add an outage of 20 to 60 s about every two minutes."""
    begin = float(s.rng.uniform(150.0, 220.0))
    while begin < s.seconds - 80.0:
        end = begin + float(s.rng.uniform(20.0, 60.0))
        s.outages.append((begin, end))
        begin = end + float(s.rng.uniform(50.0, 120.0))


def _direction(s: Scenario) -> Array:
    angle = s.rng.uniform(-math.pi, math.pi)
    return np.array((math.cos(angle), math.sin(angle)))


def _inject_nothing(s: Scenario) -> None:
    pass


def _step_gyro(size: float, has_outages: bool = False) -> Callable[[Scenario], None]:
    def inject(s: Scenario) -> None:
        bias = 0.0
        for begin, _ in _schedule(s, (150.0, 150.0), (10.0, 60.0)):
            if has_outages:
                lost = begin - float(s.rng.uniform(5.0, 40.0))
                s.outages.append((lost, lost + 60.0))
            sign = float(s.rng.choice([-1.0, 1.0]))
            if abs(bias + sign * size) > 1.5 * size:
                sign = -sign
            bias += sign * size
            s.gyro_bias[round(begin * RATE) :] = bias

    return inject


def _scale_gyro(s: Scenario) -> None:
    s.gyro_scale = 0.02
    _add_outages(s)


def _spoof(rate: float, moves_velocity: bool, most: float = math.inf) -> Callable[[Scenario], None]:
    """Return a fault that drags the fixes off, up to `most` meters, where the offset then stays."""

    def inject(s: Scenario) -> None:
        for window in _schedule(s, (300.0, 600.0), (150.0, 240.0)):
            inside, towards = s.between(window), _direction(s)
            since = s.t[inside] - window[0]
            s.fix_offset[inside] = np.minimum(rate * since, most)[:, None] * towards
            if moves_velocity:
                s.velocity_offset[inside] = rate * towards

    return inject


def _ramp_multipath(s: Scenario) -> None:
    for window in _schedule(s, (60.0, 150.0), (60.0, 120.0)):
        size = 3.0 * 10.0 ** float(s.rng.uniform(0.0, 1.0))
        most = 0.4 * (window[1] - window[0])
        rise, fall = (min(float(s.rng.uniform(10.0, 60.0)), most) for _ in range(2))
        s.fix_offset += size * s.ramp(window, rise, fall)[:, None] * _direction(s)


def _step_multipath(s: Scenario) -> None:
    for window in _schedule(s, (60.0, 60.0), (90.0, 150.0)):
        s.fix_offset[s.between(window)] = float(s.rng.uniform(10.0, 60.0)) * _direction(s)


def _enter_canyon(s: Scenario) -> None:
    """Fixes 10 to 40 m off, in a direction and by an amount that change within a minute."""
    for window in _schedule(s, (120.0, 300.0), (60.0, 150.0)):
        inside = s.ramp(window, 10.0, 10.0)
        size = np.clip(25.0 + 8.0 * wander(s.rng, s.size, 30.0), 10.0, 40.0)
        angle = s.rng.uniform(-math.pi, math.pi) + wander(s.rng, s.size, 60.0)
        s.fix_offset += (inside * size)[:, None] * np.stack((np.cos(angle), np.sin(angle)), axis=1)
        s.stated_more += inside * float(s.rng.uniform(0.1, 1.1))


def _alternate_fixes(s: Scenario) -> None:
    """Fixes of a second place 15 to 40 m off, every other one, or for some seconds at a time."""
    for window in _schedule(s, (60.0, 180.0), (90.0, 150.0)):
        is_second = np.floor(GPS_HZ * s.t / float(s.rng.choice([1.0, 4.0, 16.0]))) % 2.0 * s.ramp(window, 0.0, 0.0)
        s.fix_offset += float(s.rng.uniform(15.0, 40.0)) * is_second[:, None] * _direction(s)


def _fix_wrongly(s: Scenario) -> None:
    """An ambiguity fixed wrongly from the first fix on, until the receiver finds the right one."""
    s.events.append((0.0, float(s.rng.uniform(120.0, 400.0))))
    s.fix_offset[s.between(s.events[0])] = float(s.rng.uniform(0.5, 2.0)) * _direction(s)


def _drive_at_walking_pace(s: Scenario) -> None:
    s.vehicle = dataclasses.replace(s.vehicle, top_speed=min(1.4, 0.9 * s.vehicle.top_speed))


def _lose_fixes(s: Scenario) -> None:
    s.outages += _schedule(s, (30.0, 30.0), (30.0, 60.0))


def _stop_gyro_axis(s: Scenario) -> None:
    for k, (begin, end) in enumerate(_schedule(s, (60.0, 120.0), (90.0, 150.0))):
        s.dead_axes.append((begin, end, 2 - k % 3))


def _stick_encoders(s: Scenario) -> None:
    for begin, end in _schedule(s, (60.0, 120.0), (90.0, 150.0)):
        s.stuck.append((begin, end))
        lost = begin + float(s.rng.uniform(-15.0, 30.0))
        s.outages.append((lost, lost + float(s.rng.uniform(20.0, 60.0))))


def _move_antenna(s: Scenario) -> None:
    x, y = 0.5 * _direction(s)
    s.antenna_error = (float(x), float(y), 0.0)


def _turn_mount(angle: float, outages: bool = False) -> Callable[[Scenario], None]:
    def inject(s: Scenario) -> None:
        s.mount_yaw = math.radians(angle) * float(s.rng.choice([-1.0, 1.0]))
        if outages:
            _add_outages(s)

    return inject


def _age_fixes(s: Scenario) -> None:
    s.latency = 0.0
    s.age = np.clip(0.45 + 0.2 * wander(s.rng, s.size, 40.0), 0.1, 0.8)


def _jump_clock(s: Scenario) -> None:
    for window in _schedule(s, (120.0, 240.0), (60.0, 150.0)):
        s.stamp_shift[s.between(window)] = 0.2 * float(s.rng.choice([-1.0, 1.0]))


def _silence_imu(s: Scenario) -> None:
    s.silent += _schedule(s, (3.0, 3.0), (30.0, 70.0))


def _shake(s: Scenario, window: Window, size: float, period: float) -> None:
    """Roll and pitch within a window, by `size` radians."""
    inside = s.ramp(window, 3.0, 3.0)
    for axis in range(2):
        phase = s.rng.uniform(-math.pi, math.pi)
        s.tilt[:, axis] += size * inside * np.sin(math.tau / (period * s.rng.uniform(0.8, 1.3)) * s.t + phase)


def _ride_ferry(s: Scenario) -> None:
    s.is_flat = True
    margin = s.vehicle.smoothing
    for window in _schedule(s, (120.0, 300.0), (150.0, 240.0)):
        s.stops.append((window[0] - margin - 15.0, window[1] + margin + 5.0))
        moving = s.ramp(window, 20.0, 20.0)
        s.platform_rate += 0.012 * moving * wander(s.rng, s.size, 60.0)
        s.platform_velocity += 3.0 * moving[:, None] * _direction(s)
        _shake(s, window, 0.004, 8.0)


def _turn_carrier(s: Scenario) -> None:
    """Stand on a carrier that travels and turns all the time at one rate."""
    s.is_flat = True
    margin = s.vehicle.smoothing
    for window in _schedule(s, (60.0, 200.0), (150.0, 240.0)):
        s.stops.append((window[0] - margin - 15.0, window[1] + margin + 5.0))
        moving = s.ramp(window, 10.0, 10.0)
        rate = float(s.rng.uniform(0.01, 0.05) * s.rng.choice([-1.0, 1.0])) * moving
        angle = s.rng.uniform(-math.pi, math.pi) + np.cumsum(rate) / RATE
        course = np.stack((np.cos(angle), np.sin(angle)), axis=1)
        s.platform_rate += rate
        s.platform_velocity += float(s.rng.uniform(1.0, 6.0)) * moving[:, None] * course
        _shake(s, window, 0.004, 8.0)


def _lift(s: Scenario) -> None:
    s.is_flat = True
    margin = s.vehicle.smoothing
    for window in _schedule(s, (15.0, 60.0), (150.0, 240.0)):
        s.stops.append((window[0] - margin - 10.0, window[1] + margin + 10.0))
        lasting = window[1] - window[0]
        moving = s.ramp(window, 4.0, 4.0)
        turned = float(s.rng.uniform(-math.pi, math.pi))
        s.platform_rate += turned / (lasting - 4.0) * moving
        s.platform_velocity += float(s.rng.uniform(0.4, 1.5)) * moving[:, None] * _direction(s)
        s.lift += 0.5 * s.ramp(window, 3.0, 3.0)
        _shake(s, window, 0.03, 3.0)


def _start_in_reverse(s: Scenario) -> None:
    top = s.vehicle.top_speed
    speed = min(top, float(s.rng.choice([1.0, 2.0, 8.0]) * s.rng.uniform(0.7, 1.2)))
    curvature = float(s.rng.normal(0.0, 0.05)) / s.vehicle.min_radius * min(1.0, 3.0 / speed)
    waits = float(s.rng.uniform(3.0, 12.0))
    s.segments = [
        Segment(waits, 0.0),
        Segment(float(s.rng.uniform(25.0, 60.0)), -speed, curvature),
        Segment(float(s.rng.uniform(4.0, 12.0)), 0.0),
        Segment(float(s.rng.uniform(15.0, 30.0)), min(2.0 * speed, top)),
        Segment(8.0, min(2.0 * speed, 0.4 * top), 0.4 / s.vehicle.min_radius),
        Segment(20.0, min(2.0 * speed, top)),
    ]
    s.events.append((waits, s.seconds))


def _park(s: Scenario) -> None:
    begin = s.seconds - PARKED - SETTLE - 5.0
    s.stops.append((begin - s.vehicle.smoothing, s.seconds + 10.0))
    s.events.append((begin + SETTLE, begin + SETTLE + PARKED))
    s.idling = float(s.rng.choice([0.02, 0.2, 0.4]))


def _circle(s: Scenario) -> None:
    radius = s.vehicle.min_radius * float(s.rng.uniform(2.0, 4.0))
    speed = min(s.vehicle.top_speed, math.sqrt(0.6 * s.vehicle.lateral * radius))
    s.segments = [
        Segment(8.0, 0.0),
        Segment(40.0, 0.5 * s.vehicle.top_speed),
        Segment(s.seconds, speed, float(s.rng.choice([-1.0, 1.0])) / radius),
    ]
    s.latency = float(s.rng.uniform(0.2, 0.4))
    s.events.append((50.0, s.seconds))


UNKNOWN: Final = Required(valid=0.0, beyond_protection=math.inf)
"""A fault that leaves no usable heading."""

FAULTS: Final = (
    Fault("none", _inject_nothing, "", HEALTHY),
    Fault("gyro_bias_step_005", _step_gyro(0.005), "302 s/h, longest 181", MILD_FAULT),
    Fault("gyro_bias_step_02", _step_gyro(0.02), "302 s/h, longest 181; 115 deg", MILD_FAULT),
    Fault("gyro_scale_2pct", _scale_gyro, "184 s/h, longest 44", MILD_FAULT),
    Fault("spoof_01", _spoof(0.1, False), "2600 to 3000 s/h, longest 755", FAULT, quick=("rover", 24.0)),
    Fault("spoof_02", _spoof(0.2, False), "2600 to 3000 s/h, longest 755", FAULT, quick=("rover", 24.0)),
    Fault("spoof_05", _spoof(0.5, False), "2600 to 3000 s/h, longest 755; 391 m", FAULT, quick=("car", 24.0)),
    Fault(
        "spoof_05_true_velocity",
        _spoof(0.5, False),
        "2600 to 3000 s/h, longest 755",
        FAULT,
        quick=("rover", 24.0),
        has_velocity=True,
    ),
    Fault(
        "spoof_05_false_velocity",
        _spoof(0.5, True),
        "2600 to 3000 s/h, longest 755",
        FAULT,
        quick=("rover", 24.0),
        has_velocity=True,
    ),
    Fault("multipath_ramps", _ramp_multipath, "399 s/h, longest 53", MILD_FAULT),
    Fault("multipath_steps", _step_multipath, "727 s/h, longest 98", MILD_FAULT),
    Fault("encoders_stuck", _stick_encoders, "663 s/h, longest 72; 157 m", MILD_FAULT, quick=("car", 15.0)),
    Fault("lever_arm_05", _move_antenna, "936 s/h, longest 71", MILD_FAULT, session=1200.0, receiver=Receiver.RTK),
    Fault("mount_yaw_3", _turn_mount(3.0, outages=True), "158 s/h, longest 17", FAULT, quick=("car", 15.0)),
    Fault("mount_yaw_90", _turn_mount(90.0), "heading 65 deg wrong", UNKNOWN, session=450.0),
    Fault("mount_yaw_180", _turn_mount(180.0), "heading 65 deg wrong", UNKNOWN, session=450.0),
    Fault("gps_age", _age_fixes, "34 to 120 s/h, longest 19", MILD_FAULT, quick=("car", 15.0), has_velocity=None),
    Fault("host_clock", _jump_clock, "43 s/h, longest 9", MILD_FAULT, quick=("car", 15.0), has_velocity=None),
    Fault("imu_silent_3s", _silence_imu, "16 s/h, longest 6", FAULT),
    Fault("ferry", _ride_ferry, "1166 to 1935 s/h, longest 574; 149 deg", FAULT, has_wheels=False),
    Fault("lifted", _lift, "1166 to 1935 s/h, longest 574; 149 deg", FAULT, has_wheels=False),
    Fault(
        "reverse_start",
        _start_in_reverse,
        "860 s/h, longest 104; 180 deg",
        Required(valid=0.0),
        session=150.0,
        quick=("car", 15.0),
        has_wheels=False,
    ),
    Fault(
        "stationary_3d",
        _park,
        "moves 5.5 m in 10 min, valid",
        dataclasses.replace(HEALTHY, moved=0.3, turned_deg=1.0),
        session=900.0,
        receiver=Receiver.UNSTATED,
    ),
    Fault(
        "steady_circle",
        _circle,
        "132 s/h, longest 9",
        MILD_FAULT,
        session=450.0,
        quick=("car", 15.0),
        has_velocity=None,
    ),
    Fault(
        "gyro_bias_step_02_velocity",
        _step_gyro(0.02),
        "not measured",
        MILD_FAULT,
        quick=("car", 15.0),
        has_velocity=True,
    ),
    Fault(
        "wandering_fixes",
        _drive_at_walking_pace,
        "valid 39 % of the Husky recording",
        HEALTHY,
        receiver=Receiver.WANDERING,
    ),
    Fault(
        "urban_canyon",
        _enter_canyon,
        "436 new epochs in 283 s",
        dataclasses.replace(MILD_FAULT, rmse_ratio=0.7, epochs_per_minute=1.0),
    ),
    Fault("gaps_without_wheels", _lose_fixes, "54 m, valid", GAPS, quick=("car", 15.0), has_wheels=False),
    Fault("turning_carrier", _turn_carrier, "428 s, 118 deg", FAULT, quick=("rover", 24.0)),
    Fault("drag_02_held", _spoof(0.2, False, most=40.0), "329 s, 62 m", FAULT, quick=("rover", 24.0)),
    Fault("gyro_step_in_outage", _step_gyro(0.02, has_outages=True), "143 m", FAULT, quick=("car", 15.0)),
    Fault("rtk_wrong_fix", _fix_wrongly, "71 s (3 m off)", FAULT, session=600.0, receiver=Receiver.RTK),
    Fault("gyro_axis_dead", _stop_gyro_axis, "130 deg for 4.8 s", FAULT),
    Fault("two_solutions", _alternate_fixes, "44 times the level, valid", FAULT),
)
BY_NAME: Final = {fault.name: fault for fault in FAULTS}


# --- one drive ----------------------------------------------------------------------------------------------


class Task(NamedTuple):
    """A vehicle with a fault for a time, by the seed."""

    fault: str
    vehicle: str
    seed: int
    seconds: float


@dataclass(frozen=True)
class Breach:
    """A time wrong and valid: `what` is horizontal (m) or heading (rad); `error` and `limit` are at the worst ratio.

    `begin` in its session, `seconds` wrong; `since_fault`: from the start of the last event, nan before the first.
    """

    fault: str
    vehicle: str
    seed: int
    session: int
    what: str
    begin: float
    seconds: float
    error: float
    limit: float
    since_fault: float


@dataclass(frozen=True)
class EventResult:
    """An event of a fault: seconds wrong and valid, and when detected and healed; nan: not."""

    session: int
    begin: float
    wrong: float
    detected: float
    healed: float


@dataclass
class Result:
    """Result of a task. `ratio`: worst error over limit while valid; `moved` (m) and `turned` (rad) while parked.

    `beyond_level` and `beyond_protection` are the seconds with an error beyond the level and the protection level.
    `squares` has of each session the sum and number of squared horizontal errors (m2) of the pose, valid or not, and of
    the raw fixes at their stamps. `reasons` has the seconds that the pose was not valid, by reason, `findings` how
    often each finding was seen, and `epochs` the number of new epochs.
    """

    task: Task
    seconds: float = 0.0
    valid: float = 0.0
    wrong: float = 0.0
    ratio: dict[str, float] = field(default_factory=lambda: {"horizontal": 0.0, "heading": 0.0})
    median_level: list[float] = field(default_factory=list)
    beyond_level: float = 0.0
    beyond_protection: float = 0.0
    breaches: list[Breach] = field(default_factory=list)
    events: list[EventResult] = field(default_factory=list)
    squares: list[tuple[float, ...]] = field(default_factory=list)
    reasons: dict[str, float] = field(default_factory=dict)
    findings: dict[str, int] = field(default_factory=dict)
    epochs: int = 0
    moved: float = 0.0
    turned: float = 0.0
    cpu: float = 0.0


class Looks(NamedTuple):
    """The pose at each look: seconds, validity, errors, limits, levels and protection levels (m, rad), the estimated
    x, y, yaw, the reasons; and the horizontal errors of the raw fixes (m).
    """

    t: Array
    valid: Mask
    errors: dict[str, Array]
    limits: dict[str, Array]
    levels: dict[str, Array]
    protection: dict[str, Array]
    pose: Array
    reasons: list[Invalid]
    findings: list[str]
    epochs: int
    raw: Array


def run_task(task: Task) -> Result:
    """Run the sessions of a task."""
    fault, vehicle = BY_NAME[task.fault], VEHICLES[task.vehicle]
    result = Result(task)
    started = time.process_time()
    length = fault.session or task.seconds
    names = list(BY_NAME)
    for session in range(max(round(task.seconds / length), 1)):
        seed = (task.seed, names.index(task.fault), list(VEHICLES).index(task.vehicle), session)
        scenario = Scenario(
            vehicle,
            min(length, task.seconds) if fault.name != "stationary_3d" else length,
            np.random.default_rng(seed),
            has_wheels=fault.has_wheels,
            has_velocity=(task.seed + session) % 2 == 0 if fault.has_velocity is None else fault.has_velocity,
            receiver=fault.receiver,
        )
        fault.inject(scenario)
        _evaluate(result, session, scenario, observe(scenario))
    result.cpu = time.process_time() - started
    return result


def observe(scenario: Scenario) -> Looks:
    """Drive a scenario through the filter, and look at the pose."""
    truth = compute_truth(scenario)
    setup = Setup(scenario.vehicle.build_rig(scenario.has_wheels))
    localizer = FilterLocalizer.start(setup, ORIGIN)
    rows: list[tuple[float, ...]] = []
    reasons: list[Invalid] = []
    findings: list[str] = []
    epochs: set[int] = set()
    raw: list[float] = []
    geodesy, antenna = Geodesy(ORIGIN), truth.locate(scenario.vehicle.antenna)
    look, n = LOOK_PERIOD, scenario.seconds - 0.5
    for arrival, sample in measure(scenario, truth):
        while look <= arrival and look < n:
            utime = START + round(look * 1e6)
            estimate = localizer.estimate(utime)
            reasons.append(estimate.invalid)
            epochs.add(estimate.pose_epoch)
            if math.fmod(look, FINDINGS_PERIOD) < LOOK_PERIOD:
                findings += [f"{each.sensor}:{each.reason}" for each in localizer.summary(utime).findings]
            if estimate.enu is None:
                rows.append((look, 0.0, *(math.nan,) * 9))
            else:
                x, y, _ = estimate.enu.xyz
                yaw = estimate.enu.rpy[2]
                summary = localizer.summary(utime)
                bounds = (
                    *(summary.horizontal_limit, summary.heading_limit),
                    *(estimate.horizontal_level, estimate.heading_level),
                    *(estimate.horizontal_protection_level, estimate.heading_protection_level),
                )
                rows.append((look, float(not estimate.invalid), x, y, yaw, *bounds))
            look = round(look + LOOK_PERIOD, 6)
        localizer, _ = localizer.process(sample)
        if isinstance(sample, GpsSample):
            fix = geodesy.enu_from_geodetic(sample.latitude_deg, sample.longitude_deg, sample.height_ellipsoidal)
            raw.append(math.dist(fix[:2], antenna[round((sample.header.utime - START) * 1e-6 * RATE), :2]))
    table = np.array(rows)
    at = np.round(table[:, 0] * RATE).astype(int)
    apart = table[:, 2:4] - truth.position[at, :2]
    turned = np.remainder(table[:, 4] - truth.yaw[at] + math.pi, math.tau) - math.pi
    return Looks(
        table[:, 0],
        table[:, 1] > 0.5,
        {"horizontal": np.hypot(*apart.T), "heading": np.abs(turned)},
        {"horizontal": table[:, 5], "heading": table[:, 6]},
        {"horizontal": table[:, 7], "heading": table[:, 8]},
        {"horizontal": table[:, 9], "heading": table[:, 10]},
        table[:, 2:5],
        reasons,
        findings,
        len(epochs) - 1,
        np.array(raw),
    )


def _evaluate(result: Result, session: int, scenario: Scenario, looks: Looks) -> None:
    """Add a session to a result."""
    task = result.task
    result.seconds += len(looks.t) * LOOK_PERIOD
    result.valid += float(looks.valid.sum()) * LOOK_PERIOD
    for reason, count in Counter(str(flag.name) for reasons in looks.reasons for flag in reasons).items():
        result.reasons[reason] = result.reasons.get(reason, 0.0) + count * LOOK_PERIOD
    for finding, count in Counter(looks.findings).items():
        result.findings[finding] = result.findings.get(finding, 0) + count
    result.epochs += looks.epochs
    starts = np.array([begin for begin, _ in scenario.events])
    wrong_any = np.zeros(len(looks.t), bool)
    beyond = np.zeros((2, len(looks.t)), bool)
    for what, error in looks.errors.items():
        limit = looks.limits[what]
        wrong = looks.valid & ~(error <= limit)
        wrong_any |= wrong
        beyond |= np.stack((error > looks.levels[what], error > looks.protection[what]))
        ratio = np.where(looks.valid, error / limit, 0.0)
        result.ratio[what] = max(result.ratio[what], float(ratio.max()))
        for first, last in _merge(_find_runs(wrong)):
            worst = first + int(np.argmax(ratio[first:last]))
            began = starts[starts <= looks.t[first]]
            since = float(looks.t[first] - began[-1]) if len(began) else math.nan
            result.breaches.append(
                Breach(
                    task.fault,
                    task.vehicle,
                    task.seed,
                    session,
                    what,
                    float(looks.t[first]),
                    float(wrong[first:last].sum()) * LOOK_PERIOD,
                    float(error[worst]),
                    float(limit[worst]),
                    since,
                )
            )
    result.wrong += float(wrong_any.sum()) * LOOK_PERIOD
    if looks.valid.any():
        result.median_level.append(float(np.median(looks.levels["horizontal"][looks.valid])))
    for name, count in zip(("beyond_level", "beyond_protection"), beyond.sum(axis=1), strict=True):
        setattr(result, name, getattr(result, name) + float(count) * LOOK_PERIOD)
    error = looks.errors["horizontal"][np.isfinite(looks.errors["horizontal"])]
    result.squares.append((float(error @ error), len(error), float(looks.raw @ looks.raw), len(looks.raw)))
    for k, begin in enumerate(starts.tolist()):
        end = starts[k + 1] if k + 1 < len(starts) else looks.t[-1] + 1.0
        result.events.append(_evaluate_event(session, looks, wrong_any, begin, end))
    if scenario.receiver is Receiver.UNSTATED:
        _measure_movement(result, scenario, looks)


def _find_runs(mask: Mask) -> list[tuple[int, int]]:
    """Return first and past-the-last index of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], mask.astype(int), [0]))))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def _merge(runs: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return the runs with those joined that are at most `MERGED_GAP` apart."""
    merged: list[tuple[int, int]] = []
    for first, last in runs:
        start = first
        if merged and first - merged[-1][1] <= MERGED_GAP / LOOK_PERIOD:
            start = merged.pop()[0]
        merged.append((start, last))
    return merged


def _evaluate_event(session: int, looks: Looks, wrong: Mask, begin: float, end: float) -> EventResult:
    inside = (looks.t >= begin) & (looks.t < end)
    good = looks.valid & ~wrong
    detected = looks.t[inside & ~looks.valid]
    bad = np.flatnonzero(inside & ~good)
    healed = math.nan
    if len(bad):
        count = round(HEALED_TIME / LOOK_PERIOD)
        for first, last in _find_runs(good):
            if first > bad[0] and last - first >= count and looks.t[first] < end:
                healed = float(looks.t[first] - looks.t[bad[0]])
                break
    else:
        healed = 0.0
    return EventResult(
        session,
        begin,
        float((wrong & inside).sum()) * LOOK_PERIOD,
        float(detected[0] - begin) if len(detected) else math.nan,
        healed,
    )


def _measure_movement(result: Result, scenario: Scenario, looks: Looks) -> None:
    """Measure how far the valid pose of a parked vehicle moves."""
    for begin, end in scenario.events:
        pose = looks.pose[(looks.t >= begin) & (looks.t < end) & looks.valid]
        if len(pose):
            away = pose - pose[0]
            result.moved = max(result.moved, float(np.hypot(away[:, 0], away[:, 1]).max()))
            turned = np.remainder(away[:, 2] + math.pi, math.tau) - math.pi
            result.turned = max(result.turned, float(np.abs(turned).max()))


# --- report -------------------------------------------------------------------------------------------------


class Summary(NamedTuple):
    """The figures of a fault over its tasks."""

    fault: str
    hours: float
    hmi: float
    longest: float
    worst_event: float
    num_wrong_events: int
    num_events: int
    ratio_horizontal: float
    ratio_heading: float
    worst_error: float
    worst_heading_deg: float
    valid: float
    level: float
    beyond_level: float
    beyond_protection: float
    rmse: float
    rmse_raw: float
    rmse_ratio: float
    epochs_per_minute: float
    detected: float
    healed: float
    healed_worst: float
    moved: float
    turned_deg: float
    missed: tuple[str, ...] = ()

    @property
    def holds(self) -> bool:
        """Whether no bar is missed."""
        return not self.missed


def summarize(fault: Fault, results: list[Result]) -> Summary:
    """Return the figures of a fault."""
    hours = sum(each.seconds for each in results) / 3600.0
    events = [event for each in results for event in each.events]
    breaches = [breach for each in results for breach in each.breaches]
    detected = [event.detected for event in events if not math.isnan(event.detected)]
    healed = [event.healed for event in events if event.healed != 0.0]
    # an event that ends before it heals is no shorter than the worst
    healed_worst = max((math.inf if math.isnan(x) else x for x in healed), default=0.0)
    square, n, square_raw, n_raw = np.sum([each for result in results for each in result.squares], axis=0).tolist()
    rmse, rmse_raw = math.sqrt(square / n) if n else math.nan, math.sqrt(square_raw / n_raw)
    levels = [level for each in results for level in each.median_level]
    summary = Summary(
        fault.name,
        hours,
        sum(each.wrong for each in results) / hours,
        max((breach.seconds for breach in breaches), default=0.0),
        max((event.wrong for event in events), default=0.0),
        sum(event.wrong > 0.0 for event in events),
        len(events),
        max(each.ratio["horizontal"] for each in results),
        max(each.ratio["heading"] for each in results),
        max((breach.error for breach in breaches if breach.what == "horizontal"), default=0.0),
        math.degrees(max((breach.error for breach in breaches if breach.what == "heading"), default=0.0)),
        sum(each.valid for each in results) / (hours * 3600.0),
        float(np.median(levels)) if levels else math.nan,
        sum(each.beyond_level for each in results) / (hours * 3600.0),
        sum(each.beyond_protection for each in results) / (hours * 3600.0),
        rmse,
        rmse_raw,
        rmse / rmse_raw,
        sum(each.epochs for each in results) / (hours * 60.0),
        float(np.median(detected)) if detected else math.nan,
        float(np.median([x for x in healed if not math.isnan(x)] or [math.nan])),
        healed_worst,
        max(each.moved for each in results),
        math.degrees(max(each.turned for each in results)),
    )
    return summary._replace(missed=tuple(fault.required.find_missed(summary._asdict())))


HEADER: Final = (
    f"  {'fault':24}{'hours':>6}{'HMI s/h':>8}{'longest':>8}{'event':>8}{'of events':>10}"
    f"{'x hor':>7}{'x head':>7}{'m':>7}{'deg':>6}{'valid':>7}{'level':>7}{'> lev':>8}{'> prot':>8}"
    f"{'RMSE':>7}{'raw':>7}{'ep/min':>7}"
    f"{'detected':>9}{'healed':>7}{'worst':>7}"
    "  before -> required"
)
LEGEND: Final = (
    "  HMI s/h: seconds wrong and valid in an hour. longest: interval. event: sum of the worst. of events: with any.\n"
    "  x: worst error / limit while valid, horizontal and heading. m, deg: worst error while wrong. level: median, m.\n"
    "  > lev, > prot: share of time with an error beyond the level (1e-4) and the protection level.\n"
    "  RMSE, raw: of the position of the pose, valid or not, and of the raw fixes, m. ep/min: new epochs per minute.\n"
    "  detected: median seconds to the first invalid pose. healed, worst: median and longest wrong or invalid, s."
)


def format_summary(summary: Summary) -> str:
    """Return the row of a fault."""
    fault = BY_NAME[summary.fault]
    events = f"{summary.num_wrong_events}/{summary.num_events}" if summary.num_events else "-"

    def number(value: float, digits: int = 1) -> str:
        return "-" if math.isnan(value) else f"{value:.{digits}f}"

    row = (
        f"  {fault.name:24}{summary.hours:6.2f}{summary.hmi:8.1f}{summary.longest:8.1f}"
        f"{summary.worst_event:8.1f}{events:>10}{summary.ratio_horizontal:7.2f}{summary.ratio_heading:7.2f}"
        f"{summary.worst_error:7.1f}{summary.worst_heading_deg:6.1f}{summary.valid:7.1%}{number(summary.level):>7}"
        f"{summary.beyond_level:8.2%}{summary.beyond_protection:8.2%}"
        f"{summary.rmse:7.2f}{summary.rmse_raw:7.2f}{summary.epochs_per_minute:7.2f}"
        f"{number(summary.detected):>9}{number(summary.healed):>7}{number(summary.healed_worst):>7}"
        f"  {fault.before or '-'} -> {fault.required.text}"
    )
    if math.isfinite(fault.required.moved):
        row += f"; moved {summary.moved:.2f} m, {summary.turned_deg:.2f} deg"
    return row + ("" if summary.holds else f"  <-- OUT OF BOUNDS: {', '.join(summary.missed)}")


def format_breach(breach: Breach) -> str:
    """Return the line of a time wrong and valid."""
    is_heading = breach.what == "heading"
    factor, unit = (180.0 / math.pi, "deg") if is_heading else (1.0, "m")
    since = (
        "before any event" if math.isnan(breach.since_fault) else f"{breach.since_fault:.1f} s after the fault began"
    )
    return (
        f"    {breach.vehicle} seed {breach.seed} session {breach.session} at {breach.begin:.1f} s for "
        f"{breach.seconds:.1f} s: {breach.what} {breach.error * factor:.2f} {unit}, limit "
        f"{breach.limit * factor:.2f} {unit}, {since}"
    )


def print_events(fault: Fault, results: list[Result]) -> None:
    """Print what lies behind the figures of a fault."""
    for name in dict.fromkeys(result.task.vehicle for result in results):
        summary = summarize(fault, [result for result in results if result.task.vehicle == name])
        print(f"    {name}: {summary.hmi:.1f} s/h, longest {summary.longest:.1f} s, {summary.valid:.1%} valid")
    reasons: defaultdict[str, float] = defaultdict(float)
    findings = Counter[str]()
    for result in results:
        task = result.task
        for reason, seconds in result.reasons.items():
            reasons[reason] += seconds
        findings.update(result.findings)
        for breach in sorted(result.breaches, key=lambda breach: (breach.session, breach.begin)):
            print(format_breach(breach))
        for event in result.events:
            if event.wrong or not math.isnan(event.detected):
                print(
                    f"    {task.vehicle} seed {task.seed} session {event.session} event at {event.begin:.1f} s: "
                    f"wrong {event.wrong:.1f} s, detected after {event.detected:.1f}, healed in {event.healed:.1f} s"
                )
    print(
        "    not valid by " + (", ".join(f"{name} {seconds:.0f} s" for name, seconds in reasons.items()) or "nothing")
    )
    print("    findings: " + (", ".join(name for name, _ in findings.most_common()) or "none"), end="; ")
    print(f"new epochs: {sum(result.epochs for result in results)}", flush=True)


def plan_tasks(options: argparse.Namespace) -> list[Task]:
    """Return the tasks of the options, by fault."""
    tasks = []
    for fault in FAULTS:
        if options.faults and fault.name not in options.faults:
            continue
        vehicle, minutes = fault.quick
        vehicles = options.vehicles or ([vehicle] if options.quick else list(VEHICLES))
        minutes = options.minutes or (minutes if options.quick else 60.0)
        seeds = options.seeds or (1 if options.quick else 5)
        tasks += [
            Task(fault.name, each, seed, minutes * 60.0)
            for each in vehicles
            for seed in range(options.first, options.first + seeds)
        ]
    return tasks


def run(tasks: Iterable[Task], jobs: int, events: bool, scheduler: str = "") -> tuple[list[Summary], list[Result]]:
    """Run the tasks, and print each fault when its last one is done. Raises ModelServerError for one that is lost."""
    tasks = list(tasks)
    print(HEADER, flush=True)
    summaries, finished = [], []
    grouped: dict[str, list[Result]] = {}
    with open_cluster(scheduler, jobs) as cluster:
        for _, result in cluster.run(run_task, tasks):
            if isinstance(result, ModelServerError):
                raise result
            fault = result.task.fault
            grouped.setdefault(fault, []).append(result)
            finished.append(result)
            if len(grouped[fault]) == sum(task.fault == fault for task in tasks):
                grouped[fault].sort(key=lambda result: result.task)
                summaries.append(summarize(BY_NAME[fault], grouped[fault]))
                print(format_summary(summaries[-1]), flush=True)
                if events:
                    print_events(BY_NAME[fault], grouped[fault])
    return summaries, finished


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks integrity", description=(__doc__ or "").partition("\n")[0]
    )
    parser.add_argument("--faults", nargs="+", choices=list(BY_NAME), metavar="NAME", help="only these")
    parser.add_argument("--vehicles", nargs="+", choices=list(VEHICLES), metavar="NAME", help="only these")
    parser.add_argument("--seeds", type=int, help="drives of each vehicle with each fault; default 5")
    parser.add_argument("--first", type=int, default=1, help="the first seed")
    parser.add_argument("--minutes", type=float, help="of each drive; default 60")
    parser.add_argument("--jobs", type=int, default=min(os.cpu_count() or 1, 2))
    parser.add_argument("--scheduler", default="", metavar="ADDRESS", help="of a Dask cluster; default: this machine")
    parser.add_argument("--quick", action="store_true", help="one vehicle, one seed, 15 to 24 minutes of each fault")
    parser.add_argument("--list", action="store_true", help="list faults and vehicles")
    parser.add_argument("--events", action="store_true", help="print each time wrong and valid")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures, events and times here")
    options = parser.parse_args(arguments or [])
    if options.list:
        for fault in FAULTS:
            print(f"{fault.name:24} before: {fault.before or '-'}; required: {fault.required.text}")
        print(f"vehicles: {', '.join(VEHICLES)}")
        return 0
    started = time.monotonic()
    summaries, results = run(plan_tasks(options), options.jobs, options.events, options.scheduler)
    print(LEGEND)
    simulated, spent = sum(each.seconds for each in results), sum(each.cpu for each in results)
    print(f"  {simulated / 3600.0:.1f} h in {time.monotonic() - started:.0f} s, {simulated / spent:.0f} x per core")
    if options.json:
        data = {
            "faults": [summary._asdict() for summary in summaries],
            "tasks": [dataclasses.asdict(result) for result in results],
        }
        # JSON has neither nan nor infinity
        plain = json.loads(json.dumps(data), parse_constant=lambda _: None)
        options.json.write_text(json.dumps(plain, indent=1), encoding="utf-8")
    return 0 if all(summary.holds for summary in summaries) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
