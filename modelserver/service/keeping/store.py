"""The state directory of a service: what is kept there, and that one service of a vehicle at a time keeps it."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Final

from modelserver.config import VehicleConfig
from modelserver.service.keeping.lock import HeldError, Lock
from modelserver.service.keeping.origin import OriginKeeper, safe, state_directory
from modelserver.service.keeping.state import StateKeeper, held_words

log = logging.getLogger(__name__)

SUBJECT: Final = "restart"
"""Of the notice in the health report while nothing is kept for a restart."""


@dataclass(frozen=True, slots=True)
class Store:
    """What a service keeps, None for what it does not.

    lock: that of the state directory, which each that writes there asks for anew: where its holder has ended, this
    service takes over. trouble: why nothing can be kept there, as it was logged; empty: nothing is wrong.
    """

    origin: OriginKeeper | None = None
    state: StateKeeper | None = None
    lock: Lock | None = None
    trouble: str = ""

    def close(self) -> None:
        """Let another service have the directory."""
        if self.lock is not None:
            self.lock.release()


def open_store(config: VehicleConfig, localizes: bool) -> Store:
    """Return what a service of this vehicle keeps; `localizes`: whether there is a state to keep at all.

    A directory that cannot be used, or is another service's, stops nothing: it is logged, and told in `trouble`.
    """
    directory = state_directory(config.state_directory)
    if directory is None:
        log.warning("there is no home directory, so nothing is kept for a restart; set state_directory in vehicle file")
        return Store()
    keeps_origin = config.origin.keep and config.origin.initial_utm is None
    keeps_state = config.restart.keep and localizes
    lock = Lock(directory / f"lock-{safe(config.vehicle)}")
    trouble = ""
    if keeps_origin or keeps_state:
        try:
            lock.claim()
        except HeldError as error:
            trouble = held_words(error, directory)
            log.warning("%s", trouble)
    return Store(
        OriginKeeper(directory, config.vehicle, lock) if keeps_origin else None,
        StateKeeper(directory, config.vehicle, lock=lock, trouble=trouble) if keeps_state else None,
        lock,
        trouble,
    )
