"""`modelserver status`: how the running daemon is."""

from __future__ import annotations

import json
import select
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from modelserver.errors import NoServerError, WireError, nearest_names, shown
from modelserver.messages import DriverHealth, Health
from modelserver.wire.provider import open_lcm, resolve_url, take_message
from mstools.commands.asking import JsonOption, PrefixOption, UrlOption
from mstools.terminal.interrupts import Interrupts
from mstools.terminal.status_text import as_data, is_well, line, report
from mstools.terminal.table import drawable

if TYPE_CHECKING:
    import lcm

EXIT_NOT_WELL = 3
"""The daemon was heard and has no valid pose; 1 is that it was not heard, 2 wrong usage, as for every command."""

DRIVERS_S = 1.2
"""How long drivers are listened to, seconds: each speaks once a second."""

INSTEAD_S = 1.0
"""For how long what is there instead of the daemon is listened to, seconds."""

MAX_NAMES = 1000
"""Names of channels that are told apart meanwhile, and of drivers."""

SHOWN_NAMES = 6
"""Names that are told."""

SILENT_S = 5.0
"""Without a report for so long it is said that nothing is heard: they may be seldom."""

LOOK_S = 0.2
"""How often it is looked whether to end, seconds."""

HEALTH = "MODELSERVER_HEALTH"


def command(
    config: Annotated[
        Path | None, typer.Option("--config", "-c", metavar="FILE", help="The vehicle file: its bus and its prefix.")
    ] = None,
    watch: Annotated[bool, typer.Option("--watch", "-w", help="Go on showing it, until Ctrl-C.")] = False,
    as_json: JsonOption = False,
    url: UrlOption = "",
    prefix: PrefixOption = "",
    timeout: Annotated[
        float,
        typer.Option("--timeout", metavar="SECONDS", min=0.1, max=3600.0, help="How long the daemon is waited for."),
    ] = 2.5,
) -> None:
    """Tell how the running daemon is: pose, filter, loop, sensors, drivers, what was refused, and notices.

    Waits for its next health report, which comes once a second. With --watch it goes on, each report in place of the
    last one; where the output is no terminal, a line for each.

    Exit code: 0 the daemon runs and its pose may be used, 3 it runs and has none that may be used, 1 it was not heard
    (2 is wrong usage).

    Example: modelserver status --watch
    """

    drivers: tuple[str, ...] = ()
    if config is not None:
        from modelserver.config import load_config

        vehicle = load_config(config)
        url, prefix = url or vehicle.lcm.url, prefix or vehicle.lcm.channel_prefix
        drivers = tuple(vehicle.drivers)
    provider = resolve_url(url)
    ear = HealthListener(open_lcm(provider), prefix)
    began = time.monotonic()
    if not ear.listen(timeout, lambda: ear.health is not None):
        raise NoServerError(nobody(provider, prefix, timeout, heard_instead(open_lcm(provider))))
    if watch:
        go_on(ear, drivers, as_json)
        return
    # all drivers have spoken by then
    ear.listen(max(0.0, min(DRIVERS_S, timeout) - (time.monotonic() - began)), lambda: ear.knows(drivers))
    assert ear.health is not None
    if as_json:
        typer.echo(json.dumps(as_data(ear.health, ear.drivers.values()), indent=2))
    else:
        typer.echo(drawable(report(ear.health, ear.drivers.values(), drivers)))
    if not is_well(ear.health):
        raise typer.Exit(EXIT_NOT_WELL)


class HealthListener:
    """Hears the reports of one daemon and of the drivers beside it; `reports` counts the daemon's."""

    def __init__(self, bus: lcm.LCM, prefix: str):
        from modelserver.wire.channels import literal
        from modelserver.wire.codec import decode

        self.health: Health | None = None
        self.reports = 0
        self.drivers: dict[str, DriverHealth] = {}
        self._bus = bus

        def health(_: str, data: bytes) -> None:
            try:
                self.health = decode("health_t", data)
            except WireError:
                return  # a stranger's, or of another version; `nobody` tells of it
            self.reports += 1

        def driver(_: str, data: bytes) -> None:
            try:
                found: DriverHealth = decode("driver_health_t", data)
            except WireError:
                return
            if found.source in self.drivers or len(self.drivers) < MAX_NAMES:
                self.drivers[found.source] = found

        bus.subscribe(literal(f"{prefix}{HEALTH}"), health)
        bus.subscribe(literal(f"{prefix}DRIVER_HEALTH"), driver)

    def knows(self, drivers: tuple[str, ...]) -> bool:
        """Return whether all these drivers were heard; false of none, for there may be others."""
        return bool(drivers) and all(name in self.drivers for name in drivers)

    def listen(self, seconds: float, until: Callable[[], bool]) -> bool:
        """Listen until something is so, for so long at most; return whether it is."""
        deadline = time.monotonic() + seconds
        while not until():
            left = deadline - time.monotonic()
            if left <= 0.0:
                return False
            if select.select((self._bus.fileno(),), (), (), min(left, LOOK_S))[0]:
                take_message(self._bus)
        return True


def heard_instead(bus: lcm.LCM, seconds: float = INSTEAD_S) -> dict[str, bool]:
    """Return the channels that are heard, and whether a health report came on each."""
    from modelserver.wire.kinds import type_name_of

    found: dict[str, bool] = {}

    def hear(channel: str, data: bytes) -> None:
        if channel in found or len(found) < MAX_NAMES:
            found[channel] = type_name_of(data) == "health_t"

    bus.subscribe(".*", hear)
    deadline = time.monotonic() + seconds
    while (left := deadline - time.monotonic()) > 0.0:
        take_message(bus, int(left * 1e3) + 1)
    return found


def nobody(provider: str, prefix: str, timeout: float, instead: dict[str, bool]) -> str:
    """Return what to say where no report came: where was listened, what was there instead, and what to do."""
    channel = f"{prefix}{HEALTH}"
    text = f"nothing was heard on {channel} for {timeout:g} s, on {provider}. "
    if channel in instead:
        return text + "Only messages of another version of the service come there: install the same on both sides"
    others = [name.removesuffix(HEALTH) for name, is_health in instead.items() if is_health and name.endswith(HEALTH)]
    if others:
        near = (*nearest_names(prefix, [each for each in others if each]), *others)[0]
        there = ", ".join(shown(f"{each}{HEALTH}", 80) for each in others[:SHOWN_NAMES])
        do = f"--prefix {shown(near, 40)}" if near else "no --prefix"
        return f"{text}Heard instead: {there}. Did you mean {do}?"
    if instead:
        names = ", ".join(shown(each, 64) for each in sorted(instead)[:SHOWN_NAMES])
        more = f" and {len(instead) - SHOWN_NAMES} more" if len(instead) > SHOWN_NAMES else ""
        return (
            f"{text}Others speak there ({names}{more}), the daemon does not: is it running? modelserver run -c FILE, "
            "or systemctl status modelserver"
        )
    return (
        f"{text}Nobody speaks there at all: is the daemon running (modelserver run -c FILE, or systemctl status "
        "modelserver), and on this bus (--url, or -c with its vehicle file)? modelserver doctor looks at the bus"
    )


def go_on(ear: HealthListener, drivers: tuple[str, ...], as_json: bool) -> None:
    """Show each report until Ctrl-C; what stays out is told too."""
    if as_json or not sys.stdout.isatty():
        _lines(ear, as_json)
        return
    from rich.console import Console
    from rich.live import Live
    from rich.text import Text

    last = time.monotonic()
    with Interrupts() as stop, Live(console=Console(highlight=False), screen=True, auto_refresh=False) as live:
        while not stop.came:
            assert ear.health is not None
            silent = time.monotonic() - last
            text = report(ear.health, ear.drivers.values(), drivers)
            if silent > SILENT_S:
                text = f"NOTHING HEARD for {silent:.0f} s; the last that was:\n\n{text}"
            live.update(Text(drawable(text), overflow="crop", no_wrap=True), refresh=True)
            if _next(ear, 1.0, stop):
                last = time.monotonic()


def _lines(ear: HealthListener, as_json: bool) -> None:
    with Interrupts() as stop:
        while not stop.came:
            assert ear.health is not None
            data = json.dumps(as_data(ear.health, ear.drivers.values())) if as_json else drawable(line(ear.health))
            typer.echo(data)
            sys.stdout.flush()
            began = time.monotonic()
            while not _next(ear, SILENT_S, stop) and not stop.came:
                typer.echo(f"nothing heard for {time.monotonic() - began:.0f} s", err=True)


def _next(ear: HealthListener, seconds: float, stop: Interrupts) -> bool:
    """Return whether another report came, in so many seconds at most."""
    before = ear.reports
    ear.listen(seconds, lambda: stop.came or ear.reports > before)
    return ear.reports > before
