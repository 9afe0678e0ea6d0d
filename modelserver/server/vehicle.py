"""A vehicle: its file and its geometry, checked against each other, and what the server makes of them.

`load_vehicle` checks everything before a server starts, and reports all problems at once: frames, channels, origin,
keys. `Vehicle` makes the first core state, the sensor channels, the command verifier and the snapshot.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from modelserver import core, errors, messages
from modelserver.config.vehicle_file import KEY_HINT, VehicleConfig, add_lines
from modelserver.core import CoreSettings, CoreState, ExpectedSensor, Instant
from modelserver.core.state import START
from modelserver.earth.geodesy import GeodesyError, make_origin
from modelserver.estimation.sensor_rig import (
    SPEEDOMETER,
    Mounts,
    SensorRig,
    SpeedometerSignal,
    SteeringSignal,
    find_unusable,
)
from modelserver.formats import FileExamination, examine_file
from modelserver.formats.common import is_far
from modelserver.formats.yaml_geometry import ModelSnapshot, encode_snapshot
from modelserver.geometry import Model
from modelserver.geometry.parts import suggest_frame
from modelserver.key_files import read_keys
from modelserver.server.ingress import MODE_TYPE, CommandVerifier, SensorChannel
from modelserver.signing import Key
from modelserver.wire.channels import CHANNELS, ChannelUse
from modelserver.wire.codec import get_type_name
from modelserver.wire.provider import leaves_machine

if TYPE_CHECKING:
    from modelserver.estimation.modes import LocalizerConfig

log = logging.getLogger(__name__)

HOUSEKEEPING_HZ = 50.0
"""Least rate of ticks: for waiting requests, the health report and signals."""

MODE_CHANNEL = "LOCALIZATION_MODE"
"""Default channel of mode commands."""

AIDING_SAMPLES: Mapping[str, type[messages.Sample]] = {
    "absolute_pose": messages.AbsolutePoseSample,
    "relative_pose": messages.RelativePoseSample,
    "range": messages.RangeSample,
}
"""Samples of aiding sources, by their type in the vehicle file; other types are those of installed packages."""


@dataclass(frozen=True, slots=True)
class Vehicle:
    """A vehicle file and its geometry, checked against each other.

    `rig` is None without any localization sensor, `mounts` without GPS or IMU.
    """

    config: VehicleConfig
    model: Model
    mounts: Mounts | None
    rig: SensorRig | None = None

    def start_core(
        self, now: Instant, origin: messages.Origin | None = None, restored: messages.RestoredState | None = None
    ) -> CoreState:
        """Make the first state of the core.

        Parameters
        ----------
        origin: persisted origin of an earlier run; a configured one has precedence.
        restored: persisted state of an earlier run for a warm start; None if none is configured.
        """
        config = self.config
        localizer = None
        start_report = ""
        setup = self.make_localizer_setup()
        if setup is not None:
            from modelserver.estimation.filter.warm_start import prepare_warm_start
            from modelserver.estimation.modes import ModeLocalizer

            origin = get_configured_origin(config) or origin
            mode = config.localization.initial_mode
            restored, start_report = prepare_warm_start(restored, config.vehicle, setup.setup, mode)
            localizer = ModeLocalizer.start(setup, mode, origin, restored)
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
            waiting_requests=config.limits.waiting_requests,
            wait_ms=config.limits.wait_ms,
            reply_prefix=config.lcm.reply_prefix,
            snapshot_period_ns=round(config.publish.snapshot_s * 1e9),
            may_reload=config.commands.reload,
            may_set_frames=config.commands.frames,
            may_set_pose=config.commands.set_pose,
            persist_period_ns=round(config.warm_start.period_s * 1e9) if config.warm_start.persist else 0,
            sensors=self.expected_sensors(),
            dynamics=config.dynamics,
        )
        state = core.start(settings, self.model, localizer, now)
        return state._replace(warnings={START: start_report}) if start_report else state

    def with_model(self, model: Model) -> Vehicle:
        """Return the vehicle with another geometry that has all frames of this one, at the same places."""
        if model is self.model:
            return self
        return replace(self, model=model, rig=None if self.rig is None else replace(self.rig, model=model))

    def make_localizer_setup(self) -> LocalizerConfig | None:
        """Make the configuration of the localizers; None without a localization sensor."""
        if self.rig is None:
            return None
        from modelserver.estimation.filter.state import Setup
        from modelserver.estimation.modes import LocalizerConfig

        return LocalizerConfig(
            Setup(self.rig, self.config.localization.filter, own=list_own_measurements(self.config)),
            self.config.localization.raw,
            self.mounts,
        )

    def find_unusable_sensors(self) -> tuple[messages.SensorFinding, ...]:
        """Find the configured sensors that localization cannot use in its initial mode, with the reasons."""
        return () if self.rig is None else find_unusable(self.rig, self.config.localization.initial_mode)

    def read_keys(self, file: str = "") -> tuple[Key, ...]:
        """Read the vehicle's keys; none without a key file. Raises ConfigError if the file is invalid."""
        path = self.config.commands.key_file
        try:
            return read_keys(path) if path else ()
        except errors.KeyFileError as error:
            raise errors.ConfigError(add_lines([_make_problem(file, "commands.key_file", str(error))], file)) from None

    def make_command_verifier(self, started_ns: int, file: str = "") -> CommandVerifier:
        """Make the verifier of signed commands. Raises ConfigError if the key file is invalid."""
        config = self.config
        keys = self.read_keys(file)
        mode_channel = config.localization.mode_channel
        return CommandVerifier(keys, config.lcm.channel_prefix, config.commands.window_s, mode_channel, started_ns)

    def encode_snapshot(self, model: Model) -> bytes:
        """Encode a snapshot of a geometry of this vehicle."""
        config = self.config
        return encode_snapshot(
            ModelSnapshot(
                config.vehicle,
                model,
                config.base_frame,
                config.rolling_frame or config.base_frame,
                config.limits.history_s,
                f"{config.lcm.channel_prefix}{config.sensors.joints.channel}",
                round(config.sensors.joints.latency * 1e6),
            )
        )

    def ticks_per_pose(self) -> int:
        """Return the ticks per POSE in timer mode; more than one if POSE is slower than `HOUSEKEEPING_HZ`."""
        publish = self.config.publish
        return math.ceil(HOUSEKEEPING_HZ / publish.rate_hz) if publish.mode == "timer" else 1

    def tick_hz(self) -> float:
        """Return the rate of ticks, a whole multiple of that of POSE."""
        publish = self.config.publish
        return publish.rate_hz * self.ticks_per_pose() if publish.mode == "timer" else HOUSEKEEPING_HZ

    def ticks_per_state(self) -> int:
        state_hz = self.config.publish.state_hz
        return max(1, round(self.tick_hz() / state_hz)) if state_hz else 0

    def expected_sensors(self) -> tuple[ExpectedSensor, ...]:
        """Return the configured sensors with their channels."""
        return tuple(ExpectedSensor(each.channel, each.sample, each.source) for each in _list_sensors(self.config))

    def sensor_channels(self, model: Model | None = None) -> dict[str, SensorChannel]:
        """Return the channels to subscribe to: those of sensors, and the one of mode commands if it is configured.

        The joints' channel is included if `model` (default: the loaded one) has joints.
        """
        has_joints = bool((model or self.model).joints)
        channels = {
            each.channel: SensorChannel(get_type_name(each.sample), each.latency_us)
            for each in _list_sensors(self.config)
            if has_joints or each.sample is not messages.JointsSample
        }
        if self.config.localization.mode_channel:
            name = f"{self.config.lcm.channel_prefix}{self.config.localization.mode_channel}"
            channels[name] = SensorChannel(MODE_TYPE)
        return channels

    def list_publishers(self) -> dict[str, frozenset[str]]:
        """Return the sources that the vehicle file names, by channel: those of its sensors, else its drivers."""
        found: dict[str, frozenset[str]] = {}
        for each in _list_sensors(self.config):
            name = each.source or each.publisher
            names = frozenset((name,)) if name else frozenset(self.config.drivers)
            found[each.channel] = found.get(each.channel, frozenset()) | names
        return found


class _ConfiguredSensor(NamedTuple):
    """A sensor of the vehicle file: its key below `sensors`, its channel with prefix, its samples, its source name.

    publisher: the source that it is to have, if the file names one.
    """

    key: str
    channel: str
    latency_us: int
    sample: type[messages.Sample]
    source: str = ""
    publisher: str = ""


def _list_sensors(config: VehicleConfig) -> list[_ConfiguredSensor]:
    prefix, sensors = config.lcm.channel_prefix, config.sensors
    listed: list[tuple[str, Any, type[messages.Sample], str]] = [
        ("gps", sensors.gps, messages.GpsSample, ""),
        ("imu", sensors.imu, messages.ImuSample, ""),
        ("wheels", sensors.wheels, messages.WheelsSample, ""),
        ("speedometer", sensors.speedometer, messages.VehicleStatusSample, ""),
        ("wheels.steering", sensors.steering, messages.VehicleStatusSample, ""),
        ("joints", sensors.joints, messages.JointsSample, ""),
        *(
            (f"aiding.{name}", each, AIDING_SAMPLES.get(each.type, messages.MeasurementSample), name)
            for name, each in sensors.aiding.items()
        ),
    ]
    return [
        _ConfiguredSensor(
            key, f"{prefix}{each.channel}", round(each.latency * 1e6), sample, source, getattr(each, "publisher", "")
        )
        for key, each, sample, source in listed
        if each is not None
    ]


def find_disconnected(model: Model) -> frozenset[str]:
    """Find the bodies that no constraint connects to the root."""
    return frozenset(name for assembly in model.assemblies[1:] for name in assembly)


def load_vehicle(config: VehicleConfig, file: str = "", strict: bool = False) -> Vehicle:
    """Load the geometry and check it against the vehicle file.

    Parameters
    ----------
    file: path of the vehicle file, for messages.
    strict: permit at most one constraint per frame.

    Raises
    ------
    GeometryError, ConfigError: with all problems.
    """
    geometry, problems = examine_vehicle(config, file, strict)
    model = geometry.model
    if model is None and geometry.problems:
        raise errors.GeometryError(geometry.problems)
    if model is None or errors.has_error(problems):
        raise errors.ConfigError(problems)
    mounts = None
    gps, imu = config.sensors.gps, config.sensors.imu
    if gps is not None and imu is not None:
        mounts = Mounts.from_model(model, config.rolling_frame or config.base_frame, gps.frame, imu.frame)
    return Vehicle(config, model, mounts, _make_rig(config, model))


def examine_vehicle(
    config: VehicleConfig, file: str = "", strict: bool = False
) -> tuple[FileExamination, tuple[errors.Problem, ...]]:
    """Find all problems of the geometry and of the vehicle file at once.

    Frames are looked up also in a geometry with errors, as far as its bodies can be read. An empty name of the geometry
    or of the base frame means that the vehicle file lacks it.
    """
    geometry = FileExamination()
    problems: list[errors.Problem] = []
    if config.geometry:
        try:
            geometry = examine_file(config.geometry, config.variables, strict=strict)
        except OSError as error:
            why = f"the geometry file {config.geometry} cannot be read: {error.strerror}"
            problems.append(_make_problem(file, "geometry", why))
    if geometry.partial_model is not None:
        problems += find_frame_problems(config, geometry.partial_model, file, is_whole=geometry.model is not None)
    if geometry.model is not None and not errors.has_error(problems):
        problems += _find_dynamics_problems(config, geometry.model, file)
    gps, imu = config.sensors.gps, config.sensors.imu
    if config.localization.mode == "raw" and (gps is None or imu is None):
        why = "raw mode needs a GPS and an IMU, and the section sensors does not have both"
        problems.append(_make_problem(file, "localization.mode", why, "write mode: full"))
    problems += _find_channel_problems(config, file)
    problems += _find_type_problems(config, file)
    if config.localization.mode_channel and not config.commands.key_file:
        why = f"mode commands must be signed: {KEY_HINT}"
        problems.append(_make_problem(file, "localization.mode_channel", why))
    if text := find_unsigned_drive(config):
        is_written = config.commands.drive == "unsigned"
        severity = errors.Severity.NOTE if is_written else errors.Severity.WARNING
        fix = f"{KEY_HINT}; or write ttl=0 in lcm.url, or drive: unsigned to accept it"
        problems.append(_make_problem(file, "commands", text, fix, severity=severity))
    try:
        get_configured_origin(config)
    except GeodesyError as error:
        problems.append(_make_problem(file, "origin.initial_utm", str(error)))
    return geometry, tuple(add_lines(problems, file))


def find_unsigned_drive(config: VehicleConfig) -> str:
    """Return who can drive the vehicle without a signature, empty if nobody on another machine can."""
    drives = [name for name, driver in config.drivers.items() if driver.get("command")]
    if not drives or config.commands.is_drive_signed or not leaves_machine(config.lcm.url):
        return ""
    return (
        f"every host on the network of {config.lcm.url} can drive the vehicle through driver {drives[0]}: no signature"
    )


def _make_problem(
    file: str,
    key: str,
    why: str,
    fix: str = "",
    near: tuple[str, ...] = (),
    severity: errors.Severity = errors.Severity.ERROR,
) -> errors.Problem:
    return errors.Problem(severity, why, errors.Location(file, element=key), fix, near)


def find_frame_problems(config: VehicleConfig, model: Model, file: str, is_whole: bool) -> list[errors.Problem]:
    """Check the frames that the vehicle file names; only an `is_whole` model has constraints."""
    gps, imu = config.sensors.gps, config.sensors.imu
    named = [("base_frame", config.base_frame), ("rolling_frame", config.rolling_frame)]
    named += [(f"sensors.{key}.frame", each.frame) for key, each in (("gps", gps), ("imu", imu)) if each is not None]
    named += [("sensors.gps.second_frame", gps.second_frame)] if gps is not None else []
    if config.sensors.wheels is not None:
        named += [(f"sensors.wheels.frames.{name}", frame) for name, frame in config.sensors.wheels.frames.items()]
    see = f"see: modelserver tree --frames {config.geometry}"
    problems: list[errors.Problem] = []
    unknown: set[str] = set()
    for key, frame in named:
        if not frame and key in ("base_frame", "rolling_frame", "sensors.gps.second_frame"):
            continue
        try:
            model.frame(frame)
        except errors.QueryError as error:
            unknown.add(frame)
            near = errors.Suggestion.of(frame, suggest_frame(frame, {body.name: body for body in model.bodies}))
            fix = f"write {near[0]}" if near else see
            problems.append(_make_problem(file, key, str(error), fix, near))
    if not is_whole or not config.base_frame or config.base_frame in unknown:
        return problems
    body = config.rolling_frame or config.base_frame
    for key, frame in named:
        if not frame or frame in unknown:
            continue
        try:
            model.get_transformation(frame, config.base_frame)
            joints = () if body in unknown else model.get_kinematic_path(frame, body).joints
        except errors.QueryError as error:
            problems.append(_make_problem(file, key, str(error), see))
            continue
        if joints:
            why = f"joint {joints[0].name} moves {frame} relative to the vehicle; localization needs a rigid mount"
            fix = "name a frame that is fixed to the vehicle, or make the constraint fixed"
            problems.append(_make_problem(file, key, why, fix))
    if not problems:
        problems += _find_improbable_mounts(config, model, file)
    return problems


SAME_PLACE: Final = 0.01
"""Meters within which two wheels of a vehicle do not stand."""

_SIDES: Final = {"left": 1.0, "right": -1.0}


def _find_improbable_mounts(config: VehicleConfig, model: Model, file: str) -> Iterator[errors.Problem]:
    """Yield wheels in one place, wheels on the other side than their name has, and sensors far from the vehicle."""

    def locate(frame: str) -> tuple[float, float, float]:
        return model.get_transformation(frame, config.base_frame).pose.xyz

    def warn(key: str, why: str, fix: str) -> errors.Problem:
        return _make_problem(file, key, why, fix, severity=errors.Severity.WARNING)

    sensors = config.sensors
    for key, sensor in (("gps", sensors.gps), ("imu", sensors.imu)):
        if sensor is not None and is_far(place := locate(sensor.frame)):
            far = math.hypot(*place)
            what = f"{sensor.frame} is {far:g} m from {config.base_frame}"
            yield warn(f"sensors.{key}.frame", what, f"positions are in meters; {far / 1000.0:g} m?")
    wheels = sensors.wheels.frames if sensors.wheels is not None else {}
    places = {name: locate(frame) for name, frame in wheels.items()}
    for (a, at), (b, other) in combinations(places.items(), 2):
        if math.dist(at, other) < SAME_PLACE:
            where = "in one frame" if wheels[a] == wheels[b] else "in one place"
            why = f"the wheels {a} and {b} stand {where}, {wheels[b]}"
            yield _make_problem(
                file, f"sensors.wheels.frames.{b}", why, "name the frame of its own contact point for each"
            )
            return
    for name, (_, y, _) in places.items():
        named = [sign for side, sign in _SIDES.items() if side in name.lower()]
        if len(named) == 1 and y * named[0] < -SAME_PLACE:
            actual = "left" if y > 0.0 else "right"
            why = f"the wheel {name} stands {abs(y):g} m to the {actual} of {config.base_frame}"
            fix = f"y is positive to the left: exchange the frames, or correct {wheels[name]}"
            yield warn(f"sensors.wheels.frames.{name}", why, fix)


def _make_rig(config: VehicleConfig, model: Model) -> SensorRig | None:
    """Make the sensor rig of the filter; None without a localization sensor."""
    gps, imu, wheels = config.sensors.gps, config.sensors.imu, config.sensors.wheels
    speedometer, steering = config.sensors.speedometer, config.sensors.steering
    if gps is None and imu is None and wheels is None and speedometer is None:
        return None
    rolling_frame = config.rolling_frame or config.base_frame
    frames = wheels.frames if wheels is not None else {}
    if speedometer is not None:
        frames = {SPEEDOMETER: rolling_frame}
    imu_frame, yaw_gyro_frame = (imu.frame, "") if imu is not None else ("", "")
    if imu is not None and imu.yaw_rate_only:
        imu_frame, yaw_gyro_frame = "", imu.frame
    return SensorRig(
        model,
        rolling_frame,
        imu_frame,
        gps.frame if gps is not None else "",
        gps.second_frame if gps is not None else "",
        frames,
        wheels.kinematics if wheels is not None else "differential",
        config.localization.magnetometer,
        SteeringSignal(steering.wheels, steering.geometry, steering.sigma, steering.limit, steering.max_age)
        if steering is not None
        else None,
        wheels is not None,
        SpeedometerSignal(speedometer.sigma, speedometer.unsigned) if speedometer is not None else None,
        yaw_gyro_frame,
    )


def _find_channel_problems(config: VehicleConfig, file: str) -> list[errors.Problem]:
    """Check that no channel has two uses."""
    prefix, reply_prefix = config.lcm.channel_prefix, config.lcm.reply_prefix
    used = {f"sensors.{each.key}.channel": each.channel for each in _list_sensors(config)}
    own = {f"{prefix}{channel.name}" for channel in CHANNELS}
    not_for_sensors = {f"{prefix}{channel.name}" for channel in CHANNELS if channel.use is not ChannelUse.SENSOR}
    why, fix = "is a channel of the server itself, not of a sensor", "give the sensor another channel"
    problems = [
        _make_problem(file, key, f"{channel} {why}", fix) for key, channel in used.items() if channel in not_for_sensors
    ]
    if config.localization.mode_channel:
        channel = f"{prefix}{config.localization.mode_channel}"
        if channel in used.values() or (channel in own and channel != f"{prefix}{MODE_CHANNEL}"):
            why = f"{channel} has another use, so it cannot be the channel of mode commands"
            problems.append(_make_problem(file, "localization.mode_channel", why, f"write {MODE_CHANNEL}"))
        used["localization.mode_channel"] = channel
    clashing = sorted(name for name in own | set(used.values()) if name.startswith(reply_prefix))
    if clashing:
        why = f"with the reply prefix {reply_prefix} a request could make the server reply on {clashing[0]}"
        fix = "choose a prefix that no other channel has, e.g. REPLY_"
        problems.append(_make_problem(file, "lcm.reply_prefix", why, fix))
    return problems


def _find_dynamics_problems(config: VehicleConfig, model: Model, file: str) -> list[errors.Problem]:
    """Check that the dynamics can be computed, so that Pinocchio is loaded before the service runs."""
    if config.dynamics is None:
        return []
    from modelserver.query.dynamics import check_dynamics

    try:
        check_dynamics(model, config.base_frame, config.dynamics)
    except errors.ModelServerError as error:
        return [_make_problem(file, "dynamics", str(error), "", tuple(getattr(error, "nearest", ())))]
    return []


def list_own_measurements(config: VehicleConfig) -> dict[str, str]:
    """Return the type of each source of measurements of installed packages."""
    return {name: each.type for name, each in config.sensors.aiding.items() if each.type not in AIDING_SAMPLES}


def _find_type_problems(config: VehicleConfig, file: str) -> list[errors.Problem]:
    """Check that the types of aiding sources are known here; packages are looked for only where one is not."""
    problems: list[errors.Problem] = []
    own = list_own_measurements(config)
    if not own:
        return problems
    from modelserver.estimation.filter.measurements.measurement import MEASUREMENT_TYPES, PLUGIN_GROUP
    from modelserver.estimation.filter.state import find_repeated_state

    for name, given in own.items():
        if given in MEASUREMENT_TYPES:
            continue
        key = f"sensors.aiding.{name}.type"
        if given in MEASUREMENT_TYPES.problems:
            why = f"of an installed package cannot be used: {MEASUREMENT_TYPES.problems[given]}"
            fix = "repair or reinstall that package"
            problems.append(_make_problem(file, key, f"type {errors.quote(given)} {why}", fix))
            continue
        known = (*AIDING_SAMPLES, *MEASUREMENT_TYPES)
        near = errors.suggest_name(given, known)
        package = f"install the package that defines it (entry point group {PLUGIN_GROUP})"
        fix = f"write {near[0]}" if near else f"{package}, or write one of {', '.join(known)}"
        problems.append(_make_problem(file, key, f"unknown type {errors.quote(given)}", fix, near))
    if problems:
        return problems
    repeated = find_repeated_state(dict.fromkeys(own.values()), config.localization.filter)
    if repeated is not None:
        given, state = repeated
        name = next(each for each in own if own[each] == given)
        why = f"type {errors.quote(given)} of an installed package declares the state {state}, which there is already"
        fix = "rename that state in the package"
        problems.append(_make_problem(file, f"sensors.aiding.{name}.type", why, fix))
    return problems


def get_configured_origin(config: VehicleConfig) -> messages.Origin | None:
    """Return the configured origin; None if it is to be captured."""
    origin = config.origin
    if origin.initial_utm is None or origin.zone is None:
        return None
    return make_origin(*origin.initial_utm, zone=origin.zone, north=origin.hemisphere == "north")
