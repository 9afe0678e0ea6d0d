"""`modelserver driver NAME --hard-iron`: hard-iron calibration by the IMU itself."""

from __future__ import annotations

import signal
from typing import TYPE_CHECKING, Any

import typer

from modelserver.errors import ModelServerError
from mstools.terminal.output import escape

if TYPE_CHECKING:
    from msdrivers.links import Link
    from msdrivers.settings import DriverSettings


def run_hard_iron(settings: DriverSettings, link: Link[Any], seconds: float, all_axes: bool) -> None:
    """Run the procedure on a driver's connection and print its result; progress goes to stderr.

    Raises ModelServerError where the device has not stored new offsets afterwards.
    """
    from msdrivers.devices.gx1.hard_iron import HardIronProcedure, HardIronSettings
    from msdrivers.runner import Runner, RunnerSettings, SystemTimeSource

    hard_iron = HardIronSettings(duration=seconds, two_dimensional=not all_axes, bauds=settings.device_settings.bauds)
    station = HardIronProcedure(hard_iron)
    runner = Runner(station, link, RunnerSettings(settings.name, settings.kind.name), SystemTimeSource())
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: runner.stop())
    runner.run(lambda: runner.stop() if station.result is not None else None)
    result = station.result
    if result is None:
        raise ModelServerError("hard iron: interrupted; the offsets are unchanged")
    if not result.is_stored:
        raise ModelServerError(result.text)
    for what, value in (("offsets", result.offsets), ("spans", result.spans)):
        if value is not None:
            typer.echo(f"{what:<8} " + " ".join(f"{axis * 1e6:8.2f}" for axis in value) + "  uT along x, y, z")
    typer.echo(escape(result.text))
