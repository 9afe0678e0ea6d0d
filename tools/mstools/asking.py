"""What `query`, `bodies` and `frames` share: they ask the running daemon, or with --model a file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Protocol

import typer

from modelserver.errors import ModelServerError
from modelserver.geometry import names
from modelserver.messages import Policy, PoseAnswer
from mstools.options import parse_variables
from mstools.output import print_problem

ModelOption = Annotated[
    Path | None, typer.Option("--model", metavar="FILE", help="Ask this geometry file instead of the daemon.")
]
UrlOption = Annotated[
    str, typer.Option("--url", metavar="URL", help="LCM provider. Default: $LCM_DEFAULT_URL, else loopback.")
]
PrefixOption = Annotated[str, typer.Option("--prefix", metavar="TEXT", help="Channel prefix of the vehicle.")]
TimeoutOption = Annotated[
    float,
    typer.Option("--timeout", metavar="SECONDS", min=0.01, max=3600.0, help="How long one try waits for the daemon."),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON, for scripts.")]


class Answers(Protocol):
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
        """Return where one frame is in another; time plays no part."""
        asked = {frame.partition(":")[0] for frame in (frame_of_interest, frame_of_reference)}
        if not asked.isdisjoint(names.RESERVED_BODIES):
            raise ModelServerError("a geometry file does not know where the vehicle is in the world; ask the daemon")
        return PoseAnswer(self._model.get_transformation(frame_of_interest, frame_of_reference))


def answers(model: Path | None, settings: list[str] | None, url: str, prefix: str, timeout: float) -> Answers:
    """Return where answers come from, as the options say."""
    if model is not None:
        return FileAnswers(model, settings)
    from modelserver.client.remote import Platform

    return Platform(url, channel_prefix=prefix, timeout=timeout, name="modelserver")
