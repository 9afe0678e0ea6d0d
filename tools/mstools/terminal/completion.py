"""Names that the shell completes: frames, bodies, channels and drivers of the vehicle at hand.

The vehicle is the file of `--config` or `--model` among the words typed, else vehicle.yaml in this folder. A file that
cannot be read completes nothing: a shell shows no error while a line is typed.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from modelserver.errors import ModelServerError

if TYPE_CHECKING:
    from modelserver.config.vehicle_file import VehicleConfig
    from modelserver.geometry import Model

VEHICLE_FILE = "vehicle.yaml"


def complete_frame(ctx: Any, incomplete: str) -> list[str]:
    """Return bodies, frames and world frames that begin so. `ctx`: the words so far, a context of Click."""
    model = _find_model(ctx)
    if model is None:
        return []
    frames = [frame.full_name for body in model.bodies for frame in body]
    worlds = ["map", "odom", "utm", "World:ENU", "World:UTM", "Odom:Origin"]
    return _select((*model.get_body_list(), *frames, *worlds), incomplete)


def complete_channel(ctx: Any, incomplete: str) -> list[str]:
    """Return the channels of the vehicle's sensors and of the service."""
    from modelserver.wire.channels import CHANNELS

    config = _find_config(ctx)
    sensors = () if config is None else (config.sensors.gps, config.sensors.imu, config.sensors.wheels)
    own = [each.channel for each in sensors if each is not None]
    return _select((*own, *(each.name for each in CHANNELS)), incomplete)


def complete_driver(ctx: Any, incomplete: str) -> list[str]:
    config = _find_config(ctx)
    return [] if config is None else _select(config.drivers, incomplete)


def _select(names: Iterable[str], start: str) -> list[str]:
    return [name for name in dict.fromkeys(names) if name.startswith(start)]


def _find_config(ctx: Any) -> VehicleConfig | None:
    from modelserver.config.vehicle_file import load_partly

    given = ctx.params.get("config") or VEHICLE_FILE
    try:
        return load_partly(Path(given))[0]
    except (ModelServerError, OSError):
        return None


def _find_model(ctx: Any) -> Model | None:
    from modelserver.formats import check_file

    given = ctx.params.get("model")
    config = None if given else _find_config(ctx)
    try:
        return check_file(str(given or (config.geometry if config is not None else "")))[0]
    except (ModelServerError, OSError):
        return None
