"""Drivers and emulators from their settings; what is wrong then is told at its line of the vehicle file."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from modelserver.errors import ConfigError
from msdrivers.faults import InjectedFault
from msdrivers.registry import Emulation
from msdrivers.settings import DriverSettings
from msdrivers.station import Station


def station_of(driver: DriverSettings, folder: Path) -> Station[Any]:
    """Return a driver's station; paths in its settings start from `folder`. Raises ConfigError."""
    with _located(driver):
        return driver.kind.load().station(driver.station, folder)


def emulator_of(
    driver: DriverSettings,
    folder: Path,
    samples: Iterable[Any],
    faults: tuple[InjectedFault, ...] = (),
    memory: Path | None = None,
) -> Station[Any]:
    """Return the station of the emulated device; see `Emulation`. Raises ConfigError."""
    with _located(driver):
        return driver.kind.emulate(Emulation(driver.station, folder, samples, faults, memory))


@contextmanager
def _located(driver: DriverSettings) -> Iterator[None]:
    try:
        yield
    except ConfigError as error:
        raise ConfigError(driver.place.located(driver.name, error.problems)) from None
