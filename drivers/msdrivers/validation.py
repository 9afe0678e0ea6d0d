"""Validation of drivers against their files, each other, and the vehicle's wheels and joints."""

from __future__ import annotations

import os
from collections.abc import Collection, Hashable, Iterable, Iterator
from pathlib import Path

from modelserver.errors import ConfigError, Problem, Severity, find_suggestion, quote, suggest_name
from msdrivers.factory import make_driver
from msdrivers.line_settings import CanSettings, LineSettings, ModbusSettings, SerialSettings, get_line_key
from msdrivers.settings import DriverSettings


def find_unbuildable_drivers(drivers: Iterable[DriverSettings], folder: Path) -> Iterator[Problem]:
    """Yield the problems of drivers that cannot be made: a missing DBC file, an unknown signal."""
    for driver in drivers:
        try:
            make_driver(driver, folder)
        except ConfigError as error:
            yield from error.problems


def find_shared_lines(drivers: Iterable[DriverSettings]) -> Iterator[Problem]:
    """Yield lines that several drivers use exclusively; a CAN bus can be shared."""
    owners: dict[Hashable, str] = {}
    for driver in drivers:
        owned = _exclusive_resource(driver.line)
        owner = driver.name if owned is None else owners.setdefault(owned, driver.name)
        if owner != driver.name:
            source = driver.source_map.locate("drivers", driver.name, get_line_key(type(driver.line)))
            message = f"drivers {owner} and {driver.name} have one line, {driver.line}: only one of them can use it"
            yield Problem(Severity.WARNING, message, source, "give each a line of its own, or start only one of them")


def _exclusive_resource(line: LineSettings) -> Hashable | None:
    if isinstance(line, CanSettings):
        return None
    if isinstance(line, SerialSettings):
        # a port has several names, e.g. below /dev/serial/by-id/
        return os.path.realpath(line.port)
    return (line.address, line.unit_id) if isinstance(line, ModbusSettings) else line.address


def find_unknown_wheels(driver: DriverSettings, frames: Collection[str]) -> Iterator[Problem]:
    """Yield wheels that are not in `sensors.wheels.frames`; none if that is empty."""
    wheels = tuple(getattr(driver.device_settings, "wheels", ()))
    for name in wheels if frames else ():
        if name in frames:
            continue
        what = f"sensors.wheels.frames has no {quote(name)}: what is measured of this wheel is not used"
        # a wheel there that this driver does not measure is meant: but which of the two names is the misspelled one?
        left = [frame for frame in frames if frame not in wheels]
        near = find_suggestion(name, left)
        if near:
            fix = f"write one name in both places: here it is {quote(name)}, in sensors.wheels.frames {quote(near)}"
        else:
            fix = f"known: {', '.join(list(frames)[:10])}"
        yield Problem(Severity.WARNING, what, driver.source_map.locate("drivers", driver.name, "wheels", name), fix)


def find_unknown_joint(driver: DriverSettings, constraints: Collection[str]) -> Iterator[Problem]:
    """Yield a joint that is no constraint of the geometry."""
    joint = getattr(driver.device_settings, "joint", "")
    if joint and joint not in constraints:
        what = f"the geometry has no constraint {quote(joint)}: what is measured of this joint moves nothing"
        near = suggest_name(joint, constraints)
        fix = f"write {near[0]}" if near else f"known: {', '.join(list(constraints)[:10]) or 'none'}"
        yield Problem(Severity.WARNING, what, driver.source_map.locate("drivers", driver.name, "joint"), fix, near)
