"""The vehicle file: typed, strict, every tunable in one place.

`load_config(path)` reads a YAML file and returns a `VehicleConfig`, or raises ConfigError with every problem at
once: file, line, key, what is wrong, and for a mistyped key the nearest known one.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal

from pydantic import ConfigDict

from modelserver import config_reader
from modelserver.errors import ConfigError, Location, Problem, Severity, shown
from modelserver.file_kinds import FileKind, conversion_command, file_kind
from modelserver.localization.filter.settings import FilterSettings
from modelserver.localization.magnetometer import MagnetometerCalibration
from modelserver.localization.raw.settings import RawSettings
from modelserver.messages import Mode
from modelserver.regular_files import NotRegularFileError, read_start

_STRICT: ConfigDict = {"extra": "forbid", "allow_inf_nan": False}

MAX_CHANNEL = 39
"""Characters of a sensor's channel: LCM takes 63, and a prefix has up to 24."""

MAX_NAME = 64
"""Characters of a source's name, as in the header of its messages."""

MAX_LATENCY = 5.0
"""Seconds: the localization keeps the past for no longer."""


@dataclass(frozen=True, slots=True)
class LcmConfig:
    """The bus.

    url: LCM provider. ttl=0 keeps traffic on this machine; empty takes $LCM_DEFAULT_URL, else loopback.
    channel_prefix: put before every channel name, to keep two vehicles on one network apart.
    reply_prefix: replies go only to channels that start with it.
    """

    __pydantic_config__: ClassVar[ConfigDict] = _STRICT
    url: str = ""
    channel_prefix: str = ""
    reply_prefix: str = "REPLY_"

    def __post_init__(self) -> None:
        problems = [
            f"{key} has at most 24 letters, digits and underscores, got {shown(value)}"
            for key, value in (("channel_prefix", self.channel_prefix), ("reply_prefix", self.reply_prefix))
            if not all(c.isascii() and (c.isalnum() or c == "_") for c in value) or len(value) > 24
        ]
        if not self.reply_prefix:
            problems.append("reply_prefix must not be empty: it keeps requests from making the server speak on POSE")
        _refuse(problems)


@dataclass(frozen=True, slots=True)
class PublishConfig:
    """What is broadcast, and when.

    mode: `timer` publishes POSE at rate_hz; `event` on every sample of an IMU or GPS that was taken.
    rate_hz: poses a second in timer mode. health_hz: health reports a second.
    state_hz: how often a second the filter's whole state goes out; 0 = never. decisions: whether it is told, with the
        event that settles it, which measurements were used and which not.
    snapshot_s: seconds between broadcasts of the whole geometry, for mirrors and logs that come late.
    """

    __pydantic_config__: ClassVar[ConfigDict] = _STRICT
    mode: Literal["timer", "event"] = "timer"
    rate_hz: float = 50.0
    health_hz: float = 1.0
    state_hz: float = 5.0
    decisions: bool = True
    snapshot_s: float = 5.0

    def __post_init__(self) -> None:
        _refuse(
            f"{name} is between {low:g} and {high:g}, got {getattr(self, name):g}"
            for name, low, high in (
                ("rate_hz", 0.1, 1000.0),
                ("health_hz", 0.01, 100.0),
                ("state_hz", 0.0, 50.0),
                ("snapshot_s", 0.5, 3600.0),
            )
            if not low <= getattr(self, name) <= high
        )


def _refuse(problems: Iterable[str]) -> None:
    """Raise ValueError with all problems, one a line, where there are any."""
    text = "\n".join(problems)
    if text:
        raise ValueError(text)


def _channel_problems(channel: str, key: str = "channel") -> list[str]:
    if 0 < len(channel) <= MAX_CHANNEL and channel.isascii() and channel.isprintable() and " " not in channel:
        return []
    return [f"{key} has 1 to {MAX_CHANNEL} printable ASCII characters, no spaces, got {shown(channel)}"]


def _latency_problems(latency: float) -> list[str]:
    if 0.0 <= latency <= MAX_LATENCY:
        return []
    hint = f": {latency:g} ms is {latency * 1e-3:g}" if latency > MAX_LATENCY else ""
    return [f"latency is between 0 and {MAX_LATENCY:g} seconds, got {latency:g}{hint}"]


@dataclass(frozen=True, slots=True)
class SensorConfig:
    """One sensor: the channel it is heard on, and the frame of the geometry it is mounted at.

    latency: seconds by which its stamps are later than the measurement; subtracted from each stamp.
    """

    __pydantic_config__: ClassVar[ConfigDict] = _STRICT
    channel: str
    frame: str
    latency: float = 0.0

    def __post_init__(self) -> None:
        _refuse(_channel_problems(self.channel) + _latency_problems(self.latency))


@dataclass(frozen=True, slots=True)
class GpsConfig(SensorConfig):
    """The satellite receiver. second_frame: of a dual-antenna receiver, the frame of the other antenna."""

    __pydantic_config__: ClassVar[ConfigDict] = _STRICT
    second_frame: str = ""


@dataclass(frozen=True, slots=True)
class SteeringConfig:
    """Where the angle of wheels that steer comes from, where they do not measure it themselves.

    channel: where the vehicle controller's status (vehicle_status_t) comes. wheels: names of the wheels in `frames`
        that steer by its steering_angle.
    geometry: ackermann, the angle is that of one equivalent wheel in the middle of the axle, and each wheel points
        along its own circle; parallel, all point along the angle itself.
    sigma: standard deviation of the angle, radians: play of the gear, and how far geometry is kept.
    limit: an angle beyond it to either side is damage and is not used, radians.
    max_age: an older angle is not used, seconds. Without one wheels measure the speed of their contact points alone.
    latency: seconds by which the stamps are later than the measurement; subtracted from each stamp.
    """

    __pydantic_config__: ClassVar[ConfigDict] = _STRICT
    wheels: tuple[str, ...]
    channel: str = "VEHICLE_STATUS"
    geometry: Literal["ackermann", "parallel"] = "ackermann"
    sigma: float = 0.035
    limit: float = 0.7
    max_age: float = 0.2
    latency: float = 0.0

    def __post_init__(self) -> None:
        problems = _channel_problems(self.channel) + _latency_problems(self.latency)
        if not self.wheels:
            problems.append("wheels names the wheels that steer, e.g. [front_left, front_right]; got none")
        problems += [
            f"{name} is between {low:g} and {high:g}, got {getattr(self, name):g}"
            for name, low, high in (("sigma", 1e-4, 0.5), ("limit", 0.05, 1.5), ("max_age", 0.01, 10.0))
            if not low <= getattr(self, name) <= high
        ]
        _refuse(problems)


@dataclass(frozen=True, slots=True)
class WheelsConfig:
    """The wheels: the channel they are heard on, and for each wheel's name the frame of its contact point.

    kinematics: how the vehicle turns. skid_steer: its sides roll at different speeds and wheels are dragged sideways,
        so only the mean of all is used; differential and ackermann: each wheel rolls where it points, straight ahead or
        as it is steered. A wheel whose steering angle nothing measures rolls where its contact point goes.
    steering: where the angle of wheels that steer comes from, where they do not measure it themselves.
    latency: seconds by which the stamps are later than the measurement; subtracted from each stamp.
    """

    __pydantic_config__: ClassVar[ConfigDict] = _STRICT
    channel: str = "WHEELS"
    frames: dict[str, str] = field(default_factory=dict)
    kinematics: Literal["skid_steer", "differential", "ackermann"] = "differential"
    steering: SteeringConfig | None = None
    latency: float = 0.0

    def __post_init__(self) -> None:
        _refuse(_channel_problems(self.channel) + _latency_problems(self.latency))


@dataclass(frozen=True, slots=True)
class AidingConfig:
    """A further source: the channel it is heard on, and what its messages are. They name their frames themselves.

    latency: seconds by which its stamps are later than the measurement; subtracted from each stamp.
    """

    __pydantic_config__: ClassVar[ConfigDict] = _STRICT
    channel: str
    type: Literal["absolute_pose", "relative_pose", "range"]
    latency: float = 0.0

    def __post_init__(self) -> None:
        _refuse(_channel_problems(self.channel) + _latency_problems(self.latency))


@dataclass(frozen=True, slots=True)
class JointsConfig:
    """The joints of the geometry that move: the channel that their drivers tell of them on.

    latency: seconds by which the stamps are later than the measurement; subtracted from each stamp.
    """

    __pydantic_config__: ClassVar[ConfigDict] = _STRICT
    channel: str = "JOINTS"
    latency: float = 0.0

    def __post_init__(self) -> None:
        _refuse(_channel_problems(self.channel) + _latency_problems(self.latency))


@dataclass(frozen=True, slots=True)
class SensorsConfig:
    """Which sensors there are. Where they sit stands in the geometry file alone.

    joints: where the joints are told of; heard wherever the geometry has any that move.
    aiding: further sources, each by the name that it gives itself in its messages (header.source).
    second_writer: what is done with samples of a second writer on a channel while the first one speaks: ignore or use.
    """

    __pydantic_config__: ClassVar[ConfigDict] = _STRICT
    gps: GpsConfig | None = None
    imu: SensorConfig | None = None
    wheels: WheelsConfig | None = None
    joints: JointsConfig = field(default_factory=JointsConfig)
    aiding: dict[str, AidingConfig] = field(default_factory=dict)
    second_writer: Literal["ignore", "use"] = "ignore"

    def __post_init__(self) -> None:
        for name in self.aiding:
            if not (0 < len(name) <= MAX_NAME and name.isprintable()):
                raise ValueError(f"aiding names sources with 1 to {MAX_NAME} printable characters, got {shown(name)}")
        sensors = (self.gps, self.imu, self.wheels, self.steering, self.joints, *self.aiding.values())
        channels = [each.channel for each in sensors if each]
        twice = {channel for channel in channels if channels.count(channel) > 1}
        if twice:
            raise ValueError(f"each sensor has a channel of its own; {shown(min(twice))} is given twice")

    @property
    def steering(self) -> SteeringConfig | None:
        """Where the steering angle comes from; None where nothing measures it beside the wheels."""
        return self.wheels.steering if self.wheels is not None else None


@dataclass(frozen=True, slots=True)
class OriginConfig:
    """The origin of World:UTM, when it is not to be captured from the first good fixes.

    initial_utm: grid easting, grid northing, height above the ellipsoid, metres: a datum shared by several runs.
    zone: UTM zone, 1 to 60. hemisphere: north or south.
    keep: whether a captured origin is kept across restarts (in state_directory).
    """

    __pydantic_config__: ClassVar[ConfigDict] = _STRICT
    initial_utm: tuple[float, float, float] | None = None
    zone: int | None = None
    hemisphere: Literal["north", "south"] | None = None
    keep: bool = True

    def __post_init__(self) -> None:
        given = [value is not None for value in (self.initial_utm, self.zone, self.hemisphere)]
        if any(given) and not all(given):
            raise ValueError("initial_utm, zone and hemisphere are given together or not at all")
        if self.zone is not None and not 1 <= self.zone <= 60:
            raise ValueError(f"a UTM zone is 1 to 60, got {self.zone}")


@dataclass(frozen=True, slots=True)
class LocalizationConfig:
    """How the pose comes about.

    mode: which sources are used from the start, see `modelserver.messages.Mode`. mode_channel: what signed wishes for
    another mode name as their channel; empty: nobody can switch from the bus. raw, filter: the settings of raw mode and
    of the filter.
    """

    __pydantic_config__: ClassVar[ConfigDict] = _STRICT
    mode: Literal["full", "raw", "no_imu", "no_wheels", "no_gps", "dead_reckoning"] = "full"
    mode_channel: str = ""
    raw: RawSettings = field(default_factory=RawSettings)
    filter: FilterSettings = field(default_factory=FilterSettings)
    magnetometer: MagnetometerCalibration = field(default_factory=MagnetometerCalibration)

    def __post_init__(self) -> None:
        if self.mode_channel:
            _refuse(_channel_problems(self.mode_channel, "mode_channel"))

    @property
    def first_mode(self) -> Mode:
        """The mode from the start, as the core knows it."""
        return Mode[self.mode.upper()]


@dataclass(frozen=True, slots=True)
class LimitsConfig:
    """What the server holds and does at most, so that strangers cannot starve the pose.

    history_s: seconds of poses held, at most 600, for questions about the past.
    parked_requests: requests that may wait for data at once. wait_ms: the longest wait granted, milliseconds.
    queued_requests: requests that may wait; more are dropped and counted.
    requests_per_pass: requests answered before the loop looks at sensors again.
    client_hz: requests per second that are guaranteed to each client; more are answered while there is time.
    request_share: share of the time for requests before clients get their rates alone, while others need the time.
    client_reply_bytes: bytes per second of long replies (many transformations, history) to each client.
    """

    __pydantic_config__: ClassVar[ConfigDict] = _STRICT
    history_s: float = 60.0
    parked_requests: int = 64
    wait_ms: int = 2000
    queued_requests: int = 256
    requests_per_pass: int = 16
    client_hz: float = 500.0
    request_share: float = 0.25
    client_reply_bytes: float = 5_000_000.0

    def __post_init__(self) -> None:
        problems = []
        if not 1.0 <= self.client_hz <= 100_000.0:
            problems.append(f"client_hz is between 1 and 100000, got {self.client_hz:g}")
        if not 0.0 <= self.request_share <= 1.0:
            problems.append(f"request_share is between 0 and 1, got {self.request_share:g}")
        if not 1e4 <= self.client_reply_bytes <= 1e9:
            problems.append(f"client_reply_bytes is between 10000 and 1e9, got {self.client_reply_bytes:g}")
        if not 0.0 < self.history_s <= 600.0:
            problems.append(f"history_s is above 0 and at most 600, got {self.history_s:g}")
        for name, low, high in (
            ("parked_requests", 0, 4096),
            ("wait_ms", 0, 60_000),
            ("queued_requests", 1, 65536),
            ("requests_per_pass", 1, 1024),
        ):
            if not low <= getattr(self, name) <= high:
                problems.append(f"{name} is between {low} and {high}, got {getattr(self, name)}")
        _refuse(problems)


MAKE_KEY = (
    "only signed messages change the service; modelserver key new /etc/modelserver/commands.key makes a key, then "
    "write key_file: /etc/modelserver/commands.key under commands"
)


@dataclass(frozen=True, slots=True)
class CommandsConfig:
    """What may be asked of the service from the bus that changes what it knows. Nothing by default.

    reload: reading the geometry file anew. set_pose: telling localization where the vehicle is.
    key_file: the secrets that such a message must be signed with, relative to this file; see `modelserver.keys`.
    window_s: how old a signed message may be, seconds, by the vehicle's clock.
    """

    __pydantic_config__: ClassVar[ConfigDict] = _STRICT
    reload: bool = False
    set_pose: bool = False
    key_file: str = ""
    window_s: float = 5.0

    def __post_init__(self) -> None:
        problems = []
        if not 0.1 <= self.window_s <= 300.0:
            problems.append(f"window_s is between 0.1 and 300 seconds, got {self.window_s:g}")
        if not self.key_file:
            problems += [f"{name} needs a key_file beside it: {MAKE_KEY}" for name in self._allowed()]
        _refuse(problems)

    def _allowed(self) -> list[str]:
        return [name for name in ("reload", "set_pose") if getattr(self, name)]


@dataclass(frozen=True, slots=True)
class RestartConfig:
    """What is kept for the next start, in state_directory, and when that start uses it.

    keep: whether localization's state is kept. period_s: seconds between two writes.
    max_age_s: the greatest age, seconds, at which kept biases and scales are used.
    max_pose_age_s: the pose of a vehicle that stood is used where nobody watched it for no longer, seconds; 0: never.
    """

    __pydantic_config__: ClassVar[ConfigDict] = _STRICT
    keep: bool = True
    period_s: float = 5.0
    max_age_s: float = 86400.0
    max_pose_age_s: float = 20.0

    def __post_init__(self) -> None:
        _refuse(
            f"{name} is between {low:g} and {high:g}, got {getattr(self, name):g}"
            for name, low, high in (
                ("period_s", 0.5, 600.0),
                ("max_age_s", 0.0, 31536000.0),
                ("max_pose_age_s", 0.0, 600.0),
            )
            if not low <= getattr(self, name) <= high
        )


@dataclass(frozen=True, slots=True)
class JournalConfig:
    """The black box: everything that is handled and said, on disk; see docs/journal.md.

    directory: where, relative to this file; empty: `journal-` and the vehicle's name in the state directory.
    megabytes: what it may take, 32 at least; 0: no journal. By default 1024 under systemd or where a directory is
        named, else none.
    sync_s: seconds between two times that the disk is told to hold it: what a loss of power costs at most.
    """

    __pydantic_config__: ClassVar[ConfigDict] = _STRICT
    directory: str = ""
    megabytes: int | None = None
    sync_s: float = 2.0

    def __post_init__(self) -> None:
        problems = []
        if self.megabytes is not None and self.megabytes != 0 and not 32 <= self.megabytes <= 1_000_000:
            problems.append(f"megabytes is 0 for no journal, or 32 to 1000000, got {self.megabytes}")
        if not 0.2 <= self.sync_s <= 60.0:
            problems.append(f"sync_s is between 0.2 and 60 seconds, got {self.sync_s:g}")
        _refuse(problems)


@dataclass(frozen=True, slots=True)
class VehicleConfig:
    """A vehicle: its geometry, its sensors, and how the service runs for it.

    vehicle: name, for people. geometry: path of the geometry file, relative to this file.
    variables: values for the $NAMES in a frame-tree file. base_frame: the frame that POSE describes.
    rolling_frame: the frame that moves along its own x axis when the vehicle turns: the middle of the rear axle of one
        with steered front wheels, the middle of a skid-steered one. Empty for base_frame.
    state_directory: where origin and state are kept, relative to this file; empty for the user's state directory.
    drivers: for each driver's name the kind of its device and what that kind wants to know. The service does not look
        into them; `msdrivers.settings` does.
    """

    __pydantic_config__: ClassVar[ConfigDict] = _STRICT
    vehicle: str
    geometry: str
    base_frame: str
    rolling_frame: str = ""
    variables: dict[str, str] = field(default_factory=dict)
    state_directory: str = ""
    lcm: LcmConfig = field(default_factory=LcmConfig)
    publish: PublishConfig = field(default_factory=PublishConfig)
    sensors: SensorsConfig = field(default_factory=SensorsConfig)
    origin: OriginConfig = field(default_factory=OriginConfig)
    localization: LocalizationConfig = field(default_factory=LocalizationConfig)
    limits: LimitsConfig = field(default_factory=LimitsConfig)
    commands: CommandsConfig = field(default_factory=CommandsConfig)
    restart: RestartConfig = field(default_factory=RestartConfig)
    journal: JournalConfig = field(default_factory=JournalConfig)
    drivers: dict[str, dict[str, Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in self.drivers:
            # it is a word of the command line, and the source in the headers of its samples
            if not (0 < len(name) <= MAX_NAME and name.isprintable() and " " not in name):
                raise ValueError(
                    f"drivers have names of 1 to {MAX_NAME} printable characters without spaces, got {shown(name)}"
                )


def load_config(path: str | Path) -> VehicleConfig:
    """Read a vehicle file. Raises ConfigError with every problem, OSError where it cannot be read.

    The paths in it come back absolute.
    """
    path = Path(path)
    return _with_paths(parse_config(_bytes(path), str(path)), path)


def load_partly(path: str | Path, *, blank: bool = False) -> tuple[VehicleConfig | None, tuple[Problem, ...]]:
    """Read a vehicle file without what is wrong in it: None where too little is left; and every problem.

    With `blank` the name, the geometry or the base frame that is missing is empty, so that the rest can be examined.
    Raises ConfigError for what is no YAML mapping, OSError where it cannot be read.
    """
    path = Path(path)
    config, problems = parse_partly(_bytes(path), str(path), blank=blank)
    return None if config is None else _with_paths(config, path), problems


def with_lines(problems: Iterable[Problem], path: str) -> list[Problem]:
    """Return problems of a vehicle file with the line of the key that each is about, as far as it stands there."""
    problems = list(problems)
    try:
        lines = {".".join(map(str, at)): line for at, line in config_lines(path).items()}
    except (OSError, ConfigError):
        return problems

    def line(key: str) -> int:
        while key and key not in lines:
            key = key.rpartition(".")[0]
        return lines.get(key, 0)

    return [
        dataclasses.replace(each, source=dataclasses.replace(each.source, line=line(each.element)))
        if each.file == path and not each.line
        else each
        for each in problems
    ]


NOT_ONE = "not a vehicle file"
"""What is said last of a file of another kind."""

_BEGIN = "start with: vehicle, geometry, base_frame; docs/vehicle-file.md has an example"
_MODEL = "query, bodies and frames take it with --model"
_INSTEAD: dict[FileKind, str] = {
    FileKind.EMPTY: _BEGIN,
    FileKind.COMMENTS: _BEGIN,
    FileKind.GEOMETRY: f"give the vehicle file, which names it (geometry: {{name}}); {_MODEL}",
    FileKind.URDF: f"give the vehicle file, which names it (geometry: {{name}}); {_MODEL}",
    FileKind.MIRO_PROCESS: "convert it to a vehicle file: {command}",
    FileKind.XML: f"give the vehicle file, which is YAML; if this is a geometry file, {_MODEL}",
    FileKind.LOG: "give the vehicle file; a log is played by modelserver replay",
    FileKind.BINARY: "give the vehicle file, which is YAML",
}
"""What to give instead of a file that is no vehicle file."""


def _bytes(path: Path) -> bytes:
    """Return what a vehicle file holds.

    Raises ConfigError for a directory, a FIFO, a device, and a file of another kind; OSError.
    """
    try:
        # the beginning of a larger file says what it is; the reader rejects it
        raw = read_start(path, config_reader.MAX_BYTES + 1)
    except NotRegularFileError as error:
        there = next((each for each in ("vehicle.yaml", "vehicle.yml") if (path / each).is_file()), "")
        fix = f"give {path / there}" if error.is_directory and there else "give the vehicle file itself"
        raise _no_vehicle_file(path, f"this is {error.kind}, {NOT_ONE}", fix) from None
    kind = file_kind(raw)
    if kind in _INSTEAD:
        what = kind.value if kind.is_nothing else f"{kind.value}, {NOT_ONE}"
        command = conversion_command(str(path)) if kind is FileKind.MIRO_PROCESS else ""
        raise _no_vehicle_file(path, what, _INSTEAD[kind].format(name=path.name, command=command))
    return raw


def _no_vehicle_file(path: Path, what: str, fix: str) -> ConfigError:
    return ConfigError([Problem(Severity.ERROR, what, Location(str(path)), fix)])


def _with_paths(config: VehicleConfig, path: Path) -> VehicleConfig:
    def absolute(given: str) -> str:
        return str((path.parent / Path(given).expanduser()).resolve())

    return dataclasses.replace(
        config,
        geometry=absolute(config.geometry) if config.geometry else "",
        state_directory=absolute(config.state_directory) if config.state_directory else "",
        commands=dataclasses.replace(
            config.commands, key_file=absolute(config.commands.key_file) if config.commands.key_file else ""
        ),
        journal=dataclasses.replace(
            config.journal, directory=absolute(config.journal.directory) if config.journal.directory else ""
        ),
    )


def config_lines(path: str | Path) -> dict[tuple[str | int, ...], int]:
    """Return the line of each key of a vehicle file. Raises ConfigError, OSError."""
    return config_reader.lines(_bytes(Path(path)), str(path), VehicleConfig)


def parse_partly(
    raw: bytes, name: str = "", *, blank: bool = False
) -> tuple[VehicleConfig | None, tuple[Problem, ...]]:
    """Check the bytes of a vehicle file called `name`; as `load_partly`, with the paths as they stand there."""
    blanks = dict.fromkeys(("vehicle", "geometry", "base_frame"), "") if blank else None
    return config_reader.read_partly(raw, name, VehicleConfig, blanks)


def parse_config(raw: bytes, name: str = "") -> VehicleConfig:
    """Check the bytes of a vehicle file called `name`. Raises ConfigError with every problem."""
    return config_reader.read(raw, name, VehicleConfig)
