"""`modelserver doctor`: diagnose bus, clock, machine and vehicle file, and print the commands that fix problems."""

from __future__ import annotations

import dataclasses
import json
import os
import platform
import shutil
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, Final

import typer

from modelserver.errors import BusError, ConfigError, Problem, Severity
from modelserver.server import diagnostics
from modelserver.server.diagnostics import ERROR, NOTE, OK, WARNING, Diagnosis, NetworkInterface
from modelserver.server.journal.writer import get_journal_directory, get_max_bytes, list_segments
from modelserver.server.persistence import get_state_directory
from mstools.commands.install import SERVICE, STATE, UNITS, VEHICLE
from mstools.terminal.options import JsonOption, PrefixOption, UrlOption, option
from mstools.terminal.output import escape, format_count

if TYPE_CHECKING:
    from modelserver.config.vehicle_file import VehicleConfig
    from modelserver.messages import Health
    from msdrivers.settings import DriverSettings

EXIT_WARNINGS = 1
EXIT_ERRORS = 3
"""2 is wrong usage, as for every command, and a missing vehicle file, with which nothing is checked."""

REPORT_WAIT_S: Final = 1.3
"""Time for the health reports of all daemons, seconds: each publishes one per second."""

LEVEL_NAMES = ("ok", "note", "warning", "error")
"""Names of the levels of findings, by number."""


def command(
    config: Annotated[
        Path | None, option("--config -c FILE", "The vehicle file; it is checked too.", exists=True, dir_okay=False)
    ] = None,
    url: UrlOption = "",
    prefix: PrefixOption = "",
    as_json: JsonOption = False,
) -> None:
    """Diagnose the bus, the clock, and what a vehicle file needs of this machine; print the commands that fix it.

    Sends a message to itself, and listens for health reports: two daemons on one bus are found. Nothing is changed.
    With a vehicle file also: whether it, its geometry and its key file are valid, state and journal can be written, and
    the drivers' ports exist and are accessible. Run it as the user of the service; for the systemd unit, as root.

    Exit code: 0 no problem, 1 warnings, 3 errors, 2 wrong usage, also a missing vehicle file: then nothing was checked.
    (Other commands have 1 for wrong input, which would look like a warning here.)

    Example: modelserver doctor -c config/raptor/vehicle.yaml
    """
    findings = diagnose(config, url, prefix)
    typer.echo(json.dumps(as_data(findings), indent=2) if as_json else describe(findings))
    raise typer.Exit(get_exit_code(findings))


def diagnose(config: Path | None, url: str, prefix: str) -> tuple[Diagnosis, ...]:
    """Return all findings. Takes two seconds, most of it waiting for replies."""
    from modelserver.config.vehicle_file import load_config
    from modelserver.version import __version__
    from modelserver.wire.provider import find_url_problem, resolve_url
    from mstools.commands.check import check_vehicle

    vehicle: VehicleConfig | None = None
    versions = f"modelserver {__version__}, lcm {version('lcm')}, Python {platform.python_version()}"
    found = [Diagnosis(OK, "versions", versions)]
    if config is not None:
        try:
            found.append(diagnose_vehicle_file(check_vehicle(str(config))[1], config))
            vehicle = load_config(config)
        except OSError as error:
            seen, command = f"{config} cannot be read: {error.strerror}", f"sudo chmod a+r {quote(str(config))}"
            found.append(Diagnosis(ERROR, "vehicle file", seen, "the service does not start without it", command))
        except ConfigError:
            # as found above
            pass
    if vehicle is not None:
        url, prefix = url or vehicle.lcm.url, prefix or vehicle.lcm.channel_prefix
    provider = resolve_url(url)
    wrong, leaves = find_url_problem(provider), False
    if wrong:
        found.append(Diagnosis(ERROR, "bus", f"{provider}: {wrong}", "LCM cannot be joined there"))
    else:
        facts = diagnostics.read_bus_facts(provider, diagnostics.probe_delivery)
        found.append(Diagnosis(OK, "bus", escape(provider)))
        found += diagnostics.evaluate_bus(facts)
        if facts.address is None or facts.delivered:
            try:
                found += diagnose_daemons(provider, prefix, __version__)
            except BusError as error:
                found.append(Diagnosis(ERROR, "bus", str(error), "no message can be received or sent"))
        leaves = facts.address is not None and facts.address.ttl > 0
    found.append(diagnostics.evaluate_clock(diagnostics.is_clock_synchronized(), leaves))
    if config is not None and vehicle is not None:
        found += diagnose_vehicle(vehicle, config)
    return tuple(found)


def diagnose_daemons(url: str, prefix: str, version: str) -> Iterator[Diagnosis]:
    """Yield the findings on the daemons that publish health reports with this prefix. Raises BusError."""
    from modelserver.wire.provider import open_lcm
    from mstools.commands.status import HEALTH, DaemonListener

    found: dict[tuple[str, int], Health] = {}

    def add(health: Health) -> None:
        found.setdefault((health.host[:64], health.pid), health)

    DaemonListener(open_lcm(url), prefix, {HEALTH: add}).listen(REPORT_WAIT_S, lambda: len(found) > 1)
    who = ", ".join(f"process {pid} on {host!r}" for host, pid in found)
    if not found:
        seen, why = "none publishes health reports", "start one if it should run"
        yield Diagnosis(NOTE, "daemon", seen, why, "modelserver run -c vehicle.yaml")
    elif len(found) > 1:
        why = "clients get the replies of either, and POSE is from both; stop all but one, or give each its own prefix"
        yield Diagnosis(ERROR, "daemon", f"{len(found)} answer at once: {who}", why, f"kill {list(found)[-1][1]}")
    elif (theirs := next(iter(found.values())).version[:40]) != version:
        why = "messages of one version may be undecodable for the other"
        seen = f"{who} is version {theirs!r}, this command {version}"
        yield Diagnosis(WARNING, "daemon", seen, why, "sudo systemctl restart modelserver")
    else:
        yield Diagnosis(OK, "daemon", f"one answers: {who}")


def get_exit_code(findings: Sequence[Diagnosis]) -> int:
    return (0, 0, EXIT_WARNINGS, EXIT_ERRORS)[diagnostics.get_worst_level(findings)]


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


def diagnose_vehicle(vehicle: VehicleConfig, file: Path) -> Iterator[Diagnosis]:
    """Yield the findings on what a vehicle file without errors needs of this machine."""
    from mstools.commands.driver import load_drivers

    is_unit = os.path.realpath(file) == VEHICLE and os.path.exists(f"{UNITS}/{SERVICE}")
    unit_directory = STATE[0] if is_unit and not os.environ.get("STATE_DIRECTORY") else ""
    if unit_directory and os.geteuid() != 0:
        why = "this user may not read the unit's state"
        command = f"sudo modelserver doctor -c {VEHICLE}"
        yield Diagnosis(NOTE, "state", f"{unit_directory} is readable by root only", why, command)
    else:
        yield from diagnose_storage(vehicle, unit_directory)
    with suppress(ConfigError):
        yield from diagnose_connections(load_drivers(file)[1].values(), diagnostics.list_interfaces())


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


def diagnose_storage(vehicle: VehicleConfig, unit_directory: str = "") -> Iterator[Diagnosis]:
    """Yield the findings on the directories of state and journal; `unit_directory`: of the unit, empty without one."""
    state = get_state_directory(vehicle.state_directory or unit_directory)
    lost = "the origin is lost with every restart"
    if state is None:
        yield Diagnosis(WARNING, "state", "there is no home directory", lost, "set state_directory: /var/lib/...")
    else:
        yield diagnose_directory("state", state, lost)
    journal = get_journal_directory(vehicle, unit_directory or None)
    if journal is None:
        off = vehicle.journal.megabytes == 0
        why = "journal.megabytes: 0" if off else "only under systemd, or with journal.directory"
        yield Diagnosis(OK, "journal", f"no journal is recorded ({why})")
    else:
        # its existing segments need no further space
        used = sum(path.stat().st_size for path in list_segments(journal)) if os.access(journal, os.R_OK) else 0
        needed = max(get_max_bytes(vehicle) - used, 0)
        yield diagnose_directory("journal", journal, "no journal is recorded", needed)


def diagnose_directory(subject: str, directory: Path, why: str, needed: int = 0) -> Diagnosis:
    """Return whether a directory can be made and written, with space for so many bytes; `why` that matters."""
    # the first existing folder, in which the missing ones are created
    there = next((each for each in (directory, *directory.parents) if os.path.exists(each)), Path("/"))
    free, quoted = shutil.disk_usage(there).free, quote(str(directory))
    if not os.access(there, os.W_OK | os.X_OK):
        command = f"sudo mkdir -p {quoted} && sudo chown -R {os.geteuid()} {quoted}"
        return Diagnosis(WARNING, subject, f"{directory} may not be written by this user", why, command)
    if free < needed + MIN_FREE:
        seen = f"{directory} has {free / 1e6:.0f} MB free" + (
            f", and may take {needed / 1e6:.0f} MB more" if needed else ""
        )
        command = f"du -xh --max-depth=2 {quote(str(there))} | sort -h | tail"
        return Diagnosis(WARNING, subject, seen, "on a full disk neither origin nor journal is stored", command)
    return Diagnosis(OK, subject, f"{directory} may be written, {free / 1e9:.1f} GB free")


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
        return Diagnosis(ERROR, subject, f"this user may not open {port}", explain_permission(port), f"ls -l {port}")
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
