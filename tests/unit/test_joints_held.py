"""The newest reading of each joint, republished for late subscribers: restored at any age, never in place of newer."""

from __future__ import annotations

from dataclasses import replace

import pytest
from support_mirror import feed_messages, joints, parts, snapshot
from support_moving import BASE, SCAN, T0, S, joints_at, rover

from modelserver.client.mirror_state import NEVER
from modelserver.joints import JointHistory
from modelserver.messages import NAN, Invalid, JointSample, JointsSample, Policy, SensorHeader, TimeQuery
from modelserver.wire.codec import encode

HOUR = 3600 * S


def history_of(*samples: JointsSample) -> JointHistory:
    held = JointHistory(rover().joints.values(), 60.0)
    for sample in samples:
        held, rejected = held.update(sample, sample.header.utime)
        assert not rejected
    return held


def make_sample(utime: int, source: str, *names: str) -> JointsSample:
    return JointsSample(SensorHeader(utime, source), tuple(JointSample(name, 0.25, 0.001, 0.1, 0.01) for name in names))


def test_given_joints_of_several_drivers_then_each_instant_and_teller_is_one_sample() -> None:
    held = history_of(
        make_sample(T0, "arm", "Slide", "Nod"),
        make_sample(T0 + S, "arm", "Nod"),
        make_sample(T0 + S, "table", "Table.x"),
    )
    found = held.get_newest_samples(T0 + HOUR)
    assert [(each.header.utime - T0, each.header.source, [one.name for one in each.joints]) for each in found] == [
        (0, "arm", ["Slide"]),
        (S, "arm", ["Nod"]),
        (S, "table", ["Table.x"]),
    ]
    assert {each.header.host_utime for each in found} == {T0 + HOUR}
    assert found[0].joints[0] == JointSample("Slide", 0.25, 0.001, 0.1, 0.01)


def test_given_no_readings_then_nothing_is_republished() -> None:
    assert history_of().get_newest_samples(T0) == []


def test_given_readings_of_an_hour_ago_then_they_are_restored_with_their_source_and_newer_ones_stay() -> None:
    first = history_of(make_sample(T0, "arm", "Nod", "Slide"))
    late = history_of(make_sample(T0 + HOUR, "spare", "Nod"))
    for sample in first.get_newest_samples(T0 + HOUR):
        late = late.restore(sample)
    assert (late.tracks["Nod"].newest.utime, late.tracks["Nod"].source) == (T0 + HOUR, "spare")
    assert len(late.tracks["Nod"]) == 1
    assert late.tracks["Slide"].newest == first.tracks["Slide"].newest
    assert late.tracks["Slide"].source == "arm"
    again = late.restore(first.get_newest_samples(T0 + HOUR)[0])
    assert again is late


@pytest.mark.parametrize(
    "joint",
    [JointSample("Stranger", 0.1), JointSample("Nod", NAN), JointSample("Nod", 1e9), JointSample("Nod", 0.1, -1)],
)
def test_given_what_cannot_be_then_it_is_passed_over(joint: JointSample) -> None:
    held = history_of()
    assert held.restore(JointsSample(SensorHeader(T0, "arm"), (joint,))) is held


def test_given_a_mirror_that_starts_late_then_it_has_the_joints_with_their_age() -> None:
    now = T0 + HOUR
    service = history_of(joints_at(0.0))
    events = [(now + n, *message) for n, message in enumerate(parts(snapshot(), now))]
    events += [(now + 100 + n, "JOINTS_HELD", encode(each)) for n, each in enumerate(service.get_newest_samples(now))]
    mirror = feed_messages(events)
    view = mirror.state.view
    assert view is not None
    assert mirror.state.joints_received == NEVER
    assert {name: track.newest for name, track in view.joints.tracks.items()} == {
        name: track.newest for name, track in service.tracks.items()
    }
    mine = view.transformation(SCAN, BASE, TimeQuery(now, Policy.HELD)).transformation
    truth = view._replace(joints=service).transformation(SCAN, BASE, TimeQuery(now, Policy.HELD)).transformation
    assert mine.pose == truth.pose
    assert mine.invalid_reasons == truth.invalid_reasons == int(Invalid.STALE_JOINT)
    # readings from now on are newer, and count
    mirror.feed(*joints(3600.5), now + S)
    assert mirror.state.joints_received == now + S
    assert mirror.state.joints.tracks["Nod"].last == T0 + HOUR + S // 2


def test_given_held_joints_before_any_geometry_or_of_the_future_then_they_are_not_used() -> None:
    sample = history_of(joints_at(0.0)).get_newest_samples(T0)[0]
    mirror = feed_messages([(T0, "JOINTS_HELD", encode(sample))])
    assert mirror.state.view is None
    assert not mirror.rejected
    mirror = feed_messages([(T0 + n, *message) for n, message in enumerate(parts(snapshot()))], mirror)
    ahead = replace(sample, header=replace(sample.header, utime=T0 + 10 * S))
    mirror.feed("JOINTS_HELD", encode(ahead), T0 + 100)
    mirror.feed("JOINTS_HELD", b"no message", T0 + 100)
    assert dict(mirror.rejected) == {("JOINTS_HELD", "future"): 1, ("JOINTS_HELD", "fingerprint"): 1}
    assert not mirror.state.joints.tracks
