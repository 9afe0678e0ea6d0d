"""What `modelserver doctor` says of a vehicle file: does it load, and are the drivers' lines there."""

from __future__ import annotations

import os
import platform
import re
import shlex
from collections.abc import Iterable, Iterator
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

from modelserver.config import VehicleConfig, load_config
from modelserver.errors import Problem, Severity
from modelserver.service.probing.findings import Diagnosis, DiagnosisLevel
from modelserver.service.probing.probe import Interface
from modelserver.version import __version__
from mstools.deployment.doctor_files import file_findings
from mstools.terminal.output import counted

if TYPE_CHECKING:
    from msdrivers.settings import DriverSettings


def versions() -> Diagnosis:
    """Return what runs here."""
    seen = f"modelserver {__version__}, lcm {version('lcm')}, Python {platform.python_version()}"
    return Diagnosis(DiagnosisLevel.OK, "versions", seen)


def read_vehicle(file: Path) -> VehicleConfig:
    """Return a vehicle file. Raises ConfigError, OSError."""
    return load_config(file)


def vehicle_findings(vehicle: VehicleConfig, file: Path) -> tuple[Diagnosis, ...]:
    """Return what is to be said of a vehicle file on this machine."""
    from modelserver.service.probing.machine import interfaces

    problems, drivers = _read(vehicle, file)
    return (
        file_finding(problems, file),
        *file_findings(vehicle, file),
        *line_findings(drivers, tuple(interfaces())),
    )


def _read(vehicle: VehicleConfig, file: Path) -> tuple[tuple[Problem, ...], Iterable[DriverSettings]]:
    from modelserver.config import config_lines
    from modelserver.service.daemon import examine_vehicle
    from msdrivers.settings import Place, read_drivers
    from mstools.commands.check_drivers import drivers_problems

    geometry, of_vehicle = examine_vehicle(vehicle, str(file))
    problems = (*geometry.problems, *of_vehicle)
    drivers, _ = read_drivers(vehicle.drivers, Place(str(file), config_lines(file)))
    return (*problems, *drivers_problems(vehicle, str(file), geometry.constraints)), drivers.values()


def file_finding(problems: Iterable[Problem], file: Path) -> Diagnosis:
    """Return what is to be said of a vehicle file with these problems."""
    problems = tuple(problems)
    command = f"modelserver check {shlex.quote(str(file))}"
    errors = [each for each in problems if each.severity is Severity.ERROR]
    warnings = [each for each in problems if each.severity is Severity.WARNING]
    if errors:
        seen = f"{file} has {counted(len(errors), 'error')}, the first: {errors[0].message}"
        return Diagnosis(
            DiagnosisLevel.ERROR, "vehicle file", seen, "the service or a driver does not start with it", command
        )
    if warnings:
        seen = f"{file} loads, with {counted(len(warnings), 'warning')}, the first: {warnings[0].message}"
        return Diagnosis(DiagnosisLevel.WARNING, "vehicle file", seen, "it may not be what is meant", command)
    return Diagnosis(DiagnosisLevel.OK, "vehicle file", f"{file} loads, and its geometry")


def line_findings(drivers: Iterable[DriverSettings], networks: Iterable[Interface]) -> Iterator[Diagnosis]:
    """Yield what is to be said of the lines of drivers; `networks` are the network interfaces of this machine."""
    from msdrivers.line_settings import CanSettings, SerialSettings

    by_name = {each.name: each for each in networks}
    for driver in drivers:
        subject = f"driver {driver.name}"
        if isinstance(driver.line, SerialSettings):
            yield _serial(subject, driver.line.port)
        elif isinstance(driver.line, CanSettings) and driver.line.interface == "socketcan":
            yield _can(subject, driver.line.can, by_name)
        else:
            yield Diagnosis(DiagnosisLevel.OK, subject, f"{driver.line}: only trying it tells")


def _serial(subject: str, port: str) -> Diagnosis:
    from msdrivers.links.ports import hint_for, near_ports, permission_fix

    if not os.path.exists(port):
        near = near_ports(port)
        seen = f"{port} is not there" + (f"; there are: {', '.join(near[:3])}" if near else "")
        why = "the driver waits until it is"
        return Diagnosis(DiagnosisLevel.WARNING, subject, seen, why, "modelserver driver --list")
    if not os.access(port, os.R_OK | os.W_OK):
        why = permission_fix(port)
        joining = re.search(r"sudo usermod -aG \S+ [^\s,]+", why)
        command = joining.group() if joining else f"ls -l {port}"
        return Diagnosis(DiagnosisLevel.ERROR, subject, f"{port} may not be opened by this user", why, command)
    hint = hint_for(port)
    return (
        Diagnosis(DiagnosisLevel.NOTE, subject, f"{port} is {hint}")
        if hint
        else Diagnosis(DiagnosisLevel.OK, subject, f"{port} is free")
    )


def _can(subject: str, name: str, networks: dict[str, Interface]) -> Diagnosis:
    bring_up = f"sudo ip link set {name} up type can bitrate 500000"
    network = networks.get(name)
    if network is None:
        why = "the driver waits until it is"
        command = f"modelserver driver --list; {bring_up}"
        return Diagnosis(DiagnosisLevel.WARNING, subject, f"network interface {name} is not there", why, command)
    if not network.up:
        why = "no frame comes or goes; the bitrate is the bus's own"
        return Diagnosis(DiagnosisLevel.ERROR, subject, f"network interface {name} is down", why, bring_up)
    return Diagnosis(DiagnosisLevel.OK, subject, f"network interface {name} is up")
