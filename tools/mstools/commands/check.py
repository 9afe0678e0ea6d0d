"""`modelserver check`: all problems of a geometry file or a vehicle file in one run."""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Any

import typer

from modelserver.errors import ConfigError, Location, Problem, Severity, has_error
from modelserver.files.kinds import EXAMINED_BYTES, FileKind, detect_file_kind
from modelserver.files.regular import NotRegularFileError, read_start
from modelserver.formats import check_file
from modelserver.geometry.model import Model
from mstools.terminal.options import JsonOption, Variables, argument, option, parse_variables
from mstools.terminal.output import describe_size, escape, format_count, print_problems, to_json
from mstools.terminal.problems import find_nearest_path

if TYPE_CHECKING:
    from modelserver.server.vehicle import Vehicle


def command(
    files: Annotated[
        list[str],
        argument("FILE", "Geometry files (YAML, Miro XML, URDF, libbot2 frames), or vehicle files."),
    ],
    variables: Variables = None,
    as_json: JsonOption = False,
    notes: Annotated[bool, option("--notes", "Print notes too; they do not change the exit code.")] = False,
    strict: Annotated[
        bool, option("--strict", "Reject a second constraint at a frame, as the server of 2005 did.")
    ] = False,
) -> None:
    """Report every problem of a geometry or vehicle file: severity, location, problem, and fix.

    A vehicle file is checked together with its geometry file. Exit code: 0 if no file has an error or a warning, else
    1.

    Example: modelserver check config/raptor/geometry.xml
    """
    values = parse_variables(variables)
    results = [(file, *_check(file, values, strict)) for file in files]
    if as_json:
        typer.echo(json.dumps({"files": [_as_data(*result) for result in results]}, indent=2))
    else:
        for file, model, problems in results:
            _print(file, model, problems, notes)
    raise typer.Exit(int(any(_has_findings(problems) for _, _, problems in results)))


def _check(file: str, variables: dict[str, str], strict: bool) -> tuple[Model | None, tuple[Problem, ...]]:
    try:
        if is_vehicle_file(file):
            return check_vehicle(file, strict)
        if os.path.isfile(file) and not read_start(file, 1):
            fix = "start with an example in docs/geometry-files.md, or docs/vehicle-file.md for a vehicle file"
            return None, (Problem(Severity.ERROR, "the file is empty", Location(file), fix),)
        return check_file(file, variables, strict=strict)
    except OSError as error:
        message = f"the file cannot be read: {error.strerror or error}"
        near = find_nearest_path(file) if isinstance(error, FileNotFoundError) else ""
        fix = f"did you mean {near}?" if near else "check the path and its permissions"
        return None, (Problem(Severity.ERROR, message, Location(file), fix),)


def is_vehicle_file(file: str) -> bool:
    """Return whether a file has the content of a vehicle file. Raises OSError."""
    try:
        return detect_file_kind(read_start(file, EXAMINED_BYTES)) is FileKind.VEHICLE
    except NotRegularFileError:
        return False


def check_vehicle(file: str, strict: bool = False) -> tuple[Model | None, tuple[Problem, ...]]:
    """Return the model of a vehicle file, None if it has an error, and all problems. Raises OSError."""
    # imported here: a geometry file needs no configuration libraries and no geodesy
    from modelserver.config.vehicle_file import add_lines, load_partly
    from modelserver.server.vehicle import examine_vehicle, load_vehicle
    from mstools.deployment.diagnosis import find_driver_problems

    try:
        config, problems = load_partly(file, blank=True)
    except ConfigError as error:
        return None, error.problems
    if config is None:
        return None, problems
    # each stage checks what it can, whatever another has found: one run reports all problems
    geometry, of_vehicle = examine_vehicle(config, file, strict)
    more = [*of_vehicle, *find_driver_problems(config, file, geometry.constraints)]
    sensors = config.sensors
    if (sensors.gps, sensors.imu, sensors.wheels, sensors.speedometer) == (None, None, None, None):
        # valid, but rarely intended
        words = "no localization sensor is configured, so there is no pose"
        more.append(Problem(Severity.NOTE, words, Location(file, element="sensors"), "see docs/vehicle-file.md"))
    if geometry.model is not None and config.base_frame and not has_error(of_vehicle):
        try:
            vehicle = load_vehicle(config, file, strict)
            if not any(each.element.partition(".")[0] == "sensors" for each in problems):
                more += _find_unusable_sensors(vehicle, file)
            vehicle.make_command_verifier(0, file)
        except ConfigError as error:
            more += error.problems
    # a wrong value was dropped: it is not missing, and has no further problems
    wrong = {each.element for each in problems}
    more = [each for each in add_lines(more, file) if not _is_within(each.element, wrong)]
    found = (*problems, *more, *geometry.problems)
    # a model beside a wrong vehicle file would look like success
    clean = not has_error(found)
    return geometry.model if clean else None, (*sorted(found, key=lambda each: (each.file != file, each.line)),)


def _is_within(element: str, wrong: set[str]) -> bool:
    """Return whether a finding follows from a wrong value that was dropped: its own key, or the sensors."""
    if element in ("localization.mode", "sensors"):
        return any(each.partition(".")[0] == "sensors" for each in wrong)
    return any(f"{element}.".startswith(f"{each}.") or f"{each}.".startswith(f"{element}.") for each in wrong if each)


def _find_unusable_sensors(vehicle: Vehicle, file: str) -> Iterator[Problem]:
    """Yield the sensors that localization cannot use; those that the vehicle file excludes as notes."""
    for found in vehicle.find_unusable_sensors():
        severity = Severity.NOTE if found.is_choice else Severity.WARNING
        text = f"sensors.{found.sensor}: {found.text}" if found.is_choice else found.text
        yield Problem(severity, text, Location(file, element=found.element), found.fix)


def _has_findings(problems: tuple[Problem, ...]) -> bool:
    return any(problem.severity is not Severity.NOTE for problem in problems)


def _print(file: str, model: Model | None, problems: tuple[Problem, ...], notes: bool) -> None:
    count = Counter(problem.severity for problem in problems)
    print_problems((each for each in problems if notes or each.severity is not Severity.NOTE), err=False)
    parts = [describe_size(model)] if model is not None else []
    found = [format_count(count[each], str(each)) for each in (Severity.ERROR, Severity.WARNING) if count[each]]
    parts.append(", ".join(found) or "clean")
    if count[Severity.NOTE] and not notes:
        parts.append(f"{format_count(count[Severity.NOTE], 'note')} (--notes shows them)")
    typer.echo(f"{escape(file)}: {'; '.join(parts)}")


def _as_data(file: str, model: Model | None, problems: tuple[Problem, ...]) -> dict[str, Any]:
    count = Counter(problem.severity for problem in problems)
    return {
        "file": file,
        "clean": not _has_findings(problems),
        "errors": count[Severity.ERROR],
        "warnings": count[Severity.WARNING],
        "notes": count[Severity.NOTE],
        "model": model
        and {
            "name": model.name,
            "revision": model.revision,
            "bodies": len(model.bodies),
            "frames": sum(len(body.frames) for body in model.bodies),
            "constraints": len(model.constraints),
        },
        "problems": [
            {
                name: to_json(getattr(problem, name))
                for name in ("severity", "file", "line", "element", "message", "fix", "nearest", "edit")
            }
            for problem in problems
        ],
    }
