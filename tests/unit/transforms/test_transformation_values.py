"""A Transformation knows its frames, works its covariance out late, and cannot be changed."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest

from modelserver.errors import FrameMismatchError
from modelserver.transforms import Pose, Transformation

SOME = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
AB = Transformation("B:b", "A:a", Pose((1, 2, 3)), SOME)


def test_frames_must_meet():
    bc = Transformation("C:c", "B:b", Pose((1, 0, 0)))
    assert (AB @ bc).frame_of_interest == "C:c"
    assert (AB @ bc).frame_of_reference == "A:a"
    assert (AB @ bc).pose == Pose((2, 2, 3))
    assert AB.inverse().frame_of_interest == "A:a"
    with pytest.raises(FrameMismatchError, match="left side ends at C:c but the right side starts at A:a"):
        bc @ AB
    with pytest.raises(TypeError):
        AB @ Pose()


@pytest.mark.parametrize("what", ["utime", "pose_epoch", "origin_id"])
def test_what_holds_at_different_times_epochs_or_origins_is_not_chained(what):
    one, two = Transformation("B:b", "A:a", Pose(), **{what: 1}), Transformation("C:c", "B:b", Pose(), **{what: 2})
    with pytest.raises(FrameMismatchError, match=f"left side has {what} 1, the right side 2"):
        one @ two
    static = Transformation("C:c", "B:b", Pose())
    assert getattr(one @ static, what) == 1
    assert getattr(static.inverse() @ one.inverse(), what) == 1


def test_invalid_reasons_add_up():
    one = Transformation("B:b", "A:a", Pose(), invalid_reasons=1)
    two = Transformation("C:c", "B:b", Pose(), invalid_reasons=4)
    assert (one @ two).invalid_reasons == 5
    assert not (one @ two).is_valid
    assert AB.is_valid
    assert "invalid: reasons 0x5" in str(one @ two)


def test_covariance_is_worked_out_once_and_only_when_looked_at():
    calls = []

    def work():
        calls.append(1)
        return SOME

    lazy = Transformation("B:b", "A:a", Pose(), work)
    chained = (lazy @ Transformation("C:c", "B:b", Pose(), SOME)).inverse()
    assert not calls
    np.testing.assert_array_equal(lazy.covariance, SOME)
    assert lazy.covariance is lazy.covariance
    assert chained.covariance is not None
    assert calls == [1]


def test_covariance_is_a_read_only_copy_and_leaves_the_callers_array_alone():
    mine = SOME.copy()
    for given in (mine, lambda: mine):
        made = Transformation("B:b", "A:a", Pose(), given)
        assert made.covariance is not mine
        with pytest.raises(ValueError, match="read-only"):
            made.covariance[0, 0] = 9
        assert mine.flags.writeable
    copy = Transformation("B:b", "A:a", Pose(), mine)
    mine[0, 0] = 99
    assert copy.covariance[0, 0] == 1


@pytest.mark.parametrize("wrong", [np.eye(3), np.ones(6), np.ones(36)])
def test_covariance_of_another_shape_is_rejected(wrong):
    with pytest.raises(ValueError, match=r"shape \(6, 6\), got"):
        Transformation("B:b", "A:a", Pose(), wrong)


def test_nothing_can_be_set():
    for name in ("pose", "utime", "covariance", "anything"):
        with pytest.raises(AttributeError, match="immutable"):
            setattr(AB, name, 1)
    with pytest.raises(AttributeError, match="immutable"):
        del AB.pose


def test_pickles_and_copies_keep_everything_even_what_is_not_worked_out_yet():
    made = Transformation("B:b", "A:a", Pose((1, 2, 3)), lambda: SOME, 5, 6, 7, 8, "abc")
    for back in (pickle.loads(pickle.dumps(made)), copy.copy(made), copy.deepcopy(made)):
        assert back == made
        assert hash(back) == hash(made)
        np.testing.assert_array_equal(back.covariance, SOME)
        assert (back.utime, back.invalid_reasons, back.pose_epoch, back.origin_id, back.model_revision) == (
            (5, 6, 7, 8, "abc")
        )


def test_equality_looks_at_everything():
    same = Transformation("B:b", "A:a", Pose((1, 2, 3)), SOME)
    assert same == AB
    assert hash(same) == hash(AB)
    for other in (
        Transformation("B:b", "A:a", Pose((1, 2, 3))),
        Transformation("B:c", "A:a", Pose((1, 2, 3)), SOME),
        Transformation("B:b", "A:c", Pose((1, 2, 3)), SOME),
        Transformation("B:b", "A:a", Pose((1, 2, 4)), SOME),
        Transformation("B:b", "A:a", Pose((1, 2, 3)), 2 * SOME),
        Transformation("B:b", "A:a", Pose((1, 2, 3)), SOME, utime=1),
        Transformation("B:b", "A:a", Pose((1, 2, 3)), SOME, model_revision="x"),
    ):
        assert other != AB
    assert AB != "AB"


def test_getters_are_those_of_the_pose():
    for getter in ("matrix", "position", "quaternion", "rotation", "rpy", "state_vector"):
        np.testing.assert_array_equal(getattr(AB, getter), getattr(AB.pose, getter))
    assert repr(AB).startswith("<Transformation B:b in A:a: position (1.000, 2.000, 3.000)")
