"""What one run of the daemon keeps for the next: read at the start, written by a thread that nobody waits for."""

from __future__ import annotations

import contextlib
import logging
import os
import threading
from pathlib import Path
from uuid import UUID

from modelserver.core import Instant
from modelserver.messages import Kept, Recalled
from modelserver.regular_files import read_start
from modelserver.service.keeping.form import MAX_BYTES, KeptError, kept_from_bytes, kept_to_bytes
from modelserver.service.keeping.lock import HeldError, Lock
from modelserver.service.keeping.origin import safe, write_whole
from modelserver.service.keeping.trouble import words_on
from modelserver.service.log import plain

log = logging.getLogger(__name__)

BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
BOOT_ID_VARIABLE = "MODELSERVER_BOOT_ID"

CLOCKS_AGREE = 2.0
"""Seconds by which the time of day may have gone less far than the monotonic clock: a clock that is steered."""

CLOSING_S = 1.0
"""Seconds that the end of the service waits for a disk, at most."""


def boot_id() -> str:
    """Return the name of this boot of the machine, empty where it has none.

    A unit that does not see /proc/sys (ProcSubset=pid) is given it in its environment, which writes it without hyphens.
    """
    try:
        return BOOT_ID.read_text(encoding="ascii").strip()[:64]
    except (OSError, UnicodeDecodeError):
        pass
    try:
        return str(UUID(os.environ.get(BOOT_ID_VARIABLE, "")))
    except ValueError:
        return ""


def held_words(error: HeldError, directory: Path) -> str:
    """Return what to say where another service has the state directory."""
    why = words_on(error, directory, "state_directory")
    return f"nothing is kept for a restart in {plain(str(directory))}: {why}"


class StateKeeper:
    """Keeps the state of one vehicle in a file. `keep` and `close` are called by one thread, the loop's.

    Only who has the directory's `lock` reads and writes it; None: there is none. `trouble`: why nothing can be kept, as
    it was said already.
    """

    def __init__(
        self, directory: Path, vehicle: str, boot: str | None = None, lock: Lock | None = None, trouble: str = ""
    ):
        self.path = directory / f"state-{safe(vehicle)}.json"
        self._lock = lock
        self._boot = boot_id() if boot is None else boot
        self._change = threading.Condition()
        self._waiting: Kept | None = None
        self._closing = False
        self._trouble = trouble
        self._thread: threading.Thread | None = None

    def recall(self, now: Instant, pose_age: float, most_age: float) -> Recalled:
        """Return what an earlier run kept with its age, or why nothing is known. Never raises for what it finds."""
        nothing = Recalled(pose_age=pose_age, most_age=most_age)
        try:
            self._claim()
        except HeldError as error:
            return nothing._replace(why=f"what is kept in {self.path} is that of {error.holder}, which is running")
        self._tidy()
        try:
            data = read_start(self.path, MAX_BYTES + 1)
        except FileNotFoundError:
            return nothing._replace(why="nothing is kept of an earlier run")
        except OSError as error:
            return nothing._replace(why=f"what is kept in {self.path} cannot be read: {error.strerror}")
        try:
            kept = kept_from_bytes(data)
        except KeptError as error:
            return nothing._replace(why=f"what is kept in {self.path} is not used: {error}")
        age = (now.utime - kept.utime) * 1e-6
        if age < -1.0:
            why = f"what is kept is stamped {-age:.0f} s ahead of the clock: it was set back since, or is not set yet"
            return nothing._replace(why=why)
        if kept.boot and kept.boot == self._boot:
            ran = (now.monotonic_ns - kept.monotonic_ns) * 1e-9
            if ran < 0.0 or age < ran - CLOCKS_AGREE:
                return nothing._replace(why=f"the clock was set back by {ran - age:.0f} s since the state was kept")
            age = max(age, ran)
        elif kept.pose is not None:
            # by the time of day alone, which may have been set to anything, nobody knows how long nobody watched
            kept = kept._replace(pose=None)
        return nothing._replace(kept=kept, age=max(age, 0.0))

    def _tidy(self) -> None:
        """Remove what runs left that were killed while they wrote."""
        with contextlib.suppress(OSError):
            for path in self.path.parent.glob(f"{self.path.name}?*"):
                path.unlink()

    def keep(self, kept: Kept) -> str:
        """Have a state kept, in place of one that still waits; return what is wrong with the disk, empty: nothing."""
        with self._change:
            self._waiting = kept
            self._change.notify()
            if self._thread is None:
                self._thread = threading.Thread(target=self._write_all, name="state keeper", daemon=True)
                self._thread.start()
            return self._trouble

    def close(self, kept: Kept | None = None) -> None:
        """Have the last state written and end; a disk that hangs is not waited for longer than `CLOSING_S`."""
        if kept is not None:
            self.keep(kept)
        with self._change:
            self._closing = True
            self._change.notify()
            thread = self._thread
        if thread is not None:
            thread.join(CLOSING_S)

    def _write_all(self) -> None:
        while True:
            with self._change:
                while self._waiting is None and not self._closing:
                    self._change.wait()
                kept, self._waiting = self._waiting, None
            if kept is None:
                return
            self._write(kept)

    def _claim(self) -> None:
        if self._lock is not None:
            self._lock.claim()

    def _write(self, kept: Kept) -> None:
        try:
            self._claim()
            write_whole(self.path, kept_to_bytes(kept._replace(boot=self._boot)))
        except HeldError as error:
            trouble = held_words(error, self.path.parent)
        except (OSError, ValueError) as error:
            directory = self.path.parent
            why = words_on(error, directory, "state_directory") if isinstance(error, OSError) else str(error)
            trouble = f"the state cannot be kept in {plain(str(directory))}: {why}. A restart will be a cold one"
        else:
            trouble = ""
        if trouble != self._trouble:
            self._trouble = trouble
            if trouble:
                log.warning("%s", trouble)
            else:
                log.info("the state is kept again in %s", self.path)
