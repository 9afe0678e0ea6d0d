"""`modelserver check`: everything that is wrong with a geometry file or a vehicle file, at once."""

from __future__ import annotations

import json
import os
import re
from collections import Counter
from typing import Annotated, Any

import typer

from modelserver.errors import ConfigError, GeometryError, Problem, Severity, Source
from modelserver.formats import check_file
from modelserver.geometry.model import Model
from mstools.options import Variables, parse_variables
from mstools.output import counted, print_problem, safe, size_of


def command(
    files: Annotated[
        list[str], typer.Argument(metavar="FILE", help="Geometry files (Miro XML or YAML), or vehicle files.")
    ],
    variables: Variables = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON, for scripts.")] = False,
    notes: Annotated[bool, typer.Option("--notes", help="Print notes as well; they change no exit code.")] = False,
) -> None:
    """Say everything that is wrong with a geometry file: severity, place, what, and what to do.

    A vehicle file is checked together with the geometry it names. Exits 0 when every file has neither error nor
    warning, else 1.

    Example: modelserver check config/raptor/geometry.xml
    """
    values = parse_variables(variables)
    results = [(file, *_checked(file, values)) for file in files]
    if as_json:
        typer.echo(json.dumps({"files": [_as_data(*result) for result in results]}, indent=2))
    else:
        for file, model, problems in results:
            _print(file, model, problems, notes)
    if any(_is_unclean(problems) for _, _, problems in results):
        raise typer.Exit(1)


def _checked(file: str, variables: dict[str, str]) -> tuple[Model | None, tuple[Problem, ...]]:
    try:
        return _checked_vehicle(file) if _is_vehicle_file(file) else check_file(file, variables)
    except OSError as error:
        message = f"the file cannot be read: {error.strerror or error}"
        return None, (Problem(Severity.ERROR, message, Source(file), "look at the path and its permissions"),)


def _is_vehicle_file(file: str) -> bool:
    if not os.path.isfile(file):
        return False
    with open(file, "rb") as stream:
        head = stream.read(1 << 16)
    return all(re.search(rb"^%b\s*:" % key, head, re.MULTILINE) for key in (b"vehicle", b"base_frame"))


def _checked_vehicle(file: str) -> tuple[Model | None, tuple[Problem, ...]]:
    # imported here: a geometry file needs neither the configuration's libraries nor geodesy
    from modelserver.config import load_config
    from modelserver.service.daemon import load_vehicle

    try:
        model = load_vehicle(load_config(file), file).model
    except (ConfigError, GeometryError) as error:
        return None, error.problems
    return model, model.problems


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
            }
            for problem in problems
        ],
    }
