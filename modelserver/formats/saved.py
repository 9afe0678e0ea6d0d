"""What writing a model in a form gives."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Saved:
    """The text of a file, and what of the model it does not hold, each as a phrase for a person."""

    text: str
    losses: tuple[str, ...] = ()


def plain(value: float) -> str:
    """Return the shortest text that reads back as the same float, without a trailing `.0`."""
    text = repr(value)
    return text[:-2] if text.endswith(".0") else text


def some(names: list[str], limit: int = 5) -> str:
    """Return the names as one phrase, cut where they are many."""
    rest = len(names) - limit
    return ", ".join(names[:limit]) + (f" and {rest} more" if rest > 0 else "")
