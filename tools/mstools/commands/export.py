"""`modelserver export`: an LCM log as an MCAP file for Foxglove and other tools, or the running service live."""

from __future__ import annotations

import math
import sys
import time
from pathlib import Path
from typing import Annotated

import typer

from modelserver.errors import ModelServerError, RecordingError
from modelserver.wire.provider import open_lcm, resolve_url
from mstools.terminal.options import PrefixOption, UrlOption, argument, option
from mstools.terminal.output import (
    catch_signals,
    check_writable,
    format_count,
    load_given_model,
    read_with_progress,
    require_extra,
    write_beside,
)

NEEDS_FOXGLOVE = "this needs foxglove-sdk"

DEFAULT_PORT = 8765
"""Port of Foxglove's websocket by its documentation."""


def command(
    log: Annotated[Path | None, argument("[LOG]", "LCM log of the service.")] = None,
    out: Annotated[Path | None, argument("[OUT]", "MCAP file to write.")] = None,
    model: Annotated[Path | None, option("--model FILE", "Geometry for a log that has none of the service.")] = None,
    config: Annotated[
        Path | None, option("--config -c FILE", "Vehicle file: run the localization on a log that has no poses.")
    ] = None,
    live: Annotated[bool, option("--live", "Serve the running service to Foxglove by its websocket.")] = False,
    raw: Annotated[bool, option("--raw/--no-raw", "Include the LCM messages as they are.")] = True,
    force: Annotated[bool, option("--force", "Replace OUT if it exists.")] = False,
    bind: Annotated[str, option("--bind ADDRESS", "With --live: serve at this address.")] = "127.0.0.1",
    port: Annotated[int, option("--port N", "With --live: port; 0 is any free one.", min=0, max=65535)] = DEFAULT_PORT,
    seconds: Annotated[
        float, option("--seconds N", "With --live: stop after this time. Default: never.", min=0.1)
    ] = math.inf,
    url: UrlOption = "",
    prefix: PrefixOption = "",
) -> None:
    """Export an LCM log of the service to an MCAP file, which Foxglove opens, or serve the running service to it.

    It has the frames (/tf), the pose (/pose, /pose/fix), fixes (/fix/SOURCE), the shapes of the bodies (/model), health
    (/diagnostics) and events (/events) in Foxglove's schemas, and the LCM messages as they are (/lcm/CHANNEL). It needs
    the extra foxglove; without it, the error names the command that adds it. import-bag makes the log of it again.

    With --live the topics are the same, without /lcm. Foxglove: Open connection, Foxglove WebSocket,
    ws://127.0.0.1:8765. Everyone who reaches the port can read what the service publishes, and change nothing.

    \b
    Examples:
      modelserver export drive.lcm drive.mcap
      modelserver export imported.lcm drive.mcap -c vehicle.yaml
      modelserver export --live
    """
    if live:
        if log is not None or force or not raw or model is not None or config is not None:
            raise typer.BadParameter("excludes LOG, OUT, --model, --config, --force and --no-raw", param_hint="--live")
        require_extra("foxglove", NEEDS_FOXGLOVE)
        serve_live(bind, port, seconds, url, prefix)
        return
    if log is None or out is None:
        raise typer.BadParameter("give LOG and OUT, or --live for the running service", param_hint="LOG")
    if bind != "127.0.0.1" or port != DEFAULT_PORT or math.isfinite(seconds) or url:
        raise typer.BadParameter("goes with --live", param_hint="--bind, --port, --seconds, --url")
    if model is not None and config is not None:
        raise typer.BadParameter("goes without --config, whose vehicle file names the geometry", param_hint="--model")
    require_extra("foxglove", NEEDS_FOXGLOVE)
    from mstools.commands.replay import open_localized

    check_writable(str(out), force)
    with open_localized(log, config) as localized:
        write_mcap(localized, out, raw, prefix, model)


def write_mcap(log: Path, out: Path, raw: bool, prefix: str, model: Path | None = None) -> None:
    """Write the MCAP file of a log, whole or not at all; `model`: geometry in place of the log's.

    Raises ModelServerError, RecordingError, OSError.
    """
    import foxglove

    from mstools.commands.status import find_type_files
    from mstools.recordings.foxglove_messages import FoxgloveWriter

    count = 0
    with write_beside(out) as draft:
        context = foxglove.Context()
        with (
            read_with_progress("exporting", log) as (recording, events),
            foxglove.open_mcap(draft, context=context),
        ):
            given = None if model is None else load_given_model(model, {})
            writer = FoxgloveWriter(context, prefix, find_type_files()[0].parent if raw else None, given)
            for event in events:
                count += 1
                writer.feed(event.channel, event.data, event.utime)
            if not writer.has_geometry:
                raise RecordingError(
                    f"{log}: no complete geometry on {prefix}MODEL_SNAPSHOT, so there are no frames. The service "
                    "publishes it at its start and every few seconds: record its channels too (modelserver record); "
                    "for a channel prefix use --prefix. Or give the geometry with --model FILE, or the vehicle file, "
                    "with which the localization runs too: -c FILE"
                )
    typer.echo(f"{out}: {format_count(count, 'message')}, {out.stat().st_size / 1e6:.1f} MB")
    for damage in recording.damage:
        typer.echo(f"modelserver: note: {log}: {damage}", err=True)
    if writer.skipped:
        typer.echo(f"modelserver: note: {format_count(writer.skipped, 'message')} could not be read", err=True)


def serve_live(bind: str, port: int, seconds: float, url: str, prefix: str) -> None:
    """Serve the running service until Ctrl-C. Raises ModelServerError for an address that cannot be used."""
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
