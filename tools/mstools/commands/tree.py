"""`modelserver tree`: how bodies hang together, drawn in the terminal or as an image."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Annotated

import typer

from modelserver.errors import NoServerError
from modelserver.geometry.model import Model
from modelserver.wire.provider import open_lcm, resolve_url, take_message
from mstools.commands.asking import PrefixOption, UrlOption
from mstools.terminal.graph import BodyNode, crossing_words, nodes
from mstools.terminal.options import Variables, parse_variables
from mstools.terminal.output import check_target, counted, print_problem, safe, size_of, write_file
from mstools.terminal.table import drawable

if TYPE_CHECKING:
    from modelserver.formats.snapshot import ModelSnapshot

PATIENCE_S = 11.0
"""How long MODEL_SNAPSHOT is waited for, seconds: it comes every 5 s unless the vehicle file says otherwise."""


def command(
    file: Annotated[str, typer.Argument(metavar="FILE", help="A geometry file or a vehicle file.")] = "",
    live: Annotated[
        bool, typer.Option("--live", help="Draw the running daemon's geometry instead of a file's.")
    ] = False,
    frames: Annotated[bool, typer.Option("--frames", help="Draw the frames of each body too.")] = False,
    svg: Annotated[str, typer.Option("--svg", metavar="OUT", help="Write an SVG image instead; - for stdout.")] = "",
    force: Annotated[bool, typer.Option("--force", help="Replace OUT where it exists.")] = False,
    variables: Variables = None,
    url: UrlOption = "",
    prefix: PrefixOption = "",
    wait: Annotated[
        float,
        typer.Option("--wait", metavar="SECONDS", min=0.01, max=7200.0, help="How long to wait for the daemon."),
    ] = PATIENCE_S,
) -> None:
    """Draw how bodies hang together: constraints with their joints and limits, what closes loops, orphans.

    Each body hangs on the one by which the shortest way from the root comes to it; `from here` marks a constraint that
    leads up. With --live the daemon's own geometry is drawn, which it broadcasts every few seconds.

    Example: modelserver tree config/raptor/geometry.yaml
    """
    if live == bool(file):
        raise typer.BadParameter("give a FILE, or --live for the running daemon", param_hint="FILE")
    check_target(svg)
    model = heard(url, prefix, wait).model if live else read(file, parse_variables(variables))
    title = f"{model.name or 'unnamed'}: {size_of(model)}, revision {model.revision}"
    assemblies = nodes(model)
    if not svg:
        typer.echo(drawable("\n".join((safe(title), *lines(assemblies, frames)))))
        return
    from mstools.terminal.tree_svg import drawing

    image = drawing(title, assemblies, frames)
    if svg == "-":
        typer.echo(image, nl=False)
    else:
        write_file(svg, image, force)


def read(file: str, variables: dict[str, str]) -> Model:
    """Return the model of a geometry file, or of that which a vehicle file names; problems are printed.

    Raises GeometryError, ConfigError, OSError.
    """
    from modelserver.formats import load_model
    from mstools.commands.check import is_vehicle_file

    if is_vehicle_file(file):
        from modelserver.config import load_config

        config = load_config(file)
        model = load_model(config.geometry, variables={**config.variables, **variables})
    else:
        model = load_model(file, variables=variables)
    for problem in model.problems:
        print_problem(problem, err=True)
    return model


def heard(url: str, prefix: str, seconds: float) -> ModelSnapshot:
    """Return the geometry that a daemon broadcasts. Raises NoServerError where none comes in time."""
    from modelserver.errors import WireError
    from modelserver.formats.snapshot import read as read_snapshot
    from modelserver.wire.channels import literal
    from modelserver.wire.codec import decode
    from modelserver.wire.snapshot import SnapshotAssembler

    provider = resolve_url(url)
    bus, assembler, whole = open_lcm(provider), SnapshotAssembler(), []

    def take(_: str, data: bytes) -> None:
        try:
            content = assembler.add(decode("model_snapshot_t", data))
            if content is not None:
                whole.append(read_snapshot(content))
        except WireError:
            # of a stranger, or of another version: the next may be good
            pass

    channel = f"{prefix}MODEL_SNAPSHOT"
    bus.subscribe(literal(channel), take).set_queue_capacity(0)
    deadline = time.monotonic() + seconds
    while not whole:
        left = deadline - time.monotonic()
        if left <= 0.0:
            raise NoServerError(
                f"no geometry came on {channel} at {provider} within {seconds:g} s. Is the daemon running "
                "(modelserver run -c vehicle.yaml), on this bus ($LCM_DEFAULT_URL) and with this --prefix? Its vehicle "
                "file says how often it tells (publish.snapshot_s): --wait longer than that"
            )
        take_message(bus, int(left * 1e3) + 1)
    return whole[0]


def lines(assemblies: Sequence[Sequence[BodyNode]], with_frames: bool = False) -> Iterator[str]:
    """Yield the drawing line by line; assemblies that nothing joins to the root's come below it."""
    for number, assembly in enumerate(assemblies):
        if number == 1:
            yield ""
            yield f"{counted(len(assemblies) - 1, 'orphan')}, which no constraint joins to the root:"
        for node in assembly:
            yield from _node(node, with_frames)


def _node(node: BodyNode, with_frames: bool) -> Iterator[str]:
    trunk = "".join("   " if last else "│  " for last in node.last[:-1])
    elbow = ("└─ " if node.last[-1] else "├─ ") if node.last else ""
    told = f"  ({crossing_words(node.crossing)})" if node.crossing is not None else ""
    yield f"{trunk}{elbow}{safe(node.body)}{safe(told)}"
    inside = trunk + (("   " if node.last[-1] else "│  ") if node.last else "")
    inside += "│  " if node.branches else "   "
    for each in node.loops:
        yield f"{inside}⟲ {safe(each)}"
    if with_frames:
        for frame in node.frames:
            yield f"{inside}· {safe(frame)}"
