"""`modelserver export`: an LCM log as an MCAP file for Foxglove and other tools, or the running service live."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from modelserver.errors import ModelServerError, RecordingError
from modelserver.wire.provider import open_lcm, resolve_url
from mstools.terminal.options import PrefixOption, UrlOption, argument, option
from mstools.terminal.output import (
    catch_signals,
    check_writable,
    escape,
    format_count,
    load_given_model,
    read_with_progress,
    require_extra,
    write_beside,
    write_file,
)

if TYPE_CHECKING:
    from foxglove import Context

    from mstools.foxglove.writer import FoxgloveWriter

NEEDS_FOXGLOVE = "this needs foxglove-sdk"

DEFAULT_PORT = 8765
"""Port of Foxglove's websocket by its documentation."""

SHOWN_FILES = 3


def command(
    log: Annotated[Path | None, argument("[LOG]", "LCM log of the service.")] = None,
    out: Annotated[Path | None, argument("[OUT]", "MCAP file to write.")] = None,
    model: Annotated[Path | None, option("--model FILE", "Geometry for a log that has none of the service.")] = None,
    config: Annotated[
        Path | None, option("--config -c FILE", "Vehicle file: run the localization on a log that has no poses.")
    ] = None,
    live: Annotated[bool, option("--live", "Serve the running service to Foxglove by its websocket.")] = False,
    layout: Annotated[
        Path | None, option("--layout FILE", "Write a layout for Foxglove that shows the topics; without LOG it alone.")
    ] = None,
    raw: Annotated[bool, option("--raw/--no-raw", "Include the LCM messages as they are.")] = True,
    decoded: Annotated[
        bool, option("--decoded/--no-decoded", "Include the LCM messages as JSON: half of the file.")
    ] = True,
    package_path: Annotated[
        list[Path] | None,
        option(
            "--package-path FOLDER", "Find meshes here too, package://NAME in the folder NAME. Repeatable.", exists=True
        ),
    ] = None,
    force: Annotated[bool, option("--force", "Replace OUT and the layout if they exist.")] = False,
    bind: Annotated[str, option("--bind ADDRESS", "With --live: serve at this address.")] = "127.0.0.1",
    port: Annotated[int, option("--port N", "With --live: port; 0 is any free one.", min=0, max=65535)] = DEFAULT_PORT,
    seconds: Annotated[
        float, option("--seconds N", "With --live: stop after this time. Default: never.", min=0.1)
    ] = math.inf,
    url: UrlOption = "",
    prefix: PrefixOption = "",
) -> None:
    """Export an LCM log of the service to an MCAP file, which Foxglove opens, or serve the running service to it.

    It has the frames (/tf), the pose with its covariance (/pose, /pose/fix), fixes (/fix/SOURCE), the shapes of the
    bodies (/model), ellipsoid and protection level (/uncertainty), signals to plot (/state, /nis), health
    (/diagnostics), events (/events), and the LCM messages as JSON (/decoded/CHANNEL) and as they are (/lcm/CHANNEL), of
    which import-bag makes the log again. It needs the extra foxglove; without it, the error names the command that adds
    it.

    With --live the topics are the same. Foxglove: Open connection, Foxglove WebSocket, ws://127.0.0.1:8765. Everyone
    who reaches the port can read what the service publishes, and change nothing.

    \b
    Examples:
      modelserver export drive.lcm drive.mcap --layout layout.json
      modelserver export imported.lcm drive.mcap -c vehicle.yaml
      modelserver export --live
    """
    from modelserver.config.vehicle_file import load_config

    if live:
        if log is not None or model is not None or config is not None:
            raise typer.BadParameter("excludes LOG, OUT, --model and --config", param_hint="--live")
    elif bind != "127.0.0.1" or port != DEFAULT_PORT or math.isfinite(seconds) or url:
        raise typer.BadParameter("goes with --live", param_hint="--bind, --port, --seconds, --url")
    elif log is None and layout is not None:
        if model is not None:
            raise typer.BadParameter("goes with LOG", param_hint="--model")
        require_extra("foxglove", NEEDS_FOXGLOVE)
        write_layout(layout, force, "" if config is None else load_config(config).base_frame)
        return
    elif log is None or out is None:
        raise typer.BadParameter("give LOG and OUT, or --live for the running service", param_hint="LOG")
    elif model is not None and config is not None:
        raise typer.BadParameter("goes without --config, whose vehicle file names the geometry", param_hint="--model")
    elif layout is not None and layout.resolve() in (log.resolve(), out.resolve()):
        raise typer.BadParameter("must be another file than LOG and OUT", param_hint="--layout")
    require_extra("foxglove", NEEDS_FOXGLOVE)
    if layout is not None:
        check_writable(str(layout), force)
    packages = tuple(package_path or ())
    if log is None or out is None:
        content = ExportContent(prefix, raw, decoded, layout, force, packages=packages)
        serve_live(content, bind, port, seconds, url)
        return
    from mstools.commands.replay import open_localized

    check_writable(str(out), force)
    geometry = model if config is None else Path(load_config(config).geometry)
    folder = None if geometry is None else geometry.resolve().parent
    content = ExportContent(prefix, raw, decoded, layout, force, model, folder, packages)
    with open_localized(log, config) as localized:
        write_mcap(localized, out, content)


@dataclass(frozen=True, slots=True)
class ExportContent:
    """What is exported: of which channels, with which copies of LCM messages, and a layout for it.

    `model` is a geometry file in place of the service's; `folder` and `packages` are where meshes are looked up.
    """

    prefix: str = ""
    raw: bool = True
    decoded: bool = True
    layout: Path | None = None
    replace: bool = False
    model: Path | None = None
    folder: Path | None = None
    packages: tuple[Path, ...] = ()

    def open_writer(self, context: Context) -> FoxgloveWriter:
        """Return what logs the drive to a context. Raises GeometryError, MissingToolError, OSError."""
        from mstools.commands.status import find_type_files
        from mstools.foxglove.writer import FoxgloveWriter
        from mstools.meshes import MeshFolders

        definitions = find_type_files()[0].parent if self.raw else None
        model = None if self.model is None else load_given_model(self.model, {})
        meshes = MeshFolders(self.folder, self.packages)
        return FoxgloveWriter(context, self.prefix, definitions, self.decoded, model, meshes)

    def write_layout(self, writer: FoxgloveWriter) -> None:
        """Write the layout for what the writer has logged. Raises ModelServerError, OSError."""
        if self.layout is not None:
            write_layout(self.layout, self.replace, writer.base_frame, writer.sources, writer.measurements)


def write_layout(
    path: Path, replace: bool, base_frame: str = "", sources: Collection[str] = (), measurements: Collection[str] = ()
) -> None:
    """Write a layout, see `make_layout`. Raises ModelServerError, OSError."""
    from mstools.foxglove.layout import make_layout

    write_file(str(path), f"{make_layout(base_frame, sources, measurements).to_json()}\n", replace)
    typer.echo(f"{path}: layout")


def write_mcap(log: Path, out: Path, content: ExportContent) -> None:
    """Write the MCAP file of a log, whole or not at all, and its layout.

    Raises ModelServerError, RecordingError, OSError.
    """
    import foxglove

    count = 0
    with write_beside(out) as draft:
        context = foxglove.Context()
        with (
            read_with_progress("exporting", log) as (recording, events),
            foxglove.open_mcap(draft, context=context),
        ):
            writer = content.open_writer(context)
            for event in events:
                count += 1
                writer.feed(event.channel, event.data, event.utime)
            if not writer.has_geometry:
                raise RecordingError(
                    f"{log}: no complete geometry on {content.prefix}MODEL_SNAPSHOT, so there are no frames. The "
                    "service publishes it at its start and every few seconds: record its channels too (modelserver "
                    "record); for a channel prefix use --prefix. Or give the geometry with --model FILE, or the "
                    "vehicle file, with which the localization runs too: -c FILE"
                )
    content.write_layout(writer)
    typer.echo(f"{out}: {format_count(count, 'message')}, {out.stat().st_size / 1e6:.1f} MB")
    for damage in recording.damage:
        typer.echo(f"modelserver: note: {log}: {damage}", err=True)
    print_notes(writer)


def print_notes(writer: FoxgloveWriter) -> None:
    """Print what is not in the export."""
    if writer.skipped:
        typer.echo(f"modelserver: note: {format_count(writer.skipped, 'message')} could not be read", err=True)
    for reason, files in writer.unread.items():
        missing = f"{format_count(len(files), 'mesh', 'meshes')} not drawn: {reason}: {', '.join(files[:SHOWN_FILES])}"
        typer.echo(escape(f"modelserver: note: {missing}"), err=True)


def serve_live(content: ExportContent, bind: str, port: int, seconds: float, url: str) -> None:
    """Serve the running service until Ctrl-C; write the layout when its geometry is there.

    Raises ModelServerError for an address that cannot be used.
    """
    import foxglove
    from foxglove.websocket import ChannelView, Client, ServerListener

    from mstools.foxglove.writer import MODEL_TOPIC, TF_TOPIC
    from mstools.recordings.drive import follow_bus

    context = foxglove.Context()
    bus = open_lcm(resolve_url(url))
    writer = content.open_writer(context)

    class Listener(ServerListener):
        """Has what is logged once logged again for a client that subscribes later."""

        def on_subscribe(self, client: Client, channel: ChannelView) -> None:
            if channel.topic in (MODEL_TOPIC, TF_TOPIC):
                writer.refresh()

    try:
        server = foxglove.start_server(
            name="modelserver", host=bind, port=port, context=context, server_listener=Listener()
        )
    except (OSError, RuntimeError, ValueError) as error:
        raise ModelServerError(f"cannot serve at {bind} port {port}: {error}; choose another with --port N") from None
    is_layout_due = True

    def feed(channel: str, data: bytes, now: int) -> None:
        nonlocal is_layout_due
        writer.feed(channel, data, now)
        if is_layout_due and writer.has_geometry:
            is_layout_due = False
            content.write_layout(writer)

    try:
        typer.echo(f"ws://{bind}:{server.port} (Ctrl-C ends it)")
        sys.stdout.flush()
        end = time.monotonic() + seconds
        with catch_signals() as stop:
            follow_bus(bus, content.prefix, feed, lambda: stop.is_set() or time.monotonic() >= end)
    finally:
        server.stop()
    if content.layout is not None and is_layout_due:
        note = "no geometry was received, so there is no layout"
        typer.echo(escape(f"modelserver: note: {content.layout}: {note}"), err=True)
    print_notes(writer)
