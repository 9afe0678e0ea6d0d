"""What the words of a 3DM-GX1 mean in SI units, and back with saturation.

Factors: MicroStrain, "3DM-GX1 Data Communications Protocol". A vector's word times its gain (a word of the EEPROM) by
32768000 is gauss, g or rad/s.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

from modelserver.spatial import so3
from modelserver.spatial.so3 import Quaternion, Vector3

G0 = 9.80665
"""Standard gravity, m/s2: the device's g."""

TESLA = 1e-4
"""A gauss."""

_FULL = 32_768_000.0
_ANGLE = 2.0 * math.pi / 65536.0
_ELEMENT = 1.0 / 8192.0
LOWEST, HIGHEST = -32768, 32767

QUARTER_TURN = 16384
"""A right angle in words of Euler angles."""


class Address:
    """Even addresses of the EEPROM's words."""

    GYRO_GAIN = 130
    HARD_IRON = (172, 174, 176)
    ACCELEROMETER_GAIN = 230
    MAGNETOMETER_GAIN = 232
    TIMER = (238, 240, 242, 246)


class Gains(NamedTuple):
    """The gain words of gyros, accelerometers and magnetometers."""

    gyro: int
    accelerometer: int
    magnetometer: int


def vector(words: Iterable[int], gain: int, unit: float = 1.0) -> Vector3:
    """Return three words in rad/s, or in `unit` given in SI (G0, TESLA)."""
    factor = gain * unit / _FULL
    x, y, z = words
    return (x * factor, y * factor, z * factor)


def vector_words(value: Vector3, gain: int, unit: float = 1.0) -> tuple[int, int, int]:
    """Return the words of a vector, saturated where it is too large."""
    factor = _FULL / (gain * unit)
    x, y, z = value
    return (saturated(x * factor), saturated(y * factor), saturated(z * factor))


def saturated(value: float) -> int:
    """Return the nearest signed 16-bit word."""
    return min(max(round(value), LOWEST), HIGHEST)


def is_saturated(words: Iterable[int]) -> bool:
    """Return whether a word stands at an end of its range: the device could not measure so much."""
    return any(word in (LOWEST, HIGHEST) for word in words)


def orientation_from_euler(words: Iterable[int]) -> Quaternion:
    """Return the orientation of the sensor's axes in north, east, down from the words of roll, pitch, yaw."""
    roll, pitch, yaw = words
    return so3.from_rpy(roll * _ANGLE, pitch * _ANGLE, yaw * _ANGLE)


def euler_words(orientation: Quaternion) -> tuple[int, int, int]:
    """Return roll, pitch, yaw as words, each turn within -32768..32767."""
    roll, pitch, yaw = (round(angle / _ANGLE) for angle in so3.to_rpy(orientation))
    return (_wrapped(roll), pitch, _wrapped(yaw))


def _wrapped(word: int) -> int:
    return (word + 32768) % 65536 - 32768


def orientation_from_quaternion(words: Iterable[int]) -> Quaternion:
    """Return the orientation of the sensor's axes in north, east, down from four words, scalar first.

    Raises ValueError for four zeros.
    """
    w, x, y, z = words
    return so3.normalized((w * _ELEMENT, x * _ELEMENT, y * _ELEMENT, z * _ELEMENT))


def quaternion_words(orientation: Quaternion) -> tuple[int, int, int, int]:
    """Return the four words of a unit quaternion."""
    w, x, y, z = (round(element / _ELEMENT) for element in orientation)
    return (w, x, y, z)


def is_unit(words: Iterable[int]) -> bool:
    """Return whether four words are a unit quaternion within 1 %."""
    return abs(math.hypot(*words) * _ELEMENT - 1.0) < 0.01


def temperature_celsius(word: int) -> float:
    """Return degrees Celsius from an unsigned word."""
    return (word * 5.0 / 65536.0 - 0.5) * 100.0


def temperature_word(celsius: float) -> int:
    """Return the unsigned word of a temperature, saturated."""
    return min(max(round((celsius / 100.0 + 0.5) * 65536.0 / 5.0), 0), 65535)


def tick_seconds(timer: Iterable[int]) -> float:
    """Return the seconds of a timer tick from the four timer words of the EEPROM: their product times 100 ns.

    Both documented settings agree with it, 16 16 256 1 with 6.5536 ms and 4 10 250 10 with 10 ms; for others it is
    inferred. Zero for a product of zero.
    """
    return math.prod(timer) * 1e-7


DOCUMENTED_TIMERS = frozenset({(16, 16, 256, 1), (4, 10, 250, 10)})
"""Timer words whose tick is documented: the default, and what is known as 100 Hz."""


def version_text(word: int) -> str:
    """Return the firmware's version as people write it."""
    return f"{word // 1000}.{word % 1000 // 100}.{word % 100:02d}"
