"""The daemon: puts a vehicle file together with the bus and serves until it is told to end."""

from __future__ import annotations

import gc
import logging
import signal
from dataclasses import dataclass
from pathlib import Path

from modelserver import core
from modelserver.config import VehicleConfig
from modelserver.core import CoreSettings, CoreState, Instant
from modelserver.errors import ConfigError, Problem, QueryError, Severity, Source
from modelserver.formats import load_model
from modelserver.geodesy import make_origin
from modelserver.geometry import Model
from modelserver.localization.mounts import Mounts
from modelserver.localization.raw import RawLocalizer
from modelserver.messages import Origin, OriginLatched
from modelserver.service.bus import LcmBus
from modelserver.service.clock import SystemClock
from modelserver.service.keep import OriginKeeper, default_directory
from modelserver.service.loop import Loop, LoopSettings
from modelserver.version import __version__
from modelserver.wire.provider import resolve_url

log = logging.getLogger(__name__)

HOUSEKEEPING_HZ = 50.0
"""Ticks in event mode: for requests that wait and for the health report."""


@dataclass(frozen=True, slots=True)
class Vehicle:
    """A vehicle file with its geometry loaded and everything in it checked against each other."""

    config: VehicleConfig
    model: Model
    mounts: Mounts | None

    def core(self, now: Instant, origin: Origin | None = None) -> CoreState:
        """Return the core's first state; `origin` is one kept from an earlier run, a configured one goes first."""
        config = self.config
        localizer = None
        if self.mounts is not None:
            localizer = RawLocalizer.start(self.mounts, config.localization, configured_origin(config) or origin)
        settings = CoreSettings(
            base_frame=config.base_frame,
            vehicle=config.vehicle,
            publish=config.publish.mode,
            health_period_ns=round(1e9 / config.publish.health_hz),
            history_s=config.limits.history_s,
            parked_requests=config.limits.parked_requests,
            wait_ms=config.limits.wait_ms,
            reply_prefix=config.lcm.reply_prefix,
        )
        return core.start(settings, self.model, localizer, now)

    def sensor_channels(self) -> dict[str, str]:
        """Return the wire type of each channel that sensors are heard on, with the prefix."""
        sensors = self.config.sensors
        named = ((sensors.gps, "gps_t"), (sensors.imu, "imu_t"), (sensors.wheels, "wheels_t"))
        prefix = self.config.lcm.channel_prefix
        return {f"{prefix}{each.channel}": type_name for each, type_name in named if each is not None}


def load_vehicle(config: VehicleConfig) -> Vehicle:
    """Load the geometry and check that it has every frame the vehicle file names.

    Raises GeometryError, ConfigError, OSError.
    """
    model = load_model(config.geometry, variables=config.variables)
    problems = []
    gps, imu = config.sensors.gps, config.sensors.imu
    named = [("base_frame", config.base_frame)]
    named += [(f"sensors.{key}.frame", each.frame) for key, each in (("gps", gps), ("imu", imu)) if each is not None]
    if config.sensors.wheels is not None:
        named += [(f"sensors.wheels.frames.{name}", frame) for name, frame in config.sensors.wheels.frames.items()]
    for key, frame in named:
        try:
            model.get_transformation(frame, config.base_frame)
        except QueryError as error:
            fix = f"write {error.nearest[0]}" if error.nearest else f"see: modelserver bodies --model {config.geometry}"
            problems.append(Problem(Severity.ERROR, str(error), Source(element=key), fix, error.nearest))
    if problems:
        raise ConfigError(problems)
    mounts = None
    if gps is not None and imu is not None:
        mounts = Mounts.from_model(model, config.base_frame, gps.frame, imu.frame)
    return Vehicle(config, model, mounts)


def configured_origin(config: VehicleConfig) -> Origin | None:
    """Return the origin that the vehicle file gives, None where it is to be captured."""
    origin = config.origin
    if origin.initial_utm is None or origin.zone is None:
        return None
    return make_origin(*origin.initial_utm, zone=origin.zone, north=origin.hemisphere == "north")


def run(vehicle: Vehicle, url: str = "") -> None:
    """Serve a vehicle until SIGTERM or SIGINT. Raises BusError where the bus cannot be joined."""
    config = vehicle.config
    clock = SystemClock()
    keeper = None
    if config.origin.keep and config.origin.initial_utm is None:
        directory = Path(config.state_directory) if config.state_directory else default_directory()
        keeper = OriginKeeper(directory, config.vehicle)
    origin = keeper.load() if keeper else None

    def keep(note: OriginLatched) -> None:
        if keeper is not None:
            keeper.save(note.origin)

    bus = LcmBus(resolve_url(url or config.lcm.url))
    rate_hz = config.publish.rate_hz if config.publish.mode == "timer" else HOUSEKEEPING_HZ
    settings = LoopSettings(
        period_ns=round(1e9 / rate_hz),
        sensors=vehicle.sensor_channels(),
        channel_prefix=config.lcm.channel_prefix,
        queued_requests=config.limits.queued_requests,
        requests_per_pass=config.limits.requests_per_pass,
    )
    loop = Loop(bus, clock, vehicle.core(clock.now(), origin), settings, keep)
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: loop.stop())
    log.info(
        "modelserver %s serves %s (%s) on %s; publishing %s",
        __version__,
        config.vehicle,
        vehicle.model,
        bus.url,
        f"at {rate_hz:g} Hz" if config.publish.mode == "timer" else "on every sensor event",
    )
    if origin is not None:
        log.info("the origin kept from an earlier run is used: %s", origin)
    # what is loaded lives as long as the process: the collector need not look at it again
    gc.collect()
    gc.freeze()
    loop.run()
    log.info("ended")
