"""Charts as SVG text: axes with ticks, lines and points, and an HTML page for them. Self-contained, no scripts."""

from __future__ import annotations

import html
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

WIDTH, HEIGHT = 640, 420
LEFT, RIGHT, TOP, BOTTOM = 78, 150, 34, 52

COLORS = ("#0072b2", "#d55e00", "#009e73", "#666666")
"""Distinguishable with color blindness: M. Okabe and K. Ito, "Color Universal Design", 2008."""


@dataclass(frozen=True, slots=True)
class PlotLine:
    """A curve or point cloud in data units, with its name in the legend."""

    name: str
    x: Sequence[float]
    y: Sequence[float]
    color: str
    is_dashed: bool = False
    is_dotted: bool = False


@dataclass(frozen=True, slots=True)
class Axis:
    """An axis from `low` to `high`, powers of ten where `is_logarithmic`."""

    label: str
    low: float
    high: float
    is_logarithmic: bool = False

    def fraction(self, value: float) -> float:
        """Return the position of a value on the axis, 0 at the low end and 1 at the high end."""
        low, high = self.low, self.high
        if self.is_logarithmic:
            value, low, high = math.log10(value), math.log10(low), math.log10(high)
        return (value - low) / (high - low)

    def ticks(self) -> list[float]:
        """Return the ticks: powers of ten, or even steps of 1, 2 or 5."""
        if self.is_logarithmic:
            first, last = round(math.log10(self.low)), round(math.log10(self.high))
            return [10.0**each for each in range(first, last + 1)]
        rough = (self.high - self.low) / 6.0
        power = 10.0 ** math.floor(math.log10(rough))
        step = next(factor * power for factor in (1.0, 2.0, 5.0, 10.0) if factor * power >= rough)
        count = math.floor(self.high / step + 1e-9) - math.ceil(self.low / step - 1e-9)
        first = math.ceil(self.low / step - 1e-9)
        return [(first + n) * step + 0.0 for n in range(count + 1)]


def decade_axis(label: str, values: Iterable[float]) -> Axis:
    """Return a logarithmic axis of whole decades around positive values."""
    known = list(values)
    low, high = math.floor(math.log10(min(known))), math.ceil(math.log10(max(known)))
    return Axis(label, 10.0**low, 10.0 ** max(high, low + 1), is_logarithmic=True)


def render_chart(title: str, x: Axis, y: Axis, lines: Sequence[PlotLine], square: bool = False) -> str:
    """Return an SVG element: title, axes, grid, lines and legend. `square`: equal lengths on both axes."""
    width = HEIGHT - TOP - BOTTOM if square else WIDTH - LEFT - RIGHT
    height = HEIGHT - TOP - BOTTOM
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" '
        f'aria-label="{html.escape(title)}" font-family="sans-serif" font-size="12">',
        f'<text x="{LEFT}" y="20" font-size="14" font-weight="bold">{html.escape(title)}</text>',
    ]

    def at(px: float, py: float) -> tuple[float, float]:
        return LEFT + x.fraction(px) * width, TOP + (1.0 - y.fraction(py)) * height

    for tick in x.ticks():
        px, _ = at(tick, y.low)
        parts.append(_render_grid(px, TOP, px, TOP + height))
        parts.append(f'<text x="{px:.1f}" y="{TOP + height + 16}" text-anchor="middle">{_format_number(tick)}</text>')
    for tick in y.ticks():
        _, py = at(x.low, tick)
        parts.append(_render_grid(LEFT, py, LEFT + width, py))
        parts.append(f'<text x="{LEFT - 6}" y="{py + 4:.1f}" text-anchor="end">{_format_number(tick)}</text>')
    parts.append(f'<rect x="{LEFT}" y="{TOP}" width="{width}" height="{height}" fill="none" stroke="#333"/>')
    parts.append(f'<text x="{LEFT + width / 2}" y="{HEIGHT - 12}" text-anchor="middle">{html.escape(x.label)}</text>')
    middle = TOP + height / 2
    parts.append(
        f'<text x="16" y="{middle}" text-anchor="middle" transform="rotate(-90 16 {middle})">'
        f"{html.escape(y.label)}</text>"
    )
    for row, line in enumerate(lines):
        points = [at(a, b) for a, b in zip(line.x, line.y, strict=True)]
        parts.append(_render_dots(points, line) if line.is_dotted else _render_curve(points, line))
        key_x, key_y = LEFT + width + 12, TOP + 12 + 18 * row
        parts.append(
            _render_dots([(key_x + 11, key_y)], line) if line.is_dotted else _render_legend(key_x, key_y, line)
        )
        parts.append(f'<text x="{key_x + 28}" y="{key_y + 4}">{html.escape(line.name)}</text>')
    parts.append("</svg>")
    return "\n".join(parts)


def render_page(title: str, lines: Sequence[str], charts: Sequence[str]) -> str:
    """Return an HTML page with a heading, preformatted text and charts."""
    text = html.escape("\n".join(lines))
    figures = "\n".join(f"<figure>{each}</figure>" for each in charts)
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<title>{html.escape(title)}</title>
<style>
body {{ font-family: sans-serif; max-width: 60rem; margin: 1rem auto; padding: 0 1rem; color: #111; background: #fff; }}
pre {{ white-space: pre-wrap; }}
figure {{ margin: 1rem 0; }}
svg {{ width: 100%; height: auto; }}
</style>
</head>
<body>
<h1>{html.escape(title)}</h1>
<pre>{text}</pre>
{figures}
</body>
</html>
"""


def _format_number(value: float) -> str:
    return f"{value:.6g}" if value == 0.0 or 1e-3 <= abs(value) < 1e5 else f"{value:.0e}"


def _render_grid(x1: float, y1: float, x2: float, y2: float) -> str:
    return f'<line x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}" stroke="#ddd"/>'


def _style(line: PlotLine) -> str:
    dashes = ' stroke-dasharray="5 4"' if line.is_dashed else ""
    return f'stroke="{line.color}" stroke-width="1.6"{dashes}'


def _render_curve(points: Sequence[tuple[float, float]], line: PlotLine) -> str:
    path = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    return f'<polyline points="{path}" fill="none" {_style(line)}/>'


def _render_legend(x: float, y: float, line: PlotLine) -> str:
    return f'<line x1="{x}" y1="{y}" x2="{x + 22}" y2="{y}" {_style(line)}/>'


def _render_dots(points: Sequence[tuple[float, float]], line: PlotLine) -> str:
    # zero-length strokes with round caps: one element for thousands of points
    path = "".join(f"M{x:.1f} {y:.1f}h0" for x, y in points)
    return f'<path d="{path}" stroke="{line.color}" stroke-width="3" stroke-linecap="round" fill="none"/>'
