"""Clearpath's A200 and J100 as URDF, against another loader; libbot2's own test configuration."""

import random
from itertools import product

import numpy as np
import pytest
import yourdfpy
from support_formats import read
from support_urdf import coordinates_of, pose_at

from modelserver.errors import Severity
from modelserver.formats import load_model, save_model
from modelserver.geometry import JointType

pytestmark = pytest.mark.realdata

ROBOTS = {
    "clearpath_a200.urdf": (11, ["front_left", "front_right", "rear_left", "rear_right"]),
    "clearpath_j100.urdf": (11, ["front_left", "front_right", "rear_left", "rear_right"]),
}


@pytest.fixture(params=ROBOTS)
def robot(request, data_dir):
    return data_dir / "geometry" / "urdf" / request.param


def test_a_robot_loads_clean_with_its_joints(robot):
    bodies, wheels = ROBOTS[robot.name]
    model = load_model(robot)
    assert [each for each in model.problems if each.severity is not Severity.NOTE] == []
    assert len(model.bodies) == bodies
    assert len(model.assemblies) == 1
    assert sorted(model.joints) == [f"{wheel}_wheel_joint" for wheel in wheels]
    for each in model.joints.values():
        assert (each.joint.type, each.joint.axis, each.joint.lower) == (JointType.REVOLUTE, (0.0, 1.0, 0.0), ())


def test_a_robot_agrees_with_another_loader_on_every_pair_of_links_wherever_its_joints_stand(robot):
    rng = random.Random(9)
    model = load_model(robot)
    written = read(save_model(model, "urdf").text)
    other = yourdfpy.URDF.load(str(robot), load_meshes=False)
    assert sorted(other.link_map) == sorted(model.get_body_list())
    for _ in range(5):
        values = {name: rng.uniform(-10, 10) for name in coordinates_of(model)}
        other.update_cfg(values)
        for a, b in product(model.get_body_list(), repeat=2):
            wanted = other.get_transform(frame_to=a, frame_from=b)
            for one in (model, written):
                found = pose_at(one, f"{a}:Origin", f"{b}:Origin", values).matrix
                np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-9)


def test_masses_shapes_and_text_survive_urdf_and_yaml(robot):
    model = load_model(robot)
    other = yourdfpy.URDF.load(str(robot), load_meshes=False)
    for body in model.bodies:
        link = other.link_map[body.name]
        assert (len(body.visuals), len(body.collisions)) == (len(link.visuals), len(link.collisions))
        if link.inertial is None:
            assert body.mass is None
            continue
        assert body.mass == link.inertial.mass
        center = np.zeros(3) if link.inertial.origin is None else link.inertial.origin[:3, 3]
        np.testing.assert_allclose(body.center_of_mass, center, rtol=0, atol=1e-12)
    saved = save_model(model, "urdf")
    assert saved.unsupported == ()
    assert save_model(read(saved.text), "urdf").text == saved.text
    assert read(save_model(model, "yaml").text).bodies == model.bodies


def test_libbot2s_own_configuration_loads(data_dir):
    model = load_model(data_dir / "geometry" / "bot_frames" / "libbot2_test_params.cfg")
    assert [each for each in model.problems if each.severity is not Severity.NOTE] == []
    assert model.get_body_list() == ["local", "body", "laser", "camera"]
    assert list(model.joints) == ["body"]
    assert model.get_transformation("camera:Origin", "local:Origin").pose.xyz == (1.0, 0.0, 0.0)
    # where bot_frames puts it after BODY_TO_LOCAL message (1, 2, 3) and half a turn about z
    values = dict(zip(coordinates_of(model), (0.0, 0.0, np.pi, 1.0, 2.0, 3.0), strict=True))
    assert pose_at(model, "camera:Origin", "local:Origin", values).xyz == pytest.approx((0.0, 2.0, 3.0))
