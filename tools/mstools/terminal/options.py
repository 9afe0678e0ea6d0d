"""Options that several commands share."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, TypeAlias

import typer

from modelserver.errors import quote

Variables: TypeAlias = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="NAME=VALUE",
        help="Value of $NAME in a Miro frame tree, e.g. MRN=K11; overrides the environment. May be repeated.",
    ),
]
"""Annotation of a parameter whose value goes to `parse_variables`."""

ModelOption = Annotated[
    Path | None, typer.Option("--model", metavar="FILE", help="Query this geometry file instead of the daemon.")
]
UrlOption = Annotated[
    str, typer.Option("--url", metavar="URL", help="LCM provider. Default: $LCM_DEFAULT_URL, else loopback.")
]
PrefixOption = Annotated[str, typer.Option("--prefix", metavar="TEXT", help="Channel prefix of the vehicle.")]
KeyOption = Annotated[
    Path | None,
    typer.Option("--key", metavar="FILE", help="The vehicle's key file, to sign with. Default: $MODELSERVER_KEY_FILE."),
]
TimeoutOption = Annotated[
    float,
    typer.Option("--timeout", metavar="SECONDS", min=0.01, max=3600.0, help="Timeout of one try."),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON, for scripts.")]

_ASSIGNMENT = re.compile(r"(\w+)=(.*)", re.ASCII | re.DOTALL)


def parse_variables(given: Iterable[str] | None) -> dict[str, str]:
    """Return the variables of `--set`. Raises typer.BadParameter, a usage error, for a malformed one."""
    variables = {}
    for text in given or ():
        match = _ASSIGNMENT.fullmatch(text)
        if match is None:
            raise typer.BadParameter(f"{quote(text)} is not NAME=VALUE", param_hint="--set")
        variables[match[1]] = match[2]
    return variables
