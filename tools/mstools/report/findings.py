"""What a replay's decisions and states say is wrong with the vehicle file, the sensors or the settings. Pure.

Each check is a function of all that was gathered, and says what was seen, what it probably means and what to do. A
check keeps silent where there is too little to judge by.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable

import numpy as np

from modelserver.messages import Decision, Invalid, Verdict
from modelserver.spatial.so3 import Array
from mstools.report import consistency
from mstools.report.causes import CAUSES
from mstools.report.data import Replayed, StateSample, WheelTurn
from mstools.report.finding import FindingLevel, ReportFinding
from mstools.terminal.output import counted

MOVING = 0.3
"""Speed, m/s, from which a wheel's or a fix's error tells something."""

LEAST_TURNS = 20
"""Fewest wheel samples on the move that a wheel is judged by."""


def findings(replayed: Replayed) -> list[ReportFinding]:
    """Return all findings, worst first, and of equals the causes first.

    What only follows from a sensor that is wrong, or from a filter that had to begin anew, is left out.
    """
    causes = [finding for check in CAUSES for finding in check(replayed)]
    checks = list(CHECKS)
    if not causes:
        checks += LOOKING_AT_SENSORS
        if not any(_has_diverged(each) for each in replayed.decisions):
            checks += OF_A_SOUND_STATE
        checks.append(refused_fixes)
    found = causes + [finding for check in (*checks, stamps, gaps) for finding in check(replayed)]
    found += validity(replayed, explained=bool(causes))
    return sorted(found, key=lambda each: each.grade)


# --- wheels -------------------------------------------------------------------------------------------------


def wheels_reversed(replayed: Replayed) -> Iterable[ReportFinding]:
    """Look for wheels that tell the negative of what is expected of them, and for wheels that tell nothing."""
    for name, turns in sorted(_by_wheel(replayed.wheels).items()):
        moving = [each for each in turns if abs(each.expected) > MOVING]
        if len(moving) < LEAST_TURNS:
            continue
        against = [each for each in moving if abs(each.measured + each.expected) < 0.3 * abs(each.expected)]
        if len(against) > 0.5 * len(moving):
            yield ReportFinding(
                FindingLevel.WRONG,
                f"Wheel {name} counts backward",
                f"In {len(against)} of {len(moving)} samples on the move it told the negative of what was expected.",
                "Turn the sign of this wheel in its driver, or swap its encoder's two channels.",
            )
            continue
        silent = [each for each in moving if abs(each.measured) < 0.02]
        longest = _longest(silent, moving)
        if len(silent) > 0.5 * len(moving) or longest > 5.0:
            yield ReportFinding(
                FindingLevel.WRONG,
                f"Wheel {name} stands while the vehicle drives",
                f"It told no motion in {len(silent)} of {len(moving)} samples on the move, for up to {longest:.0f} s.",
                "Look at its encoder, cable and plug; a wheel without encoder is left out of sensors.wheels.frames.",
            )


def _by_wheel(turns: Iterable[WheelTurn]) -> dict[str, list[WheelTurn]]:
    wheels: dict[str, list[WheelTurn]] = {}
    for each in turns:
        wheels.setdefault(each.name, []).append(each)
    return wheels


def _longest(marked: list[WheelTurn], among: list[WheelTurn]) -> float:
    """Return the longest time over which all of `among` are marked, seconds."""
    chosen = set(map(id, marked))
    longest, since = 0.0, math.nan
    for each in among:
        if id(each) not in chosen:
            since = math.nan
        else:
            since = each.t if math.isnan(since) else since
            longest = max(longest, each.t - since)
    return longest


def always_backward(replayed: Replayed) -> Iterable[ReportFinding]:
    """Look for a vehicle that drives backward nearly all the time: then front and rear are mistaken."""
    moving = [each for each in replayed.snapshots if abs(each.speed) > MOVING]
    backward = sum(each.speed < 0.0 for each in moving)
    if len(moving) >= 2 * LEAST_TURNS and backward > 0.8 * len(moving):
        yield ReportFinding(
            FindingLevel.DOUBTFUL,
            "The vehicle drives backward nearly all the time",
            f"Forward speed is negative in {backward / len(moving):.0%} of the time on the move.",
            "If it drove forward: all wheels count backward, or the inertial unit's mount is turned by 180 degrees.",
        )


def wheel_scale(replayed: Replayed) -> Iterable[ReportFinding]:
    """Look for wheels of another size than their driver takes them for, or at another angle than in the geometry."""
    last = _last(replayed)
    settings = replayed.settings
    scale, sigma = _state(last, "wheel_scale")
    if math.isfinite(scale) and abs(scale) > max(2.0 * settings.wheel_scale_sigma, 3.0 * sigma):
        word = "too far" if scale > 0.0 else "too short"
        yield ReportFinding(
            FindingLevel.DOUBTFUL,
            f"The wheels tell {abs(scale):.1%} {word}",
            f"wheel_scale ended at {scale:+.3f} +- {sigma:.3f}; {settings.wheel_scale_sigma:.3f} was expected of it.",
            f"Set the wheels' radius in their driver to {1.0 / (1.0 + scale):.3f} of what it is.",
        )
    yaw, sigma = _state(last, "wheel_yaw")
    if math.isfinite(yaw) and abs(yaw) > max(3.0 * settings.wheel_yaw_sigma, 3.0 * sigma):
        yield ReportFinding(
            FindingLevel.DOUBTFUL,
            f"The wheels roll {abs(math.degrees(yaw)):.1f} degrees to the {'left' if yaw > 0.0 else 'right'}",
            f"wheel_yaw ended at {math.degrees(yaw):+.2f} +- {math.degrees(sigma):.2f} degrees from the geometry's x.",
            "Survey the rolling frame's yaw, or the inertial unit's: gravity and wheels cannot tell the two apart.",
        )


# --- the inertial unit --------------------------------------------------------------------------------------


def frozen_unit(replayed: Replayed) -> Iterable[ReportFinding]:
    """Look for an inertial unit that repeats one value."""
    if replayed.frozen:
        total = sum(b - a for a, b in replayed.frozen)
        begin = replayed.frozen[0][0]
        yield ReportFinding(
            FindingLevel.WRONG,
            "The inertial unit froze",
            f"It repeated one value {counted(len(replayed.frozen), 'time')}, {total:.1f} s in all, first at "
            f"{begin:.0f} s.",
            "Its driver passes on the last value when the unit is silent: let it send nothing then, and look at the "
            "unit's cable.",
        )


def biases(replayed: Replayed) -> Iterable[ReportFinding]:
    """Look for biases far outside the data sheet's."""
    last, settings = _last(replayed), replayed.settings
    for kind, limit, unit, factor in (
        ("gyro_bias", settings.gyro_bias_sigma, "deg/s", math.degrees(1.0)),
        ("accelerometer_bias", settings.accelerometer_bias_sigma, "m/s2", 1.0),
    ):
        for axis in "xyz":
            value, sigma = _state(last, f"{kind}_{axis}")
            if math.isfinite(value) and abs(value) > 3.0 * limit and abs(value) > 3.0 * sigma:
                yield ReportFinding(
                    FindingLevel.DOUBTFUL,
                    f"{kind.replace('_', ' ').capitalize()} about {axis} is far outside its data sheet"
                    if kind == "gyro_bias"
                    else f"Accelerometer bias along {axis} is far outside its data sheet",
                    f"It ended at {value * factor:+.3g} +- {sigma * factor:.2g} {unit}; {kind}_sigma is "
                    f"{limit * factor:.3g}.",
                    f"Look at the unit and its mount; if this is how the unit is, set localization.filter.{kind}_sigma "
                    "to what its data sheet says.",
                )


# --- fixes --------------------------------------------------------------------------------------------------


ADVICE = {
    "gps_height": "The receiver's height is worse than it says, as heights are. Where height matters take a better "
    "source; gps_wander_time and uere say how fixes err.",
    "gps_position": "Its stated sigma is too small, or there is a latency, a wrong place of the antenna, or multipath: "
    "look at the track, and try modelserver tune.",
    "wheel_speed": "wheel_sigma and slip_share are too small for these wheels, or their stamps are late: "
    "try modelserver tune.",
    "non_holonomic": "The vehicle slides more than side_sigma, side_slip and roll_point_sigma say, or the rolling "
    "frame is another point: try modelserver tune.",
    "zero_rate": "The gyros are noisier at rest than gyro_noise says: modelserver calibrate imu measures it.",
    "zero_velocity": "It rocks more at rest than standing_sigma says, or it does not stand: look at its speed then.",
}
"""What to do about a kind that errs more than expected; others have a general advice."""

GENERAL = "Take its stated sigma for what it is worth; look for a mount, a latency or a sensor's place."


def stated_sigma(replayed: Replayed) -> Iterable[ReportFinding]:
    """Look for kinds of measurement whose innovations are far from what is expected of them."""
    # what is known without a sensor has its noise widened on purpose
    constraints = {each.kind for each in replayed.decisions if each.source == "filter"}
    for each in consistency.by_kind(replayed.decisions):
        if each.count < 30:
            continue
        seen = (
            f"NIS is {each.mean:.2f} in the mean of {each.count}, where 1 is expected; {each.beyond:.0%} are beyond "
            "the 95 % limit."
        )
        if each.mean > 2.5:
            advice = ADVICE.get(each.kind, GENERAL)
            yield ReportFinding(FindingLevel.DOUBTFUL, f"{each.kind} errs more than its sigma says", seen, advice)
        elif each.mean < 0.15 and each.kind not in constraints:
            yield ReportFinding(
                FindingLevel.NOTE,
                f"{each.kind} errs less than its sigma says",
                seen,
                "Nothing is wrong; it could count for more. modelserver tune says whether it is worth it.",
            )


def latency(replayed: Replayed) -> Iterable[ReportFinding]:
    """Look for fixes that lie behind the vehicle by a constant time."""
    found = fix_latency(replayed)
    if found is None:
        return
    seconds, sigma = found
    if abs(seconds) > max(0.1, 4.0 * sigma):
        where = "behind" if seconds > 0.0 else "ahead of"
        yield ReportFinding(
            FindingLevel.DOUBTFUL,
            f"Fixes lie {abs(seconds):.2f} s {where} the vehicle",
            f"Their residuals along the way go with the speed: {seconds:+.2f} +- {sigma:.2f} s.",
            f"If the receiver's stamps are late, set sensors.gps.latency: {seconds:.2f} and see whether NIS falls."
            if seconds > 0.0
            else "The other sensors' stamps may be late: see the inertial unit's and the wheels' latency.",
        )


LATENCY_BLOCKS = 8
LATENCY_WINDOW = 60.0


def fix_latency(replayed: Replayed) -> tuple[float, float] | None:
    """Return by how many seconds fixes are older than their stamps, with sigma; None where it cannot be told.

    A fix that is late by tau lies off by -tau times the velocity. What changes slowly (the wandering of fixes) is taken
    off both first. Sigma is from the scatter of the same figure over parts of the drive.
    """
    fixes = [each for each in replayed.fixes if each.off is not None and each.velocity is not None]
    if len(fixes) < 5 * LATENCY_BLOCKS:
        return None
    t = np.array([each.t for each in fixes])
    off = np.array([each.off for each in fixes])
    v = np.array([each.velocity for each in fixes])
    for series in (off, v):
        series -= _smoothed(t, series)
    part = np.minimum((np.arange(len(t)) * LATENCY_BLOCKS) // len(t), LATENCY_BLOCKS - 1)
    cross = np.array([-float((off[part == n] * v[part == n]).sum()) for n in range(LATENCY_BLOCKS)])
    square = np.array([float((v[part == n] ** 2).sum()) for n in range(LATENCY_BLOCKS)])
    total = float(square.sum())
    if total < 0.05 * len(t):  # less than 0.2 m/s rms of change tells nothing
        return None
    tau = float(cross.sum()) / total
    scatter = cross - tau * square
    sigma = math.sqrt(float((scatter**2).sum()) * LATENCY_BLOCKS / (LATENCY_BLOCKS - 1)) / total
    return tau, sigma


def _smoothed(t: Array, series: Array) -> Array:
    """Return the mean of each column within a window around each time."""
    sums = np.vstack([np.zeros((1, series.shape[1])), np.cumsum(series, axis=0)])
    low = np.searchsorted(t, t - 0.5 * LATENCY_WINDOW, side="left")
    high = np.searchsorted(t, t + 0.5 * LATENCY_WINDOW, side="right")
    means: Array = (sums[high] - sums[low]) / (high - low)[:, None]
    return means


WORDS = {
    "gate": "gate: fixes and motion contradict each other, see the track",
    "nan": "nan: the driver passed on no number",
    "no_fix": "no_fix: the receiver says that it has none, or a lesser one than localization.filter.minimum_fix_type",
    "satellites": "satellites: fewer than localization.filter.minimum_satellites",
    "dilution": "dilution: hdop above localization.filter.maximum_hdop",
    "sigma": "sigma: less sure than localization.filter.maximum_sigma",
    "range": "range: no place on Earth, or out of reach of the origin's zone",
}
"""What to know of the reasons for which fixes are refused."""


def refused_fixes(replayed: Replayed) -> Iterable[ReportFinding]:
    """Look for a large share of fixes that were refused, and why."""
    reasons = Counter(each.reason or each.verdict for each in replayed.fixes if each.verdict == "rejected")
    refused, total = sum(reasons.values()), len(replayed.fixes)
    if total >= 20 and refused > 0.2 * total:
        words = ", ".join(f"{count} {reason}" for reason, count in reasons.most_common(3))
        known = [WORDS.get(reason, f"{reason}: docs/localization.md") for reason, _ in reasons.most_common(3)]
        yield ReportFinding(
            FindingLevel.DOUBTFUL,
            f"{refused / total:.0%} of the fixes were refused",
            f"Of {counted(total, 'fix', 'fixes')} as positions: {words}.",
            f"{'; '.join(known)}.",
        )


# --- all ----------------------------------------------------------------------------------------------------


def stamps(replayed: Replayed) -> Iterable[ReportFinding]:
    """Look for samples that came too late, twice, or out of order."""
    for reason, advice in (
        ("late", "They arrive longer after their stamps than localization.filter.horizon: look at the clock or link."),
        ("duplicate", "A driver sends samples twice, or two sensors share one name in header.source."),
        ("future", "The sensor's clock is ahead of the host's: synchronise them."),
    ):
        by_source: Counter[str] = Counter()
        for (source, why), count in replayed.rejected.items():
            if why == reason:
                by_source[source] += count
        for source, count in sorted(by_source.items()):
            if count >= 5:
                yield ReportFinding(
                    FindingLevel.DOUBTFUL,
                    f"{source}: {counted(count, 'sample')} {reason}",
                    "They were not used.",
                    advice,
                )


def gaps(replayed: Replayed) -> Iterable[ReportFinding]:
    """Look for sensors with gaps that cost accuracy."""
    for sensor in replayed.sensors:
        found = [(a, b) for a, b in sensor.gaps() if b - a > max(1.0, 5.0 * sensor.period)]
        if found:
            longest = max(b - a for a, b in found)
            yield ReportFinding(
                FindingLevel.NOTE,
                f"{sensor.name}: {counted(len(found), 'gap')}, the longest {longest:.1f} s",
                f"It speaks every {sensor.period:.3g} s otherwise; the first gap begins at {found[0][0]:.0f} s.",
                "See what the position's sigma does meanwhile; look at the device's link if it was not meant.",
            )


def validity(replayed: Replayed, explained: bool = False) -> Iterable[ReportFinding]:
    """Look for poses that were not valid for long after the start, and for headings that were never found.

    `explained`: other findings say why; then the reasons given with poses, which only follow, are not repeated.
    """
    if not replayed.snapshots:
        yield ReportFinding(
            FindingLevel.WRONG,
            "There was never a state",
            "It may follow from what stands above."
            if explained
            else "No sample of a sensor that the vehicle file names could be used.",
            "Put that right first." if explained else "Compare the channels in the log with those in the vehicle file.",
        )
        return
    first = next((n for n, each in enumerate(replayed.snapshots) if not each.invalid), None)
    if first is None:
        words = replayed.snapshots[-1].invalid.explain()
        yield ReportFinding(
            FindingLevel.WRONG,
            "The pose was never valid",
            "It may follow from what stands above." if explained else f"At the end: {words}.",
            "Put that right first."
            if explained
            else "Heading takes a few metres of driving with fixes; the strip of reasons below says what was missing "
            "when.",
        )
        return
    after = replayed.snapshots[first:]
    bad = [each for each in after if each.invalid]
    if len(bad) > 0.05 * len(after):
        reasons = Counter(flag for each in bad for flag in Invalid if flag in each.invalid)
        words = "; ".join(flag.explain() for flag, _ in reasons.most_common(2))
        yield ReportFinding(
            FindingLevel.DOUBTFUL,
            f"The pose was not valid in {len(bad) / len(after):.0%} of the time after it first was",
            f"Mostly: {words}.",
            "See the strip of reasons below.",
        )


def _has_diverged(decision: Decision) -> bool:
    return decision.verdict is Verdict.TOOK_UP and "diverged" in decision.reason


def diverged(replayed: Replayed) -> Iterable[ReportFinding]:
    """Look for a filter that had to begin anew, or that took its position up anew."""
    anew = [each for each in replayed.decisions if _has_diverged(each)]
    taken = [each for each in replayed.decisions if each.verdict is Verdict.TOOK_UP and "agree" in each.reason]
    for title, found in (("The state was begun anew", anew), ("Position was taken up anew", taken)):
        if found:
            first = found[0]
            times = "" if len(found) == 1 else f", first of {len(found)} times"
            yield ReportFinding(
                FindingLevel.DOUBTFUL,
                title,
                f"At {replayed.t(first.utime):.0f} s{times}: {first.reason}.",
                "See the innovations before it: which kind went wrong first?",
            )


Check = Callable[[Replayed], Iterable[ReportFinding]]

CHECKS: tuple[Check, ...] = (frozen_unit, diverged)

LOOKING_AT_SENSORS: tuple[Check, ...] = (wheels_reversed, always_backward)
"""Those that look at sensors beside the filter's state: with a cause known they only repeat it."""

OF_A_SOUND_STATE: tuple[Check, ...] = (wheel_scale, biases, latency, stated_sigma)
"""Those that take the filter's state for good."""


def _last(replayed: Replayed) -> StateSample | None:
    return next((each for each in reversed(replayed.snapshots) if each.values), None)


def _state(snapshot: StateSample | None, name: str) -> tuple[float, float]:
    """Return a state's value and sigma, nan where it is not there."""
    if snapshot is None or name not in snapshot.values:
        return math.nan, math.nan
    return snapshot.values[name], snapshot.sigmas[name]
