"""`modelserver convert`: a geometry file in another format."""

from __future__ import annotations

import os
from typing import Annotated

import typer

from modelserver.errors import ModelServerError, Severity
from modelserver.files.kinds import EXAMINED_BYTES, FileKind, detect_file_kind
from modelserver.files.regular import read_start
from modelserver.formats import FORMATS, check_file, format_of_path, save_model
from mstools.terminal.options import Variables, argument, choose_name, option, parse_variables
from mstools.terminal.output import check_writable, describe_size, escape, format_count, print_problems, write_file


def command(
    source: Annotated[
        str,
        argument("IN", "Geometry file: YAML, Miro XML, URDF or libbot2 frames; or Miro process configuration."),
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

    A Miro process configuration becomes a vehicle file with its geometry file and the parameters that have a
    counterpart; the others are listed in it and on standard error.

    \b
    Examples:
      modelserver convert K11Frames.xml k11.yaml --set MRN=K11
      modelserver convert process.xml vehicle.yaml
      modelserver convert husky.urdf husky.yaml
    """
    output_format = _choose_format(output_format, target)
    values = parse_variables(variables)
    is_process = (
        os.path.isfile(source) and detect_file_kind(read_start(source, EXAMINED_BYTES)) is FileKind.MIRO_PROCESS
    )
    if is_process and output_format != "yaml":
        raise typer.BadParameter(
            f"{source} is a Miro process configuration, which becomes a vehicle file in YAML; name it FILE.yaml",
            param_hint="OUT",
        )
    check_writable(target, force)
    if is_process:
        # imported here: a geometry file needs no configuration libraries
        from mstools.commands.convert_process import convert_process

        text, warnings = convert_process(source, target, values)
        print_problems(warnings)
        write_file(target, text, replace=force)
        if target != "-":
            seen = f"{format_count(len(warnings), 'warning')}; modelserver check {escape(target)}"
            typer.echo(f"{escape(target)}: {seen}", err=True)
        return
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
