"""`modelserver doctor`: diagnose bus, clock, machine and vehicle file, and print the commands that fix problems."""

from __future__ import annotations

import dataclasses
import json
import os
import platform
import re
import shutil
import stat
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, Final

import typer

from modelserver.config.vehicle_file import VehicleConfig
from modelserver.errors import BusError, ConfigError, KeyFileError, Problem, Severity
from modelserver.key_files import find_group_writable_folder, read_keys
from modelserver.server.diagnostics import ERROR, NOTE, OK, WARNING, Diagnosis, NetworkInterface
from modelserver.server.journal.writer import LOCK_NAME, get_journal_directory, get_max_bytes, list_segments
from modelserver.server.persistence import get_state_directory
from mstools.deployment import CREDENTIAL, SERVICE, STATE, UNITS, VEHICLE
from mstools.terminal.options import JsonOption, PrefixOption, UrlOption, option
from mstools.terminal.output import escape, find_nearest_path, format_count

if TYPE_CHECKING:
    from modelserver.config.vehicle_file import VehicleConfig
    from modelserver.server.diagnostics import Diagnosis
    from msdrivers.settings import DriverSettings

EXIT_WARNINGS = 1
EXIT_ERRORS = 3
"""2 is wrong usage, as for every command, and a missing vehicle file, with which nothing is checked."""

LEVEL_NAMES = ("ok", "note", "warning", "error")
"""Names of the levels of findings, by number."""


def command(
    config: Annotated[Path | None, option("--config -c FILE", "The vehicle file; it is checked too.")] = None,
    url: UrlOption = "",
    prefix: PrefixOption = "",
    as_json: JsonOption = False,
) -> None:
    """Diagnose the bus, the clock, and what a vehicle file needs of this machine; print the commands that fix it.

    Sends a message to itself, and a request to all daemons: two on one bus are found. Nothing is changed. With a
    vehicle file also: whether it loads, state and journal can be written, the key file is valid, and the drivers'
    ports exist and are accessible. Run it as the user of the service; for the systemd unit, as root.

    Exit code: 0 no problem, 1 warnings, 3 errors, 2 wrong usage, also a missing vehicle file: then nothing was checked.
    (Other commands have 1 for wrong input, which would look like a warning here.)

    Example: modelserver doctor -c config/raptor/vehicle.yaml
    """
    if config is not None:
        check_exists(config)
    findings = diagnose(config, url, prefix)
    typer.echo(json.dumps(as_data(findings), indent=2) if as_json else describe(findings))
    raise typer.Exit(get_exit_code(findings))


def check_exists(config: Path) -> None:
    """Raise typer.BadParameter, a usage error, for a missing vehicle file. An unreadable one is a finding."""
    try:
        wrong = f"{config} is a folder; give the vehicle file in it" if os.path.isdir(config) else ""
        os.stat(config)
    except (FileNotFoundError, NotADirectoryError):
        near = find_nearest_path(config)
        offer = f"; did you mean {near}?" if near else ""
        wrong = f"there is no vehicle file {config}{offer}"
    except OSError:
        return
    if wrong:
        raise typer.BadParameter(escape(wrong), param_hint="--config")


def diagnose(config: Path | None, url: str, prefix: str) -> tuple[Diagnosis, ...]:
    """Return all findings. Takes two seconds, most of it waiting for replies."""
    from modelserver.config.vehicle_file import NOT_A_VEHICLE_FILE, load_config
    from modelserver.server import diagnostics as checks
    from modelserver.server.diagnostics import HostClockMonitor, discover_servers, probe_delivery, read_bus_facts
    from modelserver.version import __version__
    from modelserver.wire.channels import REPLY_PREFIX
    from modelserver.wire.provider import find_url_problem, resolve_url

    vehicle: VehicleConfig | None = None
    versions = f"modelserver {__version__}, lcm {version('lcm')}, Python {platform.python_version()}"
    found = [Diagnosis(OK, "versions", versions)]
    reply_prefix = REPLY_PREFIX
    if config is not None:
        subject = "vehicle file"
        try:
            vehicle = load_config(config)
        except OSError as error:
            seen = f"{escape(str(config))} cannot be read: {error.strerror}"
            # namei shows which folder has no permission, if it is not the file
            command = f"{'sudo chmod a+r' if os.path.exists(config) else 'sudo namei -l'} {quote(str(config))}"
            found.append(Diagnosis(ERROR, subject, seen, "the service does not start without it", command))
        except ConfigError as error:
            first = error.problems[0]
            seen, why = f"{escape(str(config))} is wrong: {escape(first.message)}", "the service does not start with it"
            command = f"modelserver check {quote(str(config))}"
            if first.message.endswith(NOT_A_VEHICLE_FILE):
                why, command = escape(f"{why}; {first.fix}"), ""  # check may find it to be a valid geometry file
            found.append(Diagnosis(ERROR, subject, seen, why, command))
    if vehicle is not None:
        url, prefix = url or vehicle.lcm.url, prefix or vehicle.lcm.channel_prefix
        reply_prefix = vehicle.lcm.reply_prefix
    provider = resolve_url(url)
    watch = HostClockMonitor()
    wrong, leaves = find_url_problem(provider), False
    if wrong:
        found.append(Diagnosis(ERROR, "bus", f"{provider}: {wrong}", "LCM cannot be joined there"))
    else:
        facts = read_bus_facts(provider, probe_delivery)
        found.append(Diagnosis(OK, "bus", escape(provider)))
        found += checks.evaluate_bus(facts)
        if facts.address is None or facts.delivered:
            try:
                servers = discover_servers(provider, prefix, reply_prefix)
                found += checks.evaluate_servers(servers, prefix, __version__)
            except BusError as error:
                found.append(Diagnosis(ERROR, "bus", str(error), "no message can be received or sent"))
        leaves = facts.address is not None and facts.address.ttl > 0
    found += checks.evaluate_clock(watch.read_facts(), leaves)
    if config is not None and vehicle is not None:
        found += diagnose_vehicle(vehicle, config)
    return tuple(found)


def get_exit_code(findings: Sequence[Diagnosis]) -> int:
    from modelserver.server.diagnostics import get_worst_level

    return (0, 0, EXIT_WARNINGS, EXIT_ERRORS)[get_worst_level(findings)]


def describe(findings: Sequence[Diagnosis]) -> str:
    """Format findings: level and observation, below them the reason and the command that fixes it."""
    width = max(len(each.subject) for each in findings)
    lines = []
    for each in findings:
        lines.append(f"{LEVEL_NAMES[each.level]:<8} {escape(each.subject):<{width}}  {escape(each.observed)}")
        below = (each.why, f"$ {each.command}" if each.command else "")
        lines += [f"{'':<8} {'':<{width}}  {escape(text)}" for text in below if text]
    count = Counter(each.level for each in findings)
    totals = [format_count(count[level], LEVEL_NAMES[level]) for level in sorted(count, reverse=True) if level]
    return "\n".join([*lines, ", ".join(totals) or "no problem found"])


def as_data(findings: Sequence[Diagnosis]) -> dict[str, object]:
    return {
        "exit_code": get_exit_code(findings),
        "findings": [dataclasses.asdict(each) | {"level": LEVEL_NAMES[each.level]} for each in findings],
    }


MIN_FREE: Final = 200_000_000
"""Free bytes on a disk below which there is a warning."""

NO_STATE: Final = "the origin is lost with every restart"
NO_JOURNAL: Final = "no journal is recorded"


def diagnose_vehicle(vehicle: VehicleConfig, file: Path) -> tuple[Diagnosis, ...]:
    from modelserver.server.diagnostics import list_interfaces
    from mstools.commands.check import check_vehicle
    from mstools.commands.driver import load_drivers

    return (
        diagnose_vehicle_file(check_vehicle(str(file))[1], file),
        *diagnose_files(vehicle, file),
        *diagnose_connections(load_drivers(file)[1].values(), list_interfaces()),
    )


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
    from msdrivers.registry import CanSettings, SerialSettings

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
