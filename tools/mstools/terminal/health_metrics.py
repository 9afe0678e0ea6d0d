"""Health reports as metrics for Prometheus: OpenMetrics 1.0 text, served by HTTP.

The process that serves them follows MODELSERVER_HEALTH and DRIVER_HEALTH like every other client, so that the service
has no socket for it. A report older than `MAX_AGE_S` is left out: `modelserver_up` is 0 then, and no old value is taken
for a present one. Unknown values have no sample. Rules: https://prometheus.io/docs/specs/om/open_metrics_spec/
(families are contiguous, counters end with _total, names with their unit, the exposition with # EOF).
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Final, TypeAlias

from modelserver.errors import ModelServerError
from modelserver.messages import ChannelHealth, DriverHealth, DriverPhase, Health, Invalid, Mode, Phase
from mstools.terminal.health_text import STATE_NAMES, is_healthy

MAX_AGE_S: Final = 5.0
"""Age of a report, seconds, from which its sender counts as gone: five periods."""

CONTENT_TYPE: Final = "application/openmetrics-text; version=1.0.0; charset=utf-8"

REQUEST_TIMEOUT_S: Final = 5.0
"""Time limit for reading a request, seconds: half of Prometheus' default scrape timeout."""

Labels: TypeAlias = dict[str, str]
Samples: TypeAlias = Iterable[tuple[Labels, float]]

UNITS: Final = ("seconds", "meters", "radians", "hertz", "bytes", "ratio")


SOURCE_METRICS: Final[tuple[tuple[str, str, str, Callable[[ChannelHealth], float]], ...]] = (
    ("source_messages", "counter", "Messages received.", lambda each: each.count),
    ("source_measured", "counter", "Measurements that localization decided on.", lambda each: each.measured),
    ("source_used", "counter", "Measurements that localization used.", lambda each: each.used),
    ("source_rate_hertz", "gauge", "Messages a second in the last period.", lambda each: each.rate_hz),
    ("source_age_seconds", "gauge", "Time since the last message.", lambda each: each.age),
    (
        "source_delay_seconds",
        "gauge",
        "Greatest delay of a sample in the last period.",
        lambda each: each.delay_max,
    ),
    ("source_silent", "gauge", "Whether the source is silent.", lambda each: each.silent),
)
"""Name, type, description and value of the metrics of each source."""

DRIVER_METRICS: Final[tuple[tuple[str, str, str, Callable[[DriverHealth], float]], ...]] = (
    ("driver_samples", "counter", "Samples published.", lambda each: each.samples),
    ("driver_reconnects", "counter", "How often the line was reopened.", lambda each: each.reconnects),
    ("driver_rate_hertz", "gauge", "Samples a second in the last period.", lambda each: each.rate_hz),
    ("driver_age_seconds", "gauge", "Time since the last sample.", lambda each: each.age),
    ("driver_clock_offset_seconds", "gauge", "Host minus device time.", lambda each: each.clock_offset),
)
"""Name, type, description and value of the metrics of each driver."""


def format_metrics(health: Health | None, age: float, drivers: Iterable[DriverHealth]) -> str:
    """Return the metrics of a report that is `age` seconds old, if there is one, and of the drivers' current ones."""
    is_up = health is not None and age <= MAX_AGE_S
    lines = list(_format_family("up", "gauge", "Whether the daemon reports its health.", [({}, is_up)]))
    if health is not None and is_up:
        lines += _format_health(health, age)
    lines += _format_drivers(sorted(drivers, key=lambda each: each.source))
    return "\n".join((*lines, "# EOF\n"))


def _format_health(health: Health, age: float) -> Iterator[str]:
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
    for name, kind, what, read in SOURCE_METRICS:
        yield from _format_family(name, kind, what, [(labels, read(each)) for labels, each in sources])
    rejected = [({"source": source, "reason": reason}, count) for source, reason, count in health.rejected]
    yield from _format_family("rejected", "counter", "Rejected input.", rejected)
    warnings = [({"subject": subject}, 1) for subject, _ in health.warnings]
    yield from _format_family("warning", "gauge", "Warnings that are present.", warnings)


def _format_drivers(drivers: list[DriverHealth]) -> Iterator[str]:
    labeled = [({"driver": each.source}, each) for each in drivers]
    phases = [
        (labels | state, value)
        for labels, each in labeled
        for state, value in _make_states("driver_phase", {phase.name: phase is each.phase for phase in DriverPhase})
    ]
    yield from _format_family("driver_phase", "stateset", "Phase of a driver.", phases)
    for name, kind, what, read in DRIVER_METRICS:
        yield from _format_family(name, kind, what, [(labels, read(each)) for labels, each in labeled])
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
