"""The daemon: puts a vehicle file together with the bus and serves until it is told to end."""

from __future__ import annotations

import gc
import logging
import math
import os
import signal
import socket
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from modelserver import core
from modelserver.config import (
    MAKE_KEY,
    GpsConfig,
    JointsConfig,
    SensorConfig,
    SteeringConfig,
    VehicleConfig,
    WheelsConfig,
    with_lines,
)
from modelserver.core import CoreSettings, CoreState, ExpectedSensor, Instant
from modelserver.core.reload import ModelLoaded
from modelserver.earth.geodesy import GeodesyError, make_origin
from modelserver.errors import (
    ConfigError,
    GeometryError,
    KeyFileError,
    Location,
    Problem,
    QueryError,
    Severity,
    Suggested,
    shown,
)
from modelserver.formats import Examined, examine_file
from modelserver.formats.snapshot import ModelSnapshot, written
from modelserver.geometry import Model
from modelserver.geometry.parts import meant_frame
from modelserver.keys import read_keys
from modelserver.localization.findings import find_unusable
from modelserver.localization.mounts import Mounts
from modelserver.localization.rig import Rig, SteeringSignal
from modelserver.messages import (
    AbsolutePoseSample,
    GpsSample,
    ImuSample,
    JointsSample,
    LoadModel,
    Mode,
    Origin,
    OriginLatched,
    RangeSample,
    Recalled,
    RelativePoseSample,
    Sample,
    SensorFinding,
    SwitchMode,
    VehicleStatusSample,
    WheelsSample,
)
from modelserver.service.bus import LcmBus
from modelserver.service.clock import SystemClock
from modelserver.service.gauges import read_gauges, read_run_delay
from modelserver.service.heard import SensorChannel
from modelserver.service.hooks import Hooks
from modelserver.service.journal.place import make_writer
from modelserver.service.journal.queue import NoJournal
from modelserver.service.keeping.store import SUBJECT as RESTART
from modelserver.service.keeping.store import Store, open_store
from modelserver.service.loop import Loop, LoopSettings
from modelserver.service.probing.rivals import Rivals
from modelserver.service.probing.start import probe, tell
from modelserver.service.requests.gate import Gate
from modelserver.service.supervision.notify import Notifier
from modelserver.service.supervision.supervised import Supervision
from modelserver.signing import Key
from modelserver.version import __version__
from modelserver.wire.channels import CHANNELS, ChannelUse
from modelserver.wire.provider import resolve_url

if TYPE_CHECKING:
    from modelserver.localization.modes import Makings

log = logging.getLogger(__name__)

NEVER = 1 << 30
"""Threshold of a generation that the garbage collector leaves alone."""

HOUSEKEEPING_HZ = 50.0
"""The least rate of ticks: for requests that wait, the health report and the order to stop."""

MODE_CHANNEL = "LOCALIZATION_MODE"
"""The customary channel for wishes about localization's mode."""

AIDING_SAMPLES: Mapping[str, type[Sample]] = {
    "absolute_pose": AbsolutePoseSample,
    "relative_pose": RelativePoseSample,
    "range": RangeSample,
}
"""What a further source's messages become, by the type that the vehicle file gives it."""


@dataclass(frozen=True, slots=True)
class Vehicle:
    """A vehicle file with its geometry loaded and everything in it checked against each other.

    `rig` is None for a vehicle without any sensor that localization could use, `mounts` for one without GPS or IMU.
    """

    config: VehicleConfig
    model: Model
    mounts: Mounts | None
    rig: Rig | None = None

    def core(self, now: Instant, origin: Origin | None = None, recalled: Recalled | None = None) -> CoreState:
        """Return the core's first state; `origin` is one kept from an earlier run, a configured one goes first.

        `recalled` is what else is known of the run before; None: nothing is, and nothing is said about it.
        """
        config = self.config
        localizer = None
        said = ""
        makings = self.makings()
        if makings is not None:
            from modelserver.localization.filter.keeping import opened
            from modelserver.localization.modes import ModeLocalizer

            origin = configured_origin(config) or origin
            mode = config.localization.first_mode
            recalled, said = opened(recalled, config.vehicle, makings.setup, mode)
            localizer = ModeLocalizer.start(makings, mode, origin, recalled)
        settings = CoreSettings(
            base_frame=config.base_frame,
            rolling_frame=config.rolling_frame,
            vehicle=config.vehicle,
            publish=config.publish.mode,
            ticks_per_pose=self.ticks_per_pose(),
            ticks_per_state=self.ticks_per_state(),
            publish_decisions=config.publish.decisions,
            health_period_ns=round(1e9 / config.publish.health_hz),
            history_s=config.limits.history_s,
            parked_requests=config.limits.parked_requests,
            wait_ms=config.limits.wait_ms,
            reply_prefix=config.lcm.reply_prefix,
            snapshot_period_ns=round(config.publish.snapshot_s * 1e9),
            may_reload=config.commands.reload,
            may_set_pose=config.commands.set_pose,
            keep_period_ns=round(config.restart.period_s * 1e9) if config.restart.keep else 0,
            sensors=self.expected(),
        )
        state = core.start(settings, self.model, localizer, now)
        return state._replace(notices={core.START: said}) if said else state

    def makings(self) -> Makings | None:
        """Return what the localizers are made of, None for a vehicle without a sensor to localize by."""
        if self.rig is None:
            return None
        from modelserver.localization.filter.setup import Setup
        from modelserver.localization.modes import Makings

        return Makings(Setup(self.rig, self.config.localization.filter), self.config.localization.raw, self.mounts)

    def unusable(self) -> tuple[SensorFinding, ...]:
        """Return the configured sensors that localization cannot use in the mode it starts in, and why."""
        return () if self.rig is None else find_unusable(self.rig, self.config.localization.first_mode)

    def keys(self, file: str = "") -> tuple[Key, ...]:
        """Return the vehicle's keys, none where it has no key file. Raises ConfigError where that cannot be used."""
        path = self.config.commands.key_file
        try:
            return read_keys(path) if path else ()
        except KeyFileError as error:
            problem = Problem(Severity.ERROR, str(error), Location(file, element="commands.key_file"))
            raise ConfigError(with_lines([problem], file)) from None

    def gate(self, started_ns: int, file: str = "") -> Gate:
        """Return what opens signed commands. Raises ConfigError where the key file cannot be used."""
        config = self.config
        keys = self.keys(file)
        mode_channel = config.localization.mode_channel
        return Gate(keys, config.lcm.channel_prefix, config.commands.window_s, mode_channel, started_ns)

    def snapshot(self, state: CoreState) -> bytes:
        """Return the bytes of the snapshot of the model in force."""
        view = state.view
        return written(
            ModelSnapshot(
                self.config.vehicle,
                view.model,
                view.base_frame,
                view.rolling_frame,
                self.config.limits.history_s,
                f"{self.config.lcm.channel_prefix}{self.config.sensors.joints.channel}",
                round(self.config.sensors.joints.latency * 1e6),
            )
        )

    def reloaded(self, wish: LoadModel, state: CoreState, file: str = "") -> ModelLoaded:
        """Return what comes of reading the geometry file anew: all of it suits this vehicle, or nothing changes."""
        try:
            vehicle = load_vehicle(self.config, file)
        except (GeometryError, ConfigError) as error:
            return ModelLoaded(wish.request, why=str(error))
        except Exception as error:
            log.exception("reading the geometry anew failed")
            return ModelLoaded(wish.request, why=f"an error of the server's own while reading it: {error}")
        lost = orphaned(vehicle.model) - orphaned(state.model)
        if lost:
            why = (
                f"nothing joins {', '.join(sorted(lost))} to the root any more: is the file still being written? Write "
                "it aside and rename it. To use it all the same start the service anew"
            )
            return ModelLoaded(wish.request, why=why)
        localizer, makings = state.localizer, vehicle.makings()
        if makings is not None:
            from modelserver.localization.modes import ModeLocalizer

            if isinstance(localizer, ModeLocalizer):
                localizer = localizer.remade(makings)
        return ModelLoaded(wish.request, vehicle.model, localizer)

    def ticks_per_pose(self) -> int:
        """Return how many ticks there are to a POSE in timer mode: more than one where POSE comes seldom."""
        publish = self.config.publish
        return math.ceil(HOUSEKEEPING_HZ / publish.rate_hz) if publish.mode == "timer" else 1

    def tick_hz(self) -> float:
        """Return the rate of ticks: a whole multiple of that of POSE."""
        publish = self.config.publish
        return publish.rate_hz * self.ticks_per_pose() if publish.mode == "timer" else HOUSEKEEPING_HZ

    def ticks_per_state(self) -> int:
        """Return how many ticks there are to a report of the filter's state, 0 where none is wanted."""
        state_hz = self.config.publish.state_hz
        return max(1, round(self.tick_hz() / state_hz)) if state_hz else 0

    def expected(self) -> tuple[ExpectedSensor, ...]:
        """Return the sensors that the vehicle file names, with the channels they are to be heard on."""
        prefix, sensors = self.config.lcm.channel_prefix, self.config.sensors
        named: list[
            tuple[GpsConfig | SensorConfig | WheelsConfig | SteeringConfig | JointsConfig | None, type[Sample]]
        ] = [
            (sensors.gps, GpsSample),
            (sensors.imu, ImuSample),
            (sensors.wheels, WheelsSample),
            (sensors.steering, VehicleStatusSample),
            (sensors.joints, JointsSample),
        ]
        return (
            *(ExpectedSensor(f"{prefix}{each.channel}", kind) for each, kind in named if each is not None),
            *(
                ExpectedSensor(f"{prefix}{each.channel}", AIDING_SAMPLES[each.type], name)
                for name, each in sensors.aiding.items()
            ),
        )

    def sensor_channels(self, model: Model | None = None) -> dict[str, SensorChannel]:
        """Return what is heard on each channel that localization listens to, with the prefix.

        Those are the sensors' channels, that of joints where the geometry has any (`model`, by default the one that was
        loaded), and the one for wishes about its mode where the vehicle file names one.
        """
        model = model or self.model
        prefix = self.config.lcm.channel_prefix
        sensors = self.config.sensors
        heard = {
            f"{prefix}{each.channel}": SensorChannel(type_name, round(each.latency * 1e6))
            for each, type_name in (
                (sensors.gps, "gps_t"),
                (sensors.imu, "imu_t"),
                (sensors.wheels, "wheels_t"),
                (sensors.steering, "vehicle_status_t"),
                (sensors.joints if model.joints else None, "joints_t"),
                *((each, f"{each.type}_t") for each in sensors.aiding.values()),
            )
            if each is not None
        }
        if self.config.localization.mode_channel:
            heard[f"{prefix}{self.config.localization.mode_channel}"] = SensorChannel("localization_mode_t")
        return heard


def orphaned(model: Model) -> frozenset[str]:
    """Return the bodies that no constraints join to the root."""
    return frozenset(name for assembly in model.assemblies[1:] for name in assembly)


def load_vehicle(config: VehicleConfig, file: str = "", strict: bool = False) -> Vehicle:
    """Load the geometry and check that it has every frame the vehicle file names.

    `file` is the vehicle file's path, for the problems; with `strict` a frame has one constraint at most. Raises
    GeometryError, ConfigError, OSError.
    """
    geometry, problems = examine_vehicle(config, file, strict)
    model = geometry.model
    if model is None and geometry.problems:
        raise GeometryError(geometry.problems)
    if model is None or problems:
        raise ConfigError(problems)
    mounts = None
    gps, imu = config.sensors.gps, config.sensors.imu
    if gps is not None and imu is not None:
        mounts = Mounts.from_model(model, config.rolling_frame or config.base_frame, gps.frame, imu.frame)
    return Vehicle(config, model, mounts, _rig(config, model))


def examine_vehicle(
    config: VehicleConfig, file: str = "", strict: bool = False
) -> tuple[Examined, tuple[Problem, ...]]:
    """Return the geometry with its problems, and those of the vehicle file: all that can be found at once.

    What does not depend on the geometry is examined without it, and frames are looked up among the bodies that a
    geometry with errors states. An empty name of a geometry or of a base frame is one that the vehicle file lacks.
    """
    geometry = Examined()
    problems: list[Problem] = []
    if config.geometry:
        try:
            geometry = examine_file(config.geometry, config.variables, strict=strict)
        except OSError as error:
            why = f"the geometry file {config.geometry} cannot be read: {error.strerror}"
            problems.append(Problem(Severity.ERROR, why, Location(file, element="geometry")))
    if geometry.stated is not None:
        problems += _frame_problems(config, geometry.stated, file, is_whole=geometry.model is not None)
    gps, imu = config.sensors.gps, config.sensors.imu
    if config.localization.mode == "raw" and (gps is None or imu is None):
        why = "raw mode takes a GPS and an IMU, and sensors does not name both"
        problems.append(Problem(Severity.ERROR, why, Location(file, element="localization.mode"), "write mode: full"))
    problems += _channel_problems(config, file)
    if config.localization.mode_channel and not config.commands.key_file:
        why = f"wishes about the mode are heard signed alone: {MAKE_KEY}"
        problems.append(Problem(Severity.ERROR, why, Location(file, element="localization.mode_channel")))
    try:
        configured_origin(config)
    except GeodesyError as error:
        problems.append(Problem(Severity.ERROR, str(error), Location(file, element="origin.initial_utm")))
    return geometry, tuple(with_lines(problems, file))


def _frame_problems(config: VehicleConfig, model: Model, file: str, is_whole: bool) -> list[Problem]:
    """Return what is wrong with the frames that the vehicle file names; `model` has constraints where `is_whole`."""
    gps, imu = config.sensors.gps, config.sensors.imu
    named = [("base_frame", config.base_frame), ("rolling_frame", config.rolling_frame)]
    named += [(f"sensors.{key}.frame", each.frame) for key, each in (("gps", gps), ("imu", imu)) if each is not None]
    named += [("sensors.gps.second_frame", gps.second_frame)] if gps is not None else []
    if config.sensors.wheels is not None:
        named += [(f"sensors.wheels.frames.{name}", frame) for name, frame in config.sensors.wheels.frames.items()]
    problems: list[Problem] = []
    unknown: set[str] = set()
    for key, frame in named:
        if not frame and key in ("base_frame", "rolling_frame", "sensors.gps.second_frame"):
            continue
        try:
            model.frame(frame)
        except QueryError as error:
            unknown.add(frame)
            near = Suggested.of(frame, meant_frame(frame, {body.name: body for body in model.bodies}))
            fix = f"write {near[0]}" if near else f"see: modelserver bodies --model {config.geometry}"
            problems.append(Problem(Severity.ERROR, str(error), Location(file, element=key), fix, near))
    if not is_whole or not config.base_frame or config.base_frame in unknown:
        return problems
    body = config.rolling_frame or config.base_frame
    for key, frame in named:
        if not frame or frame in unknown:
            continue
        try:
            model.get_transformation(frame, config.base_frame)
            legs = () if body in unknown else model.route(frame, body).legs
        except QueryError as error:
            fix = f"see: modelserver bodies --model {config.geometry}"
            problems.append(Problem(Severity.ERROR, str(error), Location(file, element=key), fix))
            continue
        if legs:
            why = f"joint {legs[0].name} moves {frame} against the vehicle; localization needs it bolted on"
            fix = "name a frame of the vehicle's own body, or make the constraint fixed"
            problems.append(Problem(Severity.ERROR, why, Location(file, element=key), fix))
    return problems


def _rig(config: VehicleConfig, model: Model) -> Rig | None:
    """Return the vehicle's frames as the filter needs them, None where it names nothing to localize by."""
    gps, imu, wheels = config.sensors.gps, config.sensors.imu, config.sensors.wheels
    if gps is None and imu is None and wheels is None:
        return None
    return Rig(
        model,
        config.rolling_frame or config.base_frame,
        imu.frame if imu is not None else "",
        gps.frame if gps is not None else "",
        gps.second_frame if gps is not None else "",
        wheels.frames if wheels is not None else {},
        wheels.kinematics if wheels is not None else "differential",
        config.localization.magnetometer,
        _steering_signal(wheels),
        wheels is not None,
    )


def _steering_signal(wheels: WheelsConfig | None) -> SteeringSignal | None:
    if wheels is None or wheels.steering is None:
        return None
    steering = wheels.steering
    return SteeringSignal(steering.wheels, steering.geometry, steering.sigma, steering.limit, steering.max_age)


def _channel_problems(config: VehicleConfig, file: str) -> list[Problem]:
    """Return what is wrong with the channels taken together."""
    prefix, reply_prefix = config.lcm.channel_prefix, config.lcm.reply_prefix
    sensors = config.sensors
    heard = {
        f"sensors.{key}.channel": f"{prefix}{each.channel}"
        for key, each in (
            ("gps", sensors.gps),
            ("imu", sensors.imu),
            ("wheels", sensors.wheels),
            ("wheels.steering", sensors.steering),
            ("joints", sensors.joints),
            *((f"aiding.{name}", each) for name, each in sensors.aiding.items()),
        )
        if each is not None
    }
    own = {f"{prefix}{channel.name}" for channel in CHANNELS}
    not_for_sensors = {f"{prefix}{channel.name}" for channel in CHANNELS if channel.way is not ChannelUse.SENSOR}
    problems = [
        Problem(
            Severity.ERROR,
            f"{channel} is a channel that the service itself uses, no sensor's",
            Location(file, element=key),
            "give the sensor another channel",
        )
        for key, channel in heard.items()
        if channel in not_for_sensors
    ]
    if config.localization.mode_channel:
        channel = f"{prefix}{config.localization.mode_channel}"
        if channel in heard.values() or (channel in own and channel != f"{prefix}{MODE_CHANNEL}"):
            problems.append(
                Problem(
                    Severity.ERROR,
                    f"{channel} is used for something else, so no wishes about the mode can be heard on it",
                    Location(file, element="localization.mode_channel"),
                    f"write {MODE_CHANNEL}",
                )
            )
        heard["localization.mode_channel"] = channel
    spoken_on = sorted(name for name in own | set(heard.values()) if name.startswith(reply_prefix))
    if spoken_on:
        problems.append(
            Problem(
                Severity.ERROR,
                f"with the reply prefix {reply_prefix} a request could make the server speak on {spoken_on[0]}",
                Location(file, element="lcm.reply_prefix"),
                "choose one that no other channel begins with, e.g. REPLY_",
            )
        )
    return problems


def configured_origin(config: VehicleConfig) -> Origin | None:
    """Return the origin that the vehicle file gives, None where it is to be captured."""
    origin = config.origin
    if origin.initial_utm is None or origin.zone is None:
        return None
    return make_origin(*origin.initial_utm, zone=origin.zone, north=origin.hemisphere == "north")


def log_wish(wish: SwitchMode, before: CoreState, after: CoreState) -> None:
    """Log what became of a wish for another mode."""
    was, now, source = _mode(before), _mode(after), shown(wish.header.source)
    if now is not wish.mode:
        kept = "none" if now is None else now.name.lower()
        log.warning("%s wishes mode %s, and it stays %s", source, wish.mode.name.lower(), kept)
    elif was is not now:
        log.info(
            "mode %s, as %s wishes (was %s)", now.name.lower(), source, "none" if was is None else was.name.lower()
        )


def _mode(state: CoreState) -> Mode | None:
    from modelserver.localization.filter.localizer import FilterLocalizer
    from modelserver.localization.modes import ModeLocalizer

    if not isinstance(state.localizer, ModeLocalizer):
        return None
    active = state.localizer.active
    return active.mode if isinstance(active, FilterLocalizer) else Mode.RAW


def run(vehicle: Vehicle, url: str = "", file: str = "", notifier: Notifier | None = None) -> None:
    """Serve a vehicle until SIGTERM or SIGINT; SIGHUP has its geometry read anew. `file` is the vehicle file.

    `notifier` tells a service manager. Raises BusError where the bus cannot be joined, or does not deliver.
    """
    notifier = notifier or Notifier.of_environment()
    notifier.starting("joining the bus")
    store = open_store(vehicle.config, localizes=vehicle.rig is not None)
    try:
        _serve(vehicle, store, notifier, url, file)
    finally:
        store.close()
    log.info("ended")


def _restrict_collector() -> None:
    """Restrict the garbage collector to what was made since its last run.

    Values are immutable and hold no cycles: serving, reloads and malformed messages leave none behind
    (tests/unit/service/test_garbage.py). A collection of all generations would find nothing and stop the loop for 40 ms
    once the history is full, one of the middle generation for 4 ms.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(gc.get_threshold()[0], NEVER, NEVER)


def _serve(vehicle: Vehicle, store: Store, notifier: Notifier, url: str, file: str) -> None:
    config = vehicle.config
    clock = SystemClock()
    keeper, states, restart = store.origin, store.state, config.restart
    origin = keeper.load() if keeper else None
    recalled = states.recall(clock.now(), restart.max_pose_age_s, restart.max_age_s) if states else None

    def keep(note: OriginLatched) -> None:
        if keeper is not None:
            keeper.save(note.origin)

    gate = vehicle.gate(clock.monotonic_ns(), file)
    bus = LcmBus(resolve_url(url or config.lcm.url))
    notifier.starting("probing the bus")
    findings = probe(bus.url)
    settings = LoopSettings(
        period_ns=round(1e9 / vehicle.tick_hz()),
        sensors=vehicle.sensor_channels(),
        channel_prefix=config.lcm.channel_prefix,
        queued_requests=config.limits.queued_requests,
        requests_per_pass=config.limits.requests_per_pass,
        client_hz=config.limits.client_hz,
        request_share=config.limits.request_share,
        client_reply_bytes=config.limits.client_reply_bytes,
        second_writer=config.sensors.second_writer,
        shared=frozenset({f"{config.lcm.channel_prefix}{config.sensors.joints.channel}"}),
    )
    supervision = Supervision(notifier, clock, lambda channel: loop.hears(channel))
    journal = make_writer(config, file, clock, store.lock, next(iter(vehicle.keys(file)), None))
    loop = Loop(
        bus,
        clock,
        vehicle.core(clock.now(), origin, recalled),
        settings,
        Hooks(
            on_origin=keep,
            on_wish=log_wish,
            on_load=supervision.loading(lambda wish, state: vehicle.reloaded(wish, state, file)),
            snapshot=vehicle.snapshot,
            channels=lambda state: vehicle.sensor_channels(state.model),
            on_keep=states.keep if states is not None else lambda kept: "",
            gauges=read_gauges,
            run_delay=read_run_delay,
            on_tick=supervision.ticked,
            gate=gate,
            journal=NoJournal() if journal is None else journal[0],
        ),
    )
    tell(findings, loop.notice)
    if store.trouble:
        loop.notice(RESTART, store.trouble)
    Rivals(socket.gethostname(), os.getpid(), loop.notice, clock).watch(bus.requests, config.lcm.channel_prefix)
    signal.signal(signal.SIGHUP, lambda *_: loop.reload())
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: loop.stop())
    log.info(
        "modelserver %s serves %s (%s) on %s; publishing %s",
        __version__,
        config.vehicle,
        vehicle.model,
        bus.url,
        f"at {config.publish.rate_hz:g} Hz" if config.publish.mode == "timer" else "on every sensor event",
    )
    if vehicle.rig is None:
        log.warning("the vehicle file names no sensor to localize by: there is no POSE")
    if origin is not None and keeper is not None:
        log.info(
            "the origin of an earlier run is used: %s (remove it to set a new one): %.3f E %.3f N %.3f m, zone %d%s",
            keeper.path,
            *origin.initial_utm,
            origin.zone,
            "N" if origin.north else "S",
        )
    if loop.state.notices:
        log.info("%s", "; ".join(loop.state.notices.values()))
    _restrict_collector()
    if journal is not None:
        journal[1].start()
    try:
        with supervision.ending():
            loop.run()
    finally:
        if states is not None:
            states.close(core.kept(loop.state, clock.now()))
        if journal is not None:
            journal[1].close()
