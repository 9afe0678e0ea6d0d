"""The vehicle file: typed, strict, every tunable in one place.

`load_config(path)` reads a YAML file and returns a `VehicleConfig`, or raises ConfigError with every problem at
once: file, line, key, what is wrong, and for a mistyped key the nearest known one.
"""

from __future__ import annotations

import dataclasses
import json
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal, get_args, get_type_hints

import yaml
from pydantic import ConfigDict, TypeAdapter, ValidationError

from modelserver.errors import ConfigError, Problem, Severity, Source, nearest_names, shown
from modelserver.localization.settings import RawSettings

_STRICT: ConfigDict = {"extra": "forbid", "allow_inf_nan": False}

MAX_FILE_BYTES = 1 << 20

MAX_DEPTH = 16
"""No section nests deeper than 3. PyYAML's composer calls itself for each level, in C, and would end the process."""

MAX_CHANNEL = 39
"""Characters of a sensor's channel: LCM takes 63, and a prefix has up to 24."""


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
        for key, value in (("channel_prefix", self.channel_prefix), ("reply_prefix", self.reply_prefix)):
            if not all(c.isascii() and (c.isalnum() or c == "_") for c in value) or len(value) > 24:
                raise ValueError(f"{key} has at most 24 letters, digits and underscores, got {shown(value)}")
        if not self.reply_prefix:
            raise ValueError("reply_prefix must not be empty: it keeps requests from making the server speak on POSE")


@dataclass(frozen=True, slots=True)
class PublishConfig:
    """What is broadcast, and when.

    mode: `timer` publishes POSE at rate_hz; `event` on every sample of an IMU or GPS that was taken.
    rate_hz: poses a second in timer mode. health_hz: health reports a second.
    """

    __pydantic_config__: ClassVar[ConfigDict] = _STRICT
    mode: Literal["timer", "event"] = "timer"
    rate_hz: float = 50.0
    health_hz: float = 1.0

    def __post_init__(self) -> None:
        if not 0.1 <= self.rate_hz <= 1000.0:
            raise ValueError(f"rate_hz is between 0.1 and 1000, got {self.rate_hz:g}")
        if not 0.01 <= self.health_hz <= 100.0:
            raise ValueError(f"health_hz is between 0.01 and 100, got {self.health_hz:g}")


def _check_channel(channel: str) -> None:
    if not (0 < len(channel) <= MAX_CHANNEL and channel.isascii() and channel.isprintable() and " " not in channel):
        raise ValueError(f"channel has 1 to {MAX_CHANNEL} printable ASCII characters, no spaces, got {shown(channel)}")


@dataclass(frozen=True, slots=True)
class SensorConfig:
    """One sensor: the channel it is heard on, and the frame of the geometry it is mounted at."""

    __pydantic_config__: ClassVar[ConfigDict] = _STRICT
    channel: str
    frame: str

    def __post_init__(self) -> None:
        _check_channel(self.channel)


@dataclass(frozen=True, slots=True)
class WheelsConfig:
    """The wheels: the channel they are heard on, and for each wheel's name the frame of its contact point."""

    __pydantic_config__: ClassVar[ConfigDict] = _STRICT
    channel: str = "WHEELS"
    frames: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _check_channel(self.channel)


@dataclass(frozen=True, slots=True)
class SensorsConfig:
    """Which sensors there are. Where they sit stands in the geometry file alone."""

    __pydantic_config__: ClassVar[ConfigDict] = _STRICT
    gps: SensorConfig | None = None
    imu: SensorConfig | None = None
    wheels: WheelsConfig | None = None

    def __post_init__(self) -> None:
        channels = [each.channel for each in (self.gps, self.imu, self.wheels) if each is not None]
        twice = {channel for channel in channels if channels.count(channel) > 1}
        if twice:
            raise ValueError(f"each sensor has a channel of its own; {shown(min(twice))} is given twice")


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
class LimitsConfig:
    """What the server holds and does at most, so that strangers cannot starve the pose.

    history_s: seconds of poses held, at most 600, for questions about the past.
    parked_requests: requests that may wait for data at once. wait_ms: the longest wait granted, milliseconds.
    queued_requests: requests held between two passes of the loop; more are refused and counted.
    requests_per_pass: requests answered before sensors are looked at again.
    """

    __pydantic_config__: ClassVar[ConfigDict] = _STRICT
    history_s: float = 60.0
    parked_requests: int = 64
    wait_ms: int = 2000
    queued_requests: int = 256
    requests_per_pass: int = 16

    def __post_init__(self) -> None:
        if not 0.0 < self.history_s <= 600.0:
            raise ValueError(f"history_s is above 0 and at most 600, got {self.history_s:g}")
        for name, low, high in (
            ("parked_requests", 0, 4096),
            ("wait_ms", 0, 60_000),
            ("queued_requests", 1, 65536),
            ("requests_per_pass", 1, 1024),
        ):
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"{name} is between {low} and {high}, got {getattr(self, name)}")


@dataclass(frozen=True, slots=True)
class VehicleConfig:
    """A vehicle: its geometry, its sensors, and how the service runs for it.

    vehicle: name, for people. geometry: path of the geometry file, relative to this file.
    variables: values for the $NAMES in a frame-tree file. base_frame: the frame that POSE describes.
    rolling_frame: the frame that moves along its own x axis when the vehicle turns: the middle of the rear axle of one
        with steered front wheels, the middle of a skid-steered one. Empty for base_frame.
    state_directory: where the captured origin is kept, relative to this file; empty for the user's state directory.
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
    localization: RawSettings = field(default_factory=RawSettings)
    limits: LimitsConfig = field(default_factory=LimitsConfig)


def load_config(path: str | Path) -> VehicleConfig:
    """Read a vehicle file. Raises ConfigError with every problem, OSError where it cannot be read.

    The paths in it come back absolute.
    """
    path = Path(path)
    with path.open("rb") as file:
        raw = file.read(MAX_FILE_BYTES + 1)
    config = parse_config(raw, str(path))

    def absolute(given: str) -> str:
        return str((path.parent / Path(given).expanduser()).resolve())

    return dataclasses.replace(
        config,
        geometry=absolute(config.geometry),
        state_directory=absolute(config.state_directory) if config.state_directory else "",
    )


def parse_config(raw: bytes, name: str = "") -> VehicleConfig:
    """Check the bytes of a vehicle file called `name`. Raises ConfigError with every problem."""
    if len(raw) > MAX_FILE_BYTES:
        raise _one(name, 0, f"the file is larger than {MAX_FILE_BYTES >> 20} MiB", "is this the vehicle file?")
    try:
        _check_shape(raw, name)
        node = yaml.compose(raw, Loader=yaml.CSafeLoader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        what = getattr(error, "problem", None) or str(error).splitlines()[0]
        raise _one(name, mark.line + 1 if mark else 0, f"not YAML: {what}", "check indentation and quotes") from None
    except UnicodeDecodeError:
        raise _one(name, 0, "not text in UTF-8", "is this the vehicle file?") from None
    if not isinstance(node, yaml.MappingNode):
        raise _one(name, 1, "the file is empty or no mapping", "start with: vehicle, geometry, base_frame")
    reader = _Reader(name)
    values = reader.value(node, ())
    if reader.problems:
        raise ConfigError(reader.problems)
    try:
        # by way of JSON: strict there means that "4" is no number, while a mapping still makes a section
        return TypeAdapter(VehicleConfig).validate_json(json.dumps(values, default=str), strict=True)
    except ValidationError as error:
        raise ConfigError(reader.explain(detail) for detail in error.errors()) from None


Path_ = tuple[str | int, ...]


class _Reader:
    """Turns YAML nodes into plain values, and remembers the line of each."""

    def __init__(self, name: str):
        self.name = name
        self.lines: dict[Path_, int] = {}
        self.problems: list[Problem] = []

    def value(self, node: yaml.Node, at: Path_) -> Any:
        self.lines.setdefault(at, node.start_mark.line + 1)
        if isinstance(node, yaml.MappingNode):
            values: dict[str, Any] = {}
            for key_node, value_node in node.value:
                if not isinstance(key_node, yaml.ScalarNode):
                    self.lines[(*at, "?")] = key_node.start_mark.line + 1
                    self.problem((*at, "?"), "a key is a name, not a list or a mapping", "write name: value")
                    continue
                key = str(key_node.value)
                if key in values:
                    first = self.lines[(*at, key)]
                    self.lines[(*at, key)] = key_node.start_mark.line + 1
                    self.problem((*at, key), f"{key} is given twice (first on line {first})", "remove one")
                    continue
                self.lines[(*at, key)] = key_node.start_mark.line + 1
                value = self.value(value_node, (*at, key))
                # a key with nothing after it counts as left out, as when all of a section is commented out
                if value is not None:
                    values[key] = value
            return values
        if isinstance(node, yaml.SequenceNode):
            return [self.value(each, (*at, index)) for index, each in enumerate(node.value)]
        return _scalar(node)

    def problem(self, at: Path_, message: str, fix: str, nearest: tuple[str, ...] = ()) -> None:
        self.problems.append(Problem(Severity.ERROR, message, self.place(at), fix, nearest))

    def place(self, at: Path_) -> Source:
        line = next((self.lines[at[:n]] for n in range(len(at), -1, -1) if at[:n] in self.lines), 0)
        return Source(self.name, line, ".".join(map(str, at)))

    def explain(self, detail: Any) -> Problem:
        """Turn one of pydantic's findings into a problem with its line and the nearest key."""
        at: Path_ = tuple(detail["loc"])
        if detail["type"] in ("unexpected_keyword_argument", "extra_forbidden"):
            known = _known_keys(at[:-1])
            near = nearest_names(str(at[-1]), known)
            fix = f"write {near[0]}" if near else f"known here: {', '.join(known)}"
            return Problem(Severity.ERROR, f"unknown key {shown(str(at[-1]))}", self.place(at), fix, near)
        if detail["type"] == "missing" and isinstance(at[-1], int):
            at = at[:-1]
            return Problem(Severity.ERROR, f"{at[-1]} has too few numbers", self.place(at))
        if detail["type"] == "missing":
            return Problem(Severity.ERROR, f"{at[-1]} is missing", self.place(at), f"add a line: {at[-1]}: ...")
        message = str(detail["msg"]).removeprefix("Value error, ")
        got = detail.get("input")
        if detail["type"] == "value_error":
            # found by the section as a whole; the message begins with the key that it is about
            key = message.partition(" ")[0]
            at = (*at, key) if (*at, key) in self.lines else at
        elif detail["type"] in ("dataclass_type", "dict_type"):
            message = "expected a mapping (key: value, one a line)"
        if detail["type"] != "value_error" and isinstance(got, (str, int, float, bool)):
            message += f", got {shown(str(got))}"
        if len(message) > 240:
            message = f"{message[:240]}..."
        return Problem(Severity.ERROR, message[:1].lower() + message[1:], self.place(at), "")


_EXPONENT = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+", re.ASCII)
"""Numbers such as 1e-3, which YAML 1.1 takes for text."""


def _scalar(node: yaml.Node) -> Any:
    if isinstance(node, yaml.ScalarNode) and not node.style and _EXPONENT.fullmatch(node.value):
        return float(node.value)
    loader = yaml.CSafeLoader("")
    try:
        return loader.construct_object(node, deep=True)
    except (yaml.YAMLError, ValueError):
        return str(node.value)


def _known_keys(at: Path_) -> list[str]:
    """Return the keys known at a place in the file."""
    kind: Any = VehicleConfig
    for step in at:
        hints = get_type_hints(kind) if dataclasses.is_dataclass(kind) else {}
        kind = hints.get(str(step))
        kind = next((each for each in (kind, *get_args(kind)) if dataclasses.is_dataclass(each)), None)
    return [each.name for each in dataclasses.fields(kind)] if dataclasses.is_dataclass(kind) else []


def _check_shape(raw: bytes, name: str) -> None:
    """Raise ConfigError for what no vehicle file has and the composer cannot bear: deep nesting, aliases of aliases."""
    depth = 0
    for event in yaml.parse(raw, Loader=yaml.CSafeLoader):
        line = event.start_mark.line + 1 if event.start_mark else 0
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
            if depth > MAX_DEPTH:
                raise _one(name, line, "nested too deeply", "look for brackets that are not closed")
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        elif isinstance(event, yaml.AliasEvent):
            raise _one(name, line, f"aliases (*{event.anchor}) are not read here", "write the value again")


def _one(name: str, line: int, message: str, fix: str) -> ConfigError:
    return ConfigError([Problem(Severity.ERROR, message, Source(name, line), fix)])
