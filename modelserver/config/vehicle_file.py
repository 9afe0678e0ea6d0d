"""The vehicle file: every setting of the service in one typed, strict YAML file.

`load_config(path)` returns a `VehicleConfig`, or raises ConfigError with every problem at once: file, line, key, what
is wrong, and a suggestion for a misspelled key. The attributes of the dataclasses below are the keys of the file.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypeAlias

from pydantic import AfterValidator, ConfigDict

from modelserver import files
from modelserver.config import reader
from modelserver.dynamics.stability import DynamicsSettings
from modelserver.errors import ConfigError, Problem, quote
from modelserver.estimation.filter.settings import FilterSettings
from modelserver.estimation.raw.settings import RawSettings
from modelserver.estimation.sensor_rig import MagnetometerCalibration
from modelserver.geometry import names
from modelserver.messages import Mode

MAX_CHANNEL = 39
"""Characters of a sensor's channel: LCM allows 63, and a prefix has up to 24."""

MAX_NAME = 64
"""Characters of a source's name, as in the header of its messages."""

MAX_LATENCY = 5.0
"""Seconds: the localization retains the past for no longer."""

FrameName: TypeAlias = Annotated[str, AfterValidator(names.complete)]
"""A frame, `Body:Frame`; a body's name alone is its frame `Origin`."""


class _Section:
    """A section of the file, whose `channel`, `latency` and settings with `RANGES` are checked if it has them."""

    __slots__ = ()

    def __post_init__(self) -> None:
        self.check()

    def check(self, *problems: str, channel: str = "channel") -> None:
        """Raise ValueError, with a line for each problem, the given `problems` first; `channel` names that key."""
        found = list(problems)
        name = getattr(self, channel, None)
        if name is not None and not (
            0 < len(name) <= MAX_CHANNEL and name.isascii() and name.isprintable() and " " not in name
        ):
            found.append(f"{channel} has 1 to {MAX_CHANNEL} printable ASCII characters, no spaces, got {quote(name)}")
        latency = getattr(self, "latency", 0.0)
        if not 0.0 <= latency <= MAX_LATENCY:
            hint = f": {latency:g} ms is {latency * 1e-3:g}" if latency > MAX_LATENCY else ""
            found.append(f"latency is between 0 and {MAX_LATENCY:g} seconds, got {latency:g}{hint}")
        for key, low, high in getattr(self, "RANGES", ()):
            value = getattr(self, key)
            if not low <= value <= high:
                digits = "" if isinstance(value, int) else "g"
                found.append(f"{key} is between {low:{digits}} and {high:{digits}}, got {value:{digits}}")
        if found:
            raise ValueError("\n".join(found))


@dataclass(frozen=True, slots=True)
class LcmConfig(_Section):
    """The message bus."""

    url: str = ""
    """LCM provider. ttl=0 limits traffic to this machine; empty: $LCM_DEFAULT_URL, else loopback."""
    channel_prefix: str = ""
    """Put before every channel name, to separate two vehicles on one network."""
    reply_prefix: str = "REPLY_"
    """Replies are sent only to channels that start with it."""

    def __post_init__(self) -> None:
        problems = [
            f"{key} has at most 24 letters, digits and underscores, got {quote(value)}"
            for key, value in (("channel_prefix", self.channel_prefix), ("reply_prefix", self.reply_prefix))
            if not all(c.isascii() and (c.isalnum() or c == "_") for c in value) or len(value) > 24
        ]
        if not self.reply_prefix:
            problems.append("reply_prefix must not be empty: with it no request can make the server publish on POSE")
        self.check(*problems)


@dataclass(frozen=True, slots=True)
class PublishConfig(_Section):
    """What the service publishes, and when."""

    RANGES = (
        ("rate_hz", 0.1, 1000.0), ("health_hz", 0.01, 100.0), ("state_hz", 0.0, 50.0), ("snapshot_s", 0.5, 3600.0),
    )  # fmt: skip
    mode: Literal["timer", "event"] = "timer"
    """`timer` publishes POSE at `rate_hz`; `event` at every accepted sample of the IMU or the GPS."""
    rate_hz: float = 50.0
    """Poses per second in timer mode."""
    health_hz: float = 1.0
    """Health reports per second."""
    state_hz: float = 5.0
    """Publications of the filter's whole state per second; 0: never."""
    decisions: bool = True
    """Whether each measurement's decision (used, or the reason why not) is published with the event that settles it."""
    snapshot_s: float = 5.0
    """Seconds between publications of the whole geometry, for mirrors and logs that start later."""


@dataclass(frozen=True, slots=True)
class SensorConfig(_Section):
    """A sensor: its channel, and the frame of the geometry at which it is mounted."""

    channel: str
    """Channel of its samples."""
    frame: FrameName
    """Frame at which it is mounted, `Body:Frame`."""
    latency: float = 0.0
    """Seconds by which its stamps are later than the measurement; subtracted from each stamp."""
    publisher: str = ""
    """The `header.source` of its samples, which others on the channel do not displace; empty: a driver of this file."""


@dataclass(frozen=True, slots=True)
class GpsConfig(SensorConfig):
    """The GNSS receiver."""

    second_frame: FrameName = ""
    """Frame of the other antenna of a dual-antenna receiver."""


@dataclass(frozen=True, slots=True)
class ImuConfig(SensorConfig):
    """The inertial measurement unit."""

    yaw_rate_only: bool = False
    """Whether it measures the turn rate alone: angular_velocity along the axis nearest to up, the rest nan. The vehicle
    is then taken to be level."""


@dataclass(frozen=True, slots=True)
class SpeedometerConfig(_Section):
    """One speed for the whole vehicle, where no wheels are measured: forward_speed of the vehicle controller."""

    RANGES = (("sigma", 1e-3, 5.0),)
    channel: str = "VEHICLE_STATUS"
    """Channel of the vehicle controller's status (vehicle_status_t)."""
    sigma: float = 0.1
    """Standard deviation of the speed, m/s."""
    unsigned: bool = False
    """Whether the speed is a magnitude, also in reverse."""
    latency: float = 0.0
    """Seconds by which the stamps are later than the measurement; subtracted from each stamp."""


@dataclass(frozen=True, slots=True)
class SteeringConfig(_Section):
    """Source of the angle of steered wheels that do not measure it themselves."""

    RANGES = (("sigma", 1e-4, 0.5), ("limit", 0.05, 1.5), ("max_age", 0.01, 10.0))
    wheels: tuple[str, ...]
    """Names of the wheels in `frames` that steer by the controller's steering_angle."""
    channel: str = "VEHICLE_STATUS"
    """Channel of the vehicle controller's status (vehicle_status_t)."""
    geometry: Literal["ackermann", "parallel"] = "ackermann"
    """`ackermann`: the angle is that of one equivalent wheel in the middle of the axle, and each wheel is tangent to
    its own circle; `parallel`: all wheels have this angle."""
    sigma: float = 0.035
    """Standard deviation of the angle, radians: backlash, and deviation from the steering geometry."""
    limit: float = 0.7
    """Larger angles to either side are rejected as damaged, radians."""
    max_age: float = 0.2
    """Older angles are not used, seconds. Without an angle, wheels measure only the speed of their contact points."""
    latency: float = 0.0
    """Seconds by which the stamps are later than the measurement; subtracted from each stamp."""

    def __post_init__(self) -> None:
        none = ["wheels names the wheels that steer, e.g. [front_left, front_right]; got none"]
        self.check(*([] if self.wheels else none))


@dataclass(frozen=True, slots=True)
class WheelsConfig(_Section):
    """The wheel odometry."""

    channel: str = "WHEELS"
    """Channel of its samples."""
    frames: dict[str, FrameName] = field(default_factory=dict)
    """For each wheel's name the frame of its contact point."""
    publisher: str = ""
    """The `header.source` of its samples, which others on the channel do not displace; empty: a driver of this file."""
    kinematics: Literal["skid_steer", "differential", "ackermann"] = "differential"
    """How the vehicle turns. `skid_steer`: its sides roll at different speeds and wheels slip sideways, so only the
    mean of all is used; `differential` and `ackermann`: each wheel rolls in its direction, straight ahead or as it is
    steered. A wheel without a measured steering angle rolls in the direction in which its contact point moves."""
    steering: SteeringConfig | None = None
    """Source of the steering angle of wheels that do not measure it themselves."""
    latency: float = 0.0
    """Seconds by which the stamps are later than the measurement; subtracted from each stamp."""


@dataclass(frozen=True, slots=True)
class AidingConfig(_Section):
    """A further source of measurements. Its messages name their frames."""

    channel: str
    """Channel of its messages."""
    type: str
    """What it measures: `absolute_pose`, `relative_pose`, `range`, or a type of an installed package."""
    latency: float = 0.0
    """Seconds by which its stamps are later than the measurement; subtracted from each stamp."""


@dataclass(frozen=True, slots=True)
class JointsConfig(_Section):
    """The joint positions, received if the geometry has joints that move."""

    channel: str = "JOINTS"
    """Channel on which the drivers publish them."""
    latency: float = 0.0
    """Seconds by which the stamps are later than the measurement; subtracted from each stamp."""


@dataclass(frozen=True, slots=True)
class SensorsConfig:
    """The sensors. Their mounting poses are in the geometry file alone."""

    gps: GpsConfig | None = None
    imu: ImuConfig | None = None
    wheels: WheelsConfig | None = None
    speedometer: SpeedometerConfig | None = None
    joints: JointsConfig = field(default_factory=JointsConfig)
    aiding: dict[str, AidingConfig] = field(default_factory=dict)
    """Further sources, each by the name in its messages (`header.source`)."""
    publisher_conflict: Literal["ignore", "use"] = "ignore"
    """Whether samples of a second publisher on a channel are ignored or used while the first one is active."""

    def __post_init__(self) -> None:
        for name in self.aiding:
            if not (0 < len(name) <= MAX_NAME and name.isprintable()):
                raise ValueError(f"aiding names sources with 1 to {MAX_NAME} printable characters, got {quote(name)}")
        if self.wheels is not None and self.speedometer is not None:
            raise ValueError("speedometer is for a vehicle without measured wheels: remove it, or wheels")
        sensors = (self.gps, self.imu, self.wheels, self.speedometer, self.steering, self.joints, *self.aiding.values())
        channels = [each.channel for each in sensors if each]
        twice = {channel for channel in channels if channels.count(channel) > 1}
        if twice:
            raise ValueError(f"each sensor has a channel of its own; {quote(min(twice))} is given twice")

    @property
    def steering(self) -> SteeringConfig | None:
        return self.wheels.steering if self.wheels is not None else None


@dataclass(frozen=True, slots=True)
class OriginConfig:
    """The origin of World:UTM. Without a configured one it is captured from the first good fixes."""

    initial_utm: tuple[float, float, float] | None = None
    """Grid easting, grid northing, height above the ellipsoid, meters: a datum that several runs share."""
    zone: int | None = None
    """UTM zone, 1 to 60."""
    hemisphere: Literal["north", "south"] | None = None
    """Hemisphere of the UTM zone."""
    persist: bool = True
    """Whether a captured origin is persisted across restarts (in `state_directory`)."""

    def __post_init__(self) -> None:
        given = [value is not None for value in (self.initial_utm, self.zone, self.hemisphere)]
        if any(given) and not all(given):
            raise ValueError("initial_utm, zone and hemisphere are given together or not at all")
        if self.zone is not None and not 1 <= self.zone <= 60:
            raise ValueError(f"a UTM zone is 1 to 60, got {self.zone}")


@dataclass(frozen=True, slots=True)
class LocalizationConfig(_Section):
    """How the pose is estimated."""

    mode: Literal["full", "raw", "no_imu", "no_wheels", "no_gps", "dead_reckoning"] = "full"
    """The sources that are used from the start, see `modelserver.messages.Mode`."""
    mode_channel: str = ""
    """Channel that signed requests for another mode name; empty: nobody can switch from the bus."""
    raw: RawSettings = field(default_factory=RawSettings)
    filter: FilterSettings = field(default_factory=FilterSettings)
    magnetometer: MagnetometerCalibration = field(default_factory=MagnetometerCalibration)

    def __post_init__(self) -> None:
        self.check(channel="mode_channel" if self.mode_channel else "channel")

    @property
    def initial_mode(self) -> Mode:
        return Mode[self.mode.upper()]


@dataclass(frozen=True, slots=True)
class LimitsConfig(_Section):
    """Memory and processing time for requests, bounded so that no client can starve the pose."""

    RANGES = (
        ("client_hz", 1.0, 100_000.0), ("request_share", 0.0, 1.0), ("waiting_requests", 0, 4096),
        ("wait_ms", 0, 60_000), ("queued_requests", 1, 65536), ("requests_per_pass", 1, 1024),
        ("client_reply_bytes", 1e4, 1e9),
    )  # fmt: skip
    history_s: float = 60.0
    """Seconds of poses stored for queries about the past, at most 600."""
    waiting_requests: int = 64
    """Requests that may wait for data at once."""
    wait_ms: int = 2000
    """The longest wait granted, milliseconds."""
    queued_requests: int = 256
    """Length of the request queue; more are dropped and counted."""
    requests_per_pass: int = 16
    """Requests answered before the loop reads sensors again."""
    client_hz: float = 500.0
    """Requests per second that are guaranteed to each client; more are answered while there is time."""
    request_share: float = 0.25
    """Share of the time for requests; beyond it clients get only their guaranteed rates while others need the time."""
    client_reply_bytes: float = 5_000_000.0
    """Bytes per second of long replies (many transformations, history) to each client."""

    def __post_init__(self) -> None:
        has_history = 0.0 < self.history_s <= 600.0
        self.check(*([] if has_history else [f"history_s is above 0 and at most 600, got {self.history_s:g}"]))


KEY_HINT = (
    "only signed messages change the service; modelserver key new /etc/modelserver/commands.key makes a key, then "
    "write key_file: /etc/modelserver/commands.key under commands"
)


@dataclass(frozen=True, slots=True)
class CommandsConfig(_Section):
    """Commands from the bus that change the state of the service. None is allowed by default."""

    RANGES = (("window_s", 0.1, 300.0),)
    reload: bool = False
    """Whether the geometry file may be reloaded."""
    frames: bool = False
    """Whether programs may add frames to the bodies while the service runs."""
    set_pose: bool = False
    """Whether the pose of the vehicle may be set."""
    drive: Literal["auto", "signed", "unsigned"] = "auto"
    """Whether commands to the vehicle controller must be signed. `auto`: where there is a key file."""
    key_file: str = ""
    """Keys with which such a message must be signed, relative to this file; see `modelserver.key_files`."""
    window_s: float = 5.0
    """Greatest age of a signed message, seconds, by the vehicle's clock."""

    def __post_init__(self) -> None:
        enabled = [name for name in ("reload", "frames", "set_pose") if getattr(self, name) and not self.key_file]
        enabled += ["drive: signed"] if self.drive == "signed" and not self.key_file else []
        self.check(*(f"{name} needs a key_file beside it: {KEY_HINT}" for name in enabled))

    @property
    def is_drive_signed(self) -> bool:
        return self.drive == "signed" or (self.drive == "auto" and bool(self.key_file))


@dataclass(frozen=True, slots=True)
class WarmStartConfig(_Section):
    """The state of the localization that is persisted in `state_directory`, and when the next start restores it."""

    RANGES = (("period_s", 0.5, 600.0), ("max_age_s", 0.0, 31536000.0), ("max_pose_age_s", 0.0, 600.0))
    persist: bool = True
    """Whether the state of the localization is persisted."""
    period_s: float = 5.0
    """Seconds between two writes."""
    max_age_s: float = 86400.0
    """Greatest age at which persisted biases and scales are restored, seconds."""
    max_pose_age_s: float = 20.0
    """Longest time without a running service after which the pose of a stationary vehicle is restored, seconds; 0:
    never."""


@dataclass(frozen=True, slots=True)
class JournalConfig(_Section):
    """The journal: everything that is received and sent, on disk; see docs/journal.md."""

    directory: str = ""
    """Its directory, relative as `state_directory`; empty: `journal-` and the vehicle's name in the state directory."""
    megabytes: int | None = None
    """Its greatest size, 32 at least; 0: no journal. Default: 1024 under systemd or with a directory, else 0."""
    sync_s: float = 2.0
    """Seconds between two calls of fsync: what a loss of power costs at most."""

    def __post_init__(self) -> None:
        problems = []
        if self.megabytes is not None and self.megabytes != 0 and not 32 <= self.megabytes <= 1_000_000:
            problems.append(f"megabytes is 0 for no journal, or 32 to 1000000, got {self.megabytes}")
        if not 0.2 <= self.sync_s <= 60.0:
            problems.append(f"sync_s is between 0.2 and 60 seconds, got {self.sync_s:g}")
        self.check(*problems)


@dataclass(frozen=True, slots=True)
class VehicleConfig:
    """A vehicle: its geometry, its sensors, and the settings of its service."""

    __pydantic_config__: ClassVar[ConfigDict] = {"extra": "forbid", "allow_inf_nan": False}
    # of all sections too: pydantic passes it on
    vehicle: str
    """Name of the vehicle."""
    geometry: str
    """Path of the geometry file, relative to this file."""
    base_frame: FrameName
    """The frame that POSE describes."""
    rolling_frame: FrameName = ""
    """The frame that moves along its own x axis when the vehicle turns: the middle of the rear axle with steered front
    wheels, the middle of the wheels with skid steering. Empty: `base_frame`."""
    variables: dict[str, str] = field(default_factory=dict)
    """Values of the $NAMES in a frame-tree file."""
    state_directory: str = ""
    """Directory of the persisted origin and state, relative to this file, for one in /etc/modelserver to
    /var/lib/modelserver; empty: the user's state directory."""
    lcm: LcmConfig = field(default_factory=LcmConfig)
    publish: PublishConfig = field(default_factory=PublishConfig)
    sensors: SensorsConfig = field(default_factory=SensorsConfig)
    origin: OriginConfig = field(default_factory=OriginConfig)
    localization: LocalizationConfig = field(default_factory=LocalizationConfig)
    limits: LimitsConfig = field(default_factory=LimitsConfig)
    commands: CommandsConfig = field(default_factory=CommandsConfig)
    warm_start: WarmStartConfig = field(default_factory=WarmStartConfig)
    journal: JournalConfig = field(default_factory=JournalConfig)
    dynamics: DynamicsSettings | None = None
    """Dynamics of the vehicle and its tip-over margin; without the section there are none."""
    drivers: dict[str, dict[str, Any]] = field(default_factory=dict)
    """For each driver's name its type of device and that type's settings. The service does not read them;
    `msdrivers.settings` does."""

    def __post_init__(self) -> None:
        for name in self.drivers:
            # a word of the command line, and the source in the headers of its samples
            if not (0 < len(name) <= MAX_NAME and name.isprintable() and " " not in name):
                raise ValueError(
                    f"drivers have names of 1 to {MAX_NAME} printable characters without spaces, got {quote(name)}"
                )


def load_config(path: str | Path) -> VehicleConfig:
    """Read a vehicle file. Its paths become absolute. Raises ConfigError with every problem, OSError."""
    path = Path(path)
    return _resolve_paths(parse_config(_read_bytes(path), str(path)), path)


def load_partly(path: str | Path, *, blank: bool = False) -> tuple[VehicleConfig | None, tuple[Problem, ...]]:
    """Return the configuration without what is wrong, None where too little is left, and every problem.

    With `blank`, a missing name, geometry or base frame is replaced by an empty text, so that the rest can be examined.
    Raises ConfigError for a file that is not a YAML mapping, OSError.
    """
    path = Path(path)
    blanks = dict.fromkeys(("vehicle", "geometry", "base_frame"), "") if blank else None
    config, problems = reader.read_partly(_read_bytes(path), str(path), VehicleConfig, blanks)
    return None if config is None else _resolve_paths(config, path), problems


def add_lines(problems: Iterable[Problem], path: str) -> list[Problem]:
    """Return problems of a vehicle file with the line of the key, or of the section, that each is about."""
    problems = list(problems)
    try:
        lines = {".".join(map(str, at)): line for at, line in read_config_lines(path).items()}
    except (OSError, ConfigError):
        return problems

    def find_line(key: str) -> int:
        while key and key not in lines:
            key = key.rpartition(".")[0]
        return lines.get(key, 0)

    return [
        dataclasses.replace(each, source=dataclasses.replace(each.source, line=find_line(each.element)))
        if each.file == path and not each.line
        else each
        for each in problems
    ]


NOT_A_VEHICLE_FILE = "not a vehicle file"
"""End of the message for a file of another type."""

_START_HINT = "start with: vehicle, geometry, base_frame; docs/vehicle-file.md has an example"
_MODEL_HINT = "modelserver query takes it with --model"
_GEOMETRY_HINT = f"give the vehicle file, which names it (geometry: {{name}}); {_MODEL_HINT}"
_FIXES: dict[files.FileKind, str] = {
    files.FileKind.EMPTY: _START_HINT,
    files.FileKind.COMMENTS: _START_HINT,
    files.FileKind.GEOMETRY: _GEOMETRY_HINT,
    files.FileKind.URDF: _GEOMETRY_HINT,
    files.FileKind.MIRO_PROCESS: files.PROCESS_FIX,
    files.FileKind.XML: f"give the vehicle file, which is YAML; if this is a geometry file, {_MODEL_HINT}",
    files.FileKind.LOG: "give the vehicle file; a log is played by modelserver replay",
    files.FileKind.BINARY: "give the vehicle file, which is YAML",
}


def _read_bytes(path: Path) -> bytes:
    """Read a vehicle file. Raises ConfigError for a file of another type, OSError."""
    try:
        # the beginning of a larger file shows its type; the reader rejects it
        raw = files.read_start(path, reader.MAX_BYTES + 1)
    except files.NotRegularFileError as error:
        there = next((each for each in ("vehicle.yaml", "vehicle.yml") if (path / each).is_file()), "")
        fix = f"give {path / there}" if error.is_directory and there else "give the vehicle file itself"
        raise reader.make_error(str(path), 0, f"this is {error.kind}, {NOT_A_VEHICLE_FILE}", fix) from None
    kind = files.detect_file_kind(raw)
    if kind in _FIXES:
        what = kind.value if kind.is_empty else f"{kind.value}, {NOT_A_VEHICLE_FILE}"
        raise reader.make_error(str(path), 0, what, _FIXES[kind].format(name=path.name))
    return raw


def _resolve_paths(config: VehicleConfig, path: Path) -> VehicleConfig:
    def resolve(given: str) -> str:
        return str((path.parent / Path(given).expanduser()).resolve()) if given else ""

    def resolve_state(given: str) -> str:
        # the units and the container have /etc read-only, and state where the file hierarchy standard has it
        is_relative = str(path.parent.resolve()) == files.INSTALLED_FOLDER and not given.startswith(("/", "~"))
        return resolve(os.path.join(files.STATE_FOLDER, given) if given and is_relative else given)

    return dataclasses.replace(
        config,
        geometry=resolve(config.geometry),
        state_directory=resolve_state(config.state_directory),
        commands=dataclasses.replace(config.commands, key_file=resolve(config.commands.key_file)),
        journal=dataclasses.replace(config.journal, directory=resolve_state(config.journal.directory)),
    )


def read_config_lines(path: str | Path) -> dict[tuple[str | int, ...], int]:
    """Return the line of each key of a vehicle file. Raises ConfigError, OSError."""
    return reader.read_lines(_read_bytes(Path(path)), str(path), VehicleConfig)


def parse_config(raw: bytes, name: str = "") -> VehicleConfig:
    """Parse the bytes of the vehicle file `name`. Raises ConfigError with every problem."""
    found, problems = reader.read_partly(raw, name, VehicleConfig)
    if found is None or problems:
        raise ConfigError(problems)
    return found
