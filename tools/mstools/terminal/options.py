"""Options that several commands share, and the names that the shell completes for them.

Names are the frames, bodies, channels and drivers of the vehicle at hand: the file of `--config` or `--model` among the
words typed, else vehicle.yaml in this folder. A file that cannot be read completes nothing: a shell shows no error
while a line is typed.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias, TypeVar

import typer

from modelserver.errors import ModelServerError, find_nearest_names, quote

if TYPE_CHECKING:
    from modelserver.config.vehicle_file import VehicleConfig
    from modelserver.geometry import Model

T = TypeVar("T")


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

    given = ctx.params.get("config") or "vehicle.yaml"
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


# --- options


def option(declaration: str, about: str, **more: Any) -> Any:
    """Declare an option as its usage has it, e.g. `--config -c FILE`; `more`: typer's min, max, autocompletion."""
    words = declaration.split()
    names = [word for word in words if word.startswith("-")]
    return typer.Option(*names, metavar=" ".join(words[len(names) :]) or None, help=about, **more)


def argument(metavar: str, about: str, **more: Any) -> Any:
    """Declare an argument as its usage shows it; `more`: typer's `autocompletion`."""
    return typer.Argument(metavar=metavar, help=about, **more)


def list_given(ctx: typer.Context, names: Iterable[str] = ()) -> dict[str, str]:
    """Return the parameters on the command line, all or those of some names, each with its option."""
    sources = {each.name or "": (each, ctx.get_parameter_source(each.name or "")) for each in ctx.command.params}
    return {
        name: each.opts[0]
        for name, (each, source) in sources.items()
        if source is not None and source.name == "COMMANDLINE" and (not names or name in names)
    }


Variables: TypeAlias = Annotated[
    list[str] | None,
    option(
        "--set NAME=VALUE",
        "Value of $NAME in a Miro frame tree, e.g. MRN=K11; overrides the environment. May be repeated.",
    ),
]
"""Annotation of a parameter whose value goes to `parse_variables`."""

ModelOption = Annotated[Path | None, option("--model FILE", "Query this geometry file instead of the daemon.")]
UrlOption = Annotated[str, option("--url URL", "LCM provider. Default: $LCM_DEFAULT_URL, else loopback.")]
PrefixOption = Annotated[str, option("--prefix TEXT", "Channel prefix of the vehicle.")]
KeyOption = Annotated[
    Path | None, option("--key FILE", "The vehicle's key file, to sign with. Default: $MODELSERVER_KEY_FILE.")
]
TimeoutOption = Annotated[float, option("--timeout SECONDS", "Timeout of one try.", min=0.01, max=3600.0)]
ChannelsOption = Annotated[
    list[str] | None,
    option("--channel NAME", "Only this channel; may be repeated.", autocompletion=complete_channel),
]
SchedulerOption = Annotated[
    str, option("--scheduler ADDRESS", "Of a Dask cluster (tcp://HOST:PORT). Default: this machine.")
]
JsonOption = Annotated[bool, option("--json", "Print JSON, for scripts.")]


def choose_name(text: str, known: Collection[str], what: str, option: str) -> str:
    """Return a known name. Raises typer.BadParameter, a usage error of `option`, with the nearest one for another."""
    if text in known:
        return text
    near = find_nearest_names(text, known)
    hint = f"did you mean {near[0]}?" if near else f"{what}s: {', '.join(known)}"
    raise typer.BadParameter(f"{quote(text, 40)} is an unknown {what}; {hint}", param_hint=option)


def parse_pairs(
    given: Iterable[str] | None, form: str, hint: str, parse: Callable[[str], T], pattern: str = "([^=]+)=(.+)"
) -> dict[str, T]:
    """Return the values of an option of a `form` like NAME=KG by name.

    Raises typer.BadParameter, a usage error of the option `hint`, where the pattern does not match, or `parse` raises
    ValueError.
    """
    found = {}
    for text in given or ():
        match = re.fullmatch(pattern, text, re.ASCII | re.DOTALL)
        try:
            if match is None:
                raise ValueError
            found[match[1]] = parse(match[2])
        except ValueError:
            raise typer.BadParameter(f"{quote(text)} is not {form}", param_hint=hint) from None
    return found


def parse_variables(given: Iterable[str] | None) -> dict[str, str]:
    """Return the variables of `--set`. Raises typer.BadParameter, a usage error, for a malformed one."""
    return parse_pairs(given, "NAME=VALUE", "--set", str, r"(\w+)=(.*)")
