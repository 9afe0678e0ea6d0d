"""Sources of poses for `query`, `bodies` and `frames`: the running daemon, a geometry file, or a log."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import typer

from modelserver.errors import ModelServerError, UnknownFrameError, find_nearest_names, quote
from modelserver.geometry import names
from modelserver.messages import NO_FLAGS, Explanation, MotionAnswer, Policy, PoseAnswer, Quality
from mstools.terminal.options import parse_variables
from mstools.terminal.output import print_problem

if TYPE_CHECKING:
    import lcm

    from mstools.recordings.log_platform import LogPlatform


def _check_world_frames(*frames: str) -> None:
    """Raise UnknownFrameError for an unknown frame of the reserved bodies."""
    known = (names.WORLD_UTM, names.WORLD_ENU, names.ODOM)
    for frame in frames:
        if frame.partition(":")[0] in names.RESERVED_BODIES and frame not in known:
            text = f"{quote(frame, 80)} is an unknown frame; known: {', '.join(known)}"
            raise UnknownFrameError(text, find_nearest_names(frame, known, 1))


def handle_until(bus: lcm.LCM, seconds: float, is_done: Callable[[], bool]) -> bool:
    """Handle messages of the bus for up to `seconds` until `is_done`; return whether it is."""
    from modelserver.wire.provider import handle_message

    deadline = time.monotonic() + seconds
    while not is_done():
        left = deadline - time.monotonic()
        if left <= 0.0:
            return False
        handle_message(bus, int(left * 1e3) + 1)
    return True


class AnswerSource(Protocol):
    """Source of poses and names: a file, or the daemon."""

    def get_pose(
        self,
        frame_of_interest: str,
        frame_of_reference: str,
        *,
        at: int = 0,
        policy: Policy = Policy.INTERPOLATED,
        wait_ms: int = 0,
    ) -> PoseAnswer:
        """Return the pose of one frame in another."""
        ...

    def get_body_list(self) -> list[str]:
        """Return the names of the bodies."""
        ...

    def get_body_frame_list(self, body: str) -> list[str]:
        """Return the names of a body's frames."""
        ...


class FileAnswers:
    """Poses of a geometry file. Raises GeometryError, OSError."""

    def __init__(self, path: Path, settings: list[str] | None):
        from modelserver.formats import load_model

        self._model = load_model(path, variables=parse_variables(settings))
        for problem in self._model.problems:
            print_problem(problem, err=True)
        self.get_body_list = self._model.get_body_list
        self.get_body_frame_list = self._model.get_body_frame_list

    def get_pose(
        self,
        frame_of_interest: str,
        frame_of_reference: str,
        *,
        at: int = 0,
        policy: Policy = Policy.INTERPOLATED,
        wait_ms: int = 0,
    ) -> PoseAnswer:
        """Return the pose of one frame in another, with joints at their defaults; the time is ignored."""
        asked = {frame.partition(":")[0] for frame in (frame_of_interest, frame_of_reference)}
        if not asked.isdisjoint(names.RESERVED_BODIES):
            _check_world_frames(frame_of_interest, frame_of_reference)
            raise ModelServerError("a geometry file has no pose of the vehicle in the world; query the daemon")
        rests = bool(self._model.get_kinematic_path(frame_of_interest, frame_of_reference).joints)
        return PoseAnswer(
            self._model.get_transformation(frame_of_interest, frame_of_reference),
            quality=Quality.JOINT_DEFAULT if rests else NO_FLAGS,
        )

    def explain(
        self,
        frame_of_interest: str,
        frame_of_reference: str,
        *,
        at: int = 0,
        policy: Policy = Policy.INTERPOLATED,
        wait_ms: int = 0,
    ) -> Explanation:
        """Return the pose with the edges on its path."""
        from modelserver.estimation.history import History
        from modelserver.messages import TimeQuery
        from modelserver.query import PlatformView
        from modelserver.query.explanation import explain

        answer = self.get_pose(frame_of_interest, frame_of_reference)
        view = PlatformView(self._model, frame_of_reference, None, History(0.0))
        found = explain(view, frame_of_interest, frame_of_reference, TimeQuery(), 0)
        # stale sensors do not invalidate the geometry of a file
        return found._replace(answer=answer._replace(quality=found.answer.quality))

    def get_motion(
        self,
        frame_of_interest: str,
        frame_of_reference: str,
        *,
        expressed_in: str = "",
        at: int = 0,
        policy: Policy = Policy.INTERPOLATED,
        wait_ms: int = 0,
    ) -> MotionAnswer:
        """Raise ModelServerError: a file has no motion."""
        raise ModelServerError("a geometry file has no motion; query the daemon")


def open_log_answers(log: Path, model: Path | None, settings: list[str] | None, prefix: str) -> LogPlatform:
    """Open a log as a source of poses, with `model` for its geometry. Raises RecordingError, GeometryError, OSError."""
    from modelserver.client.mirror_state import HISTORY_S
    from modelserver.formats import load_model
    from modelserver.formats.snapshot import ModelSnapshot
    from mstools.recordings.log_platform import LogPlatform

    if model is None:
        return LogPlatform(log, prefix)
    given = load_model(model, variables=parse_variables(settings))
    for problem in given.problems:
        print_problem(problem, err=True)
    root = f"{given.root.name}:{given.root.frames[0].name}"
    source = LogPlatform(log, prefix, ModelSnapshot("", given, root, root, HISTORY_S, f"{prefix}JOINTS"))
    if source.revision not in ("", given.revision):
        typer.echo(
            f"modelserver: note: {model} has revision {given.revision}, but the poses in {log} have {source.revision}",
            err=True,
        )
    return source


def open_answer_source(
    model: Path | None, settings: list[str] | None, url: str, prefix: str, timeout: float
) -> AnswerSource:
    """Open the source that the options select."""
    if model is not None:
        return FileAnswers(model, settings)
    from modelserver.client.remote import Platform

    return Platform(url, channel_prefix=prefix, timeout=timeout, name="modelserver")
