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
import weakref
import zipfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import nullcontext, suppress
from functools import partial
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, Final, NoReturn

import typer

from modelserver.errors import ModelServerError, NoServerError, RecordingError, WireError, find_nearest_names, quote
from modelserver.extras import DEBIAN_INSTALLER, make_system_command, read_installation
from modelserver.messages import DriverHealth, Health
from modelserver.wire.channels import BY_NAME, DEFAULT_URL, to_subscription_pattern
from modelserver.wire.codec import decode
from modelserver.wire.provider import handle_message, open_lcm, resolve_url
from mstools.terminal.health import MAX_AGE_S, as_data, format_metrics, format_report, is_healthy, serve_metrics
from mstools.terminal.options import JsonOption, PrefixOption, UrlOption, argument, option
from mstools.terminal.output import catch_signals, open_screen, replace_unencodable

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
    log: Annotated[Path | None, argument("[LOG]", "Show the last report in this LCM log instead.")] = None,
    config: Annotated[
        Path | None,
        option("--config -c FILE", "The vehicle file, for its bus and prefix; with LOG: run the localization on it."),
    ] = None,
    watch: Annotated[bool, option("--watch -w", "Show each report, until Ctrl-C.")] = False,
    spy: Annotated[bool, option("--spy", "Show all channels decoded, in lcm-spy.")] = False,
    metrics: Annotated[
        str, option("--metrics [HOST:]PORT", "Serve the health to Prometheus, until Ctrl-C; on loopback by default.")
    ] = "",
    as_json: JsonOption = False,
    url: UrlOption = "",
    prefix: PrefixOption = "",
    timeout: Annotated[
        float, option("--timeout SECONDS", "Timeout for the daemon's report.", min=0.1, max=3600.0)
    ] = 2.5,
) -> None:
    """Show the health of the running daemon: pose, filter, loop, sensors, drivers, rejected messages, and warnings.

    Waits for its next health report, which is published once a second. With --watch each report replaces the last one;
    if the output is no terminal, they follow one another.

    --spy starts lcm-spy with this project's types instead; double-click a channel to see its fields. It needs a display
    and Java (default-jre), and at the first run a Java compiler (default-jdk-headless): the types are compiled once for
    each version of the wire contract, and stored in the user's cache.

    With LOG it shows the last report in a log. With -c too the localization runs on the log first.

    --metrics serves the reports as OpenMetrics text at http://127.0.0.1:PORT/metrics instead, in a process of its own,
    also while there is no daemon.

    Exit code: 0 the daemon runs with a valid pose, 3 it runs without one, 1 no report was received, 2 wrong usage.

    \b
    Examples:
      modelserver status --watch
      modelserver status --spy
      modelserver status --metrics 9464
    """
    drivers: tuple[str, ...] = ()
    if config is not None:
        from modelserver.config.vehicle_file import load_config

        vehicle = load_config(config)
        url, prefix = url or vehicle.lcm.url, prefix or vehicle.lcm.channel_prefix
        drivers = tuple(vehicle.drivers)
    if log is not None:
        if watch or spy or metrics or url:
            raise typer.BadParameter("goes without --watch, --spy, --metrics and --url", param_hint="LOG")
        show_last_report(log, config, prefix, as_json)
        return
    if spy:
        run_spy(url)
    provider = resolve_url(url)
    if metrics:
        if watch or as_json:
            raise typer.BadParameter("excludes --watch and --json", param_hint="--metrics")
        follow_metrics(HealthListener(open_lcm(provider), prefix), metrics)
        return
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
    show_report(listener.report, listener.drivers.values(), drivers, as_json)


def show_report(health: Health, reports: Iterable[DriverHealth], drivers: tuple[str, ...], as_json: bool) -> None:
    """Print a report, and exit with EXIT_UNHEALTHY where it has no valid pose."""
    if as_json:
        typer.echo(json.dumps(as_data(health, reports), indent=2))
    else:
        typer.echo(replace_unencodable(format_report(health, reports, drivers)))
    if not is_healthy(health):
        raise typer.Exit(EXIT_UNHEALTHY)


def show_last_report(log: Path, config: Path | None, prefix: str, as_json: bool) -> None:
    """Print the last report in a log, with a vehicle file after the localization. Raises RecordingError, OSError."""
    from modelserver.wire.eventlog import LogFile
    from mstools.commands.replay import open_localized

    health: Health | None = None
    drivers: dict[str, DriverHealth] = {}
    with open_localized(log, config) as localized, LogFile(localized) as events:
        for event in events:
            with suppress(WireError):
                if event.channel == f"{prefix}{HEALTH}":
                    health = decode("health_t", event.data)
                elif event.channel == f"{prefix}DRIVER_HEALTH":
                    driver: DriverHealth = decode("driver_health_t", event.data)
                    drivers[driver.source] = driver
    if health is None:
        raise RecordingError(
            f"{log}: no report on {prefix}{HEALTH}; with -c and the vehicle file the localization runs on the log"
        )
    show_report(health, drivers.values(), tuple(drivers), as_json)


POLL_S: Final = 0.2
"""Period of checks of the condition without a message, seconds: a signal may have changed it."""


class DaemonListener:
    """Receive channels of a daemon, whose handlers get the decoded messages. `has_received`: any message.

    Messages of another type or version are ignored: the next one may be valid.
    """

    def __init__(self, bus: lcm.LCM, prefix: str, handlers: Mapping[str, Callable[[Any], object]]):
        self.has_received = False
        self._bus = bus
        self._handlers = dict(handlers)
        # a weak reference, so that the bus is left with this object
        receive = partial(_receive, weakref.ref(self))
        self.subscriptions = [
            bus.subscribe(to_subscription_pattern(f"{prefix}{name}"), partial(receive, name)) for name in handlers
        ]

    def _receive(self, name: str, data: bytes) -> None:
        self.has_received = True
        with suppress(WireError):
            self._handlers[name](decode(BY_NAME[name].type_name, data))

    def listen(self, seconds: float, until: Callable[[], bool]) -> bool:
        """Listen for up to `seconds` until a condition holds; return whether it does."""
        return handle_until(self._bus, seconds, until)


def _receive(listener: weakref.ref[DaemonListener], name: str, _: str, data: bytes) -> None:
    if (found := listener()) is not None:
        found._receive(name, data)


def handle_until(bus: lcm.LCM, seconds: float, is_done: Callable[[], bool]) -> bool:
    """Handle messages of the bus for up to `seconds` until `is_done`; return whether it is."""
    deadline = time.monotonic() + seconds
    while not is_done():
        left = deadline - time.monotonic()
        if left <= 0.0:
            return False
        handle_message(bus, int(min(left, POLL_S) * 1e3) + 1)
    return True


class HealthListener(DaemonListener):
    """Receive the health reports of one daemon and its drivers, with `more` handlers; `reports` counts the daemon's.

    `times` are those when the last reports were received, seconds of the monotonic clock, by channel or driver.
    """

    def __init__(self, bus: lcm.LCM, prefix: str, more: Mapping[str, Callable[[Any], object]] = MappingProxyType({})):
        self.health: Health | None = None
        self.reports = 0
        self.drivers: dict[str, DriverHealth] = {}
        self.times: dict[str, float] = {}
        super().__init__(bus, prefix, {HEALTH: self._on_health, "DRIVER_HEALTH": self._on_driver, **more})

    def _on_health(self, health: Health) -> None:
        self.health, self.times[HEALTH] = health, time.monotonic()
        self.reports += 1

    def _on_driver(self, health: DriverHealth) -> None:
        if health.source in self.drivers or len(self.drivers) < MAX_NAMES:
            self.drivers[health.source], self.times[f"driver {health.source}"] = health, time.monotonic()

    @property
    def report(self) -> Health:
        """The last report, after one was received."""
        assert self.health is not None
        return self.health

    def has_drivers(self, drivers: tuple[str, ...]) -> bool:
        """Return whether all these drivers have reported; False for none, as others may exist."""
        return bool(drivers) and all(name in self.drivers for name in drivers)


def probe_channels(bus: lcm.LCM, seconds: float = PROBE_S) -> dict[str, bool]:
    """Return the channels with messages, and whether each had a health report."""
    from modelserver.wire.codec import type_name_of

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
        return f"{text}The bus has other channels ({names}): is the daemon running? modelserver run -c FILE"
    return (
        f"{text}The bus has no messages at all: is the daemon running (modelserver run -c FILE, or systemctl status "
        "modelserver), and on this bus (--url, or -c with its vehicle file)? modelserver doctor checks the bus"
    )


def watch_reports(listener: HealthListener, drivers: tuple[str, ...], as_json: bool) -> None:
    """Show each report until Ctrl-C, and warn when there is none: in place on a terminal, else one after the other."""
    is_screen = sys.stdout.isatty() and not as_json
    with catch_signals() as stop, open_screen() if is_screen else nullcontext() as live:
        shown = 0

        def is_over() -> bool:
            return stop.is_set() or listener.reports > shown

        while not stop.is_set():
            silent = time.monotonic() - listener.times[HEALTH]
            reports = (listener.report, listener.drivers.values())
            text = json.dumps(as_data(*reports)) if as_json else replace_unencodable(format_report(*reports, drivers))
            if silent > SILENT_S:
                text = f"NO REPORT for {silent:.0f} s; the last one:\n\n{text}"
            if live is not None:
                from rich.text import Text

                live.update(Text(text, overflow="crop", no_wrap=True), refresh=True)
            elif listener.reports > shown:
                typer.echo(text)
                sys.stdout.flush()
            elif silent > SILENT_S:
                typer.echo(f"no report for {silent:.0f} s", err=True)
            shown = listener.reports
            listener.listen(1.0 if is_screen else SILENT_S, is_over)


# --- metrics


def follow_metrics(listener: HealthListener, address: str) -> None:
    """Serve the metrics of current reports until Ctrl-C. Raises ModelServerError for an address that cannot be used."""

    def render() -> str:
        # copies: the listener changes them in another thread
        now, times, drivers = time.monotonic(), dict(listener.times), dict(listener.drivers)
        current = [each for name, each in drivers.items() if now - times.get(f"driver {name}", -math.inf) <= MAX_AGE_S]
        return format_metrics(listener.health, now - times.get(HEALTH, -math.inf), current)

    server = serve_metrics(address, render)
    host, port = server.server_address[:2]
    typer.echo(f"http://{host!s}:{port}/metrics (Ctrl-C ends it)")
    sys.stdout.flush()
    with catch_signals() as stop:
        while not stop.is_set():
            listener.listen(SILENT_S, stop.is_set)
    server.shutdown()
    server.server_close()


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
    if shutil.which("java") is None:
        raise MissingToolError(
            "lcm-spy needs Java, which is missing: sudo apt install default-jre default-jdk-headless"
        )
    if not os.environ.get("DISPLAY"):
        raise MissingToolError(
            "lcm-spy opens a window, but there is no display (DISPLAY is empty). Over ssh use ssh -X, or modelserver "
            "status --watch"
        )


def get_types_jar() -> Path:
    """Return the jar of the wire types, compiled once for each version of them."""
    files = find_type_files()
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    folder = cache / "modelserver" / hash_contract(files)
    jar = folder / "mslcm.jar"
    if not jar.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        _build_jar(files, jar)
    return jar


def hash_contract(files: Sequence[Path]) -> str:
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
        java_library = _check_file(_get_site_packages() / "share" / "java" / "lcm.jar")
        _run([compiler, "-nowarn", "-cp", java_library, "-d", work / "classes", *sources])
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


class MissingToolError(ModelServerError):
    """A program or a file that a tool needs is missing; the message is how to install it."""


def find_binary(name: str) -> Path:
    """Return the path of the lcm wheel's program `name`, e.g. lcm-gen. Raises MissingToolError.

    It is the wheel's binary, not its `lcm-*` console script: that starts the binary as a child process and leaves it
    running when it gets SIGTERM.
    """
    return _check_file(_get_site_packages() / "bin" / name)


def find_type_files() -> tuple[Path, ...]:
    """Return the .lcm files: of the checkout, or as installed with the package mslcm. Raises MissingToolError."""
    spec = find_spec("mslcm")
    if spec is None or spec.origin is None:
        raise MissingToolError("the package mslcm is missing; reinstall modelserver")
    package = Path(spec.origin).parent
    for folder in (package / "lcm", package.parent):
        files = tuple(sorted(folder.glob("*_t.lcm")))
        if files:
            return files
    raise MissingToolError(f"no .lcm files beside {package}; reinstall modelserver")


def _get_site_packages() -> Path:
    spec = find_spec("lcm")
    if spec is None or spec.origin is None:
        raise MissingToolError("the package lcm is missing: pip install lcm")
    return Path(spec.origin).resolve().parent.parent


def _check_file(path: Path) -> Path:
    if not path.is_file():
        if read_installation()[0] == DEBIAN_INSTALLER:
            fix = f"the Debian package does not have it; in a folder with the source: {make_system_command('.')}"
            raise MissingToolError(f"{path.name} is missing: {fix}")
        raise MissingToolError(f"{path} is missing; reinstall the wheel: pip install --force-reinstall lcm")
    return path
