"""What a service persists in its state directory, which one service of a vehicle uses at a time."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Final

from modelserver.config.vehicle_file import VehicleConfig
from modelserver.server.persistence.directory import FileLock, LockHeldError
from modelserver.server.persistence.origin import OriginStore, get_state_directory, to_file_name
from modelserver.server.persistence.state import StateStore, describe_held_lock

log = logging.getLogger(__name__)

SUBJECT: Final = "restart"
"""Subject of the health warning while no state is stored."""


@dataclass(frozen=True, slots=True)
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
        """Release the directory."""
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
