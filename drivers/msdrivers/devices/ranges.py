"""Ranges of the numbers in the settings of devices."""

from __future__ import annotations


def check_ranges(settings: object, **ranges: tuple[float, float]) -> None:
    """Raise ValueError for the first attribute that is outside its range."""
    for key, (low, high) in ranges.items():
        value: float = getattr(settings, key)
        if not low <= value <= high:
            raise ValueError(f"{key} is between {low:g} and {high:g}, got {value:g}")
