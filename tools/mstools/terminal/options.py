"""Options that several commands share."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Annotated, TypeAlias

import typer

from modelserver.errors import shown

Variables: TypeAlias = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="NAME=VALUE",
        help="What $NAME stands for in a Miro frame tree, e.g. MRN=K11; before the environment. May be repeated.",
    ),
]
"""Annotate a parameter with it, and give the value to `parse_variables`."""

_ASSIGNMENT = re.compile(r"(\w+)=(.*)", re.ASCII | re.DOTALL)


def parse_variables(given: Iterable[str] | None) -> dict[str, str]:
    """Return the variables that `--set` gave. Raises typer.BadParameter, a usage error, for a malformed one."""
    variables = {}
    for text in given or ():
        match = _ASSIGNMENT.fullmatch(text)
        if match is None:
            raise typer.BadParameter(f"{shown(text)} is not of the form NAME=VALUE", param_hint="--set")
        variables[match[1]] = match[2]
    return variables
