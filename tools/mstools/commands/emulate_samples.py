"""What an emulated device measures: a simulated drive, or what a log says was measured."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain, dropwhile
from pathlib import Path
from typing import TYPE_CHECKING

from modelserver.errors import ModelServerError
from mstools.commands.driver import channels_of

if TYPE_CHECKING:
    from modelserver.config import VehicleConfig
    from modelserver.messages import Sample
    from modelserver.spatial.so3 import Vector3
    from msdrivers.settings import DriverSettings

log = logging.getLogger(__name__)

LONGEST_S = 3600.0
"""Of a simulated drive, where no other length is asked for."""

LEAD_US = 200_000
"""From now to the first sample: what it takes to open the line."""

GPS_HZ = 4.0
"""Where the driver's settings say nothing of a rate."""


@dataclass(frozen=True, slots=True)
class Wanted:
    """What is to be measured: an LCM log, or without one a simulated drive of `seconds`.

    start: when it begins, microseconds of UTC; None: at once. own_field: as in `simulated`.
    """

    log: Path | None
    start: int | None
    seconds: float
    scenario: str
    seed: int
    own_field: Vector3


def samples_of(vehicle: VehicleConfig, settings: DriverSettings, wanted: Wanted) -> Iterator[Sample]:
    """Return what the emulator of a driver's device measures; its end is told in the log.

    Raises ModelServerError where that is nothing: a log without the channel, a drive that was over before now.
    """
    kind, now = settings.kind, time.time_ns() // 1000
    start = now + LEAD_US if wanted.start is None else wanted.start
    if wanted.log is not None:
        samples, what = logged(wanted.log, vehicle, settings, start), str(wanted.log)
    elif not kind.follows or (wanted.start is None and kind.commands):
        # alone it does as it is commanded
        return iter(())
    else:
        if start + round(wanted.seconds * 1e6) < now:
            ago = f"{(now - start) * 1e-6:.0f} s ago, and the drive lasts {wanted.seconds:g} s"
            raise ModelServerError(f"--start {wanted.start} is {ago}: it is over, and nothing would be measured")
        samples, what = (
            simulated(vehicle, settings, start, wanted.seconds, wanted.scenario, wanted.seed, wanted.own_field),
            "the simulated drive",
        )
    if wanted.start is not None or wanted.log is None:
        # who comes late to a drive that has begun, and be it by making the drive, does not catch up
        now = time.time_ns() // 1000
        samples = dropwhile(lambda sample: sample.header.utime < now, samples)
    if wanted.log is not None:
        # now, and not when the line is open, it is told that there is nothing
        first = next(samples, None)
        if first is None:
            raise ModelServerError(f"--start {wanted.start} is so long ago that {what} is over: nothing is left of it")
        samples = chain((first,), samples)
    return told_end(samples, settings.name, what)


def told_end(samples: Iterator[Sample], name: str, what: str) -> Iterator[Sample]:
    """Yield samples, and say so when there are no more: the emulator speaks on, but measures nothing."""
    yield from samples
    log.warning("%s: %s is over, nothing more is measured", name, what)


def logged(file: Path, vehicle: VehicleConfig, settings: DriverSettings, start_utime: int) -> Iterator[Sample]:
    """Yield the samples of a driver's channel in a log, their stamps moved so that the first is at `start_utime`.

    Raises ModelServerError where the log has none of that channel.
    """
    from modelserver.wire.channels import BY_NAME
    from modelserver.wire.codec import decode
    from modelserver.wire.eventlog import LogFile
    from msdrivers.registry import CHANNELS

    kind = settings.kind.sample
    channel = f"{vehicle.lcm.channel_prefix}{channels_of(vehicle, settings).get(kind) or CHANNELS[kind]}"
    type_name = BY_NAME[CHANNELS[kind]].type_name
    shift = None
    with LogFile(file) as events:
        for event in events:
            if event.channel != channel:
                continue
            sample: Sample = decode(type_name, event.data)
            header = sample.header
            shift = start_utime - header.utime if shift is None else shift
            host = header.host_utime + shift if header.host_utime else 0
            yield replace(sample, header=replace(header, utime=header.utime + shift, host_utime=host))
    if shift is None:
        raise ModelServerError(f"{file} has nothing on {channel}; modelserver spy, or --channel of the recording")


def simulated(
    vehicle: VehicleConfig,
    settings: DriverSettings,
    start_utime: int,
    seconds: float,
    scenario: str,
    seed: int,
    own_field: Vector3 = (0.0, 0.0, 0.0),
) -> Iterator[Sample]:
    """Return what the sensor of a driver measures on a simulated drive that begins at `start_utime`.

    `own_field`: what the vehicle adds to the earth's magnetic field, tesla along the sensor's axes. A receiver measures
    at the rate of its driver's settings, wheels and the vehicle controller at 100 Hz. The wheels steer that the vehicle
    file or the driver's settings say steer. Raises ModelServerError for a sensor that has no place.
    """
    from modelserver.messages import GpsSample, ImuSample, VehicleStatusSample, WheelsSample
    from modelserver.simulation import GpsModel, ImuModel, MagnetometerModel, Timing, WheelsModel
    from mstools.demo.drive import WHEELS_HZ, simulation

    sensors = vehicle.sensors
    needed = {
        GpsSample: (GpsSample, "gps", sensors.gps),
        ImuSample: (ImuSample, "imu", sensors.imu),
        WheelsSample: (WheelsSample, "wheels", sensors.wheels),
        VehicleStatusSample: (VehicleStatusSample, "wheels", sensors.wheels),
    }
    if settings.kind.sample not in needed:
        # it does as it is commanded
        return iter(())
    kind, name, sensor = needed[settings.kind.sample]
    if sensor is None:
        raise ModelServerError(f"the vehicle file says nothing of sensors.{name}: where is the sensor?")
    steered = sensors.steering.wheels if sensors.steering is not None else ()
    mapped = getattr(settings.station, "wheels", {})
    wheels = [name for name, wheel in mapped.items() if wheel.steers or wheel.steering is not None]
    run = simulation(
        vehicle,
        start_utime,
        seconds,
        scenario,
        seed,
        (kind,),
        gps_model=GpsModel(Timing(getattr(settings.station, "rate_hz", GPS_HZ))),
        imu_model=ImuModel(magnetometer=MagnetometerModel(hard_iron=own_field)),
        wheels_model=WheelsModel(Timing(WHEELS_HZ), steered=frozenset((*steered, *wheels))),
    )
    return (sample for sample in run.events(seconds) if isinstance(sample, kind))
