"""The kept state as bytes: a line with version and checksum, then JSON. What is not whole and right is refused."""

from __future__ import annotations

import hashlib
import json
import math
from typing import Any, Final

from modelserver.errors import shown
from modelserver.messages import Kept, KeptPose

VERSION: Final = 1

MAX_BYTES: Final = 1 << 18
"""Ten times what a filter of 30 error states takes."""

MOST_STATES: Final = 100
MOST_WHEELS: Final = 64
MOST_NAME: Final = 256

_MAGIC: Final = "modelserver-kept"
_LARGEST: Final = 1e9
"""No number of a kept state is larger, but for times and counts."""


class KeptError(ValueError):
    """What was read is no kept state of this version; the message says why."""


def kept_to_bytes(kept: Kept) -> bytes:
    """Return a kept state as the bytes of its file."""
    return _sealed(_content(kept))


def kept_from_bytes(data: bytes) -> Kept:
    """Return the kept state that the bytes of a file hold. Raises KeptError for anything but a whole, right one."""
    return _kept(_opened(data))


def _sealed(content: dict[str, Any]) -> bytes:
    text = json.dumps(content, allow_nan=False).encode()
    return f"{_MAGIC} {VERSION} {hashlib.sha256(text).hexdigest()}\n".encode() + text + b"\n"


def _opened(data: bytes) -> dict[str, Any]:
    if not data:
        raise KeptError("it is empty")
    if len(data) > MAX_BYTES:
        raise KeptError(f"it is larger than {MAX_BYTES} bytes")
    line, _, text = data.partition(b"\n")
    words = line.split(b" ")
    if len(words) != 3 or words[0] != _MAGIC.encode():
        raise KeptError("it is no kept state")
    if words[1] != str(VERSION).encode():
        raise KeptError(f"its format is version {shown(words[1][:20].decode(errors='replace'))}, not {VERSION}")
    if not text.endswith(b"\n") or hashlib.sha256(text[:-1]).hexdigest().encode() != words[2]:
        raise KeptError("it is damaged: its checksum is another")
    try:
        content = json.loads(text, parse_constant=_no_number)
    except (ValueError, RecursionError) as error:
        raise KeptError(f"it is damaged: {error}") from None
    if not isinstance(content, dict):
        raise KeptError("it is no mapping")
    return content


def _no_number(word: str) -> float:
    raise KeptError(f"it holds {word}")


def _content(kept: Kept) -> dict[str, Any]:
    pose = kept.pose
    return {**kept._asdict(), "pose": None if pose is None else pose._asdict()}


def _kept(content: object) -> Kept:
    found = _mapping(content, Kept._fields)
    names = found["names"]
    if not isinstance(names, list) or not 15 <= len(names) <= MOST_STATES:
        raise KeptError(f"names are 15 to {MOST_STATES} error states")
    if not all(isinstance(name, str) and len(name) <= MOST_NAME for name in names):
        raise KeptError("names are words")
    n = len(names)
    covariance = _numbers(found, "covariance", n * n)
    if any(covariance[k * (n + 1)] < 0.0 for k in range(n)):
        raise KeptError("covariance has a variance below 0")
    return Kept(
        _text(found, "vehicle"),
        _count(found, "utime"),
        _count(found, "monotonic_ns"),
        _text(found, "boot"),
        _text(found, "setup"),
        _count(found, "sensor_utime"),
        tuple(names),
        _vector(found, "gyro_bias"),
        _vector(found, "accelerometer_bias"),
        _numbers(found, "extras", n - 15),
        covariance,
        None if found["pose"] is None else _pose(found["pose"]),
    )


def _pose(content: object) -> KeptPose:
    found = _mapping(content, KeptPose._fields)
    latitude, longitude = _number(found, "latitude_deg"), _number(found, "longitude_deg")
    if abs(latitude) > 90.0 or abs(longitude) > 360.0:
        raise KeptError(f"latitude {latitude:g} with longitude {longitude:g} is no place")
    w, x, y, z = _numbers(found, "attitude", 4)
    if not abs(math.hypot(w, x, y, z) - 1.0) < 1e-6:
        raise KeptError("attitude is no unit quaternion")
    doubt = _vector(found, "doubt")
    allowance, restless = _number(found, "allowance"), _number(found, "restless")
    if min(*doubt, allowance) < 0.0 or restless < 1.0:
        raise KeptError("doubt, allowance or restless is out of range")
    wheels = found["wheels"]
    if not isinstance(wheels, list) or len(wheels) > MOST_WHEELS:
        raise KeptError(f"wheels are {MOST_WHEELS} pairs at most")
    ways = []
    for pair in wheels:
        if not (isinstance(pair, list) and len(pair) == 2 and isinstance(pair[0], str) and _is_number(pair[1])):
            raise KeptError("wheels are pairs of a name and a way")
        ways.append((pair[0], float(pair[1])))
    return KeptPose(
        latitude,
        longitude,
        _number(found, "height"),
        _vector(found, "position"),
        (w, x, y, z),
        _vector(found, "shown"),
        doubt,
        allowance,
        restless,
        _count(found, "fix_utime"),
        _count(found, "confirmed"),
        _count(found, "pose_epoch"),
        _text(found, "wheels_source"),
        _count(found, "wheels_seq"),
        tuple(ways),
    )


def _mapping(content: object, keys: tuple[str, ...]) -> dict[str, Any]:
    if not isinstance(content, dict) or set(content) != set(keys):
        raise KeptError("its keys are others")
    return content


def _field(content: dict[str, Any], key: str) -> Any:
    if key not in content:
        raise KeptError(f"{key} is missing")
    return content[key]


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= _LARGEST


def _number(content: dict[str, Any], key: str) -> float:
    value = _field(content, key)
    if not _is_number(value):
        raise KeptError(f"{key} is no number within reason")
    return float(value)


def _numbers(content: dict[str, Any], key: str, count: int) -> tuple[float, ...]:
    values = _field(content, key)
    if not isinstance(values, list) or len(values) != count or not all(map(_is_number, values)):
        raise KeptError(f"{key} has to be {count} numbers")
    return tuple(map(float, values))


def _vector(content: dict[str, Any], key: str) -> tuple[float, float, float]:
    x, y, z = _numbers(content, key, 3)
    return (x, y, z)


def _count(content: dict[str, Any], key: str) -> int:
    value = _field(content, key)
    if type(value) is not int or not 0 <= value < 1 << 63:
        raise KeptError(f"{key} is no count")
    return int(value)


def _text(content: dict[str, Any], key: str, most: int = MOST_NAME) -> str:
    value = _field(content, key)
    if not isinstance(value, str) or len(value) > most:
        raise KeptError(f"{key} is no text of at most {most} characters")
    return value
