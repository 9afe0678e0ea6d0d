"""`modelserver status`: the health of the running daemon."""

from __future__ import annotations

import hashlib
import json
import math
import os
import shutil
import subprocess
import sys
import tempfile
import time
import zipfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from threading import Event
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, Final, NoReturn

import typer

from modelserver.core import DEGRADED, RUNNING, STARTING
from modelserver.errors import NoServerError, find_nearest_names, quote
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
from modelserver.wire.channels import DEFAULT_URL
from modelserver.wire.provider import open_lcm, resolve_url
from mstools.commands.listener import DaemonListener, handle_until
from mstools.lcm_wheel import MissingToolError, find_binary, find_java_library, find_type_files
from mstools.terminal.options import JsonOption, PrefixOption, UrlOption, option
from mstools.terminal.output import (
    catch_signals,
    escape,
    format_count,
    format_table,
    open_screen,
    replace_unencodable,
    to_json,
)

if TYPE_CHECKING:
    import lcm

EXIT_UNHEALTHY = 3
"""The daemon runs without a valid pose; 1 is no report, 2 wrong usage, as for every command."""

DRIVER_WAIT_S = 1.2
"""Wait for the reports of drivers, seconds: each publishes one per second."""

PROBE_S = 1.0
"""Duration of listening for other channels when no report was received, seconds."""

MAX_NAMES = 1000
"""Largest number of channels and of drivers."""

MAX_SHOWN_NAMES = 6
"""Names in a message."""

SILENT_S = 5.0
"""Time without a report until a warning, seconds."""

HEALTH = "MODELSERVER_HEALTH"


def command(
    config: Annotated[Path | None, option("--config -c FILE", "The vehicle file, for its bus and prefix.")] = None,
    watch: Annotated[bool, option("--watch -w", "Show each report, until Ctrl-C.")] = False,
    spy: Annotated[bool, option("--spy", "Show all channels decoded, in lcm-spy.")] = False,
    as_json: JsonOption = False,
    url: UrlOption = "",
    prefix: PrefixOption = "",
    timeout: Annotated[
        float, option("--timeout SECONDS", "Timeout for the daemon's report.", min=0.1, max=3600.0)
    ] = 2.5,
) -> None:
    """Show the health of the running daemon: pose, filter, loop, sensors, drivers, rejected messages, and warnings.

    Waits for its next health report, which is published once a second. With --watch each report replaces the last one;
    if the output is no terminal, each is one line.

    --spy starts lcm-spy with this project's types instead; double-click a channel to see its fields. It needs a display
    and Java (default-jre), and at the first run a Java compiler (default-jdk-headless): the types are compiled once for
    each version of the wire contract, and stored in the user's cache.

    Exit code: 0 the daemon runs with a valid pose, 3 it runs without one, 1 no report was received, 2 wrong usage.

    \b
    Examples:
      modelserver status --watch
      modelserver status --spy
    """
    drivers: tuple[str, ...] = ()
    if config is not None:
        from modelserver.config.vehicle_file import load_config

        vehicle = load_config(config)
        url, prefix = url or vehicle.lcm.url, prefix or vehicle.lcm.channel_prefix
        drivers = tuple(vehicle.drivers)
    if spy:
        run_spy(url)
    provider = resolve_url(url)
    listener = HealthListener(open_lcm(provider), prefix)
    began = time.monotonic()
    if not listener.listen(timeout, lambda: listener.health is not None):
        raise NoServerError(format_no_report(provider, prefix, timeout, probe_channels(open_lcm(provider))))
    if watch:
        watch_reports(listener, drivers, as_json)
        return
    # all drivers have published by then
    listener.listen(
        max(0.0, min(DRIVER_WAIT_S, timeout) - (time.monotonic() - began)), lambda: listener.has_drivers(drivers)
    )
    reports = (listener.report, listener.drivers.values())
    text = json.dumps(as_data(*reports), indent=2) if as_json else replace_unencodable(format_report(*reports, drivers))
    typer.echo(text)
    if not is_healthy(listener.report):
        raise typer.Exit(EXIT_UNHEALTHY)


class HealthListener(DaemonListener):
    """Receive the health reports of one daemon and its drivers, with `more` handlers; `reports` counts the daemon's."""

    def __init__(self, bus: lcm.LCM, prefix: str, more: Mapping[str, Callable[[Any], object]] = MappingProxyType({})):
        self.health: Health | None = None
        self.reports = 0
        self.drivers: dict[str, DriverHealth] = {}
        super().__init__(bus, prefix, {HEALTH: self._on_health, "DRIVER_HEALTH": self._on_driver, **more})

    def _on_health(self, health: Health) -> None:
        self.health = health
        self.reports += 1

    def _on_driver(self, health: DriverHealth) -> None:
        if health.source in self.drivers or len(self.drivers) < MAX_NAMES:
            self.drivers[health.source] = health

    @property
    def report(self) -> Health:
        """The last report, after one was received."""
        assert self.health is not None
        return self.health

    def wait_for_report(self, seconds: float, stop: Event) -> bool:
        """Wait up to `seconds`, or until `stop`, for another report; return whether there was one."""
        before = self.reports
        self.listen(seconds, lambda: stop.is_set() or self.reports > before)
        return self.reports > before

    def has_drivers(self, drivers: tuple[str, ...]) -> bool:
        """Return whether all these drivers have reported; False for none, as others may exist."""
        return bool(drivers) and all(name in self.drivers for name in drivers)


def probe_channels(bus: lcm.LCM, seconds: float = PROBE_S) -> dict[str, bool]:
    """Return the channels with messages, and whether each had a health report."""
    from modelserver.wire.encoded import type_name_of

    found: dict[str, bool] = {}

    def handle(channel: str, data: bytes) -> None:
        if channel in found or len(found) < MAX_NAMES:
            found[channel] = type_name_of(data) == "health_t"

    bus.subscribe(".*", handle)
    handle_until(bus, seconds, lambda: False)
    return found


def format_no_report(provider: str, prefix: str, timeout: float, channels: dict[str, bool]) -> str:
    """Format the error for a missing report: where, which channels exist instead, and what to do."""
    text = f"no health report on {prefix}{HEALTH} within {timeout:g} s, on {provider}. "
    if f"{prefix}{HEALTH}" in channels:
        return text + "Its messages are of another version of the service: install the same version on both sides"
    others = [name.removesuffix(HEALTH) for name, is_health in channels.items() if is_health and name.endswith(HEALTH)]
    if others:
        near = (*find_nearest_names(prefix, [each for each in others if each]), *others)[0]
        there = ", ".join(quote(f"{each}{HEALTH}", 80) for each in others[:MAX_SHOWN_NAMES])
        do = f"--prefix {quote(near, 40)}" if near else "no --prefix"
        return f"{text}Other reports: {there}. Did you mean {do}?"
    if channels:
        names = ", ".join(quote(each, 64) for each in sorted(channels)[:MAX_SHOWN_NAMES])
        names += f" and {len(channels) - MAX_SHOWN_NAMES} more" if len(channels) > MAX_SHOWN_NAMES else ""
        do = "is the daemon running? modelserver run -c FILE, or systemctl status modelserver"
        return f"{text}The bus has other channels ({names}): {do}"
    return (
        f"{text}The bus has no messages at all: is the daemon running (modelserver run -c FILE, or systemctl status "
        "modelserver), and on this bus (--url, or -c with its vehicle file)? modelserver doctor checks the bus"
    )


def watch_reports(listener: HealthListener, drivers: tuple[str, ...], as_json: bool) -> None:
    """Show each report until Ctrl-C, and warn when there is none."""
    if as_json or not sys.stdout.isatty():
        _print_lines(listener, as_json)
        return
    from rich.text import Text

    last = time.monotonic()
    with catch_signals() as stop, open_screen() as live:
        while not stop.is_set():
            silent = time.monotonic() - last
            text = format_report(listener.report, listener.drivers.values(), drivers)
            if silent > SILENT_S:
                text = f"NO REPORT for {silent:.0f} s; the last one:\n\n{text}"
            live.update(Text(replace_unencodable(text), overflow="crop", no_wrap=True), refresh=True)
            if listener.wait_for_report(1.0, stop):
                last = time.monotonic()


def _print_lines(listener: HealthListener, as_json: bool) -> None:
    with catch_signals() as stop:
        while not stop.is_set():
            data = as_data(listener.report, listener.drivers.values()) if as_json else None
            typer.echo(json.dumps(data) if as_json else replace_unencodable(format_line(listener.report)))
            sys.stdout.flush()
            began = time.monotonic()
            while not listener.wait_for_report(SILENT_S, stop) and not stop.is_set():
                typer.echo(f"no report for {time.monotonic() - began:.0f} s", err=True)


STATE_NAMES: Final = {STARTING: "STARTING", RUNNING: "RUNNING", DEGRADED: "DEGRADED"}

MAX_ROWS: Final = 40
"""Rows of a table that are shown: an unknown publisher may invent as many sources as the daemon counts."""

SENSOR_PREFIX: Final = "sensor:"
"""Prefix of the sensors' names in a report."""

LARGE_SIGMA_HORIZONTAL: Final = 10.0
"""Standard deviation of the position beyond which status warns, meters: three times that of an ordinary fix."""

LARGE_SIGMA_UP: Final = 20.0
"""The same of the height: it is known less well than the position, and without undulation not at all."""

FRESH_S: Final = 1.0
"""A source without a rate and with a message in this time was first received after the last rate computation."""


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
    """Format pose, filter, geometry and process of a report."""
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
            *_format_place(localization),
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


def _format_place(localization: LocalizationHealth) -> list[tuple[str, str]]:
    """Return the lines for latitude, longitude, height, heading and their uncertainty."""
    if math.isnan(localization.latitude_deg):
        return []
    heading = "" if math.isnan(localization.heading_deg) else f", heading {localization.heading_deg:.1f} deg"
    place = f"{localization.latitude_deg:.7f}, {localization.longitude_deg:.7f} deg"
    lines = [("", f"at {place}, height {localization.height:.1f} m{heading}")]
    for name, sigma, limit in (
        ("position", localization.sigma_horizontal, LARGE_SIGMA_HORIZONTAL),
        ("height", localization.sigma_up, LARGE_SIGMA_UP),
    ):
        if sigma > limit:
            lines.append(("", f"WARNING: the {name} is uncertain, sigma {sigma:.1f} m"))
    return lines


def _format_stability(stability: StabilityHealth) -> str:
    """Format the tip-over margins and the loads."""
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
    """Format the levels beside their limits, and the protection levels."""
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
    """Format the filter's phase and whether the vehicle moves."""
    localization = health.localization
    phase = "" if localization.phase is None else localization.phase.name.lower()
    head = f", {phase}" if phase else ", no filter"
    if not _get_sensors(health):
        return f"{head}: no sensor sample received yet"
    # during leveling only a stationary vehicle is detected
    motion = "stationary" if localization.stationary else "" if localization.phase is Phase.LEVELING else "moving"
    if is_current(health):
        return f"{head}, {motion}" if motion else head
    last = " and ".join(filter(None, (phase, motion)))
    when = "last IMU sample" if Invalid.STALE_IMU in health.invalid_reasons else "last sensor sample"
    return f"{'' if phase else head}; {last} at the {when}"


def _format_fix_age(age_s: float) -> str:
    if math.isnan(age_s):
        return "no fix used yet"
    if age_s < 0.0:
        return f"last fix used has a stamp {format_duration(-age_s)} ahead of the clock"
    return f"last fix used {format_duration(age_s)} ago"


def _is_fresh(each: ChannelHealth) -> bool:
    """Return whether a source is in its first period, without a rate."""
    return bool(each.count) and not each.silent and each.rate_hz == 0.0 and each.age < FRESH_S


def _format_channels(channels: Iterable[ChannelHealth]) -> str:
    rows = [
        (
            each.channel,
            str(each.count),
            "-" if _is_fresh(each) else format_number(each.rate_hz, 1),
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
    return "; ".join(("pose valid", *(text for _, text in _format_place(localization)), _format_bounds(localization)))


def format_line(health: Health) -> str:
    """Format a report as one line, for logs."""
    localization = health.localization
    parts = [format_clock(health.utime), STATE_NAMES.get(health.state, str(health.state))]
    if localization.mode is not None:
        reasons = health.invalid_reasons
        parts.append(f"pose not valid: {reasons.explain()}" if reasons else _format_bounds(localization))
        parts += [text for _, text in _format_place(localization)]
    parts += [f"{each.channel} {_format_source(each)}" for each in health.channels[:MAX_ROWS]]
    parts.append(f"tick latency p99 {health.tick_latency_p99 * 1e3:.2f} ms")
    parts += [f"{name}: {text}" for name, text in health.warnings]
    return escape("; ".join(parts))


def _format_source(each: ChannelHealth) -> str:
    if not each.count:
        return "never received"
    return "SILENT" if each.silent else "received" if _is_fresh(each) else f"{each.rate_hz:.1f} Hz"


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


# --- lcm-spy


def run_spy(url: str) -> NoReturn:
    """Become lcm-spy, so that signals reach it and its exit code is ours. Raises MissingToolError, OSError."""
    check_java()
    jar = get_types_jar()
    spy = find_binary("lcm-spy")
    environment = dict(os.environ)
    environment["CLASSPATH"] = os.pathsep.join(filter(None, (str(jar), environment.get("CLASSPATH", ""))))
    provider = url or environment.get("LCM_DEFAULT_URL", "") or DEFAULT_URL
    sys.stdout.flush()
    os.execve(spy, [str(spy), f"--lcm-url={provider}"], environment)


def check_java() -> None:
    """Raise MissingToolError if lcm-spy cannot open its window."""
    java = shutil.which("java")
    libraries = Path(java or "").resolve().parent.parent / "lib"
    wrong = ""
    if java is None:
        wrong = "needs Java, which is missing: sudo apt install default-jre default-jdk-headless"
    elif (libraries / "libjava.so").exists() and not (libraries / "libawt_xawt.so").exists():
        wrong = "opens a window, but this Java is headless: sudo apt install default-jre"
    elif not os.environ.get("DISPLAY"):
        ways = "Over ssh use ssh -X, or modelserver status --watch"
        wrong = f"opens a window, but there is no display (DISPLAY is empty). {ways}"
    if wrong:
        raise MissingToolError(f"lcm-spy {wrong}")


def get_types_jar() -> Path:
    """Return the jar of the wire types, compiled once for each version of them."""
    files = find_type_files()
    folder = get_cache_folder() / hash_contract(files)
    jar = folder / "mslcm.jar"
    if not jar.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        _build_jar(files, jar)
    return jar


def get_cache_folder() -> Path:
    """Return this program's folder in the user's cache."""
    cache = Path(os.environ.get("XDG_CACHE_HOME", ""))
    if not cache.is_absolute():
        try:
            cache = Path.home() / ".cache"
        except RuntimeError:
            raise MissingToolError("no home directory for the compiled types; set XDG_CACHE_HOME") from None
    return cache / "modelserver"


def hash_contract(files: Sequence[Path]) -> str:
    """Return a hash of these types and of the version of lcm."""
    digest = hashlib.sha256(version("lcm").encode())
    for path in files:
        digest.update(b"\0%b\0%b" % (path.name.encode(), path.read_bytes()))
    return digest.hexdigest()[:16]


def _build_jar(files: Sequence[Path], jar: Path) -> None:
    compiler = shutil.which("javac")
    if compiler is None:
        raise MissingToolError(
            "the types are not compiled yet, and the Java compiler is missing: sudo apt install default-jdk-headless"
        )
    typer.echo(f"compiling the types into {jar}", err=True)
    with tempfile.TemporaryDirectory(dir=jar.parent) as scratch:
        work = Path(scratch)
        _run([find_binary("lcm-gen"), "--java", "--jpath", work / "src", *files])
        sources = sorted((work / "src").rglob("*.java"))
        _run([compiler, "-nowarn", "-cp", find_java_library(), "-d", work / "classes", *sources])
        finished = work / jar.name
        with zipfile.ZipFile(finished, "w", zipfile.ZIP_DEFLATED) as archive:
            for path in sorted((work / "classes").rglob("*.class")):
                archive.write(path, path.relative_to(work / "classes"))
        # atomic, also for two builds at once or an interrupted one
        finished.replace(jar)


def _run(arguments: Sequence[str | Path]) -> None:
    done = subprocess.run(arguments, capture_output=True, text=True)
    if done.returncode:
        output = (done.stderr or done.stdout).strip().splitlines() or [f"exit code {done.returncode}"]
        raise MissingToolError(f"{Path(arguments[0]).name} failed: {output[0]}")
