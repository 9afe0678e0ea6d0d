"""Commands of the core: reload, set pose; and the schedule of the model snapshot."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support_moving import SCAN, joints_at, rover
from support_moving import T0 as ROVER_T0
from support_samples import ME, ORIGIN, START, ScriptedLocalizer, cart, imu, instant_at, make_decision, start_core

from modelserver.core import CoreSettings, CoreState, Instant, ModelLoaded, start, step
from modelserver.errors import Status
from modelserver.estimation.raw.localizer import RawLocalizer
from modelserver.estimation.sensor_rig import Mounts
from modelserver.geometry import Model, ModelBuilder
from modelserver.messages import (
    CHANNEL_OF,
    AbsolutePoseSample,
    Acknowledgement,
    GetBodyList,
    GetTransformation,
    LoadModel,
    NameListReply,
    Output,
    PoseAnswer,
    PublishDecisions,
    PublishSnapshot,
    ReloadModel,
    ReloadReply,
    RequestHeader,
    SendReply,
    SetHTransform,
    SetStateVector,
    SignedCommand,
    Tick,
    TimeQuery,
    TransformReply,
    Verdict,
)
from modelserver.transforms import Pose, Transformation

S = 1_000_000
ASK = ReloadModel(ME)
DRY = ReloadModel(ME, dry_run=True)
CHANGES = ("body Lamp is removed", "constraint Mounted moves by 100 mm and 0 deg")
SETTERS = [SetStateVector, SetHTransform]


def make_changed_cart() -> Model:
    """The cart with its camera 10 cm higher, without the lamp."""
    builder = ModelBuilder("cart")
    old = cart()
    for body in old.bodies[:2]:
        made = builder.add_body(body.name)
        for frame in body:
            made.add_frame(frame.name, frame.pose, sigma=frame.sigma)
    mount = old.constraints[0]
    builder.add_constraint(mount.name, mount.from_, mount.to, Pose((0.0, 0.0, 0.1)) @ mount.pose)
    return builder.build()


def feed(state: CoreState, event: Any, at: float = 0.0) -> tuple[CoreState, tuple[Output, ...]]:
    signed = isinstance(event, (ReloadModel, SetStateVector, SetHTransform))
    return step(state, SignedCommand(event, "me") if signed else event, instant_at(START + round(at * S)))


def feed_and_get_reply(state: CoreState, event: Any, at: float = 0.0) -> tuple[CoreState, Any]:
    state, outputs = feed(state, event, at)
    (reply,) = [each for each in outputs if isinstance(each, SendReply)]
    assert reply.channel == ME.reply_channel
    assert reply.reply.header.request_id == ME.request_id
    return state, reply.reply


def at_place(**changes: Any) -> Transformation:
    values: dict[str, Any] = {"frame_of_interest": "Cart:Base", "frame_of_reference": "World:UTM"} | changes
    return Transformation(pose=Pose((100.0, 50.0, 5.0)), **values)


class Recording(ScriptedLocalizer):
    """A localizer that records its samples."""

    samples: list[Any] = []  # noqa: RUF012

    def process(self, sample: Any) -> Any:
        self.samples.append(sample)
        return super().process(sample)


# --- reload ---------------------------------------------------------------------------------------------------------


def test_given_no_permission_then_reloading_is_forbidden_names_the_setting_and_changes_nothing() -> None:
    before = start_core()
    state, reply = feed_and_get_reply(before, ASK)
    assert isinstance(reply, ReloadReply)
    assert reply.header.status is Status.FORBIDDEN
    assert "commands: {reload: true}" in reply.header.message
    assert (reply.revision, reply.changes) == ("", ())
    assert state.rejected == {("PLATFORM_RELOAD_MODEL", "forbidden"): 1}
    assert state.model is before.model


@pytest.mark.parametrize("request_", [ASK, DRY])
def test_given_permission_then_the_loop_is_asked_to_read_the_file(request_: ReloadModel) -> None:
    before = start_core(may_reload=True)
    state, outputs = feed(before, request_)
    assert outputs == (LoadModel(request_),)
    assert state is before


def test_given_a_reply_channel_outside_the_rules_then_commands_are_counted_and_not_executed() -> None:
    header = RequestHeader(1, "POSE")
    state = start_core(may_reload=True, may_set_pose=True)
    for request in (ReloadModel(header), *(kind(header, PoseAnswer(at_place())) for kind in SETTERS)):
        state, outputs = feed(state, request)
        assert outputs == ()
        assert state.rejected[CHANNEL_OF[type(request)], "reply_channel"] == 1


@pytest.mark.parametrize("request_", [ASK, None])
def test_given_another_model_then_it_counts_at_once_and_goes_out(request_: ReloadModel | None) -> None:
    before, model = start_core(may_reload=True), make_changed_cart()
    localizer = ScriptedLocalizer(count=7)
    state, outputs = feed(before, ModelLoaded(request_, model, localizer, changes=CHANGES))
    assert state.model is model
    assert state.localizer is localizer
    assert outputs[0] == PublishSnapshot(START)
    if request_ is None:
        assert len(outputs) == 1
    else:
        reply = outputs[1].reply  # type: ignore[union-attr]
        assert isinstance(reply, ReloadReply)
        assert reply.header.status is Status.OK
        assert reply.revision == reply.header.model_revision == model.revision
        assert reply.changes == CHANGES
        assert state.requests_answered == before.requests_answered + 1
    _, bodies = feed_and_get_reply(state, GetBodyList(ME))
    assert isinstance(bodies, NameListReply)
    assert bodies.names == ("Cart", "Camera")


def test_given_a_dry_run_then_the_changes_are_reported_and_not_applied() -> None:
    before = start_core(may_reload=True)
    state, reply = feed_and_get_reply(
        before, ModelLoaded(DRY, make_changed_cart(), ScriptedLocalizer(count=7), changes=CHANGES)
    )
    assert state._replace(requests_answered=0) == before
    assert reply.revision == make_changed_cart().revision
    assert reply.header.model_revision == before.model.revision
    assert reply.changes == CHANGES


@pytest.mark.parametrize("request_", [ASK, DRY, None])
def test_given_an_invalid_file_then_the_old_model_stays_and_the_client_gets_the_reason(
    request_: ReloadModel | None,
) -> None:
    before = start_core(may_reload=True)
    state, outputs = feed(before, ModelLoaded(request_, why="geometry.yaml:3: error: nonsense"))
    assert state.view is before.view
    assert state.rejected == {("PLATFORM_RELOAD_MODEL", "rejected"): 1}
    if request_ is None:
        assert outputs == ()
    else:
        header = outputs[0].reply.header  # type: ignore[union-attr]
        assert (header.status, header.message) == (Status.REJECTED, "geometry.yaml:3: error: nonsense")
        assert header.model_revision == before.model.revision


def test_given_known_joint_positions_then_a_new_model_keeps_those_of_its_own_joints() -> None:
    model = rover()
    now = Instant(10, ROVER_T0)
    state = start(CoreSettings("Rover:Base", may_reload=True), model, None, now)
    state, _ = step(state, joints_at(0.0), now)
    before, _ = step(state, GetTransformation(ME, SCAN, "Rover:Base"), now)
    assert "Nod" in before.view.joints.tracks
    builder = ModelBuilder("rover")
    for body in model.bodies:
        made = builder.add_body(body.name)
        for frame in body:
            made.add_frame(frame.name, frame.pose)
    nod = model.joints["Nod"]
    builder.add_constraint("Nod", nod.from_, nod.to, nod.pose, joint=nod.joint)
    state, _ = step(state, ModelLoaded(None, builder.build(), None), now)
    assert set(state.view.joints.tracks) == {"Nod"}
    assert state.view.joints.names == ("Nod",)


def test_given_a_request_that_waits_and_whose_frame_goes_then_it_is_answered_so() -> None:
    state = start_core(may_reload=True)
    state, _ = feed(state, imu(START))
    waiting = GetTransformation(ME, "Camera:Origin", "World:UTM", TimeQuery(START + S, wait_ms=1000))
    state, outputs = feed(state, waiting)
    assert (outputs, len(state.waiting)) == ((), 1)
    builder = ModelBuilder("cart")
    builder.add_body("Cart").add_frame("Base")
    state, _ = feed(state, ModelLoaded(None, builder.build(), state.localizer))
    state, reply = feed_and_get_reply(state, Tick(), 0.02)
    assert isinstance(reply, TransformReply)
    assert reply.header.status is Status.UNKNOWN_BODY
    assert state.waiting == ()


# --- the model snapshot ---------------------------------------------------------------------------------------------


def count_snapshots(outputs: tuple[Output, ...]) -> int:
    return sum(isinstance(each, PublishSnapshot) for each in outputs)


def test_given_ticks_then_the_geometry_goes_out_at_the_first_and_once_a_period() -> None:
    state = start_core(snapshot_period_ns=500_000_000)
    times = []
    for n in range(60):
        state, outputs = feed(state, Tick(), n * 0.02)
        times += [n] * count_snapshots(outputs)
    assert times == [0, 25, 50]


def test_given_a_pause_then_one_snapshot_is_enough_and_the_next_is_due_from_then_on() -> None:
    state = start_core(snapshot_period_ns=500_000_000)
    state, _ = feed(state, Tick(), 0.0)
    state, outputs = feed(state, Tick(), 60.0)
    assert count_snapshots(outputs) == 1
    assert not count_snapshots(feed(state, Tick(), 60.4)[1])
    assert count_snapshots(feed(state, Tick(), 60.5)[1])


def test_given_a_reload_then_the_period_restarts() -> None:
    state = start_core(snapshot_period_ns=500_000_000)
    state, _ = feed(state, Tick(), 0.0)
    state, outputs = feed(state, ModelLoaded(None, make_changed_cart(), state.localizer), 0.4)
    assert count_snapshots(outputs) == 1
    assert not count_snapshots(feed(state, Tick(), 0.6)[1])
    assert count_snapshots(feed(state, Tick(), 0.9)[1])


# --- setting the pose -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", SETTERS)
def test_given_no_permission_then_setting_the_pose_is_forbidden_and_names_the_setting(kind: Any) -> None:
    state, reply = feed_and_get_reply(start_core(), kind(ME, PoseAnswer(at_place())))
    assert isinstance(reply, Acknowledgement)
    assert reply.header.status is Status.FORBIDDEN
    assert "commands: {set_pose: true}" in reply.header.message
    assert state.rejected == {(CHANNEL_OF[kind], "forbidden"): 1}


@pytest.mark.parametrize("kind", SETTERS)
def test_given_permission_then_the_pose_is_a_measurement_of_the_operators(kind: Any) -> None:
    Recording.samples.clear()
    state, reply = feed_and_get_reply(
        start_core(Recording(newest=START), may_set_pose=True), kind(ME, PoseAnswer(at_place())), 3.0
    )
    assert reply.header.status is Status.OK
    sample = Recording.samples[-1]
    assert isinstance(sample, AbsolutePoseSample)
    assert (sample.header.source, sample.header.utime) == ("operator", START + 3 * S)
    assert (sample.frame_of_interest, sample.frame_of_reference, sample.position) == (
        "Cart:Base",
        "World:UTM",
        (100.0, 50.0, 5.0),
    )
    assert np.allclose(
        np.sqrt(np.array(sample.covariance).reshape(6, 6).diagonal()), [1.0] * 3 + [math.radians(5.0)] * 3
    )
    assert state.history.last == START + 3 * S
    assert state.requests_answered == 1


def test_given_a_covariance_an_instant_and_the_services_own_origin_then_they_count() -> None:
    Recording.samples.clear()
    covariance = np.diag([4.0, 4.0, 9.0, 0.01, 0.01, 0.02])
    pose = at_place(covariance=covariance, utime=START + S, origin_id=ORIGIN.origin_id)
    _, reply = feed_and_get_reply(
        start_core(Recording(newest=START), may_set_pose=True), SetStateVector(ME, PoseAnswer(pose, ORIGIN)), 1.5
    )
    assert reply.header.status is Status.OK
    assert Recording.samples[-1].header.utime == START + S
    assert Recording.samples[-1].covariance == tuple(covariance.ravel())


@pytest.mark.parametrize(
    ("localizer", "answer", "why"),
    [
        (None, PoseAnswer(at_place()), "no localization sensor"),
        (
            ScriptedLocalizer(),
            PoseAnswer(at_place(frame_of_interest="Camera:Origin")),
            "the pose of Cart:Base in World:UTM",
        ),
        (
            ScriptedLocalizer(),
            PoseAnswer(at_place(frame_of_reference="World:ENU")),
            "the pose of Cart:Base in World:UTM",
        ),
        (ScriptedLocalizer(newest=START, origin=None), PoseAnswer(at_place()), "origin is not known yet"),
        (ScriptedLocalizer(newest=START), PoseAnswer(at_place(), replace(ORIGIN, easting=1.0)), "another origin"),
        (ScriptedLocalizer(newest=START), PoseAnswer(at_place(origin_id=ORIGIN.origin_id + 1)), "another origin"),
        (ScriptedLocalizer(newest=START), PoseAnswer(at_place(utime=START + 5 * S)), "ahead of the server's clock"),
    ],
)
def test_given_a_pose_that_cannot_be_set_then_it_is_rejected_with_the_reason(
    localizer: ScriptedLocalizer | None, answer: PoseAnswer, why: str
) -> None:
    before = start_core(localizer, may_set_pose=True)
    state, reply = feed_and_get_reply(before, SetHTransform(ME, answer))
    assert reply.header.status is Status.REJECTED
    assert why in reply.header.message
    assert state.localizer is before.localizer
    assert state.requests_answered == 1


def test_given_raw_mode_then_setting_the_pose_is_rejected_rather_than_lost() -> None:
    mounts = Mounts.from_model(cart(), "Cart:Base", "Cart:Antenna", "Cart:Imu")
    state = start_core(RawLocalizer.start(mounts, None, ORIGIN), may_set_pose=True)  # type: ignore[arg-type]
    state, _ = feed(state, imu(START))
    _, reply = feed_and_get_reply(state, SetStateVector(ME, PoseAnswer(at_place())))
    assert reply.header.status is Status.REJECTED
    assert "raw mode" in reply.header.message


class DelayedDecisions(ScriptedLocalizer):
    """A localizer that decides, with every sample, on an earlier one of another source; and rejects the operator's."""

    own: bool = False

    def process(self, sample: Any) -> Any:
        taken, _ = super().process(sample)
        other = make_decision(
            replace(sample, header=replace(sample.header, source="gps", seq=3)), Verdict.REJECTED, "gate"
        )
        earlier = make_decision(replace(sample, header=replace(sample.header, seq=99)), Verdict.REJECTED, "gate")
        own = (make_decision(sample, Verdict.REJECTED, "too_old"),) if self.own else ()
        return taken, (other, earlier, *own)


class RejectingLocalizer(DelayedDecisions):
    own = True


@pytest.mark.parametrize(
    ("localizer", "status"), [(DelayedDecisions(START), Status.OK), (RejectingLocalizer(START), Status.REJECTED)]
)
def test_given_decisions_on_others_with_it_then_only_one_on_the_pose_itself_rejects_it(
    localizer: ScriptedLocalizer, status: Status
) -> None:
    state, outputs = feed(start_core(localizer, may_set_pose=True), SetStateVector(ME, PoseAnswer(at_place())))
    (decisions,) = [each for each in outputs if isinstance(each, PublishDecisions)]
    (reply,) = [each.reply for each in outputs if isinstance(each, SendReply)]
    assert len(decisions.decisions) == (3 if status else 2)
    assert reply.header.status is status
    assert ("too_old" in reply.header.message) == bool(status)
    assert state.rejected["sensor:gps", "gate"] == 1
