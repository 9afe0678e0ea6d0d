"""`modelserver emulate`: a device in software, on a line that its driver opens as if it were the device."""

from __future__ import annotations

import logging
import math
import signal
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from modelserver.errors import nearest_names, shown
from mstools.commands.driver import load_driver
from mstools.commands.emulate_samples import LONGEST_S, Wanted, samples_of

if TYPE_CHECKING:
    from modelserver.spatial.so3 import Vector3
    from msdrivers.links import Link
    from msdrivers.settings import DriverSettings

SCENARIOS = ("eight", "circle", "stand", "straight", "city")


def command(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the driver in the vehicle file.")],
    config: Annotated[Path, typer.Option("--config", "-c", metavar="FILE", help="The vehicle file.")],
    pty: Annotated[bool, typer.Option("--pty", help="Make a pseudo-terminal and print its path.")] = False,
    link: Annotated[
        Path | None, typer.Option("--link", metavar="PATH", help="With --pty: a symbolic link to it, made here.")
    ] = None,
    tcp: Annotated[
        int | None, typer.Option("--tcp", metavar="PORT", min=0, max=65535, help="Listen on loopback; 0: any free one.")
    ] = None,
    can: Annotated[str, typer.Option("--can", metavar="CHANNEL", help="Speak on a CAN bus.")] = "",
    interface: Annotated[
        str, typer.Option("--interface", metavar="NAME", help="With --can: python-can's name. Default: the driver's.")
    ] = "",
    log: Annotated[
        Path | None, typer.Option("--from", metavar="LOG", help="Measure what an LCM log says was measured.")
    ] = None,
    scenario: Annotated[
        str, typer.Option(metavar="NAME", help=f"The simulated drive: {', '.join(SCENARIOS)}.")
    ] = SCENARIOS[0],
    faults: Annotated[
        list[str] | None,
        typer.Option(
            "--fault", metavar="KIND@SECONDS[:AMOUNT]", help="drop, corrupt, stall, restart, jump; more by device."
        ),
    ] = None,
    state: Annotated[
        Path | None, typer.Option("--state", metavar="FILE", help="Keep here what the device keeps without power.")
    ] = None,
    iron: Annotated[
        str, typer.Option("--iron", metavar="X,Y,Z", help="Magnetic field of the vehicle's own at an imu, microtesla.")
    ] = "0,0,0",
    seconds: Annotated[
        float | None, typer.Option("--seconds", metavar="N", min=0.1, help="End after so long. Default: never.")
    ] = None,
    seed: Annotated[int, typer.Option("--seed", metavar="N", help="Of the simulation's noise.")] = 1,
    start: Annotated[
        int | None,
        typer.Option(
            "--start",
            metavar="UTIME",
            min=0,
            help="When the drive begins, microseconds of UTC: devices that are given one instant are on one vehicle, "
            "and its controller is driven and not commanded. Default: now.",
        ),
    ] = None,
) -> None:
    """Be a device: answer its driver, and measure a simulated drive or what a log says.

    Prints the line to put into the vehicle file, and speaks until SIGTERM, Ctrl-C or --seconds.

    \b
    Examples:
      modelserver emulate gps -c config/raptor/vehicle.yaml --pty --link /tmp/gps
      modelserver emulate imu -c vehicle.yaml --tcp 4001 --fault stall@10:2 --fault corrupt@15:3
      modelserver emulate wheels -c vehicle.yaml --can vcan0 --from drive.lcm
    """
    from msdrivers.faults import parse_fault

    if scenario not in SCENARIOS:
        near = nearest_names(scenario, SCENARIOS)
        hint = f"did you mean {near[0]}?" if near else f"there are: {', '.join(SCENARIOS)}"
        raise typer.BadParameter(f"{shown(scenario, 40)} is no scenario; {hint}", param_hint="--scenario")
    if (pty, tcp is not None, bool(can)).count(True) != 1:
        raise typer.BadParameter("give one of --pty, --tcp PORT and --can CHANNEL", param_hint="--pty")
    if link is not None and not pty:
        raise typer.BadParameter("a link goes with --pty", param_hint="--link")
    vehicle, settings = load_driver(name, config)
    try:
        wanted = tuple(parse_fault(text, settings.kind.faults) for text in faults or ())
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="--fault") from None
    if state is not None and not settings.kind.remembers:
        raise typer.BadParameter(f"a {settings.kind.name} keeps nothing without power", param_hint="--state")
    if log is not None and not settings.kind.follows:
        raise typer.BadParameter(
            f"device {settings.kind.name} goes where it is told to, not by a log", param_hint="--from"
        )
    own_field = _field(iron)
    line = _line(settings, link, tcp, can, interface)
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(name)s: %(message)s")
    samples = samples_of(vehicle, settings, Wanted(log, start, seconds or LONGEST_S, scenario, seed, own_field))

    from msdrivers.making import emulator_of
    from msdrivers.runner import Runner, RunnerSettings, SystemTime

    station = emulator_of(settings, config.parent, samples, wanted, state)
    how = RunnerSettings(name, f"emulated {settings.kind.name}", silence=math.inf, reopen=math.inf)
    line.open()
    typer.echo(f"{name} ({settings.kind.name}) speaks on {line.description}")
    runner = Runner(station, line, how, SystemTime())
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: runner.stop())
    end = math.inf if seconds is None else time.monotonic() + seconds

    def attend() -> None:
        if time.monotonic() >= end:
            runner.stop()

    runner.run(attend)


def _line(settings: DriverSettings, link: Path | None, tcp: int | None, can: str, interface: str) -> Link[Any]:
    """Return the device's end of the line. Raises typer.BadParameter for one that its driver cannot open."""
    from msdrivers.line_settings import CanSettings, ModbusSettings, SerialSettings
    from msdrivers.links.pty import PtyLink
    from msdrivers.links.tcp import TcpServerLink

    kinds = settings.kind.lines
    if can:
        if CanSettings not in kinds:
            raise typer.BadParameter(f"a {settings.kind.name} is not on a CAN bus", param_hint="--can")
        from msdrivers.links.can_bus import CanLink

        given = settings.line.interface if isinstance(settings.line, CanSettings) else ""
        return CanLink(can, interface or given)
    if CanSettings in kinds:
        raise typer.BadParameter(f"a {settings.kind.name} is on a CAN bus: --can CHANNEL", param_hint="--can")
    if tcp is not None:
        server = TcpServerLink(tcp)
        if ModbusSettings in kinds:
            from msdrivers.links.modbus import ModbusServerLink

            return ModbusServerLink(server)
        return server
    if SerialSettings not in kinds:
        raise typer.BadParameter(f"a {settings.kind.name} has no serial port: --tcp PORT", param_hint="--pty")
    return PtyLink(link=link)


def _field(text: str) -> Vector3:
    """Return the tesla of `X,Y,Z` in microtesla."""
    try:
        x, y, z = (float(part) * 1e-6 for part in text.split(","))
    except ValueError:
        raise typer.BadParameter(f"{shown(text, 40)} is not of the form X,Y,Z", param_hint="--iron") from None
    if not math.hypot(x, y, z) < 1e-3:
        raise typer.BadParameter("no unit works in a field above 1000 microtesla", param_hint="--iron")
    return (x, y, z)
