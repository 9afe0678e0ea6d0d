"""`modelserver run`: the daemon."""

from __future__ import annotations

import logging
import os
from pathlib import Path
from typing import Annotated, TypeAlias

import typer

from modelserver.service.log_format import FORMATS, set_up
from mstools.commands.asking import UrlOption

LEVELS = ("debug", "info", "warning", "error")

FormatOption: TypeAlias = Annotated[
    str, typer.Option("--log-format", help=f"One of {', '.join(FORMATS)}; auto: journal where systemd reads the log.")
]


def command(
    config: Annotated[Path, typer.Option("--config", "-c", metavar="FILE", help="The vehicle file.")],
    url: UrlOption = "",
    log_level: Annotated[str, typer.Option("--log-level", help=f"One of {', '.join(LEVELS)}.")] = "info",
    log_format: FormatOption = "auto",
) -> None:
    """Run the service for a vehicle file, until SIGTERM or Ctrl-C.

    Loads the geometry, listens to the sensors, broadcasts POSE and answers requests. Refuses to start where the
    vehicle file or the geometry is wrong, and says everything that is; under a service manager, which would start it
    anew at once, it ends only when one of the files has changed, or after 30 s. Logs go to stderr. SIGHUP has it read
    the geometry file anew: all of it is used, or, where it is wrong, nothing changes and the log says why.

    Example: modelserver run -c config/raptor/vehicle.yaml
    """
    check_log(log_level, log_format)
    # one thread serves; idle BLAS threads would only disturb its timing
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    from modelserver.config import load_config
    from modelserver.service import daemon
    from modelserver.service.supervision.notify import Notifier
    from mstools.deployment.refusal import Start

    set_up(log_level, log_format)
    notifier = Notifier.of_environment()
    notifier.starting(f"reading {config}")
    start = Start(config, notifier)
    with start.patient():
        settings = load_config(config)
        start.needs(settings.geometry, settings.commands.key_file)
        vehicle = daemon.load_vehicle(settings, str(config))
        vehicle.gate(0, str(config))
    for problem in vehicle.model.problems:
        logging.getLogger("modelserver").warning("%s", problem)
    daemon.run(vehicle, url, str(config), notifier)


def check_log(level: str, form: str) -> None:
    """Raise typer.BadParameter, a usage error, for a level or a form of log that there is not."""
    for option, given, known in (("--log-level", level, LEVELS), ("--log-format", form, FORMATS)):
        if given not in known:
            raise typer.BadParameter(f"{given!r} is not one of {', '.join(known)}", param_hint=option)
