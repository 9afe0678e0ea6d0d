"""The replica of a mirror equals the server's data: geometry, poses and joints from the bus, and their ages."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support_between import lookup_between
from support_mirror import DELAY, FedPlatform, drive, feed_messages, joints, parts, pose, snapshot
from support_moving import BASE, DEEP, ODOM, SCAN, SURVEY, T0, UTM, S, estimate, joints_at, rover, truth, twist, vehicle
from support_moving import view as exact_view

import modelserver as ms
from modelserver.client.mirror_state import MAX_COUNTERS, MirrorReceiver, PublishedEstimate
from modelserver.geometry.builder import ModelBuilder
from modelserver.geometry.model import Model
from modelserver.messages import Invalid, Policy, Quality, SnapshotPart, TimeQuery
from modelserver.query.batch import lookup_batch
from modelserver.query.path import compute_motion, explain
from modelserver.query.view import PlatformView, complete
from modelserver.transforms.pose import Pose
from modelserver.wire.codec import encode

END = T0 + 4 * S
PAIRS = [(BASE, UTM), (UTM, BASE), (BASE, ODOM), (SCAN, UTM), (SCAN, BASE), (DEEP, SCAN), ("Finger:Tip", ODOM)]
TIMES = [T0, T0 + 1_230_000, T0 + 2_000_000, T0 + 2_005_000, T0 + 3_333_333, END]


@pytest.fixture(scope="module")
def receiver() -> MirrorReceiver:
    return feed_messages(drive())


@pytest.fixture(scope="module")
def exact() -> PlatformView:
    return exact_view()


def view_of(knowledge: MirrorReceiver) -> PlatformView:
    view = knowledge.state.view
    assert view is not None
    return view


def other_model() -> Model:
    """The rover with a frame more: another revision, the same joints."""
    model = rover()
    builder = ModelBuilder("rover")
    for body in model.bodies:
        made = builder.add_body(body.name)
        for frame in body:
            made.add_frame(frame.name, frame.pose, sigma=frame.sigma)
    builder.add_body("Lamp").add_frame("Origin")
    for each in model.constraints:
        builder.add_constraint(each.name, each.from_, each.to, each.pose, sigma=each.sigma, joint=each.joint)
    builder.add_constraint("LampOn", "Rover:Mast", "Lamp:Origin", Pose((0.0, 0.0, 0.3)), sigma=SURVEY)
    return builder.build()


@pytest.mark.parametrize(("pose", "is_known"), [(Pose((3.0, 4.0, 0.0)), True), (Pose(), False)])
def test_given_a_published_pose_without_covariance_then_it_is_in_the_world_unless_it_is_the_identity(
    pose: Pose, is_known: bool
) -> None:
    answer = exact_view().get_published_pose(estimate(0.0), UTM)
    world = answer._replace(transformation=ms.Transformation(BASE, UTM, pose))
    found = PublishedEstimate(T0, world, exact_view().get_published_pose(estimate(0.0), ODOM), None, False).resolve()
    assert found.utm == (pose if is_known else None)


# --- the same answers as the service's ----------------------------------------------------------------------


@pytest.mark.parametrize(("interest", "reference"), PAIRS)
def test_given_a_drive_then_answers_at_held_times_are_the_services(
    receiver: MirrorReceiver, exact: PlatformView, interest: str, reference: str
) -> None:
    for at in (0, *TIMES):
        mine = view_of(receiver).transformation(interest, reference, TimeQuery(at), END)
        theirs = exact.transformation(interest, reference, TimeQuery(at), END)
        assert mine.transformation.pose.is_close(theirs.transformation.pose, 1e-9, 1e-9)
        np.testing.assert_allclose(
            mine.transformation.covariance, theirs.transformation.covariance, rtol=1e-9, atol=1e-15
        )
        for name in ("utime", "invalid_reasons", "pose_epoch", "origin_id", "model_revision"):
            assert getattr(mine.transformation, name) == getattr(theirs.transformation, name)
        assert (mine.origin, mine.quality) == (theirs.origin, theirs.quality)


def test_given_a_drive_then_many_instants_through_odom_are_the_services(
    receiver: MirrorReceiver, exact: PlatformView
) -> None:
    # without LOCALIZATION_STATE the growth of Odom's covariance is unknown, so the larger one is assumed
    utimes = np.array(TIMES, dtype=np.int64)
    mine = complete(lookup_batch(view_of(receiver), SCAN, BASE, utimes, END, ODOM, True, END))
    theirs = complete(lookup_batch(exact, SCAN, BASE, utimes, END, ODOM, True, END))
    np.testing.assert_allclose(mine.vectors, theirs.vectors, atol=1e-9)
    assert mine.covariances is not None
    assert theirs.covariances is not None
    assert (mine.covariances[:, ::7] > theirs.covariances[:, ::7] - 1e-12).all()
    one = lookup_between(view_of(receiver), SCAN, T0 + S, BASE, END)
    assert one.transformation.pose.is_close(truth(SCAN, BASE, 1.0, 4.0, ODOM), 1e-9, 1e-9)


def test_given_a_filter_at_work_then_odom_drifts_as_the_service_reports(exact: PlatformView) -> None:
    receiver = MirrorReceiver()
    receiver.feed("LOCALIZATION_STATE", b"whatever it holds", T0)
    feed_messages(drive(1.0), receiver)
    mine = lookup_between(view_of(receiver), BASE, T0 + S, BASE, T0 + 500_000).transformation
    theirs = lookup_between(exact, BASE, T0 + S, BASE, T0 + 500_000).transformation
    np.testing.assert_allclose(mine.covariance, theirs.covariance, rtol=1e-9, atol=1e-15)


def test_given_a_drive_then_motion_is_within_what_it_states(receiver: MirrorReceiver) -> None:
    published = compute_motion(view_of(receiver), BASE, UTM, BASE, TimeQuery(T0 + 3 * S))
    assert published.covariance is not None
    sigmas = np.sqrt(np.diagonal(np.reshape(published.covariance, (6, 6))))
    errors = np.array(published.velocity + published.angular_velocity) - np.array(sum(twist(3.0), ()))
    assert (np.abs(errors) < 3.0 * sigmas).all()
    assert sigmas.max() < 0.2
    assert all(map(math.isnan, published.acceleration))


def test_given_a_drive_then_an_explanation_names_the_same_edges(receiver: MirrorReceiver, exact: PlatformView) -> None:
    mine, theirs = (explain(view, SCAN, UTM, TimeQuery(T0 + S), END) for view in (view_of(receiver), exact))
    for a, b in zip(mine.edges, theirs.edges, strict=True):
        assert (a.kind, a.name, a.provenance, a.stamp) == (b.kind, b.name, b.provenance, b.stamp)
        assert a.position_share == pytest.approx(b.position_share, abs=1e-9)


def test_given_no_origin_yet_then_there_is_no_pose_in_the_world_and_one_in_odom() -> None:
    published = replace(estimate(1.0), utm=None, enu=None, covariance=None, origin=None, invalid=Invalid.NO_ORIGIN)
    receiver = feed_messages(
        (T0 + S + DELAY, channel, data) for channel, data in (*parts(snapshot()), *pose(published))
    )
    with pytest.raises(ms.NoPoseError, match="origin is not set"):
        view_of(receiver).transformation(BASE, UTM, TimeQuery())
    assert view_of(receiver).transformation(BASE, ODOM, TimeQuery()).transformation.is_valid


# --- joining late, losing messages, damage ------------------------------------------------------------------


def test_given_one_who_joins_late_then_poses_from_before_the_snapshot_count_too(exact: PlatformView) -> None:
    receiver = MirrorReceiver()
    for at, channel, data in drive(2.0, 1.25):
        if channel == "MODEL_SNAPSHOT" and at < T0 + 3 * S:
            continue  # none before it had listened for a while
        receiver.feed(channel, data, at)
    at = T0 + 1_500_000
    mine = view_of(receiver).transformation(BASE, UTM, TimeQuery(at)).transformation
    assert mine.pose.is_close(exact.transformation(BASE, UTM, TimeQuery(at)).transformation.pose)
    with pytest.raises(ms.TooOldError, match="joint Nod"):
        view_of(receiver).transformation(SCAN, UTM, TimeQuery(at))


@pytest.mark.parametrize("order", ["backwards", "lost", "mixed"])
def test_given_parts_lost_or_out_of_order_then_the_next_broadcast_completes_the_geometry(order: str) -> None:
    first, again = parts(snapshot(), size=200), parts(snapshot(), T0 + S, size=200)
    other = parts(snapshot(other_model()), size=200)
    assert len(first) > 2
    receiver = MirrorReceiver()
    encode_parts = {
        "backwards": first[::-1],
        "lost": [*first[1:], again[0]],
        "mixed": [first[0], other[0], *again],
    }[order]
    for number, (channel, data) in enumerate(encode_parts):
        assert receiver.state.view is None
        receiver.feed(channel, data, T0 + number)
    assert view_of(receiver).model.revision == rover().revision
    assert not receiver.rejected


def test_given_an_older_snapshot_that_was_overtaken_then_the_newer_stays() -> None:
    receiver = MirrorReceiver()
    for channel, data in (*parts(snapshot(other_model()), T0 + 10_000), *parts(snapshot(), T0)):
        receiver.feed(channel, data, T0 + 20_000)
    assert view_of(receiver).model.revision == other_model().revision


def test_given_damage_then_it_is_counted_and_what_is_known_stays(receiver: MirrorReceiver) -> None:
    known = feed_messages(drive(0.1))
    before = known.state.view
    good = parts(snapshot())[0][1]
    rotten = encode(SnapshotPart(T0 + 1, "0" * 16, 0, 1, b"no zlib stream"))
    for channel, data in (
        ("MODEL_SNAPSHOT", good[:-3]),
        ("MODEL_SNAPSHOT", rotten),
        ("POSE", b""),
        ("POSE_ODOM", good),
        ("JOINTS", b"\0" * 40),
        ("ELSEWHERE", b"\0"),
    ):
        known.feed(channel, data, T0 + 200_000)
    assert known.state.view is before
    assert dict(known.rejected) == {
        ("MODEL_SNAPSHOT", "truncated"): 1,
        ("MODEL_SNAPSHOT", "malformed"): 1,
        ("POSE", "fingerprint"): 1,
        ("POSE_ODOM", "fingerprint"): 1,
        ("JOINTS", "fingerprint"): 1,
    }


CHANNELS = st.sampled_from(["MODEL_SNAPSHOT", "POSE", "POSE_ODOM", "JOINTS", "JOINTS_HELD", "LOCALIZATION_STATE"])
GOOD = [data for _, _, data in list(drive(0.05))]


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(CHANNELS, st.one_of(st.binary(max_size=60), st.sampled_from(GOOD))), max_size=12))
def test_given_anything_at_all_then_nothing_is_raised(messages: list[tuple[str, bytes]]) -> None:
    receiver = MirrorReceiver()
    for number, (channel, data) in enumerate(messages):
        receiver.feed(channel, data, T0 + number)
    assert sum(receiver.rejected.values()) <= len(messages)


def test_given_a_flood_of_causes_then_the_counters_are_bounded() -> None:
    receiver, sample = feed_messages(drive(0.02)), joints_at(0.02)
    for number in range(2 * MAX_COUNTERS):
        stranger = replace(sample.joints[0], name=f"Stranger{number:04d}")
        receiver.feed("JOINTS", encode(replace(sample, joints=(stranger,))), T0 + 30_000)
    assert len(receiver.rejected) <= MAX_COUNTERS + 1


def test_given_a_pose_in_odom_that_was_lost_then_its_partner_is_left_out(exact: PlatformView) -> None:
    lost = T0 + 500_000 + DELAY + 1
    receiver = feed_messages(event for event in drive(1.0) if event[0] != lost)
    held = view_of(receiver).transformation(BASE, UTM, TimeQuery(T0 + 500_000))
    assert Quality.INTERPOLATED in held.quality
    assert held.transformation.pose.is_close(vehicle(0.5), 1e-3, 1e-3)


def test_given_poses_of_something_else_then_they_are_counted() -> None:
    receiver = feed_messages(drive(0.1))
    before = receiver.state.history.last
    world, odom = pose(estimate(0.2))
    receiver.feed("POSE", odom[1], T0 + 200_000)
    receiver.feed("POSE_ODOM", world[1], T0 + 200_000)
    assert receiver.state.history.last == before
    assert dict(receiver.rejected) == {("POSE", "other frames"): 1, ("POSE_ODOM", "other frames"): 1}


# --- changes: geometry, epoch, clock, another run -----------------------------------------------------------


def test_given_a_new_geometry_then_it_is_refused_until_its_snapshot_comes_and_joints_stay() -> None:
    receiver, model = feed_messages(drive(1.0)), other_model()
    answer = FedPlatform(receiver, T0 + S + 20_000)
    for channel, data in pose(estimate(1.01), model):
        receiver.feed(channel, data, T0 + 1_011_000)
    with pytest.raises(ms.OutOfDateError, match=f"{model.revision}.*no complete MODEL_SNAPSHOT"):
        answer.get_transformation("Rover:Mast", BASE)
    for channel, data in parts(snapshot(model), T0 + 1_012_000):
        receiver.feed(channel, data, T0 + 1_012_000)
    assert answer.get_body_list()[-1] == "Lamp"
    assert answer.get_transformation("Lamp:Origin", BASE).model_revision == model.revision
    # the received joint positions are of the same joints
    before = answer.get_transformation(SCAN, UTM, at=T0 + 500_000)
    assert before.pose.is_close(truth(SCAN, UTM, 0.5), 1e-9, 1e-9)


def test_given_a_new_epoch_then_the_pose_before_it_is_held_and_odom_goes_on() -> None:
    receiver = feed_messages(drive(1.0))
    for n in range(5):
        published = estimate(1.1 + 0.01 * n)
        assert published.utm is not None
        jumped = replace(published, utm=Pose((5.0, 0.0, 0.0)) @ published.utm, pose_epoch=1)
        for channel, data in pose(jumped):
            receiver.feed(channel, data, jumped.utime + DELAY)
    view = view_of(receiver)
    held = view.transformation(BASE, UTM, TimeQuery(T0 + 1_050_000))
    assert Quality.HELD in held.quality
    assert held.transformation.pose.is_close(vehicle(1.0), 1e-9, 1e-9)
    assert view.transformation(BASE, UTM, TimeQuery(T0 + 1_100_000)).transformation.pose_epoch == 1
    assert lookup_between(view, BASE, T0 + S, BASE, T0 + 1_100_000).transformation.pose.is_close(
        vehicle(1.1).inverse() @ vehicle(1.0), 1e-9, 1e-9
    )


@pytest.mark.parametrize("epoch", [0, 3])
def test_given_a_service_that_was_started_again_then_what_it_reported_before_is_forgotten(epoch: int) -> None:
    receiver = MirrorReceiver()
    for channel, data in parts(snapshot()):
        receiver.feed(channel, data, T0)
    for t in (2.0, 2.01, 2.02):
        published = replace(estimate(t), pose_epoch=epoch)
        for channel, data in pose(published):
            receiver.feed(channel, data, published.utime + DELAY)
    fresh = replace(estimate(4.0), odom=Pose.identity(), odom_covariance=tuple(1e-6 * np.eye(6).ravel()))
    for channel, data in pose(fresh):
        receiver.feed(channel, data, fresh.utime + DELAY)
    assert len(receiver.state.history) == 1
    with pytest.raises(ms.TooOldError):
        view_of(receiver).transformation(BASE, UTM, TimeQuery(T0 + 2_010_000))


def test_given_a_clock_that_was_set_back_then_two_times_are_not_mixed() -> None:
    receiver = feed_messages(drive(1.0, 10.0))
    # the service's clock is 9.5 s back from here on
    for n in range(20):
        published = estimate(11.0 + 0.01 * n)
        set_back = replace(published, utime=published.utime - 9_500_000)
        for channel, data in pose(set_back):
            receiver.feed(channel, data, published.utime + DELAY)
    view, now = view_of(receiver), T0 + 11_190_000 + DELAY
    assert view.history.first == T0 + 1_500_000
    # until the next snapshot it is taken to be as late as before, and the pose to be old
    assert not FedPlatform(receiver, now).get_transformation(BASE, UTM).is_valid
    for channel, data in parts(snapshot(), T0 + 1_690_000):
        receiver.feed(channel, data, now)
    assert receiver.state.get_service_time(now) == T0 + 1_690_000
    answer = FedPlatform(receiver, now).get_transformation(BASE, UTM)
    assert (answer.utime, answer.is_valid) == (T0 + 1_690_000, True)


def test_given_a_latency_of_the_joints_then_their_stamps_are_that_much_earlier() -> None:
    receiver = MirrorReceiver()
    for channel, data in parts(snapshot(latency_us=50_000)):
        receiver.feed(channel, data, T0)
    for n in range(50):
        receiver.feed(*joints(n / 50, 50_000), T0 + n * 20_000 + 60_000)
    answer = FedPlatform(receiver, T0 + S).get_transformation(SCAN, BASE, at=T0 + 400_000)
    assert answer.pose.is_close(truth(SCAN, BASE, 0.4), 1e-9, 1e-9)


# --- past the last pose -------------------------------------------------------------------------------------


@pytest.mark.parametrize("ahead", [0.05, 0.5, 2.0])
def test_given_a_prediction_then_truth_lies_within_three_of_its_sigmas(receiver: MirrorReceiver, ahead: float) -> None:
    at = END + round(ahead * S)
    for world in (UTM, ODOM):
        answer = view_of(receiver).transformation(BASE, world, TimeQuery(at, Policy.PREDICTED), at)
        assert Quality.PREDICTED in answer.quality
        transformation = answer.transformation
        X = estimate(4.0 + ahead).odom if world == ODOM else vehicle(4.0 + ahead)
        meters, radians = transformation.pose.distance(X)
        assert transformation.covariance is not None
        sigmas = np.sqrt(np.diagonal(transformation.covariance))
        assert meters < 3.0 * sigmas[:3].max()
        assert radians < 3.0 * sigmas[3:].max()
        assert (ahead > 1.0) == bool(transformation.invalid_reasons & Invalid.STALE_IMU)
    assert math.isnan(answer.horizontal_protection_level)


def test_given_a_time_beyond_what_can_be_predicted_then_it_is_too_new(receiver: MirrorReceiver) -> None:
    with pytest.raises(ms.TooNewError, match="5 s ahead"):
        view_of(receiver).transformation(BASE, UTM, TimeQuery(END + 6 * S, Policy.PREDICTED))
    with pytest.raises(ms.TooNewError):
        view_of(receiver).transformation(BASE, UTM, TimeQuery(END + 1))


def test_given_a_single_pose_then_a_prediction_is_sure_of_little() -> None:
    receiver = feed_messages(
        (T0 + DELAY, channel, data) for channel, data in (*parts(snapshot()), *pose(estimate(0.0)))
    )
    answer = view_of(receiver).transformation(BASE, UTM, TimeQuery(T0 + S, Policy.PREDICTED))
    assert answer.transformation.covariance is not None
    assert math.sqrt(answer.transformation.covariance[0, 0]) > 5.0
    with pytest.raises(ms.NoPoseError, match="velocity"):
        compute_motion(view_of(receiver), BASE, UTM, "", TimeQuery())


def test_given_silence_then_the_latest_pose_reports_it(receiver: MirrorReceiver) -> None:
    for seconds, silent in ((0.5, False), (1.5, True)):
        answer = FedPlatform(receiver, END + round(seconds * S)).get_transformation(BASE, UTM)
        assert bool(answer.invalid_reasons & Invalid.STALE_GPS) is silent
