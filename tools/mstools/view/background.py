"""A picture of the ground below the map: a GeoTIFF, an MBTiles file, or a folder of tiles, drawn into a view.

GDAL (rasterio) reads and warps: each view is drawn as one picture, in the grid of the origin's pinned UTM zone, so that
a pixel of it is a pixel of the map. Where a finer picture has nothing, a coarser zoom shows. Nothing is loaded from the
internet: formats that refer to other files or addresses (VRT, WMS) are not opened.
"""

from __future__ import annotations

import html
import math
import re
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
import rasterio
from rasterio.enums import ColorInterp, Resampling
from rasterio.errors import NotGeoreferencedWarning, RasterioError
from rasterio.vrt import WarpedVRT
from rasterio.warp import reproject, transform_bounds

from modelserver.earth import Origin
from modelserver.errors import ModelServerError
from mstools.view.map import View

Pixels = npt.NDArray[np.uint8]
"""Red, green, blue and alpha, 4 x height x width."""

DRIVERS: Final = ("GTiff", "MBTiles", "GPKG", "JP2OpenJPEG", "PNG", "JPEG")
TILE_DRIVERS: Final = ("PNG", "JPEG", "WEBP")
SUFFIXES: Final = (".png", ".jpg", ".jpeg", ".webp")

TILE_PX: Final = 256
"""Side of a tile of the Web Mercator scheme; larger ones (512) are finer pictures of the same square."""

MERCATOR: Final = "EPSG:3857"
HALF_WORLD: Final = math.pi * 6_378_137.0
"""Of Web Mercator, from the middle to each side, meters: WGS 84's half axis times pi."""

MAX_ZOOM: Final = 24
"""Of a folder of tiles: 1 cm for each pixel at the equator."""

MAX_PX: Final = 4096
"""Of each side of a picture; larger views have larger pixels."""

MAX_TILES: Final = 600
"""Of a folder in a picture: 4096 px squared with pixels larger by a root of two than those of the tiles."""

MAX_ATTRIBUTION: Final = 200
"""Characters of the line below the map."""

HELP: Final = "give a GeoTIFF, an MBTiles file with images, or a folder of tiles ZOOM/COLUMN/ROW.png"


class MapError(ModelServerError):
    """A picture of the ground cannot be read."""


class _Target(NamedTuple):
    """What is drawn into: the UTM grid, west, south, east and north in it, and its pixels."""

    grid: str
    bounds: tuple[float, float, float, float]
    transform: Any
    width: int
    height: int

    def find_mercator_bounds(self) -> tuple[float, float, float, float]:
        bounds: tuple[float, float, float, float] = transform_bounds(self.grid, MERCATOR, *self.bounds)
        return bounds

    def find_mercator_pixel(self) -> float:
        """Return the side of a pixel in units of Web Mercator."""
        west, _, east, _ = self.find_mercator_bounds()
        return (east - west) / self.width


@dataclass(frozen=True)
class Background:
    """A picture of the ground, safe for threads: who made it, and how it is drawn."""

    attribution: str
    _draw: Callable[[_Target], Pixels]
    _lock: Lock = field(default_factory=Lock, repr=False)

    def draw(self, view: View, origin: Origin) -> bytes:
        """Return what is below a view of a map around an origin as a PNG image, clear where nothing is.

        Raises MapError where the file cannot be read any more.
        """
        scale = max(1.0, view.width / MAX_PX, view.height / MAX_PX)
        view = View(
            view.east,
            view.north,
            view.scale * scale,
            *(max(round(each / scale), 1) for each in (view.width, view.height)),
        )
        west, south, east, north = view.bounds
        x, y = origin.easting, origin.northing
        target = _Target(
            f"EPSG:{(32600 if origin.north else 32700) + origin.zone}",
            (x + west, y + south, x + east, y + north),
            _make_transform(x + west, y + north, view.scale),
            view.width,
            view.height,
        )
        with self._lock, _report("the map cannot be read any more"):
            return _encode(self._draw(target))


def open_background(path: Path) -> Background:
    """Open a picture of the ground. Raises MapError with what is wrong with it and the fix."""
    if path.is_dir():
        return _open_folder(path)
    try:
        path.open("rb").close()
    except OSError as error:
        raise MapError(
            f"the map {path} cannot be read: {error.strerror}: check the path and its permissions"
        ) from error
    dataset = _open_dataset(path, DRIVERS)
    if dataset is None:
        raise MapError(
            f"the map {path} is of an unknown kind or damaged: {HELP}; GDAL makes one: gdal_translate IN OUT.tif"
        )
    if dataset.crs is None or dataset.transform.is_identity:
        raise MapError(f"the map {path} has no place on the earth: GDAL adds it: gdal_translate -a_srs ... -a_ullr ...")
    if set(dataset.dtypes) != {"uint8"} or dataset.count > 4:
        raise MapError(
            f"the map {path} has {dataset.count} bands of {dataset.dtypes[0]}, not a picture of 8 bits: "
            "gdal_translate -ot Byte -scale -b 1 IN OUT.tif makes one"
        )
    coarser = []
    if dataset.driver == "MBTiles":
        with _report(f"the map {path} is damaged: {HELP}"):
            coarser = [rasterio.open(path, OVERVIEW_LEVEL=level) for level in range(len(dataset.overviews(1)))]

    def draw(target: _Target) -> Pixels:
        # GDAL takes the zoom that suits the view; where that has no tile, a coarser one may have
        pixel = target.find_mercator_pixel() if coarser else 0.0
        layers = [dataset, *(each for each in coarser if each.res[0] > pixel)]
        return _combine((_warp(each, target) for each in layers), target)

    tags = dataset.tags()
    return Background(
        _make_line(tags.get("attribution") or tags.get("TIFFTAG_COPYRIGHT") or ""),
        draw,
    )


def _open_dataset(path: Path, drivers: tuple[str, ...]) -> Any:
    """Open a file with the first driver that can; None without one."""
    for driver in drivers:
        with suppress(RasterioError), warnings.catch_warnings(action="ignore", category=NotGeoreferencedWarning):
            return rasterio.open(path, driver=driver)
    return None


def _open_folder(path: Path) -> Background:
    zooms = [each for each in range(MAX_ZOOM + 1) if next(_list_tiles(path / str(each)), None) is not None]
    if not zooms:
        raise MapError(f"the folder {path} has no tiles: {HELP}")
    return Background(
        "",
        lambda target: _combine((_mosaic(path, zoom, target) for zoom in _order_zooms(zooms, target)), target),
    )


def _list_tiles(path: Path) -> Iterator[Path]:
    return (each for each in path.glob("*/*") if each.suffix.lower() in SUFFIXES)


def _order_zooms(zooms: list[int], target: _Target) -> list[int]:
    """Return the zooms to draw: the coarsest whose pixels are no larger than those of the view by a root of two, first.

    Zooms differ by a factor of two, so the nearest one has between this and its inverse.
    """
    pixel = target.find_mercator_pixel()
    fine = [each for each in zooms if HALF_WORLD * 2.0 / (TILE_PX << each) <= pixel * math.sqrt(2.0)]
    wanted = fine[0] if fine else zooms[-1]
    return [each for each in reversed(zooms) if each <= wanted]


def _mosaic(path: Path, zoom: int, target: _Target) -> Pixels:
    """Draw the tiles of a zoom that are in a view."""
    side = 2.0 * HALF_WORLD / (1 << zoom)
    west, south, east, north = target.find_mercator_bounds()
    columns = range(max(math.floor((west + HALF_WORLD) / side), 0), math.floor((east + HALF_WORLD) / side) + 1)
    rows = range(max(math.floor((HALF_WORLD - north) / side), 0), math.floor((HALF_WORLD - south) / side) + 1)
    drawn = np.zeros((4, target.height, target.width), dtype=np.uint8)
    if len(columns) * len(rows) > MAX_TILES:
        return drawn
    found = {
        (column, row): image
        for column in columns
        for row in rows
        if (image := _read_tile(path / str(zoom) / str(column), row)) is not None
    }
    if not found:
        return drawn
    size = max(image.shape[1] for image in found.values())
    whole = np.zeros((4, len(rows) * size, len(columns) * size), dtype=np.uint8)
    for (column, row), image in found.items():
        x, y = (column - columns[0]) * size, (row - rows[0]) * size
        whole[:, y : y + image.shape[1], x : x + image.shape[2]] = image
    corner = _make_transform(columns[0] * side - HALF_WORLD, HALF_WORLD - rows[0] * side, side / size)
    reproject(
        whole,
        drawn,
        src_transform=corner,
        src_crs=MERCATOR,
        dst_transform=target.transform,
        dst_crs=target.grid,
        src_alpha=4,
        dst_alpha=4,
        resampling=Resampling.bilinear,
    )
    return drawn


def _read_tile(folder: Path, row: int) -> Pixels | None:
    """Return the tile of a row; None where there is none that can be read."""
    for suffix in SUFFIXES:
        path = folder / f"{row}{suffix}"
        if path.is_file() and (dataset := _open_dataset(path, TILE_DRIVERS)) is not None:
            # a damaged tile is a hole in the picture
            with dataset, suppress(RasterioError):
                return _paint(dataset, dataset.read(), dataset.dataset_mask())
    return None


def _warp(dataset: Any, target: _Target) -> Pixels:
    """Draw a file with a place into a view."""
    has_palette = dataset.colorinterp[0] is ColorInterp.palette
    with WarpedVRT(
        dataset,
        crs=target.grid,
        transform=target.transform,
        width=target.width,
        height=target.height,
        # numbers of a palette have no mean
        resampling=Resampling.nearest if has_palette else Resampling.bilinear,
        add_alpha=ColorInterp.alpha not in dataset.colorinterp,
    ) as warped:
        bands = warped.read()
        return _paint(dataset, bands[: dataset.count], bands[-1])


def _paint(dataset: Any, bands: Pixels, alpha: Pixels) -> Pixels:
    """Return bands of a dataset (gray, palette, colors) as red, green, blue and alpha."""
    if dataset.colorinterp[0] is ColorInterp.palette:
        colors = np.zeros((256, 4), dtype=np.uint8)
        for number, color in dataset.colormap(1).items():
            colors[number] = color
        painted = colors[bands[0]].transpose(2, 0, 1)
        return np.concatenate([painted[:3], np.minimum(painted[3:], alpha[None])])
    has_colors = dataset.count >= 3
    return np.concatenate([bands[:3] if has_colors else np.repeat(bands[:1], 3, axis=0), alpha[None]])


def _combine(layers: Iterator[Pixels], target: _Target) -> Pixels:
    """Return layers in one, the first above: where it is clear the next shows."""
    drawn = np.zeros((4, target.height, target.width), dtype=np.uint8)
    for layer in layers:
        is_clear = drawn[3] == 0
        drawn[:, is_clear] = layer[:, is_clear]
        if drawn[3].all():
            break
    return drawn


def _encode(pixels: Pixels) -> bytes:
    _, height, width = pixels.shape
    with warnings.catch_warnings(action="ignore", category=NotGeoreferencedWarning), rasterio.MemoryFile() as file:
        # the fastest level of compression: the page is on the same machine or network
        with file.open(driver="PNG", width=width, height=height, count=4, dtype="uint8", ZLEVEL=1) as image:
            image.write(pixels)
        return bytes(file.read())


def _make_line(text: str) -> str:
    """Return an attribution, which is HTML in MBTiles files, as plain text."""
    return " ".join(html.unescape(re.sub(r"<[^>]*>", " ", text)).split())[:MAX_ATTRIBUTION]


def _make_transform(west: float, north: float, pixel: float) -> Any:
    """Return the transformation from pixels to places, by the place of the north-western corner."""
    return rasterio.Affine(pixel, 0.0, west, 0.0, -pixel, north)


@contextmanager
def _report(problem: str) -> Iterator[None]:
    """Raise MapError for an error of GDAL."""
    try:
        yield
    except (RasterioError, OSError, ValueError) as error:
        raise MapError(f"{problem} ({error})") from error
