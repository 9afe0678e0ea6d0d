"""Driver of a device that sends the positions of joints as lines of text, such as a pan-tilt head.

head:
  device: text_joints
  port: /dev/ttyUSB3
  baud: 57600
  columns: 2                                   # 12.50 -3.25
  separator: ""
  joints:
    Pan: {column: 0, scale: 0.0174533}         # degrees; the names of constraints in the geometry
    Tilt: {column: 1, scale: 0.0174533}
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from modelserver.messages import NAN, JointSample, JointsSample, SensorHeader
from msdrivers.devices.ranges import check_ranges
from msdrivers.devices.text_driver import TextDriver, check_text_settings
from msdrivers.protocol.can.mapping import Strict
from msdrivers.protocol.text_lines import ColumnMap

TIME: Final = "time"

MAX_POSITION: Final = 1000.0
"""Radians or meters; a joint beyond is none."""


@dataclass(frozen=True, slots=True)
class TextJointsSettings(Strict):
    """Settings of a device that sends joints as lines of text. Raises ValueError with the key for an invalid value."""

    source: str
    joints: Mapping[str, ColumnMap]
    """Columns by the names of the constraints in the geometry; radians or meters."""
    columns: int
    """Number of columns of a line; others are rejected."""
    time: ColumnMap | None = None
    """Column of the device's clock, seconds."""
    sigma: float = 0.0
    """Standard deviation of a position, radians or meters; 0: that of the joint in the geometry."""
    separator: str = ","
    """What separates columns; empty: spaces or tabs."""
    starts_with: str = ""
    """What a line with positions begins with; other lines are not used."""
    checksum: str = "none"
    """`xor`: a line ends with * and the exclusive-or of the characters before, as in NMEA; `none`."""
    silence: float = 1.0
    """Timeout for usable lines, seconds."""
    delay: float = 0.0
    """From the measurement to the device's time, or to the arrival of the line's first byte, seconds."""
    delay_sigma: float = 0.005
    """Its standard deviation, seconds."""

    def __post_init__(self) -> None:
        if not 1 <= len(self.joints) <= 64:
            raise ValueError(f"joints has 1 to 64 joints, got {len(self.joints)}")
        check_text_settings(self)
        check_ranges(self, sigma=(0.0, 10.0))

    @property
    def fields(self) -> Mapping[str, ColumnMap]:
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
