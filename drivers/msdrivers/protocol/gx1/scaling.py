"""Convert the words of a 3DM-GX1 to SI units and back, with saturation.

Factors: MicroStrain, "3DM-GX1 Data Communications Protocol". A vector's word times its gain (a word of the EEPROM) by
32768000 is gauss, g or rad/s.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

from modelserver.transforms import so3
from modelserver.transforms.so3 import Quaternion, Vector3

G0 = 9.80665
"""Standard gravity, m/s2: the device's g."""

TESLA = 1e-4
"""A gauss."""

_FULL_SCALE = 32_768_000.0
_ANGLE_SCALE = 2.0 * math.pi / 65536.0
_QUATERNION_SCALE = 1.0 / 8192.0
MIN_WORD, MAX_WORD = -32768, 32767

QUARTER_TURN = 16384
"""A right angle in words of Euler angles."""


def vector_from_words(words: Iterable[int], gain: int, unit: float = 1.0) -> Vector3:
    """Return three words in rad/s, or in `unit` given in SI (G0, TESLA)."""
    factor = gain * unit / _FULL_SCALE
    x, y, z = words
    return so3.scale(factor, (x, y, z))


def vector_to_words(value: Vector3, gain: int, unit: float = 1.0) -> tuple[int, int, int]:
    """Return the words of a vector, saturated where it is too large."""
    x, y, z = so3.scale(_FULL_SCALE / (gain * unit), value)
    return (saturate(x), saturate(y), saturate(z))


def saturate(value: float) -> int:
    """Return the nearest signed 16-bit word."""
    return min(max(round(value), MIN_WORD), MAX_WORD)


def is_saturated(words: Iterable[int]) -> bool:
    """Return whether a word is at an end of its range."""
    return any(word in (MIN_WORD, MAX_WORD) for word in words)


def orientation_from_euler(words: Iterable[int]) -> Quaternion:
    """Return the orientation of the sensor's axes in north, east, down from the words of roll, pitch, yaw."""
    return so3.from_rpy(*(word * _ANGLE_SCALE for word in words))


def euler_to_words(orientation: Quaternion) -> tuple[int, int, int]:
    """Return roll, pitch, yaw as words, each turn within -32768..32767."""
    roll, pitch, yaw = (round(angle / _ANGLE_SCALE) for angle in so3.to_rpy(orientation))
    return (_wrap(roll), pitch, _wrap(yaw))


def _wrap(word: int) -> int:
    return (word + 32768) % 65536 - 32768


def orientation_from_quaternion(words: Iterable[int]) -> Quaternion:
    """Return the orientation of the sensor's axes in north, east, down from four words, scalar first.

    Raises ValueError for four zeros.
    """
    w, x, y, z = (word * _QUATERNION_SCALE for word in words)
    return so3.normalize((w, x, y, z))


def quaternion_to_words(orientation: Quaternion) -> tuple[int, int, int, int]:
    w, x, y, z = (round(element / _QUATERNION_SCALE) for element in orientation)
    return (w, x, y, z)


def is_unit(words: Iterable[int]) -> bool:
    """Return whether four words are a unit quaternion within 1 %."""
    return abs(math.hypot(*words) * _QUATERNION_SCALE - 1.0) < 0.01


def temperature_from_word(word: int) -> float:
    """Return degrees Celsius from an unsigned word."""
    return (word * 5.0 / 65536.0 - 0.5) * 100.0


def temperature_to_word(celsius: float) -> int:
    return min(max(round((celsius / 100.0 + 0.5) * 65536.0 / 5.0), 0), 65535)


def tick_from_timer_words(timer: Iterable[int]) -> float:
    """Return the seconds of a timer tick from the four timer words of the EEPROM: their product times 100 ns.

    Both documented settings agree with it, 16 16 256 1 with 6.5536 ms and 4 10 250 10 with 10 ms; for others it is
    inferred. Zero for a product of zero.
    """
    return math.prod(timer) * 1e-7


DOCUMENTED_TIMERS = frozenset({(16, 16, 256, 1), (4, 10, 250, 10)})
"""Timer words whose tick is documented: the default, and what is known as 100 Hz."""


def format_version(word: int) -> str:
    """Return the firmware's version as people write it."""
    return f"{word // 1000}.{word % 1000 // 100}.{word % 100:02d}"
