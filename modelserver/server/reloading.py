"""Reload of the geometry beside the loop, so that no tick waits for it.

A process of its own reads and checks the file: parsing holds Python's lock for a second with 10,000 frames. A thread
takes the result over, compares it with the old geometry and encodes its snapshot. The loop polls, and uses the old
geometry until the new one is whole. The localizer is that of the moment at which the loop takes the new geometry.
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
from typing import Final, NamedTuple, TypeAlias

from modelserver import errors
from modelserver.config.vehicle_file import VehicleConfig
from modelserver.core import CoreState, ModelLoaded
from modelserver.geometry import Model
from modelserver.geometry.model import describe_changes
from modelserver.messages import LoadModel
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
    """A geometry that was read, as part of its vehicle, or `why` not; what has changed, and its snapshot."""

    vehicle: Vehicle | None = None
    why: str = ""
    changes: tuple[str, ...] = ()
    snapshot: bytes = b""


class GeometryReader:
    """Reads the geometry of a vehicle again, one reload at a time. `read` is `read_geometry`, or does the same."""

    def __init__(
        self, vehicle: Vehicle, file: str = "", read: Callable[[VehicleConfig, str], Vehicle | str] | None = None
    ):
        self._vehicle = vehicle
        self._file = file
        self._read = read or self._read_in_process
        self._process: subprocess.Popen[bytes] | None = None
        self._snapshot: tuple[Model | None, bytes] = (None, b"")

    def begin(self, command: LoadModel, state: CoreState) -> PollReload:
        """Begin to read the file; return the function that ends it."""
        found: list[NewGeometry] = []
        thread = threading.Thread(target=lambda: found.append(self._prepare(state.model)), name="reload", daemon=True)
        thread.start()

        return lambda state: self._finish(command, found[0], state) if found else None

    def encode_snapshot(self, model: Model) -> bytes:
        """Return the snapshot of a geometry, which is encoded already if it was read again."""
        known, data = self._snapshot
        return data if known is model else self._vehicle.encode_snapshot(model)

    def close(self) -> None:
        if self._process is not None:
            self._process.kill()

    def _finish(self, command: LoadModel, found: NewGeometry, state: CoreState) -> ModelLoaded:
        if found.vehicle is None:
            return ModelLoaded(command.request, why=found.why)
        self._snapshot = (found.vehicle.model, found.snapshot)
        localizer, setup = state.localizer, found.vehicle.make_localizer_setup()
        if setup is not None:
            from modelserver.estimation.modes import ModeLocalizer

            if isinstance(localizer, ModeLocalizer):
                localizer = localizer.reconfigure(setup)
        return ModelLoaded(command.request, found.vehicle.model, localizer, changes=found.changes)

    # --- in the thread ---

    def _prepare(self, before: Model) -> NewGeometry:
        usual = sys.getswitchinterval()
        sys.setswitchinterval(SWITCH_INTERVAL_S)
        try:
            vehicle = self._read(self._vehicle.config, self._file)
            if isinstance(vehicle, str):
                return NewGeometry(why=vehicle)
            return compare_geometry(vehicle, before)
        except Exception as error:
            log.exception("reloading the geometry failed")
            return NewGeometry(why=f"internal error while reading it: {error}")
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


def compare_geometry(vehicle: Vehicle, before: Model) -> NewGeometry:
    """Return a vehicle with its new geometry, unless that lost bodies that the one before has."""
    if lost := find_disconnected(vehicle.model) - find_disconnected(before):
        return NewGeometry(
            why=f"{', '.join(sorted(lost))}: no longer connected to the root; if the file is still being written, "
            "write a temporary file and rename it; to use the geometry as it is, restart the server"
        )
    return NewGeometry(vehicle, "", describe_changes(before, vehicle.model), vehicle.encode_snapshot(vehicle.model))


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
