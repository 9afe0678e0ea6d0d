"""The `modelserver` command: runs the subcommand's module, and turns errors into one readable line.

Exit codes: 0 done, 1 the input is wrong or nobody answered, 2 wrong usage, 130 interrupted.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Sequence
from typing import Annotated

import typer

from modelserver.errors import ConfigError, GeometryError, ModelServerError, QueryError
from modelserver.version import __version__
from mstools.output import print_problem, safe

COMMANDS = {
    "demo": "Run the whole service on simulated sensors and watch it answer.",
    "run": "Run the service for a vehicle file.",
    "check": "Say everything that is wrong with a geometry or vehicle file.",
    "convert": "Write a geometry file in another form.",
    "query": "Where is one frame in another?",
    "bodies": "List the bodies.",
    "frames": "List the frames of a body.",
    "replay": "Feed a recorded log to the bus, or straight through the localization.",
    "mode": "Tell the running daemon which sources its localization is to use.",
    "tune": "Propose noise settings of the filter from a log, by fixes that were withheld.",
    "calibrate": "Find an inertial unit's noise, or the iron around its magnetometer, from a log.",
    "import-bag": "Turn a ROS bag into an LCM log of this project's types.",
    "spy": "Watch the channels with lcm-spy, decoded.",
}
"""Subcommands and what each is for. `import-bag` is function `command` of module `mstools.import_bag`, and so on; a
command with subcommands of its own has a Typer application there instead."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and exit."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    try:
        build(arguments)(arguments, prog_name="modelserver")
    except (GeometryError, ConfigError) as error:
        for problem in error.problems:
            print_problem(problem, err=True)
        sys.exit(1)
    except QueryError as error:
        near = f". Nearest: {', '.join(error.nearest)}" if error.nearest else ""
        _fail(f"{error}{near}")
    except ModelServerError as error:
        _fail(str(error))
    except OSError as error:
        place = f"{error.filename}: " if error.filename else ""
        _fail(f"{place}{error.strerror or error}")
    except KeyboardInterrupt:
        sys.exit(130)


def build(arguments: Sequence[str]) -> typer.Typer:
    """Return the application; only the subcommand that `arguments` name is imported.

    `query` must not pay for what `replay` needs, so the others stand in it as stubs that carry their help.
    """
    app = typer.Typer(
        help="Where is A relative to B, now or at time t, and how sure are we?",
        epilog="Start with: modelserver demo",
        add_completion=False,
        no_args_is_help=True,
        rich_markup_mode=None,
        pretty_exceptions_enable=False,
    )
    app.callback()(_options)
    wanted = next((argument for argument in arguments if not argument.startswith("-")), "")
    for name, summary in COMMANDS.items():
        function: Callable[..., None] | typer.Typer = _stub
        if name == wanted:
            function = importlib.import_module(f"mstools.{name.replace('-', '_')}").command
        if isinstance(function, typer.Typer):
            app.add_typer(function, name=name, short_help=summary)
        else:
            app.command(name, short_help=summary)(function)
    return app


def _stub() -> None:
    """Stand in for a subcommand that is listed but not run."""


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"modelserver {__version__}")
        raise typer.Exit


def _options(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version.", callback=_show_version, is_eager=True)
    ] = False,
) -> None:
    pass


def _fail(message: str) -> None:
    typer.echo(safe(f"modelserver: {message}"), err=True)
    sys.exit(1)
