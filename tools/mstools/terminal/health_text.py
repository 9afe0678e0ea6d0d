"""Formats of the health report: text and JSON."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
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
    StabilityHealth,
)
from mstools.terminal.output import escape, format_count, format_table, to_json

STATE_NAMES: Final = {STARTING: "STARTING", RUNNING: "RUNNING", DEGRADED: "DEGRADED"}

MAX_ROWS: Final = 40
"""Rows of a table that are shown: an unknown publisher may invent as many sources as the daemon counts."""

SENSOR_PREFIX: Final = "sensor:"
"""Prefix of the sensors' names in a report."""


def is_healthy(health: Health) -> bool:
    """Return whether the pose may be used, or no localization is configured."""
    return health.localization.mode is None or (health.state == RUNNING and not health.invalid_reasons)


def format_report(health: Health, drivers: Iterable[DriverHealth] = (), expected: Iterable[str] = ()) -> str:
    """Format a report for the terminal; `expected` names the drivers of the vehicle file."""
    drivers = sorted(drivers, key=lambda each: each.source)
    missing = [name for name in expected if name not in {each.source for each in drivers}]
    state = STATE_NAMES.get(health.state, str(health.state))
    who = f", process {health.pid} on {health.host}" if health.pid else ""
    head = f"{health.vehicle}: {state}, up {format_duration(health.uptime)}; modelserver {health.version}{who}"
    parts = [escape(f"{head}, {format_clock(health.utime)}"), format_body(health)]
    if health.warnings:
        parts.append("warnings\n" + "\n".join(f"  {escape(name)}: {escape(text)}" for name, text in health.warnings))
    if health.channels:
        parts.append("received\n" + _format_channels(health.channels))
    if drivers or missing:
        parts.append("drivers\n" + _format_drivers(drivers, missing))
    if health.rejected:
        rows = [(name, reason, str(count)) for name, reason, count in health.rejected]
        parts.append("rejected\n" + _format_limited_table(("what", "reason", "count"), rows, numbers=(2,)))
    return "\n\n".join(parts)


def format_body(health: Health) -> str:
    localization = health.localization
    if localization.mode is None:
        rows = [("pose", "none: no localization sensor is configured")]
    else:
        bounds = _format_bounds(localization)
        if math.isfinite(localization.seconds_to_limit):
            bounds += f"; {format_duration(localization.seconds_to_limit)} to the limit without further measurements"
        mode = f"mode {localization.mode.name.lower()}{_format_motion(health)}"
        origin = f"origin {health.origin_id & (1 << 64) - 1:016x}" if health.origin_id else "no origin yet"
        published = format_count(health.poses_published, "pose")
        rows = [
            ("pose", f"NOT VALID: {health.invalid_reasons.explain()}" if health.invalid_reasons else "valid"),
            ("", bounds),
            *([("", place)] if (place := _format_place(localization)) else []),
            ("filter", f"{mode}; {_format_fix_age(localization.fix_age)}"),
            ("", f"epoch {health.pose_epoch}, {origin}, {published} published"),
        ]
    latency = (health.tick_latency_p50, health.tick_latency_p90, health.tick_latency_p99, health.tick_latency_max)
    ticks = f"tick latency {' / '.join(format_number(each * 1e3, 2) for each in latency)} ms (p50, p90, p99, max)"
    missed, errors = format_count(health.ticks_missed, "tick"), format_count(health.handler_errors, "internal error")
    cpu = "CPU load unknown" if math.isnan(health.cpu_share) else f"{health.cpu_share:.0%} of a CPU"
    memory = f"{health.memory / 1e6:.0f} MB" if health.memory else "memory unknown"
    waiting = f"{health.requests_waiting} waiting for data, {health.requests_queued} queued"
    if not math.isnan(health.stability.margin):
        rows.append(("stability", _format_stability(health.stability)))
    rows += [
        ("geometry", f"revision {health.model_revision}"),
        ("loop", f"{ticks}; {missed} missed, {errors}"),
        ("process", f"{cpu}, {memory}"),
        ("requests", f"{health.requests_answered} answered, {waiting}"),
    ]
    return "\n".join(f"{name:<9} {escape(text)}".rstrip() for name, text in rows)


def _format_place(localization: LocalizationHealth) -> str:
    """Format latitude, longitude, height and heading, empty if unknown."""
    if math.isnan(localization.latitude_deg):
        return ""
    heading = "" if math.isnan(localization.heading_deg) else f", heading {localization.heading_deg:.1f} deg"
    place = f"{localization.latitude_deg:.7f}, {localization.longitude_deg:.7f} deg"
    return f"at {place}, height {localization.height:.1f} m{heading}"


def _format_stability(stability: StabilityHealth) -> str:
    margins = [
        f"{name} {math.degrees(margin):.1f} deg" + ("" if math.isnan(sigma) else f" +- {math.degrees(sigma):.1f}")
        for name, margin, sigma in (
            ("static", stability.margin, stability.margin_sigma),
            ("dynamic", stability.dynamic_margin, stability.dynamic_margin_sigma),
        )
        if not math.isnan(margin)
    ]
    loads = ", ".join(
        f"{name.partition(':')[2]} {load:.0f} N" for name, load in zip(stability.contacts, stability.loads, strict=True)
    )
    return f"tip-over margin {', '.join(margins)}; {loads}"


def _format_bounds(localization: LocalizationHealth) -> str:
    position, heading = localization.horizontal_protection_level, localization.heading_protection_level
    if not math.isfinite(position) and not math.isfinite(heading):
        return "protection levels unknown"
    meters = f"{position:.2f} m" if math.isfinite(position) else "of position unknown"
    degrees = f"{math.degrees(heading):.1f} deg" if math.isfinite(heading) else "unknown"
    protection = f"protection level {meters}, heading {degrees}"
    level, limit = localization.horizontal_level, localization.horizontal_limit
    if not math.isfinite(level + limit):
        return protection
    heading_level, heading_limit = map(math.degrees, (localization.heading_level, localization.heading_limit))
    return f"level {level:.2f} of {limit:g} m, heading {heading_level:.1f} of {heading_limit:.0f} deg; {protection}"


def is_current(health: Health) -> bool:
    """Return whether phase and motion are current: the sensors that they are estimated from are not silent."""
    return Invalid.STALE_IMU not in health.invalid_reasons and any(not each.silent for each in _get_sensors(health))


def _get_sensors(health: Health) -> list[ChannelHealth]:
    return [each for each in health.channels if each.channel.startswith(SENSOR_PREFIX) and each.count]


def _format_motion(health: Health) -> str:
    localization = health.localization
    phase = "no filter" if localization.phase is None else localization.phase.name.lower()
    if not _get_sensors(health):
        return f", {phase}: no sensor sample received yet"
    # during leveling only a stationary vehicle is detected
    motion = "stationary" if localization.stationary else "" if localization.phase is Phase.LEVELING else "moving"
    text = ", ".join(filter(None, (phase, motion)))
    return f", {text}" if is_current(health) else f"; {text} at the last sensor sample"


def _format_fix_age(age_s: float) -> str:
    if math.isnan(age_s):
        return "no fix used yet"
    if age_s < 0.0:
        return f"last fix used has a stamp {format_duration(-age_s)} ahead of the clock"
    return f"last fix used {format_duration(age_s)} ago"


def _format_channels(channels: Iterable[ChannelHealth]) -> str:
    rows = [
        (
            each.channel,
            str(each.count),
            format_number(each.rate_hz, 1),
            format_duration(each.age),
            format_number(each.delay_max * 1e3, 1),
            f"{each.used}/{each.measured}" if each.measured else "",
            "never received" if not each.count else "SILENT" if each.silent else "",
        )
        for each in channels
    ]
    return _format_limited_table(
        ("source", "count", "Hz", "age", "delay ms", "used", ""), rows, numbers=(1, 2, 3, 4, 5)
    )


def _format_drivers(drivers: Iterable[DriverHealth], missing: Iterable[str]) -> str:
    rows = [
        (
            each.source,
            each.device,
            each.phase.name.lower() if each.phase is DriverPhase.STREAMING else each.phase.name,
            format_number(each.rate_hz, 1),
            format_duration(each.age),
            str(each.reconnects),
            each.link,
            each.text,
        )
        for each in drivers
    ]
    rows += [(name, "", "NO REPORT", "", "", "", "", f"modelserver driver {name} -c FILE") for name in missing]
    head = ("driver", "device", "phase", "Hz", "age", "reopened", "line", "")
    return _format_limited_table(head, rows, numbers=(3, 4, 5))


def _format_limited_table(head: Sequence[str], rows: Sequence[Sequence[str]], numbers: Sequence[int]) -> str:
    text = format_table(head, rows[:MAX_ROWS], numbers=numbers)
    return f"{text}\n  and {len(rows) - MAX_ROWS} more" if len(rows) > MAX_ROWS else text


def describe_pose(health: Health) -> str:
    """Describe whether the pose is valid and where the vehicle is, in one line."""
    localization, reasons = health.localization, health.invalid_reasons
    if localization.mode is None:
        return "no pose: no localization sensor is configured"
    if reasons:
        return f"pose not valid: {health.invalid_text or reasons.explain()}"
    return "; ".join(filter(None, ("pose valid", _format_place(localization), _format_bounds(localization))))


def as_data(health: Health, drivers: Iterable[DriverHealth] = ()) -> dict[str, Any]:
    """Return a report as JSON data: enumerations by name, null for unknown values."""
    data: dict[str, Any] = to_json(health)
    data["state"] = STATE_NAMES.get(health.state, health.state)
    data["healthy"] = is_healthy(health)
    data["invalid_text"] = health.invalid_reasons.explain()
    data["localization"]["current"] = is_current(health)
    data["rejected"] = [{"channel": a, "reason": b, "count": c} for a, b, c in health.rejected]
    data["warnings"] = dict(health.warnings)
    drivers = sorted(drivers, key=lambda each: each.source)
    data["drivers"] = [to_json(each) | {"counters": dict(each.counters)} for each in drivers]
    return data


def format_number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else "-"


def format_duration(seconds: float) -> str:
    """Format a duration in milliseconds, seconds, minutes, hours or days; - if it is not finite."""
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


def format_clock(utime: int) -> str:
    """Format a time of day in UTC; the number itself where it is no time."""
    try:
        return datetime.fromtimestamp(utime * 1e-6, UTC).strftime("%H:%M:%S.%f")[:-5] + " UTC"
    except (OverflowError, ValueError, OSError):
        return str(utime)
