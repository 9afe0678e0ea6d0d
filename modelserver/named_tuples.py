"""A faster way to make a NamedTuple, for values that are replaced with every sample, tick or query.

The constructor of a NamedTuple is a Python function that only passes its arguments on to `tuple.__new__`: calling that
takes a third to a half of the time. It checks nothing: all fields are given, in their order. Elsewhere the constructor
is the one to call.
"""

from __future__ import annotations

from typing import Final

new_tuple: Final = tuple.__new__
"""`new_tuple(Point, (x, y))` is `Point(x, y)`."""
