"""Explanation of an answer: edges, their provenance, and shares that add up."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from support_moving import BASE, DEEP, ODOM, SCAN, T0, UTM, S, view

from modelserver.joints import JointHistory
from modelserver.messages import JointSample, JointsSample, Policy, SensorHeader, TimeQuery
from modelserver.query.path import explain
from modelserver.query.view import PlatformView
from modelserver.transforms.pose import Pose

NOW = T0 + 2 * S
BETWEEN = TimeQuery(T0 + 1_234_567)


@cache
def held() -> PlatformView:
    return view(2.0)


@pytest.mark.parametrize(
    ("interest", "reference"),
    [(SCAN, UTM), (UTM, SCAN), (DEEP, SCAN), (SCAN, DEEP), ("Finger:Tip", BASE), (BASE, "Finger:Tip"), (ODOM, SCAN)],
)
def test_given_a_pair_then_shares_sum_to_one_and_the_edges_make_the_answer(interest: str, reference: str) -> None:
    found = explain(held(), interest, reference, BETWEEN, NOW)
    assert sum(each.position_share for each in found.edges) == pytest.approx(1.0)
    assert sum(each.rotation_share for each in found.edges) == pytest.approx(1.0)
    assert all(0.0 <= each.position_share <= 1.0 for each in found.edges)
    pose = Pose.identity()
    for each in found.edges:
        pose = pose @ each.pose
    assert pose.is_close(found.answer.transformation.pose, 1e-9, 1e-9)


def test_given_both_directions_then_the_edges_are_the_same_the_other_way_round() -> None:
    forth = explain(held(), SCAN, UTM, BETWEEN, NOW).edges
    back = explain(held(), UTM, SCAN, BETWEEN, NOW).edges
    assert [(e.kind, e.name, e.ends) for e in forth] == [(e.kind, e.name, e.ends) for e in reversed(back)]
    assert [e.forward for e in forth] == [not e.forward for e in reversed(back)]


def test_given_a_laser_in_the_world_then_each_edge_has_kind_ends_and_provenance() -> None:
    found = explain(held(), SCAN, UTM, BETWEEN, NOW).edges
    assert [(e.kind, e.name, e.ends, e.provenance, e.source) for e in found] == [
        ("vehicle", UTM, (UTM, BASE), "interpolated", "localization"),
        ("frame", "Rover:Mast", ("Rover", "Rover:Mast"), "fixed", ""),
        ("constraint", "Nod", ("Rover:Mast", "Laser:Axle"), "fixed", ""),
        ("joint", "Nod", ("Rover:Mast", "Laser:Axle"), "interpolated", "arm"),
        ("frame", SCAN, ("Laser", SCAN), "fixed", ""),
    ]
    # the newest measurement in it: the next sample after the instant, of the vehicle at 100 Hz and of joints at 50
    assert [e.stamp - T0 if e.stamp else 0 for e in found] == [1_240_000, 0, 0, 1_240_000, 0]
    assert found[0].age == pytest.approx(0.76)
    assert math.isnan(found[1].age)
    assert len(found[3].coordinates) == 1


@pytest.mark.parametrize(
    ("time", "how", "stamp"),
    [
        (TimeQuery(T0 + S), "measured", S),
        (TimeQuery(T0 + S + 5, Policy.HELD), "held", S),
        (TimeQuery(T0 + 2 * S + 5, Policy.PREDICTED), "predicted", 2 * S),
        (TimeQuery(), "measured", 2 * S),
    ],
)
def test_given_a_policy_then_joint_and_vehicle_have_its_provenance_and_stamp(
    time: TimeQuery, how: str, stamp: int
) -> None:
    found = explain(held(), SCAN, UTM, time, NOW).edges
    assert (found[3].provenance, found[3].stamp - T0) == (how, stamp)
    assert found[0].stamp - T0 == stamp


def test_given_joints_never_received_then_they_are_at_defaults_with_no_stamp_and_no_source() -> None:
    platform = held()._replace(joints=JointHistory(held().model.joints.values(), 60.0))
    nod = explain(platform, SCAN, BASE, BETWEEN, NOW).edges[2]
    assert (nod.kind, nod.provenance, nod.stamp, nod.source) == ("joint", "default", 0, "")


NOD = JointSample("Nod", 0.7)


@pytest.mark.parametrize(
    ("time", "now", "frame", "warnings"),
    [
        (BETWEEN, NOW, SCAN, {"Nod": ""}),
        (TimeQuery(), NOW, SCAN, {"Nod": ""}),
        (TimeQuery(), NOW + 3 * S, SCAN, {"Nod": "silent for 3.0 s"}),
        (TimeQuery(T0 + 4 * S, Policy.HELD), NOW, SCAN, {"Nod": "silent for 2.0 s"}),
        (TimeQuery(), T0, SCAN, {"Nod": "stamped in the future: the clock was set back"}),
        (BETWEEN, NOW, DEEP, {"Slide": "", "Ball": "", "Table": ""}),
    ],
)
def test_given_a_joint_that_flags_the_answer_then_its_edge_has_the_warning_and_no_other(
    time, now, frame, warnings
) -> None:
    platform = held()._replace(localizer=None) if time.policy is Policy.HELD else held()
    found = explain(platform, frame, BASE, time, now)
    assert {each.name: each.warning for each in found.edges if each.kind == "joint"} == warnings
    assert bool(found.answer.transformation.invalid_reasons) == any(warnings.values())
    assert not any(each.warning for each in found.edges if each.kind != "joint")


def test_given_a_joint_beyond_its_limits_or_never_received_then_its_edge_has_a_warning() -> None:
    bare = JointHistory(held().model.joints.values(), 60.0)
    beyond, _ = bare.update(JointsSample(SensorHeader(T0, "laser head"), (NOD,)), T0)
    (edge,) = (
        each
        for each in explain(held()._replace(joints=beyond), SCAN, BASE, TimeQuery(T0), T0).edges
        if each.kind == "joint"
    )
    assert (edge.warning, edge.source) == ("beyond its limits", "laser head")
    found = explain(held()._replace(joints=bare), DEEP, BASE, BETWEEN, NOW).edges
    assert {each.name: each.warning for each in found if each.kind == "joint"} == {
        "Slide": "not received: at its default",
        "Ball": "not received, and no default is stated",
        "Table": "not received, and no default is stated",
    }


def test_given_two_sources_of_a_joint_then_the_last_is_reported() -> None:
    joints, _ = held().joints.update(JointsSample(SensorHeader(T0 + 2 * S + 20_000, "spare"), (NOD,)), NOW + S)
    late, _ = joints.update(JointsSample(SensorHeader(T0 + S + 1, "arm"), (NOD,)), NOW + S)
    for each in (joints, late):
        found = explain(held()._replace(joints=each), SCAN, BASE, TimeQuery(T0 + S), NOW).edges
        assert [edge.source for edge in found if edge.kind == "joint"] == ["spare"]


def test_given_a_follower_then_its_source_names_the_leader() -> None:
    found = explain(held(), "Finger:Tip", DEEP, BETWEEN, NOW).edges
    assert [each.source for each in found if each.kind == "joint"] == ["arm of Nod"]


def test_given_edges_that_state_no_sigma_then_their_shares_are_unknown_and_the_others_add_up() -> None:
    found = explain(view(2.0, sigma=None), SCAN, UTM, BETWEEN, NOW).edges
    unknown = [math.isnan(each.position_share) for each in found]
    assert unknown == [False, True, True, False, True]
    assert np.nansum([each.position_share for each in found]) == pytest.approx(1.0)
