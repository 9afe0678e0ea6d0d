"""`modelserver bodies`: the bodies of a model."""

from __future__ import annotations

import json

import typer

from mstools.commands.pose_source import open_answer_source
from mstools.terminal.options import JsonOption, ModelOption, PrefixOption, TimeoutOption, UrlOption, Variables
from mstools.terminal.output import escape


def command(
    model: ModelOption = None,
    settings: Variables = None,
    as_json: JsonOption = False,
    url: UrlOption = "",
    prefix: PrefixOption = "",
    timeout: TimeoutOption = 1.0,
) -> None:
    """List the bodies, root first.

    Queries the running daemon, or with --model a geometry file.

    Example: modelserver bodies --model config/raptor/geometry.yaml
    """
    bodies = open_answer_source(model, settings, url, prefix, timeout).get_body_list()
    typer.echo(json.dumps(bodies) if as_json else "\n".join(map(escape, bodies)))
