"""Driver of the VectorNav VN-100: switches its binary output on and publishes its samples."""

from __future__ import annotations

import math
from dataclasses import dataclass

from modelserver.messages import NAN, ImuSample, OrientationReference, YawSource
from modelserver.transforms.so3 import Quaternion
from msdrivers.devices.ranges import check_ranges
from msdrivers.devices.stream_driver import StreamDriver, check_stream_settings
from msdrivers.endpoint import HostTime, Output
from msdrivers.protocol import vectornav as vn
from msdrivers.protocol.vectornav import VnBinary, VnMessage, VnStream

MAX_RATE, MAX_ACCELERATION = 40.0, 400.0
"""Beyond the ranges of the unit, 2000 deg/s and 16 g, with room: rad/s, m/s2."""


@dataclass(frozen=True, slots=True)
class VectornavSettings:
    """Settings of a VN-100. Raises ValueError with the key for an invalid value."""

    source: str
    rate_hz: float = 100.0
    """Samples per second: 800 divided by a whole number. 115200 baud carry 140 Hz."""
    unit_port: int = 1
    """Serial port of the unit that this line is at, 1 or 2."""
    heading: str = "magnetic"
    """What the yaw of its orientation is measured against: `magnetic`, or `none` where its magnetometers are off."""
    bauds: tuple[int, ...] = (115200, 921600, 460800, 230400)
    """Baud rates to try; the line is opened at the first. Empty: the line has none."""
    silence: float = 0.5
    """Timeout for samples, seconds, after which the setup is repeated."""
    answer_timeout: float = 0.3
    """Timeout for an answer, seconds."""
    attempts: int = 3
    """How often an unanswered command is sent."""
    delay: float = 0.0
    """From the measurement to the instant that the unit states, seconds."""
    delay_sigma: float = 0.0
    """Its standard deviation, seconds."""

    def __post_init__(self) -> None:
        check_stream_settings(self)
        check_ranges(self, rate_hz=(1.0, 800.0), unit_port=(1, 2))
        if self.heading not in ("magnetic", "none"):
            raise ValueError(f"heading is magnetic or none, got '{self.heading}'")


class VectornavDriver(StreamDriver[VnMessage]):
    """An `Endpoint` of bytes at the host's end of the unit's line; see `VectornavSettings`.

    Further counts: `lost` samples, by the unit's clock; `saturated` and `rejected.range` vectors.
    """

    device = "vectornav"
    description = "VectorNav unit"
    awaited = "binary output"

    def __init__(self, settings: VectornavSettings) -> None:
        super().__init__(settings, VnStream())
        self._rate_hz, self._port = settings.rate_hz, settings.unit_port
        self._yaw_source = YawSource.MAGNETIC if settings.heading == "magnetic" else YawSource.NONE
        self._last_ns: int | None = None

    def _make_identification(self) -> bytes:
        return vn.encode_text("RRG,01")

    def _on_start(self) -> None:
        self._last_ns = None

    def _on_message(self, message: VnMessage, now: HostTime) -> list[Output[bytes]]:
        if isinstance(message, VnBinary):
            return self._on_binary(message, now)
        words, step = message.words, self._step
        if words[0] == "RRG" and len(words) > 2 and words[1].lstrip("0") == "1":
            return self._on_identity(
                words[2].strip() or "VectorNav unit", vn.make_setup(self._rate_hz, self._port), now
            )
        if words[0] == "ERR" and step is not None:
            return self._on_acknowledgement(now, _describe_error(words))
        if words[0] == "WRG" and step is not None and len(words) > 1 and words[1].isdecimal():
            # numbers may come padded or not
            register = int(step.frame.decode("ascii").split(",")[1])
            return self._on_acknowledgement(now) if int(words[1]) == register else []
        return []

    def _on_binary(self, message: VnBinary, now: HostTime) -> list[Output[bytes]]:
        time_ns = message.time_ns
        rate = message.get_floats(vn.RATE) or message.get_floats(vn.COMPENSATED_RATE)
        force = message.get_floats(vn.ACCELERATION) or message.get_floats(vn.COMPENSATED_ACCELERATION)
        if rate is None and force is None:
            self._counts["without_rate"] += 1
            return []
        if time_ns is not None and self._last_ns is not None:
            if time_ns == self._last_ns:
                self._counts["repeated"] += 1
                return []
            step = (time_ns - self._last_ns) * 1e-9 * self._rate_hz
            self._counts["lost"] += max(0, round(step) - 1) if step < 1000.0 else 0
        self._last_ns = time_ns
        magnetic, celsius = message.get_floats(vn.MAGNETIC), message.get_floats(vn.TEMPERATURE)
        orientation = _to_quaternion(message.get_floats(vn.QUATERNION))
        sample = ImuSample(
            self._make_header(
                self._find_arrival(message.start, now), 0 if time_ns is None else max(1, time_ns // 1000)
            ),
            angular_velocity=self._read_vector(rate, MAX_RATE),
            specific_force=self._read_vector(force, MAX_ACCELERATION),
            magnetic_field=self._read_vector(magnetic, MAX_ACCELERATION, vn.GAUSS),
            orientation=orientation,
            orientation_reference=OrientationReference.NONE if orientation is None else OrientationReference.NED,
            yaw_source=YawSource.NONE if orientation is None else self._yaw_source,
            temperature_celsius=celsius[0] if celsius is not None and math.isfinite(celsius[0]) else NAN,
        )
        return self._publish(sample, now)


def _to_quaternion(values: tuple[float, ...] | None) -> Quaternion | None:
    """Return w, x, y, z of a quaternion x, y, z, w; None for one that is no rotation."""
    if values is None:
        return None
    x, y, z, w = values
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    return (w / norm, x / norm, y / norm, z / norm) if abs(norm - 1.0) < 0.01 else None


def _describe_error(words: tuple[str, ...]) -> str:
    try:
        code = int(words[1], 16)
    except (IndexError, ValueError):
        return "error without a code"
    return f"error {code:02X}, {vn.ERRORS.get(code, 'unknown')}"
