"""What is wrong with the sensors and the vehicle file, from what the sensors said: the causes of the other findings."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from modelserver.messages import Mode, Verdict
from mstools.report.data import Replayed
from mstools.report.finding import FindingLevel, ReportFinding
from mstools.report.raw import Turning, turning
from mstools.terminal.output import counted

UNUSED = 0.05
"""Share of a sensor's samples up to which it counts as not used at all."""

LEAST_SAMPLES = 20
"""Fewest samples that a sensor is judged by."""

WITHOUT = {
    "gps": (Mode.NO_GPS, Mode.DEAD_RECKONING),
    "imu": (Mode.NO_IMU,),
    "wheels": (Mode.NO_WHEELS, Mode.RAW),
}
"""The modes that do without a sensor."""

DEGREES = math.degrees(1.0)


# --- sensors that say nothing, or nothing that can be used ---------------------------------------------------


def missing(replayed: Replayed) -> Iterable[ReportFinding]:
    """Look for sensors of the vehicle file of which the log has nothing."""
    for key, channel in replayed.silent:
        if replayed.mode in WITHOUT.get(key, ()):
            continue
        there = f"the log has {', '.join(replayed.channels)}" if replayed.channels else "the log has nothing"
        remedy = (
            "correct the channel"
            if key not in WITHOUT
            else (
                f"correct the channel; a vehicle without it: localization.mode: {WITHOUT[key][0].name.lower()}, or no "
                f"sensors.{key}"
            )
        )
        yield ReportFinding(
            FindingLevel.WRONG,
            f"Nothing on channel {channel} (sensors.{key})",
            f"{there[0].upper()}{there[1:]}.",
            f"{remedy[0].upper()}{remedy[1:]}.",
        )


@dataclass(frozen=True, slots=True)
class _Unused:
    """A source that is not used: its samples that something was decided of, and the reason that counts most."""

    key: str
    source: str
    decided: int
    reason: str


def _unused(replayed: Replayed) -> Iterable[_Unused]:
    used: dict[str, set[tuple[int, int]]] = {}
    refused: dict[str, dict[tuple[int, int], str]] = {}
    for each in replayed.decisions:
        stamp = (each.utime, each.seq)
        if each.verdict is Verdict.REJECTED:
            refused.setdefault(each.source, {}).setdefault(stamp, each.reason or "rejected")
        else:
            used.setdefault(each.source, set()).add(stamp)
    for source, key in sorted(replayed.keys.items()):
        reasons = refused.get(source, {})
        good = len(used.get(source, ()))
        if key == "imu":  # nothing is decided of an inertial sample that is used
            good = replayed.samples_of(source) - len(reasons)
        if len(reasons) >= LEAST_SAMPLES and good <= UNUSED * (good + len(reasons)):
            ((reason, _),) = Counter(reasons.values()).most_common(1)
            yield _Unused(key, source, len(reasons), reason)


def unused(replayed: Replayed) -> Iterable[ReportFinding]:
    """Look for sensors whose samples are there and are not used, nearly all of them."""
    for each in _unused(replayed):
        if each.reason == "gate":
            continue  # fixes and motion contradict each other: which of them is wrong the other rules say
        yield ReportFinding(
            FindingLevel.WRONG,
            f"Nothing of sensors.{each.key} is used: {each.reason}",
            f"Of {counted(each.decided, 'sample')} of {each.source} that could have been used, nearly all were "
            f"refused. {_seen(replayed, each)}".strip(),
            _advice(replayed, each),
        )


def _are_names(replayed: Replayed, each: _Unused) -> bool:
    return (
        each.key == "wheels"
        and each.reason in ("names", "nan")
        and bool(replayed.wheel_names)
        and not set(replayed.wheel_names) & set(replayed.raw.sides)
    )


def _seen(replayed: Replayed, each: _Unused) -> str:
    if _are_names(replayed, each):
        return (
            f"Its wheels are called {', '.join(replayed.wheel_names)}; sensors.wheels.frames has "
            f"{', '.join(replayed.raw.sides)}."
        )
    if each.key == "wheels" and each.reason == "range":
        fastest = max((abs(v) for wheel in replayed.raw.wheels.values() for v in wheel.values()), default=math.nan)
        return (
            f"The fastest second is {fastest:.0f} m/s; localization.filter.maximum_speed is "
            f"{replayed.settings.maximum_speed:.0f}."
        )
    return ""


def _advice(replayed: Replayed, each: _Unused) -> str:
    if _are_names(replayed, each):
        return "Write the log's names in sensors.wheels.frames, or the vehicle file's names in the driver."
    if each.reason == "range":
        return {
            "wheels": "Look at the unit in the driver: speed is in m/s and travel in m; mm are too large by 1000.",
            "gps": "Look at the unit in the driver: latitude and longitude are in degrees, height in metres.",
            "imu": "Look at the unit in the driver: rates are in rad/s, specific force in m/s2.",
        }.get(each.key, "Look at the unit in the driver: metres, seconds and radians.")
    return {
        "nan": "The driver passes on no number: look at what it reads.",
        "no_fix": "The receiver says that it has no fix: look at its antenna, and at localization.filter."
        "minimum_fix_type.",
        "late": "Its stamps are older than localization.filter.horizon: look at its clock, or its latency.",
        "future": "Its clock is ahead of the others': synchronise them.",
        "sigma": "Its fixes are less sure than localization.filter.maximum_sigma.",
    }.get(each.reason, "docs/localization.md says what the word means.")


# --- units, signs and names: one sensor beside another --------------------------------------------------------


def gyro_unit(replayed: Replayed) -> Iterable[ReportFinding]:
    """Look for a gyro in degrees a second: it turns 57 times as fast as wheels or fixes."""
    found = _beside_gyro(replayed)
    if found is None:
        return
    compared, what = found
    # wheels that are dragged through a turn tell up to twice of it
    if abs(compared.correlation) > 0.5 and 0.4 * DEGREES < compared.ratio < 1.6 * DEGREES:
        yield ReportFinding(
            FindingLevel.WRONG,
            "The gyro is in degrees a second",
            f"It turns {compared.ratio:.0f} times as fast as the {what}; a radian is 57.3 degrees.",
            "Give angular_velocity in rad/s: look at the unit in its driver.",
        )


def _beside_gyro(replayed: Replayed) -> tuple[Turning, str] | None:
    """Return how the gyro turns beside the wheels, else beside the fixes; None where neither tells."""
    raw = replayed.raw
    for compared, what in ((turning(raw.gyro, raw.wheel_turn), "wheels"), (raw.beside_courses(raw.gyro), "fixes")):
        if compared is not None and abs(compared.correlation) > 0.5:
            return compared, what
    return None


def wheel_signs(replayed: Replayed) -> Iterable[ReportFinding]:
    """Look for wheels whose sign, or whose side, is swapped."""
    raw = replayed.raw
    by_gyro = bool(raw.gyro)
    reference, what = (raw.gyro, "gyro") if by_gyro else (raw.course_turn(), "fixes' course")
    if _is_degrees(replayed):
        reference = {second: math.radians(rate) for second, rate in raw.gyro.items()}
    against, straight = raw.opposed(reference)
    if straight >= 5 and against > 0.8 * straight:
        backward = raw.backward_wheels()
        names = ", ".join(backward)
        yield ReportFinding(
            FindingLevel.WRONG,
            f"Wheel {names} counts backward" if backward else "The wheels of one side count backward",
            f"In {against} of {straight} s straight ahead by the {what} the two sides rolled against each other.",
            "Turn the sign of this wheel in its driver, or swap its encoder's two channels.",
        )
        return
    course = raw.beside_courses(raw.wheel_turn)
    compared = turning(raw.gyro, raw.wheel_turn) if by_gyro else course
    if compared is None or compared.correlation > -0.6:
        return
    if by_gyro and course is not None and course.correlation > 0.6:
        yield ReportFinding(
            FindingLevel.WRONG,
            "The gyro turns against the wheels and the fixes",
            f"Its turns are opposite to the wheels' (correlation {compared.correlation:.2f}).",
            "Look at the inertial unit's mount in the geometry, and at the signs in its driver.",
        )
        return
    yield ReportFinding(
        FindingLevel.WRONG,
        "Left and right wheels are swapped",
        f"By the wheels it turns against the {what} (correlation {compared.correlation:.2f}).",
        "Swap the names in sensors.wheels.frames, or the frames' places in the geometry; where all wheels count "
        "backward, their signs.",
    )


def _is_degrees(replayed: Replayed) -> bool:
    return any(True for _ in gyro_unit(replayed))


def ways(replayed: Replayed) -> Iterable[ReportFinding]:
    """Look for fixes that move another distance than the wheels roll: one of them is in another unit."""
    found = replayed.raw.ways()
    if found.wheels < 20.0:
        return
    ratio = found.wheels / max(found.fixes, 1e-6)
    if 1.0 / 3.0 < ratio < 3.0:
        return
    if 0.5 * DEGREES < ratio < 2.0 * DEGREES:
        advice = "57 is radians for degrees: give latitude_deg and longitude_deg in degrees in the receiver's driver."
    elif 500.0 < ratio < 2000.0:
        advice = "1000 is mm for m: give travel in m and speed in m/s in the wheels' driver."
    else:
        advice = "Look at the units in both drivers (m and m/s; degrees), and at the wheels' radius."
    yield ReportFinding(
        FindingLevel.WRONG,
        f"Fixes moved {found.fixes:.1f} m while the wheels rolled {found.wheels:.0f} m",
        f"The wheels tell {ratio:.3g} times the way of the fixes.",
        advice,
    )


def gravity(replayed: Replayed) -> Iterable[ReportFinding]:
    """Look for gravity of another strength than the Earth's, or that does not come from below."""
    if replayed.felt_up is None:
        return
    x, y, z = replayed.felt_up
    angle = math.atan2(math.hypot(x, y), z)
    size = math.sqrt(x * x + y * y + z * z)
    if angle > 0.3 and size > 0.5:
        yield ReportFinding(
            FindingLevel.WRONG,
            "The inertial unit is mounted otherwise than the geometry says",
            f"The mean specific force points {math.degrees(angle):.0f} degrees away from the vehicle's up "
            f"({x:+.1f}, {y:+.1f}, {z:+.1f} m/s2 along x, y, z).",
            "Run modelserver calibrate imu LOG -c VEHICLE: it says which mount fits.",
        )
    if 0.9 < size < 1.1:
        yield ReportFinding(
            FindingLevel.WRONG,
            "Specific force is in g, not in m/s2",
            f"Its mean is {size:.2f}, and gravity is 9.81 m/s2.",
            "Give specific_force in m/s2: look at the unit in its driver.",
        )
    elif not 9.0 < size < 10.6:
        yield ReportFinding(
            FindingLevel.WRONG,
            f"The inertial unit feels {size:.2f} m/s2 in the mean",
            "Whatever the vehicle does, the mean of its specific force is near 9.8 m/s2.",
            "Look at the unit of acceleration in the driver, and whether gravity is taken off there.",
        )


CAUSES: tuple[Callable[[Replayed], Iterable[ReportFinding]], ...] = (
    missing,
    unused,
    gravity,
    gyro_unit,
    wheel_signs,
    ways,
)
"""In the order in which they are told."""
