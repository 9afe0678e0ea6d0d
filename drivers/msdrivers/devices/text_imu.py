"""Driver of an inertial unit that sends lines of text, as microcontrollers do: the vehicle file describes its columns.

    imu:
      device: text_imu
      port: /dev/ttyACM0
      baud: 115200
      columns: 7                                        # 1234,0.01,-0.02,1.00,0.5,0.1,-0.3
      fields:
        time: {column: 0, scale: 0.001}                 # milliseconds
        specific_force_x: {column: 1, scale: 9.80665}   # g
        specific_force_y: {column: 2, scale: 9.80665}
        ...
        angular_velocity_x: {column: 4, scale: 0.0174533}   # degrees per second

A line is used if it has as many columns as described, and each that is used is a number within what such a unit can
measure. The first line after the port was opened is not used: it may be the end of one.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import xor
from typing import Final

from modelserver.errors import quote, suggest_name
from modelserver.messages import NAN, ImuSample, SensorHeader
from modelserver.transforms.so3 import Vector3
from msdrivers.devices.ranges import check_ranges
from msdrivers.endpoint import EndpointPhase, EndpointStatus, HostTime, MeasuredSample, Output
from msdrivers.protocol.can.mapping import Strict
from msdrivers.protocol.recognition import recognize_line
from msdrivers.protocol.text_lines import MAX_LINE, ColumnMap, LineReader

VECTORS: Final = {"specific_force": 400.0, "angular_velocity": 60.0, "magnetic_field": 0.01}
"""Vectors that a line may have, and what is beyond every such unit: m/s2, rad/s, tesla."""

FIELDS: Final = (*(f"{vector}_{axis}" for vector in VECTORS for axis in "xyz"), "temperature", "time")

EXAMINED_BYTES: Final = 4096
_SECOND_NS: Final = 1_000_000_000


@dataclass(frozen=True, slots=True)
class TextImuSettings(Strict):
    """Settings of a unit that sends lines of text. Raises ValueError with the key for an invalid value."""

    source: str
    fields: Mapping[str, ColumnMap]
    """Columns by what they are: specific_force_x, _y, _z (m/s2), angular_velocity_x, _y, _z (rad/s),
    magnetic_field_x, _y, _z (tesla), temperature (degrees Celsius), time (seconds of the unit's clock)."""
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
    """From the measurement to the unit's time, or to the arrival of the line's first byte, seconds."""
    delay_sigma: float = 0.005
    """Its standard deviation, seconds."""

    def __post_init__(self) -> None:
        check_ranges(self, columns=(1, 256), silence=(0.05, 3600.0), delay=(-5.0, 5.0), delay_sigma=(0.0, 5.0))
        if self.checksum not in ("none", "xor"):
            raise ValueError(f"checksum is none or xor, got {quote(self.checksum)}")
        for name, column in self.fields.items():
            if name not in FIELDS:
                near = suggest_name(name, FIELDS)
                raise ValueError(
                    f"fields: {quote(name)} is unknown; {f'write {near[0]}' if near else ', '.join(FIELDS)}"
                )
            if column.column >= self.columns:
                raise ValueError(f"fields: {name} is in column {column.column}, but a line has {self.columns}, from 0")
        for vector in VECTORS:
            known = [axis for axis in "xyz" if f"{vector}_{axis}" in self.fields]
            if len(known) in (1, 2) and not (vector == "angular_velocity" and known == ["z"]):
                missing = next(axis for axis in "xyz" if axis not in known)
                raise ValueError(f"fields: {vector}_{missing} is missing beside {vector}_{known[0]}")
        if not any(f"{vector}_z" in self.fields for vector in ("specific_force", "angular_velocity")):
            raise ValueError("fields: has specific_force_x, _y, _z, angular_velocity_x, _y, _z, or both")


class TextImuDriver:
    """An `Endpoint` of bytes at the host's end of the unit's line; see `TextImuSettings`."""

    def __init__(self, settings: TextImuSettings) -> None:
        self._settings = settings
        self.max_silence = settings.silence
        self._reader = LineReader()
        self._phase, self._reported = EndpointPhase.WAITING, ""
        self._silence_deadline_ns: int | None = None
        self._first_bytes, self._last_line = b"", b""
        self._seq = 0
        self.counts: Counter[str] = Counter()
        """Lines, samples, `other_lines`, and `rejected.<reason>`: columns, number, checksum, range, length."""

    def on_open(self, now: HostTime) -> Sequence[Output[bytes]]:
        """Wait for lines."""
        self._reader.clear()
        self._first_bytes = self._last_line = b""
        self._silence_deadline_ns = now.monotonic_ns + round(self._settings.silence * _SECOND_NS)
        return self._set_status(EndpointPhase.WAITING, "waiting for lines of text")

    def on_receive(self, unit: bytes, now: HostTime) -> Sequence[Output[bytes]]:
        """Process received bytes."""
        if len(self._first_bytes) < EXAMINED_BYTES:
            self._first_bytes += unit[: EXAMINED_BYTES - len(self._first_bytes)]
        out: list[Output[bytes]] = []
        for line, utime in self._reader.feed(unit, now.utime):
            out += self._on_line(line, utime, now)
        return out

    def on_timer(self, now: HostTime) -> Sequence[Output[bytes]]:
        """Report silence."""
        if self._silence_deadline_ns is None or now.monotonic_ns < self._silence_deadline_ns:
            return []
        self._silence_deadline_ns = None
        return self._set_status(EndpointPhase.SILENT, self._explain_silence())

    def get_deadline(self) -> int | None:
        """Return when to call `on_timer`, monotonic nanoseconds."""
        return self._silence_deadline_ns

    def on_close(self, now: HostTime) -> Sequence[Output[bytes]]:
        """Leave the unit as it is."""
        return []

    def _set_status(self, phase: EndpointPhase, text: str) -> list[Output[bytes]]:
        if (phase, text) == (self._phase, self._reported):
            return []
        self._phase, self._reported = phase, text
        return [EndpointStatus(phase, text)]

    def _explain_silence(self) -> str:
        head = f"no usable line for {self._settings.silence:g} s"
        if self._last_line:
            shown = quote(self._last_line.decode("ascii", "replace"), 80)
            wanted = f"{self._settings.columns} columns" + (
                f" beginning {quote(self._settings.starts_with)}" if self._settings.starts_with else ""
            )
            return f"{head}; the last one was {shown}, expected are {wanted}: check columns, separator and starts_with"
        return f"{head}; {recognize_line(self._first_bytes, 'text_imu')}"

    def _on_line(self, line: bytes, utime: int, now: HostTime) -> list[Output[bytes]]:
        values = self._read(line)
        if values is None:
            return []
        device_utime = max(1, round(1e6 * values["time"])) if "time" in values else 0
        header = SensorHeader(0, self._settings.source, self._seq, utime, device_utime)
        self._seq += 1
        self.counts["samples"] += 1
        sample = ImuSample(
            header,
            angular_velocity=_get_vector(values, "angular_velocity"),
            specific_force=_get_vector(values, "specific_force"),
            magnetic_field=_get_vector(values, "magnetic_field"),
            temperature_celsius=values.get("temperature", NAN),
        )
        self._silence_deadline_ns = now.monotonic_ns + round(self._settings.silence * _SECOND_NS)
        status = self._set_status(EndpointPhase.STREAMING, f"receiving lines of {self._settings.columns} columns")
        return [MeasuredSample(sample, self._settings.delay, self._settings.delay_sigma, 1e-3), *status]

    def _read(self, line: bytes) -> dict[str, float] | None:
        """Return the numbers of a line in SI units; None, counted by reason, for one that is not used."""
        settings = self._settings
        self.counts["lines"] += 1
        self._last_line = line[:200]
        if len(line) > MAX_LINE:
            self.counts["rejected.length"] += 1
            return None
        text = line.decode("latin-1").strip()
        if settings.checksum == "xor":
            text, star, checksum = text.rpartition("*")
            body = text.removeprefix("$").encode("latin-1")
            if not star or checksum.upper() != f"{reduce(xor, body, 0):02X}":
                self.counts["rejected.checksum"] += 1
                return None
        if not text.startswith(settings.starts_with):
            self.counts["other_lines"] += 1
            return None
        columns = text.split(settings.separator) if settings.separator else text.split()
        if len(columns) != settings.columns:
            self.counts["rejected.columns"] += 1
            return None
        try:
            values = {
                name: float(columns[each.column]) * each.scale + each.offset for name, each in settings.fields.items()
            }
        except ValueError:
            self.counts["rejected.number"] += 1
            return None
        for name, value in values.items():
            if not abs(value) <= VECTORS.get(name[:-2], 1e12):
                self.counts["rejected.range"] += 1
                return None
        return values


def _get_vector(values: Mapping[str, float], name: str) -> Vector3 | None:
    if f"{name}_z" not in values:
        return None
    x, y, z = (values.get(f"{name}_{axis}", math.nan) for axis in "xyz")
    return (x, y, z)
