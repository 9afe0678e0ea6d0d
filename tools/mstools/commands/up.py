"""`modelserver up`: the service and all drivers of a vehicle in one terminal, with real or emulated devices."""

from __future__ import annotations

import math
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Annotated, Final

import typer

from modelserver.config.vehicle_file import VehicleConfig, load_config
from modelserver.errors import ModelServerError, Severity, has_error
from modelserver.files import check_links
from modelserver.wire.provider import open_lcm, resolve_url
from mstools.commands.check import check_vehicle
from mstools.commands.driver import load_driver
from mstools.commands.status import HealthListener
from mstools.commands.view import check_installed
from mstools.launch.processes import (
    MODELSERVER,
    SERVICE,
    STATE_FOLDER,
    ChildProcesses,
    EmulatedConnections,
    get_start_utime,
    make_connections,
    start_devices,
    start_programs,
)
from mstools.terminal.health import describe_pose
from mstools.terminal.options import UrlOption, choose_name, option
from mstools.terminal.output import catch_signals, escape, print_problems

DEFAULT_FILE: Final = Path("vehicle.yaml")

EMULATED_FOLDER: Final = "emulated"
"""Folder beside the vehicle file for the copy that leads to emulated devices, with its state and journal."""

SELF: Final = "up"
"""Name of this command in the output."""

VIEW: Final = "view"
"""Name of the viewer in the output."""

POLL_S: Final = 0.5


def command(
    config: Annotated[
        Path, option("--config -c FILE", f"The vehicle file. Default: {DEFAULT_FILE} in this folder.")
    ] = DEFAULT_FILE,
    emulate: Annotated[bool, option("--emulate", "Emulate each device, all on one simulated drive.")] = False,
    faults: Annotated[
        list[str] | None,
        option("--fault NAME:KIND@SECONDS[:AMOUNT]", "Fault of an emulated device, e.g. gps:stall@20:30. Repeatable."),
    ] = None,
    view: Annotated[bool, option("--view", "Open the viewer in the browser too.")] = False,
    seconds: Annotated[float, option("--seconds N", "Stop after this time. Default: never.", min=0.1)] = math.inf,
    url: UrlOption = "",
) -> None:
    """Run the service and all drivers of a vehicle file, a process each, with their logs in this terminal.

    A process that ends is restarted, later each time. Ctrl-C ends all of them. With --emulate no hardware is needed:
    each device is emulated, and measures one simulated drive. What that writes is in the folder emulated/ beside the
    vehicle file. On a vehicle, `modelserver install` lets systemd do the same.

    \b
    Examples:
      modelserver up
      modelserver up -c vehicle.yaml --emulate --view
      modelserver status, in another terminal
    """
    if view:
        check_installed()
    vehicle = load_checked(config)
    if emulate and not vehicle.drivers:
        raise ModelServerError(
            f"{config} has no section drivers, so there is no device to emulate; modelserver new writes an example"
        )
    of_devices = assign_faults(faults or (), vehicle, config, emulate=emulate)
    lines = emulate_lines(config) if emulate else EmulatedConnections(url, config, {})
    printer = LinePrinter(
        (SERVICE, SELF, VIEW, *(name for each in vehicle.drivers for name in (each, f"{each} device")))
    )
    with catch_signals() as stop, ChildProcesses(printer.print) as children:
        began = time.monotonic()
        if emulate:
            start_devices(children, lines, get_start_utime(len(vehicle.drivers)), faults=of_devices)
        start_programs(children, lines.vehicle, vehicle.drivers, ("--url", url) if url else ())
        if view:
            bus = ("--url", url or vehicle.lcm.url, "--prefix", vehicle.lcm.channel_prefix)
            children.start(VIEW, *MODELSERVER, "view", "--live", *bus)
        listener = HealthListener(open_lcm(resolve_url(url or vehicle.lcm.url)), vehicle.lcm.channel_prefix)

        def is_over() -> bool:
            return stop.is_set() or time.monotonic() >= began + seconds

        supervise(children, listener, printer, is_over)
        printer.print(SELF, "stopping")


def load_checked(config: Path) -> VehicleConfig:
    """Return a vehicle file without errors; print its problems, and exit with 1 on an error. Raises OSError."""
    if not config.exists():
        hint = "modelserver new writes one" if config == DEFAULT_FILE else "check the path"
        raise ModelServerError(f"{config} does not exist; give the vehicle file with -c, or {hint}")
    _, problems = check_vehicle(str(config))
    print_problems(each for each in problems if each.severity is not Severity.NOTE)
    if has_error(problems):
        raise typer.Exit(1)
    return load_config(config)


def emulate_lines(config: Path) -> EmulatedConnections:
    """Write the copy of a vehicle file for emulated devices, without the state of an earlier drive."""
    folder = config.resolve().parent / EMULATED_FOLDER
    check_links(folder)
    folder.mkdir(exist_ok=True)
    # the next drive begins at the same place as the last one
    shutil.rmtree(folder / STATE_FOLDER, ignore_errors=True)
    return make_connections(config.resolve(), folder, own_bus=False)


def assign_faults(
    faults: Iterable[str], vehicle: VehicleConfig, config: Path, *, emulate: bool
) -> dict[str, tuple[str, ...]]:
    """Return the options of the emulators for `NAME:KIND@SECONDS[:AMOUNT]`. Raises typer.BadParameter."""
    from msdrivers.emulate import parse_fault

    options: dict[str, tuple[str, ...]] = {}
    for each in faults:
        name, _, fault = each.partition(":")
        if not emulate:
            raise typer.BadParameter("goes with --emulate", param_hint="--fault")
        name = choose_name(name, vehicle.drivers, "driver", "--fault")
        try:
            parse_fault(fault, load_driver(name, config)[1].kind.faults)
        except ValueError as error:
            raise typer.BadParameter(str(error), param_hint="--fault") from None
        options[name] = (*options.get(name, ()), "--fault", fault)
    return options


class LinePrinter:
    """Print lines of several processes with their names. It is used by several threads."""

    def __init__(self, names: Iterable[str]):
        self._lock = threading.Lock()
        self._width = max(map(len, names))

    def print(self, name: str, text: str) -> None:
        with self._lock:
            typer.echo(f"{name:>{self._width}} | {escape(text)}")
            sys.stdout.flush()


def supervise(
    children: ChildProcesses, listener: HealthListener, printer: LinePrinter, is_done: Callable[[], bool]
) -> None:
    """Restart processes that end, and print when the pose becomes valid or invalid, until `is_done`."""
    shown: tuple[object, ...] = ()
    while not is_done():
        listener.listen(POLL_S, is_done)
        for name, what in children.restart_ended():
            printer.print(SELF, f"{name} {what}")
        health = listener.health
        if health is not None and shown != (health.state, health.invalid_reasons, health.pid):
            shown = (health.state, health.invalid_reasons, health.pid)
            printer.print(SELF, describe_pose(health))
