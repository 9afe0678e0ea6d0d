"""What a service persists in its state directory: the captured origin, and the state for a warm start.

The state file is a line with magic, version and SHA-256, then JSON; anything else is rejected with a reason. It is
written atomically by a thread, so that the loop never waits for the disk; only the newest state waits to be written.

The age of a state is measured by the monotonic clock if the boot id is the same. After a reboot only the time of day is
left, which may have been set: then the pose is dropped and the biases are used.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import logging
import math
import os
import threading
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Final, TypeVar, get_type_hints
from uuid import UUID

import msgspec

from modelserver.config.vehicle_file import VehicleConfig
from modelserver.core import Instant
from modelserver.earth.geodesy import make_origin
from modelserver.errors import quote
from modelserver.files import read_start
from modelserver.messages import Origin, PersistedPose, PersistedState, RestoredState
from modelserver.server.log import escape_text, start_in_background
from modelserver.server.persistence.directory import (
    FileLock,
    LockHeldError,
    describe_error,
    get_state_directory,
    to_file_name,
    write_atomically,
)
from modelserver.transforms.so3 import Quaternion, Vector3

log = logging.getLogger(__name__)

VERSION: Final = 1
"""Version of both files."""

MAX_ORIGIN_BYTES: Final = 4096
"""Ten times the size of a valid file."""


class OriginStore:
    """Persists the origin of one vehicle in a file. Only the holder of the directory's `lock` writes; None: no lock."""

    def __init__(self, directory: Path, vehicle: str, lock: FileLock | None = None):
        self._lock = lock
        self.path = directory / f"origin-{to_file_name(vehicle)}.json"

    def load(self) -> Origin | None:
        """Return the stored origin; None where there is none or the file is damaged, which is logged."""
        try:
            text = read_start(self.path, MAX_ORIGIN_BYTES).decode()
        except FileNotFoundError:
            return None
        except (OSError, UnicodeDecodeError) as error:
            log.warning("the stored origin in %s cannot be read (%s); a new one will be captured", self.path, error)
            return None
        try:
            return _parse_origin(json.loads(text))
        except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
            log.warning("the stored origin in %s is damaged (%r); a new one will be captured", self.path, error)
            return None

    def save(self, origin: Origin) -> None:
        """Store an origin. An error of the disk is logged: the next start captures a new one."""
        content = json.dumps({"version": VERSION, **dataclasses.asdict(origin)}, indent=1)
        try:
            if self._lock is not None:
                self._lock.claim()
            write_atomically(self.path, (content + "\n").encode())
        except OSError as error:
            why = describe_error(error, self.path.parent, "state_directory")
            log.warning("the origin cannot be stored in %s: %s. The next start will capture a new one", self.path, why)


def _parse_origin(content: dict[str, Any]) -> Origin:
    if content["version"] != VERSION:
        raise ValueError(f"version {content['version']}; expected {VERSION}")
    easting, northing, height = (float(content[name]) for name in ("easting", "northing", "height"))
    zone, north, origin_id = content["zone"], content["north"], content["origin_id"]
    if type(zone) is not int or type(north) is not bool or type(origin_id) is not int:
        raise ValueError("zone, north or origin_id has a wrong type")
    origin = make_origin(easting, northing, height, zone, north)
    if not 0 < origin_id < 1 << 63:
        raise ValueError(f"origin_id {origin_id} is out of range")
    # the published id stays, even if this version would derive another one from the numbers
    return dataclasses.replace(origin, origin_id=origin_id)


MAX_BYTES: Final = 1 << 18
"""Ten times the size of a filter with 30 error states."""

MAX_STATES: Final = 100
MAX_WHEELS: Final = 64
MAX_NAME_LENGTH: Final = 256

_MAGIC: Final = "modelserver-state"
_MAX_NUMBER: Final = 1e9
"""Upper bound of the numbers, except times and counts."""

_Text = Annotated[str, msgspec.Meta(max_length=MAX_NAME_LENGTH)]
_Count = Annotated[int, msgspec.Meta(ge=0, le=(1 << 63) - 1)]
_Number = Annotated[float, msgspec.Meta(ge=-_MAX_NUMBER, le=_MAX_NUMBER)]

_FIELDS: Final[Mapping[Any, tuple[Any, str]]] = MappingProxyType(
    {
        str: (_Text, f"a text of at most {MAX_NAME_LENGTH} characters"),
        int: (_Count, "a count"),
        float: (_Number, f"a number within +-{_MAX_NUMBER:g}"),
        Vector3: (tuple[_Number, _Number, _Number], "3 numbers"),
        Quaternion: (tuple[_Number, _Number, _Number, _Number], "4 numbers"),
        tuple[float, ...]: (tuple[_Number, ...], "numbers"),
        tuple[str, ...]: (tuple[_Text, ...], f"texts of at most {MAX_NAME_LENGTH} characters"),
        tuple[tuple[str, float], ...]: (
            Annotated[list[Any], msgspec.Meta(max_length=MAX_WHEELS)],
            f"at most {MAX_WHEELS} pairs",
        ),
        PersistedPose | None: (Any, ""),
    }
)
"""What is valid for a field of each declared type, and its description."""

_Row = TypeVar("_Row", PersistedState, PersistedPose)


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
    state = _convert_fields(content, PersistedState)
    count = len(state.names)
    if not 15 <= count <= MAX_STATES:
        raise PersistedStateError(f"names: expected 15 to {MAX_STATES} error states")
    for key, values, expected in (("covariance", state.covariance, count**2), ("extras", state.extras, count - 15)):
        if len(values) != expected:
            raise PersistedStateError(f"{key}: expected {expected} numbers")
    if min(state.covariance[:: count + 1]) < 0.0:
        raise PersistedStateError("covariance: negative variance")
    return state if state.pose is None else state._replace(pose=_parse_pose(state.pose))


def _parse_pose(content: object) -> PersistedPose:
    pose = _convert_fields(content, PersistedPose)
    if abs(pose.latitude_deg) > 90.0 or abs(pose.longitude_deg) > 360.0:
        raise PersistedStateError(f"latitude {pose.latitude_deg:g}, longitude {pose.longitude_deg:g}: out of range")
    if not abs(math.hypot(*pose.attitude) - 1.0) < 1e-6:
        raise PersistedStateError("attitude: expected a unit quaternion")
    if min(*pose.correlated_error_variance, pose.allowance) < 0.0 or pose.gnss_noise_inflation < 1.0:
        raise PersistedStateError("correlated_error_variance, allowance or gnss_noise_inflation: out of range")
    pairs = tuple[tuple[str, _Number], ...]
    return pose._replace(wheels=_convert("wheels", pose.wheels, pairs, "pairs of a name and a distance"))


def _convert_fields(content: object, row: type[_Row]) -> _Row:
    """Convert a mapping to a NamedTuple, each field as declared. Raises PersistedStateError."""
    if not isinstance(content, dict) or set(content) != set(row._fields):
        raise PersistedStateError("unknown or missing keys")
    return row(*(_convert(key, content[key], *_FIELDS[hint]) for key, hint in get_type_hints(row).items()))


def _convert(key: str, value: object, kind: Any, expected: str) -> Any:
    try:
        return msgspec.convert(value, kind)
    except msgspec.ValidationError:
        raise PersistedStateError(f"{key}: expected {expected}") from None


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
                start_in_background(self._thread)
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


SUBJECT: Final = "restart"
"""Subject of the health warning while no state is stored."""


@dataclasses.dataclass(frozen=True, slots=True)
class PersistentStores:
    """Stores of a service, None for what it does not persist.

    `lock` is that of the state directory. Each writer claims it again before writing, so that this service takes over
    when its holder has ended. `warning`: why nothing can be stored, as already logged.
    """

    origin: OriginStore | None = None
    state: StateStore | None = None
    lock: FileLock | None = None
    warning: str = ""

    def close(self) -> None:
        if self.lock is not None:
            self.lock.release()


def open_stores(config: VehicleConfig, localizes: bool) -> PersistentStores:
    """Open the stores of a vehicle's service; `localizes`: whether there is a state to persist.

    A directory that is unusable or held by another service does not stop the start: it is logged, see `warning`.
    """
    directory = get_state_directory(config.state_directory)
    if directory is None:
        log.warning(
            "there is no home directory: no state is stored for a warm start; set state_directory in the vehicle file"
        )
        return PersistentStores()
    persists_origin = config.origin.persist and config.origin.initial_utm is None
    persists_state = config.warm_start.persist and localizes
    lock = FileLock(directory / f"lock-{to_file_name(config.vehicle)}")
    warning = ""
    if persists_origin or persists_state:
        try:
            lock.claim()
        except LockHeldError as error:
            warning = describe_held_lock(error, directory)
            log.warning("%s", warning)
    return PersistentStores(
        OriginStore(directory, config.vehicle, lock) if persists_origin else None,
        StateStore(directory, config.vehicle, lock=lock, warning=warning) if persists_state else None,
        lock,
        warning,
    )
