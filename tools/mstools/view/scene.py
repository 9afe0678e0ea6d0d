"""The 3D scene: the vehicle's geometry under a node that moves in World:UTM, with trail, fixes and uncertainty.

Scene nodes, of which `/world` alone moves with the follow camera (the vehicle then stays at the scene's origin):

    /world                      World:UTM
    /world/place                its origin, without its attitude: uncertainty
    /world/vehicle              the base frame
    /world/vehicle/body/NUMBER  a body: its shapes, the axes and the names of its frames
    /world/vehicle/edges        constraints, a segment each

Bodies that no constraints join to the base frame are drawn beside the vehicle.

The ground, `/world/grid`, is at the height of the lowest point of the vehicle with its joints at their defaults, below
the base frame. Translucent shapes, such as what a camera sees, do not count there.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from enum import StrEnum
from itertools import pairwise, product
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
import trimesh
import viser

from modelserver.earth import Origin
from modelserver.earth.geodesy import GeodesyError, geodesy_of
from modelserver.geometry import names
from modelserver.geometry.model import Model
from modelserver.geometry.parts import Body, Shape, ShapeKind
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Array, Vector3
from mstools.meshes import MeshError, MeshFolders
from mstools.recordings.drive import FramePoses, Picture
from mstools.recordings.pose_signals import CHI_SQUARE_3, compute_ellipsoid
from mstools.shapes import DrawnAs, choose_color, find_color, list_corners, list_drawings, make_frame_box
from mstools.view.camera import choose_labels, project

MAX_TRAIL_POINTS: Final = 4_000
TRAIL_PERIOD_US: Final = 5_000_000
MAX_FIXES: Final = 10_000
MIN_WEDGE: Final = 2.0
"""Least length of the lines of the heading's protection level, meters."""

Rgb = tuple[int, int, int]
FIXED_COLOR: Final[Rgb] = (150, 150, 150)
MOVABLE_COLOR: Final[Rgb] = (240, 150, 40)
PATH_COLOR: Final[Rgb] = (230, 60, 160)
TRAIL_COLOR: Final[Rgb] = (70, 150, 250)
VALID_COLOR: Final[Rgb] = (60, 180, 90)
INVALID_COLOR: Final[Rgb] = (225, 70, 60)
FIX_COLORS: Final = np.array([VALID_COLOR, INVALID_COLOR, (240, 190, 60), FIXED_COLOR], np.uint8)
"""By `FixColor`."""

LABEL_PX: Final = (6.0, 16.0)
"""Width of a label's character and height of a label in pixels, as viser draws them (measured on a screenshot)."""

AXES_PX: Final = 24.0
"""Length of axes in pixels: one and a half labels high."""

AXES_SCALE: Final = 0.05
AXES_SCALES: Final = (0.005, 0.2)
"""Length of axes before there is a camera, and the least and largest one, as parts of the size of the model.

Far away they would cover the vehicle; a camera within a frame would have none."""

AXES_TOLERANCE: Final = 0.05
"""Relative change of the length that is sent: one pixel."""

GRID_LABELS: Final = 1
"""Labeled grid crossings on each side of the vehicle, at `LABEL_SPACING`."""

AMBIENT_LIGHT: Final = 1.5
"""Intensity of the light on sides that no lamp reaches; the lamp above has 3."""

SOFT_LIGHT: Final = (0.3, 0.5)
"""With shadows: intensities of the light of the surroundings, and of what is left of the ambient light beside it."""

SHADOW: Final = 0.25
"""Opacity of the shadow on the ground."""

CYLINDER_SIDES: Final = 48
"""Sides of a drawn cylinder: half a pixel less than a circle at a radius of 250 pixels (1 - cos(pi / 48) = 0.002)."""

MIN_OPACITY: Final = 0.5
"""Least opacity of what is part of the vehicle, and not what a sensor sees."""

GIZMO_SCALE: Final = 0.2
"""Length of the gizmo's arrows, as a part of the size of the model."""

LABEL_SPACING: Final = 20.0
"""Meters."""

NO_LINES: Final = np.zeros((0, 2, 3))

SELECTED_COLOR: Final[Rgb] = (130, 40, 240)
MARK_SCALE: Final = 0.12
"""Edge of the cube that marks a frame, as a part of the size of the model: axes have 0.05, the gizmo covers less."""

OUTLINE_SCALE: Final = 1.01
"""Size of an outline relative to its shape, whose surface would hide half of each line."""

_CUBE: Final = np.array(
    [
        (a, b)
        for a in np.ndindex(2, 2, 2)
        for b in np.ndindex(2, 2, 2)
        if a < b and sum(p != q for p, q in zip(a, b, strict=True)) == 1
    ],
    float,
)
"""The 12 edges of the unit cube (12, 2, 3), corners at 0 and 1."""


KINDS: Final = ("shapes", "axes", "constraints", "grid", "track", "fixes")
"""What can be hidden."""


class NameLabels(StrEnum):
    """Which names stand in the scene."""

    NONE = "none"
    BODIES = "bodies"
    FRAMES = "frames"


class NodeLabel(NamedTuple):
    """The name of a body or a frame, at a place on a body."""

    kind: NameLabels
    text: str
    body: str
    place: Vector3
    handle: viser.LabelHandle


class VehicleScene:
    """Draw one model and its pictures.

    Parameters
    ----------
    meshes : the folders in which mesh files are looked up
    pick : called with the full name of a frame that was clicked, and whether Shift was held
    """

    def __init__(self, server: viser.ViserServer, meshes: MeshFolders, pick: Callable[[str, bool], None]):
        self._scene = server.scene
        self._meshes = meshes
        self._pick = pick
        self._bodies: dict[str, viser.SceneNodeHandle] = {}
        self._frames: FramePoses | None = None
        self._poses: dict[str, Pose] = {}
        self._axes: dict[str, Any] = {}
        self._labels: list[NodeLabel] = []
        self._path: tuple[str, ...] = ()
        self._ends: list[list[list[tuple[str, Vector3]]]] = [[], []]
        self._labeled: tuple[int, int, Origin] | None = None
        self._size = 1.0
        self._points: dict[str, Array] = {}
        self._solid: dict[str, Array] = {}
        self._ground = 0.0
        self.unread: dict[str, list[str]] = {}
        """Mesh files that are not drawn, by the reason."""
        self.is_edited = False
        """Whether it has a gizmo: bodies are not clicked then, frames are."""
        self._light = self._scene.add_light_ambient("/light", intensity=AMBIENT_LIGHT)
        self._world = self._scene.add_frame("/world", show_axes=False)
        self._vehicle = self._scene.add_frame("/world/vehicle", show_axes=False)
        self._grid = self._scene.add_grid(
            "/world/grid",
            infinite_grid=True,
            cell_size=1.0,
            section_size=10.0,
            cell_color=(205, 205, 205),
            section_color=(160, 160, 160),
            # from three quarters at 10 m to a tenth at 100 m: lines that are nearer than a pixel would flicker
            fade_distance=200.0,
            fade_strength=4.0,
        )
        self.set_shadows(False)
        groups = {"track": "/world/track", "fixes": "/world/sensors", "constraints": "/world/vehicle/edges"}
        self._groups: dict[str, list[viser.SceneNodeHandle]] = {
            "grid": [self._grid],
            **{kind: [self._scene.add_frame(node, show_axes=False)] for kind, node in groups.items()},
        }
        self._hidden: tuple[frozenset[str], frozenset[str]] = (frozenset(), frozenset())
        self._trail = self._add_lines("/world/track/trail", TRAIL_COLOR, 3.0)
        self._trail_end = self._add_lines("/world/track/end", TRAIL_COLOR, 3.0)
        self._trail_span = (0, 0)
        # what is around the position moves with it, and has its own shape more rarely
        self._place = self._scene.add_frame("/world/place", show_axes=False, visible=False)
        self._level = self._scene.add_frame("/world/place/protection_level", show_axes=False, visible=False)
        self._circle = self._add_lines("/world/place/protection_level/position", VALID_COLOR, 2.0)
        self._uncertainty_color = VALID_COLOR
        angles = np.linspace(0.0, 2.0 * math.pi, 65)
        self._draw_line(self._circle, np.stack([np.cos(angles), np.sin(angles), np.zeros(65)], axis=1))
        self._wedge = [
            self._add_lines(f"/world/place/protection_level/heading/{n}", VALID_COLOR, 2.0) for n in range(2)
        ]
        for side in self._wedge:
            side.points = np.array([[(0.0, 0.0, 0.0), (1.0, 0.0, 0.0)]], np.float32)
        self._edges = (
            self._add_lines("/world/vehicle/edges/fixed", FIXED_COLOR, 2.5),
            self._add_lines("/world/vehicle/edges/movable", MOVABLE_COLOR, 3.5),
        )
        self._path_lines = self._add_lines("/world/vehicle/path", PATH_COLOR, 5.0)
        self._fixes = self._scene.add_point_cloud(
            "/world/sensors/fixes",
            np.zeros((1, 3), np.float32),
            np.zeros((1, 3), np.uint8),
            visible=False,
            point_size=0.08,
            point_shape="circle",
            precision="float32",
        )
        self._gizmo: Any = None
        self._gizmo_count = 0
        self._mark: Any = None
        self._ellipsoid = self._scene.add_icosphere(
            "/world/place/ellipsoid", 1.0, VALID_COLOR, opacity=0.25, visible=False
        )

    def _add_lines(self, name: str, color: Rgb, width: float, points: Array = NO_LINES) -> Any:
        """Add a node of line segments (n, 2, 3), `width` pixels wide."""
        return self._scene.add_line_segments(
            name, points.astype(np.float32), color, thickness=width, thickness_units="screen"
        )

    def set_shadows(self, is_on: bool) -> None:
        """Turn shadows and the light of the surroundings on or off.

        They are for a machine with a graphics card: in software, the first picture would come seconds later.
        """
        self._scene.configure_default_lights(cast_shadow=is_on)
        self._scene.configure_environment_map("studio" if is_on else None, environment_intensity=SOFT_LIGHT[0])
        self._light.intensity = SOFT_LIGHT[1] if is_on else AMBIENT_LIGHT
        self._grid.shadow_opacity = SHADOW if is_on else 0.0

    # --- geometry

    def set_model(self, model: Model, base_frame: str) -> None:
        """Draw another model; `base_frame` is the frame whose pose is published."""
        for each in self._bodies.values():
            each.remove()
        # went with its body
        self._gizmo = self._mark = None
        self._bodies, self._poses, self._labels, self._points, self._solid, self.unread = {}, {}, [], {}, {}, {}
        self._axes = {}
        self._groups |= {"shapes": [], "axes": []}
        self._frames = FramePoses(model, base_frame)
        # the largest extent of a body's frames
        size = self._size = max([0.5, *(float(np.ptp(list_corners(body), axis=0).max()) for body in model.bodies)])
        orphans = 0
        for number, body in enumerate(model.bodies):
            root = f"/world/vehicle/body/{number}"
            node = self._scene.add_frame(root, show_axes=False)
            self._bodies[body.name] = node
            if body.name not in self._frames.paths:
                # not joined to the base: beside the vehicle
                orphans += 1
                self._poses[body.name] = Pose((0.0, -size - orphans * 0.5, 0.0))
                node.position = self._poses[body.name].xyz
            self._draw_body(root, body, size)
        self._ends = [
            [
                [(names.split(frame)[0], model.frame(frame).pose.xyz) for frame in (each.from_, each.to)]
                for each in model.constraints
                if each.joint.is_movable == is_movable
            ]
            for is_movable in (False, True)
        ]
        self._place_bodies(self._frames.compute_bodies())
        self.hide(*self._hidden)
        joined = [self._poses[name].transform(self._solid[name]) for name in self._frames.paths]
        self._ground = min((float(each[:, 2].min()) for each in joined if len(each)), default=0.0)

    def list_points(self) -> Array:
        """Return the outermost points (n, 3) of shapes and frames in the scene, as they are drawn."""
        found = [pose.transform(self._points[name]) for name, pose in self._poses.items()]
        return self._to_scene(np.concatenate([np.zeros((0, 3)), *found]))

    def _to_scene(self, points: Array) -> Array:
        """Return points (n, 3) of the base frame in the scene."""
        vehicle = Pose(self._vehicle.position.tolist(), self._vehicle.wxyz.tolist())
        found: Array = vehicle.transform(points) + self._world.position
        return found

    @property
    def size(self) -> float:
        """The largest extent of a body's frames, meters."""
        return self._size

    @property
    def center(self) -> Array:
        """The place of the base frame in the scene (3)."""
        return np.asarray(self._vehicle.position + self._world.position)

    @property
    def heading(self) -> float:
        """The yaw of the vehicle in the scene, radians."""
        return float(Pose((0.0, 0.0, 0.0), self._vehicle.wxyz.tolist()).rpy[2])

    def _draw_body(self, root: str, body: Body, size: float) -> None:
        points: list[Array] = []
        solid: list[Array] = []
        for kind, shapes in list_drawings(body):
            drawn = [
                node
                for number, shape in enumerate(shapes)
                if (node := self._draw_shape(f"{root}/{kind}/{number}", shape, kind, points, solid)) is not None
            ]
            # what can be clicked hides from the pointer what is behind it: frames in a stand-in box, and the gizmo
            if kind is not DrawnAs.BOX and body.frames and not self.is_edited:
                for node in drawn:
                    self._add_pick(node, lambda _: body.frames[0].full_name)
            self._groups["shapes"] += drawn
            if drawn:
                break
        places = np.array([frame.pose.xyz for frame in body]).reshape(-1, 3)
        self._points[body.name] = np.concatenate([places, *points])
        self._solid[body.name] = np.concatenate([np.zeros((0, 3)), *solid])
        self._add_label(NameLabels.BODIES, f"{root}/name", body.name, body.name, (0.0, 0.0, 0.0))
        if not body.frames:
            return
        axes = self._scene.add_batched_axes(
            f"{root}/axes",
            np.array([each.pose.wxyz for each in body.frames], np.float32),
            np.array([each.pose.xyz for each in body.frames], np.float32),
            np.full(len(body.frames), AXES_SCALE * size, np.float32),
            axes_length=1.0,
            axes_radius=0.03,
        )
        self._axes[body.name] = axes
        self._groups["axes"].append(axes)
        self._add_pick(axes, lambda event: body.frames[event.instance_index or 0].full_name)
        for number, frame in enumerate(body.frames):
            self._add_label(NameLabels.FRAMES, f"{root}/names/{number}", frame.full_name, body.name, frame.pose.xyz)

    def _add_label(self, kind: NameLabels, node: str, text: str, body: str, place: Vector3) -> None:
        label = self._scene.add_label(
            node, text, position=place, visible=False, font_screen_scale=0.8, anchor="bottom-center"
        )
        self._labels.append(NodeLabel(kind, text, body, place, label))

    def _add_pick(self, node: Any, find_frame: Callable[[Any], str]) -> None:
        node.on_click(lambda event: self._pick(find_frame(event), False))
        node.on_click(lambda event: self._pick(find_frame(event), True), modifier="shift")

    def _draw_shape(self, name: str, shape: Shape, kind: DrawnAs, points: list[Array], solid: list[Array]) -> Any:
        """Draw a shape; None for a mesh that cannot be read.

        Its outermost points in the body are appended to `points`, and to `solid` where it is part of the vehicle.
        """
        stated = find_color(shape)
        *rgb, opacity = choose_color(shape, kind)
        color = tuple(round(255 * each) for each in rgb)
        scene = self._scene
        place: dict[str, Any] = {"wxyz": shape.pose.wxyz, "position": shape.pose.xyz}
        look: dict[str, Any] = {"color": color, "opacity": opacity if opacity < 1.0 else None, **place}
        is_translucent = stated is not None and opacity < MIN_OPACITY
        # what a sensor sees throws no shadow
        look["cast_shadow"] = not is_translucent
        if shape.kind is ShapeKind.MESH:
            try:
                mesh = self._meshes.read(shape.file, stated)
            except MeshError as error:
                files = self.unread.setdefault(str(error), [])
                if shape.file not in files:
                    files.append(shape.file)
                return None
            corners = mesh.outline * np.array(shape.size)
        else:
            corners = _list_outline(shape)
        points.append(shape.pose.transform(corners))
        if not is_translucent:
            solid.append(points[-1])
        if shape.kind is ShapeKind.BOX:
            return scene.add_box(name, dimensions=np.array(shape.size), **look)
        if shape.kind is ShapeKind.CYLINDER:
            return scene.add_cylinder(name, shape.size[0], shape.size[1], radial_segments=CYLINDER_SIDES, **look)
        if shape.kind is ShapeKind.SPHERE:
            return scene.add_icosphere(name, shape.size[0], **look)
        x, y, z = shape.size
        return scene.add_glb(name, mesh.glb, scale=(x, y, z), **place)

    def scale_axes(self, camera: Any, density: float) -> None:
        """Draw the axes of frames with a constant length in the picture of a camera; `density` as in `show_labels`."""
        focal = 0.5 * camera.image_height / math.tan(0.5 * camera.fov)
        for name, axes in self._axes.items():
            places = self._poses.get(name, Pose.identity()).transform(axes.batched_positions)
            _, depths = project(self._to_scene(places), camera)
            least, most = (each * self._size for each in AXES_SCALES)
            scales = np.clip(AXES_PX * density * depths / focal, least, most)
            if np.any(np.abs(scales / axes.batched_scales - 1.0) > AXES_TOLERANCE):
                axes.batched_scales = scales.astype(np.float32)

    def show_labels(self, shown: NameLabels, chosen: Collection[str], camera: Any = None, density: float = 1.0) -> None:
        """Show the names of bodies or frames, and those of some frames in any case.

        Those that would cover another one in the picture of a camera are left out, the nearest come first. `density`:
        pixels of the camera per pixel of its page.
        """
        is_chosen = np.array([each.kind is NameLabels.FRAMES and each.text in chosen for each in self._labels], bool)
        wanted = is_chosen | np.array([each.kind is shown for each in self._labels], bool)
        if camera is not None and self._labels:
            # a body without frames is drawn at the base frame
            bodies = [self._poses.get(each.body, Pose.identity()) for each in self._labels]
            places = [body.transform(each.place) for body, each in zip(bodies, self._labels, strict=True)]
            pixels, depths = project(self._to_scene(np.array(places)), camera)
            pixels[~wanted] = math.nan
            widths = np.array([LABEL_PX[0] * (len(each.text) + 1) for each in self._labels])
            wanted = choose_labels(pixels / density, np.where(is_chosen, 0.0, depths), widths, LABEL_PX[1])
        for each, is_visible in zip(self._labels, wanted.tolist(), strict=True):
            if each.handle.visible != is_visible:
                each.handle.visible = is_visible

    def hide(self, bodies: frozenset[str], kinds: frozenset[str]) -> None:
        """Hide bodies by name and what is of one of `KINDS`, and show the others."""
        self._hidden = (bodies, kinds)
        for name, node in self._bodies.items():
            node.visible = name not in bodies
        for kind, nodes in self._groups.items():
            for each in nodes:
                each.visible = kind not in kinds

    def find_frame(self, camera: Any, x: float, y: float, distance: float) -> tuple[str, Pose] | None:
        """Return the frame at a place of a camera's picture, and its pose in the base frame; None where there is none.

        `x` and `y` are parts of the picture's width and height from the upper left, `distance` is the greatest one of
        the frame from there, a part of the height. Of several the nearest to the camera is returned.
        """
        if self._frames is None:
            return None
        poses = self._frames.compute_frames(self._poses)
        if not poses:
            return None
        pixels, depths = project(self._to_scene(np.array([each.xyz for each in poses.values()])), camera)
        pointer = np.array((x * camera.image_width, y * camera.image_height))
        is_near = np.linalg.norm(pixels - pointer, axis=1) <= distance * camera.image_height
        if not is_near.any():
            return None
        return list(poses.items())[int(np.argmin(np.where(is_near, depths, math.inf)))]

    # --- pictures

    def show(self, picture: Picture, follow: bool = True) -> None:
        """Move the vehicle and its joints to those of a picture; the vehicle stays at the origin where `follow`."""
        if self._frames is not None and (moved := self._frames.move_joints(picture.joints)):
            self._place_bodies(moved)
        pose = picture.pose or Pose.identity()
        self._vehicle.position, self._vehicle.wxyz = pose.xyz, pose.wxyz
        self._place.position = pose.xyz
        self._grid.position = (0.0, 0.0, float(pose.transform((0.0, 0.0, self._ground))[2]))
        x, y, z = pose.xyz if follow else (0.0, 0.0, 0.0)
        self._world.position = (-x, -y, -z)

    def _place_bodies(self, poses: Mapping[str, Pose]) -> None:
        """Move bodies to their poses in the base frame, and redraw what depends on them."""
        for name, pose in poses.items():
            node, before = self._bodies[name], self._poses.get(name)
            node.wxyz = pose.wxyz
            if before is None or before.xyz != pose.xyz:
                node.position = pose.xyz
        self._poses.update(poses)
        for ends, lines in zip(self._ends, self._edges, strict=True):
            if not ends or any(body in poses for pair in ends for body, _ in pair):
                points = [[self._poses[body].transform(place) for body, place in pair] for pair in ends]
                lines.points = np.array(points, np.float32).reshape(-1, 2, 3)
        if not poses.keys().isdisjoint(frame.partition(":")[0] for frame in self._path):
            self._draw_path()

    def get_frame_pose(self, frame: str) -> Pose | None:
        """Return the pose of a frame in the base frame as drawn; None for an unknown or world frame."""
        body, _, name = frame.partition(":")
        if body not in self._poses or self._frames is None or not self._frames.model.body(body).has_frame(name):
            return None
        return self._poses[body] @ self._frames.model.frame(frame).pose

    def highlight_path(self, frames: Sequence[str]) -> None:
        self._path = tuple(frames)
        self._draw_path()

    def _draw_path(self) -> None:
        points = [pose.xyz for frame in self._path if (pose := self.get_frame_pose(frame)) is not None]
        lines = [pair for pair in pairwise(points) if pair[0] != pair[1]]
        self._path_lines.points = np.array(lines, np.float32).reshape(-1, 2, 3)

    def show_gizmo(self, body: str, parent: Pose, pose: Pose, move: Callable[[Pose, bool], None]) -> None:
        """Show a gizmo at a pose in the frame `parent` of a body.

        `move` is called with the pose to which it is dragged, and whether that is the end of the drag.
        """
        self.hide_gizmo()
        node = self._bodies.get(body)
        if node is None:
            return
        # a name of its own each time: a page hides for good what is removed and added again under the same one
        self._gizmo_count += 1
        name = f"{node.name}/edited{self._gizmo_count}"
        self._gizmo = self._scene.add_frame(name, show_axes=False, position=parent.xyz, wxyz=parent.wxyz)
        controls = self._scene.add_transform_controls(
            f"{name}/gizmo",
            scale=GIZMO_SCALE * self._size,
            depth_test=False,
            position=pose.xyz,
            wxyz=pose.wxyz,
        )

        async def follow(event: viser.TransformControlsEvent) -> None:
            # async: the order of the phases is kept
            place = Pose(event.target.position.tolist(), event.target.wxyz.tolist())
            if event.phase != "start":
                move(place, event.phase == "end")

        controls.on_update(follow)

    def hide_gizmo(self) -> None:
        if self._gizmo is not None:
            self._gizmo.remove()
            self._gizmo = None

    def mark(self, body: str, place: Pose | None) -> None:
        """Outline a body, and a frame on it at `place`, where they are drawn."""
        if self._mark is not None:
            self._mark.remove()
            self._mark = None
        node = self._bodies.get(body)
        if node is None or self._frames is None:
            return
        shapes = list(_list_shapes(self._frames.model.body(body)))
        if place is not None:
            shapes.append(Shape(ShapeKind.BOX, (MARK_SCALE * self._size,) * 3, place))
        edges = [self._outline(each) for each in shapes]
        # as for the gizmo
        self._gizmo_count += 1
        self._mark = self._add_lines(
            f"{node.name}/selected{self._gizmo_count}", SELECTED_COLOR, 3.0, np.concatenate(edges)
        )

    def _outline(self, shape: Shape) -> Array:
        """Return the edges (12, 2, 3) of the box around a shape, on its body; none of a mesh that cannot be read."""
        if shape.kind is ShapeKind.MESH:
            try:
                points = self._meshes.read(shape.file).outline * np.array(shape.size)
            except MeshError:
                return NO_LINES
        else:
            points = _list_outline(shape)
        low, high = points.min(axis=0), points.max(axis=0)
        center, half = (low + high) / 2.0, OUTLINE_SCALE * (high - low) / 2.0
        corners = (center + (2.0 * _CUBE - 1.0) * half).reshape(-1, 3)
        return shape.pose.transform(corners).reshape(-1, 2, 3)

    def show_trail(self, utimes: npt.NDArray[np.int64], points: Array) -> None:
        """Draw the trail through points (n, 3) in World:UTM at times (n,), microseconds.

        Only its last seconds are sent again with each picture, the rest when it is `TRAIL_PERIOD_US` old.
        """
        if not len(points):
            self._trail_span = (0, 0)
            for lines in (self._trail, self._trail_end):
                lines.visible = False
            return
        span = (int(utimes[0]), int(utimes[-1]))
        begin, end = self._trail_span
        if not (0 <= span[1] - end < TRAIL_PERIOD_US and abs(span[0] - begin) < 2 * TRAIL_PERIOD_US):
            self._trail_span = begin, end = span
            step = max(1, -(-len(points) // MAX_TRAIL_POINTS))
            self._draw_line(self._trail, points[::-1][::step][::-1])
        self._draw_line(self._trail_end, points[np.searchsorted(utimes, end) :])

    @staticmethod
    def _draw_line(lines: Any, points: Array) -> None:
        lines.visible = len(points) > 1
        if lines.visible:
            lines.points = np.stack([points[:-1], points[1:]], axis=1).astype(np.float32)

    def show_fixes(self, points: Array, colors: npt.NDArray[np.int64]) -> None:
        """Draw fixes at points (n, 3) in World:UTM, by their `FixColor` (n,)."""
        self._fixes.visible = bool(len(points))
        if len(points):
            self._fixes.points = points[-MAX_FIXES:].astype(np.float32)
            self._fixes.colors = FIX_COLORS[colors[-MAX_FIXES:]].reshape(-1, 3)

    def show_uncertainty(self, picture: Picture, confidence: int, is_shown: bool) -> None:
        """Draw the ellipsoid of the position at a confidence, and the protection levels of position and heading."""
        pose, color = picture.pose, INVALID_COLOR if picture.invalid else VALID_COLOR
        radius, heading = picture.horizontal_protection_level, picture.heading_protection_level
        self._place.visible = is_shown and pose is not None
        if pose is None or not is_shown:
            return
        self._ellipsoid.visible = picture.covariance is not None
        if picture.covariance is not None:
            self._ellipsoid.scale, axes = compute_ellipsoid(picture.covariance, CHI_SQUARE_3[confidence])
            self._ellipsoid.wxyz = axes.wxyz
        if color != self._uncertainty_color:
            self._uncertainty_color = self._ellipsoid.color = color
            for lines in (self._circle, *self._wedge):
                lines.colors = np.array(color, np.uint8)
        self._level.visible = math.isfinite(radius)
        if self._level.visible:
            self._circle.scale = round(radius, 2)
            for sign, side in zip((-1.0, 1.0), self._wedge, strict=True):
                side.visible, side.scale = math.isfinite(heading), round(max(radius, MIN_WEDGE), 2)
                if side.visible:
                    yaw = float(pose.rpy[2]) + sign * min(heading, math.pi)
                    side.wxyz = Pose.from_rpy((0.0, 0.0, 0.0), yaw=yaw).wxyz

    def label_grid(self, picture: Picture, origin: Origin | None) -> None:
        """Label the grid around the vehicle with UTM coordinates, latitude and longitude."""
        if picture.pose is None or origin is None:
            return
        east, north = (round(each / LABEL_SPACING) for each in picture.pose.xyz[:2])
        if self._labeled == (east, north, origin):
            return
        self._labeled, geodesy = (east, north, origin), geodesy_of(origin)
        for i in range(-GRID_LABELS, GRID_LABELS + 1):
            for k in range(-GRID_LABELS, GRID_LABELS + 1):
                x, y = (east + i) * LABEL_SPACING, (north + k) * LABEL_SPACING
                easting, northing = origin.initial_utm[0] + x, origin.initial_utm[1] + y
                try:
                    latitude, longitude, _ = geodesy.geodetic_from_utm(easting, northing, 0.0)
                except GeodesyError:
                    continue
                text = f"{easting:.0f} E {northing:.0f} N\n{latitude:.6f}, {longitude:.6f}"
                self._scene.add_label(f"/world/grid/{i} {k}", text, position=(x, y, 0.0), font_screen_scale=0.6)


def _list_shapes(body: Body) -> tuple[Shape, ...]:
    return body.visuals or body.collisions or (make_frame_box(body),)


def _list_outline(shape: Shape) -> Array:
    """Return points (n, 3) of a box, cylinder or sphere around its center: corners, or points on its circles."""
    if shape.kind is ShapeKind.BOX:
        return np.array(list(product((-0.5, 0.5), repeat=3))) * shape.size
    radius = shape.size[0]
    if shape.kind is ShapeKind.SPHERE:
        return radius * np.asarray(trimesh.creation.icosphere(2).vertices)
    angles = np.linspace(0.0, 2.0 * math.pi, CYLINDER_SIDES, endpoint=False)
    circle = radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    ends = [np.column_stack([circle, np.full(len(circle), z)]) for z in (-shape.size[1] / 2.0, shape.size[1] / 2.0)]
    return np.concatenate(ends)
