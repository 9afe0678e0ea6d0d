"""`modelserver convert`: a geometry file in another form."""

from __future__ import annotations

import os
from typing import Annotated

import typer

from modelserver.errors import ModelServerError, Severity, nearest_names, shown
from modelserver.formats import FORMS, check_file, form_of_path, save_model
from mstools.options import Variables, parse_variables
from mstools.output import counted, print_problem, safe, size_of, write_file


def command(
    source: Annotated[str, typer.Argument(metavar="IN", help="Geometry file: YAML, Miro XML, URDF or libbot2 frames.")],
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

    \b
    Examples:
      modelserver convert K11Frames.xml k11.yaml --set MRN=K11
      modelserver convert husky.urdf husky.yaml
    """
    form = _form(form, target)
    values = parse_variables(variables)
    if target != "-" and not force and os.path.lexists(target):
        # said before the reading, for that may take a while; the writing looks again
        raise ModelServerError(f"{safe(target)} exists already; give --force to replace it, or another name")
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
