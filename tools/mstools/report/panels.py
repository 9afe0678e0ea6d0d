"""Time-series panels, interval strips and maps as SVG text, self-contained and without scripts.

Curves are decimated to at most four points per pixel column (first, lowest, highest, last) and dots to one per pixel,
so that the page stays small for a long recording.
"""

from __future__ import annotations

import html
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

from mstools.report.svg import Axis

WIDTH = 1060
LEFT, RIGHT = 74, 14
INNER = WIDTH - LEFT - RIGHT
GAP = 10
HEADER = 22

BLUE, ORANGE, GREEN, PINK, SKY, AMBER, GRAY, RED = (
    *("#0072b2", "#d55e00", "#009e73", "#cc79a7"),
    *("#56b4e9", "#e69f00", "#8a8f98", "#c22f2f"),
)
"""Distinguishable with color blindness: M. Okabe and K. Ito, "Color Universal Design", 2008; gray and red added."""

PALETTE = (BLUE, ORANGE, GREEN, PINK, SKY, AMBER, GRAY, RED)

Numbers: TypeAlias = Sequence[float]
Place: TypeAlias = Callable[[float], float]


@dataclass(frozen=True, slots=True)
class Curve:
    """A line through points; nan interrupts it."""

    name: str
    x: Numbers
    y: Numbers
    color: str = BLUE
    width: float = 1.4
    dashed: bool = False


@dataclass(frozen=True, slots=True)
class Dots:
    """Single points; those beyond the panel are drawn at its edge."""

    name: str
    x: Numbers
    y: Numbers
    color: str = BLUE
    size: float = 2.6


@dataclass(frozen=True, slots=True)
class Band:
    """The area between two lines."""

    name: str
    x: Numbers
    low: Numbers
    high: Numbers
    color: str = BLUE


@dataclass(frozen=True, slots=True)
class HorizontalLine:
    """A horizontal line."""

    name: str
    y: float
    color: str = GRAY


Mark: TypeAlias = Curve | Dots | Band | HorizontalLine


@dataclass(frozen=True, slots=True)
class Panel:
    """One chart of a stack over a common time axis: title, y axis, and marks from back to front."""

    title: str
    y: Axis
    marks: Sequence[Mark]
    height: float = 120.0


@dataclass(frozen=True, slots=True)
class StripRow:
    """A row of a strip: named intervals (begin, end, tooltip)."""

    name: str
    intervals: Sequence[tuple[float, float, str]]
    color: str


def value_range(values: Iterable[float], share: float = 1.0, min_width: float = 0.0) -> tuple[float, float]:
    """Return a range around the middle `share` of the finite values, with a margin, at least `min_width` wide."""
    known = sorted(value for value in values if math.isfinite(value))
    if not known:
        return (-0.5 * (min_width or 1.0), 0.5 * (min_width or 1.0))
    cut = int(0.5 * (1.0 - share) * len(known))
    low, high = known[cut], known[-1 - cut]
    middle, half = 0.5 * (low + high), max(0.55 * (high - low), 0.5 * min_width, 1e-9)
    return middle - half, middle + half


def render_panels(
    label: str, begin: float, end: float, panels: Sequence[Panel], events: Sequence[tuple[float, str]] = ()
) -> str:
    """Return an SVG of panels above one another over seconds; `events` are vertical lines through all of them."""
    x = Axis("seconds from the log's first event", begin, max(end, begin + 1e-3))
    height = sum(HEADER + each.height + GAP for each in panels) + 34
    parts = [_open_svg(label, height)]
    top = 0.0
    for panel in panels:
        parts += _render_panel(panel, x, top, events)
        top += HEADER + panel.height + GAP
    parts += _render_time_ticks(x, top - GAP)
    parts.append("</svg>")
    return "\n".join(parts)


def render_strip(
    label: str, begin: float, end: float, rows: Sequence[StripRow], events: Sequence[tuple[float, str]] = ()
) -> str:
    """Return an SVG of rows with intervals over seconds."""
    x = Axis("seconds from the log's first event", begin, max(end, begin + 1e-3))
    pitch, left = 24.0, 190.0
    inner = WIDTH - left - RIGHT
    parts = [_open_svg(label, pitch * len(rows) + 40)]

    def at(value: float) -> float:
        return left + min(max(x.fraction(value), 0.0), 1.0) * inner

    bottom = 4.0 + pitch * len(rows)
    for tick in x.ticks():
        parts.append(f'<line x1="{at(tick):.1f}" y1="2" x2="{at(tick):.1f}" y2="{bottom:.0f}" class="grid"/>')
        parts.append(f'<text x="{at(tick):.1f}" y="{bottom + 15:.0f}" text-anchor="middle">{tick:g}</text>')
    for number, row in enumerate(rows):
        y = 4.0 + pitch * number
        parts.append(f'<text x="{left - 8}" y="{y + 15:.0f}" text-anchor="end">{html.escape(row.name)}</text>')
        parts.append(f'<rect x="{left}" y="{y + 4:.0f}" width="{inner}" height="14" class="track"/>')
        for first, last, words in row.intervals:
            width = max(at(last) - at(first), 1.5)
            title = f"<title>{html.escape(words)}</title>" if words else ""
            parts.append(
                f'<rect x="{at(first):.1f}" y="{y + 4:.0f}" width="{width:.1f}" height="14" '
                f'fill="{row.color}">{title}</rect>'
            )
    for when, words in events:
        parts.append(
            f'<line x1="{at(when):.1f}" y1="2" x2="{at(when):.1f}" y2="{bottom:.0f}" class="event">'
            f"<title>{html.escape(words)}</title></line>"
        )
    parts.append(f'<text x="{left + inner / 2:.0f}" y="{bottom + 32:.0f}" text-anchor="middle">{x.label}</text>')
    parts.append("</svg>")
    return "\n".join(parts)


def render_map(label: str, marks: Sequence[Curve | Dots], min_height: float = 420.0, max_height: float = 900.0) -> str:
    """Return an SVG map: east to the right, north up, meters, one scale for both; its height fits within limits."""
    xs = [value for mark in marks for value in mark.x if math.isfinite(value)]
    ys = [value for mark in marks for value in mark.y if math.isfinite(value)]
    (x_low, x_high), (y_low, y_high) = value_range(xs, min_width=2.0), value_range(ys, min_width=2.0)
    inner = min(max(INNER * (y_high - y_low) / (x_high - x_low), min_height), max_height)
    height = inner + HEADER + 44
    scale = min(INNER / (x_high - x_low), inner / (y_high - y_low))
    half_x, half_y = 0.5 * INNER / scale, 0.5 * inner / scale
    x_mid, y_mid = 0.5 * (x_low + x_high), 0.5 * (y_low + y_high)
    x = Axis("east of the origin, m", x_mid - half_x, x_mid + half_x)
    y = Axis("north of the origin, m", y_mid - half_y, y_mid + half_y)
    parts = [_open_svg(label, height)]
    parts += _render_frame(x, y, HEADER, inner, marks, y.label)
    # one scale for both axes
    step = (y.ticks()[1] - y.ticks()[0]) if len(y.ticks()) > 1 else 1.0
    for n in range(math.ceil(x.low / step), math.floor(x.high / step) + 1):
        px = LEFT + x.fraction(n * step) * INNER
        parts.append(f'<line x1="{px:.1f}" y1="{HEADER}" x2="{px:.1f}" y2="{HEADER + inner:.0f}" class="grid"/>')
        parts.append(f'<text x="{px:.1f}" y="{HEADER + inner + 15:.0f}" text-anchor="middle">{n * step:g}</text>')
    parts += _render_marks(x, y, HEADER, inner, marks)
    parts.append(f'<text x="{LEFT + INNER / 2:.0f}" y="{height - 8:.0f}" text-anchor="middle">{x.label}</text>')
    parts.append("</svg>")
    return "\n".join(parts)


# --- parts --------------------------------------------------------------------------------------------------


def _open_svg(label: str, height: float) -> str:
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height:.0f}" role="img" '
        f'aria-label="{html.escape(label)}">'
    )


def _render_panel(panel: Panel, x: Axis, top: float, events: Sequence[tuple[float, str]]) -> list[str]:
    y0 = top + HEADER
    parts = [f'<text x="{LEFT}" y="{top + 15:.0f}" class="title">{html.escape(panel.title)}</text>']
    parts += _render_frame(x, panel.y, y0, panel.height, panel.marks, panel.y.label)
    for tick in x.ticks():
        px = LEFT + x.fraction(tick) * INNER
        parts.append(f'<line x1="{px:.1f}" y1="{y0:.1f}" x2="{px:.1f}" y2="{y0 + panel.height:.1f}" class="grid"/>')
    parts += _render_marks(x, panel.y, y0, panel.height, panel.marks)
    for when, words in events:
        px = LEFT + x.fraction(when) * INNER
        parts.append(
            f'<line x1="{px:.1f}" y1="{y0:.1f}" x2="{px:.1f}" y2="{y0 + panel.height:.1f}" class="event">'
            f"<title>{html.escape(words)}</title></line>"
        )
    return parts


def _render_frame(x: Axis, y: Axis, top: float, height: float, marks: Sequence[Mark], label: str) -> list[str]:
    """Return the box, the y axis with its ticks, and the legend at the right above the box."""
    parts = [f'<rect x="{LEFT}" y="{top:.1f}" width="{INNER}" height="{height:.1f}" class="box"/>']
    every = 1 if height > 100.0 else 2
    for tick in y.ticks()[::every]:
        py = top + (1.0 - y.fraction(tick)) * height
        parts.append(f'<line x1="{LEFT}" y1="{py:.1f}" x2="{LEFT + INNER}" y2="{py:.1f}" class="grid"/>')
        parts.append(f'<text x="{LEFT - 6}" y="{py + 4:.1f}" text-anchor="end">{_format_number(tick)}</text>')
    middle = top + 0.5 * height
    parts.append(
        f'<text x="13" y="{middle:.1f}" text-anchor="middle" transform="rotate(-90 13 {middle:.1f})">'
        f"{html.escape(label)}</text>"
    )
    right = float(LEFT + INNER)
    for mark in reversed([each for each in marks if each.name]):
        right -= 6.3 * len(mark.name)
        parts.append(f'<text x="{right:.0f}" y="{top - 7:.1f}">{html.escape(mark.name)}</text>')
        parts.append(_render_legend(mark, right - 20.0, top - 11.0))
        right -= 38.0
    return parts


def _render_legend(mark: Mark, x: float, y: float) -> str:
    match mark:
        case Dots():
            return f'<circle cx="{x + 10:.0f}" cy="{y:.1f}" r="3" fill="{mark.color}"/>'
        case Band():
            return f'<rect x="{x:.0f}" y="{y - 4:.1f}" width="16" height="8" fill="{mark.color}" class="band"/>'
        case Curve():
            dashes = ' stroke-dasharray="5 3"' if mark.dashed else ""
            return (
                f'<line x1="{x:.0f}" y1="{y:.1f}" x2="{x + 16:.0f}" y2="{y:.1f}" stroke="{mark.color}" '
                f'stroke-width="2"{dashes}/>'
            )
        case HorizontalLine():
            return (
                f'<line x1="{x:.0f}" y1="{y:.1f}" x2="{x + 16:.0f}" y2="{y:.1f}" stroke="{mark.color}" '
                'stroke-dasharray="5 3"/>'
            )


def _render_marks(x: Axis, y: Axis, top: float, height: float, marks: Sequence[Mark]) -> list[str]:
    """Return the marks, clipped to the box by a nested SVG."""
    parts = [
        f'<svg x="{LEFT}" y="{top:.1f}" width="{INNER}" height="{height:.1f}" '
        f'viewBox="0 0 {INNER} {height:.1f}" overflow="hidden">'
    ]

    def px(value: float) -> float:
        return x.fraction(value) * INNER

    def py(value: float) -> float:
        return (1.0 - y.fraction(value)) * height

    for mark in marks:
        match mark:
            case Curve():
                parts += _render_curve(mark, px, py, y)
            case Band():
                parts += _render_band(mark, px, py)
            case Dots():
                parts.append(_render_dots(mark, px, py, y, height))
            case HorizontalLine():
                level = py(mark.y)
                parts.append(
                    f'<line x1="0" y1="{level:.1f}" x2="{INNER}" y2="{level:.1f}" stroke="{mark.color}" '
                    'stroke-dasharray="5 3"/>'
                )
    parts.append("</svg>")
    return parts


def _render_curve(mark: Curve, px: Place, py: Place, y: Axis) -> list[str]:
    pieces: list[list[tuple[float, float]]] = [[]]
    for a, b in zip(mark.x, mark.y, strict=True):
        if math.isfinite(a) and math.isfinite(b) and not (y.is_logarithmic and b <= 0.0):
            pieces[-1].append((px(a), py(b)))
        elif pieces[-1]:
            pieces.append([])
    dashes = ' stroke-dasharray="5 3"' if mark.dashed else ""
    return [
        f'<polyline points="{_format_points(decimate(piece))}" fill="none" stroke="{mark.color}" '
        f'stroke-width="{mark.width}" stroke-linejoin="round"{dashes}/>'
        for piece in pieces
        if len(piece) > 1
    ]


def _render_band(mark: Band, px: Place, py: Place) -> list[str]:
    pieces: list[list[tuple[float, float, float]]] = [[]]
    for a, low, high in zip(mark.x, mark.low, mark.high, strict=True):
        if math.isfinite(low) and math.isfinite(high):
            pieces[-1].append((px(a), py(low), py(high)))
        elif pieces[-1]:
            pieces.append([])
    found = []
    for piece in pieces:
        drawn: list[tuple[float, float, float]] = []
        for point in piece:
            if not drawn or point[0] - drawn[-1][0] >= 1.5:
                drawn.append(point)
        if len(drawn) > 1:
            there = _format_points([(a, low) for a, low, _ in drawn])
            back = _format_points([(a, high) for a, _, high in reversed(drawn)])
            found.append(f'<polygon points="{there} {back}" fill="{mark.color}" class="band"/>')
    return found


def _render_dots(mark: Dots, px: Place, py: Place, y: Axis, height: float) -> str:
    seen: dict[tuple[int, int], None] = {}
    for a, b in zip(mark.x, mark.y, strict=True):
        if math.isfinite(a) and math.isfinite(b):
            b = max(b, y.low) if y.is_logarithmic else b
            seen[round(px(a)), round(min(max(py(b), 1.0), height - 1.0))] = None
    # zero-length strokes with round caps: one element for thousands of points
    path = "".join(f"M{a} {b}h0" for a, b in seen)
    return f'<path d="{path}" stroke="{mark.color}" stroke-width="{mark.size}" stroke-linecap="round" fill="none"/>'


def decimate(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return a curve with at most the first, lowest, highest and last point of each run within one pixel column."""
    drawn: list[tuple[float, float]] = []
    run: list[tuple[float, float]] = []
    column = math.nan
    for point in points:
        if math.floor(point[0]) != column:
            drawn += _extremes(run)
            run, column = [], math.floor(point[0])
        run.append(point)
    return drawn + _extremes(run)


def _extremes(run: list[tuple[float, float]]) -> list[tuple[float, float]]:
    if len(run) <= 4:
        return run
    low = min(range(len(run)), key=lambda n: run[n][1])
    high = max(range(len(run)), key=lambda n: run[n][1])
    return [run[n] for n in sorted({0, low, high, len(run) - 1})]


def _format_points(points: Iterable[tuple[float, float]]) -> str:
    return " ".join(f"{a:.1f},{b:.1f}" for a, b in points)


def _render_time_ticks(x: Axis, bottom: float) -> list[str]:
    parts = [
        f'<text x="{LEFT + x.fraction(tick) * INNER:.1f}" y="{bottom + 14:.0f}" text-anchor="middle">{tick:g}</text>'
        for tick in x.ticks()
    ]
    parts.append(f'<text x="{LEFT + INNER / 2:.0f}" y="{bottom + 30:.0f}" text-anchor="middle">{x.label}</text>')
    return parts


def _format_number(value: float) -> str:
    return f"{value:.6g}" if value == 0.0 or 1e-4 <= abs(value) < 1e5 else f"{value:.0e}"
