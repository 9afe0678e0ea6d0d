"""Chains of names that lead back to themselves."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator


def circles(names: Iterable[str], up: Callable[[str], str | None]) -> Iterator[list[str]]:
    """Yield each circle that going `up` from names leads into, with its first name again at the end, cut where long."""
    settled: set[str] = set()
    for start in names:
        way: dict[str, None] = {}
        here: str | None = start
        while here is not None and here not in settled and here not in way:
            way[here] = None
            here = up(here)
        if here is not None and here in way:
            line = list(way)
            circle = line[line.index(here) :]
            yield [*(circle if len(circle) <= 8 else [*circle[:7], "..."]), here]
        settled.update(way)
