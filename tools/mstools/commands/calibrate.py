"""`modelserver calibrate`: an IMU's noise (Allan deviation) and its magnetometer (hard and soft iron) from a log.

The mount is checked against gravity: at rest an accelerometer measures the specific force, which points up: two of the
three angles of a mount. The angle about the vertical remains unknown; candidates are the 24 rotations of a cube onto
itself, of which 4 share an up.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from modelserver.errors import ModelServerError
from modelserver.transforms import so3
from modelserver.transforms.so3 import Array, Quaternion, Vector3
from mstools.calibration import (
    CalibrationError,
    ImuRecording,
    SampleRange,
    find_stationary_ranges,
    finite_rows,
    read_recording,
)
from mstools.calibration.allan import (
    INSTABILITY_FLOOR,
    AllanCurve,
    NoiseParameter,
    NoiseParameters,
    allan_deviation,
    fit_noise_parameters,
)
from mstools.calibration.ellipsoid import SECTORS, MagnetometerFit, fit_level, project_to_level
from mstools.report import charts
from mstools.terminal.options import argument, option
from mstools.terminal.output import check_outputs, escape, format_count, require_extra, write_file

MIN_STATIONARY_S = 60.0
"""Shortest stationary range with a proposal, seconds: noise at 1 s averaging is then known to 10 %."""

LogArgument = Annotated[Path, argument("LOG", "LCM event log.")]
ChannelOption = Annotated[str, option("--channel NAME", "The unit's channel.")]
FromOption = Annotated[float, option("--from S", "Start here, seconds into the log.")]
ToOption = Annotated[float, option("--to S", "End here: seconds into the log.")]
PlotOption = Annotated[str, option("--plot HTML", "Write a plot to this file, for a browser.")]
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
    config: Annotated[Path | None, option("--config -c FILE", "The vehicle file, to check the IMU's mount.")] = None,
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
    advice = None if config is None else _mount_advice(config, valid.forces[used.start : used.stop])
    typer.echo("\n".join(format_noise(escape(str(log)), noise, advice)), err=output == "-")
    _print_damage(log, recorded)
    if plot:
        write_file(plot, render_noise_page(str(log), noise), replace=force)
    if noise.seconds < MIN_STATIONARY_S:
        needed = f"{MIN_STATIONARY_S:.0f} s are needed for a proposal, 10 minutes for the bias random walk"
        raise _make_error(log, f"the longest stationary range is {noise.seconds:.1f} s; {needed}: record longer")
    if not any(each.setting and math.isfinite(each.propose(noise)) for each in QUANTITIES):
        why = "the samples are frozen, or other errors exceed the noise; see --plot"
        raise _make_error(log, f"no figure follows from {noise.seconds:.0f} s: {why}")
    write_file(output, format_noise_yaml(str(log), noise), replace=force)


@command.command("magnetometer")
def magnetometer(
    log: LogArgument,
    channel: ChannelOption = "IMU",
    place: Annotated[str, option("--place LAT,LON", "The location in degrees, for a log without fixes.")] = "",
    begin: FromOption = 0.0,
    end: ToOption = math.inf,
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
        page = render_magnetometer_page(str(log), lines, found, recorded.fields[good])
        write_file(plot, page, replace=force)
    write_file(output, format_magnetometer_yaml(str(log), found), replace=force)


def _compute_noise(recorded: ImuRecording, used: SampleRange, samples: int) -> ImuNoise:
    def compute_axes(values: Array) -> tuple[AxisNoise, ...]:
        curves = [allan_deviation(axis, used.rate_hz) for axis in values[used.start : used.stop].T]
        return tuple(AxisNoise(curve, fit_noise_parameters(curve)) for curve in curves)

    dropped = samples - len(recorded.utimes)
    begin, end = (float(recorded.times[n]) for n in (used.start, used.stop - 1))
    axes = (compute_axes(recorded.rates), compute_axes(recorded.forces))
    return ImuNoise(samples, dropped, begin, end, used.seconds, used.rate_hz, *axes)


def _mount_advice(config: Path, forces: Any) -> MountCheck:
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
    direction = f"{angle:.0f} degrees from the IMU's {axis_name(force)} axis, which points up"
    lines = [f"mean specific force of the drive: {strength:.2f} m/s2, {direction}"]
    if config is not None:
        try:
            lines.append(f"mount: {_mount_advice(config, recorded.forces).text}")
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


# --- mount --------------------------------------------------------------------------------------------------

MAX_TILT = 0.6
"""Largest angle between the measured up and the geometry's, rad. No vehicle starts on a slope of 35 degrees; the wrong
one of two axis-aligned mounts is wrong by 90, so the limit is also below half of that.
"""

STANDARD_GRAVITY = 9.80665
GRAVITY_TOLERANCE = 1.0
"""Largest difference of the measured strength from standard gravity, m/s2: the earth's is within 0.03 of 9.81; ten
times a 3DM-GX1's bias of 10 mg. Beyond, the unit moves, or its scale is wrong.
"""

_UP: Vector3 = (0.0, 0.0, 1.0)


@dataclass(frozen=True, slots=True)
class MountCandidate:
    """A mount that is consistent with gravity: `rpy_deg`, and the angle from the stated one in radians."""

    rpy_deg: Vector3
    rotation_angle: float


@dataclass(frozen=True, slots=True)
class MountCheck:
    """Result of the check of the stated mount against gravity.

    angle: between the measured and the stated up, radians. measured_up, stated_up: unit vectors along the sensor's
    axes. candidates: mounts that are consistent, nearest to the stated one first; empty where the stated one is.
    """

    is_consistent: bool
    angle: float
    measured_up: Vector3
    stated_up: Vector3
    candidates: tuple[MountCandidate, ...]

    @property
    def text(self) -> str:
        measured, stated = axis_name(self.measured_up), axis_name(self.stated_up)
        degrees = math.degrees(self.angle)
        if self.is_consistent:
            return (
                f"gravity is measured along the sensor's {measured} axis, {degrees:.1f} deg from up in the geometry: "
                "the mount is consistent; gravity does not determine the rotation about the vertical"
            )
        head = (
            f"gravity is measured along the sensor's {measured} axis, but up in the geometry is {stated}: "
            f"{degrees:.0f} deg apart"
        )
        if not self.candidates:
            return f"{head}; no mount along the vehicle's axes fits: the unit is tilted or the vehicle on a steep slope"
        mounts = ", ".join(f"[{', '.join(f'{angle:g}' for angle in each.rpy_deg)}]" for each in self.candidates)
        tail = "; drive straight ahead or look at the unit to find which"
        if degrees > 180.0 - math.degrees(MAX_TILT):
            tail += "; or the driver publishes gravity instead of specific force, its opposite: compare imu_t"
        return f"{head}; mounts that fit: rpy_deg {mounts}{tail}"


def check_mount(mean_force: Vector3, q_base_sensor: Quaternion) -> MountCheck:
    """Compare the specific force at rest with the stated mount.

    Candidates are the 24 rotations onto the vehicle's axes, each followed by the tilt of the stated mount relative to
    the nearest of them, where they are consistent with gravity.

    Parameters
    ----------
    mean_force : mean specific force along the sensor's axes, m/s2, on nearly level ground
    q_base_sensor : the stated rotation R_base_sensor; base: x forward, y left, z up

    Raises
    ------
    CalibrationError
        For a force whose strength is not that of gravity.
    """
    strength = math.hypot(*mean_force)
    if not abs(strength - STANDARD_GRAVITY) <= GRAVITY_TOLERANCE:
        raise CalibrationError(
            f"the mean specific force is {strength:.3g} m/s2, and gravity is 9.81: the vehicle must be stationary, "
            "and the unit publish all three axes of specific force in m/s2"
        )
    measured = so3.scale(1.0 / strength, mean_force)
    q_stated = so3.normalize(q_base_sensor)
    stated = so3.rotate(so3.conjugate(q_stated), _UP)
    angle = _angle(measured, stated)
    is_consistent = angle <= MAX_TILT
    candidates = () if is_consistent else _find_candidates(measured, q_stated)
    return MountCheck(is_consistent, angle, measured, stated, candidates)


def aligned_rotations() -> tuple[Quaternion, ...]:
    """Return the 24 rotations of a cube onto itself."""
    found = []
    for first, second in itertools.permutations(range(3), 2):
        for a, b in itertools.product((1.0, -1.0), repeat=2):
            x, y = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
            x[first], y[second] = a, b
            z = (x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0])
            found.append(so3.from_rows(((x[0], x[1], x[2]), (y[0], y[1], y[2]), z)))
    return tuple(found)


def axis_name(direction: Vector3) -> str:
    index = max(range(3), key=lambda each: abs(direction[each]))
    return f"{'+' if direction[index] >= 0 else '-'}{'xyz'[index]}"


def _find_candidates(measured: Vector3, q_stated: Quaternion) -> tuple[MountCandidate, ...]:
    rotations = aligned_rotations()
    nearest = min(rotations, key=lambda each: _rotation_angle(each, q_stated))
    # the tilt of the bracket stays when the unit is rotated in it
    tilt = so3.multiply(q_stated, so3.conjugate(nearest))
    found = []
    for each in rotations:
        q = so3.normalize(so3.multiply(tilt, each))
        if _angle(so3.rotate(q, measured), _UP) <= MAX_TILT:
            rpy_deg = so3.to_vector3(round(math.degrees(angle), 2) + 0.0 for angle in so3.to_rpy(q))
            found.append(MountCandidate(rpy_deg, _rotation_angle(q, q_stated)))
    # rounded, for a fixed order of mounts equally near
    return tuple(
        sorted(found, key=lambda each: (round(each.rotation_angle, 9), [abs(angle) for angle in each.rpy_deg]))
    )


def _rotation_angle(a: Quaternion, b: Quaternion) -> float:
    return math.hypot(*so3.logarithm(so3.normalize(so3.multiply(so3.conjugate(a), b))))


def _angle(a: Vector3, b: Vector3) -> float:
    return math.atan2(math.hypot(*so3.cross(a, b)), sum(x * y for x, y in zip(a, b, strict=True)))


# --- reports ------------------------------------------------------------------------------------------------

MAX_POINTS = 1500
"""Most points of a cloud that are drawn."""


@dataclass(frozen=True, slots=True)
class AxisNoise:
    """Allan deviation of one axis and the noise figures from it."""

    curve: AllanCurve
    figures: NoiseParameters


@dataclass(frozen=True, slots=True)
class ImuNoise:
    """Noise of a stationary IMU. begin, end: seconds into the log of the interval used, `seconds` long.

    samples: read; dropped: of them not finite. gyro, accelerometer: axes x, y, z.
    """

    samples: int
    dropped: int
    begin: float
    end: float
    seconds: float
    rate_hz: float
    gyro: tuple[AxisNoise, ...]
    accelerometer: tuple[AxisNoise, ...]


@dataclass(frozen=True, slots=True)
class _Quantity:
    """A noise figure: its setting (empty for none), name, unit, and the fields of `ImuNoise` and `NoiseParameters`."""

    setting: str
    name: str
    unit: str
    sensor: str
    figure: str

    def axes(self, noise: ImuNoise) -> tuple[AxisNoise, ...]:
        return getattr(noise, self.sensor)  # type: ignore[no-any-return]

    def of(self, figures: NoiseParameters) -> NoiseParameter | None:
        return getattr(figures, self.figure)  # type: ignore[no-any-return]

    def propose(self, noise: ImuNoise) -> float:
        """Return the value of the noisiest axis, NaN where no axis has one."""
        found = [each for axis in self.axes(noise) if (each := self.of(axis.figures)) is not None]
        return max((each.value for each in found), default=math.nan)


QUANTITIES = (
    _Quantity("gyro_noise", "angle random walk", "rad/s/sqrt(Hz)", "gyro", "white"),
    _Quantity("", "gyro bias instability", "rad/s", "gyro", "instability"),
    _Quantity("gyro_bias_walk", "gyro bias random walk", "rad/s/sqrt(s)", "gyro", "random_walk"),
    _Quantity("accelerometer_noise", "velocity random walk", "m/s^2/sqrt(Hz)", "accelerometer", "white"),
    _Quantity("", "accelerometer bias instability", "m/s^2", "accelerometer", "instability"),
    _Quantity(
        "accelerometer_bias_walk", "accelerometer bias random walk", "m/s^2/sqrt(s)", "accelerometer", "random_walk"
    ),
)


VIBRATION_NOTE = "of the stationary unit, without the vibration of engine and road"


def format_noise(log: str, noise: ImuNoise, advice: MountCheck | None) -> list[str]:
    lines = [
        f"{log}: {format_count(noise.samples, 'sample')}, {noise.rate_hz:.1f} Hz; stationary, used: {noise.begin:.1f} "
        f"to {noise.end:.1f} s of the log ({noise.seconds:.1f} s)"
    ]
    if noise.dropped:
        lines.append(f"  {format_count(noise.dropped, 'sample')} without rates or forces dropped")
    for quantity in QUANTITIES:
        value = quantity.propose(noise)
        words = f"{value:.3g} {quantity.unit}" if math.isfinite(value) else "not determined"
        lines.append(f"{quantity.name}: {words}")
        for axis, measured in zip("xyz", quantity.axes(noise), strict=True):
            words = "not determined"
            if (figure := quantity.of(measured.figures)) is not None:
                where = f"at {figure.tau:.3g} s, {format_count(round(figure.clusters), 'cluster')}"
                words = f"{figure.value:.3g} +- {figure.sigma / figure.value:.1%} ({where})"
            lines.append(f"  {axis}: {words}")
    for name, axes in (("gyro", noise.gyro), ("accelerometer", noise.accelerometer)):
        missing: dict[str, str] = {}
        for axis, found in zip("xyz", axes, strict=True):
            for each in found.figures.missing:
                missing[each] = missing.get(each, "") + axis
        lines += [f"{name}{'' if of == 'xyz' else f' {of}'}: {each}" for each, of in missing.items()]
    lines.append(f"Proposed: the noisiest axis. accelerometer_noise is that {VIBRATION_NOTE}.")
    if advice is not None:
        lines.append(f"mount: {advice.text}")
    return lines


def format_noise_yaml(log: str, noise: ImuNoise) -> str:
    """Return the proposed settings as part of a vehicle file; undetermined ones are comments."""
    lines = []
    for each in QUANTITIES:
        value = each.propose(noise)
        if not each.setting:
            continue
        if math.isfinite(value):
            more = f"; {VIBRATION_NOTE}" if each.setting == "accelerometer_noise" else ""
            lines.append(f"    {each.setting}: {value:.3e}   # {each.unit}, {each.name}{more}")
        else:
            lines.append(f"    # {each.setting}: not determined from this record")
    return _format_proposal(log, f"{noise.seconds:.0f} s stationary", "filter", lines)


def render_noise_page(log: str, noise: ImuNoise) -> str:
    drawn = [
        _render_allan_chart("Gyro", "rad/s", noise.gyro, QUANTITIES[0].propose(noise)),
        _render_allan_chart("Accelerometer", "m/s²", noise.accelerometer, QUANTITIES[3].propose(noise)),
    ]
    return charts.render_text_page(f"Allan deviation: {escape(log)}", format_noise(escape(log), noise, None), drawn)


def _render_allan_chart(name: str, unit: str, axes: Sequence[AxisNoise], white: float) -> str:
    taus = axes[0].curve.taus
    x = charts.decade_axis("averaging time τ, s", taus)
    lines = [
        charts.Series(axis, each.curve.taus, each.curve.deviations, color)
        for axis, each, color in zip("xyz", axes, charts.PALETTE, strict=False)
    ]
    y = charts.decade_axis(f"Allan deviation, {unit}", [value for line in lines for value in line.y])
    if math.isfinite(white):
        ends = (taus[0], taus[-1])
        values = [white / math.sqrt(tau) for tau in ends]
        lines.append(charts.Series("noise / √τ", ends, values, charts.GRAY, shape="dashes"))
    floors = [each.figures.instability.value for each in axes if each.figures.instability is not None]
    if floors:
        lines.append(charts.level("0.664 B", x, max(floors) * INSTABILITY_FLOOR, charts.PINK))
    return charts.render_panels(name, x, [charts.Panel(name, y, lines, 360.0)])


def format_magnetometer(log: str, found: MagnetometerFit, position: Vector3 | None, field: Vector3 | None) -> list[str]:
    seen = sum(found.sectors)
    lines = [
        f"{log}: {format_count(found.samples, 'sample')}, {seen} of {SECTORS} sectors of 30 degrees seen, "
        f"{format_count(found.outliers, 'outlier')} dropped"
    ]
    if position is not None and field is not None:
        declination = math.degrees(math.atan2(field[0], field[1]))
        lines.append(
            f"field at {position[0]:.4f}, {position[1]:.4f}: {math.hypot(*field) * 1e6:.2f} uT, horizontal "
            f"{math.hypot(field[0], field[1]) * 1e6:.2f} uT, declination {declination:+.2f} deg (World Magnetic Model)"
        )
    else:
        why = "position unknown" if position is None else "no model of the field for that time"
        lines.append(
            f"{why}: the horizontal field is set to the measured mean, "
            f"{found.strength * 1e6:.2f} uT" + ("; give it with --place LAT,LON" if position is None else "")
        )
    matrix = found.soft_iron
    lines += [
        f"hard iron, uT: {_format_numbers([each * 1e6 for each in found.hard_iron], 3)}",
        "soft iron: " + "; ".join(_format_numbers(matrix[row : row + 3], 4) for row in (0, 3, 6)),
        f"residual: {found.rms * 1e6:.3f} uT rms, {math.degrees(found.heading_rms):.2f} deg of heading",
    ]
    if field is None:
        lines.append("Vertical hard iron is not determined without the field at the position: set to 0.")
    return [*lines, "Determined on level ground only: slopes turn part of the vertical field into the horizontal."]


def format_magnetometer_yaml(log: str, found: MagnetometerFit) -> str:
    """Return the proposed settings as part of a vehicle file."""
    hard = ", ".join(f"{each:.4e}" for each in found.hard_iron)
    soft = ", ".join(f"{each:.6f}" for each in found.soft_iron)
    residual = f"residual {found.rms * 1e6:.3f} uT rms"
    lines = [
        f"    hard_iron: [{hard}]   # tesla, along the unit's axes",
        f"    soft_iron: [{soft}]   # 3 x 3, row-major",
    ]
    return _format_proposal(log, f"rotated on level ground, {residual}", "magnetometer", lines)


def render_magnetometer_page(log: str, lines: Sequence[str], found: MagnetometerFit, fields: Array) -> str:
    """Return an HTML page: `lines` of text, and the field in the horizontal plane before and after calibration."""
    chosen = fields[:: -(-len(fields) // MAX_POINTS)]
    before = project_to_level(chosen, found.up) * 1e6
    after = project_to_level(found.apply(chosen), found.up) * 1e6
    circle = found.strength * 1e6 * np.exp(1j * np.linspace(0.0, 2.0 * np.pi, 121))
    drawn = [
        charts.dots("measured", before.tolist(), charts.ORANGE, 3.0),
        charts.dots("calibrated", after.tolist(), charts.BLUE, 3.0),
        charts.Series(
            "earth's field" if found.is_strength_known else "mean radius",
            circle.real.tolist(),
            circle.imag.tolist(),
            charts.GRAY,
        ),
    ]
    axes = ("along in the horizontal plane, µT", "across in the horizontal plane, µT")
    chart = charts.render_map("Field during rotation", *axes, drawn, heights=(600, 600))
    return charts.render_text_page(f"Magnetometer: {escape(log)}", lines, [chart])


def _format_proposal(log: str, how: str, section: str, lines: Sequence[str]) -> str:
    head = (
        f"# Proposed by modelserver calibrate from {escape(log)}: {how}.",
        "# Merge these lines into the vehicle file; nothing was changed.",
        "localization:",
        f"  {section}:",
    )
    return "\n".join([*head, *lines, ""])


def _format_numbers(values: Sequence[float], digits: int) -> str:
    return "[" + ", ".join(f"{each:.{digits}f}" for each in values) + "]"
