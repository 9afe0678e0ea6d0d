"""`modelserver convert`: a geometry file in another form."""

from __future__ import annotations

import os
from typing import Annotated

import typer

from modelserver.errors import ModelServerError, Severity, nearest_names, shown
from modelserver.file_kinds import LOOKED_AT, FileKind, file_kind
from modelserver.formats import FORMS, check_file, form_of_path, save_model
from mstools.terminal.options import Variables, parse_variables
from mstools.terminal.output import counted, print_problem, safe, size_of, write_file


def command(
    source: Annotated[
        str,
        typer.Argument(
            metavar="IN", help="Geometry file: YAML, Miro XML, URDF or libbot2 frames; or Miro process configuration."
        ),
    ],
    target: Annotated[str, typer.Argument(metavar="OUT", help="File to write, or - for standard output.")],
    form: Annotated[
        str,
        typer.Option(
            "--to",
            metavar="FORM",
            help=f"Form to write: {', '.join(FORMS)}. Without it the ending of OUT decides: "
            ".yaml, .yml, .urdf; .xml is miro.",
        ),
    ] = "",
    variables: Variables = None,
    repair: Annotated[
        bool,
        typer.Option("--repair", help="Drop what is badly formed, and what no constraint joins to the first body."),
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace OUT where it exists.")] = False,
) -> None:
    """Write a geometry file in another form; what that form cannot hold is said on standard error.

    A Miro process configuration becomes a vehicle file: the geometry file that it names and the tunables that have a
    counterpart; the others are listed in it and on standard error.

    \b
    Examples:
      modelserver convert K11Frames.xml k11.yaml --set MRN=K11
      modelserver convert process.xml vehicle.yaml
      modelserver convert husky.urdf husky.yaml
    """
    form = _form(form, target)
    values = parse_variables(variables)
    is_process = is_process_file(source)
    if is_process and form != "yaml":
        raise typer.BadParameter(
            f"{source} is a Miro process configuration: it becomes a vehicle file, which is YAML; name it FILE.yaml",
            param_hint="OUT",
        )
    if target != "-" and not force and os.path.lexists(target):
        # said before the reading, for that may take a while; the writing looks again
        raise ModelServerError(f"{safe(target)} exists already; give --force to replace it, or another name")
    if is_process:
        _convert_process(source, target, values, force)
        return
    model, problems = check_file(source, values, repair=repair)
    for problem in problems:
        if problem.severity is not Severity.NOTE:
            print_problem(problem, err=True)
    if model is None:
        errors = sum(problem.severity is Severity.ERROR for problem in problems)
        raise ModelServerError(f"{safe(source)} has {counted(errors, 'error')}; nothing was written")
    saved = save_model(model, form)
    for loss in saved.losses:
        typer.echo(f"modelserver: this form cannot hold {safe(loss)}", err=True)
    if target == "-":
        typer.echo(saved.text, nl=False)
    else:
        write_file(target, saved.text, replace=force)
        typer.echo(f"{safe(target)}: {size_of(model)}", err=True)


def is_process_file(file: str) -> bool:
    """Return whether a file is a Miro process configuration, by what stands in it. Raises OSError."""
    if not os.path.isfile(file):
        return False
    with open(file, "rb") as stream:
        return file_kind(stream.read(LOOKED_AT)) is FileKind.MIRO_PROCESS


def _convert_process(source: str, target: str, values: dict[str, str], force: bool) -> None:
    """Write the vehicle file of a Miro process configuration."""
    # the schema of the vehicle file needs libraries that a geometry file does not
    from mstools.commands.convert_process import convert_process

    text, problems = convert_process(source, target, values)
    for problem in problems:
        print_problem(problem, err=True)
    if target == "-":
        typer.echo(text, nl=False)
    else:
        write_file(target, text, replace=force)
        typer.echo(f"{safe(target)}: {counted(len(problems), 'warning')}; modelserver check {safe(target)}", err=True)


def _form(form: str, target: str) -> str:
    if form in FORMS:
        return form
    if form:
        near = nearest_names(form, FORMS)
        raise typer.BadParameter(
            f"{shown(form)} is no form; " + (f"write {near[0]}" if near else f"forms are {', '.join(FORMS)}"),
            param_hint="--to",
        )
    if target == "-":
        raise typer.BadParameter(
            f"standard output has no ending; say which form: {', '.join(FORMS)}", param_hint="--to"
        )
    try:
        return form_of_path(target)
    except ValueError as error:
        raise typer.BadParameter(f"{error}; or give --to", param_hint="OUT") from None
