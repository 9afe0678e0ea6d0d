"""Wide drawings over one time axis, and maps at one scale, as SVG text: panels of curves, dots, bands and stretches.

However many points there are, a curve is drawn with at most four a pixel column and dots with at most one a pixel, so
a long recording makes no large page. Nothing is loaded, and nothing moves.
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
HEAD = 22

BLUE, ORANGE, GREEN, PINK, SKY, AMBER, GREY, RED = (
    *("#0072b2", "#d55e00", "#009e73", "#cc79a7"),
    *("#56b4e9", "#e69f00", "#8a8f98", "#c22f2f"),
)
"""Told apart by the colour-blind as well: M. Okabe and K. Ito, "Color Universal Design", 2008; grey and red added."""

PALETTE = (BLUE, ORANGE, GREEN, PINK, SKY, AMBER, GREY, RED)

Numbers: TypeAlias = Sequence[float]
Place: TypeAlias = Callable[[float], float]


@dataclass(frozen=True, slots=True)
class Curve:
    """A line through points; nan interrupts it."""

    name: str
    x: Numbers
    y: Numbers
    colour: str = BLUE
    width: float = 1.4
    dashed: bool = False


@dataclass(frozen=True, slots=True)
class Dots:
    """Points by themselves; those beyond the panel are drawn at its edge."""

    name: str
    x: Numbers
    y: Numbers
    colour: str = BLUE
    size: float = 2.6


@dataclass(frozen=True, slots=True)
class Band:
    """The area between two lines."""

    name: str
    x: Numbers
    low: Numbers
    high: Numbers
    colour: str = BLUE


@dataclass(frozen=True, slots=True)
class Level:
    """A horizontal line."""

    name: str
    y: float
    colour: str = GREY


Mark: TypeAlias = Curve | Dots | Band | Level


@dataclass(frozen=True, slots=True)
class Panel:
    """What stands above one another on one time axis: a heading, the y axis, and what is drawn, first at the back."""

    title: str
    y: Axis
    marks: Sequence[Mark]
    height: float = 120.0


@dataclass(frozen=True, slots=True)
class StripRow:
    """A row of a strip: stretches (from, to, what is said where the pointer rests) on a line with a name."""

    name: str
    stretches: Sequence[tuple[float, float, str]]
    colour: str


def spread(values: Iterable[float], share: float = 1.0, least: float = 0.0) -> tuple[float, float]:
    """Return a range that holds the middle `share` of the finite values, with a margin, `least` wide or more."""
    known = sorted(value for value in values if math.isfinite(value))
    if not known:
        return (-0.5 * (least or 1.0), 0.5 * (least or 1.0))
    cut = int(0.5 * (1.0 - share) * len(known))
    low, high = known[cut], known[-1 - cut]
    middle, half = 0.5 * (low + high), max(0.55 * (high - low), 0.5 * least, 1e-9)
    return middle - half, middle + half


def stack(
    label: str, begin: float, end: float, panels: Sequence[Panel], events: Sequence[tuple[float, str]] = ()
) -> str:
    """Return an SVG of panels above one another over seconds; `events` are upright lines through all of them."""
    x = Axis("seconds from the log's first event", begin, max(end, begin + 1e-3))
    height = sum(HEAD + each.height + GAP for each in panels) + 34
    parts = [_open(label, height)]
    top = 0.0
    for panel in panels:
        parts += _panel(panel, x, top, events)
        top += HEAD + panel.height + GAP
    parts += _time_ticks(x, top - GAP)
    parts.append("</svg>")
    return "\n".join(parts)


def strip(
    label: str, begin: float, end: float, rows: Sequence[StripRow], events: Sequence[tuple[float, str]] = ()
) -> str:
    """Return an SVG of rows with stretches over seconds."""
    x = Axis("seconds from the log's first event", begin, max(end, begin + 1e-3))
    pitch, left = 24.0, 190.0
    inner = WIDTH - left - RIGHT
    parts = [_open(label, pitch * len(rows) + 40)]

    def at(value: float) -> float:
        return left + min(max(x.share(value), 0.0), 1.0) * inner

    bottom = 4.0 + pitch * len(rows)
    for tick in x.ticks():
        parts.append(f'<line x1="{at(tick):.1f}" y1="2" x2="{at(tick):.1f}" y2="{bottom:.0f}" class="grid"/>')
        parts.append(f'<text x="{at(tick):.1f}" y="{bottom + 15:.0f}" text-anchor="middle">{tick:g}</text>')
    for number, row in enumerate(rows):
        y = 4.0 + pitch * number
        parts.append(f'<text x="{left - 8}" y="{y + 15:.0f}" text-anchor="end">{html.escape(row.name)}</text>')
        parts.append(f'<rect x="{left}" y="{y + 4:.0f}" width="{inner}" height="14" class="track"/>')
        for first, last, words in row.stretches:
            width = max(at(last) - at(first), 1.5)
            title = f"<title>{html.escape(words)}</title>" if words else ""
            parts.append(
                f'<rect x="{at(first):.1f}" y="{y + 4:.0f}" width="{width:.1f}" height="14" '
                f'fill="{row.colour}">{title}</rect>'
            )
    for when, words in events:
        parts.append(
            f'<line x1="{at(when):.1f}" y1="2" x2="{at(when):.1f}" y2="{bottom:.0f}" class="event">'
            f"<title>{html.escape(words)}</title></line>"
        )
    parts.append(f'<text x="{left + inner / 2:.0f}" y="{bottom + 32:.0f}" text-anchor="middle">{x.label}</text>')
    parts.append("</svg>")
    return "\n".join(parts)


def plan(label: str, marks: Sequence[Curve | Dots], lowest: float = 420.0, highest: float = 900.0) -> str:
    """Return an SVG map: east to the right, north up, metres, one scale for both; as high as fits, within limits."""
    xs = [value for mark in marks for value in mark.x if math.isfinite(value)]
    ys = [value for mark in marks for value in mark.y if math.isfinite(value)]
    (x_low, x_high), (y_low, y_high) = spread(xs, least=2.0), spread(ys, least=2.0)
    inner = min(max(INNER * (y_high - y_low) / (x_high - x_low), lowest), highest)
    height = inner + HEAD + 44
    scale = min(INNER / (x_high - x_low), inner / (y_high - y_low))
    half_x, half_y = 0.5 * INNER / scale, 0.5 * inner / scale
    x_mid, y_mid = 0.5 * (x_low + x_high), 0.5 * (y_low + y_high)
    x = Axis("east of the origin, m", x_mid - half_x, x_mid + half_x)
    y = Axis("north of the origin, m", y_mid - half_y, y_mid + half_y)
    parts = [_open(label, height)]
    parts += _frame(x, y, HEAD, inner, marks, y.label)
    # the same steps both ways: a square on the ground is a square here
    step = (y.ticks()[1] - y.ticks()[0]) if len(y.ticks()) > 1 else 1.0
    for n in range(math.ceil(x.low / step), math.floor(x.high / step) + 1):
        px = LEFT + x.share(n * step) * INNER
        parts.append(f'<line x1="{px:.1f}" y1="{HEAD}" x2="{px:.1f}" y2="{HEAD + inner:.0f}" class="grid"/>')
        parts.append(f'<text x="{px:.1f}" y="{HEAD + inner + 15:.0f}" text-anchor="middle">{n * step:g}</text>')
    parts += _inside(x, y, HEAD, inner, marks)
    parts.append(f'<text x="{LEFT + INNER / 2:.0f}" y="{height - 8:.0f}" text-anchor="middle">{x.label}</text>')
    parts.append("</svg>")
    return "\n".join(parts)


# --- parts --------------------------------------------------------------------------------------------------


def _open(label: str, height: float) -> str:
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height:.0f}" role="img" '
        f'aria-label="{html.escape(label)}">'
    )


def _panel(panel: Panel, x: Axis, top: float, events: Sequence[tuple[float, str]]) -> list[str]:
    y0 = top + HEAD
    parts = [f'<text x="{LEFT}" y="{top + 15:.0f}" class="title">{html.escape(panel.title)}</text>']
    parts += _frame(x, panel.y, y0, panel.height, panel.marks, panel.y.label)
    for tick in x.ticks():
        px = LEFT + x.share(tick) * INNER
        parts.append(f'<line x1="{px:.1f}" y1="{y0:.1f}" x2="{px:.1f}" y2="{y0 + panel.height:.1f}" class="grid"/>')
    parts += _inside(x, panel.y, y0, panel.height, panel.marks)
    for when, words in events:
        px = LEFT + x.share(when) * INNER
        parts.append(
            f'<line x1="{px:.1f}" y1="{y0:.1f}" x2="{px:.1f}" y2="{y0 + panel.height:.1f}" class="event">'
            f"<title>{html.escape(words)}</title></line>"
        )
    return parts


def _frame(x: Axis, y: Axis, top: float, height: float, marks: Sequence[Mark], label: str) -> list[str]:
    """Return the box, the y axis with its ticks and the key, which stands at the right above the box."""
    parts = [f'<rect x="{LEFT}" y="{top:.1f}" width="{INNER}" height="{height:.1f}" class="box"/>']
    every = 1 if height > 100.0 else 2
    for tick in y.ticks()[::every]:
        py = top + (1.0 - y.share(tick)) * height
        parts.append(f'<line x1="{LEFT}" y1="{py:.1f}" x2="{LEFT + INNER}" y2="{py:.1f}" class="grid"/>')
        parts.append(f'<text x="{LEFT - 6}" y="{py + 4:.1f}" text-anchor="end">{_number(tick)}</text>')
    middle = top + 0.5 * height
    parts.append(
        f'<text x="13" y="{middle:.1f}" text-anchor="middle" transform="rotate(-90 13 {middle:.1f})">'
        f"{html.escape(label)}</text>"
    )
    right = float(LEFT + INNER)
    for mark in reversed([each for each in marks if each.name]):
        right -= 6.3 * len(mark.name)
        parts.append(f'<text x="{right:.0f}" y="{top - 7:.1f}">{html.escape(mark.name)}</text>')
        parts.append(_key(mark, right - 20.0, top - 11.0))
        right -= 38.0
    return parts


def _key(mark: Mark, x: float, y: float) -> str:
    match mark:
        case Dots():
            return f'<circle cx="{x + 10:.0f}" cy="{y:.1f}" r="3" fill="{mark.colour}"/>'
        case Band():
            return f'<rect x="{x:.0f}" y="{y - 4:.1f}" width="16" height="8" fill="{mark.colour}" class="band"/>'
        case Curve():
            dashes = ' stroke-dasharray="5 3"' if mark.dashed else ""
            return (
                f'<line x1="{x:.0f}" y1="{y:.1f}" x2="{x + 16:.0f}" y2="{y:.1f}" stroke="{mark.colour}" '
                f'stroke-width="2"{dashes}/>'
            )
        case Level():
            return (
                f'<line x1="{x:.0f}" y1="{y:.1f}" x2="{x + 16:.0f}" y2="{y:.1f}" stroke="{mark.colour}" '
                'stroke-dasharray="5 3"/>'
            )


def _inside(x: Axis, y: Axis, top: float, height: float, marks: Sequence[Mark]) -> list[str]:
    """Return what is drawn, cut off at the box: an SVG within an SVG does that."""
    parts = [
        f'<svg x="{LEFT}" y="{top:.1f}" width="{INNER}" height="{height:.1f}" '
        f'viewBox="0 0 {INNER} {height:.1f}" overflow="hidden">'
    ]

    def px(value: float) -> float:
        return x.share(value) * INNER

    def py(value: float) -> float:
        return (1.0 - y.share(value)) * height

    for mark in marks:
        match mark:
            case Curve():
                parts += _curve(mark, px, py, y)
            case Band():
                parts += _band(mark, px, py)
            case Dots():
                parts.append(_dots(mark, px, py, y, height))
            case Level():
                level = py(mark.y)
                parts.append(
                    f'<line x1="0" y1="{level:.1f}" x2="{INNER}" y2="{level:.1f}" stroke="{mark.colour}" '
                    'stroke-dasharray="5 3"/>'
                )
    parts.append("</svg>")
    return parts


def _curve(mark: Curve, px: Place, py: Place, y: Axis) -> list[str]:
    pieces: list[list[tuple[float, float]]] = [[]]
    for a, b in zip(mark.x, mark.y, strict=True):
        if math.isfinite(a) and math.isfinite(b) and not (y.logarithmic and b <= 0.0):
            pieces[-1].append((px(a), py(b)))
        elif pieces[-1]:
            pieces.append([])
    dashes = ' stroke-dasharray="5 3"' if mark.dashed else ""
    return [
        f'<polyline points="{_points(thinned(piece))}" fill="none" stroke="{mark.colour}" '
        f'stroke-width="{mark.width}" stroke-linejoin="round"{dashes}/>'
        for piece in pieces
        if len(piece) > 1
    ]


def _band(mark: Band, px: Place, py: Place) -> list[str]:
    pieces: list[list[tuple[float, float, float]]] = [[]]
    for a, low, high in zip(mark.x, mark.low, mark.high, strict=True):
        if math.isfinite(low) and math.isfinite(high):
            pieces[-1].append((px(a), py(low), py(high)))
        elif pieces[-1]:
            pieces.append([])
    found = []
    for piece in pieces:
        kept: list[tuple[float, float, float]] = []
        for point in piece:
            if not kept or point[0] - kept[-1][0] >= 1.5:
                kept.append(point)
        if len(kept) > 1:
            there = _points([(a, low) for a, low, _ in kept])
            back = _points([(a, high) for a, _, high in reversed(kept)])
            found.append(f'<polygon points="{there} {back}" fill="{mark.colour}" class="band"/>')
    return found


def _dots(mark: Dots, px: Place, py: Place, y: Axis, height: float) -> str:
    seen: dict[tuple[int, int], None] = {}
    for a, b in zip(mark.x, mark.y, strict=True):
        if math.isfinite(a) and math.isfinite(b):
            b = max(b, y.low) if y.logarithmic else b
            seen[round(px(a)), round(min(max(py(b), 1.0), height - 1.0))] = None
    # strokes of no length with round ends: one element for thousands of points
    path = "".join(f"M{a} {b}h0" for a, b in seen)
    return f'<path d="{path}" stroke="{mark.colour}" stroke-width="{mark.size}" stroke-linecap="round" fill="none"/>'


def thinned(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return a curve with at most the first, lowest, highest and last point of each run within one pixel column.

    A curve that goes to and fro, like a track on a map, keeps its turns: a run ends where it leaves the column.
    """
    kept: list[tuple[float, float]] = []
    run: list[tuple[float, float]] = []
    column = math.nan
    for point in points:
        if math.floor(point[0]) != column:
            kept += _ends(run)
            run, column = [], math.floor(point[0])
        run.append(point)
    return kept + _ends(run)


def _ends(run: list[tuple[float, float]]) -> list[tuple[float, float]]:
    if len(run) <= 4:
        return run
    low = min(range(len(run)), key=lambda n: run[n][1])
    high = max(range(len(run)), key=lambda n: run[n][1])
    return [run[n] for n in sorted({0, low, high, len(run) - 1})]


def _points(points: Iterable[tuple[float, float]]) -> str:
    return " ".join(f"{a:.1f},{b:.1f}" for a, b in points)


def _time_ticks(x: Axis, bottom: float) -> list[str]:
    parts = [
        f'<text x="{LEFT + x.share(tick) * INNER:.1f}" y="{bottom + 14:.0f}" text-anchor="middle">{tick:g}</text>'
        for tick in x.ticks()
    ]
    parts.append(f'<text x="{LEFT + INNER / 2:.0f}" y="{bottom + 30:.0f}" text-anchor="middle">{x.label}</text>')
    return parts


def _number(value: float) -> str:
    return f"{value:.6g}" if value == 0.0 or 1e-4 <= abs(value) < 1e5 else f"{value:.0e}"
