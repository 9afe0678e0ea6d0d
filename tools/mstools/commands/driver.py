"""`modelserver driver`: a device onto the bus."""

from __future__ import annotations

import contextlib
import logging
import signal
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from modelserver.errors import ConfigError, ModelServerError, RecordingError, Severity, nearest_names, shown
from modelserver.service.log_format import set_up
from mstools.commands.asking import UrlOption
from mstools.commands.run import LEVELS, FormatOption, check_log
from mstools.terminal.output import print_problem, safe

if TYPE_CHECKING:
    from modelserver.config import VehicleConfig
    from msdrivers.links import Link
    from msdrivers.registry import DeviceKind
    from msdrivers.settings import DriverSettings
    from mstools.deployment.refusal import Start

COMMANDS_LOOK_S = 0.02
"""How often a driver that takes commands looks for them."""


def command(
    name: Annotated[str, typer.Argument(metavar="[NAME]", help="Name of the driver in the vehicle file.")] = "",
    config: Annotated[Path | None, typer.Option("--config", "-c", metavar="FILE", help="The vehicle file.")] = None,
    list_ports: Annotated[
        bool, typer.Option("--list", help="List the ports found, and the drivers of the vehicle file; then end.")
    ] = False,
    record_raw: Annotated[
        Path | None, typer.Option("--record-raw", metavar="FILE", help="Keep what comes and goes on the line.")
    ] = None,
    record_limit: Annotated[
        float, typer.Option("--record-limit", metavar="MB", min=0.001, help="Largest recording; then it ends.")
    ] = 1000.0,
    play_raw: Annotated[
        Path | None, typer.Option("--play-raw", metavar="FILE", help="Take a recording in place of the device.")
    ] = None,
    hard_iron: Annotated[
        bool, typer.Option("--hard-iron", help="Turn the vehicle: find its own magnetic field, store it, then end.")
    ] = False,
    seconds: Annotated[
        float, typer.Option("--seconds", metavar="N", min=1.0, help="With --hard-iron: how long to turn it.")
    ] = 60.0,
    all_axes: Annotated[
        bool, typer.Option("--all-axes", help="With --hard-iron: it is turned about all axes, not on level ground.")
    ] = False,
    url: UrlOption = "",
    log_level: Annotated[str, typer.Option("--log-level", help=f"One of {', '.join(LEVELS)}.")] = "info",
    log_format: FormatOption = "auto",
) -> None:
    """Read a device and publish what it measures, until SIGTERM or Ctrl-C.

    Connects, sets the device up, stamps each sample with the instant of its measurement, and connects again when the
    device has been away. How it goes is on DRIVER_HEALTH once a second, and on stderr when it changes. What drivers
    there are stands in the vehicle file, under `drivers`.

    \b
    Examples:
      modelserver driver --list
      modelserver driver gps -c config/raptor/vehicle.yaml
      modelserver driver imu -c vehicle.yaml --record-raw imu.raw
      modelserver driver imu -c vehicle.yaml --hard-iron --seconds 90
    """
    from modelserver.service.supervision.notify import Notifier
    from mstools.deployment.refusal import Start

    check_log(log_level, log_format)
    if list_ports:
        show_ports()
        if config is not None:
            show_drivers(config)
        return
    if config is None:
        raise typer.BadParameter("give the vehicle file: -c vehicle.yaml", param_hint="--config")
    if record_raw is not None and play_raw is not None:
        raise typer.BadParameter("a recording that is played is not recorded again", param_hint="--record-raw")
    if all_axes and not hard_iron:
        raise typer.BadParameter("belongs to --hard-iron, which is not given", param_hint="--all-axes")
    start = Start(config, Notifier.of_environment())
    with start.patient():
        vehicle, settings = load_driver(name, config)
    if hard_iron and not settings.kind.hard_iron:
        raise typer.BadParameter(f"a {settings.kind.name} has no such procedure", param_hint="--hard-iron")
    set_up(log_level, log_format, f"modelserver-driver-{settings.name}")
    warn_of_names(vehicle, settings)
    with contextlib.ExitStack() as stack:
        link = _line(stack, settings, record_raw, round(record_limit * 1e6), play_raw)
        if hard_iron:
            from mstools.calibration.hard_iron import run_hard_iron

            run_hard_iron(settings, link, seconds, all_axes)
            return
        run(vehicle, settings, link, config.parent, url, start)


def show_ports() -> None:
    """Print the ports of this machine."""
    from msdrivers.links.can_bus import can_networks
    from msdrivers.links.ports import found_ports

    ports = found_ports()
    for port in ports:
        typer.echo(safe(f"{port.path:<16} {port.what}") + (f"\n    {safe(port.hint)}" if port.hint else ""))
    for network in can_networks():
        typer.echo(safe(f"{network:<16} CAN network interface"))
    if not ports:
        typer.echo("no serial port found: is the adapter plugged in? dmesg says what the kernel made of it")


def show_drivers(config: Path) -> None:
    """Print the drivers of a vehicle file, and what is wrong with them, as `modelserver check` does."""
    from mstools.commands.check_drivers import constraints_of, drivers_problems

    vehicle, drivers = load_drivers(config)
    for name, driver in drivers.items():
        typer.echo(safe(f"{name:<16} {driver.kind.name}: {driver.kind.about}; {driver.line}"))
    problems = drivers_problems(vehicle, str(config), constraints_of(vehicle))
    for problem in problems:
        print_problem(problem, err=True)
    if any(problem.severity is Severity.ERROR for problem in problems):
        raise typer.Exit(1)


def load_drivers(config: Path) -> tuple[VehicleConfig, dict[str, DriverSettings]]:
    """Return a vehicle file and its drivers, without those of which something is wrong. Raises ConfigError, OSError."""
    from modelserver.config import config_lines, load_config
    from msdrivers.settings import Place, read_drivers

    vehicle = load_config(config)
    drivers, _ = read_drivers(vehicle.drivers, Place(str(config), config_lines(config)))
    return vehicle, drivers


def load_driver(
    name: str, config: Path, kinds: Mapping[str, DeviceKind] | None = None
) -> tuple[VehicleConfig, DriverSettings]:
    """Return a vehicle file and the settings of one of its drivers, of these kinds, else of all that are known here.

    Raises ConfigError, OSError, ModelServerError.
    """
    from modelserver.config import config_lines, load_config
    from msdrivers.registry import KINDS
    from msdrivers.settings import Place, empty_section, empty_sections, read_driver

    vehicle = load_config(config)
    place = Place(str(config), config_lines(config))
    if name in vehicle.drivers:
        return vehicle, read_driver(name, vehicle.drivers[name], place, kinds or KINDS)
    if name in empty_sections(vehicle.drivers, place):
        raise ConfigError([empty_section(name, place)])
    if not vehicle.drivers:
        raise ModelServerError(f"{config} names no drivers; write a section drivers: see docs/vehicle-file.md")
    known = f"{config} has: {', '.join(vehicle.drivers)}"
    if not name:
        raise typer.BadParameter(f"name the driver; {known}", param_hint="NAME")
    near = nearest_names(name, vehicle.drivers)
    hint = f"did you mean {near[0]}? " if near else ""
    raise typer.BadParameter(f"{shown(name, 40)} is no driver; {hint}{known}", param_hint="NAME")


def warn_of_names(vehicle: VehicleConfig, settings: DriverSettings) -> None:
    """Log the names of a driver's wheels and joints that the vehicle does not have: what has them is lost."""
    from mstools.commands.check_drivers import constraints_of, misnamed

    constraints = constraints_of(vehicle) if hasattr(settings.station, "joint") else None
    for problem in misnamed(vehicle, [settings], constraints):
        logging.getLogger(__name__).warning("%s: %s; %s", problem.source, problem.message, problem.fix)


def channels_of(vehicle: VehicleConfig, settings: DriverSettings) -> dict[type, str]:
    """Return on which channels a driver's samples go out: the driver's own, else those that the service hears."""
    from modelserver.messages import GpsSample, ImuSample, VehicleStatusSample, WheelsSample

    sensors = vehicle.sensors
    subscribed = (
        (GpsSample, sensors.gps),
        (ImuSample, sensors.imu),
        (WheelsSample, sensors.wheels),
        (VehicleStatusSample, sensors.steering),
    )
    channels: dict[type, str] = {kind: sensor.channel for kind, sensor in subscribed if sensor is not None}
    if settings.channel:
        channels[settings.kind.sample] = settings.channel
    return channels


def _line(
    stack: contextlib.ExitStack, settings: DriverSettings, record: Path | None, limit: int, play: Path | None
) -> Link[Any]:
    """Return the driver's line, recorded, or a recording in its place."""
    from msdrivers.lines import form_of, link_of
    from msdrivers.links.recorded import PlayedLink, RecordingLink
    from msdrivers.raw_log import open_for_reading, recording
    from msdrivers.runner import SystemTime

    form = form_of(settings)
    if play is not None:
        reader = open_for_reading(play)
        stack.callback(reader.stream.close)
        if (reader.kind, reader.device) != (form.name, settings.kind.name):
            said = f"{reader.kind} of a {reader.device} (driver {reader.source})"
            raise RecordingError(f"{play} holds {said}, and driver {settings.name} reads a {settings.kind.name}")
        return PlayedLink(reader, form.unpack, SystemTime())
    link = link_of(settings)
    if record is None:
        return link
    writer = stack.enter_context(recording(record, limit))
    writer.begin(form.name, settings.name, settings.kind.name)
    return RecordingLink(link, form, writer, SystemTime())


def run(
    vehicle: VehicleConfig, settings: DriverSettings, link: Link[Any], folder: Path, url: str, start: Start
) -> None:
    """Run a driver on a line until it is told to end. Raises ConfigError, OSError, BusError."""
    from modelserver.service.supervision.notify import Notifier
    from modelserver.wire.provider import open_lcm, resolve_url
    from msdrivers.making import station_of
    from msdrivers.publishing import Publisher
    from msdrivers.runner import Runner, RunnerSettings, SystemTime
    from mstools.commands.driver_supervised import DriverSupervision

    kind = settings.kind
    with start.patient():
        if database := getattr(settings.station, "dbc", ""):
            start.needs(folder / Path(database).expanduser())
        station = station_of(settings, folder)
    bus = open_lcm(resolve_url(url or vehicle.lcm.url))
    publisher = Publisher(bus.publish, channels_of(vehicle, settings), vehicle.lcm.channel_prefix)
    how = RunnerSettings(settings.name, kind.name)
    if kind.commands:
        how = replace(how, look=COMMANDS_LOOK_S)
    runner = Runner(station, link, how, SystemTime(), publisher.sample, publisher.health)
    attend: Callable[[], object] = lambda: None  # noqa: E731
    if kind.commands:
        attend = _hear_commands(bus, f"{vehicle.lcm.channel_prefix}{kind.commands}", runner)
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: runner.stop())
    supervision = DriverSupervision(runner, Notifier.of_environment())
    with supervision.ending():
        runner.run(supervision.attending(attend))


def _hear_commands(bus: Any, channel: str, runner: Any) -> Callable[[], object]:
    """Return what takes the commands that have come on a channel."""
    from modelserver.errors import WireError
    from modelserver.wire.channels import literal
    from modelserver.wire.codec import decode
    from modelserver.wire.provider import take_message

    def handle(_: str, data: bytes) -> None:
        try:
            wish = decode("vehicle_command_t", data)
        except WireError as error:
            runner.refuse(error.reason, f"a command on {channel} refused: {error}")
            return
        runner.command(wish)

    bus.subscribe(literal(channel), handle)

    def attend() -> None:
        while take_message(bus):
            pass

    return attend
