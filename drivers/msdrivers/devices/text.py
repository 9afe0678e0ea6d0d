"""Drivers of devices that send lines of text, whose columns the vehicle file describes: an inertial unit, joints.

imu:                                                head:
  device: text_imu                                    device: text_joints
  port: /dev/ttyACM0                                  port: /dev/ttyUSB3
  columns: 7   # 1234,0.01,-0.02,1.00,0.5,0.1,-0.3    columns: 2   # 12.50 -3.25
  fields:                                             separator: ""
    time: {column: 0, scale: 0.001}                   joints:
    specific_force_x: {column: 1, scale: 9.80665}       Pan: {column: 0, scale: 0.0174533}
    ...                                                 Tilt: {column: 1, scale: 0.0174533}

A line is used if it has as many columns as described, and each that is used is a number within its limit. The first
line after the port was opened is not used: it may be the end of one.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from functools import reduce
from operator import xor
from typing import Final, NamedTuple

from modelserver.errors import quote, suggest_name
from modelserver.messages import NAN, ImuSample, JointSample, JointsSample, Sample, SensorHeader
from modelserver.transforms.so3 import Vector3
from msdrivers.devices import Strict, check_choice, check_factor, check_ranges
from msdrivers.devices.stream import NEVER_NS, ByteSettings, ParsedFrame, Script, StreamDriver, recognize_line
from msdrivers.endpoint import EndpointPhase, HostTime, Output

MAX_LINE: Final = 1024
"""Longer lines are cut."""


@dataclass(frozen=True, slots=True)
class ColumnMap(Strict):
    """A number of a line: that of `column` times `scale` plus `offset`, in SI units."""

    column: int
    """Number of the column, from 0."""
    scale: float = 1.0
    """Factor: 9.80665 for g, 0.0174533 for degrees per second, 1e-6 for microtesla, 0.001 for milliseconds."""
    offset: float = 0.0
    """Offset after scaling."""

    def __post_init__(self) -> None:
        if not 0 <= self.column < 256:
            raise ValueError(f"column is 0 to 255, got {self.column}")
        check_factor(self.scale, "scale")


@dataclass(frozen=True, slots=True, kw_only=True)
class TextSettings(Strict, ByteSettings):
    """Settings that these devices have in common. Raises ValueError with the key for an invalid value."""

    columns: int
    """Number of columns of a line; others are rejected."""
    separator: str = ","
    """What separates columns; empty: spaces or tabs."""
    starts_with: str = ""
    """What a line with measurements begins with, such as a name in column 0; other lines are not used."""
    checksum: str = "none"
    """`xor`: a line ends with * and the exclusive-or of the characters before, as in NMEA; `none`."""
    silence: float = 1.0
    """Timeout for usable lines, seconds."""
    delay: float = 0.0
    """From the measurement to the device's time, or to the arrival of the line's first byte, seconds."""
    delay_sigma: float = 0.005
    """Its standard deviation, seconds."""

    def __post_init__(self) -> None:
        ByteSettings.__post_init__(self)
        check_ranges(self, columns=(1, 256))
        check_choice(self, checksum=("none", "xor"))
        for name, column in self.mapped.items():
            if column.column >= self.columns:
                raise ValueError(f"fields: {name} is in column {column.column}, but a line has {self.columns}, from 0")

    @property
    def mapped(self) -> Mapping[str, ColumnMap]:
        """The columns by what they are."""
        raise NotImplementedError


class TextLine(NamedTuple):
    """A line without its end, and the offset of its first byte in the stream. is_cut: only a part of it."""

    data: bytes
    start: int
    is_cut: bool = False


class LineFormat:
    """A `FrameFormat` of lines of text; any byte may begin one."""

    start_bytes = bytes(range(256))

    def scan(self, buffer: bytearray, at: int, start: int) -> ParsedFrame[TextLine] | None:
        end = buffer.find(b"\n", at)
        if end >= 0:
            return ParsedFrame(end + 1, "lines", TextLine(bytes(buffer[at:end]).rstrip(b"\r"), start))
        is_short = len(buffer) - at <= MAX_LINE
        return None if is_short else ParsedFrame(len(buffer), "lines", TextLine(bytes(buffer[at:]), start, True))


def encode_line(description: TextSettings, values: Mapping[str, float]) -> bytes:
    """Return the line of some fields in SI units; columns without a field are 0."""
    columns = ["0"] * description.columns
    for name, each in description.mapped.items():
        columns[each.column] = f"{(values[name] - each.offset) / each.scale:.9g}"
    if description.starts_with:
        columns[0] = description.starts_with
    text = (description.separator or " ").join(columns)
    if description.checksum == "xor":
        text = f"{text}*{reduce(xor, text.removeprefix('$').encode(), 0):02X}"
    return f"{text}\r\n".encode()


class TextDriver(StreamDriver[TextLine]):
    """An `Endpoint` of bytes at the host's end of the device's line.

    Counts: lines, samples, `other_lines`, and `rejected.<reason>`: columns, number, checksum, range, length.
    """

    description = "device that sends lines of text"
    formats = (LineFormat(),)
    _settings: TextSettings

    def __init__(self, settings: TextSettings) -> None:
        super().__init__(settings)
        self.awaited = f"lines of {settings.columns} columns"
        self._is_partial = True
        """What comes next may be the end of a line."""
        self._last_line = b""

    @abstractmethod
    def _make_sample(self, values: Mapping[str, float], header: SensorHeader) -> Sample:
        """Return the sample of a line's numbers in SI units."""

    @abstractmethod
    def _get_limit(self, name: str) -> float:
        """Return the largest magnitude of a field."""

    def _on_start(self) -> None:
        self._is_partial, self._last_line, self._first_bytes = True, b"", b""

    def _run_setup(self) -> Script:
        """Only read."""
        self._restart_silence_timer()
        yield from ()

    def _on_silence(self, now: HostTime) -> list[Output[bytes]]:
        self._silence_deadline_ns = NEVER_NS
        return self._set_status(EndpointPhase.SILENT, self._explain_silence())

    def _explain_silence(self) -> str:
        head = f"no usable line for {self._settings.silence:g} s"
        if self._last_line:
            shown = quote(self._last_line.decode("ascii", "replace"), 80)
            wanted = f"{self._settings.columns} columns" + (
                f" beginning {quote(self._settings.starts_with)}" if self._settings.starts_with else ""
            )
            return f"{head}; the last one was {shown}, expected are {wanted}: check columns, separator and starts_with"
        return f"{head}; {recognize_line(self._first_bytes, self.device)}"

    def _on_message(self, message: TextLine, now: HostTime) -> list[Output[bytes]]:
        is_partial, self._is_partial = self._is_partial, message.is_cut
        if is_partial:
            return []
        self._last_line = message.data[:200]
        values, reason = self._read(message.data)
        if reason == "other_lines":
            self._counts[reason] += 1
        elif reason:
            self._stream.reject(reason)
        if reason:
            return []
        device_utime = max(1, round(1e6 * values["time"])) if "time" in values else 0
        header = self._make_header(self._find_arrival(message.start, now), device_utime)
        return self._publish(self._make_sample(values, header), now, 1e-3)

    def _read(self, line: bytes) -> tuple[dict[str, float], str]:
        """Return the numbers of a line in SI units, or why it is not used."""
        settings = self._settings
        if len(line) > MAX_LINE:
            return {}, "length"
        text = line.decode("latin-1").strip()
        if settings.checksum == "xor":
            text, star, checksum = text.rpartition("*")
            body = text.removeprefix("$").encode("latin-1")
            if not star or checksum.upper() != f"{reduce(xor, body, 0):02X}":
                return {}, "checksum"
        if not text.startswith(settings.starts_with):
            return {}, "other_lines"
        columns = text.split(settings.separator) if settings.separator else text.split()
        if len(columns) != settings.columns:
            return {}, "columns"
        try:
            values = {
                name: float(columns[each.column]) * each.scale + each.offset for name, each in settings.mapped.items()
            }
        except ValueError:
            return {}, "number"
        is_possible = all(abs(value) <= self._get_limit(name) for name, value in values.items())
        return (values, "") if is_possible else ({}, "range")


VECTORS: Final = {"specific_force": 400.0, "angular_velocity": 60.0, "magnetic_field": 0.01}
"""Vectors that a line may have, and what is beyond every such unit: m/s2, rad/s, tesla."""

FIELDS: Final = (*(f"{vector}_{axis}" for vector in VECTORS for axis in "xyz"), "temperature", "time")


@dataclass(frozen=True, slots=True, kw_only=True)
class TextImuSettings(TextSettings):
    """Settings of a unit that sends lines of text. Raises ValueError with the key for an invalid value."""

    fields: Mapping[str, ColumnMap]
    """Columns by what they are: specific_force_x, _y, _z (m/s2), angular_velocity_x, _y, _z (rad/s),
    magnetic_field_x, _y, _z (tesla), temperature (degrees Celsius), time (seconds of the unit's clock)."""

    def __post_init__(self) -> None:
        for name in self.fields:
            if name not in FIELDS:
                near = suggest_name(name, FIELDS)
                raise ValueError(
                    f"fields: {quote(name)} is unknown; {f'write {near[0]}' if near else ', '.join(FIELDS)}"
                )
        TextSettings.__post_init__(self)
        for vector in VECTORS:
            known = [axis for axis in "xyz" if f"{vector}_{axis}" in self.fields]
            if len(known) in (1, 2) and not (vector == "angular_velocity" and known == ["z"]):
                missing = next(axis for axis in "xyz" if axis not in known)
                raise ValueError(f"fields: {vector}_{missing} is missing beside {vector}_{known[0]}")
        if not any(f"{vector}_z" in self.fields for vector in ("specific_force", "angular_velocity")):
            raise ValueError("fields: has specific_force_x, _y, _z, angular_velocity_x, _y, _z, or both")

    @property
    def mapped(self) -> Mapping[str, ColumnMap]:
        return self.fields


class TextImuDriver(TextDriver):
    """An `Endpoint` of bytes at the host's end of the unit's line; see `TextImuSettings`."""

    device = "text_imu"

    def _get_limit(self, name: str) -> float:
        return VECTORS.get(name[:-2], 1e12)

    def _make_sample(self, values: Mapping[str, float], header: SensorHeader) -> ImuSample:
        return ImuSample(
            header,
            angular_velocity=_get_vector(values, "angular_velocity"),
            specific_force=_get_vector(values, "specific_force"),
            magnetic_field=_get_vector(values, "magnetic_field"),
            temperature_celsius=values.get("temperature", NAN),
        )


def _get_vector(values: Mapping[str, float], name: str) -> Vector3 | None:
    if f"{name}_z" not in values:
        return None
    x, y, z = (values.get(f"{name}_{axis}", math.nan) for axis in "xyz")
    return (x, y, z)


TIME: Final = "time"

MAX_POSITION: Final = 1000.0
"""Radians or meters; a joint beyond is none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TextJointsSettings(TextSettings):
    """Settings of a device that sends joints as lines of text. Raises ValueError with the key for an invalid value."""

    joints: Mapping[str, ColumnMap]
    """Columns by the names of the constraints in the geometry; radians or meters."""
    time: ColumnMap | None = None
    """Column of the device's clock, seconds."""
    sigma: float = 0.0
    """Standard deviation of a position, radians or meters; 0: that of the joint in the geometry."""

    def __post_init__(self) -> None:
        if not 1 <= len(self.joints) <= 64:
            raise ValueError(f"joints has 1 to 64 joints, got {len(self.joints)}")
        TextSettings.__post_init__(self)
        check_ranges(self, sigma=(0.0, 10.0))

    @property
    def mapped(self) -> Mapping[str, ColumnMap]:
        return {**self.joints, **({} if self.time is None else {TIME: self.time})}


class TextJointsDriver(TextDriver):
    """An `Endpoint` of bytes at the host's end of the device's line; see `TextJointsSettings`."""

    device = "text_joints"

    def __init__(self, settings: TextJointsSettings) -> None:
        super().__init__(settings)
        self._joints, self._sigma = tuple(settings.joints), settings.sigma or NAN

    def _get_limit(self, name: str) -> float:
        return 1e12 if name == TIME else MAX_POSITION

    def _make_sample(self, values: Mapping[str, float], header: SensorHeader) -> JointsSample:
        return JointsSample(header, tuple(JointSample(name, values[name], self._sigma) for name in self._joints))
