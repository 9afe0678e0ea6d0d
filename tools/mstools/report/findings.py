"""Findings of a replay: what its decisions and states reveal about vehicle file, sensors and settings. Pure.

Each check is a function of `ReplayData` and yields findings: what was observed, the probable cause, and what to do. It
yields nothing where there is too little data. Tests of consistency compare the mean NIS per degree of freedom with 1
(consistency.py). The GNSS latency tau is a least-squares fit of the horizontal residuals r to the velocity v, both
high-pass filtered by subtracting a running mean: a fix that is tau old lies at -tau v, so tau = -sum(r v) / sum(v^2);
its sigma is from the scatter over parts of the drive.
Order: causes from the raw sensor data (sensor_checks.py) first; with one of them, checks that would only repeat its
consequences are left out, and so are checks of the state of a filter that diverged.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable
from itertools import groupby

import numpy as np

from modelserver.messages import Decision, Invalid, Verdict
from modelserver.transforms.so3 import Array
from mstools.report import consistency
from mstools.report.replay_data import ReplayData, ReportFinding, error, note, warning
from mstools.report.sensor_checks import SENSOR_CHECKS
from mstools.terminal.output import format_count

MOVING_SPEED = 0.3
"""Speed, m/s, above which the errors of wheels and fixes are evaluated."""

MIN_WHEEL_SAMPLES = 20
"""Fewest samples in motion to evaluate a wheel."""


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
    found += check_validity(data, has_cause=bool(causes))
    return sorted(found, key=lambda each: each.level)


# --- wheels -------------------------------------------------------------------------------------------------


def check_wheels(data: ReplayData) -> Iterable[ReportFinding]:
    """Find wheels with reversed sign, and wheels without pulses."""
    by_name = sorted(data.wheels, key=lambda each: each.name)
    for name, turns in groupby(by_name, lambda each: each.name):
        moving = [each for each in turns if abs(each.expected) > MOVING_SPEED]
        if len(moving) < MIN_WHEEL_SAMPLES:
            continue
        against = sum(abs(each.measured + each.expected) < 0.3 * abs(each.expected) for each in moving)
        runs = [list(run) for is_silent, run in groupby(moving, lambda each: abs(each.measured) < 0.02) if is_silent]
        silent, longest = sum(map(len, runs)), max((run[-1].t - run[0].t for run in runs), default=0.0)
        if against > 0.5 * len(moving):
            yield error(
                f"Wheel {name} counts backward",
                f"In {against} of {len(moving)} samples in motion it measured the negative of the expected speed.",
                "Reverse the sign of this wheel in its driver, or swap its encoder's two channels.",
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
    if len(moving) >= 2 * MIN_WHEEL_SAMPLES and backward > 0.8 * len(moving):
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
    """Find an IMU that repeats one sample."""
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
    """Find biases far outside the data sheet."""
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
    for each in consistency.compute_consistency(data.decisions):
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
    seconds, sigma = found
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


REJECT_REASONS = {
    "gate": "gate: fixes disagree with the motion, see the track",
    "nan": "nan: the driver sent a non-finite number",
    "no_fix": "no_fix: the receiver reports none, or a fix type below localization.filter.minimum_fix_type",
    "satellites": "satellites: fewer than localization.filter.minimum_satellites",
    "dilution": "dilution: hdop above localization.filter.maximum_hdop",
    "sigma": "sigma: above localization.filter.maximum_sigma",
    "range": "range: no position on Earth, or outside the origin's UTM zone",
}
"""Explanation of the reasons for which fixes are rejected."""


def check_rejected_fixes(data: ReplayData) -> Iterable[ReportFinding]:
    """Find a large share of rejected fixes, with the reasons."""
    reasons = Counter(each.reason or each.verdict for each in data.fixes if each.verdict == "rejected")
    rejected, total = sum(reasons.values()), len(data.fixes)
    if total >= 20 and rejected > 0.2 * total:
        words = ", ".join(f"{count} {reason}" for reason, count in reasons.most_common(3))
        known = [REJECT_REASONS.get(reason, f"{reason}: docs/words.md") for reason, _ in reasons.most_common(3)]
        yield warning(
            f"{rejected / total:.0%} of the fixes were rejected",
            f"Of {format_count(total, 'fix', 'fixes')} as positions: {words}.",
            f"{'; '.join(known)}.",
        )


# --- all ----------------------------------------------------------------------------------------------------


def check_stamps(data: ReplayData) -> Iterable[ReportFinding]:
    """Find delayed, duplicate and future samples."""
    for reason, advice in (
        ("too_old", "Their latency exceeds localization.filter.horizon: check clock and link."),
        ("duplicate", "A driver sends samples twice, or two sensors share one header.source."),
        ("future", "The sensor's clock is ahead of the host's: synchronize them."),
    ):
        by_source: Counter[str] = Counter()
        for (source, why), count in data.rejected.items():
            if why == reason:
                by_source[source] += count
        for source, count in sorted(by_source.items()):
            if count >= 5:
                yield warning(
                    f"{source}: {format_count(count, 'sample')} {reason}",
                    "They were not used.",
                    advice,
                )


def check_gaps(data: ReplayData) -> Iterable[ReportFinding]:
    """Find sensors with gaps that cost accuracy."""
    for sensor in data.sensors:
        found = [(a, b) for a, b in sensor.find_gaps() if b - a > max(1.0, 5.0 * sensor.period)]
        if found:
            longest = max(b - a for a, b in found)
            yield note(
                f"{sensor.name}: {format_count(len(found), 'gap')}, the longest {longest:.1f} s",
                f"Its period is {sensor.period:.3g} s; the first gap begins at {found[0][0]:.0f} s.",
                "See the position's sigma in the gap; check the device's link if it was not intended.",
            )


def check_validity(data: ReplayData, has_cause: bool = False) -> Iterable[ReportFinding]:
    """Find poses that were invalid for long after the start, and headings that were never found.

    `has_cause`: other findings explain it; then the reasons given with poses are not repeated.
    """
    consequence = ("Probably a consequence of the findings above.", "Fix those first.")
    if not data.snapshots:
        reason = "No sample of a configured sensor could be used."
        advice = "Compare the channels in the log with those in the vehicle file."
        yield error("There was never a state", *(consequence if has_cause else (reason, advice)))
        return
    first = next((n for n, each in enumerate(data.snapshots) if not each.invalid), None)
    if first is None:
        reason = f"At the end: {data.snapshots[-1].invalid.explain()}."
        advice = (
            "Heading alignment takes a few meters of driving with fixes; the strip below shows the reasons over time."
        )
        yield error("The pose was never valid", *(consequence if has_cause else (reason, advice)))
        return
    after = data.snapshots[first:]
    bad = [each for each in after if each.invalid]
    if len(bad) > 0.05 * len(after):
        reasons = Counter(flag for each in bad for flag in Invalid if flag in each.invalid)
        words = "; ".join(flag.explain() for flag, _ in reasons.most_common(2))
        yield warning(
            f"The pose was not valid in {len(bad) / len(after):.0%} of the time after it first was",
            f"Mostly: {words}.",
            "See the strip of reasons below.",
        )


def _has_diverged(decision: Decision) -> bool:
    return decision.verdict is Verdict.RESET and "diverged" in decision.reason


def check_divergence(data: ReplayData) -> Iterable[ReportFinding]:
    """Find a filter that restarted after divergence, or that reset its position."""
    restarts = [each for each in data.decisions if _has_diverged(each)]
    resets = [each for each in data.decisions if each.verdict is Verdict.RESET and "agree" in each.reason]
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

CHECKS: tuple[Check, ...] = (check_frozen_imu, check_divergence)

SENSOR_RESIDUAL_CHECKS: tuple[Check, ...] = (check_wheels, check_direction)
"""Checks that compare sensors with the filter's state: with a known cause they only repeat it."""

STATE_CHECKS: tuple[Check, ...] = (check_wheel_scale, check_biases, check_latency, check_stated_sigma)
"""Checks that need a filter without divergence."""


def _get_state(data: ReplayData, name: str) -> tuple[float, float]:
    """Return the value and sigma of a state at the end, nan where there is none."""
    last = next((each for each in reversed(data.snapshots) if each.values), None)
    return (math.nan, math.nan) if last is None else (last.values.get(name, math.nan), last.sigmas.get(name, math.nan))
