"""Charts as SVG text, and an HTML page for them: self-contained, without scripts.

Lines and bands are decimated to at most four points per pixel column (first, lowest, highest, last) and dots to one per
pixel, so that the page stays small for a long recording.
"""

from __future__ import annotations

import html
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Literal, TypeAlias

WIDTH = 1060
LEFT, RIGHT = 74, 14
INNER = WIDTH - LEFT - RIGHT
GAP = 10
HEADER = 22

BLUE, ORANGE, GREEN, PINK, SKY, AMBER, GRAY, RED = PALETTE = (
    *("#0072b2", "#d55e00", "#009e73", "#cc79a7"),
    *("#56b4e9", "#e69f00", "#8a8f98", "#c22f2f"),
)
"""Distinguishable with color blindness: M. Okabe and K. Ito, "Color Universal Design", 2008; gray and red added."""

Place: TypeAlias = Callable[[float], float]


@dataclass(frozen=True, slots=True)
class Axis:
    """An axis from `low` to `high`, powers of ten where `is_logarithmic`."""

    label: str
    low: float
    high: float
    is_logarithmic: bool = False

    def fraction(self, value: float) -> float:
        """Return the position of a value on the axis, 0 at the low end and 1 at the high end; nan if it has none."""
        low, high = self.low, self.high
        if self.is_logarithmic:
            value, low, high = math.log10(value) if value > 0.0 else math.nan, math.log10(low), math.log10(high)
        return (value - low) / (high - low)

    def ticks(self) -> list[float]:
        """Return the ticks: powers of ten, or even steps of 1, 2 or 5."""
        if self.is_logarithmic:
            return [10.0**n for n in range(round(math.log10(self.low)), round(math.log10(self.high)) + 1)]
        rough = (self.high - self.low) / 6.0
        power = 10.0 ** math.floor(math.log10(rough))
        step = next(factor * power for factor in (1.0, 2.0, 5.0, 10.0) if factor * power >= rough)
        return [n * step for n in range(math.ceil(self.low / step - 1e-9), math.floor(self.high / step + 1e-9) + 1)]


@dataclass(frozen=True, slots=True)
class Series:
    """Values over x, named in the legend; non-finite ones interrupt lines and bands.

    `high` are the upper values of a band, whose lower ones are `y`. Dots beyond the panel are drawn at its edge.
    """

    name: str
    x: Sequence[float]
    y: Sequence[float]
    color: str = BLUE
    width: float = 1.4
    shape: Literal["line", "dashes", "dots", "band"] = "line"
    high: Sequence[float] = ()


@dataclass(frozen=True, slots=True)
class Panel:
    """One chart of a stack over a common x axis: title, y axis, and series from back to front."""

    title: str
    y: Axis
    series: Sequence[Series]
    height: float = 120.0


@dataclass(frozen=True, slots=True)
class StripRow:
    """A row of a strip: named intervals (begin, end, tooltip)."""

    name: str
    intervals: Sequence[tuple[float, float, str]]
    color: str


def decade_axis(label: str, values: Iterable[float]) -> Axis:
    """Return a logarithmic axis of whole decades around the positive values; 0.1 to 10 without any."""
    known = [each for each in values if math.isfinite(each) and each > 0.0] or [0.1, 10.0]
    low, high = math.floor(math.log10(min(known))), math.ceil(math.log10(max(known)))
    return Axis(label, 10.0**low, 10.0 ** max(high, low + 1), is_logarithmic=True)


def value_range(values: Iterable[float], share: float = 1.0, min_width: float = 0.0) -> tuple[float, float]:
    """Return a range around the middle `share` of the finite values, with a margin, at least `min_width` wide."""
    known = sorted(value for value in values if math.isfinite(value))
    if not known:
        return (-0.5 * (min_width or 1.0), 0.5 * (min_width or 1.0))
    cut = int(0.5 * (1.0 - share) * len(known))
    low, high = known[cut], known[-1 - cut]
    middle, half = 0.5 * (low + high), max(0.55 * (high - low), 0.5 * min_width, 1e-9)
    return middle - half, middle + half


def level(name: str, x: Axis, y: float, color: str = GRAY) -> Series:
    """Return a dashed horizontal line."""
    return Series(name, (x.low, x.high), (y, y), color, shape="dashes")


def dots(name: str, points: Iterable[Sequence[float]], color: str, size: float) -> Series:
    """Return points as dots; only their first two coordinates count."""
    places = list(points)
    return Series(name, [each[0] for each in places], [each[1] for each in places], color, size, "dots")


# --- charts -------------------------------------------------------------------------------------------------


def render_panels(label: str, x: Axis, panels: Sequence[Panel], events: Sequence[tuple[float, str]] = ()) -> str:
    """Return an SVG of panels above one another; `events` are vertical lines through all of them."""
    parts: list[str] = []
    top = float(HEADER)
    for panel in panels:
        parts += _render_panel(panel, x, top, events)
        top += panel.height + GAP + HEADER
    bottom = top - GAP - HEADER
    return _render_svg(label, bottom + 44, [*parts, *_render_x_axis(x, LEFT, INNER, bottom)])


def render_map(label: str, x: str, y: str, series: Sequence[Series], heights: tuple[float, float] = (420, 900)) -> str:
    """Return an SVG map with one scale for both axes, whose labels are `x` and `y`; its height fits within limits."""
    (west, east), (south, north) = spans = [
        value_range((value for each in series for value in getattr(each, axis)), min_width=2.0) for axis in "xy"
    ]
    height = min(max(INNER * (north - south) / (east - west), heights[0]), heights[1])
    scale = max((east - west) / INNER, (north - south) / height)
    axes = [
        Axis(name, 0.5 * (low + high - scale * pixels), 0.5 * (low + high + scale * pixels))
        for name, (low, high), pixels in zip((x, y), spans, (INNER, height), strict=True)
    ]
    return render_panels(label, axes[0], [Panel("", axes[1], series, height)])


def render_strip(label: str, x: Axis, rows: Sequence[StripRow], events: Sequence[tuple[float, str]] = ()) -> str:
    """Return an SVG of rows with intervals."""
    pitch, left = 24.0, 190.0
    width, bottom = WIDTH - left - RIGHT, 4.0 + pitch * len(rows)

    def at(value: float) -> float:
        return left + min(max(x.fraction(value), 0.0), 1.0) * width

    parts = _render_verticals(at, 2.0, bottom, x.ticks(), ())
    for number, row in enumerate(rows):
        y = 8.0 + pitch * number
        parts.append(render_text(left - 8, y + 11, row.name, text_anchor="end"))
        parts.append(element("rect", x=left, y=y, width=width, height=14, class_="track"))
        parts += [
            element("rect", _title(words), x=at(a), y=y, width=max(at(b) - at(a), 1.5), height=14, fill=row.color)
            for a, b, words in row.intervals
        ]
    parts += _render_verticals(at, 2.0, bottom, (), events)
    return _render_svg(label, bottom + 38, [*parts, *_render_x_axis(x, left, width, bottom)])


# --- parts --------------------------------------------------------------------------------------------------


def element(name: str, content: str = "", /, **attributes: str | float) -> str:
    """Return an XML element; `_` in an attribute's name becomes `-`, and one at its end goes, as in `class_`."""
    words = [name]
    for key, each in attributes.items():
        value = html.escape(each) if isinstance(each, str) else f"{each:.1f}".removesuffix(".0")
        words.append(f'{key.removesuffix("_").replace("_", "-")}="{value}"')
    return f"<{' '.join(words)}>{content}</{name}>" if content else f"<{' '.join(words)}/>"


def format_points(points: Iterable[tuple[float, float]]) -> str:
    """Return points as an attribute of a polyline or a polygon has them."""
    return " ".join(f"{a:.1f},{b:.1f}" for a, b in points)


def render_text(x: float, y: float, words: str, **attributes: str | float) -> str:
    """Return words at a baseline."""
    return element("text", html.escape(words), x=x, y=y, **attributes)


def _title(words: str) -> str:
    return element("title", html.escape(words)) if words else ""


def _render_svg(label: str, height: float, parts: Iterable[str]) -> str:
    head = {"xmlns": "http://www.w3.org/2000/svg", "viewBox": f"0 0 {WIDTH} {height:.0f}", "aria-label": label}
    return element("svg", "\n".join(parts), **head, role="img")


def _render_verticals(
    at: Place, top: float, bottom: float, ticks: Iterable[float], events: Iterable[tuple[float, str]]
) -> list[str]:
    lines = [(at(tick), "", "grid") for tick in ticks] + [(at(when), words, "event") for when, words in events]
    return [element("line", _title(words), x1=x, y1=top, x2=x, y2=bottom, class_=kind) for x, words, kind in lines]


def _render_x_axis(x: Axis, left: float, width: float, bottom: float) -> list[str]:
    places = [(left + x.fraction(tick) * width, 15, _format_number(tick)) for tick in x.ticks()]
    places.append((left + width / 2, 32, x.label))
    return [render_text(at, bottom + below, words, text_anchor="middle") for at, below, words in places]


def _render_panel(panel: Panel, x: Axis, top: float, events: Sequence[tuple[float, str]]) -> list[str]:
    """Return title, box, y axis with its ticks, legend at the right above the box, and the series, clipped to it."""
    y, height = panel.y, panel.height

    def at_x(value: float) -> float:
        return x.fraction(value) * INNER

    def at_y(value: float) -> float:
        return (1.0 - y.fraction(value)) * height

    parts = [
        render_text(LEFT, top - 7, panel.title, class_="title"),
        element("rect", x=LEFT, y=top, width=INNER, height=height, class_="box"),
    ]
    for tick in y.ticks()[:: 1 if height > 100.0 else 2]:
        line = top + at_y(tick)
        parts.append(element("line", x1=LEFT, y1=line, x2=LEFT + INNER, y2=line, class_="grid"))
        parts.append(render_text(LEFT - 6, line + 4, _format_number(tick), text_anchor="end"))
    middle = top + 0.5 * height
    parts.append(render_text(13, middle, y.label, text_anchor="middle", transform=f"rotate(-90 13 {middle:.1f})"))
    right = float(LEFT + INNER)
    for each in reversed([each for each in panel.series if each.name]):
        right -= 6.3 * len(each.name)
        parts += [render_text(right, top - 7, each.name), *_render_legend(each, right - 20.0, top - 11.0)]
        right -= 38.0
    box = {"height": f"{height:.1f}", "viewBox": f"0 0 {INNER} {height:.1f}", "overflow": "hidden"}
    inner = [part for each in panel.series for part in _render_series(each, at_x, at_y, height)]
    parts += _render_verticals(lambda value: LEFT + at_x(value), top, top + height, x.ticks(), ())
    parts.append(element("svg", "".join(inner), x=LEFT, y=top, width=INNER, **box))
    return parts + _render_verticals(lambda value: LEFT + at_x(value), top, top + height, (), events)


def _render_legend(series: Series, x: float, y: float) -> list[str]:
    if series.shape == "dots":
        return [element("circle", cx=x + 10, cy=y, r=3, fill=series.color)]
    ends = [(x, y - 4.0), (x + 16.0, y - 4.0)] if series.shape == "band" else [(x, y), (x + 16.0, y)]
    return [_render_run(series, [(a, b, b + 8.0) for a, b in ends])]


def _render_series(series: Series, at_x: Place, at_y: Place, height: float) -> list[str]:
    rows = [
        (at_x(a), at_y(low), at_y(high))
        for a, low, high in zip(series.x, series.y, series.high or series.y, strict=True)
    ]
    runs = [list(group) for known, group in groupby(rows, lambda row: all(map(math.isfinite, row))) if known]
    if series.shape != "dots":
        return [_render_run(series, run) for run in runs if len(run) > 1]
    pixels = {(round(a), round(min(max(b, 1.0), height - 1.0))): None for run in runs for a, b, _ in run}
    # zero-length strokes with round caps: one element for thousands of points
    path = "".join(f"M{a} {b}h0" for a, b in pixels)
    return [element("path", d=path, stroke=series.color, stroke_width=series.width, stroke_linecap="round")]


def _render_run(series: Series, run: Sequence[tuple[float, float, float]]) -> str:
    """Return a line, or the area of a band, through points (x, y, upper y)."""
    points = decimate([(a, low) for a, low, _ in run])
    if series.shape == "band":
        points += reversed(decimate([(a, high) for a, _, high in run]))
        return element("polygon", points=format_points(points), fill=series.color, class_="band")
    style: dict[str, str] = {"stroke_dasharray": "5 3"} if series.shape == "dashes" else {}
    style |= {"points": format_points(points), "fill": "none", "stroke": series.color}
    return element("polyline", **style, stroke_width=series.width)


def decimate(points: Iterable[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return a curve with at most the first, lowest, highest and last point of each run within one pixel column."""
    drawn: list[tuple[float, float]] = []
    for _, column in groupby(points, lambda point: math.floor(point[0])):
        run = list(column)
        heights = [each[1] for each in run]
        chosen = {0, heights.index(min(heights)), heights.index(max(heights)), len(run) - 1}
        drawn += run if len(run) <= 4 else [run[n] for n in sorted(chosen)]
    return drawn


def _format_number(value: float) -> str:
    return f"{value:.6g}" if value == 0.0 or 1e-4 <= abs(value) < 1e5 else f"{value:.0e}"


# --- page ---------------------------------------------------------------------------------------------------


def render_page(title: str, body: str) -> str:
    """Return an HTML page; `title` is text, `body` HTML."""
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{html.escape(title)}</title>
<style>{CHART_STYLE}{PAGE_STYLE}</style>
</head>
<body>
{body}
</body>
</html>
"""


CHART_STYLE = """
svg text { font: 11.5px system-ui, "Segoe UI", Roboto, "DejaVu Sans", sans-serif; fill: #3c4654; }
svg .title { font-weight: 600; font-size: 13px; fill: #1c2430; }
svg .box { fill: #fbfcfd; stroke: #c6cdd6; }
svg .grid { stroke: #e6eaef; }
svg .track { fill: #f0f2f5; }
svg .band { opacity: .22; }
svg .event { stroke: #7a4fb5; stroke-dasharray: 2 2; }
"""

PAGE_STYLE = """
:root { --ink: #1c2430; --soft: #5b6675; --line: #dfe4ea; --paper: #ffffff; --wash: #f5f7f9; }
* { box-sizing: border-box; }
body { font: 15px/1.5 system-ui, "Segoe UI", Roboto, "DejaVu Sans", sans-serif; color: var(--ink);
  background: var(--paper); max-width: 1120px; margin: 0 auto; padding: 0 24px 40px; }
header { padding: 28px 0 8px; border-bottom: 1px solid var(--line); }
header p { margin: 0; color: var(--soft); }
.kicker { text-transform: uppercase; letter-spacing: .1em; font-size: 12px; }
h1 { margin: 2px 0; font-size: 30px; }
h2 { margin: 38px 0 12px; font-size: 20px; }
h3 { margin: 0 0 2px; font-size: 15px; }
nav { margin: 14px 0 8px; display: flex; flex-wrap: wrap; gap: 4px 18px; }
nav a { color: #0072b2; text-decoration: none; }
nav a:hover { text-decoration: underline; }
.figures { display: flex; flex-wrap: wrap; gap: 10px; margin: 18px 0 6px; }
.figures div { flex: 1 1 130px; background: var(--wash); border-radius: 8px; padding: 10px 14px; }
.figures strong { display: block; font-size: 20px; font-variant-numeric: tabular-nums; }
.figures span { color: var(--soft); font-size: 13px; }
.finding { border-left: 4px solid var(--tone); background: var(--wash); border-radius: 0 8px 8px 0;
  padding: 10px 16px; margin: 8px 0; }
.finding p { margin: 2px 0; }
.finding p + p { color: var(--soft); }
.finding h3 span { color: var(--tone); text-transform: uppercase; font-size: 11px; letter-spacing: .06em;
  margin-right: 6px; }
.error { --tone: #c22f2f; } .warning { --tone: #b36b00; } .note { --tone: #0072b2; }
.good { border-left: 4px solid #009e73; background: var(--wash); padding: 10px 16px; }
figure { margin: 14px 0; }
figcaption { color: var(--soft); font-size: 13px; margin: 4px 0 0 8px; max-width: 90ch; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; margin: 10px 0; }
th, td { text-align: left; padding: 4px 18px 4px 4px; border-bottom: 1px solid var(--line); }
th { font-weight: 600; color: var(--soft); font-size: 13px; }
.n { text-align: right; }
figure > svg { width: 100%; height: auto; display: block; }
footer { margin-top: 40px; color: var(--soft); font-size: 13px; border-top: 1px solid var(--line); padding-top: 10px; }
@media print { body { max-width: none; } section { break-inside: avoid; } nav { display: none; } }
"""
