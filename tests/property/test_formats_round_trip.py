"""Every format reads back the model that it wrote, but for the features that it lists as unsupported."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support_formats import assert_same_transforms, models, read
from support_spatial import rotations

from modelserver.formats import save_model
from modelserver.formats.common import to_rpy_degrees
from modelserver.transforms import Pose

pytestmark = pytest.mark.slow


def fold_spaces(text):
    return " ".join("".join(each if each.isprintable() else " " for each in text).split())


def assert_same_poses(one, other, default=False):
    """Compare the stored poses to 1e-12: the content of the file, not only what follows from it.

    With `default` the joints of the first are at their default position: the other has none.
    """
    pairs = [(a.pose, b.pose) for x, y in zip(one.bodies, other.bodies, strict=True) for a, b in zip(x, y, strict=True)]
    joined = zip(one.constraints, other.constraints, strict=True)
    pairs += [(a.default_pose if default else a.pose, b.pose) for a, b in joined]
    pairs += [(a.pose or Pose(), b.pose or Pose()) for a, b in zip(one.bodies, other.bodies, strict=True)]
    for a, b in pairs:
        np.testing.assert_allclose(a.matrix, b.matrix, rtol=0, atol=1e-12)


@given(models())
@settings(max_examples=25)
def test_yaml_gives_back_everything(model):
    saved = save_model(model, "yaml")
    again = read(saved.text)
    assert saved.unsupported == ()
    assert_same_poses(model, again)
    assert_same_transforms(model, again)
    assert (again.name, again.description) == (model.name, model.description)
    for mine, theirs in zip(model.bodies, again.bodies, strict=True):
        assert (mine.name, mine.description, mine.inertia) == (theirs.name, theirs.description, theirs.inertia)
        assert (mine.pose is None) == (theirs.pose is None)
        for a, b in zip(mine, theirs, strict=True):
            assert (a.name, a.description, a.sigma, a.pose.xyz) == (b.name, b.description, b.sigma, b.pose.xyz)
    for a, b in zip(model.constraints, again.constraints, strict=True):
        assert (a.name, a.from_, a.to, a.description, a.sigma, a.joint) == (
            b.name,
            b.from_,
            b.to,
            b.description,
            b.sigma,
            b.joint,
        )


@given(models())
@settings(max_examples=25)
def test_miro_xml_gives_back_all_transforms_and_lists_what_is_unsupported(model):
    saved = save_model(model, "miro")
    again = read(saved.text)
    assert_same_poses(model, again, default=True)
    assert_same_transforms(model, again)
    assert not again.joints
    frames = [frame for body in model.bodies for frame in body]
    lost = " ".join(saved.unsupported)
    assert ("sigmas of" in lost) == any(each.sigma for each in (*frames, *model.constraints))
    assert ("motion of" in lost) == bool(model.joints)
    assert ("inertia" in lost) == any(body.inertia is not None for body in model.bodies)
    assert [fold_spaces(body.description) for body in model.bodies] == [body.description for body in again.bodies]
    assert [frame.name for frame in frames] == [frame.name for body in again.bodies for frame in body]


@given(rotations)
@settings(max_examples=300)
def test_angles_in_degrees_are_written_only_where_they_read_back(wxyz):
    degrees = to_rpy_degrees(wxyz)
    if degrees is not None:
        back = Pose.from_rpy((0, 0, 0), *np.radians(degrees).tolist())
        assert back.distance(Pose((0, 0, 0), wxyz))[1] <= 1e-12


@given(st.tuples(*[st.integers(-89, 89).map(lambda tenth: tenth / 10)] * 3))
def test_round_angles_are_written_round(angles):
    wxyz = Pose.from_rpy((0, 0, 0), *np.radians(angles).tolist()).wxyz
    assert to_rpy_degrees(wxyz) == angles
