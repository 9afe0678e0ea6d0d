"""`modelserver view`: a geometry file, a log, or the running service in the browser."""

from __future__ import annotations

import math
import os
import sys
import time
import webbrowser
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from modelserver.files import EXAMINED_BYTES, FileKind, detect_file_kind, read_start
from mstools.terminal.options import (
    KeyOption,
    PrefixOption,
    TimeoutOption,
    UrlOption,
    Variables,
    argument,
    option,
    parse_variables,
)
from mstools.terminal.output import catch_signals, check_writable, escape, require_extra

if TYPE_CHECKING:
    from mstools.view.background import Background
    from mstools.view.editor import Editing
    from mstools.view.sources import Source

LOOPBACK = "127.0.0.1"
DEFAULT_PORT = 8080
SHOWN_NOTES = 5


def command(
    file: Annotated[
        Path | None, argument("[FILE]", "A geometry file, vehicle file, LCM log, journal, ROS bag, or MCAP file.")
    ] = None,
    live: Annotated[bool, option("--live", "Follow the running service.")] = False,
    model: Annotated[Path | None, option("--model FILE", "Geometry for a log, in place of its own.")] = None,
    config: Annotated[
        Path | None, option("--config -c FILE", "Vehicle file: run the localization on a log that has no poses.")
    ] = None,
    settings: Variables = None,
    package_path: Annotated[
        list[Path] | None,
        option(
            "--package-path FOLDER", "Find meshes here too, package://NAME in the folder NAME. Repeatable.", exists=True
        ),
    ] = None,
    ground: Annotated[
        Path | None,
        option("--map FILE", "Picture of the ground below the map: GeoTIFF, MBTiles, or a folder of tiles."),
    ] = None,
    bind: Annotated[
        str, option("--bind ADDRESS", "Serve the page at this address. Beyond loopback its link has a token.")
    ] = LOOPBACK,
    port: Annotated[
        int | None,
        option("--port N", f"Port of the page. Default: {DEFAULT_PORT}, else a free one.", min=0, max=65535),
    ] = None,
    edit: Annotated[bool, option("--edit", "Edit the geometry file too. Its link has a token.")] = False,
    no_browser: Annotated[bool, option("--no-browser", "Only print the link.")] = False,
    seconds: Annotated[float, option("--seconds N", "Stop after this time. Default: never.", min=0.1)] = math.inf,
    url: UrlOption = "",
    prefix: PrefixOption = "",
    timeout: TimeoutOption = 1.0,
    key: KeyOption = None,
) -> None:
    """Show a geometry file, a log, or with --live the running service in the browser.

    The page shows bodies, frames, constraints and joints in 3D, the vehicle in the world with trail, fixes and
    uncertainty, and answers where one frame is in another. A log has a slider, playback, and jumps to events. With
    --config the localization runs on a recording that has no poses, such as a bag; without, its fixes and rates are
    shown. With --edit it changes a geometry file (YAML), or that of a vehicle file, checks each change, and applies it
    when saved to the running service, signed with --key. It needs the extra view; without it, the error names the
    command that adds it. Nothing is loaded from the internet.

    \b
    Examples:
      modelserver view config/raptor/geometry.yaml
      modelserver view config/raptor/vehicle.yaml --edit --key reload.key
      modelserver view drive.lcm
      modelserver view drive.bag -c vehicle.yaml --map site.mbtiles
      modelserver view --live
    """
    if live == (file is not None):
        raise typer.BadParameter("give a file or --live", param_hint="FILE")
    if config is not None and (live or edit or model is not None):
        raise typer.BadParameter("goes with a log: it runs the localization on it", param_hint="--config")
    if ground is not None and edit:
        raise typer.BadParameter("goes with a log or --live, which have a map", param_hint="--map")
    if edit and live:
        raise typer.BadParameter("goes with a geometry or vehicle file: that of the service", param_hint="--edit")
    check_installed()
    from mstools.view.page import ViewError, open_page
    from mstools.view.viewer import Viewer

    background = open_map(ground)
    editing = open_editing(file, settings, url, prefix, key or "") if edit and file is not None else None
    with ExitStack() as stack:
        shown = file
        if file is not None and editing is None:
            from mstools.commands.replay import open_localized
            from mstools.recordings.bag_log import open_lcm_log

            shown = stack.enter_context(open_localized(stack.enter_context(open_lcm_log(file)), config))
        source = open_source(shown, model, settings, url, prefix, timeout, editing, package_path or ())
        stack.callback(source.close)
        if file is not None and shown != file:
            # a bag is shown by a log made of it
            source.title = file.name
        if ground is not None and not source.has_time:
            raise typer.BadParameter("goes with a log or --live, which have a map", param_hint="--map")
        try:
            page = open_page(bind, DEFAULT_PORT if port is None else port, with_token=edit)
        except ViewError:
            if port is not None:
                raise
            page = open_page(bind, 0, with_token=edit)
        stack.callback(page.close)
        viewer = Viewer(page, source, editing, background)
        typer.echo(escape(f"{source.title}: {page.link} (Ctrl-C ends it)"))
        sys.stdout.flush()
        if editing is not None and editing.session.file.is_new:
            typer.echo(escape(f"modelserver: {file} does not exist yet; the button Save writes it"), err=True)
        if editing is not None and editing.session.has_errors:
            typer.echo(escape(f"modelserver: {source.title}: has errors, listed in the tab Edit"), err=True)
        for each in source.notes[:SHOWN_NOTES]:
            typer.echo(escape(f"modelserver: {source.title}: {each}"), err=True)
        if not no_browser and bind == LOOPBACK and has_screen():
            webbrowser.open(page.link)
        end = time.monotonic() + seconds
        with catch_signals() as stop:
            viewer.run(lambda: stop.is_set() or time.monotonic() >= end)


def has_screen() -> bool:
    """Return whether a browser can have a window; one of the terminal would take it, and cannot draw the page."""
    return sys.platform != "linux" or any(os.environ.get(each) for each in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER"))


def check_installed() -> None:
    require_extra("view", "the viewer needs viser")


def open_map(path: Path | None) -> Background | None:
    """Open a picture of the ground. Raises MapError."""
    if path is None:
        return None
    require_extra("map", "pictures of the ground need rasterio")
    from mstools.view.background import open_background

    return open_background(path)


def open_editing(file: Path, settings: list[str] | None, url: str, prefix: str, key: str | Path) -> Editing:
    """Begin to edit a geometry file, or that of a vehicle file. Raises typer.BadParameter, EditError, OSError.

    A YAML file that is not there is a new geometry file. Bus and prefix are those given, else of the vehicle file.
    """
    from mstools.edit import EditedFile, EditSession
    from mstools.view.editor import Editing

    is_new = file.suffix.lower() in (".yaml", ".yml") and not os.path.lexists(file)
    if not is_new and detect_file_kind(read_start(file, EXAMINED_BYTES)) is FileKind.LOG:
        raise typer.BadParameter("goes with a geometry or vehicle file, not with a log", param_hint="--edit")
    edited = EditedFile(file, is_new=True) if is_new else EditedFile.open(file)
    check_writable(str(edited.path))
    if edited.config is not None:
        url, prefix = url or edited.config.lcm.url, prefix or edited.config.lcm.channel_prefix
    return Editing(EditSession(edited, parse_variables(settings)), url, prefix, key=str(key))


def open_source(
    file: Path | None,
    model: Path | None,
    settings: list[str] | None,
    url: str,
    prefix: str,
    timeout: float,
    editing: Editing | None = None,
    packages: Sequence[Path] = (),
) -> Source:
    """Open what is to be shown, or edited. Raises GeometryError, ConfigError, RecordingError, OSError."""
    from mstools.view.sources import open_geometry, open_live, open_log

    if file is None:
        return open_live(url, prefix, timeout, packages)
    kind = detect_file_kind(read_start(file, EXAMINED_BYTES)) if editing is None else FileKind.GEOMETRY
    if kind is FileKind.LOG:
        return open_log(file, prefix, model, packages)
    if model is not None:
        raise typer.BadParameter(f"goes with a log, but {file} is none: {kind.value}", param_hint="--model")
    session = None if editing is None else editing.session
    return open_geometry(file, parse_variables(settings), session, packages)
