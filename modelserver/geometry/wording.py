"""What the messages about a model have in common."""

from __future__ import annotations

from collections.abc import Sequence

from modelserver.errors import Location

LISTED = 12
"""Names that a message lists at most."""


def first_at(place: Location) -> str:
    """Return where the first of two stands, for a message about the second."""
    return f" (first at {place})" if str(place) else ""


def few(several: Sequence[str]) -> str:
    """Return the first of several names: a file of 10,000 frames must not make a message of 10,000 names."""
    return ", ".join(several[:LISTED]) + (f", ... ({len(several)} in all)" if len(several) > LISTED else "")
