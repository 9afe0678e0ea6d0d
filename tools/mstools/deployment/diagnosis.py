"""Checks of `modelserver doctor` on a vehicle file: does it load, are its ports, its storage and its key usable."""

from __future__ import annotations

import os
import re
import shutil
import stat
from collections.abc import Collection, Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Final

from modelserver.config.vehicle_file import VehicleConfig, read_config_lines
from modelserver.errors import KeyFileError, Problem, Severity
from modelserver.server.diagnostics.checks import ERROR, NOTE, OK, WARNING, Diagnosis, NetworkInterface
from modelserver.server.journal.segments import LOCK_NAME, list_segments
from modelserver.server.journal.writer import get_journal_directory, get_max_bytes
from modelserver.server.persistence.directory import get_state_directory
from modelserver.signing.key_files import find_group_writable_folder, read_keys
from mstools.deployment.files import CREDENTIAL
from mstools.deployment.plan import SERVICE, STATE, UNITS, VEHICLE
from mstools.terminal.output import format_count

if TYPE_CHECKING:
    from msdrivers.settings import DriverSettings

MIN_FREE: Final = 200_000_000
"""Free bytes on a disk below which there is a warning."""

NO_STATE: Final = "the origin is lost with every restart"
NO_JOURNAL: Final = "no journal is recorded"


def diagnose_vehicle(vehicle: VehicleConfig, file: Path) -> tuple[Diagnosis, ...]:
    """Return the findings on a vehicle file on this machine."""
    from modelserver.server.diagnostics.machine import list_interfaces
    from modelserver.server.vehicle import examine_vehicle
    from msdrivers.settings import SourceMap, read_drivers

    geometry, of_vehicle = examine_vehicle(vehicle, str(file))
    of_drivers = find_driver_problems(vehicle, str(file), geometry.constraints)
    drivers, _ = read_drivers(vehicle.drivers, SourceMap(str(file), read_config_lines(file)))
    return (
        diagnose_vehicle_file((*geometry.problems, *of_vehicle, *of_drivers), file),
        *diagnose_files(vehicle, file),
        *diagnose_connections(drivers.values(), list_interfaces()),
    )


def find_driver_problems(vehicle: VehicleConfig, file: str, constraints: Collection[str] | None) -> tuple[Problem, ...]:
    """Return every problem of the drivers of a vehicle file that is visible without their devices.

    `constraints` are those of its geometry; None if unknown.
    """
    lines = read_config_lines(file)
    if not any(path[:1] == ("drivers",) for path in lines):
        return ()
    # imported here: a vehicle file without drivers needs none of their libraries
    from msdrivers.factory import find_shared_lines, find_unbuildable_drivers
    from msdrivers.settings import SourceMap, read_drivers

    found, problems = read_drivers(vehicle.drivers, SourceMap(file, lines))
    drivers = found.values()
    unbuildable = find_unbuildable_drivers(drivers, Path(file).parent)
    return (*problems, *unbuildable, *find_shared_lines(drivers), *find_misnamed(vehicle, drivers, constraints))


def find_misnamed(
    vehicle: VehicleConfig, drivers: Iterable[DriverSettings], constraints: Collection[str] | None
) -> Iterator[Problem]:
    """Yield the wheels and joints of drivers that the vehicle file or the geometry does not have."""
    from msdrivers.factory import find_backward_counters, find_unknown_joint, find_unknown_wheels

    wheels = vehicle.sensors.wheels
    for driver in drivers:
        yield from find_backward_counters(driver)
        # the server does not receive a driver on another channel
        if wheels is not None and driver.channel in ("", wheels.channel):
            yield from find_unknown_wheels(driver, wheels.frames)
        if constraints is not None:
            yield from find_unknown_joint(driver, constraints)


def diagnose_vehicle_file(problems: Iterable[Problem], file: Path) -> Diagnosis:
    """Return the finding on a vehicle file with these problems."""
    problems = tuple(problems)
    for severity, level, loads, why in (
        (Severity.ERROR, ERROR, "has", "the service or a driver does not start with it"),
        (Severity.WARNING, WARNING, "loads, with", "the configuration may not be what was intended"),
    ):
        if found := [each.message for each in problems if each.severity is severity]:
            seen = f"{file} {loads} {format_count(len(found), str(severity))}, the first: {found[0]}"
            return Diagnosis(level, "vehicle file", seen, why, f"modelserver check {quote(str(file))}")
    return Diagnosis(OK, "vehicle file", f"{file} loads, and its geometry")


def diagnose_files(vehicle: VehicleConfig, file: Path) -> tuple[Diagnosis, ...]:
    """Return the findings on state, journal and key, for the installed unit where the vehicle file is the unit's."""
    unit = is_unit_file(file)
    return (*diagnose_storage(vehicle, STATE[0] if unit else ""), *diagnose_keys(vehicle, unit))


def is_unit_file(file: Path) -> bool:
    """Return whether a vehicle file is the installed unit's, and this process is not the unit's."""
    is_installed = os.path.realpath(file) == VEHICLE and os.path.exists(f"{UNITS}/{SERVICE}")
    return is_installed and not os.environ.get("STATE_DIRECTORY")


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
        yield Diagnosis(NOTE, "state", f"{unit_directory} is readable by root only", why, command)
        return
    else:
        yield from diagnose_state(state)
    if journal is not None and _is_outside(journal, unit_directory):
        yield _diagnose_outside("journal", journal, unit_directory, NO_JOURNAL, "journal.directory")
    else:
        yield _diagnose_journal(vehicle, journal)


def _is_outside(directory: Path, given: str) -> bool:
    return bool(given) and not any(directory.is_relative_to(each) for each in (given, *STATE))


def _diagnose_outside(subject: str, directory: Path, given: str, why: str, key: str) -> Diagnosis:
    why = f"{why}; leave {key} out of the vehicle file, or name a folder in {given}"
    command = f"sudoedit {VEHICLE} && sudo systemctl restart {SERVICE}"
    return Diagnosis(WARNING, subject, f"the unit may not write in {directory}", why, command)


def diagnose_state(directory: Path | None) -> Iterator[Diagnosis]:
    """Yield the finding on the state directory; None: there is no home directory."""
    if directory is None:
        yield Diagnosis(WARNING, "state", "there is no home directory", NO_STATE, "set state_directory: /var/lib/...")
    elif problem := _diagnose_not_writable("state", directory, NO_STATE):
        yield problem
    elif (free := _get_free(directory)) < MIN_FREE:
        why = "on a full disk neither origin nor journal is stored"
        yield _diagnose_full("state", directory, f"{directory} has {free / 1e6:.0f} MB free", why)
    else:
        yield Diagnosis(OK, "state", f"{directory} may be written, {free / 1e9:.1f} GB free")


def _diagnose_journal(vehicle: VehicleConfig, directory: Path | None) -> Diagnosis:
    """Return the finding on the journal directory; None: no journal is recorded."""
    if directory is None:
        off = vehicle.journal.megabytes == 0
        why = "journal.megabytes: 0" if off else "only under systemd, or with journal.directory"
        return Diagnosis(OK, "journal", f"no journal is recorded ({why})")
    if problem := _diagnose_not_writable("journal", directory, NO_JOURNAL):
        return problem
    most, used, free = get_max_bytes(vehicle), 0, _get_free(directory)
    with suppress(OSError):
        used = sum(path.stat().st_size for path in list_segments(directory))
    left = max(most - used, 0)
    if free >= left + MIN_FREE:
        seen = f"{directory} may be written; {used / 1e6:.0f} of {most >> 20} MB are used, {free / 1e9:.1f} GB free"
        return Diagnosis(OK, "journal", seen)
    fits = int(used + free - MIN_FREE) >> 20
    smaller = f", or set journal.megabytes: {fits}" if fits >= 32 else ""
    seen = f"{directory} has {free / 1e6:.0f} MB free, and may take {left / 1e6:.0f} MB more"
    why = f"on a full disk neither origin nor journal is stored; free space{smaller}"
    return _diagnose_full("journal", directory, seen, why)


def _get_free(directory: Path) -> int:
    return shutil.disk_usage(_nearest_existing(directory)).free


def _diagnose_full(subject: str, directory: Path, seen: str, why: str) -> Diagnosis:
    command = f"du -xh --max-depth=2 {quote(str(_nearest_existing(directory)))} | sort -h | tail"
    return Diagnosis(WARNING, subject, seen, why, command)


def _nearest_existing(directory: Path) -> Path:
    """Return the first existing folder, in which the missing ones are created."""
    return next((each for each in (directory, *directory.parents) if os.path.exists(each)), Path("/"))


def _diagnose_not_writable(subject: str, directory: Path, why: str) -> Diagnosis | None:
    """Return why nothing can be written in a directory, None where it can."""
    there, lock = _nearest_existing(directory), directory / LOCK_NAME
    existing, quoted = quote(str(there)), quote(str(directory))
    if not there.is_dir():
        seen, command = f"{there} is not a folder", f"mv {existing} {existing}.aside"
    elif os.access(there, os.W_OK | os.X_OK) and (not os.path.exists(lock) or os.access(lock, os.R_OK | os.W_OK)):
        return None
    elif os.statvfs(there).f_flag & os.ST_RDONLY:
        seen = f"{directory} is on a file system that is read-only"
        command = f'sudo mount -o remount,rw "$(findmnt -no TARGET -T {existing})"'
    else:
        seen = f"{directory} may not be written by this user"
        command = f"sudo mkdir -p {quoted} && sudo chown -R {os.geteuid()} {quoted}"
    return Diagnosis(WARNING, subject, seen, why, command)


def diagnose_keys(vehicle: VehicleConfig, unit: bool = False) -> Iterator[Diagnosis]:
    """Yield the finding on the key file; `unit`: the installed unit reads it, as a user of its own."""
    if not vehicle.commands.key_file:
        return
    subject, path = "key file", vehicle.commands.key_file
    why = "the service does not start without the keys of signed commands"
    is_credential = _is_credential(path)
    try:
        keys = read_keys(path)
    except KeyFileError as error:
        if os.path.exists(path) and not os.access(path, os.R_OK) and is_credential:
            seen = f"{path} is passed to the service by systemd, and not readable by this user"
            yield Diagnosis(OK, subject, seen)
        else:
            yield Diagnosis(ERROR, subject, str(error), why, _key_fix_command(path))
        return
    if unit and not is_credential:
        seen = f"{path} is valid, but systemd does not pass it to the service, whose user may not read it"
        credential = f"{os.path.basename(quote(path))}:{quote(path)}"
        command = f"sudo modelserver install  # writes LoadCredential={credential}"
        yield Diagnosis(ERROR, subject, seen, why, command)
    elif shared := "" if is_credential else find_group_writable_folder(path):
        seen = f"{path} is below {shared}, which a group may write"
        danger = "members of the group can replace the key, and command the vehicle"
        yield Diagnosis(WARNING, subject, seen, danger, f"sudo chmod g-w {quote(shared)}")
    else:
        seen = f"{path} may be read by this user alone or its group, {format_count(len(keys), 'key')}"
        yield Diagnosis(OK, subject, seen)


def _key_fix_command(path: str) -> str:
    quoted = quote(path)
    make = f"sudo modelserver key new {quoted}"
    try:
        status = os.stat(path)
    except FileNotFoundError:
        return make
    except OSError:
        return f"sudo ls -ld {quoted}"
    if stat.S_ISREG(status.st_mode):
        if status.st_mode & (stat.S_IRWXO | stat.S_IWGRP):
            return f"sudo chmod 600 {quoted}"
        if not os.access(path, os.R_OK):
            return f"sudo chown {os.geteuid()} {quoted}"
        if status.st_uid not in (0, os.geteuid()):
            return f"sudo chown root {quoted}"
        for folder in Path(path).absolute().parents:
            mode = folder.stat().st_mode
            if mode & stat.S_IWOTH and not mode & stat.S_ISVTX:
                return f"sudo chmod o-w {quote(str(folder))}"
    return f"sudo mv {quoted} {quoted}.aside && {make}"


def _is_credential(path: str) -> bool:
    """Return whether systemd passes a file to the service as a credential; the file stays root's."""
    with suppress(OSError, UnicodeDecodeError):
        lines = Path(CREDENTIAL).read_text(encoding="utf-8").splitlines()
        return any(line.startswith("LoadCredential=") and line.partition(":")[2] == path for line in lines)
    return False


def diagnose_connections(
    drivers: Iterable[DriverSettings], networks: Iterable[NetworkInterface]
) -> Iterator[Diagnosis]:
    """Yield the findings on the drivers' connections; `networks` are the network interfaces of this machine."""
    from msdrivers.line_settings import CanSettings, SerialSettings

    are_up = {each.name: each.up for each in networks}
    for driver in drivers:
        subject = f"driver {driver.name}"
        if isinstance(driver.line, SerialSettings):
            yield _diagnose_serial(subject, driver.line.port)
        elif isinstance(driver.line, CanSettings) and driver.line.interface == "socketcan":
            yield _diagnose_can(subject, driver.line.can, are_up.get(driver.line.can))
        else:
            yield Diagnosis(OK, subject, f"{driver.line}: not tested")


def _diagnose_serial(subject: str, port: str) -> Diagnosis:
    from msdrivers.links.serial_port import explain_permission, find_access_problem, suggest_ports

    if not os.path.exists(port):
        near = suggest_ports(port)
        seen = f"{port} is not there" + (f"; there are: {', '.join(near[:3])}" if near else "")
        return Diagnosis(WARNING, subject, seen, "the driver waits until it is", "modelserver driver --list")
    if not os.access(port, os.R_OK | os.W_OK):
        why = explain_permission(port)
        joining = re.search(r"sudo usermod -aG \S+ [^\s,]+", why)
        command = joining.group() if joining else f"ls -l {port}"
        return Diagnosis(ERROR, subject, f"this user may not open {port}", why, command)
    hint = find_access_problem(port)
    return Diagnosis(NOTE if hint else OK, subject, f"{port} is {hint or 'free'}")


def _diagnose_can(subject: str, name: str, is_up: bool | None) -> Diagnosis:
    bring_up = f"sudo ip link set {name} up type can bitrate 500000"
    if is_up is None:
        seen, why = f"network interface {name} is not there", "the driver waits until it is"
        return Diagnosis(WARNING, subject, seen, why, f"modelserver driver --list; {bring_up}")
    if not is_up:
        why = "no frames are received or sent; use the bitrate of the bus"
        return Diagnosis(ERROR, subject, f"network interface {name} is down", why, bring_up)
    return Diagnosis(OK, subject, f"network interface {name} is up")
