"""Findings of a replay: what its decisions and states reveal about vehicle file, sensors and settings. Pure.

Each check is a function of `ReplayData` and yields findings: what was observed, the probable cause, and what to do. It
yields nothing where there is too little data. A sensor's unit, sign or name is verified by comparison with another
sensor, without any pose: turn rates of gyro, wheels and fixes; distances of wheels and fixes; mean specific force
against gravity. The GNSS latency tau is a least-squares fit of the horizontal residuals r to the velocity v, both
high-pass filtered by subtracting a running mean: a fix that is tau old lies at -tau v, so tau = -sum(r v) / sum(v^2);
its sigma is from the scatter over parts of the drive.
Order: causes from the raw sensor data first; with one of them, checks that would only repeat its consequences are left
out, and so are checks of the state of a filter that diverged.

Consistency of the innovations: NIS is a decision's statistic y' S^-1 y of the innovation y with covariance S. In a
consistent filter it is chi-square distributed with as many degrees of freedom as y has components: its mean per degree
of freedom is 1, and 5 % exceed the 95 % limit (Bar-Shalom, Li and Kirubarajan (2001) 5.4).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from itertools import groupby

import numpy as np

from modelserver.errors import Severity
from modelserver.estimation.filter.eskf import chi_square_gate
from modelserver.messages import Decision, Mode, Verdict
from modelserver.transforms.so3 import Array
from mstools.report.replay_data import ReplayData, compare_turn_rates
from mstools.report.validity import NO_SAMPLES, summarize_validity
from mstools.terminal.output import format_count

MOVING_SPEED = 0.3
"""Speed, m/s, above which the errors of wheels and fixes are evaluated."""

MIN_SAMPLES = 20
"""Fewest samples to evaluate a sensor, or a wheel in motion."""

UNUSED_SHARE = 0.05
"""Share of accepted samples up to which a sensor counts as unused."""

MODES_WITHOUT = {
    "gps": (Mode.NO_GPS, Mode.DEAD_RECKONING),
    "imu": (Mode.NO_IMU,),
    "wheels": (Mode.NO_WHEELS, Mode.RAW),
}
"""Modes that need no such sensor."""

REVERSE_WHEEL = "Reverse the sign of this wheel in its driver, or swap its encoder's two channels."

DEGREES_PER_RADIAN = math.degrees(1.0)


@dataclass(frozen=True, slots=True)
class ReportFinding:
    """One finding: a headline, the observation, and what to do."""

    level: Severity
    title: str
    observation: str
    advice: str


error, warning, note = (partial(ReportFinding, level) for level in Severity)


def collect_findings(data: ReplayData) -> list[ReportFinding]:
    """Return all findings, worst first, and of equals the causes first."""
    causes = [finding for check in SENSOR_CHECKS for finding in check(data)]
    checks = list(CHECKS)
    if not causes:
        checks += SENSOR_RESIDUAL_CHECKS
        if not any(_has_diverged(each) for each in data.decisions):
            checks += STATE_CHECKS
        checks.append(check_rejected_fixes)
    found = causes + [finding for check in (*checks, check_stamps, check_gaps) for finding in check(data)]
    found += check_validity(data)
    return sorted(found, key=lambda each: list(Severity).index(each.level))


def _to_sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}."


# --- missing and unused sensors -----------------------------------------------------------------------------


def check_missing(data: ReplayData) -> Iterable[ReportFinding]:
    for key, channel in data.missing_channels:
        if data.mode in MODES_WITHOUT.get(key, ()):
            continue
        remedy = "Correct the channel."
        if key in MODES_WITHOUT:
            mode = MODES_WITHOUT[key][0].name.lower()
            remedy = f"Correct the channel; a vehicle without it: localization.mode: {mode}, or no sensors.{key}."
        yield error(
            f"No messages on channel {channel} (sensors.{key})",
            f"The log has {', '.join(data.channels)}." if data.channels else "The log is empty.",
            remedy,
        )


def check_clocks(data: ReplayData) -> Iterable[ReportFinding]:
    """Find stamps that are on another axis than the log's times: of one source, or of all."""
    level, advice = (
        (note, "As it should be for a simulation; else the clock of the recorder was off.")
        if data.axis.common
        else (error, "Correct the clock of its driver: utime is microseconds since 1970, UTC.")
    )
    for sentence in data.axis.describe():
        title, _, observation = sentence.rpartition(": ")
        yield level(_to_sentence(title)[:-1], _to_sentence(observation), advice)


RANGE_ADVICE = {
    "wheels": "Check the units in the driver: speed in m/s and travel in m; mm are too large by 1000.",
    "gps": "Check the units in the driver: latitude and longitude in degrees, height in meters; and that the origin of "
    "the vehicle file is in the UTM zone of the drive: without one the first fixes set it.",
    "imu": "Check the units in the driver: rates in rad/s, specific force in m/s2.",
}
"""What to do about samples of a sensor that are out of range."""

REASONS = {
    "gate": "fixes disagree with the motion, see the track",
    "nan": "the driver sends non-finite numbers: check its input",
    "no_fix": "the receiver reports no fix, or a type below localization.filter.minimum_fix_type: check its antenna",
    "satellites": "fewer than localization.filter.minimum_satellites",
    "dilution": "hdop above localization.filter.maximum_hdop",
    "sigma": "the sigma of its fixes is above localization.filter.maximum_sigma",
    "range": "no position on Earth, or outside the origin's UTM zone",
    "too_old": "its stamps are older than localization.filter.horizon: check its clock and its latency",
    "duplicate": "a driver sends samples twice, or two sensors share one header.source",
    "future": "its clock is ahead of the others': synchronize them",
}
"""Explanation of the reasons for which samples are rejected, and what to do."""


def check_unused(data: ReplayData) -> Iterable[ReportFinding]:
    used: dict[str, set[tuple[int, int]]] = {}
    rejected: dict[str, dict[tuple[int, int], str]] = {}
    for each in data.decisions:
        stamp = (each.utime, each.seq)
        if each.verdict is Verdict.REJECTED:
            rejected.setdefault(each.source, {}).setdefault(stamp, each.reason or "rejected")
        else:
            used.setdefault(each.source, set()).add(stamp)
    for source, key in sorted(data.sensor_keys.items()):
        reasons = rejected.get(source, {})
        # accepted IMU samples have no decisions
        good = data.count_samples(source) - len(reasons) if key == "imu" else len(used.get(source, ()))
        if len(reasons) < MIN_SAMPLES or good > UNUSED_SHARE * (good + len(reasons)):
            continue
        ((reason, _),) = Counter(reasons.values()).most_common(1)
        if reason == "gate":
            continue  # fixes disagree with the motion; other checks find which of them is wrong
        observation = (
            f"Of {format_count(len(reasons), 'sample')} of {source} with a decision, nearly all were rejected."
        )
        advice = _to_sentence(REASONS.get(reason, "docs/words.md explains the reason"))
        known = data.sensor_motion.lateral_offsets
        if key == "wheels" and reason in ("names", "nan") and data.wheel_names and not known.keys() & data.wheel_names:
            observation += (
                f" The log's wheels are {', '.join(data.wheel_names)}; sensors.wheels.frames has {', '.join(known)}."
            )
            advice = "Use the log's names in sensors.wheels.frames, or the vehicle file's names in the driver."
        elif reason == "range":
            advice = RANGE_ADVICE.get(key, "Check the units in the driver: meters, seconds and radians.")
        yield error(f"No sample of sensors.{key} is used: {reason}", observation, advice)


# --- units, signs and names: comparison of sensors ----------------------------------------------------------


def check_gyro_unit(data: ReplayData) -> Iterable[ReportFinding]:
    """Find a gyro in degrees per second: its rate is 57 times that of wheels, without them that of fixes."""
    motion = data.sensor_motion
    pairs = (
        (compare_turn_rates(motion.gyro, motion.wheel_turn_rate), "wheels"),
        (motion.compare_with_course(motion.gyro), "fixes"),
    )
    known = [(found.ratio, what) for found, what in pairs if found is not None and abs(found.correlation) > 0.5]
    for ratio, what in known[:1]:
        # wheels that skid through a turn measure up to twice its rate
        if 0.4 * DEGREES_PER_RADIAN < ratio < 1.6 * DEGREES_PER_RADIAN:
            yield error(
                "The gyro is in degrees per second",
                f"Its rate is {ratio:.0f} times that of the {what}; a radian is 57.3 degrees.",
                "angular_velocity must be in rad/s: check the unit in its driver.",
            )


def check_wheel_signs(data: ReplayData) -> Iterable[ReportFinding]:
    raw = data.sensor_motion
    reference = raw.gyro
    if any(check_gyro_unit(data)):
        reference = {second: math.radians(rate) for second, rate in raw.gyro.items()}
    against, straight = raw.count_opposed(reference)
    if straight >= 5 and against > 0.8 * straight:
        backward = raw.backward_wheels()
        names = ", ".join(backward)
        yield error(
            f"Wheel {names} counts backward" if backward else "The wheels of one side count backward",
            f"In {against} of {straight} s of straight driving by the gyro the sides rolled against each other.",
            REVERSE_WHEEL,
        )
        return
    course = raw.compare_with_course(raw.wheel_turn_rate)
    by_gyro = compare_turn_rates(raw.gyro, raw.wheel_turn_rate)
    compared, what = (by_gyro, "gyro") if raw.gyro else (course, "fixes' course")
    if compared is None or compared.correlation > -0.6:
        return
    if raw.gyro and course is not None and course.correlation > 0.6:
        yield error(
            "The gyro's rate has the opposite sign of wheels and fixes",
            f"Its correlation with the wheels' turn rate is {compared.correlation:.2f}).",
            "Check the IMU mount in the geometry, and the signs in its driver.",
        )
        return
    yield error(
        "Left and right wheels are swapped",
        f"The correlation of the wheels' turn rate with the {what} is {compared.correlation:.2f}).",
        "Swap the names in sensors.wheels.frames, or the frames' positions in the geometry; where all wheels count "
        "backward, reverse their signs.",
    )


def check_distances(data: ReplayData) -> Iterable[ReportFinding]:
    """Find fixes and wheels with different distances: one of them has the wrong unit."""
    found = data.sensor_motion.compare_distances()
    if found.wheels < 20.0:
        return
    ratio = found.wheels / max(found.fixes, 1e-6)
    if 1.0 / 3.0 < ratio < 3.0:
        return
    if 0.5 * DEGREES_PER_RADIAN < ratio < 2.0 * DEGREES_PER_RADIAN:
        advice = "57 is degrees per radian: the receiver's driver must give degrees, not radians."
    elif 500.0 < ratio < 2000.0:
        advice = "1000 is mm per m: the wheels' driver must give travel in m and speed in m/s."
    else:
        advice = "Check the units in both drivers (m and m/s; degrees), and the wheel radius."
    yield error(
        f"Fixes moved {found.fixes:.1f} m while the wheels rolled {found.wheels:.0f} m",
        f"The distance by the wheels is {ratio:.3g} times that of the fixes.",
        advice,
    )


def check_gravity(data: ReplayData) -> Iterable[ReportFinding]:
    """Find a mean specific force that differs from gravity in size or direction."""
    if data.mean_force is None:
        return
    x, y, z = data.mean_force
    angle = math.atan2(math.hypot(x, y), z)
    size = math.sqrt(x * x + y * y + z * z)
    if angle > 0.3 and size > 0.5:
        yield error(
            "The IMU mount differs from the geometry",
            f"The mean specific force is {math.degrees(angle):.0f} degrees from the vehicle's up axis "
            f"({x:+.1f}, {y:+.1f}, {z:+.1f} m/s2 along x, y, z).",
            "Run modelserver calibrate imu LOG -c VEHICLE: it finds the mount that fits.",
        )
    if 0.9 < size < 1.1:
        yield error(
            "Specific force is in g, not in m/s2",
            f"Its mean is {size:.2f}, and gravity is 9.81 m/s2.",
            "specific_force must be in m/s2: check the unit in its driver.",
        )
    elif not 9.0 < size < 10.6:
        yield error(
            f"The mean specific force is {size:.2f} m/s2",
            "In any drive its mean is close to 9.8 m/s2.",
            "Check the unit of acceleration in the driver, and whether gravity is subtracted there.",
        )


# --- wheels -------------------------------------------------------------------------------------------------


def check_wheels(data: ReplayData) -> Iterable[ReportFinding]:
    """Find wheels with reversed sign, and wheels without pulses."""
    by_name = sorted(data.wheels, key=lambda each: each.name)
    for name, turns in groupby(by_name, lambda each: each.name):
        moving = [each for each in turns if abs(each.expected) > MOVING_SPEED]
        if len(moving) < MIN_SAMPLES:
            continue
        against = sum(abs(each.measured + each.expected) < 0.3 * abs(each.expected) for each in moving)
        runs = [list(run) for is_silent, run in groupby(moving, lambda each: abs(each.measured) < 0.02) if is_silent]
        silent, longest = sum(map(len, runs)), max((run[-1].t - run[0].t for run in runs), default=0.0)
        if against > 0.5 * len(moving):
            yield error(
                f"Wheel {name} counts backward",
                f"In {against} of {len(moving)} samples in motion it measured the negative of the expected speed.",
                REVERSE_WHEEL,
            )
        elif silent > 0.5 * len(moving) or longest > 5.0:
            yield error(
                f"Wheel {name} is stationary while the vehicle drives",
                f"It measured no motion in {silent} of {len(moving)} samples, for up to {longest:.0f} s.",
                "Check its encoder, cable and plug; leave a wheel without encoder out of sensors.wheels.frames.",
            )


def check_direction(data: ReplayData) -> Iterable[ReportFinding]:
    """Find a vehicle that drives backward nearly all the time: front and rear are swapped."""
    moving = [each for each in data.snapshots if abs(each.speed) > MOVING_SPEED]
    backward = sum(each.speed < 0.0 for each in moving)
    if len(moving) >= 2 * MIN_SAMPLES and backward > 0.8 * len(moving):
        yield warning(
            "The vehicle drives backward nearly all the time",
            f"Forward speed is negative in {backward / len(moving):.0%} of the time in motion.",
            "If it drove forward: all wheels count backward, or the IMU mount is rotated by 180 degrees.",
        )


def check_wheel_scale(data: ReplayData) -> Iterable[ReportFinding]:
    """Find wheels whose radius or rolling direction differs from driver and geometry."""
    settings = data.settings
    scale, sigma = _get_state(data, "wheel_scale")
    if abs(scale) > max(2.0 * settings.wheel_scale_sigma, 3.0 * sigma):
        word = "too long" if scale > 0.0 else "too short"
        yield warning(
            f"The distance by the wheels is {abs(scale):.1%} {word}",
            f"wheel_scale ended at {scale:+.3f} +- {sigma:.3f}; its prior sigma is {settings.wheel_scale_sigma:.3f}.",
            f"Multiply the wheel radius in the driver by {1.0 / (1.0 + scale):.3f}.",
        )
    yaw, sigma = _get_state(data, "wheel_yaw")
    if abs(yaw) > max(3.0 * settings.wheel_yaw_sigma, 3.0 * sigma):
        yield warning(
            f"The wheels roll {abs(math.degrees(yaw)):.1f} degrees to the {'left' if yaw > 0.0 else 'right'}",
            f"wheel_yaw ended at {math.degrees(yaw):+.2f} +- {math.degrees(sigma):.2f} degrees from the geometry's x.",
            "Survey the yaw of the rolling frame and of the IMU: gravity and wheels cannot distinguish the two.",
        )


# --- IMU ----------------------------------------------------------------------------------------------------


def check_frozen_imu(data: ReplayData) -> Iterable[ReportFinding]:
    if data.frozen:
        total = sum(b - a for a, b in data.frozen)
        begin = data.frozen[0][0]
        yield error(
            "The IMU froze",
            f"It repeated one sample {format_count(len(data.frozen), 'time')}, {total:.1f} s in all, first at "
            f"{begin:.0f} s.",
            "Its driver repeats the last sample when the unit is silent: it must send nothing then. Check the unit's "
            "cable.",
        )


def check_biases(data: ReplayData) -> Iterable[ReportFinding]:
    for kind, words, unit, factor in (
        ("gyro_bias", "Gyro bias about", "deg/s", math.degrees(1.0)),
        ("accelerometer_bias", "Accelerometer bias along", "m/s2", 1.0),
    ):
        limit = getattr(data.settings, f"{kind}_sigma")
        for axis in "xyz":
            value, sigma = _get_state(data, f"{kind}_{axis}")
            if abs(value) > 3.0 * max(limit, sigma):
                yield warning(
                    f"{words} {axis} is far outside its data sheet",
                    f"It ended at {value * factor:+.3g} +- {sigma * factor:.2g} {unit}; {kind}_sigma is "
                    f"{limit * factor:.3g}.",
                    f"Check the unit and its mount; if the unit is that poor, set localization.filter.{kind}_sigma "
                    "to the data sheet's value.",
                )


# --- fixes --------------------------------------------------------------------------------------------------


ADVICE = {
    "gps_height": "The receiver's height is worse than stated, as is usual. Where height matters use a better "
    "source; gps_correlation_time and uere model the error of fixes.",
    "gps_position": "Its stated sigma is too small, or there is a latency, a wrong antenna lever arm, or multipath: "
    "see the track, and try modelserver tune.",
    "wheel_speed": "wheel_sigma and slip_ratio are too small for these wheels, or their stamps have a latency: "
    "try modelserver tune.",
    "non_holonomic": "The vehicle slides more than side_sigma, side_slip and roll_point_sigma model, or the rolling "
    "frame is another point: try modelserver tune.",
    "zero_rate": "The stationary gyros are noisier than gyro_noise: modelserver calibrate imu measures it.",
    "zero_velocity": "It rocks more at rest than stationary_sigma, or it is not stationary: see its speed then.",
}
"""What to do about a kind of measurement with too large innovations; GENERAL_ADVICE for the others."""

GENERAL_ADVICE = "Its stated sigma may be too small; check mount, latency and position of the sensor."


def check_stated_sigma(data: ReplayData) -> Iterable[ReportFinding]:
    """Find kinds of measurement with inconsistent innovations (NIS far from 1)."""
    # the noise of constraints without a sensor is inflated on purpose
    constraints = {each.kind for each in data.decisions if each.source == "filter"}
    for each in compute_consistency(data.decisions):
        if each.count < 30:
            continue
        seen = (
            f"Mean NIS is {each.mean:.2f} over {each.count} innovations, expected 1; {each.beyond:.0%} exceed the 95 % "
            "limit."
        )
        if each.mean > 2.5:
            advice = ADVICE.get(each.kind, GENERAL_ADVICE)
            yield warning(f"{each.kind}: errors larger than its sigma", seen, advice)
        elif each.mean < 0.15 and each.kind not in constraints:
            yield note(
                f"{each.kind}: errors smaller than its sigma",
                seen,
                "Nothing is wrong; a smaller sigma would give it more weight. modelserver tune measures the gain.",
            )


def check_latency(data: ReplayData) -> Iterable[ReportFinding]:
    """Find fixes with a constant latency relative to the other sensors."""
    found = estimate_fix_latency(data)
    if found is None:
        return
    # the residuals have what the filter's own estimate leaves
    estimated, _ = _get_state(data, "gps_latency")
    seconds, sigma = found[0] + (0.0 if math.isnan(estimated) else estimated), found[1]
    if abs(seconds) > max(0.1, 4.0 * sigma):
        where = "behind" if seconds > 0.0 else "ahead of"
        yield warning(
            f"Fixes lie {abs(seconds):.2f} s {where} the vehicle",
            f"Their residuals along the path are proportional to the speed: {seconds:+.2f} +- {sigma:.2f} s.",
            f"If the receiver's stamps have this latency, set sensors.gps.latency: {seconds:.2f}; NIS should fall."
            if seconds > 0.0
            else "The other sensors' stamps may have a latency: check those of IMU and wheels.",
        )


LATENCY_BLOCKS = 8
LATENCY_WINDOW = 60.0


def estimate_fix_latency(data: ReplayData) -> tuple[float, float] | None:
    """Return the latency of the fixes and its sigma, s; None without enough change of velocity."""
    fixes = [each for each in data.fixes if each.residual is not None and each.velocity is not None]
    if len(fixes) < 5 * LATENCY_BLOCKS:
        return None
    t = np.array([each.t for each in fixes])
    off = np.array([each.residual for each in fixes])
    v = np.array([each.velocity for each in fixes])
    for series in (off, v):
        series -= _smooth(t, series)
    part = np.minimum((np.arange(len(t)) * LATENCY_BLOCKS) // len(t), LATENCY_BLOCKS - 1)
    cross = np.bincount(part, -(off * v).sum(axis=1))
    square = np.bincount(part, (v * v).sum(axis=1))
    total = float(square.sum())
    if total < 0.05 * len(t):  # too little change: 0.2 m/s rms
        return None
    tau = float(cross.sum()) / total
    scatter = cross - tau * square
    sigma = math.sqrt(float((scatter**2).sum()) * LATENCY_BLOCKS / (LATENCY_BLOCKS - 1)) / total
    return tau, sigma


def _smooth(t: Array, series: Array) -> Array:
    """Return the mean of each column within a window around each time."""
    sums = np.vstack([np.zeros((1, series.shape[1])), np.cumsum(series, axis=0)])
    low = np.searchsorted(t, t - 0.5 * LATENCY_WINDOW, side="left")
    high = np.searchsorted(t, t + 0.5 * LATENCY_WINDOW, side="right")
    means: Array = (sums[high] - sums[low]) / (high - low)[:, None]
    return means


def check_rejected_fixes(data: ReplayData) -> Iterable[ReportFinding]:
    reasons = Counter(each.reason or each.verdict for each in data.fixes if each.verdict == "rejected")
    rejected, total = sum(reasons.values()), len(data.fixes)
    if total >= 20 and rejected > 0.2 * total:
        words = ", ".join(f"{count} {reason}" for reason, count in reasons.most_common(3))
        known = [f"{reason}: {REASONS.get(reason, 'docs/words.md')}" for reason, _ in reasons.most_common(3)]
        yield warning(
            f"{rejected / total:.0%} of the fixes were rejected",
            f"Of {format_count(total, 'fix', 'fixes')} as positions: {words}.",
            f"{'; '.join(known)}.",
        )


# --- all ----------------------------------------------------------------------------------------------------


def check_stamps(data: ReplayData) -> Iterable[ReportFinding]:
    for reason in ("too_old", "duplicate", "future"):
        by_source: Counter[str] = Counter()
        for (source, why), count in data.rejected.items():
            if why == reason:
                by_source[source] += count
        for source, count in sorted(by_source.items()):
            if count >= 5:
                yield warning(
                    f"{source}: {format_count(count, 'sample')} {reason}",
                    "They were not used.",
                    _to_sentence(REASONS[reason]),
                )


def check_gaps(data: ReplayData) -> Iterable[ReportFinding]:
    for sensor in data.sensors:
        found = [(a, b) for a, b in sensor.find_gaps() if b - a > max(1.0, 5.0 * sensor.period)]
        if found:
            longest = max(b - a for a, b in found)
            yield note(
                f"{sensor.name}: {format_count(len(found), 'gap')}, the longest {longest:.1f} s",
                f"Its period is {sensor.period:.3g} s; the first gap begins at {found[0][0]:.0f} s.",
                "See the position's sigma in the gap; check the device's link if it was not intended.",
            )


def check_validity(data: ReplayData) -> Iterable[ReportFinding]:
    """Find poses that were invalid for long after the start, and those that were never valid."""
    found = summarize_validity(data)
    if not data.snapshots:
        yield error(
            "There was never a state", "No sample of a configured sensor could be used.", _to_sentence(NO_SAMPLES)
        )
    elif math.isnan(found.first_valid):
        reason = f"At the end: {data.snapshots[-1].invalid.explain()}."
        yield error("The pose was never valid", reason, _to_sentence(found.reasons[0].remedy))
    elif found.is_interrupted:
        yield warning(
            f"The pose was not valid in {found.invalid_after / found.after:.0%} of the time after it first was",
            f"Mostly: {'; '.join(each.reason for each in found.reasons_after[:2])}.",
            _to_sentence(found.reasons_after[0].remedy),
        )


def _has_diverged(decision: Decision) -> bool:
    return decision.verdict is Verdict.RESET and "diverged" in decision.reason


def is_position_reset(decision: Decision) -> bool:
    """Return whether a decision moved the position, unlike those that begin a localization or change its mode."""
    return decision.verdict is Verdict.RESET and ("agree" in decision.reason or _has_diverged(decision))


def check_divergence(data: ReplayData) -> Iterable[ReportFinding]:
    """Find a filter that restarted after divergence, or that reset its position."""
    restarts = [each for each in data.decisions if _has_diverged(each)]
    resets = [each for each in data.decisions if is_position_reset(each) and not _has_diverged(each)]
    for title, found in (("The filter was restarted", restarts), ("The position was reset", resets)):
        if found:
            first = found[0]
            times = "" if len(found) == 1 else f", first of {len(found)} times"
            yield warning(
                title,
                f"At {data.to_seconds(first.utime):.0f} s{times}: {first.reason}.",
                "See the innovations before it: which kind failed first?",
            )


Check = Callable[[ReplayData], Iterable[ReportFinding]]

SENSOR_CHECKS: tuple[Check, ...] = (
    check_missing,
    check_clocks,
    check_unused,
    check_gravity,
    check_gyro_unit,
    check_wheel_signs,
    check_distances,
)
"""In the order of the report."""

CHECKS: tuple[Check, ...] = (check_frozen_imu, check_divergence)

SENSOR_RESIDUAL_CHECKS: tuple[Check, ...] = (check_wheels, check_direction)
"""Checks that compare sensors with the filter's state: with a known cause they only repeat it."""

STATE_CHECKS: tuple[Check, ...] = (check_wheel_scale, check_biases, check_latency, check_stated_sigma)
"""Checks that need a filter without divergence."""


def _get_state(data: ReplayData, name: str) -> tuple[float, float]:
    """Return the value and sigma of a state at the end, nan where there is none."""
    last = next((each for each in reversed(data.snapshots) if each.values), None)
    return (math.nan, math.nan) if last is None else (last.values.get(name, math.nan), last.sigmas.get(name, math.nan))


# --- consistency of the innovations -------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Consistency:
    """Innovations of one kind of measurement.

    Attributes
    ----------
    count : number of innovations
    rejected : innovations that the gate rejected; included in `mean` and `beyond`
    mean : mean NIS per degree of freedom
    beyond : share of innovations beyond the 95 % limit
    """

    kind: str
    count: int
    rejected: int
    mean: float
    beyond: float


def has_nis(decision: Decision) -> bool:
    """Return whether a decision has an innovation and was not set aside on purpose."""
    return decision.dof > 0 and math.isfinite(decision.statistic) and decision.verdict is not Verdict.MONITORED


def compute_consistency(decisions: Iterable[Decision]) -> list[Consistency]:
    """Return the consistency of each kind of measurement, by name."""
    known = sorted(filter(has_nis, decisions), key=lambda each: each.kind)
    result = []
    for kind, group in groupby(known, lambda each: each.kind):
        found = list(group)
        rejected = sum(each.verdict is Verdict.REJECTED for each in found)
        beyond = sum(each.statistic > chi_square_gate(each.dof, 0.05) for each in found)
        mean = sum(each.statistic for each in found) / sum(each.dof for each in found)
        result.append(Consistency(kind, len(found), rejected, mean, beyond / len(found)))
    return result


def compute_running_nis(decisions: Iterable[Decision], window_s: float) -> tuple[list[int], list[float]]:
    """Return utimes and the mean NIS per degree of freedom in the `window_s` before each."""
    known = sorted(filter(has_nis, decisions), key=lambda decision: decision.utime)
    utimes = np.array([each.utime for each in known], dtype=np.int64)
    first = np.searchsorted(utimes, utimes - round(window_s * 1e6))
    totals = np.cumsum([0.0, *(each.statistic for each in known)])
    numbers = np.cumsum([0, *(each.dof for each in known)])
    means = np.maximum(totals[1:] - totals[first], 0.0) / (numbers[1:] - numbers[first])
    return utimes.tolist(), means.tolist()
