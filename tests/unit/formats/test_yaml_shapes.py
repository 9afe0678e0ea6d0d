"""Visuals and collisions in the YAML format."""

import pytest
from support_formats import YAML, problems_of, read

from modelserver.errors import Severity
from modelserver.formats import save_model
from modelserver.geometry import Material, ModelBuilder, Shape, ShapeKind
from modelserver.transforms import Pose

VISUALS = """\
  Camera:
    visuals:
      - box: [0.1, 0.2, 0.3]
        xyz: [0, 0, 1]
        rpy_deg: [0, 0, 90]
        name: case
      - cylinder: {radius: 0.05, length: 0.2}
      - mesh: "meshes/lens cap.stl"
        scale: [0.001, 0.001, 0.001]
        material: {name: "on", color: [1, 0, 0, 0.5], texture: a.png}
    collisions:
      - sphere: {radius: 0.3}
"""
TEXT = YAML.replace("  Camera:\n", VISUALS)


def test_shapes_are_read():
    body = read(TEXT).body("Camera")
    case, barrel, cap = body.visuals
    assert case == Shape(ShapeKind.BOX, (0.1, 0.2, 0.3), case.pose, name="case")
    assert case.pose.is_close(Pose.from_rpy((0, 0, 1), 0, 0, 1.5707963267948966))
    assert barrel == Shape(ShapeKind.CYLINDER, (0.05, 0.2))
    red = Material("on", (1, 0, 0, 0.5), "a.png")
    assert cap == Shape(ShapeKind.MESH, (0.001,) * 3, file="meshes/lens cap.stl", material=red)
    assert body.collisions == (Shape(ShapeKind.SPHERE, (0.3,)),)


def test_shapes_come_back():
    model = read(TEXT)
    assert read(save_model(model, "yaml").text).bodies == model.bodies


def test_a_body_takes_its_templates_shapes_unless_it_has_its_own():
    text = (
        "templates:\n  t:\n    visuals: [{sphere: {radius: 1}}]\n    frames: {Origin: }\n"
        "bodies:\n  A: {template: t}\n  B: {template: t, visuals: [{box: [1, 1, 1]}]}\n"
        "constraints:\n  C: {from: A:Origin, to: B:Origin}\n"
    )
    a, b = read(text).bodies
    assert a.visuals[0].kind is ShapeKind.SPHERE
    assert [shape.kind for shape in b.visuals] == [ShapeKind.BOX]


def test_a_body_added_again_keeps_its_shapes():
    camera = read(TEXT).body("Camera")
    builder = ModelBuilder()
    builder.copy_body(camera.with_name("Rear"))
    assert builder.build().root.visuals == camera.visuals


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("box: [0.1, 0.2, 0.3]", "box: [0.1, 0.2]", "box has 2 numbers, not 3"),
        ("box: [0.1, 0.2, 0.3]", "box: [0.1, -0.2, 0.3]", "the y of a box is finite and not negative"),
        ("box: [0.1, 0.2, 0.3]", "boks: [0.1, 0.2, 0.3]", "expected one shape, got no shape"),
        ("box: [0.1, 0.2, 0.3]", "box: [1, 1, 1]\n        sphere: {radius: 1}", "got both box and sphere"),
        ("box: [0.1, 0.2, 0.3]", "box: [1, 1, 1]\n        scale: [1, 1, 1]", "a box has no scale"),
        (", length: 0.2", "", "length is missing"),
        ('mesh: "meshes/lens cap.stl"', 'mesh: ""', "a mesh's file is missing"),
        ("color: [1, 0", "color: [2, 0", "each from 0 to 1"),
        ('name: "on", ', "", "a material's name is missing"),
        ("- sphere: {radius: 0.3}", "sphere", "expected a list of shapes"),
    ],
)
def test_a_bad_shape_is_an_error_with_its_place(old, new, message):
    errors = [each for each in problems_of(TEXT.replace(old, new)) if each.severity is Severity.ERROR]
    problem = next(each for each in errors if message in each.message)
    assert problem.fix
    assert problem.line > 5
    assert problem.element.startswith("body Camera, ")
