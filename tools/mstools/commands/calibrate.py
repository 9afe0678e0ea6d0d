"""`modelserver calibrate`: what a recording tells of the noise of an inertial unit and of the iron around it."""

from __future__ import annotations

import dataclasses
import json
import math
import os
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from modelserver.errors import ModelServerError
from modelserver.localization.calibration import mount
from modelserver.localization.calibration.allan import NoiseFigures, allan_deviation, noise_figures
from modelserver.localization.calibration.ellipsoid import MagnetometerFit, fit_all_axes, fit_level
from modelserver.localization.calibration.errors import CalibrationError
from modelserver.localization.calibration.even import Stretch
from modelserver.localization.calibration.standing import standing
from modelserver.spatial.so3 import Vector3
from mstools.calibration import log as calibrate_log
from mstools.calibration import report as calibrate_report
from mstools.calibration.log import Recorded
from mstools.calibration.report import AxisNoise, ImuNoise
from mstools.terminal.output import check_target, counted, safe, write_file

LEAST_STANDING = 60.0
"""Seconds of standing below which nothing is proposed: the noise at one second is then known to a tenth."""

LogArgument = Annotated[Path, typer.Argument(metavar="LOG", help="LCM event log.")]
ChannelOption = Annotated[str, typer.Option("--channel", metavar="NAME", help="The unit's channel.")]
FromOption = Annotated[float, typer.Option("--from", metavar="S", help="Begin here: seconds into the log.")]
ToOption = Annotated[float, typer.Option("--to", metavar="S", help="End here: seconds into the log.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON, for scripts.")]
PlotOption = Annotated[str, typer.Option("--plot", metavar="HTML", help="Draw it into this file, for a browser.")]
OutOption = Annotated[
    str, typer.Option("-o", "--output", metavar="YAML", help="Write the proposal here, - for standard output.")
]
ForceOption = Annotated[bool, typer.Option("--force", help="Replace files that exist.")]

command = typer.Typer(
    help="""Find the settings of an inertial unit from a recording; docs/calibration.md says how to record.

    \b
    Examples:
      modelserver calibrate imu stood.lcm --plot allan.html -o imu.yaml
      modelserver calibrate magnetometer turned.lcm --plot circle.html -o magnetometer.yaml
    """,
    no_args_is_help=True,
    rich_markup_mode=None,
)


@command.command("imu")
def imu(
    log: LogArgument,
    channel: ChannelOption = "IMU",
    begin: FromOption = 0.0,
    end: ToOption = math.inf,
    config: Annotated[
        Path | None, typer.Option("--config", "-c", metavar="FILE", help="The vehicle file: checks the unit's mount.")
    ] = None,
    as_json: JsonOption = False,
    plot: PlotOption = "",
    output: OutOption = "",
    force: ForceOption = False,
) -> None:
    """Find the noise of gyros and accelerometers: their Allan deviation, from the longest stretch of standing.

    The settings of the filter that follow are proposed, nothing is changed. Of the three axes the noisiest counts.
    With less than a minute of standing what can be told is told, nothing is proposed, and the exit code is 1. A drive
    without any standing still tells which axis of the unit points up, and with -c whether the mount agrees.

    Example: modelserver calibrate imu stood.lcm --plot allan.html -o imu.yaml
    """
    _check_paths(begin, end, log, (plot, output), force)
    if as_json and output == "-":
        raise typer.BadParameter("--json and -o - both write to standard output; name a file for the proposal")
    recorded = calibrate_log.read(log, channel, "", begin, end)
    good = calibrate_log.finite(recorded.rates, recorded.forces)
    if not good.any():
        raise CalibrationError(
            f"{safe(str(log))}: {counted(good.size, 'sample')} on {channel}, none with all of angular velocity and "
            "specific force: this is no inertial unit's channel, or its driver passes neither on"
        )
    kept = dataclasses.replace(
        recorded, **{name: getattr(recorded, name)[good] for name in ("utimes", "at", "rates", "forces", "fields")}
    )
    stretches = standing(kept.utimes, kept.rates, kept.forces)
    if not stretches:
        _tell_up(config, kept, as_json, output == "-")
        raise CalibrationError(
            f"{safe(str(log))}: the vehicle never stands still in {_span(kept)}: for the noise, record it standing, "
            "engine off, for 10 minutes or more"
        )
    used = max(stretches, key=lambda each: each.seconds)
    noise = _noise(kept, used, good.size)
    advice = None if config is None else _mount_advice(config, kept.forces[used.start : used.stop])
    if as_json:
        typer.echo(json.dumps(calibrate_report.noise_data(noise, advice), indent=2, allow_nan=False))
    else:
        typer.echo("\n".join(calibrate_report.noise_lines(safe(str(log)), noise, advice)), err=output == "-")
    _tell_damage(log, recorded)
    if plot:
        write_file(plot, calibrate_report.noise_page(str(log), noise), replace=force)
    if noise.seconds < LEAST_STANDING:
        raise CalibrationError(
            f"{safe(str(log))}: the longest standing stretch is {noise.seconds:.1f} s, {LEAST_STANDING:.0f} s are "
            "needed for a proposal, and 10 minutes for the biases' walk: record longer"
        )
    if not calibrate_report.proposal(noise):
        raise CalibrationError(
            f"{safe(str(log))}: no figure can be told from {noise.seconds:.0f} s of standing: the samples are frozen, "
            "or something other than noise covers it; --plot shows what"
        )
    _write_proposal(output, calibrate_report.noise_yaml(str(log), noise), force)


@command.command("magnetometer")
def magnetometer(
    log: LogArgument,
    channel: ChannelOption = "IMU",
    gps_channel: Annotated[
        str, typer.Option("--gps-channel", metavar="NAME", help="The receiver's channel: it tells the place.")
    ] = "GPS",
    place: Annotated[
        str, typer.Option("--place", metavar="LAT,LON", help="The place in degrees, where the log has no fixes.")
    ] = "",
    all_axes: Annotated[
        bool, typer.Option("--all-axes", help="The unit was turned about all axes, not only the vehicle in the level.")
    ] = False,
    begin: FromOption = 0.0,
    end: ToOption = math.inf,
    as_json: JsonOption = False,
    plot: PlotOption = "",
    output: OutOption = "",
    force: ForceOption = False,
) -> None:
    """Find the vehicle's own iron, hard and soft, from samples taken while it turned through full circles.

    The strength of the earth's field is the World Magnetic Model's where the place is known, from fixes in the log or
    from --place; otherwise it is left open, and the filter cannot tell a disturbed field by its strength. The settings
    that follow are proposed, nothing is changed.

    \b
    Example:
      modelserver calibrate magnetometer turned.lcm --plot circle.html -o magnetometer.yaml
    """
    _check_paths(begin, end, log, (plot, output), force)
    if as_json and output == "-":
        raise typer.BadParameter("--json and -o - both write to standard output; name a file for the proposal")
    given = _place(place)
    recorded = calibrate_log.read(log, channel, gps_channel, begin, end)
    good = calibrate_log.finite(recorded.fields)
    if not good.any():
        raise CalibrationError(
            f"{safe(str(log))}: {counted(good.size, 'sample')} on {channel}, none with a magnetic field: this unit has "
            "no magnetometer, or its driver does not pass it on"
        )
    where = given or recorded.place
    field = None if where is None else _field(where, int(np.median(recorded.utimes)))
    up = _up(recorded)
    found = _fit(log, recorded.fields[good], up, field, all_axes)
    if as_json:
        typer.echo(json.dumps(calibrate_report.magnetometer_data(found, where, field), indent=2, allow_nan=False))
    else:
        typer.echo(
            "\n".join(calibrate_report.magnetometer_lines(safe(str(log)), found, where, field)), err=output == "-"
        )
    _tell_damage(log, recorded)
    if plot:
        page = calibrate_report.magnetometer_page(str(log), found, recorded.fields[good], found.coverage.axis)
        write_file(plot, page, replace=force)
    _write_proposal(output, calibrate_report.magnetometer_yaml(str(log), found), force)


def _noise(recorded: Recorded, used: Stretch, samples: int) -> ImuNoise:
    def axis(values: Any) -> AxisNoise:
        curve = allan_deviation(values, used.rate_hz)
        return AxisNoise(curve, _of_enough(noise_figures(curve), used.seconds))

    rows = slice(used.start, used.stop)
    return ImuNoise(
        samples=samples,
        dropped=samples - len(recorded.utimes),
        begin=float(recorded.at[used.start]),
        end=float(recorded.at[used.stop - 1]),
        seconds=used.seconds,
        rate_hz=used.rate_hz,
        gyro=tuple(axis(recorded.rates[rows, n]) for n in range(3)),
        accelerometer=tuple(axis(recorded.forces[rows, n]) for n in range(3)),
    )


def _of_enough(figures: NoiseFigures, seconds: float) -> NoiseFigures:
    """Return the figures without those of the biases where the standing was too short: a minimum is then chance."""
    if seconds >= LEAST_STANDING or (figures.instability is None and figures.walk is None):
        return figures
    told = tuple(each for each in figures.missing if not each.startswith("bias"))
    why = f"biases: {seconds:.1f} s of standing tell nothing of them; stand for 10 minutes or more"
    return dataclasses.replace(figures, instability=None, walk=None, missing=(*told, why))


def _mount_advice(config: Path, forces: Any) -> mount.MountAdvice:
    # imported here: without --config neither the configuration's libraries nor geodesy are needed
    from modelserver.config import load_config
    from modelserver.service.daemon import load_vehicle

    vehicle = load_vehicle(load_config(config), str(config))
    if vehicle.rig is None or not vehicle.rig.imu_frame:
        raise ModelServerError(f"{safe(str(config))}: names no IMU under sensors, so there is no mount to compare")
    x, y, z = (float(each) for each in forces.mean(axis=0))
    return mount.advise((x, y, z), vehicle.rig.pose(vehicle.rig.imu_frame).wxyz)


def _tell_up(config: Path | None, recorded: Recorded, as_json: bool, on_stderr: bool) -> None:
    """Say which of the unit's axes points up, by the mean specific force of a drive: its accelerations cancel."""
    x, y, z = (float(each) for each in recorded.forces.mean(axis=0))
    up, angle = mount.axis_name((x, y, z)), math.nan
    strength = math.hypot(x, y, z)
    if strength > 0.0:
        angle = math.degrees(math.acos(min(max(abs(x), abs(y), abs(z)) / strength, 1.0)))
    words = [
        f"mean specific force on the move: {strength:.2f} m/s2, {angle:.0f} degrees from the unit's {up} axis, which "
        "points up"
    ]
    text = ""
    if config is not None:
        try:
            text = _mount_advice(config, recorded.forces).text
        except CalibrationError as error:
            text = str(error)
        words.append(f"mount: {text}")
    if as_json:
        typer.echo(json.dumps({"up": up, "mount": {"text": text} if text else None}, indent=2))
    else:
        typer.echo("\n".join(words), err=on_stderr)


def _fit(log: Path, fields: Any, up: Vector3 | None, field: Vector3 | None, all_axes: bool) -> MagnetometerFit:
    horizontal = math.nan if field is None else math.hypot(field[0], field[1])
    try:
        if all_axes:
            return fit_all_axes(fields, math.nan if field is None else math.hypot(*field), horizontal)
        if up is None:
            raise CalibrationError(
                "the unit gives no specific force, so up is unknown; turn it about all axes and give --all-axes"
            )
        return fit_level(fields, up, horizontal, math.nan if field is None else field[2])
    except CalibrationError as error:
        raise CalibrationError(f"{safe(str(log))}: {error}") from None


def _up(recorded: Recorded) -> Vector3 | None:
    """Return the middle specific force: a slow turn hardly tilts it, bumps do not count."""
    good = calibrate_log.finite(recorded.forces)
    if not good.any():
        return None
    x, y, z = (float(each) for each in np.median(recorded.forces[good], axis=0))
    return (x, y, z)


def _field(place: Vector3, utime: int) -> Vector3 | None:
    from modelserver.earth import magnetism

    if not magnetism.is_covered(utime):
        typer.echo(
            "modelserver: the samples' stamps lie outside the years of the World Magnetic Model: strength left open",
            err=True,
        )
        return None
    return magnetism.field_at(*place, utime)


def _place(text: str) -> Vector3 | None:
    if not text:
        return None
    try:
        latitude, longitude = (float(each) for each in text.split(","))
    except ValueError:
        latitude = longitude = math.nan
    if not (abs(latitude) <= 90.0 and abs(longitude) <= 360.0):
        raise typer.BadParameter(
            f"a place is latitude,longitude in degrees, e.g. 42.36,-71.06, got {safe(text[:40])}", param_hint="--place"
        )
    return (latitude, longitude, 0.0)


def _check_paths(begin: float, end: float, log: Path, targets: tuple[str, ...], force: bool) -> None:
    if not (math.isfinite(begin) and begin >= 0.0 and end > begin):
        raise typer.BadParameter(f"--from {begin:g} --to {end:g} is no stretch of a log: 0 <= from < to, in seconds")
    named = [each for each in targets if each and each != "-"]
    if len({os.path.realpath(each) for each in (*named, str(log))}) <= len(named):
        raise typer.BadParameter("LOG, --plot and --output must be different files")
    for target in named:
        if not force and os.path.isfile(target):
            # said before the reading, for that may take a while; the writing looks again
            raise ModelServerError(f"{safe(target)} exists already; give --force to replace it, or another name")
        check_target(target)


def _write_proposal(output: str, text: str, force: bool) -> None:
    if output == "-":
        typer.echo(text, nl=False)
    elif output:
        write_file(output, text, replace=force)


def _tell_damage(log: Path, recorded: Recorded) -> None:
    if recorded.bad:
        typer.echo(
            f"modelserver: {safe(str(log))}: {counted(recorded.bad, 'message')} of the channel left out", err=True
        )
    for each in recorded.damage[:5]:
        typer.echo(f"modelserver: {safe(str(log))}: {each}", err=True)


def _span(recorded: Recorded) -> str:
    return f"{float(recorded.at[-1] - recorded.at[0]):.1f} s"
