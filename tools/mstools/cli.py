"""The `modelserver` command: runs the module of a subcommand, and prints errors as one line.

Exit codes: 0 success, 1 wrong input or no answer, 2 wrong usage, 130 interrupted. `doctor` has its own: 1 warnings, 3
errors.
"""

from __future__ import annotations

import gc
import importlib
import os
import sys
from collections.abc import Callable, Sequence
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from modelserver.errors import ConfigError, GeometryError, ModelServerError, QueryError, find_nearest_names, quote
from modelserver.version import __version__
from mstools.terminal.options import option
from mstools.terminal.output import escape, print_problems, suggest_path

GROUPS = {
    "Start": {
        "demo": "Run the whole service on simulated sensors and show its answers.",
        "new": "Write the files of a new vehicle, from a few questions.",
        "up": "Run the service and all drivers of a vehicle, or emulate them.",
        "run": "Run the service for a vehicle file.",
    },
    "Geometry": {
        "check": "Report every problem of a geometry or vehicle file.",
        "convert": "Convert a geometry file to another format.",
        "query": "Where is one frame in another?",
        "dynamics": "Mass, center of mass, equations of motion, tip-over margin and wheel loads.",
        "tree": "Draw the kinematic tree: constraints, joints, loops, orphans.",
        "view": "Show a geometry file, a log, or the running service in the browser.",
    },
    "Service": {
        "status": "Show the health of the running daemon, or all channels in lcm-spy.",
        "doctor": "Diagnose bus, clock and machine, and print the commands that fix problems.",
        "mode": "Switch the localization mode of the running daemon.",
        "reload": "Reload the geometry file of the running daemon.",
        "set-pose": "Set the pose of the vehicle in the running daemon.",
        "key": "Create a key to sign commands with.",
    },
    "Recordings": {
        "record": "Record the bus as an LCM log, with the types of its messages checked.",
        "replay": "Replay a log on the bus, or offline through the localization.",
        "import-bag": "Convert a ROS bag to an LCM log of this project's types.",
        "archive": "Replay many logs on a cluster into Parquet tables, and report on them.",
        "export": "Convert an LCM log to an MCAP file for Foxglove, or serve the running service to it.",
    },
    "Tuning": {
        "tune": "Tune the filter's noise settings on a log, with withheld fixes.",
        "calibrate": "Calibrate an IMU's noise, or its magnetometer, from a log.",
    },
    "Deployment": {
        "driver": "Run the driver of a device: read it and publish its samples.",
        "emulate": "Emulate a device for its driver.",
        "install": "Install the service and its drivers under systemd, or remove them.",
    },
}
"""Subcommands with their summary, in the groups of `modelserver --help`."""

COMMANDS = {name: summary for group in GROUPS.values() for name, summary in group.items()}

_MODULES = {
    "convert": "check",
    "emulate": "driver",
    "key": "control",
    "mode": "control",
    "reload": "control",
    "run": "driver",
    "set-pose": "control",
}
"""Modules that hold more commands than that of their own name, each as a function of its name. Else a command is
`command` in the module of its name. One with subcommands of its own is a Typer application there."""

COMPLETION_VARIABLE = "_MODELSERVER_COMPLETE"
"""Environment variable with which a shell asks for completions."""

_ALIASES = {
    "new": "init create template",
    "up": "launch all",
    "run": "serve server start daemon",
    "check": "validate lint",
    "archive": "fleet batch campaign dask parquet",
    "replay": "play verify journal report",
    "record": "log logger rec",
    "import-bag": "import",
    "export": "mcap foxglove bridge",
    "mode": "switch",
    "set-pose": "set initialpose localize",
    "status": "watch health top spy listen echo",
    "doctor": "diagnose probe",
    "tree": "graph draw bodies frames",
    "reload": "hup",
    "install": "setup uninstall remove",
    "query": "explain motion",
    "dynamics": "mass inertia stability tip payload",
    "view": "viewer gui show3d rviz",
}

COMMAND_ALIASES = {alias: name for name, aliases in _ALIASES.items() for alias in aliases.split()}
"""Other words for the commands."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and exit."""
    _open_closed_streams()
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    if COMPLETION_VARIABLE in os.environ:
        # a shell asks what may follow its words, the first of which is this program
        words = os.environ.get("_TYPER_COMPLETE_ARGS") or os.environ.get("COMP_WORDS", "")
        build_app(words.split()[1:])(prog_name="modelserver")
    _check_command(_command_of(arguments))
    try:
        build_app(arguments)(arguments, prog_name="modelserver")
    except (GeometryError, ConfigError) as error:
        print_problems(error.problems)
        sys.exit(1)
    except QueryError as error:
        near = f". Nearest: {', '.join(error.nearest)}" if error.nearest else ""
        _fail(f"{error}{near}")
    except ModelServerError as error:
        _fail(str(error))
    except OSError as error:
        place = f"{error.filename}: " if error.filename else ""
        _fail(f"{place}{error.strerror or error}{suggest_path(error)}")
    except ModuleNotFoundError as error:
        # what lcm's package reports where its shared library lacks another one
        if error.name != "lcm.Release":
            raise
        _fail("the LCM library needs libglib-2.0, which this machine lacks: sudo apt install libglib2.0-0")
    except KeyboardInterrupt:
        sys.exit(130)


def _open_closed_streams() -> None:
    """Open standard streams that the caller closed (2>&-) on /dev/null.

    Else the next socket or file would have their number, and receive what libraries write to standard error.
    """
    for number, name, mode in ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w")):
        try:
            os.fstat(number)
        except OSError:
            # the lowest free number is this one
            opened = os.open(os.devnull, os.O_RDWR)
            os.set_inheritable(opened, True)
            setattr(sys, name, open(opened, mode, encoding="utf-8", closefd=False))  # noqa: SIM115


class GroupedHelp(TyperGroup):
    """Application whose help lists the commands in their groups."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        for title, commands in GROUPS.items():
            with formatter.section(title):
                formatter.write_dl(list(commands.items()))


def build_app(arguments: Sequence[str]) -> typer.Typer:
    """Return the application. Only the subcommand in `arguments` is imported, the others are stubs, for speed."""
    app = typer.Typer(
        cls=GroupedHelp,
        help="Where is A relative to B, now or at time t, and with which uncertainty?",
        epilog="Start with: modelserver demo, then modelserver new",
        add_completion=True,
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
    """Import a subcommand with the garbage collector off, which saves a sixth of the time."""
    gc.disable()
    try:
        own = name.replace("-", "_")
        module = importlib.import_module(f"mstools.commands.{_MODULES.get(name, own)}")
        command: Callable[..., None] | typer.Typer = getattr(module, own if name in _MODULES else "command")
        return command
    finally:
        gc.freeze()
        gc.enable()


def _command_of(arguments: Sequence[str]) -> str:
    return next((argument for argument in arguments if not argument.startswith("-")), "")


def _check_command(wanted: str) -> None:
    """Exit with 2 and the nearest command if there is none of that name."""
    if not wanted or wanted in COMMANDS:
        return
    near = COMMAND_ALIASES.get(wanted.casefold()) or next(iter(find_nearest_names(wanted, COMMANDS)), "")
    hint = f"did you mean {near}? {COMMANDS[near]}" if near else f"commands: {', '.join(COMMANDS)}"
    typer.echo(escape(f"modelserver: unknown command {quote(wanted, 40)}; {hint} (modelserver --help)"), err=True)
    sys.exit(2)


def _stub() -> None:
    """Placeholder of a subcommand that is not run."""


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"modelserver {__version__}")
        raise typer.Exit


def _options(
    version: Annotated[bool, option("--version", "Print the version.", callback=_show_version, is_eager=True)] = False,
) -> None:
    pass


def _fail(message: str) -> None:
    typer.echo(escape(f"modelserver: {message}"), err=True)
    sys.exit(1)
