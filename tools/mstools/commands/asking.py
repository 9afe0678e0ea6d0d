"""What `query`, `bodies` and `frames` share: they ask the running daemon, a geometry file, or `query` a log."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Protocol

import typer

from modelserver.errors import ModelServerError, UnknownFrameError, nearest_names, shown
from modelserver.geometry import names
from modelserver.messages import NO_FLAGS, Explanation, MotionAnswer, Policy, PoseAnswer, Quality
from mstools.terminal.options import parse_variables
from mstools.terminal.output import print_problem

if TYPE_CHECKING:
    import lcm

    from mstools.recordings.log_answers import LogAnswers

ModelOption = Annotated[
    Path | None, typer.Option("--model", metavar="FILE", help="Ask this geometry file instead of the daemon.")
]
UrlOption = Annotated[
    str, typer.Option("--url", metavar="URL", help="LCM provider. Default: $LCM_DEFAULT_URL, else loopback.")
]
PrefixOption = Annotated[str, typer.Option("--prefix", metavar="TEXT", help="Channel prefix of the vehicle.")]
KeyOption = Annotated[
    Path | None,
    typer.Option("--key", metavar="FILE", help="The vehicle's key, to sign with. Default: $MODELSERVER_KEY_FILE."),
]
TimeoutOption = Annotated[
    float,
    typer.Option("--timeout", metavar="SECONDS", min=0.01, max=3600.0, help="How long one try waits for the daemon."),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON, for scripts.")]


def _check_worlds(*frames: str) -> None:
    """Raise UnknownFrameError for a frame of the service's own bodies that there is not."""
    known = (names.WORLD_UTM, names.WORLD_ENU, names.ODOM)
    for frame in frames:
        if frame.partition(":")[0] in names.RESERVED_BODIES and frame not in known:
            text = f"{shown(frame, 80)} is no frame; there are {', '.join(known)}"
            raise UnknownFrameError(text, nearest_names(frame, known, 1))


def handle_until(bus: lcm.LCM, seconds: float, is_done: Callable[[], bool]) -> bool:
    """Handle messages of the bus until `is_done`, for so many seconds at most; return whether it is done."""
    from modelserver.wire.provider import take_message

    deadline = time.monotonic() + seconds
    while not is_done():
        left = deadline - time.monotonic()
        if left <= 0.0:
            return False
        take_message(bus, int(left * 1e3) + 1)
    return True


class AnswerSource(Protocol):
    """Where answers come from: a file, or the daemon."""

    def get_pose(
        self,
        frame_of_interest: str,
        frame_of_reference: str,
        *,
        at: int = 0,
        policy: Policy = Policy.INTERPOLATED,
        wait_ms: int = 0,
    ) -> PoseAnswer:
        """Return where one frame is in another."""
        ...

    def get_body_list(self) -> list[str]:
        """Return the names of the bodies."""
        ...

    def get_body_frame_list(self, body: str) -> list[str]:
        """Return the names of a body's frames."""
        ...


class FileAnswers:
    """Answers from a geometry file. Raises GeometryError, OSError."""

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
        """Return where one frame is in another; time plays no part, and joints stand where they rest."""
        asked = {frame.partition(":")[0] for frame in (frame_of_interest, frame_of_reference)}
        if not asked.isdisjoint(names.RESERVED_BODIES):
            _check_worlds(frame_of_interest, frame_of_reference)
            raise ModelServerError("a geometry file does not know where the vehicle is in the world; ask the daemon")
        rests = bool(self._model.route(frame_of_interest, frame_of_reference).legs)
        return PoseAnswer(
            self._model.get_transformation(frame_of_interest, frame_of_reference),
            quality=Quality.AT_REST if rests else NO_FLAGS,
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
        """Return what `get_pose` does, and the edges it rests on."""
        from modelserver.history import History
        from modelserver.messages import TimeQuery
        from modelserver.platform import PlatformView
        from modelserver.platform.explained import explained

        answer = self.get_pose(frame_of_interest, frame_of_reference)
        view = PlatformView(self._model, frame_of_reference, None, History(0.0))
        found = explained(view, frame_of_interest, frame_of_reference, TimeQuery(), 0)
        # that nobody was heard is no reason against an answer that is of the file alone
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
        """Raise: a file stands still."""
        raise ModelServerError("a geometry file does not know how anything moves; ask the daemon")


def log_answers(log: Path, model: Path | None, settings: list[str] | None, prefix: str) -> LogAnswers:
    """Return what answers from a log, with `model` for its geometry. Raises RecordingError, GeometryError, OSError."""
    from modelserver.client.knowledge import HISTORY_S
    from modelserver.formats import load_model
    from modelserver.formats.snapshot import ModelSnapshot
    from mstools.recordings.log_answers import LogAnswers

    if model is None:
        return LogAnswers(log, prefix)
    given = load_model(model, variables=parse_variables(settings))
    for problem in given.problems:
        print_problem(problem, err=True)
    root = f"{given.root.name}:{given.root.frames[0].name}"
    source = LogAnswers(log, prefix, ModelSnapshot("", given, root, root, HISTORY_S, f"{prefix}JOINTS"))
    if source.revision not in ("", given.revision):
        typer.echo(
            f"modelserver: note: {model} is of revision {given.revision}, and the poses in {log} "
            f"rest on {source.revision}",
            err=True,
        )
    return source


def answers(model: Path | None, settings: list[str] | None, url: str, prefix: str, timeout: float) -> AnswerSource:
    """Return where answers come from, as the options say."""
    if model is not None:
        return FileAnswers(model, settings)
    from modelserver.client.remote import Platform

    return Platform(url, channel_prefix=prefix, timeout=timeout, name="modelserver")
