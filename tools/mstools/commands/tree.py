"""`modelserver tree`: the kinematic tree, drawn in the terminal or as an image."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Annotated, Any

import typer

from modelserver.errors import NoServerError
from modelserver.geometry.model import Model
from mstools.commands.pose_source import load_given_model
from mstools.terminal.model_tree import BodyNode, build_nodes, describe_crossing
from mstools.terminal.options import PrefixOption, UrlOption, Variables, argument, option, parse_variables
from mstools.terminal.output import check_writable, describe_size, escape, format_count, replace_unencodable, write_file

if TYPE_CHECKING:
    from modelserver.formats.snapshot import ModelSnapshot

TIMEOUT_S = 11.0
"""Timeout for MODEL_SNAPSHOT, seconds; it is published every 5 s by default."""


def command(
    file: Annotated[str, argument("FILE", "A geometry file or a vehicle file.")] = "",
    live: Annotated[bool, option("--live", "Draw the running daemon's geometry instead of a file's.")] = False,
    frames: Annotated[bool, option("--frames", "Draw the frames of each body too.")] = False,
    svg: Annotated[str, option("--svg OUT", "Write an SVG image instead; - for stdout.")] = "",
    force: Annotated[bool, option("--force", "Replace OUT where it exists.")] = False,
    variables: Variables = None,
    url: UrlOption = "",
    prefix: PrefixOption = "",
    wait: Annotated[float, option("--wait SECONDS", "Timeout for the daemon.", min=0.01, max=7200.0)] = TIMEOUT_S,
) -> None:
    """Draw the kinematic tree: constraints with their joints and limits, loop closures, orphans.

    The parent of each body is on its shortest path from the root; `from here` marks a constraint that points to the
    parent. --live draws the geometry of the daemon, which publishes it every few seconds.

    Example: modelserver tree config/raptor/geometry.yaml
    """
    if live == bool(file):
        raise typer.BadParameter("give a FILE, or --live for the running daemon", param_hint="FILE")
    check_writable(svg)
    model = receive_geometry(url, prefix, wait).model if live else load_geometry(file, parse_variables(variables))
    title = f"{model.name or 'unnamed'}: {describe_size(model)}, revision {model.revision}"
    assemblies = build_nodes(model)
    if not svg:
        typer.echo(replace_unencodable("\n".join((escape(title), *draw_lines(assemblies, frames)))))
        return
    from mstools.terminal.model_tree import draw_svg

    write_file(svg, draw_svg(title, assemblies, frames), force)


def load_geometry(file: str, variables: dict[str, str]) -> Model:
    """Load a geometry file, or that of a vehicle file, and print its problems.

    Raises GeometryError, ConfigError, OSError.
    """
    from mstools.commands.check import is_vehicle_file

    if is_vehicle_file(file):
        from modelserver.config.vehicle_file import load_config

        config = load_config(file)
        file, variables = config.geometry, {**config.variables, **variables}
    return load_given_model(file, variables)


def receive_geometry(url: str, prefix: str, seconds: float) -> ModelSnapshot:
    """Return the geometry that a daemon publishes. Raises NoServerError after a timeout."""
    from modelserver.formats.snapshot import decode_snapshot
    from modelserver.wire.provider import open_lcm, resolve_url
    from modelserver.wire.snapshot import SnapshotAssembler
    from mstools.commands.listener import DaemonListener

    provider = resolve_url(url)
    assembler, whole = SnapshotAssembler(), []

    def add(chunk: Any) -> None:
        if (content := assembler.add(chunk)) is not None:
            whole.append(decode_snapshot(content))

    listener = DaemonListener(open_lcm(provider), prefix, {"MODEL_SNAPSHOT": add})
    listener.subscriptions[0].set_queue_capacity(0)
    if not listener.listen(seconds, lambda: bool(whole)):
        raise NoServerError(
            f"no geometry received on {prefix}MODEL_SNAPSHOT at {provider} within {seconds:g} s. Is the daemon running "
            "(modelserver run -c vehicle.yaml), on this bus ($LCM_DEFAULT_URL) and with this --prefix? Its period is "
            "publish.snapshot_s in the vehicle file: use a longer --wait"
        )
    return whole[0]


def draw_lines(assemblies: Sequence[Sequence[BodyNode]], with_frames: bool = False) -> Iterator[str]:
    """Yield the lines of the drawing; unconnected assemblies come last."""
    for number, assembly in enumerate(assemblies):
        if number == 1:
            yield ""
            yield f"{format_count(len(assemblies) - 1, 'orphan')}, not connected to the root:"
        for node in assembly:
            yield from _draw_node(node, with_frames)


def _draw_node(node: BodyNode, with_frames: bool) -> Iterator[str]:
    trunk = "".join("   " if last else "│  " for last in node.is_last[:-1])
    elbow = ("└─ " if node.is_last[-1] else "├─ ") if node.is_last else ""
    label = f"  ({describe_crossing(node.crossing)})" if node.crossing is not None else ""
    yield f"{trunk}{elbow}{escape(node.body)}{escape(label)}"
    inside = trunk + (("   " if node.is_last[-1] else "│  ") if node.is_last else "")
    inside += "│  " if node.has_children else "   "
    for each in node.loops:
        yield f"{inside}⟲ {escape(each)}"
    if with_frames:
        for frame in node.frames:
            yield f"{inside}· {escape(frame)}"
