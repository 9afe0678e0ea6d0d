"""`modelserver run`: the daemon."""

from __future__ import annotations

import logging
import os
from pathlib import Path
from typing import Annotated

import typer

from mstools.asking import UrlOption

LEVELS = ("debug", "info", "warning", "error")


def command(
    config: Annotated[Path, typer.Option("--config", "-c", metavar="FILE", help="The vehicle file.")],
    url: UrlOption = "",
    log_level: Annotated[str, typer.Option("--log-level", help=f"One of {', '.join(LEVELS)}.")] = "info",
) -> None:
    """Run the service for a vehicle file, until SIGTERM or Ctrl-C.

    Loads the geometry, listens to the sensors, broadcasts POSE and answers requests. Refuses to start where the
    vehicle file or the geometry is wrong, and says everything that is. Logs go to stderr. SIGHUP has it read the
    geometry file anew: all of it is used, or, where it is wrong, nothing changes and the log says why.

    Example: modelserver run -c config/raptor/vehicle.yaml
    """
    if log_level not in LEVELS:
        raise typer.BadParameter(f"{log_level!r} is not one of {', '.join(LEVELS)}", param_hint="--log-level")
    # one thread serves; idle BLAS threads would only disturb its timing
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    from modelserver.config import load_config
    from modelserver.service import daemon

    logging.basicConfig(level=log_level.upper(), format="%(levelname)s %(name)s: %(message)s")
    vehicle = daemon.load_vehicle(load_config(config), str(config))
    for problem in vehicle.model.problems:
        logging.getLogger("modelserver").warning("%s", problem)
    daemon.run(vehicle, url, str(config))
