"""`modelserver frames`: the frames of a body."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from modelserver.geometry import names
from mstools.commands.pose_source import open_answer_source
from mstools.terminal.options import (
    JsonOption,
    ModelOption,
    PrefixOption,
    TimeoutOption,
    UrlOption,
    Variables,
    argument,
)
from mstools.terminal.output import escape


def command(
    body: Annotated[str, argument("BODY", "Name of the body.")],
    model: ModelOption = None,
    settings: Variables = None,
    as_json: JsonOption = False,
    url: UrlOption = "",
    prefix: PrefixOption = "",
    timeout: TimeoutOption = 1.0,
) -> None:
    """List the frames of a body, as Body:Frame.

    Queries the running daemon, or with --model a geometry file.

    Example: modelserver frames Digiclops --model config/raptor/geometry.yaml
    """
    found = open_answer_source(model, settings, url, prefix, timeout).get_body_frame_list(body)
    frames = [names.join(body, frame) for frame in found]
    typer.echo(json.dumps(frames) if as_json else "\n".join(map(escape, frames)))
