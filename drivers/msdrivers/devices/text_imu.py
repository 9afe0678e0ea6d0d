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
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from modelserver.errors import quote, suggest_name
from modelserver.messages import NAN, ImuSample, SensorHeader
from modelserver.transforms.so3 import Vector3
from msdrivers.devices.text_driver import TextDriver, check_text_settings
from msdrivers.protocol.can.mapping import Strict
from msdrivers.protocol.text_lines import ColumnMap

VECTORS: Final = {"specific_force": 400.0, "angular_velocity": 60.0, "magnetic_field": 0.01}
"""Vectors that a line may have, and what is beyond every such unit: m/s2, rad/s, tesla."""

FIELDS: Final = (*(f"{vector}_{axis}" for vector in VECTORS for axis in "xyz"), "temperature", "time")


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
        for name in self.fields:
            if name not in FIELDS:
                near = suggest_name(name, FIELDS)
                raise ValueError(
                    f"fields: {quote(name)} is unknown; {f'write {near[0]}' if near else ', '.join(FIELDS)}"
                )
        check_text_settings(self)
        for vector in VECTORS:
            known = [axis for axis in "xyz" if f"{vector}_{axis}" in self.fields]
            if len(known) in (1, 2) and not (vector == "angular_velocity" and known == ["z"]):
                missing = next(axis for axis in "xyz" if axis not in known)
                raise ValueError(f"fields: {vector}_{missing} is missing beside {vector}_{known[0]}")
        if not any(f"{vector}_z" in self.fields for vector in ("specific_force", "angular_velocity")):
            raise ValueError("fields: has specific_force_x, _y, _z, angular_velocity_x, _y, _z, or both")


class TextImuDriver(TextDriver):
    """An `Endpoint` of bytes at the host's end of the unit's line; see `TextImuSettings`."""

    device = "text_imu"

    def __init__(self, settings: TextImuSettings) -> None:
        super().__init__(settings)

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
