"""`modelserver run`: the daemon of the service."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Annotated, TypeAlias

import typer

from modelserver.server.log import FORMATS, set_up_logging
from mstools.terminal.options import UrlOption, option

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
    exits only when one of the files has changed, or after 30 s. Logs go to stderr. SIGHUP reloads the geometry file:
    the whole file is used, or, if it is wrong, nothing changes and the log has the reason.

    Example: modelserver run -c config/raptor/vehicle.yaml
    """
    check_log_options(log_level, log_format)
    from modelserver.config.vehicle_file import load_config
    from modelserver.server import daemon
    from modelserver.server.supervision import Notifier
    from modelserver.server.vehicle import load_vehicle
    from mstools.deployment.service_start import ServiceStart

    set_up_logging(log_level, log_format)
    notifier = Notifier.from_environment()
    notifier.notify_starting(f"reading {config}")
    start = ServiceStart(config, notifier)
    with start.wait_on_error():
        settings = load_config(config)
        start.add_files(settings.geometry, settings.commands.key_file)
        vehicle = load_vehicle(settings, str(config))
        vehicle.make_command_verifier(0, str(config))
    for problem in vehicle.model.problems:
        logging.getLogger("modelserver").warning("%s", problem)
    daemon.run(vehicle, url, str(config), notifier)


def check_log_options(level: str, log_format: str) -> None:
    """Raise typer.BadParameter, a usage error, for an unknown level or format of the log."""
    for name, given, known in (("--log-level", level, LEVELS), ("--log-format", log_format, FORMATS)):
        if given not in known:
            raise typer.BadParameter(f"{given!r} is not one of {', '.join(known)}", param_hint=name)
