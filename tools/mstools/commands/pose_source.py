"""Sources of poses for `query`: the running daemon, a geometry file, or a log."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from modelserver.client.interface import NO_DEMAND, FrameClient, R
from modelserver.errors import ModelServerError, UnknownFrameError, find_nearest_names, quote
from modelserver.geometry import names
from modelserver.messages import (
    NO_FLAGS,
    ExplanationReply,
    GetExplanation,
    GetMotion,
    Policy,
    PoseAnswer,
    PoseDemand,
    Quality,
)
from mstools.terminal.options import parse_variables
from mstools.terminal.output import load_given_model

if TYPE_CHECKING:
    from mstools.recordings.log_platform import LogPlatform


class FileAnswers(FrameClient):
    """Poses of a geometry file, with joints at their defaults; times are ignored. Raises GeometryError, OSError."""

    def __init__(self, path: Path, settings: list[str] | None):
        self._model = load_given_model(path, parse_variables(settings))

    def _query_pose(
        self, interest: str, reference: str, at: int, policy: Policy, wait_ms: int, demand: PoseDemand = NO_DEMAND
    ) -> PoseAnswer:
        known = (names.WORLD_UTM, names.WORLD_ENU, names.ODOM)
        reserved = [each for each in (interest, reference) if each.partition(":")[0] in names.RESERVED_BODIES]
        for frame in reserved:
            if frame not in known:
                text = f"{quote(frame, 80)} is an unknown frame; known: {', '.join(known)}"
                raise UnknownFrameError(text, find_nearest_names(frame, known, 1))
        if reserved:
            raise ModelServerError("a geometry file has no pose of the vehicle in the world; query the daemon")
        rests = bool(self._model.get_kinematic_path(interest, reference).joints)
        answer = PoseAnswer(
            self._model.get_transformation(interest, reference), quality=Quality.JOINT_DEFAULT if rests else NO_FLAGS
        )
        if not any(demand):
            return answer
        from modelserver.query.answers import find_unmet

        unmet, reason = find_unmet(answer, demand, age=math.inf if rests else 0.0)
        return answer._replace(unmet=unmet, unmet_reason=reason)

    def _query(self, request: Any, reply_type: type[R]) -> R:
        from modelserver.estimation.history import History
        from modelserver.query.answers import compute_answer
        from modelserver.query.view import PlatformView

        if isinstance(request, GetMotion):
            raise ModelServerError("a geometry file has no motion; query the daemon")
        answer = (
            self._query_pose(*request[1:3], 0, Policy.INTERPOLATED, 0) if isinstance(request, GetExplanation) else None
        )
        root = self._model.root
        view = PlatformView(self._model, names.join(root.name, root.frames[0].name), None, History(0.0))
        (reply,) = compute_answer(view, request, 0)
        if isinstance(reply, ExplanationReply) and reply.answer is not None and answer is not None:
            # a joint at its default does not invalidate the geometry of a file
            answer = answer._replace(quality=reply.answer.answer.quality)
            reply = ExplanationReply(reply.header, reply.answer._replace(answer=answer))
        assert isinstance(reply, reply_type)
        return reply


def open_log_answers(log: Path, model: Path | None, settings: list[str] | None, prefix: str) -> LogPlatform:
    """Open a log as a source of poses, with `model` for its geometry. Raises RecordingError, GeometryError, OSError."""
    from mstools.recordings.log_platform import LogPlatform

    if model is None:
        return LogPlatform(log, prefix)
    given = load_given_model(model, parse_variables(settings))
    source = LogPlatform(log, prefix, given)
    if source.revision not in ("", given.revision):
        there = f"{model} has revision {given.revision}, but the poses in {log} have {source.revision}"
        typer.echo(f"modelserver: note: {there}", err=True)
    return source


def open_answer_source(
    model: Path | None, settings: list[str] | None, url: str, prefix: str, timeout: float
) -> FrameClient:
    """Open the source that the options select."""
    if model is not None:
        return FileAnswers(model, settings)
    from modelserver.client.remote import Platform

    return Platform(url, channel_prefix=prefix, timeout=timeout, name="modelserver")
