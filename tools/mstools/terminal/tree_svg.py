"""The graph of a model as one SVG image: a row a body, so that it reads however many there are."""

from __future__ import annotations

import html
import textwrap
from collections.abc import Sequence

from mstools.report.svg import COLOURS
from mstools.terminal.graph import BodyNode, crossing_words

ROW, STEP, MARGIN, GAP = 24, 26, 16, 14
"""Pixels: between rows, to the right for each level, around, and between assemblies."""

LETTER = 7.2
"""Pixels that a letter takes at most, for how wide the image is."""

LINE = 100
"""Letters in a line of frames."""

FIXED, MOVING, LOOP = COLOURS[3], COLOURS[0], COLOURS[1]


def drawing(title: str, assemblies: Sequence[Sequence[BodyNode]], with_frames: bool = False) -> str:
    """Return the image. Joints that move are drawn in blue, loops dashed in orange, orphans below the rest."""
    parts: list[str] = []
    y, width = MARGIN + ROW, MARGIN * 2 + LETTER * len(title) * 1.2
    for number, assembly in enumerate(assemblies):
        if number:
            y += GAP
        places: list[int] = []
        for node in assembly:
            x = MARGIN + STEP * node.depth
            places.append(y)
            if node.crossing is not None:
                parts.append(_branch(x - STEP + 6, places[node.parent], x, y, _colour(node)))
            words = crossing_words(node.crossing) if node.crossing is not None else "root" if not number else "orphan"
            lines = [(words, _colour(node)), *((each, LOOP) for each in node.loops)]
            if with_frames:
                lines += [(each, FIXED) for each in textwrap.wrap(", ".join(node.frames), LINE, break_long_words=False)]
            parts.append(_body(x, y, node, lines[0]))
            width = max(width, x + LETTER * (len(node.body) + len(words) + 4) + MARGIN)
            for words, colour in lines[1:]:
                y += ROW
                parts.append(_text(x + 18, y, words, colour, "italic"))
                width = max(width, x + 18 + LETTER * len(words) + MARGIN)
            y += ROW
    height = y + MARGIN - ROW // 2
    name = html.escape(title)
    return "\n".join(
        (
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:.0f}" height="{height}" '
            f'viewBox="0 0 {width:.0f} {height}" role="img" aria-label="{name}" font-family="sans-serif" '
            'font-size="12">',
            '<rect width="100%" height="100%" fill="#fff"/>',
            f'<text x="{MARGIN}" y="{MARGIN + 4}" font-size="14" font-weight="bold">{name}</text>',
            *parts,
            "</svg>",
            "",
        )
    )


def _colour(node: BodyNode) -> str:
    return MOVING if node.crossing is not None and node.crossing.constraint.joint.moves else FIXED


def _branch(x1: int, y1: int, x2: int, y2: int, colour: str) -> str:
    return f'<path d="M{x1} {y1 + 6}V{y2}H{x2 - 4}" fill="none" stroke="{colour}" stroke-width="1.4"/>'


def _body(x: int, y: int, node: BodyNode, told: tuple[str, str]) -> str:
    words, colour = told
    dashed = ' stroke-dasharray="3 2"' if node.loops else ""
    ring = LOOP if node.loops else colour
    return (
        f'<circle cx="{x + 6}" cy="{y}" r="5" fill="#fff" stroke="{ring}" stroke-width="1.8"{dashed}/>'
        f'<text x="{x + 18}" y="{y + 4}"><tspan font-weight="bold">{html.escape(node.body)}</tspan>'
        f'<tspan dx="10" fill="{colour}">{html.escape(words)}</tspan></text>'
    )


def _text(x: int, y: int, words: str, colour: str, style: str) -> str:
    return f'<text x="{x}" y="{y + 4}" fill="{colour}" font-style="{style}">{html.escape(words)}</text>'
