"""Commands: reload the geometry, set the pose, switch the mode. Executed only if signed. Pure.

A reload has two steps, since the core does no input or output: it outputs `LoadModel`, the file is read beside the
loop, and the result comes back as the event `ModelLoaded` (`apply_model`). A pose that is set becomes an absolute-pose
sample of the source `OPERATOR`, and passes the gates of localization as any other measurement.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from modelserver import messages
from modelserver.core.host_clock import Instant
from modelserver.core.requests import is_answerable, reply_error
from modelserver.core.samples import COMMAND_FUTURE_LIMIT_S, switch_mode, update_localizer
from modelserver.core.state import CoreState, StepResult, count_rejection
from modelserver.errors import Status
from modelserver.estimation.history import Localizer, LocalizerEvent
from modelserver.geometry import names
from modelserver.geometry.model import Model
from modelserver.transforms.covariance import find_problem


@dataclass(frozen=True, slots=True)
class ModelLoaded:
    """Event: the geometry was read. It has a model, the localizer for it and its changes, or the reason `why` not.

    `request` is the client's request, None for a reload by signal.
    """

    request: messages.ReloadModel | None
    model: Model | None = None
    localizer: Localizer | None = None
    why: str = ""
    changes: tuple[str, ...] = ()


COMMANDS: Final = (messages.ReloadModel, messages.SetStateVector, messages.SetHTransform)
"""Requests that must be signed."""

SET_COVARIANCE: Final = tuple(np.diag([1.0] * 3 + [math.radians(5.0) ** 2] * 3).ravel().tolist())
"""Default covariance of a pose that is set: 1 m and 5 degrees."""

OPERATOR: Final = "operator"
"""Source of the sample that a set pose becomes."""

UNSIGNED_MESSAGE: Final = (
    "the command is not signed; sign it with the vehicle's key (Platform(key_file=...), --key FILE or "
    "$MODELSERVER_KEY_FILE; docs/wire.md for other languages)"
)


def deny_unsigned(
    state: CoreState, command: messages.ReloadModel | messages.SetStateVector | messages.SetHTransform, now: Instant
) -> StepResult:
    """Deny a command without signature."""
    forbidden = _forbid(state, command, now)
    if forbidden is not None:
        return forbidden
    state = count_rejection(state, messages.CHANNEL_OF[type(command)], "unsigned")
    return state, reply_error(state, type(command), command.header, Status.FORBIDDEN, UNSIGNED_MESSAGE, now)


def execute_command(state: CoreState, signed: messages.SignedCommand, now: Instant) -> StepResult:
    """Execute a command whose signature is verified, where the vehicle file permits it."""
    command = signed.command
    if isinstance(command, messages.SwitchMode):
        return switch_mode(state, command, now)
    forbidden = _forbid(state, command, now)
    if forbidden is not None:
        return forbidden
    return (
        (state, (messages.LoadModel(command),))
        if isinstance(command, messages.ReloadModel)
        else _set_pose(state, command, now)
    )


def _forbid(
    state: CoreState, command: messages.ReloadModel | messages.SetStateVector | messages.SetHTransform, now: Instant
) -> StepResult | None:
    """Reject a command whose reply channel, or which itself, is not permitted; None if it is."""
    channel, settings = messages.CHANNEL_OF[type(command)], state.settings
    if not is_answerable(command.header, settings.reply_prefix):
        return count_rejection(state, channel, "reply_channel"), ()
    name, is_permitted = "set_pose", settings.may_set_pose
    if isinstance(command, messages.ReloadModel):
        name, is_permitted = "reload", settings.may_reload
    if is_permitted:
        return None
    state = count_rejection(state, channel, "forbidden")
    why = (
        f"the vehicle file does not permit it; write commands: {{{name}: true}} and beside it a key_file, whose key "
        "clients sign with"
    )
    return state, reply_error(state, type(command), command.header, Status.FORBIDDEN, why, now)


def apply_model(state: CoreState, loaded: ModelLoaded, now: Instant) -> StepResult:
    """Replace the geometry as a whole, or keep the old one if the new one could not be loaded."""
    request, model = loaded.request, loaded.model
    if model is None:
        state = count_rejection(state, messages.CHANNEL_OF[messages.ReloadModel], "rejected")
        if request is None:
            return state, ()
        return state, reply_error(state, messages.ReloadModel, request.header, Status.REJECTED, loaded.why, now)
    outputs: list[messages.Output] = []
    if request is None or not request.dry_run:
        view = state.view._replace(model=model, localizer=loaded.localizer, joints=state.view.joints.for_model(model))
        due = now.monotonic_ns + state.settings.snapshot_period_ns
        state = state._replace(view=view, snapshot_due_ns=due)
        outputs.append(messages.PublishSnapshot(now.utime))
    if request is not None:
        state = state._replace(requests_answered=state.requests_answered + 1)
        header = messages.ReplyHeader(request.header.request_id, now.utime, model_revision=state.model.revision)
        outputs.append(
            messages.SendReply(
                request.header.reply_channel, messages.ReloadReply(header, model.revision, loaded.changes)
            )
        )
    return state, tuple(outputs)


def _set_pose(state: CoreState, request: messages.SetStateVector | messages.SetHTransform, now: Instant) -> StepResult:
    given, view = request.pose.transformation, state.view
    state = state._replace(requests_answered=state.requests_answered + 1)
    origin = None if view.localizer is None else view.localizer.estimate(now.utime).origin
    why = ""
    if view.localizer is None:
        why = "no localization sensor is configured (section 'sensors' of the vehicle file)"
    elif (given.frame_of_interest, given.frame_of_reference) != (view.base_frame, names.WORLD_UTM):
        why = (
            f"the pose is of {given.frame_of_interest} in {given.frame_of_reference}; expected the pose of "
            f"{view.base_frame} in {names.WORLD_UTM}"
        )
    elif origin is None:
        why = "the origin is not known yet; configure one in the vehicle file, or wait for GPS fixes"
    elif given.covariance is not None and (problem := find_problem(given.covariance)):
        why = f"invalid covariance: {problem}"
    elif _has_other_origin(request.pose, origin):
        why = "the pose has another origin than the server; ask for the vehicle's pose to get that origin"
    elif given.utime > now.utime + COMMAND_FUTURE_LIMIT_S * 1e6:
        ahead = (given.utime - now.utime) * 1e-6
        why = f"the pose is stamped {ahead:.3f} s ahead of the server's clock; stamp it with 0 for now"
    if why or view.localizer is None:
        return state, reply_error(state, type(request), request.header, Status.REJECTED, why, now)
    covariance = SET_COVARIANCE if given.covariance is None else tuple(given.covariance.ravel().tolist())
    sample = messages.AbsolutePoseSample(
        messages.SensorHeader(given.utime or now.utime, OPERATOR, state.requests_answered),
        given.frame_of_interest,
        given.frame_of_reference,
        given.pose.xyz,
        given.pose.wxyz,
        covariance,
    )
    # the localizer is pure, so it may process the sample twice: the counts do not identify the rejected sample
    localizer, events = view.localizer.process(sample)
    reasons = [reason for event in events if (reason := _get_rejection_reason(event, sample))]
    state, outputs = update_localizer(state, view.localizer, sample, now)
    header = messages.ReplyHeader(request.header.request_id, now.utime, model_revision=state.model.revision)
    if reasons:
        text = f"localization rejected the pose: {', '.join(reasons)}"
        if not _STAMP_REASONS.isdisjoint(reasons):
            text += "; its time is older than what can still be fused, stamp it with 0 for now"
        header = header._replace(status=Status.REJECTED, message=text)
    elif localizer is view.localizer:
        text = "the active mode fuses no external poses (raw mode uses GPS and IMU only)"
        header = header._replace(status=Status.REJECTED, message=text)
    return state, (*outputs, messages.SendReply(request.header.reply_channel, messages.Acknowledgement(header)))


_STAMP_REASONS: Final = frozenset({"too_old", "out_of_sequence", "duplicate"})


def _get_rejection_reason(event: LocalizerEvent, sample: messages.AbsolutePoseSample) -> str:
    """Return why a sample was rejected, else an empty text; a decision may also be on an earlier sample."""
    if isinstance(event, messages.Rejected):
        return event.reason
    if isinstance(event, messages.Decision) and event.verdict is messages.Verdict.REJECTED:
        is_own = (event.source, event.seq) == (sample.header.source, sample.header.seq)
        return (event.reason or "rejected") if is_own else ""
    return ""


def _has_other_origin(pose: messages.PoseAnswer, origin: messages.Origin) -> bool:
    """Return whether a pose names another origin; without a name it means the server's."""
    named = pose.transformation.origin_id
    return (pose.origin is not None and pose.origin != origin) or (named != 0 and named != origin.origin_id)
