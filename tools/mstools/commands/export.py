"""`modelserver export`: an LCM log as an MCAP file for Foxglove and other tools."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Annotated

import typer

from modelserver.errors import ModelServerError, RecordingError
from modelserver.wire.eventlog import LogFile
from mstools.terminal.options import PrefixOption, argument, option
from mstools.terminal.output import check_writable, format_count, show_progress

PROGRESS_EVENTS = 5_000


def command(
    log: Annotated[Path, argument("LOG", "LCM log of the service.")],
    out: Annotated[Path, argument("OUT", "MCAP file to write.")],
    raw: Annotated[bool, typer.Option("--raw/--no-raw", help="Include the LCM messages as they are.")] = True,
    prefix: PrefixOption = "",
    force: Annotated[bool, option("--force", "Replace OUT if it exists.")] = False,
) -> None:
    """Export an LCM log of the service to an MCAP file, which Foxglove opens.

    It has the frames (/tf), the pose (/pose, /pose/fix), fixes (/fix/SOURCE), the shapes of the bodies (/model), health
    (/diagnostics) and events (/events) in Foxglove's schemas, and the LCM messages as they are (/lcm/CHANNEL). It needs
    the extra foxglove: pip install 'modelserver[foxglove]'. import-bag makes the log of it again.

    Example: modelserver export drive.lcm drive.mcap
    """
    check_foxglove()
    import foxglove

    from mstools.recordings.foxglove_messages import FoxgloveWriter, find_definitions

    if out.exists() and not force:
        raise ModelServerError(f"{out} exists; give another name, or --force to replace it")
    check_writable(str(out))
    # written beside it first: an export that is interrupted leaves no half file under this name
    part = out.with_name(f".{out.name}.part")
    part.unlink(missing_ok=True)
    count = 0
    try:
        context = foxglove.Context()
        with (
            LogFile(log) as events,
            show_progress(f"exporting {log.name}", events.size) as show,
            foxglove.open_mcap(part, context=context),
        ):
            writer = FoxgloveWriter(context, prefix, find_definitions() if raw else None)
            for count, event in enumerate(events, 1):
                writer.feed(event.channel, event.data, event.utime)
                if count % PROGRESS_EVENTS == 0:
                    show(event.end)
            if not writer.has_geometry:
                raise RecordingError(
                    f"{log}: no complete geometry on {prefix}MODEL_SNAPSHOT, so there are no frames. The service "
                    "publishes it at its start and every few seconds: record its channels too (lcm-logger); for a "
                    "channel prefix use --prefix"
                )
        part.replace(out)
    finally:
        part.unlink(missing_ok=True)
    typer.echo(f"{out}: {format_count(count, 'message')}, {out.stat().st_size / 1e6:.1f} MB")
    for damage in events.damage:
        typer.echo(f"modelserver: note: {log}: {damage}", err=True)
    if writer.skipped:
        typer.echo(f"modelserver: note: {format_count(writer.skipped, 'message')} could not be read", err=True)


def check_foxglove() -> None:
    """Raise ModelServerError if the extra `foxglove` is not installed."""
    if importlib.util.find_spec("foxglove") is None:
        raise ModelServerError("this needs foxglove-sdk, which is not installed: pip install 'modelserver[foxglove]'")
