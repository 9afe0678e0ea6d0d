"""The health report in words."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from enum import IntEnum, IntFlag
from typing import Any, Final

from modelserver.core import DEGRADED, RUNNING, STARTING
from modelserver.messages import (
    ChannelHealth,
    DriverHealth,
    DriverPhase,
    Health,
    Invalid,
    LocalizationHealth,
    Phase,
)
from mstools.terminal.output import counted, safe
from mstools.terminal.table import table

STATES: Final = {STARTING: "STARTING", RUNNING: "RUNNING", DEGRADED: "DEGRADED"}

MAX_ROWS: Final = 40
"""Rows of a table that are shown; a stranger may make up as many sources as the daemon tells apart."""

SENSOR: Final = "sensor:"
"""What the names of sensors' sources begin with in a report."""

FRESH_S: Final = 1.0
"""A source without a rate that spoke in the last second was first heard after rates were last worked out."""


def is_well(health: Health) -> bool:
    """Return whether the pose may be used, or the vehicle file asks for none."""
    return health.localization.mode is None or (health.state == RUNNING and not health.invalid_reasons)


def report(health: Health, drivers: Iterable[DriverHealth] = (), expected: Iterable[str] = ()) -> str:
    """Return a report for people to read; `expected` names the drivers that there should be."""
    drivers = sorted(drivers, key=lambda each: each.source)
    missing = [name for name in expected if name not in {each.source for each in drivers}]
    parts = [_head(health), _body(health)]
    if health.notices:
        parts.append("notices\n" + "\n".join(f"  {safe(name)}: {safe(text)}" for name, text in health.notices))
    if health.channels:
        parts.append("heard\n" + _channels(health.channels))
    if drivers or missing:
        parts.append("drivers\n" + _drivers(drivers, missing))
    if health.rejected:
        rows = [(name, reason, str(count)) for name, reason, count in health.rejected]
        parts.append("refused\n" + _table(("what", "reason", "count"), rows, numbers=(2,)))
    return "\n\n".join(parts)


def _head(health: Health) -> str:
    state = STATES.get(health.state, str(health.state))
    who = f", process {health.pid} on {health.host}" if health.pid else ""
    return safe(
        f"{health.vehicle}: {state}, up {duration(health.uptime)}; modelserver {health.version}{who}, "
        f"{clock(health.utime)}"
    )


def _body(health: Health) -> str:
    said = health.localization
    rows: list[tuple[str, str]] = []
    if said.mode is None:
        rows.append(("pose", "none: the vehicle file names no sensor to localize by"))
    else:
        reasons = health.invalid_reasons.explain()
        rows.append(("pose", f"NOT VALID: {reasons}" if health.invalid_reasons else "valid"))
        bounds = _bounds(said)
        if math.isfinite(said.seconds_to_limit):
            bounds += f"; {duration(said.seconds_to_limit)} to a limit if nothing more arrives"
        rows.append(("", bounds))
        rows.append(("filter", f"mode {said.mode.name.lower()}{_motion(health)}; {_fix(said.fix_age)}"))
        origin = f"origin {health.origin_id & (1 << 64) - 1:016x}" if health.origin_id else "no origin yet"
        rows.append(("", f"epoch {health.pose_epoch}, {origin}, {counted(health.poses_published, 'pose')} published"))
    rows.append(("geometry", f"revision {health.model_revision}"))
    late = (health.tick_lateness_p50, health.tick_lateness_p90, health.tick_lateness_p99, health.tick_lateness_max)
    rows.append(
        ("loop", f"late by {' / '.join(number(each * 1e3, 2) for each in late)} ms (p50, p90, p99, most); "
         f"{counted(health.ticks_missed, 'tick')} missed, {counted(health.handler_errors, 'error')} of its own")
    )  # fmt: skip
    cpu = "processor time not known yet" if math.isnan(health.cpu_share) else f"{health.cpu_share:.0%} of a processor"
    memory = f"{health.memory / 1e6:.0f} MB" if health.memory else "memory not known"
    waits = "waits" if health.requests_parked == 1 else "wait"
    rows.append(("process", f"{cpu}, {memory}"))
    rows.append(
        (
            "requests",
            f"{health.requests_answered} answered, {health.requests_parked} {waits} for data, "
            f"{health.requests_queued} in the queue",
        )
    )
    return "\n".join(f"{name:<9} {safe(text)}".rstrip() for name, text in rows)


def _bounds(said: LocalizationHealth) -> str:
    """Return the protection bounds in words, as far as they are known."""
    within = f"within {number(said.horizontal_bound, 2)} m" if math.isfinite(said.horizontal_bound) else ""
    heading = f"heading {degrees(said.heading_bound)} deg" if math.isfinite(said.heading_bound) else ""
    if not within and not heading:
        return "no bound is known"
    return f"{within or 'position without a bound'}, {heading or 'heading without a bound'}"


def is_current(health: Health) -> bool:
    """Return whether phase and motion are those of now: not where what the localization knows them from is silent."""
    heard = [each for each in health.channels if each.channel.startswith(SENSOR) and each.count]
    return Invalid.STALE_IMU not in health.invalid_reasons and any(not each.silent for each in heard)


def _motion(health: Health) -> str:
    """Return in words how far localization has come and whether the vehicle moves, as far as that is known."""
    said = health.localization
    phase = "" if said.phase is None else said.phase.name.lower()
    filtered = f", {phase}" if phase else ", no filter"
    if not any(each.channel.startswith(SENSOR) and each.count for each in health.channels):
        return f"{filtered}: no sensor was heard yet"
    # while it levels it knows of standing alone
    moves = "standing" if said.standing else "" if said.phase is Phase.LEVELLING else "moving"
    if is_current(health):
        return f"{filtered}, {moves}" if moves else filtered
    was = " and ".join(filter(None, (phase, moves)))
    when = (
        "at the last inertial sample" if Invalid.STALE_IMU in health.invalid_reasons else "when the sensors fell silent"
    )
    return f"{'' if phase else filtered}; {was} {when}"


def _fix(age_s: float) -> str:
    if math.isnan(age_s):
        return "no fix used yet"
    if age_s < 0.0:
        return f"last fix used has a stamp {duration(-age_s)} ahead of the clock"
    return f"last fix used {duration(age_s)} ago"


def _rate(each: ChannelHealth) -> str:
    """Return a source's rate; - for one that was first heard in the period that is not over."""
    return "-" if _is_fresh(each) else number(each.rate_hz, 1)


def _is_fresh(each: ChannelHealth) -> bool:
    return bool(each.count) and not each.silent and each.rate_hz == 0.0 and each.age < FRESH_S


def _channels(channels: Iterable[ChannelHealth]) -> str:
    rows = [
        (
            each.channel,
            str(each.count),
            _rate(each),
            age(each.age),
            number(each.delay_max * 1e3, 1),
            f"{each.used}/{each.measured}" if each.measured else "",
            "never heard" if not each.count else "SILENT" if each.silent else "",
        )
        for each in channels
    ]
    return _table(("source", "count", "Hz", "age", "delay ms", "used", ""), rows, numbers=(1, 2, 3, 4, 5))


def _drivers(drivers: Iterable[DriverHealth], missing: Iterable[str]) -> str:
    rows = [
        (
            each.source,
            each.device,
            each.phase.name.lower() if each.phase is DriverPhase.STREAMING else each.phase.name,
            number(each.rate_hz, 1),
            age(each.age),
            str(each.reconnects),
            each.link,
            each.text,
        )
        for each in drivers
    ]
    rows += [(name, "", "NOT HEARD", "", "", "", "", f"modelserver driver {name} -c FILE") for name in missing]
    head = ("driver", "device", "phase", "Hz", "age", "reopened", "line", "")
    return _table(head, rows, numbers=(3, 4, 5))


def _table(head: Sequence[str], rows: Sequence[Sequence[str]], numbers: Sequence[int]) -> str:
    text = table(head, rows[:MAX_ROWS], numbers=numbers)
    return f"{text}\n  and {len(rows) - MAX_ROWS} more" if len(rows) > MAX_ROWS else text


def line(health: Health) -> str:
    """Return a report in one line, for logs."""
    said = health.localization
    parts = [clock(health.utime), STATES.get(health.state, str(health.state))]
    if said.mode is not None:
        parts.append(f"pose not valid: {health.invalid_reasons.explain()}" if health.invalid_reasons else _bounds(said))
    parts += [f"{each.channel} {_heard(each)}" for each in health.channels[:MAX_ROWS]]
    parts.append(f"late p99 {health.tick_lateness_p99 * 1e3:.2f} ms")
    parts += [f"{name}: {text}" for name, text in health.notices]
    return safe("; ".join(parts))


def _heard(each: ChannelHealth) -> str:
    if not each.count:
        return "never heard"
    return "SILENT" if each.silent else "heard" if _is_fresh(each) else f"{each.rate_hz:.1f} Hz"


def as_data(health: Health, drivers: Iterable[DriverHealth] = ()) -> dict[str, Any]:
    """Return a report for scripts: enumerations by name, null for what is not known."""
    data: dict[str, Any] = {
        each.name: plain(getattr(health, each.name))
        for each in dataclasses.fields(health)
        if each.name not in ("channels", "rejected", "notices", "localization", "state")
    }
    data["state"] = STATES.get(health.state, health.state)
    data["well"] = is_well(health)
    data["invalid_text"] = health.invalid_reasons.explain()
    data["localization"] = fields_of(health.localization) | {"current": is_current(health)}
    data["channels"] = [fields_of(each) for each in health.channels]
    data["rejected"] = [{"channel": a, "reason": b, "count": c} for a, b, c in health.rejected]
    data["notices"] = dict(health.notices)
    data["drivers"] = [
        fields_of(each) | {"counters": dict(each.counters)} for each in sorted(drivers, key=lambda each: each.source)
    ]
    return data


def fields_of(value: Any) -> dict[str, Any]:
    """Return the fields of a dataclass, each as `plain`."""
    return {each.name: plain(getattr(value, each.name)) for each in dataclasses.fields(value)}


def plain(value: Any) -> Any:
    """Return a value as JSON has it: nan is null, an enumeration its name, flags their number."""
    if isinstance(value, IntFlag):
        return int(value)
    if isinstance(value, IntEnum):
        return value.name
    return None if isinstance(value, float) and not math.isfinite(value) else value


def number(value: float, digits: int) -> str:
    """Return a number with so many digits, - for one that is not known."""
    return f"{value:.{digits}f}" if math.isfinite(value) else "-"


def degrees(radians: float) -> str:
    """Return an angle in degrees."""
    return number(math.degrees(radians), 1)


def age(seconds: float) -> str:
    """Return an age, - for what never was."""
    return duration(seconds) if math.isfinite(seconds) else "-"


def duration(seconds: float) -> str:
    """Return a time in the units that people read at a glance."""
    if not math.isfinite(seconds):
        return "-"
    if seconds < 0.9995:
        return f"{seconds * 1e3:.0f} ms"
    if seconds < 60.0:
        return f"{seconds:.1f} s"
    minutes, hours = int(seconds // 60), int(seconds // 3600)
    if hours == 0:
        return f"{minutes} min {int(seconds) % 60:02d} s"
    return f"{hours} h {minutes % 60:02d} min" if hours < 48 else f"{hours // 24} days {hours % 24} h"


def clock(utime: int) -> str:
    """Return an instant as people tell it, in UTC; its number where it is no time of day."""
    try:
        return datetime.fromtimestamp(utime * 1e-6, UTC).strftime("%H:%M:%S.%f")[:-5] + " UTC"
    except (OverflowError, ValueError, OSError):
        return str(utime)
