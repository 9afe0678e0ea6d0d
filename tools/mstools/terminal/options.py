"""Options that several commands share."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import typer

from modelserver.errors import find_nearest_names, quote
from mstools.terminal.completion import complete_channel


def option(declaration: str, about: str, **more: Any) -> Any:
    """Declare an option as its usage has it, e.g. `--config -c FILE`; `more`: typer's min, max, autocompletion."""
    words = declaration.split()
    names = [word for word in words if word.startswith("-")]
    return typer.Option(*names, metavar=" ".join(words[len(names) :]) or None, help=about, **more)


def argument(metavar: str, about: str, **more: Any) -> Any:
    """Declare an argument as its usage shows it; `more`: typer's `autocompletion`."""
    return typer.Argument(metavar=metavar, help=about, **more)


Variables: TypeAlias = Annotated[
    list[str] | None,
    option(
        "--set NAME=VALUE",
        "Value of $NAME in a Miro frame tree, e.g. MRN=K11; overrides the environment. May be repeated.",
    ),
]
"""Annotation of a parameter whose value goes to `parse_variables`."""

ModelOption = Annotated[Path | None, option("--model FILE", "Query this geometry file instead of the daemon.")]
UrlOption = Annotated[str, option("--url URL", "LCM provider. Default: $LCM_DEFAULT_URL, else loopback.")]
PrefixOption = Annotated[str, option("--prefix TEXT", "Channel prefix of the vehicle.")]
KeyOption = Annotated[
    Path | None, option("--key FILE", "The vehicle's key file, to sign with. Default: $MODELSERVER_KEY_FILE.")
]
TimeoutOption = Annotated[float, option("--timeout SECONDS", "Timeout of one try.", min=0.01, max=3600.0)]
ChannelsOption = Annotated[
    list[str] | None,
    option("--channel NAME", "Only this channel; may be repeated.", autocompletion=complete_channel),
]
JsonOption = Annotated[bool, option("--json", "Print JSON, for scripts.")]

_ASSIGNMENT = re.compile(r"(\w+)=(.*)", re.ASCII | re.DOTALL)


def choose_name(text: str, known: Collection[str], what: str, option: str) -> str:
    """Return a known name. Raises typer.BadParameter, a usage error of `option`, with the nearest one for another."""
    if text in known:
        return text
    near = find_nearest_names(text, known)
    hint = f"did you mean {near[0]}?" if near else f"{what}s: {', '.join(known)}"
    raise typer.BadParameter(f"{quote(text, 40)} is an unknown {what}; {hint}", param_hint=option)


def parse_variables(given: Iterable[str] | None) -> dict[str, str]:
    """Return the variables of `--set`. Raises typer.BadParameter, a usage error, for a malformed one."""
    variables = {}
    for text in given or ():
        match = _ASSIGNMENT.fullmatch(text)
        if match is None:
            raise typer.BadParameter(f"{quote(text)} is not NAME=VALUE", param_hint="--set")
        variables[match[1]] = match[2]
    return variables
