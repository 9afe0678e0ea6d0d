"""`modelserver calibrate`: an IMU's noise (Allan deviation) and its magnetometer (hard and soft iron) from a log."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from modelserver.errors import ModelServerError
from modelserver.estimation.filter.settings import FilterSettings
from modelserver.estimation.sensor_rig import MagnetometerCalibration
from modelserver.transforms import so3
from modelserver.transforms.so3 import Array, Vector3
from mstools.calibration import (
    CalibrationError,
    ImuRecording,
    SampleRange,
    find_stationary_ranges,
    finite_rows,
    read_recording,
)
from mstools.calibration.allan import allan_deviation, fit_noise_parameters
from mstools.calibration.ellipsoid import MagnetometerFit, fit_level
from mstools.calibration.mount import MountCheck, check_mount, name_axis
from mstools.calibration.reports import (
    QUANTITIES,
    AxisNoise,
    ImuNoise,
    PresentNoise,
    format_magnetometer,
    format_magnetometer_yaml,
    format_noise,
    format_noise_yaml,
    render_magnetometer_page,
    render_noise_page,
)
from mstools.report import charts
from mstools.terminal.options import argument, option
from mstools.terminal.output import check_outputs, escape, format_count, require_extra, write_file

MIN_STATIONARY_S = 60.0
"""Shortest stationary range with a proposal, seconds: noise at 1 s averaging is then known to 10 %."""

LogArgument = Annotated[Path, argument("LOG", "LCM event log.")]
ChannelOption = Annotated[str, option("--channel NAME", "The unit's channel.")]
FromOption = Annotated[float, option("--from S", "Start here, seconds into the log.")]
ToOption = Annotated[float, option("--to S", "End here: seconds into the log.")]
ConfigOption = Annotated[Path | None, option("--config -c FILE", "The vehicle file, to compare its values and mount.")]
PlotOption = Annotated[str, option("--plot HTML", "Write a report for a browser to this file.")]
OutOption = Annotated[str, option("-o --output YAML", "Write the proposal here, - for standard output.")]
ForceOption = Annotated[bool, option("--force", "Replace files that exist.")]

command = typer.Typer(
    help="""Calibrate an IMU from a recording; docs/calibration.md explains how to record.

    \b
    Examples:
      modelserver calibrate imu stationary.lcm --plot allan.html -o imu.yaml
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
    config: ConfigOption = None,
    plot: PlotOption = "",
    output: OutOption = "",
    force: ForceOption = False,
) -> None:
    """Estimate the noise of gyros and accelerometers from the Allan deviation of the longest stationary range.

    The resulting filter settings are proposed, nothing is changed. The noisiest of the three axes counts. With less
    than a minute stationary the known figures are printed, nothing is proposed, and the exit code is 1. A drive without
    a stop still shows which axis of the IMU points up, and with -c whether the mount agrees.

    Example: modelserver calibrate imu stationary.lcm --plot allan.html -o imu.yaml
    """
    _check_options(begin, end, log, plot, output, force)
    recorded = read_recording(log, channel, begin, end)
    good = finite_rows(recorded.rates, recorded.forces)
    if not good.any():
        why = "none with angular velocity and specific force: it is no IMU's channel, or its driver publishes neither"
        raise _make_error(log, f"{format_count(good.size, 'sample')} on {channel}, {why}")
    columns = ("utimes", "times", "rates", "forces", "fields")
    valid = replace(recorded, **{name: getattr(recorded, name)[good] for name in columns})
    stretches = find_stationary_ranges(valid.utimes, valid.rates, valid.forces)
    if not stretches:
        _print_up_axis(config, valid, output == "-")
        span, fix = valid.times[-1] - valid.times[0], "with the engine off, for 10 minutes or more"
        raise _make_error(log, f"the vehicle is never stationary in {span:.1f} s; record it stationary, {fix}")
    used = max(stretches, key=lambda each: each.seconds)
    noise = _compute_noise(valid, used, good.size)
    mount = None if config is None else _check_mount(config, valid.forces[used.start : used.stop])
    typer.echo("\n".join(format_noise(escape(str(log)), noise, mount)), err=output == "-")
    _print_damage(log, recorded)
    problem = _find_problem(noise)
    if plot:
        page = render_noise_page(str(log), noise, _read_present_noise(config), mount, problem)
        write_file(plot, page, replace=force)
    if problem:
        raise _make_error(log, problem)
    write_file(output, format_noise_yaml(str(log), noise), replace=force)


@command.command("magnetometer")
def magnetometer(
    log: LogArgument,
    channel: ChannelOption = "IMU",
    place: Annotated[str, option("--place LAT,LON", "The location in degrees, for a log without fixes.")] = "",
    begin: FromOption = 0.0,
    end: ToOption = math.inf,
    config: ConfigOption = None,
    plot: PlotOption = "",
    output: OutOption = "",
    force: ForceOption = False,
) -> None:
    """Estimate the hard and soft iron of the vehicle from samples of full circles.

    The strength of the earth's field is that of the World Magnetic Model at the location, from fixes in the log or
    from --place; without one it stays open, and the filter cannot detect a disturbed field by its strength. The
    resulting settings are proposed, nothing is changed.

    \b
    Example:
      modelserver calibrate magnetometer turned.lcm --plot circle.html -o magnetometer.yaml
    """
    _check_options(begin, end, log, plot, output, force)
    given = _parse_place(place)
    recorded = read_recording(log, channel, begin, end)
    good = finite_rows(recorded.fields)
    if not good.any():
        why = "none with a magnetic field: it has no magnetometer, or its driver does not publish it"
        raise _make_error(log, f"{format_count(good.size, 'sample')} on {channel}, {why}")
    where = given or recorded.position
    field = None if where is None else _get_field(where, int(np.median(recorded.utimes)))
    found = _fit(log, recorded, recorded.fields[good], field)
    lines = format_magnetometer(escape(str(log)), found, where, field)
    typer.echo("\n".join(lines), err=output == "-")
    _print_damage(log, recorded)
    if plot:
        present, name = _read_present_correction(config)
        page = render_magnetometer_page(str(log), lines, found, recorded.fields[good], present, name)
        write_file(plot, page, replace=force)
    write_file(output, format_magnetometer_yaml(str(log), found), replace=force)


def _read_present_correction(config: Path | None) -> tuple[MagnetometerCalibration, str]:
    """Return the correction of a vehicle file with its name, the default without a file."""
    if config is None:
        return MagnetometerCalibration(), DEFAULT
    from modelserver.config.vehicle_file import load_config

    return load_config(config).localization.magnetometer, config.name


def _compute_noise(recorded: ImuRecording, used: SampleRange, samples: int) -> ImuNoise:
    def compute_axes(values: Array) -> tuple[AxisNoise, ...]:
        curves = [allan_deviation(axis, used.rate_hz) for axis in values[used.start : used.stop].T]
        return tuple(AxisNoise(curve, fit_noise_parameters(curve)) for curve in curves)

    dropped = samples - len(recorded.utimes)
    begin, end = (float(recorded.times[n]) for n in (used.start, used.stop - 1))
    axes = (compute_axes(recorded.rates), compute_axes(recorded.forces))
    return ImuNoise(samples, dropped, begin, end, used.seconds, used.rate_hz, *axes)


def _find_problem(noise: ImuNoise) -> str:
    """Return why nothing is proposed; empty where something is."""
    if noise.seconds < MIN_STATIONARY_S:
        needed = f"{MIN_STATIONARY_S:.0f} s are needed for a proposal, 10 minutes for the bias random walk"
        return f"the longest stationary range is {noise.seconds:.1f} s; {needed}: record longer"
    if not any(each.setting and each.propose(noise) for each in QUANTITIES):
        why = "the samples are frozen, or other errors exceed the noise; see --plot"
        return f"no figure follows from {noise.seconds:.0f} s: {why}"
    return ""


DEFAULT = "default"
"""Name of the present values where no vehicle file is given."""


def _read_present_noise(config: Path | None) -> PresentNoise:
    if config is None:
        return PresentNoise(FilterSettings(), DEFAULT)
    from modelserver.config.vehicle_file import load_config

    return PresentNoise(load_config(config).localization.filter, config.name)


def _check_mount(config: Path, forces: Any) -> MountCheck:
    # imported here: without --config no configuration libraries and no geodesy are needed
    from modelserver.config.vehicle_file import load_config
    from modelserver.server.vehicle import load_vehicle

    vehicle = load_vehicle(load_config(config), str(config))
    if vehicle.rig is None or not vehicle.rig.imu_frame:
        raise ModelServerError(f"{escape(str(config))}: no IMU under sensors, so there is no mount to compare")
    return check_mount(so3.to_vector3(forces.mean(axis=0)), vehicle.rig.pose(vehicle.rig.imu_frame).wxyz)


def _print_up_axis(config: Path | None, recorded: ImuRecording, on_stderr: bool) -> None:
    """Print which axis of the IMU points up, from the mean specific force of a drive, whose accelerations cancel."""
    force = so3.to_vector3(recorded.forces.mean(axis=0))
    strength, along = math.hypot(*force), max(map(abs, force))
    angle = math.degrees(math.acos(min(along / strength, 1.0))) if strength > 0.0 else math.nan
    direction = f"{angle:.0f} degrees from the IMU's {name_axis(force)} axis, which points up"
    lines = [f"mean specific force of the drive: {strength:.2f} m/s2, {direction}"]
    if config is not None:
        try:
            lines.append(f"mount: {_check_mount(config, recorded.forces).text}")
        except CalibrationError as error:
            lines.append(f"mount: {error}")
    typer.echo("\n".join(lines), err=on_stderr)


def _fit(log: Path, recorded: ImuRecording, fields: Any, field: Vector3 | None) -> MagnetometerFit:
    horizontal = math.nan if field is None else math.hypot(field[0], field[1])
    try:
        forces = recorded.forces[finite_rows(recorded.forces)]
        if not len(forces):
            raise CalibrationError("the IMU has no specific force, so up is unknown")
        # the median is robust against bumps, and hardly tilted in a slow turn
        up = so3.to_vector3(np.median(forces, axis=0))
        return fit_level(fields, up, horizontal, math.nan if field is None else field[2])
    except CalibrationError as error:
        raise _make_error(log, str(error)) from None


def _get_field(place: Vector3, utime: int) -> Vector3 | None:
    from modelserver.earth import magnetism

    if not magnetism.is_covered(utime):
        why = "the samples' stamps are outside the World Magnetic Model's years; the strength stays open"
        typer.echo(f"modelserver: {why}", err=True)
        return None
    return magnetism.field_at(*place, utime)


def _parse_place(text: str) -> Vector3 | None:
    if not text:
        return None
    try:
        latitude, longitude = (float(each) for each in text.split(","))
    except ValueError:
        latitude = longitude = math.nan
    if not (abs(latitude) <= 90.0 and abs(longitude) <= 360.0):
        raise typer.BadParameter(
            f"a location is latitude,longitude in degrees, e.g. 42.36,-71.06, got {escape(text[:40])}",
            param_hint="--place",
        )
    return (latitude, longitude, 0.0)


def _check_options(begin: float, end: float, log: Path, plot: str, output: str, force: bool) -> None:
    if not (math.isfinite(begin) and begin >= 0.0 and end > begin):
        raise typer.BadParameter(f"--from {begin:g} --to {end:g} is no range; expected 0 <= from < to, seconds")
    check_outputs((log,), plot, output, force)
    if plot:
        require_extra("report", charts.NEEDS_PLOTLY)


def _print_damage(log: Path, recorded: ImuRecording) -> None:
    lost = format_count(recorded.malformed, "message") + " of the channel left out" if recorded.malformed else ""
    for each in filter(None, (lost, *recorded.damage[:5])):
        typer.echo(f"modelserver: {escape(str(log))}: {each}", err=True)


def _make_error(log: Path, why: str) -> CalibrationError:
    return CalibrationError(f"{escape(str(log))}: {why}")
