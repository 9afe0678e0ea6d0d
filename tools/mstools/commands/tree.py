"""`modelserver tree`: the kinematic tree, drawn in the terminal or as an image."""

from __future__ import annotations

import html
import json
import math
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import typer

from modelserver.errors import NoServerError
from modelserver.geometry import names
from modelserver.geometry.joint import Joint, coordinate_names
from modelserver.geometry.model import Model
from modelserver.geometry.parts import Constraint
from modelserver.geometry.topology import Crossing, LoopClosure, Topology, compute_misclosure
from mstools.report.charts import BLUE, ORANGE
from mstools.terminal.options import PrefixOption, UrlOption, Variables, argument, option, parse_variables
from mstools.terminal.output import (
    check_writable,
    describe_size,
    escape,
    format_count,
    load_given_model,
    replace_unencodable,
    write_file,
)

if TYPE_CHECKING:
    from modelserver.client.mirror_state import MirrorState

TIMEOUT_S = 11.0
"""Timeout for MODEL_SNAPSHOT, seconds; it is published every 5 s by default."""

LISTENING_S = 2.0
"""Seconds for which POSE and JOINTS are counted: enough for the rate of a joint that is published once a second."""


def command(
    file: Annotated[str, argument("FILE", "A geometry file or a vehicle file.")] = "",
    live: Annotated[bool, option("--live", "Draw the running daemon's geometry instead of a file's.")] = False,
    frames: Annotated[bool, option("--frames", "Draw the frames of each body too.")] = False,
    as_json: Annotated[bool, option("--json", "Print the frames of each body as JSON, root first.")] = False,
    svg: Annotated[str, option("--svg OUT", "Write an SVG image instead; - for stdout.")] = "",
    force: Annotated[bool, option("--force", "Replace OUT where it exists.")] = False,
    variables: Variables = None,
    url: UrlOption = "",
    prefix: PrefixOption = "",
    wait: Annotated[float, option("--wait SECONDS", "Timeout for the daemon.", min=0.01, max=7200.0)] = TIMEOUT_S,
) -> None:
    """Draw the kinematic tree: constraints with their joints and limits, loop closures, orphans.

    The parent of each body is on its shortest path from the root; `from here` marks a constraint that points to the
    parent. --live draws the geometry of the daemon, which publishes it every few seconds, with the rates and ages of
    the pose and of each joint, and the source that publishes it.

    \b
    Examples:
      modelserver tree config/raptor/geometry.yaml --frames
      modelserver tree --live --json
    """
    if live == bool(file):
        raise typer.BadParameter("give a FILE, or --live for the running daemon", param_hint="FILE")
    if as_json and svg:
        raise typer.BadParameter("excludes --svg", param_hint="--json")
    check_writable(svg, force)
    model, notes = (
        receive_geometry(url, prefix, wait, 0.0 if as_json or svg else LISTENING_S)
        if live
        else (load_geometry(file, parse_variables(variables)), {})
    )
    if as_json:
        typer.echo(json.dumps({body.name: [frame.full_name for frame in body.frames] for body in model.bodies}))
        return
    title = f"{model.name or 'unnamed'}: {describe_size(model)}, revision {model.revision}{notes.get('', '')}"
    assemblies = build_nodes(model)
    if not svg:
        typer.echo(replace_unencodable("\n".join((escape(title), *draw_lines(assemblies, frames, notes)))))
        return
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


def receive_geometry(url: str, prefix: str, seconds: float, listening: float) -> tuple[Model, dict[str, str]]:
    """Return the geometry that a daemon publishes, and a note for each constraint with a joint; "": for the pose.

    The notes are rate, age and source in the `listening` seconds. Raises NoServerError after a timeout.
    """
    from modelserver.client.mirror import PlatformMirror

    with PlatformMirror(url, channel_prefix=prefix) as mirror:
        if mirror.wait_for(lambda: mirror.read_state()[0].snapshot is not None, seconds):
            if listening:
                mirror.wait_for(lambda: False, listening)
            state, now = mirror.read_state()
            assert state.snapshot is not None
            return state.snapshot.model, describe_rates(state, now) if listening else {}
        raise NoServerError(
            f"no geometry received on {prefix}MODEL_SNAPSHOT at {mirror.url} within {seconds:g} s. Is the daemon "
            "running (modelserver run -c vehicle.yaml), on this bus ($LCM_DEFAULT_URL) and with this --prefix? Its "
            "period is publish.snapshot_s in the vehicle file: use a longer --wait"
        )


def describe_rates(state: MirrorState, now: int) -> dict[str, str]:
    """Return rate, age and source of each joint, by its constraint, and of the pose, by an empty name."""
    assert state.snapshot is not None
    service_now, history = state.get_service_time(now), state.history
    notes = {"": "; no POSE"}
    if len(history):
        notes[""] = f"; POSE {_describe_rate(len(history), history.first, history.last, service_now)}"
    for name, constraint in state.snapshot.model.joints.items():
        tracks = state.joints.tracks
        found = [tracks[each] for each in coordinate_names(name, constraint.joint) if each in tracks]
        if constraint.joint.mimic is None:
            notes[name] = ", at its default: no reading"
        if found:
            track = max(found, key=lambda each: each.last)
            rate = _describe_rate(len(track), track.first, track.last, service_now)
            notes[name] = f", {rate} by {track.source or 'unknown'}"
    return notes


def _describe_rate(count: int, first: int, last: int, now: int) -> str:
    rate = f"{(count - 1) * 1e6 / (last - first):.1f} Hz, " if last > first else ""
    return f"{rate}{max(now - last, 0) * 1e-6:.2f} s ago"


@dataclass(frozen=True, slots=True)
class BodyNode:
    """A body in the drawing, with the constraint to its parent and the constraints that close loops at it.

    `is_last`: for each level from the second on, whether the branch there is the last one of its parent.
    """

    body: str
    is_last: tuple[bool, ...]
    crossing: Crossing | None
    frames: tuple[str, ...]
    loops: tuple[str, ...]
    parent: int = -1
    """Index of the parent, -1 for none."""
    has_children: bool = False


def build_nodes(model: Model) -> list[list[BodyNode]]:
    """Return the bodies of each assembly in drawing order; the root's assembly comes first."""
    topology = Topology(model.bodies, model.constraints)
    loops: dict[str, list[str]] = {}
    for each in topology.find_loop_closures():
        loops.setdefault(names.split(each.path[0].near_frame)[0], []).append(_describe_loop(each, model))
    return [_build_assembly(model, topology, assembly[0], loops) for assembly in topology.assemblies]


def _build_assembly(model: Model, topology: Topology, root: str, loops: dict[str, list[str]]) -> list[BodyNode]:
    below: dict[str, list[Crossing]] = {}
    for onward in topology.traverse_breadth_first(root):
        below.setdefault(onward.near_body, []).append(onward)
    drawn: list[BodyNode] = []
    # no recursion: a chain may be longer than Python's stack
    waiting: list[tuple[str, tuple[bool, ...], Crossing | None, int]] = [(root, (), None, -1)]
    while waiting:
        body, last, crossing, parent = waiting.pop()
        children = below.get(body, [])
        frames, closures = tuple(model.get_body_frame_list(body)), tuple(loops.get(body, ()))
        waiting += [
            (names.split(each.far_frame)[0], (*last, each is children[-1]), each, len(drawn))
            for each in reversed(children)
        ]
        drawn.append(BodyNode(body, last, crossing, frames, closures, parent, bool(children)))
    return drawn


def _describe_loop(closing: LoopClosure, model: Model) -> str:
    crossing = closing.path[0]
    found = compute_misclosure(closing.path, model.frame)
    words = f"loop: {crossing.constraint.name} ({describe_joint(crossing.constraint)}) to {crossing.far_frame}, "
    if found.is_exact:
        return words + "closes exactly"
    words += f"misses by {found.meters * 1e3:.3g} mm and {math.degrees(found.radians):.3g} deg"
    if found.sigmas is not None:
        words += f", {found.sigmas:.1f} sigma"
    return words + (" with joints at their defaults" if found.joints else "")


def describe_joint(constraint: Constraint) -> str:
    joint = constraint.joint
    if not joint.is_movable:
        return "fixed"
    words = [str(joint.type)]
    if joint.mimic is not None:
        shift = f" {_format_number(joint.mimic.offset, joint, 0, signed=True)}" if joint.mimic.offset else ""
        words.append(f"follows {joint.mimic.joint} times {joint.mimic.multiplier:g}{shift}")
    limits = list(_describe_limits(constraint.name, joint))
    return ", ".join(words + limits)


def _describe_limits(name: str, joint: Joint) -> Iterator[str]:
    for number, coordinate in enumerate(coordinate_names(name, joint)):
        low = joint.lower[number] if joint.lower else -math.inf
        high = joint.upper[number] if joint.upper else math.inf
        rate = joint.rate_limit[number] if joint.rate_limit else math.inf
        which = f"{coordinate.rpartition('.')[2]} " if joint.count > 1 else ""
        if math.isfinite(low) and math.isfinite(high):
            yield f"{which}{_format_number(low, joint, number, unit=False)} to {_format_number(high, joint, number)}"
        elif math.isfinite(low):
            yield f"{which}from {_format_number(low, joint, number)}"
        elif math.isfinite(high):
            yield f"{which}up to {_format_number(high, joint, number)}"
        if math.isfinite(rate):
            yield f"{which}{_format_number(rate, joint, number)}/s at most"


def _format_number(value: float, joint: Joint, number: int, signed: bool = False, unit: bool = True) -> str:
    angle = joint.angle_flags[number]
    shown = round(math.degrees(value), 9) if angle else value
    text = f"{shown:+.6g}" if signed else f"{shown:.6g}"
    return text + ((" deg" if angle else " m") if unit else "")


def describe_crossing(crossing: Crossing, note: str = "") -> str:
    direction = "" if crossing.forward else ", from here"
    return f"{crossing.constraint.name}: {describe_joint(crossing.constraint)}{note}{direction}"


ROW, STEP, MARGIN, GAP = 24, 26, 16, 14
"""Pixels: row height, indentation of a level, margin, and space between assemblies."""

LETTER_WIDTH = 7.2
"""Largest width of a letter, pixels: the image's width depends on it."""

LINE_LENGTH = 100
"""Letters in a line of frames."""

FIXED, MOVING, LOOP = "#666666", BLUE, ORANGE


def draw_svg(title: str, assemblies: Sequence[Sequence[BodyNode]], with_frames: bool = False) -> str:
    """Draw the tree as SVG: movable joints in blue, loops dashed in orange, orphans below the rest."""
    parts: list[str] = []
    y, width = MARGIN + ROW, MARGIN * 2 + LETTER_WIDTH * len(title) * 1.2
    for number, assembly in enumerate(assemblies):
        if number:
            y += GAP
        places: list[int] = []
        for node in assembly:
            x = MARGIN + STEP * len(node.is_last)
            places.append(y)
            color, words = FIXED, "orphan" if number else "root"
            if node.crossing is not None:
                color = MOVING if node.crossing.constraint.joint.is_movable else FIXED
                words = describe_crossing(node.crossing)
                branch = f"M{x - STEP + 6} {places[node.parent] + 6}V{y}H{x - 4}"
                parts.append(f'<path d="{branch}" fill="none" stroke="{color}" stroke-width="1.4"/>')
            ring, dashed = (LOOP, ' stroke-dasharray="3 2"') if node.loops else (color, "")
            parts.append(
                f'<circle cx="{x + 6}" cy="{y}" r="5" fill="#fff" stroke="{ring}" stroke-width="1.8"{dashed}/>'
                f'<text x="{x + 18}" y="{y + 4}"><tspan font-weight="bold">{html.escape(node.body)}</tspan>'
                f'<tspan dx="10" fill="{color}">{html.escape(words)}</tspan></text>'
            )
            width = max(width, x + LETTER_WIDTH * (len(node.body) + len(words) + 4) + MARGIN)
            lines = [(each, LOOP) for each in node.loops]
            if with_frames:
                frames = textwrap.wrap(", ".join(node.frames), LINE_LENGTH, break_long_words=False)
                lines += [(each, FIXED) for each in frames]
            for words, color in lines:
                y += ROW
                text = f'<text x="{x + 18}" y="{y + 4}" fill="{color}" font-style="italic">'
                parts.append(f"{text}{html.escape(words)}</text>")
                width = max(width, x + 18 + LETTER_WIDTH * len(words) + MARGIN)
            y += ROW
    height = y + MARGIN - ROW // 2
    name = html.escape(title)
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:.0f}" height="{height}" '
        f'viewBox="0 0 {width:.0f} {height}" role="img" aria-label="{name}" font-family="sans-serif" font-size="12">',
        '<rect width="100%" height="100%" fill="#fff"/>',
        f'<text x="{MARGIN}" y="{MARGIN + 4}" font-size="14" font-weight="bold">{name}</text>',
    )
    return "\n".join((*head, *parts, "</svg>", ""))


def draw_lines(
    assemblies: Sequence[Sequence[BodyNode]], with_frames: bool = False, notes: Mapping[str, str] | None = None
) -> Iterator[str]:
    """Yield the lines of the drawing, with notes of constraints by name; unconnected assemblies come last."""
    for number, assembly in enumerate(assemblies):
        if number == 1:
            yield ""
            yield f"{format_count(len(assemblies) - 1, 'orphan')}, not connected to the root:"
        for node in assembly:
            levels = ["   " if last else "│  " for last in node.is_last]
            elbows = ["└─ " if last else "├─ " for last in node.is_last[-1:]]
            label = ""
            if node.crossing is not None:
                note = (notes or {}).get(node.crossing.constraint.name, "")
                label = f"  ({describe_crossing(node.crossing, note)})"
            yield "".join((*levels[:-1], *elbows, escape(node.body), escape(label)))
            inside = "".join((*levels, "│  " if node.has_children else "   "))
            yield from (f"{inside}⟲ {escape(each)}" for each in node.loops)
            if with_frames:
                yield from (f"{inside}· {escape(frame)}" for frame in node.frames)
