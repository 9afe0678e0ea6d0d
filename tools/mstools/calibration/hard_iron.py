"""`modelserver driver NAME --hard-iron`: the procedure by which an inertial unit finds the vehicle's own field."""

from __future__ import annotations

import signal
from typing import TYPE_CHECKING, Any

import typer

from modelserver.errors import ModelServerError
from mstools.terminal.output import safe

if TYPE_CHECKING:
    from msdrivers.links import Link
    from msdrivers.settings import DriverSettings


def run_hard_iron(settings: DriverSettings, link: Link[Any], seconds: float, all_axes: bool) -> None:
    """Do the procedure on a driver's line and print its result; how it goes is on stderr.

    Raises ModelServerError where the device does not hold new offsets afterwards.
    """
    from msdrivers.devices.gx1 import HardIron, HardIronSettings
    from msdrivers.runner import Runner, RunnerSettings, SystemTime

    how = HardIronSettings(duration=seconds, two_dimensional=not all_axes, bauds=settings.station.bauds)
    station = HardIron(how)
    runner = Runner(station, link, RunnerSettings(settings.name, settings.kind.name), SystemTime())
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: runner.stop())
    runner.run(lambda: runner.stop() if station.result is not None else None)
    result = station.result
    if result is None:
        raise ModelServerError("hard iron: interrupted; the offsets are as they were before")
    if not result.stored:
        raise ModelServerError(result.text)
    for what, value in (("offsets", result.offsets), ("spans", result.spans)):
        if value is not None:
            typer.echo(f"{what:<8} " + " ".join(f"{axis * 1e6:8.2f}" for axis in value) + "  uT along x, y, z")
    typer.echo(safe(result.text))
