"""A counter whose names come from the line: however many there are, it stays small."""

from __future__ import annotations

from collections import Counter
from typing import Final

MOST_NAMES: Final = 64
"""Names that are counted one by one."""

LONGEST_NAME: Final = 48
"""Characters of a name; the rest is cut off."""


class BoundedCounter(Counter[str]):
    """Counts by name; once `MOST_NAMES` are known, a new one is counted as `other` of its kind.

    The kind is what stands before the first dot: `novatel.id 4711B` becomes `novatel.other`.
    """

    def add(self, name: str) -> None:
        """Count one more of `name`."""
        name = name[:LONGEST_NAME]
        if name not in self and len(self) >= MOST_NAMES:
            # one `other` for each kind; kinds are this program's own words
            name = f"{name.partition('.')[0]}.other"
        self[name] += 1
