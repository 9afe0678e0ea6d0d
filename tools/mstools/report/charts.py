"""Charts that one can touch, and an HTML page for them: one file that opens without internet.

A chart is a figure of plotly.js as JSON; the library's script is in the page, compressed (`page.js` draws the figures,
links their time axes and shows one time on all of them). Lines and bands are decimated to at most four points in each
of `COLUMNS` (first, lowest, highest, last) and dots to one per cell, so that the page stays small for a long recording.
"""

from __future__ import annotations

import base64
import gzip
import html
import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from modelserver.transforms.so3 import Array
from modelserver.version import __version__
from mstools.terminal.output import escape, require_extra

NEEDS_PLOTLY = "reports need plotly"

WIDTH = 1060
"""Width of a chart in pixels for which its height is chosen; it follows the page's."""

LEFT, RIGHT, BELOW = 80, 16, 46
INNER = WIDTH - LEFT - RIGHT
HEADER = 32
COLUMNS = 2000
ROWS = 400

BLUE, ORANGE, GREEN, PINK, SKY, AMBER, GRAY, RED = PALETTE = (
    *("#0072b2", "#d55e00", "#009e73", "#cc79a7"),
    *("#56b4e9", "#e69f00", "#8a8f98", "#c22f2f"),
)
"""Distinguishable with color blindness: M. Okabe and K. Ito, "Color Universal Design", 2008; gray and red added."""


@dataclass(frozen=True, slots=True)
class Axis:
    """An axis from `low` to `high`, powers of ten where `is_logarithmic`."""

    label: str
    low: float
    high: float
    is_logarithmic: bool = False

    def fraction(self, values: Array) -> Array:
        """Return the positions of values on the axis, 0 at the low end and 1 at the high end; nan without one."""
        low, high = self.low, self.high
        if self.is_logarithmic:
            values, low, high = np.log10(np.where(values > 0.0, values, np.nan)), math.log10(low), math.log10(high)
        return (values - low) / (high - low)


@dataclass(frozen=True, slots=True)
class Series:
    """Values over x, named in the legend; non-finite ones interrupt lines and bands.

    `high` are the upper values of a band, whose lower ones are `y`. `times` are the seconds of the points of a track on
    a map. Dots beyond the panel are drawn at its edge.
    """

    name: str
    x: Sequence[float] | Array
    y: Sequence[float] | Array
    color: str = BLUE
    width: float = 1.4
    shape: Literal["line", "dashes", "dots", "band"] = "line"
    high: Sequence[float] | Array = ()
    times: Sequence[float] = ()


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
    middle, half = 0.5 * (low + high), max(0.55 * (high - low), 0.5 * min_width)
    if half <= RESOLUTION * abs(middle):
        half = 0.1 * abs(middle) or 0.5
    return middle - half, middle + half


RESOLUTION = 1e-12
"""Relative range below which values count as constant: labels of ticks need some digits of double precision's 16."""


def level(name: str, x: Axis, y: float, color: str = GRAY) -> Series:
    return Series(name, (x.low, x.high), (y, y), color, shape="dashes")


def dots(name: str, points: Iterable[Sequence[float]], color: str, size: float) -> Series:
    """Return points as dots; only their first two coordinates count."""
    places = list(points)
    return Series(name, [each[0] for each in places], [each[1] for each in places], color, size, "dots")


# --- charts -------------------------------------------------------------------------------------------------


def render_panels(label: str, x: Axis, panels: Sequence[Panel], events: Sequence[tuple[float, str]] = ()) -> str:
    """Return panels above one another as HTML; `events` are vertical lines through all of them."""
    figure = make_panels_figure(x, panels, events)
    _fit_margin(figure["layout"])
    return _render_chart(label, figure, is_over_time=x.label.startswith("seconds"))


def render_map(label: str, x: str, y: str, series: Sequence[Series], heights: tuple[float, float] = (420, 900)) -> str:
    """Return a map with one scale for both axes, whose labels are `x` and `y`; its height fits within limits."""
    (west, east), (south, north) = spans = [
        value_range((value for each in series for value in getattr(each, axis)), min_width=2.0) for axis in "xy"
    ]
    height = min(max(INNER * (north - south) / (east - west), heights[0]), heights[1])
    axes = [Axis(name, low, high) for name, (low, high) in zip((x, y), spans, strict=True)]
    traces, layout = _make_panels(axes[0], [Panel("", axes[1], series, height)], ())
    layout["yaxis"] |= {"scaleanchor": "x", "scaleratio": 1}
    layout["hovermode"] = "closest"
    _fit_margin(layout)
    return _render_chart(label, {"data": traces, "layout": layout})


def render_strip(label: str, x: Axis, rows: Sequence[StripRow], events: Sequence[tuple[float, str]] = ()) -> str:
    figure = make_strip_figure(x, rows, events)
    _fit_margin(figure["layout"])
    return _render_chart(label, figure, is_over_time=True)


# --- figures of plotly.js


def make_panels_figure(x: Axis, panels: Sequence[Panel], events: Sequence[tuple[float, str]] = ()) -> dict[str, Any]:
    """Return the figure of `render_panels`."""
    traces, layout = _make_panels(x, panels, events)
    return {"data": traces, "layout": layout}


def make_strip_figure(x: Axis, rows: Sequence[StripRow], events: Sequence[tuple[float, str]] = ()) -> dict[str, Any]:
    """Return the figure of `render_strip`."""
    traces: list[dict[str, Any]] = [
        {
            "type": "bar",
            "orientation": "h",
            "base": [round(a, 3) for a, _, _ in row.intervals],
            "x": [round(b - a, 3) for a, b, _ in row.intervals],
            "y": [_to_text(row.name)] * len(row.intervals),
            "text": [_to_text(words) for _, _, words in row.intervals],
            "textposition": "none",
            "hovertemplate": "%{base:.1f} s, for %{x:.1f} s<br>%{text}<extra>%{y}</extra>",
            "marker": {"color": row.color},
            "showlegend": False,
        }
        for row in rows
    ]
    layout = {
        "height": 24 * len(rows) + BELOW + 12,
        "margin": {"l": 190, "r": RIGHT, "t": 8, "b": BELOW},
        "barmode": "overlay",
        "bargap": 0.35,
        "hovermode": "closest",
        "xaxis": _make_axis(x),
        "yaxis": {
            "categoryarray": [_to_text(row.name) for row in rows],
            "categoryorder": "array",
            "autorange": "reversed",
            "fixedrange": True,
        },
        "shapes": [_make_event_line(when) for when, _ in events],
    }
    return {"data": traces, "layout": layout}


# --- parts of a figure ---


def _make_panels(
    x: Axis, panels: Sequence[Panel], events: Sequence[tuple[float, str]]
) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Return traces and layout of panels with a common x axis, the first at the top."""
    inner = sum(each.height for each in panels) + HEADER * (len(panels) - 1)
    traces: list[dict[str, Any]] = []
    layout: dict[str, Any] = {
        "height": round(inner + HEADER + BELOW),
        "margin": {"l": LEFT, "r": RIGHT, "t": HEADER, "b": BELOW},
        "hovermode": "x unified",
        "separators": SEPARATORS,
        "annotations": [],
        "shapes": [_make_event_line(when) for when, _ in events],
    }
    top = 1.0
    for number, panel in enumerate(panels, 1):
        suffix = "" if number == 1 else str(number)
        bottom = max(top - panel.height / inner, 0.0)
        layout[f"yaxis{suffix}"] = _make_axis(panel.y) | {"domain": [bottom, top], "anchor": "x"}
        layout[f"legend{suffix}"] = {"orientation": "h", "x": 1, "xanchor": "right", "y": top, "yanchor": "bottom"}
        title = {"text": f"<b>{_to_text(panel.title)}</b>", "x": 0, "xanchor": "left", "y": top, "yanchor": "bottom"}
        layout["annotations"].append(title | {"xref": "paper", "yref": "paper", "showarrow": False})
        place = {"xaxis": "x", "yaxis": f"y{suffix}", "legend": f"legend{suffix}"}
        traces += [trace | place for series in panel.series for trace in _make_traces(series, x, panel.y)]
        top = bottom - HEADER / inner
    if events:
        where = [panels[0].y.high] * len(events)
        marks = {"x": [when for when, _ in events], "y": where, "text": [_to_text(words) for _, words in events]}
        style = {"mode": "markers", "marker": {"symbol": "triangle-down", "size": 9, "color": EVENT_COLOR}}
        traces.append(marks | style | {"hovertemplate": "%{text}<extra></extra>", "showlegend": False})
    layout["xaxis"] = _make_axis(x) | {"anchor": f"y{len(panels) if len(panels) > 1 else ''}"}
    return traces, layout


EVENT_COLOR = "#7a4fb5"

SEPARATORS = ".\u2009"
"""Of decimals and thousands: a point and a thin space."""

SMALL = 1e-3
"""Size of an axis's values below which its labels have a power of ten: with more zeros they are hard to read."""


def _fit_margin(layout: dict[str, Any]) -> None:
    """Let the left margin be as wide as the labels of the y axes need: a telephone has no room for more."""
    layout["margin"]["l"] = 8
    for name in layout:
        if name.startswith("yaxis"):
            layout[name]["automargin"] = "width"


def _make_event_line(when: float) -> dict[str, Any]:
    ends = {"x0": when, "x1": when, "y0": 0, "y1": 1, "yref": "paper"}
    return {"type": "line", **ends, "line": {"color": EVENT_COLOR, "width": 1, "dash": "dot"}}


def _make_axis(axis: Axis) -> dict[str, Any]:
    title = {"title": {"text": _to_text(axis.label), "standoff": 8}}
    if axis.is_logarithmic:
        return title | {
            "type": "log",
            "range": [math.log10(axis.low), math.log10(axis.high)],
            "exponentformat": "power",
            "hoverformat": ".4~r",
        }
    # as numbers: with a prefix (16µ, 4.693742M) a label is no value in the axis's unit. Of very small ones a power
    is_small = max(abs(axis.low), abs(axis.high)) < SMALL
    # values below the pointer have digits for a thousandth of the axis, at least
    decimals = 3 - math.floor(math.log10(axis.high - axis.low)) if axis.high > axis.low else 6
    form = {
        "exponentformat": "power" if is_small else "none",
        "hoverformat": ".6~g" if is_small else f".{max(decimals, 0)}~f",
    }
    return title | form | {"range": [axis.low, axis.high], "zeroline": False}


def _make_traces(series: Series, x: Axis, y: Axis) -> list[dict[str, Any]]:
    """Return the traces of a series: one, for a band its two edges."""
    name = {"name": _to_text(series.name), "showlegend": bool(series.name)}
    if not series.name:
        name["hoverinfo"] = "skip" if series.shape == "band" else "y"
    points = np.column_stack([np.asarray(series.x, float), np.asarray(series.y, float)])
    if series.shape == "dots":
        points = points[_select_dots(points, x, y)]
        points[:, 1] = np.clip(points[:, 1], y.low, y.high)
        style: dict[str, Any] = {"mode": "markers", "marker": {"color": series.color, "size": series.width + 1.0}}
        return [_make_trace(points) | name | style]
    if series.shape == "band":
        upper = np.column_stack([points[:, 0], np.asarray(series.high, float)])
        edge = {"mode": "lines", "line": {"width": 0, "color": series.color}, "hoverinfo": "skip"}
        fill = {"fill": "tonexty", "fillcolor": f"rgba({','.join(map(str, bytes.fromhex(series.color[1:])))},0.22)"}
        shown = {"showlegend": False, "legendgroup": series.name}
        return [
            _make_trace(_decimate(points, x)) | edge | shown,
            _make_trace(_decimate(upper, x)) | name | edge | fill | {"legendgroup": series.name},
        ]
    line = {"color": series.color, "width": series.width, "dash": "dash" if series.shape == "dashes" else "solid"}
    if series.times:
        # a point that interrupts a line has no time
        times = [None if math.isnan(each) else round(each, 2) for each in series.times]
        hover = "%{customdata} s<br>%{x:.2f}, %{y:.2f} m<extra>%{fullData.name}</extra>"
        name |= {"customdata": times, "hovertemplate": hover}
    else:
        # a track goes to and fro: no column of it can be decimated
        points = _decimate(points, x)
    return [_make_trace(points) | name | {"mode": "lines", "line": line}]


def _make_trace(points: Array) -> dict[str, Any]:
    return {"type": "scatter", "x": _encode(points[:, 0]), "y": _encode(points[:, 1])}


def _encode(values: Array) -> dict[str, str]:
    """Return numbers as plotly.js reads them: in base64, nan interrupts a line.

    In single precision where that rounds by less than 1e-4 of their range, a tenth of a pixel of `WIDTH`.
    """
    numbers = np.where(np.isfinite(values), values, np.nan)
    known = numbers[np.isfinite(numbers)]
    error = np.abs(known - known.astype("<f4")).max() if len(known) else 0.0
    kind = "f4" if error <= 1e-4 * (np.ptp(known) if len(known) else 0.0) else "f8"
    return {"dtype": kind, "bdata": base64.b64encode(numbers.astype(f"<{kind}").tobytes()).decode()}


def _to_text(words: str) -> str:
    """Return words as plotly.js reads them, which knows some tags."""
    return html.escape(words, quote=False)


def _select_dots(points: Array, x: Axis, y: Axis) -> npt.NDArray[np.intp]:
    """Return the numbers of the finite points, one of each cell of the panel."""
    rows = np.clip(y.fraction(points[:, 1]), 0.0, 1.0) * ROWS
    cells = np.round(np.column_stack([x.fraction(points[:, 0]) * COLUMNS, rows]))
    finite = np.flatnonzero(np.isfinite(cells).all(axis=1) & np.isfinite(points[:, 1]))
    _, first = np.unique(cells[finite], axis=0, return_index=True)
    return finite[np.sort(first)]


def _decimate(points: Array, x: Axis) -> Array:
    return points if len(points) <= COLUMNS else decimate(points, np.floor(x.fraction(points[:, 0]) * COLUMNS))


def decimate(points: Array, columns: Array) -> Array:
    """Return at most the first, lowest, highest and last point (x, y) of each run in one column; nan stays a gap."""
    gaps = np.isnan(points[:, 1])
    begins = np.flatnonzero((columns[1:] != columns[:-1]) | (gaps[1:] != gaps[:-1])) + 1
    chosen: list[int] = []
    for run in np.split(np.arange(len(points)), begins):
        y = points[run, 1]
        chosen += sorted({run[0], run[y.argmin()], run[y.argmax()], run[-1]})
    return points[chosen]


def encode_json(value: object) -> str:
    """Return a figure, or what else a page reads, as JSON. Raises ValueError for numbers that JSON does not have."""
    return json.dumps(value, allow_nan=False, separators=(",", ":"))


def _render_chart(label: str, figure: dict[str, Any], is_over_time: bool = False) -> str:
    """Return a chart as HTML: an element of its height with the figure in JSON."""
    time = " data-time" if is_over_time else ""
    height = f"height:{figure['layout']['height']}px"
    attributes = f'class="chart" role="img" aria-label="{html.escape(label)}"{time} style="{height}"'
    # within HTML nothing may look like the end of the script
    inside = encode_json(figure).replace("<", "\\u003c")
    return f'<div {attributes}><script type="application/json">{inside}</script></div>'


# --- page ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Answer:
    """What a report has to answer, at its top: how good it is (`good`, or a severity), a headline, and few lines."""

    tone: str
    headline: str
    lines: Sequence[str] = ()


def render_answer(answer: Answer) -> str:
    lines = "".join(f"<p>{escape_text(each)}</p>" for each in answer.lines)
    return f'<div class="answer {answer.tone}"><strong>{escape_text(answer.headline)}</strong>{lines}</div>\n'


def render_text(lines: Iterable[str]) -> str:
    return f"<pre>{html.escape(chr(10).join(lines))}</pre>"


def escape_text(text: str) -> str:
    return html.escape(escape(text))


def render_figure(chart: str, caption: str) -> str:
    return f"<figure>{chart}<figcaption>{caption}</figcaption></figure>"


def render_table(head: Sequence[str], rows: Sequence[Sequence[str]], numbers: Iterable[int] = ()) -> str:
    right = frozenset(numbers)

    def cells(row: Sequence[str], tag: str) -> str:
        return "".join(
            f"<{tag}{' class=n' if n in right else ''}>{escape_text(each)}</{tag}>" for n, each in enumerate(row)
        )

    body = "\n".join(f"<tr>{cells(row, 'td')}</tr>" for row in rows)
    return f"<table><thead><tr>{cells(head, 'th')}</tr></thead>\n<tbody>{body}</tbody></table>"


def render_key_figures(figures: Iterable[tuple[str, str]]) -> str:
    """Return values with what they are, in large type."""
    cells = "".join(f"<div><strong>{value}</strong><span>{what}</span></div>" for value, what in figures)
    return f'<div class="figures">{cells}</div>'


def render_report(
    title: str, heads: Sequence[str], summary: str, sections: Sequence[tuple[str, str, str]], about: str
) -> str:
    """Return a page of sections (name, title, HTML) below a summary, with links to them. Raises as `render_page`.

    heads: kind of the report, its subject, and lines below, as text; summary: HTML, the answer and key figures; about:
    what explains it.
    """
    kicker, subject, *lines = map(escape_text, heads)
    links = " ".join(f'<a href="#{name}">{title}</a>' for name, title, _ in sections)
    body = "\n".join(f'<section id="{name}"><h2>{title}</h2>\n{text}\n</section>' for name, title, text in sections)
    below = "".join(f"<p>{line}</p>\n" for line in lines)
    top = f'<p class="kicker">{kicker}</p>\n<h1>{subject}</h1>\n{below}{summary}\n<nav>{links}</nav>'
    head = f"<header>\n{top}\n</header>\n"
    foot = f"\n<footer>modelserver {__version__}; {about}</footer>"
    return render_page(escape(title), head + body + foot)


def read_plotly() -> bytes:
    """Return the script of plotly.js. Raises ModelServerError without the extra `report`."""
    require_extra("report", NEEDS_PLOTLY)
    return (files("plotly") / "package_data" / "plotly.min.js").read_bytes()


def render_page(title: str, body: str) -> str:
    """Return an HTML page; `title` is text, `body` HTML. Raises ModelServerError without the extra `report`."""
    library = base64.b64encode(gzip.compress(read_plotly(), 9, mtime=0)).decode()
    own = files("mstools.report")
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{html.escape(title)}</title>
<style>
{(own / "page.css").read_text()}</style>
</head>
<body>
<button id="theme" type="button">Dark</button>
{body}
<script id="plotly" type="text/plain">{library}</script>
<script>
{(own / "charts.js").read_text()}</script>
<script>
{(own / "page.js").read_text()}</script>
</body>
</html>
"""
