"""Long computations in steps: a generator that yields between steps and returns the result.

The server runs a step of about half a millisecond between its ticks; other callers complete the work at once.
"""

from __future__ import annotations

from collections.abc import Generator
from typing import TypeAlias, TypeVar

T = TypeVar("T")

Steps: TypeAlias = Generator[None, None, T]


def complete(work: Steps[T]) -> T:
    """Run all steps and return the result. Raises what the steps raise."""
    while True:
        try:
            next(work)
        except StopIteration as end:
            result: T = end.value
            return result
