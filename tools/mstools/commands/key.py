"""`modelserver key`: the secret keys that sign commands."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mstools.terminal.options import argument, option
from mstools.terminal.output import escape

command = typer.Typer(
    help="""Create the key to sign commands to a vehicle with.

    The vehicle file names the key file (commands: {key_file: ...}); the commanding program gets it by --key FILE or
    $MODELSERVER_KEY_FILE. docs/network.md explains how to distribute and change keys.

    Example: modelserver key new /etc/modelserver/commands.key
    """,
    no_args_is_help=True,
    rich_markup_mode=None,
)


@command.callback()
def _group() -> None:
    """Keep `new` a subcommand."""


@command.command("new")
def create(
    file: Annotated[Path, argument("FILE", "The file to create; it must not exist.")],
    name: Annotated[str, option("--name TEXT", "Name of the key.")] = "",
) -> None:
    """Write a new key to a file that only its owner can read."""
    from modelserver.key_files import generate_key, write_key

    key = generate_key(name)
    write_key(file, key)
    typer.echo(f"{escape(str(file))}: key {key.name}, readable by its owner only")
