"""Whether drivers can be made of their settings, with the files they name, beside each other, on this vehicle."""

from __future__ import annotations

import os
from collections.abc import Collection, Hashable, Iterable, Iterator
from pathlib import Path

from modelserver.errors import ConfigError, Problem, Severity, shown, suggestion, suggestions
from msdrivers.line_settings import CanSettings, LineSettings, ModbusSettings, SerialSettings, first_key
from msdrivers.making import station_of
from msdrivers.settings import DriverSettings


def unfit_files(drivers: Iterable[DriverSettings], folder: Path) -> Iterator[Problem]:
    """Yield why drivers cannot be made: a DBC file that is missing, a signal that it does not have."""
    for driver in drivers:
        try:
            station_of(driver, folder)
        except ConfigError as error:
            yield from error.problems


def shared_lines(drivers: Iterable[DriverSettings]) -> Iterator[Problem]:
    """Yield what several drivers want for themselves; a CAN bus is for all."""
    owners: dict[Hashable, str] = {}
    for driver in drivers:
        owned = _owned(driver.line)
        owner = driver.name if owned is None else owners.setdefault(owned, driver.name)
        if owner != driver.name:
            source = driver.place.source("drivers", driver.name, first_key(type(driver.line)))
            message = f"drivers {owner} and {driver.name} have one line, {driver.line}: only one of them can use it"
            yield Problem(Severity.WARNING, message, source, "give each a line of its own, or start only one of them")


def _owned(line: LineSettings) -> Hashable | None:
    if isinstance(line, CanSettings):
        return None
    if isinstance(line, SerialSettings):
        # a port has several names, e.g. below /dev/serial/by-id/
        return os.path.realpath(line.port)
    return (line.address, line.unit_id) if isinstance(line, ModbusSettings) else line.address


def unknown_wheels(driver: DriverSettings, frames: Collection[str]) -> Iterator[Problem]:
    """Yield the wheels that the vehicle does not have, by the names in `sensors.wheels.frames`; none there: any."""
    wheels = tuple(getattr(driver.station, "wheels", ()))
    for name in wheels if frames else ():
        if name in frames:
            continue
        what = f"sensors.wheels.frames has no {shown(name)}: what is measured of this wheel is not used"
        # a wheel there that this driver does not measure is meant: but which of the two names is the misspelled one?
        left = [frame for frame in frames if frame not in wheels]
        near = suggestion(name, left)
        if near:
            fix = f"write one name in both places: here it is {shown(name)}, in sensors.wheels.frames {shown(near)}"
        else:
            fix = f"known: {', '.join(list(frames)[:10])}"
        yield Problem(Severity.WARNING, what, driver.place.source("drivers", driver.name, "wheels", name), fix)


def unknown_joint(driver: DriverSettings, constraints: Collection[str]) -> Iterator[Problem]:
    """Yield a joint that is none of the geometry's constraints."""
    joint = getattr(driver.station, "joint", "")
    if joint and joint not in constraints:
        what = f"the geometry has no constraint {shown(joint)}: what is measured of this joint moves nothing"
        near = suggestions(joint, constraints)
        fix = f"write {near[0]}" if near else f"known: {', '.join(list(constraints)[:10]) or 'none'}"
        yield Problem(Severity.WARNING, what, driver.place.source("drivers", driver.name, "joint"), fix, near)
