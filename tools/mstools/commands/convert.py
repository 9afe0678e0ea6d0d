"""`modelserver convert`: a geometry file in another format."""

from __future__ import annotations

from typing import Annotated

import typer

from modelserver.errors import ModelServerError, Severity
from modelserver.formats import FORMATS, check_file, format_of_path, save_model
from mstools.terminal.options import Variables, argument, choose_name, option, parse_variables
from mstools.terminal.output import check_writable, describe_size, escape, format_count, print_problems, write_file


def command(
    source: Annotated[
        str,
        argument("IN", "Geometry file: YAML, Miro XML, URDF or libbot2 frames."),
    ],
    target: Annotated[str, argument("OUT", "File to write, or - for standard output.")],
    output_format: Annotated[
        str,
        option(
            "--to FORMAT",
            f"Format to write: {', '.join(FORMATS)}. Default: by the extension of OUT, "
            ".yaml, .yml, .urdf; .xml is miro.",
        ),
    ] = "",
    variables: Variables = None,
    repair: Annotated[
        bool, option("--repair", "Drop malformed elements, and bodies that no constraint connects to the first one.")
    ] = False,
    force: Annotated[bool, option("--force", "Replace OUT where it exists.")] = False,
) -> None:
    """Convert a geometry file to another format; unsupported features are listed on standard error.

    \b
    Examples:
      modelserver convert K11Frames.xml k11.yaml --set MRN=K11
      modelserver convert husky.urdf husky.yaml
    """
    output_format = _choose_format(output_format, target)
    values = parse_variables(variables)
    check_writable(target, force)
    model, problems = check_file(source, values, repair=repair)
    print_problems(problem for problem in problems if problem.severity is not Severity.NOTE)
    if model is None:
        errors = sum(problem.severity is Severity.ERROR for problem in problems)
        raise ModelServerError(f"{escape(source)} has {format_count(errors, 'error')}; nothing was written")
    saved = save_model(model, output_format)
    for loss in saved.unsupported:
        typer.echo(f"modelserver: the format does not support {escape(loss)}", err=True)
    write_file(target, saved.text, replace=force)
    if target != "-":
        typer.echo(f"{escape(target)}: {describe_size(model)}", err=True)


def _choose_format(form: str, target: str) -> str:
    if form:
        return choose_name(form, FORMATS, "format", "--to")
    if target == "-":
        raise typer.BadParameter(
            f"standard output has no extension; give the format: {', '.join(FORMATS)}", param_hint="--to"
        )
    try:
        return format_of_path(target)
    except ValueError as error:
        raise typer.BadParameter(f"{error}; or give --to", param_hint="OUT") from None
