"""Mesh files of a geometry: where they are, and what viewers draw of them.

A package URL, `package://NAME/PATH`, is looked up in the folders of --package-path, beside the geometry file and in
the three folders above it, in ROS_PACKAGE_PATH (ROS 1) and in share/ of AMENT_PREFIX_PATH (ROS 2). A geometry from the
bus, of a log or the running service, opens only files of these folders: its publisher must not choose others.

Colors of DAE, OBJ and others are sRGB, those of glTF are linear (glTF 2.0, 3.9.2). All triangles are double sided, as
robot descriptions have them wound either way, and none is metallic: a metal shows its surroundings, and there are
none. Vertices are split where faces meet at an edge: smooth surfaces are drawn across shared ones.
"""

from __future__ import annotations

import functools
import glob
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
import trimesh
from trimesh.exchange.gltf import export_glb

from modelserver.transforms.so3 import Array

MAX_MESH_BYTES: Final = 50_000_000
PACKAGE: Final = "package://"
LOCAL_FILE: Final = "file://"
ROS_VARIABLES: Final = ("ROS_PACKAGE_PATH", "AMENT_PREFIX_PATH")
PACKAGE_DEPTH: Final = 3
"""Levels of folders that are searched for a package in a workspace: src/REPOSITORY/PACKAGE."""

MESH_COLOR: Final = (0.72, 0.73, 0.75, 1.0)
"""sRGB and opacity of a mesh that states no color."""

CREASE: Final = np.radians(30.0)
"""Faces that meet at a larger angle have an edge between them: half of that of a hexagonal prism, which has edges."""

ROUGHNESS: Final = 0.8
"""Of surfaces that state no other: paint and plastic, without mirror images of the lamp."""

Rgba = tuple[float, float, float, float]


class MeshError(ValueError):
    """A mesh that is not drawn, with the reason and the remedy."""


class Mesh(NamedTuple):
    """A mesh as viewers draw it: a GLB file, and its outermost vertices (n, 3) before its scale."""

    glb: bytes
    outline: Array


@dataclass(frozen=True, slots=True)
class MeshFolders:
    """The folders in which mesh files are looked up.

    `folder` is that of the geometry file, None where the geometry comes from the bus; `packages` are those given by
    --package-path, `environment` has those of ROS.
    """

    folder: Path | None = None
    packages: tuple[Path, ...] = ()
    environment: Mapping[str, str] = field(default_factory=lambda: os.environ)

    def read(self, file: str, color: Rgba | None = None) -> Mesh:
        """Read a mesh, drawn in `color` (sRGB, opacity) instead of its own. Raises MeshError."""
        path = self.find(file)
        try:
            stat = path.stat()
            if stat.st_size > MAX_MESH_BYTES:
                raise MeshError(f"larger than {MAX_MESH_BYTES // 1_000_000} MB: simplify it")
            return _read_mesh(path, stat.st_mtime_ns, color)
        except OSError as error:
            raise MeshError(f"cannot be read: {error.strerror or error}") from None

    def find(self, file: str) -> Path:
        """Return the path of a mesh file: a path, `file://` or `package://`. Raises MeshError."""
        relative = PurePosixPath(file.removeprefix(PACKAGE).removeprefix(LOCAL_FILE))
        is_package = file.startswith(PACKAGE) and len(relative.parts) > 1
        if self.folder is None and (relative.is_absolute() or ".." in relative.parts):
            raise MeshError("a geometry from the bus cannot choose files; give its own by --model FILE")
        places: Iterator[Path] = (each / relative for each in (self.folder, *self.packages) if each is not None)
        if is_package:
            places = self._list_places(relative.parts[0], PurePosixPath(*relative.parts[1:]))
        found = next((each for each in places if each.is_file()), None)
        if found is None:
            raise MeshError(self._explain_missing(relative, is_package))
        return found

    def _list_places(self, package: str, relative: PurePosixPath) -> Iterator[Path]:
        """Yield where a file of a package may be: in its folders, else in one above the geometry file by any name."""
        yield from (each / relative for each in self._find_packages(package))
        yield from (each / relative for each in self._list_parents())

    def _find_packages(self, name: str) -> Iterator[Path]:
        """Yield the folders that are a package of a name, those that were given first."""
        for root in self.packages:
            yield from _search(root, name)
        for folder in self._list_parents():
            yield from _select_folders(folder / name)
        ros1, ros2 = (self.environment.get(each, "").split(os.pathsep) for each in ROS_VARIABLES)
        for each in filter(None, ros1):
            yield from _search(Path(each), name)
        yield from _select_folders(*[Path(root) / "share" / name for root in filter(None, ros2)])

    def _list_parents(self) -> list[Path]:
        return [] if self.folder is None else [self.folder, *self.folder.parents[:PACKAGE_DEPTH]]

    def _explain_missing(self, relative: PurePosixPath, is_package: bool) -> str:
        if not is_package:
            if self.folder is None:
                return "not found; give the folder of the geometry file by --package-path FOLDER"
            return f"not found in {self.folder}; correct the path, or give the folder by --package-path FOLDER"
        name = relative.parts[0]
        if (found := next(self._find_packages(name), None)) is not None:
            return f"not found in package {name}, which is {found}; is it another version?"
        beside = [] if self.folder is None else ["beside the geometry file"]
        searched = ", ".join(["--package-path", *beside, *ROS_VARIABLES])
        return f"package {name} not found ({searched}); give the folder that has it by --package-path FOLDER"


def _select_folders(*places: Path) -> Iterator[Path]:
    return (each for each in places if each.is_dir())


def _search(root: Path, name: str) -> Iterator[Path]:
    """Yield the folders of a package at, in or below a folder, as rospack finds them."""
    yield from _select_folders(root / name, *([root] if root.name == name else []), root / "share" / name)
    yield from _search_below(root, name)


@functools.lru_cache(maxsize=256)
def _search_below(root: Path, name: str) -> tuple[Path, ...]:
    """Return the packages in a workspace. Searched once: that may be many folders, for each of many meshes."""
    patterns = ["*/" * depth + glob.escape(name) + "/package.xml" for depth in range(1, PACKAGE_DEPTH + 1)]
    return tuple(each.parent for pattern in patterns for each in sorted(root.glob(pattern)))


# --- reading

OUTLINE_DIVISIONS: Final = 2
"""Divisions of an icosahedron for the directions of an outline: 162, 16 degrees apart, with the axes among them."""


@functools.lru_cache(maxsize=128)
def _read_mesh(path: Path, mtime: int, color: Rgba | None) -> Mesh:
    """Read a file as it was at a time. Raises OSError, MeshError."""
    try:
        scene = trimesh.load_scene(path)
        # a unit other than the meter: only COLLADA states one
        scale = (
            1.0 if path.suffix.lower() != ".dae" else trimesh.units.unit_conversion(scene.units or "meters", "meters")
        )
    except OSError:
        raise
    except Exception as error:
        raise MeshError(f"cannot be read: {error or type(error).__name__}") from None
    is_linear = path.suffix.lower() in (".glb", ".gltf")
    meshes = {name: each for name, each in scene.geometry.items() if isinstance(each, trimesh.Trimesh)}
    if not any(len(each.faces) for each in meshes.values()):
        raise MeshError("has no triangles")
    drawn = trimesh.Scene()
    for node in scene.graph.nodes_geometry:
        X, name = scene.graph[node]
        if name in meshes and len(meshes[name].faces):
            X = np.diag((scale, scale, scale, 1.0)) @ X
            drawn.add_geometry(_prepare(meshes[name], is_linear, color is None), node_name=node, transform=X)
    vertices = [
        trimesh.transform_points(drawn.geometry[name].vertices, X)
        for X, name in (drawn.graph[node] for node in drawn.graph.nodes_geometry)
    ]
    finish = functools.partial(_finish_materials, color=color or MESH_COLOR, is_linear=is_linear)
    export: Any = export_glb
    glb = export(drawn, include_normals=False, tree_postprocessor=finish)
    return Mesh(glb, _find_outline(np.concatenate(vertices)))


def _find_outline(vertices: Array) -> Array:
    """Return the vertices that are outermost in one of many directions: corners of the convex hull."""
    directions = trimesh.creation.icosphere(OUTLINE_DIVISIONS).vertices
    return np.asarray(vertices[np.unique([int(np.argmax(vertices @ each)) for each in directions])])


def _label_patches(pairs: npt.NDArray[np.int64], count: int) -> npt.NDArray[np.int64]:
    """Return for each of `count` faces the least number of those that are joined to it by pairs (n, 2)."""
    labels = np.arange(count)
    while True:
        first, second = labels[pairs[:, 0]], labels[pairs[:, 1]]
        joined = labels.copy()
        np.minimum.at(joined, first, second)
        np.minimum.at(joined, second, first)
        while not np.array_equal(joined, joined[joined]):
            joined = joined[joined]
        if np.array_equal(joined, labels):
            return labels
        labels = joined


def _prepare(mesh: Any, is_linear: bool, with_colors: bool) -> trimesh.Trimesh:
    """Return a mesh with vertices split at its edges, with its material or linear colors of vertices, or without."""
    faces, vertices = mesh.faces, mesh.vertices
    if not (faces.min() >= 0 and faces.max() < len(vertices) and np.isfinite(vertices).all()):
        raise MeshError("has triangles with corners that it does not have")
    smooth = mesh.face_adjacency[mesh.face_adjacency_angles < CREASE]
    patches = _label_patches(np.asarray(smooth), len(faces))
    corners = np.stack([np.repeat(patches, 3), faces.ravel()], axis=1)
    split, inverse = np.unique(corners, axis=0, return_inverse=True)
    chosen = split[:, 1]
    visual: Any = None
    make_textured: Any = trimesh.visual.TextureVisuals
    if with_colors and mesh.visual.kind == "texture":
        uv = mesh.visual.uv
        visual = make_textured(None if uv is None else uv[chosen], mesh.visual.material)
    elif with_colors and mesh.visual.kind in ("vertex", "face"):
        if mesh.visual.kind == "face":
            # the mean of the faces at a corner
            sums = np.zeros((len(chosen), 4))
            np.add.at(sums, inverse.ravel(), np.repeat(mesh.visual.face_colors, 3, axis=0) / 255.0)
            colors = sums / np.bincount(inverse.ravel())[:, None]
        else:
            colors = mesh.visual.vertex_colors[chosen] / 255.0
        if not is_linear:
            colors[:, :3] = _linearize(colors[:, :3])
        visual = trimesh.visual.ColorVisuals(vertex_colors=np.round(255.0 * colors).astype(np.uint8))
    return trimesh.Trimesh(vertices[chosen], inverse.reshape(-1, 3), visual=visual, process=False)


def _finish_materials(tree: dict[str, Any], color: Rgba, is_linear: bool) -> None:
    """Complete the materials of a glTF tree, with `color` (sRGB) for what has no material and no colors."""
    materials = tree.setdefault("materials", [])
    for each in materials:
        surface = each.setdefault("pbrMetallicRoughness", {})
        *rgb, opacity = surface.get("baseColorFactor", (1.0, 1.0, 1.0, 1.0))
        # COLLADA has two conventions for transparency, and files of each that mean the other: nothing is invisible
        surface["baseColorFactor"] = [*(rgb if is_linear else map(float, _linearize(rgb))), opacity or 1.0]
        surface.setdefault("roughnessFactor", ROUGHNESS)
        if 0.0 < opacity < 1.0:
            each.setdefault("alphaMode", "BLEND")
    for primitive in (each for mesh in tree["meshes"] for each in mesh["primitives"] if "material" not in each):
        rgba = (1.0, 1.0, 1.0, 1.0) if "COLOR_0" in primitive["attributes"] else color
        primitive["material"] = len(materials)
        surface = {"baseColorFactor": [*map(float, _linearize(rgba[:3])), rgba[3]], "roughnessFactor": ROUGHNESS}
        materials.append({"pbrMetallicRoughness": surface, "alphaMode": "BLEND" if rgba[3] < 1.0 else "OPAQUE"})
    for each in materials:
        each["doubleSided"] = True
        each["pbrMetallicRoughness"]["metallicFactor"] = 0.0


def _linearize(srgb: npt.ArrayLike) -> Array:
    """Return linear intensities of sRGB values from 0 to 1 (IEC 61966-2-1)."""
    values = np.asarray(srgb, float)
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
