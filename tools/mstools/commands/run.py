"""`modelserver run`: the daemon of the service."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, TypeAlias

import typer

from modelserver.errors import ConfigError, GeometryError, Location, ModelServerError, Problem, Severity
from modelserver.server.log import FORMATS, set_up_logging
from modelserver.server.supervision import FAILED_START_S, Notifier
from mstools.terminal.options import UrlOption, option
from mstools.terminal.output import print_problems

LEVELS = ("debug", "info", "warning", "error")

FormatOption: TypeAlias = Annotated[
    str, option("--log-format", f"One of {', '.join(FORMATS)}; auto: journal where systemd reads the log.")
]


def command(
    config: Annotated[Path, option("--config -c FILE", "The vehicle file.")],
    url: UrlOption = "",
    log_level: Annotated[str, option("--log-level", f"One of {', '.join(LEVELS)}.")] = "info",
    log_format: FormatOption = "auto",
) -> None:
    """Run the service for a vehicle file, until SIGTERM or Ctrl-C.

    Loads the geometry, subscribes to the sensors, publishes POSE and answers requests. Does not start with a wrong
    vehicle file or geometry, and reports all problems; under a service manager, which would restart it at once, it then
    exits after 10 s. Logs go to stderr. SIGHUP reloads the geometry file:
    the whole file is used, or, if it is wrong, nothing changes and the log has the reason.

    Example: modelserver run -c config/raptor/vehicle.yaml
    """
    check_log_options(log_level, log_format)
    from modelserver.config.vehicle_file import load_config
    from modelserver.server import daemon
    from modelserver.server.vehicle import load_vehicle

    set_up_logging(log_level, log_format)
    notifier = Notifier.from_environment()
    notifier.notify_starting(f"reading {config}")
    with wait_on_error(config, notifier):
        settings = load_config(config)
        vehicle = load_vehicle(settings, str(config))
        vehicle.make_command_verifier(0, str(config))
    for problem in vehicle.model.problems:
        level = logging.INFO if problem.severity is Severity.NOTE else logging.WARNING
        logging.getLogger("modelserver").log(level, "%s", problem)
    daemon.run(vehicle, url, str(config), notifier)


def check_log_options(level: str, log_format: str) -> None:
    """Raise typer.BadParameter, a usage error, for an unknown level or format of the log."""
    for name, given, known in (("--log-level", level, LEVELS), ("--log-format", log_format, FORMATS)):
        if given not in known:
            raise typer.BadParameter(f"{given!r} is not one of {', '.join(known)}", param_hint=name)


@contextmanager
def wait_on_error(config: Path, notifier: Notifier) -> Iterator[None]:
    """Run the block, the start of a service; where its files are wrong, report that and wait before the process exits.

    Without a service manager errors propagate. With one they are printed at once, the first is its status, and the
    process exits with the same code, after `FAILED_START_S`.
    """
    if not notifier.is_active:
        yield
        return
    code, problems = 1, tuple[Problem, ...]()
    try:
        yield
        return
    except (ConfigError, GeometryError) as error:
        text, problems = "", error.problems
    except OSError as error:
        if error.filename is None or Path(error.filename) != config:
            raise
        text = f"the vehicle file cannot be read: {error.strerror}"
    except typer.BadParameter as error:
        text, code = error.message, error.exit_code
    except ModelServerError as error:
        text = str(error)
    problems = problems or (Problem(Severity.ERROR, text, Location(str(config))),)
    print_problems(problems)
    # also extends the start timeout of systemd
    notifier.notify_starting(format_status(problems))
    time.sleep(FAILED_START_S)
    raise typer.Exit(code)


def format_status(problems: Iterable[Problem]) -> str:
    """Return the problems in one line: the first error, and the number of others."""
    errors = [problem for problem in problems if problem.severity is Severity.ERROR]
    first = errors[0] if errors else None
    place = f"{first.file}:{first.line}: " if first is not None and first.line else ""
    more = f" (and {len(errors) - 1} more)" if len(errors) > 1 else ""
    message = first.message if first is not None else "the vehicle file or its geometry is wrong"
    return f"start failed, waiting for the file to be fixed: {place}{message}{more}"
