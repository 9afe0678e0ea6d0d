"""The newest reading of each joint, told again for who comes late: held there of any age, never in place of newer."""

from __future__ import annotations

from dataclasses import replace

import pytest
from support_mirror import fed, joints, parts, snapshot
from support_moving import BASE, SCAN, T0, S, joints_at, rover

from modelserver.client.knowledge import NEVER
from modelserver.joints.joints import Joints
from modelserver.messages import NAN, Invalid, JointSample, JointsSample, Policy, SensorHeader, TimeQuery
from modelserver.wire.codec import encode

HOUR = 3600 * S


def known(*samples: JointsSample) -> Joints:
    held = Joints(rover().joints.values(), 60.0)
    for sample in samples:
        held, refused = held.taken(sample, sample.header.utime)
        assert not refused
    return held


def told(utime: int, source: str, *names: str) -> JointsSample:
    return JointsSample(SensorHeader(utime, source), tuple(JointSample(name, 0.25, 0.001, 0.1, 0.01) for name in names))


def test_given_joints_of_several_drivers_then_each_instant_and_teller_is_one_sample() -> None:
    held = known(told(T0, "arm", "Slide", "Nod"), told(T0 + S, "arm", "Nod"), told(T0 + S, "table", "Table.x"))
    found = held.newest(T0 + HOUR)
    assert [(each.header.utime - T0, each.header.source, [one.name for one in each.joints]) for each in found] == [
        (0, "arm", ["Slide"]),
        (S, "arm", ["Nod"]),
        (S, "table", ["Table.x"]),
    ]
    assert {each.header.host_utime for each in found} == {T0 + HOUR}
    assert found[0].joints[0] == JointSample("Slide", 0.25, 0.001, 0.1, 0.01)


def test_given_nothing_told_then_nothing_is_told_again() -> None:
    assert known().newest(T0) == []


def test_given_readings_of_an_hour_ago_then_they_are_held_with_who_told_them_and_newer_ones_stay() -> None:
    first = known(told(T0, "arm", "Nod", "Slide"))
    late = known(told(T0 + HOUR, "spare", "Nod"))
    for sample in first.newest(T0 + HOUR):
        late = late.recalled(sample)
    assert (late.tracks["Nod"].newest.utime, late.tracks["Nod"].source) == (T0 + HOUR, "spare")
    assert len(late.tracks["Nod"]) == 1
    assert late.tracks["Slide"].newest == first.tracks["Slide"].newest
    assert late.tracks["Slide"].source == "arm"
    again = late.recalled(first.newest(T0 + HOUR)[0])
    assert again is late


@pytest.mark.parametrize(
    "joint",
    [JointSample("Stranger", 0.1), JointSample("Nod", NAN), JointSample("Nod", 1e9), JointSample("Nod", 0.1, -1)],
)
def test_given_what_cannot_be_then_it_is_passed_over(joint: JointSample) -> None:
    held = known()
    assert held.recalled(JointsSample(SensorHeader(T0, "arm"), (joint,))) is held


def test_given_a_mirror_that_starts_late_then_it_has_where_joints_were_told_to_be_and_says_how_old_that_is() -> None:
    now = T0 + HOUR
    service = known(joints_at(0.0))
    events = [(now + n, *message) for n, message in enumerate(parts(snapshot(), now))]
    events += [(now + 100 + n, "JOINTS_HELD", encode(each)) for n, each in enumerate(service.newest(now))]
    heard = fed(events)
    view = heard.known.view
    assert view is not None
    assert heard.known.joints_heard == NEVER
    assert {name: track.newest for name, track in view.joints.tracks.items()} == {
        name: track.newest for name, track in service.tracks.items()
    }
    mine = view.transformation(SCAN, BASE, TimeQuery(now, Policy.HELD)).transformation
    truth = replace(view, joints=service).transformation(SCAN, BASE, TimeQuery(now, Policy.HELD)).transformation
    assert mine.pose == truth.pose
    assert mine.invalid_reasons == truth.invalid_reasons == int(Invalid.STALE_JOINT)
    # what is told from now on is newer, and counts
    heard.feed(*joints(3600.5), now + S)
    assert heard.known.joints_heard == now + S
    assert heard.known.joints.tracks["Nod"].last == T0 + HOUR + S // 2


def test_given_held_joints_before_any_geometry_or_of_the_future_then_they_are_not_taken() -> None:
    sample = known(joints_at(0.0)).newest(T0)[0]
    heard = fed([(T0, "JOINTS_HELD", encode(sample))])
    assert heard.known.view is None
    assert not heard.rejected
    heard = fed([(T0 + n, *message) for n, message in enumerate(parts(snapshot()))], heard)
    ahead = replace(sample, header=replace(sample.header, utime=T0 + 10 * S))
    heard.feed("JOINTS_HELD", encode(ahead), T0 + 100)
    heard.feed("JOINTS_HELD", b"no message", T0 + 100)
    assert dict(heard.rejected) == {("JOINTS_HELD", "future"): 1, ("JOINTS_HELD", "fingerprint"): 1}
    assert not heard.known.joints.tracks
