"""What `modelserver calibrate` found: in words, as data, as a proposal in YAML, and drawn."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from modelserver.localization.calibration.allan import FLOOR, AllanCurve, Figure, NoiseFigures
from modelserver.localization.calibration.ellipsoid import SECTORS, MagnetometerFit, level_plane
from modelserver.localization.calibration.mount import MountAdvice
from modelserver.spatial.so3 import Array, Vector3
from mstools.report import svg
from mstools.terminal.output import counted, safe

DRAWN = 1500
"""Most points of a cloud that are drawn."""


@dataclass(frozen=True, slots=True)
class AxisNoise:
    """The Allan deviation of one axis and what it tells."""

    curve: AllanCurve
    figures: NoiseFigures


@dataclass(frozen=True, slots=True)
class ImuNoise:
    """What a standing unit's samples tell. begin, end: seconds into the log of the stretch used, `seconds` long.

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
    """One of the figures: its setting (empty where it has none), what it is called, its unit, where it is found."""

    setting: str
    words: str
    unit: str
    axes: Callable[[ImuNoise], tuple[AxisNoise, ...]]
    figure: Callable[[NoiseFigures], Figure | None]
    limit: Callable[[NoiseFigures], float]

    def proposed(self, noise: ImuNoise) -> float:
        """Return the noisiest axis' value, NaN where no axis tells."""
        found = [each for axis in self.axes(noise) if (each := self.figure(axis.figures)) is not None]
        return max((each.value for each in found), default=math.nan)

    def at_most(self, noise: ImuNoise) -> float:
        """Return what it is at most on every axis, NaN where that is open."""
        limits = [self.limit(axis.figures) for axis in self.axes(noise)]
        return max(limits) if all(map(math.isfinite, limits)) else math.nan


def _gyro(noise: ImuNoise) -> tuple[AxisNoise, ...]:
    return noise.gyro


def _accelerometer(noise: ImuNoise) -> tuple[AxisNoise, ...]:
    return noise.accelerometer


def _white(figures: NoiseFigures) -> Figure | None:
    return figures.white


def _instability(figures: NoiseFigures) -> Figure | None:
    return figures.instability


def _walk(figures: NoiseFigures) -> Figure | None:
    return figures.walk


def _open(_: NoiseFigures) -> float:
    return math.nan


def _most_instability(figures: NoiseFigures) -> float:
    return figures.instability_limit


def _most_walk(figures: NoiseFigures) -> float:
    return figures.walk_limit


QUANTITIES = (
    _Quantity("gyro_noise", "angle random walk", "rad/s/sqrt(Hz)", _gyro, _white, _open),
    _Quantity("", "gyro bias instability", "rad/s", _gyro, _instability, _most_instability),
    _Quantity("gyro_bias_walk", "gyro bias random walk", "rad/s/sqrt(s)", _gyro, _walk, _most_walk),
    _Quantity("accelerometer_noise", "velocity random walk", "m/s^2/sqrt(Hz)", _accelerometer, _white, _open),
    _Quantity("", "accelerometer bias instability", "m/s^2", _accelerometer, _instability, _most_instability),
    _Quantity(
        "accelerometer_bias_walk", "accelerometer bias random walk", "m/s^2/sqrt(s)", _accelerometer, _walk, _most_walk
    ),
)


def proposal(noise: ImuNoise) -> dict[str, float]:
    """Return the settings of the filter that can be told."""
    return {each.setting: value for each in QUANTITIES if each.setting and math.isfinite(value := each.proposed(noise))}


SHAKING = "of the standing unit: what the engine and the road shake comes on top"


def noise_lines(log: str, noise: ImuNoise, advice: MountAdvice | None) -> list[str]:
    """Return the report on noise, one line each."""
    lines = [
        f"{log}: {counted(noise.samples, 'sample')}, {noise.rate_hz:.1f} Hz; stood and used: {noise.begin:.1f} to "
        f"{noise.end:.1f} s of the log ({noise.seconds:.1f} s)"
    ]
    if noise.dropped:
        lines.append(f"  {counted(noise.dropped, 'sample')} without rates or forces left out")
    for quantity in QUANTITIES:
        value = quantity.proposed(noise)
        if math.isfinite(value):
            head = f"{value:.3g} {quantity.unit}"
        elif math.isfinite(most := quantity.at_most(noise)):
            head = f"not determined; at most {most:.3g} {quantity.unit}"
        else:
            head = "not determined"
        lines.append(f"{quantity.words}: {head}")
        lines += [
            f"  {axis}: {_figure_words(quantity, each)}" for axis, each in zip("xyz", quantity.axes(noise), strict=True)
        ]
    for name, axes in (("gyro", noise.gyro), ("accelerometer", noise.accelerometer)):
        missing: dict[str, str] = {}
        for axis, found in zip("xyz", axes, strict=True):
            for each in found.figures.missing:
                missing[each] = missing.get(each, "") + axis
        lines += [f"{name}{'' if of == 'xyz' else f' {of}'}: {each}" for each, of in missing.items()]
    lines.append(f"The noisiest axis counts. accelerometer_noise is that {SHAKING}.")
    if advice is not None:
        lines.append(f"mount: {advice.text}")
    return lines


def _figure_words(quantity: _Quantity, axis: AxisNoise) -> str:
    figure = quantity.figure(axis.figures)
    if figure is None:
        most = quantity.limit(axis.figures)
        return f"not determined; at most {most:.3g}" if math.isfinite(most) else "not determined"
    where = f"at {figure.tau:.3g} s, {counted(round(figure.clusters), 'cluster')}"
    return f"{figure.value:.3g} +- {figure.sigma / figure.value:.1%} ({where})"


def noise_data(noise: ImuNoise, advice: MountAdvice | None) -> dict[str, Any]:
    """Return the report on noise for scripts; what is not determined is null."""
    return {
        "samples": noise.samples,
        "dropped": noise.dropped,
        "from": noise.begin,
        "to": noise.end,
        "seconds": noise.seconds,
        "rate_hz": noise.rate_hz,
        "proposal": proposal(noise),
        "gyro": [_axis_data(each) for each in noise.gyro],
        "accelerometer": [_axis_data(each) for each in noise.accelerometer],
        "mount": None
        if advice is None
        else {
            "agrees": advice.agrees,
            "angle": advice.angle,
            "fitting_rpy_deg": [list(each.rpy_deg) for each in advice.fitting],
            "text": advice.text,
        },
    }


def _axis_data(axis: AxisNoise) -> dict[str, Any]:
    def data(figure: Figure | None) -> dict[str, float] | None:
        if figure is None:
            return None
        return {"value": figure.value, "sigma": figure.sigma, "tau": figure.tau, "clusters": figure.clusters}

    figures = axis.figures
    return {
        "white": data(figures.white),
        "instability": data(figures.instability),
        "walk": data(figures.walk),
        "instability_limit": _or_none(figures.instability_limit),
        "walk_limit": _or_none(figures.walk_limit),
        "missing": list(figures.missing),
        "taus": list(axis.curve.taus),
        "deviations": list(axis.curve.deviations),
    }


def noise_yaml(log: str, noise: ImuNoise) -> str:
    """Return the settings that are proposed, as part of a vehicle file; what is not determined stands in a comment."""
    lines = [
        *_proposal_head(log, f"{noise.seconds:.0f} s of standing"),
        "localization:",
        "  filter:",
    ]
    for each in QUANTITIES:
        if not each.setting:
            continue
        value = each.proposed(noise)
        if math.isfinite(value):
            more = f"; {SHAKING}" if each.setting == "accelerometer_noise" else ""
            lines.append(f"    {each.setting}: {value:.3e}   # {each.unit}, {each.words}{more}")
        else:
            most = each.at_most(noise)
            words = f", at most {most:.1e} {each.unit}" if math.isfinite(most) else ""
            lines.append(f"    # {each.setting}: not determined from this record{words}")
    return "\n".join(lines) + "\n"


def noise_page(log: str, noise: ImuNoise) -> str:
    """Return the Allan deviations, drawn, as an HTML page."""
    charts = [
        _allan_chart("Gyro", "rad/s", noise.gyro, QUANTITIES[0].proposed(noise)),
        _allan_chart("Accelerometer", "m/s²", noise.accelerometer, QUANTITIES[3].proposed(noise)),
    ]
    return svg.page(f"Allan deviation: {safe(log)}", noise_lines(safe(log), noise, None), charts)


def _allan_chart(name: str, unit: str, axes: Sequence[AxisNoise], white: float) -> str:
    drawn = [
        (axis, [(t, d) for t, d in zip(each.curve.taus, each.curve.deviations, strict=True) if d > 0.0])
        for axis, each in zip("xyz", axes, strict=True)
    ]
    lines = [
        svg.PlotLine(axis, [t for t, _ in points], [d for _, d in points], colour)
        for (axis, points), colour in zip(drawn, svg.COLOURS, strict=False)
        if points
    ]
    taus = axes[0].curve.taus
    if math.isfinite(white):
        ends = [taus[0], taus[-1]]
        lines.append(
            svg.PlotLine("noise / √τ", ends, [white / math.sqrt(t) for t in ends], svg.COLOURS[3], dashed=True)
        )
    floors = [each.figures.instability for each in axes if each.figures.instability is not None]
    if floors:
        level = max(each.value for each in floors) * FLOOR
        lines.append(svg.PlotLine("0.664 B", [taus[0], taus[-1]], [level, level], "#cc79a7", dashed=True))
    values = [value for line in lines for value in line.y] or [0.1, 1.0]
    x = svg.decades("averaging time τ, s", taus)
    return svg.chart(name, x, svg.decades(f"Allan deviation, {unit}", values), lines)


def magnetometer_lines(log: str, found: MagnetometerFit, place: Vector3 | None, field: Vector3 | None) -> list[str]:
    """Return the report on a magnetometer, one line each."""
    seen = sum(found.coverage.sectors)
    lines = [
        f"{log}: {counted(found.samples, 'sample')}, {seen} of {SECTORS} sectors of 30 degrees seen, "
        f"{counted(found.strays, 'stray')} left out"
    ]
    if not found.planar:
        lines.append(f"  directions reach over {found.coverage.spread:.0%} of the sphere's height")
    if place is not None and field is not None:
        turned = math.degrees(math.atan2(field[0], field[1]))
        lines.append(
            f"field at {place[0]:.4f}, {place[1]:.4f}: {math.hypot(*field) * 1e6:.2f} uT, horizontal "
            f"{math.hypot(field[0], field[1]) * 1e6:.2f} uT, declination {turned:+.2f} deg (World Magnetic Model)"
        )
    else:
        why = "place unknown" if place is None else "no model of the field for that time"
        lines.append(
            f"{why}: the {'horizontal ' if found.planar else ''}field is taken to be the mean felt, "
            f"{found.strength * 1e6:.2f} uT" + ("; --place LAT,LON would tell" if place is None else "")
        )
    matrix = found.soft_iron
    lines += [
        f"hard iron, uT: {_numbers([each * 1e6 for each in found.hard_iron], 3)}",
        "soft iron: " + "; ".join(_numbers(matrix[row : row + 3], 4) for row in (0, 3, 6)),
        f"residual: {found.rms * 1e6:.3f} uT rms"
        + (f", {math.degrees(found.heading_rms):.2f} deg of heading" if math.isfinite(found.heading_rms) else ""),
    ]
    if found.planar and field is None:
        lines.append("Hard iron along the vertical is not determined without the field at the place: taken as 0.")
    if found.planar:
        lines.append("Found on the level: it holds there; slopes bring part of the vertical field into the horizontal.")
    return lines


def magnetometer_data(found: MagnetometerFit, place: Vector3 | None, field: Vector3 | None) -> dict[str, Any]:
    """Return the report on a magnetometer for scripts."""
    return {
        "samples": found.samples,
        "strays": found.strays,
        "planar": found.planar,
        "sectors": list(found.coverage.sectors),
        "spread": _or_none(found.coverage.spread),
        "place": None if place is None else list(place),
        "field": None if field is None else list(field),
        "strength": found.strength,
        "strength_known": found.strength_known,
        "rms": found.rms,
        "heading_rms": _or_none(found.heading_rms),
        "proposal": {"hard_iron": list(found.hard_iron), "soft_iron": list(found.soft_iron)},
    }


def magnetometer_yaml(log: str, found: MagnetometerFit) -> str:
    """Return the settings that are proposed, as part of a vehicle file."""
    how = "turned on the level" if found.planar else "turned about all axes"
    hard = ", ".join(f"{each:.4e}" for each in found.hard_iron)
    soft = ", ".join(f"{each:.6f}" for each in found.soft_iron)
    residual = f"residual {found.rms * 1e6:.3f} uT rms"
    return "\n".join(
        (
            *_proposal_head(log, f"{how}, {residual}"),
            "localization:",
            "  magnetometer:",
            f"    hard_iron: [{hard}]   # tesla, along the unit's axes",
            f"    soft_iron: [{soft}]   # 3 x 3, row-major",
            "",
        )
    )


def magnetometer_page(log: str, found: MagnetometerFit, fields: Array, up: Vector3) -> str:
    """Return the field in the horizontal plane before and after, drawn, as an HTML page."""
    chosen = fields[:: -(-len(fields) // DRAWN)]
    before = level_plane(chosen, up) * 1e6
    after = level_plane(found.applied(chosen), up) * 1e6
    angle = np.linspace(0.0, 2.0 * np.pi, 121)
    radius = found.strength * 1e6
    lines = [
        svg.PlotLine("as felt", before[:, 0].tolist(), before[:, 1].tolist(), svg.COLOURS[1], dots=True),
        svg.PlotLine("calibrated", after[:, 0].tolist(), after[:, 1].tolist(), svg.COLOURS[0], dots=True),
        svg.PlotLine(
            "earth's field" if found.strength_known else "mean radius",
            (radius * np.cos(angle)).tolist(),
            (radius * np.sin(angle)).tolist(),
            svg.COLOURS[3],
        ),
    ]
    reach = max(max(map(abs, (*line.x, *line.y))) for line in lines) * 1.1
    plane = "the horizontal plane" if found.planar else "the plane turned in most"
    x, y = (svg.Axis(f"{name} in {plane}, µT", -reach, reach) for name in ("along", "across"))
    words = magnetometer_lines(safe(log), found, None, None)[:1] if found.strength_known else []
    words += [f"hard iron, uT: {_numbers([each * 1e6 for each in found.hard_iron], 3)}"]
    words += [f"residual: {found.rms * 1e6:.3f} uT rms"]
    chart = svg.chart("Field while turning", x, y, lines, square=True)
    return svg.page(f"Magnetometer: {safe(log)}", words, [chart])


def _proposal_head(log: str, how: str) -> tuple[str, ...]:
    return (
        f"# Proposed by modelserver calibrate from {safe(log)}: {how}.",
        "# Merge what follows into the vehicle file; nothing was changed.",
    )


def _numbers(values: Sequence[float], digits: int) -> str:
    return "[" + ", ".join(f"{each:.{digits}f}" for each in values) + "]"


def _or_none(value: float) -> float | None:
    return value if math.isfinite(value) else None
