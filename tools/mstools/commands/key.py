"""`modelserver key`: the secrets that commands are signed with."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mstools.terminal.output import safe

command = typer.Typer(
    help="""Make the key that commands to a vehicle are signed with.

    The vehicle file names its file (commands: {key_file: ...}), and so does who commands: --key FILE, or
    $MODELSERVER_KEY_FILE. docs/network.md says how keys are handed out and changed.

    Example: modelserver key new /etc/modelserver/commands.key
    """,
    no_args_is_help=True,
    rich_markup_mode=None,
)


@command.callback()
def _group() -> None:
    """Keep `new` a subcommand: another may come."""


@command.command("new")
def new(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="The file to make; none may be there.")],
    name: Annotated[str, typer.Option("--name", metavar="TEXT", help="What to call the key.")] = "",
) -> None:
    """Write a new key into a file that only its owner may read."""
    from modelserver.keys import new_key, write_key

    key = new_key(name)
    write_key(file, key)
    typer.echo(f"{safe(str(file))}: key {key.name}, for its owner's eyes alone")
