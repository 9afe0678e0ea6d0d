"""Persisted state of localization for a warm start: file format, restore, and a writer thread.

The file is a line with magic, version and SHA-256, then JSON; anything else is rejected with a reason. It is written
atomically by a thread, so that the loop never waits for the disk; only the newest state waits to be written.

The age of a state is measured by the monotonic clock if the boot id is the same. After a reboot only the time of day is
left, which may have been set: then the pose is dropped and the biases are used.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import math
import os
import threading
from pathlib import Path
from typing import Any, Final
from uuid import UUID

from modelserver.core import Instant
from modelserver.errors import quote
from modelserver.files.regular import read_start
from modelserver.messages import PersistedPose, PersistedState, RestoredState
from modelserver.server.log import escape_text
from modelserver.server.persistence.directory import FileLock, LockHeldError, describe_error
from modelserver.server.persistence.origin import to_file_name, write_atomically

log = logging.getLogger(__name__)

VERSION: Final = 1

MAX_BYTES: Final = 1 << 18
"""Ten times the size of a filter with 30 error states."""

MAX_STATES: Final = 100
MAX_WHEELS: Final = 64
MAX_NAME_LENGTH: Final = 256

_MAGIC: Final = "modelserver-state"
_MAX_NUMBER: Final = 1e9
"""Upper bound of the numbers, except times and counts."""


class PersistedStateError(ValueError):
    """The data are no valid state of this version; the message is the reason."""


def encode_state(state: PersistedState) -> bytes:
    """Encode a state as the bytes of its file."""
    return _pack({**state._asdict(), "pose": None if state.pose is None else state.pose._asdict()})


def decode_state(data: bytes) -> PersistedState:
    """Decode and validate the bytes of a state file. Raises PersistedStateError."""
    return _parse_state(_unpack(data))


def _pack(content: dict[str, Any]) -> bytes:
    text = json.dumps(content, allow_nan=False).encode()
    return f"{_MAGIC} {VERSION} {hashlib.sha256(text).hexdigest()}\n".encode() + text + b"\n"


def _unpack(data: bytes) -> dict[str, Any]:
    if not data:
        raise PersistedStateError("the file is empty")
    if len(data) > MAX_BYTES:
        raise PersistedStateError(f"the file is larger than {MAX_BYTES} bytes")
    line, _, text = data.partition(b"\n")
    words = line.split(b" ")
    if len(words) != 3 or words[0] != _MAGIC.encode():
        raise PersistedStateError("it is no state file")
    if words[1] != str(VERSION).encode():
        raise PersistedStateError(
            f"its format is version {quote(words[1][:20].decode(errors='replace'))}; expected {VERSION}"
        )
    if not text.endswith(b"\n") or hashlib.sha256(text[:-1]).hexdigest().encode() != words[2]:
        raise PersistedStateError("it is damaged: the checksum is wrong")
    try:
        content = json.loads(text, parse_constant=_reject_constant)
    except (ValueError, RecursionError) as error:
        raise PersistedStateError(f"it is damaged: {error}") from None
    if not isinstance(content, dict):
        raise PersistedStateError("it is no mapping")
    return content


def _reject_constant(word: str) -> float:
    raise PersistedStateError(f"it contains {word}")


def _parse_state(content: object) -> PersistedState:
    found = _check_mapping(content, PersistedState._fields)
    names = found["names"]
    if not isinstance(names, list) or not 15 <= len(names) <= MAX_STATES:
        raise PersistedStateError(f"names: expected 15 to {MAX_STATES} error states")
    if not all(isinstance(name, str) and len(name) <= MAX_NAME_LENGTH for name in names):
        raise PersistedStateError(f"names: expected texts of at most {MAX_NAME_LENGTH} characters")
    n = len(names)
    covariance = _get_numbers(found, "covariance", n * n)
    if any(covariance[k * (n + 1)] < 0.0 for k in range(n)):
        raise PersistedStateError("covariance: negative variance")
    return PersistedState(
        _get_text(found, "vehicle"),
        _get_count(found, "utime"),
        _get_count(found, "monotonic_ns"),
        _get_text(found, "boot"),
        _get_text(found, "setup"),
        _get_count(found, "sensor_utime"),
        tuple(names),
        _get_vector(found, "gyro_bias"),
        _get_vector(found, "accelerometer_bias"),
        _get_numbers(found, "extras", n - 15),
        covariance,
        None if found["pose"] is None else _parse_pose(found["pose"]),
    )


def _parse_pose(content: object) -> PersistedPose:
    found = _check_mapping(content, PersistedPose._fields)
    latitude, longitude = _get_number(found, "latitude_deg"), _get_number(found, "longitude_deg")
    if abs(latitude) > 90.0 or abs(longitude) > 360.0:
        raise PersistedStateError(f"latitude {latitude:g}, longitude {longitude:g}: out of range")
    w, x, y, z = _get_numbers(found, "attitude", 4)
    if not abs(math.hypot(w, x, y, z) - 1.0) < 1e-6:
        raise PersistedStateError("attitude: expected a unit quaternion")
    variance = _get_vector(found, "correlated_error_variance")
    allowance, inflation = _get_number(found, "allowance"), _get_number(found, "gnss_noise_inflation")
    if min(*variance, allowance) < 0.0 or inflation < 1.0:
        raise PersistedStateError("correlated_error_variance, allowance or gnss_noise_inflation: out of range")
    wheels = found["wheels"]
    if not isinstance(wheels, list) or len(wheels) > MAX_WHEELS:
        raise PersistedStateError(f"wheels: expected at most {MAX_WHEELS} pairs")
    distances = []
    for pair in wheels:
        if not (isinstance(pair, list) and len(pair) == 2 and isinstance(pair[0], str) and _is_number(pair[1])):
            raise PersistedStateError("wheels: expected pairs of a name and a distance")
        distances.append((pair[0], float(pair[1])))
    return PersistedPose(
        latitude,
        longitude,
        _get_number(found, "height"),
        _get_vector(found, "position"),
        (w, x, y, z),
        _get_vector(found, "correlated_error"),
        variance,
        allowance,
        inflation,
        _get_count(found, "fix_utime"),
        _get_count(found, "confirmed"),
        _get_count(found, "pose_epoch"),
        _get_text(found, "wheels_source"),
        _get_count(found, "wheels_seq"),
        tuple(distances),
    )


def _check_mapping(content: object, keys: tuple[str, ...]) -> dict[str, Any]:
    if not isinstance(content, dict) or set(content) != set(keys):
        raise PersistedStateError("unknown or missing keys")
    return content


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= _MAX_NUMBER


def _get_number(content: dict[str, Any], key: str) -> float:
    value = content[key]
    if not _is_number(value):
        raise PersistedStateError(f"{key}: expected a number within +-{_MAX_NUMBER:g}")
    return float(value)


def _get_numbers(content: dict[str, Any], key: str, count: int) -> tuple[float, ...]:
    values = content[key]
    if not isinstance(values, list) or len(values) != count or not all(map(_is_number, values)):
        raise PersistedStateError(f"{key}: expected {count} numbers")
    return tuple(map(float, values))


def _get_vector(content: dict[str, Any], key: str) -> tuple[float, float, float]:
    x, y, z = _get_numbers(content, key, 3)
    return (x, y, z)


def _get_count(content: dict[str, Any], key: str) -> int:
    value = content[key]
    if type(value) is not int or not 0 <= value < 1 << 63:
        raise PersistedStateError(f"{key}: expected a count")
    return int(value)


def _get_text(content: dict[str, Any], key: str) -> str:
    value = content[key]
    if not isinstance(value, str) or len(value) > MAX_NAME_LENGTH:
        raise PersistedStateError(f"{key}: expected a text of at most {MAX_NAME_LENGTH} characters")
    return value


BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
BOOT_ID_VARIABLE = "MODELSERVER_BOOT_ID"

CLOCK_TOLERANCE_S = 2.0
"""Seconds that the time of day may fall behind the monotonic clock, as a clock that NTP slews does."""

CLOSE_TIMEOUT_S = 1.0
"""Seconds that the stopping service waits for the disk."""


def read_boot_id() -> str:
    """Return the boot id of the machine, empty where it has none.

    A systemd unit without /proc/sys (ProcSubset=pid) gets it in its environment, without hyphens.
    """
    try:
        return BOOT_ID.read_text(encoding="ascii").strip()[:64]
    except (OSError, UnicodeDecodeError):
        pass
    try:
        return str(UUID(os.environ.get(BOOT_ID_VARIABLE, "")))
    except ValueError:
        return ""


def describe_held_lock(error: LockHeldError, directory: Path) -> str:
    """Return the warning that another service holds the state directory."""
    cause = describe_error(error, directory, "state_directory")
    return f"no state is stored for a warm start in {escape_text(str(directory))}: {cause}"


class StateStore:
    """Persists the state of one vehicle in a file. The loop's thread calls `save` and `close`.

    Only the holder of the directory's `lock` (None: no lock) reads and writes it. `warning` is the one already logged.
    """

    def __init__(
        self, directory: Path, vehicle: str, boot: str | None = None, lock: FileLock | None = None, warning: str = ""
    ):
        self.path = directory / f"state-{to_file_name(vehicle)}.json"
        self._lock = lock
        self._boot = read_boot_id() if boot is None else boot
        self._change = threading.Condition()
        self._waiting: PersistedState | None = None
        self._closing = False
        self._warning = warning
        self._thread: threading.Thread | None = None

    def restore(self, now: Instant, max_pose_age: float, max_age: float) -> RestoredState:
        """Return the state of the previous run with its age, or the reason why there is none."""
        nothing = RestoredState(max_pose_age=max_pose_age, max_age=max_age)
        try:
            self._claim()
        except LockHeldError as error:
            return nothing._replace(reason=f"the state in {self.path} belongs to {error.holder}, which is running")
        self._remove_temporary_files()
        try:
            data = read_start(self.path, MAX_BYTES + 1)
        except FileNotFoundError:
            return nothing._replace(reason="no state of an earlier run is stored")
        except OSError as error:
            return nothing._replace(reason=f"the state in {self.path} cannot be read: {error.strerror}")
        try:
            state = decode_state(data)
        except PersistedStateError as error:
            return nothing._replace(reason=f"the state in {self.path} is not used: {error}")
        age = (now.utime - state.utime) * 1e-6
        if age < -1.0:
            reason = f"the stored state is {-age:.0f} s ahead of the clock, which was set back since or is not set yet"
            return nothing._replace(reason=reason)
        if state.boot and state.boot == self._boot:
            ran = (now.monotonic_ns - state.monotonic_ns) * 1e-9
            if ran < 0.0 or age < ran - CLOCK_TOLERANCE_S:
                return nothing._replace(
                    reason=f"the clock was set back by {ran - age:.0f} s since the state was stored"
                )
            age = max(age, ran)
        elif state.pose is not None:
            # the time of day may have been set: how long the vehicle was unobserved is not known
            state = state._replace(pose=None)
        return nothing._replace(state=state, age=max(age, 0.0))

    def _remove_temporary_files(self) -> None:
        """Remove the temporary files of runs that were killed while writing."""
        with contextlib.suppress(OSError):
            for path in self.path.parent.glob(f"{self.path.name}?*"):
                path.unlink()

    def save(self, state: PersistedState) -> str:
        """Queue a state for writing, in place of one that still waits; return the current warning, if any."""
        with self._change:
            self._waiting = state
            self._change.notify()
            if self._thread is None:
                self._thread = threading.Thread(target=self._write_all, name="state store", daemon=True)
                self._thread.start()
            return self._warning

    def close(self, state: PersistedState | None = None) -> None:
        """Write the last state and stop, waiting at most `CLOSE_TIMEOUT_S` for the disk."""
        if state is not None:
            self.save(state)
        with self._change:
            self._closing = True
            self._change.notify()
            thread = self._thread
        if thread is not None:
            thread.join(CLOSE_TIMEOUT_S)

    def _write_all(self) -> None:
        while True:
            with self._change:
                while self._waiting is None and not self._closing:
                    self._change.wait()
                state, self._waiting = self._waiting, None
            if state is None:
                return
            self._write(state)

    def _claim(self) -> None:
        if self._lock is not None:
            self._lock.claim()

    def _write(self, state: PersistedState) -> None:
        try:
            self._claim()
            write_atomically(self.path, encode_state(state._replace(boot=self._boot)))
        except LockHeldError as error:
            warning = describe_held_lock(error, self.path.parent)
        except (OSError, ValueError) as error:
            directory = self.path.parent
            cause = describe_error(error, directory, "state_directory") if isinstance(error, OSError) else str(error)
            warning = (
                f"the state cannot be stored in {escape_text(str(directory))}: {cause}. The next start will be cold"
            )
        else:
            warning = ""
        if warning != self._warning:
            self._warning = warning
            if warning:
                log.warning("%s", warning)
            else:
                log.info("the state is stored again in %s", self.path)
