"""The core's commands: reading the geometry anew, setting the pose, and when the geometry goes out."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support_moving import SCAN, joints_at, rover
from support_moving import T0 as ROVER_T0
from support_samples import ME, ORIGIN, START, Scripted, cart, decided, imu, now_at, started

from modelserver.core import CoreSettings, CoreState, Instant, start, step
from modelserver.core.reload import ModelLoaded
from modelserver.errors import Status
from modelserver.geometry import Model, ModelBuilder
from modelserver.localization.mounts import Mounts
from modelserver.localization.raw.localizer import RawLocalizer
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
from modelserver.spatial import Pose, Transformation

S = 1_000_000
ASK = ReloadModel(ME)
DRY = ReloadModel(ME, dry_run=True)
SETTERS = [SetStateVector, SetHTransform]


def moved_cart() -> Model:
    """The cart with its camera 10 cm higher, without the lamp."""
    builder = ModelBuilder("cart")
    old = cart()
    for body in old.bodies[:2]:
        made = builder.body(body.name)
        for frame in body:
            made.frame(frame.name, frame.pose, sigma=frame.sigma)
    mount = old.constraints[0]
    builder.constraint(mount.name, mount.from_, mount.to, Pose((0.0, 0.0, 0.1)) @ mount.pose)
    return builder.build()


def fed(state: CoreState, event: Any, at: float = 0.0) -> tuple[CoreState, tuple[Output, ...]]:
    signed = isinstance(event, (ReloadModel, SetStateVector, SetHTransform))
    return step(state, SignedCommand(event, "me") if signed else event, now_at(START + round(at * S)))


def replied(state: CoreState, event: Any, at: float = 0.0) -> tuple[CoreState, Any]:
    state, outputs = fed(state, event, at)
    (reply,) = [each for each in outputs if isinstance(each, SendReply)]
    assert reply.channel == ME.reply_channel
    assert reply.reply.header.request_id == ME.request_id
    return state, reply.reply


def at_place(**changes: Any) -> Transformation:
    values: dict[str, Any] = {"frame_of_interest": "Cart:Base", "frame_of_reference": "World:UTM"} | changes
    return Transformation(pose=Pose((100.0, 50.0, 5.0)), **values)


class Recording(Scripted):
    """A localizer that keeps what it was given."""

    samples: list[Any] = []  # noqa: RUF012

    def take(self, sample: Any) -> Any:
        self.samples.append(sample)
        return super().take(sample)


# --- reload ---------------------------------------------------------------------------------------------------------


def test_given_no_permission_then_reloading_is_forbidden_names_the_setting_and_changes_nothing() -> None:
    before = started()
    state, reply = replied(before, ASK)
    assert isinstance(reply, ReloadReply)
    assert reply.header.status is Status.FORBIDDEN
    assert "commands: {reload: true}" in reply.header.message
    assert (reply.revision, reply.changes) == ("", ())
    assert state.rejected == {("PLATFORM_RELOAD_MODEL", "forbidden"): 1}
    assert state.model is before.model


@pytest.mark.parametrize("request_", [ASK, DRY])
def test_given_permission_then_the_shell_is_told_to_read_the_file(request_: ReloadModel) -> None:
    before = started(may_reload=True)
    state, outputs = fed(before, request_)
    assert outputs == (LoadModel(request_),)
    assert state is before


def test_given_a_reply_channel_outside_the_rules_then_commands_are_counted_and_not_obeyed() -> None:
    header = RequestHeader(1, "POSE")
    state = started(may_reload=True, may_set_pose=True)
    for request in (ReloadModel(header), *(kind(header, PoseAnswer(at_place())) for kind in SETTERS)):
        state, outputs = fed(state, request)
        assert outputs == ()
        assert state.rejected[CHANNEL_OF[type(request)], "reply_channel"] == 1


@pytest.mark.parametrize("request_", [ASK, None])
def test_given_another_model_then_it_counts_at_once_and_goes_out(request_: ReloadModel | None) -> None:
    before, model = started(may_reload=True), moved_cart()
    localizer = Scripted(taken=7)
    state, outputs = fed(before, ModelLoaded(request_, model, localizer))
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
        assert reply.changes == ("body Lamp is gone", "constraint Mounted moves by 100 mm and 0 deg",
                                 "constraint Mounted states another sigma")[: len(reply.changes)]  # fmt: skip
        assert state.requests_answered == before.requests_answered + 1
    _, bodies = replied(state, GetBodyList(ME))
    assert isinstance(bodies, NameListReply)
    assert bodies.names == ("Cart", "Camera")


def test_given_a_dry_run_then_what_would_change_is_told_and_nothing_does() -> None:
    before = started(may_reload=True)
    state, reply = replied(before, ModelLoaded(DRY, moved_cart(), Scripted(taken=7)))
    assert state._replace(requests_answered=0) == before
    assert reply.revision == moved_cart().revision
    assert reply.header.model_revision == before.model.revision
    assert "body Lamp is gone" in reply.changes


@pytest.mark.parametrize("request_", [ASK, DRY, None])
def test_given_a_file_that_is_wrong_then_the_old_model_stays_and_who_asked_is_told_why(
    request_: ReloadModel | None,
) -> None:
    before = started(may_reload=True)
    state, outputs = fed(before, ModelLoaded(request_, why="geometry.yaml:3: error: nonsense"))
    assert state.view is before.view
    assert state.rejected == {("PLATFORM_RELOAD_MODEL", "rejected"): 1}
    if request_ is None:
        assert outputs == ()
    else:
        header = outputs[0].reply.header  # type: ignore[union-attr]
        assert (header.status, header.message) == (Status.REJECTED, "geometry.yaml:3: error: nonsense")
        assert header.model_revision == before.model.revision


def test_given_joints_heard_then_a_new_model_keeps_those_that_it_has_too() -> None:
    model = rover()
    now = Instant(10, ROVER_T0)
    state = start(CoreSettings("Rover:Base", may_reload=True), model, None, now)
    state, _ = step(state, joints_at(0.0), now)
    before, _ = step(state, GetTransformation(ME, SCAN, "Rover:Base"), now)
    assert "Nod" in before.view.joints.tracks
    builder = ModelBuilder("rover")
    for body in model.bodies:
        made = builder.body(body.name)
        for frame in body:
            made.frame(frame.name, frame.pose)
    nod = model.joints["Nod"]
    builder.constraint("Nod", nod.from_, nod.to, nod.pose, joint=nod.joint)
    state, _ = step(state, ModelLoaded(None, builder.build(), None), now)
    assert set(state.view.joints.tracks) == {"Nod"}
    assert state.view.joints.names == ("Nod",)


def test_given_a_request_that_waits_and_whose_frame_goes_then_it_is_answered_so() -> None:
    state = started(may_reload=True)
    state, _ = fed(state, imu(START))
    waiting = GetTransformation(ME, "Camera:Origin", "World:UTM", TimeQuery(START + S, wait_ms=1000))
    state, outputs = fed(state, waiting)
    assert (outputs, len(state.parked)) == ((), 1)
    builder = ModelBuilder("cart")
    builder.body("Cart").frame("Base")
    state, _ = fed(state, ModelLoaded(None, builder.build(), state.localizer))
    state, reply = replied(state, Tick(), 0.02)
    assert isinstance(reply, TransformReply)
    assert reply.header.status is Status.UNKNOWN_BODY
    assert state.parked == ()


# --- when the geometry goes out -------------------------------------------------------------------------------------


def told(outputs: tuple[Output, ...]) -> int:
    return sum(isinstance(each, PublishSnapshot) for each in outputs)


def test_given_ticks_then_the_geometry_goes_out_at_the_first_and_once_a_period() -> None:
    state = started(snapshot_period_ns=500_000_000)
    times = []
    for n in range(60):
        state, outputs = fed(state, Tick(), n * 0.02)
        times += [n] * told(outputs)
    assert times == [0, 25, 50]


def test_given_a_pause_then_one_snapshot_is_enough_and_the_next_is_due_from_then_on() -> None:
    state = started(snapshot_period_ns=500_000_000)
    state, _ = fed(state, Tick(), 0.0)
    state, outputs = fed(state, Tick(), 60.0)
    assert told(outputs) == 1
    assert not told(fed(state, Tick(), 60.4)[1])
    assert told(fed(state, Tick(), 60.5)[1])


def test_given_a_reload_then_the_period_begins_anew() -> None:
    state = started(snapshot_period_ns=500_000_000)
    state, _ = fed(state, Tick(), 0.0)
    state, outputs = fed(state, ModelLoaded(None, moved_cart(), state.localizer), 0.4)
    assert told(outputs) == 1
    assert not told(fed(state, Tick(), 0.6)[1])
    assert told(fed(state, Tick(), 0.9)[1])


# --- setting the pose -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", SETTERS)
def test_given_no_permission_then_setting_the_pose_is_forbidden_and_names_the_setting(kind: Any) -> None:
    state, reply = replied(started(), kind(ME, PoseAnswer(at_place())))
    assert isinstance(reply, Acknowledgement)
    assert reply.header.status is Status.FORBIDDEN
    assert "commands: {set_pose: true}" in reply.header.message
    assert state.rejected == {(CHANNEL_OF[kind], "forbidden"): 1}


@pytest.mark.parametrize("kind", SETTERS)
def test_given_permission_then_the_pose_is_a_measurement_of_the_operators(kind: Any) -> None:
    Recording.samples.clear()
    state, reply = replied(started(Recording(newest=START), may_set_pose=True), kind(ME, PoseAnswer(at_place())), 3.0)
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
    _, reply = replied(
        started(Recording(newest=START), may_set_pose=True), SetStateVector(ME, PoseAnswer(pose, ORIGIN)), 1.5
    )
    assert reply.header.status is Status.OK
    assert Recording.samples[-1].header.utime == START + S
    assert Recording.samples[-1].covariance == tuple(covariance.ravel())


@pytest.mark.parametrize(
    ("localizer", "answer", "why"),
    [
        (None, PoseAnswer(at_place()), "names no sensor"),
        (Scripted(), PoseAnswer(at_place(frame_of_interest="Camera:Origin")), "the pose of Cart:Base in World:UTM"),
        (Scripted(), PoseAnswer(at_place(frame_of_reference="World:ENU")), "the pose of Cart:Base in World:UTM"),
        (Scripted(newest=START, known=None), PoseAnswer(at_place()), "origin is not known yet"),
        (Scripted(newest=START), PoseAnswer(at_place(), replace(ORIGIN, easting=1.0)), "another origin"),
        (Scripted(newest=START), PoseAnswer(at_place(origin_id=ORIGIN.origin_id + 1)), "another origin"),
        (Scripted(newest=START), PoseAnswer(at_place(utime=START + 5 * S)), "after the service's clock"),
    ],
)
def test_given_a_pose_that_cannot_be_set_then_it_is_rejected_and_says_why(
    localizer: Scripted | None, answer: PoseAnswer, why: str
) -> None:
    before = started(localizer, may_set_pose=True)
    state, reply = replied(before, SetHTransform(ME, answer))
    assert reply.header.status is Status.REJECTED
    assert why in reply.header.message
    assert state.localizer is before.localizer
    assert state.requests_answered == 1


def test_given_raw_mode_then_setting_the_pose_is_rejected_rather_than_lost() -> None:
    mounts = Mounts.from_model(cart(), "Cart:Base", "Cart:Antenna", "Cart:Imu")
    state = started(RawLocalizer.start(mounts, None, ORIGIN), may_set_pose=True)  # type: ignore[arg-type]
    state, _ = fed(state, imu(START))
    _, reply = replied(state, SetStateVector(ME, PoseAnswer(at_place())))
    assert reply.header.status is Status.REJECTED
    assert "raw mode" in reply.header.message


class Judging(Scripted):
    """A localizer that settles, with every sample, an earlier one of another source; and refuses the operator's own."""

    own: bool = False

    def take(self, sample: Any) -> Any:
        taken, _ = super().take(sample)
        other = decided(replace(sample, header=replace(sample.header, source="gps", seq=3)), Verdict.REJECTED, "gate")
        earlier = decided(replace(sample, header=replace(sample.header, seq=99)), Verdict.REJECTED, "gate")
        own = (decided(sample, Verdict.REJECTED, "late"),) if self.own else ()
        return taken, (other, earlier, *own)


class Refusing(Judging):
    own = True


@pytest.mark.parametrize(("localizer", "status"), [(Judging(START), Status.OK), (Refusing(START), Status.REJECTED)])
def test_given_decisions_on_others_with_it_then_only_one_on_the_pose_itself_rejects_it(
    localizer: Scripted, status: Status
) -> None:
    state, outputs = fed(started(localizer, may_set_pose=True), SetStateVector(ME, PoseAnswer(at_place())))
    (decisions,) = [each for each in outputs if isinstance(each, PublishDecisions)]
    (reply,) = [each.reply for each in outputs if isinstance(each, SendReply)]
    assert len(decisions.decisions) == (3 if status else 2)
    assert reply.header.status is status
    assert ("late" in reply.header.message) == bool(status)
    assert state.rejected["sensor:gps", "gate"] == 1
