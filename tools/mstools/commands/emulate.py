"""`modelserver emulate`: an emulated device for its driver. It measures a simulated drive, or replays a log."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain, dropwhile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from modelserver.errors import ModelServerError, quote
from mstools.commands.driver import channels_of, load_driver, stop_on_signal
from mstools.terminal.options import argument, choose_name, option

if TYPE_CHECKING:
    from modelserver.config.vehicle_file import VehicleConfig
    from modelserver.messages import Sample
    from modelserver.transforms.so3 import Vector3
    from msdrivers.links import Link
    from msdrivers.settings import DriverSettings


log = logging.getLogger(__name__)

MAX_DRIVE_S = 3600.0
"""Default duration of a simulated drive, seconds."""

START_DELAY_US = 200_000
"""Time from now to the first sample, in which the driver connects."""

GPS_HZ = 4.0
"""Default rate of a receiver."""


@dataclass(frozen=True, slots=True)
class DriveOptions:
    """What to measure: an LCM log, or without one a simulated drive of `seconds`.

    start: its start, microseconds of UTC; None: now. own_field: hard iron, tesla along the sensor's axes.
    """

    log: Path | None
    start: int | None
    seconds: float
    scenario: str
    seed: int
    own_field: Vector3


def samples_of(vehicle: VehicleConfig, settings: DriverSettings, wanted: DriveOptions) -> Iterator[Sample]:
    """Return the samples that the emulator of a driver's device measures; their end is logged.

    Raises ModelServerError if there are none: a log without the channel, a drive that is already over.
    """
    kind, now = settings.kind, time.time_ns() // 1000
    start = now + START_DELAY_US if wanted.start is None else wanted.start
    if wanted.log is not None:
        samples, what = read_logged(wanted.log, vehicle, settings, start), str(wanted.log)
    elif not kind.follows_samples or (wanted.start is None and kind.command_channel):
        # without a drive it follows its commands
        return iter(())
    else:
        if start + round(wanted.seconds * 1e6) < now:
            ago = f"{(now - start) * 1e-6:.0f} s ago, and the drive lasts {wanted.seconds:g} s"
            raise ModelServerError(f"--start {wanted.start} is {ago}: it is over, so there are no samples")
        samples, what = simulate(vehicle, settings, start, wanted), "the simulated drive"
    if wanted.start is not None or wanted.log is None:
        # samples before now are skipped, also those of the time that making the drive took
        now = time.time_ns() // 1000
        samples = dropwhile(lambda sample: sample.header.utime < now, samples)
    if wanted.log is not None:
        # an error now, not after the driver has connected
        first = next(samples, None)
        if first is None:
            raise ModelServerError(f"--start {wanted.start} is so long ago that {what} is over: no samples are left")
        samples = chain((first,), samples)
    return log_end(samples, settings.name, what)


def log_end(samples: Iterator[Sample], name: str, what: str) -> Iterator[Sample]:
    """Yield samples, and log a warning at their end: the emulator continues without measurements."""
    yield from samples
    log.warning("%s: %s is over, there are no more measurements", name, what)


def read_logged(file: Path, vehicle: VehicleConfig, settings: DriverSettings, start_utime: int) -> Iterator[Sample]:
    """Yield the samples of a driver's channel in a log, with stamps shifted so that the first is at `start_utime`.

    Raises ModelServerError if there are none.
    """
    from modelserver.wire.channels import BY_NAME
    from modelserver.wire.codec import decode
    from modelserver.wire.eventlog import LogFile
    from msdrivers.registry import CHANNELS

    kind = settings.kind.sample
    channel = f"{vehicle.lcm.channel_prefix}{channels_of(vehicle, settings).get(kind) or CHANNELS[kind]}"
    shift = None
    with LogFile(file) as events:
        for event in events:
            if event.channel == channel:
                sample: Sample = decode(BY_NAME[CHANNELS[kind]].type_name, event.data)
                header = sample.header
                shift = start_utime - header.utime if shift is None else shift
                host = header.host_utime + shift if header.host_utime else 0
                yield replace(sample, header=replace(header, utime=header.utime + shift, host_utime=host))
    if shift is None:
        raise ModelServerError(f"{file} has no messages on {channel}; expected the driver's channel")


def simulate(
    vehicle: VehicleConfig, settings: DriverSettings, start_utime: int, wanted: DriveOptions
) -> Iterator[Sample]:
    """Return the samples of a driver's sensor on a simulated drive from `start_utime` on.

    A receiver measures at the rate of its driver's settings, wheels and the vehicle controller at 100 Hz. Steered
    wheels are those of the vehicle file and the driver's settings. Raises ModelServerError for a sensor without a
    section in the vehicle file.
    """
    from modelserver.messages import GpsSample, ImuSample, VehicleStatusSample, WheelsSample
    from modelserver.simulation import GpsModel, ImuModel, MagnetometerModel, Timing, WheelsModel
    from mstools.launch.drive import WHEELS_HZ, make_simulation

    sections = {GpsSample: "gps", ImuSample: "imu", WheelsSample: "wheels", VehicleStatusSample: "wheels"}
    sensors, kind = vehicle.sensors, settings.kind.sample
    if kind not in sections:
        # it follows its commands
        return iter(())
    if getattr(sensors, sections[kind]) is None:
        raise ModelServerError(
            f"the vehicle file has no section sensors.{sections[kind]}, which has the sensor's frame"
        )
    steered = sensors.steering.wheels if sensors.steering is not None else ()
    mapped = getattr(settings.device_settings, "wheels", {})
    wheels = [name for name, wheel in mapped.items() if wheel.is_steered or wheel.steering is not None]
    run = make_simulation(
        vehicle,
        start_utime,
        wanted.seconds,
        wanted.scenario,
        wanted.seed,
        (kind,),
        gps_model=GpsModel(Timing(getattr(settings.device_settings, "rate_hz", GPS_HZ))),
        imu_model=ImuModel(magnetometer=MagnetometerModel(hard_iron=wanted.own_field)),
        wheels_model=WheelsModel(Timing(WHEELS_HZ), steered=frozenset((*steered, *wheels))),
    )
    return (sample for sample in run.events(wanted.seconds) if isinstance(sample, kind))


SCENARIOS = ("eight", "circle", "stand", "straight", "city")


def command(
    name: Annotated[str, argument("NAME", "Name of the driver in the vehicle file.")],
    config: Annotated[Path, option("--config -c FILE", "The vehicle file.")],
    pty: Annotated[bool, option("--pty", "Create a pseudo-terminal and print its path.")] = False,
    link: Annotated[Path | None, option("--link PATH", "With --pty: create a symbolic link to it here.")] = None,
    tcp: Annotated[int | None, option("--tcp PORT", "Listen on loopback; 0: any port.", min=0, max=65535)] = None,
    can: Annotated[str, option("--can CHANNEL", "Connect to a CAN bus.")] = "",
    interface: Annotated[str, option("--interface NAME", "With --can: python-can's name. Default: the driver's.")] = "",
    log: Annotated[Path | None, option("--from LOG", "Replay the samples of an LCM log.")] = None,
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
    """Emulate a device: answer its driver, and measure a simulated drive or replay a log.

    Prints the line to put into the vehicle file, and speaks until SIGTERM, Ctrl-C or --seconds.

    \b
    Examples:
      modelserver emulate gps -c config/raptor/vehicle.yaml --pty --link /tmp/gps
      modelserver emulate imu -c vehicle.yaml --tcp 4001 --fault stall@10:2 --fault corrupt@15:3
      modelserver emulate wheels -c vehicle.yaml --can vcan0 --from drive.lcm
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
    if log is not None and not settings.kind.follows_samples:
        raise typer.BadParameter(
            f"device {settings.kind.name} follows its commands and cannot replay a log", param_hint="--from"
        )
    own_field = _parse_field(iron)
    line = _make_link(settings, link, tcp, can, interface)
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(name)s: %(message)s")
    samples = samples_of(vehicle, settings, DriveOptions(log, start, seconds or MAX_DRIVE_S, scenario, seed, own_field))

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


def _make_link(settings: DriverSettings, link: Path | None, tcp: int | None, can: str, interface: str) -> Link[Any]:
    """Return the device's end of the connection. Raises typer.BadParameter if its driver cannot open that."""
    from msdrivers.links import TcpServerLink
    from msdrivers.links.serial_port import PtyLink
    from msdrivers.registry import CanSettings, ModbusSettings, SerialSettings

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


def _parse_field(text: str) -> Vector3:
    """Parse `X,Y,Z` in microtesla; return tesla."""
    try:
        x, y, z = (float(part) * 1e-6 for part in text.split(","))
    except ValueError:
        raise typer.BadParameter(f"{quote(text, 40)} is not X,Y,Z", param_hint="--iron") from None
    if not math.hypot(x, y, z) < 1e-3:
        raise typer.BadParameter("expected a field below 1000 microtesla", param_hint="--iron")
    return (x, y, z)
