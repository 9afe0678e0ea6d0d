"""Driver of Xsens MTi units (1-, 10-, 100-, 600-series): configures MTData2 and publishes its samples."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from modelserver.messages import NAN, ImuSample, OrientationReference, YawSource
from modelserver.transforms.so3 import Quaternion
from msdrivers.devices.ranges import check_ranges
from msdrivers.devices.stream_driver import StreamDriver, check_stream_settings
from msdrivers.endpoint import HostTime, Output
from msdrivers.protocol import xsens
from msdrivers.protocol.xsens import ItemId, MessageId, MtData, XbusMessage, XbusStream

MAX_RATE: Final = 60.0
MAX_ACCELERATION: Final = 400.0
"""Beyond the ranges of the units, with room: rad/s, m/s2."""


@dataclass(frozen=True, slots=True)
class XsensSettings:
    """Settings of an MTi. Raises ValueError with the key for an invalid value."""

    source: str
    rate_hz: int = 100
    """Samples per second, 1 to 400; a 1-series unit reaches 100, and 115200 baud carry 130."""
    field_strength: float = 0.0
    """Magnetic field at its calibration, tesla: the unit reports multiples of it. 0: its field is not used."""
    heading: str = "magnetic"
    """What the yaw of its orientation is measured against: `magnetic`, `none` (VRU), or `true` (with declination)."""
    bauds: tuple[int, ...] = (115200, 921600, 460800, 230400, 2000000)
    """Baud rates to try; the line is opened at the first. Empty: the line has none."""
    silence: float = 0.5
    """Timeout for samples, seconds, after which the setup is repeated."""
    answer_timeout: float = 0.5
    """Timeout for an answer, seconds."""
    attempts: int = 5
    """How often an unanswered message is sent: some units do not answer after power-up."""
    delay: float = 0.0
    """From the measurement to the instant that the unit states, seconds."""
    delay_sigma: float = 0.0
    """Its standard deviation, seconds."""

    def __post_init__(self) -> None:
        check_stream_settings(self)
        check_ranges(self, rate_hz=(1, 400), field_strength=(0.0, 1e-3))
        if self.heading not in _YAW_SOURCES:
            raise ValueError(f"heading is one of {', '.join(_YAW_SOURCES)}, got '{self.heading}'")


_YAW_SOURCES: Final = {"magnetic": YawSource.MAGNETIC, "none": YawSource.NONE, "true": YawSource.TRUE}


class SampleTimeUnwrapper:
    """SampleTimeFine as a number that does not wrap."""

    def __init__(self) -> None:
        self._last: int | None = None
        self._offset = 0

    def unwrap(self, ticks: int) -> int:
        """Return the ticks since the first wrap; a restart of the unit begins again from its own ticks."""
        last, self._last = self._last, ticks
        if last is not None and ticks < last and ticks < xsens.WRAP_MARGIN:
            for wrap in (xsens.DAY_TICKS, 1 << 32):
                if 0 <= wrap - last < xsens.WRAP_MARGIN:
                    self._offset += wrap
                    return self._offset + ticks
            self._offset = 0
        return self._offset + ticks


class XsensDriver(StreamDriver[XbusMessage]):
    """An `Endpoint` of bytes at the host's end of the unit's line; see `XsensSettings`.

    Further counts: `lost` packets, by the packet counter; `clipped` packets; `rejected.range` vectors.
    """

    device = "xsens"
    description = "Xsens MTi"
    awaited = "MTData2"

    def __init__(self, settings: XsensSettings) -> None:
        super().__init__(settings, XbusStream())
        self._own = settings
        self._ticks = SampleTimeUnwrapper()
        self._last_counter: int | None = None
        self._celsius = NAN

    def _make_identification(self) -> bytes:
        return xsens.encode(MessageId.GO_TO_CONFIG)

    def _on_start(self) -> None:
        self._last_counter = None

    def _on_message(self, message: XbusMessage, now: HostTime) -> list[Output[bytes]]:
        if message.id == MessageId.MT_DATA_2:
            return self._on_data(message, now)
        if message.id == MessageId.GO_TO_CONFIG_ACK:
            steps = xsens.make_setup(self._own.rate_hz, has_field=self._own.field_strength > 0.0)
            return self._on_identity("Xsens MTi", steps, now)
        step = self._step
        if step is None:
            return []
        if message.id == MessageId.ERROR:
            code = message.data[0] if message.data else 0
            return self._on_acknowledgement(now, f"error {code:02X}, {xsens.ERRORS.get(code, 'unknown')}")
        return self._on_acknowledgement(now) if message.id == step.frame[2] + 1 else []

    def _on_data(self, message: XbusMessage, now: HostTime) -> list[Output[bytes]]:
        try:
            data = MtData.parse(message.data)
        except ValueError:
            self._stream.reject("mtdata2")
            return []
        counter = data.get_integer(ItemId.PACKET_COUNTER)
        if counter is not None and self._last_counter is not None:
            step = (counter - self._last_counter) & 0xFFFF
            # half of its range or more: it began again
            self._counts["lost"] += step - 1 if 0 < step < 0x8000 else 0
        self._last_counter = counter
        if (celsius := data.get_numbers(ItemId.TEMPERATURE, 1)) is not None:
            self._celsius = celsius[0]
        rate, force = data.get_numbers(ItemId.RATE_OF_TURN, 3), data.get_numbers(ItemId.ACCELERATION, 3)
        if rate is None and force is None:
            # such as the packets of a receiver
            self._counts["without_rate"] += 1
            return []
        self._counts["clipped"] += data.is_clipped
        ticks = data.get_integer(ItemId.SAMPLE_TIME_FINE)
        device_utime = 0 if ticks is None else max(1, round(self._ticks.unwrap(ticks) * xsens.TICK * 1e6))
        field = data.get_numbers(ItemId.MAGNETIC_FIELD, 3)
        orientation, reference = _find_orientation(data)
        sample = ImuSample(
            self._make_header(self._find_arrival(message.start, now), device_utime),
            angular_velocity=self._read_vector(rate, MAX_RATE),
            specific_force=self._read_vector(force, MAX_ACCELERATION),
            magnetic_field=self._read_vector(field, 100.0, self._own.field_strength)
            if self._own.field_strength
            else None,
            orientation=orientation,
            orientation_reference=reference,
            yaw_source=YawSource.NONE if orientation is None else _YAW_SOURCES[self._own.heading],
            temperature_celsius=self._celsius,
        )
        return self._publish(sample, now, xsens.TICK)


def _find_orientation(data: MtData) -> tuple[Quaternion | None, OrientationReference]:
    """Return the unit's own orientation (w, x, y, z) and its reference; None if it has none, or in another frame."""
    for frame, reference in ((xsens.FRAME_ENU, OrientationReference.ENU), (xsens.FRAME_NED, OrientationReference.NED)):
        values = data.get_numbers(ItemId.QUATERNION, 4, frame)
        if values is not None:
            norm = math.sqrt(sum(each * each for each in values))
            if abs(norm - 1.0) < 0.01:
                w, x, y, z = (each / norm for each in values)
                return (w, x, y, z), reference
    return None, OrientationReference.NONE
