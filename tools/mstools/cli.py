"""The `modelserver` command: runs the subcommand's module, and turns errors into one readable line.

Exit codes: 0 done, 1 the input is wrong or nobody answered, 2 wrong usage, 130 interrupted. `doctor` grades what it
finds by its own: 1 warnings, 3 errors.
"""

from __future__ import annotations

import gc
import importlib
import sys
from collections.abc import Callable, Sequence
from typing import Annotated

import typer

from modelserver.errors import ConfigError, GeometryError, ModelServerError, QueryError, nearest_names, shown
from modelserver.version import __version__
from mstools.terminal.missing import meant
from mstools.terminal.output import print_problem, safe

COMMANDS = {
    "demo": "Run the whole service on simulated sensors and watch it answer.",
    "run": "Run the service for a vehicle file.",
    "check": "Say everything that is wrong with a geometry or vehicle file.",
    "convert": "Write a geometry file in another form, Miro's process configuration as vehicle file.",
    "query": "Where is one frame in another?",
    "bodies": "List the bodies.",
    "frames": "List the frames of a body.",
    "tree": "Draw how bodies hang together: constraints, joints, loops, orphans.",
    "reload": "Have the running daemon read its geometry file anew.",
    "set-pose": "Set the pose of the vehicle in the running daemon.",
    "key": "Make the key that commands are signed with.",
    "replay": "Feed a recorded log to the bus, or straight through the localization.",
    "mode": "Tell the running daemon which sources its localization is to use.",
    "tune": "Propose noise settings of the filter from a log, by fixes that were withheld.",
    "calibrate": "Find an inertial unit's noise, or the iron around its magnetometer, from a log.",
    "import-bag": "Turn a ROS bag into an LCM log of this project's types.",
    "driver": "Read a device and publish what it measures.",
    "emulate": "Be a device, for its driver to read.",
    "status": "How is the running daemon?",
    "spy": "Watch the channels, decoded: with lcm-spy, or in the terminal.",
    "doctor": "Is this machine fit for the service? Prints the commands that mend it.",
    "install": "Have systemd run the service and its drivers.",
    "uninstall": "Take back what install did.",
}
"""Subcommands and what each is for. `import-bag` is function `command` of module `mstools.commands.import_bag`, and so
on; a command with subcommands of its own has a Typer application there instead."""


OTHER_WORDS = {
    "serve": "run",
    "server": "run",
    "start": "run",
    "daemon": "run",
    "validate": "check",
    "lint": "check",
    "play": "replay",
    "verify": "replay",
    "journal": "replay",
    "import": "import-bag",
    "switch": "mode",
    "set": "set-pose",
    "initialpose": "set-pose",
    "localize": "set-pose",
    "watch": "status",
    "health": "status",
    "top": "status",
    "diagnose": "doctor",
    "probe": "doctor",
    "listen": "spy",
    "echo": "spy",
    "graph": "tree",
    "draw": "tree",
    "hup": "reload",
    "setup": "install",
    "remove": "uninstall",
    "explain": "query",
    "motion": "query",
}
"""What others call our commands."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and exit."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    _check_command(_command_of(arguments))
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
        _fail(f"{place}{error.strerror or error}{meant(error)}")
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
    wanted = _command_of(arguments)
    for name, summary in COMMANDS.items():
        function: Callable[..., None] | typer.Typer = _stub
        if name == wanted:
            function = _import_command(name)
        if isinstance(function, typer.Typer):
            app.add_typer(function, name=name, short_help=summary)
        else:
            app.command(name, short_help=summary)(function)
    return app


def _import_command(name: str) -> Callable[..., None] | typer.Typer:
    """Import a subcommand, without the garbage collector: what is imported stays, and looking for garbage in it takes
    a sixth of the time."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        command: Callable[..., None] | typer.Typer
        command = importlib.import_module(f"mstools.commands.{name.replace('-', '_')}").command
        return command
    finally:
        if was_on:
            gc.freeze()
            gc.enable()


def _command_of(arguments: Sequence[str]) -> str:
    return next((argument for argument in arguments if not argument.startswith("-")), "")


def _check_command(wanted: str) -> None:
    """Exit as for wrong usage, with the nearest command, where there is none of that name."""
    if not wanted or wanted in COMMANDS:
        return
    near = OTHER_WORDS.get(wanted.casefold()) or next(iter(nearest_names(wanted, COMMANDS)), "")
    offer = f"did you mean {near}? {COMMANDS[near]}" if near else f"there are: {', '.join(COMMANDS)}"
    typer.echo(safe(f"modelserver: there is no command {shown(wanted, 40)}; {offer} (modelserver --help)"), err=True)
    sys.exit(2)


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
