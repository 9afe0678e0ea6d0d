"""`modelserver mode`: which sources localization uses, told to the running daemon."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from modelserver.errors import ConfigError, Problem, Severity, Source, nearest_names, shown
from modelserver.messages import Mode, SensorHeader, SwitchMode
from mstools.asking import UrlOption

MODES = tuple(mode.name.lower() for mode in Mode)


def command(
    mode: Annotated[str, typer.Argument(metavar="MODE", help=f"One of {', '.join(MODES)}.")],
    config: Annotated[Path, typer.Option("--config", "-c", metavar="FILE", help="The vehicle file.")],
    url: UrlOption = "",
) -> None:
    """Tell the running daemon which sources its localization is to use from now on.

    The wish goes out once, on the channel that the vehicle file names (localization.mode_channel); the daemon must
    have been started with the same. It is not answered: LOCALIZATION_STATE says which mode is in force.

    Example: modelserver mode no_gps -c config/husky/vehicle.yaml
    """
    wanted = parse_mode(mode)
    from modelserver.config import load_config
    from modelserver.wire.codec import encode
    from modelserver.wire.provider import open_lcm, resolve_url

    vehicle = load_config(config)
    if not vehicle.localization.mode_channel:
        why = "the vehicle file names no channel for wishes about the mode, so the daemon hears none"
        fix = "write mode_channel: LOCALIZATION_MODE under localization, and start the daemon anew"
        source = Source(str(config), element="localization.mode_channel")
        raise ConfigError([Problem(Severity.ERROR, why, source, fix)])
    channel = f"{vehicle.lcm.channel_prefix}{vehicle.localization.mode_channel}"
    bus = open_lcm(resolve_url(url or vehicle.lcm.url))
    utime = time.time_ns() // 1000
    bus.publish(channel, encode(SwitchMode(SensorHeader(utime, "operator", host_utime=utime), wanted)))
    typer.echo(f"told {channel}: {wanted.name.lower()}")


def parse_mode(text: str) -> Mode:
    """Return the mode of that name. Raises typer.BadParameter, a usage error, with the nearest for another name."""
    name = text.strip().replace("-", "_").upper()
    if name in Mode.__members__:
        return Mode[name]
    near = nearest_names(name, MODES)
    hint = f"did you mean {near[0]}?" if near else f"there are: {', '.join(MODES)}"
    raise typer.BadParameter(f"{shown(text, 40)} is no mode; {hint}", param_hint="MODE")
