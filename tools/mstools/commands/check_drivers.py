"""What is wrong with the drivers of a vehicle file, as far as it can be told without their devices."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from modelserver.errors import Problem

if TYPE_CHECKING:
    from modelserver.config import VehicleConfig
    from msdrivers.settings import DriverSettings


def drivers_problems(vehicle: VehicleConfig, file: str, constraints: Collection[str] | None) -> tuple[Problem, ...]:
    """Return everything that is wrong with the drivers of a vehicle file.

    `constraints` are those of its geometry; None where it is not known.
    """
    from modelserver.config import config_lines

    lines = config_lines(file)
    if not any(path[:1] == ("drivers",) for path in lines):
        return ()
    from msdrivers.checks import shared_lines, unfit_files
    from msdrivers.settings import Place, read_drivers

    found, problems = read_drivers(vehicle.drivers, Place(file, lines))
    drivers = found.values()
    return (
        *problems,
        *unfit_files(drivers, Path(file).parent),
        *shared_lines(drivers),
        *misnamed(vehicle, drivers, constraints),
    )


def misnamed(
    vehicle: VehicleConfig, drivers: Iterable[DriverSettings], constraints: Collection[str] | None
) -> Iterator[Problem]:
    """Yield the wheels and joints of drivers that the rest of the vehicle file and the geometry do not have."""
    from msdrivers.checks import unknown_joint, unknown_wheels

    wheels = vehicle.sensors.wheels
    for driver in drivers:
        # on a channel of its own the service does not hear it
        if wheels is not None and driver.channel in ("", wheels.channel):
            yield from unknown_wheels(driver, wheels.frames)
        if constraints is not None:
            yield from unknown_joint(driver, constraints)


def constraints_of(vehicle: VehicleConfig) -> tuple[str, ...] | None:
    """Return the constraints of the geometry that a vehicle file names; None where it cannot be read."""
    from modelserver.formats import examine_file

    try:
        return examine_file(vehicle.geometry, vehicle.variables).constraints
    except OSError:
        return None
