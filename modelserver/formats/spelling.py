"""Names as problems show them, and what a misspelt key may have meant."""

from __future__ import annotations

from functools import lru_cache

from modelserver.errors import Suggested, shown, suggest_key


def label(name: str) -> str:
    """Return a name fit for the place of a problem: as it is, or escaped, quoted and cut where it is not fit."""
    return name if name.isprintable() and 0 < len(name) <= 80 else shown(name)


@lru_cache(maxsize=1024)
def nearest_keys(name: str, known: tuple[str, ...]) -> Suggested:
    """Return the key that `name` misspells; a file tends to misspell one the same way a thousand times."""
    return suggest_key(name, known)
