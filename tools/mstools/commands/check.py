"""`modelserver check`: everything that is wrong with a geometry file or a vehicle file, at once."""

from __future__ import annotations

import dataclasses
import json
import os
from collections import Counter
from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Any

import typer

from modelserver.errors import ConfigError, Location, Problem, Severity
from modelserver.file_kinds import LOOKED_AT, FileKind, file_kind
from modelserver.formats import check_file
from modelserver.geometry.model import Model
from modelserver.regular_files import NotRegularFileError, read_start
from mstools.commands.check_drivers import drivers_problems
from mstools.terminal.missing import nearest_path
from mstools.terminal.options import Variables, parse_variables
from mstools.terminal.output import counted, print_problem, safe, size_of

if TYPE_CHECKING:
    from modelserver.config import VehicleConfig
    from modelserver.service.daemon import Vehicle


def command(
    files: Annotated[
        list[str],
        typer.Argument(metavar="FILE", help="Geometry files (YAML, Miro XML, URDF, libbot2 frames), or vehicle files."),
    ],
    variables: Variables = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON, for scripts.")] = False,
    notes: Annotated[bool, typer.Option("--notes", help="Print notes as well; they change no exit code.")] = False,
    strict: Annotated[
        bool, typer.Option("--strict", help="Refuse a second constraint at a frame, as the server of 2005 did.")
    ] = False,
) -> None:
    """Say everything that is wrong with a geometry file: severity, place, what, and what to do.

    A vehicle file is checked together with the geometry it names. Exits 0 when every file has neither error nor
    warning, else 1.

    Example: modelserver check config/raptor/geometry.xml
    """
    values = parse_variables(variables)
    results = [(file, *_checked(file, values, strict)) for file in files]
    if as_json:
        typer.echo(json.dumps({"files": [_as_data(*result) for result in results]}, indent=2))
    else:
        for file, model, problems in results:
            _print(file, model, problems, notes)
    if any(_is_unclean(problems) for _, _, problems in results):
        raise typer.Exit(1)


def _checked(file: str, variables: dict[str, str], strict: bool) -> tuple[Model | None, tuple[Problem, ...]]:
    try:
        if is_vehicle_file(file):
            return checked_vehicle(file, strict)
        if os.path.isfile(file) and not read_start(file, 1):
            fix = "see docs/geometry-files.md, or docs/vehicle-file.md for a vehicle file, for an example to begin with"
            return None, (Problem(Severity.ERROR, "the file is empty", Location(file), fix),)
        return check_file(file, variables, strict=strict)
    except OSError as error:
        message = f"the file cannot be read: {error.strerror or error}"
        near = nearest_path(file) if isinstance(error, FileNotFoundError) else ""
        fix = f"did you mean {near}?" if near else "look at the path and its permissions"
        return None, (Problem(Severity.ERROR, message, Location(file), fix),)


def is_vehicle_file(file: str) -> bool:
    """Return whether a file is a vehicle file, by what stands in it. Raises OSError where it cannot be read."""
    try:
        return file_kind(read_start(file, LOOKED_AT)) is FileKind.VEHICLE
    except NotRegularFileError:
        return False


def checked_vehicle(file: str, strict: bool = False) -> tuple[Model | None, tuple[Problem, ...]]:
    """Return the model of a vehicle file, None where anything is wrong, and every problem. Raises OSError."""
    # imported here: a geometry file needs neither the configuration's libraries nor geodesy
    from modelserver.config import load_partly, with_lines
    from modelserver.service.daemon import examine_vehicle, load_vehicle

    try:
        config, problems = load_partly(file, blank=True)
    except ConfigError as error:
        return None, error.problems
    if config is None:
        return None, problems
    # each stage examines what it can, whatever another has found: all faults are reported in one run
    geometry, of_vehicle = examine_vehicle(config, file, strict)
    more = [*of_vehicle, *drivers_problems(config, file, geometry.constraints), *_worth_knowing(config, file)]
    if geometry.model is not None and config.base_frame and not of_vehicle:
        try:
            vehicle = load_vehicle(config, file, strict)
            if not any(each.element.partition(".")[0] == "sensors" for each in problems):
                more += _unusable(vehicle, file)
            vehicle.gate(0, file)
        except ConfigError as error:
            more += error.problems
    # what a wrong value was left out of is not missing, and what was left out says nothing of itself
    wrong = {each.element for each in problems}
    more = [each for each in with_lines(more, file) if not _is_within(each.element, wrong)]
    found = (*problems, *more, *geometry.problems)
    # a model beside a wrong vehicle file would look as if all were well
    clean = not any(each.severity is Severity.ERROR for each in found)
    return geometry.model if clean else None, (*sorted(found, key=lambda each: (each.file != file, each.line)),)


def _is_within(element: str, wrong: set[str]) -> bool:
    """Return whether a finding rests on what was left out of a vehicle file as wrong: its own key, or the sensors."""
    if element == "localization.mode" or element == "sensors":
        return any(each.partition(".")[0] == "sensors" for each in wrong)
    return any(f"{element}.".startswith(f"{each}.") or f"{each}.".startswith(f"{element}.") for each in wrong if each)


def _worth_knowing(config: VehicleConfig, file: str) -> Iterator[Problem]:
    """Yield what is allowed in a vehicle file and hardly meant."""
    sensors = config.sensors
    if sensors.gps is None and sensors.imu is None and sensors.wheels is None:
        words = "no sensors: there will never be a pose"
        yield Problem(Severity.NOTE, words, Location(file, element="sensors"), "see docs/vehicle-file.md")


def _unusable(vehicle: Vehicle, file: str) -> Iterator[Problem]:
    """Yield the sensors that localization cannot use; those that the vehicle file leaves out on purpose as notes."""
    for found in vehicle.unusable():
        severity = Severity.NOTE if found.is_choice else Severity.WARNING
        text = f"sensors.{found.sensor}: {found.text}" if found.is_choice else found.text
        yield Problem(severity, text, Location(file, element=found.element), found.fix)


def _is_unclean(problems: tuple[Problem, ...]) -> bool:
    return any(problem.severity is not Severity.NOTE for problem in problems)


def _print(file: str, model: Model | None, problems: tuple[Problem, ...], notes: bool) -> None:
    count = Counter(problem.severity for problem in problems)
    for problem in problems:
        if notes or problem.severity is not Severity.NOTE:
            print_problem(problem)
    parts = [size_of(model)] if model is not None else []
    found = [counted(count[each], str(each)) for each in (Severity.ERROR, Severity.WARNING) if count[each]]
    parts.append(", ".join(found) or "clean")
    if count[Severity.NOTE] and not notes:
        parts.append(f"{counted(count[Severity.NOTE], 'note')} (--notes shows them)")
    typer.echo(f"{safe(file)}: {'; '.join(parts)}")


def _as_data(file: str, model: Model | None, problems: tuple[Problem, ...]) -> dict[str, Any]:
    count = Counter(problem.severity for problem in problems)
    return {
        "file": file,
        "clean": not _is_unclean(problems),
        "errors": count[Severity.ERROR],
        "warnings": count[Severity.WARNING],
        "notes": count[Severity.NOTE],
        "model": None
        if model is None
        else {
            "name": model.name,
            "revision": model.revision,
            "bodies": len(model.bodies),
            "frames": sum(len(body.frames) for body in model.bodies),
            "constraints": len(model.constraints),
        },
        "problems": [
            {
                "severity": str(problem.severity),
                "file": problem.file,
                "line": problem.line,
                "element": problem.element,
                "message": problem.message,
                "fix": problem.fix,
                "nearest": list(problem.nearest),
                "edit": None if problem.edit is None else dataclasses.asdict(problem.edit),
            }
            for problem in problems
        ],
    }
