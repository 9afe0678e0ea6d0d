"""`modelserver doctor`: diagnose bus, clock, machine and vehicle file, and print the commands that fix problems."""

from __future__ import annotations

import dataclasses
import json
import os
import platform
import shlex
from collections import Counter
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from modelserver.errors import BusError, ConfigError
from mstools.terminal.options import JsonOption, PrefixOption, UrlOption, option
from mstools.terminal.output import escape, format_count
from mstools.terminal.problems import find_nearest_path

if TYPE_CHECKING:
    from modelserver.config.vehicle_file import VehicleConfig
    from modelserver.server.diagnostics.checks import Diagnosis

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
    from modelserver.server.diagnostics import checks
    from modelserver.server.diagnostics.bus_probe import discover_servers, probe_delivery
    from modelserver.server.diagnostics.checks import ERROR, OK, Diagnosis
    from modelserver.server.diagnostics.machine import HostClockMonitor, read_bus_facts
    from modelserver.version import __version__
    from modelserver.wire.channels import REPLY_PREFIX
    from modelserver.wire.provider import find_url_problem, resolve_url
    from mstools.deployment.diagnosis import diagnose_vehicle

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
            command = f"{'sudo chmod a+r' if os.path.exists(config) else 'sudo namei -l'} {shlex.quote(str(config))}"
            found.append(Diagnosis(ERROR, subject, seen, "the service does not start without it", command))
        except ConfigError as error:
            first = error.problems[0]
            seen, why = f"{escape(str(config))} is wrong: {escape(first.message)}", "the service does not start with it"
            command = f"modelserver check {shlex.quote(str(config))}"
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
    from modelserver.server.diagnostics.checks import get_worst_level

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
    """Return findings as JSON data."""
    return {
        "exit_code": get_exit_code(findings),
        "findings": [dataclasses.asdict(each) | {"level": LEVEL_NAMES[each.level]} for each in findings],
    }
