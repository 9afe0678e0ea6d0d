"""The 3D scene of the viewer against the answers of queries."""

from __future__ import annotations

import ast
import math
import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml

pytest.importorskip("viser", reason="the extra view is not installed: pip install -e '.[view]'")

from modelserver.transforms.pose import Pose
from mstools.commands.demo import find_vehicle_file
from mstools.recordings.drive import Picture
from mstools.view.page import Page, escape_markdown, open_page
from mstools.view.scene import (
    CHI_SQUARE_3,
    MARK_SCALE,
    OUTLINE_SCALE,
    NameLabels,
    VehicleScene,
    compute_ellipsoid,
    read_mesh,
)
from mstools.view.sources import Source, list_coordinates, open_geometry
from mstools.view.viewer import describe_answer, format_code

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


@pytest.fixture
def page() -> Iterator[Page]:
    opened = open_page(port=0)
    yield opened
    opened.close()


def make_scene(page: Page, source: Source) -> VehicleScene:
    scene = VehicleScene(page.server, source.folder, lambda frame, is_reference: None)
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
    assert len(read_mesh("meshes/mast.obj", tmp_path).faces) == 4
    assert len(read_mesh("package://robot/meshes/mast.obj", tmp_path).faces) == 4
    (tmp_path / "meshes" / "empty.stl").write_bytes(b"no mesh")
    (tmp_path / "meshes" / "bad.ply").write_bytes(b"no mesh")
    for file, folder, reason in (
        ("missing.stl", tmp_path, "not found"),
        ("meshes/empty.stl", tmp_path, "no triangles"),
        ("meshes/bad.ply", tmp_path, "cannot be read"),
        ("meshes/short.glb", tmp_path, "corners that it does not have"),
        ("meshes/mast.obj", None, "not from the bus"),
    ):
        with pytest.raises(ValueError, match=reason):
            read_mesh(file, folder)
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
    assert scene.unread == ["missing.stl: not found"]
    drawn = {node.name.partition("/body/")[2] for node in page.server.scene._handle_from_node_name.values()}
    assert {"0/visual/0", "1/collision/0", "2/box/0"} < drawn
    assert not {"0/collision/0", "0/box/0", "1/box/0"} & drawn


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
    shown = {text for kind, text, label in scene._labels if label.visible and kind is NameLabels.FRAMES}
    assert shown == {"Raptor:CG", "FLEA:Lens"}


def test_given_markup_in_a_name_then_it_is_shown_as_text() -> None:
    assert escape_markdown("a|b<script>*_") == r"a\|b\<script\>\*\_"
