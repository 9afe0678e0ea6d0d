"""`modelserver bodies`: which bodies are there?"""

from __future__ import annotations

import json

import typer

from mstools.commands.asking import JsonOption, ModelOption, PrefixOption, TimeoutOption, UrlOption, answers
from mstools.terminal.options import Variables
from mstools.terminal.output import safe


def command(
    model: ModelOption = None,
    settings: Variables = None,
    as_json: JsonOption = False,
    url: UrlOption = "",
    prefix: PrefixOption = "",
    timeout: TimeoutOption = 1.0,
) -> None:
    """List the bodies, root first.

    Asks the running daemon, or with --model a geometry file.

    Example: modelserver bodies --model config/raptor/geometry.yaml
    """
    bodies = answers(model, settings, url, prefix, timeout).get_body_list()
    typer.echo(json.dumps(bodies) if as_json else "\n".join(map(safe, bodies)))
