"""The north-up map of a drive: what is in a view, decimated to its pixels, for the page to paint.

Positions are in World:UTM, meters from the origin; the page adds the origin's grid coordinates. Everything that needs
geodesy or the drive is computed here: the page scales and paints.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from modelserver.earth import Origin
from modelserver.earth.geodesy import GeodesyError, geodesy_of
from modelserver.transforms.so3 import Array, Vector3
from mstools.recordings.drive import FIX_COLOR, FIX_POSITION, INVALID, MAX_STAMP, Drive, FixColor, Picture

MAX_FIXES: Final = 3_000
"""Fixes of a view at most, the latest: a page paints them with their ellipses in some 10 ms."""

FIX_CELL_PX: Final = 2.0
"""Of the fixes in a square of so many pixels the latest is shown, which covers the others."""

MAX_METERS_PER_PIXEL: Final = 2_000.0
"""Beyond this a view is larger than a UTM zone."""


MIN_GRID_PX: Final = 80.0
"""Least distance of the lines of a grid: a label (11 digits of 7 px) fits between two."""

GRID_POINTS: Final = 17
"""Points of a meridian or parallel in a view: over 100 km a chord of a sixteenth deviates by less than a meter."""


@dataclass(frozen=True)
class View:
    """What a map shows: its center in World:UTM, meters, the meters of a pixel, and its size in pixels."""

    east: float
    north: float
    scale: float
    width: int
    height: int

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """West, south, east, north."""
        half_x, half_y = 0.5 * self.width * self.scale, 0.5 * self.height * self.scale
        return self.east - half_x, self.north - half_y, self.east + half_x, self.north + half_y


def fit_view(drive: Drive, width: int, height: int) -> View:
    """Return the view of the whole track and the fixes, with a margin; of 40 m around a single place."""
    # drive.end may be before a fix that came last
    points = np.concatenate([drive.get_track(drive.end)[1][:, :2], drive.get_fixes(MAX_STAMP)[0][:, :2]])
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        points = np.zeros((1, 2))
    low, high = points.min(axis=0), points.max(axis=0)
    spans = np.maximum(high - low, 40.0) * 1.15
    scale = max(spans[0] / max(width, 1), spans[1] / max(height, 1))
    east, north = (0.5 * (low + high)).tolist()
    return View(east, north, float(scale), width, height)


def describe_map(
    drive: Drive, picture: Picture, trail_s: float, view: View, places: Mapping[str, Vector3]
) -> dict[str, Any]:
    """Return what a view shows at the time of a picture, as JSON: trail, fixes, named `places`, geodesy.

    fixes: [east, north, `FixColor`, variance east, north, covariance] each, variances None where they are not known.
    trail: lines of one validity each, {"valid": ..., "points": [[east, north], ...]}.
    """
    found: dict[str, Any] = {
        "view": [view.east, view.north, view.scale],
        "trail": _list_trail(drive, picture.utime, trail_s, view),
        "fixes": _list_fixes(drive, picture.utime, view),
        "places": {name: _round(place) for name, place in places.items()},
        "origin": None,
    }
    if drive.origin is not None:
        found["origin"] = describe_origin(drive.origin, view)
    return found


def make_grid(origin: Origin, view: View, kind: str) -> list[dict[str, Any]]:
    """Return the lines of a grid over a view: "utm", or "geodetic" in degrees; none beyond UTM's range.

    Each is {"label": ..., "is_upright": ..., "points": [[east, north], ...]}, from the west or the south.
    """
    west, south, east, north = view.bounds
    least = MIN_GRID_PX * view.scale
    if kind == "utm":
        lines = [
            (f"{value:.{_count_decimals(least)}f} E", True, [(value - origin.easting, y) for y in (south, north)])
            for value in _list_steps(origin.easting + west, origin.easting + east, least)
        ] + [
            (f"{value:.{_count_decimals(least)}f} N", False, [(x, value - origin.northing) for x in (west, east)])
            for value in _list_steps(origin.northing + south, origin.northing + north, least)
        ]
    else:
        try:
            lines = _make_graticule(origin, view)
        except GeodesyError:
            return []
    return [
        {"label": label, "is_upright": is_upright, "points": [_round(point) for point in points]}
        for label, is_upright, points in lines
    ]


def _make_graticule(origin: Origin, view: View) -> list[tuple[str, bool, list[tuple[float, float]]]]:
    """Return parallels and meridians over a view, as `make_grid`. Raises GeodesyError."""
    geodesy = geodesy_of(origin)
    west, south, east, north = view.bounds
    edge = [
        geodesy.geodetic_from_utm(origin.easting + x, origin.northing + y, 0.0)[:2]
        for x in np.linspace(west, east, GRID_POINTS).tolist()
        for y in (south, view.north, north)
    ]
    latitudes, longitudes = np.array(edge).T
    # without a step at 180 degrees
    middle = longitudes[len(longitudes) // 2]
    longitudes = middle + np.remainder(longitudes - middle + 180.0, 360.0) - 180.0
    spans = ((latitudes.min(), latitudes.max()), (longitudes.min(), longitudes.max()))
    lines = []
    for number, (low, high) in enumerate(spans):
        is_upright = number == 1
        length = (view.width if is_upright else view.height) * view.scale
        least = MIN_GRID_PX * view.scale * (high - low) / length
        for value in _list_steps(low, high, least):
            other = np.linspace(*spans[1 - number], GRID_POINTS).tolist()
            places = [(each, value) if is_upright else (value, each) for each in other]
            points = [geodesy.to_relative_utm(geodesy.utm_from_geodetic(a, b, 0.0))[:2] for a, b in places]
            shown = math.remainder(value, 360.0)
            side = ("W" if shown < 0.0 else "E") if is_upright else ("S" if shown < 0.0 else "N")
            lines.append((f"{abs(shown):.{_count_decimals(least)}f}\u00b0 {side}", is_upright, points))
    return lines


def _find_step(least: float) -> float:
    """Return the smallest of 1, 2 and 5 times a power of ten that is not below `least`."""
    power: float = 10.0 ** math.floor(math.log10(least))
    return next(each * power for each in (1.0, 2.0, 5.0, 10.0) if each * power >= least)


def _count_decimals(least: float) -> int:
    return max(0, -math.floor(math.log10(_find_step(least) * (1.0 + 1e-9))))


def _list_steps(low: float, high: float, least: float) -> list[float]:
    step = _find_step(least)
    return [number * step for number in range(math.ceil(low / step), math.floor(high / step) + 1)]


def _round(values: tuple[float, ...]) -> list[float]:
    return [round(each, 3) for each in values]


def describe_origin(origin: Origin, view: View) -> dict[str, Any] | None:
    """Return an origin, and polynomials of latitude and longitude over a view.

    They are quadratic in (x, y), the offsets from the view's center in units of its half diagonal: 1, x, y, x2, xy, y2.
    Fitted to nine points, they are exact to a centimeter over 2 km (measured by a test). None beyond UTM's range.
    """
    half = 0.5 * view.scale * math.hypot(view.width, view.height)
    geodesy = geodesy_of(origin)
    steps = [(x, y) for x in (-1.0, 0.0, 1.0) for y in (-1.0, 0.0, 1.0)]
    matrix = np.array([(1.0, x, y, x * x, x * y, y * y) for x, y in steps])
    east, north = origin.easting + view.east, origin.northing + view.north
    try:
        places = np.array([geodesy.geodetic_from_utm(east + x * half, north + y * half, 0.0)[:2] for x, y in steps])
    except GeodesyError:
        return None
    latitude, longitude = np.linalg.lstsq(matrix, places, rcond=None)[0].T
    return {
        "easting": origin.easting,
        "northing": origin.northing,
        "zone": f"{origin.zone}{'N' if origin.north else 'S'}",
        "half": half,
        "latitude": latitude.tolist(),
        "longitude": longitude.tolist(),
    }


def _list_trail(drive: Drive, utime: int, seconds: float, view: View) -> list[dict[str, Any]]:
    utimes, points = drive.get_track(utime, seconds)
    if not len(points):
        return []
    first = int(np.searchsorted(drive.poses.utimes, utimes[0]))
    is_valid = drive.poses.rows[first : first + len(points), INVALID] == 0
    shown = _decimate(points[:, :2], is_valid, view)
    places, flags = np.round(points[shown, :2], 3).tolist(), is_valid[shown]
    breaks = [0, *(np.flatnonzero(np.diff(flags)) + 1).tolist(), len(shown)]
    # a line begins where the last one ends
    return [{"valid": bool(flags[begin]), "points": places[max(begin - 1, 0) : end]} for begin, end in pairwise(breaks)]


def _decimate(points: Array, is_valid: npt.NDArray[np.bool_], view: View) -> npt.NDArray[np.intp]:
    """Return the numbers of the points of a track that matter: one of a run in a pixel; beyond the view one of many."""
    west, south, _, _ = view.bounds
    cells = np.floor((points - (west, south)) / view.scale)
    size = np.array([view.width, view.height])
    is_inside = np.all((cells >= -size) & (cells <= 2 * size), axis=1)
    coarse = np.where(is_inside.reshape(-1, 1), cells, np.floor(cells / size) * size)
    changes = np.any(np.diff(coarse, axis=0) != 0, axis=1) | (np.diff(is_valid) != 0)
    chosen: npt.NDArray[np.intp] = np.flatnonzero(np.append(True, changes))
    return np.union1d(chosen, [len(points) - 1])


def _list_fixes(drive: Drive, utime: int, view: View) -> list[list[float | None]]:
    tables = list(drive.get_fix_tables(utime).values())
    if not tables:
        return []
    rows = np.concatenate(tables)
    west, south, east, north = view.bounds
    places = rows[:, FIX_POSITION][:, :2]
    is_inside = np.all((places >= (west, south)) & (places <= (east, north)), axis=1)
    rows, places = rows[is_inside], places[is_inside]
    cells = np.floor((places - (west, south)) / (FIX_CELL_PX * view.scale))
    # what became of a fix is part of the cell: a rejected one is not hidden by those around it
    keys = np.column_stack([cells, rows[:, FIX_COLOR]])
    _, last = np.unique(keys[::-1], axis=0, return_index=True)
    chosen = np.sort(len(rows) - 1 - last)[-MAX_FIXES:]
    # rejected ones are painted last
    chosen = chosen[np.argsort(rows[chosen, FIX_COLOR] == FixColor.REJECTED, kind="stable")]
    return [
        [round(float(row[3]), 3), round(float(row[4]), 3), int(row[FIX_COLOR]), *map(_to_json, row[7:10].tolist())]
        for row in rows[chosen]
    ]


def _to_json(value: float) -> float | None:
    return value if math.isfinite(value) else None
