"""What `modelserver doctor` says of the files of a vehicle's service: where it keeps state and journal, and its key."""

from __future__ import annotations

import os
import shlex
import shutil
import stat
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final

from modelserver.errors import KeyFileError
from modelserver.keys import read_keys, shared_folder
from modelserver.service.journal.place import bound, journal_directory
from modelserver.service.journal.ring import LOCK_NAME, segments
from modelserver.service.keeping.origin import state_directory
from modelserver.service.probing.findings import Diagnosis, DiagnosisLevel
from mstools.deployment.files import CREDENTIAL
from mstools.deployment.plan import SERVICE, STATE, UNITS, VEHICLE
from mstools.terminal.output import counted

if TYPE_CHECKING:
    from modelserver.config import VehicleConfig

LEAST_FREE: Final = 200_000_000
"""Bytes of room on a disk below which it is told."""

NO_STATE: Final = "the origin is lost with every restart"
NO_JOURNAL: Final = "nothing is recorded of what happens"


def file_findings(vehicle: VehicleConfig, file: Path) -> tuple[Diagnosis, ...]:
    """Return what is to be said of a vehicle's state, journal and key, for its unit where it is the one installed."""
    unit = is_of_unit(file)
    return (*kept_findings(vehicle, STATE[0] if unit else ""), *key_findings(vehicle, unit))


def is_of_unit(file: Path) -> bool:
    """Return whether a vehicle file is that of the installed unit, and this process is not run as the unit is."""
    return (
        os.path.realpath(file) == VEHICLE
        and os.path.exists(f"{UNITS}/{SERVICE}")
        and not os.environ.get("STATE_DIRECTORY")
    )


def kept_findings(vehicle: VehicleConfig, given: str = "") -> Iterator[Diagnosis]:
    """Yield what is to be said of where state and journal are kept; `given`: the state directory of the unit, if any.

    The unit may write nowhere else.
    """
    state = state_directory(vehicle.state_directory or given)
    journal = journal_directory(vehicle, given or None)
    if state is not None and _is_outside(state, given):
        yield _outside("state", state, given, NO_STATE, "state_directory")
    elif given and os.geteuid() != 0 and not os.access(given, os.W_OK | os.X_OK):
        why = "what the unit keeps there is not for this user's eyes"
        command = f"sudo modelserver doctor -c {VEHICLE}"
        yield Diagnosis(DiagnosisLevel.NOTE, "state", f"{given} is looked into by root alone", why, command)
        return
    else:
        yield from state_findings(state)
    if journal is not None and _is_outside(journal, given):
        yield _outside("journal", journal, given, NO_JOURNAL, "journal.directory")
    else:
        yield from journal_findings(vehicle, journal)


def state_findings(directory: Path | None) -> Iterator[Diagnosis]:
    """Yield what is to be said of the place where state is kept; None: there is no home to keep it in."""
    if directory is None:
        command = "set state_directory: /var/lib/..."
        yield Diagnosis(DiagnosisLevel.WARNING, "state", "there is no home directory", NO_STATE, command)
        return
    trouble = _trouble("state", directory, NO_STATE)
    if trouble is not None:
        yield trouble
        return
    there = _first_there(directory)
    free = shutil.disk_usage(there).free
    if free < LEAST_FREE:
        seen = f"{directory} has {free / 1e6:.0f} MB of room left"
        why = "a full disk keeps neither origin nor journal"
        yield Diagnosis(DiagnosisLevel.WARNING, "state", seen, why, _largest(there))
        return
    yield Diagnosis(DiagnosisLevel.OK, "state", f"{directory} may be written, {free / 1e9:.1f} GB free")


def journal_findings(vehicle: VehicleConfig, directory: Path | None) -> Iterator[Diagnosis]:
    """Yield what is to be said of the place where the journal is kept; None: none is kept here."""
    subject = "journal"
    if directory is None:
        off = vehicle.journal.megabytes == 0
        why = "journal.megabytes: 0" if off else "on a desk; under systemd one is, or with journal.directory"
        yield Diagnosis(DiagnosisLevel.OK, subject, f"none is kept ({why})")
        return
    trouble = _trouble(subject, directory, NO_JOURNAL)
    if trouble is not None:
        yield trouble
        return
    most = bound(vehicle)
    there = _first_there(directory)
    used = 0
    with suppress(OSError):
        used = sum(path.stat().st_size for path in segments(directory))
    left = max(most - used, 0)
    free = shutil.disk_usage(there).free
    seen = f"{directory} may be written; {used / 1e6:.0f} of {most >> 20} MB are used, {free / 1e9:.1f} GB free"
    if free >= left + LEAST_FREE:
        yield Diagnosis(DiagnosisLevel.OK, subject, seen)
        return
    fits = int(used + free - LEAST_FREE) >> 20
    smaller = f", or write megabytes: {fits} under journal" if fits >= 32 else ""
    seen = f"{directory} has {free / 1e6:.0f} MB of room left, and may take {left / 1e6:.0f} MB more"
    why = f"a full disk keeps neither origin nor journal; make room{smaller}"
    yield Diagnosis(DiagnosisLevel.WARNING, subject, seen, why, _largest(there))


def key_findings(vehicle: VehicleConfig, unit: bool = False) -> Iterator[Diagnosis]:
    """Yield what is to be said of the file of keys; `unit`: the installed unit is to read it, as a user of its own."""
    if not vehicle.commands.key_file:
        return
    subject, path = "key file", vehicle.commands.key_file
    why = "the service does not start without the keys of signed commands"
    quoted = shlex.quote(path)
    handed = _is_handed_over(path)
    try:
        keys = read_keys(path)
    except KeyFileError as error:
        if os.path.exists(path) and not os.access(path, os.R_OK) and handed:
            yield Diagnosis(
                DiagnosisLevel.OK, subject, f"{path} is handed to the service by systemd, and not for this user"
            )
            return
        yield Diagnosis(DiagnosisLevel.ERROR, subject, str(error), why, _key_command(path))
        return
    if unit and not handed:
        seen = f"{path} is well, and systemd does not hand it to the service, whose user may not read it"
        command = f"sudo modelserver install  # writes LoadCredential={os.path.basename(quoted)}:{quoted}"
        yield Diagnosis(DiagnosisLevel.ERROR, subject, seen, why, command)
        return
    shared = "" if handed else shared_folder(path)
    if shared:
        seen = f"{path} is reached by {shared}, which a group may write"
        danger = "who is in the group can put another key in its place, and command the vehicle with that"
        yield Diagnosis(DiagnosisLevel.WARNING, subject, seen, danger, f"sudo chmod g-w {shlex.quote(shared)}")
        return
    yield Diagnosis(
        DiagnosisLevel.OK, subject, f"{path} may be read by this user alone or its group, {counted(len(keys), 'key')}"
    )


def _key_command(path: str) -> str:
    """Return what mends a key file that cannot be used."""
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


def _is_handed_over(path: str) -> bool:
    """Return whether systemd hands a file over to the service: it is root's, and stays so."""
    with suppress(OSError, UnicodeDecodeError):
        lines = Path(CREDENTIAL).read_text(encoding="utf-8").splitlines()
        return any(line.startswith("LoadCredential=") and line.partition(":")[2] == path for line in lines)
    return False


def _is_outside(directory: Path, given: str) -> bool:
    return bool(given) and not any(directory.is_relative_to(each) for each in (given, *STATE))


def _outside(subject: str, directory: Path, given: str, why: str, key: str) -> Diagnosis:
    seen = f"{directory} lies where the unit may not write"
    why = f"{why}; leave {key} out of the vehicle file, or name a folder in {given}"
    return Diagnosis(
        DiagnosisLevel.WARNING, subject, seen, why, f"sudoedit {VEHICLE} && sudo systemctl restart {SERVICE}"
    )


def _first_there(directory: Path) -> Path:
    """Return the first folder that there is: what is not there yet is made below it."""
    return next((each for each in (directory, *directory.parents) if os.path.exists(each)), Path("/"))


def _trouble(subject: str, directory: Path, why: str) -> Diagnosis | None:
    """Return why nothing can be written in a directory, None where it can."""
    there = _first_there(directory)
    quoted = shlex.quote(str(there))
    if not there.is_dir():
        return Diagnosis(DiagnosisLevel.WARNING, subject, f"{there} is no folder", why, f"mv {quoted} {quoted}.aside")
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


def _largest(directory: Path) -> str:
    return f"du -xh --max-depth=2 {shlex.quote(str(directory))} | sort -h | tail"
