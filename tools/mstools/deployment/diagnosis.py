"""Checks of `modelserver doctor` on a vehicle file: does it load, are its ports, its storage and its key usable."""

from __future__ import annotations

import os
import platform
import re
import shlex
import shutil
import stat
from collections.abc import Iterable, Iterator
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Final

from modelserver.config.vehicle_file import VehicleConfig, load_config
from modelserver.errors import KeyFileError, Problem, Severity
from modelserver.server.diagnostics.checks import Diagnosis, DiagnosisLevel, NetworkInterface
from modelserver.server.journal.segments import LOCK_NAME, list_segments
from modelserver.server.journal.writer import get_journal_directory, get_max_bytes
from modelserver.server.persistence.directory import get_state_directory
from modelserver.signing.key_files import find_group_writable_folder, read_keys
from modelserver.version import __version__
from mstools.deployment.files import CREDENTIAL
from mstools.deployment.plan import SERVICE, STATE, UNITS, VEHICLE
from mstools.terminal.output import format_count

if TYPE_CHECKING:
    from modelserver.config.vehicle_file import VehicleConfig
    from msdrivers.settings import DriverSettings


MIN_FREE: Final = 200_000_000
"""Free bytes on a disk below which there is a warning."""

NO_STATE: Final = "the origin is lost with every restart"
NO_JOURNAL: Final = "no journal is recorded"


def diagnose_files(vehicle: VehicleConfig, file: Path) -> tuple[Diagnosis, ...]:
    """Return the findings on state, journal and key, for the installed unit where the vehicle file is the unit's."""
    unit = is_unit_file(file)
    return (*diagnose_storage(vehicle, STATE[0] if unit else ""), *diagnose_keys(vehicle, unit))


def is_unit_file(file: Path) -> bool:
    """Return whether a vehicle file is the installed unit's, and this process is not the unit's."""
    return (
        os.path.realpath(file) == VEHICLE
        and os.path.exists(f"{UNITS}/{SERVICE}")
        and not os.environ.get("STATE_DIRECTORY")
    )


def diagnose_storage(vehicle: VehicleConfig, unit_directory: str = "") -> Iterator[Diagnosis]:
    """Yield the findings on the directories of state and journal.

    `unit_directory`: the state directory of the unit, which may write nowhere else; empty without a unit.
    """
    state = get_state_directory(vehicle.state_directory or unit_directory)
    journal = get_journal_directory(vehicle, unit_directory or None)
    if state is not None and _is_outside(state, unit_directory):
        yield _diagnose_outside("state", state, unit_directory, NO_STATE, "state_directory")
    elif unit_directory and os.geteuid() != 0 and not os.access(unit_directory, os.W_OK | os.X_OK):
        why = "this user may not read the unit's state"
        command = f"sudo modelserver doctor -c {VEHICLE}"
        yield Diagnosis(DiagnosisLevel.NOTE, "state", f"{unit_directory} is readable by root only", why, command)
        return
    else:
        yield from diagnose_state(state)
    if journal is not None and _is_outside(journal, unit_directory):
        yield _diagnose_outside("journal", journal, unit_directory, NO_JOURNAL, "journal.directory")
    else:
        yield from diagnose_journal(vehicle, journal)


def diagnose_state(directory: Path | None) -> Iterator[Diagnosis]:
    """Yield the findings on the state directory; None: there is no home directory."""
    if directory is None:
        command = "set state_directory: /var/lib/..."
        yield Diagnosis(DiagnosisLevel.WARNING, "state", "there is no home directory", NO_STATE, command)
        return
    problem = _diagnose_not_writable("state", directory, NO_STATE)
    if problem is not None:
        yield problem
        return
    there = _nearest_existing(directory)
    free = shutil.disk_usage(there).free
    if free < MIN_FREE:
        seen = f"{directory} has {free / 1e6:.0f} MB free"
        why = "on a full disk neither origin nor journal is stored"
        yield Diagnosis(DiagnosisLevel.WARNING, "state", seen, why, _disk_usage_command(there))
        return
    yield Diagnosis(DiagnosisLevel.OK, "state", f"{directory} may be written, {free / 1e9:.1f} GB free")


def diagnose_journal(vehicle: VehicleConfig, directory: Path | None) -> Iterator[Diagnosis]:
    """Yield the findings on the journal directory; None: no journal is recorded."""
    subject = "journal"
    if directory is None:
        off = vehicle.journal.megabytes == 0
        why = "journal.megabytes: 0" if off else "only under systemd, or with journal.directory"
        yield Diagnosis(DiagnosisLevel.OK, subject, f"no journal is recorded ({why})")
        return
    problem = _diagnose_not_writable(subject, directory, NO_JOURNAL)
    if problem is not None:
        yield problem
        return
    most = get_max_bytes(vehicle)
    there = _nearest_existing(directory)
    used = 0
    with suppress(OSError):
        used = sum(path.stat().st_size for path in list_segments(directory))
    left = max(most - used, 0)
    free = shutil.disk_usage(there).free
    seen = f"{directory} may be written; {used / 1e6:.0f} of {most >> 20} MB are used, {free / 1e9:.1f} GB free"
    if free >= left + MIN_FREE:
        yield Diagnosis(DiagnosisLevel.OK, subject, seen)
        return
    fits = int(used + free - MIN_FREE) >> 20
    smaller = f", or set journal.megabytes: {fits}" if fits >= 32 else ""
    seen = f"{directory} has {free / 1e6:.0f} MB free, and may take {left / 1e6:.0f} MB more"
    why = f"on a full disk neither origin nor journal is stored; free space{smaller}"
    yield Diagnosis(DiagnosisLevel.WARNING, subject, seen, why, _disk_usage_command(there))


def diagnose_keys(vehicle: VehicleConfig, unit: bool = False) -> Iterator[Diagnosis]:
    """Yield the findings on the key file; `unit`: the installed unit reads it, as a user of its own."""
    if not vehicle.commands.key_file:
        return
    subject, path = "key file", vehicle.commands.key_file
    why = "the service does not start without the keys of signed commands"
    quoted = shlex.quote(path)
    is_credential = _is_credential(path)
    try:
        keys = read_keys(path)
    except KeyFileError as error:
        if os.path.exists(path) and not os.access(path, os.R_OK) and is_credential:
            yield Diagnosis(
                DiagnosisLevel.OK, subject, f"{path} is passed to the service by systemd, and not readable by this user"
            )
            return
        yield Diagnosis(DiagnosisLevel.ERROR, subject, str(error), why, _key_fix_command(path))
        return
    if unit and not is_credential:
        seen = f"{path} is valid, but systemd does not pass it to the service, whose user may not read it"
        command = f"sudo modelserver install  # writes LoadCredential={os.path.basename(quoted)}:{quoted}"
        yield Diagnosis(DiagnosisLevel.ERROR, subject, seen, why, command)
        return
    shared = "" if is_credential else find_group_writable_folder(path)
    if shared:
        seen = f"{path} is below {shared}, which a group may write"
        danger = "members of the group can replace the key, and command the vehicle"
        yield Diagnosis(DiagnosisLevel.WARNING, subject, seen, danger, f"sudo chmod g-w {shlex.quote(shared)}")
        return
    yield Diagnosis(
        DiagnosisLevel.OK,
        subject,
        f"{path} may be read by this user alone or its group, {format_count(len(keys), 'key')}",
    )


def _key_fix_command(path: str) -> str:
    """Return the command that fixes an unusable key file."""
    quoted = shlex.quote(path)
    make = f"sudo modelserver key new {quoted}"
    try:
        status = os.stat(path)
    except FileNotFoundError:
        return make
    except OSError:
        return f"sudo ls -ld {quoted}"
    if not stat.S_ISREG(status.st_mode):
        return f"sudo mv {quoted} {quoted}.aside && {make}"
    if status.st_mode & (stat.S_IRWXO | stat.S_IWGRP):
        return f"sudo chmod 600 {quoted}"
    if not os.access(path, os.R_OK):
        return f"sudo chown {os.geteuid()} {quoted}"
    if status.st_uid not in (0, os.geteuid()):
        return f"sudo chown root {quoted}"
    for folder in Path(path).absolute().parents:
        mode = folder.stat().st_mode
        if mode & stat.S_IWOTH and not mode & stat.S_ISVTX:
            return f"sudo chmod o-w {shlex.quote(str(folder))}"
    return f"sudo mv {quoted} {quoted}.aside && {make}"


def _is_credential(path: str) -> bool:
    """Return whether systemd passes a file to the service as a credential; the file stays root's."""
    with suppress(OSError, UnicodeDecodeError):
        lines = Path(CREDENTIAL).read_text(encoding="utf-8").splitlines()
        return any(line.startswith("LoadCredential=") and line.partition(":")[2] == path for line in lines)
    return False


def _is_outside(directory: Path, given: str) -> bool:
    return bool(given) and not any(directory.is_relative_to(each) for each in (given, *STATE))


def _diagnose_outside(subject: str, directory: Path, given: str, why: str, key: str) -> Diagnosis:
    seen = f"the unit may not write in {directory}"
    why = f"{why}; leave {key} out of the vehicle file, or name a folder in {given}"
    return Diagnosis(
        DiagnosisLevel.WARNING, subject, seen, why, f"sudoedit {VEHICLE} && sudo systemctl restart {SERVICE}"
    )


def _nearest_existing(directory: Path) -> Path:
    """Return the first existing folder, in which the missing ones are created."""
    return next((each for each in (directory, *directory.parents) if os.path.exists(each)), Path("/"))


def _diagnose_not_writable(subject: str, directory: Path, why: str) -> Diagnosis | None:
    """Return why nothing can be written in a directory, None where it can."""
    there = _nearest_existing(directory)
    quoted = shlex.quote(str(there))
    if not there.is_dir():
        return Diagnosis(
            DiagnosisLevel.WARNING, subject, f"{there} is not a folder", why, f"mv {quoted} {quoted}.aside"
        )
    lock = directory / LOCK_NAME
    if os.access(there, os.W_OK | os.X_OK) and (not os.path.exists(lock) or os.access(lock, os.R_OK | os.W_OK)):
        return None
    if os.statvfs(there).f_flag & os.ST_RDONLY:
        command = f'sudo mount -o remount,rw "$(findmnt -no TARGET -T {quoted})"'
        return Diagnosis(
            DiagnosisLevel.WARNING, subject, f"{directory} is on a file system that is read-only", why, command
        )
    quoted = shlex.quote(str(directory))
    command = f"sudo mkdir -p {quoted} && sudo chown -R {os.geteuid()} {quoted}"
    return Diagnosis(DiagnosisLevel.WARNING, subject, f"{directory} may not be written by this user", why, command)


def _disk_usage_command(directory: Path) -> str:
    return f"du -xh --max-depth=2 {shlex.quote(str(directory))} | sort -h | tail"


def diagnose_versions() -> Diagnosis:
    """Return the installed versions."""
    seen = f"modelserver {__version__}, lcm {version('lcm')}, Python {platform.python_version()}"
    return Diagnosis(DiagnosisLevel.OK, "versions", seen)


def read_vehicle(file: Path) -> VehicleConfig:
    """Return a vehicle file. Raises ConfigError, OSError."""
    return load_config(file)


def diagnose_vehicle(vehicle: VehicleConfig, file: Path) -> tuple[Diagnosis, ...]:
    """Return the findings on a vehicle file on this machine."""
    from modelserver.server.diagnostics.machine import list_interfaces

    problems, drivers = _examine(vehicle, file)
    return (
        diagnose_vehicle_file(problems, file),
        *diagnose_files(vehicle, file),
        *diagnose_connections(drivers, tuple(list_interfaces())),
    )


def _examine(vehicle: VehicleConfig, file: Path) -> tuple[tuple[Problem, ...], Iterable[DriverSettings]]:
    from modelserver.config.vehicle_file import read_config_lines
    from modelserver.server.vehicle import examine_vehicle
    from msdrivers.settings import SourceMap, read_drivers
    from mstools.commands.driver import find_driver_problems

    geometry, of_vehicle = examine_vehicle(vehicle, str(file))
    problems = (*geometry.problems, *of_vehicle)
    drivers, _ = read_drivers(vehicle.drivers, SourceMap(str(file), read_config_lines(file)))
    return (*problems, *find_driver_problems(vehicle, str(file), geometry.constraints)), drivers.values()


def diagnose_vehicle_file(problems: Iterable[Problem], file: Path) -> Diagnosis:
    """Return the finding on a vehicle file with these problems."""
    problems = tuple(problems)
    command = f"modelserver check {shlex.quote(str(file))}"
    errors = [each for each in problems if each.severity is Severity.ERROR]
    warnings = [each for each in problems if each.severity is Severity.WARNING]
    if errors:
        seen = f"{file} has {format_count(len(errors), 'error')}, the first: {errors[0].message}"
        return Diagnosis(
            DiagnosisLevel.ERROR, "vehicle file", seen, "the service or a driver does not start with it", command
        )
    if warnings:
        seen = f"{file} loads, with {format_count(len(warnings), 'warning')}, the first: {warnings[0].message}"
        return Diagnosis(
            DiagnosisLevel.WARNING, "vehicle file", seen, "the configuration may not be what was intended", command
        )
    return Diagnosis(DiagnosisLevel.OK, "vehicle file", f"{file} loads, and its geometry")


def diagnose_connections(
    drivers: Iterable[DriverSettings], networks: Iterable[NetworkInterface]
) -> Iterator[Diagnosis]:
    """Yield the findings on the drivers' connections; `networks` are the network interfaces of this machine."""
    from msdrivers.line_settings import CanSettings, SerialSettings

    by_name = {each.name: each for each in networks}
    for driver in drivers:
        subject = f"driver {driver.name}"
        if isinstance(driver.line, SerialSettings):
            yield _diagnose_serial(subject, driver.line.port)
        elif isinstance(driver.line, CanSettings) and driver.line.interface == "socketcan":
            yield _diagnose_can(subject, driver.line.can, by_name)
        else:
            yield Diagnosis(DiagnosisLevel.OK, subject, f"{driver.line}: not tested")


def _diagnose_serial(subject: str, port: str) -> Diagnosis:
    from msdrivers.links.serial_port import explain_permission, find_access_problem, suggest_ports

    if not os.path.exists(port):
        near = suggest_ports(port)
        seen = f"{port} is not there" + (f"; there are: {', '.join(near[:3])}" if near else "")
        why = "the driver waits until it is"
        return Diagnosis(DiagnosisLevel.WARNING, subject, seen, why, "modelserver driver --list")
    if not os.access(port, os.R_OK | os.W_OK):
        why = explain_permission(port)
        joining = re.search(r"sudo usermod -aG \S+ [^\s,]+", why)
        command = joining.group() if joining else f"ls -l {port}"
        return Diagnosis(DiagnosisLevel.ERROR, subject, f"this user may not open {port}", why, command)
    hint = find_access_problem(port)
    return (
        Diagnosis(DiagnosisLevel.NOTE, subject, f"{port} is {hint}")
        if hint
        else Diagnosis(DiagnosisLevel.OK, subject, f"{port} is free")
    )


def _diagnose_can(subject: str, name: str, networks: dict[str, NetworkInterface]) -> Diagnosis:
    bring_up = f"sudo ip link set {name} up type can bitrate 500000"
    network = networks.get(name)
    if network is None:
        why = "the driver waits until it is"
        command = f"modelserver driver --list; {bring_up}"
        return Diagnosis(DiagnosisLevel.WARNING, subject, f"network interface {name} is not there", why, command)
    if not network.up:
        why = "no frames are received or sent; use the bitrate of the bus"
        return Diagnosis(DiagnosisLevel.ERROR, subject, f"network interface {name} is down", why, bring_up)
    return Diagnosis(DiagnosisLevel.OK, subject, f"network interface {name} is up")
