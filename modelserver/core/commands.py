"""Requests that change what the service knows: the geometry read anew, a pose that is set. Only signed ones count."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np

from modelserver.core.host_clock import Instant
from modelserver.core.reload import ModelLoaded
from modelserver.core.requests import turned_down
from modelserver.core.samples import FUTURE_LIMIT_S, localized, mode_wished
from modelserver.core.state import CoreState, Step, counted
from modelserver.errors import Status
from modelserver.geometry import names
from modelserver.geometry.difference import changes
from modelserver.localization.interface import Note
from modelserver.messages import (
    CHANNEL_OF,
    AbsolutePoseSample,
    Acknowledgement,
    Decision,
    LoadModel,
    Origin,
    Output,
    PoseAnswer,
    PublishSnapshot,
    Rejected,
    ReloadModel,
    ReloadReply,
    ReplyHeader,
    Request,
    SendReply,
    SensorHeader,
    SetHTransform,
    SetStateVector,
    SignedCommand,
    SwitchMode,
    Verdict,
)
from modelserver.spatial.covariance import fault

SET_COVARIANCE: Final = tuple(np.diag([1.0] * 3 + [math.radians(5.0) ** 2] * 3).ravel().tolist())
"""Of a pose that is set without one: 1 m and 5 degrees."""

OPERATOR: Final = "operator"
"""The source under which a pose that was set is known to localization and its ledger."""


UNSIGNED: Final = (
    "it is not signed: whoever asks needs the vehicle's key (Platform(key_file=...), --key FILE or "
    "$MODELSERVER_KEY_FILE; docs/wire.md for other languages)"
)
"""What is said to who asks without a signature for what would be done with one."""


def unsigned(state: CoreState, request: ReloadModel | SetStateVector | SetHTransform, now: Instant) -> Step:
    """Turn down what changes the service and comes without a signature."""
    if not request.header.is_answerable(state.settings.reply_prefix):
        return counted(state, CHANNEL_OF[type(request)], "reply_channel"), ()
    reload = isinstance(request, ReloadModel)
    if not (state.settings.may_reload if reload else state.settings.may_set_pose):
        return _forbidden(state, request, "commands.reload" if reload else "commands.set_pose", now)
    state = counted(state, CHANNEL_OF[type(request)], "unsigned")
    return state, turned_down(state, type(request), request.header, Status.FORBIDDEN, UNSIGNED, now)


def commanded(state: CoreState, command: SignedCommand, now: Instant) -> Step:
    """Do what a sender who has proved to know the key asks for, where the vehicle file allows it."""
    order = command.order
    if isinstance(order, SwitchMode):
        return mode_wished(state, order, now)
    if isinstance(order, ReloadModel):
        return _reload_wished(state, order, now)
    return _pose_set(state, order, now)


def _reload_wished(state: CoreState, request: ReloadModel, now: Instant) -> Step:
    """Have the geometry read anew, where clients may ask for that."""
    if not request.header.is_answerable(state.settings.reply_prefix):
        return counted(state, CHANNEL_OF[ReloadModel], "reply_channel"), ()
    if not state.settings.may_reload:
        return _forbidden(state, request, "commands.reload", now)
    return state, (LoadModel(request),)


def model_loaded(state: CoreState, loaded: ModelLoaded, now: Instant) -> Step:
    """Take the new geometry as a whole, or leave the old one as it is."""
    request, model = loaded.request, loaded.model
    if model is None:
        state = counted(state, CHANNEL_OF[ReloadModel], "rejected")
        if request is None:
            return state, ()
        return state, turned_down(state, ReloadModel, request.header, Status.REJECTED, loaded.why, now)
    said = changes(state.model, model)
    outputs: list[Output] = []
    if request is None or not request.dry_run:
        view = replace(state.view, model=model, localizer=loaded.localizer, joints=state.view.joints.for_model(model))
        due = now.monotonic_ns + state.settings.snapshot_period_ns
        state = state._replace(view=view, snapshot_due_ns=due)
        outputs.append(PublishSnapshot(now.utime))
    if request is not None:
        state = state._replace(requests_answered=state.requests_answered + 1)
        header = ReplyHeader(request.header.request_id, now.utime, model_revision=state.model.revision)
        outputs.append(SendReply(request.header.reply_channel, ReloadReply(header, model.revision, said)))
    return state, tuple(outputs)


def _pose_set(state: CoreState, request: SetStateVector | SetHTransform, now: Instant) -> Step:
    """Tell localization where the vehicle is, where clients may do that."""
    if not request.header.is_answerable(state.settings.reply_prefix):
        return counted(state, CHANNEL_OF[type(request)], "reply_channel"), ()
    if not state.settings.may_set_pose:
        return _forbidden(state, request, "commands.set_pose", now)
    wish, view = request.pose.transformation, state.view
    state = state._replace(requests_answered=state.requests_answered + 1)
    origin = None if view.localizer is None else view.localizer.estimate(now.utime).origin
    why = ""
    if view.localizer is None:
        why = "the vehicle file names no sensor to localize by"
    elif (wish.frame_of_interest, wish.frame_of_reference) != (view.base_frame, names.WORLD_UTM):
        why = f"the pose of {view.base_frame} in {names.WORLD_UTM} is set, not that of another frame"
    elif origin is None:
        why = "the origin is not known yet; give one in the vehicle file, or wait for fixes"
    elif wish.covariance is not None and (wrong := fault(wish.covariance)):
        why = f"its covariance is none: {wrong}"
    elif _is_elsewhere(request.pose, origin):
        why = "the pose is told from another origin than the service's; ask for the vehicle's pose to see that one"
    elif wish.utime > now.utime + FUTURE_LIMIT_S * 1e6:
        ahead = (wish.utime - now.utime) * 1e-6
        why = f"the pose is stamped {ahead:.3f} s after the service's clock; stamp it with 0 for now"
    if why or view.localizer is None:
        return state, turned_down(state, type(request), request.header, Status.REJECTED, why, now)
    covariance = SET_COVARIANCE if wish.covariance is None else tuple(wish.covariance.ravel().tolist())
    sample = AbsolutePoseSample(
        SensorHeader(wish.utime or now.utime, OPERATOR, state.requests_answered),
        wish.frame_of_interest,
        wish.frame_of_reference,
        wish.pose.xyz,
        wish.pose.wxyz,
        covariance,
    )
    # pure, so it may be asked twice: the counts do not say which sample a refusal is of
    taken, notes = view.localizer.take(sample)
    refused = [why for each in notes if (why := _refusal(each, sample))]
    state, outputs = localized(state, view.localizer, sample, now)
    header = ReplyHeader(request.header.request_id, now.utime, model_revision=state.model.revision)
    if refused:
        text = f"localization did not take it: {', '.join(refused)}"
        if not _STAMPED_BADLY.isdisjoint(refused):
            text += "; its instant lies before what can still be weighed, stamp it with 0 for now"
        header = header._replace(status=Status.REJECTED, message=text)
    elif taken is view.localizer:
        text = "localization takes no poses from outside in the mode in force (raw mode knows GPS and IMU only)"
        header = header._replace(status=Status.REJECTED, message=text)
    return state, (*outputs, SendReply(request.header.reply_channel, Acknowledgement(header)))


_STAMPED_BADLY: Final = frozenset({"late", "order", "duplicate"})


def _refusal(note: Note, sample: AbsolutePoseSample) -> str:
    """Return why a note says that the sample was not taken, else nothing; what is told late is of an earlier one."""
    if isinstance(note, Rejected):
        return note.reason
    if isinstance(note, Decision) and note.verdict is Verdict.REJECTED:
        of_it = (note.source, note.seq) == (sample.header.source, sample.header.seq)
        return (note.reason or "rejected") if of_it else ""
    return ""


def _is_elsewhere(pose: PoseAnswer, origin: Origin) -> bool:
    """Return whether a pose says that it is told from another origin; one that says nothing means the service's."""
    named = pose.transformation.origin_id
    return (pose.origin is not None and pose.origin != origin) or (named != 0 and named != origin.origin_id)


def _forbidden(state: CoreState, request: Request, key: str, now: Instant) -> Step:
    state = counted(state, CHANNEL_OF[type(request)], "forbidden")
    section, _, name = key.partition(".")
    allowing = f"{section}: {{{name}: true}}"
    why = f"the vehicle file does not allow it; write {allowing} and a key_file beside it, whose key clients sign with"
    return state, turned_down(state, type(request), request.header, Status.FORBIDDEN, why, now)
