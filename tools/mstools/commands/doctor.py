"""`modelserver doctor`: is this machine fit for the service, and if not, the commands that mend it."""

from __future__ import annotations

import json
import os
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from modelserver.errors import BusError, ConfigError
from mstools.commands.asking import JsonOption, PrefixOption, UrlOption
from mstools.terminal.missing import nearest_path
from mstools.terminal.output import counted, safe

if TYPE_CHECKING:
    from modelserver.config import VehicleConfig
    from modelserver.service.probing.findings import Diagnosis

EXIT_WARNINGS = 1
EXIT_ERRORS = 3
"""2 is wrong usage, as for every command; and a vehicle file that is not there, with which nothing is looked at."""

WORDS = ("ok", "note", "warning", "error")
"""What the grades of findings are called, by their number."""


def command(
    config: Annotated[
        Path | None, typer.Option("--config", "-c", metavar="FILE", help="The vehicle file; it is looked at too.")
    ] = None,
    url: UrlOption = "",
    prefix: PrefixOption = "",
    as_json: JsonOption = False,
) -> None:
    """Look at the bus, the clock, and what a vehicle file needs of this machine; print the commands that mend it.

    It sends a message to itself, and asks who answers: two daemons on one bus are found. Nothing is changed. With
    a vehicle file also: does it load, may state and journal be kept, is the key file well, are the drivers' lines
    there and may they be used. Run it as the user that the service runs as; for the unit's own, as root.

    Exit code: 0 nothing to mend, 1 warnings, 3 errors. 2 is wrong usage, also a vehicle file that is not there: then
    nothing was looked at. (Other commands have 1 for wrong input, which here would look like a warning.)

    Example: modelserver doctor -c config/raptor/vehicle.yaml
    """
    if config is not None:
        check_there(config)
    findings = examine(config, url, prefix)
    typer.echo(json.dumps(as_data(findings), indent=2) if as_json else describe(findings))
    code = exit_code(findings)
    if code:
        raise typer.Exit(code)


def check_there(config: Path) -> None:
    """Raise typer.BadParameter, a usage error, where there is no such vehicle file.

    One that is there and may not be read is a finding.
    """
    try:
        wrong = f"{config} is a folder; name the vehicle file in it" if os.path.isdir(config) else ""
        os.stat(config)
    except (FileNotFoundError, NotADirectoryError):
        near = nearest_path(config)
        offer = f"; did you mean {near}?" if near else ""
        wrong = f"there is no vehicle file {config}{offer}"
    except OSError:
        return
    if wrong:
        raise typer.BadParameter(safe(wrong), param_hint="--config")


def examine(config: Path | None, url: str, prefix: str) -> tuple[Diagnosis, ...]:
    """Return all that is found. Takes two seconds, most of it waiting for who answers."""
    from modelserver.config import NOT_ONE
    from modelserver.service.probing.clock import clock_findings
    from modelserver.service.probing.findings import Diagnosis, DiagnosisLevel
    from modelserver.service.probing.listening import hears_itself, who_answers
    from modelserver.service.probing.machine import ClockWatch, bus_facts
    from modelserver.service.probing.probe import bus_findings
    from modelserver.service.probing.servers import server_findings
    from modelserver.version import __version__
    from modelserver.wire.channels import REPLY_PREFIX
    from modelserver.wire.provider import resolve_url
    from modelserver.wire.urls import url_problem
    from mstools.deployment.doctor_vehicle import read_vehicle, vehicle_findings, versions

    vehicle: VehicleConfig | None = None
    found: list[Diagnosis] = [versions()]
    reply_prefix = REPLY_PREFIX
    if config is not None:
        try:
            vehicle = read_vehicle(config)
        except OSError as error:
            seen = f"{safe(str(config))} cannot be read: {error.strerror}"
            # which of the folders around it is closed, if it is not the file
            command = f"{'sudo chmod a+r' if os.path.exists(config) else 'sudo namei -l'} {shlex.quote(str(config))}"
            found.append(
                Diagnosis(DiagnosisLevel.ERROR, "vehicle file", seen, "the service does not start without it", command)
            )
        except ConfigError as error:
            first = error.problems[0]
            seen, why = f"{safe(str(config))} is wrong: {safe(first.message)}", "the service does not start with it"
            command = f"modelserver check {shlex.quote(str(config))}"
            if first.message.endswith(NOT_ONE):
                why, command = safe(f"{why}; {first.fix}"), ""  # check might find it to be a good geometry
            found.append(Diagnosis(DiagnosisLevel.ERROR, "vehicle file", seen, why, command))
    if vehicle is not None:
        url, prefix = url or vehicle.lcm.url, prefix or vehicle.lcm.channel_prefix
        reply_prefix = vehicle.lcm.reply_prefix
    provider = resolve_url(url)
    watch = ClockWatch()
    wrong, leaves = url_problem(provider), False
    if wrong:
        found.append(Diagnosis(DiagnosisLevel.ERROR, "bus", f"{provider}: {wrong}", "LCM cannot be joined there"))
    else:
        facts = bus_facts(provider, hears_itself)
        found.append(Diagnosis(DiagnosisLevel.OK, "bus", safe(provider)))
        found += bus_findings(facts)
        if facts.address is None or facts.heard:
            try:
                found += server_findings(who_answers(provider, prefix, reply_prefix), prefix, __version__)
            except BusError as error:
                found.append(Diagnosis(DiagnosisLevel.ERROR, "bus", str(error), "nothing is heard or said"))
        leaves = facts.address is not None and facts.address.ttl > 0
    found += clock_findings(watch.facts(), leaves)
    if config is not None and vehicle is not None:
        found += vehicle_findings(vehicle, config)
    return tuple(found)


def exit_code(findings: Sequence[Diagnosis]) -> int:
    """Return the exit code that findings make."""
    from modelserver.service.probing.findings import DiagnosisLevel, worst

    return {DiagnosisLevel.WARNING: EXIT_WARNINGS, DiagnosisLevel.ERROR: EXIT_ERRORS}.get(worst(findings), 0)


def describe(findings: Sequence[Diagnosis]) -> str:
    """Return findings for people to read: the grade, what was seen, and below it why it matters and what mends it."""
    width = max(len(each.subject) for each in findings)
    lines = []
    for each in findings:
        lines.append(f"{WORDS[each.grade]:<8} {safe(each.subject):<{width}}  {safe(each.seen)}")
        if each.why:
            lines.append(f"{'':<8} {'':<{width}}  {safe(each.why)}")
        if each.command:
            lines.append(f"{'':<8} {'':<{width}}  $ {safe(each.command)}")
    number = [sum(each.grade == grade for each in findings) for grade in range(len(WORDS))]
    said = [counted(number[grade], WORDS[grade]) for grade in (3, 2, 1) if number[grade]]
    return "\n".join([*lines, ", ".join(said) or "all is well"])


def as_data(findings: Sequence[Diagnosis]) -> dict[str, object]:
    """Return findings for scripts."""
    return {
        "exit_code": exit_code(findings),
        "findings": [
            {
                "grade": WORDS[each.grade],
                "subject": each.subject,
                "seen": each.seen,
                "why": each.why,
                "command": each.command,
            }
            for each in findings
        ],
    }
