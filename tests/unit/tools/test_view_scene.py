"""The 3D scene of the viewer against the answers of queries."""

from __future__ import annotations

import ast
import base64
import json
import math
import re
import shlex
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh
import yaml
from support_lcm import reserved_url
from trimesh.visual.material import PBRMaterial

pytest.importorskip("viser", reason="the extra view is not installed: pip install -e '.[view]'")

from modelserver import load_model
from modelserver.formats.yaml_geometry import ModelSnapshot, encode_snapshot
from modelserver.messages import SnapshotPart
from modelserver.transforms.pose import Pose
from modelserver.wire.codec import encode
from modelserver.wire.eventlog import encode_event
from mstools.commands.demo import find_vehicle_file
from mstools.commands.new import TEMPLATES, Device, NewVehicle, make_geometry
from mstools.commands.view import open_source
from mstools.meshes import MeshError, MeshFolders
from mstools.recordings.drive import Picture
from mstools.recordings.pose_signals import CHI_SQUARE_3, compute_ellipsoid
from mstools.view.camera import VIEWS, fit_camera, project
from mstools.view.page import Page, escape_markdown, open_page
from mstools.view.scene import (
    AXES_PX,
    LABEL_PX,
    MARK_SCALE,
    OUTLINE_SCALE,
    NameLabels,
    VehicleScene,
)
from mstools.view.sources import Source, list_coordinates, open_geometry
from mstools.view.viewer import describe_answer, describe_unread, format_code

TETRAHEDRON = """\
v 0 0 0
v 1 0 0
v 0 1 0
v 0 0 1
f 1 3 2
f 1 2 4
f 1 4 3
f 2 3 4
"""
PIXEL = "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAIAAACQd1PeAAAADElEQVR4nGP4z8AAAAMBAQDJ/pLvAAAAAElFTkSuQmCC"
"""A PNG file of one red pixel."""


@pytest.fixture
def page() -> Iterator[Page]:
    opened = open_page(port=0)
    yield opened
    opened.close()


def make_scene(page: Page, source: Source) -> VehicleScene:
    scene = VehicleScene(page.server, source.meshes, lambda frame, is_reference: None)
    assert source.drive.model is not None
    scene.set_model(source.drive.model, source.drive.base_frame)
    return scene


def test_given_joints_anywhere_then_each_frame_is_drawn_where_a_query_places_it(page: Page) -> None:
    source = open_geometry(find_vehicle_file(), {})
    scene = make_scene(page, source)
    model = source.drive.model
    assert model is not None
    assert source.set_joints is not None
    generator = np.random.default_rng(3)
    for _ in range(5):
        source.set_joints({name: generator.uniform(-0.5, 0.5) for name, _, _ in list_coordinates(model)})
        scene.show(source.drive.get_picture())
        for body in model.bodies:
            for frame in body:
                drawn = scene.get_frame_pose(frame.full_name)
                found = source.answers.get_pose(frame.full_name, source.drive.base_frame).transformation
                assert drawn is not None
                assert found.is_valid
                assert drawn.is_close(found.pose, 1e-9, 1e-9), frame.full_name


def test_given_bodies_that_nothing_joins_then_they_are_beside_the_vehicle(page: Page, tmp_path: Path) -> None:
    path = tmp_path / "geometry.yaml"
    path.write_text("modelserver: geometry/1\nbodies:\n  A: {frames: {F: {}}}\n  B: {frames: {F: {}}}\n")
    scene = make_scene(page, open_geometry(path, {}))
    near, far = (scene.get_frame_pose(name) for name in ("A:F", "B:F"))
    assert near is not None
    assert far is not None
    assert near.xyz == (0.0, 0.0, 0.0)
    assert far.xyz[1] < -0.5
    assert scene.get_frame_pose("World:UTM") is None


def test_given_a_mesh_then_it_is_read_from_the_folder_and_a_missing_one_is_named(page: Page, tmp_path: Path) -> None:
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "mast.obj").write_text(TETRAHEDRON)
    # the binary chunk begins with the numbers of the corners
    head, _, tail = bytes(trimesh.creation.box().export(file_type="glb")).partition(b"BIN\0")
    (tmp_path / "meshes" / "short.glb").write_bytes(head + b"BIN\0" + (99).to_bytes(4, "little") + tail[4:])
    (tmp_path / "meshes" / "empty.stl").write_bytes(b"no mesh")
    (tmp_path / "meshes" / "bad.ply").write_bytes(b"no mesh")
    folders = MeshFolders(tmp_path)
    for file in ("meshes/mast.obj", "package://robot/meshes/mast.obj", f"file://{tmp_path}/meshes/mast.obj"):
        assert sorted(folders.read(file).outline.tolist()) == [[0, 0, 0], [0, 0, 1], [0, 1, 0], [1, 0, 0]]
    for file, reason in (
        ("missing.stl", "not found in .*--package-path"),
        ("package://robot/missing.stl", "package robot not found .*ROS_PACKAGE_PATH.*--package-path FOLDER"),
        ("package://", "not found"),
        ("meshes/empty.stl", "no triangles"),
        ("meshes/bad.ply", "cannot be read"),
        ("meshes/short.glb", "corners that it does not have"),
    ):
        with pytest.raises(MeshError, match=reason):
            folders.read(file)
    urdf = tmp_path / "robot.urdf"
    urdf.write_text(
        '<robot name="r"><link name="a"><visual><geometry><mesh filename="meshes/mast.obj"/></geometry></visual></link>'
        '<link name="b"><visual><geometry><mesh filename="missing.stl"/></geometry></visual>'
        '<collision><geometry><sphere radius="1"/></geometry></collision></link>'
        '<link name="c"><visual><geometry><mesh filename="missing.stl"/></geometry></visual></link>'
        '<joint name="j" type="fixed"><parent link="a"/><child link="b"/></joint>'
        '<joint name="k" type="fixed"><parent link="a"/><child link="c"/></joint></robot>'
    )
    scene = make_scene(page, open_geometry(urdf, {}))
    assert list(scene.unread.values()) == [["missing.stl"]]
    assert "<wbr>missing" not in describe_unread(scene.unread)
    assert all(each in describe_unread(scene.unread) for each in ("missing.stl", "--package-path"))
    drawn = {node.name.partition("/body/")[2] for node in page.server.scene._handle_from_node_name.values()}
    assert {"0/visual/0", "1/collision/0", "2/box/0"} < drawn
    assert not {"0/collision/0", "0/box/0", "1/box/0"} & drawn


def test_given_folders_of_packages_then_meshes_are_found_there_also_for_a_geometry_from_the_bus(tmp_path: Path) -> None:
    def make(folder: str, number: int) -> Path:
        place = tmp_path / folder / "meshes"
        place.mkdir(parents=True)
        (place / "mast.obj").write_text(TETRAHEDRON.replace("v 1 0 0", f"v {number} 0 0"))
        return tmp_path / folder

    make("given/arm", 1)
    workspace = make("workspace/src/stack/cart", 2)
    (workspace / "package.xml").write_text("<package/>")
    make("prefix/share/mast", 3)
    environment = {"ROS_PACKAGE_PATH": f"/none:{tmp_path}/workspace", "AMENT_PREFIX_PATH": f"{tmp_path}/prefix"}
    folders = MeshFolders(None, (tmp_path / "given",), environment)
    for file, number in (
        ("package://arm/meshes/mast.obj", 1),
        ("arm/meshes/mast.obj", 1),
        ("package://cart/meshes/mast.obj", 2),
        ("package://mast/meshes/mast.obj", 3),
    ):
        assert folders.read(file).outline[:, 0].max() == number, file
    # a folder that is itself the package
    assert MeshFolders(None, (tmp_path / "given" / "arm",), {}).find("package://arm/meshes/mast.obj").is_file()
    secret = tmp_path / "secret.obj"
    secret.write_text(TETRAHEDRON)
    for file in (str(secret), f"file://{secret}", "package://arm/../../secret.obj", f"package://{secret}"):
        with pytest.raises(MeshError, match="from the bus"):
            folders.find(file)
    with pytest.raises(MeshError, match="not found in package arm, which is"):
        folders.find("package://arm/meshes/none.obj")


def test_given_the_geometry_of_a_log_or_a_service_then_its_meshes_are_drawn_from_the_folders_given(
    page: Page, tmp_path: Path
) -> None:
    (tmp_path / "given" / "arm").mkdir(parents=True)
    (tmp_path / "given" / "arm" / "mast.obj").write_text(TETRAHEDRON)
    urdf = tmp_path / "robot.urdf"
    urdf.write_text(
        '<robot name="r"><link name="a"><visual><geometry><mesh filename="package://arm/mast.obj"/></geometry></visual>'
        "</link></robot>"
    )
    model = load_model(urdf)
    whole = encode_snapshot(ModelSnapshot("r", model, "a:Origin", "a:Origin", 60.0, "JOINTS"))
    log = tmp_path / "drive.lcm"
    log.write_bytes(
        encode_event(0, 10**15, b"MODEL_SNAPSHOT", encode(SnapshotPart(10**15, model.revision, 0, 1, whole)))
    )
    packages = (tmp_path / "given",)
    for given in ((), packages):
        scene = make_scene(page, open_source(log, None, None, "", "", 1.0, packages=given))
        assert list(scene.unread.values()) == ([] if given else [["package://arm/mast.obj"]])
    with reserved_url() as url:
        live = open_source(None, None, None, url, "", 1.0, packages=packages)
        live.close()
    assert live.meshes == MeshFolders(None, packages)


def read_tree(glb: bytes) -> dict[str, Any]:
    """Return the JSON chunk of a GLB file, after a header of 12 bytes (glTF 2.0, 4.4)."""
    return dict(json.loads(glb[20 : 20 + int.from_bytes(glb[12:16], "little")]))


# pycollada, which reads and writes DAE files, does that
@pytest.mark.filterwarnings("ignore:Setting the shape on a NumPy array:DeprecationWarning")
def test_given_colors_of_a_mesh_then_they_are_drawn_and_those_of_the_shape_replace_them(tmp_path: Path) -> None:
    (tmp_path / "two.mtl").write_text("newmtl red\nKd 0.5 0 0\nnewmtl green\nKd 0 1 0\n")
    faces = TETRAHEDRON.replace("f 1 3 2", "usemtl red\nf 1 3 2").replace("f 1 4 3", "usemtl green\nf 1 4 3")
    (tmp_path / "two.obj").write_text(f"mtllib two.mtl\n{faces}")
    colored = trimesh.creation.box()
    colored.visual.vertex_colors = np.tile((255, 0, 0, 255), (8, 1))  # type: ignore[union-attr]
    colored.export(tmp_path / "vertices.ply")
    trimesh.creation.box().export(tmp_path / "plain.stl")
    metal = PBRMaterial(baseColorFactor=(128, 0, 0, 255), metallicFactor=1.0)
    box = trimesh.creation.box()
    box.visual = trimesh.visual.TextureVisuals(material=metal)
    box.export(tmp_path / "metal.glb")
    text = str(box.export(file_type="dae").decode())
    (tmp_path / "cm.dae").write_text(text.replace("<up_axis>", '<unit name="cm" meter="0.01"/><up_axis>'))
    folders = MeshFolders(tmp_path)

    def find_colors(file: str, color: tuple[float, float, float, float] | None = None) -> list[tuple[float, ...]]:
        materials = read_tree(folders.read(file, color).glb)["materials"]
        assert all(each["doubleSided"] for each in materials)
        assert all(each["pbrMetallicRoughness"]["metallicFactor"] == 0.0 for each in materials)
        return [tuple(each["pbrMetallicRoughness"]["baseColorFactor"]) for each in materials]

    # 128/255 in sRGB is 0.216 of the intensity of 1 (IEC 61966-2-1); what glTF has is linear
    assert {round(each[0], 2) for each in find_colors("two.obj")} == {0.22, 0.0}
    assert [round(each[0], 2) for each in find_colors("metal.glb")] == [0.5]
    assert [round(each[0], 2) for each in find_colors("cm.dae")] == [0.22]
    assert np.ptp(folders.read("cm.dae").outline, axis=0) == pytest.approx([0.01] * 3)
    assert find_colors("vertices.ply") == [(1.0, 1.0, 1.0, 1.0)]
    assert b"COLOR_0" in folders.read("vertices.ply").glb
    assert find_colors("plain.stl")[0][0] == pytest.approx(0.477, abs=0.001)
    for file in ("two.obj", "vertices.ply", "plain.stl", "metal.glb"):
        assert {each[1:] for each in find_colors(file, (0.0, 1.0, 0.0, 0.5))} == {(1.0, 0.0, 0.5)}
        assert b"COLOR_0" not in folders.read(file, (0.0, 1.0, 0.0, 0.5)).glb
        assert read_tree(folders.read(file, (0.0, 1.0, 0.0, 0.5)).glb)["materials"][0]["alphaMode"] == "BLEND"


def test_given_a_round_mesh_then_its_edges_alone_are_sharp(tmp_path: Path) -> None:
    trimesh.creation.cylinder(1.0, 1.0, sections=32).export(tmp_path / "wheel.stl")
    tree = read_tree(MeshFolders(tmp_path).read("wheel.stl").glb)
    corners = tree["meshes"][0]["primitives"][0]["attributes"]["POSITION"]
    # rim and two ends of 32 corners each, and the centers of the ends
    assert tree["accessors"][corners]["count"] == 4 * 32 + 2


def test_given_a_texture_then_its_picture_is_drawn(tmp_path: Path) -> None:
    (tmp_path / "red.png").write_bytes(base64.b64decode(PIXEL))
    (tmp_path / "flat.mtl").write_text("newmtl red\nKd 1 1 1\nmap_Kd red.png\n")
    triangle = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl red\nf 1/1 2/2 3/3\n"
    (tmp_path / "flat.obj").write_text(f"mtllib flat.mtl\n{triangle}")
    mesh = MeshFolders(tmp_path).read("flat.obj")
    tree = read_tree(mesh.glb)
    assert tree["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"] == {"index": 0}
    assert "TEXCOORD_0" in tree["meshes"][0]["primitives"][0]["attributes"]
    assert len(tree["images"]) == 1
    # flat: without a volume
    assert len(mesh.outline) == 3


def test_given_shadows_then_they_are_drawn_in_another_light(page: Page) -> None:
    scene = make_scene(page, open_geometry(find_vehicle_file(), {}))
    plain = (scene._grid.shadow_opacity, scene._light.intensity)
    scene.set_shadows(True)
    assert scene._grid.shadow_opacity > plain[0] == 0.0
    assert scene._light.intensity < plain[1]
    scene.set_shadows(False)
    assert (scene._grid.shadow_opacity, scene._light.intensity) == plain


@pytest.mark.parametrize("kind", TEMPLATES)
def test_given_a_new_vehicle_then_its_wheels_are_on_the_ground(kind: str, page: Page, tmp_path: Path) -> None:
    path = tmp_path / "geometry.yaml"
    device = Device(None)
    path.write_text(make_geometry(NewVehicle("rover", TEMPLATES[kind], device, device, device, has_camera=True)))
    scene = make_scene(page, open_geometry(path, {}))
    for height in (0.0, 7.0):
        scene.show(Picture(1, Pose((3.0, 4.0, height))))
        assert scene._grid.position[2] == pytest.approx(height, abs=1e-4)


@pytest.mark.parametrize(("name", "ground"), [("raptor", -0.65 + 0.017), ("husky", -0.13228)])
def test_given_a_vehicle_then_the_grid_is_below_its_wheels(name: str, ground: float, page: Page) -> None:
    scene = make_scene(page, open_geometry(find_vehicle_file().parents[1] / name / "vehicle.yaml", {}))
    scene.show(Picture(1))
    assert scene._grid.position[2] == pytest.approx(ground, abs=1e-4)
    assert scene.unread == {}


def test_given_a_direction_then_the_camera_sees_all_that_is_drawn_and_as_large_as_it_fits(page: Page) -> None:
    scene = make_scene(page, open_geometry(find_vehicle_file(), {}))
    points = scene.list_points()
    assert np.ptp(points, axis=0)[2] > 2.0
    for aspect, direction in product((0.5, 1.0, 2.0), (*VIEWS.values(), (0.0, 0.3, -1.0))):
        position, target = fit_camera(points, np.array(direction), math.radians(45.0), aspect)
        back = (position - target) / np.linalg.norm(position - target)
        assert back == pytest.approx(np.array(direction) / np.linalg.norm(direction))
        right = np.cross((0.0, 0.0, 1.0), back) / np.linalg.norm(np.cross((0.0, 0.0, 1.0), back))
        depth = -(points - position) @ back
        assert depth.min() > 0.0
        across = np.abs((points - position) @ right) / depth / (math.tan(math.radians(22.5)) * aspect)
        along = np.abs((points - position) @ np.cross(back, right)) / depth / math.tan(math.radians(22.5))
        assert 0.75 < max(across.max(), along.max()) < 1.0
    above = fit_camera(points, np.array((0.0, 0.0, 2.0)), math.radians(45.0), 1.0)
    assert above.position[:2] == pytest.approx(above.look_at[:2])


def test_given_a_selected_body_then_its_shapes_and_the_frame_are_outlined(page: Page, tmp_path: Path) -> None:
    (tmp_path / "part.obj").write_text(TETRAHEDRON)
    path = tmp_path / "geometry.yaml"
    path.write_text("""\
modelserver: geometry/1
bodies:
  Base:
    visuals:
      - {box: [2, 1, 1], xyz: [5, 0, 0], rpy_deg: [0, 0, 90]}
      - {cylinder: {radius: 1, length: 4}}
      - {sphere: {radius: 3}, xyz: [0, 10, 0]}
      - {mesh: part.obj, scale: [2, 2, -2]}
      - {mesh: absent.obj}
    frames: {Origin: {}, End: {xyz: [0, 0, 20]}}
""")
    source = open_geometry(path, {})
    scene = make_scene(page, source)
    scene.mark("Base", Pose((0.0, 0.0, 20.0)))
    boxes = np.array(scene._mark.points).reshape(-1, 24, 3)
    side = MARK_SCALE * scene._size
    centers = [(5, 0, 0), (0, 0, 0), (0, 10, 0), (1, 1, -1), (0, 0, 20)]
    sizes = [(1, 2, 1), (2, 2, 4), (6, 6, 6), (2, 2, 2), (side, side, side)]
    np.testing.assert_allclose((boxes.max(axis=1) + boxes.min(axis=1)) / 2.0, centers, atol=1e-6)
    np.testing.assert_allclose(np.ptp(boxes, axis=1), OUTLINE_SCALE * np.array(sizes), rtol=1e-6)
    # along the axes, four in each direction
    edges = np.abs(np.diff(np.array(scene._mark.points)[12:24], axis=1)[:, 0]) > 1e-6
    assert edges.sum(axis=0).tolist() == [4, 4, 4]
    scene.mark("Other", None)
    assert scene._mark is None


def test_given_a_camera_then_no_name_covers_another_and_the_chosen_ones_are_shown(page: Page) -> None:
    scene = make_scene(page, open_geometry(find_vehicle_file(), {}))
    scene.show(Picture(1))
    position, look_at = fit_camera(scene.list_points(), np.array(VIEWS["Oblique"]), math.radians(45.0), 1.5)
    camera = SimpleNamespace(
        position=position,
        look_at=look_at,
        up_direction=np.array((0.0, 0.0, 1.0)),
        fov=math.radians(45.0),
        image_width=1200,
        image_height=800,
    )
    scene.show_labels(NameLabels.FRAMES, ("Raptor:CG",), camera)
    shown = [each for each in scene._labels if each.handle.visible]
    assert 5 < len(shown) < len([each for each in scene._labels if each.kind is NameLabels.FRAMES])
    assert "Raptor:CG" in {each.text for each in shown}
    frames = {each.text: each for each in scene._labels if each.kind is NameLabels.FRAMES}
    places = np.array([scene.get_frame_pose(each.text).xyz for each in shown])  # type: ignore[union-attr]
    pixels, depths = project(places, camera)
    assert len(frames) > len(shown)
    assert ((pixels > 0) & (pixels < (1200, 800))).all()
    assert depths.min() > 0.0
    for number, pixel in enumerate(pixels):
        for other, place in enumerate(pixels[:number]):
            width = 0.5 * LABEL_PX[0] * (len(shown[number].text) + len(shown[other].text) + 2)
            assert abs(pixel[0] - place[0]) >= width or abs(pixel[1] - place[1]) >= LABEL_PX[1]
    # what is looked at is in the middle of the picture, and what is behind has no place in it
    assert project(np.array([look_at]), camera)[0][0] == pytest.approx((600.0, 400.0))
    assert np.isnan(project(np.array([2 * position - look_at]), camera)[0]).all()


def test_given_a_camera_that_comes_nearer_then_axes_have_the_same_length_in_its_picture(page: Page) -> None:
    scene = make_scene(page, open_geometry(find_vehicle_file(), {}))
    axes = scene._axes["Raptor"]
    for distance in (3.0, 4.5, 6.0):
        camera = SimpleNamespace(
            position=np.array((-distance, 0.0, 2.0)),
            look_at=np.array((0.0, 0.0, 0.5)),
            up_direction=np.array((0.0, 0.0, 1.0)),
            fov=0.9,
            image_width=1200,
            image_height=800,
        )
        scene.scale_axes(camera, 1.5)
        starts, length = axes.batched_positions, axes.batched_scales.reshape(-1, 1)
        pixels, depths = project(scene._to_scene(scene._poses["Raptor"].transform(starts)), camera)
        right = np.cross(
            (camera.look_at - camera.position) / np.linalg.norm(camera.look_at - camera.position), (0, 0, 1)
        )
        ends = scene._to_scene(scene._poses["Raptor"].transform(starts)) + length * right / np.linalg.norm(right)
        shown = np.linalg.norm(project(ends, camera)[0] - pixels, axis=1)
        assert shown[depths > 0.5] == pytest.approx(1.5 * AXES_PX, rel=0.06)
    # far away they shrink with the vehicle
    camera.position = np.array((-500.0, 0.0, 2.0))
    scene.scale_axes(camera, 2.0)
    assert axes.batched_scales == pytest.approx(0.2 * scene.size)


def test_given_a_covariance_then_its_ellipsoid_holds_the_stated_share_of_its_errors() -> None:
    generator = np.random.default_rng(1)
    root = generator.normal(size=(3, 3))
    covariance = root @ root.T
    errors = generator.multivariate_normal(np.zeros(3), covariance, 20_000)
    for percent, quantile in CHI_SQUARE_3.items():
        radii, pose = compute_ellipsoid(covariance, quantile)
        inside = np.sum((pose.inverse().transform(errors) / np.array(radii)) ** 2, axis=1) <= 1.0
        assert abs(float(np.mean(inside)) - 0.01 * percent) < 0.012


def test_given_a_picture_with_nan_and_without_covariance_then_nothing_is_drawn_of_them(page: Page) -> None:
    scene = make_scene(page, open_geometry(find_vehicle_file(), {}))
    for picture in (
        Picture(1),
        Picture(1, Pose.identity()),
        Picture(1, Pose.identity(), covariance=np.zeros((3, 3)), horizontal_protection_level=math.inf),
    ):
        scene.show(picture)
        scene.show_uncertainty(picture, 95, True)
        scene.show_trail(np.zeros(0, np.int64), np.zeros((0, 3)))
        scene.show_fixes(np.zeros((0, 3)), np.zeros(0, np.int64))


def test_given_a_trail_that_grows_then_both_its_parts_together_are_the_whole_trail(page: Page) -> None:
    scene = make_scene(page, open_geometry(find_vehicle_file(), {}))
    whole = np.stack([np.arange(1000.0), np.zeros(1000), np.zeros(1000)], axis=1)
    utimes = np.arange(1000, dtype=np.int64) * 33_000 + 10**15
    redrawn = set()
    for end in (*range(2, 700, 7), *range(400, 420)):
        scene.show_trail(utimes[:end], whole[:end])
        redrawn.add(len(scene._trail.points))
        shown = [lines.points[:, :, 0].ravel() for lines in (scene._trail, scene._trail_end) if lines.visible]
        assert sorted({*np.concatenate(shown).tolist()}) == list(range(end)), end
    assert len(redrawn) < 10
    scene.show_trail(utimes[:0], whole[:0])
    assert not scene._trail.visible
    assert not scene._trail_end.visible


def test_given_an_answer_then_the_panel_shows_its_numbers_and_how_to_ask_for_them() -> None:
    source = open_geometry(find_vehicle_file(), {})
    explanation = source.answers.explain("FrontSICKLaser:Scan", "Raptor:CG")
    text = describe_answer(explanation, None)
    found = explanation.answer.transformation
    assert f"| x | {found.pose.xyz[0]:.4f} m |" in text
    assert "FrontNoddingSICKAxis" in text
    code = format_code("FrontSICKLaser:Scan", "Raptor:CG", 5, explanation.answer)
    assert 'platform.get_pose("FrontSICKLaser:Scan", "Raptor:CG", at=5)' in code
    assert "modelserver query 'FrontSICKLaser:Scan' 'Raptor:CG' --at 5" in code


def test_given_quotes_in_names_then_what_is_copied_is_python_shell_and_yaml() -> None:
    interest, reference = """B:'"$(id)`""", r"C:\n"
    python, shell = re.findall(r"```\w+\n(.*)\n```", format_code(interest, reference, 0, None))
    assert [each.value for each in ast.parse(python).body[0].value.args] == [interest, reference]  # type: ignore[attr-defined]
    assert shlex.split(shell) == ["modelserver", "query", interest, reference]
    source = open_geometry(find_vehicle_file(), {})
    answer = source.answers.explain("FrontSICKLaser:Scan", "Raptor:CG").answer
    code = re.findall(r"```yaml\n(.*)\n```", format_code(interest, reference, 0, answer), re.DOTALL)[0]
    found = answer.transformation
    assert found.covariance is not None
    stated = yaml.safe_load(code)
    assert stated["xyz"] == pytest.approx(found.pose.xyz, rel=1e-5)
    sigmas = np.sqrt(np.diag(found.covariance))
    assert stated["sigma"]["xyz"] == pytest.approx(sigmas[:3], rel=1e-3)
    assert stated["sigma"]["rpy_deg"] == pytest.approx(np.degrees(sigmas[3:]), rel=1e-3)


def test_given_two_frames_that_are_queried_then_their_names_are_in_the_scene(page: Page) -> None:
    scene = make_scene(page, open_geometry(find_vehicle_file(), {}))
    scene.show_labels(NameLabels.BODIES, ("Raptor:CG", "FLEA:Lens"))
    shown = {each.text for each in scene._labels if each.handle.visible and each.kind is NameLabels.FRAMES}
    assert shown == {"Raptor:CG", "FLEA:Lens"}


def test_given_markup_in_a_name_then_it_is_shown_as_text() -> None:
    assert escape_markdown("a|b<script>*_") == r"a\|b\<script\>\*\_"
