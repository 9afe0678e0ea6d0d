"""What an answer rests on: the edges, how each was come by, and shares that add up."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from support_moving import BASE, DEEP, ODOM, SCAN, T0, UTM, S, view

from modelserver.joints import Joints
from modelserver.messages import Policy, TimeQuery
from modelserver.platform import PlatformView
from modelserver.platform.explained import explained
from modelserver.spatial.pose import Pose

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
    found = explained(held(), interest, reference, BETWEEN, NOW)
    assert sum(each.position_share for each in found.edges) == pytest.approx(1.0)
    assert sum(each.rotation_share for each in found.edges) == pytest.approx(1.0)
    assert all(0.0 <= each.position_share <= 1.0 for each in found.edges)
    pose = Pose.identity()
    for each in found.edges:
        pose = pose @ each.pose
    assert pose.is_close(found.answer.transformation.pose, 1e-9, 1e-9)


def test_given_both_directions_then_the_edges_are_the_same_the_other_way_round() -> None:
    forth = explained(held(), SCAN, UTM, BETWEEN, NOW).edges
    back = explained(held(), UTM, SCAN, BETWEEN, NOW).edges
    assert [(e.kind, e.name, e.ends) for e in forth] == [(e.kind, e.name, e.ends) for e in reversed(back)]
    assert [e.forward for e in forth] == [not e.forward for e in reversed(back)]


def test_given_a_laser_in_the_world_then_each_edge_says_what_it_is_between_what_and_how() -> None:
    found = explained(held(), SCAN, UTM, BETWEEN, NOW).edges
    assert [(e.kind, e.name, e.ends, e.how, e.source) for e in found] == [
        ("vehicle", UTM, (UTM, BASE), "interpolated", "localization"),
        ("frame", "Rover:Mast", ("Rover", "Rover:Mast"), "fixed", ""),
        ("constraint", "Nod", ("Rover:Mast", "Laser:Axle"), "fixed", ""),
        ("joint", "Nod", ("Rover:Mast", "Laser:Axle"), "interpolated", "JOINTS"),
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
def test_given_a_policy_then_joint_and_vehicle_say_how_and_on_what_they_rest(
    time: TimeQuery, how: str, stamp: int
) -> None:
    found = explained(held(), SCAN, UTM, time, NOW).edges
    assert (found[3].how, found[3].stamp - T0) == (how, stamp)
    assert found[0].stamp - T0 == stamp


def test_given_joints_never_heard_then_they_are_at_rest_with_no_stamp_and_no_source() -> None:
    platform = replace(held(), joints=Joints(held().model.joints.values(), 60.0))
    nod = explained(platform, SCAN, BASE, BETWEEN, NOW).edges[2]
    assert (nod.kind, nod.how, nod.stamp, nod.source) == ("joint", "at_rest", 0, "")


def test_given_a_follower_then_its_source_names_the_leader() -> None:
    found = explained(held(), "Finger:Tip", DEEP, BETWEEN, NOW).edges
    assert [each.source for each in found if each.kind == "joint"] == ["JOINTS of Nod"]


def test_given_edges_that_state_no_sigma_then_their_shares_are_unknown_and_the_others_add_up() -> None:
    found = explained(view(2.0, sigma=None), SCAN, UTM, BETWEEN, NOW).edges
    unknown = [math.isnan(each.position_share) for each in found]
    assert unknown == [False, True, True, False, True]
    assert np.nansum([each.position_share for each in found]) == pytest.approx(1.0)
