"""The picture of the ground below the map: what is drawn, where, and what is not."""

from __future__ import annotations

import io
import sqlite3
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rasterio", reason="the extra map is not installed: pip install -e '.[map]'")
pytest.importorskip("viser", reason="the extra view, which brings Pillow, is not installed: pip install -e '.[view]'")

import rasterio
from PIL import Image
from rasterio.enums import ColorInterp
from rasterio.errors import NotGeoreferencedWarning
from rasterio.shutil import copy
from rasterio.transform import from_origin

from modelserver.earth.geodesy import make_origin
from mstools.view.background import MAX_PX, MapError, open_background
from mstools.view.map import View

ORIGIN = make_origin(487_500.0, 5_569_500.0, 700.0, 12, True)
SOUTH = make_origin(487_500.0, 5_569_500.0, 700.0, 12, False)
GREEN = (0, 90, 0, 255)
COLORS = [ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.alpha]
"""A cross of white lines at the origin on green, 400 m to each side."""


def write_cross(path: Path, epsg: int = 32612, bands: int = 4, place: bool = True, dtype: str = "uint8") -> Path:
    pixels = np.zeros((4, 1600, 1600), dtype=np.uint8)
    pixels[:] = np.array(GREEN).reshape(4, 1, 1)
    pixels[:3, 799:801, :] = pixels[:3, :, 799:801] = 255
    where = {"crs": f"EPSG:{epsg}", "transform": from_origin(487_100.0, 5_569_900.0, 0.5, 0.5)} if place else {}
    with (
        warnings.catch_warnings(action="ignore", category=NotGeoreferencedWarning),
        rasterio.open(path, "w", driver="GTiff", width=1600, height=1600, count=bands, dtype=dtype, **where) as file,
    ):
        file.write(pixels[:bands].astype(dtype))
        file.colorinterp = COLORS[:bands] if bands >= 3 else [ColorInterp.gray]
    return path


def write_tiles(folder: Path, source: Path) -> Path:
    """Write an MBTiles file of a GeoTIFF, and a folder beside it with its tiles."""
    path = folder / "cross.mbtiles"
    copy(source, path, driver="MBTILES")
    with rasterio.open(path, "r+") as file:
        file.build_overviews([2, 4])
    base = sqlite3.connect(path)
    for zoom, column, row, data in base.execute("SELECT zoom_level, tile_column, tile_row, tile_data FROM tiles"):
        place = folder / "tiles" / str(zoom) / str(column)
        place.mkdir(parents=True, exist_ok=True)
        (place / f"{2**zoom - 1 - row}.png").write_bytes(data)
    base.execute("INSERT INTO metadata VALUES ('attribution', '&copy; <a href=\"http://x\">Survey  of Alberta</a>')")
    base.commit()
    base.close()
    return path


def draw(background: Any, view: View, origin: Any = ORIGIN) -> Any:
    """Return the picture, height x width x RGBA."""
    image = Image.open(io.BytesIO(background.draw(view, origin)))
    assert image.mode == "RGBA"
    return np.asarray(image)


def find_cross(pixels: Any, view: View) -> tuple[float, float]:
    """Return the place of the white lines, meters east and north of the origin: the mean of their pixels."""
    is_white = (pixels[:, :, 0] > 100) & (pixels[:, :, 3] > 0)
    columns, rows = (np.flatnonzero(is_white.mean(axis=axis) > 0.5) for axis in (0, 1))
    west, _, _, north = view.bounds
    return west + (columns.mean() + 0.5) * view.scale, north - (rows.mean() + 0.5) * view.scale


@pytest.fixture(scope="module", name="folder")
def make_sources(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("ground")
    write_tiles(folder, write_cross(folder / "cross.tif"))
    return folder


@pytest.mark.parametrize("name", ["cross.tif", "cross.mbtiles", "tiles"])
@pytest.mark.parametrize("scale", [0.07, 0.5, 0.9])
def test_given_a_picture_then_each_place_is_within_a_pixel_of_it_or_of_the_view(
    folder: Path, name: str, scale: float
) -> None:
    view = View(7.0, -3.0, scale, 400, 300)
    pixels = draw(open_background(folder / name), view)
    assert pixels.shape == (300, 400, 4)
    assert find_cross(pixels, view) == pytest.approx((0.0, 0.0), abs=max(scale, 0.6))
    assert tuple(pixels[10, 10]) == pytest.approx(GREEN, abs=3)


@pytest.mark.parametrize("name", ["cross.tif", "cross.mbtiles", "tiles"])
def test_given_a_view_larger_than_the_picture_then_what_is_beyond_is_clear(folder: Path, name: str) -> None:
    pixels = draw(open_background(folder / name), View(0.0, 0.0, 2.0, 800, 600))
    assert pixels[300, 350, 3] == 255
    assert pixels[300, 50, 3] == pixels[20, 400, 3] == 0
    assert not draw(open_background(folder / name), View(50_000.0, 0.0, 1.0, 80, 60)).any()
    assert not draw(open_background(folder / name), View(0.0, 0.0, 2000.0, 800, 600))[:, :300].any()
    assert not draw(open_background(folder / name), View(0.0, 0.0, 1.0, 80, 60), SOUTH).any()


def test_given_a_fine_tile_that_is_missing_or_damaged_then_a_coarser_zoom_shows(tmp_path: Path) -> None:
    mbtiles = write_tiles(tmp_path, write_cross(tmp_path / "cross.tif"))
    finest = max((tmp_path / "tiles").iterdir(), key=lambda each: int(each.name))
    columns = sorted(finest.iterdir())
    for each in columns[: len(columns) // 2]:
        for tile in each.iterdir():
            tile.unlink()
    next(columns[-2].iterdir()).write_bytes(b"\x89PNG\r\n\x1a\n damaged")
    with sqlite3.connect(mbtiles) as base:
        base.execute(f"DELETE FROM tiles WHERE zoom_level = {finest.name} AND tile_column < {columns[3].name}")
    base.close()
    for path in (tmp_path / "tiles", mbtiles):
        pixels = draw(open_background(path), View(0.0, 0.0, 0.5, 1500, 1500))
        assert (pixels[:, :, 3] == 255).all()
        assert tuple(pixels[100, 100]) == pytest.approx(GREEN, abs=3)


def test_given_gray_colors_or_a_palette_then_all_are_drawn(tmp_path: Path) -> None:
    view = View(20.0, 20.0, 0.5, 40, 30)
    assert tuple(draw(open_background(write_cross(tmp_path / "rgb.tif", bands=3)), view)[5, 5]) == GREEN
    assert tuple(draw(open_background(write_cross(tmp_path / "gray.tif", bands=1)), view)[5, 5]) == (0, 0, 0, 255)
    path = write_cross(tmp_path / "palette.tif", bands=1)
    with rasterio.open(path, "r+") as file:
        file.colorinterp = [ColorInterp.palette]
        file.write_colormap(1, {0: (1, 2, 3, 255), 255: (9, 9, 9, 255)})
    assert tuple(draw(open_background(path), view)[5, 5]) == (1, 2, 3, 255)
    # outside of a picture without alpha it is clear
    assert draw(open_background(path), View(600.0, 0.0, 0.5, 40, 30))[5, 5, 3] == 0


def test_given_the_author_of_a_picture_then_it_is_plain_text(folder: Path) -> None:
    assert open_background(folder / "cross.mbtiles").attribution == "\u00a9 Survey of Alberta"
    assert open_background(folder / "tiles").attribution == ""


def test_given_a_huge_view_then_its_picture_is_bounded(folder: Path) -> None:
    pixels = draw(open_background(folder / "cross.tif"), View(0.0, 0.0, 0.1, 8192, 16))
    assert pixels.shape == (8, MAX_PX, 4)


def test_given_what_is_no_picture_with_a_place_then_the_error_names_the_fix(tmp_path: Path) -> None:
    text = tmp_path / "notes.txt"
    text.write_text("no picture")
    (tmp_path / "cut.tif").write_bytes(write_cross(tmp_path / "whole.tif").read_bytes()[:300])
    (tmp_path / "empty").mkdir()
    (tmp_path / "vectors.mbtiles").write_bytes(b"SQLite format 3\0" + bytes(5000))
    # a file that would fetch from elsewhere
    (tmp_path / "far.vrt").write_text("<VRTDataset rasterXSize='1' rasterYSize='1'></VRTDataset>")
    for name, words in {
        "notes.txt": "GeoTIFF, an MBTiles",
        "cut.tif": "unknown kind or damaged",
        "empty": "has no tiles",
        "vectors.mbtiles": "unknown kind or damaged",
        "far.vrt": "unknown kind",
        "missing.tif": "check the path",
    }.items():
        with pytest.raises(MapError, match=words):
            open_background(tmp_path / name)
    with pytest.raises(MapError, match="gdal_translate -a_srs"):
        open_background(write_cross(tmp_path / "nowhere.tif", place=False))
    with pytest.raises(MapError, match="-ot Byte"):
        open_background(write_cross(tmp_path / "heights.tif", bands=1, dtype="float32"))
