"""`modelserver status`: the health of the running daemon."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Annotated

import typer

from modelserver.errors import NoServerError, find_nearest_names, quote
from modelserver.messages import DriverHealth, Health
from modelserver.wire.provider import open_lcm, resolve_url
from mstools.commands.listener import DaemonListener, handle_until
from mstools.terminal.health_text import as_data, format_line, format_report, is_healthy
from mstools.terminal.options import JsonOption, PrefixOption, UrlOption, option
from mstools.terminal.output import replace_unencodable
from mstools.terminal.progress import catch_signals, open_screen

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

    Exit code: 0 the daemon runs with a valid pose, 3 it runs without one, 1 no report was received, 2 wrong usage.

    Example: modelserver status --watch
    """
    drivers: tuple[str, ...] = ()
    if config is not None:
        from modelserver.config.vehicle_file import load_config

        vehicle = load_config(config)
        url, prefix = url or vehicle.lcm.url, prefix or vehicle.lcm.channel_prefix
        drivers = tuple(vehicle.drivers)
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
    """Receive the health reports of one daemon and its drivers; `reports` counts the daemon's."""

    def __init__(self, bus: lcm.LCM, prefix: str):
        self.health: Health | None = None
        self.reports = 0
        self.drivers: dict[str, DriverHealth] = {}
        super().__init__(bus, prefix, {HEALTH: self._on_health, "DRIVER_HEALTH": self._on_driver})

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
