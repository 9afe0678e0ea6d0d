"""Change of the geometry beside the loop, so that no tick waits for it: a reload of its file, or an added frame.

A process of its own reads and checks the file: parsing holds Python's lock for a second with 10,000 frames. A thread
takes the result over, adds the frames of programs, compares it with the old geometry and encodes its snapshot. The loop
polls, and uses the old geometry until the new one is whole. The localizer is that of the moment at which the loop takes
the new geometry.
"""

from __future__ import annotations

import logging
import os
import pickle
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import Final, NamedTuple, TypeAlias

from modelserver import errors
from modelserver.config.vehicle_file import VehicleConfig
from modelserver.core import CoreState, ModelLoaded
from modelserver.geometry import Model
from modelserver.geometry.model import describe_changes
from modelserver.messages import Lifetime, LoadModel, ReloadModel, SetFrame
from modelserver.server.added_frames import add_frames, change_frames
from modelserver.server.persistence import AddedFramesStore
from modelserver.server.vehicle import Vehicle, find_disconnected, load_vehicle

log = logging.getLogger(__name__)

PollReload: TypeAlias = Callable[[CoreState], ModelLoaded | None]
"""Called in each pass with the state of that moment, until it returns what was read."""

LIMIT_S: Final = 300.0
"""Longest time for reading a geometry, seconds: twenty times what 100,000 frames take."""

SWITCH_INTERVAL_S: Final = 1e-4
"""How long the loop waits for Python's lock while a result is taken over; five milliseconds by default."""

NICE: Final = 10
"""Added to the niceness of the process that reads: the loop is before it."""

_MAIN: Final = "from modelserver.server.reloading import main; main()"


class NewGeometry(NamedTuple):
    """The next geometry or `why` there is none: the vehicle as its file has it, and the one with added frames."""

    of_file: Vehicle
    frames: tuple[SetFrame, ...] = ()
    vehicle: Vehicle | None = None
    why: str = ""
    changes: tuple[str, ...] = ()
    snapshot: bytes = b""


class GeometryReader:
    """Changes the geometry of a vehicle, one change at a time. `read` is `read_geometry`, or does the same.

    `frames`: the store of permanent added frames; None: none can be permanent.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        file: str = "",
        read: Callable[[VehicleConfig, str], Vehicle | str] | None = None,
        frames: AddedFramesStore | None = None,
    ):
        self._of_file = vehicle
        self._file = file
        self._read = read or self._read_in_process
        self._store = frames
        self._frames: tuple[SetFrame, ...] = ()
        self._process: subprocess.Popen[bytes] | None = None
        self._snapshot: tuple[Model | None, bytes] = (None, b"")

    def restore_frames(self) -> tuple[Vehicle, str]:
        """Return the vehicle with the permanent frames of earlier runs, and which could not be added, and why."""
        self._frames, why = ((), "") if self._store is None else self._store.load()
        model, left_out = add_frames(self._of_file.model, self._frames)
        return self._of_file.with_model(model), "; ".join(filter(None, (why, *left_out.values())))

    def begin(self, command: LoadModel, state: CoreState) -> PollReload:
        """Begin to make the next geometry; return the function that ends it."""
        found: list[NewGeometry] = []
        request, before = command.request, state.model
        thread = threading.Thread(
            target=lambda: found.append(self._prepare(request, before)), name="reload", daemon=True
        )
        thread.start()

        return lambda state: self._finish(command, found[0], state) if found else None

    def encode_snapshot(self, model: Model) -> bytes:
        """Return the snapshot of a geometry, which is encoded already if it was read again."""
        known, data = self._snapshot
        return data if known is model else self._of_file.encode_snapshot(model)

    def close(self) -> None:
        if self._process is not None:
            self._process.kill()

    def _finish(self, command: LoadModel, found: NewGeometry, state: CoreState) -> ModelLoaded:
        if found.vehicle is None:
            return ModelLoaded(command.request, why=found.why)
        loaded = ModelLoaded(command.request, found.vehicle.model, state.localizer, changes=found.changes)
        if loaded.is_dry_run:
            return loaded
        if why := self._store_frames(found.frames):
            return ModelLoaded(command.request, why=why)
        self._of_file, self._frames = found.of_file, found.frames
        self._snapshot = (found.vehicle.model, found.snapshot)
        setup = found.vehicle.make_localizer_setup()
        if setup is not None:
            from modelserver.estimation.modes import ModeLocalizer

            if isinstance(state.localizer, ModeLocalizer):
                return replace(loaded, localizer=state.localizer.reconfigure(setup))
        return loaded

    def _store_frames(self, frames: tuple[SetFrame, ...]) -> str:
        """Store the permanent frames where they have changed; return why it cannot be done, "" if it was."""
        before, after = (
            [each for each in some if each.lifetime is Lifetime.PERMANENT] for some in (self._frames, frames)
        )
        if before == after:
            return ""
        return "there is no state directory for permanent frames" if self._store is None else self._store.save(after)

    # --- in the thread ---

    def _prepare(self, request: ReloadModel | SetFrame | None, before: Model) -> NewGeometry:
        usual = sys.getswitchinterval()
        sys.setswitchinterval(SWITCH_INTERVAL_S)
        of_file, frames = self._of_file, self._frames
        try:
            if isinstance(request, SetFrame):
                try:
                    frames = change_frames(frames, request, of_file.model)
                except ValueError as error:
                    return NewGeometry(of_file, why=str(error))
            else:
                read = self._read(of_file.config, self._file)
                if isinstance(read, str):
                    return NewGeometry(of_file, why=read)
                of_file = read
            return compare_geometry(of_file, frames, before)
        except Exception as error:
            log.exception("changing the geometry failed")
            return NewGeometry(of_file, why=f"internal error while reading it: {error}")
        finally:
            sys.setswitchinterval(usual)

    def _read_in_process(self, config: VehicleConfig, file: str) -> Vehicle | str:
        """Read in a process that runs this Python with the same modules."""
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
        command = (sys.executable, "-P", "-c", _MAIN)
        process = self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment, start_new_session=True
        )
        try:
            data, _ = process.communicate(pickle.dumps((config, file)), LIMIT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
            return f"reading it took more than {LIMIT_S:.0f} s"
        if code := process.returncode:
            how = signal.Signals(-code).name if code < 0 else f"code {code}"
            return f"the process that read it ended early ({how}); the service's log has more"
        found: Vehicle | str = pickle.loads(data)
        return found


def compare_geometry(of_file: Vehicle, frames: tuple[SetFrame, ...], before: Model) -> NewGeometry:
    """Return the geometry of a file with the frames that fit it, unless it lost bodies that the one before has."""
    lost = find_disconnected(of_file.model) - find_disconnected(before)
    if lost:
        why = (
            f"{', '.join(sorted(lost))}: no longer connected to the root; if the file is still being written, "
            "write a temporary file and rename it; to use the geometry as it is, restart the server"
        )
        return NewGeometry(of_file, why=why)
    model, left_out = add_frames(of_file.model, frames)
    vehicle = of_file.with_model(model)
    changes = (*describe_changes(before, model), *(f"not added: {why}" for why in left_out.values()))
    return NewGeometry(of_file, frames, vehicle, "", changes, vehicle.encode_snapshot(model))


def read_geometry(config: VehicleConfig, file: str) -> Vehicle | str:
    """Read the geometry file of a vehicle, and check all of it against the vehicle file; return why not, if not."""
    try:
        return load_vehicle(config, file)
    except (errors.GeometryError, errors.ConfigError) as error:
        return str(error)


def main() -> None:
    """Read the geometry of the vehicle on standard input, and write it to standard output."""
    with suppress(OSError):
        os.nice(NICE)
    found = read_geometry(*pickle.load(sys.stdin.buffer))
    sys.stdout.buffer.write(pickle.dumps(found))
    sys.stdout.buffer.flush()
