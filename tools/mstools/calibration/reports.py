"""Texts, proposals and pages of a calibration: what was found beside what is set, what to do, and the residuals.

A change is significant beyond `SIGNIFICANT` standard deviations of the measured value. The residuals of a noise model
are the measured Allan deviation over that of the filter's settings, sqrt(N^2 / tau + K^2 tau / 3) (allan.py); those of
a magnetometer are the strength of the corrected horizontal field minus the earth's, and the angle between the field
corrected as now and as proposed, by which heading is wrong now.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from modelserver.estimation.filter.settings import FilterSettings
from modelserver.estimation.sensor_rig import MagnetometerCalibration
from modelserver.transforms.so3 import Array, Vector3
from mstools.calibration.allan import INSTABILITY_FLOOR, AllanCurve, NoiseParameter, NoiseParameters
from mstools.calibration.ellipsoid import SECTORS, MagnetometerFit, project_to_level
from mstools.calibration.mount import MountCheck
from mstools.report import charts
from mstools.report.charts import Answer, Axis, Panel, Series
from mstools.terminal.output import escape, format_count

MAX_POINTS = 1500
"""Most points of a cloud that are drawn."""

SIGNIFICANT = 3.0
"""Standard deviations beyond which a change is significant: 0.3 % of the changes by chance are."""

FIELD_SIGMA = 0.14e-6
"""Standard deviation of a component of the World Magnetic Model, tesla (its error model, see magnetism.py): a common
factor of the soft iron is known no better.
"""

ABOUT = "docs/calibration.md explains each figure"

# --- noise of an IMU ----------------------------------------------------------------------------------------


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
class NoiseQuantity:
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

    def propose(self, noise: ImuNoise) -> NoiseParameter | None:
        """Return the figure of the noisiest axis, None where no axis has one."""
        found = [each for axis in self.axes(noise) if (each := self.of(axis.figures)) is not None]
        return max(found, key=lambda each: each.value, default=None)

    def explain_missing(self, noise: ImuNoise) -> str:
        """Return why the figure is not determined, and what to do; empty where no reason is known."""
        texts = [each for axis in self.axes(noise) for each in axis.figures.missing]
        begin = {"white": "white noise: ", "random_walk": "bias random walk: "}[self.figure]
        own = [each.removeprefix(begin) for each in texts if each.startswith(begin)]
        return next(iter((*own, *texts)), "")


QUANTITIES = (
    NoiseQuantity("gyro_noise", "angle random walk", "rad/s/sqrt(Hz)", "gyro", "white"),
    NoiseQuantity("", "gyro bias instability", "rad/s", "gyro", "instability"),
    NoiseQuantity("gyro_bias_walk", "gyro bias random walk", "rad/s/sqrt(s)", "gyro", "random_walk"),
    NoiseQuantity("accelerometer_noise", "velocity random walk", "m/s^2/sqrt(Hz)", "accelerometer", "white"),
    NoiseQuantity("", "accelerometer bias instability", "m/s^2", "accelerometer", "instability"),
    NoiseQuantity(
        "accelerometer_bias_walk", "accelerometer bias random walk", "m/s^2/sqrt(s)", "accelerometer", "random_walk"
    ),
)


VIBRATION_NOTE = "of the stationary unit, without the vibration of engine and road"


def format_noise(log: str, noise: ImuNoise, mount: MountCheck | None) -> list[str]:
    lines = [
        f"{log}: {format_count(noise.samples, 'sample')}, {noise.rate_hz:.1f} Hz; stationary, used: {noise.begin:.1f} "
        f"to {noise.end:.1f} s of the log ({noise.seconds:.1f} s)"
    ]
    if noise.dropped:
        lines.append(f"  {format_count(noise.dropped, 'sample')} without rates or forces dropped")
    for quantity in QUANTITIES:
        proposed = quantity.propose(noise)
        words = "not determined" if proposed is None else f"{proposed.value:.3g} {quantity.unit}"
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
    if mount is not None:
        lines.append(f"mount: {mount.text}")
    return lines


def format_noise_yaml(log: str, noise: ImuNoise, quantities: Sequence[NoiseQuantity] = QUANTITIES) -> str:
    """Return the proposed settings as part of a vehicle file; undetermined ones are comments."""
    lines = []
    for each in quantities:
        found = each.propose(noise)
        if not each.setting:
            continue
        if found is not None:
            more = f"; {VIBRATION_NOTE}" if each.setting == "accelerometer_noise" else ""
            lines.append(f"    {each.setting}: {found.value:.3e}   # {each.unit}, {each.name}{more}")
        else:
            lines.append(f"    # {each.setting}: not determined from this record")
    return _format_proposal(log, f"{noise.seconds:.0f} s stationary", "filter", lines)


@dataclass(frozen=True, slots=True)
class PresentNoise:
    """The settings of the filter at present, and the name of the file that has them."""

    settings: FilterSettings
    name: str

    def compare(self, quantity: NoiseQuantity, noise: ImuNoise) -> tuple[NoiseParameter | None, float, str]:
        """Return the proposal for a setting, the present value, and what to do, which begins with `set` or not."""
        now = float(getattr(self.settings, quantity.setting))
        found = quantity.propose(noise)
        if found is None:
            return None, now, f"not determined: {quantity.explain_missing(noise)}"
        if abs(found.value - now) <= SIGNIFICANT * found.sigma:
            return found, now, "no significant change"
        if quantity.setting == "accelerometer_noise" and found.value < now:
            return found, now, f"no change, as the measured value is {VIBRATION_NOTE}"
        return found, now, "set: the change is significant"


def render_noise_page(log: str, noise: ImuNoise, present: PresentNoise, mount: MountCheck | None, problem: str) -> str:
    """Return the page of an IMU's noise and mount. `problem`: why nothing is proposed, empty where something is."""
    settings = [each for each in QUANTITIES if each.setting]
    compared = [(each, *present.compare(each, noise)) for each in settings]
    rows = [
        (
            each.setting,
            each.unit,
            f"{now:.3g}",
            "" if found is None else f"{found.value:.3g}",
            "" if found is None else f"{found.sigma:.2g}",
            action,
        )
        for each, found, now, action in compared
    ]
    lines = [
        f"{setting}: {action}" if not value else f"{setting}: {now} -> {value} +- {sigma} {unit}: {action}"
        for setting, unit, now, value, sigma, action in rows
    ]
    changes = [each for each, _, _, action in compared if action.startswith("set")]
    known = sum(found is not None for _, found, _, _ in compared)
    tone, headline = "good", f"{known} of {len(settings)} noise settings determined, no change is needed"
    proposal = ""
    if problem:
        tone, headline = "error", "Nothing is proposed"
        lines.insert(0, f"{problem[:1].upper()}{problem[1:]}.")
    elif changes:
        tone = "note"
        headline = f"{known} of {len(settings)} noise settings determined, {len(changes)} to change"
        lines.append(f"Remedy: {APPLY}.")
        proposal = charts.render_text(format_noise_yaml(log, noise, changes).splitlines())
    if mount is not None:
        lines.append(f"Mount: {mount.text}.")
        tone = tone if mount.is_consistent else "error"
    head = ("setting", "unit", f"now ({present.name})", "measured", "sigma", "what to do")
    figures = [
        (f"{noise.seconds:.0f} s", "stationary, used"),
        (f"{noise.rate_hz:.1f} Hz", "rate"),
        (f"{noise.samples}", "samples"),
        (f"{noise.dropped}", "samples dropped"),
    ]
    sections = [
        ("settings", "Settings", charts.render_table(head, rows, numbers=(2, 3, 4)) + proposal),
        ("gyro", "Gyro", _render_allan_chart("Gyro", "rad/s", noise.gyro, present, noise, QUANTITIES[:3])),
        (
            "accelerometer",
            "Accelerometer",
            _render_allan_chart("Accelerometer", "m/s²", noise.accelerometer, present, noise, QUANTITIES[3:]),
        ),
        ("details", "Details", charts.render_text(format_noise(escape(log), noise, mount))),
    ]
    summary = charts.render_answer(Answer(tone, headline, lines)) + charts.render_key_figures(figures)
    heads = ("Calibration report", "IMU noise", f"{log}, {noise.begin:.1f} to {noise.end:.1f} s")
    return charts.render_report(f"IMU noise: {log}", heads, summary, sections, ABOUT)


APPLY = (
    "merge the lines below into the vehicle file, run modelserver check on it, and compare the reports of a drive with "
    "both: modelserver replay DRIVE -c VEHICLE --report HTML"
)
"""How a proposal is applied; no command changes a vehicle file."""


def _render_allan_chart(
    name: str,
    unit: str,
    axes: Sequence[AxisNoise],
    present: PresentNoise,
    noise: ImuNoise,
    quantities: Sequence[NoiseQuantity],
) -> str:
    """Return the Allan deviations of three axes beside those of the settings, and their ratio."""
    taus = np.array(axes[0].curve.taus)
    x = charts.decade_axis("averaging time τ, s", taus)
    lines = [
        Series(axis, each.curve.taus, each.curve.deviations, color)
        for axis, each, color in zip("xyz", axes, (charts.GREEN, charts.PINK, charts.SKY), strict=True)
    ]
    white, _, walk = quantities
    noisiest = np.max([each.curve.deviations for each in axes], axis=0)
    ratios = []
    now = tuple(float(getattr(present.settings, each.setting)) for each in (white, walk))
    found = [each.propose(noise) for each in (white, walk)]
    proposed = tuple(old if each is None else each.value for old, each in zip(now, found, strict=True))
    for words, (N, K), color in (("now", now, charts.ORANGE), ("proposed", proposed, charts.BLUE)):
        model = np.sqrt(N**2 / taus + K**2 * taus / 3.0)
        lines.append(Series(f"settings {words}", taus, model, color, shape="dashes"))
        # a setting of 0 has no ratio
        ratios.append(Series(words, taus, noisiest / np.where(model > 0.0, model, np.nan), color))
    y = charts.decade_axis(f"Allan deviation, {unit}", [value for line in lines for value in line.y])
    floors = [each.figures.instability.value for each in axes if each.figures.instability is not None]
    if floors:
        lines.append(charts.level("0.664 B", x, max(floors) * INSTABILITY_FLOOR))
    ratio = charts.decade_axis("ratio", [value for line in ratios for value in line.y])
    panels = [
        Panel(f"{name}: Allan deviation", y, lines, 320.0),
        Panel("Measured, noisiest axis, relative to the settings", ratio, [charts.level("", x, 1.0), *ratios], 140.0),
    ]
    caption = (
        "Dashed: deviation by noise and bias random walk of the settings; a figure that is not determined stays as it "
        "is. Below 1 the filter assumes more noise than there is, above 1 it is overconfident."
    )
    return charts.render_figure(charts.render_panels(name, x, panels), caption)


# --- magnetometer -------------------------------------------------------------------------------------------


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


def render_magnetometer_page(
    log: str, lines: Sequence[str], found: MagnetometerFit, fields: Array, present: MagnetometerCalibration, name: str
) -> str:
    """Return the page of a magnetometer; `lines`: text, `name`: of the file with the `present` correction."""
    chosen = fields[:: -(-len(fields) // MAX_POINTS)]
    now = np.array([present.apply(each) for each in chosen.tolist()])
    raw, before, after = (
        project_to_level(each, found.up) * 1e6 @ np.array([1.0, 1j]) for each in (chosen, now, found.apply(chosen))
    )
    errors = np.degrees(np.angle(before * after.conj()))
    rows, is_significant = _compare_magnetometer(found, present)
    largest, rms = f"{np.abs(errors).max():.1f} degrees", f"{math.degrees(found.heading_rms):.2f} degrees"
    answers = []
    if is_significant:
        headline = f"Heading is wrong by up to {largest} now; with the values found the error is {rms} rms"
        hard = [_format_numbers([each * 1e6 for each in of.hard_iron], 3) for of in (present, found)]
        soft = [_format_numbers(of.soft_iron, 4) for of in (present, found)]
        answers += [f"hard_iron, µT: {' -> '.join(hard)}", f"soft_iron: {' -> '.join(soft)}"]
        answers.append(f"The change is significant. Remedy: {APPLY}.")
    else:
        headline = f"No significant change; the error of heading is {rms} rms"
    if not found.is_strength_known:
        answers.append("The strength of the earth's field is not known: give the place with --place LAT,LON.")
    tone = "warning" if not found.is_strength_known else "note" if is_significant else "good"
    figures = [
        (f"{sum(found.sectors)} of {SECTORS}", "sectors of 30 degrees seen"),
        (f"{found.samples}", "samples"),
        (f"{found.outliers}", "outliers dropped"),
        (f"{found.rms * 1e6:.3f} µT", "rms residual"),
    ]
    head = ("value", f"now ({name})", "found", "sigma", "change")
    settings = charts.render_table(head, rows, numbers=(1, 2, 3))
    settings += charts.render_text(format_magnetometer_yaml(log, found).splitlines())
    sections = [
        ("settings", "Settings", settings),
        ("residuals", "Residuals", _render_residuals(found, before, after, errors)),
        ("field", "Field", _render_circle(found, raw, before, after)),
        ("details", "Details", charts.render_text(lines)),
    ]
    summary = charts.render_answer(Answer(tone, headline, answers)) + charts.render_key_figures(figures)
    return charts.render_report(
        f"Magnetometer: {log}", ("Calibration report", "Magnetometer", log), summary, sections, ABOUT
    )


def _compare_magnetometer(
    found: MagnetometerFit, present: MagnetometerCalibration
) -> tuple[list[tuple[str, str, str, str, str]], bool]:
    """Return the rows of a table of both corrections, and whether a value that the turn determines has changed."""
    # of the vertical a turn on the level determines nothing
    is_level = [abs(each) < math.sqrt(0.5) for each in found.up]
    of_scale = math.hypot(found.soft_iron_sigma, FIELD_SIGMA / found.strength if found.is_strength_known else 0.0)
    compared = [
        (f"hard_iron {a}, µT", present.hard_iron[n] * 1e6, found.hard_iron[n] * 1e6, found.hard_iron_sigma * 1e6, level)
        for n, (a, level) in enumerate(zip("xyz", is_level, strict=True))
    ]
    compared += [
        (
            f"soft_iron {a}{b}",
            present.soft_iron[k],
            found.soft_iron[k],
            of_scale if n == m else found.soft_iron_sigma,
            is_level[n] and is_level[m],
        )
        for n, a in enumerate("xyz")
        for m, b in enumerate("xyz")
        if m >= n
        for k in (3 * n + m,)
    ]
    rows, is_significant = [], False
    for name, now, new, sigma, is_determined in compared:
        change = abs(new - now) / sigma if is_determined and sigma > 0.0 else 0.0
        words = f"{change:.1f} sigma" if is_determined else "not determined by a turn on the level"
        is_significant |= change > SIGNIFICANT
        rows.append(
            (
                name,
                f"{now:.4f}",
                f"{new:.4f}",
                f"{sigma:.2g}" if is_determined else "",
                f"{words}, significant" if change > SIGNIFICANT else words,
            )
        )
    return rows, is_significant


def _render_residuals(found: MagnetometerFit, before: Array, after: Array, errors: Array) -> str:
    x = Axis("direction of the calibrated field in the horizontal plane, degrees", -180.0, 180.0)
    at, strength = np.degrees(np.angle(after)), found.strength * 1e6
    panels = []
    for title, unit, values, color in (
        ("Error of heading now", "deg", errors, charts.ORANGE),
        ("Strength now, minus the earth's", "µT", np.abs(before) - strength, charts.ORANGE),
        ("Strength as proposed, minus the earth's", "µT", np.abs(after) - strength, charts.BLUE),
    ):
        drawn = [charts.level("", x, 0.0), Series("", at, values, color, 3.0, "dots")]
        panels.append(Panel(title, Axis(unit, *charts.value_range([0.0, *values.tolist()])), drawn, 120.0))
    caption = "A wave once per turn is hard iron, twice per turn soft iron. What remains is noise, without a pattern."
    return charts.render_figure(charts.render_panels("Residuals", x, panels), caption)


def _render_circle(found: MagnetometerFit, raw: Array, before: Array, after: Array) -> str:
    circle = found.strength * 1e6 * np.exp(1j * np.linspace(0.0, 2.0 * np.pi, 121))
    clouds = [("measured", raw, charts.GRAY), ("now", before, charts.ORANGE), ("calibrated", after, charts.BLUE)]
    drawn = [
        Series(name, points.real, points.imag, color, 3.0, "dots")
        for name, points, color in clouds
        if name != "now" or not np.allclose(raw, before)
    ]
    name = "earth's field" if found.is_strength_known else "mean radius"
    drawn.append(Series(name, circle.real, circle.imag, charts.GRAY))
    axes = ("along in the horizontal plane, µT", "across in the horizontal plane, µT")
    chart = charts.render_map("Field during rotation", *axes, drawn, heights=(600, 600))
    return charts.render_figure(chart, "The horizontal field during the turn: without iron a circle around 0.")


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
