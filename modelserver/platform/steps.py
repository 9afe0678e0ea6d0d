"""Long work in steps: a generator that yields between steps and returns the result.

A service works such an answer out between its ticks, a step of about half a millisecond at a time; everyone else
completes it at once.
"""

from __future__ import annotations

from collections.abc import Generator
from typing import TypeAlias, TypeVar

T = TypeVar("T")

Steps: TypeAlias = Generator[None, None, T]


def complete(work: Steps[T]) -> T:
    """Do all steps and return the result. Raises what the work raises."""
    while True:
        try:
            next(work)
        except StopIteration as end:
            result: T = end.value
            return result
