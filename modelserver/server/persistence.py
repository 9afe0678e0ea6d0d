"""Persistence across restarts: the state directory, and what a service stores there.

The directory has a lock, atomic files, and errors with their remedies. It holds the captured origin, and the state for
a warm start: a line with version and SHA-256, then JSON; anything else is rejected with a reason. It is written
atomically by a thread, so that the loop never waits for the disk; only the newest state waits to be written.

The age of a state is measured by the monotonic clock if the boot id is the same. After a reboot only the time of day is
left, which may have been set: then the pose is dropped and the biases are used.
"""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import fcntl
import hashlib
import json
import logging
import os
import shlex
import tempfile
import threading
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final
from uuid import UUID

import msgspec

from modelserver.config.vehicle_file import VehicleConfig
from modelserver.core import Instant
from modelserver.earth.geodesy import make_origin
from modelserver.files import check_links, read_start
from modelserver.geometry import Sigma
from modelserver.messages import Lifetime, Origin, PersistedState, RequestHeader, RestoredState, SetFrame
from modelserver.server.log import escape_text, start_in_background
from modelserver.transforms.pose import Pose

log = logging.getLogger(__name__)

FILE_MODE: Final = 0o640
FOLDER_MODE: Final = 0o750

MAX_PID_DIGITS: Final = 20
"""Digits of the process id that are read from a lock file."""


class LockHeldError(BlockingIOError):
    """Another process, `pid` (0 = not known), holds the lock."""

    def __init__(self, path: Path, pid: int = 0):
        self.pid = pid
        super().__init__(errno.EWOULDBLOCK, f"{self.holder} writes there already", str(path))

    @property
    def holder(self) -> str:
        return f"another service (process {self.pid})" if self.pid else "another service"


class FileLock:
    """A lock file (flock(2)) with its holder's process id. Thread-safe; the kernel releases it when the process ends.

    Releasing does not remove the file: then two processes could each lock one of the same name.
    """

    def __init__(self, path: Path):
        self.path = path
        self._file: int | None = None
        self._mutex = threading.Lock()

    def acquire(self) -> None:
        """Acquire the lock if not held yet. Raises LockHeldError, OSError where the file cannot be opened."""
        with self._mutex:
            if self._file is not None:
                # a directory that was removed and created again has another lock file
                with contextlib.suppress(FileNotFoundError):
                    if os.path.samestat(os.fstat(self._file), self.path.stat()):
                        return
                self._close_file()
            self._file = _open_locked(self.path)

    def claim(self) -> None:
        """Acquire the lock, creating its directory. Raises LockHeldError.

        Other errors (disk full, read-only, missing) are ignored here: the write that follows reports them.
        """
        try:
            create_directory(self.path.parent)
            self.acquire()
        except LockHeldError:
            raise
        except OSError:
            return

    def release(self) -> None:
        with self._mutex:
            self._close_file()

    def _close_file(self) -> None:
        if self._file is not None:
            os.close(self._file)
            self._file = None


def _open_locked(path: Path) -> int:
    file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK, FILE_MODE)
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        pid = _read_pid(file)
        os.close(file)
        raise LockHeldError(path, pid) from None
    except OSError:
        os.close(file)
        raise
    # for people; the lock is valid without it, also on a full disk
    with contextlib.suppress(OSError):
        os.ftruncate(file, 0)
        os.pwrite(file, f"{os.getpid()}\n".encode(), 0)
    return file


def _read_pid(file: int) -> int:
    with contextlib.suppress(OSError):
        digits = os.pread(file, MAX_PID_DIGITS, 0).strip()
        return int(digits) if digits.isdigit() else 0
    return 0


def get_state_directory(named: str) -> Path | None:
    """Return the state directory: as named, else systemd's, else the user's; None without a home directory."""
    if named:
        return Path(named)
    given = os.environ.get("STATE_DIRECTORY", "").split(":")[0]
    if given:
        return Path(given)
    try:
        base = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    except RuntimeError:
        return None
    return Path(base) / "modelserver"


def create_directory(path: Path) -> None:
    """Create a directory and those above it, none of which others can write, whatever the umask. Raises OSError."""
    check_links(path)
    for each in (*reversed(path.parents), path):
        if not each.exists():
            each.mkdir(FOLDER_MODE, exist_ok=True)
    if not path.is_dir():
        raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path))


def to_file_name(vehicle: str) -> str:
    """Return a vehicle's name with the characters that are not safe in file names replaced by _."""
    return "".join(character if character.isalnum() or character in "-_" else "_" for character in vehicle)


def write_atomically(path: Path, data: bytes) -> None:
    """Write a file atomically and durably: after a power cut it has the old or the new content. Raises OSError.

    Creates missing directories, and blocks until the data are on the disk.
    """
    temporary: Path | None = None
    create_directory(path.parent)
    try:
        # temporary file, fsync, rename; then fsync the directory, or the new name may be lost
        with tempfile.NamedTemporaryFile("wb", dir=path.parent, prefix=path.name, delete=False) as file:
            temporary = Path(file.name)
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError:
        if temporary is not None:
            with contextlib.suppress(OSError):
                temporary.unlink()
        raise
    sync_directory(path.parent)


def sync_directory(path: Path) -> None:
    """Sync the names in a directory to the disk. Raises OSError."""
    directory = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(directory)
    finally:
        os.close(directory)


_FULL = "free space on its disk (df -h {place}), or set another {setting} in the vehicle file"
_DENIED = (
    "let the service's user write there (sudo chown -R {user} {place}), or set another {setting} in the vehicle file"
)
_BLOCKED = "move the file at this path away (ls -ld {place}), or set another {setting}"
_READ_ONLY = (
    "set a writable {setting} in the vehicle file (under systemd: /var/lib/modelserver), or mount its file system"
)
_REMEDIES: Final[Mapping[int | None, str]] = {
    **dict.fromkeys((0, None), "the log has its traceback; report it"),
    **dict.fromkeys((errno.ENOSPC, errno.EDQUOT), _FULL),
    **dict.fromkeys((errno.EACCES, errno.EPERM), _DENIED),
    **dict.fromkeys((errno.EEXIST, errno.ENOTDIR, errno.ELOOP), _BLOCKED),
    errno.EROFS: f"{_READ_ONLY} read-write",
    errno.ENOENT: "it is created again",
    errno.EWOULDBLOCK: "stop one of the two, or set another {setting} in the vehicle file of this one",
}
_OTHER_REMEDY = "see the kernel log (sudo dmesg | tail), or set another {setting} in the vehicle file"


def describe_error(error: OSError, directory: Path, setting: str) -> str:
    """Return cause and remedy of an error of a directory, in one line for people.

    `setting` is the key of the vehicle file that names the directory. The cause is the system's message, with the path
    where it is outside the directory (temporary names inside vary).
    """
    named, cause = str(error.filename or ""), error.strerror or str(error)
    if named and not isinstance(error, LockHeldError) and not Path(named).is_relative_to(directory):
        cause += f" ({named})"
    place = shlex.quote(escape_text(str(directory)))
    remedy = _REMEDIES.get(error.errno, _OTHER_REMEDY).format(place=place, setting=setting, user=os.geteuid())
    return f"{escape_text(cause)}; {remedy}"


def _write_json(path: Path, content: Mapping[str, Any], lock: FileLock | None) -> str:
    """Write a file of the state directory as the holder of its lock; return why it cannot be done, "" if it was."""
    try:
        if lock is not None:
            lock.claim()
        write_atomically(path, (json.dumps(content, indent=1) + "\n").encode())
    except OSError as error:
        return describe_error(error, path.parent, "state_directory")
    return ""


VERSION: Final = 1
"""Version of the origin's file."""

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
        if why := _write_json(self.path, {"version": VERSION, **dataclasses.asdict(origin)}, self._lock):
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


FRAMES_VERSION: Final = 1
"""Version of the file of added frames."""

MAX_FRAMES_BYTES: Final = 1 << 20
"""Some 1,000 bytes for each of `added_frames.MAX_FRAMES`."""


class AddedFramesStore:
    """Persists the permanent frames of one vehicle in a file. Only the holder of the directory's `lock` writes."""

    def __init__(self, directory: Path, vehicle: str, lock: FileLock | None = None):
        self._lock = lock
        self.path = directory / f"frames-{to_file_name(vehicle)}.json"

    def load(self) -> tuple[tuple[SetFrame, ...], str]:
        """Return the stored frames; none where the file cannot be read, and why."""
        try:
            content = json.loads(read_start(self.path, MAX_FRAMES_BYTES).decode())
            if content["version"] != FRAMES_VERSION:
                raise ValueError(f"version {content['version']}; expected {FRAMES_VERSION}")
            return tuple(map(_parse_frame, content["frames"])), ""
        except FileNotFoundError:
            return (), ""
        except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
            return (), f"the added frames in {self.path} cannot be read ({error!r}); none was added"

    def save(self, frames: Iterable[SetFrame]) -> str:
        """Store the permanent frames; return why it cannot be done, "" if it was."""
        content = {"version": FRAMES_VERSION, "frames": list(map(_describe_frame, frames))}
        why = _write_json(self.path, content, self._lock)
        return why and f"the permanent frames cannot be stored in {self.path}: {why}"


def _describe_frame(frame: SetFrame) -> dict[str, Any]:
    """Return the entry of a frame in the file; quaternions are w x y z."""
    return {
        "frame": frame.frame,
        "position": frame.pose.xyz,
        "orientation": frame.pose.wxyz,
        "position_sigma": frame.position_sigma,
        "rotation_sigma": frame.rotation_sigma,
    }


def _parse_frame(entry: dict[str, Any]) -> SetFrame:
    sigma = Sigma(entry["position_sigma"], entry["rotation_sigma"])
    pose = Pose(tuple(entry["position"]), tuple(entry["orientation"]))
    return SetFrame(RequestHeader(0, ""), str(entry["frame"]), pose, sigma.position, sigma.rotation, Lifetime.PERMANENT)


MAX_BYTES: Final = 1 << 18
"""Ten times the size of a filter with 30 error states."""

_HEAD: Final = b"modelserver-state 2 "


class PersistedStateError(ValueError):
    """The data are no valid state of this version; the message is the reason."""


def encode_state(state: PersistedState) -> bytes:
    """Encode a state as the bytes of its file."""
    text = msgspec.json.encode(state)
    return _HEAD + hashlib.sha256(text).hexdigest().encode() + b"\n" + text


def decode_state(data: bytes) -> PersistedState:
    """Decode and validate the bytes of a state file. Raises PersistedStateError."""
    line, _, text = data.partition(b"\n")
    if not line.startswith(_HEAD):
        raise PersistedStateError("it is no state file of this version")
    if line.removeprefix(_HEAD) != hashlib.sha256(text).hexdigest().encode():
        raise PersistedStateError("it is damaged: the checksum is wrong")
    try:
        return msgspec.json.decode(text, type=PersistedState)
    except msgspec.MsgspecError as error:
        raise PersistedStateError(str(error)) from None


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
            data = read_start(self.path, MAX_BYTES)
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
    frames: AddedFramesStore | None = None
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
    persists_frames = config.commands.frames
    lock = FileLock(directory / f"lock-{to_file_name(config.vehicle)}")
    warning = ""
    if persists_origin or persists_state or persists_frames:
        try:
            lock.claim()
        except LockHeldError as error:
            warning = describe_held_lock(error, directory)
            log.warning("%s", warning)
    return PersistentStores(
        OriginStore(directory, config.vehicle, lock) if persists_origin else None,
        StateStore(directory, config.vehicle, lock=lock, warning=warning) if persists_state else None,
        AddedFramesStore(directory, config.vehicle, lock) if persists_frames else None,
        lock,
        warning,
    )
