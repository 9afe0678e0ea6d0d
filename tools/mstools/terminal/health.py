"""Formats of the health report: text, JSON, and metrics for Prometheus (OpenMetrics 1.0 text, served by HTTP).

The process that serves them follows MODELSERVER_HEALTH and DRIVER_HEALTH like every other client, so that the service
has no socket for it. A report older than `MAX_AGE_S` is left out: `modelserver_up` is 0 then, and no old value is taken
for a present one. Unknown values have no sample. Rules: https://prometheus.io/docs/specs/om/open_metrics_spec/
(families are contiguous, counters end with _total, names with their unit, the exposition with # EOF).
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Final, TypeAlias

from modelserver.core import DEGRADED, RUNNING, STARTING
from modelserver.errors import ModelServerError
from modelserver.messages import (
    ChannelHealth,
    DriverHealth,
    DriverPhase,
    Health,
    Invalid,
    LocalizationHealth,
    Mode,
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


# --- metrics ------------------------------------------------------------------------------------------------

MAX_AGE_S: Final = 5.0
"""Age of a report, seconds, from which its sender counts as gone: five periods."""

CONTENT_TYPE: Final = "application/openmetrics-text; version=1.0.0; charset=utf-8"

REQUEST_TIMEOUT_S: Final = 5.0
"""Time limit for reading a request, seconds: half of Prometheus' default scrape timeout."""

Labels: TypeAlias = dict[str, str]
Samples: TypeAlias = Iterable[tuple[Labels, float]]

UNITS: Final = ("seconds", "meters", "radians", "hertz", "bytes", "ratio")


SOURCE_METRICS: Final = (
    ("source_messages", "counter", "Messages received.", "count"),
    ("source_measured", "counter", "Measurements that localization decided on.", "measured"),
    ("source_used", "counter", "Measurements that localization used.", "used"),
    ("source_rate_hertz", "gauge", "Messages a second in the last period.", "rate_hz"),
    ("source_age_seconds", "gauge", "Time since the last message.", "age"),
    ("source_delay_seconds", "gauge", "Greatest delay of a sample in the last period.", "delay_max"),
    ("source_silent", "gauge", "Whether the source is silent.", "silent"),
)
"""Name, type, description and attribute of the metrics of each source."""

DRIVER_METRICS: Final = (
    ("driver_samples", "counter", "Samples published.", "samples"),
    ("driver_reconnects", "counter", "How often the line was reopened.", "reconnects"),
    ("driver_rate_hertz", "gauge", "Samples a second in the last period.", "rate_hz"),
    ("driver_age_seconds", "gauge", "Time since the last sample.", "age"),
    ("driver_clock_offset_seconds", "gauge", "Host minus device time.", "clock_offset"),
)
"""Name, type, description and attribute of the metrics of each driver."""


def format_metrics(health: Health | None, age: float, drivers: Iterable[DriverHealth]) -> str:
    """Return the metrics of a report that is `age` seconds old, if there is one, and of the drivers' current ones."""
    is_up = health is not None and age <= MAX_AGE_S
    lines = list(_format_family("up", "gauge", "Whether the daemon reports its health.", [({}, is_up)]))
    if health is not None and is_up:
        lines += _format_health_metrics(health, age)
    lines += _format_driver_metrics(sorted(drivers, key=lambda each: each.source))
    return "\n".join((*lines, "# EOF\n"))


def _format_health_metrics(health: Health, age: float) -> Iterator[str]:
    local, stability = health.localization, health.stability
    about = {"version": health.version, "vehicle": health.vehicle, "model_revision": health.model_revision}
    yield from _format_family("", "info", "The daemon.", [(about, 1)])
    reasons = {str(each.name): each in health.invalid_reasons for each in Invalid}
    states = {name: number == health.state for number, name in STATE_NAMES.items()}
    modes, phases = (
        {each.name: each is now for each in kind} for kind, now in ((Mode, local.mode), (Phase, local.phase))
    )
    for name, what, values in (
        ("state", "State of the daemon.", states),
        ("pose_invalid_reason", "Reasons why the pose may not be used.", reasons),
        ("localization_mode", "Sources that localization uses.", modes),
        ("alignment_phase", "Phase of the filter's alignment.", phases),
    ):
        yield from _format_family(name, "stateset", what, _make_states(name, values))
    valid = local.mode is not None and is_healthy(health)
    latency = (("0.5", health.tick_latency_p50), ("0.9", health.tick_latency_p90), ("0.99", health.tick_latency_p99))
    quantiles = [({"quantile": name}, value) for name, value in (*latency, ("1", health.tick_latency_max))]
    yield from _format_family(
        "tick_latency_seconds", "summary", "Latency of the loop's ticks in the last period.", quantiles
    )
    for name, what, value in (
        ("report_age_seconds", "Age of the health report.", age),
        ("uptime_seconds", "Time since the daemon started.", health.uptime),
        ("pose_valid", "Whether the pose may be used.", valid),
        ("pose_epoch", "Discontinuities of the world pose.", health.pose_epoch),
        ("stationary", "Whether the vehicle is stationary.", local.stationary),
        ("horizontal_protection_level_meters", "Horizontal protection level.", local.horizontal_protection_level),
        ("heading_protection_level_radians", "Heading protection level.", local.heading_protection_level),
        ("horizontal_level_meters", "Horizontal level, which its limit is compared with.", local.horizontal_level),
        ("heading_level_radians", "Heading level, which its limit is compared with.", local.heading_level),
        ("horizontal_limit_meters", "Limit of the horizontal level of a valid pose.", local.horizontal_limit),
        ("heading_limit_radians", "Limit of the heading level of a valid pose.", local.heading_limit),
        ("limit_reached_seconds", "Time until a limit is passed without measurements.", local.seconds_to_limit),
        ("fix_age_seconds", "Time since the last GNSS fix that was used.", local.fix_age),
        ("tip_over_margin_radians", "Static tip-over margin.", stability.margin),
        ("requests_waiting", "Requests that wait for data.", health.requests_waiting),
        ("requests_queued", "Requests in the queue.", health.requests_queued),
        ("memory_bytes", "Resident memory of the daemon.", health.memory or math.nan),
        ("cpu_ratio", "Share of one processor's time.", health.cpu_share),
    ):
        yield from _format_family(name, "gauge", what, [({}, value)])
    for name, what, value in (
        ("poses_published", "Poses published.", health.poses_published),
        ("requests_answered", "Requests answered.", health.requests_answered),
        ("ticks_missed", "Ticks of the loop that were skipped.", health.ticks_missed),
        ("handler_errors", "Exceptions in handlers.", health.handler_errors),
    ):
        yield from _format_family(name, "counter", what, [({}, value)])
    sources = [({"source": each.channel}, each) for each in health.channels]
    for name, kind, what, attribute in SOURCE_METRICS:
        yield from _format_family(name, kind, what, [(labels, getattr(each, attribute)) for labels, each in sources])
    rejected = [({"source": source, "reason": reason}, count) for source, reason, count in health.rejected]
    yield from _format_family("rejected", "counter", "Rejected input.", rejected)
    warnings = [({"subject": subject}, 1) for subject, _ in health.warnings]
    yield from _format_family("warning", "gauge", "Warnings that are present.", warnings)


def _format_driver_metrics(drivers: list[DriverHealth]) -> Iterator[str]:
    labeled = [({"driver": each.source}, each) for each in drivers]
    phases = [
        (labels | state, value)
        for labels, each in labeled
        for state, value in _make_states("driver_phase", {phase.name: phase is each.phase for phase in DriverPhase})
    ]
    yield from _format_family("driver_phase", "stateset", "Phase of a driver.", phases)
    for name, kind, what, attribute in DRIVER_METRICS:
        yield from _format_family(name, kind, what, [(labels, getattr(each, attribute)) for labels, each in labeled])
    counts = [(labels | {"counter": name}, value) for labels, each in labeled for name, value in each.counters]
    yield from _format_family("driver_counter", "counter", "Counters of the device's driver.", counts)


def _make_states(name: str, values: Mapping[str, bool]) -> list[tuple[Labels, float]]:
    """Return the samples of a StateSet, whose label has the family's name."""
    return [({f"modelserver_{name}": state}, is_on) for state, is_on in values.items()]


def _format_family(name: str, kind: str, what: str, samples: Samples) -> Iterator[str]:
    """Yield the lines of a metric family, none without a known value."""
    family = f"modelserver_{name}".rstrip("_")
    suffix = {"counter": "_total", "info": "_info"}.get(kind, "")
    known = [(labels, float(value)) for labels, value in samples if not math.isnan(value)]
    if not known:
        return
    yield f"# TYPE {family} {kind}"
    if (unit := name.rpartition("_")[2]) in UNITS:
        yield f"# UNIT {family} {unit}"
    yield f"# HELP {family} {what}"
    for labels, value in known:
        inside = ",".join(f'{key}="{_escape(text)}"' for key, text in labels.items())
        number = repr(value) if math.isfinite(value) else "+Inf" if value > 0.0 else "-Inf"
        yield f"{family}{suffix}{f'{{{inside}}}' if inside else ''} {number}"


def _escape(text: str) -> str:
    whole = text.encode("utf-8", "replace").decode()
    return whole.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")


def serve_metrics(address: str, render: Callable[[], str]) -> ThreadingHTTPServer:
    """Serve the rendered metrics at [HOST:]PORT in a thread, on loopback without HOST. Raises ModelServerError."""

    class Handler(BaseHTTPRequestHandler):
        timeout = REQUEST_TIMEOUT_S

        def do_GET(self) -> None:
            if self.path.partition("?")[0] != "/metrics":
                self.send_error(404, "the metrics are at /metrics")
                return
            body = render().encode()
            self.send_response(200)
            self.send_header("Content-Type", CONTENT_TYPE)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *_: object) -> None:  # noqa: A002
            """Log nothing: there is a request every few seconds."""

    host, _, port = address.rpartition(":")
    try:
        server = ThreadingHTTPServer((host.strip("[]") or "127.0.0.1", int(port)), Handler)
    except (OSError, OverflowError, ValueError) as error:
        raise ModelServerError(f"cannot serve at {address!r}: {error}; give a free port, or ADDRESS:PORT") from None
    server.daemon_threads = True
    threading.Thread(target=server.serve_forever, daemon=True).start()
    return server
