"""What a drive has over time, as charts: motion, uncertainty, innovations, rates and latencies, validity, states.

A chart shows a span of a drive, in seconds after its begin. Its lines are decimated by extremes to the span, so that an
hour of 200 Hz is drawn as fast as a minute, and a zoom shows what is in it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from modelserver.messages import Invalid
from modelserver.transforms.so3 import Array
from modelserver.wire.channels import BY_NAME, ChannelUse
from mstools.recordings.drive import EPOCH, HORIZONTAL, INVALID, QUATERNION, Drive, Table
from mstools.recordings.pose_signals import MAX_GAP_US, compute_headings, compute_sigmas, compute_speeds
from mstools.report import charts
from mstools.report.charts import Axis, Panel, Series, StripRow

SHOWN_SHARE: Final = 0.995
"""Share of the values that an axis has: a jump of the pose, as at its alignment, would flatten the rest."""

LEFT: Final = 170
"""Pixels left of the charts: the names of the reasons, and the same for all, so that times are below one another."""

STATE: Final = "state "
"""What precedes the names of the filter's states among the charts."""


@dataclass(frozen=True)
class Span:
    """The span of a chart: `begin` and `end` in microseconds, of a drive that begins at `zero`."""

    begin: int
    end: int
    zero: int

    def select(self, table: Table) -> tuple[npt.NDArray[np.int64], Array]:
        """Return times and rows of a table within the span, and one beyond each of its ends."""
        first, last = np.searchsorted(table.utimes, (self.begin, self.end))
        chosen = slice(max(int(first) - 1, 0), int(last) + 1)
        return table.utimes[chosen], table.rows[chosen]

    def to_seconds(self, utimes: npt.NDArray[np.int64]) -> Array:
        return np.asarray((utimes - self.zero) * 1e-6, np.float64)

    @property
    def axis(self) -> Axis:
        return Axis("seconds", (self.begin - self.zero) * 1e-6, (self.end - self.zero) * 1e-6)


def list_charts(drive: Drive) -> list[str]:
    """Return the names of the charts that a drive has."""
    navigation = drive.get_report("LOCALIZATION_STATE")
    states = navigation.names if navigation is not None else ()
    return [*CHARTS, *(f"{STATE}{each}" for each in states)]


def make_panels(drive: Drive, span: Span, names: Sequence[str]) -> dict[str, Any]:
    """Return charts of a drive as a figure of plotly.js; unknown names are left out."""
    panels = [
        _make_state(drive, span, name.removeprefix(STATE)) if name.startswith(STATE) else CHARTS[name](drive, span)
        for name in names
        if name in CHARTS or name.startswith(STATE)
    ]
    figure = charts.make_panels_figure(span.axis, panels)
    figure["layout"]["margin"]["l"] = LEFT
    return figure


def make_strip(drive: Drive, span: Span) -> dict[str, Any]:
    """Return the validity of the pose with its reasons as a figure of plotly.js."""
    utimes, rows = span.select(drive.poses)
    flags = rows[:, INVALID].astype(np.int64)

    def row(name: str, chosen: npt.NDArray[np.bool_], color: str, words: str = "") -> StripRow:
        found = [(begin, end, words) for begin, end in _find_intervals(span, utimes, chosen)]
        return StripRow(name, found, color)

    reasons = [
        row(str(flag.name).lower(), (flags & flag.value) != 0, charts.RED, flag.explain())
        for flag in Invalid
        if np.any(flags & flag.value)
    ]
    figure = charts.make_strip_figure(span.axis, [row("valid", flags == 0, charts.GREEN), *reasons])
    layout = figure["layout"]
    # its time axis is that of the charts below
    layout["height"] -= charts.BELOW
    layout["margin"] |= {"l": LEFT, "b": 2}
    layout["xaxis"] |= {"title": None, "showticklabels": False}
    return figure


def _find_intervals(
    span: Span, utimes: npt.NDArray[np.int64], chosen: npt.NDArray[np.bool_]
) -> list[tuple[float, float]]:
    """Return the intervals in which rows are chosen, seconds; a row lasts until the next one, or for a gap at most."""
    if not len(utimes):
        return []
    ends = np.minimum(np.append(utimes[1:], max(span.end, int(utimes[-1]))), utimes + MAX_GAP_US)
    joined = np.append(False, chosen[1:] & chosen[:-1] & (ends[:-1] == utimes[1:]))
    firsts = np.flatnonzero(chosen & ~joined)
    lasts = np.flatnonzero(chosen & ~np.append(joined[1:], False))
    begins, closes = span.to_seconds(utimes[firsts]), span.to_seconds(ends[lasts])
    low, high = span.axis.low, span.axis.high
    return [
        (max(begin, low), min(end, high)) for begin, end in zip(begins, closes, strict=True) if end > low < high > begin
    ]


# --- poses


def _interrupt(x: Array, *values: Array, at: npt.NDArray[np.bool_]) -> tuple[Array, ...]:
    """Return times and values with nan inserted before the marked rows, which interrupts lines."""
    where = np.flatnonzero(at)
    return np.insert(x, where, x[where]), *(np.insert(each, where, math.nan) for each in values)


def _select_poses(table: Table, span: Span) -> tuple[npt.NDArray[np.int64], Array, npt.NDArray[np.bool_]]:
    """Return times and rows of poses, and before which of them lines are interrupted."""
    utimes, rows = span.select(table)
    return (
        utimes,
        rows,
        np.append(False, (np.diff(utimes) > MAX_GAP_US) | (np.diff(rows[:, EPOCH]) != 0))[: len(utimes)],
    )


def _make_axis(label: str, values: Sequence[Array], least: float, floor: float | None = None) -> Axis:
    """Return an axis around the finite values, at least `least` wide, and from `floor` upwards if given."""
    known = np.concatenate([np.asarray(each, float) for each in values] or [np.zeros(0)])
    known = known[np.isfinite(known)]
    tail = 0.5 * (1.0 - SHOWN_SHARE)
    low, high = charts.value_range(np.quantile(known, (tail, 1.0 - tail)) if len(known) else (), min_width=least)
    if floor is not None:
        return Axis(label, floor, max(high, floor + least))
    return Axis(label, low, high)


# --- charts


def _make_speed(drive: Drive, span: Span) -> Panel:
    utimes, rows, cut = _select_poses(drive.motion, span)
    x, y = _interrupt(span.to_seconds(utimes), compute_speeds(utimes, rows), at=cut)
    return Panel("Speed", _make_axis("m/s", [y], 1.0, 0.0), [Series("", x, y)])


def _make_heading(drive: Drive, span: Span) -> Panel:
    utimes, rows, cut = _select_poses(drive.poses, span)
    headings = compute_headings(rows[:, QUATERNION])
    cut = cut | np.append(False, np.abs(np.diff(headings)) > 180.0)[: len(cut)]
    x, y = _interrupt(span.to_seconds(utimes), headings, at=cut)
    return Panel("Heading (from grid north)", _make_axis("deg", [y], 5.0), [Series("", x, y)])


def _make_uncertainty(drive: Drive, span: Span) -> Panel:
    utimes, rows, cut = _select_poses(drive.poses, span)
    x, sigma, level = _interrupt(span.to_seconds(utimes), compute_sigmas(rows), rows[:, HORIZONTAL], at=cut)
    series = [Series("protection level", x, level, charts.ORANGE), Series("sigma", x, sigma, charts.BLUE)]
    return Panel("Horizontal uncertainty", _make_axis("m", [sigma, level], 0.1, 0.0), series)


def _make_nis(drive: Drive, span: Span) -> Panel:
    found = {name: span.select(table) for name, table in sorted(drive.nis.items())}
    values = [rows[:, 0] for _, rows in found.values()]
    series = [
        charts.level("expected", span.axis, 1.0),
        *(
            Series(name, span.to_seconds(utimes), rows[:, 0], _choose_color(n), 3.0, "dots")
            for n, (name, (utimes, rows)) in enumerate(found.items())
        ),
    ]
    return Panel(
        "Innovations: NIS per degree of freedom", charts.decade_axis("", np.concatenate([[1.0], *values])), series
    )


def _make_rates(drive: Drive, span: Span) -> Panel:
    return _make_channels(drive, span, "Rates of sensors", "Hz", 0, 1.0)


def _make_latencies(drive: Drive, span: Span) -> Panel:
    return _make_channels(drive, span, "Latencies of sensors: longest in a second", "ms", 1, 1e3)


def _make_channels(drive: Drive, span: Span, title: str, unit: str, column: int, scale: float) -> Panel:
    series = []
    for n, name in enumerate(list_sensor_channels(drive)):
        utimes, rows = span.select(drive.channels[name].course)
        series.append(Series(name, span.to_seconds(utimes), rows[:, column] * scale, _choose_color(n)))
    return Panel(title, _make_axis(unit, [np.asarray(each.y) for each in series], 1.0), series)


def _make_state(drive: Drive, span: Span, state: str) -> Panel:
    times, values, sigmas = drive.get_state_course(state, span.end, (span.end - span.begin) * 1e-6)
    x = times + (span.end - span.zero) * 1e-6
    band = Series("sigma", x, values - sigmas, charts.SKY, shape="band", high=values + sigmas)
    axis = _make_axis("", [values - sigmas, values + sigmas], 1e-6)
    return Panel(f"State {state}", axis, [band, Series("value", x, values)])


def list_sensor_channels(drive: Drive) -> list[str]:
    """Return the channels that are no message of the service or of its clients, in alphabetical order."""
    known = {name: BY_NAME.get(name.removeprefix(drive.prefix)) for name in sorted(drive.channels)}
    return [
        name
        for name, channel in known.items()
        if (
            not name.removeprefix(drive.prefix).startswith("REPLY_")
            if channel is None
            else channel.use is ChannelUse.SENSOR
        )
    ]


def _choose_color(number: int) -> str:
    return charts.PALETTE[number % len(charts.PALETTE)]


CHARTS: Final[Mapping[str, Callable[[Drive, Span], Panel]]] = {
    "speed": _make_speed,
    "heading": _make_heading,
    "uncertainty": _make_uncertainty,
    "innovations": _make_nis,
    "rates": _make_rates,
    "latencies": _make_latencies,
}
"""Charts by name, in their order; states of the filter are further ones, as `STATE` and their name."""
