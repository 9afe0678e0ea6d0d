"""`modelserver run`: the daemon; `driver`: publish the samples of a device; `emulate`: the device itself."""

from __future__ import annotations

import logging
import math
import signal
import time
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

import typer

from modelserver.errors import (
    ConfigError,
    GeometryError,
    Location,
    ModelServerError,
    Problem,
    Severity,
    find_nearest_names,
    quote,
)
from modelserver.server.log import FORMATS, set_up_logging
from modelserver.server.supervision import FAILED_START_S, Notifier
from mstools.terminal.options import UrlOption, argument, choose_name, complete_driver, option
from mstools.terminal.output import escape, print_problems

if TYPE_CHECKING:
    from modelserver.config.vehicle_file import VehicleConfig
    from modelserver.messages import Sample
    from modelserver.transforms.so3 import Vector3
    from msdrivers.endpoint import TimeSource
    from msdrivers.links import Link
    from msdrivers.runner import Runner
    from msdrivers.settings import DriverSettings


LEVELS = ("debug", "info", "warning", "error")

FormatOption: TypeAlias = Annotated[
    str, option("--log-format", f"One of {', '.join(FORMATS)}; auto: journal where systemd reads the log.")
]


def run(
    config: Annotated[Path, option("--config -c FILE", "The vehicle file.")],
    url: UrlOption = "",
    log_level: Annotated[str, option("--log-level", f"One of {', '.join(LEVELS)}.")] = "info",
    log_format: FormatOption = "auto",
) -> None:
    """Run the service for a vehicle file, until SIGTERM or Ctrl-C.

    Loads the geometry, subscribes to the sensors, publishes POSE and answers requests. Does not start with a wrong
    vehicle file or geometry, and reports all problems; under a service manager, which would restart it at once, it then
    exits after 10 s. Logs go to stderr. SIGHUP reloads the geometry file:
    the whole file is used, or, if it is wrong, nothing changes and the log has the reason.

    Example: modelserver run -c config/raptor/vehicle.yaml
    """
    check_log_options(log_level, log_format)
    from modelserver.config.vehicle_file import load_config
    from modelserver.server import daemon
    from modelserver.server.vehicle import load_vehicle

    set_up_logging(log_level, log_format)
    notifier = Notifier.from_environment()
    notifier.notify_starting(f"reading {config}")
    with wait_on_error(config, notifier):
        settings = load_config(config)
        vehicle = load_vehicle(settings, str(config))
        vehicle.make_command_verifier(0, str(config))
    for problem in vehicle.model.problems:
        level = logging.INFO if problem.severity is Severity.NOTE else logging.WARNING
        logging.getLogger("modelserver").log(level, "%s", problem)
    daemon.run(vehicle, url, str(config), notifier)


def check_log_options(level: str, log_format: str) -> None:
    """Raise typer.BadParameter, a usage error, for an unknown level or format of the log."""
    for name, given, known in (("--log-level", level, LEVELS), ("--log-format", log_format, FORMATS)):
        if given not in known:
            raise typer.BadParameter(f"{given!r} is not one of {', '.join(known)}", param_hint=name)


@contextmanager
def wait_on_error(config: Path, notifier: Notifier) -> Iterator[None]:
    """Run the block, the start of a service; where its files are wrong, report that and wait before the process exits.

    Without a service manager errors propagate. With one they are printed at once, the first is its status, and the
    process exits with the same code, after `FAILED_START_S`.
    """
    if not notifier.is_active:
        yield
        return
    code, problems = 1, tuple[Problem, ...]()
    try:
        yield
        return
    except (ConfigError, GeometryError) as error:
        text, problems = "", error.problems
    except OSError as error:
        if error.filename is None or Path(error.filename) != config:
            raise
        text = f"the vehicle file cannot be read: {error.strerror}"
    except typer.BadParameter as error:
        text, code = error.message, error.exit_code
    except ModelServerError as error:
        text = str(error)
    problems = problems or (Problem(Severity.ERROR, text, Location(str(config))),)
    print_problems(problems)
    # also extends the start timeout of systemd
    notifier.notify_starting(format_status(problems))
    time.sleep(FAILED_START_S)
    raise typer.Exit(code)


def format_status(problems: Iterable[Problem]) -> str:
    """Return the problems in one line: the first error, and the number of others."""
    errors = [problem for problem in problems if problem.severity is Severity.ERROR]
    first = errors[0] if errors else None
    place = f"{first.file}:{first.line}: " if first is not None and first.line else ""
    more = f" (and {len(errors) - 1} more)" if len(errors) > 1 else ""
    message = first.message if first is not None else "the vehicle file or its geometry is wrong"
    return f"start failed, waiting for the file to be fixed: {place}{message}{more}"


# --- drivers


def find_driver_problems(vehicle: VehicleConfig, file: str, constraints: Collection[str] | None) -> tuple[Problem, ...]:
    """Return every problem of the drivers of a vehicle file that is visible without their devices.

    `constraints` are those of its geometry; None if unknown.
    """
    from modelserver.config.vehicle_file import read_config_lines

    lines = read_config_lines(file)
    if not any(path[:1] == ("drivers",) for path in lines):
        return ()
    # imported here: a vehicle file without drivers needs none of their libraries
    from msdrivers.settings import (
        SourceMap,
        find_backward_counters,
        find_shared_lines,
        find_unbuildable_drivers,
        find_unknown_joint,
        find_unknown_wheels,
        read_drivers,
    )

    found, problems = read_drivers(vehicle.drivers, SourceMap(file, lines))
    drivers, wheels = found.values(), vehicle.sensors.wheels
    misnamed: list[Problem] = []
    for driver in drivers:
        misnamed += find_backward_counters(driver)
        # the server does not receive a driver on another channel
        if wheels is not None and driver.channel in ("", wheels.channel):
            misnamed += find_unknown_wheels(driver, wheels.frames)
        if constraints is not None:
            misnamed += find_unknown_joint(driver, constraints)
    return (*problems, *find_unbuildable_drivers(drivers, Path(file).parent), *find_shared_lines(drivers), *misnamed)


COMMAND_POLL_S = 0.02
"""Poll period of a driver with commands, seconds."""


def command(
    name: Annotated[
        str, argument("[NAME]", "Name of the driver in the vehicle file.", autocompletion=complete_driver)
    ] = "",
    config: Annotated[Path | None, option("--config -c FILE", "The vehicle file.")] = None,
    list_ports: Annotated[bool, option("--list", "List the ports, then exit.")] = False,
    record_raw: Annotated[Path | None, option("--record-raw FILE", "Record the bytes of the connection.")] = None,
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

    check_log_options(log_level, log_format)
    if list_ports:
        show_ports()
        return
    if config is None:
        raise typer.BadParameter("give the vehicle file: -c vehicle.yaml", param_hint="--config")
    if record_raw is not None and play_raw is not None:
        raise typer.BadParameter("a replayed recording is not recorded again", param_hint="--record-raw")
    with wait_on_error(config, Notifier.from_environment()):
        vehicle, settings = load_driver(name, config)
    set_up_logging(log_level, log_format)
    with ExitStack() as stack:
        link = _make_link(stack, settings, record_raw, play_raw)
        run_driver(vehicle, settings, link, config, url)


def show_ports() -> None:
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


def load_drivers(config: Path) -> tuple[VehicleConfig, dict[str, DriverSettings]]:
    """Return a vehicle file and its valid drivers. Raises ConfigError, OSError."""
    from modelserver.config.vehicle_file import load_config, read_config_lines
    from msdrivers.settings import SourceMap, read_drivers

    vehicle = load_config(config)
    drivers, _ = read_drivers(vehicle.drivers, SourceMap(str(config), read_config_lines(config)))
    return vehicle, drivers


def load_driver(name: str, config: Path) -> tuple[VehicleConfig, DriverSettings]:
    """Return a vehicle file and the settings of one of its drivers.

    Raises ConfigError, OSError, ModelServerError.
    """
    from modelserver.config.vehicle_file import load_config, read_config_lines
    from msdrivers.settings import SourceMap, find_empty_sections, read_driver

    vehicle = load_config(config)
    place = SourceMap(str(config), read_config_lines(config))
    if name in vehicle.drivers:
        return vehicle, read_driver(name, vehicle.drivers[name], place)
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


def _make_link(stack: ExitStack, settings: DriverSettings, record: Path | None, play: Path | None) -> Link[Any]:
    """Return the driver's connection, with a recorder, or a recording in its place."""
    from msdrivers.raw_log import RecordingLink, ReplayLink, open_for_reading, open_for_writing
    from msdrivers.registry import SerialSettings, TcpSettings
    from msdrivers.runner import SystemTimeSource
    from msdrivers.settings import make_link

    names = settings.name, settings.kind.name
    if play is not None:
        return ReplayLink(stack.enter_context(open_for_reading(play, *names)), str(play), SystemTimeSource())
    link = make_link(settings)
    if record is None:
        return link
    if not isinstance(settings.line, SerialSettings | TcpSettings):
        raise typer.BadParameter("only bytes are recorded; a bus by candump or tcpdump", param_hint="--record-raw")
    return RecordingLink(link, stack.enter_context(open_for_writing(record)), *names, SystemTimeSource())


def run_driver(vehicle: VehicleConfig, settings: DriverSettings, link: Link[Any], config: Path, url: str) -> None:
    """Run a driver on a connection until SIGTERM or Ctrl-C. Raises ConfigError, OSError, BusError."""
    from modelserver.wire.provider import open_lcm, resolve_url
    from msdrivers.runner import DriverPublisher, Runner, RunnerSettings, SystemTimeSource
    from msdrivers.settings import make_driver

    kind, notifier = settings.kind, Notifier.from_environment()
    with wait_on_error(config, notifier):
        station = make_driver(settings, config.parent)
    bus = open_lcm(resolve_url(url or vehicle.lcm.url))
    publisher = DriverPublisher(bus.publish, channels_of(vehicle, settings), vehicle.lcm.channel_prefix)
    options = RunnerSettings(settings.name, kind.name)
    if kind.command_channel:
        options = replace(options, poll_timeout=COMMAND_POLL_S)
    time_source = SystemTimeSource()
    corrections = None
    if settings.ntrip is not None:
        from msdrivers.corrections import CorrectionsClient

        corrections = CorrectionsClient(settings.ntrip, settings.name)

    def publish(sample: Sample) -> None:
        if corrections is not None:
            corrections.note_place(sample)
        publisher.publish_sample(sample)

    runner = Runner(station, link, options, time_source, publish, publisher.publish_health)
    attend: Callable[[], object] = lambda: None  # noqa: E731
    if kind.command_channel:
        attend = subscribe_commands(bus, vehicle, kind.command_channel, runner, time_source)
    if corrections is not None:
        attend = corrections.feed_runner(runner)
        corrections.start()
    stop_on_signal(runner)
    try:
        runner.run(supervise(runner, notifier, attend))
    finally:
        notifier.notify_stopping()
        if corrections is not None:
            corrections.stop()


def stop_on_signal(runner: Runner[Any]) -> None:
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: runner.stop())


def subscribe_commands(
    bus: Any, vehicle: VehicleConfig, channel: str, runner: Runner[Any], time_source: TimeSource
) -> Callable[[], object]:
    """Subscribe to a command channel; return the function that processes the received commands.

    Where commands must be signed, those on `channel` itself are rejected. Raises KeyFileError.
    """
    from modelserver.errors import WireError
    from modelserver.key_files import read_keys
    from modelserver.wire.channels import DRIVE_SIGNED, to_subscription_pattern
    from modelserver.wire.codec import decode
    from modelserver.wire.provider import handle_message
    from msdrivers.runner import COMMAND_TYPE, CommandDeniedError, DriveVerifier

    prefix, config = vehicle.lcm.channel_prefix, vehicle.commands
    plain = f"{prefix}{channel}"

    def handle(channel: str, read: Callable[[bytes], Any]) -> None:
        """Subscribe to a channel: its commands are sent as they are read, or rejected."""

        def send(_: str, data: bytes) -> None:
            try:
                runner.send_command(read(data))
            except (WireError, CommandDeniedError) as error:
                runner.reject_command(error.reason, f"a command on {channel} rejected: {error}")

        bus.subscribe(to_subscription_pattern(channel), send)

    def reject_unsigned(_: bytes) -> None:
        text = "it is not signed; use modelserver.VehicleCommander with the vehicle's key"
        raise CommandDeniedError("unsigned", text)

    if config.is_drive_signed:
        now = time_source.now().monotonic_ns
        verifier = DriveVerifier(read_keys(config.key_file), prefix, channel, config.window_s, now)
        handle(f"{prefix}{DRIVE_SIGNED}", lambda data: verifier.verify(data, time_source.now()))
        handle(plain, reject_unsigned)
    else:
        handle(plain, partial(decode, COMMAND_TYPE))

    def attend() -> None:
        while handle_message(bus):
            pass

    return attend


READY_PASSES = 2
"""A driver is ready after one complete pass: it has tried its connection and published its health."""


def supervise(
    runner: Runner[Any],
    notifier: Notifier,
    attend: Callable[[], object],
    monotonic_ns: Callable[[], int] = time.monotonic_ns,
) -> Callable[[], object]:
    """Return the callback before each pass of a runner: `attend`, then the due notifications of systemd.

    A missing device does not stop readiness or watchdog: the driver waits for it and reports that. A pass that hangs
    and a driver with nothing but errors do.
    """
    if not notifier.is_active:
        return attend
    from modelserver.server.supervision import StallDetector

    progress, passes = StallDetector(), count(1)

    def describe_phase() -> str:
        phase, text = runner.state
        return f"{phase.name.lower()}: {text}" if text else phase.name.lower()

    def on_pass() -> None:
        attend()
        if not notifier.is_ready:
            if next(passes) >= READY_PASSES:
                notifier.notify_ready(describe_phase())
            return
        notifier.update_status(describe_phase)
        failures = sum(number for name, number in runner.counts.items() if name.startswith("errors."))
        if progress.is_progressing(runner.samples, failures, monotonic_ns()):
            notifier.ping_watchdog()

    return on_pass


log = logging.getLogger(__name__)

MAX_DRIVE_S = 3600.0
"""Default duration of a simulated drive, seconds."""

START_DELAY_US = 200_000
"""Time from now to the first sample, in which the driver connects."""

GPS_HZ = 4.0
"""Default rate of a receiver."""


def simulate(
    vehicle: VehicleConfig,
    settings: DriverSettings,
    start: int | None = None,
    seconds: float = MAX_DRIVE_S,
    scenario: str = "eight",
    seed: int = 1,
    own_field: Vector3 = (0.0, 0.0, 0.0),
) -> Iterator[Sample]:
    """Return the samples that the emulator of a driver's device measures in a drive; their end is logged.

    The drive starts at `start`, microseconds of UTC, None for now; `own_field` is hard iron, tesla along the sensor's
    axes. A receiver measures at the rate of its driver's settings, wheels and the vehicle controller at 100 Hz. Steered
    wheels are those of the vehicle file and the driver's settings. Raises ModelServerError for a drive that is already
    over, and a sensor without a section in the vehicle file.
    """
    from modelserver.messages import GpsSample, ImuSample, VehicleStatusSample, WheelsSample
    from modelserver.simulation import GpsModel, ImuModel, MagnetometerModel, Timing, WheelsModel
    from mstools.launch.drive import WHEELS_HZ, make_simulation

    now = time.time_ns() // 1000
    begin = now + START_DELAY_US if start is None else start
    sections = {GpsSample: "gps", ImuSample: "imu", WheelsSample: "wheels", VehicleStatusSample: "wheels"}
    sensors, kind = vehicle.sensors, settings.kind.sample
    follows_commands = not settings.kind.follows_samples or (start is None and settings.kind.command_channel)
    if follows_commands or kind not in sections:
        return
    if begin + round(seconds * 1e6) < now:
        ago = f"{(now - begin) * 1e-6:.0f} s ago, and the drive lasts {seconds:g} s"
        raise ModelServerError(f"--start {start} is {ago}: it is over, so there are no samples")
    if getattr(sensors, sections[kind]) is None:
        raise ModelServerError(
            f"the vehicle file has no section sensors.{sections[kind]}, which has the sensor's frame"
        )
    steered = sensors.steering.wheels if sensors.steering is not None else ()
    mapped = getattr(settings.device_settings, "wheels", {})
    wheels = [name for name, wheel in mapped.items() if wheel.is_steered or wheel.steering is not None]
    drive = make_simulation(
        vehicle,
        begin,
        seconds,
        scenario,
        seed,
        (kind,),
        gps_model=GpsModel(Timing(getattr(settings.device_settings, "rate_hz", GPS_HZ))),
        imu_model=ImuModel(magnetometer=MagnetometerModel(hard_iron=own_field)),
        wheels_model=WheelsModel(Timing(WHEELS_HZ), steered=frozenset((*steered, *wheels))),
    )
    # samples before now are skipped, also those of the time that making the drive took
    now = time.time_ns() // 1000
    for sample in drive.events(seconds):
        if isinstance(sample, kind) and sample.header.utime >= now:
            yield sample
    log.warning("%s: the simulated drive is over, there are no more measurements", settings.name)


SCENARIOS = ("eight", "circle", "stand", "straight", "city")


def emulate(
    name: Annotated[str, argument("NAME", "Name of the driver in the vehicle file.", autocompletion=complete_driver)],
    config: Annotated[Path, option("--config -c FILE", "The vehicle file.")],
    pty: Annotated[bool, option("--pty", "Create a pseudo-terminal and print its path.")] = False,
    link: Annotated[Path | None, option("--link PATH", "With --pty: create a symbolic link to it here.")] = None,
    tcp: Annotated[int | None, option("--tcp PORT", "Listen on loopback; 0: any port.", min=0, max=65535)] = None,
    can: Annotated[str, option("--can CHANNEL", "Connect to a CAN bus.")] = "",
    scenario: Annotated[str, option("--scenario NAME", f"The simulated drive: {', '.join(SCENARIOS)}.")] = SCENARIOS[0],
    faults: Annotated[
        list[str] | None,
        option("--fault KIND@SECONDS[:AMOUNT]", "drop, corrupt, stall, restart, jump; more by device."),
    ] = None,
    iron: Annotated[str, option("--iron X,Y,Z", "Hard iron at an IMU, microtesla.")] = "0,0,0",
    seconds: Annotated[float | None, option("--seconds N", "Exit after this time. Default: never.", min=0.1)] = None,
    seed: Annotated[int, option("--seed N", "Seed of the simulation's noise.")] = 1,
    start: Annotated[
        int | None,
        option(
            "--start UTIME",
            "When the drive begins, microseconds of UTC: devices that are given one instant are on one vehicle, "
            "and its controller is driven and not commanded. Default: now.",
            min=0,
        ),
    ] = None,
) -> None:
    """Emulate a device: answer its driver, and measure a simulated drive.

    Prints the line to put into the vehicle file, and speaks until SIGTERM, Ctrl-C or --seconds.

    \b
    Examples:
      modelserver emulate gps -c config/raptor/vehicle.yaml --pty --link /tmp/gps
      modelserver emulate imu -c vehicle.yaml --tcp 4001 --fault stall@10:2 --fault corrupt@15:3
      modelserver emulate wheels -c vehicle.yaml --can vcan0 --scenario city
    """
    from msdrivers.emulate import parse_fault

    choose_name(scenario, SCENARIOS, "scenario", "--scenario")
    if (pty, tcp is not None, bool(can)).count(True) != 1:
        raise typer.BadParameter("give one of --pty, --tcp PORT and --can CHANNEL", param_hint="--pty")
    if link is not None and not pty:
        raise typer.BadParameter("a link goes with --pty", param_hint="--link")
    vehicle, settings = load_driver(name, config)
    try:
        wanted = tuple(parse_fault(text, settings.kind.faults) for text in faults or ())
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="--fault") from None
    own_field = _parse_field(iron)
    line = _make_device_link(settings, link, tcp, can)
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(name)s: %(message)s")
    samples = simulate(vehicle, settings, start, seconds or MAX_DRIVE_S, scenario, seed, own_field)

    from msdrivers.runner import Runner, RunnerSettings, SystemTimeSource
    from msdrivers.settings import make_emulator

    station = make_emulator(settings, config.parent, samples, wanted)
    options = RunnerSettings(name, f"emulated {settings.kind.name}", silence=math.inf, reopen_timeout=math.inf)
    line.open()
    typer.echo(f"{name} ({settings.kind.name}) is on {line.description}")
    runner = Runner(station, line, options, SystemTimeSource())
    stop_on_signal(runner)
    end = math.inf if seconds is None else time.monotonic() + seconds

    runner.run(lambda: runner.stop() if time.monotonic() >= end else None)


def _make_device_link(settings: DriverSettings, link: Path | None, tcp: int | None, can: str) -> Link[Any]:
    from msdrivers.links import TcpServerLink
    from msdrivers.links.serial_port import PtyLink
    from msdrivers.registry import CanSettings, ModbusSettings, SerialSettings

    kinds = settings.kind.lines
    if can:
        if CanSettings not in kinds:
            raise typer.BadParameter(f"a {settings.kind.name} is not on a CAN bus", param_hint="--can")
        from msdrivers.links.can_bus import CanLink

        given = settings.line.interface if isinstance(settings.line, CanSettings) else ""
        return CanLink(can, given)
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


def _parse_field(text: str) -> Vector3:
    """Parse `X,Y,Z` in microtesla; return tesla."""
    try:
        x, y, z = (float(part) * 1e-6 for part in text.split(","))
    except ValueError:
        raise typer.BadParameter(f"{quote(text, 40)} is not X,Y,Z", param_hint="--iron") from None
    if not math.hypot(x, y, z) < 1e-3:
        raise typer.BadParameter("expected a field below 1000 microtesla", param_hint="--iron")
    return (x, y, z)
