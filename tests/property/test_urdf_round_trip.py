"""URDF reads back the model that it wrote, but for unsupported features; another loader reads the same."""

import io
from itertools import product

import numpy as np
import pytest
import yourdfpy
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from support_formats import all_frames, read
from support_urdf import URDF, jointed_models, joints, pose_at, positions

from modelserver.formats import save_model
from modelserver.formats.urdf import list_link_names
from modelserver.geometry import ModelBuilder
from modelserver.transforms import Pose

pytestmark = pytest.mark.slow


def assert_same_places(model, again, place, values):
    """Compare every pair of frames with the joints at `values`; `place` maps the frames of one to the other."""
    root = next(iter(place))
    # one route for each frame here, and one for each pair only in the model that is tested: routes are what takes time
    X_R = {frame: pose_at(model, frame, root, values) for frame in place}
    X_inverse = {frame: pose.inverse() for frame, pose in X_R.items()}
    for a, b in product(place, repeat=2):
        wanted = X_inverse[b] @ X_R[a]
        assert pose_at(again, place[a], place[b], values).is_close(wanted, 1e-9, 1e-9), (a, b)


def assert_same_shapes(one, other):
    assert len(one) == len(other)
    for a, b in zip(one, other, strict=True):
        assert (a.kind, a.size, a.file, a.name, a.material) == (b.kind, b.size, b.file, b.name, b.material)
        assert a.pose.is_close(b.pose, 1e-12, 1e-10)


def assert_same_joints(one, other):
    for a, b in zip(one.constraints, other.constraints, strict=True):
        assert (a.name, a.from_, a.to) == (b.name, b.from_, b.to)
        assert a.pose.is_close(b.pose, 1e-12, 1e-10)
        assert np.allclose(a.joint.axis, b.joint.axis, rtol=0, atol=1e-15)
        for what in ("type", "lower", "upper", "rate_limit", "mimic"):
            assert getattr(a.joint, what) == getattr(b.joint, what)


@given(st.data())
@settings(max_examples=40)
def test_a_model_written_as_urdf_has_every_frame_at_its_place_wherever_the_joints_stand(data):
    model = data.draw(jointed_models())
    saved = save_model(model, "urdf")
    again = read(saved.text)
    place = {full: f"{link}:Origin" for full, link in list_link_names(model).items()}
    assert_same_places(model, again, place, data.draw(positions(model)))
    assert set(again.joints) == set(model.joints)
    assert not [loss for loss in saved.unsupported if "frames but as links" not in loss]


@given(st.data())
@settings(max_examples=40)
def test_a_model_that_came_from_urdf_comes_back_from_it_whole(data):
    model = read(save_model(data.draw(jointed_models()), "urdf").text)
    saved = save_model(model, "urdf")
    again = read(saved.text)
    assert saved.unsupported == ()
    assert again.get_body_list() == model.get_body_list()
    assert all_frames(again) == all_frames(model)
    assert_same_joints(model, again)
    for mine, theirs in zip(model.bodies, again.bodies, strict=True):
        assert_same_shapes(mine.visuals, theirs.visuals)
        assert_same_shapes(mine.collisions, theirs.collisions)
        assert (mine.inertia is None) == (theirs.inertia is None)
        if mine.inertia is not None:
            scale = np.abs(mine.inertia).max()
            np.testing.assert_allclose(theirs.inertia, mine.inertia, rtol=0, atol=1e-12 * scale)
    assert_same_places(model, again, {full: full for full in all_frames(model)}, data.draw(positions(model)))


@given(jointed_models())
@settings(max_examples=40)
def test_yaml_keeps_shapes_and_inertias_exactly(model):
    again = read(save_model(model, "yaml").text)
    for mine, theirs in zip(model.bodies, again.bodies, strict=True):
        assert mine.inertia == theirs.inertia
        assert_same_shapes(mine.visuals, theirs.visuals)
        assert_same_shapes(mine.collisions, theirs.collisions)


@given(st.data())
@settings(max_examples=40)
def test_urdf_through_yaml_and_back_keeps_joints_limits_mimic_and_every_transform(data):
    model = read(save_model(data.draw(jointed_models()), "urdf").text)
    again = read(save_model(read(save_model(model, "yaml").text), "urdf").text)
    assert_same_joints(model, again)
    assert_same_places(model, again, {full: full for full in all_frames(model)}, data.draw(positions(model)))


def plain(most):
    """Numbers that are 0 or no smaller than 1e-6: the other loader takes for nothing what turns by less than 1e-8."""
    return st.floats(-most, most).map(lambda value: round(value, 6))


@st.composite
def robots(draw):
    """Return a model that was URDF, with names and joints that the other loader takes: no mimic of a mimic."""
    builder = ModelBuilder("robot")
    count = draw(st.integers(2, 6))
    leaders: list[str] = []
    for number in range(count):
        body = builder.add_body(f"link{number}").add_frame("Origin")
        for each in range(number + 1, count):
            body.add_frame(f"joint{each}")
        if number:
            joint = draw(joints(forward=False, leaders=leaders))
            parent = draw(st.integers(0, number - 1))
            pose = Pose.from_rpy(*draw(st.tuples(st.tuples(*[plain(5)] * 3), *[plain(3)] * 3)))
            name = f"joint{number}"
            builder.add_constraint(name, f"link{parent}:{name}", f"link{number}:Origin", pose, joint=joint)
            if joint.is_movable and joint.mimic is None:
                leaders.append(name)
    return builder.build()


@given(st.data())
@settings(max_examples=40)
def test_another_loader_reads_what_is_written_and_agrees_on_every_pair_of_links(data):
    model = data.draw(robots())
    values = {name: round(value, 6) for name, value in data.draw(positions(model)).items()}
    text = save_model(model, "urdf").text
    other = yourdfpy.URDF.load(io.BytesIO(text.encode()), load_meshes=False, build_collision_scene_graph=False)
    other.update_cfg(values)
    # the other loader leaves out each transformation that is within 1e-8 of none
    for _, _, edge in other.scene.graph.to_edgelist():
        assume(not 0.0 < np.abs(np.asarray(edge["matrix"]) - np.eye(4)).max() <= 1e-8)
    again = read(text)
    for a, b in product(model.get_body_list(), repeat=2):
        wanted = other.get_transform(frame_to=a, frame_from=b)
        for one in (model, again):
            found = pose_at(one, f"{a}:Origin", f"{b}:Origin", values).matrix
            np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-9)


def test_the_support_file_itself_comes_back():
    model = read(URDF)
    assert save_model(read(save_model(model, "urdf").text), "urdf").text == save_model(model, "urdf").text
