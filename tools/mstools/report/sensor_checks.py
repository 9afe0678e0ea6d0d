"""Checks of sensors and vehicle file from the raw sensor data: the causes of the other findings. Pure.

A sensor's unit, sign or name is verified by comparison with another sensor (sensor_motion.py), without any pose:
turn rates of gyro, wheels and fixes; distances of wheels and fixes; mean specific force against gravity.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable

from modelserver.messages import Mode, Verdict
from mstools.report.replay_data import ReplayData, ReportFinding, error, note
from mstools.report.sensor_motion import compare_turn_rates
from mstools.terminal.output import format_count

UNUSED_SHARE = 0.05
"""Share of accepted samples up to which a sensor counts as unused."""

MIN_SAMPLES = 20
"""Fewest samples to evaluate a sensor."""

MODES_WITHOUT = {
    "gps": (Mode.NO_GPS, Mode.DEAD_RECKONING),
    "imu": (Mode.NO_IMU,),
    "wheels": (Mode.NO_WHEELS, Mode.RAW),
}
"""Modes that need no such sensor."""

DEGREES_PER_RADIAN = math.degrees(1.0)


# --- missing and unused sensors -----------------------------------------------------------------------------


def check_missing(data: ReplayData) -> Iterable[ReportFinding]:
    """Find sensors of the vehicle file without messages in the log."""
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
        yield level(f"{title[:1].upper()}{title[1:]}", f"{observation[:1].upper()}{observation[1:]}.", advice)


RANGE_ADVICE = {
    "wheels": "Check the units in the driver: speed in m/s and travel in m; mm are too large by 1000.",
    "gps": "Check the units in the driver: latitude and longitude in degrees, height in meters.",
    "imu": "Check the units in the driver: rates in rad/s, specific force in m/s2.",
}
REASON_ADVICE = {
    "range": "Check the units in the driver: meters, seconds and radians.",
    "nan": "The driver sends non-finite numbers: check its input.",
    "no_fix": "The receiver reports no fix: check its antenna, and localization.filter.minimum_fix_type.",
    "too_old": "Its stamps are older than localization.filter.horizon: check its clock and its latency.",
    "future": "Its clock is ahead of the others': synchronize them.",
    "sigma": "The sigma of its fixes is above localization.filter.maximum_sigma.",
}
"""What to do about samples that are rejected for a reason, and about the range of each sensor."""


def check_unused(data: ReplayData) -> Iterable[ReportFinding]:
    """Find sensors whose samples are nearly all rejected."""
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
        advice = REASON_ADVICE.get(reason, "docs/words.md explains the reason.")
        known = data.sensor_motion.lateral_offsets
        if key == "wheels" and reason in ("names", "nan") and data.wheel_names and not known.keys() & data.wheel_names:
            observation += (
                f" The log's wheels are {', '.join(data.wheel_names)}; sensors.wheels.frames has {', '.join(known)}."
            )
            advice = "Use the log's names in sensors.wheels.frames, or the vehicle file's names in the driver."
        elif reason == "range":
            advice = RANGE_ADVICE.get(key, advice)
            if key == "wheels":
                speeds = [abs(v) for wheel in data.sensor_motion.wheels.values() for v in wheel.values()]
                observation += (
                    f" The fastest second is {max(speeds, default=math.nan):.0f} m/s; "
                    f"localization.filter.maximum_speed is {data.settings.maximum_speed:.0f}."
                )
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
    """Find wheels with reversed sign or swapped sides."""
    raw = data.sensor_motion
    by_gyro = bool(raw.gyro)
    reference, what = (raw.gyro, "gyro") if by_gyro else (raw.course_turn_rate(), "fixes' course")
    if any(check_gyro_unit(data)):
        reference = {second: math.radians(rate) for second, rate in raw.gyro.items()}
    against, straight = raw.count_opposed(reference)
    if straight >= 5 and against > 0.8 * straight:
        backward = raw.backward_wheels()
        names = ", ".join(backward)
        yield error(
            f"Wheel {names} counts backward" if backward else "The wheels of one side count backward",
            f"In {against} of {straight} s of straight driving by the {what} the sides rolled against each other.",
            "Reverse the sign of this wheel in its driver, or swap its encoder's two channels.",
        )
        return
    course = raw.compare_with_course(raw.wheel_turn_rate)
    compared = compare_turn_rates(raw.gyro, raw.wheel_turn_rate) if by_gyro else course
    if compared is None or compared.correlation > -0.6:
        return
    if by_gyro and course is not None and course.correlation > 0.6:
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


SENSOR_CHECKS: tuple[Callable[[ReplayData], Iterable[ReportFinding]], ...] = (
    check_missing,
    check_clocks,
    check_unused,
    check_gravity,
    check_gyro_unit,
    check_wheel_signs,
    check_distances,
)
"""In the order of the report."""
