"""`modelserver bridge`: the running service for viewers with protocols of their own."""

from __future__ import annotations

import math
import sys
import time
from typing import Annotated, Final

import typer

from modelserver.errors import ModelServerError
from modelserver.wire.provider import open_lcm, resolve_url
from mstools.commands.export import check_foxglove
from mstools.terminal.options import PrefixOption, UrlOption, argument, choose_name, option
from mstools.terminal.progress import catch_signals

PROTOCOLS: Final = ("foxglove",)


def command(
    protocol: Annotated[str, argument("PROTOCOL", f"Protocol of the viewer: {', '.join(PROTOCOLS)}.")],
    bind: Annotated[str, option("--bind ADDRESS", "Serve at this address.")] = "127.0.0.1",
    port: Annotated[int, option("--port N", "Port; 0 is any free one.", min=0, max=65535)] = 8765,
    seconds: Annotated[float, option("--seconds N", "Stop after this time. Default: never.", min=0.1)] = math.inf,
    url: UrlOption = "",
    prefix: PrefixOption = "",
) -> None:
    """Serve the running service to Foxglove by its websocket, in the topics of `modelserver export` without /lcm.

    Foxglove: Open connection, Foxglove WebSocket, ws://127.0.0.1:8765. Everyone who reaches the port can read what the
    service publishes, and change nothing. It needs the extra foxglove: pip install 'modelserver[foxglove]'.

    Example: modelserver bridge foxglove
    """
    choose_name(protocol, PROTOCOLS, "protocol", "PROTOCOL")
    check_foxglove()
    import foxglove

    from mstools.recordings.drive import follow_bus
    from mstools.recordings.foxglove_messages import FoxgloveWriter

    context = foxglove.Context()
    bus = open_lcm(resolve_url(url))
    try:
        server = foxglove.start_server(name="modelserver", host=bind, port=port, context=context)
    except (OSError, RuntimeError, ValueError) as error:
        raise ModelServerError(f"cannot serve at {bind} port {port}: {error}; choose another with --port N") from None
    try:
        writer = FoxgloveWriter(context, prefix)
        typer.echo(f"ws://{bind}:{server.port} (Ctrl-C ends it)")
        sys.stdout.flush()
        end = time.monotonic() + seconds
        with catch_signals() as stop:
            follow_bus(bus, prefix, writer.feed, lambda: stop.is_set() or time.monotonic() >= end)
    finally:
        server.stop()
