"""Values of this project as parts of Foxglove's messages: times, poses, fixes, and the entities of its 3D scene."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, Final

import numpy as np
from foxglove.messages import (
    Color,
    CubePrimitive,
    CylinderPrimitive,
    FrameTransform,
    LocationFix,
    LocationFixPositionCovarianceType,
    ModelPrimitive,
    Quaternion,
    SceneEntity,
    SpherePrimitive,
    Timestamp,
    Vector3,
)
from foxglove.messages import Pose as FoxglovePose

from modelserver.geometry import names
from modelserver.geometry.parts import Body, Shape, ShapeKind
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from mstools.meshes import MeshError, MeshFolders
from mstools.recordings.drive import Picture
from mstools.recordings.pose_signals import CHI_SQUARE_3, compute_ellipsoid
from mstools.shapes import Rgba, choose_color, find_color, list_drawings

CONFIDENCE: Final = 95
"""Probability in percent that the position is in the drawn ellipsoid."""

DISC_HEIGHT: Final = 0.02
"""Height of the disc of the protection level, meters: a line where it is seen from the side."""

VALID_COLORS: Final = (Color(r=0.24, g=0.71, b=0.35, a=0.3), Color(r=0.24, g=0.71, b=0.35, a=0.15))
INVALID_COLORS: Final = (Color(r=0.88, g=0.27, b=0.24, a=0.3), Color(r=0.88, g=0.27, b=0.24, a=0.15))
"""Colors of ellipsoid and disc."""

GLB: Final = "model/gltf-binary"
"""Media type of glTF's binary form (glTF 2.0, 4.3)."""

Y_UP: Final = Pose.from_rpy((0.0, 0.0, 0.0), roll=-math.pi / 2.0)
"""What is undone by Foxglove, which turns glTF by 90 degrees about x: its y axis is up (glTF 2.0, 3.3), z is here."""


def make_timestamp(utime: int) -> Timestamp:
    """Raises OverflowError for a time that Foxglove's cannot hold."""
    seconds, microseconds = divmod(utime, 1_000_000)
    return Timestamp(seconds, microseconds * 1000)


def convert_pose(pose: Pose) -> FoxglovePose:
    position, orientation = _convert(pose)
    return FoxglovePose(position=position, orientation=orientation)


def _convert(pose: Pose) -> tuple[Vector3, Quaternion]:
    qw, qx, qy, qz = pose.wxyz
    return _make_vector(pose.xyz), Quaternion(x=qx, y=qy, z=qz, w=qw)


def _make_vector(xyz: so3.Vector3) -> Vector3:
    x, y, z = xyz
    return Vector3(x=x, y=y, z=z)


def make_transform(parent: str, child: str, pose: Pose, utime: int) -> FrameTransform:
    translation, rotation = _convert(pose)
    return FrameTransform(
        timestamp=make_timestamp(utime),
        parent_frame_id=names.shorten(parent),
        child_frame_id=names.shorten(child),
        translation=translation,
        rotation=rotation,
    )


def make_fix(
    utime: int,
    frame: str,
    place: tuple[float, float, float],
    covariance: list[float] | None,
    heading: float | None = None,
) -> LocationFix:
    """Return a fix at latitude and longitude in degrees and a height, with its covariance along east, north, up.

    `heading` is in radians, clockwise from north.
    """
    latitude, longitude, height = place
    kind = LocationFixPositionCovarianceType
    return LocationFix(
        timestamp=make_timestamp(utime),
        frame_id=names.shorten(frame),
        latitude=latitude,
        longitude=longitude,
        altitude=height if math.isfinite(height) else 0.0,
        position_covariance=covariance,
        position_covariance_type=kind.Unknown if covariance is None else kind.Known,
        heading=heading,
    )


# --- 3D scene


class BodyDrawer:
    """Make the entities of bodies, with meshes in them; `unread` has the files that cannot be read, by the reason."""

    def __init__(self, meshes: MeshFolders):
        self._meshes = meshes
        self.unread: dict[str, list[str]] = {}

    def draw(self, body: Body, utime: int) -> SceneEntity:
        """Return the entity of a body, which moves with its first frame."""
        frame = body.frames[0]
        to_frame = frame.pose.inverse()
        drawn: dict[ShapeKind, list[Any]] = {kind: [] for kind in ShapeKind}
        for drawn_as, shapes in list_drawings(body):
            for shape in shapes:
                primitive = self._draw_shape(shape, to_frame @ shape.pose, choose_color(shape, drawn_as))
                if primitive is not None:
                    drawn[shape.kind].append(primitive)
            if any(drawn.values()):
                break
        return SceneEntity(
            timestamp=make_timestamp(utime),
            frame_id=names.shorten(frame.full_name),
            id=body.name,
            frame_locked=True,
            cubes=drawn[ShapeKind.BOX],
            cylinders=drawn[ShapeKind.CYLINDER],
            spheres=drawn[ShapeKind.SPHERE],
            models=drawn[ShapeKind.MESH],
        )

    def _draw_shape(self, shape: Shape, place: Pose, rgba: Rgba) -> object:
        pose, color = convert_pose(place), _make_color(rgba)
        if shape.kind is ShapeKind.BOX:
            x, y, z = shape.size
            return CubePrimitive(pose=pose, size=Vector3(x=x, y=y, z=z), color=color)
        if shape.kind is ShapeKind.CYLINDER:
            radius, length = shape.size
            return _make_cylinder(pose, radius, length, color)
        if shape.kind is ShapeKind.SPHERE:
            return SpherePrimitive(pose=pose, size=_make_vector((2.0 * shape.size[0],) * 3), color=color)
        try:
            mesh = self._meshes.read(shape.file, find_color(shape))
        except MeshError as error:
            files = self.unread.setdefault(str(error), [])
            if shape.file not in files:
                files.append(shape.file)
            return None
        x, y, z = shape.size
        # the axes of the scale are those of the turned file
        return ModelPrimitive(
            pose=convert_pose(place @ Y_UP), scale=Vector3(x=x, y=z, z=y), color=color, media_type=GLB, data=mesh.glb
        )


def make_uncertainty(picture: Picture, frame: str) -> SceneEntity:
    """Return the entity with the ellipsoid of the position and the disc of the horizontal protection level.

    The ellipsoid is that of the position's whole covariance at `CONFIDENCE`; what is not known is not drawn.
    """
    spheres, cylinders = [], []
    radius, covariance = picture.horizontal_protection_level, picture.covariance
    if picture.pose is not None:
        inner, outer = INVALID_COLORS if picture.invalid else VALID_COLORS
        if covariance is not None and np.isfinite(covariance).all():
            semi_axes, axes = compute_ellipsoid(covariance, CHI_SQUARE_3[CONFIDENCE])
            size = Vector3(x=2.0 * semi_axes[0], y=2.0 * semi_axes[1], z=2.0 * semi_axes[2])
            pose = convert_pose(Pose(picture.pose.xyz, axes.wxyz))
            spheres.append(SpherePrimitive(pose=pose, size=size, color=inner))
        if 0.0 < radius < math.inf:
            cylinders.append(_make_cylinder(convert_pose(Pose(picture.pose.xyz)), radius, DISC_HEIGHT, outer))
    return SceneEntity(
        timestamp=make_timestamp(picture.utime),
        frame_id=names.shorten(frame),
        id="uncertainty",
        spheres=spheres,
        cylinders=cylinders,
    )


def _make_cylinder(pose: FoxglovePose, radius: float, length: float, color: Color) -> CylinderPrimitive:
    size = Vector3(x=2.0 * radius, y=2.0 * radius, z=length)
    return CylinderPrimitive(pose=pose, size=size, bottom_scale=1.0, top_scale=1.0, color=color)


def _make_color(rgba: Iterable[float]) -> Color:
    r, g, b, a = rgba
    return Color(r=r, g=g, b=b, a=a)
