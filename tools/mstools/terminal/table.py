"""Tables and line drawings for the terminal."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from mstools.terminal.output import safe

_PLAIN = str.maketrans({"→": ">", "├": "|", "└": "`", "─": "-", "│": "|", "·": ".", "⟲": "@"})


def table(head: Sequence[str], rows: Sequence[Sequence[str]], indent: str = "  ", numbers: Sequence[int] = ()) -> str:
    """Return rows in columns as wide as they need; those of `numbers` are set to the right."""
    lines = [[safe(cell) for cell in row] for row in (head, *rows)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join(
        indent
        + "  ".join(
            cell.rjust(width) if number in numbers else cell.ljust(width)
            for number, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )


def drawable(text: str, encoding: str | None = None) -> str:
    """Return `text` with its lines and arrows in ASCII where the terminal's encoding has none of its own."""
    try:
        text.encode(encoding or sys.stdout.encoding or "utf-8")
    except (UnicodeEncodeError, LookupError):
        return text.translate(_PLAIN).encode("ascii", "replace").decode()
    return text
