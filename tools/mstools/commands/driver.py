"""`modelserver driver`: publish the samples of a device; and the checks of a vehicle file's drivers."""

from __future__ import annotations

import contextlib
import logging
import signal
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from modelserver.errors import (
    ConfigError,
    ModelServerError,
    RecordingError,
    find_nearest_names,
    has_error,
    quote,
)
from modelserver.server.log import set_up_logging
from mstools.commands.run import LEVELS, FormatOption, check_log_options
from mstools.terminal.options import UrlOption, argument, option
from mstools.terminal.output import escape, print_problems

if TYPE_CHECKING:
    from modelserver.config.vehicle_file import VehicleConfig
    from modelserver.messages import Sample
    from modelserver.server.supervision.systemd import Notifier
    from msdrivers.links import Link
    from msdrivers.raw_log import TimeSource
    from msdrivers.registry import DeviceKind
    from msdrivers.runner import Runner
    from msdrivers.settings import DriverSettings
    from mstools.deployment.service_start import ServiceStart


def constraints_of(vehicle: VehicleConfig) -> tuple[str, ...] | None:
    """Return the constraints of a vehicle file's geometry; None if it cannot be read."""
    from modelserver.formats import examine_file

    try:
        return examine_file(vehicle.geometry, vehicle.variables).constraints
    except OSError:
        return None


COMMAND_POLL_S = 0.02
"""Poll period of a driver with commands, seconds."""


def command(
    name: Annotated[str, argument("[NAME]", "Name of the driver in the vehicle file.")] = "",
    config: Annotated[Path | None, option("--config -c FILE", "The vehicle file.")] = None,
    list_ports: Annotated[
        bool, option("--list", "List the ports and the drivers of the vehicle file, then exit.")
    ] = False,
    record_raw: Annotated[Path | None, option("--record-raw FILE", "Record the bytes of the connection.")] = None,
    record_limit: Annotated[float, option("--record-limit MB", "Largest size of the recording.", min=0.001)] = 1000.0,
    play_raw: Annotated[Path | None, option("--play-raw FILE", "Read a recording instead of the device.")] = None,
    url: UrlOption = "",
    log_level: Annotated[str, option("--log-level", f"One of {', '.join(LEVELS)}.")] = "info",
    log_format: FormatOption = "auto",
) -> None:
    """Run the driver of a device: publish its samples until SIGTERM or Ctrl-C.

    Connects, configures the device, stamps each sample with the time of its measurement, and reconnects when the
    device was away. Its status is on DRIVER_HEALTH once a second, and on stderr when it changes. Drivers are configured
    in the vehicle file, under `drivers`.

    \b
    Examples:
      modelserver driver --list
      modelserver driver gps -c config/raptor/vehicle.yaml
      modelserver driver imu -c vehicle.yaml --record-raw imu.raw
    """
    from modelserver.server.supervision.systemd import Notifier
    from mstools.deployment.service_start import ServiceStart

    check_log_options(log_level, log_format)
    if list_ports:
        show_ports()
        if config is not None:
            show_drivers(config)
        return
    if config is None:
        raise typer.BadParameter("give the vehicle file: -c vehicle.yaml", param_hint="--config")
    if record_raw is not None and play_raw is not None:
        raise typer.BadParameter("a replayed recording is not recorded again", param_hint="--record-raw")
    start = ServiceStart(config, Notifier.from_environment())
    with start.wait_on_error():
        vehicle, settings = load_driver(name, config)
    set_up_logging(log_level, log_format, f"modelserver-driver-{settings.name}")
    warn_of_names(vehicle, settings)
    with contextlib.ExitStack() as stack:
        link = _make_link(stack, settings, record_raw, round(record_limit * 1e6), play_raw)
        run(vehicle, settings, link, config.parent, url, start)


def show_ports() -> None:
    """Print the ports of this machine."""
    from msdrivers.links.can_bus import list_can_interfaces
    from msdrivers.links.serial_port import find_ports

    ports = find_ports()
    for port in ports:
        typer.echo(escape(f"{port.path:<16} {port.description}") + (f"\n    {escape(port.hint)}" if port.hint else ""))
    for network in list_can_interfaces():
        typer.echo(escape(f"{network:<16} CAN network interface"))
    show_plugins()
    if not ports:
        typer.echo("no serial port found: is the adapter plugged in? see dmesg for the kernel's messages")


def show_plugins() -> None:
    """Print the devices and measurements of installed packages, and why one of them cannot be used."""
    from modelserver.estimation.filter.measurements import MEASUREMENT_TYPES
    from msdrivers.registry import KINDS

    for name, kind in KINDS.plugins.items():
        typer.echo(escape(f"{name:<16} device of an installed package: {kind.description}"))
    for name, why in KINDS.problems.items():
        typer.echo(escape(f"{name:<16} device of an installed package, not usable: {why}"), err=True)
    for name, found in MEASUREMENT_TYPES.plugins.items():
        typer.echo(escape(f"{name:<16} measurement of an installed package: {'; '.join(found.values)}"))
    for name, why in MEASUREMENT_TYPES.problems.items():
        typer.echo(escape(f"{name:<16} measurement of an installed package, not usable: {why}"), err=True)


def show_drivers(config: Path) -> None:
    """Print the drivers of a vehicle file, and their problems as `modelserver check` does."""
    vehicle, drivers = load_drivers(config)
    for name, driver in drivers.items():
        typer.echo(escape(f"{name:<16} {driver.kind.name}: {driver.kind.description}; {driver.line}"))
    from mstools.deployment.diagnosis import find_driver_problems

    problems = find_driver_problems(vehicle, str(config), constraints_of(vehicle))
    print_problems(problems)
    if has_error(problems):
        raise typer.Exit(1)


def load_drivers(config: Path) -> tuple[VehicleConfig, dict[str, DriverSettings]]:
    """Return a vehicle file and its valid drivers. Raises ConfigError, OSError."""
    from modelserver.config.vehicle_file import load_config, read_config_lines
    from msdrivers.settings import SourceMap, read_drivers

    vehicle = load_config(config)
    drivers, _ = read_drivers(vehicle.drivers, SourceMap(str(config), read_config_lines(config)))
    return vehicle, drivers


def load_driver(
    name: str, config: Path, kinds: Mapping[str, DeviceKind] | None = None
) -> tuple[VehicleConfig, DriverSettings]:
    """Return a vehicle file and the settings of one of its drivers; `kinds` default to all device kinds.

    Raises ConfigError, OSError, ModelServerError.
    """
    from modelserver.config.vehicle_file import load_config, read_config_lines
    from msdrivers.registry import KINDS
    from msdrivers.settings import SourceMap, find_empty_sections, read_driver

    vehicle = load_config(config)
    place = SourceMap(str(config), read_config_lines(config))
    if name in vehicle.drivers:
        return vehicle, read_driver(name, vehicle.drivers[name], place, kinds or KINDS)
    if problem := find_empty_sections(vehicle.drivers, place).get(name):
        raise ConfigError([problem])
    if not vehicle.drivers:
        raise ModelServerError(f"{config} has no section drivers; see docs/vehicle-file.md")
    known = f"{config} has: {', '.join(vehicle.drivers)}"
    if not name:
        raise typer.BadParameter(f"the driver's name is missing; {known}", param_hint="NAME")
    near = find_nearest_names(name, vehicle.drivers)
    hint = f"did you mean {near[0]}? " if near else ""
    raise typer.BadParameter(f"{quote(name, 40)} is an unknown driver; {hint}{known}", param_hint="NAME")


def warn_of_names(vehicle: VehicleConfig, settings: DriverSettings) -> None:
    """Log the wheels and joints of a driver that the vehicle does not have: their samples are not used."""
    has_joints = any(hasattr(settings.device_settings, name) for name in ("joint", "joints"))
    constraints = constraints_of(vehicle) if has_joints else None
    from mstools.deployment.diagnosis import find_misnamed

    for problem in find_misnamed(vehicle, [settings], constraints):
        logging.getLogger(__name__).warning("%s: %s; %s", problem.source, problem.message, problem.fix)


def channels_of(vehicle: VehicleConfig, settings: DriverSettings) -> dict[type, str]:
    """Return the channels of a driver's samples by type: the driver's own, else those of the vehicle's sensors."""
    from modelserver.messages import GpsSample, ImuSample, VehicleStatusSample, WheelsSample

    sensors = vehicle.sensors
    subscribed = zip(
        (GpsSample, ImuSample, WheelsSample, VehicleStatusSample),
        (sensors.gps, sensors.imu, sensors.wheels, sensors.steering),
        strict=True,
    )
    channels: dict[type, str] = {kind: sensor.channel for kind, sensor in subscribed if sensor is not None}
    if settings.channel:
        channels[settings.kind.sample] = settings.channel
    return channels


def _make_link(
    stack: contextlib.ExitStack, settings: DriverSettings, record: Path | None, limit: int, play: Path | None
) -> Link[Any]:
    """Return the driver's connection, with a recorder, or a recording in its place."""
    from msdrivers.factory import make_codec, make_link
    from msdrivers.raw_log import RecordingLink, ReplayLink, open_for_reading, open_for_writing
    from msdrivers.runner import SystemTimeSource

    codec = make_codec(settings)
    if play is not None:
        reader = open_for_reading(play)
        stack.callback(reader.stream.close)
        if (reader.kind, reader.device) != (codec.name, settings.kind.name):
            found = f"{reader.kind} of a {reader.device} (driver {reader.source})"
            raise RecordingError(f"{play}: recording of {found}, but driver {settings.name} is a {settings.kind.name}")
        return ReplayLink(reader, codec.unpack, SystemTimeSource())
    link = make_link(settings)
    if record is None:
        return link
    writer = stack.enter_context(open_for_writing(record, limit))
    writer.begin(codec.name, settings.name, settings.kind.name)
    return RecordingLink(link, codec, writer, SystemTimeSource())


def run(
    vehicle: VehicleConfig, settings: DriverSettings, link: Link[Any], folder: Path, url: str, start: ServiceStart
) -> None:
    """Run a driver on a connection until SIGTERM or Ctrl-C. Raises ConfigError, OSError, BusError."""
    from modelserver.server.supervision.systemd import Notifier
    from modelserver.wire.provider import open_lcm, resolve_url
    from msdrivers.factory import make_driver
    from msdrivers.health import DriverPublisher
    from msdrivers.runner import Runner, RunnerSettings, SystemTimeSource

    kind = settings.kind
    with start.wait_on_error():
        if database := getattr(settings.device_settings, "dbc", ""):
            start.add_files(folder / Path(database).expanduser())
        station = make_driver(settings, folder)
    bus = open_lcm(resolve_url(url or vehicle.lcm.url))
    publisher = DriverPublisher(bus.publish, channels_of(vehicle, settings), vehicle.lcm.channel_prefix)
    options = RunnerSettings(settings.name, kind.name)
    if kind.command_channel:
        options = replace(options, poll_timeout=COMMAND_POLL_S)
    time_source = SystemTimeSource()
    publish: Callable[[Sample], object] = publisher.publish_sample
    corrections = None
    if settings.ntrip is not None:
        from msdrivers.corrections import CorrectionsClient

        corrections = CorrectionsClient(settings.ntrip, settings.name)
        publish = corrections.wrap_publish(publish)
    runner = Runner(station, link, options, time_source, publish, publisher.publish_health)
    attend: Callable[[], object] = lambda: None  # noqa: E731
    if kind.command_channel:
        attend = subscribe_commands(bus, vehicle, kind.command_channel, runner, time_source)
    if corrections is not None:
        attend = corrections.feed_runner(runner)
        corrections.start()
    stop_on_signal(runner)
    notifier = Notifier.from_environment()
    try:
        runner.run(DriverSupervision(runner, notifier).wrap_callback(attend))
    finally:
        notifier.notify_stopping()
        if corrections is not None:
            corrections.stop()


def stop_on_signal(runner: Runner[Any]) -> None:
    """Let SIGTERM and Ctrl-C end a runner."""
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: runner.stop())


def subscribe_commands(
    bus: Any, vehicle: VehicleConfig, channel: str, runner: Runner[Any], time_source: TimeSource
) -> Callable[[], object]:
    """Subscribe to a command channel; return the function that processes the received commands.

    Where commands must be signed, those on `channel` itself are rejected. Raises KeyFileError.
    """
    from modelserver.errors import WireError
    from modelserver.signing.key_files import read_keys
    from modelserver.wire.channels import DRIVE_SIGNED, to_subscription_pattern
    from modelserver.wire.codec import decode
    from modelserver.wire.provider import handle_message
    from msdrivers.signed_commands import COMMAND_TYPE, CommandDeniedError, DriveVerifier

    prefix, config = vehicle.lcm.channel_prefix, vehicle.commands
    plain = f"{prefix}{channel}"

    def handle(_: str, data: bytes) -> None:
        try:
            runner.send_command(decode(COMMAND_TYPE, data))
        except WireError as error:
            runner.reject_command(error.reason, f"a command on {plain} rejected: {error}")

    def reject_unsigned(_: str, data: bytes) -> None:
        text = (
            f"a command on {plain} rejected: it is not signed; use modelserver.VehicleCommander with the vehicle's key"
        )
        runner.reject_command("unsigned", text)

    if config.is_drive_signed:
        signed = f"{prefix}{DRIVE_SIGNED}"
        verifier = DriveVerifier(
            read_keys(config.key_file), prefix, channel, config.window_s, time_source.now().monotonic_ns
        )

        def verify(_: str, data: bytes) -> None:
            try:
                runner.send_command(verifier.verify(data, time_source.now()))
            except CommandDeniedError as error:
                runner.reject_command(error.reason, f"a command on {signed} rejected: {error}")

        bus.subscribe(to_subscription_pattern(signed), verify)
    bus.subscribe(to_subscription_pattern(plain), reject_unsigned if config.is_drive_signed else handle)

    def attend() -> None:
        while handle_message(bus):
            pass

    return attend


READY_PASSES = 2
"""A driver is ready after one complete pass: it has tried its connection and published its health."""


class DriverSupervision:
    """Notify systemd of one runner.

    A missing device does not stop readiness or watchdog: the driver waits for it and reports that. A pass that hangs
    and a driver with nothing but errors do.
    """

    def __init__(self, runner: Runner[Any], notifier: Notifier, monotonic_ns: Callable[[], int] = time.monotonic_ns):
        from modelserver.server.supervision.systemd import StallDetector

        self._runner, self._notifier, self._monotonic_ns = runner, notifier, monotonic_ns
        self._progress = StallDetector()
        self._passes = 0

    def wrap_callback(self, attend: Callable[[], object]) -> Callable[[], object]:
        """Return the callback before each pass: `attend`, then the due notifications."""
        if not self._notifier.is_active:
            return attend

        def on_pass() -> None:
            attend()
            self._notify()

        return on_pass

    def _notify(self) -> None:
        self._passes += 1
        if not self._notifier.is_ready:
            if self._passes >= READY_PASSES:
                self._notifier.notify_ready(self._format_status())
            return
        self._notifier.update_status(self._format_status)
        runner = self._runner
        failures = sum(count for name, count in runner.counts.items() if name.startswith("errors."))
        if self._progress.is_progressing(runner.samples, failures, self._monotonic_ns()):
            self._notifier.ping_watchdog()

    def _format_status(self) -> str:
        phase, text = self._runner.state
        return f"{phase.name.lower()}: {text}" if text else phase.name.lower()
