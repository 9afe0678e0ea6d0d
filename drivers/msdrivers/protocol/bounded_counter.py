"""A counter of bounded size for names that come from the line."""

from __future__ import annotations

from collections import Counter
from typing import Final

MAX_NAMES: Final = 64
"""Largest number of names; further ones are counted as `other`."""

MAX_NAME_LENGTH: Final = 48
"""Longer names are truncated."""


class BoundedCounter(Counter[str]):
    """Counts by name; once `MAX_NAMES` are known, a new one is counted as `other` of its kind.

    The kind is the part before the first dot: `novatel.id 4711B` becomes `novatel.other`.
    """

    def add(self, name: str) -> None:
        """Count one more of `name`."""
        name = name[:MAX_NAME_LENGTH]
        if name not in self and len(self) >= MAX_NAMES:
            # one `other` for each kind; kinds are this program's own words
            name = f"{name.partition('.')[0]}.other"
        self[name] += 1
