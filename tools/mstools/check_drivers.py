"""What is wrong with the drivers of a vehicle file, as far as it can be told without their devices."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from modelserver.errors import ConfigError, GeometryError, Problem

if TYPE_CHECKING:
    from modelserver.config import VehicleConfig
    from modelserver.geometry.model import Model
    from msdrivers.settings import DriverSettings


def drivers_problems(vehicle: VehicleConfig, file: str, model: Model | None) -> tuple[Problem, ...]:
    """Return everything that is wrong with the drivers of a vehicle file; `model` None: its geometry is not known."""
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
        *misnamed(vehicle, drivers, model),
    )


def misnamed(vehicle: VehicleConfig, drivers: Iterable[DriverSettings], model: Model | None) -> Iterator[Problem]:
    """Yield the wheels and joints of drivers that the rest of the vehicle file and the geometry do not have."""
    from msdrivers.checks import unknown_joint, unknown_wheels

    wheels = vehicle.sensors.wheels
    for driver in drivers:
        # on a channel of its own the service does not hear it
        if wheels is not None and driver.channel in ("", wheels.channel):
            yield from unknown_wheels(driver, wheels.frames)
        if model is not None:
            yield from unknown_joint(driver, [each.name for each in model.constraints])


def model_of(vehicle: VehicleConfig) -> Model | None:
    """Return the geometry that a vehicle file names; None where it cannot be had, which others tell."""
    from modelserver.formats import load_model

    try:
        return load_model(vehicle.geometry, variables=vehicle.variables)
    except (ConfigError, GeometryError, OSError):
        return None
